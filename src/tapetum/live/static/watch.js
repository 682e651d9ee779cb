// The watch's view: the probe's picture, the cameras, where one looks, and the events.

import { $, bright, colour, colourName, element, keep, name, number, percent, post, refused, remove, say } from "/static/common.js";
import { now, on } from "/static/socket.js";

const view = $("view"), pen = view.getContext("2d");
const TRAIL = 120, SPAN = 120e3, EVENTS = 100, MOMENTS = 100;
const trails = new Map();  // by a camera's id: places of the probe in its field
const stays = new Map();  // by a camera's id: from and to when it was seen, ms
const moments = new Map();  // by a camera's id: when its shutter opened, ms
const places = new Map();  // by a frame's number: its cameras, so that marks stand where that picture shows them
let state = null, chosen = null;

on("state", (message) => {
  state = message;
  places.set(message.frame, message.cameras);
  if (places.size > 40) places.delete(places.keys().next().value);
  for (const one of state.cameras) {
    const moment = state.utc_ns / 1e6, stay = stays.get(one.id) ?? { from: one.since_utc_ns / 1e6 };
    stays.set(one.id, { ...stay, to: moment });
    if (one.gaze_x && one.gaze_y && one.seen) {
      const trail = trails.get(one.id) ?? [];
      trail.push([one.gaze_x[0], one.gaze_y[0]]);
      if (trail.length > TRAIL) trail.shift();
      trails.set(one.id, trail);
    }
  }
  for (const [id, { to }] of stays) {
    if (to < state.utc_ns / 1e6 - SPAN) { stays.delete(id); trails.delete(id); moments.delete(id); }
  }
  requestAnimationFrame(draw);
});
on("picture", () => requestAnimationFrame(draw));
on("event", happened);

let drawn = 0;
function draw() {
  if (!state || $("view-watch").hidden) return;
  drawPicture();
  const now = performance.now();
  if (now - drawn < 100) return;  // words and lists need no more than ten changes a second
  drawn = now;
  $("none").hidden = state.cameras.length > 0;
  drawCameras();
  drawGaze();
  drawLine();
}

function drawPicture() {
  const picture = now.picture;
  if (!picture) return;
  if (view.width !== picture.width || view.height !== picture.height) {
    view.width = picture.width;
    view.height = picture.height;
  }
  pen.drawImage(picture, 0, 0);
  const scale = view.width / state.size[0], unit = view.width / Math.max(view.clientWidth, 1);
  pen.font = `600 ${14 * unit}px system-ui, sans-serif`;
  for (const one of places.get(now.shown) ?? state.cameras) {
    const x = (one.x + 0.5) * scale, y = (one.y + 0.5) * scale;
    const radius = Math.max(13 * unit, 0.8 * one.diameter * scale);
    pen.lineWidth = (one.id === chosen ? 3.5 : 2) * unit;
    pen.setLineDash(one.seen ? [] : [4 * unit, 4 * unit]);
    for (const [wide, style] of [[2 * unit, "#000a"], [0, bright(one.id)]]) {
      pen.strokeStyle = style;
      pen.lineWidth += wide;
      pen.beginPath();
      pen.arc(x, y, radius, 0, 2 * Math.PI);
      pen.stroke();
      pen.lineWidth -= wide;
    }
    const text = String(number(one.id)), left = x + radius + 4 * unit, low = y - radius * 0.5;
    pen.strokeStyle = "#000c";
    pen.lineWidth = 4 * unit;
    pen.setLineDash([]);
    pen.strokeText(text, left, low);
    pen.fillStyle = bright(one.id);
    pen.fillText(text, left, low);
  }
}

function drawCameras() {
  const list = $("cameras"), ids = new Set(state.cameras.map((one) => one.id));
  for (const item of [...list.children]) if (!ids.has(item.dataset.id)) item.remove();
  const gone = !ids.has(chosen);
  if (gone) chosen = (state.cameras.find((one) => one.gaze_x) ?? state.cameras[0])?.id ?? null;
  for (const one of state.cameras) {
    const item = list.querySelector(`[data-id="${one.id}"]`) ?? card(one.id, list);
    item.classList.toggle("chosen", one.id === chosen);
    item.classList.toggle("hidden-now", !one.seen);
    item.querySelector(".name").setAttribute("aria-pressed", String(one.id === chosen));
    const said = item.querySelector(".said"), text = words(one);
    if (said.textContent !== text) said.textContent = text;
    item.querySelector("[data-by=device]").hidden = !one.device;
    if (one.seen) thumbnail(item.querySelector("canvas"), one);
  }
}

const WAYS = [
  ["place", "this place", "No camera near this place is reported"],
  ["device", "this device", "No camera that is taken for this device is reported"],
  ["look", "this look", "A camera that looks as this one did in the last minute is not reported, wherever it is"],
];

