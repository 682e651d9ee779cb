"""SNR of a retro-reflection in its crop, on which most of an estimate's error depends."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.models.features import as_images, check_levels

__all__ = ["crop_snr"]

# Excess below this many standard deviations is ignored: the noise of 160 000 dark pixels would add up to a signal.
_GATE = 4.0
# Side of the four squares in the corners of a crop that lie outside its inscribed disc.
_CORNER = (1 - math.sqrt(0.5)) / 2
# Pixels across such a square at least: noise is taken of the differences of neighbours.
_LEAST_CORNER = 2


def crop_snr(images: NDArray[np.generic], full_scale: float | None = None) -> NDArray[np.float64]:
    """Return the signal-to-noise ratio [N] of a matched filter that knows the image.

    This is the root of the summed squared excess over the background, divided by a dark pixel's standard deviation. The
    background is the crop's median. The noise comes from the differences of neighbouring pixels in the four corners,
    outside the inscribed disc, and is at least the rounding noise. Shot noise of the RR itself is not counted.

    Parameters
    ----------
    images
        [N, side, side] crops centred on the RR, counts.
    full_scale
        Largest count of the camera; 255 by default for uint8.

    Raises
    ------
    InputError
        For images that are no square crops of 4 pixels or more, or whose levels are negative or not finite.
    """
    array, _ = as_images(images, full_scale)
    check_levels(array)
    if array.shape[1] < 2 * _LEAST_CORNER:
        what = f"crops of {array.shape[1]} x {array.shape[1]} pixels have no corners of {_LEAST_CORNER} pixels"
        raise InputError(what, where="images", remedy=f"give {2 * _LEAST_CORNER} pixels or more a side")
    edge = max(_LEAST_CORNER, round(_CORNER * array.shape[1]))
    ends = np.r_[:edge, -edge:0]
    corners = array[:, ends[:, None], ends].astype(np.float64)
    # Not across the gap between the left and the right corners.
    steps = np.abs(np.diff(corners.reshape(len(array), 2 * edge, 2, edge), axis=3))
    # Neighbours differ by 2/sqrt(pi) deviations of one in the mean.
    noise = np.maximum(math.sqrt(math.pi) / 2 * steps.mean(axis=(1, 2, 3)), 1 / math.sqrt(12))
    return np.array([_strength(*one) for one in zip(array, noise.tolist(), strict=True)]) / noise


def _strength(image: NDArray[np.generic], noise: float) -> float:
    """Return the root of the summed squared excess over the median."""
    if image.dtype.kind == "f":
        levels, count = image.ravel().astype(np.float64), np.ones(image.size)
        middle = float(np.median(levels))
    else:
        # Integer counts take few values, so a histogram gives the median and the sum.
        count = _counts(image)
        levels = np.arange(len(count))
        middle = float(np.searchsorted(np.cumsum(count), image.size / 2))
    excess = levels - middle
    return math.sqrt(float((count * np.where(excess > _GATE * noise, excess, 0.0) ** 2).sum()))


def _counts(image: NDArray[np.generic]) -> NDArray[Any]:
    """Return how many pixels have each integer count; of bytes several times faster than numpy's."""
    if image.dtype != np.uint8:
        return np.bincount(image.ravel())
    pixels = np.ascontiguousarray(image, dtype=np.uint8)
    return cv2.calcHist([pixels], [0], None, [256], [0, 256]).ravel().astype(np.intp)
