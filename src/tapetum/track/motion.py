"""The motion that all of a picture shares, because a hand-held probe shakes by far more than its targets move.

It is removed before spots are assigned, so that each track keeps only its own motion. A detector that sees the room
finds it from the pictures (`tapetum.detection.global_motion`). Where spots are all there is, every pair of a track's
expected place and a spot like it votes for a shift; the shift with most votes is refined by a rotation and scale where
enough pairs agree.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["MOTION", "common_motion", "motion_columns", "motion_of"]

Array = NDArray[np.float64]

# Pixels within which pairs agree; side of the bins that are counted.
_AGREE = 10.0
# Fewest pairs that fix a common shift, and a rotation and scale besides.
_FEWEST, _TURNED = 3, 4
# Largest rotation (rad) or change of scale between frames; what exceeds it is a chance.
_LARGEST_TURN = 0.1


MOTION = ("shift_x", "shift_y", "turn", "scale")
"""Columns for a frame's motion since the one before: shift of its middle, pixels; turn from x to y, rad; and scale."""


def motion_columns(motion: Array | None, size: tuple[int, int]) -> dict[str, float]:
    """Return what `MOTION` names of a matrix [2, 3], for a frame of (width, height) pixels; empty without one."""
    if motion is None:
        return {}
    (a, b), middle = motion[:, 0].tolist(), (np.array(size) - 1) / 2
    shift = motion[:, :2] @ middle + motion[:, 2] - middle
    return dict(zip(MOTION, (*shift.tolist(), math.atan2(b, a), math.hypot(a, b)), strict=True))


def motion_of(columns: Mapping[str, Any], size: tuple[int, int] | None) -> Array | None:
    """Return the matrix [2, 3] of `motion_columns`; None where a column, or the size, is missing or empty."""
    x, y, turn, scale = (columns.get(name) for name in MOTION)
    if size is None or x is None or y is None or turn is None or scale is None:
        return None
    a, b, middle = scale * math.cos(turn), scale * math.sin(turn), (np.array(size) - 1) / 2
    turned = np.array([[a, -b], [b, a]])
    return np.column_stack([turned, middle + np.array([x, y]) - turned @ middle])


def common_motion(expected: Array, found: Array, alike: NDArray[np.bool_], limit: float) -> Array | None:
    """Find where the expected places of tracks went together.

    Parameters
    ----------
    expected
        [T, 2] places of the tracks, in pixels.
    found
        [N, 2] places of the spots.
    alike
        [T, N] which pairs may be the same by their looks.
    limit
        Largest shift in pixels.

    Returns
    -------
    array or None
        [2, 3] matrix A of the motion, ``A @ (x, y, 1)``; None where no shift has the votes of three tracks and of half
        of those that could vote.

    Examples
    --------
    >>> places = np.array([[0.0, 0], [100, 30], [40, 90], [70, 200]])
    >>> motion = common_motion(places, places + [33, -50], np.ones((4, 4), bool), 100)
    >>> np.round(motion, 6).tolist()
    [[1.0, 0.0, 33.0], [0.0, 1.0, -50.0]]
    """
    apart = found[None] - expected[:, None]
    able = alike & (np.hypot(apart[..., 0], apart[..., 1]) <= limit)
    needed = max(_FEWEST, 0.5 * min(int(able.any(1).sum()), int(able.any(0).sum())))
    votes = apart[able]
    if len(votes) < needed:
        return None
    side = 2 * int(np.ceil(limit / _AGREE)) + 3
    row, column = ((votes + limit) // _AGREE).astype(int).T + 1
    count = np.bincount(row * side + column, minlength=side * side).reshape(side, side)
    near = np.sum([np.roll(count, (a, b), (0, 1)) for a in (-1, 0, 1) for b in (-1, 0, 1)], axis=0)
    # Of shifts with as many votes the smallest.
    reach = np.arange(side) - side // 2
    best = np.argmax(near - 1e-3 * np.hypot(reach[:, None], reach[None]))
    middle = (np.array(np.unravel_index(best, near.shape)) - 0.5) * _AGREE - limit
    shift = np.median(votes[np.abs(votes - middle).max(1) <= 1.5 * _AGREE], axis=0)
    one, other = _partners(expected + shift, found, able)
    if len(one) < needed:
        return None
    shift = np.median(found[other] - expected[one], axis=0)
    matrix = np.column_stack([np.eye(2), shift])
    if len(one) >= _TURNED:
        turned = _similarity(expected[one], found[other])
        if np.abs(turned[:, :2] - np.eye(2)).max() <= _LARGEST_TURN:
            matrix = turned
    return matrix


def _partners(expected: Array, found: Array, able: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers of the pairs that are each other's nearest, and agree."""
    distance = np.where(able, np.linalg.norm(found[None] - expected[:, None], axis=2), np.inf)
    nearest = distance.argmin(1)
    one = np.arange(len(expected))
    mutual = (distance.argmin(0)[nearest] == one) & (distance[one, nearest] <= 1.5 * _AGREE)
    return one[mutual], nearest[mutual]


def _similarity(before: Array, after: Array) -> Array:
    """Rotation, scale and shift, [2, 3], that bring places [N, 2] onto others with least squares."""
    middle, to = before.mean(0), after.mean(0)
    a, b = (before - middle) @ np.array([1, 1j]), (after - to) @ np.array([1, 1j])
    power = float((np.abs(a) ** 2).sum())
    turn = complex((a.conj() * b).sum() / power) if power > 0 else 1.0 + 0j
    rotation = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
    return np.column_stack([rotation, to - rotation @ middle])
