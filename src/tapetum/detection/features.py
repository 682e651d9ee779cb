"""Features of a candidate: numbers that separate a camera from edges, foliage, lettering and people.

Each is a logarithm or a share, so that a weighted sum of them can be the logarithm of odds (score.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tapetum.detection.candidates import DARK_REACH, HALF, LIT_REACH, SIGMAS, Cut, differences_of_gaussians

__all__ = ["OF_A_FRAME", "OF_A_PAIR", "beside_rivals", "looks", "shape"]

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

height: over the spread of the surroundings; outlier: the same, relative to the other candidates of the frame; contrast:
over the local brightness; isolation and alone: over the largest responses of the same filter within 12 and 20 pixels;
elongation and fill: of the pixels over 40 % of its peak; inside: 0 at the edge of the frame, or of the dark one; size;
saturated: 1 where a pixel is at full scale.
"""
OF_A_PAIR = ("vanishes", "fresh", "motion", "partner", "clear", "level", "above", "apart", "twin")
"""Besides, where there is a dark frame.

vanishes: the share of the lit frame's answer that the dark one lacks nearby; fresh: what is left after the surroundings
alone are registered once more; motion: how unequal the flow is nearby; partner: how strongly the dark frame alone shows
something of the same size nearby, as where a thing moved; clear: the height over the spread and what the registration
left of edges around; level: the height in grey levels. From rivals, places that are bright in the dark frame alone
(`candidates.screened`) and so no cameras: above, how much higher it stands than the third highest; apart, than any,
where distant ones count less; twin, how similar one nearby is in size and level, as where a small thing moved.
"""
_SHAPE = 10
# Of the frame's longer side: how far a rival matters to a factor of e, and how far a thing may move.
_FADES, _MOVES = 0.2, 0.12
_MANY = 3
_AGAIN, _REACH = 12, 4


def looks(cut: Cut, bright: Array, full_scale: float, flow: NDArray[np.float32] | None) -> Array:
    """Measure candidates, [N, features]; "outlier" stays 0 until it is known which of them are kept.

    Parameters
    ----------
    cut
        The candidates.
    bright
        [N] local mean of the lit frame about each.
    full_scale
        Level at which the lit frame saturates.
    flow
        [H, W, 2] of the registration, for a pair, on a grid that covers the frame evenly.
    """
    x, y, size = cut.x, cut.y, cut.size
    sigma = np.array(SIGMAS)[size]
    height, lit_height = cut.answer[:, HALF, HALF], cut.lit_answer[:, LIT_REACH, LIT_REACH]
    rest = _quantile(np.abs(cut.answer), size, lambda s, r: r > 4 * s + 2, 0.995)
    second = _quantile(cut.lit_answer, size, lambda s, r: (r > 3 * s + 2) & (r <= LIT_REACH), 0.98)
    elongation, fill = shape(cut)
    edge = _inside(x, y, cut.shape)
    if flow is not None:
        # Pixels outside the dark frame do not count as surroundings either.
        moved = _at(flow, cut, np.zeros(1))[:, 0, 0] / cut.step[:, None]
        edge = np.minimum(edge, _inside(x + moved[:, 0], y + moved[:, 1], cut.shape))
    middle = slice(HALF - 1, HALF + 2)
    peak = cut.lit[:, middle, middle].max((1, 2))
    own = [
        np.log(cut.height),
        np.zeros(len(x)),
        np.log(np.maximum(lit_height, 0.1) / (0.1 * np.maximum(bright, 0.02 * full_scale) + 0.012 * full_scale)),
        np.clip((lit_height - second) / np.maximum(lit_height, 1), -1, 1),
        np.log(np.maximum(height, 0.1) / (rest + 0.5)),
        elongation,
        fill,
        np.clip((edge - 1) / 4, 0, 1),
        np.log(sigma * cut.step),
        (peak >= 0.98 * full_scale).astype(float),
    ]
    if flow is None or cut.dark_answer is None:
        return np.stack(own, 1)
    radius = np.hypot(*np.mgrid[-DARK_REACH : DARK_REACH + 1, -DARK_REACH : DARK_REACH + 1])
    of_dark = cut.dark_answer[:, radius <= DARK_REACH].max(1)
    own += [
        np.clip(1 - np.maximum(of_dark, 0) / np.maximum(lit_height, 1), -1, 1),
        _fresh(cut),
        np.log(0.3 + _uneven(flow, cut)),
        np.log((np.maximum(-cut.answer.min((1, 2)), 0) + 0.5) / (np.maximum(height, 0.1) + 0.5)),
        np.log(cut.clear),
        np.log(np.maximum(height, 0.1)),
    ]
    return np.stack(own, 1)


