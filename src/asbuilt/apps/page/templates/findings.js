/* Findings and errors, each with a button for the option that cures it. */
import { make, upper } from "./parts.js";
import { page, setOption } from "./talk.js";

export function drawFindings(list, findings, curable = true) {
  list.textContent = "";
  for (const finding of findings) {
    const row = make(list, "li", { class: finding.severity });
    if (finding.severity === "error") make(row, "strong", {}, "Error. ");
    const cure = finding.cure ? finding.cure.text : "";
    const sentence = begin(finding.message.replace(/\.$/, "")) + ".";
    if (finding.source) make(row, "strong", {}, finding.source + ": ");
    make(row, "span", {}, sentence + (cure ? " " + upper(cure) + "." : ""));
    for (const [name, value] of Object.entries(curable && finding.cure ? finding.cure.settings : {})) {
      const line = Object.keys(page().options).find((each) => page().options[each][name]);
      if (line) addButton(row, line, page().options[line][name], value);
    }
    if (curable && finding.cure && finding.cure.call === "find_gains") addButton(row, "reading", "--gain", null);
  }
}

/* A sentence begins with a capital, the name of a recording as it is. */
const begin = (text) => (/^\S+\.\w+: /.test(text) ? text : upper(text));

/* Buttons for the options that a sentence names, such as "... (--torque-source command)". */
export function addCures(row, text) {
  for (const [, option, value] of text.matchAll(/(--[a-z][a-z-]+)(?: ([^\s()]+))?\)?/g)) {
    const line = Object.keys(page().options).find((each) => Object.values(page().options[each]).includes(option));
    if (line) addButton(row, line, option, value === undefined ? null : value);
  }
}

/* A value in capitals, or none, is one that only a person knows. */
function addButton(row, line, option, value) {
  const isFlag = page().flags.includes(option);
  const text = Array.isArray(value) ? value.join(",") : String(value);
  // What is chosen already cures nothing more.
  if (page().fields[line][option] === (isFlag ? true : text)) return;
  const isOpen = !isFlag && (value === null || value === undefined || /\b[A-Z]{2,}\b/.test(text));
  const button = make(row, "button", { type: "button" }, isOpen ? "Give " + option : "Use " + option + (isFlag ? "" : " " + text));
  button.addEventListener("click", () => (isOpen ? lead(line, option, text) : setOption(line, option, isFlag ? true : text)));
}

/* Lead to the field of an option, or to the line in which it is written. */
function lead(line, option, text) {
  const field = document.querySelector(`[data-option="${option}"]`);
  const target = field || document.getElementById(line);
  for (let node = target; node; node = node.parentElement) if (node.tagName === "DETAILS") node.open = true;
  if (!field) target.value = `${page().choices[line]} ${option} ${/^(null|undefined)$/.test(text) ? "" : text}`.trimStart();
  target.scrollIntoView({ block: "center" });
  target.focus();
}
