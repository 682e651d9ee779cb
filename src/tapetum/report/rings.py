"""Error against distance from the centre of the field, with bars that know that frames follow each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.report.metrics import matched

__all__ = ["ErrorByDistance", "error_by_distance"]


@dataclass(frozen=True)
class ErrorByDistance:
    """MAE in rings of the field around its centre (the paper's Fig. 10).

    Parameters
    ----------
    edges
        [B + 1] distances from the centre, fractions of the field.
    count
        [B] frames.
    mae
        [B] mean over both axes, fractions of the field; NaN where there is no frame.
    low, high
        [B] ends of the bootstrap interval; NaN where there is no frame.
    level
        Probability the interval is meant to hold.
    """

    edges: NDArray[np.float64]
    count: NDArray[np.int64]
    mae: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    level: float

    @property
    def centre(self) -> NDArray[np.float64]:
        """[B] middle of each ring."""
        return 0.5 * (self.edges[1:] + self.edges[:-1])


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

    Frames of a video resemble their neighbours, so whole blocks of them are resampled: bars from single
    frames would be too short.

    Parameters
    ----------
    truth, predicted
        [N, 2] gaze (x, y) in the order of filming, fractions of the field of view.
    edges
        [B + 1] edges of the rings, rising; ten equal ones from 0 to the largest distance when None.
    block
        Frames a block: 15 is one second of the paper's videos.
    repeats
        Bootstrap samples.
    level
        Probability of the interval.
    seed
        Of the bootstrap.

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
    bins = len(rings) - 1
    which = np.searchsorted(rings, distance, side="right") - 1
    inside = (which >= 0) & (which < bins)
    blocks = int(np.ceil(len(a) / block))
    total = np.zeros((blocks, bins))
    count = np.zeros((blocks, bins))
    where = (np.arange(len(a))[inside] // block, which[inside])
    np.add.at(total, where, error[inside])
    np.add.at(count, where, 1)
    draws = np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1 / blocks), size=repeats)
    means = _ratio(draws @ total, draws @ count)
    tail = (1 - level) / 2
    return ErrorByDistance(
        edges=rings,
        count=count.sum(axis=0).astype(np.int64),
        mae=_ratio(total.sum(axis=0), count.sum(axis=0)),
        low=_quantile(means, tail),
        high=_quantile(means, 1 - tail),
        level=level,
    )


def _ratio(total: NDArray[np.float64], count: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.divide(total, count, out=np.full(np.shape(total), np.nan), where=count > 0)


def _quantile(means: NDArray[np.float64], q: float) -> NDArray[np.float64]:
    # A ring that a bootstrap sample missed says nothing about that ring, hence has no part in its quantile.
    kept = (column[np.isfinite(column)] for column in means.T)
    return np.array([np.quantile(column, q) if len(column) else np.nan for column in kept])