def beside_rivals(own: Array, rivals: Array, side: int) -> Array:
    """The features "above", "apart" and "twin" of places, [N, 3].

    Parameters
    ----------
    own, rivals
        [N, 5], [M, 5] x and y in pixels, clear height, level, and pixels a step of the octave.
    side
        The frame's longer side in pixels.
    """
    if not len(rivals):
        rivals = np.array([[-10.0 * side, -10.0 * side, 1.0, 0.1, 1.0]])
    height, other = (np.log(np.maximum(one[:, 2], 1.0)) for one in (own, rivals))
    level, step = (np.log(np.maximum(own[:, None, n], 0.1) / np.maximum(rivals[:, n], 0.1)) for n in (3, 4))
    away = np.hypot(own[:, None, 0] - rivals[:, 0], own[:, None, 1] - rivals[:, 1]) / side
    third = np.sort(other)[-min(_MANY, len(other))]
    # A rival that is much dimmer or brighter is another thing.
    alike = np.exp(-np.square(level / 0.7) - np.square(step / 0.7)) * (away < _MOVES)
    return np.stack([height - third, (height[:, None] - other + away / _FADES).min(1), alike.max(1)], 1)


def _uneven(flow: NDArray[np.float32], cut: Cut) -> Array:
    """Standard deviation of the flow within each patch, in pixels, [N]."""
    near = _at(flow, cut, np.linspace(-HALF, HALF, 15))
    return np.hypot(*np.moveaxis(near.std((1, 2)), -1, 0))


def _at(flow: NDArray[np.float32], cut: Cut, step: Array) -> NDArray[np.float32]:
    """The flow at candidates' places and as many steps [n] from them, in pixels of their octaves, [N, n, n, 2]."""
    rows, columns = flow.shape[:2]
    h, w = cut.shape[:, :1], cut.shape[:, 1:]
    row = np.clip((cut.y[:, None] + step + 0.5) * rows / h, 0, rows - 1).astype(int)
    column = np.clip((cut.x[:, None] + step + 0.5) * columns / w, 0, columns - 1).astype(int)
    return flow[row[:, :, None], column[:, None, :]]


def _inside(x: NDArray[Any], y: NDArray[Any], shape: NDArray[np.int64]) -> Array:
    """How many pixels places lie inside frames of so many rows and columns [N, 2]: [N]."""
    return np.minimum.reduce([x, y, shape[:, 1] - 1 - x, shape[:, 0] - 1 - y]).astype(np.float64)


def shape(cut: Cut) -> tuple[Array, Array]:
    """Elongation (log of the axes' ratio) and fill (log of area over an ellipse's) of each candidate, [N]."""
    count = len(cut.x)
    wider = slice(HALF - _SHAPE - 3, HALF + _SHAPE + 4)
    along = np.arange(-_SHAPE, _SHAPE + 1)
    patch = _smoothed(cut.difference[:, wider, wider], 0.6)[:, 3:-3, 3:-3]
    patch = patch - _quantile(patch, cut.size, lambda s, r: r > 2.5 * s + 2, 0.5)[:, None, None]
    radius = np.hypot(along[:, None], along)
    middle = np.where(radius < 2.1, patch, -np.inf).reshape(count, -1)
    over = patch > 0.4 * np.maximum(middle.max(1), 0.5)[:, None, None]
    within = np.zeros((3, 3, 3), int)
    within[1] = 1
    labels = np.empty(over.shape, np.int32)
    ndimage.label(over, within, output=labels)
    flat = labels.reshape(count, -1)
    own = (flat == np.take_along_axis(flat, middle.argmax(1)[:, None], 1)) & (flat > 0)
    rows, columns = (one.ravel() for one in np.meshgrid(along, along, indexing="ij"))
    powers = np.stack([rows * 0 + 1, columns, rows, columns**2, rows**2, rows * columns], 1)
    sums = (own.astype(np.float32) @ powers.astype(np.float32)).astype(np.float64)
    area = np.maximum(sums[:, 0], 1)
    x, y, xx, yy, xy = (sums[:, 1:] / area[:, None]).T
    # A pixel alone has the second moment of a square.
    xx, yy, xy = xx - x**2 + 1 / 12, yy - y**2 + 1 / 12, xy - x * y
    middle_axis, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    long, short = middle_axis + apart, np.maximum(middle_axis - apart, 1e-3)
    return np.log(long / short) / 2, np.log(area / (4 * np.pi * np.sqrt(long * short)))


