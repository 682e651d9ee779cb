"""Chance level of a score: labels moved to other frames in such a way that they stay as smooth in time.

Shifts and permutations are [rounds, N]: the number of the frame whose label frame n gets in a round.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["deals_possible", "dealt_blocks", "dealt_recordings", "shifted", "shifts_possible"]


def shifted(
    recording: NDArray[np.integer],
    order: NDArray[np.floating],
    rounds: int,
    rng: np.random.Generator,
    among: NDArray[np.integer] | None = None,
) -> NDArray[np.int64]:
    """Shift the labels of each recording cyclically by a tenth of it or more.

    With `among` only the labels of these frames move, among themselves.
    """
    chance = np.tile(np.arange(len(recording)), (rounds, 1))
    frames = np.arange(len(recording)) if among is None else among
    for number in np.unique(recording):
        own = frames[recording[frames] == number]
        own = own[np.argsort(order[own], kind="stable")]
        least = max(1, len(own) // 10)
        if len(own) > 2 * least:
            for turn in chance:
                turn[own] = np.roll(own, int(rng.integers(least, len(own) - least)))
    return chance


def shifts_possible(values: NDArray[np.float64], recording: NDArray[np.integer], order: NDArray[np.floating]) -> int:
    """Return how many of those shifts are independent, given that labels [N, C] stay correlated above a half.

    Counts stop at a million.
    """
    count = 1.0
    for number in np.unique(recording):
        own = np.flatnonzero(recording == number)
        series = values[own[np.argsort(order[own], kind="stable")]]
        series = series - series.mean(axis=0)
        power = np.fft.rfft(series, n=2 * len(series), axis=0)
        alike = np.fft.irfft(np.abs(power) ** 2, axis=0)[: len(series)].sum(axis=1)
        if alike[0] > 0:
            below = np.flatnonzero(alike < 0.5 * alike[0])
            count *= len(series) / (below[0] if len(below) else len(series))
    return int(min(count, 1e6))


def dealt_blocks(
    recording: NDArray[np.integer], split: NDArray[np.integer], rounds: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Permute constant labels over fifths of neighbouring frames of each recording and part."""
    chance = np.tile(np.arange(len(recording)), (rounds, 1))
    for part in np.unique(split):
        whole = [np.flatnonzero((recording == number) & (split == part)) for number in np.unique(recording)]
        _deal(chance, [piece for one in whole for piece in np.array_split(one, 5) if len(piece)], rng)
    return chance


def dealt_recordings(
    recording: NDArray[np.integer], group: NDArray[np.integer], rounds: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Permute constant labels over whole recordings within each group."""
    chance = np.tile(np.arange(len(recording)), (rounds, 1))
    for one in np.unique(group):
        _deal(chance, [np.flatnonzero(recording == r) for r in np.unique(recording[group == one])], rng)
    return chance


def _deal(chance: NDArray[np.int64], pieces: list[NDArray[np.int64]], rng: np.random.Generator) -> None:
    for turn in chance:
        for piece, other in zip(pieces, rng.permutation(len(pieces)), strict=True):
            turn[piece] = pieces[other][0]


def deals_possible(classes: NDArray[np.integer], group: NDArray[np.integer]) -> int:
    """Return the number of permutations of `dealt_recordings`, for class and group of each recording, [R] each."""
    count = 1
    for one in np.unique(group):
        sizes = np.unique(classes[group == one], return_counts=True)[1].tolist()
        count *= math.factorial(sum(sizes)) // math.prod(math.factorial(size) for size in sizes)
    return count
