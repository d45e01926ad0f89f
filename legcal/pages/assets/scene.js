"use strict";
// A machine in space on a canvas. The content of a scene has its `unit`, whether it is `flat`, and two `models`
// of joints A and B, anchors, standing and moving lines, by pose: the difference between both is exaggerated by
// one of the `factors`. Base and platform are lines around joints (`rims`), uncertainties half axes at joints (`rings`,
// those of the platform turned as it is), `cameras` an eye and the corners of its picture.
(() => {
  const GREY = "#9aa1ab", BLUE = "#1f5fa8", AMBER = "#b26a00", GREEN = "#1e7d46", BROWN = "#8a6d3b";
  const INK = "#1d2126", DIM = "#667080", RULE = "#e4e8ec";
  const ZERO = 1e-12, FONT = "system-ui, sans-serif";
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const circle = Array.from({ length: 25 }, (_, k) => [Math.cos(k * Math.PI / 12), Math.sin(k * Math.PI / 12)]);
  const span = (points, k) => [Math.min(...points.map((p) => p[k])), Math.max(...points.map((p) => p[k]))];
  const ticks = (low, high) => {
    const raw = (high - low) / 8, power = 10 ** Math.floor(Math.log10(Math.max(raw, ZERO)));
    const step = power * [1, 2, 5, 10].find((s) => s * power >= raw * 0.999), found = [];
    for (let k = Math.ceil(low / step); k <= high / step + 1e-9; k++) found.push(Number((k * step).toPrecision(12)));
    return found;
  };

  // What is drawn: layers of lines, words, and points with a tip.
  const machine = ({ models, legend, rims, rings, cameras, names }, pose, factor) => {
    const at = (poses) => poses[pose] ?? poses[0];
    const between = (a, b) => (typeof a === "number" ? a + factor * (b - a) : a.map((x, k) => between(x, b[k])));
    const [before, after] = models.map((m) => ({ ...m, A: at(m.A), B: at(m.B), moving: at(m.moving) }));
    const shown = Object.fromEntries(Object.keys(before).map((key) => [key, between(before[key], after[key])]));
    const around = (points, rim) => rim.map((j) => points[j]);
    const layers = [before, shown].flatMap((model, k) => [
      { name: legend[k], colour: [GREY, BLUE][k], width: [2, 4][k], lines: model.A.map((a, j) => [a, model.B[j]]) },
      { colour: [GREY, BLUE][k], width: [1.3, 2][k], lines: [
        around(model.anchors.length > 2 ? model.anchors : model.A, rims.base), around(model.B, rims.platform),
        ...model.standing] },
      { colour: [GREY, BROWN][k], width: [2.5, 5][k], lines: model.moving },
    ]);
    const turned = (turn, p) => (turn ? turn.map((row) => dot(row, p)) : p);
    const ellipses = (centres, shapes, turn) => shapes.flatMap((axes, j) => [[0, 1], [1, 2], [0, 2]].map(([p, q]) =>
      circle.map(([c, s]) => turned(turn, axes.map((row) => c * row[p] + s * row[q])).map((x, k) => centres[j][k] + x))));
    if (rings.base) layers.push({ name: rings.name, colour: AMBER, width: 1.3, lines: [
      ...ellipses(shown.A, rings.base), ...ellipses(shown.B, rings.platform, rings.turns[pose])] });
    if (cameras.length) layers.push({ name: "cameras", colour: GREEN, width: 1.3, lines: cameras.flatMap(({ points }) =>
      [[...points.slice(1), points[1]], ...points.slice(1).map((p) => [points[0], p])]) });
    return {
      layers, words: names.map((text, j) => ({ text, at: shown.A[j] })),
      tips: cameras.map(({ name, points }) => ({ text: `camera ${name}`, at: points[0] })),
    };
  };

  const show = (canvas, content) => {
    const form = document.querySelector(`form[data-for="${canvas.id}"]`), { elements } = form;
    const paper = canvas.getContext("2d");
    const solid = content.models.flatMap((m) => [...m.A.flat(), ...m.B.flat(), ...m.standing.flat()]);
    const [[x0, x1], [y0, y1], [z0, z1]] = [0, 1, 2].map((k) => span(solid, k)), reach = 0.3 * Math.max(x1 - x0, y1 - y0);
    const xs = ticks(x0 - reach, x1 + reach), ys = ticks(y0 - reach, y1 + reach); // of the floor
    const corners = [xs[0], xs.at(-1)].flatMap((x) => [ys[0], ys.at(-1)].map((y) => [x, y]));
    const room = [...solid, ...corners.map(([x, y]) => [x, y, z0])];
    const all = [...room, ...(content.cameras ?? []).flatMap(({ points }) => points)];
    const view = { azimuth: content.flat ? -Math.PI / 2 : -0.857, elevation: content.flat ? Math.PI / 2 : 0.38,
      target: [(x0 + x1) / 2, (y0 + y1) / 2, (z0 + z1) / 2], distance: 0 };
    let drawn, spots = [];

    const axes = () => {
      const [c, s] = [Math.cos, Math.sin].map((f) => f(view.azimuth));
      const [a, b] = [Math.cos, Math.sin].map((f) => f(view.elevation));
      return { right: [-s, c, 0], up: [-b * c, -b * s, a], back: [a * c, a * s, b] };
    };
    const relative = (p) => p.map((x, k) => x - view.target[k]);
    // The distance from which points fit into the picture.
    const away = (points, width, height, focal) => {
      const { right, up, back } = axes();
      return Math.max(...points.map(relative).map((d) => dot(d, back)
        + 2.2 * focal * Math.max(Math.abs(dot(d, right)) / (width - 50), Math.abs(dot(d, up)) / height)));
    };
    const draw = () => {
      const width = canvas.clientWidth, height = canvas.clientHeight, dpr = window.devicePixelRatio || 1;
      if (!width) return;
      canvas.width = Math.round(width * dpr); canvas.height = Math.round(height * dpr);
      paper.setTransform(dpr, 0, 0, dpr, 0, 0);
      const focal = 1.25 * height, { right, up, back } = axes();
      const place = (p) => {
        const d = relative(p), depth = view.distance - dot(d, back);
        return [width / 2 + focal * dot(d, right) / depth, height / 2 - focal * dot(d, up) / depth, depth];
      };
      for (let k = 0; k < 3 && !view.settled; k++) { // at first all is in the picture, and in its middle
        view.distance = Math.min(away(all, width, height, focal), 1.5 * away(room, width, height, focal));
        const [top, bottom] = span(all.map(place), 1), shift = (top + bottom - height) / 2 * view.distance / focal;
        view.target = view.target.map((x, j) => x - shift * up[j]);
      }
      view.settled = true;
      const visible = (p) => p[2] > 0.02 * view.distance;
      const stroke = (a, b, colour, thick) => {
        paper.strokeStyle = colour; paper.lineWidth = thick;
        paper.beginPath(); paper.moveTo(a[0], a[1]); paper.lineTo(b[0], b[1]); paper.stroke();
      };
      const write = (text, x, y, colour, align = "center", size = 11) => {
        paper.font = `${size}px ${FONT}`; paper.textAlign = align; paper.fillStyle = colour; paper.fillText(text, x, y);
      };
      paper.fillStyle = "#fff"; paper.fillRect(0, 0, width, height);
      paper.lineCap = "round";

      // A floor with the coordinates, and the height at the left.
      const floor = (x, y) => place([x, y, z0]);
      const grid = (from, across, point) => {
        for (const f of from) for (let k = 1; k < across.length; k++) {
          const a = point(f, across[k - 1]), b = point(f, across[k]);
          if (visible(a) && visible(b)) stroke(a, b, RULE, 1);
        }
      };
      grid(xs, ys, floor); grid(ys, xs, (y, x) => floor(x, y));
      const nearer = (list, point) => [list[0], list.at(-1)].sort((a, b) => point(a)[2] - point(b)[2])[0];
      const yEdge = nearer(ys, (y) => floor((x0 + x1) / 2, y)), xEdge = nearer(xs, (x) => floor(x, (y0 + y1) / 2));
      const label = (text, p, outside) => {
        const q = place(outside);
        if (!visible(p)) return;
        const far = Math.hypot(p[0] - q[0], p[1] - q[1]) || 1;
        write(text, p[0] + 16 * (p[0] - q[0]) / far, p[1] + 4 + 14 * (p[1] - q[1]) / far, DIM);
      };
      const inside = [(x0 + x1) / 2, (y0 + y1) / 2];
      const named = (name, list, edge) => { // the ends of both edges meet in one corner
        const far = list.at(-1) === edge ? list[0] : list.at(-1);
        return list.filter((v) => v !== edge).map((v) => [v, v === far ? `${name} [${content.unit}]` : String(v)]);
      };
      for (const [x, text] of named("x", xs, xEdge)) label(text, floor(x, yEdge), [x, inside[1], z0]);
      for (const [y, text] of named("y", ys, yEdge)) label(text, floor(xEdge, y), [inside[0], y, z0]);
      if (!content.flat) {
        const [x, y] = corners.toSorted((a, b) => floor(...a)[0] - floor(...b)[0])[0];
        const zs = [z0, ...ticks(z0, z1).filter((z) => z > z0)].map((z) => [z, place([x, y, z])]);
        const end = zs.at(-1)[1];
        if (visible(zs[0][1]) && visible(end)) {
          stroke(zs[0][1], end, RULE, 1);
          const [aside, align] = end[0] < 60 ? [6, "left"] : [-6, "right"];
          write(`z [${content.unit}]`, end[0] + aside, end[1] - 8, DIM, align);
          let last = zs[0][1][1];
          for (const [z, p] of zs.slice(1)) {
            if (last - p[1] > 13) { write(String(z), p[0] + aside, p[1] + 4, DIM, align); last = p[1]; }
          }
        }
      }

      // From far to near.
      const items = drawn.layers.flatMap(({ lines, colour, width: thick }) => lines.flatMap((line) => {
        const points = line.map(place);
        return points.slice(1).map((b, k) => ({ a: points[k], b, colour, thick, depth: (points[k][2] + b[2]) / 2 }));
      })).filter(({ a, b }) => visible(a) && visible(b));
      for (const { a, b, colour, thick } of items.sort((p, q) => q.depth - p.depth)) stroke(a, b, colour, thick);
      for (const { text, at } of drawn.words) {
        const [x, y, depth] = place(at);
        if (depth > 0) write(text, x, y + 15, INK);
      }
      spots = drawn.tips.map(({ text, at }) => ({ text, at: place(at) })).filter(({ at }) => visible(at));
      drawn.layers.filter(({ name }) => name).forEach(({ name, colour, width: thick }, k) => {
        stroke([8, 14 + 18 * k], [34, 14 + 18 * k], colour, thick);
        write(name, 42, 18 + 18 * k, INK, "left", 12);
      });
    };

    const update = () => {
      const pose = Number(elements.pose?.value ?? 0), factor = content.factors[Number(elements.factor.value)] ?? 1;
      elements.factor_text.value = `${factor} times`;
      if (elements.pose) elements.pose_text.value = content.poses[pose];
      drawn = machine(content, pose, factor);
      canvas.layers = drawn.layers;
      draw();
    };
    form.addEventListener("input", update);
    form.addEventListener("submit", (event) => event.preventDefault());

    // Drag turns, with Shift or the right button it moves; the wheel, two fingers and keys too.
    const turn = (dx, dy) => {
      view.azimuth -= 0.008 * dx;
      view.elevation = Math.min(Math.max(view.elevation + 0.008 * dy, -Math.PI / 2), Math.PI / 2);
      draw();
    };
    const zoom = (scale) => { view.distance *= scale; draw(); };
    const fingers = new Map();
    const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, ({ pointerId }) => fingers.delete(pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const last = fingers.get(event.pointerId), here = [event.clientX, event.clientY];
      if (!last) {
        const spot = spots.find(({ at }) => Math.hypot(at[0] - event.offsetX, at[1] - event.offsetY) < 9);
        showTip(event, spot?.text);
        return;
      }
      const before = fingers.size === 2 ? apart() : 0, [dx, dy] = [here[0] - last[0], here[1] - last[1]];
      fingers.set(event.pointerId, here);
      if (before) zoom(before / Math.max(apart(), 1));
      else if (event.shiftKey || event.buttons === 2) {
        const { right, up } = axes(), scale = view.distance / (1.25 * canvas.clientHeight);
        view.target = view.target.map((x, k) => x + scale * (dy * up[k] - dx * right[k]));
        draw();
      } else turn(dx, dy);
    });
    canvas.addEventListener("pointerleave", (event) => showTip(event, ""));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => { event.preventDefault(); zoom(Math.exp(event.deltaY / 700)); }, { passive: false });
    canvas.addEventListener("keydown", ({ key }) => {
      const step = { ArrowLeft: [-9, 0], ArrowRight: [9, 0], ArrowUp: [0, -9], ArrowDown: [0, 9] }[key];
      if (step) turn(...step);
      if ("+-".includes(key)) zoom(key === "+" ? 0.9 : 1.1);
    });
    new ResizeObserver(draw).observe(canvas);
    canvas.show = (changes) => { Object.assign(content, changes); update(); };
    update();
  };
  for (const script of document.querySelectorAll("script[data-scene]")) {
    show(document.getElementById(script.dataset.scene), JSON.parse(script.textContent));
  }
})();
