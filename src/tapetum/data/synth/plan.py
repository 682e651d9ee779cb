"""What is filmed for each of the paper's three sets: which videos, with which scenes, sessions and labels.

A new set is one `SetRecipe` in `SETS`: the command line, the paper and the seeds take its name from there.
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

from tapetum.bench import Scene, load_scene, scene_dict, with_values
from tapetum.data.dataset import DEVICE
from tapetum.data.write import CHUNK, Rules
from tapetum.defaults import SEED
from tapetum.errors import one_of
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
    "Video",
    "focusing_plan",
    "make_plan",
    "phones_plan",
    "rotation_plan",
]

Labels = Mapping[str, float | str]

# The set's 135 mm lens cannot be computed more accurately in reasonable time, and its frames are many. Compared with an
# accuracy of 0.03 of the peak and propagation over the distance, images at 50 and 85 mm differ by 4 to 9 % RMS, by 8 to
# 38 % of the peak in a few pixels, and hold the same light within 2 %.
FOCUSING_SAMPLING = ("sampling.accuracy=0.3", "sampling.propagation=far field")
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
"""The field of a scene behind each label that is constant within a video."""

# Assumed: the hand's roll about the optical axis, in radians, and the jitter of the laser's power, as a fraction.
_ROLL, _POWER_JITTER = 0.02, 0.01
# Sideways motion of the hand, in metres. In diverging light the RR moves by f_p z s/d with the gaze s: at most a fifth
# of what this sway adds to its place, so that the place does not tell the gaze.
_SWAY = 0.01


@dataclass(frozen=True)
class Video:
    """One video to film: what stands on the bench and how it is filmed, and the labels that are constant within it."""

    name: str
    scene: Scene
    session: Session
    labels: tuple[tuple[str, float | str], ...] = ()

    @property
    def frames(self) -> int:
        """Frames that the probe takes if it loses none."""
        return round(self.session.seconds * self.session.rate)

    def as_dict(self) -> dict[str, Any]:
        """Return all that decides what is filmed, as plain values."""
        session = json.loads(json.dumps(dataclasses.asdict(self.session), default=str))
        return {"name": self.name, "scene": scene_dict(self.scene), "session": session, "labels": dict(self.labels)}


@dataclass(frozen=True)
class Part:
    """Some probe frames of one video, `first` to `last` (left out): what one worker makes in one go."""

    number: int  # among all parts of the plan
    video: int
    first: int
    last: int


@dataclass(frozen=True)
class Plan:
    """All that decides what is in a set, and how it is divided into parts.

    Parameters
    ----------
    kind, size, seed
        As asked for.
    videos
        In the order in which they stand in the set.
    rules
        How frames are judged, cut and split.
    piece
        Frames of a part.
    """

    kind: str
    size: str
    seed: int
    videos: tuple[Video, ...]
    rules: Rules = dataclasses.field(default_factory=Rules)
    piece: int = PIECE

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
        """Return plain values, with the version of the software: two plans that agree give the same set."""
        return {
            "kind": self.kind,
            "size": self.size,
            "seed": self.seed,
            "rules": dataclasses.asdict(self.rules),
            "piece": self.piece,
            "videos": [video.as_dict() for video in self.videos],
            "software": importlib.metadata.version("tapetum"),
        }

    @property
    def digest(self) -> str:
        """SHA-256 of `as_dict`."""
        return hashlib.sha256(json.dumps(self.as_dict(), sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class SetRecipe:
    """One of the sets that can be filmed.

    Parameters
    ----------
    name
        Of the set and of its bundled scene.
    videos
        Each video's name, and its labels that are constant within it.
    seconds
        Length of every video, by size. `paper` is the paper's; `laptop` is enough to learn from, and takes two cores
        minutes; `small` shows that every step runs.
    extent
        How far the gaze goes from the centre, in fractions of the field.
    rules
        How frames are judged, cut and split.
    settings
        What differs from the bundled scene, as `KEY=VALUE`.
    """

    name: str
    videos: tuple[tuple[str, Labels], ...]
    seconds: Mapping[str, float]
    extent: float
    rules: Rules = dataclasses.field(default_factory=Rules)
    settings: tuple[str, ...] = ()

    def plan(self, scene: Scene | None = None, size: str = "small", seed: int = SEED) -> Plan:
        """Return the plan of the set, filmed with a scene of one's own or the bundled one."""
        one_of(size, SIZES, "size")
        scene = load_scene(self.name, self.settings) if scene is None else scene
        videos = (self._video(n, name, labels, scene, size, seed) for n, (name, labels) in enumerate(self.videos))
        return Plan(self.name, size, seed, tuple(videos), self.rules)

    def _video(self, number: int, name: str, labels: Labels, scene: Scene, size: str, seed: int) -> Video:
        # Each video of each set has its own seed. Nothing else differs between videos but the label: a background that
        # stood still within one video would tell it from the others, and so its label. The sensor's fixed pattern is
        # that of the one probe.
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


# Most of the paper's gazes of phones lie in the centre half of the field, where phones answer; a zoom, too, answers in
# the middle only (5 degrees at 50 mm, 2 at 135 mm), and is held towards the probe (assumed).
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
            settings=FOCUSING_SAMPLING,
        ),
        SetRecipe(
            "phones",
            _by_device(PHONES),
            seconds={"paper": 100.0, "laptop": 16.0, "small": 3.0},
            extent=0.25,
            # Away from the middle of its field a phone returns nothing, and frames show only the sensor's fixed
            # pattern, which reaches 8 times the noise.
            rules=Rules(min_snr=10.0),
        ),
    )
}
"""The sets by name. A set's place here is part of its seeds: add new ones at the end."""

KINDS = tuple(SETS)


def make_plan(kind: str, size: str = "small", seed: int = SEED) -> Plan:
    """Return the plan of one of the sets, from its bundled scene; an unknown kind or size raises an InputError.

    Parameters
    ----------
    kind
        `rotation`, `focusing` or `phones`.
    size
        `paper`; `laptop`: the same videos, each 8 to 30 seconds long; `small`: of 2 to 4 seconds each, too few
        frames to learn from.
    seed
        Of everything random.
    """
    return SETS[one_of(kind, KINDS, "kind")].plan(None, size, seed)


def rotation_plan(scene: Scene, size: str = "small", seed: int = SEED) -> Plan:
    """Seven videos of one hand-held camera (paper, §4.2)."""
    return SETS["rotation"].plan(scene, size, seed)


def focusing_plan(scene: Scene, size: str = "small", seed: int = SEED) -> Plan:
    """One video for each of three focal lengths and six object distances (paper, §4.3)."""
    return SETS["focusing"].plan(scene, size, seed)


def phones_plan(scene: Scene, size: str = "small", seed: int = SEED, names: tuple[str, ...] = PHONES) -> Plan:
    """One video of each phone (paper, §4.5)."""
    return dataclasses.replace(SETS["phones"], videos=_by_device(names)).plan(scene, size, seed)
