"""How many of an hour's events a guard finds, and how many false alerts it raises.

    .venv/bin/python scripts/measure_guard.py 1 2              drawn spots
    .venv/bin/python scripts/measure_guard.py 1 2 --film       films of the virtual bench

Of drawn spots there are no pictures: four places at which cameras come and go, begin to image, and look at a protected
region, 200 of these in an hour; with noise, estimates that are far off, frames in which a camera is missed, and spots
that are none. The tracker, the filter of whether a camera images, the events and the rules are those of a watch.

Films (`guard_films.py`) are half an hour of a camera that looks about and half an hour of phones, with 100 events each,
which a watch with the guard reads frame by frame.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from guard_films import KINDS, REGION, GuardFilm, Happening
from tapetum.live.events import Event, Events
from tapetum.live.guard import Guard
from tapetum.live.loop import Watch
from tapetum.live.rules import Rules, rules_from_text
from tapetum.live.state import Health, State
from tapetum.models import pretrained
from tapetum.track.activity import Activity
from tapetum.track.cameras import CameraDetector
from tapetum.track.detections import Detections
from tapetum.track.rows import TrackedFrame

__all__ = ["Raised", "Score", "Script", "draw_script", "guarded", "score", "watched"]

_HEAD = f"""
schema: tapetum/rules/1
regions: {{door: {list(REGION)}}}
rules:
"""
_RULES = {
    "here": "  - {name: here, cooldown: 0}\n",
    "images": "  - {name: images, when: {imaging: true}, cooldown: 0}\n",
    "looks": "  - {name: looks, when: {looks_at: door}, cooldown: 0}\n",
}
PLACES = ((130.0, 120.0), (500.0, 130.0), (150.0, 360.0), (510.0, 350.0))
RATE = 15.0  # frames a second
WITHIN = 1.0  # s from what happens to its alert
_MISSED = 0.1  # of the frames of a camera
_DROPOUT = (1 / 30, 0.3)  # a second, and their length in seconds
_FALSE, _GLINT = 0.03, 1 / 20  # false spots a frame; reflections that last some frames, a second
_GAZE, _WILD = 0.012, 0.02  # standard deviation of a gaze in fractions of the field; share of estimates far off
# Classes of a return's asymmetry of a camera that is idle, and that images (tapetum.track.activity).
_CLASSES = {False: (0.88, 0.10, 0.015, 0.005), True: (0.005, 0.02, 0.08, 0.895)}
_VALUES = (3e-4, 1.5e-3, 4e-3, 2e-2)


@dataclass(frozen=True)
class Raised:
    """An alert: its rule's name, seconds from the first frame, and where its camera was."""

    rule: str
    time: float
    at: tuple[float, float]

    @classmethod
    def of(cls, event: Event, start: int) -> Raised:
        assert event.after is not None
        return cls(event.detail, (event.utc_ns - start) / 1e9, (event.after.x, event.after.y))


@dataclass(frozen=True)
class Script:
    """What happens in so many seconds."""

    seconds: float
    happenings: tuple[Happening, ...]


@dataclass(frozen=True)
class Score:
    """Happenings, those found within a second, false alerts, and the delays of those found in seconds."""

    happenings: int
    found: int
    false: int
    delays: tuple[float, ...]


def draw_script(seed: int, count: int = 200, seconds: float = 3600.0) -> Script:
    """Draw so many happenings: stays of cameras at the four places, each with what its camera does meanwhile."""
    rng = np.random.default_rng([seed, 1])
    made: list[Happening] = []
    # As many stays a place as have about the number asked for, and the rest of the time between them.
    share = math.ceil(count / len(PLACES))
    for place in range(len(PLACES)):
        stays: list[list[Happening]] = []
        while sum(map(len, stays)) < share:
            stays.append(_stay(rng, place, share - sum(map(len, stays)), seconds / 12))
        free = seconds - 10 - sum(one[0].end for one in stays) - 6.0 * len(stays)
        if free < 0:
            raise ValueError(f"{count} happenings do not fit into {seconds} s")
        gaps = free * np.diff(np.sort(rng.uniform(0, 1, len(stays) + 1)), prepend=0.0)
        start = 5.0
        for stay, gap in zip(stays, gaps, strict=False):
            start += gap
            made += [Happening(one.rule, place, start + one.begin, start + one.end) for one in stay]
            start += stay[0].end + 6.0
    kept = sorted(made, key=lambda one: one.rule != "here")[:count]
    return Script(seconds, tuple(sorted(kept, key=lambda one: one.begin)))


