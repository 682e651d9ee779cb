"""Contents and defects of a dataset: counts, labels, duplicates, overexposed and empty frames, centring."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.content import image_digests
from tapetum.data.crop import SIGMA, find_peak
from tapetum.data.dataset import DEVICE, EMBARGO, TEST, TRAIN, image_batches
from tapetum.data.doubles import CELLS, Doubles, exact_pairs, fingerprint, near_pairs, summed_up
from tapetum.data.write import RING_SIGMA
from tapetum.errors import InputError
from tapetum.progress import Progress, quiet

__all__ = [
    "EMPTY_SNR",
    "OFF_CENTRE",
    "SATURATED_SHARE",
    "DatasetQuality",
    "LabelQuality",
    "Spread",
    "class_names",
    "inspect_dataset",
]

SATURATED_SHARE = 1e-4
"""A frame is saturated when more than this share of its pixels (16 of 400 x 400) is at full scale."""

EMPTY_SNR = 6.0
"""A frame is empty when its brightest smoothed point is less than this many times the noise: noise alone gives 4."""

OFF_CENTRE = 0.05
"""A frame is off centre when its brightest smoothed point lies this fraction of the side or more from the middle."""

_BATCH, _BINS = 64, 24
# Limits of possible labels: gaze is a fraction of the field of view, lengths are positive.
_POSSIBLE = {
    "gaze_x": (-0.5, 0.5),
    "gaze_y": (-0.5, 0.5),
    "object_distance": (1e-12, np.inf),
    "focal_length": (1e-12, np.inf),
}


@dataclass(frozen=True)
class Spread:
    """Distribution of a quantity's finite values over the frames; NaN where there are none."""

    least: float
    median: float
    mean: float
    most: float
    counts: tuple[int, ...]
    edges: tuple[float, ...]


@dataclass(frozen=True)
class LabelQuality:
    """Distribution of one label, and its numbers of missing and impossible values."""

    unit: str
    spread: Spread
    not_finite: int
    out_of_range: int
    distinct: int


@dataclass(frozen=True)
class DatasetQuality:
    """Result of `inspect_dataset`; every count is a number of frames.

    Parameters
    ----------
    frames, train, test, embargo
        Counts; embargo frames neither train nor test.
    side, full_scale
        Pixels along an edge, and the camera's largest count.
    per_recording, recordings
        (train, test) of each number in ``recording``, in order, and the names.
    labels, classes
        By target; frames of each class of the label ``device``, empty without one.
    exact, near
        Identical images, and near duplicates that are not identical; see `tapetum.data.doubles`.
    saturated, saturated_share
        Frames with more pixels at full scale than `SATURATED_SHARE`; distribution of that share.
    empty, snr
        Frames of an SNR under `EMPTY_SNR`; distribution of the SNR.
    badly_centred, off_centre
        Frames off centre by `OFF_CENTRE` or more; distance of the brightest smoothed point from the middle, in pixels.
    quality
        Of the labels; None where unknown.
    not_finite
        Frames with pixels that are not finite.
    interleaved
        Test frames that lie in time between train frames of their own recording, and so resemble them.
    """

    frames: int
    train: int
    test: int
    embargo: int
    side: int
    full_scale: float
    per_recording: tuple[tuple[int, int], ...]
    recordings: tuple[str, ...]
    labels: dict[str, LabelQuality]
    classes: dict[str, int]
    exact: Doubles
    near: Doubles
    saturated: int
    saturated_share: Spread
    empty: int
    snr: Spread
    off_centre: Spread
    badly_centred: int
    quality: Spread | None
    not_finite: int
    interleaved: int


def class_names(dataset: xr.Dataset, name: str) -> list[str]:
    """Return the names of a label's classes, from its attribute ``classes``; empty for a number."""
    classes = dataset[name].attrs.get("classes", ())
    return [str(c) for c in (classes.split() if isinstance(classes, str) else classes)]


