// The playground: sliders change a scene, the server computes it, this page draws what comes back.
// Over 400 lines: controls, requests and drawings share one state, and a page without a build step loads it at once.
"use strict";

const PAGE = Math.random().toString(36).slice(2);
const IDLE = 220; // ms without a change before the dearer answers are asked for
const PATIENCE = 1200; // ms of waiting after which the page says so
const STEPS = 1000;
const ONE_LENS = ["focal_length", "f_number"];
const $ = (id) => document.getElementById(id);
const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

let known = null; // what GET /api/play says
let chosen = "a";
let filming = false;
let whole = false;
const rows = new Map(); // the controls by setting
const sides = {};

// ---- numbers ----

function figures(value) {
  if (value === null || value === undefined) return "–";
  if (!Number.isFinite(value)) return "∞";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e5 || size < 1e-3) return raised(value, 2);
  return String(Number(value.toPrecision(4)));
}

function raised(value, digits) {
  const [number, power] = value.toExponential(digits).split("e");
  return `${number}·10${[...power.replace("+", "")].map((one) => (one === "-" ? "⁻" : "⁰¹²³⁴⁵⁶⁷⁸⁹"[one])).join("")}`;
}

function withUnit(value, unit) {
  if (value === null) return "–";
  if (value === 0) return `0 ${unit}`;
  const prefixes = ["f", "p", "n", "µ", "m", "", "k", "M"];
  const power = Math.min(2, Math.max(-5, Math.floor(Math.log10(Math.abs(value) * 1.00001) / 3)));
  const scaled = value / 10 ** (3 * power);
  if (Math.abs(scaled) < 0.01) return `${raised(value, 1)} ${unit}`;
  return `${Number(scaled.toPrecision(3))} ${prefixes[power + 5]}${unit}`;
}

function round(value) {
  return Number(value.toPrecision(5));
}

// ---- settings ----

function span(setting, side) {
  let { low, high } = setting;
  const lens = known.lenses[side.shown.lens];
  if (lens && setting.name === "f_number") low = round(lens.f_number * 1.0001);
  if (lens && setting.name === "focal_length") {
    const [first, last] = lens.focal_length;
    [low, high] = first === last ? [Math.max(low, first / 3), Math.min(high, first * 3)] : [first, last];
  }
  return [low, high];
}

function toSlider(setting, value, side) {
  const [low, high] = span(setting, side);
  const share = setting.log ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
  return Math.round(STEPS * Math.min(1, Math.max(0, share)));
}

function fromSlider(setting, place, side) {
  const [low, high] = span(setting, side);
  const share = place / STEPS;
  if (place >= STEPS) return high;
  if (place <= 0) return low;
  if (setting.log) return round(low * (high / low) ** share);
  const value = low + (high - low) * share;
  return round(Math.round(value / setting.step) * setting.step);
}

function spoken(setting, value) {
  if (setting.infinite && value >= setting.high) return "∞";
  return typeof value === "string" ? value : figures(value);
}

function build() {
  for (const name of Object.keys(known.scenes)) $("scene").append(new Option(name, name));
  const groups = new Map();
  for (const setting of known.settings) {
    if (!groups.has(setting.group)) {
      const box = document.createElement("fieldset");
      const legend = document.createElement("legend");
      legend.textContent = setting.group;
      box.append(legend);
      groups.set(setting.group, box);
      $("groups").append(box);
    }
    groups.get(setting.group).append(makeRow(setting));
  }
}

