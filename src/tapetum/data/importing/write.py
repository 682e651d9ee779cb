"""From images with labels to a dataset: ordered, split, centred and cut like those of recordings."""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.data.dataset import DEVICE, QUANTITIES, TEST, TRAIN
from tapetum.data.importing.columns import Reader, held_out, label_values, numbers, seconds, texts
from tapetum.data.importing.mapping import ImportMapping, Stack
from tapetum.data.importing.pictures import Pictures, open_pictures
from tapetum.data.write import AS_IMPORTED, DatasetWriter, Rules, dataset_writer
from tapetum.errors import InputError
from tapetum.progress import Progress

__all__ = ["check_size", "write_stacks"]


@dataclass(frozen=True)
class _Part:
    """One stack without its images; arrays [N] are in the order in which the images are stored."""

    pictures: Pictures
    order: NDArray[np.int64]  # numbers of the images
    recording: NDArray[np.int64]  # number of the video
    place: NDArray[np.int64]  # in the video
    time: NDArray[np.float64]  # seconds from the video's beginning
    split: NDArray[np.int8]
    names: list[str]  # of the videos
    values: dict[str, NDArray[Any]]  # labels; of a device the names
    good: NDArray[np.bool_]  # whether an image has all its labels


def _grouped(stack: Stack, reader: Reader, count: int) -> tuple[NDArray[np.int64], list[str]]:
    """Return the number of every image's video, and the videos' names in order of appearance."""
    place = Path(str(stack.images.folder or stack.images.file))
    name = stack.name or (place.name if stack.images.folder else place.stem)
    if stack.recording is None:
        return np.zeros(count, np.int64), [name]
    words = texts(reader.values(stack.recording, count, stack.images.file))
    names = list(dict.fromkeys(words))
    return np.array([names.index(word) for word in words]), [f"{name} {one}" for one in names]


def _read(stack: Stack, mapping: ImportMapping, reader: Reader, pictures: Pictures) -> _Part:
    count, file, where = pictures.count, stack.images.file, pictures.where
    values = label_values(stack.labels, reader, count, file)
    good = np.ones(count, bool)
    for name, one in values.items():
        known = one != "" if name == DEVICE else np.isfinite(one)
        if mapping.missing == "refuse" and not known.all():
            lost = np.flatnonzero(~known)
            what = f"{name} is missing or not finite for {len(lost)} of {count} pictures, first for {lost[0]}"
            raise InputError(what, where=where, remedy="mend the labels, or set 'missing: drop'")
        good &= known
    recording, names = _grouped(stack, reader, count)
    time, key = None, np.arange(count)
    if stack.time is not None:
        key = time = seconds(reader.values(stack.time, count, file), stack.time, f"{where}: time")
    if stack.order is not None:
        key = numbers(reader.values(stack.order, count, file), f"{where}: order")
        if not np.isfinite(key).all():
            raise InputError("order holds values that are not finite", where=where, remedy="mend them")
    order = np.lexsort((key, recording))
    recording = recording[order]
    begin = np.searchsorted(recording, recording)
    place = np.arange(count) - begin
    if stack.split is None:
        split = _rules(mapping).split(place, np.bincount(recording)[recording])
    else:
        tests = held_out(reader.values(stack.split, count, file), f"{where}: split")
        split = np.where(tests, TEST, TRAIN)[order].astype(np.int8)
    time = place / stack.rate if time is None else time[order] - time[order][begin]
    values = {name: one[order] for name, one in values.items()}
    return _Part(pictures, order, recording, place, time, split, names, values, good[order])


def _checked(parts: list[_Part], mapping: ImportMapping) -> tuple[str, ...]:
    """Return the label names, after a check that all parts have the same labels, type and depth."""
    first, names = parts[0].pictures, parts[0].values
    for part in parts:
        pictures = part.pictures
        if set(part.values) != set(names):
            what = f"is labelled with {', '.join(part.values)}, {first.where} with {', '.join(names)}"
            raise InputError(what, where=pictures.where, remedy="import them into two datasets")
        if (pictures.dtype, pictures.full_scale) != (first.dtype, first.full_scale):
            what = f"differs in depth from {first.where}: {pictures.full_scale}, {first.full_scale}"
            raise InputError(what, where=pictures.where, remedy="import them into two datasets")
        check_size(pictures.size, mapping, pictures.where)
    return tuple(name for name in (*QUANTITIES, DEVICE) if name in names)


