"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const element = (id) => document.getElementById(id);
  const table = element("parameter-table");
  let recording = 0;
  let joint = 0;

  function sides(x, y, shade) {
    return [-1, 1].map((side) => {
      const keep = x.map((value) => value * side > 0);
      return { x: x.filter((_, i) => keep[i]), y: y.filter((_, i) => keep[i]), shade };
    });
  }

  function drawError(of) {
    const z = of.histogram.z;
    asbuiltPlot.plot(element("histogram-plot"), { label: "Distribution of the error", x: "error / " + of.histogram.spread + " " + of.unit, panels: [{ bare: true, traces: [
      { kind: "bars", x: z, y: of.histogram.density, shade: "measured" },
      { x: z, y: z.map((value) => Math.exp(-0.5 * value * value) / Math.sqrt(2 * Math.PI)), shade: "ink" } ] }] });
    asbuiltPlot.plot(element("correlation-plot"), { label: "Autocorrelation of the error", x: "lag [s]", panels: [{ range: [-0.6, 1.05], traces: [
      { kind: "band", x: [0, of.lags[of.lags.length - 1]], y: [-of.band, of.band], shade: "line" },
      { x: of.lags, y: of.correlation, shade: "measured" } ] }] });
    const friction = of.friction;
    asbuiltPlot.plot(element("friction-plot"), { label: "Torque of the drive against velocity", x: "velocity [" + of.speed_unit + "]", panels: [{ title: "[" + of.unit + "]", traces: [
      { kind: "dots", x: friction.speed, y: friction.torque, shade: "measured" },
      ...sides(friction.bin, friction.median, "measured"),
      ...sides(friction.speed, friction.law, "built") ] }] });
  }

  function drawSingularValues() {
    const values = data.singular_values;
    const numbers = values.map((_, i) => i + 1);
    const part = (from, to, kind, shade) => ({ kind, x: numbers.slice(from, to), y: values.slice(from, to), shade, size: 3 });
    const traces = [part(0, data.rank, "dots", "measured")];
    if (data.rank < values.length) traces.push(part(data.rank, values.length, "cross", "built"));
    asbuiltPlot.plot(element("singular-plot"), { label: "Singular values", x: "number", panels: [{ title: "singular value", log: true, traces }] });
  }

  function draw() {
    drawSingularValues();
    if (!data.recordings.length) return;
    const whole = data.recordings[recording];
    element("torque-title").textContent = data.joints[joint];
    element("torque-note").textContent = "Drawn with the extremes of every interval of " + whole.n_samples + " samples; drag to zoom, double-click to reset.";
    document.querySelectorAll("#joints button").forEach((button) => button.setAttribute("aria-pressed", String(Number(button.dataset.joint) === joint)));
    document.querySelectorAll(".residuals").forEach((each) => { each.style.display = Number(each.dataset.recording) === recording ? "" : "none"; });
    asbuiltPlot.torques(element("torque-plot"), whole.joints[joint], data.joints[joint]);
    drawError(whole.joints[joint]);
  }

  function cellValue(row, column) {
    const cell = row.cells[column];
    if (cell.dataset.value === undefined) return cell.textContent;
    return cell.dataset.value === "" ? null : Number(cell.dataset.value);
  }

  function sortBy(column) {
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
    let count = 0;
    const rows = table.tBodies[0].rows;
    for (const row of rows) {
      const text = row.cells[0].textContent + " " + row.cells[1].textContent.toLowerCase();
      row.hidden = !(words.every((word) => text.includes(word)) && (!verdict || row.dataset.verdict === verdict));
      count += row.hidden ? 0 : 1;
    }
    element("count").textContent = count + " of " + rows.length + " parameters";
  }

  document.querySelectorAll("#joints button").forEach((button) => button.addEventListener("click", () => { joint = Number(button.dataset.joint); draw(); }));
  if (element("recording")) {
    element("recording").addEventListener("change", (event) => {
      recording = Number(event.target.value);
      element("torque-plot").range = null;
      draw();
    });
  }
  if (table) {
    Array.from(table.tHead.rows[0].cells).forEach((cell, column) => {
      const button = cell.querySelector("button");
      if (button) button.addEventListener("click", () => sortBy(column));
    });
    element("find").addEventListener("input", filter);
    element("show").addEventListener("change", filter);
    filter();
  }
  let pending = 0;
  for (const folded of document.querySelectorAll("details")) folded.addEventListener("toggle", draw);
  window.addEventListener("resize", () => { clearTimeout(pending); pending = setTimeout(draw, 150); });
  draw();
  document.documentElement.dataset.ready = "true";
})();
