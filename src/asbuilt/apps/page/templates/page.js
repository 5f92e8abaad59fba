/* The page of `asbuilt open`: every section is drawn from one state (talk.js). */
import { digits, element, errorText, fileName, make, mark, upper } from "./parts.js";
import { choose, current, onChange, page, post, refresh, setOption, upload, useLogs } from "./talk.js";
import { drawColumns } from "./columns.js";
import { addCures, drawFindings } from "./findings.js";
import { drawCurves, drawFiles, drawResult, fileAddress } from "./result.js";

const descriptions = /\.(urdf|xml|mjcf|xacro|sdf|toml|csv)$/i;

function draw() {
  drawStart();
  drawChoices();
  drawFields();
  drawRobot();
  drawColumns(current("columns"));
  drawCheck();
  drawIdentify();
  drawResult();
  drawView();
  drawExport();
  drawJob();
  for (const [step, told] of Object.entries(page().steps)) drawCommand(step, told);
}

/* Text of a field, unless somebody is writing in it, or mends what was refused. */
function fill(node, text) {
  if (!node.isTyped && element("trouble").hidden) node.value = text;
}

for (const node of document.querySelectorAll("input")) {
  node.addEventListener("input", () => { node.isTyped = true; });
  node.addEventListener("change", () => { node.isTyped = false; });
}

/* ---- 1 robot and 2 logs ---- */

function drawStart() {
  const { choices, job, note } = page();
  element("start").hidden = Boolean(choices.robot || countLogs(choices));
  element("sample").disabled = Boolean(job);
  element("note").hidden = !note;
  element("note").textContent = note;
}

function drawChoices() {
  const { choices, robots } = page();
  const names = element("robot-name");
  if (names.options.length === 1) for (const name of robots) make(names, "option", { value: name }, name);
  names.value = robots.includes(choices.robot) ? choices.robot : "";
  fill(element("robot-path"), robots.includes(choices.robot) ? "" : choices.robot);
  drawLogs(choices);
}

/* What a recording is for: the fields of the choices that hold recordings. */
const roles = { logs: "identify with it", validation: "validate on it", payload: "it carries a load" };
const countLogs = (choices) => Object.keys(roles).reduce((sum, use) => sum + choices[use].length, 0);

let drawnLogs = "";
function drawLogs(choices) {
  const count = countLogs(choices);
  mark("logs", count ? count + (count > 1 ? " logs" : " log") : "", "good");
  const signature = JSON.stringify(Object.keys(roles).map((use) => choices[use]));
  const list = element("log-list");
  if (signature !== drawnLogs) fillLogs(list, choices);
  drawnLogs = signature;
  // A choice that was refused, or that another one took back, is not shown.
  for (const role of list.querySelectorAll("select")) role.value = role.dataset.use;
}

function fillLogs(list, choices) {
  list.textContent = "";
  for (const use of Object.keys(roles)) {
    for (const path of choices[use]) {
      const row = make(list, "li", {});
      const name = make(row, "span", { class: "name" });
      make(name, "b", {}, fileName(path));
      make(name, "span", { class: "quiet" }, " " + path);
      const role = make(row, "select", { "aria-label": "use of " + path, "data-use": use });
      for (const [value, text] of Object.entries(roles)) make(role, "option", { value }, text);
      role.addEventListener("change", () => useLogs([path], role.value));
      make(row, "button", { type: "button" }, "Remove").addEventListener("click", () => useLogs([path], ""));
    }
  }
}

function drawRobot() {
  const robot = current("show");
  const failed = Boolean(robot && robot.error);
  const place = element("robot-answer");
  place.className = "answer" + (failed ? " bad" : "");
  place.textContent = "";
  element("title").textContent = robot && !failed ? robot.robot : "asbuilt";
  mark("show", failed ? "not yet" : robot ? "done" : "", failed ? "bad" : "good");
  if (failed) place.textContent = errorText(robot);
  else if (robot) {
    const mass = robot.model.links.reduce((sum, link) => sum + (link.inertia ? link.inertia[9] || 0 : 0), 0);
    const odd = Object.keys(robot.inconsistencies || {});
    place.textContent = `${robot.robot}: ${robot.model.joints.length} joints, ${digits(mass)} kg moving` + (odd.length ? `; physically inconsistent: ${odd.join(", ")}` : "");
  }
}

