"use strict";
(() => {
  const soft = "#5b6875", line = "#dde3e9";
  const axis = { gridcolor: line, zerolinecolor: "#b8c2cc", linecolor: "#b8c2cc", automargin: true,
    title: { standoff: 8 }, tickfont: { color: soft } };
  const narrow = () => innerWidth < 600;
  const coarse = matchMedia("(pointer: coarse)").matches;

  // plotly.js is unpacked when the first plot comes into sight.
  let library;
  const source = document.getElementById("plotly-gzip");  // none where it could not be fetched
  const plotly = () => library ??= (async () => {
    const packed = Uint8Array.from(atob(source.textContent), c => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
    const script = document.createElement("script");
    script.textContent = await new Response(stream).text();
    document.head.append(script);
    return window.Plotly;
  })();

  function layoutOf(given) {
    const layout = { font: { family: "system-ui, sans-serif", size: 12.5, color: "#1d2733" },
      margin: { l: 56, r: 14, t: given.title ? 36 : 12, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)", hovermode: "x unified", autosize: true, dragmode: coarse ? false : "zoom",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: "#a8b2bc", activecolor: soft }, legend: { orientation: "h", y: 1.02, yanchor: "bottom", x: 0 }, ...given };
    for (const key of Object.keys(layout)) {
      if (/^[xy]axis\d*$/.test(key)) layout[key] = { ...axis, ...layout[key], title: titled(layout[key].title) };
    }
    layout.xaxis ??= axis; layout.yaxis ??= axis;
    if (narrow()) layout.margin = { ...layout.margin, l: 44, r: 6 };
    return layout;
  }
  const titled = t => ({ standoff: 8, ...(typeof t === "string" ? { text: t } : t) });

  async function draw(place) {
    if (place.dataset.drawn) return;
    place.dataset.drawn = "1";
    const { data, layout } = JSON.parse(place.querySelector("script").textContent);
    try {
      const Plotly = await plotly();
      await Plotly.newPlot(place, data, layoutOf(layout), { displaylogo: false, responsive: true,
        showSendToCloud: false, modeBarButtonsToRemove: ["lasso2d", "select2d", "autoScale2d"],
        displayModeBar: coarse || narrow() ? false : "hover" });
      if ("seeks" in place.dataset) place.on("plotly_click", e => seek(+e.points[0].x));
    } catch (problem) {
      place.textContent = `This browser cannot draw the plot (${problem}). Open the page in a newer browser.`;
      console.error(problem);
    }
  }
  const shown = place => place.offsetParent !== null;
  const watch = new IntersectionObserver(entries => entries.forEach(e => { if (e.isIntersecting) draw(e.target); }),
    { rootMargin: "400px" });
  document.querySelectorAll(".plot").forEach(place => {
    if (!source) { place.dataset.drawn = "none"; place.textContent = `Not drawn: ${place.ariaLabel}`; return; }
    place.style.height = `${place.dataset.height}px`; watch.observe(place);
  });
  // The library is unpacked when the page has come to rest, so that printing finds it ready.
  if (source) addEventListener("load", () => setTimeout(plotly, 500));
  // On paper a plot is as wide as its column there (page.css: zoom), not as it was on the screen.
  const plots = [...document.querySelectorAll(".plot")];
  const sized = size => place => place.dataset.drawn && window.Plotly?.relayout(place, size(place));
  const paper = sized(place => ({ autosize: false, width: place.closest(".chooser") ? 690 : 980 }));
  const screen = sized(() => ({ autosize: true, width: null }));
  addEventListener("beforeprint", () => plots.forEach(place => draw(place).then(() => paper(place))));
  addEventListener("afterprint", () => plots.forEach(screen));

  function seek(time) { document.dispatchEvent(new CustomEvent("seek", { detail: time })); }
  document.querySelectorAll("a.seek").forEach(a => a.addEventListener("click", () => seek(+a.dataset.time)));
  document.querySelectorAll(".chooser").forEach(chooser => {
    const parts = [...chooser.children].filter(part => part.classList.contains("choice"));
    chooser.querySelector("select").addEventListener("change", event => {
      parts.forEach((part, i) => part.hidden = i !== event.target.selectedIndex);
      chooser.querySelectorAll(".plot").forEach(place => {
        if (shown(place)) place.dataset.drawn ? window.Plotly?.Plots.resize(place) : draw(place);
      });
    });
  });
})();
