"""Small bright places of a frame or of a difference of frames, at every size that a retro-reflection can have.

First comes a fast screen in the frame's own type: a difference of box means at every octave. The smallest spots are
screened on the highest of each four pixels, so that nothing is filtered at full size. The highest response of each
block of pixels is compared with those of the blocks around it and, in a difference, with the response that an error of
the registration would cause at the dark frame's own edges there. Only the highest places are cut out of the frames as
patches: in a difference those first that stand alone, as edges that are left run on beside a place. On these a
difference of Gaussians responds to a spot of its own size, and neither to slopes nor to wide steps.

Over 400 lines, as the screen and the patches share the octaves' geometry.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from tapetum.detection.registration import Registered

__all__ = [
    "DARK_REACH",
    "HALF",
    "LIT_REACH",
    "SIGMAS",
    "Cut",
    "Layer",
    "Place",
    "cut_out",
    "differences_of_gaussians",
    "layers",
    "patches",
    "screened",
]

Array = NDArray[np.float32]
Whole = NDArray[np.int64]

SIGMAS = (0.8, 1.13, 1.6)
"""Standard deviations of the inner Gaussian within an octave, in its pixels."""
HALF = 20
"""Half the side of the patches about a candidate, in pixels of its octave."""
_RATIO = 1.6
# Beyond the patches, so that filters need not guess what lies there; half the side of the wide Gaussian's kernel.
_MARGIN = 8
# How far from a place the responses to the lit and to the dark frame are used.
LIT_REACH, DARK_REACH = 12, 4
_QUANTUM = 0.3
# What a registration leaves of an edge, as a share of its height: as much as it left of those around, twice over for
# what is worst, and within these bounds. Where the registration is good, a camera beside a window is found; where
# people walk, an edge is expected to leave a quarter of its height.
_LEFT_OF_EDGES = (0.04, 0.25)
_WORST_OF_EDGES = 2.0
_FLAT = 1.0
# How far around a place the screen asks what was left of edges, in pixels of what it screens.
_NEAR_EDGES = 9
_BLOCK = 8
# In a difference, beyond which pixels and up to which one a place is compared with the ring around it; and how much, at
# most, that a place stands alone counts.
_RING = (2.0, 5.3)
_ALONE = 3.0
# Blocks around one with whose responses its own is compared: 7 x 7 of them, 56 pixels.
_AROUND = 7
# The highest of 64 responses to white noise is 2.3 standard deviations high, of 16 highest of four each 1.9.
_HIGHEST_OF_NOISE = {1: 2.3, 2: 1.9}
# Response of the screen to a glint over that of a difference of Gaussians; and how many times as many places of a
# difference are asked whether they stand alone.
_SCREENED, _ASKED = 2, 2
# The last octave of bytes: in the means of 64 pixels and more, rounding would be most of the noise.
_WHOLE = 4
# Most places of an octave that only the dark frame shows bright.
_RIVALS = 60
# Level of no difference, in bytes.
_ZERO = 64


class Cutter(Protocol):
    """Cuts squares [N, 2·half + 1, 2·half + 1] about places x, y out of a frame."""

    def __call__(self, x: Whole, y: Whole, half: int, /) -> Array: ...


@dataclass(frozen=True)
class Layer:
    """A frame, or a registered pair, at one octave.

    Parameters
    ----------
    step
        Pixels of the frame in one of the octave.
    shape
        Rows and columns of the octave.
    lit, dark
        Cut patches out of the lit frame and, where there is one, out of the registered dark frame.
    bright, base
        [h, w] what is screened of the lit and of the dark frame, both uint8 or both float32.
    cell
        Pixels of the octave in one of these.
    """

    step: int
    shape: tuple[int, int]
    lit: Cutter
    dark: Cutter | None
    bright: NDArray
    base: NDArray | None
    cell: int = 1

    def swapped(self) -> Layer:
        """The pair the other way round."""
        assert self.dark is not None and self.base is not None
        return Layer(self.step, self.shape, self.dark, self.lit, self.base, self.bright, self.cell)


@dataclass(frozen=True)
class Place:
    """Places of an octave, [N] each: whole pixels of it, and the height over the screen's response around.

    `height` allows for the worst that the registration may leave of edges, `clear` for what it left of those around;
    `level` is the response itself, in grey levels. By `worth` they are searched: `clear`, or more or less where a place
    stands alone or not.
    """

    x: Whole
    y: Whole
    height: Array
    clear: Array
    level: Array
    worth: Array

    @classmethod
    def none(cls) -> Place:
        """No places."""
        nowhere, nothing = np.empty(0, np.int64), np.empty(0, np.float32)
        return cls(nowhere, nowhere, nothing, nothing, nothing, nothing)

    def first(self, count: int) -> Place:
        """The first so many."""
        return Place(**{name: one[:count] for name, one in vars(self).items()})


@dataclass(frozen=True)
class Cut:
    """Candidates of all octaves, N of them, and the patches about them, in pixels of their octaves.

    Parameters
    ----------
    step
        [N] pixels of the frame in one of the octave.
    x, y
        [N] whole pixels of the octave.
    shape
        [N, 2] rows and columns of the octave.
    height, clear
        [N] height over the spread of its surroundings and what a registration may leave of edges, at worst and, as
        `clear`, by what it left of edges around.
    spread
        [N] standard deviation of the response of the difference of Gaussians around, in levels.
    size
        [N] which of `SIGMAS`, in rising order.
    number
        [N] which of the places that were cut out, in their order, each one is.
    difference, lit, dark
        [N, 2 HALF + 1, 2 HALF + 1] what is searched, the lit frame, and the dark frame where there is one.
    answer, lit_answer, dark_answer
        Responses of the difference of Gaussians of each candidate's size to them, up to HALF, `LIT_REACH` and
        `DARK_REACH` pixels from the place.
    """

    step: Whole
    x: Whole
    y: Whole
    shape: Whole
    height: Array
    clear: Array
    spread: Array
    size: Whole
    number: Whole
    difference: Array
    lit: Array
    dark: Array | None
    answer: Array
    lit_answer: Array
    dark_answer: Array | None


def differences_of_gaussians(stack: Array, size: Whole, margin: int = 0) -> Array:
    """Gaussian of each patch's own size minus one 1.6 times as wide, [N, h - 2 margin, w - 2 margin].

    Parameters
    ----------
    stack
        [N, side, side], mirrored outside.
    size
        [N] which of `SIGMAS`, in rising order.
    margin
        Pixels at each edge that are not wanted.
    """
    side = stack.shape[1]
    found = np.empty((len(stack), side - 2 * margin, side - 2 * margin), np.float32)
    for n in range(len(SIGMAS)):
        first, last = np.searchsorted(size, (n, n + 1))
        if last > first:
            # Products of matrices: several times faster than filters on small patches.
            along, down = _filters(n, side, margin)
            both = stack[first:last] @ along
            np.matmul(down, np.concatenate(np.split(both, 2, axis=2), axis=1), out=found[first:last])
    return found


@functools.cache
def _filters(size: int, side: int, margin: int) -> tuple[Array, Array]:
    """Both Gaussians along rows, beside each other, [side, 2 n], and what subtracts them down columns, [n, 2 side]."""
    found = []
    for sigma in (SIGMAS[size], _RATIO * SIGMAS[size]):
        reach = min(_MARGIN, math.ceil(3 * sigma))
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
        at = _mirrored(np.arange(margin, side - margin)[:, None] + np.arange(-reach, reach + 1), side)
        matrix = np.zeros((side - 2 * margin, side))
        np.add.at(matrix, (np.arange(len(at))[:, None], at), weights / weights.sum())
        found.append(matrix.astype(np.float32))
    narrow, wide = found
    return np.ascontiguousarray(np.concatenate([narrow, wide]).T), np.concatenate([narrow, -wide], axis=1)


def patches(image: NDArray, x: Whole, y: Whole, half: int) -> Array:
    """Squares of 2·half + 1 pixels about places of an image [H, W]: [N, 2·half + 1, 2·half + 1]; edges are mirrored."""
    height, width = image.shape
    side = 2 * half + 1
    inside = (half <= y) & (y < height - half) & (half <= x) & (x < width - half)
    if len(x) and inside.all():
        return sliding_window_view(image, (side, side))[y - half, x - half].astype(np.float32, copy=False)
    found = np.empty((len(x), side, side), np.float32)
    if inside.any():
        # By windows whole rows are copied, several times faster than by the numbers of pixels.
        found[inside] = sliding_window_view(image, (side, side))[y[inside] - half, x[inside] - half]
    if not inside.all():
        step = np.arange(-half, half + 1)
        rows, columns = (_mirrored(at[~inside, None] + step, end) for at, end in ((y, height), (x, width)))
        found[~inside] = image[rows[:, :, None], columns[:, None, :]]
    return found


def layers(lit: NDArray, registered: Registered | None, largest: float) -> list[Layer]:
    """Octaves of a frame [H, W], or of a pair, uint8 or float32, up to spots of a diameter of `largest` pixels."""
    small, dark = _halved(lit), None
    if registered is None:
        found = [Layer(1, _shape(lit), _cutter(lit), None, lit, None)]
    else:
        # In a difference, whose level is known, the highest pixels serve as well as means, at a quarter of the time.
        base, dark = registered.moved(_pooled(registered.taken), _halved(registered.taken))
        of_dark = functools.partial(registered.patches, registered.taken)
        found = [Layer(1, _shape(lit), _cutter(lit), of_dark, _pooled(lit), base, 2)]
    while min(small.shape) >= 16 and 4 * SIGMAS[0] * 2 * found[-1].step <= largest:
        cut_dark = None if dark is None else _cutter(dark)
        found.append(Layer(2 * found[-1].step, _shape(small), _cutter(small), cut_dark, small, dark))
        if found[-1].step == _WHOLE:
            small, dark = small.astype(np.float32), None if dark is None else dark.astype(np.float32)
        small, dark = _halved(small), None if dark is None else _halved(dark)
    return [one for one in found if one.step == 1 or 4 * SIGMAS[0] * one.step <= largest]


def screened(layer: Layer, most: int) -> tuple[Place, Place]:
    """Screen an octave for about as many places as are wanted, and in a pair for rivals; the highest are kept.

    Rivals are places that are bright in the dark frame alone, found in the same way. No camera makes them; things that
    moved, and edges that the registration left, are as often brighter in the dark frame as in the lit one. A few are
    kept.
    """
    image = layer.bright
    if layer.base is not None:
        # What is much darker in the lit frame does not matter: bytes may end there.
        whole = image.dtype == np.uint8
        image = cv2.addWeighted(image, 1, layer.base, -1, _ZERO) if whole else cv2.subtract(image, layer.base)
    narrow, wide = _means(np.asarray(image), sharp=layer.cell > 1)
    if layer.base is None:
        return _highest(_above(narrow, wide, wide), layer, None, most), Place.none()
    found = _highest(_above(narrow, wide), layer, layer.base, most)
    return found, _highest(_above(wide, narrow, wide), layer, layer.bright, _RIVALS, alone=False)


def _highest(answer: NDArray, layer: Layer, other: NDArray | None, most: int, *, alone: bool = True) -> Place:
    """The highest places of an octave's screen; `other` is the frame that should not show them.

    With `alone`, places of a difference that stand alone come first.
    """
    block = _BLOCK // layer.cell
    peaks = _block_maxima(answer, block)
    highest = peaks.astype(np.float32)
    cut = 3 * _median(peaks[::2, ::2]) + 1
    around = cv2.blur(np.minimum(highest, cut), (_AROUND, _AROUND)) / _HIGHEST_OF_NOISE[layer.cell]
    variance = np.square(around) + _QUANTUM**2
    height = highest / np.sqrt(variance)
    if other is None:
        # In one frame alone, a place that stands alone is worth a closer look more than one of many.
        ring = np.ones((5, 5), np.uint8)
        ring[1:4, 1:4] = 0
        height *= np.clip(highest / np.maximum(np.asarray(cv2.dilate(peaks, ring)), 0.5), 1 / _ALONE, _ALONE)
    flat = height.ravel()
    alone = alone and other is not None
    count = _SCREENED * most * (_ASKED if alone else 1)
    number = np.flatnonzero(flat >= max(_least_of_highest(flat, count), 1e-6))
    row, column = np.divmod(number, height.shape[1])
    x, y = _highest_of_block(answer, row, column, block)
    own = answer[y, x].astype(np.float32)
    top = own >= patches(answer, x, y, 2).max((1, 2))
    x, y, number, own = x[top], y[top], number[top], own[top]
    worst = clear = worth = flat[number]
    if other is not None and len(x):
        lone = _standing_alone(answer, x, y) if alone else np.ones(len(x), np.float32)
        first = np.argsort(-worth * lone, kind="stable")[: _SCREENED * most]
        x, y, number, own, lone = x[first], y[first], number[first], own[first], lone[first]
        edge, share = _edges(answer, other, x, y, layer.cell > 1)
        noise = variance.ravel()[number]
        worst, clear = (own / np.sqrt(noise + np.square(k * edge)) for k in (_LEFT_OF_EDGES[1], share))
        worth = clear * lone
    kept = np.argsort(-worth, kind="stable")[:most]
    columns = (np.asarray(one[kept], dtype=np.float32) for one in (worst, clear, own, worth))
    return Place(layer.cell * x[kept], layer.cell * y[kept], *columns)


def _standing_alone(answer: NDArray, x: Whole, y: Whole) -> Array:
    """A screen's response at places over the highest in the ring around each, within bounds, [N]."""
    reach = int(_RING[1])
    near, radius = patches(answer, x, y, reach), np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1])
    beside = near[:, (radius > _RING[0]) & (radius <= _RING[1])].max(1)
    return np.clip(near[:, reach, reach] / np.maximum(beside, 0.5), 1 / _ALONE, _ALONE)


