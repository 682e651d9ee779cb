"""One take of a scene by two cameras, any frame of which can be made alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from tapetum.bench import Scene, scene_dict
from tapetum.record.beats import Beat
from tapetum.record.clutter import Painter, Stage
from tapetum.record.motion import Hand
from tapetum.record.noise import counts
from tapetum.record.patch import add_patch
from tapetum.record.returns import Flashes, Returns, flashes_of, returns_of
from tapetum.record.room import Room
from tapetum.record.session import Placed, Session
from tapetum.record.stray import Ground

__all__ = ["Shot", "probe_frames"]

Array = npt.NDArray[np.float64]
# What keeps the draws of one recording apart.
_CLOCKS = {"probe": 3, "target": 4}
_NOISE = {"probe": 5, "target": 6}
_POWER = {"probe": 7, "target": 8}
_EXPOSURE = {"probe": 9, "target": 10}
_CLUTTER, _DOTS = 11, 12
# Exposure of the target's camera, in seconds: assumed, as of a video camera in a lit room.
_TARGET_EXPOSURE = 0.01
# Columns of the target's pictures at the most: a phone's preview, not its photographs.
_WIDEST_PICTURE = 1000


class Shot:
    """One take of a scene, prepared: any frame of either camera, whichever frames were asked for before.

    Parameters
    ----------
    scene
        What stands on the bench; the target's rotation is the hand's.
    session
        Length, motion, clocks, light and seed.

    Attributes
    ----------
    beats
        When each stream's frames are taken, by name: `probe`, `target`.

    Raises
    ------
    InputError
        For a session without frames, and as `simulate.Camera`.

    Notes
    -----
    Random numbers of a frame come from a generator of its own, seeded by (seed, stream, frame); retro-reflections are
    rendered in batches that begin at multiples of their size, by one thread. So a frame is the same to the last bit
    whichever frames are made, in whatever order and by however many workers, with the same libraries on the same kind
    of processor. Other kinds may differ in the last bit of the light, and so in a number of a pixel here or there.
    """

    def __init__(self, scene: Scene, session: Session) -> None:
        self.scene, self.session = scene, session
        clocks = {"probe": session.probe_clock, "target": session.target_clock}
        self.beats: dict[str, Beat] = {
            name: Beat(*clock.draw(session.frames, session.rate, np.random.default_rng([session.seed, _CLOCKS[name]])))
            for name, clock in clocks.items()
        }
        mine = Placed((0.0, 0.0), motion=session.motion)
        self._placed = (mine, *session.others)
        self._scenes = [_scene_of(scene, one) for one in self._placed]
        # Others get seeds of their own: none moves as the first one does.
        seeds = [session.seed, *(_mixed(session.seed, n, one.seed) for n, one in enumerate(session.others))]
        self._hands = [
            one.motion.draw(seed, own.distance, session.seconds)
            for one, seed, own in zip(self._placed, seeds, self._scenes, strict=True)
        ]
        exposures = {"probe": session.exposure, "target": session.target_exposure}
        self._exposure = {
            name: exposures[name].at(
                beat.times,
                np.random.default_rng([session.seed, _EXPOSURE[name]]),
                self._spread(self._hands[0].distance(beat.times)),
            )
            for name, beat in self.beats.items()
        }
        self._shares = {name: self._share(name) for name in self.beats}
        self._power = {name: self._powers(name) for name in self.beats}

    @property
    def picture(self) -> tuple[int, int]:
        """Columns and rows of the target's pictures: its sensor's, binned by a whole number where they are many."""
        columns, rows = self.scene.target.sensor.pixels
        binned = math.ceil(columns / _WIDEST_PICTURE)
        return columns // binned, rows // binned

    def probe(self, first: int, last: int) -> npt.NDArray[Any]:
        """Frames of the probe's camera from `first` to before `last`: digital numbers [T, H, W], uint8 or uint16."""
        return _stacked([self._probe(i) for i in self._range("probe", first, last)], self._empty("probe"))

    def target(self, first: int, last: int) -> npt.NDArray[np.uint8]:
        """Pictures of the target's camera from `first` to before `last`: [T, h, w], uint8."""
        return _stacked([self._target(i) for i in self._range("target", first, last)], self._empty("target"))

    def gaze(self, frames: Sequence[int]) -> Array:
        """Return where the target that films really looked in frames of the probe, fractions of its field: [N, 2]."""
        return self._hands[0].gaze(self.beats["probe"].times)[np.asarray(frames, dtype=int)]

    def exposure(self, stream: str, frame: int) -> float:
        """Return a frame's exposure time, in seconds."""
        return float(self._seconds(stream) * self._exposure[stream][frame])

    def lit(self, stream: str, frame: int) -> bool:
        """Return whether the laser was on for most of a frame's exposure."""
        return bool(self._shares[stream][frame] > 0.5)

    def truth(self) -> pa.Table:
        """What was true of every frame: a row a stream, target and frame.

        Returns
        -------
        pyarrow.Table
            `stream`, `target` (0 is the one that films), `frame`, `gaze_x` and `gaze_y` (fractions of the field),
            `offset_x` and `offset_y` (m), `roll` (rad), `distance` (m), `x` and `y` (of the RR in the probe's picture
            or of the laser in the target's, in pixels), `exposure` (s) and `laser` (its power over the scene's).
        """
        tables: list[pa.Table] = []
        for name, beat in self.beats.items():
            for number in range(len(self._scenes)):
                if name == "target" and number:
                    continue
                gaze, place, roll, distance = self._held(number, beat.times)
                if name == "probe":
                    where = self._returns[number][0].pixels
                else:
                    size = np.array(self.picture)
                    where = (size - 1) / 2 + gaze * size
                columns = {
                    "stream": [name] * len(beat),
                    "frame": np.arange(len(beat)),
                    "gaze_x": gaze[:, 0],
                    "gaze_y": gaze[:, 1],
                    "offset_x": place[:, 0],
                    "offset_y": place[:, 1],
                    "target": np.full(len(beat), number),
                    "roll": roll,
                    "distance": distance,
                    "x": where[:, 0],
                    "y": where[:, 1],
                    "exposure": self._seconds(name) * self._exposure[name],
                    "laser": self._power[name],
                }
                tables.append(pa.table(columns))
        return pa.concat_tables(tables)

    def parameters(self) -> dict[str, Any]:
        """Everything chosen or drawn that truth does not hold, as plain values."""
        others = [
            {**asdict(replace(one, target=None)), "scene": scene_dict(own)}
            for one, own in zip(self._placed[1:], self._scenes[1:], strict=True)
        ]
        phases = [self._phase(n) for n in range(len(self._scenes))]
        return {"scene": scene_dict(self.scene), **self.session.as_dict(), "others": others, "dot_phases": phases}

    def _range(self, stream: str, first: int, last: int) -> range:
        if not 0 <= first <= last <= len(self.beats[stream]):
            raise IndexError(f"frames {first} to {last} of {len(self.beats[stream])}")
        return range(first, last)

    def _empty(self, stream: str) -> npt.NDArray[Any]:
        sensor = self.scene.probe.sensor
        columns, rows = sensor.pixels if stream == "probe" else self.picture
        return np.empty((0, rows, columns), np.uint16 if stream == "probe" and sensor.bits > 8 else np.uint8)

    def _seconds(self, stream: str) -> float:
        return self.scene.probe.sensor.exposure if stream == "probe" else _TARGET_EXPOSURE

    def _powers(self, stream: str) -> Array:
        """The laser's power in each frame, over the scene's: [T]."""
        times, session = self.beats[stream].times, self.session
        power = np.ones(len(times))
        if session.power_jitter:
            draws = [frame_rng(session.seed, _POWER[stream], i).standard_normal() for i in range(len(times))]
            power = np.maximum(0.0, power + session.power_jitter * np.array(draws))
        return power * self._shares[stream]

    def _share(self, stream: str) -> Array:
        """Share of each exposure in which the laser is on, [T]."""
        times, code = self.beats[stream].times, self.session.code
        return np.ones(len(times)) if code is None else code.share(times, self._seconds(stream))

    def _spread(self, distance: Array) -> Array:
        """Irradiance at the target over that at the scene's distance."""
        diverges = self.scene.illumination.mode == "diverging"
        return (self.scene.distance / distance) ** (2.0 if diverges else 0.0)

    def _held(self, number: int, times: Array) -> tuple[Array, Array, Array, Array]:
        hand: Hand = self._hands[number]
        place = hand.place(times) + np.array(self._placed[number].offset)
        return hand.gaze(times), place, hand.roll(times), hand.distance(times)

    @cached_property
    def _returns(self) -> list[list[Returns]]:
        """Of every target the returns of all its cameras."""
        times = self.beats["probe"].times
        return [returns_of(own, *self._held(n, times)) for n, own in enumerate(self._scenes)]

    def _phase(self, number: int) -> float:
        """When a target's dot projector pulses, in parts of its period."""
        return float(np.random.default_rng([self.session.seed, _DOTS, number]).random())

    @cached_property
    def _flashes(self) -> list[Flashes]:
        """Of every target that has a dot projector."""
        times, exposure = self.beats["probe"].times, self._seconds("probe") * self._exposure["probe"]
        found = [
            flashes_of(own, times, exposure, self._phase(n), self._held(n, times)) for n, own in enumerate(self._scenes)
        ]
        return [one for one in found if one is not None]

    @cached_property
    def _ground(self) -> Ground:
        return Ground.of(self.scene, self.session.stray, self.session.seed)

    @cached_property
    def _painters(self) -> list[tuple[bool, Painter]]:
        beat = self.beats["probe"].times
        stage = Stage(self.scene, beat, self._hands[0].place(beat))
        return [
            (one.of_laser, one.prepare(stage, np.random.default_rng([self.session.seed, _CLUTTER, number])))
            for number, one in enumerate(self.session.clutter)
        ]

    def _probe(self, i: int) -> npt.NDArray[Any]:
        exposure, power = float(self._exposure["probe"][i]), float(self._power["probe"][i])
        mean = self._ground.lit(exposure)
        if power:
            for returns in chain.from_iterable(self._returns):
                for patch in returns.patches(i):
                    add_patch(mean, patch, exposure * power)
        for flashes in self._flashes:
            if (patch := flashes.patch(i)) is not None:
                add_patch(mean, patch, 1.0)
        for of_laser, paint in self._painters:
            if power or not of_laser:
                add_patch(mean, paint(i), exposure * power if of_laser else exposure)
        mean = self._ground.seen(mean)
        return counts(mean, self.scene.probe.sensor, frame_rng(self.session.seed, _NOISE["probe"], i))

    @cached_property
    def _room(self) -> Room:
        return Room(*self.picture, self.session.seed)

    @cached_property
    def _first_held(self) -> tuple[Array, Array, Array, Array]:
        return self._held(0, self.beats["target"].times)

    def _target(self, i: int) -> npt.NDArray[np.uint8]:
        gaze, _, roll, distance = (one[i] for one in self._first_held)
        light = float(self._power["target"][i]) if self.session.laser else 0.0
        light *= float(self._spread(distance))
        return self._room.picture(
            gaze,
            frame_rng(self.session.seed, _NOISE["target"], i),
            roll=float(roll),
            nearer=self.scene.distance / float(distance),
            laser=light,
            exposure=float(self._exposure["target"][i]),
            second=self._second,
        )

    @cached_property
    def _second(self) -> tuple[float, float, float] | None:
        """The second beam's spot beside the first in the target's picture, in pixels, and its relative power."""
        beam = self.scene.illumination.second_beam
        if beam is None or beam.ratio == 0:
            return None
        target = self.scene.target
        reach = target.lens.focal_length / target.sensor.pitch * self.picture[0] / target.sensor.pixels[0]
        return reach * math.tan(beam.angle[0]), reach * math.tan(beam.angle[1]), beam.ratio