function makeRow(setting) {
  const row = document.createElement("div");
  row.className = "row";
  const label = document.createElement("label");
  label.textContent = setting.label;
  const value = document.createElement("span");
  value.className = "value";
  row.append(label, value);
  if (setting.choices.length) {
    const list = document.createElement("select");
    for (const choice of setting.choices) list.append(new Option(choice, choice));
    list.id = `set-${setting.name}`;
    label.htmlFor = list.id;
    list.addEventListener("change", () => set(setting.name, list.value));
    value.append(list);
    rows.set(setting.name, { setting, row, list });
    return row;
  }
  const box = document.createElement("input");
  box.type = "text";
  box.inputMode = "decimal";
  box.setAttribute("aria-label", `${setting.label}, as a number in ${setting.unit || "its unit"}`);
  const unit = document.createElement("span");
  unit.className = "unit";
  unit.textContent = setting.unit;
  value.append(box, unit);
  const slider = document.createElement("input");
  slider.type = "range";
  slider.min = 0;
  slider.max = STEPS;
  slider.id = `set-${setting.name}`;
  label.htmlFor = slider.id;
  slider.addEventListener("input", () => set(setting.name, fromSlider(setting, Number(slider.value), sides[chosen])));
  slider.addEventListener("keydown", (event) => {
    const far = { PageUp: 50, PageDown: -50 }[event.key];
    if (!far) return;
    event.preventDefault();
    slider.value = Number(slider.value) + far;
    slider.dispatchEvent(new Event("input"));
  });
  box.addEventListener("change", () => {
    const text = box.value.trim();
    const number = text === "∞" || text === "inf" ? setting.high : Number(text.replace(",", "."));
    if (text === "" || !Number.isFinite(number)) return show(sides[chosen]);
    set(setting.name, number);
  });
  label.addEventListener("dblclick", () => unset(setting.name));
  label.title = "double-click to reset";
  row.insertBefore(slider, value);
  row.classList.add("slides");
  rows.set(setting.name, { setting, row, slider, box });
  return row;
}

function set(name, value) {
  const side = sides[chosen];
  side.values[name] = value;
  side.shown[name] = value;
  if (name === "lens" || name === "phone") for (const one of ONE_LENS) delete side.values[one];
  if (name === "focal_length" || name === "f_number") if (side.shown.lens) side.values.lens = side.shown.lens;
  changed(side);
}

function unset(name) {
  delete sides[chosen].values[name];
  sides[chosen].shown = { ...known.scenes[sides[chosen].scene], ...sides[chosen].values };
  changed(sides[chosen]);
}

function changed(side) {
  side.wanted += 1;
  side.moved = performance.now();
  side.root.querySelector(".limit").classList.add("old");
  if (side === sides[chosen]) show(side);
  keepLink();
  nameSide(side);
  pump(side);
}

// What a talk's audience must know of each of two scenes: where it began, and what was changed.
function nameSide(side) {
  const said = known.settings
    .filter((one) => one.name in side.values)
    .map((one) => `${one.label} ${spoken(one, side.values[one.name])} ${one.unit === "of field" ? "" : one.unit}`.trim());
  side.root.querySelector(".name").textContent = `${side.name.toUpperCase()}: ${[side.scene, ...said].join(", ")}`;
}

function show(side) {
  $("scene").value = side.scene;
  for (const [name, one] of rows) {
    const value = side.shown[name];
    one.row.hidden = value === undefined || !applies(name, side.shown);
    one.row.classList.toggle("changed", name in side.values);
    if (one.row.hidden) continue;
    if (one.list) {
      one.list.value = value;
      continue;
    }
    one.slider.value = toSlider(one.setting, value, side);
    one.slider.setAttribute("aria-valuetext", `${spoken(one.setting, value)} ${one.setting.unit}`);
    if (document.activeElement !== one.box) one.box.value = spoken(one.setting, value);
  }
  for (const box of $("groups").children) box.hidden = [...box.querySelectorAll(".row")].every((row) => row.hidden);
}

function applies(name, shown) {
  if (name === "photosite_pitch" || name === "fill") return shown.photosites !== "none";
  if (name === "filter_depth") return shown.filter > 0;
  if (name === "second_x" || name === "second_y") return shown.second_beam > 0;
  if (name === "divergence") return shown.mode === "diverging";
  return true;
}

// ---- asking the server ----