def cut_out(chosen: Iterable[tuple[Layer, Whole, Whole]]) -> Cut | None:
    """Cut the patches about places of octaves, and find the size with the largest response at each; None where there is
    none.

    Of an octave that was screened at half size the places move to the highest pixel near.
    """
    half = HALF + _MARGIN
    steps, at, shapes, of_lit, of_dark = [], [], [], [], []
    for layer, x, y in chosen:
        if not len(x):
            continue
        if layer.cell > 1:
            x, y = _highest_near(layer, x, y)
        of_lit.append(layer.lit(x, y, half))
        if layer.dark is not None:
            of_dark.append(layer.dark(x, y, half))
        steps.append(np.full(len(x), layer.step))
        at.append(np.stack([x, y]))
        shapes.append(np.tile(layer.shape, (len(x), 1)))
    if not steps:
        return None
    lit, dark = np.concatenate(of_lit), np.concatenate(of_dark) if of_dark else None
    difference = lit if dark is None else lit - dark
    kernels = _kernels()
    middle = slice(half - _MARGIN, half + _MARGIN + 1)
    size = np.argmax(difference[:, middle, middle].reshape(len(lit), -1) @ kernels.reshape(len(SIGMAS), -1).T, axis=1)
    # By size, so that those of one size are one image below another.
    order = np.argsort(size, kind="stable")
    size, lit, difference = size[order], lit[order], lit[order] if dark is None else difference[order]
    dark = None if dark is None else dark[order]
    inner = slice(_MARGIN, -_MARGIN)
    x, y = np.concatenate(at, 1)[:, order]
    answer = _answers(difference, size, HALF)
    near = slice(HALF - LIT_REACH, HALF + LIT_REACH + 1)
    dark_answer = None if dark is None else _answers(dark, size, HALF)
    of_dark = slice(HALF - DARK_REACH, HALF + DARK_REACH + 1)
    return Cut(
        np.concatenate(steps)[order],
        x,
        y,
        np.concatenate(shapes)[order],
        *_heights(answer, dark_answer, size),
        size,
        order,
        difference[:, inner, inner],
        lit[:, inner, inner],
        None if dark is None else dark[:, inner, inner],
        answer,
        answer[:, near, near] if dark is None else _answers(lit, size, LIT_REACH),
        None if dark_answer is None else dark_answer[:, of_dark, of_dark],
    )


