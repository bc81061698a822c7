"use strict";
// A figure of capsules that moves: drag to turn, wheel or two fingers to zoom. World: z up, metres.
document.querySelectorAll(".player").forEach(place => {
  const data = JSON.parse(place.querySelector("script").textContent);
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const x = new Int16Array(bytes(data.x).buffer), dim = data.dimmed ? bytes(data.dimmed) : null;
  const { frames, points, quantum, middle, ends, radii, colours, cameras } = data;
  let { low, high, floor } = data;
  const last = frames - 1, duration = last / data.rate;
  const size = Math.hypot(...high.map((h, i) => h - low[i])), tall = high[2] - low[2];
  const home = { turn: 0.7, tilt: 0.22, zoom: 1 };
  const view = { ...home, follow: size > 2.2 * tall, cameras: false };
  let at = 0, playing = false, speed = 1, before = 0, moved = null;  // moved: points and lost ones of a live figure

  const make = (tag, parent, fields = {}) => parent.appendChild(Object.assign(document.createElement(tag), fields));
  const canvas = make("canvas", place), pen = canvas.getContext("2d");
  canvas.setAttribute("aria-label", "Moving 3D figure: drag to turn it");
  const bar = make("div", place, { className: "bar" });
  const play = make("button", bar, { textContent: "Play", onclick: () => run(!playing) });
  const slider = make("input", bar, { type: "range", min: 0, max: Math.max(last, 1), step: "any", value: 0 });
  slider.setAttribute("aria-label", "time");
  const clock = make("span", bar, { className: "at" });
  const pick = make("select", bar, { title: "speed", onchange: () => speed = +pick.value });
  for (const [value, text] of [[1, "speed 1"], [0.5, "½"], [0.25, "¼"], [0.1, "⅒"]]) make("option", pick, { value, textContent: text });
  const button = (text, act) => make("button", bar, { textContent: text, onclick: () => { act(); draw(); } });
  button("Front", () => Object.assign(view, { turn: heading(), tilt: 0.08 }));
  button("Side", () => Object.assign(view, { turn: heading() - Math.PI / 2, tilt: 0.08 }));
  button("Top", () => Object.assign(view, { tilt: Math.PI / 2 - 0.01 }));
  button("Follow", () => view.follow = !view.follow);
  if (cameras.length) button("Cameras", () => { view.cameras = !view.cameras; view.follow = false; view.zoom = 1; });
  button("+", () => view.zoom *= 1.25);
  button("−", () => view.zoom /= 1.25);

  // Points of the time `at`, in frames: straight between two frames.
  function pose() {
    if (moved) return moved.points;
    const a = Math.min(Math.floor(at), last), b = Math.min(a + 1, last), s = at - a, out = [];
    for (let p = 0; p < points; p++) {
      const i = 3 * (a * points + p), j = 3 * (b * points + p);
      out.push([0, 1, 2].map(k => middle[k] + quantum * ((1 - s) * x[i + k] + s * x[j + k])));
    }
    return out;
  }
  // Direction in which the person looks: at right angles to the line from the left half of the body to the right.
  function heading() {
    const now = pose(), sum = [0, 0];
    ends.forEach(([a], c) => { sum[0] += data.sides[c] * now[a][0]; sum[1] += data.sides[c] * now[a][1]; });
    return Math.atan2(sum[0], -sum[1]);
  }
  function centre(now) {
    const all = view.cameras ? [low, high, ...cameras.map(c => c.points[0])] : view.follow ? now : [low, high];
    return [0, 1, 2].map(k => { const v = all.map(p => p[k]); return (Math.min(...v) + Math.max(...v)) / 2; });
  }
  function extent() {
    if (view.cameras) {
      const c = centre(); return 1.35 * Math.max(...cameras.map(k => Math.hypot(...k.points[0].map((v, i) => v - c[i]))));
    }
    return view.follow ? 1.25 * Math.max(tall, 1) : Math.max(0.72 * size, 1.2 * tall);
  }

  function draw() {
    const scale = devicePixelRatio || 1, W = canvas.clientWidth, H = canvas.clientHeight;
    if (!W) return;
    if (canvas.width !== Math.round(W * scale)) { canvas.width = Math.round(W * scale); canvas.height = Math.round(H * scale); }
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, W, H);
    const now = pose(), c = centre(now), far = 2.5 * extent() / view.zoom;
    const focal = 2.1 * Math.min(W, H), ct = Math.cos(view.turn), st = Math.sin(view.turn);
    const cu = Math.cos(view.tilt), su = Math.sin(view.tilt);
    // Screen x, y, scale [px/m] and depth of a point; the eye stands at the turn's azimuth.
    const project = p => {
      const dx = p[0] - c[0], dy = p[1] - c[1], dz = p[2] - c[2];
      const right = -st * dx + ct * dy, away = -(ct * dx + st * dy), up = dz * cu + away * su;
      const depth = far + away * cu - dz * su, f = focal / Math.max(depth, 0.05);
      return [W / 2 + f * right, H / 2 - f * up, f, depth];
    };
    grid(project, c, far);
    const a = Math.min(Math.round(at), last), parts = [];
    ends.forEach(([i, j], k) => {
      const P = project(now[i]), Q = project(now[j]), bit = a * ends.length + k;
      parts.push([Math.max(P[3], Q[3]) + Math.min(P[3], Q[3]), () => capsule(P, Q, radii[k], colours[k],
        moved ? moved.lost[k] : dim && dim[bit >> 3] >> (7 - bit % 8) & 1)]);
    });
    if (view.cameras) for (const camera of cameras) {
      const q = camera.points.map(project);
      parts.push([2 * q[0][3], () => pyramid(q, camera.name)]);
    }
    parts.sort((p, q) => q[0] - p[0]).forEach(part => part[1]());
    slider.value = at;
    if (!moved) clock.textContent = `${(data.start + at / data.rate).toFixed(2)} s`;
  }
  function grid(project, c, far) {
    const wide = view.cameras ? 2 * extent() : size, step = wide > 12 ? 2 : wide > 5 ? 1 : 0.5;
    const around = view.cameras ? extent() / 1.5 : 0.75;
    const box = [0, 1].map(k => [Math.floor(((view.cameras ? c[k] : low[k]) - around) / step) * step,
      Math.ceil(((view.cameras ? c[k] : high[k]) + around) / step) * step]);
    pen.lineWidth = 1; pen.strokeStyle = "#cfd8df"; pen.beginPath();
    const segment = (p, q) => { const P = project(p), Q = project(q);
      if (P[3] > 0.1 && Q[3] > 0.1) { pen.moveTo(P[0], P[1]); pen.lineTo(Q[0], Q[1]); } };
    for (let v = box[0][0]; v <= box[0][1] + 1e-6; v += step) segment([v, box[1][0], floor], [v, box[1][1], floor]);
    for (let v = box[1][0]; v <= box[1][1] + 1e-6; v += step) segment([box[0][0], v, floor], [box[0][1], v, floor]);
    pen.stroke();
    pen.fillStyle = "#5b6875"; pen.font = "12px system-ui, sans-serif";
    pen.fillText(`grid ${step} m`, 10, canvas.clientHeight - 10);
  }
  const shade = (hex, factor) => "rgb(" + [1, 3, 5].map(i => {
    const v = parseInt(hex.slice(i, i + 2), 16); return Math.round(factor < 1 ? v * factor : v + (255 - v) * (factor - 1)); }) + ")";
  function capsule(P, Q, [r, s], colour, lost) {
    r *= P[2]; s *= Q[2];
    const dx = Q[0] - P[0], dy = Q[1] - P[1], d = Math.hypot(dx, dy);
    pen.beginPath();
    if (d <= Math.abs(r - s) + 1e-6) {
      const [C, R] = r > s ? [P, r] : [Q, s];
      pen.arc(C[0], C[1], R, 0, 7);
    } else {
      const along = Math.atan2(dy, dx), half = Math.acos((r - s) / d);
      pen.arc(P[0], P[1], r, along + half, along - half + 2 * Math.PI);
      pen.arc(Q[0], Q[1], s, along - half, along + half);
      pen.closePath();
    }
    const wide = Math.max(r, s), nx = d > 1e-6 ? -dy / d : 0, ny = d > 1e-6 ? dx / d : 1, up = ny > 0 ? -1 : 1;
    const light = pen.createLinearGradient(P[0] + up * nx * wide, P[1] + up * ny * wide, P[0] - up * nx * wide, P[1] - up * ny * wide);
    const tone = lost ? data.lost : colour;
    light.addColorStop(0, shade(tone, 1.25)); light.addColorStop(0.35, shade(tone, 1.08)); light.addColorStop(1, shade(tone, 0.62));
    pen.fillStyle = light; pen.globalAlpha = lost ? 0.35 : 1; pen.fill(); pen.globalAlpha = 1;
    pen.setLineDash(lost ? [5, 4] : []);
    pen.strokeStyle = shade(tone, 0.5); pen.lineWidth = lost ? 1.4 : 0.8; pen.stroke();
    pen.setLineDash([]);
  }
  function pyramid(q, name) {
    if (q.some(p => p[3] < 0.1)) return;
    pen.strokeStyle = "#37474f"; pen.lineWidth = 1.3; pen.beginPath();
    for (let i = 1; i < 5; i++) { const n = q[i % 4 + 1];
      pen.moveTo(q[0][0], q[0][1]); pen.lineTo(q[i][0], q[i][1]); pen.lineTo(n[0], n[1]); }
    pen.stroke();
    pen.fillStyle = "#1d2733"; pen.font = "13px system-ui, sans-serif"; pen.fillText(name, q[0][0] + 7, q[0][1] - 7);
  }

  function run(go) {
    playing = go && last > 0; play.textContent = playing ? "Pause" : "Play";
    if (playing) { if (at >= last) at = 0; before = performance.now(); requestAnimationFrame(tick); }
  }
  function tick(time) {
    if (!playing) return;
    at += Math.max(0, time - before) / 1000 * data.rate * speed; before = time;
    if (at >= last) at = duration > 0.2 ? at % last : last;
    draw(); requestAnimationFrame(tick);
  }
  slider.addEventListener("input", () => { run(false); at = Math.min(+slider.value, last); draw(); });
  document.addEventListener("seek", event => {
    run(false); at = Math.min(Math.max((event.detail - data.start) * data.rate, 0), last); draw();
  });
  place.move = (points, lost) => {
    const first = !moved, lowest = Math.min(...points.map((p, i) => p[2] - radii[i >> 1][i % 2]));
    moved = { points, lost };
    [low, high] = [Math.min, Math.max].map(most => [0, 1, 2].map(k => most(...points.map(p => p[k]))));
    floor = first ? lowest : Math.min(floor, lowest);
    if (first) Object.assign(view, { turn: heading() + 0.6, follow: true });
    draw();
  };
  const fingers = new Map();
  canvas.addEventListener("pointerdown", e => { fingers.set(e.pointerId, [e.clientX, e.clientY]); canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointermove", e => {
    const old = fingers.get(e.pointerId);
    if (!old) return;
    const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    const was = fingers.size === 2 ? apart() : 0;
    fingers.set(e.pointerId, [e.clientX, e.clientY]);
    if (fingers.size === 2) view.zoom *= apart() / Math.max(was, 1);
    else {
      view.turn -= (e.clientX - old[0]) * 0.008;
      view.tilt = Math.min(Math.max(view.tilt + (e.clientY - old[1]) * 0.006, -0.3), Math.PI / 2 - 0.01);
    }
    draw();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, e => fingers.delete(e.pointerId));
  canvas.addEventListener("wheel", e => { if (!e.ctrlKey && !e.altKey && !fingers.size && document.activeElement !== canvas) return;
    e.preventDefault(); view.zoom *= Math.exp(-e.deltaY * 0.0015); draw(); }, { passive: false });
  canvas.tabIndex = 0;
  view.turn = heading() + 0.6;
  new ResizeObserver(draw).observe(canvas);
  draw();
});
