"""A model's predictions for a dataset's test part with the truth, from which all scores and figures are made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from tapetum.data.dataset import DEVICE, TRUE_GAZE, image_batches
from tapetum.errors import InputError
from tapetum.models import Prediction, Predictor
from tapetum.models.snr import crop_snr
from tapetum.progress import Progress, quiet

__all__ = ["COVARIATES", "Outcome", "gather", "gather_parts"]

COVARIATES = {"distance": "m", "exposure": "s"}
"""Quantities besides SNR that a frame's error may depend on, with units."""

# Their paths in the entries of `dataset.tp.recordings` of the virtual bench.
_IN_SCENE = {"distance": ("scene", "distance"), "exposure": ("scene", "probe", "sensor", "exposure")}
_BATCH = 64

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Outcome:
    """Truth and prediction of N frames that were not used in training.

    Parameters
    ----------
    dataset, simulated
        The dataset's name, and whether the virtual bench filmed it; None where the dataset does not say.
    prediction, truth
        Of the N frames; the truth is [N] for each predicted quantity.
    recording, recordings
        [N] index of each frame's recording, and the recordings' names.
    time, snr
        [N] seconds in the recording, and signal-to-noise ratio by `tapetum.models.snr.crop_snr`.
    guess, commonest
        Baselines from the training part, which look at no image: the mean of each quantity (None without training
        frames) and the commonest device.
    device
        [N] names of the true devices, which the model may not know; None where the dataset does not hold them.
    covariates
        [N] of some of `COVARIATES`; absent where unknown.
    true_gaze
        [N, 2] true gaze, from which the labels differ by the label error; None where unknown.
    """

    dataset: str
    prediction: Prediction
    truth: Mapping[str, Array]
    recording: NDArray[np.int64]
    recordings: tuple[str, ...]
    time: Array
    snr: Array
    guess: Mapping[str, float] | None = None
    device: tuple[str, ...] | None = None
    commonest: str | None = None
    covariates: Mapping[str, Array] = field(default_factory=dict)
    true_gaze: Array | None = None
    simulated: bool | None = None

    def __post_init__(self) -> None:
        count = len(self.prediction)
        columns = {**self.truth, **self.covariates, "recording": self.recording, "time": self.time, "snr": self.snr}
        for name, values in columns.items():
            if np.shape(values) != (count,):
                raise InputError(f"expected {count} values, got shape {np.shape(values)}", where=name)
        if self.device is not None and len(self.device) != count:
            raise InputError(f"expected {count} names, got {len(self.device)}", where=DEVICE)
        if self.true_gaze is not None and self.true_gaze.shape != (count, 2):
            raise InputError(f"expected shape ({count}, 2), got {self.true_gaze.shape}", where="true_gaze")
        missing = [name for name in self.prediction.names if name not in self.truth]
        if missing:
            raise InputError("is predicted, but the truth is not known", where=missing[0])

    def __len__(self) -> int:
        return len(self.prediction)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the quantities predicted."""
        return self.prediction.names

    @property
    def targets(self) -> Array:
        """[N, K] true values."""
        return self.stacked(self.truth)

    @property
    def baseline(self) -> Array | None:
        """[N, K] of the guess that looks at no image; None without training frames."""
        if self.guess is None:
            return None
        row = np.array([self.guess[name] for name in self.quantities], dtype=np.float64)
        return np.tile(row, (len(self), 1))

    @property
    def has_gaze(self) -> bool:
        """Whether both coordinates of the gaze are predicted."""
        return {"gaze_x", "gaze_y"} <= set(self.quantities)

    def stacked(self, columns: Mapping[str, Array]) -> Array:
        """Return columns in the order of the quantities, [N, K]."""
        found = [np.asarray(columns[name], dtype=np.float64) for name in self.quantities]
        return np.stack(found, axis=1) if found else np.empty((len(self), 0))

    def pair(self, names: Sequence[str] = ("gaze_x", "gaze_y")) -> tuple[Array, Array]:
        """Return truth and prediction of these quantities, [N, len(names)] each."""
        truth = np.stack([self.truth[name] for name in names], axis=1)
        return truth, np.stack([self.prediction[name] for name in names], axis=1)


def gather(
    model: Predictor,
    dataset: xr.Dataset,
    *,
    covariates: Mapping[str, ArrayLike] | None = None,
    progress: Progress = quiet,
) -> Outcome:
    """Predict a dataset's test part and collect the truth and baselines of those frames.

    Parameters
    ----------
    model, dataset
        A fitted model and the whole dataset: its training part gives the baselines.
    covariates
        [N] values of `COVARIATES` for the test frames, where the dataset does not hold them.
    progress
        Shown over the frames.

    Raises
    ------
    InputError
        When there are no test frames, a label that the model predicts is missing or not finite, the crops are smaller
        than those it was trained on, or all frames show one class.
    """
    return gather_parts(model, dataset.tp.test, dataset.tp.train, covariates=covariates, progress=progress)


def gather_parts(
    model: Predictor,
    test: xr.Dataset,
    train: xr.Dataset,
    *,
    covariates: Mapping[str, ArrayLike] | None = None,
    progress: Progress = quiet,
) -> Outcome:
    """As `gather`, with test and training frames that may come from different datasets."""
    where = _name(test)
    missing = next((name for name in model.target_names if name not in test), None)
    if missing is not None:
        have = ", ".join(test.tp.targets) or "none"
        remedy = f"it has: {have}; use a model of what it is labelled with"
        raise InputError(f"has no label {missing}", where=where, remedy=remedy)
    if not test.sizes["frame"]:
        raise InputError("has no test frames", where=where, remedy="build it with a test fraction above 0")
    quantities = model.quantities
    truth = {name: np.asarray(test[name].values, dtype=np.float64) for name in quantities}
    for name, values in truth.items():
        bad = int(np.count_nonzero(~np.isfinite(values)))
        if bad:
            what = f"{bad} of {len(values)} labels {name} are no numbers"
            raise InputError(what, where=where, remedy="leave out frames without a label")
    device = _devices(test)
    if DEVICE in model.target_names and device is not None and len(set(device)) < 2:
        what = f"all test frames show one class, {device[0]}: there is nothing to distinguish"
        raise InputError(what, where=where, remedy="add recordings of other devices")
    entries = test.tp.recordings
    number = np.asarray(test["recording"].values, dtype=np.int64)
    guessed = {name: np.asarray(train[name].values, dtype=np.float64) for name in quantities if name in train}
    trains = train.sizes["frame"] > 0 and len(guessed) == len(quantities)
    known = _devices(train)
    return Outcome(
        dataset=Path(where).name,
        # Score refused frames too, so that refusing does not improve a score; refusals are counted separately.
        prediction=model.predict(test, progress=progress, anyway=True),
        truth=truth,
        recording=number,
        recordings=_recording_names(entries, number),
        time=np.asarray(test["time"].values if "time" in test else np.arange(len(number)), dtype=np.float64),
        snr=_snr(test, progress),
        guess={name: float(values.mean()) for name, values in guessed.items()} if trains else None,
        device=device,
        commonest=max(sorted(set(known)), key=known.count) if known else None,
        covariates=_covariates(test, entries, number) | _given(covariates),
        true_gaze=_true_gaze(test),
        simulated=_simulated(test, entries),
    )


def _name(dataset: xr.Dataset) -> str:
    return str(dataset.encoding.get("source", "dataset"))


def _devices(dataset: xr.Dataset) -> tuple[str, ...] | None:
    """Return the device of every frame, or None."""
    if DEVICE not in dataset:
        return None
    names = dataset.tp.classes
    return tuple(names[int(k)] for k in dataset[DEVICE].values)


def _true_gaze(dataset: xr.Dataset) -> Array | None:
    if not all(name in dataset for name in TRUE_GAZE):
        return None
    return np.stack([np.asarray(dataset[name].values, dtype=np.float64) for name in TRUE_GAZE], axis=1)


def _snr(dataset: xr.Dataset, progress: Progress) -> Array:
    """Return the SNR of every frame, as used by the models' intervals."""
    total = -(-dataset.sizes["frame"] // _BATCH)
    parts = progress(image_batches(dataset, _BATCH), "signal over noise", total=total)
    return np.concatenate([crop_snr(images, dataset.tp.full_scale) for images in parts])


def _recording_names(entries: list[dict[str, Any]], number: NDArray[np.int64]) -> tuple[str, ...]:
    count = max(len(entries), int(number.max(initial=-1)) + 1)
    told = [str(entry.get("name", f"recording {n}")) for n, entry in enumerate(entries)]
    return tuple(told + [f"recording {n}" for n in range(len(told), count)])


def _given(covariates: Mapping[str, ArrayLike] | None) -> dict[str, Array]:
    return {name: np.asarray(values, dtype=np.float64) for name, values in (covariates or {}).items()}


def _covariates(dataset: xr.Dataset, entries: list[dict[str, Any]], number: NDArray[np.int64]) -> dict[str, Array]:
    """Return covariates of every frame, from a variable along the frames or from its recording."""
    found: dict[str, Array] = {}
    for name, path in _IN_SCENE.items():
        if name in dataset and dataset[name].dims == ("frame",):
            found[name] = np.asarray(dataset[name].values, dtype=np.float64)
            continue
        values = [_told(entry, name, path) for entry in entries]
        if all(0 <= n < len(values) and values[n] is not None for n in np.unique(number).tolist()):
            found[name] = np.array([values[n] for n in number.tolist()], dtype=np.float64)
    return {name: values for name, values in found.items() if np.isfinite(values).all()}


def _told(entry: Mapping[str, Any], name: str, path: tuple[str, ...]) -> float | None:
    value: Any = entry.get(name)
    if value is None:
        value = entry.get("parameters")
        for key in path:
            value = value.get(key) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _simulated(dataset: xr.Dataset, entries: list[dict[str, Any]]) -> bool | None:
    if "synth" in dataset.attrs:
        return True
    # Only recordings of the virtual bench name a scene among their hardware.
    words = " ".join(str(entry.get(key, "")) for entry in entries for key in ("hardware", "bench", "source"))
    known = any(isinstance(entry.get("parameters"), Mapping) and "scene" in entry["parameters"] for entry in entries)
    return known or "virtual" in words or "simulated" in words or None
