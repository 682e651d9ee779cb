"""A frame without its spots: its uneven background, its noise, and its hot pixels."""

from __future__ import annotations

import functools
import math

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["clean"]

# Blocks along the short side of the frame: enough for a surface of the fourth order, few enough to fit in 1 ms.
_BLOCKS = 30
_ORDER = 4
# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
_MAD = 1.4826


@functools.lru_cache(maxsize=8)
def _legendre(samples: int) -> NDArray[np.float64]:
    """Return Legendre polynomials at the centres of `samples` equal parts of -1...1."""
    places = (np.arange(samples) + 0.5) * (2 / samples) - 1
    return np.asarray(np.polynomial.legendre.legvander(places, _ORDER), dtype=np.float64)


@functools.lru_cache(maxsize=8)
def _basis(rows: int, columns: int) -> tuple[NDArray[np.float64], list[tuple[int, int]], NDArray[np.int64]]:
    """Return products of the polynomials on a grid, [rows*columns, terms], their orders and their sums."""
    y, x = _legendre(rows), _legendre(columns)
    pairs = [(i, order - i) for order in range(_ORDER + 1) for i in range(order + 1)]
    basis = np.stack([np.outer(y[:, i], x[:, j]).ravel() for i, j in pairs], axis=1)
    return basis, pairs, np.array([i + j for i, j in pairs])


def _surface(values: NDArray[np.floating], order: int, floor: float, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Fit a polynomial surface from below, without blocks that rise above it: these hold light of a spot.

    The order rises step by step, so that a spot which covers a good part of the frame is recognised before the surface
    can follow it. Returns the surface at the pixels of a frame of the given shape.
    """
    rows, columns = values.shape
    basis, pairs, orders = _basis(rows, columns)
    flat = values.astype(np.float64).ravel()
    # At least half of the blocks are free of spots, whatever their size.
    fit = np.full_like(flat, np.quantile(flat, 0.4))
    weights = np.zeros((_ORDER + 1, _ORDER + 1))
    weights[0, 0] = fit[0]
    for step in [0, 1, 1, *range(2, order + 1), order]:
        rest = flat - fit
        below = -rest[rest < 0]
        spread = max(_MAD * float(np.median(below)) if below.size else 0.0, floor)
        # Wide at first, since an unfitted slope is no spot; the last rounds clip closely.
        keep = rest < (3.0 if step < 2 else 2.5) * spread
        terms = basis[:, orders <= step]
        if keep.sum() < 3 * terms.shape[1]:
            break
        # Legendre polynomials are nearly orthogonal here: the normal equations are accurate and fast.
        kept = terms[keep]
        gram = kept.T @ kept
        gram[np.diag_indices_from(gram)] += 1e-9 * len(kept)
        solution = np.linalg.solve(gram, kept.T @ flat[keep])
        fit = terms @ solution
        weights[:] = 0
        for (i, j), weight in zip(pairs, solution, strict=False):
            weights[i, j] = weight
    return (_legendre(shape[0]) @ weights @ _legendre(shape[1]).T).astype(np.float32)


def clean(image: NDArray[np.generic], quantum: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Remove background and hot pixels from a finite frame [H, W] of uint8, uint16 or float32.

    Returns two float32 frames [H, W]: the excess over the background, hot pixels set to zero, and the standard
    deviation of the background's noise, positive everywhere. `quantum` is the step between grey levels: the noise is at
    least its rounding, ``quantum/sqrt(12)``.
    """
    height, width = image.shape
    pixels = image.astype(np.float32)
    block = max(2, min(height, width) // _BLOCKS)
    grid = (max(1, width // block), max(1, height // block))
    means = np.asarray(cv2.resize(pixels, grid, interpolation=cv2.INTER_AREA), dtype=np.float32)
    # Differences of pixels two apart, in every other row, cancel a slope or a wide spot but keep noise that is
    # correlated between neighbours.
    rows = pixels[::2]
    step = cv2.subtract(rows[:, 2:], rows[:, :-2])
    squares = np.asarray(cv2.resize(cv2.multiply(step, step), grid, interpolation=cv2.INTER_AREA), dtype=np.float32)
    least = quantum / math.sqrt(12)
    shape = (height, width)
    excess = np.asarray(cv2.subtract(pixels, _surface(means, _ORDER, least / block, shape)), dtype=np.float32)

    # The median over neighbouring blocks removes those with a hot pixel or a spot's rim.
    variance = np.asarray(cv2.medianBlur(squares / 2, 5 if min(grid) >= 5 else 3), dtype=np.float32)
    noise = np.sqrt(np.maximum(_surface(variance, 2, least**2, shape), np.float32(least**2)))

    # A point imaged by a lens also lights its neighbours in both directions. A sensor's defect is isolated, and the
    # stamp of some cameras in their first pixels is a line one pixel thin.
    beside = np.asarray(cv2.dilate(excess, np.array([[1, 0, 1]], np.uint8)))
    above = np.asarray(cv2.dilate(excess, np.array([[1], [0], [1]], np.uint8)))
    lone = cv2.scaleAdd(excess, -0.15, np.asarray(cv2.min(beside, above)))
    hot = (np.asarray(lone) < 2 * noise) & (excess > 5 * noise)
    excess[hot] = 0
    return np.asarray(cv2.max(excess, -5 * noise), dtype=np.float32), noise