async function ask(side, what) {
  const patience = setTimeout(() => {
    if (what.part !== "limit") side.root.querySelector(".took").textContent = "Still computing: this scene takes its time.";
  }, PATIENCE);
  const body = { scene: side.scene, settings: side.values, page: PAGE, side: side.name, seed: side.seed, ...what };
  let answer;
  try {
    answer = await fetch("/api/play", {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body),
    });
  } catch {
    return { refused: "the server does not answer; is tapetum still running?" };
  } finally {
    clearTimeout(patience);
  }
  if (answer.status === 409) return null;
  let found;
  try {
    found = await answer.json();
  } catch {
    return { refused: `the server answered ${answer.status} without words` };
  }
  return answer.ok ? found : { refused: found.detail || `the server answered ${answer.status}` };
}

// One request at a time: what changes meanwhile is asked for next, so that no picture is computed that nobody waits for.
async function pump(side) {
  if (side.busy) return;
  side.busy = true;
  try {
    while (side.done !== side.wanted) {
      const number = side.wanted;
      const found = await ask(side, { draft: true });
      if (found === null) continue;
      if (found.refused) refuse(side, found.refused);
      else await arrived(side, found);
      if (side.wanted !== number) continue;
      if (found.refused) { side.done = number; break; }
      await stillFor(side, IDLE);
      if (side.wanted !== number) continue;
      if (found.draft) {
        const full = await ask(side, {});
        if (full && side.wanted === number) {
          if (full.refused) refuse(side, full.refused);
          else await arrived(side, full);
        }
        if (side.wanted !== number) continue;
      }
      if (side.wanted === number) side.done = number;
    }
  } finally {
    side.busy = false;
  }
  askLimit(side);
  if (filming) setTimeout(() => nextFrame(side), 120);
}

// The limit may take seconds; pictures do not wait for it.
async function askLimit(side) {
  if (side.limiting) return;
  side.limiting = true;
  try {
    while (side.limited !== side.done && !side.root.classList.contains("stale")) {
      const number = side.done;
      const limit = await ask(side, { part: "limit" });
      if (limit) showLimit(side, limit);
      side.limited = number;
      side.root.querySelector(".limit").classList.toggle("old", side.wanted !== number);
    }
  } finally {
    side.limiting = false;
  }
}

async function stillFor(side, wait) {
  // Only a first picture is followed by a dearer one.
  while (side.result && side.result.draft && performance.now() - side.moved < wait) {
    await new Promise((go) => setTimeout(go, 40));
  }
}

async function nextFrame(side) {
  if (!filming || side.busy || side.root.hidden) return;
  side.busy = true;
  side.seed = (side.seed + 1) % 1000000;
  const number = side.wanted;
  const found = await ask(side, { draft: true });
  side.busy = false;
  if (found && !found.refused && number === side.wanted) await arrived(side, found, true);
  if (side.done !== side.wanted) pump(side);
  else setTimeout(() => nextFrame(side), 120);
}

// ---- drawing ----

function refuse(side, why) {
  side.root.querySelector(".refused").textContent = why;
  side.root.querySelector(".refused").hidden = false;
  side.root.classList.add("stale");
  side.root.querySelector(".took").textContent = side.result ? "What is shown, dimmed, is the last scene that could be computed." : "";
}

async function arrived(side, found, filmed = false) {
  const [image, frame] = await Promise.all([picture(found.image), picture(found.frame)]);
  side.result = found;
  side.pixels = { image, frame };
  side.root.classList.remove("stale");
  side.root.querySelector(".refused").hidden = true;
  // The server's values are those of the scene: a lens brings its own focal length.
  side.shown = { ...side.shown, ...found.settings, ...side.values };
  if (side === sides[chosen]) show(side);
  drawPictures(side);
  if (filmed) return;
  // The drawing of a real lens stays until its next one is traced.
  if (found.draft === "thin lens" && side.rays) side.result.rays = side.rays;
  side.rays = found.rays;
  drawRays(side);
  showBudget(side, found);
  showEye(side, found);
  const took = side.root.querySelector(".took");
  took.classList.toggle("draft", found.draft !== "");
  const claim = found.error === null ? "no claim of accuracy" : `error within ${figures(found.error)} of the peak`;
  took.textContent = found.draft
    ? `First picture, ${found.draft === "thin lens" ? "as of a thin lens of this focal length and aperture" : `on few samples (${claim})`}; the full one follows.`
    : `${found.prepared ? "Kept target" : "New target"}: ${Math.round(found.milliseconds)} ms; ${claim}; ${found.propagation}.`;
  document.documentElement.dataset.drawn = String(Number(document.documentElement.dataset.drawn || 0) + 1);
}

