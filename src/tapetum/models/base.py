"""Common part of all models: targets, training frames, `predict`, and the interface of estimators.

A little over 400 lines: what every model shares is in one place, so that a new one is one file.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self, TypeAlias, TypeVar

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import DEVICE, STD, TRAIN, image_batches
from tapetum.data.embargo import meeting, reach_of
from tapetum.data.marks import marks_of
from tapetum.errors import InputError, of_type, one_of
from tapetum.models.domain import Domain, judged
from tapetum.models.features import as_images
from tapetum.models.intervals import Intervals
from tapetum.models.prediction import Prediction, joined
from tapetum.progress import Progress, quiet

__all__ = [
    "TARGETS",
    "UNIT_CHOICES",
    "Data",
    "Estimator",
    "Predictor",
    "TrainingPart",
    "quantities_of",
    "target_names",
    "training_part",
]

TARGETS: dict[str, tuple[str, ...]] = {
    "gaze": ("gaze_x", "gaze_y"),
    "focus": ("object_distance", "focal_length"),
    "device": (DEVICE,),
    "phone": ("gaze_x", "gaze_y", DEVICE),
}
"""Short names of targets, and their labels. A label's own name is a target as well."""

Data: TypeAlias = xr.Dataset | NDArray[np.generic]
"""A dataset, or crops [N, side, side]."""


T = TypeVar("T")

UNIT_CHOICES = ("own", "other")
"""Whose intervals: those of the copy of the camera that the model was trained on, or those of another one."""


