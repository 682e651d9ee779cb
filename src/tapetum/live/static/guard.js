// The guard's desk: alerts until they are acknowledged, and the rules as they are now.

import { $, clock, element, keep, name, post, say } from "/static/common.js";
import { on } from "/static/socket.js";

let newest = 0;

on("modes", ({ guard }) => {
  const waiting = guard.alerts.filter((one) => one.acknowledged_utc_ns === null);
  if (waiting.length && waiting[0].number > newest) say("alert-now", `Alert: ${waiting[0].rule}, ${name(waiting[0].camera)}`);
  if (guard.alerts.length) newest = Math.max(newest, guard.alerts[0].number);
  if ($("view-guard").hidden) return;
  draw(guard);
});
let latest = null;
on("modes", ({ guard }) => { latest = guard; });
addEventListener("view", ({ detail }) => { if (detail === "guard" && latest) draw(latest); });

function draw(guard) {
  say("alert-count", String(guard.waiting));
  $("acknowledge-all").hidden = guard.waiting < 2;
  $("no-alert").hidden = guard.alerts.length > 0;
  keep($("alerts"), guard.alerts, (one) => one.number, row, (item, one) => {
    const done = one.acknowledged_utc_ns !== null;
    item.classList.toggle("done", done);
    item.querySelector("button").hidden = done;
    say(item.querySelector(".said"), [
      `${new Date(one.utc_ns / 1e6).toLocaleDateString("en-GB")} ${clock(one.utc_ns)}`, name(one.camera), one.holds ? "still so" : "over",
      done ? `acknowledged ${clock(one.acknowledged_utc_ns)}` : "",
    ].filter(Boolean).join(" · "));
  });
  say("guard-clock", guard.local ? `${guard.local} ${guard.time_zone}` : "");
  $("no-rules").hidden = guard.rules.length > 0;
  keep($("rules"), guard.rules, (one) => one.name, (one) => element("li", { className: "rule" },
    element("b", { textContent: one.name }), element("div", { className: "said" }), element("span", { className: "now" })),
  (item, one) => {
    item.classList.toggle("awake", !one.quiet_now);
    const parts = [`When ${one.when}${one.hold ? `, for ${one.hold} s` : ""}`, `at most every ${one.cooldown} s`];
    parts.push(one.hours.length ? `quiet ${one.hours.join("; ")}` : "never quiet");
    if (one.tell.length) parts.push(`tells ${one.tell.join(", ")}`);
    say(item.children[1], `${parts.join(" · ")}.`);
    say(item.children[2], one.quiet_now ? "quiet now" : "on guard");
  });
}

function row(one) {
  const button = element("button", { type: "button", textContent: "Acknowledge", "aria-label": `Acknowledge ${one.rule}, ${name(one.camera)}` });
  button.onclick = () => post("/api/guard/acknowledged", { number: one.number });
  const picture = one.picture ? element("img", { src: `/api/events/${one.number}/picture`, alt: `${name(one.camera)} at the alert`, loading: "lazy" }) : element("i");
  return element("li", { className: "alert-row" }, picture,
    element("div", {}, element("b", { textContent: one.rule }), element("div", { className: "said" })), button);
}

$("acknowledge-all").onclick = () => post("/api/guard/acknowledged", {});
