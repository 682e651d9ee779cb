"""Whether a label can be read from anything but the picture of the retro-reflection.

A network learns whatever gives the answer away. `score_leaks` tries each thing that might, with models so simple that
success can only mean that it is written there: a ridge on few polynomial terms, nearest neighbours, and for pixels a
linear ridge. They learn on one part of the set and are scored on the other.

=======================  =======================================================================================
source                   what it is, and what a find means
=======================  =======================================================================================
position                 where the crop stood in the probe's frame: the target moved as it turned
time                     time since the recording's first frame: a trend, a motion that repeats
label smoothing          test labels that share a measurement with a training frame's: `tapetum.data.embargo`
neighbours in time       the nearest train frame of the same recording: the parts are too close to each other
store order              number in the store: frames sorted by their label
neighbours in store      the nearest train frame in the store: sorted, then split at random
label quality            how sure the label is
background               level, noise and hot share of the corners, far from the RR: a lamp, an exposure, a border
fixed pattern            the corners' pixels over their neighbours, in the crop: the same background or sensor dirt
hot pixels               hot pixels by their place in the probe's frame: which camera, which recording
=======================  =======================================================================================

**Labels that change within a recording** (gaze) are learnt on the train frames and judged on the test frames. Chance is
what the same models score when the labels of each recording are shifted against the rest in a circle: a hand moves and
turns smoothly, and two smooth curves resemble each other far more often than two lists of independent numbers. For
neighbours the train labels are shifted among themselves: as smooth as before, no longer next to their test frames.
Where the recordings are too few and short for 199 independent shifts, the verdict is *untested*.

**Labels that are constant within a recording** (device, focal length, object distance in the paper's sets) are taken as
classes. Time, order and the recording's number name the recording, hence the class, by construction, and no model sees
them: they are not scored. What is left is judged twice. *Scope split*: learnt on the train frames, judged on the test
frames of the same recordings; chance is what comes out when the classes are dealt again to fifths of recordings. A find
means that recordings can be distinguished by it, and so the classes, in this set. *Scope recordings*, where every class
has two recordings or more, and all together enough for 199 deals: learnt on half of each class's recordings, judged on
the others; chance deals the classes again to whole recordings. A find means that it goes with the class itself.

**Not leaks**: the RR's own brightness, saturation and width. They follow from gaze, focus and lens; they are the
picture.

**The RR's light in the corners** is kept apart from the background's by its fall-off. A background counts only if it
tells the label after each admissible share (`tapetum.data.corners.FALL_OFFS`) of the halo nearer to the RR has been
taken away, and tells it better than that halo alone does; light of the RR is always stronger there. Where the halo's
median exceeds the noise of a pixel the corners are not dark at all, and the verdict is *untested*. The pixel sources
have smooth light taken out.

**Found** means: over the largest of 199 scores of chance and over the trivial score, by a tenth (neighbours: half) of
what is left to know. A clean source thus passes less than 1 time in 200.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.chance import deals_possible, dealt_blocks, dealt_recordings, shifted, shifts_possible
from tapetum.data.corners import FALL_OFFS, Corners, read_corners
from tapetum.data.dataset import TEST, TRAIN
from tapetum.data.embargo import meeting, reach_of
from tapetum.data.trivial import linear, nearest, smooth
from tapetum.progress import Progress, quiet

__all__ = ["Leak", "find_leaks", "score_leaks"]

ROUNDS = 199
_EFFECT, _EFFECT_OF_NEIGHBOURS = 0.1, 0.5
_FEW_SHIFTS = "chance has only some {} independent shifts of so slow a label: record longer or more often"
_FEWEST_TRAIN, _FEWEST_TEST = 30, 10

Models = Callable[[NDArray[Any], NDArray[Any]], list[Any]]
Scope = Literal["split", "recordings"]


@dataclass(frozen=True)
class Leak:
    """One source tried on one label.

    Parameters
    ----------
    name
        The source; see the module's table.
    target
        The label.
    score
        What the best trivial model gets: the share of the label's variance it explains (1 is all, 0 no better
        than the mean, negative worse), or for classes the share it gets right. NaN where untested.
    baseline
        What needs no source at all: 0, or the share of the commonest class.
    limit
        What chance reaches, or what is too little to matter: a leak scores more.
    verdict
        "found", "none" or "untested".
    scope
        "split" or "recordings".
    why
        Why it could not be tested.
    """

    name: str
    target: str
    score: float
    baseline: float
    limit: float
    verdict: Literal["found", "none", "untested"]
    scope: Scope = "split"
    why: str = ""

    def __str__(self) -> str:
        if self.verdict == "untested":
            return f"{self.target} from {self.name}: untested, {self.why}"
        across = " of recordings not learnt from" if self.scope == "recordings" else ""
        figures = f"score {self.score:.2f}{across} (without it {self.baseline:.2f}, limit {self.limit:.2f})"
        read = "can be read" if self.verdict == "found" else "cannot be read"
        return f"{self.target} {read} from {self.name}: {figures}"


@dataclass(frozen=True)
class _Label:
    name: str
    values: NDArray[np.float64]  # [N, 1], or one column a class
    classes: bool
    steady: bool


@dataclass(frozen=True)
class _Score:
    score: float
    baseline: float
    limit: float


@dataclass(frozen=True)
class _Trial:
    """Frames to learn from and to judge by, and frames whose labels stand for theirs by chance, [rounds, N]."""

    train: NDArray[np.int64]
    test: NDArray[np.int64]
    chance: NDArray[np.int64]


def find_leaks(
    dataset: xr.Dataset, corners: Corners | None = None, *, seed: int = 0, progress: Progress = quiet
) -> list[Leak]:
    """Return the leaks of a dataset: labels that can be read from something else than the picture; none in a clean one.

    Parameters
    ----------
    dataset
        A dataset with both parts of a split, stored or in memory.
    corners
        What `read_corners` returned, where it has been read already.
    seed
        Of the rounds of chance.
    progress
        Shown while the images are read and over the labels.
    """
    return [leak for leak in score_leaks(dataset, corners, seed=seed, progress=progress) if leak.verdict == "found"]


def score_leaks(
    dataset: xr.Dataset, corners: Corners | None = None, *, seed: int = 0, progress: Progress = quiet
) -> list[Leak]:
    """Return every source tried on every label, found or not; parameters as for `find_leaks`."""
    if corners is None:
        corners = read_corners(dataset, progress)
    recording = np.asarray(dataset["recording"].values)
    told: list[Leak] = []
    for name in progress(dataset.tp.targets, "looking for leaks", total=len(dataset.tp.targets)):
        values = np.asarray(dataset[name].values, dtype=np.float64)
        if not np.isfinite(values).all():
            why = f"{np.count_nonzero(~np.isfinite(values))} values are not finite"
            told.append(Leak("anything", name, np.nan, np.nan, np.nan, "untested", why=why))
        elif np.ptp(values) > 0:
            told.extend(_tried(dataset, _label(dataset, name, recording), corners, recording, seed))
    return told


def _label(dataset: xr.Dataset, name: str, recording: NDArray[np.integer]) -> _Label:
    values = np.asarray(dataset[name].values, dtype=np.float64)
    steady = all(np.ptp(values[recording == number]) == 0 for number in np.unique(recording))
    classes = steady or "classes" in dataset[name].attrs
    columns = (values[:, None] == np.unique(values)).astype(np.float64) if classes else values[:, None]
    return _Label(name, columns, classes, steady)


def _tried(
    dataset: xr.Dataset, label: _Label, corners: Corners, recording: NDArray[np.integer], seed: int
) -> Iterator[Leak]:
    """Try every source that could tell the label."""
    split, rng = np.asarray(dataset["split"].values), np.random.default_rng(seed)
    learnt, judged = np.flatnonzero(split == TRAIN), np.flatnonzero(split == TEST)
    if len(learnt) < _FEWEST_TRAIN or len(judged) < _FEWEST_TEST:
        why = f"{len(learnt)} frames to learn from and {len(judged)} to judge by are too few"
        yield _untested("anything", label, "split", why)
        return
    if not label.steady:
        yield _smoothing(dataset, label, recording, split)
    few = np.intersect1d(learnt, corners.frames), np.intersect1d(judged, corners.frames)
    if label.steady:
        chance = dealt_blocks(recording, split, ROUNDS, rng)
        yield from _from_picture(dataset, label, corners, _Trial(*few, chance), "split")
        half = _other_half(label, recording)
        if half is not None:
            chance = dealt_recordings(recording, half, ROUNDS, rng)
            first, second = (np.intersect1d(np.flatnonzero(half == part), corners.frames) for part in (0, 1))
            yield from _from_picture(dataset, label, corners, _Trial(first, second, chance), "recordings")
        return
    order = np.arange(len(split), dtype=np.float64)
    one, order = np.zeros_like(recording), np.arange(len(split), dtype=np.float64)
    time = np.asarray(dataset["time"].values, dtype=np.float64) if "time" in dataset else None
    if time is not None:
        # A recording is farther from the next than any of its frames is from another.
        apart = time + recording * (10 * np.ptp(time) + 1)
        beside = _Trial(learnt, few[1], shifted(recording, time, ROUNDS, rng, learnt))
        yield _verdict("neighbours in time", label, [_scored(label, apart[:, None], beside, nearest)])
    beside = _Trial(learnt, few[1], shifted(one, order, ROUNDS, rng, learnt))
    yield _verdict("neighbours in store", label, [_scored(label, order[:, None], beside, nearest)])
    if (shifts := shifts_possible(label.values, one, order)) < ROUNDS:
        yield _untested("store order", label, "split", _FEW_SHIFTS.format(shifts))
    else:
        whole = _Trial(*few, shifted(one, order, ROUNDS, rng))
        yield _verdict("store order", label, [_scored(label, order[:, None], whole, smooth)])
    if (shifts := shifts_possible(label.values, recording, order if time is None else time)) < ROUNDS:
        yield _untested("time, place and corners", label, "split", _FEW_SHIFTS.format(shifts))
        return
    inside = _Trial(*few, shifted(recording, order if time is None else time, ROUNDS, rng))
    if time is not None:
        yield _verdict("time", label, [_scored(label, time[:, None], inside, smooth)])
    if "quality" in dataset:
        quality = np.asarray(dataset["quality"].values, dtype=np.float64)
        yield _verdict("label quality", label, [_scored(label, quality[:, None], inside, smooth)])
    yield from _from_picture(dataset, label, corners, inside, "split")


def _smoothing(dataset: xr.Dataset, label: _Label, recording: NDArray[np.integer], split: NDArray[Any]) -> Leak:
    """Count the test frames whose label shares a measurement with a training frame's: none may."""
    span = reach_of(dataset)
    if span is None:
        why = "the dataset does not say how far its labels reach: build it again"
        return _untested("label smoothing", label, "split", why)
    test = split == TEST
    share = float(meeting(span, recording, test, split == TRAIN)[test].mean())
    return Leak("label smoothing", label.name, share, 0.0, 0.0, "found" if share else "none")


