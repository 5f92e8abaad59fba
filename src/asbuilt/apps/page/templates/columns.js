/* Section 3: which column is which quantity of which joint, matched by dragging or by lists. */
import { element, errorText, fileName, make, mark, select, span } from "./parts.js";
import { page, post } from "./talk.js";

const usual = ["", "time", "position", "velocity", "acceleration", "torque", "command"];
const mostChips = 200;
let answer = null;
let columns = [];

/* Draw the answer of the step; unsaved changes of an older one are gone with it. */
export function drawColumns(next) {
  if (next === answer && next !== null) return;
  answer = next;
  const usable = answer && !answer.error;
  element("columns-all").hidden = !usable;
  element("columns-table-all").hidden = !usable;
  element("assign-line").hidden = !usable;
  say(answer ? sentence() : "", Boolean(answer) && (answer.error !== undefined || !answer.ok));
  if (!usable) return;
  element("columns-all").open = !answer.ok;
  reset();
}

/* Columns as the log was read. */
function reset() {
  columns = answer.columns.map((column) => ({ name: column.name, quantity: column.quantity || "", joint: column.joint || "" }));
  drawTable();
  drawPlaces();
  tellChanges();
}

function say(text, bad) {
  const place = element("columns-answer");
  place.textContent = text;
  place.className = "answer" + (bad ? " bad" : "");
  mark("columns", bad ? "not yet" : text ? "done" : "", bad ? "bad" : "good");
}

function sentence() {
  if (answer.error) return errorText(answer);
  if (!answer.ok) return shortProblem();
  const used = answer.columns.filter((column) => column.quantity);
  const names = [...new Set(used.map((column) => column.quantity))].sort((one, two) => rank(one) - rank(two));
  const counted = names.map((name) => `${used.filter((column) => column.quantity === name).length} ${name.replace(/_/g, " ")}`);
  return `${used.length} of ${answer.columns.length} columns are used: ${counted.join(", ")}.`;
}

/* A draft is shown as places; its text, which the command prints, is not repeated here. */
function shortProblem() {
  const problem = nameFile(answer.problem);
  if (!problem.includes("\n") || !answer.columns.some((column) => column.quantity)) return problem;
  return problem.split(/[;\n]/)[0] + ". The places below are a guess from the values: mend what is wrong, then read the log by them.";
}

/* Step 2 has the folder of the log. */
function nameFile(text) {
  const { logs, validation, payload } = page().choices;
  const log = [...logs, ...validation, ...payload].find((path) => text.startsWith(path));
  return log ? fileName(log) + text.slice(log.length) : text;
}

const rank = (quantity) => (usual.includes(quantity) ? usual.indexOf(quantity) : usual.length) || usual.length + 1;
const isOfRobot = (joint) => answer.joints.includes(joint);
const isUsed = (column) => column.quantity === "time" || (column.quantity !== "" && isOfRobot(column.joint));
const isChanged = (k) => columns[k].quantity !== (answer.columns[k].quantity || "") || columns[k].joint !== (answer.columns[k].joint || "");

/* ---- places to drag columns to: joints down, quantities across ---- */

function drawPlaces() {
  const table = element("places");
  table.textContent = "";
  const wanted = ["position", "velocity", "torque"];
  const shown = usual.slice(2).filter((name) => wanted.includes(name) || columns.some((column) => column.quantity === name));
  const head = make(make(table, "thead", {}), "tr", {});
  make(head, "th", {}, "joint");
  for (const quantity of shown) make(head, "th", {}, quantity);
  const body = make(table, "tbody", {});
  const first = make(body, "tr", {});
  make(first, "th", { scope: "row" }, "time");
  place(make(first, "td", { colspan: String(shown.length) }), "time", "");
  for (const joint of answer.joints) {
    const row = make(body, "tr", {});
    make(row, "th", { scope: "row" }, joint);
    for (const quantity of shown) place(make(row, "td", {}), quantity, joint);
  }
  const pool = element("unused");
  pool.textContent = "";
  droppable(pool, "", "");
  const unused = columns.map((column, k) => k).filter((k) => !isUsed(columns[k]));
  for (const k of unused.slice(0, mostChips)) chip(pool, k);
  if (!unused.length) make(pool, "span", { class: "quiet" }, "none");
  if (unused.length > mostChips) make(pool, "span", { class: "quiet" }, `and ${unused.length - mostChips} more, in the list below`);
}

