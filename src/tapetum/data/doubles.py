"""Duplicate frames of a dataset: identical pixels, or copies of one exposure."""

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
"""Frames are near duplicates when their 256-bit fingerprints differ in at most this many bits.

The fingerprint says which of two neighbouring cells of a 16 x 17 mosaic is brighter. In dark areas noise decides that,
so two exposures of one scene differ in some hundred bits; near duplicates are copies of one exposure, compressed,
shifted by some counts, or scaled. Only noiseless images can be near duplicates by their RR alone.
"""

CELLS = 16
"""Rows of the fingerprint's mosaic, and comparisons in each."""

# A limit above the number of frames, to code distance and number in one integer; and pairs compared at once.
_FRAMES = 1 << 40
_FAR = (NEAR_BITS + 1) * _FRAMES
_AT_ONCE = 1 << 18
# Measured time of comparing a pair that shares a part, over that of a pair in a matrix product.
_DEARER = 4
# Pairs that a summary lists.
_PAIRS_KEPT = 20


@dataclass(frozen=True)
class Doubles:
    """Number of repeated frames, number of these across the split, and the first pairs (earlier, later)."""

    frames: int
    across_split: int
    pairs: tuple[tuple[int, int], ...]


def fingerprint(image: NDArray[np.generic]) -> NDArray[np.bool_]:
    """Return the 256-bit fingerprint of a finite image [H, W]; see `NEAR_BITS`."""
    mosaic = cv2.resize(image.astype(np.float32), (CELLS + 1, CELLS), interpolation=cv2.INTER_AREA)
    return (mosaic[:, 1:] > mosaic[:, :-1]).ravel()


def exact_pairs(digests: NDArray[np.uint8], split: NDArray[np.integer]) -> list[tuple[int, int]]:
    """Return (first, later) for every frame with an earlier digest [N, B], preferring a first of the other part."""
    seen: dict[bytes, dict[int, int]] = {}
    pairs: list[tuple[int, int]] = []
    for n, (found, part) in enumerate(zip(digests, split.tolist(), strict=True)):
        firsts = seen.setdefault(found.tobytes(), {})
        if firsts:
            pairs.append((next((f for p, f in firsts.items() if p != part), min(firsts.values())), n))
        firsts.setdefault(part, n)
    return pairs


def near_pairs(prints: NDArray[np.bool_], wanted: NDArray[np.bool_], progress: Progress) -> Iterator[tuple[int, int]]:
    """Yield (nearest earlier, later) for every wanted frame whose fingerprint is near an earlier one's.

    Fingerprints that differ in at most `NEAR_BITS` bits agree in one of `NEAR_BITS` + 1 parts (multi-index hashing:
    Norouzi, Punjani and Fleet, CVPR 2012), so only frames that share a part are compared. Where too many do, all pairs
    are compared by matrix products.
    """
    frames = np.flatnonzero(wanted)
    bits = prints[frames]
    # Every 17th bit, because neighbouring cells of the mosaic are correlated.
    parts = [_numbered(bits[:, part :: NEAR_BITS + 1]) for part in range(NEAR_BITS + 1)]
    shared = sum(int((np.unique(part, return_counts=True)[1].astype(np.int64) ** 2).sum()) for part in parts)
    few = _DEARER * shared < len(frames) ** 2
    nearest = _near_by_parts(bits, parts, progress) if few else _near_of_all(bits, progress)
    for n in np.flatnonzero(nearest < _FAR).tolist():
        yield int(frames[nearest[n] % _FRAMES]), int(frames[n])


def _numbered(bits: NDArray[np.bool_]) -> NDArray[np.int64]:
    return bits @ (1 << np.arange(bits.shape[1], dtype=np.int64))


def _near_by_parts(bits: NDArray[np.bool_], parts: list[NDArray[np.int64]], progress: Progress) -> NDArray[np.int64]:
    """Return each frame's nearest earlier one that shares a part, as `_FRAMES` times the distance plus its number."""
    packed = np.packbits(bits, axis=1).view(np.uint64)
    nearest = np.full(len(bits), _FAR, dtype=np.int64)
    for part in progress(parts, "comparing them", total=len(parts)):
        order = np.argsort(part, kind="stable")
        key, first, lag = part[order], np.arange(len(part)), 0
        while len(first):
            lag += 1
            first = first[first + lag < len(key)]
            first = first[key[first] == key[first + lag]]
            for some in np.array_split(first, -(-len(first) // _AT_ONCE) or 1):
                earlier, later = order[some], order[some + lag]
                apart = np.bitwise_count(packed[earlier] ^ packed[later]).sum(axis=1, dtype=np.int64)
                near = apart <= NEAR_BITS
                np.minimum.at(nearest, later[near], apart[near] * _FRAMES + earlier[near])
    return nearest


def _near_of_all(bits: NDArray[np.bool_], progress: Progress) -> NDArray[np.int64]:
    """Return the same among all earlier frames, by matrix products."""
    signs = np.where(bits, np.float32(1), np.float32(-1))
    nearest = np.full(len(bits), _FAR, dtype=np.int64)
    step = 512
    for start in progress(range(0, len(signs), step), "comparing them", total=-(-len(signs) // step)):
        later = slice(start, min(start + step, len(signs)))
        # Equal bits add 1 to the product, others take 1 away.
        apart = (signs.shape[1] - signs[later] @ signs[: later.stop].T) / 2
        apart[np.arange(later.stop)[None, :] >= np.arange(start, later.stop)[:, None]] = np.inf
        least, best = apart.min(axis=1), apart.argmin(axis=1)
        near = least <= NEAR_BITS
        nearest[later][near] = least[near].astype(np.int64) * _FRAMES + best[near]
    return nearest


def summed_up(pairs: list[tuple[int, int]], split: NDArray[np.integer]) -> Doubles:
    """Return the number of pairs, of those across the split, and the first pairs."""
    across = sum({int(split[a]), int(split[b])} == {TRAIN, TEST} for a, b in pairs)
    return Doubles(len(pairs), across, tuple(pairs[:_PAIRS_KEPT]))
