"""Constant stray light in the probe's frame, and the sensor's fixed pattern."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.bench import Scene
from tapetum.errors import InputError
from tapetum.record.clutter import Thing, blurred
from tapetum.simulate.exposure import hot_currents
from tapetum.simulate.radiometry import dark_electrons

__all__ = ["DimRoom", "FixedPattern", "Gradient", "Ground", "Stray", "draw_stray"]

Frame = npt.NDArray[np.float32]
# Pixels of the dim room across its blur; finer ones would not be visible.
_CELLS = 24


@dataclass(frozen=True)
class Gradient(Thing):
    """Stray light that grows evenly across the frame, as from a window beside the probe.

    Parameters
    ----------
    electrons, angle
        At the bright corner in the scene's exposure (the opposite one has none); and the direction of growth, in
        radians from x to y.
    """

    electrons: float
    angle: float = 0.0

    positive: ClassVar[tuple[str, ...]] = ("electrons",)

    def light(self, scene: Scene, rng: np.random.Generator) -> Frame:
        """Return the electrons, [H, W]."""
        columns, rows = scene.probe.sensor.pixels
        x = (np.arange(columns) - (columns - 1) / 2) * math.cos(self.angle)
        y = (np.arange(rows) - (rows - 1) / 2) * math.sin(self.angle)
        ramp = x + y[:, None]
        reach = float(np.ptp(ramp)) or 1.0
        return (self.electrons * (ramp - ramp.min()) / reach).astype(np.float32)


@dataclass(frozen=True)
class DimRoom(Thing):
    """A furnished room behind the target, out of focus: the probe sees it blurred by a disc of D f_p/d.

    Parameters
    ----------
    electrons, distance
        Mean over the frame in the scene's exposure, and distance of its wall from the probe in metres; None for 2 m
        behind the target.
    contrast
        Standard deviation of the logarithm of the furniture's reflected light: assumed 0.8.
    """

    electrons: float
    distance: float | None = None
    contrast: float = 0.8

    positive: ClassVar[tuple[str, ...]] = ("electrons", "distance")

    def light(self, scene: Scene, rng: np.random.Generator) -> Frame:
        """Return the electrons, [H, W]."""
        probe = scene.probe
        columns, rows = probe.sensor.pixels
        distance = scene.distance + 2 if self.distance is None else self.distance
        scale = probe.lens.focal_length / distance / probe.sensor.pitch
        blur = 2 * probe.lens.aperture_radius * scale
        cell = max(1.0, blur / _CELLS)
        margin = math.ceil(blur / cell / 2) + 2
        width, height = math.ceil(columns / cell) + 2 * margin, math.ceil(rows / cell) + 2 * margin
        room = np.zeros((height, width), np.float32)
        # Overlapping objects of 1 to 50 cm, until each place has been covered about ten times.
        covered = 0.0
        while covered < 10 * width * height:
            w, h = np.exp(rng.uniform(math.log(0.01), math.log(0.5), 2)) * scale / cell
            x, y = rng.uniform(-w, width), rng.uniform(-h, height)
            tone = float(self.contrast * rng.standard_normal())
            corners = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]])
            cv2.fillConvexPoly(room, np.rint(corners * 16).astype(np.int32), tone, shift=4)
            covered += max(1.0, min(w, width) * min(h, height))
        seen = blurred(np.exp(room), blur / cell)
        # The frame's middle is the room's; pixel centres at whole numbers.
        x, y = ((np.arange(n) - (n - 1) / 2) / cell for n in (columns, rows))
        across, down = np.meshgrid(x + (width - 1) / 2, y + (height - 1) / 2)
        done = cv2.remap(seen, across.astype(np.float32), down.astype(np.float32), cv2.INTER_CUBIC)
        frame = np.maximum(np.asarray(done, np.float32), 0)
        return frame * np.float32(self.electrons / frame.mean())


@dataclass(frozen=True)
class FixedPattern:
    """A sensor's constant offsets and uneven sensitivity, determined by its serial number.

    Parameters
    ----------
    columns, rows, pixels
        RMS of the offsets of columns, rows and single pixels, in electrons. They count as light: they cannot make a
        pixel negative, and have shot noise (small beside the read noise).
    gain
        RMS of the pixels' relative sensitivity.
    """

    columns: float = 0.5
    rows: float = 0.2
    pixels: float = 0.5
    gain: float = 0.01

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0):
                where = f"fixedpattern.{name}"
                raise InputError(f"must not be negative, is {value}", where=where, remedy="give 0 or more")

    def draw(self, scene: Scene) -> tuple[Frame, Frame]:
        """Return offsets in electrons and sensitivities, [H, W] each."""
        columns, rows = scene.probe.sensor.pixels
        rng = np.random.default_rng([scene.probe.sensor.serial, 0xF1])
        across, down = rng.standard_normal(columns), rng.standard_normal(rows)
        single, gain = (rng.standard_normal((rows, columns), dtype=np.float32) for _ in range(2))
        offset = self.columns * across + self.rows * down[:, None] + self.pixels * single
        return offset.astype(np.float32), np.maximum(0, 1 + np.float32(self.gain) * gain)


Stray = Gradient | DimRoom | FixedPattern


@dataclass(frozen=True)
class Ground:
    """A frame without laser and clutter: [H, W] electrons in the scene's exposure, and the sensor's pattern, if any."""

    light: Frame
    offset: Frame | None = None
    gain: Frame | None = None

    @classmethod
    def of(cls, scene: Scene, stray: tuple[Stray, ...] = (), seed: int = 0) -> Ground:
        """Return the scene's even background and dark current, hot pixels included, plus stray light."""
        sensor = scene.probe.sensor
        light = np.full(sensor.pixels[::-1], dark_electrons(sensor), np.float32)
        if sensor.hot_pixels and sensor.hot_current:
            light += (hot_currents(sensor) * sensor.exposure).numpy()
        offset = gain = None
        for number, one in enumerate(stray):
            if isinstance(one, FixedPattern):
                offset, gain = one.draw(scene)
            else:
                light += one.light(scene, np.random.default_rng([seed, 12, number]))
        return cls(light, offset, gain)

    def lit(self, exposure: float) -> Frame:
        """Return a new frame of mean electrons, to which more light may be added."""
        return self.light * np.float32(exposure)

    def seen(self, mean: Frame) -> Frame:
        """Apply the sensor's pattern to a frame in place; return it."""
        if self.gain is not None and self.offset is not None:
            mean *= self.gain
            mean += self.offset
            np.maximum(mean, 0, out=mean)
        return mean


def draw_stray(scene: Scene, seed: int) -> tuple[Stray, ...]:
    """Return a dim room, a gradient and a fixed pattern, at most as bright as the scene's background (assumed)."""
    rng = np.random.default_rng([seed, 0x57])
    usual = max(10.0, scene.probe.sensor.background)
    room, ramp = usual * rng.uniform(0.2, 1.0, 2)
    return DimRoom(float(room)), Gradient(float(ramp), float(rng.uniform(0, 2 * math.pi))), FixedPattern()
