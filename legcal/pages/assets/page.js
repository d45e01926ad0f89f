"use strict";
// Tables that editors make are saved by the browser.
const downloadTable = (file, text) => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" }));
  link.download = file;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
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

  // Plots are drawn when they come near the window, and all of them for the printer.
  const config = { displaylogo: false, responsive: true, displayModeBar: false };
  const waiting = new Map();
  const draw = (div) => {
    const spec = waiting.get(div);
    if (!spec) return;
    waiting.delete(div);
    Plotly.newPlot(div, spec.data, spec.layout, config);
    if (spec.extra.modes) control(div, spec);
    if (spec.extra.links) {
      div.on("plotly_click", ({ points: [point] }) => {
        const to = spec.extra.links[point.customdata[0]];
        if (to) location.assign(to);
      });
    }
    div.dataset.drawn = "";
  };
  const near = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting) { near.unobserve(entry.target); draw(entry.target); }
  }, { rootMargin: "300px" });
  for (const script of document.querySelectorAll("script[data-plot]")) {
    const div = document.getElementById(script.dataset.plot);
    waiting.set(div, JSON.parse(script.textContent));
  }
  document.addEventListener("DOMContentLoaded", () => { for (const div of waiting.keys()) near.observe(div); });

  // Printers get none of what WebGL drew once it is shown: scenes are copied while it is there.
  addEventListener("beforeprint", () => {
    for (const part of document.querySelectorAll("details:not([open])")) {
      part.open = true;
      part.dataset.folded = ""; // until it is printed
    }
    for (const div of [...waiting.keys()]) draw(div);
    for (const div of document.querySelectorAll(".plot")) {
      const scene = div._fullLayout?.scene?._scene;
      if (!scene?.glplot) continue;
      scene.glplot.redraw();
      const drawn = scene.glplot.canvas, copy = document.createElement("canvas");
      copy.className = "copy"; copy.width = drawn.width; copy.height = drawn.height;
      copy.getContext("2d").drawImage(drawn, 0, 0);
      drawn.after(copy);
    }
  });
  addEventListener("afterprint", () => {
    for (const copy of document.querySelectorAll(".plot .copy")) copy.remove();
    for (const part of document.querySelectorAll("details[data-folded]")) {
      part.open = false;
      delete part.dataset.folded;
    }
  });

  // A scene: legs from A to B of a model and of another one, whose difference is exaggerated.
  const control = (div, { extra }) => {
    const form = document.querySelector(`form[data-for="${div.id}"]`), { elements } = form;
    const show = () => {
      const mode = extra.modes[Number(elements.mode.value)];
      const pose = elements.pose ? Number(elements.pose.value) : 0;
      const factor = extra.factors[Number(elements.factor.value)];
      elements.factor_text.value = `${factor} times`;
      if (elements.pose) elements.pose_text.value = extra.poses[pose];
      const between = (a, b) => a.map((p, i) => p.map((x, k) => x + factor * (b[i][k] - x)));
      const base = mode.base[pose] ?? mode.base[0], platform = mode.platform[pose];
      const parts = [[base[0], platform[0]], [between(...base), between(...platform)]];
      const motors = mode.motors?.[pose] ?? mode.motors?.[0], moves = motors?.[0].length > 0;
      const bodies = moves && [motors[0], between(...motors)];
      const standing = moves && [mode.standing[0], between(...mode.standing)];
      const apart = (ends) => ends.flatMap((p, k) => (k % 2 ? [p, null] : [p]));
      const x = [[], [], []], which = [];
      const put = (trace, points) => {
        which.push(trace);
        for (let k = 0; k < 3; k++) x[k].push(points.map((p) => p && p[k]));
      };
      parts.forEach(([A, B], i) => {
        put(extra.traces.legs[i], A.flatMap((a, j) => [a, B[j], null]));
        if (bodies) {
          put(extra.traces.base[i], apart(standing[i]));
          put(extra.traces.motors[i], apart(bodies[i]));
        } else put(extra.traces.base[i], extra.outline.base.map((j) => A[j]));
        put(extra.traces.platform[i], extra.outline.platform.map((j) => B[j]));
      });
      const [A, B] = parts[1];
      const rings = (centres, shapes) => centres.flatMap((c, j) =>
        shapes[j].flatMap((ring) => [...ring.map((p) => p.map((v, k) => c[k] + v)), null]));
      if (extra.rings) {
        const R = extra.turns[pose];
        const turned = extra.rings.platform.map((rs) => rs.map((ring) => ring.map((p) =>
          R.map((r) => r[0] * p[0] + r[1] * p[1] + r[2] * p[2]))));
        put(extra.traces.rings, [...rings(A, extra.rings.base), ...rings(B, turned)]);
      }
      Plotly.restyle(div, { x: x[0], y: x[1], z: x[2] }, which);
      Plotly.restyle(div, { name: mode.legend }, extra.traces.legs);
    };
    elements.mode.addEventListener("input", () => {
      elements.factor.value = extra.modes[Number(elements.mode.value)].step;
    });
    form.addEventListener("input", show);
    form.addEventListener("submit", (event) => event.preventDefault());
    show();
  };

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
