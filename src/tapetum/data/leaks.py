"""Whether a label can be read from anything but the image of the retro-reflection.

A network learns whatever gives the answer away. `score_leaks` tries each source of information below with models so
simple that they succeed only if the label is plainly there: a ridge on few polynomial terms, nearest neighbours, and
for pixels a linear ridge. They learn on one part of the set and are scored on the other.

=======================  =======================================================================================
source                   what it is, and what a find means
=======================  =======================================================================================
position                 the crop's place in the probe's frame: the target moved as it turned
time                     time since the recording's first frame: a trend, a periodic motion
label smoothing          test labels that share a measurement with a training frame's: `tapetum.data.embargo`
neighbours in time       the nearest train frame of the same recording: the parts are too close to each other
store order              number in the store: frames sorted by their label
neighbours in store      the nearest train frame in the store: sorted, then split at random
label quality            quality of the label
background               level, noise and hot share of the corners, far from the RR: a lamp, an exposure, a border
fixed pattern            the corners' pixels over their neighbours, in the crop: the same background or sensor dirt
hot pixels               hot pixels by their place in the probe's frame: which camera, which recording
=======================  =======================================================================================

**Labels that change within a recording** (gaze) are learnt on the train frames and tested on the test frames. Chance is
the score of the same models with the labels of each recording shifted cyclically: a hand moves smoothly, and two smooth
curves correlate far more often than independent numbers. For neighbours only the train labels are shifted. Where the
recordings are too few and short for 199 independent shifts, the verdict is *untested*.

**Labels that are constant within a recording** (device, focal length, object distance in the paper's sets) are classes.
Time, order and the recording's number identify the recording, hence the class, and are not scored. The other sources
are tested twice. *Scope split*: learnt on the train frames, tested on the test frames of the same recordings; chance
permutes the classes over fifths of recordings. A find means that the source distinguishes the recordings, and so the
classes, of this set. *Scope recordings*, where every class has two recordings or more and 199 permutations exist:
learnt on half of each class's recordings, tested on the others; chance permutes the classes over whole recordings. A
find means that the source depends on the class itself.

**Not leaks**: the RR's own brightness, saturation and width, which follow from gaze, focus and lens.

**The RR's light in the corners** is separated from the background by its fall-off. A background counts only if it
predicts the label after each admissible share (`tapetum.data.corners.FALL_OFFS`) of the halo nearer to the RR has been
subtracted, and better than that halo alone. Where the halo's median exceeds the noise of a pixel the corners are not
dark, and the verdict is *untested*. The pixel sources have smooth light removed.

**Found** means: above the largest of 199 chance scores and above the trivial score, by a tenth (neighbours: half) of
the distance to a perfect score. A clean source is reported less than 1 time in 200.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.sparse import csr_array
from sklearn.linear_model import Ridge
from sklearn.neighbors import NearestNeighbors
from sklearn.preprocessing import PolynomialFeatures, StandardScaler

from tapetum.data.chance import deals_possible, dealt_blocks, dealt_recordings, shifted, shifts_possible
from tapetum.data.corners import FALL_OFFS, Corners, read_corners
from tapetum.data.dataset import TEST, TRAIN
from tapetum.data.embargo import meeting, reach_of
from tapetum.defaults import SEED
from tapetum.progress import Progress, quiet

__all__ = ["Leak", "find_leaks", "score_leaks"]

ROUNDS = 199
_EFFECT, _EFFECT_OF_NEIGHBOURS = 0.1, 0.5
_FEW_SHIFTS = "the label is so slow that only some {} shifts of it are independent, too few to judge: record longer"
_FEWEST_TRAIN, _FEWEST_TEST = 30, 10

Frames = NDArray[np.int64]
Models = Callable[[NDArray[Any], NDArray[Any]], list[Any]]
Scope = Literal["split", "recordings"]


@dataclass(frozen=True)
class Leak:
    """One source (`name`, see the module's table) tried on one label (`target`).

    Parameters
    ----------
    score
        Of the best trivial model: explained share of the label's variance (1 is all, 0 no better than the mean,
        negative worse), or accuracy for classes. NaN where untested.
    baseline
        Score without any source: 0, or the share of the commonest class.
    limit
        The largest score that chance reaches or that is too small to matter; a leak scores more.
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
class _Score:
    score: float
    baseline: float
    limit: float


