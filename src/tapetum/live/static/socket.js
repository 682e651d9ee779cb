// One socket brings states, pictures, events and the modes; only the newest of each is kept.

import { $, say } from "/static/common.js";

const listeners = { state: [], event: [], modes: [], picture: [] };
export const now = { state: null, modes: null, picture: null, shown: -1, paused: false, last: 0 };
export const on = (what, listener) => listeners[what].push(listener);
const tell = (what, content) => { for (const one of listeners[what]) one(content); };
let retry = 500;

export function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}/ws?after=${now.last}`);
  socket.binaryType = "blob";
  socket.onopen = () => { retry = 500; };
  socket.onmessage = ({ data }) => (typeof data === "string" ? take(JSON.parse(data)) : show(data));
  socket.onclose = () => {
    say("connected", "the watch does not answer");
    $("state").className = "off";
    setTimeout(connect, retry);
    retry = Math.min(retry * 2, 5000);
  };
}

// Exported for the test of long watches.
export function flood(message) { take(message); }

function take(message) {
  if (message.type === "event") {
    if (message.event.number <= now.last) return;
    now.last = message.event.number;
    tell("event", message.event);
  } else if (message.type === "modes") {
    now.modes = message;
    tell("modes", message);
  } else if (message.type === "state") {
    // A server that was started again, without a log, counts its events from the beginning.
    if (now.state && message.frame < now.state.frame && message.health.frames < now.state.health.frames) now.last = 0;
    now.state = message;
    tell("state", message);
  }
}

let decoding = false;
async function show(blob) {
  // A picture that comes while one is decoded is left out; the next one comes soon.
  if (now.paused || decoding || document.hidden) return;
  decoding = true;
  try {
    const head = new DataView(await blob.slice(0, 8).arrayBuffer()), next = await createImageBitmap(blob.slice(8));
    now.picture?.close();
    [now.picture, now.shown] = [next, Number(head.getBigUint64(0))];
    tell("picture", next);
  } finally { decoding = false; }
}
