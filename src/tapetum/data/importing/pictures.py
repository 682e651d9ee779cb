"""Grey images from arrays, folders and videos, read in any order."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.data.importing.arrays import ARRAY_SUFFIXES, open_array
from tapetum.data.importing.columns import Reader, texts
from tapetum.data.importing.mapping import ImagesEntry
from tapetum.errors import InputError
from tapetum.record.frames import open_frames
from tapetum.record.images import ImageSource, read_image
from tapetum.record.source import existing
from tapetum.record.video import count_frames, truncated

__all__ = ["Pictures", "open_pictures"]

SLICE = 64 << 20
"""Bytes of an array read at a time."""


@dataclass(frozen=True)
class Pictures(ABC):
    """Opened images."""

    count: int
    size: tuple[int, ...]  # height and width of the first one
    dtype: np.dtype[Any]  # uint8, uint16 or float32
    full_scale: int
    where: str  # what to call them in a message

    @abstractmethod
    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        """Yield the images numbered in `order`, each [H, W] of `dtype`."""


@contextlib.contextmanager
def open_pictures(images: ImagesEntry, reader: Reader, full_scale: int | None) -> Iterator[Pictures]:
    """Open the images of a stack with the largest count `full_scale`, if the mapping gives it.

    Raises an InputError when a file is missing, damaged, empty, or no grey image, or an array's depth is unknown.
    """
    if images.folder is not None:
        yield _folder(images, reader, full_scale)
        return
    file = existing(reader.root / str(images.file))
    if file.suffix.lower() not in ARRAY_SUFFIXES:
        yield _frames(file, full_scale)
        return
    with open_array(file, images.array) as array:
        yield _array(array, images, file, full_scale)


@dataclass(frozen=True)
class _Files(Pictures):
    files: tuple[tuple[Path, int], ...]

    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        for n in order:
            yield read_image(*self.files[n])[0]


def _folder(images: ImagesEntry, reader: Reader, full_scale: int | None) -> Pictures:
    folder = existing(reader.root / str(images.folder))
    if images.names is None:
        files: tuple[tuple[Path, int], ...] = tuple(ImageSource.from_path(folder)._pages)  # type: ignore[attr-defined]
    else:
        names = texts(reader.values(images.names, None))
        files = tuple((folder / name, 0) for name in names)
        lost = [number for number, (file, _) in enumerate(files) if not file.is_file()]
        if lost:
            what = f"{len(lost)} of {len(files)} images are missing, the first is {names[lost[0]]!r}"
            raise InputError(what, where=folder, remedy="copy them again, or correct 'folder' or the table")
        outside = next((file for file, _ in files if not file.resolve().is_relative_to(folder.resolve())), None)
        if outside is not None:
            raise InputError("lies outside of the images' folder", where=outside, remedy="correct the table")
    first, depth = read_image(*files[0])
    return _Files(len(files), first.shape, first.dtype, full_scale or depth, str(folder), files)


class _Frames(Pictures):
    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        if list(order) != sorted(order):
            remedy = "leave 'recording' and 'order' out, or save the frames as images"
            raise InputError("a video can be read in its own order only", where=self.where, remedy=remedy)
        wanted, found = set(order), 0
        for frame in open_frames(self.where):
            if found == len(order):
                return
            if frame.index in wanted:
                yield frame.image
                found += 1
        if found < len(order):
            raise InputError(f"the video ends before frame {order[found]}", where=self.where, remedy="copy it again")


def _frames(file: Path, full_scale: int | None) -> Pictures:
    source = open_frames(file)
    first = source.first().image
    count = len(source) if isinstance(source, ImageSource) else count_frames(file)
    if source.count is not None and count < source.count:
        raise truncated(file, count)
    return _Frames(count, first.shape, first.dtype, full_scale or source.full_scale, str(file))


@dataclass(frozen=True)
class _Slices(Pictures):
    array: Any
    axes: tuple[str, ...]

    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        axis = self.axes.index("frame")
        wanted = [self.axes.index(name) for name in ("frame", "y", "x", "channel") if name in self.axes]
        each = max(1, int(np.prod(self.array.shape)) // max(1, self.array.shape[axis]) * self.array.dtype.itemsize)
        for start, stop in _runs(order, max(1, SLICE // each)):
            key = tuple(slice(start, stop) if n == axis else slice(None) for n in range(len(self.axes)))
            try:
                block = np.asarray(self.array[key])
            except (OSError, ValueError, RuntimeError) as error:
                told = f"pictures {start} to {stop - 1} cannot be read ({error})"
                raise InputError(told, where=self.where, remedy="copy the file again") from error
            for number, picture in enumerate(np.transpose(block, wanted), start):
                yield self._grey(picture, number)

    def _grey(self, picture: NDArray[Any], number: int) -> NDArray[Any]:
        here = f"{self.where} picture {number}"
        if picture.dtype.kind == "f" and not np.isfinite(picture).all():
            raise InputError("holds values that are not finite", where=here, remedy="mend or leave out the picture")
        if picture.min() < 0 or picture.max() > self.full_scale:
            what = f"counts {picture.min():g} to {picture.max():g}, allowed are 0 to {self.full_scale}"
            raise InputError(what, where=here, remedy="give 'full_scale'")
        picture = np.ascontiguousarray(picture.astype(self.dtype))
        if picture.ndim == 2:
            return picture
        return picture[..., 0] if picture.shape[2] == 1 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))


def _runs(order: Sequence[int], longest: int) -> Iterator[tuple[int, int]]:
    """Split an order into runs of consecutive numbers; return start and stop of each, none longer than `longest`."""
    start = 0
    for n in range(1, len(order) + 1):
        if n == len(order) or order[n] != order[n - 1] + 1 or n - start == longest:
            yield order[start], order[n - 1] + 1
            start = n


def _array(array: Any, images: ImagesEntry, file: Path, full_scale: int | None) -> Pictures:
    shape, axes, where = array.shape, tuple(images.axes), f"{file}{':' + images.array if images.array else ''}"
    if len(shape) != len(axes):
        what = f"has {len(shape)} axes ({' x '.join(map(str, shape))}), the mapping names {len(axes)}"
        raise InputError(what, where=where, remedy="correct 'axes', for example 'frame y x'")
    sizes = dict(zip(axes, shape, strict=True))
    if not min(shape):
        raise InputError("holds no pictures", where=where, remedy="give another array")
    if sizes.get("channel", 1) not in (1, 3):
        raise InputError(f"has {sizes['channel']} channels", where=where, remedy="give grey or RGB pictures")
    if array.dtype.kind not in "uif":
        raise InputError(f"holds {array.dtype}, no grey levels", where=where, remedy="give whole or real numbers")
    if full_scale is None:
        if array.dtype != np.uint8:
            what = f"the depth of {array.dtype} pictures cannot be known"
            raise InputError(what, where=where, remedy="say it in the mapping, for example 'full_scale: 4095'")
        full_scale = 255
    if array.dtype.kind == "f":
        dtype = np.dtype(np.float32)
    elif full_scale > 65535:
        raise InputError(f"is {full_scale}", where="full_scale", remedy="give at most 65535 for whole numbers")
    else:
        dtype = np.dtype(np.uint8 if full_scale <= 255 else np.uint16)
    return _Slices(sizes["frame"], (sizes["y"], sizes["x"]), dtype, full_scale, where, array, axes)
