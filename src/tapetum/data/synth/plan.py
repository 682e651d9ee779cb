"""Plans of the paper's three sets: their videos, with scenes, sessions and labels.

A new set is one `SetRecipe` in `SETS`, from which the command line, the paper and the seeds take its name.
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tapetum.bench import Scene, Tolerances, draw_unit, load_scene, scene_dict, with_values
from tapetum.data.dataset import DEVICE
from tapetum.data.write import CHUNK, Rules
from tapetum.defaults import SEED
from tapetum.errors import InputError, one_of
from tapetum.record import HandMotion, Session
from tapetum.record.stray import FixedPattern

__all__ = [
    "FOCUSING_SAMPLING",
    "KINDS",
    "PIECE",
    "SEED",
    "SETS",
    "SIZES",
    "Part",
    "Plan",
    "SetRecipe",
    "Units",
    "Video",
    "focusing_plan",
    "make_plan",
    "phones_plan",
    "rotation_plan",
]

Labels = Mapping[str, float | str]

# A higher accuracy takes too long for the set's 135 mm lens, and is refused at some of its gazes. Against an accuracy
# of 0.03 of the peak images of three of the set's cameras differ by 0.4 to 5 % RMS.
FOCUSING_SAMPLING = ("sampling.accuracy=0.1",)
# Far from the truth at 135 mm, which the probe's aperture cuts: 55 % RMS at a focus of 3 m.
_ROUGH = ("sampling.accuracy=0.3", "sampling.propagation=far field")
SIZES = ("small", "laptop", "paper")
RATE = 15.0

PIECE = 2 * CHUNK
"""Frames of one part: what a worker makes in one go."""

FOCAL_LENGTHS = (0.050, 0.085, 0.135)
OBJECT_DISTANCES = (3.0, 3.5, 4.0, 4.5, 5.0, 5.5)
PHONES = tuple(f"phone-{number:02d}" for number in range(1, 12))

FIELDS = {
    "focal_length": "target.lens.focal_length",
    "object_distance": "target.object_distance",
    DEVICE: "target.name",
}
"""The scene's field for each label that is constant within a video."""

# Assumed: the hand's roll about the optical axis, in radians, and the jitter of the laser's power, as a fraction.
_ROLL, _POWER_JITTER = 0.02, 0.01
# Sideways motion of the hand, in metres. In diverging light the RR moves by f_p z s/d with the gaze s, at most a fifth
# of this sway, so that the place does not reveal the gaze.
_SWAY = 0.01


@dataclass(frozen=True)
class Units:
    """How many copies of every camera to film, drawn from which tolerances: None for those of the kind of target."""

    count: int
    tolerances: Tolerances | str | None = None

    def __post_init__(self) -> None:
        if self.count < 1:
            raise InputError(f"must be positive, is {self.count}", where="--units", remedy="give a number of copies")


@dataclass(frozen=True)
class Video:
    """One video to film: its scene, its session, the labels that are constant within it, and its unit's number."""

    name: str
    scene: Scene
    session: Session
    labels: tuple[tuple[str, float | str], ...] = ()
    unit: int | None = None

    @property
    def frames(self) -> int:
        """Frames that the probe takes if it loses none."""
        return round(self.session.seconds * self.session.rate)

    def as_dict(self) -> dict[str, Any]:
        """Return everything that determines the video, as plain values."""
        session = json.loads(json.dumps(dataclasses.asdict(self.session), default=str))
        own = {} if self.unit is None else {"unit": self.unit}
        told = {"name": self.name, "scene": scene_dict(self.scene), "session": session}
        return {**told, "labels": dict(self.labels), **own}


@dataclass(frozen=True)
class Part:
    """Probe frames `first` to `last` (excluded) of one video, which one worker makes at once."""

    number: int  # among all parts of the plan
    video: int
    first: int
    last: int


