"""Patches of a frame: where each lies, and adding them up."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Patch", "add_patch", "bell", "moved"]


class Patch(NamedTuple):
    """Light on part of the probe's sensor: column and row of its upper left pixel, and electrons [h, w]."""

    left: int
    top: int
    light: npt.NDArray[np.float32]


def bell(place: npt.ArrayLike, height: float, sigma: float, reach: int) -> Patch:
    """Return a Gaussian of given height and width `sigma` at (x, y), drawn within `reach` of it, all in pixels."""
    left, top = (int(one) - reach for one in np.rint(place))
    offsets = (np.arange(2 * reach + 1) + c - p for c, p in zip((left, top), np.asarray(place), strict=True))
    across, down = (np.exp(-(one**2) / (2 * sigma**2)) for one in offsets)
    return Patch(left, top, (height * down[:, None] * across).astype(np.float32))


def moved(patch: Patch, by: npt.ArrayLike) -> Patch:
    """Return a patch moved by (x, y) pixels; parts of pixels by linear interpolation."""
    x, y = np.asarray(by, dtype=np.float64)
    column, row = math.floor(x), math.floor(y)
    light = np.pad(patch.light, ((0, 1), (0, 1)))
    for axis, part in ((1, x - column), (0, y - row)):
        light = (1 - part) * light + part * np.roll(light, 1, axis)
    return Patch(patch.left + column, patch.top + row, light.astype(np.float32))


def add_patch(frame: npt.NDArray[np.float32], patch: Patch, gain: float) -> None:
    """Add `gain` times a patch to a frame [H, W], clipped at its edges."""
    left, top, light = patch
    inside = frame[max(0, top) : max(0, top + light.shape[0]), max(0, left) : max(0, left + light.shape[1])]
    if inside.size:
        dy, dx = max(0, -top), max(0, -left)
        inside += np.float32(gain) * light[dy : dy + inside.shape[0], dx : dx + inside.shape[1]]
