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

# Stands for "may not be paired"; far above any cost within the gates.
_NEVER = 1e9
# Seconds in which a track forgets how bright its spot was, to 1/e.
_MEMORY = 4.0


@dataclass(frozen=True)
class TrackPoint:
    """Where a track is in one frame.

    Parameters
    ----------
    track
        Number of the track, from 1, never used twice by a tracker.
    x, y
        Pixels: the detection's centroid where there is one, else where the track is expected to be.
    vx, vy
        Estimated velocity, pixels per second.
    detection
        Which detection of the frame it is; None while the track coasts.
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
    """State (x, y, vx, vy) with its covariance, and what is known of the spot's looks."""

    def __init__(self, number: int, spot: Detections, noise: float, speed: float, time: float) -> None:
        self.number = number
        self.state = np.array([spot.x[0], spot.y[0], 0.0, 0.0])
        self.covariance = np.diag([noise**2, noise**2, speed**2, speed**2])
        self.peak, self.diameter = float(spot.peak[0]), float(spot.diameter[0])
        self.hits, self.misses, self.seen_at = 1, 0, time

    def predict(self, dt: float, acceleration: float) -> None:
        step = np.eye(4)
        step[0, 2] = step[1, 3] = dt
        push = np.array([[dt * dt / 2, 0], [0, dt * dt / 2], [dt, 0], [0, dt]])
        self.state = step @ self.state
        self.peak *= math.exp(-dt / _MEMORY)
        self.covariance = step @ self.covariance @ step.T + acceleration**2 * (push @ push.T)

    def correct(self, spot: Detections, noise: float, time: float) -> None:
        spread = self.covariance[:2, :2] + noise**2 * np.eye(2)
        gain = np.linalg.solve(spread, self.covariance[:2]).T
        self.state = self.state + gain @ (np.array([spot.x[0], spot.y[0]]) - self.state[:2])
        # Joseph's form stays positive whatever the rounding.
        rest = np.eye(4)
        rest[:, :2] -= gain
        self.covariance = rest @ self.covariance @ rest.T + noise**2 * gain @ gain.T
        # The brightness of the last seconds: while a spot fades, its ghost must not catch up with it.
        self.peak = max(self.peak, float(spot.peak[0]))
        self.diameter += 0.5 * (float(spot.diameter[0]) - self.diameter)
        self.hits, self.misses, self.seen_at = self.hits + 1, 0, time


