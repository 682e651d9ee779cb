// The vote: answers, where cameras point, the tally and its replay.

import { $, ask, bright, element, fitted, keep, name, number, post, remove, say } from "/static/common.js";
import { now, on } from "/static/socket.js";

const canvas = $("ballot");
const TONES = ["#0b5f6b", "#6b3d0b", "#463f86", "#7a2452", "#2a5480", "#5c6312"];
let vote = null, hidden = true, replay = [], playing = 0, known = -1;

on("modes", (modes) => {
  vote = modes.vote;
  if (!hidden) { words(); requestAnimationFrame(draw); }
});
on("state", () => { if (!hidden) requestAnimationFrame(draw); });
addEventListener("view", ({ detail }) => { hidden = detail !== "vote"; if (!hidden) { words(); draw(); } });

// The zones that stand beside each other, in the order of the answers.
// Whoever points to the right sees the probe on the left: zones of the field are laid out from right to left.
function zones(answers, plane) {
  const [from, to] = plane === "screen" ? [0, 1] : [0.45, -0.45], gap = plane === "screen" ? 0.02 : 0.03;
  const wide = (to - from) / answers.length, [top, bottom] = plane === "screen" ? [0, 1] : [-0.5, 0.5];
  return answers.map((answer, k) => {
    const ends = [from + k * wide, from + (k + 1) * wide].sort((a, b) => a - b);
    return { name: answer, left: ends[0] + gap / 2, top, right: ends[1] - gap / 2, bottom };
  });
}

$("vote").onsubmit = async (event) => {
  event.preventDefault();
  const answers = $("answers").value.split("\n").map((one) => one.trim()).filter(Boolean), plane = $("plane").value;
  replay = [];
  stop();
  await post("/api/vote", {
    question: $("question").value, zones: zones(answers, plane), plane, dwell: Number($("dwell").value), keep: $("keep").checked,
  });
};
$("vote-end").onclick = () => remove("/api/vote");

function words() {
  if (!vote) return;
  const { ballot } = vote;
  $("no-vote").hidden = Boolean(ballot);
  $("vote-end").hidden = !vote.is_open;
  say("ballot-title", ballot ? ballot.question : "Point your camera at an answer");
  say("ballot-note", !ballot ? "Begin a vote beside." : vote.is_open ? "Each camera has one voice: it counts once it has pointed at an answer for a while, and may change."
    : `The vote has ended.${vote.file ? ` It is kept as ${vote.file}.` : ""}`);
  const at = Number($("replay-at").value), shown = replay.length ? replay[at].voices : vote.voices ?? {};
  const most = Math.max(1, ...Object.values(shown)), total = Object.values(shown).reduce((a, b) => a + b, 0);
  say("voices", String(total));
  keep($("tally"), ballot ? ballot.zones : [], (one) => one.name, (one) => element("li", {},
    element("span", { textContent: one.name }), element("b"), element("progress", { className: "bar", max: 1, value: 0, "aria-label": one.name })),
  (item, one) => {
    const count = shown[one.name] ?? 0;
    say(item.children[1], String(count));
    item.children[2].max = most;
    item.children[2].value = count;
  });
  say("pending", vote.pending.map((one) => `${name(one.camera)} points at ${one.zone}`).join("; ") + (vote.fault ? ` ${vote.fault}` : ""));
  const ended = ballot && !vote.is_open && vote.changes > 0;
  // Hidden until the replay of this vote is here: the slider still stands where the last one left it.
  $("replay").hidden = !ended || !replay.length;
  if (ended && known !== vote.begun_utc_ns) {
    known = vote.begun_utc_ns;
    replay = [];
    ask("/api/vote/replay").then((told) => {
      if (known !== vote.begun_utc_ns) return;
      replay = told ?? [];
      $("replay-at").max = Math.max(0, replay.length - 1);
      $("replay-at").value = $("replay-at").max;
      step();
    });
  }
  if (vote.is_open) known = -1;
}

function step() {
  if (!replay.length) return;
  const at = Number($("replay-at").value), after = (replay[at].utc_ns - vote.begun_utc_ns) / 1e9;
  say("replay-say", `voice ${at + 1} of ${replay.length}, after ${after.toFixed(1)} s`);
  words();
}
function stop() { clearInterval(playing); playing = 0; say("replay-play", "Play"); }
$("replay-at").oninput = () => { stop(); step(); };
$("replay-play").onclick = () => {
  if (playing) { stop(); return; }
  const slider = $("replay-at");
  if (slider.value === slider.max) slider.value = 0;
  say("replay-play", "Stop");
  playing = setInterval(() => {
    slider.value = Number(slider.value) + 1;
    step();
    if (slider.value === slider.max) stop();
  }, 400);
};

function draw() {
  if (hidden || !vote) return;
  const { pen, width, height } = fitted(canvas), ballot = vote.ballot, screen = ballot?.plane === "screen";
  // Of the field its mirror image is drawn: where cameras point, not where they see the probe.
  const x = (one) => (screen ? one : 0.5 - one) * width, y = (one) => (screen ? one : 0.5 - one) * height;
  pen.font = "600 18px system-ui, sans-serif";
  pen.textAlign = "center";
  (ballot?.zones ?? []).forEach((one, k) => {
    const [a, b] = [x(one.left), x(one.right)].sort((p, q) => p - q), [c, d] = [y(one.top), y(one.bottom)].sort((p, q) => p - q);
    pen.fillStyle = TONES[k % TONES.length];
    pen.beginPath();
    pen.roundRect(a, c, b - a, d - c, 10);
    pen.fill();
    pen.fillStyle = "#f2f6f6";
    pen.fillText(one.name, (a + b) / 2, c + 34, b - a - 12);
    pen.font = "600 44px system-ui, sans-serif";
    pen.fillText(String(vote.voices?.[one.name] ?? 0), (a + b) / 2, (c + d) / 2 + 16);
    pen.font = "600 18px system-ui, sans-serif";
  });
  const pending = new Map(vote.pending.map((one) => [one.camera, one.share]));
  const places = screen ? now.modes.exhibit.pointers.map((one) => [one.camera, one.x, one.y])
    : (now.state?.cameras ?? []).filter((one) => one.seen && one.gaze_x).map((one) => [one.id, one.gaze_x[0], one.gaze_y[0]]);
  for (const [id, px, py] of places) {
    const [at, along] = [Math.min(width - 12, Math.max(12, x(px))), Math.min(height - 12, Math.max(12, y(py)))];
    pen.fillStyle = "#06090acc";
    pen.beginPath();
    pen.arc(at, along, 15, 0, 2 * Math.PI);
    pen.fill();
    pen.strokeStyle = bright(id);
    pen.lineWidth = 4;
    pen.beginPath();
    pen.arc(at, along, 13, -Math.PI / 2, -Math.PI / 2 + 2 * Math.PI * (vote.given?.[id] && !pending.has(id) ? 1 : pending.get(id) ?? 0.02));
    pen.stroke();
    pen.fillStyle = bright(id);
    pen.font = "600 14px system-ui, sans-serif";
    pen.fillText(String(number(id)), at, along + 5);
  }
  pen.textAlign = "start";
}
