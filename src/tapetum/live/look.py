"""The look of a return: numbers by which a camera of ours is recognised at another place.

A look consists of numbers that do not change when the camera turns about the line of sight: size, light, the light in
each ring, and how uneven it is along the rings. They change with the camera's gaze, so one camera has many looks; it is
recognised by those that were seen. Which cameras they distinguish was measured on the virtual bench
(`scripts/measure_looks.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.data.crop import crop

__all__ = ["LEAST", "NAMES", "TOLERANCE", "distance", "look", "resembles"]

Array = npt.NDArray[np.float64]

LEAST = 20.0
"""Least diameter, in pixels, of a return with a look: smaller ones all look alike."""
TOLERANCE = 0.5
"""How far a look of ours may lie from those that were seen. Rather too small, because a camera taken for ours is not
reported."""
_RINGS = 6
NAMES = ("size", "light", "uneven", *(f"ring {k + 1}" for k in range(_RINGS)))
"""What the numbers of a look are."""
# What counts as one step of each number: chosen by hand, the tolerance by scripts/measure_looks.py.
_SCALES = np.array([0.05, 0.12, 0.25, *([0.12] * _RINGS)])
_SIDE = 64  # of the reduced square
_SHARE = 0.75  # of the latest looks that must resemble


def look(
    image: npt.NDArray[np.generic], x: float, y: float, diameter: float, full_scale: float
) -> tuple[float, ...] | None:
    """Return the look of a return in a frame; None where it is too small, faint, or largely saturated.

    Parameters
    ----------
    image
        [H, W] digital numbers.
    x, y, diameter
        The return's place and diameter (D4 sigma), pixels.
    full_scale
        Digital number of a saturated pixel.
    """
    if not diameter >= LEAST:
        return None
    side = math.ceil(2 * diameter) + 4
    square = crop(image, (x, y), side).astype(np.float32)
    rim = max(2, side // 16)
    edge = np.concatenate(
        [square[:rim].ravel(), square[-rim:].ravel(), square[:, :rim].ravel(), square[:, -rim:].ravel()]
    )
    if np.mean(square >= full_scale) > 0.02:
        return None
    light = np.maximum(square - np.median(edge), 0) / full_scale
    small = cv2.resize(light, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float64)
    total = float(small.sum())
    if total <= 0:
        return None
    rows, columns = np.indices(small.shape)
    middle = np.array([(small * columns).sum(), (small * rows).sum()]) / total
    radius = np.hypot(columns - middle[0], rows - middle[1]) / (_SIDE / 4)
    # Amplitudes, in which faint rings count.
    amplitude = np.sqrt(small)
    ring = np.minimum((radius * _RINGS / 1.2).astype(int), _RINGS)
    count = np.bincount(ring.ravel(), minlength=_RINGS + 1)[:_RINGS]
    mean = np.bincount(ring.ravel(), amplitude.ravel(), _RINGS + 1)[:_RINGS] / np.maximum(count, 1)
    within = ring < _RINGS
    left = amplitude[within] - mean[ring[within]]
    uneven = float((left**2).sum() / max(float((amplitude[within] ** 2).sum()), 1e-12))
    flux = total * (side / _SIDE) ** 2
    profile = mean / max(float(mean.max()), 1e-12)
    return (math.log(diameter), math.log(flux), math.log(uneven + 1e-3), *profile.tolist())


def distance(one: Sequence[float], others: Array) -> float:
    """Return how far a look lies from the nearest of others [N, looks], root mean square in scales."""
    return float(np.sqrt(np.mean(((np.asarray(one) - others) / _SCALES) ** 2, axis=1)).min())


def resembles(latest: Sequence[Sequence[float]], known: Array, tolerance: float) -> bool:
    """Return whether most of a camera's latest looks resemble one that is known."""
    near = sum(distance(one, known) <= tolerance for one in latest)
    return bool(latest) and near >= _SHARE * len(latest)
