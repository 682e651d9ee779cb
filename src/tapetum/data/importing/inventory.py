"""What lies in a folder: videos, arrays, tables and folders of images, with what is known without reading them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tapetum.data.importing.arrays import ARRAY_SUFFIXES, ArrayInfo, list_arrays
from tapetum.data.importing.tables import TABLE_SUFFIXES, read_table
from tapetum.errors import InputError
from tapetum.record.images import IMAGE_SUFFIXES, ImageSource
from tapetum.record.recording import is_recording
from tapetum.record.source import existing
from tapetum.record.video import VideoSource, count_frames

__all__ = ["VIDEO_SUFFIXES", "Inventory", "common_root", "look_into"]

VIDEO_SUFFIXES = (".mkv", ".mp4", ".m4v", ".avi", ".mov", ".webm", ".mpg", ".mpeg", ".ts", ".wmv", ".ogv", ".y4m")


@dataclass(frozen=True)
class VideoFound:
    """A video: its path from the root, size in pixels, frames a second, number of frames and full scale."""

    path: str
    width: int
    height: int
    rate: float
    count: int
    full_scale: int


@dataclass(frozen=True)
class ArrayFound:
    """An array of a file."""

    path: str
    info: ArrayInfo


@dataclass(frozen=True)
class TableFound:
    """A table: its columns' names and number of rows."""

    path: str
    columns: tuple[str, ...]
    rows: int


@dataclass(frozen=True)
class FolderFound:
    """A folder of images: how many, and the first one's size and full scale."""

    path: str
    count: int
    width: int
    height: int
    full_scale: int


@dataclass
class Inventory:
    """All that was found under a root.

    Attributes
    ----------
    root
        The folder that all paths start from.
    faults
        What could not be read, a line each.
    recordings
        Recordings, which need no import.
    other
        How many files of no known kind there are.
    """

    root: Path
    videos: list[VideoFound] = field(default_factory=list)
    arrays: list[ArrayFound] = field(default_factory=list)
    tables: list[TableFound] = field(default_factory=list)
    folders: list[FolderFound] = field(default_factory=list)
    recordings: list[str] = field(default_factory=list)
    faults: list[InputError] = field(default_factory=list)
    other: int = 0

    @property
    def lines(self) -> list[str]:
        """What was found, for people."""
        told = [
            f"video   {v.path}: {v.width} x {v.height} px, {v.rate:g} frames/s, {v.count} frames" for v in self.videos
        ]
        told += [f"array   {a.path}: {a.info.text}" for a in self.arrays]
        told += [f"table   {t.path}: {t.rows} rows of {', '.join(t.columns)}" for t in self.tables]
        told += [f"images  {f.path}/: {f.count} images, the first {f.width} x {f.height} px" for f in self.folders]
        told += [f"recording  {r}: cut it with `tapetum dataset build`" for r in self.recordings]
        told += [f"unreadable  {fault}" for fault in self.faults]
        return told + ([f"{self.other} files of other kinds"] if self.other else [])


def common_root(sources: Sequence[str | os.PathLike[str]]) -> Path:
    """The folder that a mapping's paths start from: the one given, or the nearest that holds all that is given.

    Raises
    ------
    InputError
        When nothing is given or a source does not exist.
    """
    places = [existing(source).absolute() for source in sources]
    if not places:
        raise InputError("no folder or file given", where="sources", remedy="name one")
    return Path(os.path.commonpath([place if place.is_dir() else place.parent for place in places]))


def look_into(sources: Sequence[str | os.PathLike[str]]) -> Inventory:
    """List what lies in folders, at any depth, and files.

    Raises
    ------
    InputError
        When nothing is given or a source does not exist. What is damaged is listed in `faults`.
    """
    found = Inventory(common_root(sources))
    for place in (Path(source).absolute() for source in sources):
        if place.is_dir():
            _folder(place, found)
        else:
            _file(place, found)
    return found


def _folder(folder: Path, found: Inventory) -> None:
    if is_recording(folder):
        found.recordings.append(_name(folder, found))
        return
    if (folder / "zarr.json").exists():
        return
    entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
    images = [entry for entry in entries if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file()]
    if images:
        _images(folder, found)
    for entry in entries:
        # A link could lead round in a circle.
        if entry.is_dir() and not entry.is_symlink():
            _folder(entry, found)
        elif entry.is_file() and entry not in images:
            _file(entry, found)


def _name(place: Path, found: Inventory) -> str:
    return place.relative_to(found.root).as_posix()


def _images(folder: Path, found: Inventory) -> None:
    try:
        source = ImageSource.from_path(folder)
        first = next(iter(source))
        height, width = first.image.shape
        scale = int(first.full_scale or 0)
        found.folders.append(FolderFound(_name(folder, found), len(source), width, height, scale))
    except InputError as error:
        found.faults.append(error)


def _file(file: Path, found: Inventory) -> None:
    suffix, name = file.suffix.lower(), _name(file, found)
    try:
        if suffix in ARRAY_SUFFIXES:
            found.arrays += [ArrayFound(name, info) for info in list_arrays(file)]
        elif suffix in (".csv", ".tsv"):
            table = read_table(file)
            found.tables.append(TableFound(name, tuple(table), len(next(iter(table.values())))))
        elif suffix in TABLE_SUFFIXES:
            _text(file, found)
        elif suffix in VIDEO_SUFFIXES:
            found.videos.append(_video(file, name))
        elif suffix in IMAGE_SUFFIXES:
            _images(file, found)
        else:
            found.other += 1
    except InputError as error:
        found.faults.append(error)


def _text(file: Path, found: Inventory) -> None:
    """A text is a table only where it looks like one: a readme is none."""
    try:
        table = read_table(file)
    except InputError:
        found.other += 1
        return
    rows = len(next(iter(table.values())))
    if len(table) > 1 and rows > 1:
        found.tables.append(TableFound(_name(file, found), tuple(table), rows))
    else:
        found.other += 1


def _video(file: Path, name: str) -> VideoFound:
    source = VideoSource.from_path(file)
    height, width = next(iter(source)).image.shape
    count = source.count or count_frames(file)
    return VideoFound(name, width, height, round(source.rate, 3), count, source.full_scale)
