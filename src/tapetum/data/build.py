"""From recordings to a dataset: find the retro-reflection in every labelled probe frame and cut it out."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import zarr
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BloscShuffle, Crc32cCodec

from tapetum.data.content import DIGEST, hash_of, image_digests
from tapetum.data.crop import CENTRING, SIGMA, crop, find_centre, find_peak
from tapetum.data.dataset import (
    DEVICE,
    EMBARGO,
    FORMAT,
    QUANTITIES,
    TEST,
    TRAIN,
    TRUE_GAZE,
    VERSION,
    class_variable,
    split_variable,
)
from tapetum.data.embargo import embargoed
from tapetum.errors import InputError
from tapetum.files import atomic_folder
from tapetum.progress import Progress, quiet
from tapetum.record.clocks import join
from tapetum.record.recording import Recording, open_recording

__all__ = ["CHUNK", "build_dataset"]

CHUNK = 64
LARGEST_SIDE = 4000
"""Largest side of a crop: a chunk of 16 bit crops then fills the 2 GB that its compression can take."""
"""Frames a chunk of the store: 10 MB of 400 x 400 pixels before compression."""


# Standard deviation in pixels of the smoothing that shows a faint RR best.
_RING_SIGMA = 4.0


@dataclass(frozen=True)
class Labels:
    """The labels of one recording by probe frame."""

    names: tuple[str, ...]
    # Values in the order of names, quality, and how far the label reaches back and ahead of the frame, in seconds.
    by_frame: dict[int, tuple[NDArray[np.float32], float, NDArray[np.float64]]]


@dataclass(frozen=True)
class Rules:
    """Which frames are kept, how they are cut and where they go: the arguments of `build_dataset`."""

    side: int = 400
    test_fraction: float = 0.2
    min_quality: float = 0.5
    min_snr: float = 6.0
    sigma: float = SIGMA
    centring: str = CENTRING
    embargo: float = 0.0


@dataclass
class Kept:
    """What grows while frames are kept; the images go to the store at once."""

    columns: dict[str, list[float]] = field(default_factory=dict)

    def add(self, **values: float) -> None:
        for name, value in values.items():
            self.columns.setdefault(name, []).append(value)


class Sink(Protocol):
    """Where crops go, one after the other."""

    def add(self, image: NDArray[np.generic], /) -> None: ...


class Images:
    """Appends crops to an array of the store, whole chunks at a time, and keeps a digest of each."""

    def __init__(self, group: zarr.Group, side: int, dtype: np.dtype[Any]) -> None:
        self.digests: list[NDArray[np.uint8]] = []
        self._buffer: list[NDArray[np.generic]] = []
        self._array = make_array(group, "image", (0, side, side), (CHUNK, side, side), dtype, ("frame", "y", "x"))
        self._array.attrs["units"] = "count"
        self._array.attrs["long_name"] = "crop around the retro-reflection"

    def add(self, image: NDArray[np.generic]) -> None:
        self.digests.append(image_digests([image]))
        self._buffer.append(image)
        if len(self._buffer) == CHUNK:
            self.flush()

    def flush(self) -> None:
        if self._buffer:
            self._array.append(np.stack(self._buffer))
            self._buffer.clear()


def make_array(
    group: zarr.Group,
    name: str,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    dtype: np.dtype[Any],
    dimensions: tuple[str, ...],
) -> zarr.Array[Any]:
    shuffle = BloscShuffle.bitshuffle if dtype.itemsize == 1 else BloscShuffle.shuffle
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        dimension_names=dimensions,
        # Blosc alone does not notice a flipped bit; the checksum does.
        compressors=[BloscCodec(cname="zstd", clevel=3, shuffle=shuffle), Crc32cCodec()],
        # A chunk of zeros is written too, so that a missing one can be distinguished from it.
        config={"write_empty_chunks": True},
    )


def _classes(recordings: Sequence[Recording]) -> list[str]:
    """Names of all devices that the recordings are labelled with, sorted: their numbers are their places."""
    tables = (recording.labels() for recording in recordings)
    columns = (table.column(DEVICE).to_pylist() for table in tables if table and DEVICE in table.column_names)
    return sorted({str(name) for column in columns for name in column if name is not None})


def _values(table: pa.Table, name: str, classes: list[str]) -> NDArray[np.float32]:
    """Return a label's column; a null is NaN."""
    if name != DEVICE:
        return table.column(name).to_numpy(zero_copy_only=False).astype(np.float32)
    number = {one: n for n, one in enumerate(classes)}
    return np.array([np.nan if one is None else number[str(one)] for one in table.column(name).to_pylist()], np.float32)


