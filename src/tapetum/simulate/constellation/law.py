"""Evenness of what a set of probes does, and the law of overlapping beams in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from tapetum.errors import InputError
from tapetum.simulate.constellation.room import Array, between

__all__ = ["Evenness", "OverlapLaw", "evenness", "overlap_law"]


@dataclass(frozen=True)
class Evenness:
    """Smallest, largest and mean of something over a volume; `ratio` is largest over smallest."""

    low: float
    high: float
    mean: float

    @property
    def ratio(self) -> float:
        return self.high / self.low if self.low > 0 else math.inf


def evenness(values: npt.ArrayLike) -> Evenness:
    """How even finite, non-negative `values` are."""
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 or not np.isfinite(array).all() or (array < 0).any():
        raise InputError("must be finite and not negative, and at least one", where="values", remedy="check them")
    return Evenness(float(array.min()), float(array.max()), float(array.mean()))


@dataclass(frozen=True)
class OverlapLaw:
    """By distance: beams, illumination and summed signal, each 1 at the nearest, and the combined SNR."""

    beams: Array
    illumination: Array
    signal: Array
    snr: Array


def overlap_law(
    distance: npt.ArrayLike, nearest: float, electrons_nearest: float, noise: float, *, exponent: float = 2.0
) -> OverlapLaw:
    """What n(d) = (d/nearest)^exponent equal overlapping diverging beams do, in closed form.

    Each beam gives E ∝ 1/d² and, while the return fits the probe's aperture, S = S₀ (nearest/d)². So

        illumination, ΣS ∝ n/d²          constant for n ∝ d²
        SNR² = n S²/(S + B)              n S → constant for n ∝ d² where S ≫ B (shot noise)
                                         n S²/B → falls as 1/d² for n ∝ d² where S ≪ B (readout, stray light)

    Illumination, summed signal and SNR are constant at once under shot noise only. Against a constant noise B a
    constant SNR needs n ∝ d⁴, and then the illumination grows as d².

    Parameters
    ----------
    distance
        In metres, any shape, not below `nearest`.
    nearest
        Where one beam lights the camera, in metres.
    electrons_nearest
        S₀, in electrons a frame.
    noise
        B, variance in electrons² of a probe's noise other than the RR's shot noise.
    exponent
        Of the beams' number.
    """
    between("nearest", nearest, 0, math.inf)
    between("electrons_nearest", electrons_nearest, 0, math.inf)
    between("noise", noise, 0, math.inf, low_too=True)
    d = np.asarray(distance, dtype=np.float64)
    if d.size == 0 or not np.isfinite(d).all() or (d < nearest).any():
        raise InputError(f"reaches below {nearest:g} m or is not finite", where="distance", remedy="start there")
    beams = (d / nearest) ** exponent
    fall = (nearest / d) ** 2
    each = electrons_nearest * fall
    return OverlapLaw(beams, beams * fall, beams * fall, np.sqrt(beams * each**2 / (each + noise)))
