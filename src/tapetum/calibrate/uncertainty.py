"""Values with standard uncertainties, from the scatter of the parts they are computed from."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Measured", "jackknife", "left_out", "mean_and_error", "root_of"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Measured:
    """A value with its standard uncertainty."""

    value: float
    error: float

    def __str__(self) -> str:
        if not (math.isfinite(self.value) and math.isfinite(self.error)):
            return "not measured"
        digits = 0 if self.error <= 0 else max(0, 1 - math.floor(math.log10(self.error)))
        return f"{self.value:.{min(digits, 9)}f} ± {self.error:.{min(digits, 9)}f}"


def jackknife(left: Array) -> float:
    """Standard error of a value from those without one tile each."""
    known = left[np.isfinite(left)]
    if len(known) < 2:
        return math.inf
    return math.sqrt((len(known) - 1) * float(np.mean((known - known.mean()) ** 2)))


def left_out(values: Array, weights: Array) -> Array:
    """Return the weighted mean [T] without each tile."""
    known = np.isfinite(values) & (weights > 0)
    values, weights = values[known], weights[known]
    return ((values * weights).sum() - values * weights) / (weights.sum() - weights)


def root_of(square: Measured, slope: float) -> tuple[Measured, bool]:
    """Return the root of a square in digital numbers, in electrons; its upper limit, and True, where it drowns."""
    if square.value > 2 * square.error:
        root = math.sqrt(square.value)
        return Measured(root / slope, square.error / (2 * root * slope)), False
    most = math.sqrt(max(square.value, 0.0) + 2 * square.error) / slope
    return Measured(most, most), True


def mean_and_error(values: Array, weights: Array) -> Measured:
    """Return the weighted mean over the tiles with its standard error; NaN where none is known."""
    known = np.isfinite(values) & (weights > 0)
    if not known.any():
        return Measured(math.nan, math.inf)
    return Measured(float(np.average(values[known], weights=weights[known])), jackknife(left_out(values, weights)))
