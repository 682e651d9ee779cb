"""Covariance of one crop's residuals: each pixel's own noise, and offsets that columns and rows share."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

__all__ = ["Noise"]

Array = NDArray[np.float64]


class Noise:
    """The covariance Σ of a crop's digital numbers, ready to be divided by.

    Pixels scatter each for itself; a sensor's columns and rows have offsets of their own besides, the same for all
    their pixels. Beside the noise of one pixel these are small, yet not beside that of a column's sum, and the rings
    of an RR cross many pixels of each: without them a fit trusts its crop too much.

    Parameters
    ----------
    slope
        [H, W] digital numbers an electron; 0 where saturated.
    variance
        [H W] of each pixel's own noise, in digital numbers squared.
    offsets
        Root mean square of the offsets of columns and of rows, in electrons.

    Notes
    -----
    Σ = D + U Uᵀ with one column of U for each column and row of pixels: Woodbury's identity inverts it by a matrix as
    wide as there are columns and rows, not pixels.
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
        """Products one Σ⁻¹ otherᵀ, [P, Q], of vectors [P, H W] and [Q, H W]."""
        plain = (one * self._own) @ other.T
        if self._factor is None:
            return plain
        return plain - self._shared(one) @ cho_solve(self._factor, self._shared(other).T)

    def _shared(self, vectors: Array) -> Array:
        """Their products with Σ's shared part, [P, W + H]: sums over columns, then over rows."""
        weighed = (vectors * self._own).reshape(-1, *self._shape) * self._slope
        return np.concatenate([self._offsets[0] * weighed.sum(1), self._offsets[1] * weighed.sum(2)], axis=1)
