"""Pictures with labels become a dataset: ordered, split, centred and cut like those of recordings."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.data.build import RING_SIGMA
from tapetum.data.crop import crop, find_centre, find_peak
from tapetum.data.dataset import DEVICE, QUANTITIES, TEST, TRAIN
from tapetum.data.importing.columns import Reader, held_out, label_values, numbers, seconds, texts
from tapetum.data.importing.mapping import ImportMapping, Stack
from tapetum.data.importing.pictures import Pictures, open_pictures
from tapetum.data.write import DatasetWriter, Rules, dataset_writer
from tapetum.errors import InputError
from tapetum.progress import Progress

__all__ = ["write_stacks"]


@dataclass(frozen=True)
class _Part:
    """One stack, read but for its pictures.

    Attributes
    ----------
    order
        Numbers of the pictures in the order in which they are kept, [N].
    recording, place, time, split
        Of every picture in that order: number of the video, place in it, seconds from its beginning, and part.
    names
        Of the videos.
    values, classes
        Labels in that order, and the names of a device's numbers.
    """

    pictures: Pictures
    order: NDArray[np.int64]
    recording: NDArray[np.int64]
    place: NDArray[np.int64]
    time: NDArray[np.float64]
    split: NDArray[np.int8]
    names: list[str]
    values: dict[str, NDArray[np.float64]]
    classes: list[str]

    @property
    def good(self) -> NDArray[np.bool_]:
        """Which pictures have all their labels."""
        return np.all([np.isfinite(values) for values in self.values.values()], axis=0)


def _default_name(stack: Stack) -> str:
    place = Path(str(stack.images.folder or stack.images.file))
    return stack.name or (place.name if stack.images.folder else place.stem)


def _grouped(stack: Stack, reader: Reader, count: int) -> tuple[NDArray[np.int64], list[str]]:
    """Number of the video of every picture, and the videos' names in the order in which they first come."""
    if stack.recording is None:
        return np.zeros(count, np.int64), [_default_name(stack)]
    words = texts(reader.values(stack.recording, count, stack.images.file))
    names = list(dict.fromkeys(words))
    number = {name: n for n, name in enumerate(names)}
    return np.array([number[word] for word in words]), [f"{_default_name(stack)} {name}" for name in names]


def _read(stack: Stack, mapping: ImportMapping, reader: Reader, pictures: Pictures) -> _Part:
    count, file = pictures.count, stack.images.file
    values, classes = label_values(stack.labels, reader, count, file)
    for name, one in values.items():
        if mapping.missing == "refuse" and not np.isfinite(one).all():
            lost = np.flatnonzero(~np.isfinite(one))
            what = f"{name} is missing or not finite for {len(lost)} of {count} pictures, first for {lost[0]}"
            raise InputError(what, where=pictures.where, remedy="mend the labels, or set 'missing: drop'")
    recording, names = _grouped(stack, reader, count)
    time = key = None
    if stack.time is not None:
        key = time = seconds(reader.values(stack.time, count, file), stack.time, f"{pictures.where}: time")
    if stack.order is not None:
        key = numbers(reader.values(stack.order, count, file), f"{pictures.where}: order")
        if not np.isfinite(key).all():
            raise InputError("order holds values that are not finite", where=pictures.where, remedy="mend them")
    order = np.lexsort((np.arange(count) if key is None else key, recording))
    recording = recording[order]
    begin = np.searchsorted(recording, recording)
    place, total = np.arange(count) - begin, np.bincount(recording)[recording]
    time = place / stack.rate if time is None else time[order] - time[order][begin]
    if stack.split is None:
        # Rounded, so that 0.8 of 10 pictures is 8 whatever the last bit of 1 - 0.2 is.
        split = np.where(place < np.round((1 - mapping.test_fraction) * total, 6), TRAIN, TEST)
    else:
        column = reader.values(stack.split, count, file)
        split = np.where(held_out(column, f"{pictures.where}: split"), TEST, TRAIN)[order]
    ordered = {name: one[order] for name, one in values.items()}
    return _Part(pictures, order, recording, place, time, split.astype(np.int8), names, ordered, classes)


def _checked(parts: list[_Part], mapping: ImportMapping) -> tuple[tuple[str, ...], np.dtype[Any], int]:
    """Labels, type and depth that all parts have in common."""
    names = tuple(name for name in (*QUANTITIES, DEVICE) if name in parts[0].values)
    first = parts[0].pictures
    for part in parts:
        pictures = part.pictures
        if set(part.values) != set(names):
            what = f"is labelled with {', '.join(part.values)}, {first.where} with {', '.join(names)}"
            raise InputError(what, where=pictures.where, remedy="import them into two datasets")
        if (pictures.dtype, pictures.full_scale) != (first.dtype, first.full_scale):
            what = f"differs in depth from {first.where}: {pictures.full_scale}, {first.full_scale}"
            raise InputError(what, where=pictures.where, remedy="import them into two datasets")
        _check_size(pictures.size, mapping, pictures.where)
    return names, first.dtype, first.full_scale


