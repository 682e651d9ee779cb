"""Small bright places of a frame or of a difference of frames, at every size that a retro-reflection can have.

A difference of Gaussians answers a spot of its own size and neither slopes nor wide steps. Its height is compared with
what the same filter answers around the place and, in a difference, with what an error of the registration would make of
the dark frame's own edges there. Each octave halves the frame: sizes from one pixel to sixty cost little more than one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["HALF", "SIGMAS", "Octave", "difference_of_gaussians", "octaves", "patches"]

Array = NDArray[np.float32]

SIGMAS = (0.8, 1.13, 1.6)
"""Standard deviations of the inner Gaussian within an octave, in its pixels."""
HALF = 20
"""Half the side of the patches about a candidate, in pixels of its octave."""
_RATIO = 1.6
_NEIGHBOURHOOD = 61
_QUANTUM = 0.3
# What a registration leaves of an edge: a quarter of its height, a pixel away.
_LEFT_OF_EDGES = 0.25
_LEAST = 1.5


@dataclass(frozen=True)
class Octave:
    """Candidates of one octave; N of them.

    Parameters
    ----------
    step
        Pixels of the frame in one of the octave.
    x, y
        [N] whole pixels of the octave.
    height
        [N] height over the spread of its surroundings.
    size
        [N] which of `SIGMAS`.
    difference, lit, dark
        [h, w] what was searched, the lit frame, and the dark frame where there is one, at this octave.
    answers, lit_answers, dark_answers
        [h, w] a size: what the filter made of each.
    """

    step: int
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    height: Array
    size: NDArray[np.int64]
    difference: Array
    lit: Array
    dark: Array | None
    answers: list[Array]
    lit_answers: list[Array]
    dark_answers: list[Array]


def difference_of_gaussians(image: Array, sigma: float) -> Array:
    """Gaussian of `sigma` minus one 1.6 times as wide, [H, W]."""
    narrow, wide = (cv2.GaussianBlur(image, (0, 0), s) for s in (sigma, _RATIO * sigma))
    return np.asarray(cv2.subtract(narrow, wide), dtype=np.float32)


def patches(image: NDArray, x: NDArray[np.int64], y: NDArray[np.int64], half: int) -> NDArray:
    """Squares of 2·half + 1 pixels about places of an image [H, W]: [N, 2·half + 1, 2·half + 1]; edges are mirrored."""
    padded = np.pad(image, half, mode="reflect" if min(image.shape) > half else "edge")
    step = np.arange(2 * half + 1)
    return padded[y[:, None, None] + step[None, :, None], x[:, None, None] + step[None, None, :]]


def octaves(
    difference: Array, lit: Array, dark: Array | None, seen: NDArray[np.bool_] | None, largest: float, most: int
) -> Iterator[Octave]:
    """Find candidates, octave by octave from the smallest spots up.

    Parameters
    ----------
    difference
        [H, W] what is searched: lit minus dark, or the lit frame itself.
    lit, dark
        [H, W] the frames; dark None where there is none.
    seen
        [H, W] where the dark frame shows the place.
    largest
        Largest diameter of a spot, in pixels.
    most
        Most candidates of an octave; the highest are kept.
    """
    step, share = 1, None if seen is None else seen.astype(np.float32)
    while min(difference.shape) >= 16 and 4 * SIGMAS[0] * step <= largest:
        found = _search(difference, lit, dark, share, step, most)
        if found is not None:
            yield found
        difference, lit = _halved(difference), _halved(lit)
        dark, share = None if dark is None else _halved(dark), None if share is None else _halved(share)
        step *= 2


def _search(
    difference: Array, lit: Array, dark: Array | None, share: Array | None, step: int, most: int
) -> Octave | None:
    highest = np.full(difference.shape, -np.inf, np.float32)
    size = np.zeros(difference.shape, np.int64)
    answers: list[Array] = []
    of_lit: list[Array] = []
    of_dark: list[Array] = []
    for n, sigma in enumerate(SIGMAS):
        answer = difference_of_gaussians(difference, sigma)
        variance = _spread(answer) ** 2 + np.float32(_QUANTUM**2)
        if dark is not None:
            of_dark.append(difference_of_gaussians(dark, sigma))
            of_lit.append(difference_of_gaussians(lit, sigma))
            edges = cv2.dilate(np.abs(of_dark[n]), np.ones((3, 3), np.uint8))
            variance += (_LEFT_OF_EDGES * np.asarray(cv2.GaussianBlur(edges, (0, 0), sigma))) ** 2
        height = answer / np.sqrt(variance)
        better = height > highest
        highest[better], size[better] = height[better], n
        answers.append(answer)
    if share is not None:
        highest[share < 0.99] = 0
    top = (highest == cv2.dilate(highest, np.ones((5, 5), np.uint8))) & (highest > _LEAST)
    y, x = np.nonzero(top)
    kept = np.argsort(-highest[y, x], kind="stable")[:most]
    y, x = y[kept], x[kept]
    if not len(y):
        return None
    lit_answers = of_lit or answers
    return Octave(step, x, y, highest[y, x], size[y, x], difference, lit, dark, answers, lit_answers, of_dark)


def _spread(answer: Array) -> Array:
    """Spread of a filter's answer about each pixel; what stands far out of it counts little."""
    size = np.abs(answer)
    # The median of every third pixel is the median of all within a percent, at a ninth of the price.
    cut = 3 * float(np.median(size[::3, ::3])) + 1e-6
    return np.asarray(cv2.blur(np.minimum(size, cut), (_NEIGHBOURHOOD, _NEIGHBOURHOOD))) * np.float32(1.25)


def _halved(image: Array) -> Array:
    size = max(1, image.shape[1] // 2), max(1, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
