"use strict";
// Moves the figure by the packets of the session, and tells what is dropped, silent and lost.
(() => {
  const { segments, points, turn } = JSON.parse(document.getElementById("capsules").textContent);
  const status = document.getElementById("status"), list = document.getElementById("sensors");
  const figure = document.querySelector(".player");
  let body = null, socket = null, at = 0;

  // R(q) x + t for every end of a capsule, then turned to z up.
  const placed = places => points.map((x, k) => {
    const [px, py, pz, w, a, b, c] = places[segments[k]];
    const u = [b * x[2] - c * x[1], c * x[0] - a * x[2], a * x[1] - b * x[0]];
    const y = [0, 1, 2].map(i => x[i] + 2 * (w * u[i] + [b * u[2] - c * u[1], c * u[0] - a * u[2], a * u[1] - b * u[0]][i]));
    const z = [y[0] + px, y[1] + py, y[2] + pz];
    return turn.map(row => row[0] * z[0] + row[1] * z[1] + row[2] * z[2]);
  });

  const act = {
    hello(p) {
      if (body && body.body !== p.body) { location.reload(); return; }
      body = p; list.textContent = "";
      for (const name of p.sensors) {
        const label = list.appendChild(document.createElement("label"));
        const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
        box.onchange = () => socket.send(JSON.stringify({ sensor: name, use: box.checked }));
        label.append(box, ` ${name}`); label.dataset.sensor = name;
      }
    },
    pose(p) {
      const lost = new Set(p.lost);
      figure.move(placed(p.segments), segments.filter((_, k) => k % 2 === 0).map(s => lost.has(s)));
      const names = p.lost.map(s => body.segments[s]);
      tell(p, `quality ${Math.round(100 * p.quality)} %` + (names.length ? `, lost: ${names.join(", ")}` : ""));
    },
    waiting(p) { tell(p, "person not found"); },
    refused(p) { status.textContent = p.why; },
    done() {},
  };
  function tell(p, what) {
    const now = performance.now(), rate = at ? 1000 / (now - at) : 0;
    at = now;
    const dropped = Object.values(p.dropped).reduce((a, b) => a + b, 0);
    status.textContent = `${p.time.toFixed(2)} s, ${(1000 * p.latency).toFixed(0)} ms after the image, ${rate.toFixed(0)} poses per second, `
      + `${dropped} frames dropped, ${what}`;
    for (const label of list.children) label.className = p.silent.includes(label.dataset.sensor) ? "silent" : "";
  }
  function open() {
    socket = new WebSocket(location.href.replace(/^http/, "ws"));
    socket.onmessage = event => { const p = JSON.parse(event.data); (act[p.type] || (() => {}))(p); };
    socket.onclose = () => { status.textContent = "the session has ended; the next session with the same token appears here"; setTimeout(open, 1000); };
  }
  open();
})();
