/* Section 6: the verdict, effects as switches, torque curves, files. */
import { digits, element, errorText, fileName, make, mark, percent } from "./parts.js";
import { last, page, post, readFile } from "./talk.js";
import { drawFindings } from "./findings.js";

let shown = null;
let kept = false;
let curves = null;
let recording = 0;
let joint = 0;

export function drawResult() {
  const told = page().steps.identify;
  const answer = last("identify");
  const failed = Boolean(answer && answer.error);
  const isOld = !told.current;
  const visible = Boolean(answer) && !failed;
  element("result-none").hidden = visible;
  element("result-none").textContent = failed && !isOld ? errorText(answer) : "Nothing is identified yet.";
  element("result-none").className = failed && !isOld ? "answer bad" : "quiet";
  element("result-body").hidden = !visible;
  element("result-body").className = isOld ? "old" : "";
  element("result-old").hidden = !(visible && isOld);
  element("result-old-command").textContent = told.answered || "";
  if (!visible) mark("result", failed && !isOld ? "failed" : "", "bad");
  else mark("result", isOld ? "of other choices" : "done", isOld ? "" : "good");
  if (!visible) { shown = null; return; }
  const verdict = answer.verdict || { use: "", text: describeFit(answer) };
  element("verdict").textContent = verdict.text;
  element("verdict").className = "verdict " + (isOld ? "" : { yes: "yes", no: "no", "with care": "care", untested: "care" }[verdict.use] || "");
  drawEffects(answer, isOld);
  if (shown === answer && kept === told.kept) return;
  shown = answer;
  kept = told.kept;
  element("payload-verdict").hidden = !answer.payload;
  const carried = answer.payload ? answer.payload.headline : "";
  element("payload-verdict").textContent = carried;
  element("payload-verdict").className = "verdict " + (/^USE:/.test(carried) ? "yes" : /^DO NOT/.test(carried) ? "no" : "care");
  drawCards(answer);
  drawJoints(answer);
  drawFindings(element("findings"), answer.findings, false);
  element("findings-title").textContent = `${answer.findings.length} findings`;
  // Files that another run has replaced are not this answer's.
  const files = kept ? answer.files : {};
  drawFiles(element("result-files"), files, told.key);
  drawTorque(answer, files, told.key);
}

function describeFit(answer) {
  const what = answer.validation.length ? "what was held out" : "the recording itself";
  return `Predicts ${what} to ${percent(held(answer).relative_error)} of the torque (CAD ${percent(answer.cad && answer.cad.relative_error)}).`;
}

/* Masses that the log allows, in the words of the report; null is an open end. */
const range = (least, greatest) => (greatest === null ? `${digits(least)} kg or more` : `${digits(least)} to ${digits(greatest)} kg`);

const held = (answer) => answer.validation[0] || answer.train;

function drawCards(answer) {
  const cards = element("cards");
  cards.textContent = "";
  const card = (figure, label) => {
    const node = make(cards, "div", { class: "card" });
    make(node, "div", { class: "figure" }, figure);
    make(node, "div", { class: "label" }, label);
  };
  const judged = answer.verdict && answer.verdict.measure === "torque" ? answer.verdict.error : {};
  card(percent(judged.exported ?? held(answer).relative_error), "torque error as built");
  if (answer.cad) card(percent(judged.cad ?? answer.cad.relative_error), "torque error of CAD");
  if (answer.mass && answer.mass.feasible) card(range(...answer.mass.feasible), `mass of the links by this log, CAD ${digits(answer.mass.cad)} kg`);
  card(answer.physically_consistent === false ? "no" : answer.physically_consistent ? "yes" : "-", "physically consistent");
}

function drawJoints(answer) {
  const body = element("joint-errors").tBodies[0];
  body.textContent = "";
  answer.joints.forEach((name, k) => {
    const row = make(body, "tr", {});
    make(row, "td", {}, name);
    make(row, "td", { class: "number" }, answer.cad ? digits(answer.cad.rms[k]) : "-");
    make(row, "td", { class: "number" }, digits(held(answer).rms[k]));
    make(row, "td", {}, held(answer).units ? held(answer).units[k] : "N m");
  });
}

/* ---- effects as switches ---- */

