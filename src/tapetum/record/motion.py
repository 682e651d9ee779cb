"""How a hand holds a camera: a gaze that wanders over the field, a body that sways, a tremor on both."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

__all__ = ["HandMotion"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class HandMotion:
    """Spectrum and extent of a hand-held camera's motion. Gaze and sway are independent of each other.

    Parameters
    ----------
    extent
        Largest gaze, in fractions of the field.
    sweep_band
        Frequencies of the deliberate sweep over the field, in Hz.
    tremor_band
        Frequencies of the physiological tremor, in Hz: 8 to 12 (Elble and Koller, Tremor, 1990).
    tremor
        Its root mean square, in fractions of the field.
    sway
        Root mean square of the camera's sideways position, in metres.
    sway_band
        Its frequencies, in Hz.

    Notes
    -----
    Each is a sum of sinusoids with random phases, so a motion can be read at any time of either camera's clock. The
    sweep's normal distribution is mapped to a uniform one: every part of the field is visited alike.
    """

    extent: float = 0.48
    sweep_band: tuple[float, float] = (0.03, 0.3)
    tremor_band: tuple[float, float] = (8.0, 12.0)
    tremor: float = 0.002
    sway: float = 3e-3
    sway_band: tuple[float, float] = (0.05, 0.6)

    def draw(self, seed: int) -> tuple[_Path, _Path]:
        """Gaze (fractions of the field) and sideways position (metres), each a function of times [T] to [T, 2]."""
        rng = np.random.default_rng([seed, 1])
        sweep = _Waves.draw(rng, self.sweep_band)
        tremor = _Waves.draw(rng, self.tremor_band)
        sway = _Waves.draw(rng, self.sway_band)
        return (
            _Path(sweep, self.extent, uniform=True, tremor=tremor, tremor_scale=self.tremor),
            _Path(sway, self.sway, uniform=False),
        )

    def as_dict(self) -> dict[str, object]:
        """Plain values, for a recording."""
        return asdict(self)


@dataclass(frozen=True)
class _Waves:
    """Two independent Gaussian processes of unit variance, as sums of sinusoids."""

    frequency: Array
    phase: Array

    @classmethod
    def draw(cls, rng: np.random.Generator, band: tuple[float, float], count: int = 24) -> _Waves:
        return cls(rng.uniform(*band, size=(count, 2)), rng.uniform(0, 2 * np.pi, size=(count, 2)))

    def __call__(self, times: Array) -> Array:
        angle = 2 * np.pi * self.frequency * times[:, None, None] + self.phase
        return np.sqrt(2 / len(self.frequency)) * np.cos(angle).sum(axis=1)


@dataclass(frozen=True)
class _Path:
    waves: _Waves
    scale: float
    uniform: bool
    tremor: _Waves | None = None
    tremor_scale: float = 0.0

    def __call__(self, times: Array) -> Array:
        """Positions [T, 2] at times [T], in seconds."""
        values = self.waves(times)
        values = self.scale * (2 * ndtr(values) - 1 if self.uniform else values)
        if self.tremor is not None:
            values = values + self.tremor_scale * self.tremor(times)
        return values
