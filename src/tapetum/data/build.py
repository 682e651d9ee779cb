"""From labelled recordings to a dataset: the retro-reflection is cut out of every labelled probe frame."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from tapetum.data.crop import SIGMA
from tapetum.data.dataset import DEVICE, QUANTITIES, STD
from tapetum.data.write import CHUNK, LARGEST_SIDE, Rules, dataset_writer
from tapetum.errors import InputError, number, of_type
from tapetum.progress import Progress, quiet
from tapetum.record.clocks import join
from tapetum.record.recording import Recording, as_recording

__all__ = ["build_dataset"]

Given: TypeAlias = str | os.PathLike[str] | Recording


@dataclass(frozen=True)
class FrameLabels:
    """The labels of one recording by probe frame."""

    names: tuple[str, ...]
    # Values in the order of names, quality, and how far the label reaches back and ahead of the frame (s).
    by_frame: dict[int, tuple[NDArray[np.float32], float, NDArray[np.float64]]]
    # Names of the labels with a known standard deviation, and those deviations by frame.
    deviating: tuple[str, ...] = ()
    deviations: dict[int, NDArray[np.float32]] = field(default_factory=dict)


def _classes(recordings: Sequence[Recording]) -> list[str]:
    """Return the sorted names of all devices among the labels; their places are their numbers."""
    tables = (recording.labels() for recording in recordings)
    columns = (table.column(DEVICE).to_pylist() for table in tables if table and DEVICE in table.column_names)
    return sorted({str(name) for column in columns for name in column if name is not None})


def _column(table: pa.Table, name: str, classes: Sequence[str] = ()) -> NDArray[np.float64]:
    """Return a column as numbers; a null is NaN."""
    if name != DEVICE:
        return table.column(name).to_numpy(zero_copy_only=False).astype(np.float64)
    number = {one: n for n, one in enumerate(classes)}
    return np.array([np.nan if one is None else number[str(one)] for one in table.column(name).to_pylist()])


def labels_of(recording: Recording, classes: list[str]) -> FrameLabels:
    """Return the labels of a recording's frames; a device as its number among the classes."""
    where = recording.path / "labels.parquet"
    table: pa.Table | None = recording.labels()
    if table is None:
        remedy = "label it first: tapetum.record.label_recording"
        raise InputError("the recording has no labels", where=where, remedy=remedy)
    names = tuple(name for name in (*QUANTITIES, DEVICE) if name in table.column_names)
    if "frame" not in table.column_names or not names:
        what = f"expected columns frame and one of {', '.join((*QUANTITIES, DEVICE))}"
        raise InputError(what, where=where, remedy="label it again")
    frames = table.column("frame").to_numpy()
    values = np.stack([_column(table, name, classes).astype(np.float32) for name in names], axis=1)
    quality = _column(table, "quality") if "quality" in table.column_names else np.ones(len(frames))
    deviating = tuple(name for name in names if f"{name}{STD}" in table.column_names)
    wide = np.array([_column(table, f"{name}{STD}") for name in deviating], np.float32).reshape(-1, len(frames)).T
    good = np.isfinite(values).all(axis=1) & np.isfinite(quality) & np.isfinite(wide).all(axis=1)
    rows = zip(frames[good], values[good], quality[good], _reach(recording, table)[good], strict=True)
    deviations = {int(f): one for f, one in zip(frames[good], wide[good], strict=True)}
    return FrameLabels(names, {int(f): (v, float(q), r) for f, v, q, r in rows}, deviating, deviations)


def _reach(recording: Recording, table: pa.Table) -> NDArray[np.float64]:
    """Return how far each label reaches back and ahead of its frame, [N, 2] in seconds; 0 where unknown."""
    frames = table.column("frame").to_numpy()
    reach = np.zeros((len(frames), 2))
    if {"reach_back", "reach_ahead"} <= set(table.column_names):
        reach = np.stack([_column(table, name) for name in ("reach_back", "reach_ahead")], axis=1)
    elif "how" in table.column_names and "target" in recording.streams:
        # Older labels lack these columns: their reach follows from the clocks.
        spots = np.array([how == "laser-spot" for how in table.column("how").to_pylist()], bool)
        inside = spots & (frames < len(joined := join(recording)))
        reach[inside] = joined.reach()[frames[inside]]
    return np.nan_to_num(reach)


def _checked(recordings: Iterable[Given] | Given, rules: Rules) -> list[Recording]:
    remedy = "name at least one NAME.rec folder"
    of_type(recordings, (str, os.PathLike, Recording, Iterable), "recordings", remedy)
    given = [recordings] if isinstance(recordings, str | os.PathLike | Recording) else list(recordings)
    if not given:
        raise InputError("no recording given", where="recordings", remedy=remedy)
    if rules.side < 1:
        raise InputError(f"must be positive, is {rules.side}", where="side", remedy="give a number of pixels")
    if rules.side > LARGEST_SIDE:
        what = f"is larger than the {LARGEST_SIDE} pixels that a chunk of {CHUNK} crops can hold: {rules.side}"
        raise InputError(what, where="side", remedy="the paper's largest crops have 400")
    if not 0 <= rules.test_fraction <= 1:
        what = f"must lie in 0 ... 1, is {rules.test_fraction}"
        raise InputError(what, where="test_fraction", remedy="the paper's is 0.2")
    for name in ("min_quality", "min_snr"):
        number(getattr(rules, name), name, "0 keeps every frame")
    number(rules.embargo, "embargo", "give seconds", least=0)
    opened = [as_recording(one, f"recordings[{n}]") for n, one in enumerate(given)]
    paths = [one.path.resolve() for one in opened]
    twice = next((p for p in paths if paths.count(p) > 1), None)
    if twice is not None:
        raise InputError("is given twice", where=twice, remedy="name every recording once")
    return opened


