// The exhibit: marks to look at, and where cameras point.

import { $, bright, clock, element, fitted, keep, name, number, post, remove, say } from "/static/common.js";
import { now, on } from "/static/socket.js";

const stage = $("stage"), canvas = $("points"), TRAIL = 40;
const trails = new Map();
const SAY = {
  look: "Point at the mark", "hold still": "Hold still", "no camera": "No camera is seen", "no gaze": "The camera shows no gaze",
  next: "Next", done: "Done",
};
let exhibit = null, before = null, hidden = true;

on("modes", (modes) => {
  exhibit = modes.exhibit;
  lead(modes);
  if (hidden) return;
  for (const one of exhibit.pointers) {
    const trail = trails.get(one.camera) ?? [];
    trail.push([one.x, one.y]);
    if (trail.length > TRAIL) trail.shift();
    trails.set(one.camera, trail);
  }
  for (const id of trails.keys()) if (!exhibit.pointers.some((one) => one.camera === id)) trails.delete(id);
  words(modes);
  requestAnimationFrame(draw);
});
on("state", ({ cameras }) => {
  if (hidden) return;
  const list = $("calibrate-camera"), chosen = list.value, shown = cameras.filter((one) => one.gaze_x);
  const wanted = shown.map((one) => one.id).join(" ");
  if (list.dataset.has === wanted) return;
  list.dataset.has = wanted;
  list.replaceChildren(list.options[0], ...shown.map((one) => element("option", { value: one.id, textContent: name(one.id) })));
  list.value = shown.some((one) => one.id === chosen) ? chosen : "";
});
addEventListener("view", ({ detail }) => {
  hidden = detail !== "exhibit";
  if (hidden || !now.modes) return;
  // Nothing may come for long after: what came before is shown.
  exhibit = now.modes.exhibit;
  words(now.modes);
  draw();
});
addEventListener("resize", () => { if (!hidden) draw(); });

function words({ hands }) {
  const { step } = exhibit;
  let text = exhibit.fault ? `That did not work: ${exhibit.fault}` : exhibit.calibrated ? "Calibrated." : "Not calibrated.";
  if (step && step.say !== "done") text = `Mark ${step.number} of ${step.count}: ${SAY[step.say] ?? step.say}`;
  say("step", text);
  say("stage-say", step && step.mark ? SAY[step.say] ?? "" : exhibit.calibrated ? "" : "Calibrate first");
  $("calibrate-cancel").hidden = !step || step.say === "done";
  $("calibrate-forget").hidden = $("calibrated").hidden = !exhibit.calibrated;
  $("hand-note").hidden = $("self-line").hidden = !hands;
  if (hands && !$("across").dataset.set) {
    // The simulated screen's, which a lens of 100 mm sees small.
    $("across").dataset.set = "yes";
    $("across").value = 0.17;
  }
  if (exhibit.calibrated) {
    say("error-px", exhibit.error === null ? "unknown" : `${exhibit.error.toFixed(1)} px of ${exhibit.screen.width}`);
    say("error-deg", exhibit.degrees === null ? "unknown" : `${exhibit.degrees.toFixed(2)}°`);
    say("took", exhibit.seconds === null ? "earlier" : `${exhibit.seconds.toFixed(0)} s`);
    say("made-at", clock(exhibit.utc_ns));
  }
  keep($("pointing"), exhibit.pointers, (one) => one.camera, (one) => {
    const item = element("li", {}, element("span", { textContent: name(one.camera) }), element("span"));
    item.style.setProperty("--colour", bright(one.camera));
    return item;
  }, (item, one) => {
    const at = (share, size) => `${Math.round(share * size)}`, { width, height } = exhibit.screen;
    say(item.lastChild, `${at(one.x, width)}, ${at(one.y, height)} px${one.inside ? "" : ", beside the screen"}`);
  });
  $("no-pointing").hidden = exhibit.pointers.length > 0;
  const blind = now.state?.cameras.length && !now.state.cameras.some((one) => one.gaze_x);
  say("no-pointing", blind ? "No camera shows its gaze: that takes a --model, as “tapetum serve hand” has." : "No camera points.");
}

