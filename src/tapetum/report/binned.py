"""Mean errors in rings of the field or in bins of another quantity, with intervals from blocks of frames.

Neighbouring video frames are correlated, so resampling single frames would give intervals that are too short.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.report.metrics import matched

__all__ = ["Binned", "ErrorByDistance", "binned_errors", "error_by_distance"]

Array = NDArray[np.float64]

# Up to this many distinct values get a point each instead of bins.
_FEW = 12


@dataclass(frozen=True)
class ErrorByDistance:
    """MAE in rings of the field around its centre (the paper's Fig. 10).

    Parameters
    ----------
    edges, count
        [B + 1] distances from the centre, fractions of the field; and [B] frames.
    mae, low, high
        [B] mean over both axes and the ends of its bootstrap interval, fractions of the field; NaN without frames.
    level
        Nominal coverage of the interval.
    """

    edges: Array
    count: NDArray[np.int64]
    mae: Array
    low: Array
    high: Array
    level: float

    @property
    def centre(self) -> Array:
        """[B] middle of each ring."""
        return 0.5 * (self.edges[1:] + self.edges[:-1])


@dataclass(frozen=True)
class Binned:
    """Mean error in bins of another quantity.

    Parameters
    ----------
    x, count
        [B] median of that quantity, and number of frames.
    mean, low, high
        [B] mean error and the ends of its 95 % bootstrap interval.
    """

    x: Array
    count: NDArray[np.int64]
    mean: Array
    low: Array
    high: Array


def error_by_distance(
    truth: ArrayLike,
    predicted: ArrayLike,
    *,
    edges: ArrayLike | None = None,
    block: int = 15,
    repeats: int = 1000,
    level: float = 0.95,
    seed: int = 0,
) -> ErrorByDistance:
    """Average the error in rings by the true distance from the field's centre, with bootstrap intervals.

    Parameters
    ----------
    truth, predicted
        [N, 2] gaze (x, y) in the order of filming, fractions of the field of view.
    edges
        [B + 1] rising edges of the rings; ten equal rings from 0 to the largest distance when None.
    block, repeats, seed
        Bootstrap: consecutive frames drawn together (15 is one second of the paper's videos), resamples, seed.
    level
        Nominal coverage of the interval.

    Raises
    ------
    InputError
        When the shapes are wrong, a value is not finite, or the edges do not rise.
    """
    a, b = matched(truth, predicted, 2)
    distance, error = np.hypot(a[:, 0], a[:, 1]), np.abs(b - a).mean(axis=1)
    if edges is None:
        edges = np.linspace(0.0, max(float(distance.max()), 1e-6) * (1 + 1e-9), 11)
    rings = np.asarray(edges, dtype=np.float64)
    if rings.ndim != 1 or len(rings) < 2 or not (np.diff(rings) > 0).all():
        raise InputError(f"must rise, are {rings.tolist()}", where="edges", remedy="give at least two")
    if block < 1 or repeats < 1 or not 0 < level < 1:
        raise InputError(
            f"block={block}, repeats={repeats}, level={level}", where="bootstrap", remedy="give positive ones"
        )
    which = np.searchsorted(rings, distance, side="right") - 1
    return ErrorByDistance(rings, *_block_means(which, len(rings) - 1, error, block, repeats, level, seed), level)


def binned_errors(
    x: ArrayLike, error: ArrayLike, *, bins: int = 8, block: int = 15, repeats: int = 500, seed: int = 0
) -> Binned:
    """Average an error in bins of equal numbers of frames; few distinct values get a bin each.

    Parameters
    ----------
    x, error
        [N] the quantity that is binned, and absolute errors, both in the order of filming.
    bins
        Number of bins.
    block, repeats, seed
        See `error_by_distance`.

    Raises
    ------
    InputError
        When lengths differ, a value is not finite or there is none.
    """
    at, off = np.asarray(x, dtype=np.float64), np.asarray(error, dtype=np.float64)
    if at.shape != off.shape or at.ndim != 1 or not at.size or not (np.isfinite(at).all() and np.isfinite(off).all()):
        raise InputError(f"expected two finite columns, got {at.shape} and {off.shape}", where="errors in bins")
    levels = np.unique(at)
    edges = levels[1:] if len(levels) <= _FEW else np.quantile(at, np.arange(1, bins) / bins)
    used, place = np.unique(np.searchsorted(edges, at, side="right"), return_inverse=True)
    middle = np.array([np.median(at[place == k]) for k in range(len(used))])
    return Binned(middle, *_block_means(place, len(used), off, block, repeats, 0.95, seed))


def _block_means(
    place: NDArray[np.int64], bins: int, error: Array, block: int, repeats: int, level: float, seed: int
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Return count, mean and interval [B] of the errors [N] in the bins given by `place` [N], others left out."""
    inside = (place >= 0) & (place < bins)
    blocks = -(-len(error) // block)
    total, count = np.zeros((blocks, bins)), np.zeros((blocks, bins))
    where = (np.arange(len(error))[inside] // block, place[inside])
    np.add.at(total, where, error[inside])
    np.add.at(count, where, 1)
    draws = np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1 / blocks), size=repeats)
    drawn, mean = _ratio(draws @ total, draws @ count), _ratio(total.sum(axis=0), count.sum(axis=0))
    # Resamples that miss a bin do not count for it; a bin missed by all resamples gets its mean.
    drawn[0] = np.where(np.isnan(drawn).all(axis=0), mean, drawn[0])
    tail, empty = (1 - level) / 2, np.isnan(mean)
    drawn[:, empty] = 0.0
    ends = np.where(empty, np.nan, np.nanquantile(drawn, [tail, 1 - tail], axis=0))
    return count.sum(axis=0).astype(np.int64), mean, ends[0], ends[1]


def _ratio(total: Array, count: Array) -> Array:
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)
