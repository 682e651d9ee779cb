"""What every estimator takes, gives and promises."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, Self, TypeAlias, runtime_checkable

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import DEVICE, TRAIN, image_batches
from tapetum.data.embargo import meeting, reach_of
from tapetum.errors import InputError
from tapetum.models.features import as_images
from tapetum.models.prediction import Prediction
from tapetum.progress import Progress, quiet

__all__ = [
    "TARGETS",
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
"""What a model may be asked for, and the labels that answer it. Any label's own name does as well."""

Data: TypeAlias = xr.Dataset | NDArray[np.generic]
"""A dataset, or crops [N, side, side]."""


@runtime_checkable
class Predictor(Protocol):
    """A fitted model, whatever it runs on."""

    @property
    def kind(self) -> str: ...

    target_names: tuple[str, ...]
    quantities: tuple[str, ...]
    data_hash_: str | None

    def predict(
        self, data: Data, *, full_scale: float | None = None, progress: Progress = quiet, anyway: bool = False
    ) -> Prediction: ...

    def parameters(self) -> dict[str, Any]:
        """Return how it was made, fit for JSON."""
        ...

    def classes(self) -> tuple[str, ...]:
        """Return the names of the devices learned; empty where that is no target."""
        ...


@runtime_checkable
class Estimator(Predictor, Protocol):
    """A model of images that learns: scikit-learn's contract, with progress and intervals.

    Parameters are arguments of ``__init__`` and come back from `parameters`; what is learned ends in an
    underscore.
    """

    training_: dict[str, Any] | None

    def fit(self, dataset: xr.Dataset, *, progress: Progress = quiet) -> Self: ...

    def state(self) -> dict[str, torch.Tensor]:
        """Return everything that was learned."""
        ...

    @classmethod
    def from_state(
        cls, parameters: Mapping[str, Any], state: Mapping[str, torch.Tensor], classes: tuple[str, ...] = ()
    ) -> Self:
        """Make a fitted model of what `parameters`, `state` and `classes` returned."""
        ...


def target_names(target: str | tuple[str, ...]) -> tuple[str, ...]:
    """Return the labels behind a target: "gaze", "focus", "device", "phone", a label's own name or several."""
    if isinstance(target, str):
        return TARGETS.get(target, (target,))
    if not target:
        raise InputError(
            "nothing to estimate", where="target", remedy=f"give one of {', '.join(TARGETS)} or labels' names"
        )
    return tuple(target)


