"""Two streams, two cameras, one clock: which frames of the one lie around each frame of the other."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from tapetum.errors import InputError
from tapetum.record.recording import Recording

__all__ = ["Joined", "join"]


@dataclass(frozen=True, eq=False)
class Joined:
    """For each frame of one stream, the two frames of another that bracket it in time.

    Attributes
    ----------
    before, after
        Index of the frame of the other stream at or before, and after, each frame; -1 where there is none
        near enough. [N] int64.
    weight
        How far the frame lies from `before` (0) to `after` (1); 0 where there is none. [N] float64.
    gap
        Time to the nearer of the two in seconds; infinite where there is none. [N] float64.
    times
        Of the other stream's frames, in seconds from the first. [M] float64.
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
        """Carry values of the other stream's frames over, along a smooth path in time.

        The cubic through the two frames on either side, where there are four and no gap is more than twice the middle
        one: a straight line would cut the corners of a hand's path, by an eighth of its acceleration times the square
        of the frame interval. A straight line where there are not.

        Parameters
        ----------
        values
            [M] or [M, K], a value for every frame of the other stream.

        Returns
        -------
        numpy.ndarray
            [N] or [N, K] float64; NaN where a frame has no neighbours, or one that counts has NaN.
        """
        given = np.asarray(values, np.float64)
        out = np.full((len(self), *given.shape[1:]), np.nan)
        there = self.found
        before, after, weight = self.before[there], self.after[there], self.weight[there]
        wide = weight.reshape(-1, *[1] * (given.ndim - 1))
        # A neighbour of weight 0 does not count: its NaN must not spread.
        out[there] = np.where(wide > 0, (1 - wide) * given[before] + wide * given[after], given[before])

        inside = self._curved(before, after, weight)
        four = np.stack([before - 1, before, after, after + 1])[:, inside]
        times, place = self.times[four], weight[inside]
        moment = times[1] + place * (times[2] - times[1])
        shares = np.ones_like(times)
        for k in range(4):
            for other in range(4):
                if other != k:
                    shares[k] *= (moment - times[other]) / (times[k] - times[other])
        curve = (shares.reshape(4, -1, *[1] * (given.ndim - 1)) * given[four]).sum(axis=0)
        known = np.isfinite(curve).all(axis=tuple(range(1, curve.ndim)))
        out[np.flatnonzero(there)[inside][known]] = curve[known]
        return out

    def _curved(self, before: np.ndarray, after: np.ndarray, weight: np.ndarray) -> np.ndarray:
        """Whether the two frames beyond the neighbours count too, [n] bool."""
        inside = (weight > 0) & (before > 0) & (after < len(self.times) - 1)
        four = np.stack([before - 1, before, after, after + 1])[:, inside]
        gap = np.diff(self.times[four], axis=0)
        inside[inside] = (gap[[0, 2]] <= 2 * gap[1]).all(axis=0)
        return inside

    def reach(self) -> np.ndarray:
        """How far `interpolate` reaches back and ahead of each frame, [N, 2] in seconds; NaN without neighbours.

        To the farthest frame of the other stream that has a say, and half a frame interval more for its exposure.
        """
        out = np.full((len(self), 2), np.nan)
        there = self.found
        before, after, weight = self.before[there], self.after[there], self.weight[there]
        curved = self._curved(before, after, weight)
        moment = self.times[before] + weight * (self.times[after] - self.times[before])
        first, last = before - curved, np.where(weight > 0, after, before) + curved
        half = np.median(np.diff(self.times)) / 2 if len(self.times) > 1 else 0.0
        out[there] = np.stack([moment - self.times[first], self.times[last] - moment], axis=1) + half
        return out


def span(times: np.ndarray) -> str:
    """Return first and last moment (ns UTC) for a message."""
    ends = (datetime.fromtimestamp(int(value) / 1e9, UTC) for value in (times[0], times[-1]))
    return " to ".join(moment.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3] + "Z" for moment in ends)


def rising(recording: Recording, stream: str) -> np.ndarray:
    """Return a stream's UTC in ns, [N] int64, checked to be usable."""
    times = recording.utc_ns(stream)
    if not len(times):
        raise InputError(f"stream {stream} holds no frames", where=recording.path, remedy="record again")
    back = np.flatnonzero(np.diff(times) <= 0)
    if len(back):
        raise InputError(
            f"UTC of stream {stream} does not rise at frame {back[0] + 1} (its clock was set meanwhile)",
            where=recording.path,
            remedy="record again with the clock left alone",
        )
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
    recording
        The recording with both streams.
    onto
        The stream whose every frame gets an answer.
    other
        The stream in which to look.
    tolerance
        Farthest that the nearer neighbour may be, in seconds; by default 0.75 of the other stream's median
        frame interval, so that a lone lost frame is bridged except in the middle of its gap.
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
        raise InputError(
            f"the clocks of {onto} and {other} do not overlap: {span(wanted)} and {span(there)}",
            where=recording.path,
            remedy="set both cameras by one clock and record again, or give the offset between them",
        )
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
    return Joined(
        before=np.where(inside, before, -1),
        after=np.where(inside, after, -1),
        weight=weight,
        gap=np.where(inside, gap, np.inf) / 1e9,
        times=(there - there[0]) / 1e9,
    )
