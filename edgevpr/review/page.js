// Moves the ground and its steps. All that it knows is in the page: the data block "steps", and the drawings.
"use strict";
(() => {
  const block = document.getElementById("steps");
  if (!block) return;
  const { steps, pictures } = JSON.parse(block.textContent);
  const find = (query, within = document) => within.querySelector(query);
  const all = (query, within = document) => [...within.querySelectorAll(query)];
  const view = find(".view"), svg = view && find("svg", view), nowAt = document.getElementById("now-at");
  const slider = document.getElementById("step"), play = document.getElementById("play");
  let shown = steps, now = steps[0], marked = [];

  // ---- Zoom and pan: the part of the drawing that is seen is the viewBox of its SVG, in metres.
  const MOST = 60; // times
  const whole = svg ? svg.getAttribute("viewBox").split(" ").map(Number) : [0, 0, 1000, 1000];
  let box = whole;
  const zoomed = () => whole[2] / box[2];

  function look(x, y, wide) {
    wide = Math.min(Math.max(wide, whole[2] / MOST), whole[2]);
    const high = wide * whole[3] / whole[2];
    const within = (least, most, value) => Math.min(Math.max(value, least), most);
    box = [within(whole[0], whole[0] + whole[2] - wide, x), within(whole[1], whole[1] + whole[3] - high, y), wide, high];
    svg.setAttribute("viewBox", box.join(" "));
    view.style.touchAction = zoomed() > 1.01 ? "none" : "pan-x pan-y"; // unzoomed, a finger scrolls the page
    const most = box[2] / 4, power = 10 ** Math.floor(Math.log10(most)); // a quarter of the width
    const length = [5, 2, 1].map((each) => each * power).find((each) => each <= most);
    const ruler = find(".ruler", view);
    ruler.hidden = false;
    ruler.style.width = `${100 * length / box[2]}%`;
    ruler.textContent = length < 1000 ? `${+length.toPrecision(1)} m` : `${length / 1000} km`;
  }
  // Zoom about the point that is [across, down] of the view, 0 to 1 each.
  const zoom = (by, across = 0.5, down = 0.5) => {
    const wide = Math.min(Math.max(box[2] / by, whole[2] / MOST), whole[2]);
    look(box[0] + across * (box[2] - wide), box[1] + down * (box[3] - wide * whole[3] / whole[2]), wide);
  };
  const pan = (across, down) => look(box[0] + across * box[2], box[1] + down * box[3], box[2]);
  const share = (event) => {
    const frame = view.getBoundingClientRect();
    return [(event.clientX - frame.left) / frame.width, (event.clientY - frame.top) / frame.height];
  };

  function moveGround() {
    view.tabIndex = 0;
    view.setAttribute("role", "application");
    view.setAttribute("aria-label", "the ground: plus and minus zoom, arrows move, 0 shows all");
    const keys = {
      "+": () => zoom(1.5), "=": () => zoom(1.5), "-": () => zoom(1 / 1.5), "0": () => look(...whole),
      ArrowLeft: () => pan(-0.15, 0), ArrowRight: () => pan(0.15, 0),
      ArrowUp: () => pan(0, -0.15), ArrowDown: () => pan(0, 0.15),
    };
    view.addEventListener("keydown", (event) => {
      if (!keys[event.key] || event.ctrlKey || event.altKey || event.metaKey) return;
      event.preventDefault();
      keys[event.key]();
    });
    // A wheel scrolls the page until the ground has the focus; a pinch on a touchpad comes as a wheel with Ctrl.
    view.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && document.activeElement !== view) return;
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.002)), ...share(event));
    }, { passive: false });
    const fingers = new Map();
    let moved = 0;
    view.addEventListener("pointerdown", (event) => {
      if (event.target.closest("button")) return;
      if (!fingers.size) moved = 0;
      fingers.set(event.pointerId, share(event));
    });
    view.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const here = share(event), others = [...fingers].filter(([id]) => id !== event.pointerId);
      const [across, down] = [here[0] - before[0], here[1] - before[1]];
      moved += Math.hypot(across * view.clientWidth, down * view.clientHeight);
      if (others.length) {
        const other = others[0][1], far = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]) || 1e-6;
        zoom(far(here) / far(before), ...other);
      } else if (zoomed() > 1.01) {
        pan(-across, -down);
      }
      if (moved > 5) view.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, here);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      view.addEventListener(end, (event) => {
        if (fingers.delete(event.pointerId) && end === "pointerup" && moved <= 5 && !fingers.size) choose(share(event));
      });
    }
    for (const button of all("[data-zoom]", view)) {
      button.onclick = () => (+button.dataset.zoom ? zoom(+button.dataset.zoom) : look(...whole));
    }
    find(".zoom", view).hidden = false;
    look(...whole);
  }

  // ---- The step that is shown: its texts, its pictures, and its points over the ground.
  function element(name, text, parent, attributes = {}) {
    const made = document.createElement(name);
    made.textContent = text;
    Object.assign(made, attributes);
    parent.append(made);
    return made;
  }
  function draw(name, attributes, parent = nowAt) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    parent.append(made);
  }

  function show(step) {
    now = step;
    const at = shown.indexOf(step), panel = find(".now");
    slider.value = at;
    document.getElementById("which").textContent = shown.length ? `${at + 1} of ${shown.length}` : "none";
    find("h3", panel).textContent = step ? step.title : "Nothing is left: show more below.";
    const said = find("div", panel), pair = find(".pair", panel);
    said.textContent = pair.textContent = "";
    nowAt && (nowAt.textContent = "");
    for (const line of all(".cursor")) line.remove();
    if (!step) return;
    slider.setAttribute("aria-valuetext", step.title);
    for (const each of step.said) element("p", each, said);
    for (const [caption, number] of step.pictures) {
      const figure = element("figure", "", pair);
      element("img", "", figure, { src: pictures[number], alt: caption });
      element("figcaption", caption, figure);
    }
    if (step.x !== null) {
      for (const chart of all('svg[preserveAspectRatio="none"]')) {
        draw("path", { class: "cursor", d: `M${step.x} 0V${chart.viewBox.baseVal.height}` }, chart);
      }
    }
    if (nowAt) {
      const points = Object.entries(step.at), last = points.length && points[points.length - 1][1];
      if (step.square) draw("path", { class: "square", d: step.square });
      if (last && step.circle) draw("circle", { class: "claimed", cx: last[0], cy: last[1], r: step.circle });
      for (const [name, [x, y]] of points) draw("path", { class: `spot ${name}`, d: `M${x} ${y}h0` });
      if (last && zoomed() > 1.01) bring(last);
    }
  }
  const bring = ([x, y]) => { // into the view
    const inside = x > box[0] && x < box[0] + box[2] && y > box[1] && y < box[1] + box[3];
    if (!inside) look(x - box[2] / 2, y - box[3] / 2, box[2]);
  };
  function choose([across, down]) {
    const [x, y] = [box[0] + across * box[2], box[1] + down * box[3]];
    const away = (step) => Math.min(...Object.values(step.at).map((point) => Math.hypot(point[0] - x, point[1] - y)));
    const near = nearest(shown, away);
    if (near && away(near) < 40 * box[2] / view.clientWidth) show(near);
  }
  const nearest = (among, away) => among.reduce((best, each) => (!best || away(each) < away(best) ? each : best), null);

  const inLane = (marks) => shown.filter((step) => step.groups.includes(+marks.dataset.lane));

  // ---- Choosing steps by their groups: the others vanish from ground, lanes and slider.
  function filter() {
    const wanted = new Set(all("[data-group]:checked").map((each) => +each.dataset.group));
    shown = wanted.size ? steps.filter((step) => step.groups.some((group) => wanted.has(group))) : steps;
    slider.max = Math.max(0, shown.length - 1);
    for (const name of new Set(steps.flatMap((step) => Object.keys(step.at)))) {
      const dots = view && find(`.dots.layer-${name}`, view);
      dots && dots.setAttribute("d", shown.filter((step) => step.at[name]).map(({ at }) => `M${at[name].join(" ")}h0`).join(""));
    }
    for (const marks of all("[data-lane]")) {
      marks.setAttribute("d", inLane(marks).map((step) => `M${step.x} 0v20`).join(""));
    }
    show(shown.includes(now) ? now : shown[0]);
  }

  // ---- Put together.
  if (view) moveGround();
  if (!slider || !steps.length) return;
  find(".stepper").hidden = false;
  slider.oninput = () => show(shown[slider.value]);
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
    if (+slider.value === shown.length - 1) show(shown[0]);
    timer = setInterval(() => {
      const next = shown[+slider.value + 1];
      next ? show(next) : stop();
    }, Math.min(500, Math.max(60, 40000 / shown.length)));
  };
  for (const box of all("[data-group]")) box.onchange = filter;
  for (const marks of all("[data-lane]")) {
    const lane = marks.closest("svg");
    lane.addEventListener("click", (event) => {
      const frame = lane.getBoundingClientRect(), x = 1000 * (event.clientX - frame.left) / frame.width;
      const near = nearest(inLane(marks), (step) => Math.abs(step.x - x));
      near && show(near);
    });
  }
  filter();
})();
