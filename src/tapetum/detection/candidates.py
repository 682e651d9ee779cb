"""Small bright places of a frame or of a difference of frames, at every size that a retro-reflection can have.

A screen first: a difference of box means, in the frame's own type, at every octave; the highest answer of each block of
pixels is compared with those of the blocks around it and, in a difference, with what an error of the registration would
make of the dark frame's own edges there. It is cheap, and only the highest places are cut out of the frames. On these
patches a difference of Gaussians answers a spot of its own size and neither slopes nor wide steps.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["HALF", "SIGMAS", "Layer", "Octave", "cut_out", "difference_of_gaussians", "octaves", "patches"]

Array = NDArray[np.float32]

SIGMAS = (0.8, 1.13, 1.6)
"""Standard deviations of the inner Gaussian within an octave, in its pixels."""
HALF = 20
"""Half the side of the patches about a candidate, in pixels of its octave."""
_RATIO = 1.6
# Beyond the patches, so that filters need not guess what lies there; half the side of the wide Gaussian's kernel.
_MARGIN = 8
_LARGE = 10
_QUANTUM = 0.3
# What a registration leaves of an edge: a quarter of its height, a pixel away.
_LEFT_OF_EDGES = 0.25
_LEAST = 1.5
_BLOCK = 8
_ALONE = 3.0
# Blocks around one with whose answers its own is compared: 7 x 7 of them, 56 pixels.
_AROUND = 7
# The highest of 64 answers to white noise stands 2.3 standard deviations high.
_HIGHEST_OF_NOISE = 2.3
# The difference of box means that screens answers a glint by about so much of what a difference of Gaussians does.
_SCREENED = 4


@dataclass(frozen=True)
class Layer:
    """What is searched at one octave, uint8 or float32.

    Parameters
    ----------
    step
        Pixels of the frame in one of the octave.
    difference, lit, dark
        [h, w] lit minus dark, or lit itself; the lit frame; and the registered dark frame where there is one.
    """

    step: int
    difference: NDArray
    lit: NDArray
    dark: NDArray | None

    def halved(self) -> Layer:
        """The next octave."""
        lit = _halved(self.lit)
        difference = lit if self.difference is self.lit else _halved(self.difference)
        return Layer(2 * self.step, difference, lit, None if self.dark is None else _halved(self.dark))


@dataclass(frozen=True)
class Octave:
    """Candidates of one octave, N of them, and the patches [N, 2 HALF + 1, 2 HALF + 1] about them.

    Parameters
    ----------
    step
        Pixels of the frame in one of the octave.
    x, y
        [N] whole pixels of the octave.
    shape
        Rows and columns of the octave.
    height
        [N] height over the spread of its surroundings.
    size
        [N] which of `SIGMAS`.
    difference, lit, dark
        What was searched, the lit frame, and the dark frame where there is one.
    answer, lit_answer, dark_answer
        What the difference of Gaussians of each candidate's size makes of them.
    """

    step: int
    x: NDArray[np.int64]
    y: NDArray[np.int64]
    shape: tuple[int, int]
    height: Array
    size: NDArray[np.int64]
    difference: Array
    lit: Array
    dark: Array | None
    answer: Array
    lit_answer: Array
    dark_answer: Array | None


def difference_of_gaussians(image: Array, sigma: float) -> Array:
    """Gaussian of `sigma` minus one 1.6 times as wide, [H, W]."""
    narrow, wide = (cv2.GaussianBlur(image, (0, 0), s) for s in (sigma, _RATIO * sigma))
    return np.asarray(cv2.subtract(narrow, wide), dtype=np.float32)


def patches(image: NDArray, x: NDArray[np.int64], y: NDArray[np.int64], half: int) -> Array:
    """Squares of 2·half + 1 pixels about places of an image [H, W]: [N, 2·half + 1, 2·half + 1]; edges are mirrored."""
    height, width = image.shape
    inside = (half <= y) & (y < height - half) & (half <= x) & (x < width - half) & (half >= _LARGE)
    found = np.empty((len(x), 2 * half + 1, 2 * half + 1), np.float32)
    # Large ones are copied one by one, which is faster than by the numbers of their pixels.
    for n in np.flatnonzero(inside).tolist():
        column, row = int(x[n]), int(y[n])
        found[n] = image[row - half : row + half + 1, column - half : column + half + 1]
    if not inside.all():
        step = np.arange(-half, half + 1)
        rows, columns = (_mirrored(at[~inside, None] + step, end) for at, end in ((y, height), (x, width)))
        found[~inside] = image[rows[:, :, None], columns[:, None, :]]
    return found


def octaves(
    layer: Layer, largest: float, most: int
) -> Iterator[tuple[Layer, NDArray[np.int64], NDArray[np.int64], Array]]:
    """Screen a frame octave by octave, from the smallest spots up.

    Parameters
    ----------
    layer
        The first octave.
    largest
        Largest diameter of a spot, in pixels of it.
    most
        About how many places of an octave are wanted; the highest are kept.

    Yields
    ------
    layer, x, y, height
        The octave and, [N] each, whole pixels of it and the height over what the screen answers around.
    """
    while min(layer.lit.shape) >= 16 and 4 * SIGMAS[0] * layer.step <= largest:
        yield layer, *_screened(layer, most)
        layer = layer.halved()


def cut_out(layer: Layer, x: NDArray[np.int64], y: NDArray[np.int64]) -> Octave:
    """Cut the patches about places of an octave, and find which size answers each place best."""
    half = HALF + _MARGIN
    lit = patches(layer.lit, x, y, half)
    difference = lit if layer.difference is layer.lit else patches(layer.difference, x, y, half)
    dark = None if layer.dark is None else patches(layer.dark, x, y, half)
    inner = slice(_MARGIN, -_MARGIN)
    kernels = _kernels()
    reach = kernels.shape[1] // 2
    near = slice(half - reach, half + reach + 1)
    size = np.argmax(difference[:, near, near].reshape(len(x), -1) @ kernels.reshape(len(SIGMAS), -1).T, axis=1)
    answer = _answers(difference, size)[:, inner, inner]
    lit_answer = answer if difference is lit else _answers(lit, size)[:, inner, inner]
    dark_answer = None if dark is None else _answers(dark, size)[:, inner, inner]
    return Octave(
        layer.step,
        x,
        y,
        (layer.lit.shape[0], layer.lit.shape[1]),
        _heights(answer, dark_answer),
        size,
        difference[:, inner, inner],
        lit[:, inner, inner],
        None if dark is None else dark[:, inner, inner],
        answer,
        lit_answer,
        dark_answer,
    )


def _heights(answer: Array, of_dark: Array | None) -> Array:
    """Height of each patch's middle over the spread of its surroundings, [N]."""
    size = np.abs(answer)
    # What stands far out of the surroundings counts little: the place itself, or another camera.
    cut = 3 * np.median(size[:, ::3, ::3], axis=(1, 2)) + 1e-6
    spread = 1.25 * np.minimum(size, cut[:, None, None]).mean((1, 2))
    variance = spread**2 + _QUANTUM**2
    if of_dark is not None:
        near = slice(HALF - 2, HALF + 3)
        variance += (_LEFT_OF_EDGES * np.abs(of_dark[:, near, near]).max((1, 2))) ** 2
    return np.maximum(answer[:, HALF, HALF] / np.sqrt(variance), 1e-3).astype(np.float32)


