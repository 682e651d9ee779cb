"""Films of the virtual bench for a guard: one camera at a time comes before the probe, and goes, by a drawn script.

`gaze`: the camera of the scene `hand-held` turns to the probe, looks at places of its field, now and then at a
protected region, and turns away. `phone`: the main camera of a phone, at 640 nm, is carried into the beam and out of
it, and begins and stops to image. When the camera comes and when it looks is read from the drawn gaze, as a turn takes
time; when a phone images is drawn. That a phone is there is not asked for: while it does not image, its filter returns
light along its axis alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from tapetum.bench import Scene, load_scene, with_values
from tapetum.record.imaging import Imaging, idle_scene, imaging_scene
from tapetum.record.marks import scene_mark
from tapetum.record.motion import HandMotion, Waves
from tapetum.record.noise import counts
from tapetum.record.patch import add_patch
from tapetum.record.returns import Returns, returns_of
from tapetum.record.source import Frame, Stored
from tapetum.record.stray import Ground
from tapetum.simulate.phone import phone_scenes

__all__ = ["KINDS", "REGION", "GuardFilm", "Happening"]

Array = npt.NDArray[np.float64]

KINDS = ("gaze", "phone")
REGION = (-0.12, -0.12, 0.12, 0.12)
RATE = 15.0
# Phones whose activity the method was not made with (scripts/measure_activity.py).
PHONES = ("phone-04", "phone-06", "phone-07", "phone-09", "phone-10")
_SAMPLES = 100  # motion is drawn at so many samples a second
_TURN = (0.25, 0.5)  # s that a turn or a step takes
# Gaze of a camera that is turned away, and beyond which nothing returns, in fractions of the field.
_BESIDE, _RIM = 1.0, 0.7
_TREMOR, _BAND = 0.002, (8.0, 12.0)
_SWAY = HandMotion().sway


@dataclass(frozen=True)
class Happening:
    """What an alert is expected of: a rule's name, a place's number, and seconds from when to when it is true."""

    rule: str
    place: int
    begin: float
    end: float


@dataclass(frozen=True)
class _Stay:
    """Seconds from when to when a camera is before the probe, and of what it does meanwhile; its phone."""

    begin: float
    end: float
    acts: tuple[tuple[float, float], ...]
    phone: str


class GuardFilm(Stored):
    """A film with so many happenings in so many seconds; a `Source`.

    Attributes
    ----------
    happenings
        What happens, by the rules `here` and `looks`, or `images`, in order.
    """

    full_scale = 255

    def __init__(self, kind: str, seed: int, count: int = 100, seconds: float = 1800.0) -> None:
        self.name, self.rate, self.count = f"{kind}-{seed}", RATE, round(seconds * RATE)
        self.kind, self.seed = kind, seed
        rng = np.random.default_rng([seed, 11])
        self._stays = _drawn(rng, count, seconds, own=kind == "gaze")
        scene = load_scene("hand-held")
        if kind == "phone":
            scene = with_values(load_scene("phones"), {"illumination.wavelength": "640 nm"})
        self._scene, self._ground = scene, Ground.of(scene)
        self._times = np.arange(self.count) / RATE
        self._path = _looks(rng, self._stays, seconds) if kind == "gaze" else _steps(rng, self._stays, seconds, scene)
        self._sway = _SWAY * Waves.draw(rng, HandMotion().sway_band)(self._times)
        self._tremor = _TREMOR * Waves.draw(rng, _BAND)(self._times)
        self.happenings = self._happenings()
        self._shown = self._targets(rng)

    @property
    def marks(self) -> frozenset[str]:
        """The mark of its scene (`tapetum.record.marks`)."""
        return frozenset({scene_mark(self._scene)})

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(k) for k in range(len(self._times)))

    def frame(self, k: int) -> Frame:
        """Return one frame."""
        mean = self._ground.lit(1.0)
        for returns, share, number in self._shown.get(k, ()):
            for patch in returns.patches(number):
                add_patch(mean, patch, share)
        image = counts(self._ground.seen(mean), self._scene.probe.sensor, np.random.default_rng([self.seed, 12, k]))
        return Frame(k, float(self._times[k]), image, f"{self.name}[{k}]")

    def _happenings(self) -> tuple[Happening, ...]:
        if self.kind == "phone":
            return tuple(Happening("images", 0, *act) for stay in self._stays for act in stay.acts)
        fine, (x, y) = np.arange(len(self._path)) / _SAMPLES, self._path.T
        left, top, right, bottom = REGION
        inside = (x > left) & (x < right) & (y > top) & (y < bottom)
        here = np.abs(self._path).max(axis=1) < 0.5
        made = [Happening("here", 0, *one) for one in _runs(here, fine, 1.0)]
        made += [Happening("looks", 0, *one) for one in _runs(inside, fine, 1.0)]
        return tuple(sorted(made, key=lambda one: one.begin))

    def _targets(self, rng: np.random.Generator) -> dict[int, list[tuple[Returns, float, int]]]:
        """What to draw in each frame: returns, their share, and the number of the frame in them."""
        path = self._path[np.rint(self._times * _SAMPLES).astype(int)]
        shown: dict[int, list[tuple[Returns, float, int]]] = {}
        if self.kind == "gaze":
            frames = np.flatnonzero((np.abs(path) < _RIM).all(1))
            none = np.zeros(len(frames))
            gaze = path[frames] + self._tremor[frames]
            returns = returns_of(self._scene, gaze, self._sway[frames], none, none + self._scene.distance)
            for n, k in enumerate(frames.tolist()):
                shown[k] = [(one, 1.0, n) for one in returns]
            return shown
        # A phone's main camera, whose gaze wanders as in scripts/measure_activity.py.
        for phone in sorted({one.phone for one in self._stays}):
            stays = [one for one in self._stays if one.phone == phone]
            mine = np.zeros(self.count, bool)
            for one in stays:
                mine |= (self._times > one.begin - 1) & (self._times < one.end + 1)
            frames = np.flatnonzero(mine)
            images = np.zeros(len(frames))
            for one in stays:
                switches = tuple(sorted(time for act in one.acts for time in act))
                during = (self._times[frames] > one.begin - 1) & (self._times[frames] < one.end + 1)
                share = Imaging(switches, at_first=False).share(self._times[frames], self._scene.probe.sensor.exposure)
                images = np.where(during, share, images)
            units = phone_scenes(with_values(self._scene, {"target.name": phone}))
            own = next(unit for unit in units if unit.place == (0.0, 0.0))
            hand = HandMotion(extent=0.2).draw(int(rng.integers(2**31)), self._scene.distance)
            none = np.zeros(len(frames))
            held = hand.gaze(self._times[frames]), path[frames] + self._sway[frames], none, none + self._scene.distance
            on, off = (returns_of(turn(own.scene), *held)[0] for turn in (imaging_scene, idle_scene))
            for n, k in enumerate(frames.tolist()):
                pairs = ((on, float(images[n])), (off, 1 - float(images[n])))
                shown[k] = [(one, share, n) for one, share in pairs if share]
        return shown


def _drawn(rng: np.random.Generator, count: int, seconds: float, own: bool) -> list[_Stay]:
    """Draw stays, each with what its camera does, until there are so many happenings; then the pauses between them.

    `own` says whether the stay itself counts as one.
    """
    made: list[_Stay] = []
    while (left := count - sum(own + len(one.acts) for one in made)) > 0:
        now, acts = rng.uniform(2.5, 6), []
        for _ in range(min(int(rng.integers(2, 7)), left - own)):
            lasts = rng.uniform(3, 8)
            acts.append((now, now + lasts))
            now += lasts + rng.uniform(2.5, 6)
        made.append(_Stay(0.0, now, tuple(acts), str(rng.choice(PHONES))))
    free = seconds - 10 - sum(one.end + 6 for one in made)
    if free < 0:
        raise ValueError(f"{count} happenings do not fit into {seconds} s")
    gaps = free * np.diff(np.sort(rng.uniform(0, 1, len(made))), prepend=0.0)
    start, placed = 5.0, []
    for one, gap in zip(made, gaps, strict=True):
        start += float(gap)
        acts = tuple((start + first, start + last) for first, last in one.acts)
        placed.append(replace(one, begin=start, end=start + one.end, acts=acts))
        start += one.end + 6
    return placed


def _looks(rng: np.random.Generator, stays: Sequence[_Stay], seconds: float) -> Array:
    """Draw the gaze, [N, 2] in fractions of the field: away from the region but for what the script asks."""
    points: list[tuple[float, Array]] = [(0.0, _around(rng, _BESIDE))]
    for stay in stays:
        edges = [stay.begin, *(time for act in stay.acts for time in act), stay.end]
        for n, (first, last) in enumerate(pairwise(edges)):
            if n % 2:
                points.append((first, rng.uniform(-0.06, 0.06, 2)))
                continue
            now = first
            while now < last - max(_TURN):
                points.append((now, _away(rng)))
                now += rng.uniform(1.0, 4.0)
        points.append((stay.end, _around(rng, _BESIDE)))
    return _through(rng, points, seconds)


def _steps(rng: np.random.Generator, stays: Sequence[_Stay], seconds: float, scene: Scene) -> Array:
    """Draw the place, [N, 2] in metres: beside the beam but for the stays."""
    sensor = scene.probe.sensor
    far = 1.2 * max(sensor.pixels) * sensor.pitch * scene.distance / scene.probe.lens.focal_length
    points: list[tuple[float, Array]] = [(0.0, _around(rng, far))]
    for stay in stays:
        points += [(stay.begin, np.zeros(2)), (stay.end, _around(rng, far))]
    return _through(rng, points, seconds)


def _through(rng: np.random.Generator, points: Sequence[tuple[float, Array]], seconds: float) -> Array:
    """Return a path that turns to each point from its time on, with the least jerk (Flash and Hogan 1985)."""
    fine = np.arange(math.ceil(seconds * _SAMPLES) + 1) / _SAMPLES
    path = np.tile(points[0][1], (len(fine), 1))
    for (_, before), (time, point) in pairwise(points):
        first = math.ceil(time * _SAMPLES)
        part = np.clip((fine[first:] - time) / rng.uniform(*_TURN), 0, 1)[:, None]
        path[first:] = before + (point - before) * (10 * part**3 - 15 * part**4 + 6 * part**5)
    return path


def _around(rng: np.random.Generator, radius: float) -> Array:
    angle = rng.uniform(0, 2 * math.pi)
    return radius * np.array([math.cos(angle), math.sin(angle)])


def _away(rng: np.random.Generator) -> Array:
    """A gaze within the field and away from the region."""
    while True:
        gaze = rng.uniform(-0.42, 0.42, 2)
        if np.abs(gaze).max() > 0.2:
            return gaze


def _runs(true: npt.ArrayLike, times: Array, least: float) -> list[tuple[float, float]]:
    """Return from when to when something is true for at least so many seconds."""
    edges = np.flatnonzero(np.diff(np.r_[False, np.asarray(true, bool), False].astype(int)))
    ends = [
        (float(times[a]), float(times[min(b, len(times) - 1)])) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]
    return [(a, b) for a, b in ends if b - a >= least]
