// What all views share: elements, names and colours of cameras, requests.

export const $ = (id) => document.getElementById(id);
const COLOURS = 6, MOST = 2000;
const numbers = new Map();  // by a camera's id: the number that people see
let count = 0;

export const number = (id) => {
  if (!numbers.has(id)) {
    numbers.set(id, ++count);
    // Who has been gone for long has no number any more.
    if (numbers.size > MOST) numbers.delete(numbers.keys().next().value);
  }
  return numbers.get(id);
};
export const name = (id) => `Camera ${number(id)}`;
export const colourName = (id) => `--c${(number(id) - 1) % COLOURS}`;
export const colour = (id) => style(colourName(id));
export const style = (variable) => getComputedStyle(document.documentElement).getPropertyValue(variable).trim();
// On pictures, which are dark in both themes.
export const bright = (id) => ["#4fd1bd", "#ffb066", "#a99fff", "#ff8fc7", "#7fbfff", "#d3e36b"][(number(id) - 1) % COLOURS];

export function say(id, text) {
  const one = typeof id === "string" ? $(id) : id;
  if (one.textContent !== text) one.textContent = text;
}

export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [key, value] of Object.entries(properties)) {
    if (key.startsWith("aria-") || key.startsWith("data-") || key === "role" || key === "for") made.setAttribute(key, value);
    else made[key] = value;
  }
  made.append(...children);
  return made;
}

// Asks the server; says why it refused in the line at the top, and returns null then.
export async function ask(path, options = {}) {
  try {
    const answer = await fetch(path, options);
    if (answer.ok) { refused(""); return answer.status === 204 ? true : await answer.json(); }
    const told = await answer.json().catch(() => ({}));
    refused(told.detail ?? `the server answered ${answer.status}`);
  } catch {
    refused("the server does not answer");
  }
  return null;
}

export const post = (path, body) => ask(path, {
  method: "POST", ...(body === undefined ? {} : { headers: { "content-type": "application/json" }, body: JSON.stringify(body) }),
});
export const remove = (path) => ask(path, { method: "DELETE" });

export function refused(why) {
  say("refused", why);
  $("refused").hidden = !why;
}

export const clock = (ns) => new Date(ns / 1e6).toLocaleTimeString("en-GB");
export const percent = (share) => (share === null ? "?" : `${Math.round(100 * share)} %`);

// Fits a canvas to its place on the page, and returns its pen and size in CSS pixels.
export function fitted(canvas) {
  const ratio = devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  const [w, h] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  return { pen, width, height };
}

// Keeps a list's items by a key: makes those that are new, drops those that are gone, and brings all up to date.
export function keep(list, items, key, make, update) {
  const known = new Map([...list.children].map((one) => [one.dataset.key, one]));
  const wanted = items.map((one) => String(key(one)));
  for (const [was, item] of known) if (!wanted.includes(was)) item.remove();
  items.forEach((one, k) => {
    let item = known.get(wanted[k]);
    if (!item) { item = make(one); item.dataset.key = wanted[k]; }
    if (list.children[k] !== item) list.insertBefore(item, list.children[k] ?? null);
    update?.(item, one);
  });
}