def _other_half(label: _Label, recording: NDArray[np.integer]) -> NDArray[np.int64] | None:
    """Return 0 or 1 a frame, by turns within each class's recordings; None where these are too few for chance."""
    numbers, first = np.unique(recording, return_index=True)
    classes = label.values[first].argmax(axis=1)
    half = np.zeros(len(numbers), dtype=np.int64)
    for one in np.unique(classes):
        half[classes == one] = np.arange(np.count_nonzero(classes == one)) % 2
    if np.bincount(classes).min() < 2 or deals_possible(classes, half) <= ROUNDS:
        return None
    return half[np.searchsorted(numbers, recording)]


def _from_picture(dataset: xr.Dataset, label: _Label, corners: Corners, trial: _Trial, scope: Scope) -> Iterator[Leak]:
    """Try the crop's place and what stands in its corners."""
    if "centre_x" in dataset and "centre_y" in dataset:
        place = np.stack([dataset["centre_x"].values, dataset["centre_y"].values], axis=1).astype(np.float64)
        yield _verdict("position", label, [_scored(label, place, trial, smooth)], scope)
    light = float(np.median(corners.halo[:, :4].mean(axis=1)))
    if light > corners.noise:
        why = f"the RR's light reaches the corners ({light:.1f} counts nearer to it, noise {corners.noise:.1f})"
        for name in ("background", "fixed pattern", "hot pixels"):
            yield _untested(name, label, scope, why)
        return
    each = [_scored(label, corners.level - share * corners.halo, trial, smooth) for share in FALL_OFFS]
    halo = _scored(label, corners.halo, trial, smooth)
    yield _verdict("background", label, [*each, _Score(each[0].score, each[0].baseline, halo.score)], scope)
    rows = np.zeros(len(label.values), dtype=np.int64)
    rows[corners.frames] = np.arange(len(corners.frames))
    yield _verdict("fixed pattern", label, [_scored(label, corners.pattern, trial, linear, rows)], scope)
    if corners.hot.shape[1]:
        yield _verdict("hot pixels", label, [_scored(label, corners.hot, trial, linear, rows)], scope)