/* ---- options: fields, and the line that they write ---- */

function drawFields() {
  const { choices, fields } = page();
  fill(element("reading"), choices.reading);
  fill(element("options"), choices.options);
  for (const node of document.querySelectorAll("[data-option]")) {
    const value = fields[node.dataset.line][node.dataset.option];
    const text = value === undefined ? "" : value === true ? "true" : value;
    if (node.tagName !== "SELECT") fill(node, text);
    else {
      if (![...node.options].some((option) => option.value === text)) make(node, "option", { value: text }, text);
      node.value = text;
    }
  }
  drawGains();
}

let drawnGains = "";
function drawGains() {
  const robot = current("show");
  const names = robot && !robot.error ? robot.model.joints.map((joint) => joint.name) : [];
  const given = page().fields.reading["--gain"];
  const values = given ? given.split(",") : [];
  const signature = JSON.stringify([names, given]);
  if (signature === drawnGains) return;
  drawnGains = signature;
  const place = element("gains");
  place.textContent = "";
  element("gains-all").hidden = !names.length;
  element("gains-all").open = false;
  const inputs = names.map((name, k) => {
    const label = make(place, "label", {}, name + " ");
    const input = make(label, "input", { type: "number", step: "any", "aria-label": "gain of " + name });
    input.value = values[values.length === 1 ? 0 : k] || "";
    return input;
  });
  for (const input of inputs) {
    input.addEventListener("change", () => {
      const texts = inputs.map((each) => each.value);
      if (texts.every(Boolean) || !texts.some(Boolean)) setOption("reading", "--gain", texts.every(Boolean) ? texts.join(",") : "");
    });
  }
}

/* ---- 4 check and 5 identify ---- */

let drawnCheck;
function drawCheck() {
  const answer = current("check");
  const failed = Boolean(answer && answer.error);
  const findings = answer && !failed ? answer.recordings.flatMap((recording) => nameFindings(recording, answer.recordings.length > 1)) : [];
  const count = (severity) => findings.filter((finding) => finding.severity === severity).length;
  const bad = failed || count("error") > 0;
  mark("check", bad ? "not yet" : answer ? "done" : "", bad ? "bad" : "good");
  const signature = answer && [answer, current("columns")];
  if (drawnCheck && signature && drawnCheck.every((part, k) => part === signature[k])) return;
  drawnCheck = signature;
  const minor = findings.filter((finding) => finding.severity === "info");
  drawFindings(element("check-findings"), findings.filter((finding) => finding.severity !== "info"));
  drawFindings(element("check-minor"), minor);
  element("check-more").hidden = !minor.length;
  element("check-more").open = false;
  element("check-more").firstElementChild.textContent = `${minor.length} more, good to know`;
  const place = element("check-answer");
  place.className = "answer" + (bad ? " bad" : "");
  const matched = current("columns");
  const isTold = failed && matched && matched.problem && matched.problem.startsWith(answer.error.message.slice(0, 60));
  if (isTold) place.textContent = "Match the columns of the log first, in step 3.";
  else place.textContent = answer ? (failed ? errorText(answer) : summary(answer, count("error"), count("warning"))) : "";
  if (failed && !isTold) addCures(place, answer.error.hint || answer.error.message);
}

/* Findings of one code at several joints are one, as in the terminal; errors stay apart. */
function nameFindings(recording, several) {
  const found = new Map();
  for (const finding of recording.findings) {
    const place = finding.joint || finding.link;
    const key = place && finding.severity !== "error" ? finding.severity + finding.code : finding.severity + finding.message;
    const first = found.get(key);
    if (!first) found.set(key, { ...finding, others: [], ...(several ? { source: fileName(recording.source) } : {}) });
    else if (place) first.others.push(place);
  }
  return [...found.values()].map((finding) => (finding.others.length ? { ...finding, message: `${finding.message}; the same holds for ${finding.others.join(", ")}` } : finding));
}

