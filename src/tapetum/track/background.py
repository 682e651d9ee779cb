"""A frame without its spots: its uneven background, its noise, and its hot pixels."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.data.blocks import block_means

__all__ = ["Ground", "fit_ground", "without_hot_pixels"]

# Blocks along the short side of the frame: enough for a surface of the fourth order, few enough to fit in 1 ms.
_BLOCKS = 30
_ORDER = 4
# Rows of a block whose differences give its noise: with more the variance is hardly better known.
_ROWS = 8
# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
_MAD = 1.4826

Picture = NDArray[np.float32]
Places: TypeAlias = slice | NDArray[np.floating] | NDArray[np.integer]


@functools.lru_cache(maxsize=8)
def _legendre(samples: int) -> NDArray[np.float64]:
    """Return Legendre polynomials at the centres of `samples` equal parts of -1...1."""
    places = (np.arange(samples) + 0.5) * (2 / samples) - 1
    return np.asarray(np.polynomial.legendre.legvander(places, _ORDER), dtype=np.float64)


@functools.lru_cache(maxsize=8)
def _basis(rows: int, columns: int) -> tuple[NDArray[np.float64], list[tuple[int, int]]]:
    """Return products of the polynomials on a grid, [terms, rows*columns], lowest orders first, and their orders."""
    y, x = _legendre(rows), _legendre(columns)
    pairs = [(i, order - i) for order in range(_ORDER + 1) for i in range(order + 1)]
    return np.stack([np.outer(y[:, i], x[:, j]).ravel() for i, j in pairs]), pairs


def _quantile(values: NDArray[np.float64], share: float) -> float:
    """Return numpy's quantile, or median, of a few values, several times faster."""
    place = share * (len(values) - 1)
    low = min(int(place), max(0, len(values) - 2))
    ends = np.partition(values, (low, min(low + 1, len(values) - 1)))[low : low + 2]
    return float(ends[0] + (place - low) * (ends[-1] - ends[0]))


