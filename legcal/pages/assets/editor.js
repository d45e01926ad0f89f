"use strict";
(() => {
  // Outlines over their photographs: the rows of a table, what people change of them, and the
  // table with their changes to download. Names of columns are those of observations.csv.
  const dialog = document.getElementById("editor"), stage = dialog.querySelector(".stage svg");
  const list = dialog.querySelector(".rows"), form = dialog.querySelector("form"), { elements } = form;
  const said = dialog.querySelector("[role=status]"), summary = document.getElementById("edit-state");
  const { cameras, images, file, reasons } = JSON.parse(document.getElementById("editor-images").textContent);
  const packed = document.getElementById("editor-table").textContent.trim();
  const REASON = "by_hand", MEASURED = ["contrast", "length", "residual", "gamma", "by_gamma"];
  const LEAST_PIECE = 0.1, SIGMAS = [1e-5, 100], POINTS = 24, CLOSE = 12; // px; CLOSE: of the screen for one of the image
  let rows = [], header = [], column = {}, at = 0, chosen = -1, drag = null, saved = true;
  const edits = new Map(), past = [], future = [];
  const say = (text) => { said.textContent = text; };

  // Cameras: points of the sensor plane to pixels, and back by Newton's method.
  const distort = ({ K, model, distortion: d }, [x, y]) => {
    const [[fx, skew, cx], [, fy, cy]] = K, [k1 = 0, k2 = 0, p1 = 0, p2 = 0, k3 = 0, k4 = 0, k5 = 0, k6 = 0, s1 = 0, s2 = 0, s3 = 0, s4 = 0] = d;
    if (model === "splined_radial") { // d: polynomials from multiples of 15 deg on
      const r = Math.hypot(x, y), t = Math.atan(r), step = Math.PI / 12, k = Math.min(Math.floor(t / step), d.length - 1);
      const far = r > 1e-8 ? (t * (1 + d[k].reduceRight((sum, c) => sum * (t - k * step) + c, 0))) / r : 1;
      return [fx * far * x + cx, fy * far * y + cy];
    }
    if (model === "equidistant") {
      const r = Math.hypot(x, y), t = Math.atan(r), t2 = t * t;
      const far = r > 1e-8 ? (t * (1 + t2 * (k1 + t2 * (k2 + t2 * (p1 + t2 * p2))))) / r : 1; // its k3, k4 stand third, fourth
      return [fx * far * x + cx, fy * far * y + cy];
    }
    if (!d.some((k) => k !== 0)) return [fx * x + skew * y + cx, fy * y + cy];
    const r2 = x * x + y * y, far = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)));
    return [fx * (x * far + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)) + cx,
      fy * (y * far + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)) + cy];
  };
  const undistort = (camera, [u, v]) => {
    const [[fx, , cx], [, fy, cy]] = camera.K, step = 1e-6;
    let xy = [(u - cx) / fx, (v - cy) / fy];
    if (camera.model === "equidistant" || camera.model === "splined_radial") {
      const r = Math.hypot(...xy), far = r > 1e-8 ? Math.tan(Math.min(r, 1.4)) / r : 1;
      xy = xy.map((x) => x * far);
    }
    for (let k = 0; k < 30; k++) {
      const [p, q] = distort(camera, xy), [a, c] = distort(camera, [xy[0] + step, xy[1]]), [b, d] = distort(camera, [xy[0], xy[1] + step]);
      const J = [(a - p) / step, (b - p) / step, (c - q) / step, (d - q) / step], det = J[0] * J[3] - J[1] * J[2];
      const move = [(J[3] * (u - p) - J[1] * (v - q)) / det, (J[0] * (v - q) - J[2] * (u - p)) / det];
      xy = [xy[0] + move[0], xy[1] + move[1]];
      if (Math.hypot(...move) < 1e-14) break;
    }
    return xy;
  };
  // The line through two ends, signed as in eq (3): (second x first) . h > 0, the first nearer to the base.
  const lineOf = (camera, ends, like) => {
    const [[x0, y0], [x1, y1]] = ends.map((end) => undistort(camera, end));
    const h = [y1 - y0, x0 - x1, x1 * y0 - y1 * x0], norm = Math.hypot(...h);
    const sign = like && like.reduce((sum, x, k) => sum + x * h[k], 0) < 0 ? -1 : 1;
    return h.map((x) => (sign * x) / norm);
  };
  const curveOf = (camera, h, ends) => {
    const n2 = h[0] * h[0] + h[1] * h[1];
    const feet = ends.map((end) => {
      const [x, y] = undistort(camera, end), off = (h[0] * x + h[1] * y + h[2]) / n2;
      return [x - off * h[0], y - off * h[1]];
    });
    return Array.from({ length: POINTS }, (_, k) => {
      const t = k / (POINTS - 1);
      return distort(camera, [0, 1].map((c) => feet[0][c] + t * (feet[1][c] - feet[0][c])));
    });
  };

  // The table: cells of each row, and its text as it stands.
  const cellsOf = (line) => {
    if (!line.includes('"')) return line.split(",");
    const cells = [];
    let cell = "", quoted = false;
    for (let k = 0; k < line.length; k++) {
      const letter = line[k];
      if (letter === '"' && quoted && line[k + 1] === '"') { cell += letter; k++; } else if (letter === '"') quoted = !quoted;
      else if (letter === "," && !quoted) { cells.push(cell); cell = ""; } else cell += letter;
    }
    return [...cells, cell];
  };
  const parse = (text) => text.split("\n").filter((line) => line).map((line) => ({ text: line, cells: cellsOf(line) })); // no name has ends of lines
  const numbers = (cells, ...names) => names.map((name) => (cells[column[name]] === "" ? NaN : Number(cells[column[name]])));
  const load = async () => {
    const letters = atob(packed), bytes = new Uint8Array(letters.length);
    for (let k = 0; k < bytes.length; k++) bytes[k] = letters.charCodeAt(k);
    const text = await new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
    const lines = parse(text), image = new Map(images.map((entry, k) => [JSON.stringify([entry.view, entry.image]), k]));
    header = lines[0].cells;
    column = Object.fromEntries(header.map((name, k) => [name, k]));
    rows = lines.slice(1).map(({ text: line, cells }, i) => {
      const [view, name, leg, part, edge] = cells, h = numbers(cells, "a", "b", "c"), e = numbers(cells, "u0", "v0", "u1", "v1");
      const isMeasured = [...h, ...e].every(Number.isFinite);
      const k = image.get(JSON.stringify([view, name])) ?? -1;
      return { i, line, cells, image: k, leg, part, edge, h: isMeasured ? h : null, ends: isMeasured ? [e.slice(0, 2), e.slice(2)] : null,
        used: cells[column.verdict] === "used", expected: images[k]?.expected?.[`${leg}\n${part}\n${edge}`] ?? null };
    });
  };
  const cameraOf = (row) => cameras[images[row.image].camera];
  const now = (row) => {
    const edit = edits.get(row.i), ends = edit?.ends ?? row.ends;
    const h = edit?.ends ? lineOf(cameraOf(row), ends, row.h ?? lineOf(cameraOf(row), row.expected)) : row.h;
    return { ends, h, used: edit?.used ?? row.used, edited: Boolean(edit) };
  };
  const covarianceOf = (row, ends) => { // as measured where it may be used: see docs/formats.md
    const [a, b, c] = numbers(row.cells, "s00", "s01", "s11"), most = 0.5 * (a + c + Math.hypot(a - c, 2 * b));
    const least = (a * c - b * b) / most, length = Math.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]);
    return least >= SIGMAS[0] ** 2 && most <= Math.min(SIGMAS[1], length) ** 2 ? [a, b, c] : null;
  };
  const lineText = (row) => {
    const edit = edits.get(row.i);
    if (!edit) return row.line;
    const { ends, h, used } = now(row), cells = [...row.cells], put = (name, value) => { if (name in column) cells[column[name]] = String(value); };
    put("verdict", used ? "used" : "rejected");
    put("reason", used ? "" : REASON);
    put("detail", "");
    put("source", "edited");
    if (edit.ends) {
      ["a", "b", "c"].forEach((name, k) => put(name, h[k]));
      ["u0", "v0", "u1", "v1"].forEach((name, k) => put(name, ends.flat()[k]));
      for (const name of MEASURED) put(name, ""); // of another line
    }
    const variance = edit.sigma ** 2, covariance = edit.ends || (used && !covarianceOf(row, ends)) ? [variance, 0, variance] : null;
    if (covariance) ["s00", "s01", "s11"].forEach((name, k) => put(name, covariance[k]));
    return cells.map((cell) => (/[",\n\r]/.test(cell) ? `"${cell.replaceAll('"', '""')}"` : cell)).join(",");
  };
  const tableText = () => [header.join(","), ...rows.map(lineText), ""].join("\n");

  // Changes, which can be undone.
  const sigma = () => {
    const value = Number(elements.sigma.value);
    return value >= SIGMAS[0] && value <= SIGMAS[1] ? value : Number(elements.sigma.defaultValue);
  };
  const put = (i, edit) => { if (edit) edits.set(i, edit); else edits.delete(i); };
  const change = (row, next, series = "") => {
    const before = edits.get(row.i), same = !next || (!next.ends && next.used === row.used);
    const after = same ? undefined : { sigma: sigma(), ...next }, last = past[past.length - 1];
    if (!before && !after) return;
    if (series && last?.series === series) last.after = after;
    else past.push({ i: row.i, before, after, series });
    future.length = 0;
    put(row.i, after);
    show(row.i);
  };
  const step = (from, to, side) => {
    const edited = from.pop();
    if (!edited) { say(side === "before" ? "Nothing to undo." : "Nothing to do again."); return; }
    edited.series = "";
    to.push(edited);
    put(edited.i, edited[side]);
    if (rows[edited.i].image !== at) open(rows[edited.i].image);
    show(edited.i);
    say(`${nameOf(rows[edited.i])}: ${stateOf(rows[edited.i])}.`);
  };
  const undo = () => step(past, future, "before"), redo = () => step(future, past, "after");
  const use = (row) => {
    const edit = edits.get(row.i);
    if (row.ends || edit?.ends) change(row, { ends: edit?.ends, used: true });
    else if (row.expected) change(row, { ends: row.expected, used: true });
    else { say(`${nameOf(row)} is not in the image.`); return; }
    say(row.ends ? `${nameOf(row)} is used.` : `${nameOf(row)} is placed where it was expected: move both ends onto the edge.`);
  };
  const reject = (row) => { change(row, { ends: edits.get(row.i)?.ends, used: false }); say(`${nameOf(row)} is rejected.`); };
  const reset = (row) => { change(row, null); say(`${nameOf(row)} is as in the table.`); };
  const moveEnd = (row, k, to, series = "") => {
    const image = images[row.image], ends = now(row).ends.map((end) => [...end]);
    ends[k] = [Math.min(Math.max(to[0], 0), image.width - 1), Math.min(Math.max(to[1], 0), image.height - 1)];
    const length = Math.hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]);
    if (length < Math.max(LEAST_PIECE, sigma())) { say(`${nameOf(row)} stays: its ends would be ${length.toFixed(2)} px apart.`); show(row.i); return; }
    change(row, { ends, used: true }, series);
    say(`${nameOf(row)}, end ${k + 1}: ${ends[k].map((x) => x.toFixed(2)).join(", ")} px.`);
  };

  // What is seen.
  const make = (name, attributes, parent) => {
    const element = document.createElementNS(stage.namespaceURI, name);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    parent?.append(element);
    return element;
  };
  const partOf = ({ leg, part }) => (part.startsWith(leg) ? part.slice(leg.length).replace(/^[_\- ]+/, "") : part);
  const nameOf = (row) => `${row.leg} ${partOf(row)}, edge ${row.edge}`;
  const inWords = (code, detail) => {
    const [plain, detailed] = reasons[code] ?? [code, ""];
    return detail && detailed ? detailed.replace("{}", code === "partner" ? inWords(detail, "") : detail) : plain;
  };
  const stateOf = (row) => {
    const { ends, used, edited } = now(row), reason = inWords(row.cells[column.reason], row.cells[column.detail]);
    const why = edits.has(row.i) ? inWords(REASON, "") : reason ? `rejected: ${reason}` : "rejected";
    const word = !ends ? `not found${reason ? `: ${reason}` : ""}` : used ? "used" : why;
    return `${word}${edited ? " (edited)" : row.cells[column.source] === "edited" ? " (edited before)" : ""}`;
  };
  const here = () => rows.filter((row) => row.image === at);
  const scale = () => stage.getScreenCTM()?.a || 1;
  const drawLine = (row, ends = now(row).ends) => {
    const group = stage.querySelector(`[data-row="${row.i}"]`), { used, edited } = now(row);
    group.replaceChildren();
    const moved = ends && (ends !== row.ends || edits.get(row.i)?.ends);
    const shown = ends ?? row.expected;
    if (!shown) return;
    const camera = cameraOf(row), like = row.h ?? lineOf(camera, shown);
    const h = ends && !moved ? row.h : lineOf(camera, shown, like);
    const points = curveOf(camera, h, shown).map((p) => p.map((x) => x.toFixed(3)).join(",")).join(" ");
    group.setAttribute("class", `line ${!ends ? "lost" : used ? "used" : "rejected"} edge${row.edge}${row.i === chosen ? " chosen" : ""}`);
    for (const kind of ["hit", "under", "over"]) make("polyline", { class: kind, points }, group);
    const [[x0, y0], [x1, y1]] = shown, share = row.edge === "1" ? 0.42 : 0.58, k = 1 / scale();
    const place = (x, y, inside) => make("g", { transform: `translate(${x} ${y}) scale(${k})`, ...inside }, group);
    const label = make("text", { x: 7, y: -7 }, place(x0 + share * (x1 - x0), y0 + share * (y1 - y0), { class: "label" }));
    label.textContent = `${row.leg} ${row.edge}${!ends ? " ?" : used ? "" : " \u2717"}${edited ? " \u270e" : ""}`;
    if (row.i !== chosen || !ends) return;
    ends.forEach(([u, v], end) => {
      const handle = place(u, v, { class: "handle", "data-end": end, tabindex: 0, role: "button",
        "aria-label": `End ${end + 1} of ${nameOf(row)} at ${u.toFixed(2)}, ${v.toFixed(2)} px; arrow keys move it` });
      make("circle", { r: 11 }, handle);
      make("path", { d: "M-16 0h10M6 0h10M0 -16v10M0 6v10" }, handle);
      const number = make("text", { x: 14, y: 20 }, handle);
      number.textContent = String(end + 1);
    });
  };
  const show = (i) => {
    const focus = document.activeElement?.dataset?.end;
    drawLine(rows[i]);
    if (focus !== undefined) stage.querySelector(`.handle[data-end="${focus}"]`)?.focus();
    for (const button of list.querySelectorAll("button")) {
      const row = rows[Number(button.dataset.of)];
      button.setAttribute("aria-pressed", row.i === chosen);
      button.lastElementChild.textContent = stateOf(row);
    }
    const row = rows[chosen];
    elements.use.disabled = !row || now(row).used || !(now(row).ends ?? row.expected);
    elements.reject.disabled = !row || !now(row).ends || !now(row).used;
    elements.reset.disabled = !row || !edits.has(chosen);
    elements.undo.disabled = !past.length;
    elements.redo.disabled = !future.length;
    const n = edits.size;
    saved = n === 0;
    summary.textContent = n ? `${n} outline${n === 1 ? " is" : "s are"} edited and not downloaded yet.` : "Nothing is edited.";
    elements.image.selectedOptions[0].textContent = optionOf(at);
    for (const button of document.querySelectorAll("[data-download]")) button.disabled = n === 0;
  };
  const optionOf = (k) => {
    const n = [...edits.keys()].filter((i) => rows[i].image === k).length;
    return `${images[k].view}  ${images[k].image}${n ? `  (${n} edited)` : ""}`;
  };
  const choose = (i) => {
    const before = chosen;
    chosen = i;
    if (rows[before]?.image === at) drawLine(rows[before]);
    if (i < 0) { for (const button of list.querySelectorAll("button")) button.setAttribute("aria-pressed", false); return; }
    stage.append(stage.querySelector(`[data-row="${i}"]`)); // above the others
    show(i);
    say(`${nameOf(rows[i])}: ${stateOf(rows[i])}.`);
  };
  const rescale = () => {
    stage.classList.toggle("near", scale() > 4);
    for (const mark of stage.querySelectorAll(".label, .handle")) {
      mark.setAttribute("transform", mark.getAttribute("transform").replace(/scale\(.*\)/, `scale(${1 / scale()})`));
    }
  };
  const look = (x, y, width, height) => {
    const box = stage.viewBox.baseVal;
    box.x = x; box.y = y; box.width = width; box.height = height;
    rescale();
  };
  const all = () => { const { width, height } = images[at]; look(-0.5, -0.5, width, height); };
  const zoom = (factor, x, y) => {
    const box = stage.viewBox.baseVal;
    look(x + (box.x - x) * factor, y + (box.y - y) * factor, box.width * factor, box.height * factor);
  };
  const middle = () => { const box = stage.viewBox.baseVal; return [box.x + 0.5 * box.width, box.y + 0.5 * box.height]; };
  const goTo = (end) => {
    const row = rows[chosen], ends = row && now(row).ends;
    if (!ends) { say("Choose an outline that has ends first."); return; }
    const { width, height } = stage.getBoundingClientRect(), [u, v] = ends[end];
    look(u - (0.5 * width) / CLOSE, v - (0.5 * height) / CLOSE, width / CLOSE, height / CLOSE);
    stage.querySelector(`.handle[data-end="${end}"]`).focus();
  };
  const open = (k) => {
    at = (k + images.length) % images.length;
    chosen = -1;
    elements.image.value = String(at);
    const { width, height, photograph, label } = images[at];
    stage.replaceChildren();
    const picture = make("image", { x: -0.5, y: -0.5, width, height, href: photograph, "aria-label": label }, stage);
    picture.addEventListener("error", () => say(`${photograph} could not be shown: it has to lie beside this page.`));
    list.replaceChildren(...here().map((row) => {
      make("g", { "data-row": row.i }, stage);
      const item = document.createElement("li"), button = document.createElement("button");
      button.type = "button"; button.dataset.of = row.i;
      button.append(Object.assign(document.createElement("b"), { textContent: nameOf(row) }), Object.assign(document.createElement("span"), { textContent: "" }));
      button.addEventListener("click", () => choose(row.i));
      item.append(button);
      return item;
    }));
    all();
    for (const row of here()) drawLine(row);
    const first = here()[0];
    if (first) { choose(first.i); } else { say("No outline of this image is in the table."); for (const name of ["use", "reject", "reset"]) elements[name].disabled = true; }
    rescale();
  };

  // Pointer: handles are dragged, lines chosen, the photograph moved; the wheel zooms.
  const placeOf = (event) => {
    const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(stage.getScreenCTM().inverse());
    return [x, y];
  };
  stage.addEventListener("pointerdown", (event) => {
    const handle = event.target.closest(".handle"), line = event.target.closest("[data-row]");
    if (line && !handle && Number(line.dataset.row) !== chosen) choose(Number(line.dataset.row));
    const [x, y] = placeOf(event);
    drag = { at: [x, y] };
    if (handle) {
      const end = Number(handle.dataset.end), [u, v] = now(rows[chosen]).ends[end];
      drag = { end, off: [u - x, v - y], begun: false };
      handle.focus();
    }
    stage.setPointerCapture(event.pointerId);
    event.preventDefault();
  });
  stage.addEventListener("pointermove", (event) => {
    if (!drag) return;
    const [x, y] = placeOf(event);
    if (drag.end === undefined) {
      const box = stage.viewBox.baseVal;
      box.x += drag.at[0] - x; box.y += drag.at[1] - y;
      return;
    }
    const row = rows[chosen], ends = now(row).ends.map((end) => [...end]);
    ends[drag.end] = drag.to = [x + drag.off[0], y + drag.off[1]];
    drawLine(row, ends);
  });
  stage.addEventListener("pointerup", () => {
    const { end, to } = drag ?? {};
    drag = null;
    if (to) { moveEnd(rows[chosen], end, to); stage.querySelector(`.handle[data-end="${end}"]`)?.focus(); }
  });
  const abandon = () => {
    const { to } = drag ?? {};
    drag = null;
    if (to) { drawLine(rows[chosen]); say(`${nameOf(rows[chosen])} stays as it was.`); }
    return Boolean(to);
  };
  stage.addEventListener("pointercancel", abandon);
  stage.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(event.deltaY / 500), ...placeOf(event)); }, { passive: false });

  // Keys.
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  dialog.addEventListener("keydown", (event) => {
    const { key } = event, word = key.toLowerCase(), row = rows[chosen];
    const done = () => { event.preventDefault(); event.stopPropagation(); };
    if (key === "Escape") { if (abandon()) done(); return; }
    if (event.ctrlKey || event.metaKey) {
      if (word === "z") { done(); (event.shiftKey ? redo : undo)(); } else if (word === "y") { done(); redo(); }
      return;
    }
    const arrow = ARROWS[key], { end, of } = event.target.dataset ?? {};
    if (arrow && end !== undefined) {
      done();
      const size = event.shiftKey ? 1 : event.altKey ? 0.01 : 0.1, [u, v] = now(row).ends[Number(end)];
      moveEnd(row, Number(end), [u + size * arrow[0], v + size * arrow[1]], `${chosen} ${end}`);
      return;
    }
    if (arrow && of !== undefined && arrow[1]) {
      done();
      const next = event.target.parentElement[arrow[1] > 0 ? "nextElementSibling" : "previousElementSibling"]?.firstElementChild;
      if (next) { next.focus(); choose(Number(next.dataset.of)); }
      return;
    }
    if (["INPUT", "SELECT"].includes(event.target.tagName)) return;
    const keys = { u: () => row && use(row), r: () => row && reject(row), 1: () => goTo(0), 2: () => goTo(1), 0: all,
      "+": () => zoom(0.7, ...middle()), "-": () => zoom(1 / 0.7, ...middle()), n: () => open(at + 1), p: () => open(at - 1) };
    if (keys[word]) { done(); keys[word](); }
  });
  dialog.addEventListener("cancel", (event) => { if (abandon()) event.preventDefault(); });

  const download = () => {
    downloadTable(file, tableText());
    saved = true;
    summary.textContent = `${edits.size} outline${edits.size === 1 ? " is" : "s are"} edited in the table that was downloaded.`;
    say(`${file} was downloaded: copy it into the dataset.`);
  };
  addEventListener("beforeunload", (event) => { if (!saved) event.preventDefault(); });
  const actions = { use: () => use(rows[chosen]), reject: () => reject(rows[chosen]), reset: () => reset(rows[chosen]), undo, redo,
    previous: () => open(at - 1), next: () => open(at + 1), first_end: () => goTo(0), second_end: () => goTo(1), whole: all };
  form.addEventListener("click", (event) => actions[event.target.closest("button")?.name]?.());
  form.addEventListener("submit", (event) => { if (event.submitter?.name !== "close") event.preventDefault(); });
  elements.image.addEventListener("change", () => open(Number(elements.image.value)));
  addEventListener("resize", () => { if (dialog.open) rescale(); });
  for (const button of document.querySelectorAll("[data-download]")) button.addEventListener("click", download);
  let loaded = null;
  for (const button of document.querySelectorAll("[data-edit]")) {
    button.addEventListener("click", async () => {
      try {
        loaded ??= load();
        await loaded;
      } catch {
        summary.textContent = `The table could not be unpacked: found an older browser, needed one of 2023 or later; edit ${file} itself.`;
        return;
      }
      if (elements.image.length === 0) elements.image.append(...images.map((_, k) => new Option(optionOf(k), String(k))));
      dialog.showModal();
      open(Number(button.dataset.edit));
      dialog.dataset.ready = Math.round(performance.now());
    });
  }
})();
