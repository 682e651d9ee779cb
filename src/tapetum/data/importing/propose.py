"""A mapping proposed from the content of a folder, for a person to check before the import."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from tapetum.data.dataset import DEVICE, QUANTITIES
from tapetum.data.importing.columns import Reader, texts
from tapetum.data.importing.guess import constants, depth, key, looks_centred, meaning, unit
from tapetum.data.importing.inventory import VIDEO_SUFFIXES, ArrayFound, FramesFound, Inventory
from tapetum.data.importing.mapping import SCHEMA, Column, ImagesEntry, ImportMapping, Pair, mapping_from_text
from tapetum.data.importing.pictures import open_pictures
from tapetum.data.importing.videos import pair_name
from tapetum.errors import InputError

__all__ = ["Proposal", "propose"]

_SIDE = 400
_FEW = 12


@dataclass
class Proposal:
    """A mapping as plain values (`content`), and its reasons, one line each.

    `notes` are the guesses, `gaps` what a person must fill in, `dropped` the files left out, and why.
    """

    content: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    gaps: list[str] = field(default_factory=list)
    dropped: list[str] = field(default_factory=list)

    @property
    def text(self) -> str:
        """The proposal as a mapping file, with guesses as comments."""
        body = yaml.safe_dump(self.content, sort_keys=False, default_flow_style=None, width=110, allow_unicode=True)
        told = {"guess": self.notes, "missing": self.gaps, "left out": self.dropped}
        comments = [f"# {word}: {line}" for word, lines in told.items() for line in dict.fromkeys(lines)]
        return "\n".join([*comments, body])

    def mapping(self, where: str) -> ImportMapping:
        """Return the proposal as a checked mapping; raise an InputError when something could not be guessed."""
        if self.gaps:
            remedy = "write the mapping by the proposal above and pass it with --mapping"
            raise InputError(f"no mapping could be made: {self.gaps[0]}", where=where, remedy=remedy)
        return mapping_from_text(self.text, where)


@dataclass(frozen=True)
class _Source:
    """A source of values: their meaning, place and number."""

    meaning: str
    column: dict[str, Any]
    count: int


def _sources(found: Inventory) -> list[_Source]:
    out = []
    for table in found.tables:
        for name in table.columns:
            what = meaning(name)
            if what in ("gaze", None):
                continue
            out.append(_Source(what, {"file": table.path, "column": name}, table.rows))
    for array in found.arrays:
        shape, base = array.info.shape, {"file": array.path}
        if array.info.name:
            base["array"] = array.info.name
        stem = PurePosixPath(array.path).stem
        what = meaning(array.info.name or stem) or meaning(stem.rpartition("_")[2])
        long = [size for size in shape if size > 1]
        if what and len(long) == 1 and what != "gaze":
            out.append(_Source(what, base, long[0]))
        elif what in ("gaze", "gaze_x", "gaze_y") and len(shape) == 2 and 2 in shape:
            count = shape[0] if shape[1] == 2 else shape[1]
            for n, axis in enumerate(("gaze_x", "gaze_y")):
                out.append(_Source(axis, {**base, "column": n}, count))
    return out


def _pairs(found: Inventory) -> tuple[list[tuple[FramesFound, FramesFound]], list[FramesFound]]:
    """Return pairs of probe and target videos, matched by their paths, and the other videos."""
    plain = [(re.sub("probe|target", "*", v.path.casefold().rpartition(".")[0]), v) for v in found.videos]
    targets = {name: v for name, v in plain if "target" in v.path.casefold()}
    pairs = [(v, targets[name]) for name, v in plain if "probe" in v.path.casefold() and name in targets]
    paired = {v.path for pair in pairs for v in pair}
    return pairs, [v for v in found.videos if v.path not in paired]


def _times(pair: tuple[FramesFound, FramesFound], found: Inventory) -> dict[str, Any]:
    """Return a pair's entry for a table of timestamps, if one with columns of probe and target times exists."""
    for table in found.tables:
        columns = {
            side: next((c for c in table.columns if side in c.casefold() and "frame" not in c.casefold()), None)
            for side in ("probe", "target")
        }
        near = PurePosixPath(table.path).parent == PurePosixPath(pair[0].path).parent
        if near and all(columns.values()) and table.rows >= max(v.count for v in pair):
            return {
                "align": "timestamps",
                "probe_times": {"file": table.path, "column": columns["probe"]},
                "target_times": {"file": table.path, "column": columns["target"]},
            }
    return {"align": "same start"}


