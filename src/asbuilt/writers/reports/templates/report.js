"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const element = (id) => document.getElementById(id);
  const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue("--" + name).trim();
  const narrow = () => window.innerWidth < 640;
  const buttons = [["toImage"], ["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"]];
  const options = { responsive: false, displaylogo: false, modeBarButtons: buttons };
  const bare = { ...options, displayModeBar: false };
  let recording = 0;
  let joint = 0;
  let paperWidth = null;

  function axis(title, extra) {
    return {
      title: { text: title, standoff: 6 }, gridcolor: colour("grid"), linecolor: colour("line"), zeroline: false,
      automargin: true, ticks: "outside", tickcolor: colour("line"), ...extra,
    };
  }

  function layout(extra) {
    return {
      margin: { l: 56, r: 12, t: 28, b: 44 }, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: colour("ink"), size: 12, family: "system-ui, DejaVu Sans, sans-serif" },
      legend: { orientation: "h", y: 1.0, yanchor: "bottom", x: 0, font: { size: 12 } }, hovermode: "x unified",
      ...(paperWidth === null ? { autosize: true } : { autosize: false, width: paperWidth }),
      hoverlabel: { bgcolor: colour("paper"), bordercolor: colour("line"), font: { color: colour("ink") } }, ...extra,
    };
  }

  function line(x, y, name, shade, extra) {
    return { type: "scatter", mode: "lines", x, y, name, line: { color: colour(shade), width: 1.4, ...(extra && extra.line) }, connectgaps: false, ...(extra && extra.trace) };
  }

  function difference(a, b) {
    return a.map((value, i) => (value === null || b[i] === null ? null : value - b[i]));
  }

  function sides(x, y, name, shade, style) {
    return [-1, 1].map((side) => {
      const keep = x.map((value) => value * side > 0);
      const showlegend = keep.some(Boolean) && (side > 0 || !x.some((value) => value > 0));
      return line(x.filter((_, i) => keep[i]), y.filter((_, i) => keep[i]), name, shade, { trace: { showlegend }, line: style });
    });
  }

  function drawTorque(of) {
    const lower = { trace: { yaxis: "y2" } };
    const traces = [
      line(of.t, of.measured, "measured", "measured", { line: { width: 2.2 } }),
      line(of.t, of.cad, "CAD", "cad", { line: { width: 1.1 } }),
      line(of.t, of.built, "as built", "built", { line: { dash: "6px,2px" } }),
      line(of.t, difference(of.measured, of.cad), "error, CAD (RMS " + of.rms_cad + ")", "cad", { ...lower, line: { width: 1.1 } }),
      line(of.t, difference(of.measured, of.built), "error, as built (RMS " + of.rms + ")", "error", lower),
    ];
    Plotly.react("torque-plot", traces, layout({
      margin: { l: 56, r: 12, t: narrow() ? 110 : 56, b: 44 },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: colour("cad"), activecolor: colour("ink") },
      xaxis: axis("time [s]", { anchor: "y2" }),
      yaxis: axis("torque [" + of.unit + "]", { domain: [0.42, 1] }),
      yaxis2: axis("error [" + of.unit + "]", { domain: [0, 0.36], zeroline: true, zerolinecolor: colour("line") }),
    }), narrow() ? bare : options);
  }

  function drawError(of) {
    const z = of.histogram.z;
    const normal = z.map((value) => Math.exp(-0.5 * value * value) / Math.sqrt(2 * Math.PI));
    Plotly.react("histogram-plot", [
      { type: "bar", x: z, y: of.histogram.density, marker: { color: colour("measured"), opacity: 0.55 }, hoverinfo: "skip" },
      line(z, normal, "normal", "ink"),
    ], layout({ showlegend: false, bargap: 0, xaxis: axis("error / " + of.histogram.spread + " " + of.unit), yaxis: axis("", { showticklabels: false }) }), bare);
    const ends = [0, of.lags[of.lags.length - 1]];
    Plotly.react("correlation-plot", [
      line(ends, [of.band, of.band], "", "line", { line: { width: 0 }, trace: { hoverinfo: "skip" } }),
      line(ends, [-of.band, -of.band], "", "line", { line: { width: 0 }, trace: { hoverinfo: "skip", fill: "tonexty", fillcolor: colour("line") } }),
      line(of.lags, of.correlation, "autocorrelation", "measured"),
    ], layout({ showlegend: false, xaxis: axis("lag [s]"), yaxis: axis("", { range: [-0.6, 1.05] }) }), bare);
    const friction = of.friction;
    Plotly.react("friction-plot", [
      { type: "scatter", mode: "markers", x: friction.speed, y: friction.torque, name: "samples", marker: { color: colour("measured"), size: 3, opacity: 0.35 } },
      ...sides(friction.bin, friction.median, "median", "measured", { width: 2 }),
      ...sides(friction.speed, friction.law, "identified", "built", { width: 2, dash: "6px,2px" }),
    ], layout({ hovermode: "closest", xaxis: axis("velocity [" + of.speed_unit + "]"), yaxis: axis("[" + of.unit + "]") }), bare);
  }

  function drawSingularValues() {
    const values = data.singular_values;
    const numbers = values.map((_, i) => i + 1);
    const part = (from, to, name, shade, symbol) => ({
      type: "scatter", mode: "markers", x: numbers.slice(from, to), y: values.slice(from, to), name, marker: { color: colour(shade), symbol, size: 7 },
    });
    const traces = [part(0, data.rank, "determined", "measured", "circle")];
    if (data.rank < values.length) traces.push(part(data.rank, values.length, "not determined", "built", "x"));
    const positive = values.filter((value) => value > 0);
    const decades = positive.length ? Math.log10(Math.max(...positive) / Math.min(...positive)) : 1;
    const marks = decades < 3 ? "D2" : Math.ceil(decades / 6);
    Plotly.react("singular-plot", traces, layout({ hovermode: "closest", xaxis: axis("number"), yaxis: axis("singular value", { type: "log", dtick: marks, tickformat: "~g" }) }), bare);
  }

  function draw() {
    drawSingularValues();
    if (!data.recordings.length) return;
    const whole = data.recordings[recording];
    const of = whole.joints[joint];
    element("torque-title").textContent = data.joints[joint];
    element("torque-note").textContent = "Drawn with the extremes of every interval of " + whole.n_samples + " samples; drag to zoom, double-click to reset.";
    document.querySelectorAll("#joints button").forEach((button) => button.setAttribute("aria-pressed", String(Number(button.dataset.joint) === joint)));
    document.querySelectorAll(".residuals").forEach((table) => { table.style.display = Number(table.dataset.recording) === recording ? "" : "none"; });
    drawTorque(of);
    drawError(of);
  }

  function cellValue(row, column) {
    const cell = row.cells[column];
    if (cell.dataset.value === undefined) return cell.textContent;
    return cell.dataset.value === "" ? null : Number(cell.dataset.value);
  }

  function sortBy(column) {
    const table = element("parameter-table");
    const head = table.tHead.rows[0].cells[column];
    const descending = head.getAttribute("aria-sort") === "ascending";
    for (const cell of table.tHead.rows[0].cells) cell.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", descending ? "descending" : "ascending");
    const rows = Array.from(table.tBodies[0].rows);
    rows.sort((one, two) => {
      const a = cellValue(one, column);
      const b = cellValue(two, column);
      if (a === null || b === null) return (a === null) - (b === null);
      const order = typeof a === "number" ? a - b : a.localeCompare(b, "en", { numeric: true });
      return descending ? -order : order;
    });
    table.tBodies[0].append(...rows);
  }

  function filter() {
    const words = element("find").value.toLowerCase().split(/\s+/).filter(Boolean);
    const verdict = element("show").value;
    let shown = 0;
    const rows = element("parameter-table").tBodies[0].rows;
    for (const row of rows) {
      const text = row.cells[0].textContent + " " + row.cells[1].textContent.toLowerCase();
      const visible = words.every((word) => text.includes(word)) && (!verdict || row.dataset.verdict === verdict);
      row.hidden = !visible;
      shown += visible ? 1 : 0;
    }
    element("count").textContent = shown + " of " + rows.length + " parameters";
  }

  document.querySelectorAll("#joints button").forEach((button) => button.addEventListener("click", () => { joint = Number(button.dataset.joint); draw(); }));
  if (element("recording")) element("recording").addEventListener("change", (event) => { recording = Number(event.target.value); draw(); });
  Array.from(element("parameter-table").tHead.rows[0].cells).forEach((cell, column) => {
    const button = cell.querySelector("button");
    if (button) button.addEventListener("click", () => sortBy(column));
  });
  element("find").addEventListener("input", filter);
  element("show").addEventListener("change", filter);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  function redraw() {
    document.querySelectorAll(".plot").forEach((plot) => Plotly.purge(plot));
    draw();
  }

  let pending = 0;
  window.addEventListener("resize", () => { clearTimeout(pending); pending = setTimeout(redraw, 150); });
  window.addEventListener("beforeprint", () => {
    document.documentElement.dataset.paper = "true";
    paperWidth = 680;
    draw();
  });
  window.addEventListener("afterprint", () => {
    delete document.documentElement.dataset.paper;
    paperWidth = null;
    redraw();
  });
  filter();
  draw();
  document.documentElement.dataset.ready = "true";
})();
