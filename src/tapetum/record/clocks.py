"""Joining two streams by UTC: which frames of one lie around each frame of the other. (`calibrate.sync` measures
lags.)"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tapetum.errors import InputError
from tapetum.record.layout import iso
from tapetum.record.recording import Recording

__all__ = ["Joined", "NoOverlapError", "join"]


class NoOverlapError(InputError):
    """Two streams have no moment in common."""


@dataclass(frozen=True, eq=False)
class Joined:
    """For each frame of one stream, the two frames of another that bracket it in time.

    Attributes
    ----------
    before, after
        [N] index of the other stream's frame at or before, and after, each frame; -1 where none is near enough.
    weight
        [N] position of the frame between `before` (0) and `after` (1); 0 without them.
    gap
        [N] time to the nearer of the two in seconds; infinite without them.
    times
        [M] of the other stream's frames, in seconds from the first.
    """

    before: np.ndarray
    after: np.ndarray
    weight: np.ndarray
    gap: np.ndarray
    times: np.ndarray

    @property
    def found(self) -> np.ndarray:
        """Whether each frame has its two neighbours, [N] bool."""
        return self.before >= 0

    def __len__(self) -> int:
        return len(self.before)

    def at_rows(self, rows: np.ndarray, moments: np.ndarray) -> Joined:
        """Return the same neighbours at times of their own, where a shutter rolls.

        `rows` [M] are the times of what is interpolated in the other stream's frames, `moments` [N] those of this
        stream's frames, both in seconds from the other stream's first frame.
        """
        low, high = rows[np.maximum(self.before, 0)], rows[np.maximum(self.after, 0)]
        inside = self.found & (high > low)
        weight = np.where(inside, (moments - low) / np.where(inside, high - low, 1), 0.0)
        return replace(self, times=rows, weight=weight)

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values [M] or [M, K] of the other stream's frames at each frame of this one: [N] or [N, K].

        The cubic through the two frames on either side is used if there are four and no gap is more than twice the
        middle one; a straight line would be off by an eighth of the acceleration times the frame interval squared.
        Elsewhere a straight line is used; NaN without neighbours, or where one of them is NaN.
        """
        given = np.asarray(values, np.float64)
        frames, straight, cubic, _ = self._shares()

        def mixed(shares: np.ndarray) -> np.ndarray:
            shares = shares.reshape(*shares.shape, *[1] * (given.ndim - 1))
            # A NaN with weight 0 must not spread.
            return np.where(shares != 0, shares * given[frames], 0).sum(axis=1)

        out = np.full((len(self), *given.shape[1:]), np.nan)
        curve = mixed(cubic)
        known = np.isfinite(curve).all(axis=tuple(range(1, curve.ndim)), keepdims=True)
        out[self.found] = np.where(known, curve, mixed(straight))
        return out

    def _shares(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the four frames about each frame with neighbours, their linear and cubic weights, and its time."""
        before, after, weight = (one[self.found] for one in (self.before, self.after, self.weight))
        frames = np.stack([before - 1, before, after, after + 1], axis=1).clip(0, len(self.times) - 1)
        times = self.times[frames]
        gap = np.diff(times, axis=1)
        moment = times[:, 1] + weight * gap[:, 1]
        straight = np.stack([0 * weight, 1 - weight, weight, 0 * weight], axis=1)
        curved = (weight > 0) & (before > 0) & (after < len(self.times) - 1)
        curved &= (gap[:, [0, 2]] <= 2 * gap[:, 1:2]).all(axis=1)
        cubic, known = straight.copy(), times[curved]
        for k in range(4):
            others = np.delete(known, k, axis=1)
            cubic[curved, k] = ((moment[curved, None] - others) / (known[:, k : k + 1] - others)).prod(axis=1)
        return frames, straight, cubic, moment

    def reach(self) -> np.ndarray:
        """Return how far `interpolate` reaches back and ahead of each frame, [N, 2] in seconds; NaN without neighbours.

        It reaches to the farthest frame used, plus half a frame interval for its exposure.
        """
        out = np.full((len(self), 2), np.nan)
        frames, _, cubic, moment = self._shares()
        used, times = cubic != 0, self.times[frames]
        first, last = np.where(used, times, np.inf).min(axis=1), np.where(used, times, -np.inf).max(axis=1)
        half = np.median(np.diff(self.times)) / 2 if len(self.times) > 1 else 0.0
        out[self.found] = np.stack([moment - first, last - moment], axis=1) + half
        return out


def rising(recording: Recording, stream: str) -> np.ndarray:
    """Return a stream's UTC in ns, [N] int64; raise an InputError when it is empty or does not rise."""
    times = recording.utc_ns(stream)
    if not len(times):
        raise InputError(f"stream {stream} holds no frames", where=recording.path, remedy="record again")
    if len(back := np.flatnonzero(np.diff(times) <= 0)):
        what = f"UTC of stream {stream} does not rise at frame {back[0] + 1} (its clock was set meanwhile)"
        raise InputError(what, where=recording.path, remedy="record again with the clock left alone")
    return times


def join(
    recording: Recording,
    onto: str = "probe",
    other: str = "target",
    tolerance: float | None = None,
    *,
    offset: float = 0.0,
) -> Joined:
    """Find, by UTC, the frames of one stream around each frame of another.

    Parameters
    ----------
    recording, onto, other
        The recording, the stream whose frames get neighbours, and the stream to search.
    tolerance
        Largest distance to the nearer neighbour in seconds; by default 0.75 of the other stream's median frame
        interval, which bridges a single lost frame except in the middle of its gap.
    offset
        Seconds to add to the other stream's UTC, where its clock is known to be wrong.

    Raises
    ------
    InputError
        When a stream is missing or empty, or its UTC does not rise; when the two do not overlap, `NoOverlapError`.
    """
    wanted = rising(recording, onto)
    there = rising(recording, other) + round(offset * 1e9)
    if there[-1] < wanted[0] or there[0] > wanted[-1]:
        first, last, begin, end = (iso(int(one), "milliseconds") for one in (*wanted[[0, -1]], *there[[0, -1]]))
        what = f"the clocks of {onto} and {other} do not overlap: {first} to {last} and {begin} to {end}"
        remedy = "set both cameras by one clock and record again, or give the offset between them"
        raise NoOverlapError(what, where=recording.path, remedy=remedy)
    period = float(np.median(np.diff(there))) if len(there) > 1 else 1e9 / float(recording.streams[other].rate or 15)
    limit = 0.75 * period if tolerance is None else tolerance * 1e9
    after = np.searchsorted(there, wanted, side="right")
    before = after - 1
    exact = (before >= 0) & (there[np.maximum(before, 0)] == wanted)
    after = np.where(exact, before, after)
    inside = (before >= 0) & (after < len(there))
    low, high = there[np.clip(before, 0, None)], there[np.clip(after, None, len(there) - 1)]
    gap = np.where(inside, np.minimum(wanted - low, high - wanted), np.inf)
    inside &= gap <= limit
    weight = np.where(inside, (wanted - low) / np.maximum(high - low, 1), 0.0)
    before, after = np.where(inside, before, -1), np.where(inside, after, -1)
    return Joined(before, after, weight, np.where(inside, gap, np.inf) / 1e9, (there - there[0]) / 1e9)