def _check_size(size: tuple[int, int], mapping: ImportMapping, where: str) -> None:
    if min(size) < mapping.side and not mapping.pad:
        what = f"pictures of {size[1]} x {size[0]} px are smaller than the crops of {mapping.side} px"
        raise InputError(what, where=where, remedy=f"set 'side: {min(size)}' (--side), or 'pad: true'")


@contextlib.contextmanager
def _opened(mapping: ImportMapping, root: Path) -> Iterator[list[_Part]]:
    reader = Reader(root)
    with contextlib.ExitStack() as stack:
        parts = []
        for one in mapping.stacks:
            pictures = stack.enter_context(open_pictures(one.images, reader, mapping.full_scale))
            parts.append(_read(one, mapping, reader, pictures))
        yield parts


def _keep(
    part: _Part,
    mapping: ImportMapping,
    rules: Rules,
    classes: list[str],
    writer: DatasetWriter,
    progress: Progress,
) -> None:
    """Add the pictures of one part, and what became of those of each video."""
    first = len(writer.told)
    told = [
        {"name": name, "uuid": "", "frames": 0, "used": 0, "left_out": {"no label": 0, "no visible RR": 0}}
        for name in part.names
    ]
    # Each part counted its own devices.
    labels = dict(part.values)
    if DEVICE in labels:
        turned = np.array([classes.index(one) for one in part.classes] or [0], float)
        number = labels[DEVICE]
        labels[DEVICE] = np.where(np.isfinite(number), turned[np.nan_to_num(number).astype(int)], np.nan)
    good, where = part.good, part.pictures.where
    shown = progress(part.pictures.read(part.order.tolist()), f"importing {Path(where).name}", total=len(part.order))
    for n, picture in enumerate(shown):
        line = told[part.recording[n]]
        line["frames"] += 1
        if not good[n]:
            line["left_out"]["no label"] += 1
            continue
        if picture.dtype != part.pictures.dtype:
            raise InputError(f"picture {n} holds {picture.dtype}, the first {part.pictures.dtype}", where=where)
        _check_size(picture.shape, mapping, f"{where} picture {n}")
        snr = find_peak(picture, RING_SIGMA).snr
        if mapping.centred:
            centre = (picture.shape[1] - 1) / 2, (picture.shape[0] - 1) / 2
        elif snr < rules.min_snr:
            line["left_out"]["no visible RR"] += 1
            continue
        else:
            centre = find_centre(picture, rules.sigma)
        writer.add(
            crop(picture, centre, mapping.side),
            **{name: float(values[n]) for name, values in labels.items()},
            centre_x=centre[0],
            centre_y=centre[1],
            snr=min(snr, 1e6),
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


def _rules(parts: list[_Part], mapping: ImportMapping) -> Rules:
    share = mapping.test_fraction
    if any(stack.split is not None for stack in mapping.stacks):
        split = np.concatenate([part.split for part in parts])
        share = float(np.mean(split == TEST))
    if mapping.centred:
        return Rules(mapping.side, share, 0.0, 0.0, centring="as imported", embargo=mapping.embargo)
    return Rules(mapping.side, share, 0.0, embargo=mapping.embargo)


def write_stacks(
    mapping: ImportMapping, root: Path, out: str | os.PathLike[str], progress: Progress, overwrite: bool
) -> Path:
    """Write a dataset from the stacks of a mapping; see `import_dataset`."""
    with _opened(mapping, root) as parts:
        names, dtype, full_scale = _checked(parts, mapping)
        classes = sorted({one for part in parts for one in part.classes})
        rules = _rules(parts, mapping)
        with dataset_writer(out, rules, names, classes, full_scale, dtype=dtype, overwrite=overwrite) as writer:
            for part in parts:
                _keep(part, mapping, rules, classes, writer, progress)
            if writer.empty:
                remedy = "set 'centred: true' if they are crops around the RR already, or check what they show"
                left = "; ".join(f"{line['name']}: {line['left_out']}" for line in writer.told)
                raise InputError(f"no picture has its labels and a visible RR ({left})", where=out, remedy=remedy)
            writer.attributes["imported"] = json.dumps(mapping.as_dict())
    return Path(out)
