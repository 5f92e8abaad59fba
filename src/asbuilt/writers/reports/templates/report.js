"use strict";
(function () {
  const data = JSON.parse(document.getElementById("data").textContent);
  const element = (id) => document.getElementById(id);
  const table = element("parameter-table");
  let recording = 0;
  let joint = 0;

  function make(parent, tag, attributes, text) {
    const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    if (text !== undefined) node.textContent = text;
    parent.append(node);
    return node;
  }

  function ticks(low, high, count) {
    const raw = (high - low) / count;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = power * [1, 2, 5, 10].find((factor) => factor * power >= raw);
    const found = [];
    for (let k = Math.ceil(low / step); k * step <= high + 1e-9 * step; k += 1) found.push(k * step);
    return found;
  }

  function decades(low, high) {
    const found = [];
    for (let k = Math.floor(low); k <= Math.ceil(high); k += 1) {
      for (const factor of high - low < 2 ? [1, 2, 5] : [1]) found.push(k + Math.log10(factor));
    }
    return found.filter((value) => value >= low && value <= high);
  }

  const shown = (value) => String(Number(value.toPrecision(4)));

  function extent(values) {
    let low = Infinity;
    let high = -Infinity;
    for (const value of values) {
      if (value === null) continue;
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (low > high) return [0, 1];
    return low === high ? [low - 0.5, high + 0.5] : [low, high];
  }

  function path(x, y, across, up) {
    let text = "";
    let pen = "M";
    for (let i = 0; i < x.length; i += 1) {
      if (x[i] === null || y[i] === null) { pen = "M"; continue; }
      text += pen + across(x[i]).toFixed(1) + " " + up(y[i]).toFixed(1);
      pen = "L";
    }
    return text;
  }

  /* A plot: panels above each other on one x axis; traces are lines, dots, bars or a band. */
  function plot(id, spec) {
    const holder = element(id);
    if (!holder) return;
    const width = holder.clientWidth || 680;
    const height = holder.clientHeight || 260;
    const left = 52;
    const top = spec.legend ? (width < 560 ? 66 : 26) : 8;
    const bottom = height - 40;
    holder.textContent = "";
    const svg = make(holder, "svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": spec.label });
    const all = spec.panels.flatMap((panel) => panel.traces);
    const whole = extent(all.flatMap((trace) => trace.x));
    const range = holder.range || whole;
    const across = (x) => left + (width - left - 10) * (x - range[0]) / (range[1] - range[0]);
    const clip = make(make(svg, "clipPath", { id: id + "-clip" }), "rect", { x: left, y: 0, width: width - left - 10, height });
    clip.id = "";
    const sum = spec.panels.reduce((total, panel) => total + (panel.share || 1), 0);
    let from = top;
    for (const panel of spec.panels) {
      const to = from + (bottom - top - 14 * (spec.panels.length - 1)) * (panel.share || 1) / sum;
      const inside = (trace) => trace.y.filter((_, i) => trace.x[i] === null || (trace.x[i] >= range[0] && trace.x[i] <= range[1]));
      const convert = panel.log ? Math.log10 : (value) => value;
      let span = panel.range || extent(panel.traces.flatMap((trace) => inside(trace).map((value) => (value === null ? null : convert(value)))));
      if (!panel.range) span = [span[0] - 0.05 * (span[1] - span[0]), span[1] + 0.05 * (span[1] - span[0])];
      const up = (y) => to - (to - from) * (convert(y) - span[0]) / (span[1] - span[0]);
      const level = (y) => to - (to - from) * (y - span[0]) / (span[1] - span[0]);
      for (const y of panel.bare ? [] : panel.log ? decades(span[0], span[1]) : ticks(span[0], span[1], Math.max(2, (to - from) / 45))) {
        make(svg, "line", { class: "grid", x1: left, x2: width - 10, y1: level(y), y2: level(y) });
        make(svg, "text", { class: "tick", x: left - 5, y: level(y) + 4, "text-anchor": "end" }, shown(panel.log ? 10 ** y : y));
      }
      if (panel.title) make(svg, "text", { class: "tick", transform: `translate(11 ${(from + to) / 2}) rotate(-90)`, "text-anchor": "middle" }, panel.title);
      make(svg, "line", { class: "axis", x1: left, x2: width - 10, y1: to, y2: to });
      const body = make(svg, "g", { "clip-path": `url(#${id}-clip)` });
      for (const trace of panel.traces) {
        const style = `trace ${trace.kind || "line"} ${trace.shade}`;
        if (trace.kind === "dots" || trace.kind === "cross") {
          const group = make(body, "g", { class: style });
          trace.x.forEach((x, i) => make(group, "circle", { cx: across(x).toFixed(1), cy: up(trace.y[i]).toFixed(1), r: trace.size || 1.6 }));
        } else if (trace.kind === "bars") {
          const group = make(body, "g", { class: style });
          const wide = Math.abs(across(trace.x[1]) - across(trace.x[0]));
          trace.x.forEach((x, i) => make(group, "rect", { x: across(x) - wide / 2, width: wide, y: up(trace.y[i]), height: Math.max(0, up(0) - up(trace.y[i])) }));
        } else if (trace.kind === "band") {
          make(body, "rect", { class: style, x: left, width: width - left - 10, y: up(trace.y[1]), height: up(trace.y[0]) - up(trace.y[1]) });
        } else {
          make(body, "path", { class: style, d: path(trace.x, trace.y, across, up) });
        }
      }
      from = to + 14;
    }
    for (const x of ticks(range[0], range[1], Math.max(3, width / 110))) {
      make(svg, "line", { class: "axis", x1: across(x), x2: across(x), y1: bottom, y2: bottom + 4 });
      make(svg, "text", { class: "tick", x: across(x), y: bottom + 17, "text-anchor": "middle" }, shown(x));
    }
    make(svg, "text", { class: "tick", x: (left + width) / 2, y: height - 4, "text-anchor": "middle" }, spec.x);
    if (spec.legend) {
      let x = left;
      let y = 14;
      for (const trace of all.filter((each) => each.name)) {
        const text = make(svg, "text", { class: "legend", x: x + 24, y }, trace.name);
        const size = 24 + text.getComputedTextLength() + 16;
        if (x > left && x + size > width) { x = left; y += 17; text.setAttribute("x", x + 24); text.setAttribute("y", y); }
        make(svg, "path", { class: `trace line ${trace.shade}`, d: `M${x} ${y - 4}h18` });
        x += size;
      }
    }
    if (spec.zoom) zoomable(holder, svg, left, width, range, top, bottom);
  }

  function zoomable(holder, svg, left, width, range, top, bottom) {
    const place = (event) => {
      const box = svg.getBoundingClientRect();
      const x = (event.clientX - box.left) * width / box.width;
      return Math.min(Math.max(x, left), width - 10);
    };
    const time = (x) => range[0] + (range[1] - range[0]) * (x - left) / (width - left - 10);
    let start = null;
    let mark = null;
    svg.addEventListener("pointerdown", (event) => {
      start = place(event);
      mark = make(svg, "rect", { class: "selection", x: start, y: top, width: 0, height: bottom - top });
    });
    svg.addEventListener("pointermove", (event) => {
      if (start === null) return;
      mark.setAttribute("x", Math.min(start, place(event)));
      mark.setAttribute("width", Math.abs(place(event) - start));
    });
    svg.addEventListener("pointerup", (event) => {
      if (start === null) return;
      const ends = [start, place(event)].sort((one, two) => one - two);
      start = null;
      mark.remove();
      if (ends[1] - ends[0] < 6) return;
      holder.range = ends.map(time);
      draw();
    });
    svg.addEventListener("dblclick", () => { holder.range = null; draw(); });
  }

  const difference = (a, b) => a.map((value, i) => (value === null || b[i] === null ? null : value - b[i]));

  function sides(x, y, shade) {
    return [-1, 1].map((side) => {
      const keep = x.map((value) => value * side > 0);
      return { x: x.filter((_, i) => keep[i]), y: y.filter((_, i) => keep[i]), shade };
    });
  }

  function drawTorque(of) {
    plot("torque-plot", {
      label: "Measured and predicted torque, and errors, over time", x: "time [s]", legend: true, zoom: true,
      panels: [
        { title: "torque [" + of.unit + "]", share: 3, traces: [
          { x: of.t, y: of.measured, name: "measured", shade: "measured" },
          { x: of.t, y: of.cad, name: "CAD", shade: "cad" },
          { x: of.t, y: of.built, name: "as built", shade: "built" } ] },
        { title: "error [" + of.unit + "]", share: 2, traces: [
          { x: of.t, y: difference(of.measured, of.cad), name: "error of CAD, RMS " + (of.rms_cad ?? "unknown"), shade: "cad" },
          { x: of.t, y: difference(of.measured, of.built), name: "error as built, RMS " + (of.rms ?? "unknown"), shade: "error" } ] },
      ],
    });
  }

  function drawError(of) {
    const z = of.histogram.z;
    plot("histogram-plot", { label: "Distribution of the error", x: "error / " + of.histogram.spread + " " + of.unit, panels: [{ bare: true, traces: [
      { kind: "bars", x: z, y: of.histogram.density, shade: "measured" },
      { x: z, y: z.map((value) => Math.exp(-0.5 * value * value) / Math.sqrt(2 * Math.PI)), shade: "ink" } ] }] });
    plot("correlation-plot", { label: "Autocorrelation of the error", x: "lag [s]", panels: [{ range: [-0.6, 1.05], traces: [
      { kind: "band", x: [0, of.lags[of.lags.length - 1]], y: [-of.band, of.band], shade: "line" },
      { x: of.lags, y: of.correlation, shade: "measured" } ] }] });
    const friction = of.friction;
    plot("friction-plot", { label: "Torque of the drive against velocity", x: "velocity [" + of.speed_unit + "]", panels: [{ title: "[" + of.unit + "]", traces: [
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
    plot("singular-plot", { label: "Singular values", x: "number", panels: [{ title: "singular value", log: true, traces }] });
  }

  function draw() {
    drawSingularValues();
    if (!data.recordings.length) return;
    const whole = data.recordings[recording];
    element("torque-title").textContent = data.joints[joint];
    element("torque-note").textContent = "Drawn with the extremes of every interval of " + whole.n_samples + " samples; drag to zoom, double-click to reset.";
    document.querySelectorAll("#joints button").forEach((button) => button.setAttribute("aria-pressed", String(Number(button.dataset.joint) === joint)));
    document.querySelectorAll(".residuals").forEach((each) => { each.style.display = Number(each.dataset.recording) === recording ? "" : "none"; });
    drawTorque(whole.joints[joint]);
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
