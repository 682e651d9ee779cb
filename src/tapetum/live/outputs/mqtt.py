"""MQTT: events and states for a house's broker, which Home Assistant finds by itself."""

from __future__ import annotations

import json
import os
import secrets
import threading
import time
from typing import Any

from tapetum.errors import InputError, TapetumError, need
from tapetum.live.events import Event
from tapetum.live.outputs.address import parse_address
from tapetum.live.outputs.base import Queued
from tapetum.live.outputs.home_assistant import BIRTH, Slots, discovery, summary
from tapetum.live.state import CameraState, State

__all__ = ["Mqtt"]

_PORTS = {"mqtt": 1883, "mqtts": 8883}
_LIKE = "mqtt://user@host:1883/prefix"
_EVERY = 1.0  # s between two states in which nothing but numbers changed
_KEEPALIVE = 30
_RECONNECT = (1, 30)  # s
_LAST = 1.0  # s to say that this watch is over
_PASSWORD = "TAPETUM_MQTT_PASSWORD"


class Mqtt(Queued):
    """Publishes to the broker of `mqtt://[user[:password]@]host[:port][/prefix]`; `mqtts` for TLS.

    Topics, below the prefix (usually `tapetum`; two watches need two): `status`, `online` or `offline`, the latter by
    the broker when the watch is cut off; `event`, each event; `state`, counts and health, at every change and each
    second; `camera/1` to `camera/8`, one camera each. All but events are retained. A password may also be given in the
    environment as TAPETUM_MQTT_PASSWORD, where no list of processes shows it.
    """

    def __init__(self, text: str) -> None:
        address = parse_address(text, like=_LIKE, port=_PORTS.get(text.split(":")[0].lower()))
        self._prefix = address.path.strip("/") or "tapetum"
        if set(self._prefix) & set("+#$") or address.query or "//" in self._prefix:
            raise InputError(f"{self._prefix!r} cannot begin topics", where="output", remedy=f"write {_LIKE}")
        super().__init__(str(address), states=1)
        mqtt = need("paho.mqtt.client", "live")
        self._client: Any = mqtt.Client(
            mqtt.CallbackAPIVersion.VERSION2, client_id=f"tapetum-{secrets.token_hex(4)}", reconnect_on_failure=True
        )
        if address.user is not None:
            password = address.password if address.password is not None else os.environ.get(_PASSWORD)
            self._client.username_pw_set(address.user, password)
        if address.scheme == "mqtts":
            self._client.tls_set()
        self._client.will_set(f"{self._prefix}/status", "offline", qos=1, retain=True)
        self._client.reconnect_delay_set(*_RECONNECT)
        self._client.on_connect, self._client.on_connect_fail = self._connected, self._not_connected
        self._client.on_disconnect, self._client.on_message = self._cut, self._told
        self._client.on_publish = self._taken
        self._client.connect_async(address.host, address.port, keepalive=_KEEPALIVE)
        self._online = threading.Event()
        self._acknowledged: set[int] = set()
        self._acknowledgement = threading.Condition()
        self._slots = Slots()
        self._shown: dict[str, str] = {}
        self._key: Any = None
        self._since = 0.0

    def start(self) -> None:
        """Begin; the connection is made, and made again, in a thread of its own."""
        self._client.loop_start()
        super().start()

    def send_event(self, event: Event) -> None:
        """Publish an event, and wait until the broker has it."""
        self._publish("event", _json({"event_type": event.kind, **event.as_json()}), retain=False)

    def send_state(self, state: State) -> None:
        """Publish counts and cameras where they changed, or a second passed."""
        cameras = self._slots.update(state.cameras)
        health = state.health
        key = [(one.id, one.active, one.device, one.regions, one.seen) for one in state.cameras]
        key = key, health.connected, health.fault, health.ended
        if key == self._key and time.monotonic() - self._since < _EVERY:
            return
        texts = {"state": _json(summary(state))}
        texts |= {f"camera/{number}": _json(_shown(camera)) for number, camera in enumerate(cameras, 1)}
        for topic, text in texts.items():
            if self._shown.get(topic) != text:
                self._publish(topic, text)
                self._shown[topic] = text
        self._key, self._since = key, time.monotonic()

    def end(self) -> None:
        """Say that the watch is over, and leave."""
        online = self._online.is_set()
        if online:
            self._acknowledged.clear()
            number = self._client.publish(f"{self._prefix}/status", "offline", qos=1, retain=True).mid
            with self._acknowledgement:
                self._acknowledgement.wait_for(lambda: number in self._acknowledged, _LAST)
        self._client.disconnect()
        if online:
            # Otherwise the thread may be waiting for an answer; it ends by itself.
            self._client.loop_stop()

    def _publish(self, topic: str, text: str, retain: bool = True) -> None:
        # Only while connected: what waits stays in the queue, where it is counted.
        while not self._online.wait(0.1):
            if self.hurried:
                raise TapetumError(self.counts.fault or "not connected")
        self._acknowledged.clear()
        number = self._client.publish(f"{self._prefix}/{topic}", text, qos=1, retain=retain).mid
        with self._acknowledgement:
            # The client sends it again after a reconnection.
            while not self._acknowledgement.wait_for(lambda: number in self._acknowledged, 0.1):
                if self.hurried:
                    raise TapetumError("the broker did not acknowledge")

    def _connected(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        del data, flags, properties
        if reason.is_failure:
            self.set_fault(f"the broker refuses the connection ({reason})")
            return
        client.subscribe(BIRTH, qos=1)
        self._introduce()
        # A broker that was started again may have forgotten what it retained.
        self._shown, self._key = {}, None
        self.set_fault("")
        self._online.set()

    def _introduce(self) -> None:
        topic, content = discovery(self._prefix)
        self._client.publish(topic, _json(content), qos=1, retain=True)
        self._client.publish(f"{self._prefix}/status", "online", qos=1, retain=True)

    def _told(self, client: Any, data: Any, message: Any) -> None:
        """Home Assistant has started."""
        del client, data
        if message.topic == BIRTH and message.payload == b"online":
            self._introduce()
            self._shown, self._key = {}, None

    def _taken(self, client: Any, data: Any, number: int, reason: Any, properties: Any) -> None:
        del client, data, reason, properties
        with self._acknowledgement:
            self._acknowledged.add(number)
            self._acknowledgement.notify_all()

    def _not_connected(self, client: Any, data: Any) -> None:
        del client, data
        self.set_fault("the broker cannot be reached")

    def _cut(self, client: Any, data: Any, flags: Any, reason: Any, properties: Any) -> None:
        del client, data, flags, properties
        self._online.clear()
        if not self.closing.is_set():
            self.set_fault(f"the broker ended the connection ({reason})")


def _shown(camera: CameraState | None) -> dict[str, Any]:
    """What a camera's entity shows."""
    if camera is None:
        return {"here": "OFF"}
    shown: dict[str, Any] = {
        "here": "ON",
        "id": camera.id,
        "imaging": camera.active,
        "opened_utc_ns": camera.opened_utc_ns,
        "since_utc_ns": camera.since_utc_ns,
    }
    shown |= {"x": round(camera.x, 1), "y": round(camera.y, 1), "seen": camera.seen, "regions": camera.regions}
    shown |= {"device": camera.device, "device_probability": camera.device_probability}
    return shown | {"gaze_x": camera.gaze_x, "gaze_y": camera.gaze_y}


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False)