function draw() {
  if (hidden || !exhibit) return;
  const { pen, width, height } = fitted(canvas), { step } = exhibit;
  pen.strokeStyle = "#ffffff18";
  pen.lineWidth = 1;
  for (let k = 1; k < 8; k++) {
    pen.beginPath();
    pen.moveTo((k * width) / 8, 0);
    pen.lineTo((k * width) / 8, height);
    pen.moveTo(0, (k * height) / 8);
    pen.lineTo(width, (k * height) / 8);
    pen.stroke();
  }
  if (step?.mark) { mark(pen, step, width, height); return; }
  for (const one of exhibit.marks) {
    pen.fillStyle = "#ffffff55";
    pen.fillRect(one.x * width - 4, one.y * height - 0.5, 9, 1);
    pen.fillRect(one.x * width, one.y * height - 4, 1, 9);
  }
  for (const one of exhibit.pointers) point(pen, one, width, height);
}

function mark(pen, { mark: [x, y], progress, say: said }, width, height) {
  const [at, along, size] = [x * width, y * height, Math.max(14, width / 40)];
  pen.strokeStyle = "#ffffff66";
  pen.lineWidth = 2;
  pen.beginPath();
  pen.arc(at, along, size, 0, 2 * Math.PI);
  pen.stroke();
  pen.strokeStyle = said === "hold still" ? "#ffb066" : "#4fd1bd";
  pen.lineWidth = 5;
  pen.beginPath();
  pen.arc(at, along, size, -Math.PI / 2, -Math.PI / 2 + 2 * Math.PI * progress);
  pen.stroke();
  pen.fillStyle = "#ffffff";
  pen.beginPath();
  pen.arc(at, along, 4, 0, 2 * Math.PI);
  pen.fill();
}

function point(pen, one, width, height) {
  const [x, y] = [one.x * width, one.y * height];
  pen.strokeStyle = pen.fillStyle = bright(one.camera);
  pen.globalAlpha = 0.45;
  pen.lineWidth = 2;
  pen.beginPath();
  (trails.get(one.camera) ?? []).forEach(([a, b], k) => (k ? pen.lineTo(a * width, b * height) : pen.moveTo(a * width, b * height)));
  pen.stroke();
  pen.globalAlpha = 0.18;
  pen.beginPath();
  pen.ellipse(x, y, Math.max(2, one.half_x * width), Math.max(2, one.half_y * height), 0, 0, 2 * Math.PI);
  pen.fill();
  pen.globalAlpha = 1;
  pen.lineWidth = 3;
  pen.beginPath();
  pen.arc(x, y, 13, 0, 2 * Math.PI);
  pen.stroke();
  pen.beginPath();
  pen.arc(x, y, 3, 0, 2 * Math.PI);
  pen.fill();
  pen.font = "600 14px system-ui, sans-serif";
  pen.fillText(String(number(one.camera)), x + 17, y - 9);
}

$("calibrate").onsubmit = async (event) => {
  event.preventDefault();
  await post("/api/exhibit/calibration", {
    marks: Number($("calibrate-marks").value), camera: $("calibrate-camera").value,
    width: Math.round(stage.clientWidth), height: Math.round(stage.clientHeight),
    across: Number($("across").value) || null, distance: Number($("away").value) || null,
  });
  stage.focus();
};
$("calibrate-cancel").onclick = () => remove("/api/exhibit/calibration");
$("calibrate-forget").onclick = () => remove("/api/exhibit/calibration?forget=true");
$("full").onclick = () => stage.requestFullscreen?.();

// The simulated hand: follows the marks, the mouse, or the arrow keys.
const aim = { x: 0.5, y: 0.5, sent: 0 };
function point_at(x, y) {
  if (!now.modes?.hands || performance.now() - aim.sent < 90) return;
  [aim.x, aim.y, aim.sent] = [Math.min(1, Math.max(0, x)), Math.min(1, Math.max(0, y)), performance.now()];
  post("/api/hand", { x: aim.x, y: aim.y });
}
function lead({ hands, exhibit: { step } }) {
  if (!hands || !step?.mark || hidden || !$("self").checked) { before = null; return; }
  const where = String(step.mark);
  if (where !== before || performance.now() - aim.sent > 1000) { before = where; point_at(...step.mark); }
}
stage.onpointermove = (event) => {
  const box = stage.getBoundingClientRect();
  if (!exhibit?.step?.mark || !$("self").checked) point_at((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
};
stage.onkeydown = (event) => {
  const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
  if (!by || !now.modes?.hands) return;
  event.preventDefault();
  event.stopPropagation();
  point_at(aim.x + 0.04 * by[0], aim.y + 0.04 * by[1]);
};
