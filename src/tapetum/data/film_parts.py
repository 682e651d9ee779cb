"""Parts of a labelled film: frames of one camera, so many seconds of it, in a row or spread over the field."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import DEVICE, UNIT
from tapetum.errors import InputError, one_of

__all__ = ["check_one_camera", "film_seconds", "first_seconds", "of_unit", "spread_over"]

# Frames a cell of the labels' range holds, about: enough cells to reach every part, enough frames to choose among.
_A_CELL = 2
# Axes of the labels' range that are divided into cells.
_AXES = 2


def of_unit(dataset: xr.Dataset, name: str) -> xr.Dataset:
    """Return the frames of one unit; raise an InputError for a name that the set does not have."""
    if UNIT not in dataset:
        raise InputError(
            "does not distinguish copies of its camera", where=dataset.tp.source, remedy="leave --unit out"
        )
    one_of(name, dataset.tp.units, "--unit")
    names = dataset[UNIT].attrs["classes"]
    part = dataset.isel(frame=np.flatnonzero(np.asarray(dataset[UNIT].values) == names.index(name)))
    part.encoding.update(dataset.encoding)
    return part


def check_one_camera(dataset: xr.Dataset, targets: Sequence[str]) -> None:
    """Refuse training frames of more than one camera: units, devices, lenses or scenes that differ.

    `targets` are the labels to learn, which may differ.
    """
    train = dataset.tp.train
    where, remedy = dataset.tp.source, "adapt to one camera at a time: build a set of its recordings alone"
    if len(units := train.tp.units) > 1:
        what = f"holds {len(units)} copies of a camera mixed: {', '.join(units[:3])}{' …' if len(units) > 3 else ''}"
        raise InputError(what, where=where, remedy="choose one with --unit NAME")
    if DEVICE in train and DEVICE not in targets:
        present = [train.tp.classes[int(n)] for n in np.unique(np.asarray(train[DEVICE].values))]
        if len(present) > 1:
            raise InputError(f"holds {len(present)} cameras mixed: {', '.join(present)}", where=where, remedy=remedy)
    if "focal_length" in train and "focal_length" not in targets:
        lengths = np.unique(np.asarray(train["focal_length"].values))
        if len(lengths) > 1:
            said = ", ".join(f"{1e3 * one:g} mm" for one in lengths[:3])
            raise InputError(f"holds lenses of several focal lengths mixed: {said}", where=where, remedy=remedy)
    told = train.tp.recordings
    numbers = [int(n) for n in np.unique(np.asarray(train["recording"].values)) if 0 <= n < len(told)]
    seen = {_camera_of(told[n]): told[n].get("name", str(n)) for n in numbers}
    seen.pop("", None)
    if len(seen) > 1:
        names = " and ".join(list(seen.values())[:2])
        raise InputError(f"holds two cameras mixed: {names} are of different ones", where=where, remedy=remedy)


def _camera_of(told: dict[str, Any]) -> str:
    """What a recording says of the camera that it films: of the bench its lens and sensor, else its hardware."""
    scene = (told.get("parameters") or {}).get("scene") or {}
    target = scene.get("target") if isinstance(scene, dict) else None
    if isinstance(target, dict):
        # Where it is turned and focused may change from one recording to the next.
        own = {name: target[name] for name in ("kind", "name", "lens", "sensor") if name in target}
        return json.dumps(own, sort_keys=True)
    hardware = told.get("hardware")
    camera = hardware.get("target") if isinstance(hardware, dict) else None
    return json.dumps(camera, sort_keys=True) if camera else ""


def _interval(dataset: xr.Dataset) -> float:
    """Return the seconds from frame to frame."""
    if "time" not in dataset:
        remedy = "leave --seconds out, or build the set from recordings"
        raise InputError("does not know when its frames were taken", where=dataset.tp.source, remedy=remedy)
    time, recording = np.asarray(dataset["time"].values, float), np.asarray(dataset["recording"].values)
    steps = np.diff(time)[np.diff(recording) == 0]
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not len(steps):
        remedy = "leave --seconds out"
        raise InputError("has no two frames in a row", where=dataset.tp.source, remedy=remedy)
    return float(np.median(steps))


def film_seconds(dataset: xr.Dataset) -> float:
    """Return how many seconds of film its frames are: their number times the time from frame to frame."""
    return dataset.sizes["frame"] * _interval(dataset)


def first_seconds(dataset: xr.Dataset, seconds: float) -> int:
    """Return the number of frames of so many seconds of film; refuse more than the set's training frames have."""
    if not (np.isfinite(seconds) and seconds > 0):
        raise InputError(f"must be positive, is {seconds}", where="--seconds", remedy="give 10 for example")
    every = _interval(dataset)
    count, have = max(1, round(seconds / every)), dataset.sizes["frame"]
    if count > have:
        what = f"asks for {seconds:g} s of film, the training frames are {have * every:.3g} s"
        raise InputError(what, where="--seconds", remedy="film more, or ask for less")
    return count


def spread_over(values: NDArray[np.float64], count: int, seed: int) -> NDArray[np.intp]:
    """Return `count` ascending places of `values` [N, K] that are spread over their range.

    The range of the first two columns is divided into cells, about one for every two frames wanted. One frame of every
    cell that has any is taken at random, then another, until there are enough.
    """
    rng = np.random.default_rng([seed, 11])
    order = np.asarray(rng.permutation(len(values)))
    if count >= len(values):
        return np.arange(len(values))
    axes = values[:, :_AXES]
    side = max(2, round((count / _A_CELL) ** (1 / axes.shape[1])))
    low, high = axes.min(axis=0), axes.max(axis=0)
    cell = np.minimum((side * (axes - low) / np.maximum(high - low, 1e-300)).astype(int), side - 1)
    number = np.asarray(np.ravel_multi_index(tuple(cell.T), (side,) * axes.shape[1]))
    # The turn in which a frame would be taken: how many frames of its cell come before it in the random order.
    turn = np.empty(len(values))
    for one in np.unique(number):
        own = order[number[order] == one]
        turn[own] = np.arange(len(own)) + rng.uniform(0, 0.5, len(own))
    return np.sort(np.argsort(turn, kind="stable")[:count])
