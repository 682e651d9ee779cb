"""Objects in the probe's frame that are not cameras: a glint, a lamp, retro-reflective tape.

The probe is focused at infinity: an object at a distance d that fills its aperture D with light makes a disc of D f_p/d
on its sensor, whatever its own size. Objects that look small beside a retro-reflection are far away, or return a narrow
beam.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.bench import Scene
from tapetum.errors import InputError
from tapetum.record.motion import Waves
from tapetum.record.patch import Patch, bell

__all__ = ["Clutter", "Glint", "Lamp", "Painter", "Stage", "Tape", "Thing", "draw_clutter"]

Array = npt.NDArray[np.float64]
Painter = Callable[[int], Patch]


class Thing:
    """Light added to the probe's frames; `positive` names the fields that must be positive where given."""

    positive: ClassVar[tuple[str, ...]] = ("electrons", "size", "distance")

    def __post_init__(self) -> None:
        for name in self.positive:
            given = getattr(self, name)
            for value in given if isinstance(given, tuple) else (given,):
                if value is not None and not (math.isfinite(value) and value > 0):
                    where = f"{type(self).__name__.lower()}.{name}"
                    raise InputError(f"must be positive, is {value}", where=where, remedy="give electrons or metres")


@dataclass(frozen=True)
class Stage:
    """The scene, [T] times of the frames in seconds, and [T, 2] sideways place of the target in metres."""

    scene: Scene
    times: Array
    place: Array

    def pixels(self, length: float, distance: float) -> float:
        """Return how many pixels a length at a distance covers, both in metres."""
        probe = self.scene.probe
        return length * probe.lens.focal_length / distance / probe.sensor.pitch

    def blur(self, distance: float) -> float:
        """Return the diameter of the disc that a point at a distance makes, in pixels."""
        return self.pixels(2 * self.scene.probe.lens.aperture_radius, distance)

    def where(self, at: tuple[float, float]) -> Array:
        """Return the pixel [2] of a place in fractions of the frame."""
        size = np.array(self.scene.probe.sensor.pixels)
        return (size - 1) / 2 + np.array(at) * size


@dataclass(frozen=True)
class Glint(Thing):
    """Reflection of the laser in a small flat facet, as of a screw or a ring: a blob that moves by itself and twinkles.

    Parameters
    ----------
    at, electrons
        Mean place in the probe's image, in fractions of the frame from the middle, and peak electrons at the blob's
        middle in the scene's exposure.
    facet
        Diameter of the facet, in metres. The blob is a Gaussian whose width combines the beam's spread f_p facet/d and
        its diffraction λ f_p/facet (assumed; full width at half maximum).
    distance, parallax
        From the probe, in metres, None for the target's; and its share in the target's sideways motion.
    sway, sway_band
        RMS of its own motion, in metres, and the frequencies of this and of the twinkling, in Hz.
    twinkle
        RMS rotation of the facet, in widths of its beam at the probe: 0 for a steady one.
    """

    at: tuple[float, float]
    electrons: float
    facet: float = 2e-3
    distance: float | None = None
    parallax: float = 0.5
    sway: float = 2e-3
    sway_band: tuple[float, float] = (0.05, 0.6)
    twinkle: float = 0.7
    of_laser: ClassVar[bool] = True
    positive: ClassVar[tuple[str, ...]] = ("electrons", "facet", "distance")

    def prepare(self, stage: Stage, rng: np.random.Generator) -> Painter:
        """Return a function that paints its light in a frame."""
        distance = stage.scene.distance if self.distance is None else self.distance
        probe, wavelength = stage.scene.probe, stage.scene.illumination.wavelength
        diffraction = wavelength * probe.lens.focal_length / self.facet / probe.sensor.pitch
        sigma = max(0.3, math.hypot(stage.pixels(self.facet, distance), diffraction) / 2.355)
        moved = self.parallax * stage.place + self.sway * Waves.draw(rng, self.sway_band)(stage.times)
        places = stage.where(self.at) + stage.pixels(1.0, distance) * moved
        bright = np.exp(-((self.twinkle * Waves.draw(rng, self.sway_band)(stage.times)) ** 2).sum(axis=1) / 2)
        reach = math.ceil(4.5 * sigma)
        return lambda i: bell(places[i], self.electrons * bright[i], sigma, reach)


