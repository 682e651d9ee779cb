"""What every estimator takes, gives and promises."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, Self, TypeAlias, runtime_checkable

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import TRAIN, image_batches
from tapetum.errors import InputError
from tapetum.models.features import as_images
from tapetum.progress import Progress, quiet

__all__ = [
    "COVERAGE",
    "TARGETS",
    "Data",
    "Estimator",
    "Prediction",
    "TrainingPart",
    "conformal_half_width",
    "training_part",
]

COVERAGE = 0.9
"""Share of true values that the intervals are meant to hold."""

TARGETS: dict[str, tuple[str, ...]] = {
    "gaze": ("gaze_x", "gaze_y"),
    "focus": ("object_distance", "focal_length"),
}
"""What a model may be asked for, and the labels that answer it. Any label's own name does as well."""

Data: TypeAlias = xr.Dataset | NDArray[np.generic]
"""A dataset, or crops [N, side, side]."""


@dataclass(frozen=True)
class Prediction:
    """Estimates of K quantities for N images.

    Parameters
    ----------
    names
        K names, for example ("gaze_x", "gaze_y").
    value
        [N, K] estimates, SI units; gaze in fractions of the field of view.
    lower, upper
        [N, K] ends of an interval meant to hold the true value with the probability `COVERAGE`; infinite
        where a model was fitted without frames to calibrate on.
    """

    names: tuple[str, ...]
    value: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]

    def __post_init__(self) -> None:
        shape = (len(self.value), len(self.names))
        if not self.value.shape == self.lower.shape == self.upper.shape == shape:
            raise InputError(
                f"value, lower and upper must all be {shape},"
                f" are {self.value.shape}, {self.lower.shape} and {self.upper.shape}"
            )
        if not np.isfinite(self.value).all() or np.isnan(self.lower).any() or np.isnan(self.upper).any():
            raise InputError(
                "a prediction is not finite", where="model", remedy="train it again; its weights are unusable"
            )

    def __len__(self) -> int:
        return len(self.value)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the [N] estimates of one quantity."""
        if name not in self.names:
            raise InputError(f"no estimate of {name!r}", remedy=f"there are: {', '.join(self.names)}")
        return self.value[:, self.names.index(name)]

    def columns(self) -> dict[str, NDArray[np.float64]]:
        """Return the columns of a table of tracks: for each name NAME, NAME_low and NAME_high, [N] each."""
        table: dict[str, NDArray[np.float64]] = {}
        for k, name in enumerate(self.names):
            table |= {
                name: self.value[:, k],
                f"{name}_low": self.lower[:, k],
                f"{name}_high": self.upper[:, k],
            }
        return table


@runtime_checkable
class Estimator(Protocol):
    """A model of images: scikit-learn's contract, with progress and intervals.

    Parameters are arguments of ``__init__`` and come back from `parameters`; what is learned ends in an
    underscore.
    """

    kind: ClassVar[str]
    target_names: tuple[str, ...]
    data_hash_: str | None

    def fit(self, dataset: xr.Dataset, *, progress: Progress = quiet) -> Self: ...

    def predict(self, data: Data, *, full_scale: float | None = None, progress: Progress = quiet) -> Prediction: ...

    def parameters(self) -> dict[str, Any]:
        """Return the arguments of ``__init__``, fit for JSON."""
        ...

    def state(self) -> dict[str, torch.Tensor]:
        """Return everything that was learned."""
        ...

    @classmethod
    def from_state(cls, parameters: Mapping[str, Any], state: Mapping[str, torch.Tensor]) -> Self:
        """Make a fitted model of what `parameters` and `state` returned."""
        ...


def target_names(target: str | tuple[str, ...]) -> tuple[str, ...]:
    """Return the labels behind a target: "gaze", "focus", a label's own name or several of them."""
    if isinstance(target, str):
        return TARGETS.get(target, (target,))
    if not target:
        raise InputError(
            "nothing to estimate", where="target", remedy=f"give one of {', '.join(TARGETS)} or labels' names"
        )
    return tuple(target)


@dataclass(frozen=True)
class TrainingPart:
    """The training frames of a dataset, those to fit apart from those to calibrate the intervals with.

    Parameters
    ----------
    dataset
        The training frames alone.
    targets
        [N, K] labels.
    fit, calibrate
        Positions in `dataset`, in order.
    full_scale
        Largest count of the camera.
    data_hash
        Hash of the dataset they come from, where known.
    """

    dataset: xr.Dataset
    targets: NDArray[np.float64]
    fit: NDArray[np.intp]
    calibrate: NDArray[np.intp]
    full_scale: float
    data_hash: str | None


def training_part(dataset: xr.Dataset, names: tuple[str, ...], calibration_fraction: float) -> TrainingPart:
    """Take the training frames of a dataset; set the last share of each recording's aside for the intervals.

    Frames marked for testing are never used, even when the whole dataset is given.

    Raises
    ------
    InputError
        When there is no training frame, too few of them, or a label is missing.
    """
    if not 0 <= calibration_fraction < 1:
        raise InputError(
            f"must lie in 0 ... 1, is {calibration_fraction}",
            where="calibration_fraction",
            remedy="0.1 is usual",
        )
    split = np.asarray(dataset["split"].values)
    train = dataset.isel(frame=np.flatnonzero(split == TRAIN))
    targets = train.tp.values(names)
    if not np.isfinite(targets).all():
        raise InputError("labels are not finite", where="dataset", remedy="build the dataset again")
    recording = np.asarray(train["recording"].values)
    aside = np.zeros(len(recording), dtype=bool)
    for number in np.unique(recording):
        places = np.flatnonzero(recording == number)
        aside[places[len(places) - round(calibration_fraction * len(places)) :]] = True
    fit = np.flatnonzero(~aside)
    if len(fit) < 2:
        raise InputError(f"{len(recording)} frames to train with are too few", where="dataset", remedy="record more")
    return TrainingPart(train, targets, fit, np.flatnonzero(aside), train.tp.full_scale, train.attrs.get("sha256"))


def conformal_half_width(residuals: NDArray[np.float64], coverage: float = COVERAGE) -> NDArray[np.float64]:
    """Return the half-width of split-conformal intervals.

    The ``ceil((n + 1) coverage)``-th smallest absolute residual of n frames that took no part in fitting: new
    frames *exchangeable* with those fall inside with at least that probability (Lei et al., J. Am. Stat.
    Assoc. 113, 1094 (2018)). Frames of one video follow each other, so for other videos it is a guide and not
    a guarantee.

    Parameters
    ----------
    residuals
        [n, K], true minus estimated.
    coverage
        Wanted probability.

    Returns
    -------
    ndarray
        [K]; infinite where n is too small for the coverage (n < 9 for 90 %).
    """
    rank = int(np.ceil((len(residuals) + 1) * coverage))
    if rank > len(residuals):
        return np.full(residuals.shape[1], np.inf)
    return np.sort(np.abs(residuals), axis=0)[rank - 1]


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
