/* One state: the newest document of the server, and the answers that belong to it. */
import { element } from "./parts.js";

let state = null;
let draw = () => {};
let timer = 0;
let pending = 0;
const answers = {};
const requests = {};

export const page = () => state;
export const onChange = (drawn) => { draw = () => { drawn(); wait(0); }; };

/* The answer of a step to the present question; null while there is none. */
export function current(step) {
  return state.steps[step].current ? last(step) : null;
}

/* The last answer of a step, which may be one to an older question. */
export function last(step) {
  const held = answers[step];
  return held && held.key === state.steps[step].key ? held.answer : null;
}

/* Whether the screen shows all that the server knows, and nothing runs. */
export function isBusy() {
  const missing = Object.entries(state.steps).some(([step, told]) => told.key && !last(step));
  return Boolean(state.job) || pending > 0 || missing;
}

export function trouble(text) {
  element("trouble").textContent = text;
  element("trouble").hidden = !text;
}

/* Count what is on its way, and say so to those who cannot see it. */
function wait(change) {
  pending += change;
  element("main").setAttribute("aria-busy", String(!state || isBusy()));
}

/* The reply to a request and its text; null and "" where nobody answers. */
async function talk(place, sent) {
  wait(1);
  const reply = await fetch(place, sent).catch(() => null);
  const text = reply ? await reply.text().catch(() => "") : "";
  return [reply, text];
}

/* The text of a written file, empty where there is none; `use` draws it. */
export async function readFile(place, use) {
  const [reply, text] = await talk(place);
  try { use(reply && reply.ok ? text : ""); } finally { wait(-1); }
}

async function ask(method, place, body) {
  const [reply, text] = await talk(place, { method, body: method === "POST" ? JSON.stringify(body || {}) : undefined });
  wait(-1);
  if (!reply) { trouble("The program has ended; start asbuilt open again."); return null; }
  let content = null;
  try { content = JSON.parse(text); } catch { content = { error: text || String(reply.status) }; }
  if (content && typeof content.error === "string" && !reply.ok) { trouble(content.error); draw(); return null; }
  if (method === "POST") trouble("");
  return content;
}

/* Take a document unless a newer one was taken before. */
function take(next) {
  if (!next || (state && next.serial < state.serial)) { if (state) draw(); return; }
  state = next;
  for (const step of Object.keys(state.steps)) fetchAnswer(step);
  draw();
  clearTimeout(timer);
  if (state.job) timer = setTimeout(refresh, 250);
}

/* Ask for the answer of a step; of several requests only the last one counts. */
async function fetchAnswer(step) {
  const key = state.steps[step].key;
  const before = requests[step];
  if (!key || last(step) || (before && before.key === key && before.open)) return;
  const request = { key, open: true, number: before ? before.number + 1 : 1 };
  requests[step] = request;
  const reply = await ask("GET", "answer/" + key);
  request.open = false;
  if (requests[step].number !== request.number) return;
  if (reply && reply.answer) answers[step] = { key, answer: reply.answer };
  if (reply && !reply.answer) refresh();
  else draw();
}

export const refresh = async () => take(await ask("GET", "state"));

/* Requests that change something go one after another: of two choices the later one holds. */
let line = Promise.resolve();
export function post(place, body) {
  wait(1);
  const reply = line.then(() => ask("POST", place, body));
  line = reply.catch(() => {});
  return reply.then(take).finally(() => wait(-1));
}

export const choose = (choices) => post("state", choices);
export const useLogs = (paths, use) => post("logs", { paths, use });
export const setOption = (line, option, value) => post("option", { line, option, value });

function send(file, place, done) {
  return new Promise((settle) => {
    const request = new XMLHttpRequest();
    request.open("PUT", "files/" + place.split("/").map(encodeURIComponent).join("/"));
    request.upload.onprogress = (event) => done(event.loaded, event.total);
    request.onerror = () => { trouble("The upload of " + place + " failed."); settle(null); };
    request.onload = () => {
      let reply = {};
      try { reply = JSON.parse(request.responseText); } catch { reply = { error: "The upload of " + place + " was refused." }; }
      if (reply.error) trouble(reply.error);
      settle(reply.path || null);
    };
    request.send(file);
  });
}

/* Send files of one drop into a folder of their own; returns the path of each, null where it failed. */
export async function upload(files) {
  const batch = await ask("POST", "batch");
  if (!batch) return files.map(() => null);
  const line = element("upload");
  const paths = [];
  line.hidden = false;
  wait(1);
  for (const [file, name] of files) {
    paths.push(await send(file, batch.batch + "/" + name, (sent, total) => {
      line.firstElementChild.value = total ? sent / total : 0;
      line.lastElementChild.textContent = `${name}: ${(sent / 1e6).toFixed(0)} of ${(total / 1e6).toFixed(0)} MB`;
    }));
  }
  wait(-1);
  line.hidden = true;
  return paths;
}

/* Files change behind the page: look again when the reader comes back. */
window.addEventListener("focus", () => { if (state) refresh(); });