function card(id, list) {
  const item = document.createElement("li"), thumb = document.createElement("canvas");
  item.className = "camera";
  item.dataset.id = id;
  item.style.setProperty("--colour", `var(${colourName(id)})`);
  thumb.width = thumb.height = 64;
  thumb.setAttribute("aria-hidden", "true");
  const middle = document.createElement("div"), button = document.createElement("button"), said = document.createElement("div");
  button.type = "button";
  button.className = "name";
  button.textContent = name(id);
  button.onclick = () => { chosen = id; drawn = 0; draw(); };
  said.className = "said";
  middle.append(button, said);
  const ours = element("details", { className: "ignore" }, element("summary", { textContent: "Ignore", "aria-label": `Ignore ${name(id)}: it is ours` }));
  const ways = element("div", { className: "ways", role: "group", "aria-label": `What ${name(id)} is known by` });
  for (const [by, words, title] of WAYS) {
    const way = element("button", { type: "button", textContent: words, title, "data-by": by });
    way.onclick = async () => { if (await ignore(id, by)) ours.open = false; };
    ways.append(way);
  }
  ours.append(ways);
  item.append(thumb, middle, ours);
  list.append(item);
  return item;
}

function words(one) {
  const parts = [];
  if (one.device) parts.push(`${one.device} (${percent(one.device_probability)})`);
  if (one.active !== null) parts.push(one.active ? "imaging" : "not imaging");
  if (one.gaze_x && one.gaze_y) parts.push(`gaze ${within(one.gaze_x)} / ${within(one.gaze_y)}`);
  if (one.regions.length) parts.push(`looks at ${one.regions.join(", ")}`);
  const seconds = Math.max(0, Math.round((state.utc_ns - one.since_utc_ns) / 1e9));
  parts.push(one.seen ? `for ${lasting(seconds)}` : "hidden");
  return parts.join(" · ");
}

const within = ([value, low, high]) => `${value.toFixed(3).replace("-", "−")} ± ${((high - low) / 2).toFixed(3)}`;
const lasting = (s) => (s < 60 ? `${s} s` : s < 3600 ? `${Math.floor(s / 60)} min` : `${Math.floor(s / 3600)} h`);

function thumbnail(canvas, one) {
  const picture = now.picture;
  if (!picture) return;
  const scale = picture.width / state.size[0], side = Math.max(48, 3 * one.diameter) * scale;
  const draw2d = canvas.getContext("2d");
  draw2d.fillRect(0, 0, 64, 64);
  draw2d.drawImage(picture, one.x * scale - side / 2, one.y * scale - side / 2, side, side, 0, 0, 64, 64);
}

function drawGaze() {
  const one = state.cameras.find((camera) => camera.id === chosen && camera.gaze_x && camera.gaze_y);
  $("gaze-panel").hidden = !one;
  if (!one) return;
  say("gaze-title", `Where ${name(one.id)} looks`);
  const canvas = $("gaze"), draw2d = canvas.getContext("2d"), { width, height } = canvas;
  const ink = getComputedStyle(document.body).color, [at, along] = [(x) => (x + 0.5) * width, (y) => (y + 0.5) * height];
  draw2d.clearRect(0, 0, width, height);
  draw2d.strokeStyle = ink;
  draw2d.globalAlpha = 0.4;
  draw2d.lineWidth = 1;
  draw2d.beginPath();
  for (const [x0, y0, x1, y1] of [[-0.04, 0, 0.04, 0], [0, -0.05, 0, 0.05]]) {
    draw2d.moveTo(at(x0), along(y0));
    draw2d.lineTo(at(x1), along(y1));
  }
  draw2d.stroke();
  draw2d.strokeStyle = draw2d.fillStyle = colour(one.id);
  draw2d.globalAlpha = 0.5;
  draw2d.lineWidth = 2;
  draw2d.beginPath();
  (trails.get(one.id) ?? []).forEach(([x, y], k) => (k ? draw2d.lineTo(at(x), along(y)) : draw2d.moveTo(at(x), along(y))));
  draw2d.stroke();
  const [x, left, right] = one.gaze_x, [y, top, bottom] = one.gaze_y;
  draw2d.globalAlpha = 0.25;
  draw2d.fillRect(at(left), along(top), at(right) - at(left), along(bottom) - along(top));
  draw2d.globalAlpha = 1;
  draw2d.beginPath();
  draw2d.arc(at(x), along(y), 5, 0, 2 * Math.PI);
  draw2d.fill();
}

