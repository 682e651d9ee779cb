"""One take of a scene by two cameras; any frame can be computed by itself.

A little over 400 lines, as both cameras, their clocks and the truth share one motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from tapetum.bench import PhoneTarget, Scene, scene_dict
from tapetum.errors import of_type
from tapetum.record.beats import Beat
from tapetum.record.clutter import Painter, Stage
from tapetum.record.imaging import idle_scene, imaging_scene
from tapetum.record.marks import scene_mark
from tapetum.record.motion import Hand
from tapetum.record.noise import counts
from tapetum.record.patch import add_patch, moved
from tapetum.record.returns import Flashes, Returns, flashes_of, returns_of
from tapetum.record.room import Room, Trail
from tapetum.record.session import Placed, Session
from tapetum.record.source import Frame, Stored
from tapetum.record.stray import Ground

__all__ = ["BenchCamera", "Shot", "probe_frames"]

Array = npt.NDArray[np.float64]
# Seeds that separate the random draws of one recording; the target's camera adds 1 to the first four.
_CLOCK, _NOISE, _POWER, _EXPOSURE, _CLUTTER, _DOTS, _LAG = 3, 5, 7, 9, 11, 12, 13
# Exposure of the target's camera, in seconds: assumed, as of a video camera in a lit room.
_TARGET_EXPOSURE = 0.01
# Moments within an exposure at which a moving spot is drawn.
_MOMENTS = 24
# Most columns of the target's pictures: those of a phone's preview, not of its photographs.
_WIDEST_PICTURE = 1000


class BenchCamera(Stored):
    """One camera of a shot as a source of frames, which are made as they are read.

    Attributes
    ----------
    beat, clock
        When its frames are taken, and the clock that was drawn for it.
    seconds, factor
        The scene's exposure time, and [T] that of each frame relative to it.
    share, power
        [T] share of each exposure in which the laser is on, and its power relative to the scene's.
    """

    def __init__(self, shot: Shot, name: str, seconds: float, size: tuple[int, int], bits: int) -> None:
        session = shot.session
        self.shot, self.name, self.seconds = shot, name, seconds
        self.full_scale = 2**bits - 1
        self._nothing = np.empty((0, size[1], size[0]), np.uint8 if bits <= 8 else np.uint16)
        self._number = int(name == "target")
        clock, own = (session.probe_clock, None) if not self._number else (session.target_clock, session.target_rate)
        self.rate = own or session.rate
        # Lag and rate have a generator of their own, so that jitter and losses do not depend on them.
        self.clock = clock.drawn(self.rate, self._rng(_LAG))
        frames = max(session.frames, 1) if own is None else max(round(session.seconds * own), 1)
        self.beat = Beat(*self.clock.draw(frames, self.rate, self._rng(_CLOCK)))
        self.count, times = len(self.beat), self.beat.times
        exposure = session.target_exposure if self._number else session.exposure
        self.factor = exposure.at(times, self._rng(_EXPOSURE), shot.spread(times))
        self.share = np.ones(len(times)) if session.code is None else session.code.share(times, seconds)
        self.power = self.share
        if session.power_jitter:
            draws = [self.frame_rng(i, _POWER).standard_normal() for i in range(len(times))]
            self.power = np.maximum(0.0, 1 + session.power_jitter * np.array(draws)) * self.share

    @property
    def hardware(self) -> dict[str, Any]:
        """A note that the camera is simulated."""
        return {"camera": "simulated"}

    @property
    def marks(self) -> frozenset[str]:
        """The mark of its scene (`tapetum.record.marks`), where one camera alone stays at its distance."""
        changes = self.shot.session.others or getattr(self.shot.session.motion, "walk", None)
        return frozenset() if changes else frozenset({scene_mark(self.shot.scene)})

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.shot.session.seed, purpose + self._number])

    def frame_rng(self, frame: int, purpose: int = _NOISE) -> np.random.Generator:
        """Return the random generator of one frame."""
        return frame_rng(self.shot.session.seed, purpose + self._number, frame)

    def images(self, first: int, last: int, make: Callable[[int], npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """Return images [T, H, W] of the frames `first` to `last` (excluded)."""
        if not 0 <= first <= last <= self.count:
            raise IndexError(f"frames {first} to {last} of {self.count}")
        return np.stack([make(i) for i in range(first, last)]) if first < last else self._nothing

    def __iter__(self) -> Iterator[Frame]:
        make = self.shot.target if self._number else self.shot.probe
        for i, t in enumerate(self.beat.times):
            yield Frame(
                i,
                float(t - self.beat.times[0]),
                make(i, i + 1)[0],
                f"{self.name}[{i}]",
                self.full_scale,
                utc_ns=self.shot.session.start_ns + round(t * 1e9),
                monotonic_ns=round((t + 1e3) * (1 + self.clock.drift) * 1e9),
                exposure=float(self.seconds * self.factor[i]),
                lit=bool(self.share[i] > 0.5),
                lost=int(self.beat.dropped_before[i]),
            )


class Shot:
    """One prepared take of a scene, which makes any frame of either camera.

    Parameters
    ----------
    scene, session
        The bench (the target's rotation is the hand's); and length, motion, clocks, light and seed.

    Attributes
    ----------
    cameras, beats
        The two sources of frames, and when their frames are taken, by name: `probe`, `target`.

    Raises
    ------
    InputError
        For a session without frames, and as `simulate.Camera`.

    Notes
    -----
    Each frame has its own random generator, seeded by (seed, stream, frame); retro-reflections are rendered by one
    thread in batches that begin at multiples of their size. So a frame is the same to the last bit in any order and
    with any number of workers, given the same libraries and kind of processor. Other processors may differ in the last
    bit of the light, and so in rare digital numbers.
    """

    def __init__(self, scene: Scene, session: Session) -> None:
        of_type(session, Session, "session", "give a tapetum.Session")
        self.scene, self.session = scene, session
        self._placed = (Placed((0.0, 0.0), motion=session.motion), *session.others)
        self._scenes = [
            replace(scene, distance=one.distance or scene.distance, target=one.target or scene.target)
            for one in self._placed
        ]
        if session.imaging is not None:
            self._scenes[0] = imaging_scene(self._scenes[0])
        # Each further target has its own seed, so that none moves like the first.
        seeds = [session.seed, *(_mixed(session.seed, n, one.seed) for n, one in enumerate(session.others))]
        self._hands = [
            one.motion.draw(seed, own.distance, session.seconds)
            for one, seed, own in zip(self._placed, seeds, self._scenes, strict=True)
        ]
        sensor = scene.probe.sensor
        self._camera = BenchCamera(self, "probe", sensor.exposure, sensor.pixels, sensor.bits)
        self._filming = BenchCamera(self, "target", _TARGET_EXPOSURE, self.picture, 8)
        self.cameras = {"probe": self._camera, "target": self._filming}
        self.beats = {name: camera.beat for name, camera in self.cameras.items()}

    @property
    def picture(self) -> tuple[int, int]:
        """Columns and rows of the target's images: its sensor's, binned by an integer where they are many."""
        columns, rows = self.scene.target.sensor.pixels
        binned = math.ceil(columns / _WIDEST_PICTURE)
        return columns // binned, rows // binned

    def probe(self, first: int, last: int) -> npt.NDArray[Any]:
        """Return the probe's frames `first` to `last` (excluded): digital numbers [T, H, W], uint8 or uint16."""
        return self._camera.images(first, last, self._probe)

    def target(self, first: int, last: int) -> npt.NDArray[np.uint8]:
        """Return the target's images `first` to `last` (excluded): [T, h, w], uint8."""
        return self._filming.images(first, last, self._target)

    def gaze(self, frames: Sequence[int]) -> Array:
        """Return the true gaze of the filming target in probe frames, [N, 2] in fractions of its field."""
        return self._hands[0].gaze(self._camera.beat.times)[np.asarray(frames, dtype=int)]

    def exposure(self, stream: str, frame: int) -> float:
        """Return a frame's exposure time, in seconds."""
        return float(self.cameras[stream].seconds * self.cameras[stream].factor[frame])

    def lit(self, stream: str, frame: int) -> bool:
        """Return whether the laser was on for most of a frame's exposure."""
        return bool(self.cameras[stream].share[frame] > 0.5)

    def truth(self) -> pa.Table:
        """Return the true state in every frame: one row per stream, target and frame.

        Its columns are `stream`, `frame`, `gaze_x` and `gaze_y` (fractions of the field), `offset_x` and `offset_y`
        (m), `target` (0 is the one that films), `roll` (rad), `distance` (m), `x` and `y` (pixels of the RR in the
        probe's image, or of the laser in the target's), `exposure` (s), `laser` (its power relative to the scene's) and
        `imaging` (share of the exposure in which the target images).
        """
        size = np.array(self.picture)
        # Where the spot is when its row is exposed.
        seen = self._hands[0].gaze(self._row_times)
        tables = [
            *(self._true("probe", n, returns[0].pixels) for n, returns in enumerate(self._returns)),
            self._true("target", 0, (size - 1) / 2 + seen * size),
        ]
        return pa.concat_tables(tables)

    def _true(self, stream: str, number: int, where: Array) -> pa.Table:
        camera, times = self.cameras[stream], self.beats[stream].times
        gaze, place, roll, distance = self._held(number, times)
        columns = {
            "stream": [stream] * len(times),
            "frame": np.arange(len(times)),
            **_pair("gaze_x gaze_y", gaze),
            **_pair("offset_x offset_y", place),
            "target": np.full(len(times), number),
            "roll": roll,
            "distance": distance,
            **_pair("x y", where),
            "exposure": camera.seconds * camera.factor,
            "laser": camera.power,
            "imaging": self._imaging if stream == "probe" and not number else np.full(len(times), self._images(number)),
        }
        return pa.table(columns)

    def parameters(self) -> dict[str, Any]:
        """Return all parameters and draws that `truth` does not hold, as plain values."""
        others = [
            {**asdict(replace(one, target=None)), "scene": scene_dict(own)}
            for one, own in zip(self._placed[1:], self._scenes[1:], strict=True)
        ]
        phases = [self._phase(n) for n in range(len(self._scenes))]
        clocks = {name: asdict(camera.clock) for name, camera in self.cameras.items()}
        held = {**self.session.as_dict(), "clocks": clocks}
        return {"scene": scene_dict(self.scene), **held, "others": others, "dot_phases": phases}

    def spread(self, times: Array) -> Array:
        """Return the irradiance at the filming target at times [T], relative to that at the scene's distance, [T]."""
        return self.scene.illumination.spread(self._hands[0].distance(times), self.scene.distance)

    def _held(self, number: int, times: Array) -> tuple[Array, Array, Array, Array]:
        hand: Hand = self._hands[number]
        place = hand.place(times) + np.array(self._placed[number].offset)
        return hand.gaze(times), place, hand.roll(times), hand.distance(times)

    @cached_property
    def _shaken(self) -> Array:
        """Angles [T, 2] by which the probe is turned in its frames, in radians."""
        times, shake = self._camera.beat.times, self.session.shake
        return np.zeros((len(times), 2)) if shake is None else shake.draw(self.session.seed, times)

    def _seen(self, number: int) -> tuple[Array, Array, Array, Array]:
        """As `_held`, in the probe's frames: a turn of the probe moves a target as a step aside would."""
        gaze, place, roll, distance = self._held(number, self._camera.beat.times)
        return gaze, place + self._shaken * distance[:, None], roll, distance

    @cached_property
    def _imaging(self) -> Array:
        """Share [T] of the probe's exposures in which the first target images."""
        times, seconds = self._camera.beat.times, self._camera.seconds * self._camera.factor
        if self.session.imaging is None:
            return np.full(len(times), self._images(0))
        return self.session.imaging.share(times, seconds)

    def _images(self, number: int) -> float:
        """1 for a target whose scene says that it images."""
        target = self._scenes[number].target
        return float(target.imaging if isinstance(target, PhoneTarget) else True)

    @cached_property
    def _idle(self) -> Returns:
        """The return of the first target's own camera while it does not image."""
        return returns_of(idle_scene(self._scenes[0]), *self._seen(0))[0]

    @cached_property
    def _returns(self) -> list[list[Returns]]:
        """For every target, the returns of all its cameras."""
        return [returns_of(own, *self._seen(n)) for n, own in enumerate(self._scenes)]

    def _phase(self, number: int) -> float:
        """Return the phase of a target's dot projector, in parts of its period."""
        return float(np.random.default_rng([self.session.seed, _DOTS, number]).random())

    @cached_property
    def _flashes(self) -> list[tuple[int, Flashes]]:
        """Number and flashes of every target with a dot projector."""
        times, exposure = self._camera.beat.times, self._camera.seconds * self._camera.factor
        found = [flashes_of(own, times, exposure, self._phase(n), self._seen(n)) for n, own in enumerate(self._scenes)]
        return [(n, one) for n, one in enumerate(found) if one is not None]

    @cached_property
    def _ground(self) -> Ground:
        return Ground.of(self.scene, self.session.stray, self.session.seed)

    @cached_property
    def _painters(self) -> list[tuple[bool, Painter]]:
        times = self._camera.beat.times
        stage = Stage(self.scene, times, self._hands[0].place(times))
        return [
            (one.of_laser, one.prepare(stage, np.random.default_rng([self.session.seed, _CLUTTER, number])))
            for number, one in enumerate(self.session.clutter)
        ]

    def _probe(self, i: int) -> npt.NDArray[Any]:
        exposure, power = float(self._camera.factor[i]), float(self._camera.power[i])
        mean = self._ground.lit(exposure)
        if power:
            # The camera that images comes first.
            own, *others = chain.from_iterable(self._returns)
            images = float(self._imaging[i])
            shares = [
                (own, images),
                *((one, 1.0) for one in others),
                *([(self._idle, 1 - images)] if images < 1 else []),
            ]
            for returns, share in shares:
                for patch in returns.patches(i) if share else ():
                    add_patch(mean, patch, exposure * power * share)
        for number, flashes in self._flashes:
            if (patch := flashes.patch(i)) is not None:
                add_patch(mean, patch, 1.0 if number else float(self._imaging[i]))
        turned = self._shaken * (self.scene.probe.lens.focal_length / self.scene.probe.sensor.pitch)
        for of_laser, paint in self._painters:
            if power or not of_laser:
                patch = moved(paint(i), turned[i]) if self.session.shake is not None else paint(i)
                add_patch(mean, patch, exposure * power if of_laser else exposure)
        mean = self._ground.seen(mean)
        return counts(mean, self.scene.probe.sensor, self._camera.frame_rng(i))

    @cached_property
    def _room(self) -> Room:
        return Room(*self.picture, self.session.seed)

    @cached_property
    def _first_held(self) -> tuple[Array, Array, Array, Array]:
        return self._held(0, self._filming.beat.times)

    @cached_property
    def _row_times(self) -> Array:
        """Times [T] of the target's frames at which the row of the laser's spot is exposed, in seconds."""
        times, readout = self._filming.beat.times, self._filming.clock.readout
        found = times
        # The spot moves by far less than a frame in a readout: each round leaves a hundredth of the error or less.
        for _ in range(4 if readout else 0):
            found = times + readout * self._hands[0].gaze(found)[:, 1]
        return found

    def _trail(self, i: int) -> Trail:
        """Return the laser's path over the target's field while the rows about it are exposed."""
        time, at = float(self._filming.beat.times[i]), float(self._row_times[i])
        exposure, readout = float(self._filming.seconds * self._filming.factor[i]), self._filming.clock.readout
        # Rows that the spot's edges cover are exposed somewhat earlier and later.
        half = exposure / 2 + 20 * readout / self.picture[1]
        step = 2 * half / _MOMENTS
        moments: Array = (at - half + step * (np.arange(_MOMENTS) + 0.5)).astype(np.float64)
        return Trail(moments - time, self._hands[0].gaze(moments), step, exposure, readout)

    def _target(self, i: int) -> npt.NDArray[np.uint8]:
        gaze, _, roll, distance = (one[i] for one in self._first_held)
        light = float(self._filming.power[i]) if self.session.laser else 0.0
        return self._room.picture(
            gaze,
            self._filming.frame_rng(i),
            roll=float(roll),
            nearer=self.scene.distance / float(distance),
            laser=light * float(self.scene.illumination.spread(distance, self.scene.distance)),
            exposure=float(self._filming.factor[i]),
            second=self._second,
            trail=self._trail(i),
        )

    @cached_property
    def _second(self) -> tuple[float, float, float] | None:
        """Offset of the second beam's spot from the first in the target's image, in pixels, and its relative power."""
        beam = self.scene.illumination.second_beam
        if beam is None or beam.ratio == 0:
            return None
        target = self.scene.target
        reach = target.lens.focal_length / target.sensor.pitch * self.picture[0] / target.sensor.pixels[0]
        return reach * math.tan(beam.angle[0]), reach * math.tan(beam.angle[1]), beam.ratio


def frame_rng(seed: int, stream: int, frame: int) -> np.random.Generator:
    """Return the random generator of one frame of one stream."""
    return np.random.Generator(np.random.SFC64([seed, stream, frame]))


def _mixed(*seeds: int) -> int:
    return int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0])


def _pair(names: str, values: Array) -> dict[str, Array]:
    return dict(zip(names.split(), values.T, strict=True))


def probe_frames(scene: Scene, gaze: Array, place: Array, seed: int) -> Iterator[npt.NDArray[Any]]:
    """Yield probe frames for gazes [T, 2] (fractions of the field) and places [T, 2] (metres sideways)."""
    sensor, ground, none = scene.probe.sensor, Ground.of(scene), np.zeros(len(gaze))
    found = returns_of(scene, gaze, place, none, none + scene.distance)
    for i in range(len(gaze)):
        mean = ground.lit(1.0)
        for patch in chain.from_iterable(returns.patches(i) for returns in found):
            add_patch(mean, patch, 1.0)
        yield counts(mean, sensor, frame_rng(seed, _NOISE, i))