function summary(answer, errors, warnings) {
  const many = (count, what) => `${count} ${what}${count > 1 ? "s" : ""}`;
  const spans = answer.recordings.map((each) => `${each.n_samples} samples, ${digits(each.duration)} s at ${digits(each.rate)} Hz`).join("; ");
  const head = errors ? `Not sound: ${many(errors, "error")}. ` : warnings ? `Sound, with ${many(warnings, "warning")}. ` : "Sound. ";
  return head + spans + ".";
}

function drawIdentify() {
  const { steps, job } = page();
  const why = steps.identify.refusal;
  const answer = current("identify");
  const failed = Boolean(answer && answer.error);
  element("identify-button").disabled = Boolean(why || job);
  element("identify-refusal").textContent = why ? "Not yet: " + shortRefusal(why) + "." : "";
  const text = job && job.step === "identify" ? "running" : why ? "not yet" : failed ? "failed" : answer ? "done" : "ready";
  mark("identify", text, failed || (why && current("check")) ? "bad" : why ? "" : "good");
}

/* What a step above says in full is not repeated; the step is named. */
function shortRefusal(why) {
  const check = current("check");
  if (!check || !page().choices.logs.length) return why;
  const matched = current("columns");
  if (check.error && matched && matched.problem) return "match the columns of the log first, in step 3";
  return check.error ? "mend what step 4 says first" : "mend the errors of step 4 first";
}

/* ---- 7 view and 8 export ---- */

function drawWritten(step) {
  const { steps, job } = page();
  const why = steps[step].refusal;
  const answer = current(step);
  const failed = Boolean(answer && answer.error);
  element(step + "-button").disabled = Boolean(why || job);
  element(step + "-refusal").textContent = why ? "Not yet: " + why + "." : "";
  element(step + "-answer").textContent = failed ? errorText(answer) : answer && step === "export" ? upper(answer.verdict || "") : "";
  element(step + "-answer").className = "answer" + (failed ? " bad" : "");
  mark(step, failed ? "failed" : answer ? "done" : "", failed ? "bad" : "good");
  return failed ? null : answer;
}

let framed = "";
function drawView() {
  const answer = drawWritten("view");
  const frame = element("view-frame");
  const place = answer ? fileAddress(Object.values(answer.files)[0], page().steps.view.key) : "";
  frame.hidden = !place;
  if (place !== framed) frame.src = place || "about:blank";
  framed = place;
}

let drawnExport;
function drawExport() {
  const { choices, formats } = page();
  const list = element("export-format");
  if (!list.options.length) for (const [name, label] of Object.entries(formats)) make(list, "option", { value: name }, label);
  list.value = choices.export;
  const answer = drawWritten("export");
  if (drawnExport === answer) return;
  drawnExport = answer;
  drawFiles(element("export-files"), answer ? answer.files : {}, page().steps.export.key);
  for (const notes of Object.values((answer && answer.notes) || {})) for (const note of notes) make(make(element("export-files"), "li", {}), "span", { class: "quiet" }, note);
}

/* ---- the running command, and the command of each step ---- */

function drawJob() {
  const { job } = page();
  element("job").hidden = !job;
  if (!job) return;
  const bar = element("job").firstElementChild;
  if (job.fraction > 0) bar.value = job.fraction;
  else bar.removeAttribute("value");
  element("job-text").textContent = `${job.step}${job.what ? ": " + job.what : ""}, ${job.seconds.toFixed(0)} s`;
}

function drawCommand(step, told) {
  const section = document.querySelector(`[data-step="${step}"]`);
  let line = section.querySelector(".command");
  if (!line) {
    line = make(section, "div", { class: "command" });
    make(line, "code", {});
    make(line, "button", { type: "button", title: "Copy the command" }, "Copy").addEventListener("click", () => copy(line));
  }
  line.hidden = Boolean(told.refusal) && !(step === "identify" && page().choices.robot && page().choices.logs.length);
  line.firstElementChild.textContent = told.command;
}

function copy(line) {
  const marked = document.createRange();
  marked.selectNodeContents(line.firstElementChild);
  getSelection().removeAllRanges();
  getSelection().addRange(marked);
  if (navigator.clipboard) navigator.clipboard.writeText(line.firstElementChild.textContent).catch(() => document.execCommand("copy"));
  line.lastElementChild.textContent = "Copied";
  setTimeout(() => { line.lastElementChild.textContent = "Copy"; }, 1500);
}