def inspect_dataset(
    dataset: xr.Dataset, *, also: Sequence[Callable[[int, NDArray[np.generic]], None]] = (), progress: Progress = quiet
) -> DatasetQuality:
    """Inspect every frame of a dataset, stored or in memory, in one pass; memory holds one batch at a time.

    Each of `also` is called with the number of the first frame and the images [n, side, side] of every batch, for other
    measures. Raises an InputError when the dataset is empty or a part cannot be read.
    """
    frames = dataset.sizes["frame"]
    if frames == 0:
        raise InputError("holds no frame", where=dataset.tp.source)
    prints = np.zeros((frames, CELLS * CELLS), dtype=bool)
    share, off, snr = (np.zeros(frames) for _ in range(3))
    finite = np.ones(frames, dtype=bool)
    top = dataset.tp.full_scale
    sigma = float(dataset.attrs.get("centre_sigma", SIGMA))
    known = np.asarray(dataset["snr"].values, dtype=float) if "snr" in dataset else None
    digests, start, total = [], 0, -(-frames // _BATCH)
    for images in progress(image_batches(dataset, _BATCH), "looking at the crops", total=total):
        for n, image in enumerate(images, start):
            finite[n] = bool(np.isfinite(image).all())
            filled = image if finite[n] else np.nan_to_num(image.astype(np.float64), posinf=0.0, neginf=0.0)
            prints[n] = fingerprint(filled)
            share[n] = np.count_nonzero(filled >= top) / filled.size
            peak = find_peak(filled, sigma)
            off[n] = np.hypot(peak.x - (filled.shape[1] - 1) / 2, peak.y - (filled.shape[0] - 1) / 2)
            # The stored SNR is that of the whole frame, better than that of the crop, which the RR may fill.
            snr[n] = find_peak(filled, RING_SIGMA).snr if known is None else known[n]
            if filled.min() == filled.max():
                snr[n] = 0.0
        digests.append(image_digests(images))
        for look in also:
            look(start, images)
        start += len(images)
    split, recording = (np.asarray(dataset[name].values) for name in ("split", "recording"))
    exact = exact_pairs(np.concatenate(digests), split)
    single = ~np.isin(np.arange(frames), [later for _, later in exact])
    near = list(near_pairs(prints, single, progress))
    numbers = np.unique(recording).tolist()
    own = [split[recording == number] for number in numbers]
    told = dict(enumerate(dataset.tp.recordings))
    return DatasetQuality(
        frames=frames,
        train=_count(split == TRAIN),
        test=_count(split == TEST),
        embargo=_count(split == EMBARGO),
        side=dataset.tp.side,
        full_scale=top,
        per_recording=tuple((_count(one == TRAIN), _count(one == TEST)) for one in own),
        recordings=tuple(str(told[n]["name"]) if n in told else f"recording {n}" for n in numbers),
        labels={name: _label(dataset, name) for name in dataset.tp.targets},
        classes=_classes(dataset),
        exact=summed_up(exact, split),
        near=summed_up(near, split),
        saturated=_count(share > SATURATED_SHARE),
        saturated_share=_spread(share),
        empty=_count(snr < EMPTY_SNR),
        snr=_spread(snr),
        off_centre=_spread(off),
        badly_centred=_count(off >= OFF_CENTRE * dataset.tp.side),
        quality=_spread(np.asarray(dataset["quality"].values)) if "quality" in dataset else None,
        not_finite=_count(~finite),
        interleaved=_interleaved(dataset, split, recording),
    )


def _spread(values: NDArray[np.generic]) -> Spread:
    numbers = np.asarray(values, dtype=np.float64)
    numbers = numbers[np.isfinite(numbers)]
    if numbers.size == 0:
        return Spread(np.nan, np.nan, np.nan, np.nan, (), ())
    counts, edges = np.histogram(numbers, bins=_BINS)
    least, median, mean, most = (float(f(numbers)) for f in (np.min, np.median, np.mean, np.max))
    return Spread(least, median, mean, most, tuple(counts.tolist()), tuple(edges.tolist()))


def _label(dataset: xr.Dataset, name: str) -> LabelQuality:
    values = np.asarray(dataset[name].values, dtype=np.float64)
    finite = values[np.isfinite(values)]
    low, high = _POSSIBLE.get(name, (-np.inf, np.inf))
    if names := class_names(dataset, name):
        low, high = 0, len(names) - 1
    return LabelQuality(
        unit=str(dataset[name].attrs.get("units", "")),
        spread=_spread(values),
        not_finite=int(values.size - finite.size),
        out_of_range=_count((finite < low) | (finite > high)),
        distinct=int(np.unique(finite).size),
    )


def _classes(dataset: xr.Dataset) -> dict[str, int]:
    if DEVICE not in dataset:
        return {}
    numbers = np.asarray(dataset[DEVICE].values).astype(int)
    names = class_names(dataset, DEVICE) or [str(n) for n in range(int(numbers.max(initial=-1)) + 1)]
    return {name: _count(numbers == n) for n, name in enumerate(names)}


def _count(which: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(which))


def _interleaved(dataset: xr.Dataset, split: NDArray[np.integer], recording: NDArray[np.integer]) -> int:
    if "time" not in dataset:
        return 0
    time, total = np.asarray(dataset["time"].values), 0
    for number in np.unique(recording):
        own = recording == number
        train, test = time[own & (split == TRAIN)], time[own & (split == TEST)]
        if train.size:
            total += _count((test >= train.min()) & (test <= train.max()))
    return total