def labels_of(recording: Recording, classes: list[str]) -> Labels:
    where = Path(recording.path) / "labels.parquet"
    table: pa.Table | None = recording.labels()
    if table is None:
        raise InputError(
            "the recording has no labels",
            where=where,
            remedy="label it first: tapetum.record.label_recording",
        )
    names = tuple(name for name in (*QUANTITIES, DEVICE) if name in table.column_names)
    if "frame" not in table.column_names or not names:
        raise InputError(
            f"expected columns frame and one of {', '.join((*QUANTITIES, DEVICE))}",
            where=where,
            remedy="label it again",
        )
    frames = table.column("frame").to_numpy()
    values = np.stack([_values(table, name, classes) for name in names], axis=1)
    quality = np.ones(len(frames))
    if "quality" in table.column_names:
        quality = table.column("quality").to_numpy(zero_copy_only=False).astype(np.float64)
    # A null is a NaN here: no label.
    good = np.isfinite(values).all(axis=1) & np.isfinite(quality)
    rows = zip(frames[good], values[good], quality[good], _reach(recording, table)[good], strict=True)
    return Labels(names, {int(f): (v, float(q), r) for f, v, q, r in rows})


def _reach(recording: Recording, table: pa.Table) -> NDArray[np.float64]:
    """How far each label reaches back and ahead of its frame, [N, 2] in seconds; 0 where nothing says so."""
    frames = table.column("frame").to_numpy()
    reach = np.zeros((len(frames), 2))
    if {"reach_back", "reach_ahead"} <= set(table.column_names):
        ends = (table.column(name).to_numpy(zero_copy_only=False) for name in ("reach_back", "reach_ahead"))
        reach = np.stack(list(ends), axis=1).astype(np.float64)
    elif "how" in table.column_names and "target" in recording.streams:
        # Labels older than these columns: the same join says it again.
        spots = np.array([how == "laser-spot" for how in table.column("how").to_pylist()], bool)
        inside = spots & (frames < len(joined := join(recording)))
        reach[inside] = joined.reach()[frames[inside]]
    return np.nan_to_num(reach)


def _checked(recordings: Sequence[str | os.PathLike[str]], rules: Rules) -> list[Recording]:
    if isinstance(recordings, str | os.PathLike):
        recordings = [recordings]
    if not recordings:
        raise InputError("no recording given", where="recordings", remedy="name at least one NAME.rec folder")
    if rules.side < 1:
        raise InputError(f"must be positive, is {rules.side}", where="side", remedy="give a number of pixels")
    if rules.side > LARGEST_SIDE:
        what = f"is larger than the {LARGEST_SIDE} pixels that a chunk of {CHUNK} crops can hold: {rules.side}"
        raise InputError(what, where="side", remedy="the paper's largest crops have 400")
    if not 0 <= rules.test_fraction <= 1:
        raise InputError(
            f"must lie in 0 ... 1, is {rules.test_fraction}",
            where="test_fraction",
            remedy="the paper's is 0.2",
        )
    paths = [Path(r).resolve() for r in recordings]
    twice = next((p for p in paths if paths.count(p) > 1), None)
    if twice is not None:
        raise InputError("is given twice", where=twice, remedy="name every recording once")
    return [open_recording(path) for path in recordings]


def _count(recording: Recording) -> int:
    count = recording.source("probe").count
    return int(recording.frames("probe").num_rows) if count is None else int(count)