@dataclass(frozen=True)
class Plan:
    """Everything that determines a set, and its division into parts.

    Parameters
    ----------
    kind, size, seed
        As requested.
    videos
        In their order in the set.
    rules
        How frames are selected, cut and split.
    piece
        Frames of a part.
    units
        Names of the copies of cameras, by number; none where every camera is the one of its scene.
    """

    kind: str
    size: str
    seed: int
    videos: tuple[Video, ...]
    rules: Rules = dataclasses.field(default_factory=Rules)
    piece: int = PIECE
    units: tuple[str, ...] = ()

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts of all videos, in order."""
        ranges = [
            (number, first, min(first + self.piece, video.frames))
            for number, video in enumerate(self.videos)
            for first in range(0, video.frames, self.piece)
        ]
        return tuple(Part(n, *one) for n, one in enumerate(ranges))

    @property
    def full_scale(self) -> int:
        """Largest count of the probe's camera."""
        return 2 ** self.videos[0].scene.probe.sensor.bits - 1

    @property
    def classes(self) -> list[str]:
        """Names of the devices, sorted; empty where that is no label."""
        return sorted({str(value) for video in self.videos for name, value in video.labels if name == DEVICE})

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, with the software's version; equal plans give equal sets."""
        return {
            "kind": self.kind,
            "size": self.size,
            "seed": self.seed,
            "rules": dataclasses.asdict(self.rules),
            "piece": self.piece,
            "videos": [video.as_dict() for video in self.videos],
            "software": importlib.metadata.version("tapetum"),
            **({"units": list(self.units)} if self.units else {}),
        }

    def with_target_rate(self, rate: float) -> Plan:
        """The same plan with target cameras of `rate` frames per second, which only makes better labels.

        Raises an InputError for a rate that no session has.
        """
        videos = (
            dataclasses.replace(video, session=dataclasses.replace(video.session, target_rate=rate))
            for video in self.videos
        )
        return dataclasses.replace(self, videos=tuple(videos))

    @property
    def digest(self) -> str:
        """SHA-256 of `as_dict`."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class SetRecipe:
    """Recipe of a set that can be filmed; `name` is also that of its bundled scene.

    `videos` holds each video's name and constant labels, `seconds` their length by size: `paper` is the paper's,
    `laptop` is enough to learn from and takes two cores minutes, `small` only shows that every step runs. `extent` is
    the largest gaze in fractions of the field; `rules` select, cut and split frames; `settings`, by size, change the
    bundled scene, as `KEY=VALUE`.
    """

    name: str
    videos: tuple[tuple[str, Labels], ...]
    seconds: Mapping[str, float]
    extent: float
    rules: Rules = dataclasses.field(default_factory=Rules)
    settings: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)

    def plan(
        self, scene: Scene | None = None, size: str = "small", seed: int = SEED, units: Units | None = None
    ) -> Plan:
        """Return the plan of the set, for the given scene or the bundled one.

        With `units`, every video is filmed once with each copy of its camera. A device is a camera; all videos of a set
        without devices show copies of one.
        """
        one_of(size, SIZES, "size")
        scene = load_scene(self.name, self.settings.get(size, ())) if scene is None else scene
        videos = tuple(self._video(n, name, labels, scene, size, seed) for n, (name, labels) in enumerate(self.videos))
        plan = Plan(self.name, size, seed, videos, self.rules)
        return plan if units is None else self._copied(plan, scene, units)

    def _copied(self, plan: Plan, scene: Scene, units: Units) -> Plan:
        """The plan with every video filmed once with each copy of its camera."""
        cameras = [str(labels.get(DEVICE, self.name)) for _, labels in self.videos]
        order = list(dict.fromkeys(cameras))
        videos, names, count = list[Video](), list[str](), len(self.videos)
        for n, (name, labels) in enumerate(self.videos):
            camera = order.index(cameras[n])
            for copy in range(units.count):
                seed = _unit_seed(plan.seed, KINDS.index(self.name), camera, copy)
                number = camera * units.count + copy
                if number == len(names):
                    names.append(f"{cameras[n]}-{seed:08x}")
                called = f"{name}-unit-{copy + 1}"
                video = self._video(copy * count + n, called, labels, scene, plan.size, plan.seed)
                videos.append(
                    dataclasses.replace(video, scene=draw_unit(video.scene, units.tolerances, seed), unit=number)
                )
        return dataclasses.replace(plan, videos=tuple(videos), units=tuple(names))

    def _video(self, number: int, name: str, labels: Labels, scene: Scene, size: str, seed: int) -> Video:
        # Videos differ only in seed and label: a background that is constant within a video would identify it, and so
        # its label. The fixed pattern belongs to the one probe.
        own = int(np.random.SeedSequence([seed, KINDS.index(self.name), number]).generate_state(1)[0])
        session = Session(
            seconds=self.seconds[size],
            rate=RATE,
            seed=own,
            motion=HandMotion(extent=self.extent, roll=_ROLL, sway=_SWAY),
            power_jitter=_POWER_JITTER,
            stray=(FixedPattern(),),
        )
        placed = with_values(scene, {FIELDS[key]: value for key, value in labels.items()}) if labels else scene
        return Video(name, placed, session, tuple(labels.items()))


def _by_device(names: tuple[str, ...]) -> tuple[tuple[str, Labels], ...]:
    return tuple((name, {DEVICE: name}) for name in names)


# Phones give RRs in the centre half of the field, where most of the paper's gazes lie; a zoom only near the middle
# (5 degrees at 50 mm, 2 at 135 mm), and is held towards the probe (assumed).
SETS: dict[str, SetRecipe] = {
    recipe.name: recipe
    for recipe in (
        SetRecipe(
            "rotation",
            tuple((f"rotation-{n}", {}) for n in range(1, 8)),
            seconds={"paper": 100.0, "laptop": 30.0, "small": 4.0},
            extent=0.48,
        ),
        SetRecipe(
            "focusing",
            tuple(
                (f"focusing-{f * 1e3:.0f}mm-{distance:g}m", {"object_distance": distance, "focal_length": f})
                for f in FOCAL_LENGTHS
                for distance in OBJECT_DISTANCES
            ),
            seconds={"paper": 60.0, "laptop": 8.0, "small": 2.0},
            extent=0.2,
            settings={"paper": FOCUSING_SAMPLING, "laptop": FOCUSING_SAMPLING, "small": _ROUGH},
        ),
        SetRecipe(
            "phones",
            _by_device(PHONES),
            seconds={"paper": 100.0, "laptop": 16.0, "small": 3.0},
            extent=0.25,
            # Away from the middle a phone has no RR, and the sensor's fixed pattern reaches 8 times the noise.
            rules=Rules(min_snr=10.0),
        ),
    )
}
"""The sets by name. A set's place here is part of its seeds: add new ones at the end."""

