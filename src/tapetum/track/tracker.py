"""Following spots from frame to frame: a Kalman filter for each, the Hungarian method to match them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tapetum.errors import InputError
from tapetum.track.detections import Detections

__all__ = ["TrackPoint", "Tracker"]

Array = NDArray[np.float64]

# Cost of a forbidden pair, far above any cost within the gates.
_NEVER = 1e9
# Time constant, in seconds, of the remembered brightness of a track's spot.
_MEMORY = 4.0


@dataclass(frozen=True)
class TrackPoint:
    """Where a track is in one frame.

    Parameters
    ----------
    track
        Number of the track, from 1, never used twice by a tracker.
    x, y
        Pixels: the detection's centroid where there is one, else the predicted place.
    vx, vy
        Estimated velocity, pixels per second.
    detection
        Index of its detection in the frame; None while the track coasts.
    """

    track: int
    x: float
    y: float
    vx: float
    vy: float
    detection: int | None

    @property
    def seen(self) -> bool:
        """Whether the spot was detected in this frame."""
        return self.detection is not None


class _Track:
    """Place and velocity [2, xy] with the covariance [2, 2] of either axis, and the spot's brightness and size."""

    def __init__(
        self, number: int, place: Array, peak: float, diameter: float, noise: float, time: float, speed: float
    ) -> None:
        self.number = number
        self.state = np.stack([place, np.zeros(2)])
        self.covariance = np.diag([noise**2, speed**2])
        self.peak, self.diameter = peak, diameter
        self.hits, self.misses, self.seen_at = 1, 0, time

    def predict(self, dt: float, acceleration: float) -> None:
        step, push = np.array([[1.0, dt], [0.0, 1.0]]), np.array([dt * dt / 2, dt])
        self.state = step @ self.state
        self.covariance = step @ self.covariance @ step.T + acceleration**2 * np.outer(push, push)
        self.peak *= math.exp(-dt / _MEMORY)

    def correct(self, place: Array, peak: float, diameter: float, noise: float, time: float) -> None:
        gain = self.covariance[0] / (self.covariance[0, 0] + noise**2)
        self.state = self.state + np.outer(gain, place - self.state[0])
        # Joseph's form stays positive despite rounding.
        rest = np.eye(2) - np.outer(gain, [1.0, 0.0])
        self.covariance = rest @ self.covariance @ rest.T + noise**2 * np.outer(gain, gain)
        # Brightness of the last seconds: while a spot fades, its ghost must not take over the track.
        self.peak = max(self.peak, peak)
        self.diameter += 0.5 * (diameter - self.diameter)
        self.hits, self.misses, self.seen_at = self.hits + 1, 0, time


