// The scan: uploads and their candidates, and the map of a walk with the probe.

import { $, ask, bright, element, fitted, keep, name, number, percent, post, refused, remove, say } from "/static/common.js";
import { on } from "/static/socket.js";

const MOST = 32 * 2 ** 20;
let scan = null, hidden = true, shown = 0, picture = null;

on("modes", (modes) => { scan = modes.scan; if (!hidden) draw(); });
addEventListener("view", ({ detail }) => { hidden = detail !== "scan"; if (!hidden) draw(); });

const kind = () => document.querySelector("input[name=kind]:checked").value;
for (const one of document.querySelectorAll("input[name=kind]")) {
  one.onchange = () => {
    const film = kind() === "film";
    say("lit-label", film ? "Film" : "With the flash");
    $("lit").accept = film ? "video/mp4,video/quicktime,video/webm,video/x-matroska,video/x-msvideo" : "image/jpeg,image/png,image/webp";
    $("dark-line").hidden = kind() !== "pair";
    $("dark").required = kind() === "pair";
  };
}

$("upload").onsubmit = async (event) => {
  event.preventDefault();
  const lit = $("lit").files[0], dark = kind() === "pair" ? $("dark").files[0] : null;
  if (!lit || (kind() === "pair" && !dark)) { refused("choose both pictures"); return; }
  const size = lit.size + (dark?.size ?? 0);
  if (size > MOST) { refused(`${Math.round(size / 2 ** 20)} MB are more than ${MOST / 2 ** 20} MB`); return; }
  say("upload-say", "Sending");
  $("send").disabled = true;
  const told = await ask(`/api/scan?kind=${kind()}&first=${dark ? lit.size : 0}`, {
    method: "POST", headers: { "content-type": "application/octet-stream" }, body: new Blob(dark ? [lit, dark] : [lit]),
  });
  $("send").disabled = false;
  if (told) { shown = told.id; picture = null; }
  say("upload-say", told ? "Searching" : "");
};

function draw() {
  if (!scan || hidden) return;
  map(scan.coverage);
  if (!shown && scan.searches.length) shown = scan.searches[0].id;
  const search = scan.searches.find((one) => one.id === shown);
  $("found").hidden = search?.state !== "done";
  if (!search) return;
  const likely = search.candidates.filter((one) => one.likely).length;
  say("upload-say", { waiting: "Waiting for its turn", searching: "Searching", failed: `That did not work: ${search.fault}`, done: `Searched in ${search.seconds.toFixed(1)} s` }[search.state]);
  if (search.state !== "done") return;
  const count = search.candidates.length;
  say("found-title", `${likely ? `${likely} worth a look` : "Nothing likely"}${count > likely ? `, ${count - likely} less likely` : ""}${search.note ? `; ${search.note}` : ""}`);
  keep($("candidates"), search.candidates, (one) => `${search.id}.${one.number}`, (one) => {
    const path = `/api/scan/${search.id}/picture?candidate=${one.number}`, images = [["lit", "with the light"]];
    if (search.kind === "pair") images.push(["dark", "without"]);
    const said = one.frames > 1 ? `seen in ${one.frames} of ${search.frames} frames` : `${percent(one.probability)}`;
    return element("li", { className: one.likely ? "tile likely" : "tile" },
      element("div", { className: "pair" }, ...images.map(([which, words]) => element("img", { src: `${path}&which=${which}`, alt: `Candidate ${one.number} ${words}`, loading: "lazy" }))),
      element("b", { textContent: `${one.number}. ` }), `${said} · ${one.snr.toFixed(0)} × its surroundings' spread`);
  });
  whole(search);
}