KINDS = tuple(SETS)


def _unit_seed(seed: int, kind: int, camera: int, copy: int) -> int:
    """The seed of one copy; its spawn key keeps it apart from the seeds of videos."""
    return int(np.random.SeedSequence([seed, kind], spawn_key=(camera, copy)).generate_state(1)[0])


def make_plan(
    kind: str, size: str = "small", seed: int = SEED, units: Units | None = None, scene: Scene | None = None
) -> Plan:
    """Return the plan of one of the sets; an unknown kind or size raises an InputError.

    Parameters
    ----------
    kind
        `rotation`, `focusing` or `phones`.
    size
        `paper`; `laptop`: the same videos of 8 to 30 seconds; `small`: of 2 to 4 seconds, too few frames to learn from.
    seed
        Of everything random.
    units
        Copies of every camera, each of which films all its videos; None for the camera of the scene alone.
    scene
        Filmed in place of the set's bundled scene, as a twin; the set's videos change its focal length, focus or phone.
    """
    return SETS[one_of(kind, KINDS, "kind")].plan(scene, size, seed, units)


def rotation_plan(scene: Scene, size: str = "small", seed: int = SEED) -> Plan:
    """Seven videos of one hand-held camera (paper, §4.2)."""
    return SETS["rotation"].plan(scene, size, seed)


def focusing_plan(scene: Scene, size: str = "small", seed: int = SEED) -> Plan:
    """One video for each of three focal lengths and six object distances (paper, §4.3)."""
    return SETS["focusing"].plan(scene, size, seed)


def phones_plan(scene: Scene, size: str = "small", seed: int = SEED, names: tuple[str, ...] = PHONES) -> Plan:
    """One video of each phone (paper, §4.5)."""
    return dataclasses.replace(SETS["phones"], videos=_by_device(names)).plan(scene, size, seed)
