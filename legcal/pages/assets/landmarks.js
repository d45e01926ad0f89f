"use strict";
(() => {
  // Joints clicked in photographs: the rows of landmarks.csv, to download, or to save where this
  // page is served; there the legs are drawn at the cameras that follow.
  const dialog = document.getElementById("placer"), stage = dialog.querySelector(".stage svg");
  const drawing = dialog.querySelector(".drawing"), list = dialog.querySelector(".rows");
  const form = dialog.querySelector("form"), { elements } = form, said = dialog.querySelector("[role=status]");
  const summary = document.getElementById("click-state");
  const { images, joints, file, clicks: given, token } = JSON.parse(document.getElementById("placer-data").textContent);
  const SIGMAS = [0.01, 200], MOVED = 4, DELAY = 150; // px; of the screen; ms
  const clicks = new Map(), past = []; // by image and joint: u, v and sigma, "" for the usual one
  let at = 0, chosen = 0, drag = null, saved = true, drawn = null, asked = 0, silent = 0; // silent: up to which answers say nothing
  const key = (image, joint) => `${image} ${joint}`;
  for (const [image, joint, u, v, sigma] of given) clicks.set(key(image, joint), { u, v, sigma });
  const say = (text) => { said.textContent = text; };
  const clickAt = (joint = chosen) => clicks.get(key(at, joint));
  const inImage = (image) => joints.filter((_, joint) => clicks.has(key(image, joint))).length;
  const sigma = () => {
    const text = elements.sigma.value.trim(), value = Number(text);
    return text !== "" && value >= SIGMAS[0] && value <= SIGMAS[1] && text !== elements.sigma.defaultValue ? text : "";
  };

  // What is changed.
  const change = (edit, series = "") => {
    if (!series || past[past.length - 1]?.series !== series) past.push({ series, clicks: new Map(clicks), at, chosen });
    edit();
    saved = false;
    drawn = null;
    show();
    ask();
  };
  const put = ([u, v], joint = chosen, series = "") => {
    const { width, height } = images[at], x = Math.min(Math.max(u, 0), width - 1), y = Math.min(Math.max(v, 0), height - 1);
    change(() => clicks.set(key(at, joint), { u: x, v: y, sigma: clickAt(joint)?.sigma || sigma() }), series);
    say(`${joints[joint].name}: ${x.toFixed(1)}, ${y.toFixed(1)} px.`);
  };
  const remove = () => {
    if (!clickAt()) { say(`${joints[chosen].name} is not clicked in this picture.`); return; }
    change(() => clicks.delete(key(at, chosen)));
    say(`${joints[chosen].name} is not clicked any more.`);
  };
  const undo = () => {
    const before = past.pop();
    if (!before) { say("Nothing to undo."); return; }
    clicks.clear();
    for (const [name, click] of before.clicks) clicks.set(name, click);
    saved = false;
    drawn = null;
    if (before.at !== at) open(before.at);
    choose(before.chosen);
    show();
    ask();
  };

  // The table.
  const quoted = (text) => (/[",]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const rowsOf = () => [...clicks].map(([name, click]) => [...name.split(" ").map(Number), click])
    .sort(([a, b], [c, d]) => a - c || b - d);
  const tableText = () => ["view,image,joint,u,v,sigma", ...rowsOf().map(([image, joint, click]) => [
    quoted(images[image].view), quoted(images[image].image), quoted(joints[joint].name), click.u.toFixed(2), click.v.toFixed(2), click.sigma,
  ].join(","))].join("\n") + "\n";
  const download = () => {
    downloadTable(file, tableText());
    saved = true;
    say(`${file} was downloaded: copy it into the dataset.`);
    summarise("were downloaded");
  };

  // The server, where there is one.
  const post = async (path) => {
    const answer = await fetch(path, { method: "POST", headers: { "X-Legcal-Token": token, "Content-Type": "text/csv" }, body: tableText() });
    return answer.json();
  };
  const ask = () => {
    if (!token || !clicks.size) return;
    const mine = ++asked;
    setTimeout(async () => {
      if (mine !== asked) return;
      let answer;
      try { answer = await post(`clicks?image=${at}`); } catch { say("The legs could not be drawn: legcal detect --edit has ended."); return; }
      if (mine !== asked) return;
      drawn = answer;
      const { problems, notes } = answer;
      if (mine > silent) say(problems[0] ?? notes[0] ?? "The legs are drawn at the camera of these clicks.");
      said.classList.toggle("warning", problems.length > 0);
      dialog.dataset.drawn = String(mine);
      draw();
    }, DELAY);
  };
  const save = async () => {
    let answer;
    try { answer = await post("save"); } catch { say("The clicks could not be saved: legcal detect --edit has ended; download them."); return; }
    say(answer.problems[0] ?? `${answer.saved} was saved: legcal calibrate begins there.`);
    silent = asked;
    if (answer.problems.length) return;
    saved = true;
    summarise("were saved");
  };

  // What is seen.
  const make = (name, attributes, parent) => {
    const element = document.createElementNS(stage.namespaceURI, name);
    for (const [attribute, value] of Object.entries(attributes)) element.setAttribute(attribute, value);
    parent?.append(element);
    return element;
  };
  const scale = () => stage.getScreenCTM()?.a || 1;
  const place = (group, [x, y], more) => make("g", { transform: `translate(${x} ${y}) scale(${1 / scale()})`, ...more }, group);
  const draw = () => {
    const legs = stage.querySelector(".legs"), marks = stage.querySelector(".marks");
    const focus = document.activeElement?.dataset?.click;
    legs.replaceChildren();
    marks.replaceChildren();
    for (const { edges } of drawn?.image === at ? drawn.legs : []) {
      for (const edge of edges) make("polyline", { points: edge.map((p) => p.join(",")).join(" ") }, legs);
    }
    for (const [name, px] of Object.entries(drawn?.image === at ? drawn.joints : {})) {
      const joint = joints.findIndex((entry) => entry.name === name);
      if (clickAt(joint)) continue;
      const mark = place(marks, px, { class: "expected" });
      make("path", { d: "M-5 0h10M0 -5v10" }, mark);
      make("text", { x: 7, y: -5 }, mark).textContent = joints[joint].label;
    }
    joints.forEach(({ name, label }, joint) => {
      const click = clickAt(joint);
      if (!click) return;
      const mark = place(marks, [click.u, click.v], { class: `handle click${joint === chosen ? " chosen" : ""}`, "data-click": joint, tabindex: 0, role: "button",
        "aria-label": `${name} at ${click.u.toFixed(1)}, ${click.v.toFixed(1)} px; arrow keys move it` });
      make("circle", { r: 10 }, mark);
      make("path", { d: "M-15 0h10M5 0h10M0 -15v10M0 5v10" }, mark);
      make("text", { x: 13, y: -9 }, mark).textContent = label;
    });
    if (focus !== undefined) stage.querySelector(`[data-click="${focus}"]`)?.focus();
  };
  const optionOf = (k) => { const n = inImage(k); return `${images[k].view}  ${images[k].image}${n ? `  (${n})` : ""}`; };
  const summarise = (did) => {
    const views = new Set(rowsOf().map(([image]) => images[image].view));
    summary.textContent = clicks.size ? `${clicks.size} click${clicks.size === 1 ? "" : "s"} in ${views.size} view${views.size === 1 ? "" : "s"} ${did}.` : "Nothing is clicked.";
    for (const button of document.querySelectorAll("[data-landmarks]")) button.disabled = !clicks.size;
    if (elements.save) elements.save.disabled = !clicks.size;
  };
  const show = () => {
    joints.forEach((_, joint) => {
      const button = list.querySelector(`[data-of="${joint}"]`), click = clickAt(joint);
      button.setAttribute("aria-pressed", joint === chosen);
      button.lastElementChild.textContent = click ? `${click.u.toFixed(1)}, ${click.v.toFixed(1)}` : "";
    });
    for (const disc of drawing.querySelectorAll("[data-joint]")) {
      const joint = joints.findIndex(({ name }) => name === disc.dataset.joint);
      disc.classList.toggle("chosen", joint === chosen);
      disc.classList.toggle("clicked", Boolean(clickAt(joint)));
    }
    elements.remove.disabled = !clickAt();
    elements.undo.disabled = !past.length;
    if (elements.image.length) elements.image.options[at].textContent = optionOf(at);
    summarise(saved ? "are in the table" : "are not downloaded yet");
    draw();
  };
  const choose = (joint) => {
    chosen = (joint + joints.length) % joints.length;
    show();
    list.querySelector(`[data-of="${chosen}"]`).scrollIntoView({ block: "nearest" });
    const { name, label } = joints[chosen];
    say(clickAt() ? `${name}: drag it, or click its place anew.` : `Click ${name} (${label} in the drawing), or choose another joint.`);
  };
  const advance = () => {
    for (let k = 1; k < joints.length; k++) {
      const next = (chosen + k) % joints.length;
      if (!clickAt(next)) { choose(next); return; }
    }
    show();
  };
  const look = (x, y, width, height) => {
    const box = stage.viewBox.baseVal;
    box.x = x; box.y = y; box.width = width; box.height = height;
    draw();
  };
  const whole = () => look(-0.5, -0.5, images[at].width, images[at].height);
  const zoom = (factor, x, y) => {
    const box = stage.viewBox.baseVal;
    look(x + (box.x - x) * factor, y + (box.y - y) * factor, box.width * factor, box.height * factor);
  };
  const middle = () => { const box = stage.viewBox.baseVal; return [box.x + 0.5 * box.width, box.y + 0.5 * box.height]; };
  const open = (k) => {
    at = (k + images.length) % images.length;
    elements.image.value = String(at);
    const { width, height, photograph, label } = images[at];
    stage.replaceChildren();
    const picture = make("image", { x: -0.5, y: -0.5, width, height, href: photograph, "aria-label": label }, stage);
    picture.addEventListener("error", () => say(`${photograph} could not be shown: it has to lie beside this page.`));
    make("g", { class: "legs" }, stage);
    make("g", { class: "marks" }, stage);
    whole();
    const first = joints.findIndex((_, joint) => !clickAt(joint));
    choose(first < 0 ? 0 : first);
    ask();
  };

  // Pointer: a press sets the chosen joint; a mark that is dragged moves, else the photograph does.
  const placeOf = (event) => {
    const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(stage.getScreenCTM().inverse());
    return [x, y];
  };
  stage.addEventListener("pointerdown", (event) => {
    if (event.button) return;
    const mark = event.target.closest("[data-click]"), from = placeOf(event);
    drag = { from, screen: [event.clientX, event.clientY], moved: false };
    if (mark) {
      const joint = Number(mark.dataset.click), { u, v } = clickAt(joint);
      drag.mark = joint;
      drag.off = [u - from[0], v - from[1]];
    }
    stage.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  stage.addEventListener("pointermove", (event) => {
    if (!drag) return;
    drag.moved ||= Math.hypot(event.clientX - drag.screen[0], event.clientY - drag.screen[1]) > MOVED;
    if (!drag.moved) return;
    const [x, y] = placeOf(event);
    if (drag.off && drag.mark !== chosen) choose(drag.mark);
    if (!drag.off) {
      const box = stage.viewBox.baseVal;
      box.x += drag.from[0] - x; box.y += drag.from[1] - y;
      return;
    }
    drag.to = [x + drag.off[0], y + drag.off[1]];
    stage.querySelector(`[data-click="${chosen}"]`).setAttribute("transform", `translate(${drag.to.join(" ")}) scale(${1 / scale()})`);
  });
  stage.addEventListener("pointerup", (event) => {
    if (!drag) return;
    const { mark, moved, to } = drag;
    drag = null;
    if (to) put(to);
    else if (moved) return;
    else if (mark !== undefined && clickAt()) choose(mark);
    else { put(placeOf(event)); advance(); return; } // also beside another joint that is near
    stage.querySelector(`[data-click="${chosen}"]`)?.focus();
  });
  const abandon = () => {
    const was = Boolean(drag?.to);
    drag = null;
    if (was) { draw(); say(`${joints[chosen].name} stays where it was.`); }
    return was;
  };
  stage.addEventListener("pointercancel", abandon);
  stage.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(event.deltaY / 500), ...placeOf(event)); }, { passive: false });
  drawing.addEventListener("click", (event) => {
    const disc = event.target.closest("[data-joint]");
    const joint = disc ? joints.findIndex(({ name }) => name === disc.dataset.joint) : -1;
    if (joint >= 0) choose(joint);
  });

  // Keys.
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  dialog.addEventListener("keydown", (event) => {
    const { key: pressed } = event, word = pressed.toLowerCase(), done = () => { event.preventDefault(); event.stopPropagation(); };
    if (pressed === "Escape") { if (abandon()) done(); return; }
    if (event.ctrlKey || event.metaKey) { if (word === "z") { done(); undo(); } return; }
    if (["INPUT", "SELECT"].includes(event.target.tagName)) return;
    const arrow = ARROWS[pressed], click = clickAt();
    if (arrow && event.target.dataset.of !== undefined && arrow[1]) { done(); choose(chosen + arrow[1]); list.querySelector(`[data-of="${chosen}"]`).focus(); return; }
    if (arrow && click) {
      done();
      const size = event.shiftKey ? 10 : event.altKey ? 0.1 : 1;
      put([click.u + size * arrow[0], click.v + size * arrow[1]], chosen, `${at} ${chosen}`);
      return;
    }
    const keys = { delete: remove, backspace: remove, 0: whole, "+": () => zoom(0.7, ...middle()), "-": () => zoom(1 / 0.7, ...middle()),
      n: () => open(at + 1), p: () => open(at - 1) };
    if (keys[word]) { done(); keys[word](); }
  });
  dialog.addEventListener("cancel", (event) => { if (abandon()) event.preventDefault(); });

  addEventListener("beforeunload", (event) => { if (!saved) event.preventDefault(); });
  const actions = { remove, undo, whole, save, previous: () => open(at - 1), next: () => open(at + 1) };
  form.addEventListener("click", (event) => actions[event.target.closest("button")?.name]?.());
  form.addEventListener("submit", (event) => { if (event.submitter?.name !== "close") event.preventDefault(); });
  elements.image.addEventListener("change", () => open(Number(elements.image.value)));
  addEventListener("resize", () => { if (dialog.open) draw(); });
  for (const button of document.querySelectorAll("[data-landmarks]")) button.addEventListener("click", download);
  const fill = () => list.replaceChildren(...joints.map(({ name, label }, joint) => {
    const item = document.createElement("li"), button = document.createElement("button");
    button.type = "button"; button.dataset.of = joint;
    button.append(Object.assign(document.createElement("b"), { textContent: `${name} (${label})` }), document.createElement("span"));
    button.addEventListener("click", () => choose(joint));
    item.append(button);
    return item;
  }));
  for (const button of document.querySelectorAll("[data-place]")) {
    button.addEventListener("click", () => {
      if (elements.image.length === 0) {
        fill();
        elements.image.append(...images.map((_, k) => new Option(optionOf(k), String(k))));
      }
      dialog.showModal();
      open(Number(button.dataset.place));
    });
  }
  summarise("are in the table");
})();
