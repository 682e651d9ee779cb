"""Cameras of the virtual bench that point to a requested place, in real time: a visitor's hand before an exhibit.

The probe stands above a screen 5.5 m away. Each hand holds a thin-lens camera, is turned a little about the
camera's axis, takes a moment to reach a new place, and trembles. What the probe sees of it is computed, with its noise.
The motion is assumed, not measured on people.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import load_scene, with_values
from tapetum.errors import InputError
from tapetum.record.marks import scene_mark
from tapetum.record.noise import counts
from tapetum.record.patch import Patch, add_patch
from tapetum.record.returns import windows_of
from tapetum.record.source import Frame
from tapetum.record.stray import Ground
from tapetum.simulate import Camera, tilt_of_gaze
from tapetum.simulate.gaze import largest_sine
from tapetum.simulate.radiometry import photoelectrons

__all__ = ["Aim", "Hands", "how_many"]

_MOST = 3
_RATE = 12.0
_REACH = 0.55  # of the camera's field that the screen's width takes up: 0.17 m
# In fractions of the screen; the bundled model errs most of cameras that look straight at the probe.
_PROBE = (0.5, -0.12)
_ROLL = (0.07, -0.05, 0.12)  # rad
_SETTLE = 0.12  # s
_TREMBLE, _TREMBLE_TIME = 0.003, 0.4  # of the field, and s over which it changes
_APART = 430  # pixels between two returns: none lies in the square that models see of another
_SIZE = (640, 480)  # of the probe's frame with one hand
_DWELL = 2.5  # s for which a hand that nobody leads rests

Array = npt.NDArray[np.float64]


def how_many(source: str) -> int:
    """Return how many hands a text names; InputError where it names none."""
    number = source.partition(":")[2] or "1"
    if not (number.isascii() and number.isdigit() and 1 <= int(number) <= _MOST):
        raise InputError("names no hands", where=source, remedy=f"write hand, or hand:N with N from 1 to {_MOST}")
    return int(number)


class Aim:
    """Where hands point: places in fractions of the screen, set from any thread.

    A hand that nobody led for some seconds points at places of its own.
    """

    patience = 6.0

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._told: dict[int, tuple[float, float, float]] = {}

    def point(self, x: float, y: float, hand: int = 0) -> None:
        """Point a hand at a place."""
        if not (-0.5 <= x <= 1.5 and -0.5 <= y <= 1.5 and 0 <= hand < _MOST):
            raise InputError(f"x {x}, y {y}, hand {hand} is out of reach", where="hand")
        with self._lock:
            self._told[hand] = x, y, time.monotonic()

    def at(self, hand: int) -> tuple[float, float] | None:
        """Return where a hand is asked to point; None where nobody asked."""
        with self._lock:
            told = self._told.get(hand)
        if told is None or time.monotonic() - told[2] > self.patience:
            return None
        return told[:2]


@dataclass
class _Hand:
    """One hand: where it points now, and its tremble, in fractions of the screen and of the field."""

    number: int
    rng: np.random.Generator
    at: Array = field(default_factory=lambda: np.array([0.5, 0.5]))
    goal: Array = field(default_factory=lambda: np.array([0.5, 0.5]))
    tremble: Array = field(default_factory=lambda: np.zeros(2))
    until: float = 0.0
    latest: Array = field(default_factory=lambda: np.zeros(2))

    def gaze(self, told: tuple[float, float] | None, time: float, step: float) -> Array:
        """Move for `step` seconds; return the gaze."""
        if told is not None:
            self.goal, self.until = np.array(told), time + _DWELL
        elif time >= self.until:
            self.goal, self.until = self.rng.uniform(0.1, 0.9, 2), time + _DWELL * float(self.rng.uniform(0.7, 1.6))
        self.at = self.at + (1 - math.exp(-step / _SETTLE)) * (self.goal - self.at)
        kept = math.exp(-step / _TREMBLE_TIME)
        self.tremble = kept * self.tremble + math.sqrt(1 - kept**2) * _TREMBLE * self.rng.standard_normal(2)
        c, s = math.cos(_ROLL[self.number]), math.sin(_ROLL[self.number])
        # A camera that points to the right sees the probe on the left.
        away = -_REACH * (self.at - _PROBE) * [1.0, 0.75]
        self.latest = np.array([c * away[0] - s * away[1], s * away[0] + c * away[1]]) + self.tremble
        return self.latest


class Hands:
    """Hands before a probe, in real time; a `Source`.

    Parameters
    ----------
    name
        `hand`, or `hand:N` for up to three of them.
    aim
        Where they point; default: they point by themselves.
    rate
        Frames a second asked for; a machine that computes fewer loses the others.
    seed
        Of motion and noise.
    """

    live, count, full_scale = True, None, 255

    def __init__(self, name: str = "hand", aim: Aim | None = None, rate: float | None = None, seed: int = 3) -> None:
        number = how_many(name)
        self.name, self.aim = name, aim or Aim()
        self.rate: float | None = rate or _RATE
        self._rng = np.random.default_rng(seed)
        self._hands = [_Hand(k, np.random.default_rng([seed, k])) for k in range(number)]
        columns = _SIZE[0] + _APART * (len(self._hands) - 1)
        self._scene = with_values(load_scene("hand-held"), {"probe.sensor.pixels": (columns, _SIZE[1])})
        aside = (np.arange(len(self._hands)) - (len(self._hands) - 1) / 2) * _APART
        # In the probe's focal plane, in metres.
        self._places = np.stack([aside, np.zeros_like(aside)], 1) * self._scene.probe.sensor.pitch
        self._over = threading.Event()
        # Places may lie beside the screen, by half its size.
        corner = np.array([[-1.0, -1.0], [1.0, 1.0]]) * (1.3 * _REACH + 4 * _TREMBLE)
        steepest = largest_sine(tilt_of_gaze(self._scene, torch.from_numpy(corner)))
        camera = Camera(self._scene, steepest, edge="dimmed", device="cpu")
        windows, _ = windows_of(camera, steepest, float(np.abs(self._places).max()))
        self._cameras = {share: camera.on(window) for share, window in windows.items()}
        one = torch.ones((), dtype=torch.float64)
        sensor = self._scene.probe.sensor
        self._electrons = float(photoelectrons(one, sensor, self._scene.illumination.wavelength))
        self._ground = Ground.of(self._scene)

    @property
    def hardware(self) -> dict[str, Any]:
        """A note that all of it is simulated."""
        return {"camera": "simulated", "target": "a camera in a simulated hand"}

    @property
    def marks(self) -> frozenset[str]:
        """The mark of the scene that every hand's camera is of (`tapetum.record.marks`)."""
        return frozenset({scene_mark(self._scene)})

    def first(self) -> Frame:
        """Return a frame in which all hands point at the middle."""
        return Frame(0, 0.0, self.picture([np.zeros(2)] * len(self._hands)), self.name)

    def __len__(self) -> int:
        raise TypeError("hands have no end")

    def close(self) -> None:
        """End the frames."""
        self._over.set()

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames from now on; those whose time has passed are lost, as of a camera."""
        utc, start = time.time_ns(), time.monotonic_ns()
        step = round(1e9 / (self.rate or _RATE))
        before = number = -1
        while True:
            number = max(number + 1, (time.monotonic_ns() - start) // step)
            if self._over.wait(max(0.0, (start + number * step - time.monotonic_ns()) / 1e9)):
                return
            seconds = number * step / 1e9
            moved = (number - before) * step / 1e9
            gazes = [one.gaze(self.aim.at(one.number), seconds, moved) for one in self._hands]
            yield Frame(
                number,
                seconds,
                self.picture(gazes),
                f"{self.name}[{number}]",
                utc_ns=utc + number * step,
                monotonic_ns=start + number * step,
                lost=number - before - 1,
            )
            before = number

    def picture(self, gazes: list[Array]) -> npt.NDArray[np.uint8]:
        """Return the probe's frame [480, 640] of hands with these gazes (fractions of the field)."""
        scene = self._scene
        sensor = scene.probe.sensor
        mean = self._ground.lit(1.0)
        middle = (np.array(sensor.pixels) - 1) / 2
        sines = tilt_of_gaze(scene, torch.from_numpy(np.array(gazes)))
        centres = torch.from_numpy(self._places)
        for tilts, places, share in next(iter(self._cameras.values())).beams(sines, centres):
            camera = self._cameras[share]
            half = (camera.output.rows - 1) / 2
            at = middle + places.numpy() / sensor.pitch - half
            corner = np.rint(at)
            offset = torch.from_numpy((at - corner) * sensor.pitch)
            images = camera.render(tilts, offset, share, equivalent=True).numpy()
            for image, (left, top) in zip(images, corner, strict=True):
                light = np.asarray(image * np.float32(self._electrons), np.float32)
                add_patch(mean, Patch(int(left), int(top), light), 1.0)
        return counts(mean, sensor, self._rng)
