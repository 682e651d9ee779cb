"""Grey pictures from wherever they are, one after the other in any order: arrays, folders, videos."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.data.importing.arrays import ARRAY_SUFFIXES, Sliced, open_array
from tapetum.data.importing.columns import Reader, texts
from tapetum.data.importing.fields import Images
from tapetum.errors import InputError
from tapetum.record.frames import open_frames
from tapetum.record.images import ImageSource, read_image
from tapetum.record.source import existing
from tapetum.record.video import count_frames, truncated

__all__ = ["Pictures", "open_pictures"]

SLICE = 64 << 20
"""Bytes of an array that are read at once."""


@dataclass(frozen=True)
class Pictures:
    """Pictures that were opened: how many, of which size and type, where from, and how to read them.

    Parameters
    ----------
    count
        How many.
    size
        Height and width of the first one.
    dtype
        uint8, uint16 or float32.
    full_scale
        Largest count.
    where
        What to call them in a message.
    """

    count: int
    size: tuple[int, int]
    dtype: np.dtype[Any]
    full_scale: int
    where: str
    source: Any

    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        """Yield the pictures numbered in `order`, each [H, W] of `dtype`."""
        yield from self.source.read(order)


@contextlib.contextmanager
def open_pictures(images: Images, reader: Reader, full_scale: int | None) -> Iterator[Pictures]:
    """Open the pictures of a stack.

    Parameters
    ----------
    images
        Where they are.
    reader
        Of the mapping's columns.
    full_scale
        Largest count, where the mapping says it.

    Raises
    ------
    InputError
        When a file is missing, damaged, empty, or no grey picture, or an array's depth cannot be known.
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
class _Files:
    files: tuple[tuple[Path, int], ...]

    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        for n in order:
            file, page = self.files[n]
            yield read_image(file, page)[0]


def _folder(images: Images, reader: Reader, full_scale: int | None) -> Pictures:
    folder = existing(reader.root / str(images.folder))
    if images.names is None:
        files = tuple(ImageSource.from_path(folder)._pages)  # type: ignore[attr-defined]
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
    first, depth = read_image(files[0][0], files[0][1])
    height, width = first.shape
    scale = full_scale or depth
    return Pictures(len(files), (height, width), first.dtype, scale, str(folder), _Files(files))


@dataclass(frozen=True)
class _Frames:
    file: Path

    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        if list(order) != sorted(order):
            remedy = "leave 'recording' and 'order' out, or save the frames as images"
            raise InputError("a video can be read in its own order only", where=self.file, remedy=remedy)
        wanted = iter(order)
        following = next(wanted, None)
        for frame in open_frames(self.file):
            if following is None:
                return
            if frame.index == following:
                yield frame.image
                following = next(wanted, None)
        if following is not None:
            raise InputError(f"the video ends before frame {following}", where=self.file, remedy="copy it again")


def _frames(file: Path, full_scale: int | None) -> Pictures:
    source = open_frames(file)
    first = source.first()
    height, width = first.image.shape
    scale = full_scale or source.full_scale
    count = len(source) if isinstance(source, ImageSource) else count_frames(file)
    if source.count is not None and count < source.count:
        raise truncated(file, count)
    return Pictures(count, (height, width), first.image.dtype, scale, str(file), _Frames(file))


@dataclass(frozen=True)
class _Slices:
    array: Sliced
    axes: tuple[str, ...]
    dtype: np.dtype[Any]
    limit: int
    where: str

    def read(self, order: Sequence[int]) -> Iterator[NDArray[Any]]:
        axis = self.axes.index("frame")
        each = max(1, int(np.prod(self.array.shape)) // max(1, self.array.shape[axis]) * self.array.dtype.itemsize)
        for start, stop in runs(order, max(1, SLICE // each)):
            key = tuple(slice(start, stop) if n == axis else slice(None) for n in range(len(self.axes)))
            try:
                block = np.asarray(self.array[key])
            except (OSError, ValueError, RuntimeError) as error:
                told = f"pictures {start} to {stop - 1} cannot be read ({error})"
                raise InputError(told, where=self.where, remedy="copy the file again") from error
            wanted = [self.axes.index(name) for name in ("frame", "y", "x")]
            if "channel" in self.axes:
                wanted.append(self.axes.index("channel"))
            for number, picture in enumerate(np.transpose(block, wanted), start):
                yield self._grey(picture, number)

    def _grey(self, picture: NDArray[Any], number: int) -> NDArray[Any]:
        here = f"{self.where} picture {number}"
        if picture.dtype.kind == "f" and not np.isfinite(picture).all():
            raise InputError("holds values that are not finite", where=here, remedy="mend or leave out the picture")
        if picture.min() < 0 or picture.max() > self.limit:
            found = f"{picture.min():g} to {picture.max():g}"
            raise InputError(f"counts {found}, allowed are 0 to {self.limit}", where=here, remedy="give 'full_scale'")
        picture = np.ascontiguousarray(picture.astype(self.dtype))
        if picture.ndim == 2:
            return picture
        return picture[..., 0] if picture.shape[2] == 1 else np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))


def runs(order: Sequence[int], longest: int) -> Iterator[tuple[int, int]]:
    """Split an order into stretches of neighbours, start and stop of each, none longer than `longest`."""
    start = 0
    for n in range(1, len(order) + 1):
        if n == len(order) or order[n] != order[n - 1] + 1 or n - start == longest:
            yield order[start], order[n - 1] + 1
            start = n


def _array(array: Sliced, images: Images, file: Path, full_scale: int | None) -> Pictures:
    shape, axes, where = array.shape, tuple(images.axes), f"{file}{':' + images.array if images.array else ''}"
    if len(shape) != len(axes):
        what = f"has {len(shape)} axes ({' x '.join(map(str, shape))}), the mapping names {len(axes)}"
        raise InputError(what, where=where, remedy="correct 'axes', for example 'frame y x'")
    sizes = dict(zip(axes, shape, strict=True))
    if not min(shape):
        raise InputError("holds no pictures", where=where, remedy="give another array")
    if sizes.get("channel", 1) not in (1, 3):
        raise InputError(f"has {sizes['channel']} channels", where=where, remedy="give grey or RGB pictures")
    kind, size = array.dtype.kind, array.dtype.itemsize
    if kind not in "uif":
        raise InputError(f"holds {array.dtype}, no grey levels", where=where, remedy="give whole or real numbers")
    if full_scale is None:
        if (kind, size) != ("u", 1):
            what = f"the depth of {array.dtype} pictures cannot be known"
            raise InputError(what, where=where, remedy="say it in the mapping, for example 'full_scale: 4095'")
        full_scale = 255
    if kind != "f" and full_scale > 65535:
        raise InputError(f"is {full_scale}", where="full_scale", remedy="give at most 65535 for whole numbers")
    if kind == "f":
        dtype = np.dtype(np.float32)
    else:
        dtype = np.dtype(np.uint8 if full_scale <= 255 else np.uint16)
    source = _Slices(array, axes, dtype, full_scale, where)
    return Pictures(sizes["frame"], (sizes["y"], sizes["x"]), dtype, full_scale, where, source)
