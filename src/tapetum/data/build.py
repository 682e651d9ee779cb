"""From recordings to a dataset: find the retro-reflection in every labelled probe frame and cut it out."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tapetum.data.crop import SIGMA, crop, find_centre, find_peak
from tapetum.data.dataset import DEVICE, QUANTITIES, TEST, TRAIN
from tapetum.data.write import CHUNK, LARGEST_SIDE, Rules, dataset_writer
from tapetum.errors import InputError
from tapetum.progress import Progress, quiet
from tapetum.record.clocks import join
from tapetum.record.recording import Recording, open_recording

__all__ = ["RING_SIGMA", "build_dataset"]

# Standard deviation in pixels of the smoothing that shows a faint RR best.
RING_SIGMA = 4.0


@dataclass(frozen=True)
class Labels:
    """The labels of one recording by probe frame."""

    names: tuple[str, ...]
    # Values in the order of names, quality, and how far the label reaches back and ahead of the frame, in seconds.
    by_frame: dict[int, tuple[NDArray[np.float32], float, NDArray[np.float64]]]


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
    with dataset_writer(out, rules, labels[0].names, classes, int(depths[0]), overwrite=overwrite) as writer:
        for number, (recording, label) in enumerate(zip(opened, labels, strict=True)):
            writer.told.append(add_frames(recording, number, label, writer.add, rules, _count(recording), progress))
    return Path(out)


def add_frames(
    recording: Recording,
    number: int,
    labels: Labels,
    add: Callable[..., None],
    rules: Rules,
    total: int,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Add the frames of one recording, of which the whole video has `total`; return what became of them.

    `add` takes a crop and, by name, what is known of it: `DatasetWriter.add`.
    """
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
        snr = find_peak(frame.image, RING_SIGMA).snr
        if snr < rules.min_snr:
            left_out["no visible RR"] += 1
            continue
        centre = find_centre(frame.image, rules.sigma)
        add(
            crop(frame.image, centre, rules.side),
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
