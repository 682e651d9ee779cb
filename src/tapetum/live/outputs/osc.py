"""Open Sound Control: gaze and events for programs of sound, light and pictures, over UDP."""

from __future__ import annotations

import socket
from datetime import UTC, datetime
from typing import Any

from tapetum.errors import InputError, need
from tapetum.live.events import Event
from tapetum.live.outputs.address import parse_address
from tapetum.live.outputs.base import Queued
from tapetum.live.state import CameraState, State

__all__ = ["Osc"]

_UNKNOWN = -1


class Osc(Queued):
    """Sends OSC messages to `osc://host:port`.

    Events: `/tapetum/event id type kind detail time`, strings. Of each frame: `/tapetum/frame number cameras` and a
    bundle of each camera, N the number of its track: `/tapetum/camera/N/id id`, `…/place x y diameter` in pixels,
    `…/seen flag`, `…/active flag` (-1 unknown), `…/gaze x y x_low x_high y_low y_high` in fractions of its field from
    the centre, and `…/device name probability`; the last two only where they are known.
    """

    def __init__(self, text: str) -> None:
        address = parse_address(text, like="osc://host:port, as osc://127.0.0.1:9000")
        if address.path.strip("/") or address.query or address.user is not None:
            raise InputError(f"more than host and port in {text!r}", where="output", remedy="write osc://host:port")
        super().__init__(str(address), states=1)
        self._address = address
        self._socket: socket.socket | None = None
        self._to: Any = None
        self._build = need("pythonosc.osc_bundle_builder", "live")
        self._message = need("pythonosc.osc_message_builder", "live")

    def send_event(self, event: Event) -> None:
        """Send an event."""
        moment = datetime.fromtimestamp(event.utc_ns / 1e9, UTC).isoformat(timespec="milliseconds")
        self._send([("/tapetum/event", [event.id, event.type, event.kind, event.detail, moment])])

    def send_state(self, state: State) -> None:
        """Send the frame's number and each camera."""
        self._send([("/tapetum/frame", [state.frame, len(state.cameras)])])
        for camera in state.cameras:
            self._send(_messages(camera))

    def end(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()

    def _send(self, messages: list[tuple[str, list[Any]]]) -> None:
        built = [self._built(address, values) for address, values in messages]
        if len(built) == 1:
            self._post(built[0].dgram)
            return
        bundle = self._build.OscBundleBuilder(self._build.IMMEDIATELY)
        for one in built:
            bundle.add_content(one)
        self._post(bundle.build().dgram)

    def _post(self, packet: bytes) -> None:
        if self._socket is None:
            # Here, not at the beginning: to find a name's address may take long, or fail for a while.
            found = socket.getaddrinfo(self._address.host, self._address.port, type=socket.SOCK_DGRAM)
            family, _, _, _, self._to = found[0]
            self._socket = socket.socket(family, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._socket.sendto(packet, self._to)

    def _built(self, address: str, values: list[Any]) -> Any:
        message = self._message.OscMessageBuilder(address=address)
        for value in values:
            message.add_arg(value)
        return message.build()


def _messages(camera: CameraState) -> list[tuple[str, list[Any]]]:
    """Addresses and values of a camera; a value's type never changes, as receivers are built for one."""
    at = f"/tapetum/camera/{camera.track}"
    active = _UNKNOWN if camera.active is None else int(camera.active)
    messages: list[tuple[str, list[Any]]] = [
        (f"{at}/id", [camera.id]),
        (f"{at}/place", [float(camera.x), float(camera.y), float(camera.diameter)]),
        (f"{at}/seen", [int(camera.seen)]),
        (f"{at}/active", [active]),
    ]
    if camera.gaze_x is not None and camera.gaze_y is not None:
        values = [camera.gaze_x[0], camera.gaze_y[0], *camera.gaze_x[1:], *camera.gaze_y[1:]]
        messages.append((f"{at}/gaze", [float(value) for value in values]))
    if camera.device is not None:
        messages.append((f"{at}/device", [camera.device, float(camera.device_probability or 0.0)]))
    return messages