def _image_axes(array: ArrayFound, counts: set[int]) -> tuple[str, ...] | None:
    """Return the meaning of an image array's axes; None for any other array."""
    shape = array.info.shape
    if array.info.dtype in ("text", "bool") or sum(size >= 8 for size in shape) < 2 or len(shape) not in (3, 4):
        return None
    channel = len(shape) == 4
    if channel and shape[-1] not in (1, 3):
        return None
    flat = shape[:3]
    known = [n for n in (0, 2, 1) if flat[n] in counts]
    lone = next((n for n in range(3) if flat[(n + 1) % 3] == flat[(n + 2) % 3] != flat[n]), 0)
    axis = known[0] if len(known) == 1 else lone
    # MATLAB's older files count rows first and images last; its newer ones are transposed.
    rest = ["x", "y"] if array.path.casefold().endswith(".mat") and axis == 0 else ["y", "x"]
    rest.insert(axis, "frame")
    return (*rest, "channel") if channel else tuple(rest)


def propose(found: Inventory) -> Proposal:
    """Propose a mapping for what `look_into` found; raise an InputError when there are no images at all."""
    pairs, videos = _pairs(found)
    if pairs:
        return _of_pairs(found, pairs, videos)
    stacks = _Stacks(found)
    for array in found.arrays:
        stacks.add_array(array)
    for video in videos:
        stacks.add({"file": video.path}, video.count, video.path, min(video.width, video.height))
    for table in [source for source in stacks.sources if source.meaning == "names"]:
        stacks.add_named(table)
    for folder in found.folders:
        if folder.path not in stacks.used:
            stacks.add({"folder": folder.path}, folder.count, folder.path, min(folder.width, folder.height))
    return stacks.proposal()


def _of_pairs(found: Inventory, pairs: list[tuple[FramesFound, FramesFound]], videos: list[FramesFound]) -> Proposal:
    """Propose recordings from pairs of videos; all other files are left out."""
    out = Proposal({"schema": SCHEMA})
    rows: list[dict[str, Any]] = [{"probe": p.path, "target": t.path, **_times((p, t), found)} for p, t in pairs]
    names = [pair_name(Pair(**row)) for row in rows]
    for row, name, (probe, _) in zip(rows, names, pairs, strict=True):
        if names.count(name) > 1:
            row["name"] = "-".join(dict.fromkeys([*PurePosixPath(probe.path).parent.parts, name]))
        told = constants(probe.path)
        if told:
            row["labels"] = told
            out.notes.append(f"{', '.join(told)} of {probe.path}: from its name")
        if row["align"] == "same start":
            what = "both videos begin at the same moment; if the laser blinked a code, write 'align: blink'"
            out.notes.append(f"{probe.path}: {what}")
    out.content |= {"side": min(_SIDE, *(min(p.width, p.height) for p, _ in pairs)), "videos": rows}
    used = {row[key]["file"] for row in rows for key in ("probe_times", "target_times") if key in row}
    for video in videos:
        part = next((word for word in ("probe", "target") if word in video.path.casefold()), None)
        lacks = f"no {'target' if part == 'probe' else 'probe'} video of the same name" if part else "not in a pair"
        out.dropped.append(f"{video.path}: {lacks}")
    others = [one.path for one in (*found.arrays, *found.tables, *found.folders) if one.path not in used]
    out.dropped += [f"{path}: pairs of videos are labelled by the laser in the target's video" for path in others]
    return out


