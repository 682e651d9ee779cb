"""Inference by turns: of many spots the models see, in each frame, as many as a time budget allows, oldest estimate
first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.track.detections import Detections
from tapetum.track.rows import TrackRow

__all__ = ["Turns"]

_NEAR = 40.0  # pixels within which a spot is taken for the track that was there in the frame before
_ROOM = 0.7  # share of the budget below which one spot more is asked about
_FIRST = 2


@dataclass
class Turns:
    """Chooses the spots of each frame that models are asked about, so that they take no longer than a budget.

    New spots come first, then those whose estimates are the oldest. At least one is asked about, however long that
    takes. How many follows from how long the last ones took.

    Parameters
    ----------
    budget
        Seconds a frame.
    """

    budget: float
    _most: int = field(default=_FIRST, init=False)
    # By track: its place in the latest frame, and when it was last asked about.
    _known: dict[int, tuple[float, float, float]] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.budget) and self.budget > 0):
            raise InputError(f"must be positive, is {self.budget}", where="budget", remedy="give seconds, as 0.02")

    def choose(self, found: Detections) -> NDArray[np.intp]:
        """Return the numbers of the spots whose turn it is, ghosts aside."""
        spots = np.flatnonzero(~found.ghost)
        if len(spots) <= self._most:
            return spots
        asked = np.full(len(spots), -math.inf)
        if self._known:
            known = np.array(list(self._known.values()))
            apart = np.hypot(found.x[spots, None] - known[:, 0], found.y[spots, None] - known[:, 1])
            nearest = apart.argmin(1)
            asked = np.where(apart.min(1) <= _NEAR, known[nearest, 2], -math.inf)
        # Brighter ones come first among equals, as detectors give them.
        return np.sort(spots[np.argsort(asked, kind="stable")[: self._most]])

    def spent(self, count: int, seconds: float) -> None:
        """Take how long the models took for so many spots."""
        if not count:
            return
        if seconds > self.budget:
            self._most = max(1, min(self._most, math.floor(count * self.budget / seconds)))
        elif count >= self._most and seconds < _ROOM * self.budget * count / (count + 1):
            self._most += 1

    def followed(self, rows: Sequence[TrackRow], time: float) -> None:
        """Take the tracks that a frame's spots went to."""
        before = self._known
        self._known = {
            row.track: (
                row.x,
                row.y,
                time if "applies" in row.estimates else before.get(row.track, (0, 0, -math.inf))[2],
            )
            for row in rows
        }
