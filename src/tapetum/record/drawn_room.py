"""A drawn room with cameras, as a source that needs no hardware and little time to render: what `tapetum serve demo`
shows.

The room is that of the virtual bench's target camera; the returns are Gaussian spots, not computed ones, and show
neither gaze nor device. Every other frame is lit by the probe.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.record.patch import add_patch, bell
from tapetum.record.room import furnish
from tapetum.record.source import Frame

__all__ = ["DrawnRoom"]

_NOISE = 2.0
_REACH = 12
# Of the probe's light that the room throws back, relative to the room's own.
_LIT = 0.06


@dataclass(frozen=True)
class _Drawn:
    """A camera: place and sway in pixels, seconds of a sway, height and width of its return, seconds it is there."""

    at: tuple[float, float]
    sway: float
    period: float
    height: float
    sigma: float
    there: tuple[float, float] | None = None


# The third comes after 8 s and stays for 20, in every 40.
_CYCLE = 40.0
_CAMERAS = (
    _Drawn((170, 150), 6, 7.0, 150, 1.8),
    _Drawn((470, 260), 14, 11.0, 110, 1.4),
    _Drawn((330, 390), 30, 13.0, 130, 1.6, (8.0, 28.0)),
)
_LAMP = (560.0, 70.0)
_MIRROR = (60, 250, 90, 130)  # left, top, width, height
_GLINT_EVERY, _GLINT = 6.0, 0.12  # s between two glints of the mirror's edge, and how long one lasts


@dataclass
class DrawnRoom:
    """A room with three cameras, a lamp and a mirror, in real time; a `Source`.

    Parameters
    ----------
    rate
        Frames per second; every other one is lit.
    seed
        Of the room and the noise.
    """

    rate: float = 20.0
    seed: int = 3
    name: str = "demo"
    live: bool = True
    count: int | None = None
    full_scale: int = 255
    _over: threading.Event = field(default_factory=threading.Event, repr=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self._room = 0.8 * furnish(640, 480, rng)
        self._hang_mirror()
        # One field of noise, shifted at random, costs a hundredth of a new one for each frame.
        self._noise = rng.normal(0, _NOISE, (480, 640)).astype(np.float32)
        self._rng = rng

    @property
    def hardware(self) -> dict[str, Any]:
        """A note that the room is drawn."""
        return {"camera": "a drawn room"}

    def first(self) -> Frame:
        """Return the room as it is at the beginning."""
        return Frame(0, 0.0, self.picture(0.0, lit=False), self.name, lit=False)

    def __len__(self) -> int:
        raise TypeError("the drawn room has no end")

    def close(self) -> None:
        """End the frames."""
        self._over.set()

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames from now on, each at its time; those whose time has passed are lost, as of a camera."""
        utc, start = time.time_ns(), time.monotonic_ns()
        step = round(1e9 / self.rate)
        before = number = -1
        while True:
            number = max(number + 1, (time.monotonic_ns() - start) // step)
            if self._over.wait(max(0.0, (start + number * step - time.monotonic_ns()) / 1e9)):
                return
            seconds, lit = number * step / 1e9, bool(number % 2)
            image = self.picture(seconds, lit=lit)
            yield Frame(
                number,
                seconds,
                image,
                f"{self.name}[{number}]",
                utc_ns=utc + number * step,
                monotonic_ns=start + number * step,
                lit=lit,
                lost=number - before - 1,
            )
            before = number

    def places(self, seconds: float) -> list[tuple[float, float]]:
        """Return where the cameras are that are there, x and y in pixels."""
        return [self._place(one, seconds) for one in _CAMERAS if _is_there(one, seconds)]

    def picture(self, seconds: float, *, lit: bool) -> npt.NDArray[np.uint8]:
        """Return the room [480, 640] at a time in seconds."""
        light = self._room * np.float32(1 + _LIT * lit)
        add_patch(light, bell(_LAMP, 1500 * (1 + 0.05 * math.sin(23 * seconds)), 9.0, 45), 1.0)
        if lit:
            for one in _CAMERAS:
                if _is_there(one, seconds):
                    add_patch(light, bell(self._place(one, seconds), one.height, one.sigma, _REACH), 1.0)
            if seconds % _GLINT_EVERY < _GLINT:
                add_patch(light, bell((_MIRROR[0] + 40, _MIRROR[1] + 20), 160, 1.5, _REACH), 1.0)
        down, along = self._rng.integers(0, (480, 640))
        return np.clip(light + np.roll(self._noise, (int(down), int(along)), (0, 1)), 0, 255).astype(np.uint8)

    def _place(self, one: _Drawn, seconds: float) -> tuple[float, float]:
        turn = 2 * math.pi * seconds / one.period
        return one.at[0] + one.sway * math.sin(turn), one.at[1] + 0.6 * one.sway * math.sin(1.7 * turn)

    def _hang_mirror(self) -> None:
        left, top, width, height = _MIRROR
        across = self._room[top : top + height, 300 : 300 + width][:, ::-1].copy()
        self._room[top : top + height, left : left + width] = np.minimum(1.2 * across + 15, 220)
        cv2.rectangle(self._room, (left, top), (left + width, top + height), 25.0, 3)


def _is_there(one: _Drawn, seconds: float) -> bool:
    return one.there is None or one.there[0] <= seconds % _CYCLE < one.there[1]
