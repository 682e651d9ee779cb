"""A piece of a frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Patch", "add_patch"]


class Patch(NamedTuple):
    """Light on part of the probe's sensor: column and row of its upper left pixel, and electrons [h, w]."""

    left: int
    top: int
    light: npt.NDArray[np.float32]


def add_patch(frame: npt.NDArray[np.float32], patch: Patch, gain: float) -> None:
    """Add a patch, times `gain`, to a frame [H, W] as far as it lies inside."""
    left, top, light = patch
    inside = frame[max(0, top) : max(0, top + light.shape[0]), max(0, left) : max(0, left + light.shape[1])]
    if inside.size:
        dy, dx = max(0, -top), max(0, -left)
        inside += np.float32(gain) * light[dy : dy + inside.shape[0], dx : dx + inside.shape[1]]