def build_dataset(
    recordings: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    side: int = 400,
    test_fraction: float = 0.2,
    min_quality: float = 0.5,
    min_snr: float = 6.0,
    sigma: float = SIGMA,
    embargo: float = 0.0,
    progress: Progress = quiet,
    overwrite: bool = False,
) -> Path:
    """Build a dataset from labelled recordings.

    Every probe frame with a good label and a visible RR gives one crop, centred by our reading of the paper: on the
    brightest point of the smoothed frame, or of what has fine structure where a lit room is brighter (`find_centre`).
    The first part of every video trains and the last part tests (paper, section 5), by place in the video. Between them
    lies an embargo: the first frames of the last part whose labels share a measurement with a training frame's
    (`tapetum.data.embargo`) belong to neither.

    Parameters
    ----------
    recordings
        Folders NAME.rec, each with labels.
    out
        The store to write, by convention NAME.zarr.
    side
        Pixels along an edge of the crops.
    test_fraction
        Share of every video, at its end, that tests. With 0 everything trains, with 1 everything tests.
    min_quality
        Labels of a lower quality are left out.
    min_snr
        Frames whose brightest point stands less than this over the noise of the smoothed frame are left out.
    sigma
        Standard deviation in pixels of the smoothing that finds the centre.
    embargo
        Least seconds between training and test frames, for labels that were smoothed further than the recording says.
    progress
        Shown over the frames of each recording.
    overwrite
        Replace a store that is there already.

    Returns
    -------
    Path
        The store. Its attribute ``recordings`` counts, for each video, the frames used and those left out, by
        reason.

    Raises
    ------
    InputError
        When no recording is given, one has no labels, depths or labelled quantities differ, or nothing (or
        nothing for one of the two parts) is left. Nothing is written then.
    """
    rules = Rules(side, test_fraction, min_quality, min_snr, sigma, embargo=embargo)
    opened = _checked(recordings, rules)
    classes = _classes(opened)
    labels = [labels_of(recording, classes) for recording in opened]
    if len({label.names for label in labels}) > 1:
        found = "; ".join(f"{Path(r.path).name}: {', '.join(b.names)}" for r, b in zip(opened, labels, strict=True))
        raise InputError(f"recordings are labelled with different quantities ({found})", where="recordings")
    depths = [r.source("probe").full_scale for r in opened]
    if len(set(depths)) > 1:
        found = ", ".join(f"{Path(r.path).name} {depth}" for r, depth in zip(opened, depths, strict=True))
        remedy = "build one dataset for each depth"
        raise InputError(f"frames differ in depth (full scale: {found})", where="recordings", remedy=remedy)
    full_scale = int(depths[0])
    dtype = np.dtype(np.uint8 if full_scale <= 255 else np.uint16)
    names = labels[0].names
    with atomic_folder(out, overwrite=overwrite) as folder:
        group = zarr.create_group(str(folder), zarr_format=3)
        images, kept = Images(group, side, dtype), Kept()
        told = [
            add_frames(recording, number, label, images, kept, rules, _count(recording), progress)
            for number, (recording, label) in enumerate(zip(opened, labels, strict=True))
        ]
        finish(group, images, kept, told, rules, names, classes, full_scale)
    return Path(out)


def finish(
    group: zarr.Group,
    images: Images,
    kept: Kept,
    told: list[dict[str, Any]],
    rules: Rules,
    names: tuple[str, ...],
    classes: list[str],
    full_scale: int,
) -> None:
    """Write what is left of the images, the variables along ``frame``, and the store's attributes.

    Raises
    ------
    InputError
        When nothing, or nothing for one of the two parts, was kept.
    """
    images.flush()
    _set_embargo(kept, told)
    _check_parts(kept, told, rules.test_fraction)
    variables = _write_columns(group, kept, names, classes)
    digests = np.concatenate(images.digests)
    array = make_array(group, DIGEST, digests.shape, digests.shape, digests.dtype, ("frame", "digest_byte"))
    array[:] = digests
    array.attrs["long_name"] = "BLAKE2b of the crop"
    known = classes if DEVICE in names else ()
    group.attrs.update(
        {
            "format": FORMAT,
            "version": VERSION,
            "targets": list(names),
            "full_scale": full_scale,
            "centre_sigma": rules.sigma,
            "centring": rules.centring,
            "min_quality": rules.min_quality,
            "min_snr": rules.min_snr,
            "test_fraction": rules.test_fraction,
            "recordings": json.dumps(told),
            "sha256": hash_of(digests, variables, full_scale=full_scale, targets=names, classes=known),
        }
    )