def frame_rng(seed: int, stream: int, frame: int) -> np.random.Generator:
    """The generator of one frame of one stream."""
    return np.random.Generator(np.random.SFC64([seed, stream, frame]))


def _mixed(*seeds: int) -> int:
    return int(np.random.SeedSequence(seeds).generate_state(1, np.uint64)[0])


def _scene_of(scene: Scene, placed: Placed) -> Scene:
    distance = scene.distance if placed.distance is None else placed.distance
    return replace(scene, distance=distance, target=placed.target or scene.target)


def _stacked(frames: Sequence[npt.NDArray[Any]], empty: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.stack(frames) if frames else empty


def probe_frames(scene: Scene, gaze: Array, place: Array, seed: int) -> Iterator[npt.NDArray[Any]]:
    """Frames of the probe's camera for gazes [T, 2] (fractions of the field) and places [T, 2] (metres sideways)."""
    sensor, ground, none = scene.probe.sensor, Ground.of(scene), np.zeros(len(gaze))
    found = returns_of(scene, gaze, place, none, none + scene.distance)
    for i in range(len(gaze)):
        mean = ground.lit(1.0)
        for patch in chain.from_iterable(returns.patches(i) for returns in found):
            add_patch(mean, patch, 1.0)
        yield counts(mean, sensor, frame_rng(seed, _NOISE["probe"], i))
