"""Real sources to record from: cameras of this machine, video files, and folders of images."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from tapetum.errors import InputError
from tapetum.record.frames import open_frames
from tapetum.record.images import hushed, to_grey
from tapetum.record.layout import StreamInfo
from tapetum.record.source import Frame

__all__ = ["Camera", "Replay", "Shot", "Source", "is_camera", "open_source"]

PREFIX = "camera:"
STALE = 16  # frames that a driver may hold, at the most
AT_ONCE = 0.002  # s; a frame that comes sooner was there already

# What OpenCV may know of a camera; 0 and -1 stand for what it does not.
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


@dataclass(frozen=True)
class Shot:
    """One frame of a real source.

    Attributes
    ----------
    image
        [H, W], uint8 or uint16.
    monotonic_ns, utc_ns
        When it was taken: by a clock that is never set, and in nanoseconds since 1970.
    dropped_before
        Frames that the source says are lost since the one before.
    """

    image: np.ndarray
    monotonic_ns: int
    utc_ns: int
    dropped_before: int = 0


class Source(Protocol):
    """A stream to record: what it is, and its frames until it ends or is closed.

    Attributes
    ----------
    name
        What to call it in a message.
    live
        Whether its frames come at their own pace, and are lost where nobody takes them.
    """

    @property
    def name(self) -> str: ...

    @property
    def live(self) -> bool: ...

    @property
    def info(self) -> StreamInfo: ...

    @property
    def hardware(self) -> dict[str, Any]: ...

    def shots(self, start_monotonic_ns: int, start_utc_ns: int) -> Iterator[Shot]: ...

    def close(self) -> None: ...


def is_camera(source: str) -> bool:
    """Whether a text names a camera of this machine: `camera:0`."""
    return source.startswith(PREFIX)


class Camera:
    """A camera that OpenCV can read, such as a webcam; colour becomes grey, 8 bit.

    Its frames carry the moment at which they arrived here, some milliseconds after they were taken: OpenCV tells
    nothing better on every system.

    Parameters
    ----------
    source
        `camera:` and its number from 0.
    rate
        Frames a second to ask it for; None leaves it as it is.

    Raises
    ------
    InputError
        When there is no such camera or it gives no picture.
    """

    live = True

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
        height, width = first.shape[:2]
        told = {name: self._capture.get(key) for name, key in TOLD.items()}
        told = {name: value for name, value in told.items() if np.isfinite(value) and value not in (0, -1)}
        self.hardware: dict[str, Any] = {
            "camera": source,
            "driver": self._capture.getBackendName(),
            **told,
            "time": "arrival of the frame",
            "lost_frames": "only those that this program could not take are counted",
        }
        self.info = StreamInfo(height, width, 8, 255, told.get("frames_a_second", rate))

    def shots(self, start_monotonic_ns: int, start_utc_ns: int) -> Iterator[Shot]:
        """Yield frames until the camera gives no more; its clock is this machine's."""
        grabbed = self._first_new()
        while grabbed:
            monotonic = time.monotonic_ns()
            # UTC counts from the start by the clock that is never set: both streams share one time.
            utc = start_utc_ns + monotonic - start_monotonic_ns
            there, image = self._capture.retrieve()
            if not there:
                break
            yield Shot(to_grey(image), monotonic, utc)
            grabbed = self._capture.grab()
        raise InputError("gives no more pictures", where=self.name, remedy="is it still plugged in?")

    def _first_new(self) -> bool:
        """Grab the first frame that must be waited for: what comes at once stood in the driver since it was opened."""
        for _ in range(STALE):
            asked = time.monotonic()
            if not self._capture.grab():
                return False
            if time.monotonic() - asked > AT_ONCE:
                break
        return True

    def close(self) -> None:
        """Give the camera back. Not while `shots` runs: drivers crash when a camera goes in the middle of a read."""
        self._capture.release()


class Replay:
    """A video file, a folder of images or a stream of a recording, at its own times from the recording's start on.

    A file that was cut gives the frames that can be read before it says so.

    Parameters
    ----------
    source
        The file or folder.
    stream
        Which stream of a recording to take.
    rate
        Images a second of a folder, which has no clock.
    """

    live = False

    def __init__(self, source: str, stream: str, rate: float | None = None) -> None:
        self.name = source
        frames = open_frames(source, stream, rate=rate or 15.0, late=True)
        self._frames = frames
        there = iter(frames)
        first = next(there, None)
        if first is None:
            raise InputError("holds no frame", where=source, remedy="give another file")
        there.close()  # type: ignore[attr-defined]
        height, width = first.image.shape
        scale = int(first.full_scale or 0)
        told = getattr(self._frames, "rate", None)
        self.info = StreamInfo(height, width, scale.bit_length(), scale, told)
        self.hardware: dict[str, Any] = {"file": Path(source).name, "time": "the file's own"}

    def shots(self, start_monotonic_ns: int, start_utc_ns: int) -> Iterator[Shot]:
        """Yield the frames, as fast as they are taken."""
        last = -1
        for frame in self._frames:
            self._check(frame)
            # Stamps of files may repeat; a recording's clock rises.
            last = max(last + 1, round(frame.time * 1e9))
            yield Shot(frame.image, start_monotonic_ns + last, start_utc_ns + last)

    def _check(self, frame: Frame) -> None:
        if frame.image.shape != (self.info.height, self.info.width) or frame.full_scale != self.info.full_scale:
            given = f"{frame.image.shape[1]} x {frame.image.shape[0]} px, full scale {frame.full_scale}"
            wanted = f"{self.info.width} x {self.info.height} px, {self.info.full_scale}"
            remedy = "give frames of one size and depth"
            raise InputError(f"{frame.name} is {given}, the first was {wanted}", where=self.name, remedy=remedy)

    def close(self) -> None:
        """Do nothing: files close themselves."""


def open_source(source: str, stream: str, rate: float | None = None) -> Source:
    """Open a camera (`camera:0`), a video file, a folder of images, or a recording.

    Parameters
    ----------
    source
        What to open.
    stream
        Which stream of a recording: probe or target.
    rate
        Frames a second: asked of a camera, taken for images.

    Raises
    ------
    InputError
        When it is not there, in use, or damaged.
    """
    return Camera(source, rate) if is_camera(source) else Replay(source, stream, rate)
