"""How well tracks follow the truth: HOTA (Luiten et al., IJCV 129, 548 (2021)), IDF1 (Ristani et al., 2016) and MOTA
(Bernardin and Stiefelhagen, 2008), for points instead of boxes.

Two points are as alike as ``1 - distance / reach``, at least 0: half the reach apart is the usual threshold of 0.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from tapetum.errors import InputError

__all__ = ["TrackScores", "score_tracks"]

Array = NDArray[np.float64]
Numbered: TypeAlias = tuple[ArrayLike, ArrayLike]

_ALPHAS = np.arange(0.05, 0.99, 0.05)
_HALF = 0.5


@dataclass(frozen=True)
class TrackScores:
    """Shares from 0 to 1 (MOTA may be negative) and counts.

    Parameters
    ----------
    hota, deta, assa
        Means over thresholds of likeness from 0.05 to 0.95: of the geometric mean of detection and association, and of
        each.
    idf1
        Of frames in which each true target bears the one number that suits it best.
    mota
        1 less misses, false places and changes of number, over true places.
    changes
        How often a true target got another number than it last had.
    missed, false
        True places without a track, and tracks without a true place.
    """

    hota: float
    deta: float
    assa: float
    idf1: float
    mota: float
    changes: int
    missed: int
    false: int


def score_tracks(truth: Sequence[Numbered], tracks: Sequence[Numbered], *, reach: float) -> TrackScores:
    """Score tracks against the truth.

    Parameters
    ----------
    truth, tracks
        A pair a frame: the numbers [N] of what is there, and the places [N, 2] in pixels.
    reach
        Distance in pixels at which a place has nothing to do with another any more; half of it counts as found.

    Raises
    ------
    InputError
        When the two differ in frames, a number stands twice in a frame, or the reach is not positive.

    Examples
    --------
    >>> there = [([1, 2], [[0, 0], [50, 0]])] * 4
    >>> score_tracks(there, [([8, 9], [[0, 0], [50, 0]])] * 2 + [([9, 8], [[0, 0], [50, 0]])] * 2, reach=10).changes
    2
    """
    if len(truth) != len(tracks):
        raise InputError(f"{len(truth)} frames of truth and {len(tracks)} of tracks", where="tracks")
    if not reach > 0:
        raise InputError(f"must be positive, is {reach}", where="reach")
    true, true_names = _indexed(truth, "truth")
    ours, our_names = _indexed(tracks, "tracks")
    alike = [
        np.maximum(0, 1 - np.linalg.norm(a[1][:, None] - b[1][None], axis=2) / reach)
        for a, b in zip(true, ours, strict=True)
    ]
    there, said = _frames_of(true, true_names), _frames_of(ours, our_names)
    numbers = [(a[0], b[0]) for a, b in zip(true, ours, strict=True)]
    hota, deta, assa = _hota(numbers, alike, there, said)
    changes, missed, false = _clear(numbers, alike, true_names)
    total = int(there.sum())
    return TrackScores(
        hota=hota,
        deta=deta,
        assa=assa,
        idf1=_idf1(numbers, alike, there, said),
        mota=1 - (missed + false + changes) / max(1, total),
        changes=changes,
        missed=missed,
        false=false,
    )


Numbers: TypeAlias = Sequence[tuple[NDArray[np.int64], NDArray[np.int64]]]


def _indexed(frames: Sequence[Numbered], where: str) -> tuple[list[tuple[NDArray[np.int64], Array]], int]:
    """The frames with numbers from 0 on, and how many numbers there are."""
    known: dict[int, int] = {}
    found: list[tuple[NDArray[np.int64], Array]] = []
    for names, places in frames:
        own = [known.setdefault(int(name), len(known)) for name in np.asarray(names).ravel()]
        if len(set(own)) < len(own):
            raise InputError("a number stands twice in a frame", where=where)
        found.append((np.array(own, dtype=np.int64), np.asarray(places, dtype=np.float64).reshape(len(own), 2)))
    return found, len(known)


def _frames_of(frames: Sequence[tuple[NDArray[np.int64], Array]], names: int) -> Array:
    """In how many frames each number stands, [names]."""
    every = np.concatenate([np.empty(0, np.int64), *(own for own, _ in frames)])
    return np.bincount(every, minlength=names).astype(np.float64)


def _hota(numbers: Numbers, alike: Sequence[Array], there: Array, said: Array) -> tuple[float, float, float]:
    shared = np.zeros((len(there), len(said)))
    for (a, b), likeness in zip(numbers, alike, strict=True):
        both = likeness.sum(1, keepdims=True) + likeness.sum(0, keepdims=True) - likeness
        shared[np.ix_(a, b)] += np.divide(likeness, both, out=np.zeros_like(likeness), where=both > 0)
    # How well whole tracks fit decides which pairs meet in a frame.
    fitting = shared / np.maximum(there[:, None] + said[None] - shared, 1e-9)
    hits = np.zeros((len(_ALPHAS), len(there), len(said)))
    for (a, b), likeness in zip(numbers, alike, strict=True):
        one, other = linear_sum_assignment(-fitting[np.ix_(a, b)] * likeness)
        over = likeness[one, other][None] >= _ALPHAS[:, None] - 1e-9
        # A pair of numbers stands once in a frame.
        hits[:, a[one], b[other]] += over
    found = hits.sum((1, 2))
    deta = found / np.maximum(there.sum() + said.sum() - found, 1)
    pairs = hits / np.maximum(there[None, :, None] + said[None, None] - hits, 1)
    assa = (hits * pairs).sum((1, 2)) / np.maximum(found, 1)
    return float(np.sqrt(deta * assa).mean()), float(deta.mean()), float(assa.mean())


def _idf1(numbers: Numbers, alike: Sequence[Array], there: Array, said: Array) -> float:
    together = np.zeros((len(there), len(said)))
    for (a, b), likeness in zip(numbers, alike, strict=True):
        together[np.ix_(a, b)] += likeness >= _HALF
    one, other = linear_sum_assignment(-together)
    return float(2 * together[one, other].sum() / max(1, there.sum() + said.sum()))


def _clear(numbers: Numbers, alike: Sequence[Array], names: int) -> tuple[int, int, int]:
    """Changes of number, misses and false places; who was together stays together where the threshold allows."""
    latest, before = np.full(names, -1), np.full(names, -1)
    changes = missed = false = 0
    for (a, b), likeness in zip(numbers, alike, strict=True):
        worth = np.where(likeness >= _HALF, likeness + 1000.0 * (before[a][:, None] == b[None]), 0)
        one, other = linear_sum_assignment(-worth)
        kept = worth[one, other] > 0
        one, other = one[kept], other[kept]
        changes += int(((latest[a[one]] >= 0) & (latest[a[one]] != b[other])).sum())
        latest[a[one]] = b[other]
        # A frame without targets or tracks separates nobody (as in TrackEval).
        if len(a) and len(b):
            before[:] = -1
        before[a[one]] = b[other]
        missed, false = missed + len(a) - len(one), false + len(b) - len(one)
    return changes, missed, false