def add_frames(
    recording: Recording,
    number: int,
    labels: Labels,
    images: Sink,
    kept: Kept,
    rules: Rules,
    total: int,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Add the frames of one recording, of which the whole video has `total`; return what became of them."""
    name = Path(recording.path).name
    # Rounded, so that 0.8 of 10 frames is 8 whatever the last bit of 1 - 0.2 is.
    first_test = round((1 - rules.test_fraction) * total, 6)
    left_out = {"no label": 0, "poor label": 0, "no visible RR": 0}
    used = 0
    for frame in progress(recording.source("probe"), f"cutting out {name}", total=total):
        label = labels.by_frame.get(frame.index)
        if label is None:
            left_out["no label"] += 1
            continue
        values, quality, reach = label
        back, ahead = np.maximum(reach, rules.embargo / 2)
        if quality < rules.min_quality:
            left_out["poor label"] += 1
            continue
        # Whether an RR is there shows best at the width of its rings; where its middle is, at its own width.
        snr = find_peak(frame.image, _RING_SIGMA).snr
        if snr < rules.min_snr:
            left_out["no visible RR"] += 1
            continue
        centre = find_centre(frame.image, rules.sigma)
        images.add(crop(frame.image, centre, rules.side))
        kept.add(
            **dict(zip(labels.names, values.tolist(), strict=True)),
            centre_x=centre[0],
            centre_y=centre[1],
            # A noiseless float frame has no finite SNR; 1e6 stands for "no noise at all".
            snr=min(snr, 1e6),
            quality=quality,
            recording=number,
            time=frame.time,
            frame_index=frame.index,
            split=TRAIN if frame.index < first_test else TEST,
            label_back=float(back),
            label_ahead=float(ahead),
        )
        used += 1
    return {
        "name": name,
        "uuid": str(recording.meta.get("uuid", "")),
        "frames": total,
        "used": used,
        "left_out": left_out,
        **_origin(recording.meta),
    }


def _origin(meta: dict[str, Any]) -> dict[str, Any]:
    """What recording.json says of where the frames come from: cameras or the virtual bench, and its scene."""
    told = {name: meta[name] for name in ("hardware", "seed") if name in meta}
    return told | ({"parameters": {"scene": meta["scene"]}} if "scene" in meta else {})


def _set_embargo(kept: Kept, told: list[dict[str, Any]]) -> None:
    """Take out of the test part what shares measurements with the training part, and count it."""
    if not kept.columns:
        return
    time, back, ahead, recording = (
        np.asarray(kept.columns[n]) for n in ("time", "label_back", "label_ahead", "recording")
    )
    split = np.asarray(kept.columns["split"], np.int8)
    split = embargoed(split, recording, np.stack([time - back, time + ahead], axis=1))
    kept.columns["split"] = split.tolist()
    for number, line in enumerate(told):
        line["embargo"] = int(np.count_nonzero((recording == number) & (split == EMBARGO)))


def _check_parts(kept: Kept, told: list[dict[str, Any]], test_fraction: float) -> None:
    split = kept.columns.get("split", [])
    why = "; ".join(
        f"{t['name']}: {t['frames']} frames, {', '.join(f'{k} {v}' for k, v in t['left_out'].items())}" for t in told
    )
    if not split:
        remedy = "check the labels and that the probe sees the target, or lower min_snr and min_quality"
        raise InputError(f"no frame has both a good label and a visible RR ({why})", where="recordings", remedy=remedy)
    if 0 < test_fraction < 1 and not {TRAIN, TEST} <= set(split):
        part = "test" if TEST not in split else "train"
        remedy = "record longer, or set test_fraction to 0 or 1"
        if EMBARGO in split:
            why += f"; {split.count(EMBARGO)} share measurements of their labels with training frames"
        raise InputError(f"no frame is left to {part} with ({why})", where="recordings", remedy=remedy)


_COLUMNS: dict[str, tuple[type, dict[str, str]]] = {
    "centre_x": (np.float32, {"units": "px", "long_name": "centre of the crop in the probe's frame"}),
    "centre_y": (np.float32, {"units": "px", "long_name": "centre of the crop in the probe's frame"}),
    "snr": (np.float32, {"units": "1", "long_name": "height of the smoothed RR over the noise"}),
    "quality": (np.float32, {"units": "1", "long_name": "quality of the label, 0 ... 1"}),
    "recording": (np.int32, {"long_name": "number in the attribute recordings"}),
    "time": (np.float64, {"units": "s", "long_name": "time since the first frame of the recording"}),
    "frame_index": (np.int64, {"long_name": "number of the frame in the probe's video"}),
    "label_back": (np.float32, {"units": "s", "long_name": "how far the label reaches back of the frame"}),
    "label_ahead": (np.float32, {"units": "s", "long_name": "how far the label reaches ahead of the frame"}),
}
_TRUE: dict[str, tuple[type, dict[str, str]]] = {
    name: (np.float32, {"units": QUANTITIES["gaze_x"], "long_name": "where it really looked, which no label tells"})
    for name in TRUE_GAZE
}


def _write_columns(
    group: zarr.Group, kept: Kept, names: tuple[str, ...], classes: list[str]
) -> dict[str, NDArray[np.generic]]:
    """Write the variables along ``frame``; return them as they are stored."""
    kinds = {**{n: (np.float32, {"units": QUANTITIES[n]}) for n in names if n != DEVICE}, **_COLUMNS}
    kinds |= {name: kind for name, kind in _TRUE.items() if name in kept.columns}
    written: dict[str, NDArray[np.generic]] = {}
    attributes: dict[str, dict[str, Any]] = {}
    for name, (kind, attrs) in kinds.items():
        written[name], attributes[name] = np.asarray(kept.columns[name], dtype=kind), dict(attrs)
    if DEVICE in names:
        device = class_variable([classes[int(number)] for number in kept.columns[DEVICE]], classes)
        written[DEVICE], attributes[DEVICE] = device.values, dict(device.attrs)
    split = split_variable(np.asarray(kept.columns["split"], dtype=np.int8))
    written["split"], attributes["split"] = split.values, dict(split.attrs)
    for name, values in written.items():
        if values.dtype.kind == "f" and not math.isfinite(float(np.sum(values, dtype=np.float64))):
            raise InputError(
                f"{name} holds values that are not finite", where="recordings", remedy="report this as a bug"
            )
        array = make_array(group, name, values.shape, values.shape, values.dtype, ("frame",))
        array[:] = values
        array.attrs.update(attributes[name])
    return written
