"""Split of a dataset by units: copies of a camera that serve the test are not in the training part."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import DEVICE, EMBARGO, TEST, TRAIN, UNIT, split_variable
from tapetum.errors import InputError, one_of

__all__ = ["HELD_OUT", "SPLITS", "held_out_units", "split_by"]

SPLITS = ("time", "unit", "seen-unit")
"""`time`: the end of every video tests. `unit`: the last units of every camera test, and the others train with the
beginning of their videos. `seen-unit`: as `unit`, but the end of the videos of those that train tests."""

HELD_OUT = 0.2
"""Share of each camera's units that tests; at least one."""


def held_out_units(dataset: xr.Dataset, share: float = HELD_OUT) -> NDArray[np.int64]:
    """Return the numbers of the units that test: the last ones of each camera, at least one.

    Raises an InputError for a set without units, or with a camera of one unit alone.
    """
    where = dataset.tp.source
    if UNIT not in dataset:
        remedy = "film units with `tapetum dataset synth KIND --units N`, or leave --split out"
        raise InputError("does not distinguish copies of its camera", where=where, remedy=remedy)
    unit = np.asarray(dataset[UNIT].values)
    camera = np.asarray(dataset[DEVICE].values) if DEVICE in dataset else np.zeros(len(unit), np.int64)
    found = []
    for one in np.unique(camera):
        own = np.unique(unit[camera == one])
        if len(own) < 2:
            name = f" of {dataset.tp.classes[int(one)]}" if DEVICE in dataset else ""
            what = f"has {len(own)} unit{name}, and a split by units needs 2 of every camera"
            raise InputError(what, where=where, remedy="film more units, or leave --split out")
        found.append(own[len(own) - max(1, round(share * len(own))) :])
    return np.concatenate(found).astype(np.int64)


def split_by(dataset: xr.Dataset, how: str, share: float = HELD_OUT) -> xr.Dataset:
    """Return the dataset with the split that `how`, one of `SPLITS`, asks for; "time" is its own.

    Whatever tests by `unit` is neither train nor test by `seen-unit`, and the other way round; both have the same
    training frames.
    """
    one_of(how, SPLITS, "--split")
    if how == "time":
        return dataset
    other = np.isin(np.asarray(dataset[UNIT].values) if UNIT in dataset else [], held_out_units(dataset, share))
    split = np.asarray(dataset["split"].values)
    tests = other if how == "unit" else ~other & (split == TEST)
    trains = ~other & (split == TRAIN)
    new = np.where(tests, TEST, np.where(trains, TRAIN, EMBARGO)).astype(np.int8)
    changed = dataset.assign(split=split_variable(new))
    changed.encoding.update(dataset.encoding)
    return changed