def _heights(answer: Array, of_dark: Array | None, sizes: Whole) -> tuple[Array, Array, Array]:
    """Height of each patch's middle over the spread of its surroundings, twice, and that spread, [N], as in `Cut`."""
    size = np.abs(answer)
    # What stands far out of the surroundings counts little: the place itself, or another camera.
    cut = 3 * np.median(size[:, ::3, ::3], axis=(1, 2)) + 1e-6
    spread = 1.25 * np.minimum(size, cut[:, None, None]).mean((1, 2))
    own, variance = answer[:, HALF, HALF], spread**2 + _QUANTUM**2
    left: list[Array | float] = [0.0, 0.0]
    if of_dark is not None:
        near = slice(HALF - 2, HALF + 3)
        edge = np.abs(of_dark[:, near, near]).max((1, 2))
        share = _share_left(answer, of_dark, 2.5 * np.array(SIGMAS)[sizes] + 1.5)
        left = [_LEFT_OF_EDGES[1] * edge, share * edge]
    worst, likely = (np.maximum(own / np.sqrt(variance + one**2), 1e-3).astype(np.float32) for one in left)
    return worst, likely, np.sqrt(spread**2 + _QUANTUM**2).astype(np.float32)


def _answers(stack: Array, size: Whole, reach: int) -> Array:
    """Difference of Gaussians of each patch at its own size, to so many pixels from the middle; sizes rise."""
    middle, far = stack.shape[1] // 2, reach + _MARGIN
    near = slice(middle - far, middle + far + 1)
    return differences_of_gaussians(stack[:, near, near], size, _MARGIN)


