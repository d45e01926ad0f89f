"use strict";
// Tables that editors make are saved by the browser.
const downloadTable = (file, text) => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = file;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
};
// A text beside the pointer; none hides it.
const showTip = ({ clientX, clientY }, text) => {
  const tip = document.getElementById("tip");
  tip.hidden = !text;
  tip.textContent = text ?? "";
  tip.style.left = `${Math.min(clientX + 14, innerWidth - tip.offsetWidth - 8)}px`;
  tip.style.top = `${Math.min(clientY + 14, innerHeight - tip.offsetHeight - 8)}px`;
};
(() => {
  // Tables sort by a column: numbers by their exact value, texts as people count.
  const order = new Intl.Collator(undefined, { numeric: true }).compare;
  for (const table of document.querySelectorAll("table.sortable")) {
    const heads = [...table.tHead.rows[0].cells], body = table.tBodies[0];
    heads.forEach((head, k) => head.firstElementChild.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      for (const other of heads) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const key = (row) => {
        const { value } = row.cells[k].dataset;
        return value === undefined ? row.cells[k].textContent : value === "" ? null : Number(value);
      };
      const rows = [...body.rows].map((row) => [key(row), row]);
      rows.sort(([a], [b]) => {
        if (a === null || b === null) return (a === null) - (b === null); // empty ones last
        const d = typeof a === "number" && typeof b === "number" ? a - b : order(String(a), String(b));
        return down ? -d : d;
      });
      body.append(...rows.map(([, row]) => row));
    }));
  }

  // Points of charts tell what they stand for, and lead there.
  for (const charts of document.querySelectorAll(".charts")) {
    const { labels, links } = JSON.parse(charts.querySelector("script").textContent);
    for (const svg of charts.querySelectorAll("svg")) {
      const points = [...svg.querySelectorAll("[data-points]")].flatMap((path) => {
        const places = [...path.getAttribute("d").matchAll(/M([-\d.]+) ([-\d.]+)/g)];
        return path.dataset.points.split(" ").map((number, k) => [Number(places[k][1]), Number(places[k][2]), number]);
      });
      const pointed = (event) => {
        const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
        const far = ([x, y]) => Math.hypot(x - at.x, y - at.y);
        const nearest = points.reduce((a, b) => (far(b) < far(a) ? b : a));
        return far(nearest) < 7 ? nearest[2] : undefined;
      };
      svg.addEventListener("pointermove", (event) => {
        const number = pointed(event);
        svg.style.cursor = links[number] ? "pointer" : "";
        showTip(event, labels[number]);
      });
      svg.addEventListener("pointerleave", (event) => showTip(event, ""));
      svg.addEventListener("click", (event) => {
        const to = links[pointed(event)];
        if (to) location.assign(to);
      });
    }
  }

  // Printers get what is folded too.
  addEventListener("beforeprint", () => {
    for (const part of document.querySelectorAll("details:not([open])")) {
      part.open = true;
      part.dataset.folded = ""; // until it is printed
    }
  });
  addEventListener("afterprint", () => {
    for (const part of document.querySelectorAll("details[data-folded]")) {
      part.open = false;
      delete part.dataset.folded;
    }
  });

  // A crop that is chosen fills the window: wheel and drag zoom and move it.
  const dialog = document.getElementById("enlarged"), stage = dialog.querySelector("div");
  for (const button of document.querySelectorAll(".zoom")) {
    button.addEventListener("click", () => {
      const svg = button.querySelector("svg").cloneNode(true);
      stage.replaceChildren(svg);
      dialog.querySelector("p").textContent = [...button.parentElement.querySelector("figcaption").childNodes]
        .map((part) => part.textContent.split(" · ")[0].trim()).filter((text) => text).join("; ");
      dialog.showModal();
    });
  }
  stage.addEventListener("wheel", (event) => {
    event.preventDefault();
    const svg = stage.firstElementChild, box = svg.viewBox.baseVal;
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(svg.getScreenCTM().inverse());
    const scale = Math.exp(event.deltaY / 500);
    box.x = at.x + (box.x - at.x) * scale; box.y = at.y + (box.y - at.y) * scale;
    box.width *= scale; box.height *= scale;
  }, { passive: false });
  stage.addEventListener("pointermove", (event) => {
    if (!event.buttons) return;
    const svg = stage.firstElementChild, box = svg.viewBox.baseVal, scale = svg.getScreenCTM().a;
    box.x -= event.movementX / scale; box.y -= event.movementY / scale;
  });
  document.documentElement.dataset.ready = Math.round(performance.now());
})();
