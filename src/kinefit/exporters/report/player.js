"use strict";
// A skin or cylinders that move: drag to turn, wheel or two fingers to zoom. World: z up, metres.
document.querySelectorAll(".player").forEach(place => {
  const data = JSON.parse(place.querySelector("script").textContent);
  const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const x = new Int16Array(bytes(data.poses).buffer), [lost, uncertain] = [data.lost, data.uncertain].map(t => t && bytes(t));
  const { frames, segments, quantum, middle, owners, radii, colours, cameras } = data;
  const skin = data.skin && painter(data, bytes);
  let { low, high, floor } = data;
  const last = frames - 1, duration = last / data.rate;
  const size = Math.hypot(...high.map((h, i) => h - low[i])), tall = high[2] - low[2];
  const home = { turn: 0.7, tilt: 0.22, zoom: 1 };
  const view = { ...home, follow: size > 2.2 * tall, cameras: false, cylinders: !skin };
  let at = 0, playing = false, speed = 1, before = 0, waiting = null, moved = null;  // moved: a live figure's poses, lost and uncertain segments

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
  if (skin) button("Cylinders", () => view.cylinders = !view.cylinders);
  button("+", () => view.zoom *= 1.25);
  button("−", () => view.zoom /= 1.25);

  // A rotation and a place, three rows of four, of [x, y, z, w, a, b, c].
  function rigid([px, py, pz, ...q]) {
    const [w, a, b, c] = q.map(v => v / Math.hypot(...q));
    return [1 - 2 * (b * b + c * c), 2 * (a * b - c * w), 2 * (a * c + b * w), px, 2 * (a * b + c * w), 1 - 2 * (a * a + c * c),
      2 * (b * c - a * w), py, 2 * (a * c - b * w), 2 * (b * c + a * w), 1 - 2 * (a * a + b * b), pz];
  }
  const placed = (m, [a, b, c]) => [0, 4, 8].map(k => m[k] * a + m[k + 1] * b + m[k + 2] * c + m[k + 3]);
  function stored(frame, segment) {
    const i = 6 * (frame * segments + segment), v = [3, 4, 5].map(k => x[i + k] / 32767);
    return [...[0, 1, 2].map(k => middle[k] + quantum * x[i + k]), Math.sqrt(Math.max(0, 1 - v.reduce((t, u) => t + u * u, 0))), ...v];
  }
  // Poses of the segments at the time `at`, in frames: straight between two frames.
  function poses() {
    if (moved) return moved.poses;
    const a = Math.min(Math.floor(at), last), b = Math.min(a + 1, last), s = at - a;
    return colours.map((_, k) => {
      const p = stored(a, k), q = stored(b, k), sign = p.reduce((t, u, i) => i < 3 ? t : t + u * q[i], 0) < 0 ? -1 : 1;
      return rigid(p.map((v, i) => (1 - s) * v + s * (i < 3 ? 1 : sign) * q[i]));
    });
  }
  const points = now => data.ends.map((end, k) => placed(now[owners[k]], end));
  // Colour, opacity and whether it is lost, of every segment.
  function looks() {
    const a = Math.min(Math.round(at), last), told = (packed, k, i) => moved ? moved[k].has(i)
      : packed && packed[a * segments + i >> 3] >> (7 - (a * segments + i) % 8) & 1;
    return colours.map((colour, i) => told(lost, "lost", i) ? [data.lost_colour, data.opacities[0], true]
      : [colour, told(uncertain, "uncertain", i) ? data.opacities[1] : 1, false]);
  }
  // Direction in which the person looks: at right angles to the line from the left half of the body to the right.
  function heading() {
    const sum = [0, 0];
    poses().forEach((m, k) => { sum[0] += data.sides[k] * m[3]; sum[1] += data.sides[k] * m[7]; });
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
    const places = poses(), now = points(places), look = looks(), c = centre(now), far = 2.5 * extent() / view.zoom;
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
    const parts = [], limbs = radii.map((both, k) => [project(now[2 * k]), project(now[2 * k + 1]), both, look[owners[2 * k]]]);
    if (view.cylinders) for (const limb of limbs) {
      parts.push([Math.max(limb[0][3], limb[1][3]) + Math.min(limb[0][3], limb[1][3]), () => capsule(...limb)]);
    } else parts.push([2 * far, () => {
      pen.drawImage(skin(places, look, { W, H, scale, c, far, focal, ct, st, cu, su }), 0, 0, W, H);
      limbs.forEach(([P, Q, , l]) => l[2] && dashes(P, Q));
    }]);
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
  function dashes(P, Q) {
    pen.setLineDash([7, 5]); pen.lineWidth = 3; pen.strokeStyle = shade(data.lost_colour, 0.6);
    pen.beginPath(); pen.moveTo(P[0], P[1]); pen.lineTo(Q[0], Q[1]); pen.stroke(); pen.setLineDash([]);
  }
  function capsule(P, Q, [r, s], [tone, opacity, gone]) {
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
    light.addColorStop(0, shade(tone, 1.25)); light.addColorStop(0.35, shade(tone, 1.08)); light.addColorStop(1, shade(tone, 0.62));
    pen.fillStyle = light; pen.globalAlpha = opacity; pen.fill(); pen.globalAlpha = 1;
    pen.setLineDash(gone ? [5, 4] : []);
    pen.strokeStyle = shade(tone, 0.5); pen.lineWidth = gone ? 1.4 : 0.8; pen.stroke();
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
  place.move = (given, lost, uncertain) => {
    const first = !moved, turned = data.turn.flatMap(row => [...row, 0]);
    moved = { lost, uncertain, poses: given.map(p => product(turned, rigid(p))) };
    const now = points(moved.poses), lowest = Math.min(...now.map((p, i) => p[2] - radii[i >> 1][i % 2]));
    [low, high] = [Math.min, Math.max].map(most => [0, 1, 2].map(k => most(...now.map(p => p[k]))));
    floor = first ? lowest : Math.min(floor, lowest);
    if (first) Object.assign(view, { turn: heading() + 0.6, follow: true });
    waiting ??= requestAnimationFrame(() => { waiting = null; draw(); });
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

// Product of two rigid motions, three rows of four each.
function product(a, b) {
  return a.map((_, i) => { const r = i & 12, k = i & 3;
    return a[r] * b[k] + a[r + 1] * b[k + 4] + a[r + 2] * b[k + 8] + (k === 3 ? a[r + 3] : 0); });
}

// A function that draws the skin in a pose and returns the canvas with it; null where the browser has no WebGL.
// Vertices follow up to four segments (linear blending). What is translucent shows nothing of its own far side.
function painter(data, bytes) {
  const canvas = document.createElement("canvas"), gl = canvas.getContext("webgl", { antialias: true });
  if (!gl) return null;
  const { skin, rest } = data, rests = new Int16Array(bytes(skin.vertices).buffer), faces = new Uint16Array(bytes(skin.faces).buffer);
  const out = new Int8Array(bytes(skin.normals).buffer), [shown, owners, weights] = [skin.shown, skin.owners, skin.weights].map(bytes);
  const V = shown.length, x = new Float32Array(3 * V), n = new Float32Array(3 * V), tones = new Uint8Array(4 * V);
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, `
    attribute vec3 x; attribute vec3 n; attribute vec4 tone; varying vec3 normal; varying vec4 colour;
    uniform vec3 middle; uniform vec4 turn; uniform vec3 lens;
    vec3 seen(vec3 d) {  // right, up and away
      float away = -turn.x * d.x - turn.y * d.y;
      return vec3(turn.x * d.y - turn.y * d.x, d.z * turn.z + away * turn.w, away * turn.z - d.z * turn.w);
    }
    void main() {
      vec3 p = seen(x - middle); float depth = lens.z + p.z, near = 0.1 * lens.z, far = 10.0 * lens.z;
      normal = seen(n); colour = tone;
      gl_Position = vec4(lens.xy * p.xy, (depth * (far + near) - 2.0 * far * near) / (far - near), depth);
    }`], [gl.FRAGMENT_SHADER, `
    precision mediump float; varying vec3 normal; varying vec4 colour; uniform float opaque;
    void main() {
      if ((colour.a > 0.99) != (opaque > 0.5)) discard;
      vec3 m = normalize(normal);
      float light = 0.5 + 0.6 * max(dot(m, vec3(-0.36, 0.48, -0.8)), 0.0) + 0.12 * m.y, rim = pow(1.0 - abs(m.z), 3.0);
      gl_FragColor = vec4(mix(colour.rgb * light, colour.rgb * 0.55, 0.5 * rim) * colour.a, colour.a);
    }`]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
  }
  gl.linkProgram(program); gl.useProgram(program);
  const buffers = [["x", x, 3, gl.FLOAT], ["n", n, 3, gl.FLOAT], ["tone", tones, 4, gl.UNSIGNED_BYTE]].map(([name, array, size, type]) => {
    const buffer = gl.createBuffer(), place = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, size, type, type === gl.UNSIGNED_BYTE, 0, 0);
    return [buffer, array];
  });
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  gl.enable(gl.DEPTH_TEST); gl.depthFunc(gl.LEQUAL); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  const uniform = name => gl.getUniformLocation(program, name);

  return (poses, looks, { W, H, scale, c, far, focal, ct, st, cu, su }) => {
    const motions = poses.map((m, k) => product(m, [1, 0, 0, -rest[k][0], 0, 1, 0, -rest[k][1], 0, 0, 1, -rest[k][2]]));
    const colours = looks.map(([hex, opacity]) => [1, 3, 5].map(i => parseInt(hex.slice(i, i + 2), 16)).concat(255 * opacity));
    const m = new Float32Array(12);
    for (let v = 0; v < V; v++) {
      m.fill(0);
      for (let j = 4 * v; j < 4 * v + 4; j++) if (weights[j]) {
        const own = motions[owners[j]], w = weights[j] / 255;
        for (let k = 0; k < 12; k++) m[k] += w * own[k];
      }
      const sum = weights[4 * v] + weights[4 * v + 1] + weights[4 * v + 2] + weights[4 * v + 3], f = skin.grain, i = 3 * v;
      for (let k = 0; k < 3; k++) {
        const [a, b, d, t] = [m[4 * k], m[4 * k + 1], m[4 * k + 2], m[4 * k + 3]];
        x[i + k] = 255 / sum * (f * (a * rests[i] + b * rests[i + 1] + d * rests[i + 2]) + t);
        n[i + k] = a * out[i] + b * out[i + 1] + d * out[i + 2];
      }
      tones.set(colours[shown[v]], 4 * v);
    }
    canvas.width = Math.round(W * scale); canvas.height = Math.round(H * scale);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.colorMask(true, true, true, true); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    for (const [buffer, array] of buffers) { gl.bindBuffer(gl.ARRAY_BUFFER, buffer); gl.bufferData(gl.ARRAY_BUFFER, array, gl.DYNAMIC_DRAW); }
    gl.uniform3f(uniform("middle"), ...c); gl.uniform4f(uniform("turn"), ct, st, cu, su);
    gl.uniform3f(uniform("lens"), 2 * focal / W, 2 * focal / H, far);
    const pass = (opaque, colour, blend) => {
      gl.uniform1f(uniform("opaque"), opaque); gl.colorMask(colour, colour, colour, colour);
      blend ? gl.enable(gl.BLEND) : gl.disable(gl.BLEND);
      gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_SHORT, 0);
    };
    pass(1, true, false);
    if (looks.some(l => l[1] < 1)) { pass(0, false, false); pass(0, true, true); }
    return canvas;
  };
}
