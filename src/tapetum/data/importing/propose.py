"""A mapping proposed from what lies in a folder: a guess that a person reads before anything is imported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.data.dataset import QUANTITIES
from tapetum.data.importing.columns import Reader, texts
from tapetum.data.importing.fields import Column, Images
from tapetum.data.importing.guess import constants, depth, gaze_unit, key, length_unit, looks_centred, meaning
from tapetum.data.importing.inventory import VIDEO_SUFFIXES, ArrayFound, Inventory, VideoFound
from tapetum.data.importing.mapping import SCHEMA, Pair
from tapetum.data.importing.pictures import open_pictures
from tapetum.data.importing.proposal import Proposal
from tapetum.data.importing.videos import pair_name
from tapetum.errors import InputError

__all__ = ["propose"]

_SIDE = 400
_FEW = 12


@dataclass(frozen=True)
class _Source:
    """Something that holds values: what they mean, where they are, and how many."""

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


def _choose(what: str, count: int | None, image: str, sources: list[_Source]) -> dict[str, Any] | None:
    """The likeliest source of one meaning for the pictures at a path: in their file, of their name, in their folder."""

    def distance(source: _Source) -> int:
        file = source.column["file"]
        if file == image:
            return 0
        if key(file) == key(image):
            return 1
        near = PurePosixPath(file).parent in (PurePosixPath(image).parent, PurePosixPath(image))
        return 2 if near else 3

    fitting = [s for s in sources if s.meaning == what and (count is None or s.count == count)]
    return dict(min(fitting, key=distance).column) if fitting else None


def _labels(
    count: int, image: str, sources: list[_Source], reader: Reader, out: Proposal
) -> dict[str, dict[str, Any] | str]:
    labels: dict[str, dict[str, Any] | str] = {}
    for name in (*QUANTITIES, "device"):
        column = _choose(name, count, image, sources)
        if column is None:
            continue
        if name.startswith("gaze"):
            more, note = gaze_unit(column, reader, count)
            if "size" in more:
                out.gaps.append(f"the size of the target's frame is not known for {name} of {image}")
            column |= more
            out.notes.append(f"{name} of {image}: {note}")
        elif name != "device":
            more, note = length_unit(name, column, reader, count)
            column |= more
            out.notes.append(f"{name} of {image}: {note}")
        labels[name] = column
    told = constants(image)
    for name, value in told.items():
        if name not in labels:
            labels[name] = value
            out.notes.append(f"{name} of {image}: from its name")
    if not labels:
        out.gaps.append(f"no labels were found for {image} ({count} pictures)")
    return labels


def _stack(
    images: dict[str, Any], count: int, path: str, sources: list[_Source], reader: Reader, out: Proposal
) -> dict[str, Any]:
    stack: dict[str, Any] = {"images": images, "labels": _labels(count, path, sources, reader, out)}
    for name in ("recording", "order", "time", "split"):
        column = _choose(name, count, path, sources)
        # A video keeps its own order and time.
        if column is not None and not (name != "split" and images.get("file") == path and "axes" not in images):
            stack[name] = column
    return stack


def _pairs(found: Inventory) -> tuple[list[tuple[VideoFound, VideoFound]], list[VideoFound]]:
    """Videos of a probe with those of its target, by their paths, and the others."""

    def kin(path: str) -> str:
        return path.casefold().replace("probe", "*").replace("target", "*").rpartition(".")[0]

    targets = {kin(v.path): v for v in found.videos if "target" in v.path.casefold()}
    pairs = [(v, targets[kin(v.path)]) for v in found.videos if "probe" in v.path.casefold() and kin(v.path) in targets]
    paired = {v.path for pair in pairs for v in pair}
    return pairs, [v for v in found.videos if v.path not in paired]


def _times(pair: tuple[VideoFound, VideoFound], found: Inventory) -> dict[str, Any]:
    """A timestamps table for a pair, where there is one: columns with probe and target and time in their names."""
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
    """What the axes of an array of pictures are; None for any other array."""
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
    # MATLAB's own files count rows first, and pictures last; its newer ones show all of that turned.
    rest = ["x", "y"] if array.path.casefold().endswith(".mat") and axis == 0 else ["y", "x"]
    rest.insert(axis, "frame")
    return (*rest, "channel") if channel else tuple(rest)


def propose(found: Inventory) -> Proposal:
    """Propose a mapping for what was found.

    Parameters
    ----------
    found
        From `look_into`.

    Returns
    -------
    Proposal
        With the guesses it rests on; `Proposal.gaps` says what a person has to fill in.

    Raises
    ------
    InputError
        When there are no pictures at all.
    """
    reader = Reader(found.root)
    out = Proposal({"schema": SCHEMA})
    pairs, videos = _pairs(found)
    if pairs:
        rows = [{"probe": p.path, "target": t.path, **_times((p, t), found)} for p, t in pairs]
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
    sources = _sources(found)
    counts = {source.count for source in sources}
    stacks, sizes, centred = [], [], []
    for array in found.arrays:
        axes = _image_axes(array, counts)
        if axes is None:
            if not any(source.column["file"] == array.path for source in sources):
                out.dropped.append(f"{array.path} ({array.info.text}): by shape and name neither pictures nor labels")
            continue
        images: dict[str, Any] = {"file": array.path, "axes": " ".join(axes)}
        if array.info.name:
            images["array"] = array.info.name
        out.notes.append(f"axes of {array.path} ({array.info.text}): {' '.join(axes)}")
        sample = _sample(images, found.root)
        if array.info.dtype != "uint8":
            _add_depth(sample, array, out)
        size = dict(zip(axes, array.info.shape, strict=True))
        sizes.append(min(size["y"], size["x"]))
        stacks.append(_stack(images, size["frame"], array.path, sources, reader, out))
        centred.append(looks_centred(sample))
    for video in videos:
        images = {"file": video.path}
        sizes.append(min(video.width, video.height))
        stacks.append(_stack(images, video.count, video.path, sources, reader, out))
        centred.append(looks_centred(_sample(images, found.root)))
    for images, count, path, size in _folders(found, sources, out):
        sizes.append(size)
        stacks.append(_stack(images, count, path, sources, reader, out))
        centred.append(looks_centred(_sample(images, found.root)))
    if not stacks:
        seen = "; ".join(found.lines) or "nothing"
        remedy = "give a folder with videos, images or arrays, or write a mapping and pass it with --mapping"
        raise InputError(f"no pictures were found ({seen})", where=found.root, remedy=remedy)
    if centred and all(centred):
        out.content["centred"] = True
        out.notes.append("the pictures are crops with the RR in their middle already")
    whole = min(sizes) if out.content.get("centred") else min(_SIDE, *sizes)
    out.content = {"schema": SCHEMA, "side": whole, **out.content, "stacks": stacks}
    return out


def _sample(images: dict[str, Any], root: Path) -> list[NDArray[Any]]:
    """A few pictures: spread over the whole, but of a video its first ones, which cost little to reach."""
    try:
        # The true depth is not known yet; no grey picture has more than this.
        with open_pictures(Images(**images), Reader(root), 65535) as pictures:
            few = min(_FEW, pictures.count)
            last = few - 1 if Path(images.get("file", "")).suffix.lower() in VIDEO_SUFFIXES else pictures.count - 1
            return list(pictures.read(np.unique(np.linspace(0, last, few).astype(int)).tolist()))
    except InputError:
        # What cannot be read is reported when it is imported.
        return []


def _add_depth(sample: list[NDArray[Any]], array: ArrayFound, out: Proposal) -> None:
    out.content["full_scale"] = max(depth(sample), int(out.content.get("full_scale", 0)))
    out.notes.append(f"full_scale {out.content['full_scale']}, from some pictures of {array.path}")


def _folders(found: Inventory, sources: list[_Source], out: Proposal) -> list[tuple[dict[str, Any], int, str, int]]:
    """Folders of images: those that a table names together, the others each for itself."""
    stacks, used = [], set()
    for source in sources:
        if source.meaning != "names":
            continue
        names = texts(Reader(found.root).values(Column(**source.column), None))
        for base in dict.fromkeys([*(f.path for f in found.folders), PurePosixPath(source.column["file"]).parent, "."]):
            if names and (found.root / base / names[0]).is_file():
                inside = [f for f in found.folders if PurePosixPath(f.path).is_relative_to(base) or str(base) == "."]
                used |= {f.path for f in inside}
                images = {"folder": str(base), "names": source.column}
                size = min([min(f.width, f.height) for f in inside], default=_SIDE)
                stacks.append((images, source.count, source.column["file"], size))
                break
    alone = (folder for folder in found.folders if folder.path not in used)
    stacks += [({"folder": one.path}, one.count, one.path, min(one.width, one.height)) for one in alone]
    if used:
        out.notes.append("images go with the rows of the table that names them")
    return stacks