@dataclass(frozen=True)
class Lamp(Thing):
    """A lamp far behind the target: a large soft disc, independent of the laser.

    Parameters
    ----------
    at, electrons
        Its place, as of a `Glint`, and electrons on the disc in the scene's exposure: above the full well it saturates.
    size, distance
        Its diameter and distance from the probe, in metres. The disc is the probe's blur; its edge is as soft as the
        lamp is large (geometric optics, straight edge).
    flicker, mains
        Relative amplitude of its light at twice the mains' frequency (Hz): some 0.1 for a filament, up to 1 for an LED.
    """

    at: tuple[float, float]
    electrons: float
    size: float = 0.1
    distance: float = 30.0
    flicker: float = 0.1
    mains: float = 50.0
    of_laser: ClassVar[bool] = False

    def prepare(self, stage: Stage, rng: np.random.Generator) -> Painter:
        """Return a function that paints its light in a frame."""
        blur, image = stage.blur(self.distance), max(1.0, stage.pixels(self.size, self.distance))
        inner, outer = abs(blur - image) / 2, (blur + image) / 2
        places, reach = stage.where(self.at), math.ceil(outer) + 1
        left, top = (int(one) - reach for one in np.rint(places))
        x, y = (np.arange(2 * reach + 1) + c - p for c, p in zip((left, top), places, strict=True))
        rise = np.clip((outer - np.hypot(x, y[:, None])) / (outer - inner), 0, 1)
        disc = (self.electrons * (rise * rise * (3 - 2 * rise))).astype(np.float32)
        phase = rng.uniform(0, 2 * np.pi)
        bright = 1 + self.flicker * np.cos(4 * np.pi * self.mains * stage.times + phase)
        return lambda i: Patch(left, top, disc * np.float32(bright[i]))


@dataclass(frozen=True)
class Tape(Thing):
    """Retro-reflective tape, as on a safety vest: a speckled patch that follows the laser.

    Parameters
    ----------
    at, electrons
        Its mean place, as of a `Glint`, and mean electrons on the patch in the scene's exposure.
    size, angle
        Width and height in metres, and rotation in radians from x to y.
    distance
        From the probe, in metres. The patch is its image, blurred by the probe's disc: the return of beads or prisms is
        wider than the probe's aperture (assumed).
    sway, sway_band
        RMS of its motion, in metres, and its frequencies in Hz. Its speckle moves along (assumed).
    """

    at: tuple[float, float]
    electrons: float
    size: tuple[float, float] = (0.05, 0.02)
    angle: float = 0.0
    distance: float = 20.0
    sway: float = 1e-3
    sway_band: tuple[float, float] = (0.05, 0.6)
    of_laser: ClassVar[bool] = True

    def prepare(self, stage: Stage, rng: np.random.Generator) -> Painter:
        """Return a function that paints its light in a frame."""
        blur = stage.blur(self.distance)
        size = [stage.pixels(one, self.distance) for one in self.size]
        reach = math.ceil((math.hypot(*size) + blur) / 2) + 2
        reach = min(reach, max(stage.scene.probe.sensor.pixels))
        patch = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
        corners = cv2.boxPoints(((reach, reach), (size[0], size[1]), math.degrees(self.angle)))
        cv2.fillConvexPoly(patch, np.rint(corners * 16).astype(np.int32), 1.0, lineType=cv2.LINE_AA, shift=4)
        patch = blurred(patch, blur)
        probe = stage.scene.probe
        grain = stage.scene.illumination.wavelength * probe.lens.focal_length / (2 * probe.lens.aperture_radius)
        shape = self.electrons * patch / max(float(patch.max()), 1e-9)
        light = shape * _speckle(patch.shape, grain / probe.sensor.pitch, rng)
        moved = self.sway * Waves.draw(rng, self.sway_band)(stage.times)
        # Whole pixels: a speckle is about as large as one.
        corner = np.rint(stage.where(self.at) + stage.pixels(1.0, self.distance) * moved).astype(int) - reach
        return lambda i: Patch(int(corner[i, 0]), int(corner[i, 1]), light)