class Predictor(ABC):
    """A fitted model, on any runtime.

    Attributes
    ----------
    kind
        Its name on the model card.
    target_names, quantities
        The labels that it estimates, and those of them that are numbers.
    intervals_
        `tapetum.models.intervals.Intervals`, calibrated on training frames that were not fitted.
    others_
        Intervals for a copy of the camera that the model was not trained on, divided by the distance from the training
        frames (`tapetum.models.other_units`), or None.
    marks
        Of the films that it was trained on (`tapetum.record.marks`).
    whose
        Which intervals `predict` uses where its argument does not say, one of `UNIT_CHOICES`; None for what the data
        say. Not saved with a model.
    data_hash_
        Hash of the content of the fitted training frames, where known.
    """

    kind: str
    target_names: tuple[str, ...]
    quantities: tuple[str, ...]
    intervals_: Intervals
    others_: Intervals | None = None
    whose: str | None = None
    data_hash_: str | None
    _batch: ClassVar[int] = 64

    @property
    @abstractmethod
    def marks(self) -> frozenset[str]: ...

    def predict(
        self,
        data: Data,
        *,
        full_scale: float | None = None,
        progress: Progress = quiet,
        anyway: bool = False,
        unit: str | None = None,
    ) -> Prediction:
        """Estimate the target for every image.

        Parameters
        ----------
        data
            A dataset or crops [N, side, side], centred like the training crops.
        full_scale
            Largest count of the camera, for crops that are not uint8.
        progress
            Shown over the batches.
        anyway
            Keep the estimates of images to which the model does not apply; their `reason` is still set.
        unit
            Whose intervals, of `UNIT_CHOICES`; by default `Predictor.whose`. Where that is None too: "own" for a
            dataset whose recordings show what the model was trained on, and for a model without other intervals; else
            "other".

        Raises
        ------
        InputError
            When the model is not fitted, the images do not fit it, or it has no intervals for another copy.
        """
        own = self._own(data, unit) == "own"

        def estimate(images: NDArray[np.generic], depth: float) -> Prediction:
            return self._estimate(images, depth, own)

        found = joined(self._map_batches(estimate, self._progress_label(), data, full_scale, progress))
        return found if anyway else found.withheld()

    def _own(self, data: Data, unit: str | None) -> str:
        """Return whose intervals to use."""
        unit = self.whose if unit is None else one_of(unit, UNIT_CHOICES, "unit")
        if unit == "other" and self.others_ is None:
            remedy = "calibrate them with `tapetum calibrate units`, or use its own"
            raise InputError("has no intervals for another copy of its camera", where="model", remedy=remedy)
        if unit is not None or self.others_ is None:
            return unit or "own"
        return "own" if self._shown(marks_of(data) if isinstance(data, xr.Dataset) else []) else "other"

    def _shown(self, marks: Sequence[frozenset[str]]) -> bool:
        """Whether films with these marks are known to show what the model was trained on."""
        return bool(marks) and all(self.knows(one) for one in marks)

    def knows(self, marks: frozenset[str]) -> bool:
        """Whether a film with these marks (`tapetum.record.marks`) shows what the model was trained on."""
        return bool(self.marks & marks)

    def unsure(self, marks: Sequence[frozenset[str]]) -> str:
        """Return why the intervals may be too narrow for films with these marks; empty where they are not.

        They are where they would be those of its own camera, which the films are not known to show, only because it has
        none for another copy, and nobody said whose to use.
        """
        held = getattr(self, "intervals_", None)
        if held is None or not np.isfinite(held.half_width).any() or self.whose is not None or self.others_ is not None:
            return ""
        if self._shown(marks):
            return ""
        return (
            "its intervals are those of the camera that it was trained on, which this input is not known to show; "
            "it has none for another copy of it"
        )

    @abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Return the arguments that the model was made with, as values that JSON can hold."""

    def classes(self) -> tuple[str, ...]:
        """Return the names of the devices learned; empty where that is no target."""
        return ()

    @abstractmethod
    def _progress_label(self) -> str:
        """Return the label of the progress bar."""

    @abstractmethod
    def _estimate(self, images: NDArray[np.generic], full_scale: float, own: bool = True) -> Prediction:
        """Return the estimates of one batch, with a reason for each image to which the model does not apply.

        `own` says whose intervals they have, those of the copy trained on or of another one.
        """

    def _map_batches(
        self,
        read: Callable[[NDArray[np.generic], float], T],
        what: str,
        data: Data,
        full_scale: float | None = None,
        progress: Progress = quiet,
    ) -> list[T]:
        """Call `read` with each batch of images and its full scale; return its results, at least one."""
        total = -(-frame_count(data) // self._batch)
        return [read(*one) for one in progress(self._batches(data, full_scale), what, total=total)]

    def _batches(self, data: Data, full_scale: float | None) -> Iterator[tuple[NDArray[np.generic], float]]:
        """Yield batches of crops with their full scale; a single empty batch when there are no crops."""
        if isinstance(data, xr.Dataset):
            depth = data.tp.full_scale if full_scale is None else full_scale
            empty = np.empty((0, data.tp.side, data.tp.side), np.uint8)
            for images in image_batches(data, self._batch) if data.sizes["frame"] else [empty]:
                yield as_images(images, depth, where="dataset")
            return
        images, depth = as_images(data, full_scale)
        for start in range(0, max(1, len(images)), self._batch):
            yield images[start : start + self._batch], depth

    def _prediction(
        self,
        value: NDArray[np.float64],
        snr: Callable[[], NDArray[np.float64]],
        distance: NDArray[np.float64] | None,
        probability: NDArray[np.float64] | None = None,
        novelty: NDArray[np.float64] | None = None,
        own: bool = True,
        deviation: NDArray[np.float64] | None = None,
    ) -> Prediction:
        """Make a prediction of values [N, K]: add the intervals and the reasons why the model does not apply.

        `deviation` [N] multiplies the widths for the camera that the model learned.
        """
        if not own:
            assert self.others_ is not None
            width = self.others_.at(np.zeros(len(value)) if distance is None else distance)
            ends = value - width, value + width
            found = Prediction(self.quantities, value, *ends, self.classes(), probability, novelty, unit="other")
            return judged(found, distance)
        # The SNR costs half a millisecond a frame: only where the intervals depend on it.
        width = self.intervals_.at(snr() if self.intervals_.conditional else np.zeros(len(value)))
        if deviation is not None:
            width = width * deviation[:, None]
        ends = value - width, value + width
        return judged(Prediction(self.quantities, value, *ends, self.classes(), probability, novelty), distance)


class Estimator(Predictor):
    """A trainable model of images: scikit-learn's contract, with progress bars and intervals.

    Parameters are the arguments of ``__init__`` and come back from `parameters`; learned attributes end in an
    underscore.

    Attributes
    ----------
    domain_
        `tapetum.models.domain.Domain`: what the training frames look like; None with fewer than 40 frames, and in
        models saved by versions without it.
    training_
        How many frames were fitted and held out, and how crops were centred: `TrainingPart.summary`.
    """

    domain_: Domain | None
    training_: dict[str, Any] | None

    @property
    def marks(self) -> frozenset[str]:
        return frozenset((self.training_ or {}).get("films") or ())

    @abstractmethod
    def fit(self, dataset: xr.Dataset, *, progress: Progress = quiet) -> Self:
        """Fit the training frames of a dataset; return the estimator."""

    @abstractmethod
    def state(self) -> dict[str, torch.Tensor]:
        """Return everything that was learned."""

    @classmethod
    @abstractmethod
    def from_state(
        cls, parameters: Mapping[str, Any], state: Mapping[str, torch.Tensor], classes: tuple[str, ...] = ()
    ) -> Self:
        """Rebuild a fitted model from the results of `parameters`, `state` and `classes`."""

    def _check_fitted(self) -> None:
        if not hasattr(self, "intervals_"):
            raise InputError("the model is not fitted", where=self.kind, remedy="call fit or load_model first")


def frame_count(data: Data) -> int:
    """Return how many images `data` holds."""
    if isinstance(data, xr.Dataset):
        return int(data.sizes["frame"])
    return 1 if np.ndim(data) == 2 else len(data)


def target_names(target: str | Sequence[str]) -> tuple[str, ...]:
    """Return the labels of a target: "gaze", "focus", "device", "phone", a label's own name or several."""
    if isinstance(target, str):
        return TARGETS.get(target, (target,))
    of_type(target, Sequence, "target", f"give one of {', '.join(TARGETS)} or labels' names")
    if not target:
        remedy = f"give one of {', '.join(TARGETS)} or labels' names"
        raise InputError("nothing to estimate", where="target", remedy=remedy)
    return tuple(target)