def build_dataset(
    recordings: Iterable[Given] | Given,
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

    Every probe frame with a good label and a visible RR gives one crop around `tapetum.data.find_centre`. The first
    part of every video trains and the last part tests (paper, section 5). An embargo separates them: the first test
    frames whose labels share a measurement with a training frame's (`tapetum.data.embargo`) belong to neither.

    Parameters
    ----------
    recordings
        Folders NAME.rec or recordings that are open, each with labels; or a single one.
    out
        The store to write, by convention NAME.zarr.
    side
        Pixels along an edge of the crops.
    test_fraction
        Share of every video, at its end, that tests. With 0 everything trains, with 1 everything tests.
    min_quality, min_snr
        Frames with a lower label quality, or a lower SNR of the smoothed RR, are left out.
    sigma
        Standard deviation in pixels of the smoothing that finds the centre.
    embargo
        Least seconds between training and test frames, for labels smoothed further than the recording says.
    progress
        Shown over the frames of each recording.
    overwrite
        Replace an existing dataset. No other folder ever is.

    Returns
    -------
    Path
        The store. Its attribute ``recordings`` counts, for each video, the frames used and those left out, by reason.

    Raises
    ------
    InputError
        When no recording is given, one has no labels, depths or labelled quantities differ, nothing is left to train
        or to test with, or `out` may not be replaced. Nothing is written then.
    """
    rules = Rules(side, test_fraction, min_quality, min_snr, sigma, embargo=embargo)
    opened = _checked(recordings, rules)
    classes = _classes(opened)
    labels = [labels_of(recording, classes) for recording in opened]
    sources = [recording.source("probe") for recording in opened]
    if len({label.names for label in labels}) > 1:
        found = "; ".join(f"{r.path.name}: {', '.join(label.names)}" for r, label in zip(opened, labels, strict=True))
        raise InputError(f"recordings are labelled with different quantities ({found})", where="recordings")
    if len({source.full_scale for source in sources}) > 1:
        found = ", ".join(f"{r.path.name} {source.full_scale}" for r, source in zip(opened, sources, strict=True))
        remedy = "build one dataset for each depth"
        raise InputError(f"frames differ in depth (full scale: {found})", where="recordings", remedy=remedy)
    if len({label.deviating for label in labels}) > 1:
        # Old labels have no deviations; a weight for some frames only would be a guess for the others.
        labels = [replace(label, deviating=(), deviations={}) for label in labels]
    with dataset_writer(out, rules, labels[0].names, classes, sources[0].full_scale, overwrite=overwrite) as writer:
        for n, (recording, label, source) in enumerate(zip(opened, labels, sources, strict=True)):
            writer.told.append(add_frames(recording, n, label, writer.add, rules, source.count, progress))
    return Path(out)


def _deviations(labels: FrameLabels, frame: int) -> dict[str, float]:
    if not labels.deviating:
        return {}
    return {f"{name}{STD}": float(one) for name, one in zip(labels.deviating, labels.deviations[frame], strict=True)}


def add_frames(
    recording: Recording,
    number: int,
    labels: FrameLabels,
    add: Callable[..., None],
    rules: Rules,
    total: int,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Pass a recording's crops and their values by name to `add`; return the numbers of frames used and left out."""
    name = recording.path.name
    left_out = {"no label": 0, "poor label": 0, "no visible RR": 0}
    used = 0
    for frame in progress(recording.source("probe"), f"cutting out {name}", total=total):
        label = labels.by_frame.get(frame.index)
        if label is None:
            left_out["no label"] += 1
            continue
        values, quality, reach = label
        if quality < rules.min_quality:
            left_out["poor label"] += 1
            continue
        cut = rules.cut(frame.image)
        if cut is None:
            left_out["no visible RR"] += 1
            continue
        back, ahead = np.maximum(reach, rules.embargo / 2).tolist()
        add(
            cut[0],
            **dict(zip(labels.names, values.tolist(), strict=True)),
            **cut[1],
            quality=quality,
            recording=number,
            time=frame.time,
            frame_index=frame.index,
            split=int(rules.split(frame.index, total)),
            label_back=back,
            label_ahead=ahead,
            **_deviations(labels, frame.index),
        )
        used += 1
    meta = recording.meta
    return {
        "name": name,
        "uuid": str(meta.get("uuid", "")),
        "frames": total,
        "used": used,
        "left_out": left_out,
        **{name: meta[name] for name in ("hardware", "seed") if name in meta},
        **({"parameters": {"scene": meta["scene"]}} if "scene" in meta else {}),
    }