@functools.cache
def _kernels() -> Array:
    """Differences of Gaussians as kernels, [sizes, side, side]."""
    points = np.zeros((2 * _MARGIN + 1, 2 * _MARGIN + 1), np.float32)
    points[_MARGIN, _MARGIN] = 1
    sizes = np.arange(len(SIGMAS))
    return differences_of_gaussians(np.repeat(points[None], len(sizes), axis=0), sizes)


def _highest_near(layer: Layer, x: Whole, y: Whole) -> tuple[Whole, Whole]:
    """The pixels with the highest mean of 3 x 3 among the cell at places and those around it."""
    reach = 2
    spot = layer.lit(x, y, reach + 2)
    if layer.dark is not None:
        spot = spot - layer.dark(x, y, reach + 2)
    mean = np.asarray(cv2.blur(spot.reshape(-1, spot.shape[2]), (3, 3))).reshape(spot.shape)
    best = mean[:, 2:-2, 2:-2].reshape(len(x), -1).argmax(1)
    side = 2 * reach + 1
    height, width = layer.shape
    return np.clip(x + best % side - reach, 0, width - 1), np.clip(y + best // side - reach, 0, height - 1)


def _least_of_highest(values: NDArray[Any], count: int) -> float:
    """The least of so many highest values: many times faster than sorting, as few are looked at."""
    if count >= values.size:
        return float(values.min())
    # Of every sixteenth, twice as many as are wanted stand above; where chance had it otherwise all are looked at.
    sample = values[::16]
    rank = min(2 * count // 16 + 16, sample.size)
    above = values[values >= np.partition(sample, sample.size - rank)[sample.size - rank]]
    chosen = above if above.size >= count else values
    return float(np.partition(chosen, chosen.size - count)[chosen.size - count])


def _median(values: NDArray) -> float:
    """The median; of bytes by counting them."""
    if values.dtype != np.uint8:
        return float(np.median(values))
    below = np.cumsum(np.bincount(values.ravel(), minlength=256))
    low, up = (int(np.searchsorted(below, rank, "right")) for rank in ((values.size - 1) // 2, values.size // 2))
    return (low + up) / 2


def _means(image: NDArray, sharp: bool) -> tuple[NDArray, NDArray]:
    """Means over 3 x 3 pixels and some 7 x 7, [H, W] each, in the image's own type. Sharp: pixels, and over 5 x 5."""
    narrow = image if sharp else np.asarray(cv2.blur(image, (3, 3)))
    return narrow, np.asarray(cv2.blur(narrow, (5, 5)))


def _above(one: NDArray, other: NDArray, into: NDArray | None = None) -> NDArray:
    """How far one stands above the other, 0 where it does not; `into` is written over."""
    answer = np.asarray(cv2.subtract(one, other, dst=into))
    return answer if answer.dtype == np.uint8 else np.maximum(answer, 0)


def _edges(answer: NDArray, dark: NDArray, x: Whole, y: Whole, sharp: bool) -> tuple[Array, Array]:
    """The dark frame's highest edges within two pixels of places, and which share of them may be left, [N].

    `answer` is the screen's response to the difference, which shows what is left of edges around a place.
    """
    near = patches(dark, x, y, _NEAR_EDGES + 3)
    shape = near.shape
    near = near.reshape(-1, shape[2])
    narrow = near if sharp else cv2.blur(near, (3, 3))
    contrast = cv2.absdiff(narrow, cv2.blur(narrow, (5, 5))).reshape(shape)[:, 3:-3, 3:-3]
    # Of what is left the answer holds only what is bright: half.
    left = 2 * patches(answer, x, y, _NEAR_EDGES)
    near = slice(_NEAR_EDGES - 2, _NEAR_EDGES + 3)
    return contrast[:, near, near].max((1, 2)), _share_left(left, contrast, 3.5)


def _share_left(left: NDArray[Any], edges: NDArray[Any], inner: float | NDArray[Any]) -> Array:
    """The share of edges [N, side, side] that may be left at the middle of patches, from what is left around it, [N].

    Pixels nearer to the middle than `inner` are left out: a camera may lie there. A few outlying pixels, as of another
    camera, count little.
    """
    around = _around(edges.shape[1] // 2, tuple(np.unique(inner).tolist()))
    which = 0 if np.ndim(inner) == 0 else np.searchsorted(np.unique(inner), inner)
    size = np.abs(edges)
    weight = size * around[which]
    among = np.minimum(np.abs(left), size)
    share = np.einsum("nij,nij->n", among, weight) / (
        np.einsum("nij,nij->n", size, weight) + _FLAT * around.sum((1, 2))[which]
    )
    return np.clip(_WORST_OF_EDGES * share, *_LEFT_OF_EDGES).astype(np.float32)


@functools.cache
def _around(half: int, inner: tuple[float, ...]) -> Array:
    """1 for pixels farther from the middle than each of some radii, else 0: [radii, 2 half + 1, 2 half + 1]."""
    radius = np.hypot(*np.mgrid[-half : half + 1, -half : half + 1])
    return (radius > np.array(inner)[:, None, None]).astype(np.float32)


def _block_maxima(image: NDArray, block: int) -> NDArray:
    """Largest value of each block, [ceil(H / block), ceil(W / block)]."""
    height, width = image.shape
    rows, columns = -(-height // block), -(-width // block)
    if (rows * block, columns * block) != image.shape:
        image = np.asarray(
            cv2.copyMakeBorder(
                image, 0, rows * block - height, 0, columns * block - width, cv2.BORDER_CONSTANT, value=[0]
            )
        )
    # Maxima over rows of memory are fast: over the columns they are taken of the transposed.
    tall = image.reshape(rows, block, -1).max(1)
    return np.ascontiguousarray(np.ascontiguousarray(tall.T).reshape(columns, block, rows).max(1).T)


def _highest_of_block(image: NDArray, row: Whole, column: Whole, block: int) -> tuple[Whole, Whole]:
    """Where the largest value of blocks lies, x and y, [N] each."""
    height, width = image.shape
    step = np.arange(block)
    y = np.minimum(row[:, None, None] * block + step[:, None], height - 1)
    x = np.minimum(column[:, None, None] * block + step, width - 1)
    at = image[y, x].reshape(len(row), block * block).argmax(1)
    return np.minimum(column * block + at % block, width - 1), np.minimum(row * block + at // block, height - 1)


def _mirrored(at: Whole, end: int) -> Whole:
    """Numbers of pixels, mirrored at 0 and `end` - 1."""
    period = max(1, 2 * (end - 1))
    folded = np.abs(at) % period
    return np.minimum(folded, period - folded)


def _shape(image: NDArray) -> tuple[int, int]:
    return image.shape[0], image.shape[1]


def _cutter(image: NDArray) -> Cutter:
    return functools.partial(patches, image)


def _halved(image: NDArray) -> NDArray:
    """The means of 2 x 2 pixels; an odd last row or column is left out: to stretch the rest would move all places."""
    rows, columns = image.shape[0] // 2, image.shape[1] // 2
    even = image[: 2 * rows, : 2 * columns]
    return np.asarray(cv2.resize(even, (columns, rows), interpolation=cv2.INTER_AREA))


def _pooled(image: NDArray) -> NDArray:
    """The highest of each 2 x 2 pixels; an odd last row or column is left out."""
    rows, columns = image.shape[0] // 2, image.shape[1] // 2
    tall = np.asarray(cv2.max(image[0 : 2 * rows : 2], image[1 : 2 * rows : 2]))
    left, right = cv2.split(np.ascontiguousarray(tall[:, : 2 * columns]).reshape(rows, columns, 2))
    return np.asarray(cv2.max(left, right))