function drawLine() {
  const canvas = $("line"), ratio = devicePixelRatio || 1, draw2d = canvas.getContext("2d");
  const width = Math.round(canvas.clientWidth * ratio), rows = Math.max(1, stays.size), row = 14 * ratio;
  const height = Math.round(rows * row + 18 * ratio);
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
    canvas.style.height = `${height / ratio}px`;
  }
  draw2d.clearRect(0, 0, width, height);
  const now = state.utc_ns / 1e6, at = (t) => width * (1 - (now - t) / SPAN);
  draw2d.font = `${11 * ratio}px system-ui, sans-serif`;
  draw2d.fillStyle = draw2d.strokeStyle = getComputedStyle($("nothing")).color;
  const every = width / ratio < 500 ? 60 : 30;
  for (let s = 0; s <= SPAN / 1000; s += every) {
    const x = at(now - 1000 * s), text = s ? `−${s} s` : "now";
    draw2d.textAlign = s ? (s === SPAN / 1000 ? "left" : "center") : "right";
    draw2d.fillText(text, x, height - 3 * ratio);
    draw2d.globalAlpha = 0.3;
    draw2d.fillRect(Math.min(x, width - ratio), 0, ratio, rows * row);
    draw2d.globalAlpha = 1;
  }
  const ink = getComputedStyle(document.body).color;
  [...stays].forEach(([id, { from, to }], k) => {
    draw2d.fillStyle = colour(id);
    draw2d.fillRect(Math.max(0, at(from)), k * row + 3 * ratio, Math.max(2 * ratio, at(to) - Math.max(0, at(from))), row - 6 * ratio);
    draw2d.fillStyle = ink;
    for (const moment of moments.get(id) ?? []) draw2d.fillRect(at(moment) - ratio, k * row, 2 * ratio, row);
  });
}

const KINDS = {
  seen: (who) => `${who} is seen`, gone: (who) => `${who} is gone`, imaging: (who) => `${who} images`,
  "not imaging": (who) => `${who} images no more`, looks: (who, what) => `${who} looks at ${what}`,
  "looks away": (who, what) => `${who} looks away from ${what}`, device: (who, what) => `${who} is taken for ${what}`,
  "shutter opened": (who) => `${who} opened its shutter`,
  alert: (who, what) => `Alert: ${what} (${who})`,
  "source lost": (_, what) => `The source went: ${what}`, "source returned": () => "The source returned",
  "source ended": () => "The recording is at its end",
};

function happened(event) {
  if (event.kind === "shutter opened") moments.set(event.id, [...(moments.get(event.id) ?? []), event.utc_ns / 1e6].slice(-MOMENTS));
  const item = document.createElement("li"), when = document.createElement("time"), what = document.createElement("span");
  const moment = new Date(event.utc_ns / 1e6), image = event.picture ? document.createElement("img") : document.createElement("i");
  item.className = "event";
  when.dateTime = moment.toISOString();
  when.textContent = moment.toLocaleTimeString("en-GB");
  if (event.picture) { image.src = `/api/events/${event.number}/picture`; image.alt = ""; image.loading = "lazy"; }
  const source = event.kind.startsWith("source");
  what.textContent = (KINDS[event.kind] ?? ((who) => `${who}: ${event.kind}`))(source ? "" : name(event.id), event.detail);
  if (event.kind === "alert") item.classList.add("alert");
  item.append(when, image, what);
  $("events").prepend(item);
  while ($("events").children.length > EVENTS) $("events").lastChild.remove();
  $("nothing").hidden = true;
}

async function ignore(id, by = "place") {
  const one = state.cameras.find((camera) => camera.id === id);
  if (!one) { refused(`${name(id)} is no longer here: choose one of the list`); return null; }
  const place = { x: Math.max(0, one.x), y: Math.max(0, one.y), radius: Math.max(40, 2 * one.diameter) };
  const done = await post("/api/ignored", { place, device: { device: one.device }, look: { camera: id } }[by]);
  await ours();
  return done;
}

async function ours() {
  const answer = await fetch("/api/ignored"), all = answer.ok ? await answer.json() : [];
  $("ours").hidden = !all.length;
  say("ignored", `${all.length} of ours ${all.length === 1 ? "is" : "are"} ignored.`);
  keep($("ours-list"), all, (one) => one.id, (one) => {
    const known = { place: `within ${Math.round(one.radius)} pixels of ${Math.round(one.x)}, ${Math.round(one.y)}`, device: `each ${one.device}`, look: `one that looks alike (${one.looks} looks)` }[one.by];
    const again = element("button", { type: "button", textContent: "Show again", "aria-label": `Show again: ${known}` });
    again.onclick = async () => { await remove(`/api/ignored?one=${one.id}`); await ours(); };
    return element("li", {}, element("span", { textContent: known }), again);
  });
  $("look-note").hidden = !all.some((one) => one.by === "look");
}

$("forget").onclick = async () => { await remove("/api/ignored"); await ours(); };

addEventListener("keydown", (event) => {
  if (!state || $("view-watch").hidden || event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select, textarea")) return;
  const at = state.cameras.findIndex((one) => one.id === chosen), count = state.cameras.length;
  if ((event.key === "ArrowDown" || event.key === "ArrowUp") && count) {
    chosen = state.cameras[(at + (event.key === "ArrowDown" ? 1 : count - 1)) % count].id;
    event.preventDefault();
    // A camera that was first seen just now has no card before the lists are drawn.
    drawn = 0;
    draw();
    $("cameras").querySelector(`[data-id="${chosen}"] .name`)?.focus();
  } else if (event.key === "i" && chosen) {
    ignore(chosen);
  } else if (event.key === "p") {
    now.paused = !now.paused;
  } else {
    return;
  }
  draw();
});

addEventListener("view", () => { drawn = 0; draw(); });
ours();
