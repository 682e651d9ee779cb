"""How far a retro-reflection stands out of the noise of its picture: what most of an estimate's error depends on."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tapetum.models.features import as_images

__all__ = ["crop_snr"]

# Excess below so many deviations is left out: the noise of 160 000 dark pixels would add up to a signal.
_GATE = 4.0
# Side of the four squares in the corners of a crop that lie outside its inscribed disc.
_CORNER = (1 - math.sqrt(0.5)) / 2


def crop_snr(images: NDArray[np.generic], full_scale: float | None = None) -> NDArray[np.float64]:
    """Return the signal-to-noise ratio of a matched filter that knows the picture, [N].

    The root of the summed squares of what stands out of the background, over the deviation of a dark pixel. The
    background is the median of the crop, the noise comes from the differences of neighbours in its four corners,
    outside the inscribed disc, and is never below that of rounding. Shot noise of the retro-reflection itself is not
    counted.

    Parameters
    ----------
    images
        [N, side, side] crops centred on the RR, counts.
    full_scale
        Largest count of the camera; 255 for uint8 where left out.
    """
    array, _ = as_images(images, full_scale)
    edge = max(2, round(_CORNER * array.shape[1]))
    ends = np.r_[:edge, -edge:0]
    corners = array[:, ends[:, None], ends].astype(np.float64)
    # Not across the gap between the left and the right corners.
    steps = np.abs(np.diff(corners.reshape(len(array), 2 * edge, 2, edge), axis=3))
    # Neighbours differ by 2/sqrt(pi) deviations of one in the mean.
    noise = np.maximum(math.sqrt(math.pi) / 2 * steps.mean(axis=(1, 2, 3)), 1 / math.sqrt(12))
    return np.array([_strength(*one) for one in zip(array, noise.tolist(), strict=True)]) / noise


def _strength(image: NDArray[np.generic], noise: float) -> float:
    """Root of the summed squares of what stands out of the median."""
    if image.dtype.kind == "f":
        levels, count = image.ravel().astype(np.float64), np.ones(image.size)
        middle = float(np.median(levels))
    else:
        # A camera's counts are few: all that is asked for stands in how often each occurs.
        count = np.bincount(image.ravel())
        levels = np.arange(len(count))
        middle = float(np.searchsorted(np.cumsum(count), image.size / 2))
    excess = levels - middle
    return math.sqrt(float((count * np.where(excess > _GATE * noise, excess, 0.0) ** 2).sum()))