@dataclass(frozen=True)
class _Trial:
    """Frames to learn from and to test with, and the frames [rounds, N] that lend their labels under chance."""

    train: NDArray[np.int64]
    test: NDArray[np.int64]
    chance: NDArray[np.int64]


def find_leaks(
    dataset: xr.Dataset, corners: Corners | None = None, *, seed: int = SEED, progress: Progress = quiet
) -> list[Leak]:
    """Return the leaks of a dataset: labels that can be read from something else than the image.

    Parameters
    ----------
    dataset
        A dataset with both parts of a split, stored or in memory.
    corners
        Result of `read_corners`, if it was called already.
    seed
        Of the chance scores.
    progress
        Shown while the images are read and over the labels.
    """
    return [leak for leak in score_leaks(dataset, corners, seed=seed, progress=progress) if leak.verdict == "found"]


def score_leaks(
    dataset: xr.Dataset, corners: Corners | None = None, *, seed: int = SEED, progress: Progress = quiet
) -> list[Leak]:
    """Return every source tried on every label, found or not; parameters as for `find_leaks`."""
    corners = read_corners(dataset, progress) if corners is None else corners
    told: list[Leak] = []
    for name in progress(dataset.tp.targets, "looking for leaks", total=len(dataset.tp.targets)):
        values = np.asarray(dataset[name].values, dtype=np.float64)
        if not np.isfinite(values).all():
            why = f"{np.count_nonzero(~np.isfinite(values))} values are not finite"
            told.append(Leak("anything", name, np.nan, np.nan, np.nan, "untested", why=why))
        elif np.ptp(values) > 0:
            told.extend(_Search(dataset, name, corners, np.random.default_rng(seed)).run())
    return told


