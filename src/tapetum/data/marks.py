"""Marks of the films that a dataset's frames are from, by which a model recognises the camera it was trained on."""

from __future__ import annotations

import numpy as np
import xarray as xr

from tapetum.record.marks import recording_marks

__all__ = ["marks_of"]


def marks_of(dataset: xr.Dataset) -> list[frozenset[str]]:
    """Return the marks (`tapetum.record.marks`) of every recording with frames in a dataset; empty where unknown."""
    told = dataset.tp.recordings
    numbers = np.unique(np.asarray(dataset["recording"].values))
    return [recording_marks(told[n]) if 0 <= n < len(told) else frozenset() for n in map(int, numbers)]