def _stay(rng: np.random.Generator, place: int, most: int, longest: float) -> list[Happening]:
    """Draw a stay that begins at 0: the camera comes first, then does things."""
    length = rng.uniform(12, max(15.0, longest))
    inner: list[Happening] = []
    for rule in ("images", "looks"):
        now = rng.uniform(2.5, 8)
        while now + 3.5 < length:
            lasts = min(rng.uniform(3, 9), length - now)
            inner.append(Happening(rule, place, now, now + lasts))
            now += lasts + rng.uniform(4, 30)
    order = rng.permutation(len(inner))[: most - 1]
    return [Happening("here", place, 0.0, length), *(inner[k] for k in order)]


def frames(script: Script, seed: int) -> Iterator[tuple[float, Detections, list[dict[str, Any]]]]:
    """Yield the time, the spots and the models' answers of each frame."""
    rng = np.random.default_rng([seed, 2])
    # What is true at each place, by frame.
    count = round(script.seconds * RATE)
    true = {rule: np.zeros((len(PLACES), count), bool) for rule in ("here", "images", "looks")}
    for one in script.happenings:
        first, last = math.ceil(one.begin * RATE), math.ceil(one.end * RATE)
        true[one.rule][one.place, first:last] = True
    away = rng.uniform(0.2, 0.4, (len(PLACES), count // 150 + 1)) * rng.choice([-1, 1], (len(PLACES), count // 150 + 1))
    hidden = np.zeros(len(PLACES))
    glint, shines = (0.0, 0.0), 0
    for k in range(count):
        time = k / RATE
        spots: list[tuple[float, float, float]] = []
        answers: list[dict[str, Any]] = []
        for place, (x, y) in enumerate(PLACES):
            if rng.random() < _DROPOUT[0] / RATE:
                hidden[place] = time + _DROPOUT[1]
            if not true["here"][place, k] or time < hidden[place] or rng.random() < _MISSED:
                continue
            sway = 12 * math.sin(0.7 * time + place), 8 * math.sin(1.1 * time)
            at = x + sway[0] + rng.normal(0, 0.4), y + sway[1] + rng.normal(0, 0.4)
            spots.append((*at, 100 * rng.lognormal(0, 0.1)))
            gaze = np.array([0.0, 0.0] if true["looks"][place, k] else [away[place, k // 150], 0.1])
            gaze = rng.uniform(-0.5, 0.5, 2) if rng.random() < _WILD else gaze + rng.normal(0, _GAZE, 2)
            kind = rng.choice(4, p=_CLASSES[bool(true["images"][place, k])])
            answers.append({"gaze_x": float(gaze[0]), "gaze_y": float(gaze[1]), "asymmetry": _VALUES[int(kind)]})
        if shines == 0 and rng.random() < _GLINT / RATE:
            glint, shines = (float(rng.uniform(20, 620)), float(rng.uniform(20, 460))), int(rng.integers(2, 6))
        if shines:
            shines -= 1
            spots.append((*glint, 80.0))
            answers.append({})
        for _ in range(int(rng.poisson(_FALSE))):
            spots.append((float(rng.uniform(5, 635)), float(rng.uniform(5, 475)), 60.0))
            answers.append({})
        yield time, _detections(spots), answers


def _detections(spots: Sequence[tuple[float, float, float]]) -> Detections:
    x, y, peak = np.array(spots).reshape(-1, 3).T
    zero = np.zeros(len(x))
    columns = {
        "x": x,
        "y": y,
        "peak_x": x,
        "peak_y": y,
        "peak": peak,
        "snr": peak / 8,
        "diameter": zero + 6.0,
        "evidence": zero + 1,
    }
    return Detections.of({**dict.fromkeys(Detections.names(), zero), **columns})


def guarded(script: Script, seed: int) -> list[Raised]:
    """Return the alerts of a guard that watches a script."""
    rules = _rules("here", "images", "looks")
    events, guard = Events(rules.areas()), Guard(rules)
    tracker, activities = CameraDetector().tracker(), dict[int, Activity]()
    alerts: list[Raised] = []
    for k, (time, found, answers) in enumerate(frames(script, seed)):
        about = {"frame": k, "time": time, "name": "", "moment": {}}
        tracked = TrackedFrame.of(about, found, answers, tracker, activities)
        utc = round(time * 1e9)
        happened = events.update(tracked, utc)
        made = guard.update(State("", k, utc, (640, 480), events.cameras, Health()), happened)
        alerts += [Raised.of(one.as_event(), 0) for one in made]
    return alerts


def watched(film: GuardFilm) -> list[Raised]:
    """Return the alerts of a watch with a guard that reads a film."""
    phone = film.kind == "phone"
    models = () if phone else (pretrained("thin-lens-gaze"),)
    guard, listener = Guard(_rules(*(("images",) if phone else ("here", "looks")))), _Alerts()
    watch = Watch(
        lambda: film, detector="spots", models=models, mode="all", listeners=[listener], guard=guard, activity=phone
    )
    watch.start()
    watch.join()
    fault = watch.state.health.fault
    watch.close()
    if fault or watch.state.health.frames != film.count:
        raise RuntimeError(f"{film.name}: {watch.state.health.frames} of {film.count} frames were watched {fault}")
    return [Raised.of(event, listener.start) for event in listener.events]


class _Alerts:
    """A listener that keeps the alerts, and when the first frame was taken, in nanoseconds."""

    def __init__(self) -> None:
        self.start, self.events = 0, list[Event]()

    def event(self, event: Event) -> None:
        if event.kind == "alert":
            self.events.append(event)

    def state(self, state: State) -> None:
        if state.frame == 0:
            self.start = state.utc_ns

    def close(self) -> None:
        pass


def _rules(*names: str) -> Rules:
    return rules_from_text(_HEAD + "".join(_RULES[name] for name in names))


def score(
    happenings: Sequence[Happening], alerts: Sequence[Raised], places: Sequence[tuple[float, float]] = ()
) -> Score:
    """Match alerts with what happened: the same rule within a second, and the same place where places are given."""
    left = list(alerts)
    delays = []
    for one in happenings:
        for alert in left:
            near = not places or math.dist(alert.at, places[one.place]) < 40
            if alert.rule == one.rule and near and 0 <= alert.time - one.begin <= WITHIN:
                delays.append(alert.time - one.begin)
                left.remove(alert)
                break
    return Score(len(happenings), len(delays), len(left), tuple(delays))


def main(seeds: Sequence[int], films: bool) -> None:
    """Print a row a seed, or a row a film."""
    print("| of | happenings | found within 1 s | false alerts | median delay, s | longest, s |")
    print("|---|---|---|---|---|---|")
    for seed in seeds:
        if films:
            for kind in KINDS:
                film = GuardFilm(kind, seed)
                _print(film.name, score(film.happenings, watched(film)))
            continue
        script = draw_script(seed)
        _print(str(seed), score(script.happenings, guarded(script, seed), PLACES))


def _print(name: str, told: Score) -> None:
    median, longest = (np.median(told.delays), max(told.delays)) if told.delays else (math.nan, math.nan)
    counts = f"{told.happenings} | {told.found} | {told.false}"
    print(f"| {name} | {counts} | {median:.2f} | {longest:.2f} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--film", action="store_true", help="watch films of the virtual bench")
    given = parser.parse_args()
    main(given.seeds, given.film)