def _fresh(cut: Cut) -> Array:
    """Log of the height over the spread after the patch around each candidate is registered once more, [N]."""
    assert cut.dark is not None
    side = 2 * _AGAIN + 1
    wider = slice(HALF - _AGAIN - _REACH, HALF + _AGAIN + _REACH + 1)
    lit = _smoothed(cut.lit[:, wider, wider], 0.8)[:, _REACH:-_REACH, _REACH:-_REACH]
    dark = _smoothed(cut.dark[:, wider, wider], 0.8)
    radius = np.hypot(*np.mgrid[-_AGAIN : _AGAIN + 1, -_AGAIN : _AGAIN + 1])
    around = (radius > (2.5 * np.array(SIGMAS) + 1.5)[:, None, None]).astype(np.float32)
    # Every other pixel is enough to find the best shift: the pixels are smoothed.
    thin_lit = np.ascontiguousarray(lit[:, ::2, ::2])
    thin = [[np.ascontiguousarray(dark[:, row::2, column::2]) for column in (0, 1)] for row in (0, 1)]
    chosen = np.ascontiguousarray(around[:, ::2, ::2].reshape(len(SIGMAS), -1).T)
    errors = np.empty((2 * _REACH + 1, 2 * _REACH + 1, len(lit), len(SIGMAS)), np.float32)
    apart = np.empty_like(thin_lit)
    for row, column in np.ndindex(errors.shape[:2]):
        there = thin[row % 2][column % 2][:, row // 2 :, column // 2 :][:, : _AGAIN + 1, : _AGAIN + 1]
        np.square(np.subtract(thin_lit, there, out=apart), out=apart)
        np.matmul(apart.reshape(len(lit), -1), chosen, out=errors[row, column])
    best = errors[:, :, np.arange(len(lit)), cut.size].reshape(-1, len(lit)).argmin(0)
    left = np.empty_like(lit)
    for n, (row, column) in enumerate(zip(*(one.tolist() for one in np.divmod(best, 2 * _REACH + 1)), strict=True)):
        np.subtract(lit[n], dark[n, row : row + side, column : column + side], out=left[n])
    answer = differences_of_gaussians(left, cut.size)
    mine = around[cut.size]
    spread = np.sqrt((np.square(answer) * mine).sum((1, 2)) / mine.sum((1, 2))) + 0.3
    return np.log(np.maximum(answer[:, _AGAIN, _AGAIN] / spread, 0.3))


def _smoothed(stack: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    """Each patch, smoothed; where patches meet in the stack they mix a little, at their edges."""
    tall = cv2.GaussianBlur(np.ascontiguousarray(stack).reshape(-1, stack.shape[2]), (0, 0), sigma)
    return np.asarray(tall, dtype=np.float32).reshape(stack.shape)


def _quantile(
    values: NDArray[np.float32],
    size: NDArray[np.int64],
    where: Callable[[float, Array], NDArray[np.bool_]],
    share: float,
) -> Array:
    """Quantile over pixels of each patch, [N]: `where` says which, [h, w], for a standard deviation and radii."""
    half = values.shape[1] // 2
    radius = np.hypot(*np.mgrid[-half : half + 1, -half : half + 1])
    found = np.empty(len(values))
    for n, sigma in enumerate(SIGMAS):
        first, last = np.searchsorted(size, (n, n + 1))
        if last > first:
            chosen = values[first:last][:, where(sigma, radius)]
            at = share * (chosen.shape[1] - 1)
            low, up = math.floor(at), math.ceil(at)
            chosen.partition(low, axis=1)
            above = chosen[:, up:].min(1) if up > low else chosen[:, low]
            found[first:last] = chosen[:, low] + (at - low) * (above - chosen[:, low])
    return found