def plain_target(target: str | tuple[str, ...]) -> str | list[str]:
    """Return a target as a text or list of texts, for JSON."""
    return target if isinstance(target, str) else list(target)


def quantities_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those labels that are numbers: all but the device."""
    return tuple(name for name in names if name != DEVICE)


# Error of a model that the labels' own is compared with, as a part of the labels' spread.
OWN_ERROR = 0.02


@dataclass(frozen=True)
class TrainingPart:
    """The training frames of a dataset, divided into those that fit, calibrate and choose.

    `dataset` holds the training frames alone, `targets` [N, K] the values of the `quantities`; `camera` [N] numbers
    each frame's device among `classes` (None where the device is no target). `fit`, `calibrate` and `choose` are
    ascending positions in `dataset`; no frame is in two of them. `data_hash` covers images, labels, recordings and
    classes.
    """

    dataset: xr.Dataset
    quantities: tuple[str, ...]
    targets: NDArray[np.float64]
    camera: NDArray[np.int64] | None
    classes: tuple[str, ...]
    fit: NDArray[np.intp]
    calibrate: NDArray[np.intp]
    full_scale: float
    data_hash: str
    choose: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))

    @property
    def weights(self) -> NDArray[np.float64] | None:
        """Weights [N, K] of the labels by their standard deviations, with a mean of 1; None where none are known.

        A label's variance adds to the model's own, which is not known before training: a fiftieth of the labels'
        spread stands for it, about what a network reaches on gaze. So labels much surer than that weigh alike.
        """
        known = [f"{name}{STD}" in self.dataset for name in self.quantities]
        if not any(known):
            return None
        own = OWN_ERROR * self.targets.std(axis=0)
        found = np.ones(self.targets.shape)
        for k, name in enumerate(self.quantities):
            if known[k]:
                found[:, k] = 1 / (1 + (np.asarray(self.dataset[f"{name}{STD}"].values, np.float64) / own[k]) ** 2)
        if not np.isfinite(found).all():
            what = "holds standard deviations of labels that are not numbers"
            raise InputError(what, where="dataset", remedy="build it again")
        return found / found.mean(axis=0)

    @property
    def summary(self) -> dict[str, Any]:
        """The model card's entry on the training: frame counts, origin of the intervals, centring of the crops."""
        kept = len(self.calibrate)
        return {
            "frames": len(self.targets),
            "fitted": len(self.fit),
            "calibrated_on": kept,
            "embargo": len(self.targets) - len(self.fit) - kept - len(self.choose),
            # Settings that were chosen by data, and by which frames; test frames never choose.
            "chosen": {},
            "intervals": "from the last part of every recording's training frames, kept out of the fit"
            if kept
            else "none: every training frame is fitted, as in the paper",
            "centring": self.dataset.attrs.get("centring"),
            # Marks of what the frames show, by which the model knows it again.
            **({"films": films} if (films := sorted(frozenset().union(*marks_of(self.dataset)))) else {}),
            **({"units": list(units)} if (units := self.dataset.tp.units) else {}),
            # The constant estimate that serves as the baseline.
            "mean": dict(zip(self.quantities, self.targets.mean(axis=0).tolist(), strict=True)),
        }


