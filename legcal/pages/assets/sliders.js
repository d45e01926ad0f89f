"use strict";
// Sliders that move the machine of a scene: one request at a time, the latest value next, so that a slider that is dragged
// quickly causes no lag.
(() => {
  const SVG = "http://www.w3.org/2000/svg";
  const make = (parent, kind, attributes = {}) => {
    const element = parent.appendChild(document.createElementNS(SVG, kind));
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    return element;
  };
  for (const script of document.querySelectorAll("script[data-state]")) {
    const canvas = document.getElementById(script.dataset.state);
    const form = document.querySelector(`form[data-moves="${script.dataset.state}"]`);
    const words = form.nextElementSibling, gallery = words.nextElementSibling;
    let waiting = null, isBusy = false, dragged = null, photographs = "";

    const show = ({ scene, values, problems, photographs: shown }) => {
      if (scene.models) canvas.show(scene);
      for (const [name, value] of Object.entries(values)) {
        const slider = form.elements[name];
        if (slider !== dragged || !waiting) slider.value = value;
        slider.nextElementSibling.value = value;
      }
      words.textContent = problems.join(" ");
      if (JSON.stringify(shown) === photographs) return;
      photographs = JSON.stringify(shown);
      gallery.replaceChildren(...shown.map(({ file, size: [width, height], caption, lines }) => {
        const figure = document.createElement("figure");
        figure.className = "crop";
        const picture = make(figure, "svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": caption });
        picture.style.aspectRatio = `${width} / ${height}`;
        if (file) make(picture, "image", { href: file, width, height });
        for (const [kind, ends] of lines) make(picture, "polyline", { class: kind, points: ends.join(" ") });
        figure.appendChild(document.createElement("figcaption")).textContent = caption;
        return figure;
      }));
    };
    const send = async () => {
      if (isBusy || !waiting) return;
      const asked = waiting;
      waiting = null; isBusy = true;
      try {
        const answer = await fetch("/move", { method: "POST", body: JSON.stringify(asked),
          headers: { "X-Legcal-Token": form.dataset.token } });
        if (!answer.ok) throw new Error(answer.statusText);
        show(await answer.json());
      } catch {
        words.textContent = "The server of this page does not answer; start legcal view again.";
      }
      isBusy = false;
      send();
    };
    form.addEventListener("input", ({ target }) => {
      dragged = target;
      waiting = { slider: target.name, value: Number(target.value) };
      send();
    });
    form.addEventListener("click", ({ target }) => {
      if (target.tagName !== "BUTTON") return;
      waiting = { slider: target.name, value: 0 };
      send();
    });
    form.addEventListener("submit", (event) => event.preventDefault());
    show(JSON.parse(script.textContent));
  }
})();