class _Search:
    """All sources that could predict one label."""

    def __init__(self, dataset: xr.Dataset, name: str, corners: Corners, rng: np.random.Generator) -> None:
        self.dataset, self.corners, self.rng = dataset, corners, rng
        self.recording, self.split = (np.asarray(dataset[one].values) for one in ("recording", "split"))
        values = np.asarray(dataset[name].values, dtype=np.float64)
        steady = all(np.ptp(values[self.recording == number]) == 0 for number in np.unique(self.recording))
        classes = steady or "classes" in dataset[name].attrs
        columns = (values[:, None] == np.unique(values)).astype(np.float64) if classes else values[:, None]
        # Labels [N, 1], or one column a class; whether they are classes, and constant within every recording.
        self.name, self.values, self.classes, self.steady = name, columns, classes, steady

    def run(self) -> Iterator[Leak]:
        learnt, judged = np.flatnonzero(self.split == TRAIN), np.flatnonzero(self.split == TEST)
        if len(learnt) < _FEWEST_TRAIN or len(judged) < _FEWEST_TEST:
            why = f"{len(learnt)} frames to learn from and {len(judged)} to judge by are too few"
            yield self._untested("anything", why)
            return
        few = np.intersect1d(learnt, self.corners.frames), np.intersect1d(judged, self.corners.frames)
        yield from (self._constant if self.steady else self._changing)(learnt, *few)

    def _constant(self, learnt: Frames, train: Frames, test: Frames) -> Iterator[Leak]:
        """Try a label that is constant within each recording."""
        del learnt
        chance = dealt_blocks(self.recording, self.split, ROUNDS, self.rng)
        yield from self._from_picture(_Trial(train, test, chance), "split")
        half = self._other_half()
        if half is not None:
            chance = dealt_recordings(self.recording, half, ROUNDS, self.rng)
            first, second = (np.intersect1d(np.flatnonzero(half == part), self.corners.frames) for part in (0, 1))
            yield from self._from_picture(_Trial(first, second, chance), "recordings")

    def _changing(self, learnt: Frames, train: Frames, test: Frames) -> Iterator[Leak]:
        """Try a label that changes within recordings."""
        yield self._smoothing()
        recording, one = self.recording, np.zeros_like(self.recording)
        order = np.arange(len(recording), dtype=np.float64)
        time = self._column("time")
        if time is not None:
            # A recording is farther from the next than any of its frames is from another.
            apart = time + recording * (10 * np.ptp(time) + 1)
            beside = _Trial(learnt, test, shifted(recording, time, ROUNDS, self.rng, learnt))
            yield self._verdict("neighbours in time", [self._scored(apart[:, None], beside, _nearest)])
        beside = _Trial(learnt, test, shifted(one, order, ROUNDS, self.rng, learnt))
        yield self._verdict("neighbours in store", [self._scored(order[:, None], beside, _nearest)])
        if (shifts := shifts_possible(self.values, one, order)) < ROUNDS:
            yield self._untested("store order", _FEW_SHIFTS.format(shifts))
        else:
            whole = _Trial(train, test, shifted(one, order, ROUNDS, self.rng))
            yield self._verdict("store order", [self._scored(order[:, None], whole, _smooth)])
        order = order if time is None else time
        if (shifts := shifts_possible(self.values, recording, order)) < ROUNDS:
            yield self._untested("time, place and corners", _FEW_SHIFTS.format(shifts))
            return
        inside = _Trial(train, test, shifted(recording, order, ROUNDS, self.rng))
        for name, column in (("time", time), ("label quality", self._column("quality"))):
            if column is not None:
                yield self._verdict(name, [self._scored(column[:, None], inside, _smooth)])
        yield from self._from_picture(inside, "split")

    def _column(self, name: str) -> NDArray[np.float64] | None:
        return np.asarray(self.dataset[name].values, dtype=np.float64) if name in self.dataset else None

    def _smoothing(self) -> Leak:
        """Count the test frames whose label shares a measurement with a training frame's; any is a leak."""
        span = reach_of(self.dataset)
        if span is None:
            return self._untested(
                "label smoothing", "the dataset does not say how far its labels reach: build it again"
            )
        test = self.split == TEST
        share = float(meeting(span, self.recording, test, self.split == TRAIN)[test].mean())
        return Leak("label smoothing", self.name, share, 0.0, 0.0, "found" if share else "none")

    def _other_half(self) -> NDArray[np.int64] | None:
        """Return 0 or 1 per frame, alternating over each class's recordings; None if these are too few for chance."""
        numbers, first = np.unique(self.recording, return_index=True)
        classes = self.values[first].argmax(axis=1)
        half = np.array([np.count_nonzero(classes[:n] == one) % 2 for n, one in enumerate(classes)])
        if np.bincount(classes).min() < 2 or deals_possible(classes, half) <= ROUNDS:
            return None
        return half[np.searchsorted(numbers, self.recording)]

    def _from_picture(self, trial: _Trial, scope: Scope) -> Iterator[Leak]:
        """Try the crop's position and its corners."""
        corners = self.corners
        x, y = self._column("centre_x"), self._column("centre_y")
        if x is not None and y is not None:
            yield self._verdict("position", [self._scored(np.stack([x, y], axis=1), trial, _smooth)], scope)
        light = float(np.median(corners.halo[:, :4].mean(axis=1)))
        if light > corners.noise:
            why = f"the RR's light reaches the corners ({light:.1f} counts nearer to it, noise {corners.noise:.1f})"
            for name in ("background", "fixed pattern", "hot pixels"):
                yield self._untested(name, why, scope)
            return
        each = [self._scored(corners.level - share * corners.halo, trial, _smooth) for share in FALL_OFFS]
        halo = self._scored(corners.halo, trial, _smooth)
        yield self._verdict("background", [*each, replace(each[0], limit=halo.score)], scope)
        rows = np.zeros(len(self.recording), dtype=np.int64)
        rows[corners.frames] = np.arange(len(corners.frames))
        for name, pixels in (("fixed pattern", corners.pattern), ("hot pixels", corners.hot)):
            if pixels.shape[1]:
                yield self._verdict(name, [self._scored(pixels, trial, _linear, rows)], scope)

    def _untested(self, name: str, why: str, scope: Scope = "split") -> Leak:
        return Leak(name, self.name, np.nan, np.nan, np.nan, "untested", scope, why)

    def _verdict(self, name: str, scores: list[_Score], scope: Scope = "split") -> Leak:
        """Return the verdict of the weakest score, because a leak has to be found by every score."""
        weakest = min(scores, key=lambda one: one.score - one.limit)
        found = "found" if weakest.score > weakest.limit else "none"
        return Leak(name, self.name, weakest.score, weakest.baseline, weakest.limit, found, scope)

    def _scored(
        self, features: NDArray[Any], trial: _Trial, models: Models, rows: NDArray[np.int64] | None = None
    ) -> _Score:
        """Score the best of some models, also under chance; `rows` are the frames' rows in the features."""
        train, test = (trial.train, trial.test) if rows is None else (rows[trial.train], rows[trial.test])
        rounds = np.concatenate([np.arange(len(self.values))[None], trial.chance])
        truth = self.values[rounds[:, trial.test]]
        learnt = self.values[rounds[:, trial.train]]
        width, columns = learnt.shape[2], learnt.transpose(1, 0, 2).reshape(len(train), -1)
        scores = []
        # Each model's prediction is linear in the labels, so that one fit serves all rounds.
        for weights in models(features[train], features[test]):
            predicted = (weights @ columns).reshape(len(test), len(rounds), width).transpose(1, 0, 2)
            if self.classes:
                scores.append((predicted.argmax(axis=2) == truth.argmax(axis=2)).mean(axis=1))
            else:
                mean = learnt.mean(axis=1, keepdims=True)
                left = np.square(predicted - truth).sum(axis=(1, 2))
                scores.append(1 - left / np.maximum(np.square(mean - truth).sum(axis=(1, 2)), 1e-300))
        best = np.max(scores, axis=0)
        baseline = float(truth[0][:, learnt[0].sum(axis=0).argmax()].mean()) if self.classes else 0.0
        # Neighbours need more, because the end of the train part is near the start of the test part by design.
        effect = _EFFECT_OF_NEIGHBOURS if models is _nearest else _EFFECT
        chance = max(float(best[1:].max()), baseline)
        return _Score(float(best[0]), baseline, chance + effect * (1 - chance))