def _untested(name: str, label: _Label, scope: Scope, why: str) -> Leak:
    return Leak(name, label.name, np.nan, np.nan, np.nan, "untested", scope, why)


def _verdict(name: str, label: _Label, scores: list[_Score], scope: Scope = "split") -> Leak:
    """A leak has to be found whichever way it is looked for: the weakest score decides."""
    weakest = min(scores, key=lambda one: one.score - one.limit)
    found = weakest.score > weakest.limit
    return Leak(name, label.name, weakest.score, weakest.baseline, weakest.limit, "found" if found else "none", scope)


def _scored(
    label: _Label, features: NDArray[Any], trial: _Trial, models: Models, rows: NDArray[np.int64] | None = None
) -> _Score:
    """Score the best of some models, and the same under chance; `rows` are the frames' rows in the features."""
    train, test = (trial.train, trial.test) if rows is None else (rows[trial.train], rows[trial.test])
    rounds = np.concatenate([np.arange(len(label.values))[None], trial.chance])
    truth = label.values[rounds[:, trial.test]]
    learnt = label.values[rounds[:, trial.train]]
    width, columns = learnt.shape[2], learnt.transpose(1, 0, 2).reshape(len(train), -1)
    scores = []
    # Each model's prediction is linear in the labels, so that one fit serves all rounds.
    for weights in models(features[train], features[test]):
        predicted = (weights @ columns).reshape(len(test), len(rounds), width).transpose(1, 0, 2)
        if label.classes:
            scores.append((predicted.argmax(axis=2) == truth.argmax(axis=2)).mean(axis=1))
        else:
            mean = learnt.mean(axis=1, keepdims=True)
            left = np.square(predicted - truth).sum(axis=(1, 2))
            scores.append(1 - left / np.maximum(np.square(mean - truth).sum(axis=(1, 2)), 1e-300))
    best = np.max(scores, axis=0)
    baseline = float(truth[0][:, learnt[0].sum(axis=0).argmax()].mean()) if label.classes else 0.0
    # Half of what is left for neighbours: the end of the train part is near the start of the test part by design.
    effect = _EFFECT_OF_NEIGHBOURS if models is nearest else _EFFECT
    chance = max(float(best[1:].max()), baseline)
    return _Score(float(best[0]), baseline, chance + effect * (1 - chance))