def training_part(
    dataset: xr.Dataset, names: tuple[str, ...], calibration_fraction: float, *, select: bool = False
) -> TrainingPart:
    """Take the training frames of a dataset; hold the last share of each recording out of the fit.

    Held-out frames calibrate. With `select`, half of them choose instead (when to stop, for example), because a frame
    that chose would make the calibration too optimistic. Frames whose labels share a measurement with held-out frames
    (`tapetum.data.embargo`) are dropped. Test frames are never used. Raises an InputError when there are too few
    training frames, or a label is missing, not finite or constant.
    """
    of_type(dataset, xr.Dataset, "dataset", "open it by tapetum.data.open_dataset, or make one by dataset_from_arrays")
    if not 0 <= calibration_fraction < 1:
        what = f"must lie in 0 ... 1, is {calibration_fraction}"
        raise InputError(what, where="calibration_fraction", remedy="0.1 is usual")
    split = np.asarray(dataset["split"].values)
    train = dataset.isel(frame=np.flatnonzero(split == TRAIN))
    recording = np.asarray(train["recording"].values)
    few = InputError(f"{len(recording)} frames to train with are too few", where="dataset", remedy="record more")
    if len(recording) < 2:
        raise few
    quantities = quantities_of(names)
    targets = train.tp.values(quantities) if quantities else np.empty((len(recording), 0))
    camera, classes = _cameras(train) if DEVICE in names else (None, ())
    for k, name in enumerate(quantities):
        lost = np.flatnonzero(~np.isfinite(targets[:, k]))
        if len(lost):
            what = f"label {name} is not a number in {len(lost)} training frames, the first is number {lost[0]}"
            raise InputError(what, where="dataset", remedy="build or import it again without these frames")
        if np.ptp(targets[:, k]) == 0:
            count = len(np.unique(recording))
            of = "the one recording" if count == 1 else f"{count} recordings"
            what = f"{name} never changes in {of}: nothing to learn"
            raise InputError(what, where="dataset", remedy="add recordings with other values of it")
    aside, choosing = np.zeros((2, len(recording)), dtype=bool)
    owed = half = 0.0
    for number in np.unique(recording):
        places = np.flatnonzero(recording == number)
        # Rounding carries over to the next recording, so that many short recordings together give the whole share.
        owed += calibration_fraction * len(places)
        count = min(max(round(owed), 0), len(places))
        owed -= count
        last = places[len(places) - count :]
        aside[last] = True
        if select:
            half += count / 2
            choosing[last[: round(half)]] = True
            half -= round(half)
    span, rest = reach_of(train), aside & ~choosing
    fits = ~aside
    if span is not None:
        choosing &= ~meeting(span, recording, choosing, rest)
        fits &= ~meeting(span, recording, ~aside, aside)
    fit = np.flatnonzero(fits)
    if len(fit) < 2:
        raise few
    return TrainingPart(
        train,
        quantities,
        targets,
        camera,
        classes,
        fit,
        np.flatnonzero(rest),
        train.tp.full_scale,
        train.tp.hash,
        np.flatnonzero(choosing),
    )


def _cameras(train: xr.Dataset) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return the device of each frame as a number [N] among the devices that occur, and their names."""
    if DEVICE not in train:
        have = ", ".join(train.tp.targets) or "none"
        raise InputError("has no label 'device'", where="dataset", remedy=f"it has: {have}")
    names = train.tp.classes
    present, numbers = np.unique(np.asarray(train[DEVICE].values), return_inverse=True)
    if len(present) < 2:
        what = f"all frames show one device, {names[int(present[0])]}: nothing to distinguish"
        raise InputError(what, where="dataset", remedy="add recordings of other devices")
    return numbers.astype(np.int64), tuple(names[int(k)] for k in present)


def json_safe(value: Any, where: str) -> Any:
    """Return `value` after a round trip through JSON; raise an InputError for NaN, arrays and other non-JSON values."""
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        what = f"cannot be written as JSON ({error})"
        raise InputError(what, where=where, remedy="give plain numbers and text") from error
