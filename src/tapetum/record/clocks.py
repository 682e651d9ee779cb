"""Two streams, two cameras, one clock: which frames of the one lie around each frame of the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tapetum.errors import InputError
from tapetum.record.layout import iso
from tapetum.record.recording import Recording

__all__ = ["Joined", "join"]


@dataclass(frozen=True, eq=False)
class Joined:
    """For each frame of one stream, the two frames of another that bracket it in time.

    Attributes
    ----------
    before, after
        [N] index of the frame of the other stream at or before, and after, each frame; -1 where none is near enough.
    weight
        [N] how far the frame lies from `before` (0) to `after` (1); 0 where there is none.
    gap
        [N] time to the nearer of the two in seconds; infinite where there is none.
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

    def interpolate(self, values: np.ndarray) -> np.ndarray:
        """Interpolate values [M] or [M, K] of the other stream's frames at each frame of this one: [N] or [N, K].

        By the cubic through the two frames on either side, where there are four and no gap is more than twice the
        middle one: a straight line would cut the corners of a hand's path, by an eighth of its acceleration times the
        square of the frame interval. Elsewhere by a straight line; NaN without neighbours, or where one of them is NaN.
        """
        given = np.asarray(values, np.float64)
        frames, straight, cubic, _ = self._shares()

        def mixed(shares: np.ndarray) -> np.ndarray:
            shares = shares.reshape(*shares.shape, *[1] * (given.ndim - 1))
            # A frame without a share must not spread its NaN.
            return np.where(shares != 0, shares * given[frames], 0).sum(axis=1)

        out = np.full((len(self), *given.shape[1:]), np.nan)
        curve = mixed(cubic)
        known = np.isfinite(curve).all(axis=tuple(range(1, curve.ndim)), keepdims=True)
        out[self.found] = np.where(known, curve, mixed(straight))
        return out

    def _shares(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The four frames about each one that has neighbours, their shares in a line and in a cubic, and its time."""
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
        """How far `interpolate` reaches back and ahead of each frame, [N, 2] in seconds; NaN without neighbours.

        To the farthest frame of the other stream that has a share, and half a frame interval more for its exposure.
        """
        out = np.full((len(self), 2), np.nan)
        frames, _, cubic, moment = self._shares()
        used, times = cubic != 0, self.times[frames]
        first, last = np.where(used, times, np.inf).min(axis=1), np.where(used, times, -np.inf).max(axis=1)
        half = np.median(np.diff(self.times)) / 2 if len(self.times) > 1 else 0.0
        out[self.found] = np.stack([moment - first, last - moment], axis=1) + half
        return out


def rising(recording: Recording, stream: str) -> np.ndarray:
    """Return a stream's UTC in ns, [N] int64, checked to be usable."""
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
        The recording with both streams, the one whose every frame gets an answer, and the one in which to look.
    tolerance
        Farthest that the nearer neighbour may be, in seconds; by default 0.75 of the other stream's median frame
        interval, so that a lone lost frame is bridged except in the middle of its gap.
    offset
        Seconds to add to the other stream's UTC, where its clock is known to be wrong.

    Raises
    ------
    InputError
        When a stream is missing or empty, its UTC does not rise, or the two do not overlap at all.
    """
    wanted = rising(recording, onto)
    there = rising(recording, other) + round(offset * 1e9)
    if there[-1] < wanted[0] or there[0] > wanted[-1]:
        first, last, begin, end = (iso(int(one), "milliseconds") for one in (*wanted[[0, -1]], *there[[0, -1]]))
        what = f"the clocks of {onto} and {other} do not overlap: {first} to {last} and {begin} to {end}"
        remedy = "set both cameras by one clock and record again, or give the offset between them"
        raise InputError(what, where=recording.path, remedy=remedy)
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
