"""Following spots from frame to frame: a Kalman filter for each, the Hungarian method to match them.

A little over 400 lines: the steps of one update share the tracks' state and its options.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tapetum.errors import InputError
from tapetum.track.detections import Detections
from tapetum.track.motion import common_motion

__all__ = ["TrackPoint", "Tracker"]

Array = NDArray[np.float64]

# Cost of a forbidden pair, far above any cost within the gates.
_NEVER = 1e9
# Time constant, in seconds, of the remembered brightness of a track's spot.
_MEMORY = 4.0
# Largest difference in the logarithms of height and size of spots that may be the same, and that surely look so.
_ALIKE, _SAME = 1.0, 0.7
# Pixels within which tracks that jump together agree.
_SHARED = 12.0
# Frames unseen after which a track's place is no evidence of the common motion.
_LOST_FOR = 5
# Latest steps of the tracks that tell how far the probe shakes, the fewest that do, and how many times their median the
# next may be. Pixels by which a spot that is not of a scene that stands moves from one frame to the next.
_STEPS, _FEWEST_STEPS, _FOLLOW, _STILL = 15, 5, 6.0, 3.0
# Frames for which a jump of few tracks can be taken back.
_HOMING = 4
# Cost of giving a spot to a track that models take for another device: it decides between places within the gate, but
# does not end a track, for models err. Answers needed before a track counts as a device.
_OTHER_DEVICE, _TOLD = 8.0, 3
# Cost of giving a spot to a track without a number, where one with a number wants it too.
_UNNAMED = 8.0


@dataclass(frozen=True)
class TrackPoint:
    """Where a track is in one frame.

    Parameters
    ----------
    track
        Number of the track, from 1, never used twice by a tracker.
    x, y
        Pixels: the detection's centroid where there is one, else the predicted place; where that is out of the picture,
        the nearest one within.
    vx, vy
        Estimated velocity, pixels per second.
    detection
        Index of its detection in the frame; None while the track coasts.
    event
        What happened to the track in this frame: "begun", "found again", "unseen", "dark", "hidden by track N" where
        another is seen at its place, "out of the picture" where it should be beyond the frame's edge, or "ended: …"
        with the reason; else empty.
    since
        When the first of the detections was made that gave it its number, in seconds.
    lately
        Whether each of the latest frames shows it, this one last: as many as `persist` looks at, dark ones left out.
    """

    track: int
    x: float
    y: float
    vx: float
    vy: float
    detection: int | None
    event: str = ""
    since: float = math.nan
    lately: tuple[bool, ...] = ()

    @property
    def seen(self) -> bool:
        """Whether the spot was detected in this frame."""
        return self.detection is not None


class _Track:
    """Place and velocity [2, xy] with the covariance [2, 2] of either axis, and the spot's brightness and size.

    `number` is None until the spot persisted; `lately` holds when it was seen and what the spot counts, by frame, None
    where it was not.
    """

    def __init__(
        self, place: Array, peak: float, diameter: float, noise: float, time: float, speed: float, evidence: float
    ) -> None:
        self.number: int | None = None
        self.state = np.stack([place, np.zeros(2)])
        self.covariance = np.diag([noise**2, speed**2])
        self.peak, self.diameter, self.now, self.last = peak, diameter, peak, place
        self.hits, self.misses, self.since, self.seen_at = 1, 0, time, time
        self.lately: list[tuple[float, float] | None] = [(time, evidence)]
        self.hidden: int | None = None
        # Where it would be had it not followed a jump, and for how many frames that is remembered.
        self.home: Array | None = None
        self.homing = 0
        # When it was last taken to have jumped before it had a number, which may have been another spot.
        self.guessed = -math.inf
        self.devices: Counter[str] = Counter()

    @property
    def device(self) -> str | None:
        """What models mostly took it for; None before they said it often enough."""
        ((name, count),) = self.devices.most_common(1) or [(None, 0)]
        return name if count >= _TOLD and 2 * count > self.devices.total() else None

    def predict(self, dt: float, acceleration: float) -> None:
        # Written out: for each of thirty tracks, products of matrices of 2 x 2 take several times as long.
        (a, b), (_, c) = self.covariance.tolist()
        push = (acceleration * dt) ** 2
        a, b, c = a + dt * (2 * b + dt * c) + push * dt * dt / 4, b + dt * c + push * dt / 2, c + push
        self.covariance = np.array([[a, b], [b, c]])
        self.state = _moved(self.state, dt)
        self.peak *= math.exp(-dt / _MEMORY)
        self.homing = max(0, self.homing - 1)
        self.home = None if self.home is None or not self.homing else _moved(self.home, dt)

    def correct(self, place: Array, peak: float, diameter: float, noise: float, time: float) -> None:
        (a, b), (_, c) = self.covariance.tolist()
        rest = noise**2 / (a + noise**2)
        off = (place - self.state[0]) / (a + noise**2)
        self.state = self.state + np.array([[a], [b]]) * off
        # Of the forms of this update one that stays positive despite rounding.
        self.covariance = np.array([[rest * a, rest * b], [rest * b, c - b * b / (a + noise**2)]])
        # Brightness of the last seconds: while a spot fades, its ghost must not take over the track.
        self.peak, self.now, self.last = max(self.peak, peak), peak, place
        self.diameter += 0.5 * (diameter - self.diameter)
        self.hits, self.misses, self.seen_at = self.hits + 1, 0, time


def _moved(state: Array, dt: float) -> Array:
    """Place and velocity after so many seconds; a copy changed in place takes a third of the time of a stack."""
    moved = state.copy()
    moved[0] += dt * moved[1]
    return moved


@dataclass(kw_only=True, eq=False)
class Tracker:
    """Assigns the spots of successive frames to numbered tracks.

    A spot moves with constant velocity, disturbed by random accelerations; the filter uses the actual time stamps, so
    gaps and jitter do no harm. The assignment of spots to tracks is the likeliest under the filters' Gaussian
    predictions (Kuhn, Nav. Res. Logist. Q. 2, 83 (1955)). A spot that fits no track begins one. A track seen in
    `confirm` frames coasts through frames without its spot; a younger one ends at the first.

    When a spot fades, its ghost (see `tapetum.track.detector`) may remain for some frames. A spot much dimmer than a
    track was, and away from the track's predicted place, therefore neither continues that track nor begins one near it.

    A probe in the hand shakes: the motion of the whole picture since the one before is taken out before spots are
    assigned, so that each track is left with its own. Detections may say what it was; else it is the one that most
    tracks share (see `track.motion`). One or two tracks alone share any motion; they follow a jump together only where
    all of them find a spot of their look at the same shift, and no other does.

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
    shake
        Largest motion in pixels that the tracks share between two frames. 0: none is sought.
    persist
        (K, N): a track gets its number, and is returned, once the `evidence` of its spots (see `Detections`) in its
        first or latest N frames adds up to K: where each counts 1, once it was seen in K of N.
    doubt
        Evidence that each frame without its spot takes off. Where there is any, a track without a number ends when none
        is left.
    endings
        Whether a track that ends is returned once more, unseen, with the reason as its event.

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
    shake: float = 300.0
    persist: tuple[float, int] = (1, 1)
    doubt: float = 0.0
    endings: bool = False

    def __post_init__(self) -> None:
        for name in ("acceleration", "speed", "noise", "gate", "max_distance", "confirm"):
            if not (getattr(self, name) > 0 and math.isfinite(getattr(self, name))):
                raise InputError(f"must be positive, is {getattr(self, name)}", where=f"Tracker.{name}")
        for name in ("max_coast", "ghost_ratio", "ghost_radius", "shake", "doubt"):
            if not getattr(self, name) >= 0:
                raise InputError(f"must not be negative, is {getattr(self, name)}", where=f"Tracker.{name}")
        if not 1 <= self.persist[0] <= self.persist[1]:
            raise InputError(f"must be K of N with 1 <= K <= N, is {self.persist}", where="Tracker.persist")
        self.reset()

    def reset(self) -> None:
        """Forget all tracks; numbers begin at 1 again."""
        self._tracks: list[_Track] = []
        self._time: float | None = None
        self._next = 1
        # How far tracks were from where they would have been without common motion, by frame.
        self._steps: deque[float] = deque(maxlen=_STEPS)
        # Places of the spots of the frame before that no well-known track took.
        self._loose = np.empty((0, 2))
        # Whether a frame came, since spots were last assigned, whose motion is not known.
        self._adrift = False

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
        # Twice the negative logarithm of the likelihood, whose width counts: a track that has been unseen for long, and
        # could be anywhere, takes no spot from one that is known to be there.
        costs = np.where(fits, squared + 2 * np.log(variance + noise**2) + np.minimum(likeness**2, 4.0), _NEVER)
        return costs, dim & (distance <= self.ghost_radius)

    def update(
        self,
        detections: Detections,
        time: float,
        *,
        dark: bool = False,
        devices: Sequence[str | None] | None = None,
        size: tuple[int, int] | None = None,
    ) -> list[TrackPoint]:
        """Take the spots of the next frame.

        Parameters
        ----------
        detections
            Spots of the frame. Those marked as ghosts are ignored.
        time
            Of the frame, in seconds; not before that of the frame before.
        dark
            Whether the probe's light was off: a spot that is not seen is not missed then.
        devices
            What models take each spot for, None where they do not know: where places leave it open, a track keeps to
            spots of its own device.
        size
            (width, height) of the frame in pixels, where it is known: no track is then said to be beyond. One that left
            is remembered as long as any that is unseen, for a probe that shakes brings it back.

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
        if detections.motion is not None:
            self._move_all(detections.motion)
        self._adrift |= detections.motion is None
        alone = {track: track.state[0] for track in self._tracks if track.number is not None and not track.misses}
        if self._adrift and self.shake > 0 and self._tracks and len(place):
            self._move_together(place, peak, diameter, time)
        self._adrift &= not len(place)

        costs, _ = self._fit(place, peak, diameter, noise)
        costs += _UNNAMED * np.array([[track.number is None] for track in self._tracks]).reshape(-1, 1)
        told = [None if devices is None else devices[int(n)] for n in numbers]
        if any(told):
            own = [track.device for track in self._tracks]
            other = [[one is not None and two is not None and one != two for two in told] for one in own]
            costs += _OTHER_DEVICE * np.array(other, dtype=float).reshape(costs.shape)
        pairs = {int(r): int(c) for r, c in zip(*linear_sum_assignment(costs), strict=True) if costs[r, c] < _NEVER}
        counts = detections.evidence[numbers].tolist()
        looks = list(zip(place, peak.tolist(), diameter.tolist(), noise.tolist(), strict=True))
        seen: dict[_Track, int] = {}
        events: dict[_Track, str] = {}
        for row, track in enumerate(self._tracks):
            if row in pairs:
                events[track] = "found again" if track.misses else ""
                track.correct(*looks[pairs[row]], time)
                seen[track] = pairs[row]
                if (name := told[pairs[row]]) is not None:
                    track.devices[name] += 1
            elif not dark:
                track.misses += 1
            if row in pairs or not dark:
                own = (time, counts[pairs[row]]) if row in pairs else None
                track.lately = [*track.lately, own][-self.persist[1] :]
        steps = [math.dist(place[seen[track]], at) for track, at in alone.items() if track in seen]
        self._steps += [float(np.median(steps))] if steps else []
        taken = [n for track, n in seen.items() if self._well_known(track)]
        self._loose = np.delete(place, taken, axis=0)
        ended = [track for track in self._tracks if not self._lives(track, time)]
        self._tracks = [track for track in self._tracks if self._lives(track, time)]
        for n in sorted(set(range(len(looks))) - set(pairs.values())):
            # A spot like the ghost of a track, even of a new one, begins no track.
            if not self._fit(*(one[n : n + 1] for one in (place, peak, diameter, noise)))[1].any():
                self._tracks.append(_Track(*looks[n], time, self.speed, counts[n]))
                seen[self._tracks[-1]] = n
        for track in self._tracks:
            if track.number is None and self._evidence(track) >= self.persist[0]:
                # Of a jump that was guessed, what came before may have been another spot.
                times = [one[0] for one in track.lately if one is not None and one[1] > 0]
                track.since = min([one for one in times if one >= track.guessed], default=time)
                track.number, self._next = self._next, self._next + 1
                events[track] = "begun"
        points: list[TrackPoint] = []
        for track in [*self._tracks, *(ended if self.endings else ())]:
            if track.number is None:
                continue
            n = seen.get(track)
            if n is None:
                other = self._at_its_place(track, seen)
                # Another where it was last seen is what it became one with, wherever it would be by now.
                track.hidden = other if track.misses == 1 else track.hidden
                left = _beyond(track.state[0], size)
                events[track] = "dark" if dark else "unseen" if other is None else f"hidden by track {other}"
                if left and not dark and other is None:
                    events[track] = "out of the picture"
                if track in ended:
                    why = "unseen" if track.hidden is None else f"merged with track {track.hidden}"
                    why = "out of the picture" if left and track.hidden is None else why
                    events[track] = f"ended: {why} for {time - track.seen_at:.2f} s"
            x, y = _within(track.state[0], size) if n is None else place[n].tolist()
            vx, vy = track.state[1].tolist()
            detection = None if n is None else int(numbers[n])
            lately = tuple(one is not None and one[0] >= track.guessed for one in track.lately)
            points.append(TrackPoint(track.number, x, y, vx, vy, detection, events.get(track, ""), track.since, lately))
        return sorted(points, key=lambda point: point.track)

    def _move_all(self, motion: Array) -> None:
        """Move all that is remembered of the picture before by a matrix [2, 3]."""
        turned, shift = motion[:, :2].T, motion[:, 2]
        for track in self._tracks:
            track.state = track.state @ turned
            track.state[0] += shift
            track.last = track.last @ turned + shift
            if track.home is not None:
                track.home = track.home @ turned
                track.home[0] += shift
        self._loose = self._loose @ turned + shift

    def _move_together(self, place: Array, peak: Array, diameter: Array, time: float) -> None:
        """Move all tracks by what they share since the frame before, at a time."""
        expected = np.array([track.state[0] for track in self._tracks])
        # A place that coasts for long says little about the next.
        steady = np.array([track.misses <= 2 for track in self._tracks])
        bright, wide = np.array([(track.now, track.diameter) for track in self._tracks]).T[:, :, None]
        brighter = np.abs(np.log(np.maximum(peak, 1e-12) / np.maximum(bright, 1e-12)))
        wider = np.abs(np.log((diameter + 1) / (wide + 1)))
        if self._go_home(place, np.maximum(brighter, wider)):
            return
        if steady.sum() > 2:
            alike = (brighter < _ALIKE) & (wider < _ALIKE) & steady[:, None]
            motion = common_motion(expected, place, alike, self.shake)
        else:
            motion = None
        if motion is None:
            motion = self._jump(expected, place, np.maximum(brighter, wider))
            if motion is not None:
                for track in self._tracks:
                    track.home, track.homing = track.state.copy(), _HOMING
                    track.guessed = time if track.number is None else track.guessed
                    # Of few tracks the jump may make good a wrong velocity, which would be wrong again.
                    track.state[1] *= 0.5
        if motion is not None:
            for track, moved in zip(self._tracks, expected @ motion[:, :2].T + motion[:, 2], strict=True):
                track.state = np.stack([moved, track.state[1]])

    def _go_home(self, place: Array, looks: Array) -> bool:
        """Undo a jump where all that jumped find their like where they would have been: what they followed was another.

        A camera that is missed in the frame in which a reflection appears elsewhere looks as if it had jumped there.
        """
        homes = [(n, track.home) for n, track in enumerate(self._tracks) if track.home is not None and track.number]
        if not homes:
            return False
        for n, home in homes:
            track = self._tracks[n]
            near = np.linalg.norm(place - home[0], axis=1) <= max(_SHARED, 0.5 * track.diameter)
            # What is near both may as well have jumped, a little.
            apart = np.linalg.norm(place - track.state[0], axis=1) > 2 * _SHARED
            if not (near & apart & (looks[n] < _SAME)).any():
                return False
        for n, home in homes:
            self._tracks[n].state = home
        for track in self._tracks:
            track.home = None
        return True

    def _jump(self, expected: Array, place: Array, looks: Array) -> Array | None:
        """The one shift by which well-known tracks, none of which is where expected, find their like.

        `looks` [tracks, spots] says how unlike they look, as a logarithm.
        """
        known = np.array([self._well_known(track) for track in self._tracks])
        # Before anything has a number, a guess costs nothing.
        first = not any(track.number is not None for track in self._tracks)
        known = (known | first) & np.array([track.misses <= _LOST_FOR for track in self._tracks])
        apart = place[None] - expected[known][:, None]
        far = np.linalg.norm(apart, axis=2)
        spread = np.array([math.sqrt(track.covariance[0, 0] + self.noise**2) for track in self._tracks])[known]
        wide = np.array([track.diameter for track in self._tracks])[known]
        near = np.minimum(np.maximum(self.gate * spread, 0.5 * wide), self.max_distance)
        # A wrong velocity is made good where the spot still stands.
        last = np.array([track.last for track in self._tracks])[known]
        there = np.linalg.norm(place[None] - last[:, None], axis=2)
        close = np.minimum(far, there) <= self._farthest()
        able = (looks[known] < _SAME) & (far <= self.shake) & (close | self._shaken(place))
        if not able.any() or (far <= near[:, None]).any():
            return None
        shifts = apart[able]
        # [shifts, tracks, spots]: whether a track finds its like at a shift.
        finds = (np.linalg.norm(shifts[:, None, None] - apart[None], axis=3) <= _SHARED) & able[None]
        count = finds.any(2).sum(1)
        if not first and (count.max() < min(2, int(known.sum())) or 2 * count.max() <= known.sum()):
            return None
        # Of shifts by which as many find their like, the one by which they look most like themselves.
        unlike = np.where(finds, looks[known][None], np.inf).min(2)
        unlike = np.where(np.isfinite(unlike), unlike, 0).sum(1)
        best = shifts[np.argmin(np.where(count == count.max(), unlike, np.inf))]
        if np.hypot(*best) > self._farthest():
            self._steps.clear()
        return np.column_stack([np.eye(2), best])

    def _well_known(self, track: _Track) -> bool:
        return track.number is not None and track.hits >= self.confirm

    def _farthest(self) -> float:
        """How far few tracks may jump together: little before a probe that stands, where a reflection begins elsewhere
        as a camera is missed."""
        if len(self._steps) < _FEWEST_STEPS:
            return self.shake
        return min(self.shake, 2 * _SHARED + _FOLLOW * float(np.median(self._steps)))

    def _shaken(self, place: Array) -> NDArray[np.bool_]:
        """Return which spots show that a probe which stood now shakes: they moved, while every camera was missed."""
        missed = all(track.misses for track in self._tracks if self._well_known(track))
        if not missed or not len(self._loose):
            return np.zeros(len(place), dtype=bool)
        return np.linalg.norm(place[:, None] - self._loose[None], axis=2).min(1) > _STILL

    @staticmethod
    def _at_its_place(track: _Track, seen: dict[_Track, int]) -> int | None:
        """Number of another track that is seen where this one should be."""
        for other in seen:
            near = max(3.0, 0.5 * max(track.diameter, other.diameter))
            if other.number is not None and math.dist(track.state[0], other.state[0]) <= near:
                return other.number
        return None

    def _evidence(self, track: _Track) -> float:
        return sum(-self.doubt if one is None else one[1] for one in track.lately)

    def _lives(self, track: _Track, time: float) -> bool:
        if track.number is None:
            few = track.misses <= self.persist[1] - self.persist[0]
            return few and (self.doubt == 0 or self._evidence(track) > 0)
        few = track.misses <= 2 or time - track.seen_at <= self.max_coast
        return track.misses == 0 or (track.hits >= self.confirm and few)


def _beyond(place: Array, size: tuple[int, int] | None) -> bool:
    """Return whether a place lies beyond the outermost pixels of a frame."""
    return size is not None and not all(-0.5 <= at <= n - 0.5 for at, n in zip(place.tolist(), size, strict=True))


def _within(place: Array, size: tuple[int, int] | None) -> tuple[float, float]:
    """Return the place within a frame that is nearest to one that may lie beyond."""
    x, y = place.tolist()
    return (x, y) if size is None else (min(max(x, 0.0), size[0] - 1.0), min(max(y, 0.0), size[1] - 1.0))
