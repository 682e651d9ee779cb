"""Inventory of a folder: videos, arrays, tables and folders of images, described without reading them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from tapetum.data.importing.arrays import ARRAY_SUFFIXES, ArrayInfo, list_arrays
from tapetum.data.importing.columns import TABLE_SUFFIXES, read_text_table
from tapetum.errors import InputError
from tapetum.record.images import IMAGE_SUFFIXES, ImageSource
from tapetum.record.recording import is_recording
from tapetum.record.source import existing
from tapetum.record.video import VideoSource, count_frames

__all__ = ["VIDEO_SUFFIXES", "Inventory", "common_root", "look_into"]

_SHOWN = 5
VIDEO_SUFFIXES = (".mkv", ".mp4", ".m4v", ".avi", ".mov", ".webm", ".mpg", ".mpeg", ".ts", ".wmv", ".ogv", ".y4m")


@dataclass(frozen=True)
class FramesFound:
    """A video or a folder of images: its path from the root, the first frame's size in pixels, number of frames."""

    path: str
    width: int
    height: int
    count: int
    rate: float | None = None  # frames a second, of a video

    def __str__(self) -> str:
        if self.rate is None:
            return f"images  {self.path}/: {self.count} images, the first {self.width} x {self.height} px"
        return f"video   {self.path}: {self.width} x {self.height} px, {self.rate:g} frames/s, {self.count} frames"


@dataclass(frozen=True)
class ArrayFound:
    """An array of a file."""

    path: str
    info: ArrayInfo

    def __str__(self) -> str:
        return f"array   {self.path}: {self.info}"


@dataclass(frozen=True)
class TableFound:
    """A table: its columns' names and number of rows."""

    path: str
    columns: tuple[str, ...]
    rows: int

    def __str__(self) -> str:
        return f"table   {self.path}: {self.rows} rows of {', '.join(self.columns)}"


@dataclass
class Inventory:
    """Everything found under a folder, `root`, from which all paths start.

    `recordings` need no import, `faults` list unreadable files, `others` name files of unknown types.
    """

    root: Path
    videos: list[FramesFound] = field(default_factory=list)
    arrays: list[ArrayFound] = field(default_factory=list)
    tables: list[TableFound] = field(default_factory=list)
    folders: list[FramesFound] = field(default_factory=list)
    recordings: list[str] = field(default_factory=list)
    faults: list[InputError] = field(default_factory=list)
    others: list[str] = field(default_factory=list)

    @property
    def other(self) -> int:
        """Number of files of unknown types."""
        return len(self.others)

    @property
    def lines(self) -> list[str]:
        """The inventory as text, one line each."""
        told = [str(one) for one in (*self.videos, *self.arrays, *self.tables, *self.folders)]
        told += [f"recording  {r}: cut it with `tapetum dataset build`" for r in self.recordings]
        told += [f"unreadable  {fault}" for fault in self.faults]
        if self.others:
            some = ", ".join(self.others[:_SHOWN]) + (", …" if self.other > _SHOWN else "")
            kinds = f"{self.other} file{'' if self.other == 1 else 's'} of other kinds"
            told.append(f"{kinds}: {some}")
        return told

    def look(self, place: Path) -> None:
        """Add a file, or the content of a folder."""
        if place.is_dir():
            self._folder(place)
            return
        try:
            self._file(place)
        except InputError as error:
            self.faults.append(error)

    def _name(self, place: Path) -> str:
        return place.relative_to(self.root).as_posix()

    def _folder(self, folder: Path) -> None:
        if is_recording(folder):
            self.recordings.append(self._name(folder))
            return
        if (folder / "zarr.json").exists():
            return
        entries = sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))
        images = [entry for entry in entries if entry.suffix.lower() in IMAGE_SUFFIXES and entry.is_file()]
        if images:
            try:
                self._images(folder)
            except InputError as error:
                self.faults.append(error)
        for entry in entries:
            # Links to folders could form a cycle.
            if entry not in images and (entry.is_file() or (entry.is_dir() and not entry.is_symlink())):
                self.look(entry)

    def _images(self, place: Path) -> None:
        source = ImageSource.from_path(place)
        height, width = source.first().image.shape
        self.folders.append(FramesFound(self._name(place), width, height, len(source)))

    def _file(self, file: Path) -> None:
        suffix, name = file.suffix.lower(), self._name(file)
        if suffix in ARRAY_SUFFIXES:
            self.arrays += [ArrayFound(name, info) for info in list_arrays(file)]
        elif suffix in TABLE_SUFFIXES:
            self._table(file, name)
        elif suffix in VIDEO_SUFFIXES:
            source = VideoSource.from_path(file)
            height, width = source.first().image.shape
            count = source.count or count_frames(file)
            self.videos.append(FramesFound(name, width, height, count, round(source.rate, 3)))
        elif suffix in IMAGE_SUFFIXES:
            self._images(file)
        else:
            self.others.append(name)

    def _table(self, file: Path, name: str) -> None:
        """Add a table; a .txt file counts only if it has several columns and rows, unlike a readme."""
        text = file.suffix.lower() == ".txt"
        try:
            table = read_text_table(file)
        except InputError:
            if not text:
                raise
            self.others.append(name)
            return
        rows = len(next(iter(table.values())))
        if text and not (len(table) > 1 and rows > 1):
            self.others.append(name)
        else:
            self.tables.append(TableFound(name, tuple(table), rows))


def common_root(sources: Sequence[str | os.PathLike[str]]) -> Path:
    """Return the folder that a mapping's paths start from: the one given, or the nearest that holds all sources.

    Raises an InputError when nothing is given or a source does not exist.
    """
    places = [existing(source).absolute() for source in sources]
    if not places:
        raise InputError("no folder or file given", where="sources", remedy="name one")
    return Path(os.path.commonpath([place if place.is_dir() else place.parent for place in places]))


def look_into(sources: Sequence[str | os.PathLike[str]]) -> Inventory:
    """List the content of folders, at any depth, and files; damaged ones go to `Inventory.faults`.

    Raises an InputError when nothing is given or a source does not exist.
    """
    found = Inventory(common_root(sources))
    for source in sources:
        found.look(Path(source).absolute())
    return found