@dataclass(kw_only=True, eq=False)
class Tracker:
    """Assigns the spots of successive frames to numbered tracks.

    A spot moves with constant velocity, disturbed by random accelerations; the filter uses the actual time stamps, so
    gaps and jitter do no harm. The assignment of spots to tracks minimises the sum of squared distances, in standard
    deviations (Kuhn, Nav. Res. Logist. Q. 2, 83 (1955)). A spot that fits no track begins one. A track seen in
    `confirm` frames coasts through frames without its spot; a younger one ends at the first.

    When a spot fades, its ghost (see `tapetum.track.detect`) may remain for some frames. A spot much dimmer than a
    track was, and away from the track's predicted place, therefore neither continues that track nor begins one near it.

    Parameters
    ----------
    acceleration
        Standard deviation of the random acceleration, pixels/s².
    speed
        Standard deviation of the velocity of a new track, pixels/s.
    noise
        Standard deviation of a centroid, pixels, to which 2 % of the spot's diameter are added.
    gate
        Largest distance between a spot and its track, in standard deviations; spots that overlap their track's
        predicted place always fit.
    max_distance
        The same in pixels, however uncertain the track has become.
    max_coast
        Seconds for which a track continues unseen. A track always survives two frames without its spot.
    confirm
        Frames in which a spot must be seen before its track may coast.
    ghost_ratio
        Largest height of a ghost, as a fraction of its spot's. 0: there are no ghosts.
    ghost_radius
        Largest distance of a ghost from its spot in pixels.

    Raises
    ------
    InputError
        When an option is out of range.
    """

    acceleration: float = 300.0
    speed: float = 300.0
    noise: float = 0.5
    gate: float = 4.0
    max_distance: float = 150.0
    max_coast: float = 1.5
    confirm: int = 3
    ghost_ratio: float = 0.25
    ghost_radius: float = 280.0

    def __post_init__(self) -> None:
        for name in ("acceleration", "speed", "noise", "gate", "max_distance", "confirm"):
            if not (getattr(self, name) > 0 and math.isfinite(getattr(self, name))):
                raise InputError(f"must be positive, is {getattr(self, name)}", where=f"Tracker.{name}")
        for name in ("max_coast", "ghost_ratio", "ghost_radius"):
            if not getattr(self, name) >= 0:
                raise InputError(f"must not be negative, is {getattr(self, name)}", where=f"Tracker.{name}")
        self.reset()

    def reset(self) -> None:
        """Forget all tracks; numbers begin at 1 again."""
        self._tracks: list[_Track] = []
        self._time: float | None = None
        self._next = 1

    def _fit(self, place: Array, peak: Array, diameter: Array, noise: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Compare tracks and spots [tracks, spots]: the cost of each pair, and whether the spot may be a ghost."""
        expected = np.array([track.state[0] for track in self._tracks]).reshape(-1, 1, 2)
        known = [(track.covariance[0, 0], track.peak, track.diameter) for track in self._tracks]
        variance, bright, wide = np.array(known).reshape(-1, 3).T[:, :, None]
        distance = np.linalg.norm(place - expected, axis=2)
        squared = distance**2 / (variance + noise**2)
        dim = peak < self.ghost_ratio * bright
        apart = distance > 0.5 * np.maximum(wide, diameter)
        # However sharp the turn, a spot that overlaps the predicted place is the same.
        overlaps = distance <= 0.5 * np.minimum(wide, diameter)
        fits = ((squared <= self.gate**2) | overlaps) & (distance <= self.max_distance) & ~(apart & dim)
        # Brightness decides between spots that fit equally well.
        likeness = np.log(np.maximum(peak, 1e-12) / np.maximum(bright, 1e-12))
        costs = np.where(fits, squared + np.minimum(likeness**2, 4.0), _NEVER)
        return costs, dim & (distance <= self.ghost_radius)

    def update(self, detections: Detections, time: float) -> list[TrackPoint]:
        """Take the spots of the next frame.

        Parameters
        ----------
        detections
            Spots of the frame. Those marked as ghosts are ignored.
        time
            Of the frame, in seconds; not before that of the frame before.

        Returns
        -------
        list of TrackPoint
            The live tracks of this frame, seen or coasting, by number.

        Raises
        ------
        InputError
            When time runs backwards or is not finite.
        """
        if not math.isfinite(time) or (self._time is not None and time < self._time):
            raise InputError(f"{time} s follows {self._time} s", where="time", remedy="give the frames in order")
        dt = 0.0 if self._time is None else time - self._time
        self._time = time
        numbers = np.flatnonzero(~detections.ghost)
        place = np.stack([detections.x, detections.y], axis=1)[numbers]
        peak, diameter = detections.peak[numbers], detections.diameter[numbers]
        noise = self.noise + 0.02 * diameter
        for track in self._tracks:
            track.predict(dt, self.acceleration)

        costs, _ = self._fit(place, peak, diameter, noise)
        pairs = {int(r): int(c) for r, c in zip(*linear_sum_assignment(costs), strict=True) if costs[r, c] < _NEVER}
        looks = list(zip(place, peak.tolist(), diameter.tolist(), noise.tolist(), strict=True))
        seen: dict[int, int] = {}
        for row, track in enumerate(self._tracks):
            if row in pairs:
                track.correct(*looks[pairs[row]], time)
                seen[track.number] = pairs[row]
            else:
                track.misses += 1
        self._tracks = [track for track in self._tracks if self._lives(track, time)]
        for n in sorted(set(range(len(looks))) - set(pairs.values())):
            # A spot like the ghost of a track, even of a new one, begins no track.
            if not self._fit(*(one[n : n + 1] for one in (place, peak, diameter, noise)))[1].any():
                seen[self._next] = n
                self._tracks.append(_Track(self._next, *looks[n], time, self.speed))
                self._next += 1
        points: list[TrackPoint] = []
        for track in self._tracks:
            n = seen.get(track.number)
            (x, y), (vx, vy) = track.state.tolist() if n is None else (place[n].tolist(), track.state[1].tolist())
            points.append(TrackPoint(track.number, x, y, vx, vy, None if n is None else int(numbers[n])))
        return points

    def _lives(self, track: _Track, time: float) -> bool:
        few = track.misses <= 2 or time - track.seen_at <= self.max_coast
        return track.misses == 0 or (track.hits >= self.confirm and few)
