"""Lab streaming layer: gaze, activity and events as streams beside those of other instruments."""

from __future__ import annotations

import json
import math
import time
from typing import Any

from tapetum.errors import InputError, need
from tapetum.live.events import Event
from tapetum.live.outputs.base import Queued
from tapetum.live.state import CameraState, State

__all__ = ["ACTIVITY", "GAZE", "Lsl"]

GAZE = (
    ("track", "", "Track"),
    ("gaze_x", "fraction of the field", "Gaze"),
    ("gaze_x_low", "fraction of the field", "Gaze"),
    ("gaze_x_high", "fraction of the field", "Gaze"),
    ("gaze_y", "fraction of the field", "Gaze"),
    ("gaze_y_low", "fraction of the field", "Gaze"),
    ("gaze_y_high", "fraction of the field", "Gaze"),
    ("x", "pixels", "Position"),
    ("y", "pixels", "Position"),
    ("diameter", "pixels", "Size"),
    ("snr", "", "Quality"),
    ("frame", "", "Frame"),
    ("camera_time", "seconds", "Clock"),
)
"""Label, unit and type of the channels of a watch's stream of gaze: a sample of each camera of each frame."""

ACTIVITY = (
    ("track", "", "Track"),
    ("seen", "", "Presence"),
    ("active", "", "Activity"),
    ("frame", "", "Frame"),
    ("camera_time", "seconds", "Clock"),
)
"""The same of its stream of activity; `active` is 1, 0, or NaN where it is unknown."""

_WAITING = 10_000  # states: minutes, should the library ever be slow


class Lsl(Queued):
    """Streams of `lsl:NAME`: `NAME-gaze` (see `GAZE`), `NAME-activity` (see `ACTIVITY`) and `NAME-events`.

    Each sample bears the time at which its frame was taken, by the clock of the streaming layer; the probe's own clock
    is the channel `camera_time`. The gaze's stream has a sample of each camera that was seen in a frame, with NaN where
    the gaze is unknown; that of events has one channel, an event as JSON. All are of irregular rate.
    """

    def __init__(self, text: str) -> None:
        name = text.partition(":")[2].strip("/").strip()
        if not name or not name.isprintable():
            raise InputError(f"no name for the streams in {text!r}", where="output", remedy="write lsl:NAME")
        super().__init__(f"lsl:{name}", states=_WAITING)
        try:
            self._lsl: Any = need("pylsl", "lsl")
        except RuntimeError as error:
            # pylsl is there, the library that it calls is not.
            raise InputError(str(error), where="output", remedy="install liblsl") from error
        self._gaze: Any = self._outlet(f"{name}-gaze", "Gaze", GAZE)
        self._activity: Any = self._outlet(f"{name}-activity", "Activity", ACTIVITY)
        markers = self._lsl.StreamInfo(f"{name}-events", "Markers", 1, 0.0, "string", f"tapetum-{name}-events")
        markers.set_channel_labels(["event"])
        self._events_outlet: Any = self._lsl.StreamOutlet(markers)
        # The streaming layer's clock may count from another moment than this machine's monotonic one.
        self._from_monotonic = self._lsl.local_clock() - time.monotonic()
        self._from_utc = self._lsl.local_clock() - time.time()
        self._frame = -1

    def send_event(self, event: Event) -> None:
        """Send an event as a marker."""
        text = json.dumps(event.as_json(), allow_nan=False)
        self._events_outlet.push_sample([text], event.utc_ns / 1e9 + self._from_utc)

    def send_state(self, state: State) -> None:
        """Send a sample of each camera; a frame is sent once."""
        if state.frame == self._frame:
            return
        self._frame = state.frame
        moment = state.utc_ns / 1e9 + self._from_utc
        if state.monotonic_ns is not None:
            moment = state.monotonic_ns / 1e9 + self._from_monotonic
            # The watch's UTC is its monotonic clock from another beginning, so that events fit to their frames.
            self._from_utc = moment - state.utc_ns / 1e9
        for camera in state.cameras:
            own = [float(state.frame), _number(state.camera_time)]
            self._activity.push_sample([camera.track, float(camera.seen), _number(camera.active), *own], moment)
            if camera.seen_utc_ns == state.utc_ns:
                self._gaze.push_sample([*_gaze(camera, camera.is_fresh(state.utc_ns)), *own], moment)

    def end(self) -> None:
        """Let the outlets go: the library closes them when nothing holds them."""
        self._gaze = self._activity = self._events_outlet = None

    def _outlet(self, name: str, kind: str, channels: tuple[tuple[str, str, str], ...]) -> Any:
        # With a source id of its own a stream that ends is found again by a recorder.
        info = self._lsl.StreamInfo(name, kind, len(channels), 0.0, "double64", f"tapetum-{name}")
        info.set_channel_labels([label for label, _, _ in channels])
        info.set_channel_units([unit for _, unit, _ in channels])
        info.set_channel_types([type_ for _, _, type_ in channels])
        info.desc().append_child_value("manufacturer", "Tapetum")
        return self._lsl.StreamOutlet(info)


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)


def _gaze(camera: CameraState, fresh: bool) -> list[float]:
    unknown = (None, None, None)
    gaze_x, gaze_y = (camera.gaze_x, camera.gaze_y) if fresh else (None, None)
    values = (*(gaze_x or unknown), *(gaze_y or unknown), camera.x, camera.y, camera.diameter, camera.snr)
    return [float(camera.track), *(_number(value) for value in values)]
