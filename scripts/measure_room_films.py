"""What `tapetum track --detector cameras` finds in drawn films of rooms, by hand, every other frame lit.

    python scripts/measure_room_films.py [FIRST [COUNT [RATE ...]]] [--shake PX]

COUNT films of each of the twelve kinds of drawn_scenes.py from seed FIRST on, two seconds at 30 frames a second, with
three cameras of 8 to 60 times the noise, tape left out. What moves there between two frames moves through the film:
people walk, leaves swing, screens show something else every third of a second, lamps flicker; and the probe shakes in
the hand. Writes to docs/numbers/room-films.json (or -o), for each rate of false alarms that is asked for, which share
of the cameras has a number after half a second and at the end, in which share of the later half's lit frames each is
seen under a number, and how many numbered rows of a lit frame are no camera; and the same where every spot may cost
only what is asked for, and where the motion of the picture is not known. Nothing here is a photograph.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import drawn_scenes as drawn
from tapetum.detection import Found, find_cameras
from tapetum.files import atomic_file
from tapetum.record.source import Frame
from tapetum.track import Detections, track
from tapetum.track.cameras import CameraDetector

RATE, SECONDS, CAMERAS = 30.0, 2.0, 3
SHAPE, MARGIN = (480, 640), 48
"""Of the frames; and the fewest pixels of the room around them that the hand may turn to."""
SHAKE, TURN = 6.0, 0.3
"""Of the hand along each axis: RMS in pixels, and in degrees; at 8 to 12 Hz."""
REACH, SETTLED = 6.0, 0.5
"""Pixels within which a row is a camera; seconds in which one should have its number."""
OVEREXPOSED, LOOSEST = 235, 3.0
"""Grey level from which a camera is hidden; and the rate of false alarms up to which spots are kept."""

NUMBERS = Path(__file__).parents[1] / "docs" / "numbers" / "room-films.json"

Array = np.ndarray
Moving = Callable[[float], Array]


@dataclass(frozen=True)
class Film:
    """Frames, dark first, where the cameras are in each, [frames, cameras, 2], and where those that light hides are."""

    kind: str
    frames: list[Frame]
    places: Array
    hidden: Array


def _swinging(rng: np.random.Generator, picture: Array) -> Moving:
    h, w = picture.shape
    bends = rng.normal(0, 1.5, (2, max(3, h // 40), max(3, w // 40), 2)).astype(np.float32)
    y, x = np.mgrid[:h, :w].astype(np.float32)

    def at(time: float) -> Array:
        turn = 2 * math.pi * 2.0 * time
        bend = cv2.resize(bends[0] * math.cos(turn) + bends[1] * math.sin(turn), (w, h), interpolation=cv2.INTER_CUBIC)
        return cv2.remap(picture, x + bend[..., 0], y + bend[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)

    return at


def _changing(rng: np.random.Generator, shape: tuple[int, int]) -> Moving:
    """Screens whose content changes every third of a second."""
    room = drawn.room(rng, shape, 40)
    screens = [(*drawn.screen(rng, shape), int(rng.integers(2**31))) for _ in range(int(rng.integers(2, 5)))]

    def at(time: float) -> Array:
        picture = room.copy()
        for x, y, grid, content, seed in screens:
            shown = drawn.lettered(np.random.default_rng([seed, int(3 * time)]), content)
            picture[y : y + len(grid), x : x + grid.shape[1]] = shown * grid
        return picture

    return at


def _walking(rng: np.random.Generator, shape: tuple[int, int]) -> Moving:
    """People who cross the room."""
    room, people = drawn.room(rng, shape, 50), []
    for _ in range(int(rng.integers(1, 4))):
        start, tall = rng.uniform((60, 140), (shape[1] - 60, shape[0])), rng.uniform(90, 300)
        speed, phase = rng.normal(0, 120) * np.array([1, 0.1]), rng.uniform(0, 2 * math.pi)
        people.append((start, speed, phase, drawn.Person.drawn(rng, shape, tall)))

    def at(time: float) -> Array:
        picture = room.copy()
        for start, speed, phase, one in people:
            turn = 2 * math.pi * time + phase
            stride = 0.1 * one.tall * (1 + math.sin(turn))
            one.paint(picture, start, speed * time + (0, 2 * math.sin(2 * turn)), (-stride, stride))
        return picture

    return at


def _scene(kind: str, rng: np.random.Generator, shape: tuple[int, int]) -> Moving:
    if kind == "screens":
        return _changing(rng, shape)
    if kind == "people":
        return _walking(rng, shape)
    picture = drawn.KINDS[kind](rng, shape)[0]
    if kind == "leaves":
        return _swinging(rng, picture)
    if kind == "lamps":
        # The mains' hundred hertz, as 30 frames a second see them.
        return lambda time: picture * (1 + 0.15 * math.sin(2 * math.pi * 100 * time))
    return lambda time: picture


def _tremor(rng: np.random.Generator, times: Array, size: float) -> Array:
    rates, phases, parts = rng.uniform(8, 12, 5), rng.uniform(0, 2 * math.pi, 5), rng.normal(0, 1, 5)
    waves = parts[:, None] * np.cos(2 * math.pi * rates[:, None] * times + phases[:, None])
    return size * waves.sum(0) * math.sqrt(2 / np.square(parts).sum())


def film(kind: str, seed: int, shake: float = SHAKE) -> Film:
    """Draw a film of a room of a kind, by a hand that shakes by so many pixels."""
    rng = np.random.default_rng([31, list(drawn.KINDS).index(kind), seed])
    margin = max(MARGIN, round(4 * shake))
    wide = SHAPE[0] + 2 * margin, SHAPE[1] + 2 * margin
    scene = _scene(kind, rng, wide)
    soft, near = rng.uniform(0.6, 1.1), np.clip(0.5 + 0.5 * drawn.fractal(rng, wide, 2.0), 0, 1)
    light = 1 + rng.uniform(0, 0.15) * near
    spread = rng.uniform(1.0, 2.5) if kind != "noise" else rng.uniform(3, 10)
    rim = margin + 22
    where = rng.uniform((rim, rim), (wide[1] - rim, wide[0] - rim), (CAMERAS, 2))
    sizes, ratios = (np.exp(rng.uniform(math.log(a), math.log(b), CAMERAS)) for a, b in ((0.6, 4.0), (8, 60)))
    times = np.arange(round(RATE * SECONDS)) / RATE
    shifts = np.stack([_tremor(rng, times, shake) for _ in range(2)], 1)
    turns = _tremor(rng, times, TURN)
    quality = int(rng.integers(15, 60)) if kind == "blocks" else 0
    hot = rng.uniform((0, 0), SHAPE[::-1], (40, 2)).astype(int), rng.uniform(30, 255, 40)
    frames, places = [], np.empty((len(times), CAMERAS, 2))
    for n, time in enumerate(times.tolist()):
        lit = n % 2 == 1
        picture = cv2.GaussianBlur(scene(time).astype(np.float32), (0, 0), soft)
        if lit:
            picture = picture * np.float32(light)
            for (x, y), size, ratio in zip(where, sizes, ratios, strict=True):
                drawn.with_camera(picture, x, y, ratio * spread, size)
        way = cv2.getRotationMatrix2D((wide[1] / 2, wide[0] / 2), turns[n], 1)
        way[:, 2] += shifts[n]
        moved = cv2.warpAffine(picture, way, wide[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        seen = moved[margin:-margin, margin:-margin]
        places[n] = where @ way[:, :2].T + way[:, 2] - margin
        taken = seen + rng.normal(0, spread, SHAPE) * np.sqrt(0.4 + 0.6 * np.clip(seen, 0, 255) / 128)
        if kind == "hot pixels":
            taken[hot[0][:, 1], hot[0][:, 0]] += hot[1]
        image = np.clip(taken, 0, 255).round().astype(np.uint8)
        if quality:
            coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
            image = np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))
        frames.append(Frame(n, time, image, full_scale=255, lit=lit))
    # What is overexposed hides a camera: those count neither way.
    first = cv2.GaussianBlur(scene(0.0).astype(np.float32), (0, 0), soft)
    kept = np.array([float(first[int(y), int(x)]) < OVEREXPOSED for x, y in where])
    return Film(kind, frames, places[:, kept], places[:, ~kept])


@dataclass
class Known:
    """What was found in the frames of a film, and how the picture moved, by frame."""

    found: dict[int, Found] = field(default_factory=dict)
    motions: dict[int, Array | None] = field(default_factory=dict)


class Cached(CameraDetector):
    """Searches each frame once, whatever rate is asked for afterwards."""

    def __init__(self, known: Known, false_alarms: float) -> None:
        super().__init__(false_alarms=false_alarms)
        self.known, self.number = known, 0

    def __call__(self, frame: Frame, /) -> Detections:
        self.number = frame.index
        return super().__call__(frame)

    def _moved(self, image: NDArray[np.generic]) -> Array | None:
        if self.number not in self.known.motions:
            self.known.motions[self.number] = super()._moved(image)
        return self.known.motions[self.number]

    def _search(self, image: NDArray[np.generic], dark: NDArray[np.generic] | None, false_alarms: float) -> Found:
        if self.number not in self.known.found:
            self.known.found[self.number] = find_cameras(image, dark, swaps=False, false_alarms=LOOSEST)
        found = self.known.found[self.number]
        return found[found.false_alarms <= false_alarms]


class Strict(Cached):
    """The same where every spot may cost only what is allowed."""

    @property
    def _kept(self) -> float:
        return self.false_alarms


class Adrift(Cached):
    """The same where only spots tell how the picture moved."""

    def _moved(self, image: NDArray[np.generic]) -> Array | None:
        return None


def judged(one: Film, detector: Cached) -> dict[str, float]:
    """Counts of a film: cameras, numbered early and at the end, sightings, and rows that are none."""
    numbered, sightings, false, shown = np.full(one.places.shape[1], math.inf), 0, 0, 0
    last = len(one.frames) // 2
    wrong: set[int] = set()
    for told in track(one.frames, detector=detector):
        if not told.moment["lit"]:
            continue
        rows = [row for row in told.rows if row.seen]
        at = np.array([(row.x, row.y) for row in rows]).reshape(-1, 2)
        apart, beside = (np.linalg.norm(at[:, None] - of[told.frame], axis=2) for of in (one.places, one.hidden))
        for n, row in enumerate(rows):
            if not (apart[n] <= REACH).any() and not (beside[n] <= REACH).any():
                false += 1
                wrong.add(row.track)
        found = (apart <= REACH).any(0)
        numbered[found] = np.minimum(numbered[found], told.time)
        if told.frame >= last:
            places = one.places[told.frame]
            sightings += int(found.sum())
            shown += int(((places >= 0) & (places <= np.array(SHAPE[::-1]) - 1)).all(1).sum())
    return {
        "cameras": len(numbered),
        "early": int((numbered <= SETTLED).sum()),
        "end": int(np.isfinite(numbered).sum()),
        "seen": sightings,
        "of": shown,
        "false": false,
        "tracks": len(wrong),
        "lit": len(one.frames) // 2,
    }


def summed(counts: list[dict[str, float]]) -> dict[str, float]:
    """Add up the counts of some films."""
    return {key: sum(one[key] for one in counts) for key in counts[0]}


RULES = {Cached: "", Strict: ", of every spot", Adrift: ", motion not known"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int, nargs="?", default=95000, help="seed of the first film of each kind")
    parser.add_argument("count", type=int, nargs="?", default=10, help="films of each kind")
    parser.add_argument("rates", type=float, nargs="*", default=[0.01, 0.1], help="false alarms a frame that are asked")
    parser.add_argument("--shake", type=float, default=SHAKE, help="of the hand along each axis, RMS in pixels")
    parser.add_argument("-o", "--out", type=Path, default=NUMBERS)
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    rules = {f"{rate:g} asked{also}": (kind, rate) for rate in asked.rates for kind, also in RULES.items()}
    results: dict[str, list[tuple[str, dict[str, float]]]] = {name: [] for name in rules}
    for kind in drawn.KINDS:
        for seed in range(asked.first, asked.first + asked.count):
            one, known = film(kind, seed, asked.shake), Known()
            for name, (rule, rate) in rules.items():
                results[name].append((kind, judged(one, rule(known, rate))))
        print(f"{kind} done", file=sys.stderr, flush=True)
    numbers = {
        "first": asked.first,
        "count": asked.count,
        "shake": asked.shake,
        "settled": SETTLED,
        "rules": [
            {
                "rule": kind.__name__.lower(),
                "rate": rate,
                "all": summed([own for _, own in results[name]]),
                "by_kind": {of: summed([own for one, own in results[name] if one == of]) for of in drawn.KINDS},
            }
            for name, (kind, rate) in rules.items()
        ],
    }
    with atomic_file(asked.out) as part:
        part.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