async function picture(address) {
  const found = new Image();
  found.src = address;
  await found.decode();
  const canvas = new OffscreenCanvas(found.width, found.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(found, 0, 0);
  return context.getImageData(0, 0, found.width, found.height);
}

// Inferno of matplotlib, by its values at nine places.
const INFERNO = [[0, 0, 4], [31, 12, 72], [85, 15, 109], [136, 34, 106], [186, 54, 85], [227, 89, 51], [249, 140, 10], [249, 201, 50], [252, 255, 164]];
const HEAT = new Uint8ClampedArray(256 * 3);
for (let i = 0; i < 256; i++) {
  const place = (i / 255) * (INFERNO.length - 1);
  const k = Math.min(INFERNO.length - 2, Math.floor(place));
  for (let c = 0; c < 3; c++) HEAT[3 * i + c] = INFERNO[k][c] + (INFERNO[k + 1][c] - INFERNO[k][c]) * (place - k);
}

function drawPictures(side) {
  const { result, pixels } = side;
  const half = whole ? Math.max(result.width, result.height) / 2 : result.half;
  paint(side, ".image", pixels.image, half, (value) => [HEAT[3 * value], HEAT[3 * value + 1], HEAT[3 * value + 2]]);
  const stretch = Math.max(1, result.brightest * (255 / result.top));
  paint(side, ".frame", pixels.frame, half, (value) => {
    if (value >= 255) return [255, 70, 60];
    const grey = Math.min(255, (255 * value) / stretch);
    return [grey, grey, grey];
  });
  const wide = 2 * half * result.pitch;
  side.root.querySelector(".about-image").textContent = `peak ${withUnit(result.peak, "W/m²")}`;
  const clipped = result.brightest >= result.top ? ", clipped" : "";
  side.root.querySelector(".about-frame").textContent = `to ${result.brightest} of ${result.top}${clipped}`;
  side.root.querySelector(".about-size").textContent = `Shown: ${withUnit(wide, "m")} of the probe's sensor.`;
}

function paint(side, selector, pixels, half, colour) {
  const canvas = side.root.querySelector(selector);
  const size = Math.round(2 * half);
  canvas.width = canvas.height = size;
  const context = canvas.getContext("2d");
  const out = context.createImageData(size, size);
  const left = Math.floor(pixels.width / 2 - half);
  const top = Math.floor(pixels.height / 2 - half);
  for (let y = 0; y < size; y++) {
    for (let x = 0; x < size; x++) {
      const from = (x + left >= 0 && x + left < pixels.width && y + top >= 0 && y + top < pixels.height)
        ? pixels.data[4 * ((y + top) * pixels.width + x + left)] : 0;
      const at = 4 * (y * size + x);
      const [r, g, b] = colour(from);
      out.data[at] = r;
      out.data[at + 1] = g;
      out.data[at + 2] = b;
      out.data[at + 3] = 255;
    }
  }
  context.putImageData(out, 0, 0);
}

function drawRays(side) {
  const canvas = side.root.querySelector(".rays");
  const rays = side.result.rays;
  const density = window.devicePixelRatio || 1;
  const width = canvas.clientWidth || 900;
  const height = Math.max(150, Math.min(260, width * 0.27));
  canvas.width = width * density;
  canvas.height = height * density;
  const context = canvas.getContext("2d");
  context.scale(density, density);
  const real = rays.glass.some((line) => line.length > 2);
  const points = [...rays.in, ...rays.back, ...rays.glass, rays.sensor, rays.stop].flat();
  const [z0, z1] = extent(points.map((one) => one[0]));
  const bulk = [...rays.in, ...rays.glass, rays.stop].flat();
  let [y0, y1] = extent(bulk.map((one) => one[1]));
  const margin = 16;
  let sz = (width - 2 * margin) / (z1 - z0 || 1);
  let sy = (height - 2 * margin) / (y1 - y0 || 1);
  if (real) sz = sy = Math.min(sz, sy);
  else sy = Math.min(sy, 60 * sz);
  const x = (z) => width / 2 + (z - (z0 + z1) / 2) * sz;
  const y = (h) => height / 2 + (h - (y0 + y1) / 2) * sy;
  const trace = (line) => {
    context.beginPath();
    line.forEach(([z, h], k) => (k ? context.lineTo(x(z), y(h)) : context.moveTo(x(z), y(h))));
  };
  context.strokeStyle = css("--line");
  context.setLineDash([6, 5]);
  trace([[z0, 0], [z1, 0]]);
  context.stroke();
  context.setLineDash([]);
  for (const line of rays.glass) {
    if (line.length > 2) {
      trace(line);
      context.fillStyle = css("--glass");
      context.globalAlpha = 0.45;
      context.fill();
      context.globalAlpha = 1;
    }
    trace(line);
    context.strokeStyle = css("--soft");
    context.lineWidth = line.length > 2 ? 0.8 : 2;
    context.stroke();
    if (line.length === 2) arrowheads(context, line.map(([z, h]) => [x(z), y(h)]));
  }
  context.lineWidth = 1.1;
  context.strokeStyle = css("--ray");
  for (const line of rays.in) { trace(line); context.stroke(); }
  context.strokeStyle = css("--back-ray");
  context.globalAlpha = 0.85;
  context.setLineDash([7, 4]);
  for (const line of rays.back) { trace(line); context.stroke(); }
  context.setLineDash([]);
  context.globalAlpha = 1;
  context.strokeStyle = css("--ink");
  context.lineWidth = 3;
  trace(rays.sensor);
  context.stroke();
  if (real) {
    context.lineWidth = 2;
    for (const [z, h] of rays.stop) { trace([[z, h], [z, h * 1.25]]); context.stroke(); }
  }
  scaleBar(context, width, height, sz);
  const parts = [];
  if (!real) parts.push(`heights drawn ${Math.round(sy / sz)} times larger`);
  parts.push(...rays.notes);
  side.root.querySelector(".about-rays").textContent = parts.join("; ");
}

function scaleBar(context, width, height, scale) {
  const wanted = 70 / scale;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const length = [5, 2, 1].map((k) => k * power).find((one) => one <= wanted);
  context.strokeStyle = context.fillStyle = css("--soft");
  context.lineWidth = 1.5;
  context.beginPath();
  context.moveTo(12, height - 8);
  context.lineTo(12 + length * scale, height - 8);
  context.stroke();
  context.font = "12px system-ui, sans-serif";
  context.fillText(withUnit(length, "m"), 16 + length * scale, height - 4);
}

function arrowheads(context, [[ax, ay], [bx, by]]) {
  for (const [tipX, tipY, way] of [[ax, ay, Math.sign(by - ay)], [bx, by, Math.sign(ay - by)]]) {
    context.beginPath();
    context.moveTo(tipX - 5, tipY + 7 * way);
    context.lineTo(tipX, tipY);
    context.lineTo(tipX + 5, tipY + 7 * way);
    context.stroke();
  }
}

function extent(values) {
  return [Math.min(...values), Math.max(...values)];
}

function showBudget(side, found) {
  const list = side.root.querySelector(".bars");
  const least = -15;
  const top = Math.log10(found.powers[0][1]);
  list.replaceChildren(...found.powers.map(([name, watts]) => {
    const item = document.createElement("li");
    const label = document.createElement("span");
    label.textContent = name;
    const bar = document.createElement("span");
    bar.className = "bar";
    const inner = document.createElement("i");
    const share = watts > 0 ? (Math.log10(watts) - least) / (top - least) : 0;
    inner.style.width = `${Math.max(0, Math.min(100, 100 * share))}%`;
    bar.append(inner);
    const value = document.createElement("output");
    value.textContent = withUnit(watts, "W");
    item.append(label, bar, value);
    return item;
  }));
  side.root.querySelector(".about-budget").textContent = `SNR ${figures(found.snr)} a frame`;
  fill(side.root.querySelector(".budget .rows"), found.budget);
}

function fill(list, pairs) {
  list.replaceChildren(...pairs.flatMap(([name, text]) => {
    const term = document.createElement("dt");
    term.textContent = name;
    const words = document.createElement("dd");
    words.textContent = text;
    return [term, words];
  }));
}

function showEye(side, found) {
  const { eye } = found;
  const line = side.root.querySelector(".class");
  line.className = "class";
  if (eye.class) {
    line.classList.add({ 1: "safe", "1M": "careful", 2: "careful", "2M": "careful" }[eye.class] || "danger");
    line.textContent = `Class ${eye.class}`;
    const meaning = eye.rows.length ? eye.rows[0][1] : "";
    const why = meaning.split(":").slice(1).join(":").trim();
    if (why) line.textContent += `: ${why}`;
  } else {
    line.textContent = "not computed";
  }
  fill(side.root.querySelector(".eye .rows"), eye.rows);
  side.root.querySelector(".notice").textContent = found.notice;
}

const NAMES = { gaze_x: "gaze x", gaze_y: "gaze y", object_distance: "focus" };

function showLimit(side, limit) {
  const list = side.root.querySelector(".bounds");
  if (limit.refused) {
    list.replaceChildren();
    side.root.querySelector(".about-limit").textContent = limit.refused;
    return;
  }
  fill(list, Object.entries(limit.bounds).map(([name, value]) => {
    const unit = limit.units[name];
    if (value === null) return [NAMES[name] || name, "no information"];
    return [NAMES[name] || name, unit === "m" ? `± ${withUnit(value, "m")}` : `± ${figures(value)} of field`];
  }));
  const left = Object.entries(limit.left_out).map(([name, why]) => `${NAMES[name] || name}: ${why}`);
  const same = new Set(Object.values(limit.left_out)).size === 1 && left.length > 1;
  const told = Object.keys(limit.bounds).length ? ["Cramér–Rao, all of these unknown together."] : [];
  told.push(...(same ? [Object.values(limit.left_out)[0]] : left).map((why) => `${why[0].toUpperCase()}${why.slice(1)}.`));
  if (limit.milliseconds >= 1) told.push(`Took ${Math.round(limit.milliseconds)} ms.`);
  side.root.querySelector(".about-limit").textContent = told.join(" ");
}

// ---- the link ----

function keepLink() {
  const found = new URLSearchParams();
  for (const name of ["a", "b"]) {
    const side = sides[name];
    if (side.root.hidden) continue;
    found.set(name, side.scene);
    for (const [key, value] of Object.entries(side.values)) found.set(`${name}.${key}`, value);
  }
  history.replaceState(null, "", `#${found}`);
}

function readLink() {
  const found = new URLSearchParams(location.hash.slice(1));
  for (const name of ["a", "b"]) {
    const scene = found.get(name);
    if (!(scene in known.scenes)) continue;
    const side = sides[name];
    side.scene = scene;
    side.values = {};
    for (const setting of known.settings) {
      const text = found.get(`${name}.${setting.name}`);
      if (text === null) continue;
      side.values[setting.name] = setting.choices.length ? text : Number(text);
    }
    side.shown = { ...known.scenes[scene], ...side.values };
    if (name === "b") compare(true);
  }
}

function say(text) {
  $("said").textContent = text;
  clearTimeout(say.later);
  say.later = setTimeout(() => { $("said").textContent = ""; }, 2500);
}

// ---- the page ----

function makeSide(name) {
  const root = $("side").content.firstElementChild.cloneNode(true);
  root.setAttribute("aria-label", `Scene ${name.toUpperCase()}`);
  $("sides").append(root);
  const scene = "thin-lens" in known.scenes ? "thin-lens" : Object.keys(known.scenes)[0];
  const side = {
    name, root, scene, values: {}, shown: { ...known.scenes[scene] }, wanted: 0, done: 0, busy: false, moved: 0,
    limiting: false, limited: 0, result: null, seed: 0,
  };
  root.addEventListener("pointerdown", () => choose(name));
  drag(root.querySelector(".image"), side);
  return side;
}

// Dragging turns the target: the whole width of the picture is the whole field.
function drag(canvas, side) {
  let from = null;
  canvas.addEventListener("pointerdown", (event) => {
    choose(side.name);
    from = [event.clientX, event.clientY, side.shown.gaze_x ?? 0, side.shown.gaze_y ?? 0];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!from) return;
    const size = canvas.clientWidth;
    const at = (start, moved) => round(Math.max(-0.5, Math.min(0.5, start + moved / size)));
    side.values.gaze_x = side.shown.gaze_x = at(from[2], event.clientX - from[0]);
    side.values.gaze_y = side.shown.gaze_y = at(from[3], event.clientY - from[1]);
    changed(side);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { from = null; });
}

function choose(name) {
  if (sides[name].root.hidden) return;
  chosen = name;
  for (const one of Object.values(sides)) one.root.classList.toggle("chosen", one.name === name);
  document.querySelector(`.which input[value="${name}"]`).checked = true;
  show(sides[name]);
}

function compare(on) {
  const { a, b } = sides;
  $("compare").setAttribute("aria-pressed", on);
  $("sides").classList.toggle("two", on);
  document.querySelector(".which").hidden = !on;
  b.root.hidden = !on;
  if (!on) return choose("a");
  if (!b.result && !Object.keys(b.values).length) {
    b.scene = a.scene;
    b.values = { ...a.values };
    b.shown = { ...a.shown };
  }
  choose("b");
  changed(b);
  if (a.result) drawRays(a);
}

function press(id, on) {
  $(id).setAttribute("aria-pressed", on);
  return on;
}

function toggleFilm() {
  filming = press("film", !filming);
  if (filming) for (const side of Object.values(sides)) nextFrame(side);
}

function toggleWhole() {
  whole = press("whole", !whole);
  for (const side of Object.values(sides)) if (side.result) drawPictures(side);
}

async function main() {
  known = await (await fetch("/api/play")).json();
  build();
  for (const name of ["a", "b"]) sides[name] = makeSide(name);
  sides.b.root.hidden = true;
  $("compare").addEventListener("click", () => { compare($("compare").getAttribute("aria-pressed") !== "true"); keepLink(); });
  $("film").addEventListener("click", toggleFilm);
  $("whole").addEventListener("click", toggleWhole);
  $("settings").addEventListener("submit", (event) => event.preventDefault());
  for (const one of document.querySelectorAll(".which input")) one.addEventListener("change", () => choose(one.value));
  $("scene").addEventListener("change", () => start(sides[chosen], $("scene").value));
  $("reset").addEventListener("click", () => start(sides[chosen], sides[chosen].scene));
  $("link").addEventListener("click", async () => {
    keepLink();
    try {
      await navigator.clipboard.writeText(location.href);
      say("copied");
    } catch {
      say("the address bar holds the link");
    }
  });
  $("save").addEventListener("click", () => {
    const side = sides[chosen];
    if (!side.result || !side.result.yaml) return;
    const link = document.createElement("a");
    link.href = URL.createObjectURL(new Blob([side.result.yaml], { type: "application/yaml" }));
    link.download = `${side.scene}-changed.yaml`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    say("saved");
  });
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.target.type !== "range") return;
    const key = event.key.toLowerCase();
    if (key === "a" || key === "b") choose(key);
    else if (key === "f") toggleFilm();
    else if (key === "w") toggleWhole();
  });
  const redraw = () => { for (const side of Object.values(sides)) if (side.result) drawRays(side); };
  addEventListener("resize", redraw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  addEventListener("hashchange", () => { readLink(); for (const side of Object.values(sides)) if (!side.root.hidden) changed(side); });
  readLink();
  choose(chosen);
  changed(sides.a);
}

function start(side, scene) {
  side.scene = scene;
  side.values = {};
  side.shown = { ...known.scenes[scene] };
  changed(side);
}

main();
