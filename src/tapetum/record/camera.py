"""Cameras of this machine as sources of frames."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from tapetum.errors import InputError
from tapetum.record.images import hushed, to_grey
from tapetum.record.source import Arrival, Live

__all__ = ["Camera", "is_camera"]

PREFIX = "camera:"
STALE = 16  # most frames that a driver may hold
AT_ONCE = 0.002  # s; a frame that comes sooner was buffered

# Camera properties that OpenCV may know; unknown ones are 0 or -1.
TOLD = {
    "exposure": cv2.CAP_PROP_EXPOSURE,
    "automatic_exposure": cv2.CAP_PROP_AUTO_EXPOSURE,
    "gain": cv2.CAP_PROP_GAIN,
    "brightness": cv2.CAP_PROP_BRIGHTNESS,
    "gamma": cv2.CAP_PROP_GAMMA,
    "focus": cv2.CAP_PROP_FOCUS,
    "automatic_focus": cv2.CAP_PROP_AUTOFOCUS,
    "zoom": cv2.CAP_PROP_ZOOM,
    "frames_a_second": cv2.CAP_PROP_FPS,
}


def is_camera(source: str) -> bool:
    """Return whether a text names a camera of this machine: `camera:0`."""
    return source.startswith(PREFIX)


class Camera(Live):
    """A camera that OpenCV can read, such as a webcam; colour becomes grey, 8 bit.

    Frames carry their time of arrival, some milliseconds after the exposure, because OpenCV offers nothing better on
    every system.

    Parameters
    ----------
    source, rate
        `camera:` and its number from 0, and frames per second to request; None keeps the camera's own.

    Raises
    ------
    InputError
        When there is no such camera or it gives no image.
    """

    full_scale = 255

    def __init__(self, source: str, rate: float | None = None) -> None:
        number = source.removeprefix(PREFIX)
        if not number.isdecimal():
            raise InputError("names no camera", where=source, remedy="write camera:0 for the first one")
        self.name = source
        with hushed():
            self._capture = cv2.VideoCapture(int(number))
            opened = self._capture.isOpened()
        if not opened:
            remedy = "plug it in, close what else uses it, or try another number"
            raise InputError("no such camera, or it is in use", where=source, remedy=remedy)
        if rate is not None:
            self._capture.set(cv2.CAP_PROP_FPS, rate)
        there, first = self._capture.read()
        if not there:
            self._capture.release()
            raise InputError("the camera gives no picture", where=source, remedy="plug it in again")
        self._seen = to_grey(first)
        told = {name: self._capture.get(key) for name, key in TOLD.items()}
        told = {name: value for name, value in told.items() if np.isfinite(value) and value not in (0, -1)}
        self.hardware: dict[str, Any] = {
            "camera": source,
            "driver": self._capture.getBackendName(),
            **told,
            "time": "arrival of the frame",
            "lost_frames": "only those that this program could not take are counted",
        }
        self.rate: float | None = told.get("frames_a_second", rate)

    def _arrivals(self, utc_ahead: int) -> Iterator[Arrival]:
        grabbed = self._first_new()
        while grabbed:
            now = time.monotonic_ns()
            there, image = self._capture.retrieve()
            if not there:
                break
            yield Arrival(to_grey(image), now)
            grabbed = self._capture.grab()
        raise InputError("gives no more pictures", where=self.name, remedy="is it still plugged in?")

    def _first_new(self) -> bool:
        """Grab frames until one takes time to arrive: those before were buffered by the driver."""
        for _ in range(STALE):
            asked = time.monotonic()
            if not self._capture.grab():
                return False
            if time.monotonic() - asked > AT_ONCE:
                break
        return True

    def close(self) -> None:
        """Release the camera. Not during iteration: drivers crash when a camera is released during a read."""
        self._capture.release()
