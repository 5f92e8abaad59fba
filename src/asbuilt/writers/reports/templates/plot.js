"use strict";
/* Plots of the report, and of the page of `asbuilt open`. */
const asbuiltPlot = (function () {
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

  /* Panels above each other on one x axis; traces are lines, dots, bars or a band. With `zoom`: drag to zoom, double-click to see all. */
  function plot(holder, spec) {
    if (!holder) return;
    const width = holder.clientWidth || 680;
    const height = holder.clientHeight || 260;
    const left = 64;
    const top = spec.legend ? (width < 560 ? 66 : 26) : 8;
    const bottom = height - 40;
    holder.textContent = "";
    const svg = make(holder, "svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": spec.label });
    const all = spec.panels.flatMap((panel) => panel.traces);
    holder.whole = extent(all.flatMap((trace) => trace.x));
    const range = holder.range || holder.whole;
    const across = (x) => left + (width - left - 10) * (x - range[0]) / (range[1] - range[0]);
    make(make(svg, "clipPath", { id: holder.id + "-clip" }), "rect", { x: left, y: 0, width: width - left - 10, height });
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
      const body = make(svg, "g", { "clip-path": `url(#${holder.id}-clip)` });
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
    if (spec.legend) legend(svg, all.filter((each) => each.name), left, width);
    if (spec.zoom) zoomable(holder, svg, spec, { left, width, range, top, bottom });
  }

  function legend(svg, traces, left, width) {
    let x = left;
    let y = 14;
    for (const trace of traces) {
      const text = make(svg, "text", { class: "legend", x: x + 24, y }, trace.name);
      const size = 24 + text.getComputedTextLength() + 16;
      if (x > left && x + size > width) { x = left; y += 17; text.setAttribute("x", x + 24); text.setAttribute("y", y); }
      make(svg, "path", { class: `trace line ${trace.shade}`, d: `M${x} ${y - 4}h18` });
      x += size;
    }
  }

  function zoomable(holder, svg, spec, { left, width, range, top, bottom }) {
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
      plot(holder, spec);
    });
    svg.addEventListener("dblclick", () => { holder.range = null; plot(holder, spec); });
  }

  /* Show a share of the present range around its middle; zero: all there is. */
  function zoom(holder, factor) {
    const [first, last] = holder.range || holder.whole;
    const [middle, half] = [(first + last) / 2, factor * (last - first) / 2];
    const wanted = [Math.max(middle - half, holder.whole[0]), Math.min(middle + half, holder.whole[1])];
    holder.range = factor && wanted[1] - wanted[0] < holder.whole[1] - holder.whole[0] ? wanted : null;
  }

  /* The drawing alone, with the colours that it has here. */
  function standalone(holder) {
    const shown = holder.firstElementChild;
    const copy = shown.cloneNode(true);
    const [, , width, height] = shown.getAttribute("viewBox").split(" ");
    for (const [name, value] of Object.entries({ xmlns: "http://www.w3.org/2000/svg", width, height })) copy.setAttribute(name, value);
    const pairs = [[shown, copy], ...[...shown.querySelectorAll("*")].map((node, k) => [node, copy.querySelectorAll("*")[k]])];
    for (const [node, twin] of pairs) {
      const style = getComputedStyle(node);
      for (const name of ["fill", "fill-opacity", "stroke", "stroke-width", "stroke-dasharray", "stroke-linejoin", "opacity", "font-family", "font-size"]) twin.setAttribute(name, style.getPropertyValue(name));
    }
    const paper = document.createElementNS("http://www.w3.org/2000/svg", "rect");
    for (const [name, value] of Object.entries({ width, height, fill: getComputedStyle(document.body).backgroundColor })) paper.setAttribute(name, value);
    copy.prepend(paper);
    return { text: new XMLSerializer().serializeToString(copy), width: Number(width), height: Number(height) };
  }

  function download(address, name) {
    const link = document.createElement("a");
    link.href = address;
    link.download = name;
    link.click();
  }

  /* Download the drawing as "svg", or as "png" with twice the points of the screen. */
  function save(holder, kind, name) {
    const { text, width, height } = standalone(holder);
    const address = "data:image/svg+xml;charset=utf-8," + encodeURIComponent(text);
    if (kind === "svg") { download(address, name); return; }
    const image = new Image();
    image.onload = () => {
      const canvas = document.createElement("canvas");
      [canvas.width, canvas.height] = [2 * width, 2 * height];
      canvas.getContext("2d").drawImage(image, 0, 0, canvas.width, canvas.height);
      download(canvas.toDataURL("image/png"), name);
    };
    image.src = address;
  }

  const difference = (a, b) => a.map((value, i) => (value === null || b[i] === null ? null : value - b[i]));

  /* Measured and predicted torque of one joint, and the errors of both models. */
  function torques(holder, of, joint) {
    plot(holder, {
      label: "Measured and predicted torque of " + joint + ", and errors, over time", x: "time [s]", legend: true, zoom: true,
      panels: [
        { title: "torque [" + of.unit + "]", share: 3, traces: [
          { x: of.t, y: of.measured, name: "measured", shade: "measured" },
          { x: of.t, y: of.cad, name: "CAD", shade: "cad" },
          { x: of.t, y: of.built, name: "as built", shade: "built" } ] },
        { title: "error [" + of.unit + "]", share: 2, traces: [
          { x: of.t, y: difference(of.measured, of.cad), name: "error of CAD, RMS " + (of.rms_cad ?? "unknown"), shade: "cad-error" },
          { x: of.t, y: difference(of.measured, of.built), name: "error as built, RMS " + (of.rms ?? "unknown"), shade: "error" } ] },
      ],
    });
  }

  /* A curve without axes, as wide as a word or two. */
  function small(holder, x, y) {
    const svg = make(holder, "svg", { viewBox: "0 0 150 30", preserveAspectRatio: "none", "aria-hidden": "true" });
    const [[first, last], [low, high]] = [extent(x), extent(y)];
    make(svg, "path", { d: path(x, y, (value) => 150 * (value - first) / (last - first), (value) => 28 - 26 * (value - low) / (high - low)), "vector-effect": "non-scaling-stroke" });
  }

  /* Two bars: shares of the width before and after. */
  function bars(holder, shares) {
    const svg = make(holder, "svg", { viewBox: "0 0 100 22", preserveAspectRatio: "none", "aria-hidden": "true" });
    shares.forEach((share, k) => make(svg, "rect", { class: k ? "after" : "before", x: 0, y: 2 + 10 * k, width: 100 * Math.max(share || 0, 0), height: 8 }));
  }

  return { plot, torques, zoom, save, small, bars };
})();