def check_size(size: tuple[int, ...], mapping: ImportMapping, where: str, what: str = "pictures") -> None:
    """Refuse images [height, width] that are smaller than the crops, unless they may be padded."""
    if min(size) < mapping.side and not mapping.pad:
        what = f"{what} of {size[1]} x {size[0]} px are smaller than the crops of {mapping.side} px"
        raise InputError(what, where=where, remedy=f"set 'side: {min(size)}' (--side), or 'pad: true'")


def _keep(
    part: _Part, mapping: ImportMapping, rules: Rules, classes: list[str], writer: DatasetWriter, progress: Progress
) -> None:
    """Add the images of one part, and the counts of each of its videos."""
    first, where = len(writer.told), part.pictures.where
    told = [
        {"name": name, "uuid": "", "frames": 0, "used": 0, "left_out": {"no label": 0, "no visible RR": 0}}
        for name in part.names
    ]
    labels = part.values
    if DEVICE in labels:
        labels = labels | {DEVICE: np.searchsorted(np.array(classes, str), labels[DEVICE])}
    shown = progress(part.pictures.read(part.order.tolist()), f"importing {Path(where).name}", total=len(part.order))
    for n, picture in enumerate(shown):
        line = told[part.recording[n]]
        line["frames"] += 1
        if not part.good[n]:
            line["left_out"]["no label"] += 1
            continue
        if picture.dtype != part.pictures.dtype:
            raise InputError(f"picture {n} holds {picture.dtype}, the first {part.pictures.dtype}", where=where)
        check_size(picture.shape, mapping, f"{where} picture {n}")
        cut = rules.cut(picture)
        if cut is None:
            line["left_out"]["no visible RR"] += 1
            continue
        writer.add(
            cut[0],
            **{name: float(values[n]) for name, values in labels.items()},
            **cut[1],
            quality=1.0,
            recording=first + int(part.recording[n]),
            time=float(part.time[n]),
            frame_index=int(part.place[n]),
            split=int(part.split[n]),
            label_back=rules.embargo / 2,
            label_ahead=rules.embargo / 2,
        )
        line["used"] += 1
    writer.told += told


def _rules(mapping: ImportMapping, share: float | None = None) -> Rules:
    share = mapping.test_fraction if share is None else share
    if mapping.centred:
        return Rules(mapping.side, share, 0.0, 0.0, centring=AS_IMPORTED, embargo=mapping.embargo)
    return Rules(mapping.side, share, 0.0, embargo=mapping.embargo)


def write_stacks(
    mapping: ImportMapping, root: Path, out: str | os.PathLike[str], progress: Progress, overwrite: bool
) -> None:
    """Write a dataset from the stacks of a mapping; see `import_dataset`."""
    reader, parts = Reader(root), []
    with contextlib.ExitStack() as stack:
        for one in mapping.stacks:
            pictures = stack.enter_context(open_pictures(one.images, reader, mapping.full_scale))
            parts.append(_read(one, mapping, reader, pictures))
        names, first = _checked(parts, mapping), parts[0].pictures
        classes = sorted({str(name) for part in parts for name in part.values.get(DEVICE, ()) if name})
        given = any(one.split is not None for one in mapping.stacks)
        share = float(np.mean(np.concatenate([part.split for part in parts]) == TEST)) if given else None
        rules, dtype = _rules(mapping, share), first.dtype
        opened = dataset_writer(out, rules, names, classes, first.full_scale, dtype=dtype, overwrite=overwrite)
        writer = stack.enter_context(opened)
        for part in parts:
            _keep(part, mapping, rules, classes, writer, progress)
        if writer.empty:
            remedy = "set 'centred: true' if they are crops around the RR already, or check what they show"
            left = "; ".join(f"{line['name']}: {line['left_out']}" for line in writer.told)
            raise InputError(f"no picture has its labels and a visible RR ({left})", where=out, remedy=remedy)
        writer.attributes["imported"] = json.dumps(mapping.as_dict())