def _answers(stack: Array, size: NDArray[np.int64]) -> Array:
    """Difference of Gaussians of each patch at its own size: patches below one another are one image."""
    found = np.empty_like(stack)
    for n, sigma in enumerate(SIGMAS):
        if (mine := np.flatnonzero(size == n)).size:
            chosen = stack[mine]
            found[mine] = difference_of_gaussians(chosen.reshape(-1, stack.shape[2]), sigma).reshape(chosen.shape)
    return found


@functools.cache
def _kernels() -> Array:
    """Differences of Gaussians as kernels, [sizes, side, side]."""
    points = np.zeros((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.float32)
    points[_MARGIN, _MARGIN] = 1
    return np.stack([difference_of_gaussians(points, sigma) for sigma in SIGMAS])


def _screened(layer: Layer, most: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    answer = _contrast(layer.difference)
    highest = _block_maxima(answer).astype(np.float32)
    cut = 3 * float(np.median(highest)) + 1
    around = cv2.blur(np.minimum(highest, cut), (_AROUND, _AROUND)) / _HIGHEST_OF_NOISE
    height = highest / np.sqrt(around**2 + _QUANTUM**2)
    number = np.flatnonzero(height.ravel() > _LEAST)
    if len(number) > (limit := _SCREENED * most):
        number = number[np.argpartition(-height.ravel()[number], limit)[:limit]]
    row, column = np.divmod(number, height.shape[1])
    x, y = _highest_of_block(answer, row, column)
    own = answer[y, x].astype(np.float32)
    top = own >= patches(answer, x, y, 2).max((1, 2))
    x, y, row, column = (one[top] for one in (x, y, row, column))
    own = own[top]
    variance = around[row, column] ** 2 + _QUANTUM**2
    if layer.dark is not None and len(x):
        variance += (_LEFT_OF_EDGES * _edges(layer.dark, x, y)) ** 2
    # In one frame alone, a place that stands alone is worth a closer look more than one of many.
    ring = np.ones((5, 5), np.uint8)
    ring[1:4, 1:4] = 0
    others = np.maximum(np.asarray(cv2.dilate(highest, ring))[row, column], 0.5)
    heights = own / np.sqrt(variance)
    if layer.dark is None:
        heights = heights * np.clip(own / others, 1 / _ALONE, _ALONE)
    kept = np.argsort(-heights, kind="stable")[:most]
    return x[kept], y[kept], np.asarray(heights[kept], dtype=np.float32)


def _contrast(image: NDArray) -> NDArray:
    """How far a mean over 3 x 3 pixels stands above one over some 7 x 7, [H, W], in the image's own type; 0 below."""
    narrow = cv2.blur(image, (3, 3))
    answer = np.asarray(cv2.subtract(narrow, cv2.blur(narrow, (5, 5))))
    return answer if answer.dtype == np.uint8 else np.maximum(answer, 0)


def _edges(dark: NDArray, x: NDArray[np.int64], y: NDArray[np.int64]) -> Array:
    """Largest contrast, of either sign, of the dark frame within two pixels of places, [N]."""
    near = patches(dark, x, y, 5)
    shape = near.shape
    near = near.reshape(-1, shape[2])
    narrow = cv2.blur(near, (3, 3))
    contrast = cv2.absdiff(narrow, cv2.blur(narrow, (5, 5))).reshape(shape)
    return contrast[:, 3:-3, 3:-3].max((1, 2))


def _block_maxima(image: NDArray) -> NDArray:
    """Largest value of each block, [ceil(H / 8), ceil(W / 8)]."""
    height, width = image.shape
    rows, columns = -(-height // _BLOCK), -(-width // _BLOCK)
    if (rows * _BLOCK, columns * _BLOCK) != image.shape:
        image = np.asarray(
            cv2.copyMakeBorder(
                image, 0, rows * _BLOCK - height, 0, columns * _BLOCK - width, cv2.BORDER_CONSTANT, value=[0]
            )
        )
    # Maxima over rows of memory are fast: over the columns they are taken of the transposed.
    tall = image.reshape(rows, _BLOCK, -1).max(1)
    return np.ascontiguousarray(tall.T).reshape(columns, _BLOCK, rows).max(1).T


def _highest_of_block(
    image: NDArray, row: NDArray[np.int64], column: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where the largest value of blocks lies, x and y, [N] each."""
    height, width = image.shape
    step = np.arange(_BLOCK)
    y = np.minimum(row[:, None, None] * _BLOCK + step[:, None], height - 1)
    x = np.minimum(column[:, None, None] * _BLOCK + step, width - 1)
    at = image[y, x].reshape(len(row), _BLOCK * _BLOCK).argmax(1)
    return np.minimum(column * _BLOCK + at % _BLOCK, width - 1), np.minimum(row * _BLOCK + at // _BLOCK, height - 1)


def _mirrored(at: NDArray[np.int64], end: int) -> NDArray[np.int64]:
    """Numbers of pixels, mirrored at 0 and `end` - 1."""
    period = max(1, 2 * (end - 1))
    folded = np.abs(at) % period
    return np.minimum(folded, period - folded)


def _halved(image: NDArray) -> NDArray:
    size = max(1, image.shape[1] // 2), max(1, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
