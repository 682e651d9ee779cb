"""Quadrature over a round pupil without error from its edge.

A pupil sampled on square pixels has a ragged edge: even with every edge pixel weighted by the area it covers, the error
of a Fourier integral over it falls only like the pixel's area. Here the rows lie at the nodes of Gauss-Chebyshev
quadrature of the second kind, which absorbs the square root with which a chord shrinks at the top and the bottom of a
disc. Along each row the trapezoidal rule carries an end correction of high order for a chord that ends between two
samples. The nodes still form rows and columns, as matrix Fourier transforms need.
"""

# SciPy, NumPy and torch type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import bernoulli

__all__ = ["END_ORDER", "DiscRows", "Quadrature", "disc_quadrature"]

# Degree of the polynomials that the end correction integrates exactly. Higher degrees gain nothing in practice:
# their weights grow, and with them the rounding error and the demand on the smoothness of the integrand.
END_ORDER = 5


@dataclass(frozen=True)
class Quadrature:
    """Nodes and weights of a two-dimensional integral: ∫ g d²x ≈ Σ_ji weights[j, i] g(x[i], y[j]).

    Parameters
    ----------
    x, y
        Node coordinates in metres, shapes [columns] and [rows].
    weights
        In m², shape [rows, columns]; zero outside the pupil and its end correction's few samples.
    """

    x: torch.Tensor
    y: torch.Tensor
    weights: torch.Tensor

    def rho_squared(self) -> torch.Tensor:
        """Squared distance of every node from the axis, in m², shape [rows, columns]."""
        return self.x[None, :] ** 2 + self.y[:, None] ** 2


def disc_quadrature(
    radius: float, columns: int, rows: int, order: int = END_ORDER, *, step: float | None = None
) -> Quadrature:
    """Quadrature, float64 on the CPU, of a smooth function over the disc of `radius` metres.

    Parameters
    ----------
    radius
        In metres.
    columns
        Samples along x; they are equally spaced over the diameter.
    rows
        Samples along y, at r cos(jπ/(rows+1)).
    order
        Degree of the end correction.
    step
        Between columns, in metres, in place of their number: as many as cover the diameter.

    Notes
    -----
    The integrand must also be smooth a few samples beyond the edge, where the correction reads it. The end correction
    is the Euler-Maclaurin formula with an end at the fraction τ of a step past the last sample m, ∫^{m+τ} g = Σ_{i≤m}
    g_i + Σ_k b_k g_{m-k}, with b fixed by exactness for 1, x … x^order, the moments of the infinite sums taken by zeta
    regularisation (Lyness and Ninham, Math. Comp. 21, 162 (1967)).
    """
    found = DiscRows(radius, columns, rows, order, step=step)
    return Quadrature(found.x, found.y, found.weights(slice(0, rows)))


class DiscRows:
    """The same quadrature, with weights computed for some rows at a time, because a large pupil's exceed the caches.

    Parameters as for `disc_quadrature`; `device` is that of the tensors.
    """

    def __init__(
        self,
        radius: float,
        columns: int,
        rows: int,
        order: int = END_ORDER,
        device: torch.device | str = "cpu",
        *,
        step: float | None = None,
    ) -> None:
        if step is not None:
            columns = math.ceil(2 * radius / step)
        self._step, self._order, self._columns = step or 2 * radius / columns, order, columns
        x = np.asarray((np.arange(columns) - (columns - 1) / 2) * self._step, np.float64)
        angle = math.pi * np.arange(1, rows + 1) / (rows + 1)
        self.x = torch.from_numpy(x).to(device)
        self.y = torch.from_numpy(radius * np.cos(angle)).to(device)
        ends = radius * np.sin(angle)
        last, corrections = _end_corrections(ends, x, self._step, order)
        row_weight = math.pi / (rows + 1) * radius * np.sin(angle) * self._step
        self._last, self._corrections, self._row_weight = (
            torch.from_numpy(one).to(device) for one in (last, corrections, row_weight)
        )
        self._index = torch.arange(columns, device=device)
        # The last sample of each row of the upper half, from the top down: chords grow.
        self._reach = [int(one) for one in last[: (rows + 1) // 2]]

    def spanned(self, rows: slice) -> slice:
        """The columns that hold all weights of some rows of the upper half, and so of their partners."""
        last: int = self._reach[int(rows.stop) - 1]
        first = self._columns - 1 - last
        return slice(max(0, min(first, last - self._order)), max(last, first + self._order) + 1)

    def weights(self, rows: slice, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Weights of some rows in m², [rows, columns]."""
        last = self._last[rows, None]
        first = self._columns - 1 - last
        inside = ((self._index >= first) & (self._index <= last)).to(dtype)
        # Where the corrections of a short chord's two ends overlap they add, like both sides' sums.
        inside -= ((self._index < first) & (self._index > last)).to(dtype)
        steps = torch.arange(self._order + 1, device=last.device)
        corrections = self._corrections[rows].to(dtype)
        inside.scatter_add_(1, last - steps, corrections)
        inside.scatter_add_(1, first + steps, corrections)
        return inside.mul_(self._row_weight[rows, None].to(dtype))


def _end_corrections(
    ends: npt.NDArray[np.float64], x: npt.NDArray[np.float64], step: float, order: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]:
    """The last sample before each end, [ends], and what to add to it and to those before it, [ends, order + 1]."""
    place = (ends - x[0]) / step
    last = np.clip(np.rint(place), order, len(x) - 1).astype(np.int64)
    tau = (place - last)[:, None]
    power = np.arange(order + 1)
    moments = tau ** (power + 1) / (power + 1) - (-1.0) ** power * _zeta_at_minus(order) - (power == 0)
    vandermonde = (-power[None, :].astype(float)) ** power[:, None]
    corrections: npt.NDArray[np.float64] = np.linalg.solve(vandermonde, moments.T).T
    return last, corrections


@cache
def _zeta_at_minus(order: int) -> npt.NDArray[np.float64]:
    """Riemann's ζ(-q) for q = 0 … order."""
    numbers = np.asarray(bernoulli(order + 1), dtype=float)
    # SciPy's B_1 is -1/2; ζ(0) = -1/2 needs B_1 = +1/2 in ζ(-q) = -B_{q+1}/(q+1).
    numbers[1] = 0.5
    return -numbers[1:] / np.arange(1, order + 2)
