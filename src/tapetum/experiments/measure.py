"""Measures of an image of a retro-reflection: size, symmetry, and power laws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError

__all__ = ["PowerLaw", "holding_diameter", "mirror_error", "power_law", "widths"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PowerLaw:
    """y = factor · x**exponent, fitted to logarithms; `error` is the exponent's standard error from the residuals."""

    exponent: float
    error: float
    factor: float

    @property
    def words(self) -> str:
        """The exponent with its error, as "−2.000 ± 0.001"."""
        return f"{self.exponent:.3f} ± {self.error:.3f}".replace("-0.000", "0.000").replace("-", "−")


def power_law(x: ArrayLike, y: ArrayLike) -> PowerLaw:
    """Fit a power law to [N >= 3] positive values by unweighted least squares in logarithms."""
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if a.ndim != 1 or a.shape != b.shape or len(a) < 3:
        remedy = "give [N] of each, three at least"
        raise InputError(f"have the shapes {a.shape} and {b.shape}", where="x and y", remedy=remedy)
    if not (np.isfinite(a).all() and np.isfinite(b).all() and (a > 0).all() and (b > 0).all()):
        raise InputError("hold a value that is not positive", where="x and y", remedy="give positive, finite values")
    if not np.ptp(a):
        raise InputError("are all the same", where="x", remedy="give different values")
    # SciPy's linregress gives no error of the slope for constant values.
    (exponent, level), covariance = np.polyfit(np.log(a), np.log(b), 1, cov=True)
    return PowerLaw(float(exponent), float(np.sqrt(covariance[0, 0])), float(np.exp(level)))


def _offsets(count: int, pitch: float) -> Array:
    return (np.arange(count, dtype=np.float64) - (count - 1) / 2) * pitch


def _image(image: ArrayLike) -> Array:
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.isfinite(values).all() or not values.sum() > 0:
        raise InputError(f"expected one finite image [H, W] with light in it, got shape {values.shape}", where="image")
    return values


def holding_diameter(image: ArrayLike, pitch: float, share: float) -> float:
    """Diameter in metres of the circle about the middle of an image [H, W] that holds a share (0 to 1) of its light.

    Between pixels (`pitch` in metres) it is interpolated by area; a uniform disc of diameter D gives D·√share.
    """
    values = _image(image)
    if not 0 < share < 1:
        raise InputError(f"must be between 0 and 1, is {share}", where="share", remedy="give for example 0.8")
    y, x = _offsets(values.shape[0], pitch), _offsets(values.shape[1], pitch)
    area = (y[:, None] ** 2 + x[None, :] ** 2).ravel()
    order = np.argsort(area, kind="stable")
    held = np.cumsum(values.ravel()[order])
    # The light within a pixel's distance includes half of that pixel.
    inside = (held - values.ravel()[order] / 2) / held[-1]
    return 2 * float(np.sqrt(np.interp(share, inside, area[order])))


def widths(image: ArrayLike, pitch: float, share: float = 0.8) -> tuple[float, float]:
    """Width in x and in y of the strips that hold a share of the light, equal parts left out on both sides; metres."""
    values = _image(image)
    found: list[float] = []
    for axis in (0, 1):
        profile = values.sum(axis=axis)
        edges = np.concatenate([[0.0], np.cumsum(profile)]) / profile.sum()
        low, high = np.interp([(1 - share) / 2, (1 + share) / 2], edges, np.arange(len(edges)) * pitch)
        found.append(float(high - low))
    return found[0], found[1]


def mirror_error(image: ArrayLike, axis: int) -> float:
    """Asymmetry under reflection: 0 for a symmetric image, 1 for no overlap with its mirror image.

    Axis 0 mirrors top to bottom, axis 1 left to right.
    """
    values = _image(image)
    return float(np.abs(values - np.flip(values, axis=axis)).sum() / (2 * values.sum()))