function place(cell, quantity, joint) {
  cell.className = "place";
  droppable(cell, quantity, joint);
  columns.forEach((column, k) => { if (column.quantity === quantity && column.joint === joint) chip(cell, k); });
}

function chip(parent, k) {
  const column = columns[k];
  const about = column.joint && !isOfRobot(column.joint) ? ` (${column.quantity || "?"} of ${column.joint})` : "";
  const node = make(parent, "span", { class: "chip" + (isChanged(k) ? " changed" : ""), draggable: "true", "data-column": String(k), title: column.name + about });
  make(node, "span", {}, column.name);
  asbuiltPlot.small(node, answer.columns[k].curve.row, answer.columns[k].curve.above_smallest);
  node.addEventListener("dragstart", (event) => {
    event.dataTransfer.setData("text/x-column", String(k));
    event.dataTransfer.effectAllowed = "move";
  });
}

function droppable(node, quantity, joint) {
  const takes = (event) => event.dataTransfer.types.includes("text/x-column");
  node.ondragover = (event) => { if (takes(event)) { event.preventDefault(); node.classList.add("over"); } };
  node.ondragleave = () => node.classList.remove("over");
  node.ondrop = (event) => {
    node.classList.remove("over");
    if (!takes(event)) return;
    event.preventDefault();
    event.stopPropagation();
    move(Number(event.dataTransfer.getData("text/x-column")), quantity, joint);
  };
}

/* A column takes a place, and the one that was there takes the place that is left. */
function move(k, quantity, joint) {
  const left = { ...columns[k] };
  const there = columns.findIndex((column, i) => i !== k && quantity !== "" && column.quantity === quantity && column.joint === joint);
  if (there >= 0) Object.assign(columns[there], isUsed(left) ? { quantity: left.quantity, joint: left.joint } : { quantity: "", joint: "" });
  Object.assign(columns[k], { quantity, joint });
  if (joint) renameJoint(left.joint, joint);
  drawTable();
  drawPlaces();
  tellChanges();
}

/* A joint of the log that gets one of the robot gets it in all its columns. */
function renameJoint(old, joint) {
  if (!old || isOfRobot(old)) return;
  for (const column of columns) if (column.joint === old) column.joint = joint;
}

/* ---- the same as lists, with every curve ---- */

function drawTable() {
  const body = element("column-table").tBodies[0];
  body.textContent = "";
  const order = columns.map((_, k) => k).sort((one, two) => rank(answer.columns[one].quantity || "") - rank(answer.columns[two].quantity || "") || one - two);
  for (const k of order) {
    const about = answer.columns[k];
    const row = make(body, "tr", { class: isChanged(k) ? "changed" : isUsed(columns[k]) ? "" : "unused" });
    make(row, "td", {}, about.name);
    asbuiltPlot.small(make(row, "td", {}), about.curve.row, about.curve.above_smallest);
    const quantities = usual.includes(about.quantity || "") ? usual : usual.concat(about.quantity);
    const quantity = select(make(row, "td", {}), quantities, columns[k].quantity, "quantity of " + about.name);
    const strange = columns[k].joint && !isOfRobot(columns[k].joint) ? [columns[k].joint] : [];
    const joint = select(make(row, "td", {}), ["", ...strange, ...answer.joints], columns[k].joint, "joint of " + about.name);
    make(row, "td", { class: "number" }, about.smallest === null ? "empty" : span(about.smallest, about.largest));
    const change = () => {
      const old = columns[k].joint;
      Object.assign(columns[k], { quantity: quantity.value, joint: joint.value });
      if (joint.value !== old) renameJoint(old, joint.value);
      drawTable();
      drawPlaces();
      tellChanges();
    };
    quantity.addEventListener("change", change);
    joint.addEventListener("change", change);
  }
}

function tellChanges() {
  const changed = columns.filter((_, k) => isChanged(k)).length;
  element("undo").hidden = !changed;
  element("assign").disabled = !(changed || !answer.ok);
  element("assign-note").textContent = changed ? `${changed} changed.` : answer.ok ? "Drag a column to another place first." : "";
}

element("assign").addEventListener("click", () => post("sheet", {
  columns: columns.map((column) => (isUsed(column) ? column : { name: column.name, quantity: "", joint: "" })),
}));
element("undo").addEventListener("click", reset);
