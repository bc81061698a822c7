"use strict";
// Moves the figure by the packets of the session; a panel shows its numbers and angles, and asks for changes.
(() => {
  const status = document.getElementById("status"), panel = document.getElementById("panel");
  const figure = document.querySelector(".player"), DEGREES = 180 / Math.PI;
  let body = null, socket = null, paused = false, counted = [0, 0], rate = "–", drawn = 0;

  const make = (tag, parent, fields = {}) => parent.appendChild(Object.assign(document.createElement(tag), fields));
  const ask = request => socket.send(JSON.stringify(request));
  const controls = make("p", panel);
  const pause = make("button", controls, { textContent: "Pause", onclick: () => ask({ pause: !paused }) });
  const stop = make("button", controls, { textContent: "End", onclick: () => {
    if (confirm("End the session? Its files are written.")) ask({ stop: true });
  } });
  const facts = make("table", panel, { id: "facts" });
  const row = (table, name) => { const line = make("tr", table); make("th", line, { textContent: name }); return make("td", line); };
  const [latency, speed, quality, dropped, lost, people] = ["Latency", "Frame rate", "Quality", "Dropped frames", "Lost", "People in view"].map(n => row(facts, n));
  const label = make("label", row(facts, "Person")), person = make("select", label, { onchange: () => ask({ person: +person.value }) });
  const from = make("span", label), list = make("p", panel, { id: "sensors" }), angles = make("table", panel, { id: "angles" });
  let cells = [];

  const act = {
    hello(p) {
      if (body && body.body !== p.body) { location.reload(); return; }
      body = p; list.textContent = angles.textContent = "";
      cells = p.coordinates.map(name => row(angles, name));
      for (const name of p.sensors) {
        const label = make("label", list), box = make("input", label, { type: "checkbox", checked: true });
        box.onchange = () => ask({ sensor: name, use: box.checked });
        label.append(` ${name}`); label.dataset.sensor = name;
      }
    },
    pose(p) {
      figure.move(p.segments, new Set(p.lost), new Set(p.uncertain));
      tell(p, `following, ${p.time.toFixed(2)} s`);
    },
    waiting(p) { tell(p, p.paused ? "paused: what the sensors see is not followed" : "person not found"); },
    refused(p) { status.textContent = p.why; },
    done() {},
  };
  function tell(p, what) {
    const now = performance.now(), [number, at] = counted;
    if (now - at > 1000) { rate = at ? `${((p.number - number) / (now - at) * 1000).toFixed(0)} Hz` : rate; counted = [p.number, now]; }
    if (now - drawn < 200 && paused === p.paused) return;  // numbers that change faster cannot be read
    drawn = now; paused = p.paused;
    status.textContent = what; pause.textContent = paused ? "Go on" : "Pause";
    latency.textContent = `${(1000 * p.latency).toFixed(0)} ms after the image`; speed.textContent = rate;
    dropped.textContent = Object.values(p.dropped).reduce((a, b) => a + b, 0);
    quality.textContent = p.angles ? `${Math.round(100 * p.quality)} %` : "–";
    lost.textContent = p.lost?.map(s => body.segments[s]).join(", ") || "–";
    people.textContent = p.people;
    if (person.length !== p.people) person.replaceChildren(...Array.from({ length: p.people }, (_, k) => new Option(k + 1)));
    if (document.activeElement !== person) person.value = p.person ?? "";
    from.textContent = p.people > 1 ? ` from the left in ${p.camera}` : "";
    cells.forEach((cell, k) => {
      const scale = body.units[k] === "m" ? 1000 : DEGREES, unit = body.units[k] === "m" ? " mm" : "°", std = p.angle_std?.[k];
      cell.textContent = !p.angles ? "–" : std === null ? "not observed"
        : `${(scale * p.angles[k]).toFixed(1)}${unit} ± ${(2 * scale * std).toFixed(1)}`;
    });
    for (const label of list.children) label.className = p.silent.includes(label.dataset.sensor) ? "silent" : "";
  }
  function open() {
    socket = new WebSocket(location.href.replace(/^http/, "ws"));
    const able = on => { for (const control of [pause, stop, person]) control.disabled = !on; };
    socket.onopen = () => able(true);
    socket.onmessage = event => { const p = JSON.parse(event.data); (act[p.type] || (() => {}))(p); };
    socket.onclose = () => {
      able(false); status.textContent = "the session has ended; the next session with the same token appears here"; setTimeout(open, 1000);
    };
  }
  open();
})();
