/* Small makers that every section uses. */
export const element = (id) => document.getElementById(id);

export function make(parent, tag, attributes, text) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) node.setAttribute(name, value);
  if (text !== undefined) node.textContent = text;
  parent.append(node);
  return node;
}

export function select(parent, options, value, name) {
  const node = make(parent, "select", { "aria-label": name });
  for (const option of options) make(node, "option", { value: option }, option || "-");
  node.value = value || "";
  return node;
}

/* What the head of a section says: "done", "not yet", ... */
export function mark(section, text, mood) {
  const head = document.querySelector(`#${section} h2`);
  const node = head.querySelector(".state") || make(head, "span", {});
  node.className = "state " + (mood || "");
  node.textContent = text;
}

export function errorText(answer) {
  return answer.error.message + (answer.error.hint ? "; " + answer.error.hint : "");
}

/* As verdicts write it: a part of a percent with two digits. */
export const percent = (value) => (value === null || value === undefined ? "-" : (100 * value).toFixed(value < 0.01 ? 2 : 1) + " %");
export const digits = (value) => (value === null || value === undefined ? "-" : Number(value.toPrecision(3)).toString());

/* A range, with the digits that tell its ends apart. */
export function span(low, high) {
  const shown = Math.min(12, Math.max(3, 3 + Math.ceil(Math.log10(Math.max(Math.abs(low), Math.abs(high)) / (high - low || 1) || 1))));
  return [low, high].map((end) => Number(end.toPrecision(shown)).toString()).join(" ... ");
}

export const fileName = (path) => path.split("/").pop();
export const upper = (text) => (text ? text[0].toUpperCase() + text.slice(1) : "");
