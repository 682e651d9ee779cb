// The page: its views by tabs and keys, the health in its head, the record button, and the socket.

import { $, post, remove, say } from "/static/common.js";
import { connect, now, on } from "/static/socket.js";
import "/static/watch.js";
import "/static/exhibit.js";
import "/static/vote.js";
import "/static/guard.js";
import "/static/scan.js";

const VIEWS = ["watch", "exhibit", "vote", "guard", "scan"];

function view() {
  const wanted = location.hash.slice(1), chosen = VIEWS.includes(wanted) ? wanted : "watch";
  document.body.dataset.view = chosen;
  for (const one of VIEWS) {
    $(`view-${one}`).hidden = one !== chosen;
    const tab = $(`tab-${one}`);
    if (one === chosen) tab.setAttribute("aria-current", "page"); else tab.removeAttribute("aria-current");
  }
  dispatchEvent(new CustomEvent("view", { detail: chosen }));
}
addEventListener("hashchange", view);

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, select, textarea")) return;
  const chosen = VIEWS[Number(event.key) - 1];
  if (chosen) location.hash = chosen;
  else if (event.key === "r" && !$("record").hidden) $("record").click();
});

on("state", ({ health, source, cameras }) => {
  say("connected", health.ended ? "ended" : health.connected ? "live" : "no frames");
  $("state").className = health.connected ? "on" : "off";
  say("rate", health.rate.toFixed(1));
  say("delay", `${Math.round(health.delay * 1000)} ms`);
  say("frames", health.frames.toLocaleString("en"));
  say("lost", health.lost.toLocaleString("en"));
  say("source", source);
  const wrong = [health.fault, ...health.receivers, now.modes?.record.fault, now.modes?.guard.fault].filter(Boolean).join(" · ");
  say("fault", wrong);
  $("fault").hidden = !wrong;
  say("count", String(cameras.length));
});

on("modes", ({ record, guard }) => {
  $("record").hidden = !record.possible;
  $("record").classList.toggle("running", record.running);
  $("record").setAttribute("aria-pressed", String(record.running));
  say("record", record.running ? `Stop (${Math.round(record.seconds)} s)` : "Record");
  $("record").title = record.name ? `${record.name}: ${record.frames} frames, ${record.lost} lost` : "";
  say("waiting", guard.waiting ? String(guard.waiting) : "");
  $("waiting").hidden = !guard.waiting;
});
$("record").onclick = () => (now.modes?.record.running ? remove("/api/recording") : post("/api/recording"));

view();
connect();
