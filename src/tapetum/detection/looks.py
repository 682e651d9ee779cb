"""How a candidate looks: numbers that tell a camera from edges, foliage, lettering and people.

Each is a logarithm or a share, so that a weighted sum of them can be the logarithm of odds (score.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tapetum.detection.candidates import HALF, SIGMAS, Octave, difference_of_gaussians

__all__ = ["OF_A_FRAME", "OF_A_PAIR", "looks", "shape"]

Array = NDArray[np.float64]

OF_A_FRAME = (
    "height",
    "outlier",
    "contrast",
    "isolation",
    "alone",
    "elongation",
    "fill",
    "inside",
    "size",
    "saturated",
)
"""Of every candidate, in this order.

height: over the spread of the surroundings; outlier: that beside the other candidates of the frame; contrast: over the
local brightness; isolation and alone: beside what the same filter finds within 12 and 20 pixels; elongation and fill:
of the pixels over 40 % of its peak; inside: 0 at the frame's edge; size; saturated: 1 where a pixel is at full scale.
"""
OF_A_PAIR = ("vanishes", "fresh", "motion")
"""Besides, where there is a dark frame.

vanishes: the share of the lit frame's answer that the dark one lacks nearby; fresh: what is left after the surroundings
alone are registered once more; motion: how unequal the flow is nearby.
"""
_SHAPE = 10
_AGAIN, _REACH = 12, 4
# Rows between patches below one another, so that filters do not mix them.
_PAD = 8


def looks(octave: Octave, bright: Array, full_scale: float, flow: NDArray[np.float32] | None) -> Array:
    """Measure the candidates of an octave, [N, features]; "outlier" stays 0 until all octaves are known.

    Parameters
    ----------
    octave
        The candidates.
    bright
        [N] local mean of the lit frame about each.
    full_scale
        Level at which the lit frame saturates.
    flow
        [H, W, 2] of the registration, for a pair, on a grid that covers the frame evenly.
    """
    x, y = octave.x, octave.y
    sigma = np.array(SIGMAS)[octave.size]
    radius = np.hypot(*np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1])
    answer, of_lit = octave.answer, octave.lit_answer
    height, lit_height = answer[:, HALF, HALF], of_lit[:, HALF, HALF]
    rest = _quantile(np.abs(answer), octave.size, lambda s: radius > 4 * s + 2, 0.995)
    second = _quantile(of_lit, octave.size, lambda s: (radius > 3 * s + 2) & (radius <= 12), 0.98)
    elongation, fill = shape(octave)
    h, w = octave.shape
    edge = np.minimum.reduce([x, y, w - 1 - x, h - 1 - y])
    middle = slice(HALF - 1, HALF + 2)
    peak = octave.lit[:, middle, middle].max((1, 2))
    own = [
        np.log(octave.height),
        np.zeros(len(x)),
        np.log(np.maximum(lit_height, 0.1) / (0.1 * np.maximum(bright, 0.02 * full_scale) + 0.012 * full_scale)),
        np.clip((lit_height - second) / np.maximum(lit_height, 1), -1, 1),
        np.log(np.maximum(height, 0.1) / (rest + 0.5)),
        elongation,
        fill,
        np.clip((edge - 1) / 4, 0, 1),
        np.log(sigma * octave.step),
        (peak >= 0.98 * full_scale).astype(float),
    ]
    if flow is None or octave.dark_answer is None:
        return np.stack(own, 1)
    of_dark = np.where(radius <= 4, octave.dark_answer, -np.inf).max((1, 2))
    own += [
        np.clip(1 - np.maximum(of_dark, 0) / np.maximum(lit_height, 1), -1, 1),
        _fresh(octave, sigma),
        np.log(0.3 + _uneven(flow, octave)),
    ]
    return np.stack(own, 1)


def _uneven(flow: NDArray[np.float32], octave: Octave) -> Array:
    """Standard deviation of the flow within each patch, in pixels, [N]."""
    rows, columns = flow.shape[:2]
    h, w = octave.shape
    step = np.linspace(-HALF, HALF, 15)
    row = np.clip((octave.y[:, None] + step + 0.5) * rows / h, 0, rows - 1).astype(int)
    column = np.clip((octave.x[:, None] + step + 0.5) * columns / w, 0, columns - 1).astype(int)
    near = flow[row[:, :, None], column[:, None, :]]
    return np.hypot(*np.moveaxis(near.std((1, 2)), -1, 0))


def shape(octave: Octave) -> tuple[Array, Array]:
    """Elongation (log of the axes' ratio) and fill (log of area over an ellipse's) of each candidate, [N]."""
    count = len(octave.x)
    inner = slice(HALF - _SHAPE, HALF + _SHAPE + 1)
    patch = _smoothed(octave.difference, 0.6)[:, inner, inner]
    radius = np.hypot(*np.mgrid[-_SHAPE : _SHAPE + 1, -_SHAPE : _SHAPE + 1])
    patch = patch - _quantile(patch, octave.size, lambda s: radius > 2.5 * s + 2, 0.5)[:, None, None]
    middle = np.where(radius < 2.1, patch, -np.inf).reshape(count, -1)
    over = patch > 0.4 * np.maximum(middle.max(1), 0.5)[:, None, None]
    within = np.zeros((3, 3, 3), int)
    within[1] = 1
    labels = np.empty(over.shape, np.int32)
    ndimage.label(over, within, output=labels)
    flat = labels.reshape(count, -1)
    own = (labels == np.take_along_axis(flat, middle.argmax(1)[:, None], 1)[:, :, None]) & (labels > 0)
    rows, columns = np.mgrid[-_SHAPE : _SHAPE + 1, -_SHAPE : _SHAPE + 1]
    area = np.maximum(own.sum((1, 2)), 1)

    def mean(values: NDArray) -> Array:
        return (own * values).sum((1, 2)) / area

    # A pixel alone has the second moment of a square.
    xx = mean(columns**2) - mean(columns) ** 2 + 1 / 12
    yy = mean(rows**2) - mean(rows) ** 2 + 1 / 12
    xy = mean(rows * columns) - mean(rows) * mean(columns)
    middle_axis, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    long, short = middle_axis + apart, np.maximum(middle_axis - apart, 1e-3)
    return np.log(long / short) / 2, np.log(area / (4 * np.pi * np.sqrt(long * short)))


def _fresh(octave: Octave, sigma: Array) -> Array:
    """Log of the height over the spread after the patch around each candidate is registered once more, [N]."""
    assert octave.dark is not None
    side = 2 * _AGAIN + 1
    inner = slice(HALF - _AGAIN, HALF + _AGAIN + 1)
    wider = slice(HALF - _AGAIN - _REACH, HALF + _AGAIN + _REACH + 1)
    lit = _smoothed(octave.lit, 0.8)[:, inner, inner]
    dark = _smoothed(octave.dark, 0.8)[:, wider, wider]
    radius = np.hypot(*np.mgrid[-_AGAIN : _AGAIN + 1, -_AGAIN : _AGAIN + 1])
    around = (radius > (2.5 * np.array(SIGMAS) + 1.5)[:, None, None]).astype(np.float32)
    least, left = np.full(len(lit), np.inf, np.float32), np.zeros_like(lit)
    for row in range(2 * _REACH + 1):
        for column in range(2 * _REACH + 1):
            apart = lit - dark[:, row : row + side, column : column + side]
            errors = np.square(apart).reshape(len(lit), -1) @ around.reshape(len(SIGMAS), -1).T
            error = np.take_along_axis(errors, octave.size[:, None], 1)[:, 0]
            better = error < least
            least[better], left[better] = error[better], apart[better]
    answer = np.empty_like(left)
    for one in np.unique(sigma):
        mine = sigma == one
        tall = np.pad(left[mine], ((0, 0), (_PAD, _PAD), (0, 0)), mode="reflect")
        answers = difference_of_gaussians(tall.reshape(-1, side), one).reshape(tall.shape)
        answer[mine] = answers[:, _PAD:-_PAD]
    mine = around[octave.size]
    spread = np.sqrt((answer**2 * mine).sum((1, 2)) / mine.sum((1, 2))) + 0.3
    return np.log(np.maximum(answer[:, _AGAIN, _AGAIN] / spread, 0.3))


def _smoothed(stack: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Each patch, smoothed; where patches meet in the stack they mix a little, at their edges."""
    tall = cv2.GaussianBlur(stack.reshape(-1, stack.shape[2]), (0, 0), sigma)
    return np.asarray(tall, dtype=np.float32).reshape(stack.shape)


def _quantile(
    values: NDArray, size: NDArray[np.int64], where: Callable[[float], NDArray[np.bool_]], share: float
) -> Array:
    """Quantile over chosen pixels of each patch, [N]: `where` says which, [h, w], for a standard deviation."""
    found = np.empty(len(values))
    for n, sigma in enumerate(SIGMAS):
        if (mine := np.flatnonzero(size == n)).size:
            chosen = values[mine][:, where(sigma)]
            at = share * (chosen.shape[1] - 1)
            low, up = math.floor(at), math.ceil(at)
            chosen.partition((low, up), axis=1)
            found[mine] = chosen[:, low] + (at - low) * (chosen[:, up] - chosen[:, low])
    return found