Clutter = Glint | Lamp | Tape


def draw_clutter(scene: Scene, seed: int, count: int = 3) -> tuple[Clutter, ...]:
    """Return glints, lamps and tape at random places of the probe's frame.

    Parameters
    ----------
    scene
        Its probe sets brightness and distance: glints up to half of its full well, tape up to a seventh, lamps from a
        third to four times; lamps and tape cover a tenth to half of the frame's height (assumed).
    seed, count
        Equal seeds give equal objects; a larger count adds to them.
    """
    return tuple(_draw_one(scene, np.random.default_rng([seed, 0xC1, number])) for number in range(count))


def _draw_one(scene: Scene, rng: np.random.Generator) -> Clutter:
    sensor, lens, full = scene.probe.sensor, scene.probe.lens, scene.probe.sensor.full_well
    at = (float(rng.uniform(-0.45, 0.45)), float(rng.uniform(-0.45, 0.45)))
    kind = rng.integers(3)
    if kind == 0:
        # About the facet that makes the smallest blob.
        facet = math.sqrt(scene.illumination.wavelength * scene.distance) * float(rng.uniform(0.8, 2.5))
        return Glint(at, full * float(rng.uniform(0.05, 0.6)), facet, parallax=float(rng.uniform(-0.2, 1.2)))
    # The blur's diameter on the sensor, and from it the distance.
    blur = float(rng.uniform(0.1, 0.3)) * min(sensor.pixels) * sensor.pitch
    distance = 2 * lens.aperture_radius * lens.focal_length / blur
    own = blur * distance / lens.focal_length
    if kind == 1:
        electrons = full * float(np.exp(rng.uniform(np.log(0.3), np.log(4.0))))
        return Lamp(at, electrons, own * float(rng.uniform(0.1, 0.6)), distance)
    size = (own * float(rng.uniform(0.3, 1.0)), own * float(rng.uniform(0.1, 0.3)))
    return Tape(at, full * float(rng.uniform(0.015, 0.15)), size, float(rng.uniform(0, math.pi)), distance)


def blurred(picture: npt.NDArray[np.float32], diameter: float) -> npt.NDArray[np.float32]:
    """Return an image convolved with a disc of a diameter in pixels, dark beyond its edges."""
    if diameter < 1:
        return picture
    reach = math.ceil(diameter / 2)
    axis = np.arange(-reach, reach + 1)
    disc = np.clip(diameter / 2 + 0.5 - np.hypot(axis, axis[:, None]), 0, 1)
    done = cv2.filter2D(picture, cv2.CV_32F, disc / disc.sum(), borderType=cv2.BORDER_CONSTANT)
    return np.maximum(np.asarray(done, np.float32), 0)


def _speckle(shape: tuple[int, ...], grain: float, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Return fully developed speckle of mean 1 with grains `grain` pixels wide, averaged over pixels."""
    finer = max(1, math.ceil(2 / grain))
    size = (finer * shape[0], finer * shape[1])
    parts = [rng.standard_normal(size, dtype=np.float32) for _ in range(2)]
    parts = [np.asarray(cv2.GaussianBlur(one, (0, 0), 0.42 * grain * finer), np.float32) for one in parts]
    light = parts[0] ** 2 + parts[1] ** 2
    light = light.reshape(shape[0], finer, shape[1], finer).mean(axis=(1, 3))
    return (light / light.mean()).astype(np.float32)