def quantities_of(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those labels that are numbers: all but the device."""
    return tuple(name for name in names if name != DEVICE)


@dataclass(frozen=True)
class TrainingPart:
    """The training frames of a dataset, those to fit apart from those to calibrate with.

    Parameters
    ----------
    dataset
        The training frames alone.
    quantities, targets
        Names and values [N, K] of the labels that are numbers.
    device
        [N] number of each frame's device in `classes`; None where that is no target.
    classes
        Names of the devices that there are training frames of.
    fit, calibrate, choose
        Positions in `dataset`, in order; those that choose do nothing else.
    full_scale
        Largest count of the camera.
    data_hash
        Of the content of the training frames: images, labels, recordings, classes.
    """

    dataset: xr.Dataset
    quantities: tuple[str, ...]
    targets: NDArray[np.float64]
    device: NDArray[np.int64] | None
    classes: tuple[str, ...]
    fit: NDArray[np.intp]
    calibrate: NDArray[np.intp]
    full_scale: float
    data_hash: str
    choose: NDArray[np.intp] = field(default_factory=lambda: np.empty(0, np.intp))

    @property
    def summary(self) -> dict[str, Any]:
        """What the model's card says of the training: counts of frames, intervals, and how crops were centred."""
        kept = len(self.calibrate)
        return {
            "frames": len(self.targets),
            "fitted": len(self.fit),
            "calibrated_on": kept,
            "embargo": len(self.targets) - len(self.fit) - kept - len(self.choose),
            # Whatever the data decided, and by which frames: never those that test.
            "chosen": {},
            "intervals": "from the last part of every recording's training frames, kept out of the fit"
            if kept
            else "none: every training frame is fitted, as in the paper",
            "centring": self.dataset.attrs.get("centring"),
            # What a guess that looks at no image would say.
            "mean": dict(zip(self.quantities, self.targets.mean(axis=0).tolist(), strict=True)),
        }


def training_part(
    dataset: xr.Dataset, names: tuple[str, ...], calibration_fraction: float, *, select: bool = False
) -> TrainingPart:
    """Take the training frames of a dataset; set the last share of each recording's aside to calibrate with.

    Frames before those whose labels share a measurement with theirs (`tapetum.data.embargo`) are neither fitted nor
    calibrated with. With `select` the first half of those aside chooses (when to stop, say) and the second calibrates:
    what was chosen by a frame looks too good there. Frames marked for testing are never used, even when the whole
    dataset is given.

    Raises
    ------
    InputError
        When there is no training frame, too few of them, a label is missing, not a number or the same throughout.
    """
    if not 0 <= calibration_fraction < 1:
        raise InputError(
            f"must lie in 0 ... 1, is {calibration_fraction}",
            where="calibration_fraction",
            remedy="0.1 is usual",
        )
    split = np.asarray(dataset["split"].values)
    train = dataset.isel(frame=np.flatnonzero(split == TRAIN))
    recording = np.asarray(train["recording"].values)
    if len(recording) < 2:
        raise InputError(f"{len(recording)} frames to train with are too few", where="dataset", remedy="record more")
    quantities = quantities_of(names)
    targets = train.tp.values(quantities) if quantities else np.empty((len(recording), 0))
    device, classes = _devices(train) if DEVICE in names else (None, ())
    videos = len(np.unique(recording))
    for k, name in enumerate(quantities):
        lost = np.flatnonzero(~np.isfinite(targets[:, k]))
        if len(lost):
            what = f"label {name} is not a number in {len(lost)} training frames, the first is number {lost[0]}"
            raise InputError(what, where="dataset", remedy="build or import it again without these frames")
        if np.ptp(targets[:, k]) == 0:
            what = f"{name} never changes in {_of(videos)}: nothing to learn"
            raise InputError(what, where="dataset", remedy="add recordings with other values of it")
    aside, choosing, owed, half = *(np.zeros(len(recording), dtype=bool) for _ in range(2)), 0.0, 0.0
    for number in np.unique(recording):
        places = np.flatnonzero(recording == number)
        # What one recording is too short to give counts for the next: many short ones give their share, too.
        owed += calibration_fraction * len(places)
        count = min(max(round(owed), 0), len(places))
        owed -= count
        aside[places[len(places) - count :]] = True
        if select:
            half += count / 2
            first = len(places) - count
            choosing[places[first : first + round(half)]] = True
            half -= round(half)
    span, rest = reach_of(train), aside & ~choosing
    fits = ~aside
    if span is not None:
        choosing &= ~meeting(span, recording, choosing, rest)
        fits &= ~meeting(span, recording, ~aside, aside)
    fit = np.flatnonzero(fits)
    if len(fit) < 2:
        raise InputError(f"{len(recording)} frames to train with are too few", where="dataset", remedy="record more")
    return TrainingPart(
        train,
        quantities,
        targets,
        device,
        classes,
        fit,
        np.flatnonzero(rest),
        train.tp.full_scale,
        train.tp.hash,
        np.flatnonzero(choosing),
    )


def _of(videos: int) -> str:
    return "the one recording" if videos == 1 else f"{videos} recordings"


def _devices(train: xr.Dataset) -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Return each frame's device, numbered among those that occur, and their names."""
    if DEVICE not in train:
        have = ", ".join(train.tp.targets) or "none"
        raise InputError("has no label 'device'", where="dataset", remedy=f"it has: {have}")
    names = train.tp.classes
    present, numbers = np.unique(np.asarray(train[DEVICE].values), return_inverse=True)
    if len(present) < 2:
        what = f"all frames show one device, {names[int(present[0])]}: nothing to distinguish"
        raise InputError(what, where="dataset", remedy="add recordings of other devices")
    return numbers.astype(np.int64), tuple(names[int(k)] for k in present)


def batches(data: Data, full_scale: float | None, size: int) -> Iterator[tuple[NDArray[np.generic], float]]:
    """Yield batches of crops with their full scale, from a dataset or an array."""
    if isinstance(data, xr.Dataset):
        depth = data.tp.full_scale if full_scale is None else full_scale
        for images in image_batches(data, size):
            yield as_images(images, depth, where="dataset")
        return
    images, depth = as_images(data, full_scale)
    for start in range(0, len(images), size):
        yield images[start : start + size], depth


def frame_count(data: Data) -> int:
    """Return how many images `data` holds."""
    if isinstance(data, xr.Dataset):
        return int(data.sizes["frame"])
    return 1 if np.ndim(data) == 2 else len(data)


def checked_state(
    state: Mapping[str, torch.Tensor], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, NDArray[np.float64]]:
    """Return the named tensors as float64 arrays.

    Raises
    ------
    InputError
        When one is missing, has another shape or is NaN.
    """
    arrays: dict[str, NDArray[np.float64]] = {}
    for name, shape in shapes.items():
        if name not in state or tuple(state[name].shape) != shape:
            found = "missing" if name not in state else f"{tuple(state[name].shape)}"
            remedy = "the model's card and its weights do not belong together"
            raise InputError(f"expected {name} of shape {shape}, found {found}", where="weights", remedy=remedy)
        arrays[name] = state[name].detach().cpu().double().numpy()
        if np.isnan(arrays[name]).any():
            raise InputError(f"{name} is not a number", where="weights", remedy="train the model again")
    return arrays


def json_safe(value: Any, where: str) -> Any:
    """Return `value` as JSON gives it back.

    Raises
    ------
    InputError
        When JSON cannot hold it, as NaN or an array.
    """
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"cannot be written as JSON ({error})", where=where, remedy="give plain numbers and text"
        ) from error
