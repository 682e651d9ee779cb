"""Separation of the parts of a video: no label of one part may share a measurement with a label of the other.

A frame's label is interpolated between measurements around it (`tapetum.record.Joined.interpolate`). Two frames that
share one of these share its error, which a model could learn from one and reproduce for the other.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import EMBARGO, TEST, TRAIN

__all__ = ["REACH", "embargoed", "meeting", "reach_of"]

REACH = ("label_back", "label_ahead")
"""Variables of a dataset: seconds that a label reaches back and ahead of its frame."""


def reach_of(dataset: xr.Dataset) -> NDArray[np.float64] | None:
    """Return the time span [N, 2] of the measurements behind each label, in seconds; None where it is unknown."""
    if not all(name in dataset for name in ("time", *REACH)):
        return None
    time, back, ahead = (np.asarray(dataset[name].values, np.float64) for name in ("time", *REACH))
    return np.stack([time - back, time + ahead], axis=1)


def meeting(
    span: NDArray[np.float64], recording: NDArray[np.integer], one: NDArray[np.bool_], other: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return [N] which frames of part `one` [N] have a label that overlaps with one of part `other` [N] in the same
    recording.

    `span` [N, 2] is the time span of the measurements behind each label, in seconds; `recording` [N] numbers the
    recordings.
    """
    found = np.zeros(len(span), dtype=bool)
    for number in np.unique(recording[one]):
        here, there = np.flatnonzero(one & (recording == number)), other & (recording == number)
        if not there.any():
            continue
        kept = span[there][np.argsort(span[there, 0], kind="stable")]
        # A span overlaps if any span that begins before its end ends after its beginning.
        ends = np.r_[-np.inf, np.maximum.accumulate(kept[:, 1])]
        found[here] = ends[np.searchsorted(kept[:, 0], span[here, 1], side="left")] > span[here, 0]
    return found


def embargoed(split: NDArray[np.int8], recording: NDArray[np.integer], span: NDArray[np.float64]) -> NDArray[np.int8]:
    """Return the split [N] with the embargo set on test frames whose label overlaps with a training frame's."""
    return np.where(meeting(span, recording, split == TEST, split == TRAIN), EMBARGO, split).astype(np.int8)
