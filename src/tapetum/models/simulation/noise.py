"""Noise covariance of one crop: independent noise of each pixel, and offsets shared by columns and rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

__all__ = ["Noise"]

Array = NDArray[np.float64]


class Noise:
    """The covariance Σ of a crop's digital numbers, ready to be divided by.

    `slope` [H, W] is in digital numbers per electron (0 where saturated), `variance` [H W] that of each pixel's own
    noise, `offsets` the RMS offsets of columns and rows in electrons. The offsets are small beside one pixel's noise
    but not beside that of a column's sum; an RR's rings cross many pixels of each, so ignoring them makes intervals too
    narrow. Σ = D + U Uᵀ with one column of U for each column and row of pixels is inverted by Woodbury's identity.
    """

    def __init__(self, slope: Array, variance: Array, offsets: tuple[float, float]) -> None:
        self._shape, self._offsets = slope.shape, offsets
        self._own, self._factor, self.log_determinant = 1 / variance, None, float(np.log(variance).sum())
        if not any(offsets):
            return
        self._slope = slope
        weight = slope**2 * self._own.reshape(slope.shape)
        column, row = offsets
        across, down = np.diag(column**2 * weight.sum(0)), np.diag(row**2 * weight.sum(1))
        both = column * row * weight.T
        inner = np.eye(sum(slope.shape)) + np.block([[across, both], [both.T, down]])
        self._factor = cho_factor(inner)
        self.log_determinant += 2 * float(np.log(self._factor[0].diagonal()).sum())

    def __call__(self, one: Array, other: Array) -> Array:
        """Return one Σ⁻¹ otherᵀ, [P, Q], of vectors [P, H W] and [Q, H W]."""
        plain = (one * self._own) @ other.T
        if self._factor is None:
            return plain
        return plain - self._shared(one) @ cho_solve(self._factor, self._shared(other).T)

    def _shared(self, vectors: Array) -> Array:
        """Return the products Uᵀ D⁻¹ of vectors, [P, W + H]: sums over columns, then over rows."""
        weighed = (vectors * self._own).reshape(-1, *self._shape) * self._slope
        return np.concatenate([self._offsets[0] * weighed.sum(1), self._offsets[1] * weighed.sum(2)], axis=1)