/* ---- mouse and keys ---- */

function entries(transfer) {
  const items = [...transfer.items].map((item) => item.webkitGetAsEntry && item.webkitGetAsEntry()).filter(Boolean);
  const walk = async (entry) => {
    if (entry.isFile) return [[await new Promise((done, fail) => entry.file(done, fail)), entry.fullPath.replace(/^\//, "")]];
    const reader = entry.createReader();
    let all = [];
    for (;;) {
      const some = await new Promise((done, fail) => reader.readEntries(done, fail));
      if (!some.length) break;
      all = all.concat(some);
    }
    return (await Promise.all(all.map(walk))).flat();
  };
  return Promise.all(items.map(walk)).then((found) => found.flat());
}

function droppable(id, take) {
  const place = element(id);
  const hasFiles = (event) => event.dataTransfer.types.includes("Files");
  place.addEventListener("dragover", (event) => { if (hasFiles(event)) { event.preventDefault(); place.classList.add("over"); } });
  place.addEventListener("dragleave", () => place.classList.remove("over"));
  place.addEventListener("drop", async (event) => {
    place.classList.remove("over");
    if (!hasFiles(event)) return;
    event.preventDefault();
    take(await entries(event.dataTransfer));
  });
}

/* Of the files of a robot, meshes and includes among them, the description nearest to the top. */
async function takeRobot(files) {
  const paths = await upload(files);
  const depth = (k) => files[k][1].split("/").length;
  const found = paths.map((_, k) => k).filter((k) => paths[k] && descriptions.test(files[k][1])).sort((one, two) => depth(one) - depth(two));
  const chosen = found.length ? found[0] : paths.findIndex(Boolean);
  if (chosen >= 0) await choose({ robot: paths[chosen] });
}

/* A folder is one log; a sheet that lies beside a log is read with it. */
async function takeLogs(files) {
  const paths = await upload(files);
  const logs = paths.map((path, k) => {
    const depth = files[k][1].split("/").length - 1;
    const isSheet = depth === 0 && /\.toml$/i.test(files[k][1]) && files.some(([, name]) => !/\.toml$/i.test(name));
    return path && !isSheet ? path.split("/").slice(0, depth ? -depth : undefined).join("/") : null;
  });
  await useLogs([...new Set(logs.filter(Boolean))], "logs");
}

const listedFiles = (input) => [...input.files].map((file) => [file, file.webkitRelativePath || file.name]);
const entered = (id, act) => element(id).addEventListener("change", (event) => act(event.target.value.trim()));
const taken = (id, take) => element(id).addEventListener("change", async (event) => { await take(listedFiles(event.target)); event.target.value = ""; });
taken("robot-file", takeRobot);
taken("log-file", takeLogs);
taken("log-folder", takeLogs);
entered("robot-name", (robot) => robot && choose({ robot }));
entered("robot-path", (robot) => robot && choose({ robot }));
entered("log-path", (path) => { if (path) { element("log-path").value = ""; useLogs([path], "logs"); } });
entered("reading", (reading) => choose({ reading }));
entered("options", (options) => choose({ options }));
entered("export-format", (format) => choose({ export: format }));
for (const node of document.querySelectorAll("[data-option]")) {
  node.addEventListener("change", () => setOption(node.dataset.line, node.dataset.option, node.value === "true" ? true : node.value.trim()));
}
droppable("robot-drop", takeRobot);
droppable("log-drop", takeLogs);
element("sample").addEventListener("click", () => post("sample"));
element("identify-button").addEventListener("click", () => post("run/identify", { effects: "" }));
element("view-button").addEventListener("click", () => post("run/view"));
element("export-button").addEventListener("click", () => post("run/export", { export: element("export-format").value }));
element("cancel").addEventListener("click", () => post("cancel"));
let waiting = 0;
window.addEventListener("resize", () => { clearTimeout(waiting); waiting = setTimeout(drawCurves, 150); });
for (const name of ["dragover", "drop"]) window.addEventListener(name, (event) => event.preventDefault());
onChange(draw);
refresh();