class Tracker:
    """Gives the spots of successive frames the numbers of tracks.

    A spot moves with constant velocity, disturbed by random accelerations; time stamps are taken as they
    are, so gaps and jitter are no matter. Spots and tracks are paired so that the sum of squared distances,
    in standard deviations, is least (Kuhn, Nav. Res. Logist. Q. 2, 83 (1955)). A spot that fits no track
    begins one. A track that was seen in `confirm` frames coasts through frames without its spot; a younger
    one ends at the first.

    When a spot fades, its ghost (see `tapetum.track.detect`) may be left for some frames. A spot much
    dimmer than a track remembers, and away from where the track is expected, therefore neither continues
    that track nor begins one near it.

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
        expected place always fit.
    max_distance
        The same in pixels, however uncertain the track has become.
    max_coast
        Seconds for which a track goes on unseen. A track always survives two frames without its spot.
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

    def __init__(
        self,
        *,
        acceleration: float = 300.0,
        speed: float = 300.0,
        noise: float = 0.5,
        gate: float = 4.0,
        max_distance: float = 150.0,
        max_coast: float = 1.5,
        confirm: int = 3,
        ghost_ratio: float = 0.25,
        ghost_radius: float = 280.0,
    ) -> None:
        for name, value in {
            "acceleration": acceleration,
            "speed": speed,
            "noise": noise,
            "gate": gate,
            "max_distance": max_distance,
            "confirm": confirm,
        }.items():
            if not (value > 0 and math.isfinite(value)):
                raise InputError(f"must be positive, is {value}", where=f"Tracker.{name}")
        for name, value in {
            "max_coast": max_coast,
            "ghost_ratio": ghost_ratio,
            "ghost_radius": ghost_radius,
        }.items():
            if not value >= 0:
                raise InputError(f"must not be negative, is {value}", where=f"Tracker.{name}")
        self.acceleration, self.speed, self.noise = acceleration, speed, noise
        self.gate, self.max_distance, self.max_coast, self.confirm = gate, max_distance, max_coast, confirm
        self.ghost_ratio, self.ghost_radius = ghost_ratio, ghost_radius
        self.reset()

    def reset(self) -> None:
        """Forget all tracks; numbers begin at 1 again."""
        self._tracks: list[_Track] = []
        self._time: float | None = None
        self._next = 1

    def _noise_of(self, spot: Detections) -> float:
        return self.noise + 0.02 * float(spot.diameter[0])

    def _costs(self, spots: Detections) -> NDArray[np.float64]:
        """Return what each pairing [tracks, spots] costs: squared distance in standard deviations."""
        costs = np.full((len(self._tracks), len(spots)), _NEVER)
        for row, track in enumerate(self._tracks):
            for column, spot in enumerate(spots):
                off = np.array([spot.x[0], spot.y[0]]) - track.state[:2]
                distance = float(np.hypot(*off))
                spread = track.covariance[:2, :2] + self._noise_of(spot) ** 2 * np.eye(2)
                squared = float(off @ np.linalg.solve(spread, off))
                apart = distance > 0.5 * max(track.diameter, float(spot.diameter[0]))
                # However sharp the turn: a spot that overlaps the place where it was expected is no other.
                overlaps = distance <= 0.5 * min(track.diameter, float(spot.diameter[0]))
                ghostly = apart and float(spot.peak[0]) < self.ghost_ratio * track.peak
                if (squared <= self.gate**2 or overlaps) and distance <= self.max_distance and not ghostly:
                    # Brightness decides between spots that fit equally well.
                    likeness = math.log(max(float(spot.peak[0]), 1e-12) / max(track.peak, 1e-12))
                    costs[row, column] = squared + min(likeness**2, 4.0)
        return costs

    def _may_begin(self, spot: Detections) -> bool:
        """Tell whether a spot that fits no track may begin one, or looks like the ghost of one."""
        x, y, peak = float(spot.x[0]), float(spot.y[0]), float(spot.peak[0])
        return not any(
            math.hypot(x - track.state[0], y - track.state[1]) <= self.ghost_radius
            and peak < self.ghost_ratio * track.peak
            for track in self._tracks
        )

    def update(self, detections: Detections, time: float) -> list[TrackPoint]:
        """Take the spots of the next frame.

        Parameters
        ----------
        detections
            Spots of the frame. Those marked as ghosts are passed over.
        time
            Of the frame, in seconds; not before that of the frame before.

        Returns
        -------
        list of TrackPoint
            The tracks that live in this frame, by number: those seen, and those that coast.

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
        spots = detections[numbers]
        for track in self._tracks:
            track.predict(dt, self.acceleration)

        costs = self._costs(spots)
        pairs = {int(r): int(c) for r, c in zip(*linear_sum_assignment(costs), strict=True) if costs[r, c] < _NEVER}
        seen: dict[int, int] = {}
        for row, track in enumerate(self._tracks):
            if row in pairs:
                spot = spots[pairs[row]]
                track.correct(spot, self._noise_of(spot), time)
                seen[track.number] = pairs[row]
            else:
                track.misses += 1
        self._tracks = [track for track in self._tracks if self._lives(track, time)]
        for column, spot in enumerate(spots):
            if column not in pairs.values() and self._may_begin(spot):
                seen[self._next] = column
                self._tracks.append(_Track(self._next, spot, self._noise_of(spot), self.speed, time))
                self._next += 1
        points = []
        for track in self._tracks:
            column = seen.get(track.number)
            x, y, vx, vy = (float(v) for v in track.state)
            if column is not None:
                x, y = float(spots.x[column]), float(spots.y[column])
            points.append(TrackPoint(track.number, x, y, vx, vy, None if column is None else int(numbers[column])))
        return points

    def _lives(self, track: _Track, time: float) -> bool:
        if track.misses == 0:
            return True
        return track.hits >= self.confirm and (track.misses <= 2 or time - track.seen_at <= self.max_coast)