class _Stacks:
    """Collects the stacks of a proposal."""

    def __init__(self, found: Inventory) -> None:
        self.found, self.reader = found, Reader(found.root)
        self.sources = _sources(found)
        self.used: set[str] = set()
        self._out = Proposal({"schema": SCHEMA})
        self._stacks: list[dict[str, Any]] = []
        self._sizes: list[int] = []
        self._centred: list[bool] = []
        self._scale = 0

    def add_array(self, array: ArrayFound) -> None:
        """Add an array of images; list one that holds neither images nor values as dropped."""
        axes = _image_axes(array, {source.count for source in self.sources})
        if axes is None:
            if not any(source.column["file"] == array.path for source in self.sources):
                what = "by shape and name neither pictures nor labels"
                self._out.dropped.append(f"{array.path} ({array.info}): {what}")
            return
        images: dict[str, Any] = {"file": array.path, "axes": " ".join(axes)}
        if array.info.name:
            images["array"] = array.info.name
        self._out.notes.append(f"axes of {array.path} ({array.info}): {' '.join(axes)}")
        size = dict(zip(axes, array.info.shape, strict=True))
        sample = self.add(images, size["frame"], array.path, min(size["y"], size["x"]))
        if array.info.dtype != "uint8":
            self._scale = max(depth(sample), self._scale)
            self._out.notes.append(f"full_scale {self._scale}, from some pictures of {array.path}")

    def add_named(self, source: _Source) -> None:
        """Add the folders of images that a table lists."""
        names = texts(self.reader.values(Column(**source.column), None))
        file = source.column["file"]
        for base in map(str, dict.fromkeys([*(f.path for f in self.found.folders), PurePosixPath(file).parent, "."])):
            if names and (self.found.root / base / names[0]).is_file():
                inside = [f for f in self.found.folders if PurePosixPath(f.path).is_relative_to(base) or base == "."]
                self.used |= {f.path for f in inside}
                images = {"folder": base, "names": source.column}
                self.add(images, source.count, file, min([min(f.width, f.height) for f in inside], default=_SIDE))
                self._out.notes.append("images go with the rows of the table that names them")
                return

    def add(self, images: dict[str, Any], count: int, path: str, size: int) -> list[NDArray[Any]]:
        """Add a stack of `count` images at `path` with least edge `size`; return a few of them."""
        stack: dict[str, Any] = {"images": images, "labels": self._labels(count, path)}
        # A video keeps its own order and time.
        video = images == {"file": path}
        for name in ("split",) if video else ("recording", "order", "time", "split"):
            column = self._choose(name, count, path)
            if column is not None:
                stack[name] = column
        sample = _sample(images, self.reader)
        self._stacks.append(stack)
        self._sizes.append(size)
        self._centred.append(looks_centred(sample))
        return sample

    def _choose(self, what: str, count: int, image: str) -> dict[str, Any] | None:
        """Return the likeliest source of a meaning for images: in their file, of the same name, or beside it."""

        def distance(source: _Source) -> int:
            file = source.column["file"]
            if file == image:
                return 0
            if key(file) == key(image):
                return 1
            near = PurePosixPath(file).parent in (PurePosixPath(image).parent, PurePosixPath(image))
            return 2 if near else 3

        fitting = [source for source in self.sources if source.meaning == what and source.count == count]
        return dict(min(fitting, key=distance).column) if fitting else None

    def _labels(self, count: int, image: str) -> dict[str, dict[str, Any] | str]:
        out, labels = self._out, {}
        for name in (*QUANTITIES, DEVICE):
            column = self._choose(name, count, image)
            if column is None:
                continue
            labels[name] = column
            if name == DEVICE:
                continue
            more, note = unit(name, column, self.reader, count)
            if "size" in more:
                out.gaps.append(f"the size of the target's frame is not known for {name} of {image}")
            column |= more
            out.notes.append(f"{name} of {image}: {note}")
        for name, value in constants(image).items():
            if name not in labels:
                labels[name] = value
                out.notes.append(f"{name} of {image}: from its name")
        if not labels:
            out.gaps.append(f"no labels were found for {image} ({count} pictures)")
        return labels

    def proposal(self) -> Proposal:
        """Return the proposal of all stacks."""
        out, found = self._out, self.found
        if not self._stacks:
            seen = "; ".join(found.lines) or "nothing"
            remedy = "give a folder with videos, images or arrays, or write a mapping and pass it with --mapping"
            raise InputError(f"no pictures were found ({seen})", where=found.root, remedy=remedy)
        centred = all(self._centred)
        if centred:
            out.notes.append("the pictures are crops with the RR in their middle already")
        side = min(self._sizes) if centred else min(_SIDE, *self._sizes)
        scale = {"full_scale": self._scale} if self._scale else {}
        out.content |= {"side": side, **scale, **({"centred": True} if centred else {}), "stacks": self._stacks}
        self._say_unused()
        return out

    def _say_unused(self) -> None:
        """List the columns and arrays of values that no stack uses: by name or by number they fit none."""
        used = list(_columns(self._stacks))
        for table in self.found.tables:
            mine = {str(column.get("column")) for column in used if column.get("file") == table.path}
            rest = [name for name in table.columns if name not in mine]
            if rest:
                whole = f"{table.path} ({table.rows} rows)" if not mine else f"{', '.join(rest)} of {table.path}"
                self._out.dropped.append(f"{whole}: its name or its number of rows fits no pictures")
        for array in self.found.arrays:
            mine = [one for one in used if one.get("file") == array.path and one.get("array", "") == array.info.name]
            meant = any(source.column["file"] == array.path for source in self.sources)
            if meant and not mine and _image_axes(array, set()) is None:
                self._out.dropped.append(f"{array.path} ({array.info}): its name or its length fits no pictures")


def _columns(content: Any) -> Iterator[dict[str, Any]]:
    """Yield every mapping in nested values that names a file."""
    if isinstance(content, dict):
        if "file" in content:
            yield content
        content = list(content.values())
    if isinstance(content, list):
        for one in content:
            yield from _columns(one)


def _sample(images: dict[str, Any], reader: Reader) -> list[NDArray[Any]]:
    """Return a few images, evenly spread; of a video the first ones, which are faster to reach."""
    try:
        # The true depth is unknown; this is the largest of grey images.
        with open_pictures(ImagesEntry(**images), reader, 65535) as pictures:
            few = min(_FEW, pictures.count)
            last = few - 1 if Path(images.get("file", "")).suffix.lower() in VIDEO_SUFFIXES else pictures.count - 1
            return list(pictures.read(np.unique(np.linspace(0, last, few).astype(int)).tolist()))
    except InputError:
        # The import reports unreadable files.
        return []
