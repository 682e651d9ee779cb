"""Mean error against anything known of the frames, with bars that know that frames follow each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError

__all__ = ["Binned", "binned_errors"]

# As many distinct values as this get a point each, instead of bins.
_FEW = 12


@dataclass(frozen=True)
class Binned:
    """Mean of an error in bins of something else.

    Parameters
    ----------
    x
        [B] median of that in each bin.
    count
        [B] frames.
    mean
        [B] mean error.
    low, high
        [B] ends of its bootstrap interval of 95 %.
    """

    x: NDArray[np.float64]
    count: NDArray[np.int64]
    mean: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def binned_errors(
    x: ArrayLike, error: ArrayLike, *, bins: int = 8, block: int = 15, repeats: int = 500, seed: int = 0
) -> Binned:
    """Average an error in bins that hold equal numbers of frames; few distinct values get a point each.

    Parameters
    ----------
    x
        [N], in the order of filming.
    error
        [N] absolute errors.
    bins
        Of equal numbers of frames.
    block
        Neighbouring frames drawn together in the bootstrap: 15 are one second of the paper's videos.
    repeats
        Bootstrap samples.
    seed
        Of the bootstrap.

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
    place = np.searchsorted(edges, at, side="right")
    used, place = np.unique(place, return_inverse=True)
    blocks = -(-len(at) // block)
    total, count = np.zeros((blocks, len(used))), np.zeros((blocks, len(used)))
    np.add.at(total, (np.arange(len(at)) // block, place), off)
    np.add.at(count, (np.arange(len(at)) // block, place), 1)
    draws = np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1 / blocks), size=repeats)
    drawn = draws @ count
    means = np.divide(draws @ total, drawn, out=np.full(drawn.shape, np.nan), where=drawn > 0)
    # A bin that a sample missed says nothing about that bin; some sample has each.
    means[:1] = np.where(np.isnan(means).all(axis=0), total.sum(axis=0) / count.sum(axis=0), means[:1])
    return Binned(
        np.array([np.median(at[place == k]) for k in range(len(used))]),
        count.sum(axis=0).astype(np.int64),
        total.sum(axis=0) / count.sum(axis=0),
        np.nanquantile(means, 0.025, axis=0),
        np.nanquantile(means, 0.975, axis=0),
    )
