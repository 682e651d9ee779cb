"""Frames in a `.npy` file: an array [N, H, W], or [H, W] for one frame, of whole numbers."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tapetum.errors import InputError
from tapetum.record.source import Frame, Stored, existing, full_scale_of

__all__ = ["StackSource"]

_LARGEST = 2**16 - 1


@dataclass(frozen=True, eq=False)
class StackSource(Stored):
    """An array of frames as a source. Frames are timed by `rate` (per second), as an array has no clock.

    Attributes
    ----------
    path, images, rate
        The file, its array [N, H, W], read as needed, and frames per second.
    """

    path: Path
    images: np.ndarray
    rate: float = 15.0

    @classmethod
    def from_path(cls, path: str | os.PathLike[str], rate: float = 15.0) -> StackSource:
        """Open a `.npy` file; raise an InputError when it holds no frames of whole numbers. Pickles are not read."""
        file = existing(path)
        try:
            images = np.load(file, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            remedy = "copy it again, or write it with numpy.save"
            raise InputError("is truncated, or no .npy of plain numbers", where=file, remedy=remedy) from error
        if not isinstance(images, np.ndarray) or images.ndim not in (2, 3) or 0 in images.shape:
            shape = getattr(images, "shape", "several arrays")
            remedy = "give grey frames [N, H, W], one after another"
            raise InputError(f"holds an array of shape {shape}", where=file, remedy=remedy)
        if images.dtype.kind not in "iu":
            remedy = "give the camera's own counts, as uint8 or uint16"
            raise InputError(f"holds {images.dtype}, not whole numbers", where=file, remedy=remedy)
        return cls(file, images[None] if images.ndim == 2 else images, rate)

    @property
    def name(self) -> str:
        """The file, for messages."""
        return str(self.path)

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.images)

    @property
    def full_scale(self) -> int:
        """Largest number of its type: an array does not say how deep its camera was."""
        return full_scale_of(np.uint8 if self.images.dtype.itemsize == 1 else np.uint16)

    def __iter__(self) -> Iterator[Frame]:
        kind = np.uint8 if self.images.dtype.itemsize == 1 else np.uint16
        for index, image in enumerate(self.images):
            name = f"{self.path.stem}[{index}]"
            if self.images.dtype not in (np.uint8, np.uint16) and not 0 <= image.min() <= image.max() <= _LARGEST:
                what = f"frame {index} holds numbers from {image.min()} to {image.max()}"
                raise InputError(what, where=self.path, remedy=f"give counts from 0 to {_LARGEST}")
            yield Frame(index, index / self.rate, np.array(image, kind), name, self.full_scale)