def _surface(values: NDArray[np.floating], order: int, floor: float) -> NDArray[np.float64]:
    """Fit a polynomial surface from below, without blocks that rise above it: these hold light of a spot.

    The order rises step by step, so that a spot which covers a good part of the frame is recognised before the surface
    can follow it. Returns the weights [5, 5] of the products of polynomials in y and x.
    """
    rows, columns = values.shape
    basis, pairs = _basis(rows, columns)
    flat = values.astype(np.float64).ravel()
    # At least half of the blocks are free of spots, whatever their size.
    fit = np.full_like(flat, _quantile(flat, 0.4))
    weights = np.zeros((_ORDER + 1, _ORDER + 1))
    weights[0, 0] = fit[0]
    for step in [0, 1, 1, *range(2, order + 1), order]:
        rest = flat - fit
        below = -rest[rest < 0]
        spread = max(_MAD * _quantile(below, 0.5) if below.size else 0.0, floor)
        # Wide at first, since an unfitted slope is no spot; the last rounds clip closely.
        keep = rest < (3.0 if step < 2 else 2.5) * spread
        terms = basis[: (step + 1) * (step + 2) // 2]
        count = np.count_nonzero(keep)
        if count < 3 * len(terms):
            break
        # Legendre polynomials are nearly orthogonal here: the normal equations are accurate and fast.
        kept = terms * keep
        gram = kept @ terms.T
        gram.flat[:: len(terms) + 1] += 1e-9 * count
        solution = np.linalg.solve(gram, kept @ flat)
        fit = solution @ terms
        weights[:] = 0
        for (i, j), weight in zip(pairs, solution, strict=False):
            weights[i, j] = weight
    return weights


@dataclass(frozen=True)
class Ground:
    """The background of a frame and the variance of its noise, as polynomial surfaces.

    Parameters
    ----------
    shape
        (H, W) of the frame in pixels.
    level, variance
        [5, 5] weights of Legendre polynomials in y and x, in the frame's units and their square.
    least
        Standard deviation of rounding to the frame's grey levels; no noise is less.
    """

    shape: tuple[int, int]
    level: NDArray[np.float64]
    variance: NDArray[np.float64]
    least: float

    def at(self, rows: Places, columns: Places) -> tuple[Picture, Picture]:
        """Return the background and the noise's standard deviation at rows [..., h] and columns [..., w] of the frame.

        Rows and columns are slices, or numbers that may lie between pixels. Both pictures are float32 [..., h, w];
        leading axes make a stack of windows.
        """
        if isinstance(rows, slice):
            along = [one[rows] for one in self._along_rows]
        else:
            along = [_polynomials(rows, self.shape[0]) @ one.astype(np.float32) for one in (self.level, self.variance)]
        across = np.swapaxes(_polynomials(columns, self.shape[1]), -1, -2)
        level, variance = (one @ across for one in along)
        return level, np.sqrt(np.maximum(variance, np.float32(self.least**2), out=variance), out=variance)

    @functools.cached_property
    def _along_rows(self) -> list[NDArray[np.float32]]:
        """The weights of the polynomials in x in each row, [H, 5], of the level and of the variance."""
        rows = _legendre32(self.shape[0])
        return [rows @ one.astype(np.float32) for one in (self.level, self.variance)]


@functools.lru_cache(maxsize=8)
def _legendre32(samples: int) -> NDArray[np.float32]:
    return _legendre(samples).astype(np.float32)


def _polynomials(places: Places, samples: int) -> NDArray[np.float32]:
    """Return Legendre polynomials [..., orders] at pixels of an axis with `samples` of them."""
    if isinstance(places, slice):
        return _legendre32(samples)[places]
    if np.issubdtype(places.dtype, np.integer):
        return _legendre32(samples)[places.astype(np.intp, copy=False)]
    between = np.polynomial.legendre.legvander((places + 0.5) * (2 / samples) - 1, _ORDER)
    return np.asarray(between, dtype=np.float32)


def fit_ground(image: NDArray[Any], quarter: Picture, quantum: float) -> Ground:
    """Fit background and noise of a finite frame [H, W] of uint8, uint16 or float32.

    `quarter` [H//4, W//4] holds its means over 4 x 4 pixels. `quantum` is the step between grey levels: the noise is
    at least its rounding, ``quantum/sqrt(12)``.
    """
    height, width = image.shape
    block = max(2, min(height, width) // _BLOCKS)
    grid = (max(1, width // block), max(1, height // block))
    # Blocks smaller than a few quarters need the pixels themselves.
    fine = quarter if block >= 8 else image.astype(np.float32)
    means = block_means(fine, *grid[::-1])
    # Differences of pixels two apart, in some of the rows, cancel a slope or a wide spot but keep noise that is
    # correlated between neighbours.
    rows = image[:: max(2, block // _ROWS)]
    # Of integers, the sizes of the differences are as good and faster.
    step = np.asarray(cv2.absdiff(rows[:, 2:], rows[:, :-2]))
    # Whole numbers of differences a block: anything else takes six times as long.
    down, across = (max(1, size // count) * count for size, count in zip(step.shape, grid[::-1], strict=True))
    step = step[:down, :across]
    squares = np.asarray(cv2.multiply(step, step, dtype=cv2.CV_32F))
    squares = np.asarray(cv2.resize(squares, grid, interpolation=cv2.INTER_AREA), dtype=np.float32)
    least = quantum / math.sqrt(12)
    level = _surface(means, _ORDER, least / block)
    # The median over neighbouring blocks removes those with a hot pixel or a spot's rim.
    variance = np.asarray(cv2.medianBlur(squares / 2, 5 if min(grid) >= 5 else 3), dtype=np.float32)
    return Ground((height, width), level, _surface(variance, 2, least**2), least)


def without_hot_pixels(excess: Picture, noise: Picture) -> Picture:
    """Set hot pixels of an excess over the background [H, W] to zero, and limit it from below to -5 times its noise.

    A point imaged by a lens also lights its neighbours in both directions. A sensor's defect is isolated, and the stamp
    of some cameras in their first pixels is a line one pixel thin. `excess` itself changes.
    """
    bound = 5 * noise
    # Few pixels stand so high.
    row, column = np.divmod(np.flatnonzero(excess > bound), excess.shape[1])
    # Mirrored about the border's pixels: there one neighbour counts twice.
    around = np.asarray(cv2.copyMakeBorder(excess, 1, 1, 1, 1, cv2.BORDER_REFLECT_101)).ravel()
    stride = excess.shape[1] + 2
    at = (row + 1) * stride + (column + 1)
    beside, above = (np.maximum(around[at - step], around[at + step]) for step in (1, stride))
    hot = np.minimum(beside, above) - np.float32(0.15) * around[at] < 2 * noise[row, column]
    excess[row[hot], column[hot]] = 0
    return np.asarray(cv2.max(excess, np.negative(bound, out=bound)), dtype=np.float32)
