"""Frames of a dataset that are there twice: the very same pixels, or copies of one exposure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.data.dataset import TEST, TRAIN
from tapetum.progress import Progress

__all__ = ["CELLS", "NEAR_BITS", "Doubles", "exact_pairs", "fingerprint", "near_pairs", "summed_up"]

NEAR_BITS = 16
"""Frames count as nearly the same when their 256-bit fingerprints differ in at most this many bits.

The fingerprint tells which of two neighbouring cells of a 16 x 17 mosaic is brighter. In dark areas noise decides that;
so two exposures of one scene differ in some hundred bits, and what is left are copies: the same exposure saved again,
compressed, shifted by some counts, or scaled. Images without noise are near by their RR alone.
"""

CELLS = 16
"""Rows of the fingerprint's mosaic, and comparisons in each."""

# Pairs that a summary names, so that a person can look at them; frames compared with all earlier ones at once.
_PAIRS_KEPT, _STEP = 20, 512


@dataclass(frozen=True)
class Doubles:
    """Frames that repeat an earlier one: how many, how many across the split, and the first pairs (earlier, later)."""

    frames: int
    across_split: int
    pairs: tuple[tuple[int, int], ...]


def fingerprint(image: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Return the 256 bits of a finite image [H, W] that nearly equal images nearly share; see `NEAR_BITS`."""
    mosaic = cv2.resize(image.astype(np.float32), (CELLS + 1, CELLS), interpolation=cv2.INTER_AREA)
    return (mosaic[:, 1:] > mosaic[:, :-1]).ravel()


def exact_pairs(digests: NDArray[np.uint8], split: NDArray[np.integer]) -> list[tuple[int, int]]:
    """Return (first, later) for every frame whose digest [N, B] an earlier one has: the other part's first, if any."""
    seen: dict[bytes, dict[int, int]] = {}
    pairs: list[tuple[int, int]] = []
    for n, (found, part) in enumerate(zip(digests, split.tolist(), strict=True)):
        firsts = seen.setdefault(found.tobytes(), {})
        if firsts:
            pairs.append((next((f for p, f in firsts.items() if p != part), min(firsts.values())), n))
        firsts.setdefault(part, n)
    return pairs


def near_pairs(prints: NDArray[np.bool_], wanted: NDArray[np.bool_], progress: Progress) -> Iterator[tuple[int, int]]:
    """Yield (earlier, later) for every wanted frame whose fingerprint [N, 256] is near an earlier one's, nearest first.

    Every frame is compared with all earlier ones, by matrix products: for a hundred thousand frames that takes a
    fraction of the time in which their images are read.
    """
    frames = np.flatnonzero(wanted)
    signs = np.where(prints[frames], np.float32(1), np.float32(-1))
    for start in progress(range(0, len(signs), _STEP), "comparing them", total=-(-len(signs) // _STEP)):
        later = np.arange(start, min(start + _STEP, len(signs)))
        # Equal bits add 1 to the product, others take 1 away.
        apart = (signs.shape[1] - signs[later] @ signs[: later[-1] + 1].T) / 2
        apart[np.arange(later[-1] + 1) >= later[:, None]] = np.inf
        least, best = apart.min(axis=1), apart.argmin(axis=1)
        for n in np.flatnonzero(least <= NEAR_BITS):
            yield int(frames[best[n]]), int(frames[later[n]])


def summed_up(pairs: list[tuple[int, int]], split: NDArray[np.integer]) -> Doubles:
    """Count pairs, and those that stand on both sides of the split."""
    across = sum({int(split[a]), int(split[b])} == {TRAIN, TEST} for a, b in pairs)
    return Doubles(len(pairs), across, tuple(pairs[:_PAIRS_KEPT]))
