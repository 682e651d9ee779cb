"""Pieces of a frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

__all__ = ["Patch", "add_patch", "bell"]


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


def add_patch(frame: npt.NDArray[np.float32], patch: Patch, gain: float) -> None:
    """Add `gain` times a patch to a frame [H, W], clipped at its edges."""
    left, top, light = patch
    inside = frame[max(0, top) : max(0, top + light.shape[0]), max(0, left) : max(0, left + light.shape[1])]
    if inside.size:
        dy, dx = max(0, -top), max(0, -left)
        inside += np.float32(gain) * light[dy : dy + inside.shape[0], dx : dx + inside.shape[1]]
