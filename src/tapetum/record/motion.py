"""Motion of a hand-held camera: a gaze that wanders over the field, a body that sways or walks, a tremor."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from tapetum.errors import InputError

__all__ = ["Hand", "HandMotion", "ProbeShake", "Waves"]

Array = npt.NDArray[np.float64]


# Metres that a body walks away at most.
_FARTHEST = 1e4


@dataclass(frozen=True)
class HandMotion:
    """Spectrum and extent of a hand-held camera's motion. Its parts are independent of each other; bands are in Hz.

    Parameters
    ----------
    extent, sweep_band
        Largest gaze, in fractions of the field, and band of the deliberate sweep over it.
    tremor, tremor_band
        Physiological tremor, RMS in fractions of the field: at 8 to 12 Hz (Elble and Koller, Tremor, 1990).
    sway, sway_band
        Sideways position, RMS in metres. The band is that of quiet standing: nearly all power of the centre of pressure
        lies below 1 Hz (Prieto et al., IEEE Trans. Biomed. Eng. 43, 956 (1996)).
    roll, roll_band
        Turn about the target's optical axis, RMS in radians, some 0.02 for a camera held with care; the sway's band.
    reach, reach_band
        Position along the line of sight, RMS in metres, some 0.01 for a hand; the sway's band (assumed, both).
    walk
        Distances from the probe between which the target is carried during the recording, in metres; None where it
        stays at the scene's. It starts and stops gently (a raised cosine of time).

    Notes
    -----
    Each is a sum of sinusoids with random phases, of even power over its band, so a motion can be read at any time of
    either camera's clock. The sweep's normal distribution is mapped to a uniform one: every part of the field is
    visited alike.
    """

    extent: float = 0.48
    sweep_band: tuple[float, float] = (0.03, 0.3)
    tremor_band: tuple[float, float] = (8.0, 12.0)
    tremor: float = 0.002
    sway: float = 3e-3
    sway_band: tuple[float, float] = (0.05, 0.6)
    roll: float = 0.0
    roll_band: tuple[float, float] = (0.05, 0.6)
    reach: float = 0.0
    reach_band: tuple[float, float] = (0.05, 0.6)
    walk: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            numbers = value if isinstance(value, tuple) else () if value is None else (value,)
            if not all(math.isfinite(one) and one >= 0 for one in numbers):
                raise InputError(f"must not be negative, is {value}", where=f"motion.{name}", remedy="give SI numbers")
        if self.walk is not None and min(self.walk) <= 0:
            raise InputError(f"must be positive, is {self.walk}", where="motion.walk", remedy="give two distances")
        if self.walk is not None and max(self.walk) > _FARTHEST:
            remedy = f"give two distances of at most {_FARTHEST:.0f} m"
            raise InputError(f"leads too far, is {self.walk}", where="motion.walk", remedy=remedy)

    def draw(self, seed: int, distance: float = 1.0, seconds: float = 60.0) -> Hand:
        """Return one motion, determined by the seed; without a walk (over `seconds`) it stays at `distance` metres."""
        rng = np.random.default_rng([seed, 1])
        bands = (self.sweep_band, self.tremor_band, self.sway_band, self.roll_band, self.reach_band)
        sweep, tremor, sway, roll, reach = (Waves.draw(rng, band) for band in bands)
        return Hand(self, sweep, tremor, sway, roll, reach, self.walk or (distance, distance), seconds)

    def as_dict(self) -> dict[str, object]:
        """Plain values, for a recording."""
        return asdict(self)


@dataclass(frozen=True)
class Waves:
    """Two independent Gaussian processes of unit variance, as sums of sinusoids."""

    frequency: Array
    phase: Array

    @classmethod
    def draw(cls, rng: np.random.Generator, band: tuple[float, float], count: int = 24) -> Waves:
        """Return one such pair, of even power over a band of frequencies in Hz."""
        return cls(rng.uniform(*band, size=(count, 2)), rng.uniform(0, 2 * np.pi, size=(count, 2)))

    def __call__(self, times: Array) -> Array:
        """Return both processes at times [T] in seconds: [T, 2]."""
        angle = 2 * np.pi * self.frequency * times[:, None, None] + self.phase
        return np.sqrt(2 / len(self.frequency)) * np.cos(angle).sum(axis=1)


@dataclass(frozen=True)
class ProbeShake:
    """Rotation of a probe that is held in the hand: all that it sees moves together.

    Parameters
    ----------
    rms
        RMS angle about x and about y, in radians: times its focal length it is the picture's motion.
    band
        Frequencies in Hz; by default those of a hand's tremor (see `HandMotion`).
    """

    rms: float
    band: tuple[float, float] = (8.0, 12.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.rms) and self.rms >= 0 and 0 < self.band[0] <= self.band[1]):
            what = f"{self.rms} rad at {self.band} Hz is no shake"
            raise InputError(what, where="shake", remedy="give radians from 0, and frequencies that rise from above 0")

    def draw(self, seed: int, times: Array) -> Array:
        """Return the angles at times [T] in seconds, [T, 2] in radians, determined by the seed."""
        return self.rms * Waves.draw(np.random.default_rng([seed, 2]), self.band)(times)


@dataclass(frozen=True)
class Hand:
    """A drawn motion: place and gaze of a target at any times [T] in seconds from the start."""

    motion: HandMotion
    _sweep: Waves
    _tremor: Waves
    _sway: Waves
    _roll: Waves
    _reach: Waves
    _walk: tuple[float, float]
    _seconds: float

    def gaze(self, times: Array) -> Array:
        """Return the laser's place in the target's field, [T, 2] in fractions of it."""
        swept = self.motion.extent * (2 * ndtr(self._sweep(times)) - 1)
        return swept + self.motion.tremor * self._tremor(times)

    def place(self, times: Array) -> Array:
        """Return the sideways position, [T, 2] in metres."""
        return self.motion.sway * self._sway(times)

    def roll(self, times: Array) -> Array:
        """Return the rotation about the optical axis, [T] in radians, from x towards y."""
        return self.motion.roll * self._roll(times)[:, 0]

    def distance(self, times: Array) -> Array:
        """Return the distance from the probe, [T] in metres."""
        first, last = self._walk
        gone = (1 - np.cos(np.pi * np.clip(times / self._seconds, 0, 1))) / 2
        return first + (last - first) * gone + self.motion.reach * self._reach(times)[:, 0]