function whole(search) {
  if (picture?.id === search.id) return;
  const image = new Image();
  picture = { id: search.id };
  image.onload = () => {
    const canvas = $("found-view"), pen = canvas.getContext("2d"), scale = image.width / search.width;
    canvas.width = image.width;
    canvas.height = image.height;
    pen.drawImage(image, 0, 0);
    const unit = image.width / Math.max(1, canvas.clientWidth);
    pen.font = `600 ${15 * unit}px system-ui, sans-serif`;
    for (const one of search.candidates) {
      const x = (one.x + 0.5) * scale, y = (one.y + 0.5) * scale, radius = Math.max(11 * unit, 0.8 * one.diameter * scale);
      pen.strokeStyle = pen.fillStyle = one.likely ? "#4fd1bd" : "#ffb066";
      pen.lineWidth = (one.likely ? 3 : 1.5) * unit;
      pen.beginPath();
      pen.arc(x, y, radius, 0, 2 * Math.PI);
      pen.stroke();
      pen.fillText(String(one.number), x + radius + 3 * unit, y - radius * 0.4);
    }
  };
  image.src = `/api/scan/${search.id}/picture`;
}

const ADVICE = { "hold still": "Hold still for a moment", "go slower": "Go slower, or go back to where you were", "go on": "Turn on to the next part", "": "Stand in the middle, begin, and turn slowly." };

function map(coverage) {
  say("walk", coverage.running ? "End" : coverage.columns ? "Begin again" : "Begin");
  say("advice", coverage.running ? ADVICE[coverage.advice] ?? coverage.advice : coverage.columns ? "Ended." : ADVICE[""]);
  say("walk-say", coverage.columns ? `${percent(coverage.share)} of what was passed was seen for long enough, in ${Math.round(coverage.seconds)} s` : "");
  const { pen, width, height } = fitted($("map")), cells = atob(coverage.cells);
  const cell = [1 / coverage.cells_across, coverage.aspect / coverage.cells_down];  // in widths of a picture
  // At least two pictures wide and high, what was seen in the middle.
  const scale = Math.min(width / Math.max(2, coverage.columns * cell[0] + 0.3), height / Math.max(2 * coverage.aspect, coverage.rows * cell[1] + 0.2));
  const left = width / 2 - (coverage.columns * cell[0] * scale) / 2, top = height / 2 - (coverage.rows * cell[1] * scale) / 2;
  for (let k = 0; k < cells.length; k++) {
    const [column, row] = [k % coverage.columns, Math.floor(k / coverage.columns)], seen = cells.charCodeAt(k);
    if (!seen) continue;
    pen.fillStyle = `rgb(79 209 189 / ${0.12 + (0.75 * seen) / 255})`;
    pen.fillRect(left + column * cell[0] * scale, top + row * cell[1] * scale, cell[0] * scale - 1, cell[1] * scale - 1);
  }
  const at = (x, y) => [left + (x - coverage.left) * scale, top + (y - coverage.top) * coverage.aspect * scale];
  if (coverage.columns) {
    const [x, y] = at(coverage.x, coverage.y);
    pen.strokeStyle = "#ffffff";
    pen.lineWidth = 2;
    pen.strokeRect(x - scale / 2, y - (coverage.aspect * scale) / 2, scale, coverage.aspect * scale);
  }
  for (const one of coverage.sightings) {
    const [x, y] = at(one.x, one.y);
    pen.fillStyle = bright(one.camera);
    pen.beginPath();
    pen.arc(x, y, 6, 0, 2 * Math.PI);
    pen.fill();
    pen.font = "600 13px system-ui, sans-serif";
    pen.fillText(String(number(one.camera)), x + 9, y + 4);
  }
  keep($("sightings"), coverage.sightings, (one) => one.camera, (one) => {
    const item = element("li", {}, element("span", { textContent: name(one.camera) }), element("span"));
    item.style.setProperty("--colour", bright(one.camera));
    return item;
  }, (item, one) => say(item.lastChild, `${one.device ? `${one.device}, ` : ""}seen for ${one.seconds.toFixed(0)} s`));
}

$("walk").onclick = () => (scan?.coverage.running ? remove("/api/scan/coverage") : post("/api/scan/coverage"));
