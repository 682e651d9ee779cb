"""How a candidate looks: numbers that tell a camera from edges, foliage, lettering and people.

Each is a logarithm or a share, so that a weighted sum of them can be the logarithm of odds (score.py).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tapetum.detection.candidates import HALF, SIGMAS, Octave, difference_of_gaussians, patches

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


def looks(octave: Octave, local: NDArray[np.float32], full_scale: float, flow: NDArray[np.float32] | None) -> Array:
    """Measure the candidates of an octave, [N, features]; "outlier" stays 0 until all octaves are known.

    Parameters
    ----------
    octave
        The candidates.
    local
        [H, W] local mean of the lit frame.
    full_scale
        Level at which the lit frame saturates.
    flow
        [H, W, 2] of the registration, for a pair.
    """
    x, y, at = octave.x, octave.y, np.arange(len(octave.x))
    sigma = np.array(SIGMAS)[octave.size]
    radius = np.hypot(*np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1])[None]

    def chosen(stack: list[NDArray[np.float32]]) -> NDArray[np.float32]:
        return np.stack([patches(one, x, y, HALF) for one in stack])[octave.size, at]

    answer, of_lit = chosen(octave.answers), chosen(octave.lit_answers)
    height, lit_height = answer[:, HALF, HALF], of_lit[:, HALF, HALF]
    beyond = radius > (4 * sigma + 2)[:, None, None]
    rest = _quantile(np.abs(answer), beyond, 0.995)
    ring = (radius > (3 * sigma + 2)[:, None, None]) & (radius <= 12)
    second = _quantile(of_lit, ring, 0.98)
    rows, columns = local.shape
    place_x = np.clip(((x + 0.5) * octave.step).astype(int), 0, columns - 1)
    place_y = np.clip(((y + 0.5) * octave.step).astype(int), 0, rows - 1)
    bright = np.maximum(local[place_y, place_x], 0.02 * full_scale)
    elongation, fill = shape(octave, sigma)
    h, w = octave.lit.shape
    edge = np.minimum.reduce([x, y, w - 1 - x, h - 1 - y])
    peak = patches(octave.lit, x, y, 1).max((1, 2))
    own = [
        np.log(octave.height),
        np.zeros(len(x)),
        np.log(np.maximum(lit_height, 0.1) / (0.1 * bright + 0.012 * full_scale)),
        np.clip((lit_height - second) / np.maximum(lit_height, 1), -1, 1),
        np.log(np.maximum(height, 0.1) / (rest + 0.5)),
        elongation,
        fill,
        np.clip((edge - 1) / 4, 0, 1),
        np.log(sigma * octave.step),
        (peak >= 0.98 * full_scale).astype(float),
    ]
    if flow is None:
        return np.stack(own, 1)
    of_dark = np.where(radius <= 4, chosen(octave.dark_answers), -np.inf).max((1, 2))
    near = flow[:: octave.step, :: octave.step][:h, :w]
    uneven = np.hypot(*(patches(np.ascontiguousarray(near[..., n]), x, y, HALF).std((1, 2)) for n in (0, 1)))
    own += [
        np.clip(1 - np.maximum(of_dark, 0) / np.maximum(lit_height, 1), -1, 1),
        _fresh(octave, sigma),
        np.log(0.3 + uneven),
    ]
    return np.stack(own, 1)


def shape(octave: Octave, sigma: Array) -> tuple[Array, Array]:
    """Elongation (log of the axes' ratio) and fill (log of area over an ellipse's) of each candidate, [N]."""
    x, y = octave.x, octave.y
    smooth = ndimage.gaussian_filter(octave.difference, 0.6)
    patch = patches(smooth, x, y, _SHAPE)
    radius = np.hypot(*np.mgrid[-_SHAPE : _SHAPE + 1, -_SHAPE : _SHAPE + 1])
    if octave.dark is None:
        patch = patch - _quantile(patch, radius[None] > (2.5 * sigma + 2)[:, None, None], 0.5)[:, None, None]
    middle = np.where(radius < 2.1, patch, -np.inf).reshape(len(x), -1)
    over = patch > 0.4 * np.maximum(middle.max(1), 0.5)[:, None, None]
    within = np.zeros((3, 3, 3), int)
    within[1] = 1
    labels = np.empty(over.shape, np.int32)
    ndimage.label(over, within, output=labels)
    flat = labels.reshape(len(x), -1)
    own = (labels == np.take_along_axis(flat, middle.argmax(1)[:, None], 1)[:, :, None]) & (labels > 0)
    rows, columns = np.mgrid[-_SHAPE : _SHAPE + 1, -_SHAPE : _SHAPE + 1]
    count = np.maximum(own.sum((1, 2)), 1)

    def mean(values: NDArray) -> Array:
        return (own * values).sum((1, 2)) / count

    # A pixel alone has the second moment of a square.
    xx = mean(columns**2) - mean(columns) ** 2 + 1 / 12
    yy = mean(rows**2) - mean(rows) ** 2 + 1 / 12
    xy = mean(rows * columns) - mean(rows) * mean(columns)
    middle_axis, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    long, short = middle_axis + apart, np.maximum(middle_axis - apart, 1e-3)
    return np.log(long / short) / 2, np.log(count / (4 * np.pi * np.sqrt(long * short)))


def _fresh(octave: Octave, sigma: Array) -> Array:
    """Log of the height over the spread after the patch around each candidate is registered once more, [N]."""
    assert octave.dark is not None
    side = 2 * _AGAIN + 1
    lit = patches(ndimage.gaussian_filter(octave.lit, 0.8), octave.x, octave.y, _AGAIN)
    dark = patches(ndimage.gaussian_filter(octave.dark, 0.8), octave.x, octave.y, _AGAIN + _REACH)
    radius = np.hypot(*np.mgrid[-_AGAIN : _AGAIN + 1, -_AGAIN : _AGAIN + 1])
    around = radius[None] > (2.5 * sigma + 1.5)[:, None, None]
    least, left = np.full(len(lit), np.inf), np.zeros_like(lit)
    for row in range(2 * _REACH + 1):
        for column in range(2 * _REACH + 1):
            apart = lit - dark[:, row : row + side, column : column + side]
            error = np.einsum("nij,nij,nij->n", apart, apart, around)
            better = error < least
            least[better], left[better] = error[better], apart[better]
    answer = np.stack([difference_of_gaussians(one, s) for one, s in zip(left, sigma, strict=True)])
    spread = np.sqrt((answer**2 * around).sum((1, 2)) / around.sum((1, 2))) + 0.3
    return np.log(np.maximum(answer[:, _AGAIN, _AGAIN] / spread, 0.3))


def _quantile(values: NDArray, where: NDArray[np.bool_], share: float) -> Array:
    """Quantile over the pixels of each patch that are chosen, [N]; places do not depend on the patch."""
    found = np.empty(len(values))
    kinds, of = np.unique(where.reshape(len(where), -1), axis=0, return_inverse=True)
    flat = values.reshape(len(values), -1)
    for n, kind in enumerate(kinds):
        mine = of == n
        found[mine] = np.quantile(flat[mine][:, kind], share, axis=1)
    return found
