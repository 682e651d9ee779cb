"""Keeping parts of a video apart: no label of one part may share a measurement with a label of the other.

The label of a frame is a smooth path through measurements around it (`tapetum.record.Joined.interpolate`). Where two
frames share one of these, its error is in both labels, and a model that learned the one knows something of the other.
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
    """Return the span of time [N, 2] that each label of a dataset rests on, in seconds; None where it is not told."""
    if not all(name in dataset for name in ("time", *REACH)):
        return None
    time, back, ahead = (np.asarray(dataset[name].values, np.float64) for name in ("time", *REACH))
    return np.stack([time - back, time + ahead], axis=1)


def meeting(
    span: NDArray[np.float64], recording: NDArray[np.integer], one: NDArray[np.bool_], other: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return which frames of one part [N] have a label that overlaps with one of the other part in the same recording.

    `span` [N, 2] is the first and last moment that each label rests on, in seconds, `recording` [N] the number of each
    frame's recording; `one` and `other` [N] say which frames belong to each part. The result is false outside `one`.
    """
    found = np.zeros(len(span), dtype=bool)
    for number in np.unique(recording[one]):
        here, there = np.flatnonzero(one & (recording == number)), other & (recording == number)
        if not there.any():
            continue
        kept = span[there][np.argsort(span[there, 0], kind="stable")]
        # Of all spans that begin before this one ends, does the last to end do so after this one's beginning?
        ends = np.r_[-np.inf, np.maximum.accumulate(kept[:, 1])]
        found[here] = ends[np.searchsorted(kept[:, 0], span[here, 1], side="left")] > span[here, 0]
    return found


def embargoed(split: NDArray[np.int8], recording: NDArray[np.integer], span: NDArray[np.float64]) -> NDArray[np.int8]:
    """Return the split [N] with those test frames taken out whose label overlaps with a training frame's."""
    return np.where(meeting(span, recording, split == TEST, split == TRAIN), EMBARGO, split).astype(np.int8)
