// Draws the page and makes it interactive. `webpage.py` writes its content to the data block "page". Texts become text
// nodes, never HTML.
"use strict";
(() => {
  const data = JSON.parse(document.getElementById("page").textContent);
  const { steps, pictures, ground, groups, span_s } = data;
  const find = (query, within = document) => within.querySelector(query);
  const all = (query, within = document) => [...within.querySelectorAll(query)];

  // ---- Create HTML and SVG elements.
  function fillElement(element, attributes, children) {
    for (const [key, value] of Object.entries(attributes)) {
      if (value !== null && value !== false) element.setAttribute(key, value === true ? "" : value);
    }
    element.append(...children.filter((item) => item !== null && item !== undefined));
    return element;
  }
  const html = (name, attributes = {}, ...children) => fillElement(document.createElement(name), attributes, children);
  const svg = (name, attributes = {}, ...children) =>
    fillElement(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
  const section = (title, ...children) => html("section", {}, title && html("h2", {}, title), ...children);
  const figure = (value) => (Math.abs(value) >= 100 ? value.toFixed(0) : `${+value.toPrecision(3)}`);
  function clock(t_s) {
    const total_s = Math.round(t_s), minutes = Math.floor(total_s / 60), pad = (count) => String(count).padStart(2, "0");
    const hours = minutes >= 60 ? `${Math.floor(minutes / 60)}:${pad(minutes % 60)}` : minutes;
    return `${hours}:${pad(total_s % 60)}`;
  }

  // ---- The time axis: 0 to 1000 in each chart and lane.
  const has_times = span_s !== null;
  const across = (t_s) => 1000 * Math.min(Math.max(t_s / (span_s || 1), 0), 1);
  const STEPS_S = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 28800, 86400];
  const step_s = has_times ? STEPS_S.find((item) => span_s / item <= 6) || span_s / 6 : 0;
  const ticks_s = has_times ? Array.from({ length: Math.floor(span_s / step_s) + 1 || 1 }, (_, index) => index * step_s) : [];
  const grid = (height) =>
    svg("path", { class: "grid", d: `${ticks_s.map((t_s) => `M${across(t_s)} 0v${height}`).join("")}M0 ${height}h1000` });
  const times = () => html("div", { class: "times" }, ...ticks_s.filter((t_s) => !t_s || t_s <= 0.97 * span_s).map(
    (t_s) => html("span", { style: `left:${across(t_s) / 10}%` }, clock(t_s))));
  const makeStrip = (label, height, ...children) => svg("svg", {
    role: "img", "aria-label": label, viewBox: `0 0 1000 ${height}`, preserveAspectRatio: "none" }, grid(height), ...children);

  // A line through points, an area bounded by them, or dots: lines of length 0 with round ends.
  function path(points, form) {
    if (form === "dots" || points.length === 1) return points.map(([x, y]) => `M${x} ${y}h0`).join("");
    return `M${points.map(([x, y]) => `${x} ${y}`).join("L")}${form === "area" ? "z" : ""}`;
  }

  function drawChart({ title, unit, series }) {
    series = series.filter(([, , , points]) => points.length);
    if (!series.length) return null;
    const highest = Math.max(unit ? 0 : 1, ...series.flatMap(([, , , points]) => points.map(([, value]) => value)));
    const power = highest > 0 ? 10 ** Math.floor(Math.log10(highest)) : 1;
    const top = power * [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10].find((item) => item * power >= highest * 0.999);
    const lines = series.map(([, colour, form, points]) => svg("path", { class: `${form} ${colour}`, d: path(
      points.map(([t_s, value]) => [across(t_s).toFixed(1), (100 * (1 - Math.max(value, 0) / top)).toFixed(1)]), form) }));
    const keys = series.map(([name, colour]) => name && html("span", { class: `key ${colour}` }, name));
    return html("figure", { class: "chart" }, html("figcaption", {}, html("b", {}, title), ` ${unit} `, ...keys),
      html("div", { class: "plot" },
        html("div", { class: "scale" }, html("span", {}, figure(top)), html("span", {}, "0")),
        html("div", {}, makeStrip(`${title}, ${unit}`, 100, ...lines), times())));
  }

  // ---- The ground: squares or pictures of the places, with the layers above them.
  const square = ([x, y, side, up_deg]) =>
    ({ x: -side / 2, y: -side / 2, width: side, height: side, transform: `translate(${x} ${y}) rotate(${up_deg})` });
  function drawGround() {
    const [, , wide, high] = ground.box, shape = Math.min(Math.max(wide / high, 0.56), 1.8);
    const images = ground.squares.map((item) => (item[4] === null ? null
      : svg("image", { class: "layer-ground", href: pictures[item[4]], ...square(item) }))).filter(Boolean);
    const squares = images.length ? [] : ground.squares.map((item) => svg("rect", { class: "footprints layer-ground", ...square(item) }));
    const paths = ground.layers.map(({ colour, form, polylines }) => svg("path", {
      class: `${form} ${colour} layer-${colour}`, d: polylines.map((line) => path(line, form)).join("") }));
    const names = [...(ground.squares.length ? [["ground", "ground in the images"]] : []),
      ...ground.layers.map(({ colour, name }) => [colour, name])];
    const keys = names.map(([colour, name]) => {
      const box = html("input", { type: "checkbox", checked: true });
      box.onchange = () => {
        for (const item of all(`.layer-${colour}`)) item.style.display = box.checked ? "" : "none";
      };
      return html("label", { class: `key ${colour}` }, box, name);
    });
    const zooms = [[2, "zoom in", "+"], [0.5, "zoom out", "−"], [0, "show all", "⤢"]].map(([factor, label, text]) =>
      html("button", { type: "button", "data-zoom": factor, "aria-label": label }, text));
    return [html("div", { class: "legend" }, ...keys),
      html("div", { class: "view", style: `aspect-ratio:${shape};max-width:${80 * shape}vh` },
        svg("svg", { role: "img", "aria-label": "the ground of the map", viewBox: ground.box.join(" ") },
          ...squares, ...images, ...paths, svg("g", { id: "now-at" })),
        html("div", { class: "ruler", hidden: true }), html("div", { class: "north" }, "N ↑"),
        html("div", { class: "zoom", hidden: true }, ...zooms))];
  }

  function makeStepper() {
    const slide = html("div", { class: "slide" }, html("button", { type: "button", id: "play", "aria-label": "play" }, "▶"),
      html("input", { type: "range", id: "step", min: 0, value: 0, "aria-label": "step" }), html("output", { id: "which", for: "step" }));
    const now = html("div", { class: "now" }, html("h3"), html("div"), html("div", { class: "pair" }));
    return html("div", { class: "stepper" }, slide, now);
  }

  // Check boxes that filter the steps, each with its count and, if steps have times, a lane that shows them.
  function makeFilters() {
    const rows = groups.flatMap(([group, colour, count], number) => [
      html("label", {}, html("input", { type: "checkbox", "data-group": number }), group, " ", html("b", {}, `${count}`)),
      has_times && makeStrip(group, 20, svg("path", { class: `mark ${colour}`, "data-lane": number }))].filter(Boolean));
    const inside = has_times ? html("div", { class: "lanes" }, ...rows, html("span"), times()) : html("div", { class: "boxes" }, ...rows);
    return html("details", { class: "choose", open: true }, html("summary", {}, "Filter steps"), inside);
  }

  function makeSection({ title, lines, rows, folded }) {
    const [first, ...others] = rows.map((row, index) => html("tr", {}, ...row.map((text) => html(index ? "td" : "th", {}, text))));
    const table = first && html("div", { class: "scroll" }, html("table", {}, first, ...others));
    const details = folded ? html("details", {}, html("summary", {}, "configuration"), html("pre", {}, folded)) : null;
    return section(title, ...lines.map((line) => html("p", {}, line)), table, details);
  }

  document.title = data.title;
  const charts = data.charts.map(drawChart).filter(Boolean);
  const notes = data.notes.length ? html("p", { class: "soft" }, data.notes.join(" ")) : null;
  const explored = ground || steps.length ? section(ground ? "Over the ground" : "Step by step",
    html("div", { class: "ground" }, ...(ground ? drawGround() : []), ...(steps.length ? [makeStepper(), makeFilters()] : []), notes)) : null;
  const figures = data.figures.map(([name, text]) => html("div", {}, html("dt", {}, name), html("dd", {}, text)));
  document.body.append(...[
    html("h1", {}, data.title), html("p", { class: "soft" }, data.known.join(", ")),
    section("", html("dl", { class: "figures" }, ...figures)),
    data.warnings.length ? html("section", { class: "notes" }, html("ul", {}, ...data.warnings.map((item) => html("li", {}, item)))) : null,
    explored,
    charts.length ? section("Over time", html("div", { class: "charts" }, ...charts)) : null,
    ...data.sections.map(makeSection)].filter(Boolean));

  const view = find(".view"), plan = view && find("svg", view), nowAt = document.getElementById("now-at");
  const slider = document.getElementById("step"), play = document.getElementById("play");
  let visibleSteps = steps, now = steps[0];

  // ---- Zoom and pan: the visible part of the drawing is the viewBox of its SVG, in metres.
  function fit([left, top, wide, high]) { // extends the box to the shape of the view
    const shape = Math.min(Math.max(wide / high, 0.56), 1.8), width = Math.max(wide, high * shape), height = width / shape;
    return [left - (width - wide) / 2, top - (height - high) / 2, width, height];
  }
  const MAX_ZOOM = 60;
  const fullBox = ground ? fit(ground.box) : [0, 0, 1000, 1000];
  let box = fullBox;
  const zoomed = () => fullBox[2] / box[2];

  function setView(x, y, wide) {
    wide = Math.min(Math.max(wide, fullBox[2] / MAX_ZOOM), fullBox[2]);
    const high = wide * fullBox[3] / fullBox[2];
    const clamp = (min, max, value) => Math.min(Math.max(value, min), max);
    box = [clamp(fullBox[0], fullBox[0] + fullBox[2] - wide, x), clamp(fullBox[1], fullBox[1] + fullBox[3] - high, y), wide, high];
    plan.setAttribute("viewBox", box.join(" "));
    view.style.touchAction = zoomed() > 1.01 ? "none" : "pan-x pan-y"; // unzoomed, a finger scrolls the page
    const maxLength = box[2] / 4, power = 10 ** Math.floor(Math.log10(maxLength)); // a quarter of the width
    const length = [5, 2, 1].map((item) => item * power).find((item) => item <= maxLength);
    const ruler = find(".ruler", view);
    ruler.hidden = false;
    ruler.style.width = `${100 * length / box[2]}%`;
    ruler.textContent = length < 1000 ? `${+length.toPrecision(1)} m` : `${length / 1000} km`;
  }
  // Zoom about the point at [right, down] in the view, 0 to 1 each.
  const zoom = (factor, right = 0.5, down = 0.5) => {
    const wide = Math.min(Math.max(box[2] / factor, fullBox[2] / MAX_ZOOM), fullBox[2]);
    setView(box[0] + right * (box[2] - wide), box[1] + down * (box[3] - wide * fullBox[3] / fullBox[2]), wide);
  };
  const pan = (right, down) => setView(box[0] + right * box[2], box[1] + down * box[3], box[2]);
  const toViewFraction = (event) => {
    const frame = view.getBoundingClientRect();
    return [(event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height];
  };

  function moveGround() {
    view.tabIndex = 0;
    view.setAttribute("role", "application");
    view.setAttribute("aria-label", "the ground: plus and minus zoom, arrows move, 0 shows all");
    const keys = {
      "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), "0": () => setView(...fullBox),
      ArrowLeft: () => pan(-0.15, 0), ArrowRight: () => pan(0.15, 0),
      ArrowUp: () => pan(0, -0.15), ArrowDown: () => pan(0, 0.15),
    };
    view.addEventListener("keydown", (event) => {
      if (!keys[event.key] || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key]();
    });
    // The wheel scrolls the page unless the ground has the focus; a pinch on a touchpad arrives as a wheel with Ctrl.
    view.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== view) return;
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.002)), ...toViewFraction(event));
    }, { passive: false });
    const fingers = new Map();
    let moved = 0;
    view.addEventListener("pointerdown", (event) => {
      if (event.target.closest("button")) return;
      if (!fingers.size) moved = 0;
      fingers.set(event.pointerId, toViewFraction(event));
    });
    view.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const after = toViewFraction(event), others = [...fingers].filter(([id]) => id !== event.pointerId);
      const [right, down] = [after[0] - before[0], after[1] - before[1]];
      moved += Math.hypot(right * view.clientWidth, down * view.clientHeight);
      if (others.length) {
        const other = others[0][1], distanceTo = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1e-6;
        zoom(distanceTo(after) / distanceTo(before), ...other);
      } else if (zoomed() > 1.01) {
        pan(-right, -down);
      }
      if (moved > 5) view.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, after);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      view.addEventListener(end, (event) => {
        if (fingers.delete(event.pointerId) && end === "pointerup" && moved <= 5 && !fingers.size) choose(toViewFraction(event));
      });
    }
    for (const button of all("[data-zoom]", view)) {
      button.onclick = () => (+button.dataset.zoom ? zoom(+button.dataset.zoom) : setView(...fullBox));
    }
    find(".zoom", view).hidden = false;
    setView(...fullBox);
  }

  // ---- The current step: its texts, its pictures, and its points on the ground.
  function show(step) {
    now = step;
    const index = visibleSteps.indexOf(step), panel = find(".now");
    slider.value = index;
    document.getElementById("which").textContent = visibleSteps.length ? `${index + 1} of ${visibleSteps.length}` : "none";
    find("h3", panel).textContent = step ? step.title : "No step passes the filter: select more below.";
    const texts = find("div", panel), pair = find(".pair", panel);
    texts.textContent = pair.textContent = "";
    nowAt && (nowAt.textContent = "");
    for (const line of all(".cursor")) line.remove();
    if (!step) return;
    slider.setAttribute("aria-valuetext", step.title);
    texts.append(...step.texts.map((text) => html("p", {}, text)));
    pair.append(...step.pictures.map(([caption, number]) => html("figure", {},
      html("img", { src: pictures[number], alt: caption }), html("figcaption", {}, caption))));
    if (has_times) {
      for (const item of all('svg[preserveAspectRatio="none"]')) {
        item.append(svg("path", { class: "cursor", d: `M${across(step.t_s)} 0V${item.viewBox.baseVal.height}` }));
      }
    }
    if (nowAt) {
      const points = Object.entries(step.points), last = points.length && points[points.length - 1][1];
      if (step.square) nowAt.append(svg("rect", { class: "square", ...square(step.square) }));
      if (last && step.circle) nowAt.append(svg("circle", { class: "claimed", cx: last[0], cy: last[1], r: step.circle }));
      nowAt.append(...points.map(([name, [x, y]]) => svg("path", { class: `spot ${name}`, d: `M${x} ${y}h0` })));
      if (last && zoomed() > 1.01) panTo(last);
    }
  }
  const panTo = ([x, y]) => { // pans until the point is in the view
    const inside = x > box[0] && x < box[0] + box[2] && y > box[1] && y < box[1] + box[3];
    if (!inside) setView(x - box[2] / 2, y - box[3] / 2, box[2]);
  };
  function choose([right, down]) {
    const [x, y] = [box[0] + right * box[2], box[1] + down * box[3]];
    const distance = (step) => Math.min(...Object.values(step.points).map((point) => Math.hypot(point[0] - x, point[1] - y)));
    const closest = nearest(visibleSteps, distance);
    if (closest && distance(closest) < 40 * box[2] / view.clientWidth) show(closest);
  }
  const nearest = (candidates, distance) => candidates.reduce((best, item) => (!best || distance(item) < distance(best) ? item : best), null);

  const inLane = (marks) => visibleSteps.filter((step) => step.groups.includes(+marks.dataset.lane));

  // ---- Filter steps by their groups: the others are hidden on the ground, in the lanes and by the slider.
  function filter() {
    const selected = new Set(all("[data-group]:checked").map((item) => +item.dataset.group));
    visibleSteps = selected.size ? steps.filter((step) => step.groups.some((group) => selected.has(group))) : steps;
    slider.max = Math.max(0, visibleSteps.length - 1);
    for (const name of new Set(steps.flatMap((step) => Object.keys(step.points)))) {
      const dots = view && find(`.dots.layer-${name}`, view);
      dots && dots.setAttribute("d", visibleSteps.filter((step) => step.points[name]).map(({ points }) => `M${points[name].join(" ")}h0`).join(""));
    }
    for (const marks of all("[data-lane]")) {
      marks.setAttribute("d", inLane(marks).map((step) => `M${across(step.t_s).toFixed(1)} 0v20`).join(""));
    }
    show(visibleSteps.includes(now) ? now : visibleSteps[0]);
  }

  // ---- Start.
  if (view) moveGround();
  if (!steps.length) return;
  slider.oninput = () => show(visibleSteps[slider.value]);
  let timer = null;
  const stop = () => {
    clearInterval(timer);
    timer = null;
    play.textContent = "▶";
    play.setAttribute("aria-label", "play");
  };
  play.onclick = () => {
    if (timer) return stop();
    play.textContent = "❚❚";
    play.setAttribute("aria-label", "pause");
    if (+slider.value === visibleSteps.length - 1) show(visibleSteps[0]);
    timer = setInterval(() => {
      const next = visibleSteps[+slider.value + 1];
      next ? show(next) : stop();
    }, Math.min(500, Math.max(60, 40000 / visibleSteps.length)));
  };
  for (const box of all("[data-group]")) box.onchange = filter;
  for (const marks of all("[data-lane]")) {
    const lane = marks.closest("svg");
    lane.addEventListener("click", (event) => {
      const frame = lane.getBoundingClientRect(), x = 1000 * (event.clientX - frame.left) / frame.width;
      const closest = nearest(inLane(marks), (step) => Math.abs(across(step.t_s) - x));
      closest && show(closest);
    });
  }
  filter();
})();
