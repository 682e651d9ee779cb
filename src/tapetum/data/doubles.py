"""Frames of a dataset that are there twice: the very same pixels, or copies of one exposure."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.data.dataset import TEST, TRAIN
from tapetum.progress import Progress

__all__ = ["CELLS", "NEAR_BITS", "Doubles", "digest", "exact_pairs", "fingerprint", "near_pairs", "summed_up"]

NEAR_BITS = 16
"""Frames count as nearly the same when their 256-bit fingerprints differ in at most this many bits.

The fingerprint tells which of two neighbouring cells of a 16 x 17 mosaic is brighter. Where the picture is dark, noise
decides that; so two exposures of one scene differ in some hundred bits, and what is left are copies: the same exposure
saved again, compressed, shifted by some counts, or scaled. Pictures without noise are near by their RR alone.
"""

CELLS = 16
"""Rows of the fingerprint's mosaic, and comparisons in each."""

# Pairs that a summary names, so that a person can look at them.
_PAIRS_KEPT = 20


@dataclass(frozen=True)
class Doubles:
    """Frames that repeat an earlier one: how many, how many across the split, and the first pairs (earlier, later)."""

    frames: int
    across_split: int
    pairs: tuple[tuple[int, int], ...]


def digest(image: NDArray[np.generic]) -> bytes:
    """Return 16 letters that equal images share."""
    return hashlib.blake2b(np.ascontiguousarray(image).data, digest_size=8).hexdigest().encode()


def fingerprint(image: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Return the 256 bits of a finite picture [H, W] that nearly equal pictures nearly share; see `NEAR_BITS`."""
    mosaic = cv2.resize(image.astype(np.float32), (CELLS + 1, CELLS), interpolation=cv2.INTER_AREA)
    return (mosaic[:, 1:] > mosaic[:, :-1]).ravel()


def exact_pairs(digests: NDArray[np.bytes_], split: NDArray[np.integer]) -> list[tuple[int, int]]:
    """Return (first, later) for every frame that equals an earlier one; the other part's first, where there is one."""
    seen: dict[bytes, dict[int, int]] = {}
    pairs: list[tuple[int, int]] = []
    for n, found in enumerate(digests.tolist()):
        firsts = seen.setdefault(found, {})
        part = int(split[n])
        if firsts:
            pairs.append((next((f for p, f in firsts.items() if p != part), min(firsts.values())), n))
        firsts.setdefault(part, n)
    return pairs


def near_pairs(prints: NDArray[np.bool_], wanted: NDArray[np.bool_], progress: Progress) -> Iterator[tuple[int, int]]:
    """Yield (earlier, later) for every wanted frame whose fingerprint is near an earlier one's, nearest first."""
    signs = np.where(prints, np.float32(1), np.float32(-1))
    step = 512
    for start in progress(range(0, len(signs), step), "comparing them", total=-(-len(signs) // step)):
        later = slice(start, min(start + step, len(signs)))
        # Equal bits add 1 to the product, others take 1 away.
        apart = (signs.shape[1] - signs[later] @ signs[: later.stop].T) / 2
        rows, columns = np.arange(start, later.stop)[:, None], np.arange(later.stop)[None, :]
        apart[(columns >= rows) | ~wanted[None, : later.stop]] = np.inf
        nearest = apart.argmin(axis=1)
        for n in np.flatnonzero((apart.min(axis=1) <= NEAR_BITS) & wanted[later]).tolist():
            yield int(nearest[n]), start + n


def summed_up(pairs: list[tuple[int, int]], split: NDArray[np.integer]) -> Doubles:
    """Count pairs, and those that stand on both sides of the split."""
    across = sum({int(split[a]), int(split[b])} == {TRAIN, TEST} for a, b in pairs)
    return Doubles(len(pairs), across, tuple(pairs[:_PAIRS_KEPT]))