let drawnEffects = "";
function drawEffects(answer, isOld) {
  const signature = JSON.stringify([page().steps.identify.key, isOld, page().offered]);
  if (signature === drawnEffects) return;
  drawnEffects = signature;
  const offered = page().offered;
  const list = element("effects");
  list.textContent = "";
  if (!offered.length) make(list, "li", { class: "none" }, "Nothing: the recordings show no effect that the description lacks.");
  const widest = Math.max(...offered.map((effect) => Math.max(effect.error_before || 0, effect.error_after || 0)), 1e-9);
  const boxes = offered.map((effect) => {
    const row = make(list, "li", {});
    const box = make(row, "input", { type: "checkbox", "aria-label": effect.text });
    box.checked = effect.in_model;
    box.disabled = isOld || !page().switchable.includes(effect.effect);
    if (box.disabled && !isOld) box.title = "A model cannot have this effect; it is named only.";
    make(row, "span", {}, effect.text + (effect.in_model ? "" : " (not in the model)"));
    const bars = make(row, "div", { class: "bars", title: `torque error ${percent(effect.error_before)} before, ${percent(effect.error_after)} after` });
    asbuiltPlot.bars(bars, [effect.error_before / widest, effect.error_after / widest]);
    box.addEventListener("change", () => { element("effects-button").hidden = false; });
    return box;
  });
  element("effects-button").hidden = true;
  element("effects-button").onclick = () => {
    const wanted = offered.filter((_, k) => boxes[k].checked);
    post("run/identify", { effects: listEffects(wanted, answer.joints) });
  };
}

/* Effects as `--effects` takes them: `spring:joints=2/5,tilt`. */
function listEffects(wanted, joints) {
  const names = [...new Set(wanted.map((effect) => effect.effect))];
  return names.map((name) => {
    const at = wanted.filter((effect) => effect.effect === name && effect.joint).map((effect) => joints.indexOf(effect.joint) + 1);
    return at.length ? `${name}:joints=${at.join("/")}` : name;
  }).join(",") || "none";
}

/* ---- torque: the curves of the report ---- */

function drawTorque(answer, files, key) {
  curves = null;
  element("torque").hidden = true;
  const place = fileAddress(files.report || "", key);
  if (place) readFile(place, (text) => { if (shown === answer && kept) fillTorque(answer, text); });
}

function fillTorque(answer, text) {
  const data = text.match(/<script type="application\/json" id="data">(.*?)<\/script>/s);
  if (!data) return;
  curves = JSON.parse(data[1]);
  const labels = answer.validation.map((fit) => fileName(fit.source));
  const list = element("recording");
  list.textContent = "";
  curves.recordings.forEach((_, k) => make(list, "option", { value: k }, labels[k] || "training" + (curves.recordings.length - labels.length > 1 ? " " + (k - labels.length + 1) : "")));
  recording = 0;
  joint = 0;
  element("torque-plot").range = null;
  const buttons = element("joints");
  buttons.textContent = "";
  curves.joints.forEach((name, k) => make(buttons, "button", { type: "button", "aria-pressed": "false" }, name).addEventListener("click", () => { joint = k; drawCurves(); }));
  element("torque").hidden = !curves.recordings.length;
  drawCurves();
}

export function drawCurves() {
  if (!curves || !curves.recordings.length) return;
  [...element("joints").children].forEach((button, k) => button.setAttribute("aria-pressed", String(k === joint)));
  asbuiltPlot.torques(element("torque-plot"), curves.recordings[recording].joints[joint], curves.joints[joint]);
}

element("recording").addEventListener("change", (event) => {
  recording = Number(event.target.value);
  element("torque-plot").range = null;
  drawCurves();
});
for (const [id, factor] of [["zoom-in", 0.5], ["zoom-out", 2], ["zoom-all", 0]]) {
  element(id).addEventListener("click", () => { asbuiltPlot.zoom(element("torque-plot"), factor); drawCurves(); });
}
for (const kind of ["svg", "png"]) {
  element("save-" + kind).addEventListener("click", () => {
    if (curves) asbuiltPlot.save(element("torque-plot"), kind, `torque_${curves.joints[joint]}.${kind}`);
  });
}

/* ---- files ---- */

/* Where a file of the folder is served; the key lets no browser show an older one. */
export function fileAddress(path, key) {
  const folder = page().folder.replace(/\/$/, "") + "/";
  return path.startsWith(folder) ? "files/" + path.slice(folder.length).split("/").map(encodeURIComponent).join("/") + "?" + key : null;
}

export function drawFiles(list, files, key) {
  list.textContent = "";
  for (const [kind, path] of Object.entries(files || {})) {
    const place = fileAddress(path, key);
    const row = make(list, "li", {});
    if (place) make(row, "a", { href: place, target: "_blank", rel: "noopener" }, kind);
    else make(row, "span", {}, kind);
    make(row, "span", { class: "quiet" }, path);
  }
}
