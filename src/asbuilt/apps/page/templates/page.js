"use strict";
(function () {
  const element = (id) => document.getElementById(id);
  const quantities = ["", "time", "position", "velocity", "acceleration", "torque", "command"];
  const answers = {};
  let state = null;
  let columns = [];
  let found = [];
  let curves = null;
  let recording = 0;
  let joint = 0;
  let seen = {};

  /* ---- talking to the server ---- */

  async function ask(method, place, body) {
    const sent = { method, body: method === "POST" ? JSON.stringify(body || {}) : body };
    const reply = await fetch(place, sent).catch(() => null);
    if (reply === null) { trouble("The program has ended; start asbuilt open again."); return null; }
    const document = await reply.json().catch(() => ({ error: reply.status + " " + reply.statusText }));
    if (document && typeof document.error === "string") { trouble(document.error); return null; }
    trouble("");
    return document;
  }

  async function post(place, body) {
    const next = await ask("POST", place, body);
    if (next) await show(next);
  }

  function trouble(text) {
    element("trouble").textContent = text;
    element("trouble").hidden = !text;
  }

  async function send(file, name, done) {
    return new Promise((settle) => {
      const request = new XMLHttpRequest();
      request.open("PUT", "files/" + name.split("/").map(encodeURIComponent).join("/"));
      request.upload.onprogress = (event) => done(event.loaded, event.total);
      request.onerror = () => { trouble("The upload of " + name + " failed."); settle(null); };
      request.onload = () => {
        let reply = {};
        try { reply = JSON.parse(request.responseText); } catch { reply = { error: "The upload of " + name + " was refused." }; }
        if (reply.error) trouble(reply.error);
        settle(reply.path || null);
      };
      request.send(file);
    });
  }

  async function upload(files) {
    const line = element("upload");
    line.hidden = false;
    const paths = [];
    for (const [file, name] of files) {
      paths.push(await send(file, name, (sent, total) => {
        line.firstElementChild.value = total ? sent / total : 0;
        line.lastElementChild.textContent = `${name}: ${(sent / 1e6).toFixed(0)} of ${(total / 1e6).toFixed(0)} MB`;
      }));
    }
    line.hidden = true;
    return paths.filter(Boolean);
  }

  /* ---- one look at the state; steps that only read follow by themselves ---- */

  let looks = 0;
  let timer = 0;
  async function show(next) {
    const look = looks += 1;
    clearTimeout(timer);
    state = next;
    drawChoices();
    for (const [step, told] of Object.entries(state.steps)) {
      const key = JSON.stringify([told.command, told.answered]) + (state.job ? state.job.step : "");
      if (told.answered && !(state.job && state.job.step === step) && seen[step] !== key) {
        answers[step] = await ask("GET", "answer/" + step);
        if (look !== looks) return;
        seen[step] = key;
      }
    }
    drawSteps();
    drawJob();
    if (state.job) { timer = setTimeout(refresh, 250); return; }
    const due = ["show", "columns", "check"].find((step) => !state.steps[step].refusal && !state.steps[step].current);
    if (due) await post("run/" + due);
  }

  async function refresh() {
    const next = await ask("GET", "state");
    if (next) await show(next);
  }

  const current = (step) => (state.steps[step].current ? answers[step] : null);
  const choose = (choices) => post("state", choices);

  /* ---- small makers ---- */

  function make(parent, tag, attributes, text) {
    const node = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes || {})) node.setAttribute(name, value);
    if (text !== undefined) node.textContent = text;
    parent.append(node);
    return node;
  }

  function select(parent, options, value, name) {
    const node = make(parent, "select", { "aria-label": name });
    for (const option of options) make(node, "option", { value: option }, option || "-");
    node.value = value || "";
    return node;
  }

  function drawState(step, text, mood) {
    const head = document.querySelector(`#${step} h2`);
    let mark = head.querySelector(".state");
    if (!mark) mark = make(head, "span", {});
    mark.className = "state " + (mood || "");
    mark.textContent = text;
  }

  function errorText(answer) {
    return answer.error.message + (answer.error.hint ? "; " + answer.error.hint : "");
  }

  function setAnswer(step, id, text, bad) {
    const place = element(id);
    place.textContent = text;
    place.className = "answer" + (bad ? " bad" : "");
    drawState(step, bad ? "not yet" : text ? "done" : "", bad ? "bad" : text ? "good" : "");
  }

  const percent = (value) => (value === null || value === undefined ? "-" : (100 * value).toPrecision(value < 0.1 ? 2 : 3) + " %");
  const digits = (value) => (value === null || value === undefined ? "-" : Number(value.toPrecision(3)).toString());

  /* A range, with the digits that tell its ends apart. */
  function span(low, high) {
    const shown = Math.min(12, Math.max(3, 3 + Math.ceil(Math.log10(Math.max(Math.abs(low), Math.abs(high)) / (high - low || 1) || 1))));
    return [low, high].map((each) => Number(each.toPrecision(shown)).toString()).join(" ... ");
  }

  /* ---- sections ---- */

  function drawChoices() {
    const chosen = state.choices;
    const names = element("robot-name");
    if (names.options.length === 1) for (const name of state.robots) make(names, "option", { value: name }, name);
    names.value = state.robots.includes(chosen.robot) ? chosen.robot : "";
    const at = (id, text) => { if (document.activeElement !== element(id)) element(id).value = text; };
    at("robot-path", state.robots.includes(chosen.robot) ? "" : chosen.robot);
    at("reading", chosen.reading);
    at("options", chosen.options);
    const list = element("log-list");
    list.textContent = "";
    for (const use of ["logs", "validation"]) {
      for (const path of chosen[use]) {
        const row = make(list, "li", {});
        make(row, "span", { class: "name" }, path);
        const role = make(row, "select", { "aria-label": "use of " + path });
        make(role, "option", { value: "logs" }, "identify with it");
        make(role, "option", { value: "validation" }, "validate on it");
        role.value = use;
        role.addEventListener("change", () => addLogs([path], role.value));
        make(row, "button", { type: "button" }, "Remove").addEventListener("click", () => addLogs([path], ""));
      }
    }
    const count = chosen.logs.length + chosen.validation.length;
    drawState("logs", count ? count + (count > 1 ? " logs" : " log") : "", count ? "good" : "");
    for (const [step, told] of Object.entries(state.steps)) drawCommand(step, told);
  }

  function drawCommand(step, told) {
    const section = document.querySelector(`[data-step="${step}"]`);
    let line = section.querySelector(".command");
    if (!line) {
      line = make(section, "div", { class: "command" });
      make(line, "code", {});
      make(line, "button", { type: "button", title: "Copy the command" }, "Copy").addEventListener("click", () => copy(line));
    }
    line.hidden = Boolean(told.refusal) && step !== "identify";
    line.firstElementChild.textContent = told.command;
  }

  function copy(line) {
    const text = line.firstElementChild.textContent;
    const marked = document.createRange();
    marked.selectNodeContents(line.firstElementChild);
    getSelection().removeAllRanges();
    getSelection().addRange(marked);
    if (navigator.clipboard) navigator.clipboard.writeText(text).catch(() => document.execCommand("copy"));
    line.lastElementChild.textContent = "Copied";
    setTimeout(() => { line.lastElementChild.textContent = "Copy"; }, 1500);
  }

  function addLogs(paths, use) {
    const kept = (each) => state.choices[each].filter((path) => !paths.includes(path));
    const next = { logs: kept("logs"), validation: kept("validation") };
    if (use) next[use] = next[use].concat(paths);
    return choose(next);
  }

  function drawSteps() {
    const robot = current("show");
    if (robot && robot.error) setAnswer("show", "robot-answer", errorText(robot), true);
    else if (robot) {
      const mass = robot.model.links.reduce((sum, link) => sum + (link.inertia ? link.inertia[9] || 0 : 0), 0);
      const odd = Object.keys(robot.inconsistencies || {});
      setAnswer("show", "robot-answer", `${robot.robot}: ${robot.model.joints.length} joints, ${digits(mass)} kg moving` + (odd.length ? `; physically inconsistent: ${odd.join(", ")}` : ""), false);
      element("title").textContent = robot.robot;
    } else setAnswer("show", "robot-answer", "", false);
    drawColumns();
    drawCheck();
    const why = state.steps.identify.refusal;
    element("identify-button").disabled = Boolean(why) || Boolean(state.job);
    element("identify-refusal").textContent = why ? "Not yet: " + why + "." : "";
    drawState("identify", why ? "not yet" : state.steps.identify.current ? "done" : "ready", why ? "bad" : "good");
    drawResult();
    for (const step of ["view", "export"]) {
      const refusal = state.steps[step].refusal;
      element(step + "-button").disabled = Boolean(refusal) || Boolean(state.job);
      element(step + "-refusal").textContent = refusal ? "Not yet: " + refusal + "." : "";
    }
    drawView();
    drawExport();
  }

  function drawJob() {
    const job = state.job;
    element("job").hidden = !job;
    if (!job) return;
    const bar = element("job").firstElementChild;
    if (job.fraction > 0) bar.value = job.fraction; else bar.removeAttribute("value");
    element("job-text").textContent = `${job.step}${job.what ? ": " + job.what : ""}, ${job.seconds.toFixed(0)} s`;
  }

  /* ---- columns ---- */

  function drawColumns() {
    const answer = current("columns");
    const body = element("column-table").tBodies[0];
    element("columns-all").hidden = !answer || Boolean(answer.error);
    if (!answer) { setAnswer("columns", "columns-answer", "", false); found = []; return; }
    if (answer.error) { setAnswer("columns", "columns-answer", errorText(answer), true); found = []; return; }
    if (found === answer.columns) return;
    found = answer.columns;
    const order = (each) => (each.quantity ? (quantities.indexOf(each.quantity) + 1 || 90) - 1 : 99);
    found.sort((one, two) => order(one) - order(two));
    columns = found.map((each) => ({ name: each.name, quantity: each.quantity || "", joint: each.joint || "" }));
    const used = found.filter((each) => each.quantity);
    const counted = quantities.filter(Boolean).map((quantity) => [quantity, used.filter((each) => each.quantity === quantity).length]).filter((pair) => pair[1]);
    setAnswer("columns", "columns-answer", answer.ok ? `${used.length} of ${found.length} columns are used: ${counted.map((pair) => pair[1] + " " + pair[0]).join(", ")}.` : answer.problem, !answer.ok);
    if (!answer.ok) element("columns-all").open = true;
    body.textContent = "";
    found.forEach((each, k) => {
      const row = make(body, "tr", { class: each.quantity ? "" : "unused" });
      make(row, "td", {}, each.name);
      asbuiltPlot.small(make(row, "td", {}), each.curve.row, each.curve.above_smallest);
      const quantity = select(make(row, "td", {}), quantities.includes(each.quantity || "") ? quantities : quantities.concat(each.quantity), each.quantity, "quantity of " + each.name);
      const known = answer.joints.includes(each.joint || "") || !each.joint ? [""] : ["", each.joint];
      const of = select(make(row, "td", {}), known.concat(answer.joints), each.joint, "joint of " + each.name);
      make(row, "td", { class: "number" }, each.smallest === null ? "empty" : span(each.smallest, each.largest));
      const change = () => {
        columns[k] = { name: each.name, quantity: quantity.value, joint: of.value };
        row.className = quantity.value !== (each.quantity || "") || of.value !== (each.joint || "") ? "changed" : each.quantity ? "" : "unused";
        renameJoint(answer, each, of.value);
        const changed = body.querySelectorAll(".changed").length;
        element("assign").disabled = !(changed || !answer.ok);
        element("assign-note").textContent = changed ? `${changed} changed.` : "";
      };
      quantity.addEventListener("change", change);
      of.addEventListener("change", change);
      row.refresh = () => { quantity.value = columns[k].quantity; of.value = columns[k].joint; change(); };
    });
    element("assign").disabled = answer.ok;
    element("assign-note").textContent = answer.ok ? "Change a quantity or a joint first." : "";
  }

  /* A joint of the log that gets one of the robot gets it in all its columns. */
  function renameJoint(answer, changed, joint) {
    if (!changed.joint || answer.joints.includes(changed.joint) || !joint) return;
    found.forEach((each, k) => {
      if (each.joint === changed.joint && columns[k].joint === changed.joint) {
        columns[k].joint = joint;
        element("column-table").tBodies[0].rows[k].refresh();
      }
    });
  }

  /* ---- check ---- */

  function drawFindings(list, findings) {
    list.textContent = "";
    for (const finding of findings) {
      const row = make(list, "li", { class: finding.severity });
      if (finding.severity === "error") make(row, "strong", {}, "Error. ");
      const cure = finding.cure ? finding.cure.text : "";
      const sentence = finding.message.replace(/\.$/, "") + ".";
      make(row, "span", {}, sentence[0].toUpperCase() + sentence.slice(1) + (cure ? " " + cure[0].toUpperCase() + cure.slice(1) + "." : ""));
      for (const [name, value] of Object.entries(finding.cure ? finding.cure.settings : {})) {
        const field = ["reading", "options"].find((each) => state.options[each][name]);
        if (!field) continue;
        const option = state.options[field][name];
        const needs = value === null;
        const text = option + (value === true || needs ? "" : " " + (Array.isArray(value) ? value.join(",") : value));
        const button = make(row, "button", { type: "button" }, needs ? "Give " + option : "Use " + text);
        button.addEventListener("click", () => {
          if (needs || /NUMBER/.test(text)) { const input = element(field); input.value = (state.choices[field] + " " + text + " ").trimStart(); input.focus(); return; }
          choose({ [field]: toggled(state.choices[field], option, text) });
        });
      }
    }
  }

  /* An option that is given twice has its last value; a flag is given once. */
  function toggled(line, option, text) {
    return line.split(" ").includes(option) && option === text ? line : (line + " " + text).trim();
  }

  function drawCheck() {
    const answer = current("check");
    if (!answer) { setAnswer("check", "check-answer", "", false); element("check-findings").textContent = ""; element("check-more").hidden = true; return; }
    if (answer.error) { setAnswer("check", "check-answer", errorText(answer), true); element("check-findings").textContent = ""; element("check-more").hidden = true; return; }
    const findings = answer.recordings.flatMap((each) => each.findings.map((finding) => (answer.recordings.length > 1 ? { ...finding, message: each.source.split("/").pop() + ": " + finding.message } : finding)));
    const count = (severity) => findings.filter((each) => each.severity === severity).length;
    const spans = answer.recordings.map((each) => `${each.n_samples} samples, ${digits(each.duration)} s at ${digits(each.rate)} Hz`).join("; ");
    const bad = count("error");
    setAnswer("check", "check-answer", (bad ? `Not sound: ${bad} error${bad > 1 ? "s" : ""}. ` : count("warning") ? `Sound, with ${count("warning")} warning${count("warning") > 1 ? "s" : ""}. ` : "Sound. ") + spans + ".", bad > 0);
    const minor = findings.filter((each) => each.severity === "info");
    drawFindings(element("check-findings"), findings.filter((each) => each.severity !== "info"));
    drawFindings(element("check-minor"), minor);
    element("check-more").hidden = !minor.length;
    element("check-more").firstElementChild.textContent = `${minor.length} more, good to know`;
  }

  /* ---- result ---- */

  let shownResult = null;
  function drawResult() {
    const answer = answers.identify;
    const none = !answer || !state.steps.identify.answered;
    element("result-none").hidden = !none;
    element("result-body").hidden = none || Boolean(answer.error);
    if (none) return;
    if (answer.error) {
      element("result-none").hidden = false;
      element("result-none").textContent = errorText(answer);
      drawState("result", "failed", "bad");
      return;
    }
    element("result-old").hidden = state.steps.identify.current;
    drawState("result", state.steps.identify.current ? "done" : "of other choices", state.steps.identify.current ? "good" : "");
    if (shownResult === answer) return;
    shownResult = answer;
    const held = answer.validation[0] || answer.train;
    const verdict = answer.verdict || { use: "", text: `Predicts ${answer.validation.length ? "what was held out" : "the recording itself"} to ${percent(held.relative_error)} of the torque (CAD ${percent(answer.cad && answer.cad.relative_error)}).` };
    element("verdict").textContent = verdict.text;
    element("verdict").className = "verdict " + ({ yes: "yes", no: "no", "with care": "care" }[verdict.use] || "");
    const cards = element("cards");
    cards.textContent = "";
    const card = (figure, label) => { const node = make(cards, "div", { class: "card" }); make(node, "div", { class: "figure" }, figure); make(node, "div", { class: "label" }, label); };
    card(percent(held.relative_error), "torque error as built");
    if (answer.cad) card(percent(answer.cad.relative_error), "torque error of CAD");
    if (answer.mass) card(digits(answer.mass.as_built) + " kg", `as built, CAD ${digits(answer.mass.cad)} kg`);
    card(answer.physically_consistent === false ? "no" : answer.physically_consistent ? "yes" : "-", "physically consistent");
    drawEffects(answer);
    drawJoints(answer, held);
    drawFindings(element("findings"), answer.findings);
    element("findings-title").textContent = `${answer.findings.length} findings`;
    drawFiles(element("result-files"), answer.files);
    drawTorque(answer);
    element("result").scrollIntoView({ behavior: "smooth" });
  }

  function drawJoints(answer, held) {
    const body = element("joint-errors").tBodies[0];
    body.textContent = "";
    answer.joints.forEach((name, k) => {
      const row = make(body, "tr", {});
      make(row, "td", {}, name);
      make(row, "td", { class: "number" }, answer.cad ? digits(answer.cad.rms[k]) : "-");
      make(row, "td", { class: "number" }, digits(held.rms[k]));
      make(row, "td", {}, held.units ? held.units[k] : "N m");
    });
  }

  /* ---- effects as switches ---- */

  let offered = [];
  function drawEffects(answer) {
    const key = (each) => each.effect + " " + (each.joint || "");
    const old = state.choices.effects ? offered.filter((each) => !answer.effects.some((one) => key(one) === key(each))).map((each) => ({ ...each, in_model: false })) : [];
    offered = answer.effects.concat(old);
    const list = element("effects");
    list.textContent = "";
    if (!offered.length) make(list, "li", { class: "none" }, "").append("Nothing: the recordings show no effect that the description lacks.");
    const widest = Math.max(...offered.map((each) => Math.max(each.error_before || 0, each.error_after || 0)), 1e-9);
    const boxes = offered.map((each) => {
      const row = make(list, "li", {});
      const box = make(row, "input", { type: "checkbox", "aria-label": each.text });
      box.checked = each.in_model;
      box.disabled = !state.switchable.includes(each.effect);
      if (box.disabled) box.title = "A model cannot have this effect; it is named only.";
      make(row, "span", {}, each.text + (each.in_model ? "" : " (not in the model)"));
      const bars = make(row, "div", { class: "bars", title: `torque error ${percent(each.error_before)} before, ${percent(each.error_after)} after` });
      asbuiltPlot.bars(bars, [each.error_before / widest, each.error_after / widest]);
      box.addEventListener("change", () => { element("effects-button").hidden = false; });
      return box;
    });
    element("effects-button").hidden = true;
    element("effects-button").onclick = async () => {
      const wanted = offered.filter((_, k) => boxes[k].checked);
      await choose({ effects: listed(wanted, answer.joints) });
      await post("run/identify");
    };
  }

  /* Effects as `--effects` takes them: `spring:joints=2/5,tilt`. */
  function listed(wanted, joints) {
    const names = [...new Set(wanted.map((each) => each.effect))];
    return names.map((name) => {
      const at = wanted.filter((each) => each.effect === name && each.joint).map((each) => joints.indexOf(each.joint) + 1);
      return at.length ? `${name}:joints=${at.join("/")}` : name;
    }).join(",") || "none";
  }

  /* ---- torque: the curves of the report ---- */

  async function drawTorque(answer) {
    curves = null;
    element("torque-plot").textContent = "";
    const place = fileAddress(answer.files.report || "");
    const reply = place ? await fetch(place).catch(() => null) : null;
    if (!reply || !reply.ok) return;
    const data = (await reply.text()).match(/<script type="application\/json" id="data">(.*?)<\/script>/s);
    if (!data) return;
    curves = JSON.parse(data[1]);
    const labels = answer.validation.map((each) => each.source.split("/").pop());
    const list = element("recording");
    list.textContent = "";
    curves.recordings.forEach((_, k) => make(list, "option", { value: k }, labels[k] || "training" + (curves.recordings.length - labels.length > 1 ? " " + (k - labels.length + 1) : "")));
    recording = 0;
    joint = 0;
    const buttons = element("joints");
    buttons.textContent = "";
    curves.joints.forEach((name, k) => make(buttons, "button", { type: "button", "aria-pressed": "false" }, name).addEventListener("click", () => { joint = k; drawCurves(); }));
    drawCurves();
  }

  function drawCurves() {
    if (!curves || !curves.recordings.length) return;
    [...element("joints").children].forEach((each, k) => each.setAttribute("aria-pressed", String(k === joint)));
    const of = curves.recordings[recording].joints[joint];
    asbuiltPlot.torques(element("torque-plot"), of, curves.joints[joint]);
    element("torque-note").textContent = "Drag to zoom, double-click to see all.";
  }

  /* ---- files, 3-D, export ---- */

  function fileAddress(path) {
    const folder = state.folder.replace(/\/$/, "") + "/";
    return path.startsWith(folder) ? "files/" + path.slice(folder.length).split("/").map(encodeURIComponent).join("/") : null;
  }

  function drawFiles(list, files) {
    list.textContent = "";
    for (const [kind, path] of Object.entries(files || {})) {
      const place = fileAddress(path);
      const row = make(list, list.tagName === "UL" ? "li" : "span", {});
      if (place) make(row, "a", { href: place, target: "_blank", rel: "noopener" }, `${kind} (${path})`);
      else make(row, "span", {}, `${kind} (${path})`);
      if (list.tagName !== "UL") list.append(" ");
    }
  }

  let framed = null;
  function drawView() {
    const answer = current("view");
    const frame = element("view-frame");
    setAnswer("view", "view-answer", answer && answer.error ? errorText(answer) : "", Boolean(answer && answer.error));
    if (!answer || answer.error) { frame.hidden = true; framed = null; return; }
    drawState("view", "done", "good");
    if (framed === answer) return;
    framed = answer;
    frame.hidden = false;
    frame.src = fileAddress(Object.values(answer.files)[0]);
  }

  function drawExport() {
    const answer = current("export");
    const ok = answer && !answer.error && answer.files;
    setAnswer("export", "export-answer", answer ? (answer.error ? errorText(answer) : answer.verdict || "") : "", Boolean(answer && answer.error));
    drawFiles(element("export-files"), ok ? answer.files : {});
    for (const notes of ok ? Object.values(answer.notes || {}) : []) for (const note of notes) make(make(element("export-files"), "li", {}), "span", { class: "quiet" }, note);
  }

  function exportLine() {
    const [option, value] = element("export-format").value.split(" ");
    const [format, file] = value.includes("=") ? value.split("=") : ["", value];
    const quoted = `'${(state.folder + "/" + file).replace(/'/g, "'\\''")}'`;
    return option + " " + (format ? format + "=" : "") + quoted;
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
    place.addEventListener("dragover", (event) => { event.preventDefault(); place.classList.add("over"); });
    place.addEventListener("dragleave", () => place.classList.remove("over"));
    place.addEventListener("drop", async (event) => {
      event.preventDefault();
      place.classList.remove("over");
      take(await entries(event.dataTransfer));
    });
  }

  async function takeRobot(files) {
    const paths = await upload(files);
    if (paths.length) await choose({ robot: paths[0] });
  }

  /* A folder is one log: its files are sent, and the folder is chosen. */
  async function takeLogs(files) {
    const paths = await upload(files);
    const top = (k) => files[k][1].split("/").length - 1;
    const chosen = paths.map((path, k) => (top(k) ? path.split("/").slice(0, -top(k)).join("/") + (top(k) > 1 ? "" : "") : path));
    await addLogs([...new Set(chosen)], "logs");
  }

  const listedFiles = (input) => [...input.files].map((file) => [file, file.webkitRelativePath || file.name]);
  const entered = (id, act) => element(id).addEventListener("change", (event) => act(event.target.value.trim()));
  element("robot-file").addEventListener("change", (event) => takeRobot(listedFiles(event.target)));
  for (const id of ["log-file", "log-folder"]) element(id).addEventListener("change", (event) => takeLogs(listedFiles(event.target)));
  entered("robot-name", (robot) => robot && choose({ robot }));
  entered("robot-path", (robot) => robot && choose({ robot }));
  entered("log-path", (path) => { if (path) { element("log-path").value = ""; addLogs([path], "logs"); } });
  entered("reading", (reading) => choose({ reading }));
  entered("options", (options) => choose({ options }));
  entered("export-format", () => choose({ export: exportLine() }));
  entered("recording", (value) => { recording = Number(value); element("torque-plot").range = null; drawCurves(); });
  droppable("robot-drop", takeRobot);
  droppable("log-drop", takeLogs);
  element("assign").addEventListener("click", () => post("sheet", { columns }));
  element("identify-button").addEventListener("click", async () => { await choose({ effects: "" }); await post("run/identify"); });
  element("view-button").addEventListener("click", () => post("run/view"));
  element("export-button").addEventListener("click", async () => { await choose({ export: exportLine() }); await post("run/export"); });
  element("cancel").addEventListener("click", () => post("cancel"));
  let pending = 0;
  window.addEventListener("resize", () => { clearTimeout(pending); pending = setTimeout(drawCurves, 150); });
  for (const name of ["dragover", "drop"]) window.addEventListener(name, (event) => event.preventDefault());
  refresh();
})();