# Simple models, all linear in the labels: each returns weights [test, train] of the training labels, so that one fit
# predicts any number of labels, those of chance included.


def _smooth(train: NDArray[Any], test: NDArray[Any]) -> list[Any]:
    """Return the weights [test, train] of a ridge on polynomials and of the 15 nearest neighbours."""
    scaler = StandardScaler().fit(train)
    # Clipped at four deviations, so that polynomials do not diverge on outliers.
    train, test = (np.clip(scaler.transform(one), -4, 4) for one in (train, test))
    terms = PolynomialFeatures(degree=3 if train.shape[1] <= 2 else 2, include_bias=False)
    ridge = Ridge(alpha=1e-2 * len(train)).fit(terms.fit_transform(train), np.eye(len(train)))
    return [ridge.predict(terms.transform(test)), _neighbours(train, test, min(15, len(train)))]


def _nearest(train: NDArray[Any], test: NDArray[Any]) -> list[Any]:
    """Return the weights [test, train] of the nearest neighbour."""
    return [_neighbours(train, test, 1)]


def _neighbours(train: NDArray[Any], test: NDArray[Any], count: int) -> csr_array:
    tree = NearestNeighbors(n_neighbors=count).fit(train)
    return csr_array(tree.kneighbors_graph(test) / count)


def _linear(train: NDArray[Any], test: NDArray[Any]) -> list[Any]:
    """Return the weights [test, train] of a ridge on many pixels, each in its own standard deviations of noise."""
    ridge = Ridge(alpha=float(train.shape[1])).fit(train, np.eye(len(train), dtype=train.dtype))
    return [ridge.predict(test)]
