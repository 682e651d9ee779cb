"""What every origin of frames looks like to the rooms above: grey images in order, again and again."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from tapetum.errors import InputError

__all__ = ["Frame", "FrameSource", "existing", "full_scale_of"]


@dataclass(frozen=True)
class Frame:
    """One grey image of a stream.

    Attributes
    ----------
    index
        Place of the frame in its source, from 0.
    time
        Seconds from the source's first frame, by the source's own clock.
    image
        Digital numbers, [H, W], uint8 or uint16.
    name
        What to call the frame in a message: a file name, or `probe[12]`.
    full_scale
        Digital number at which this frame saturates (255, 4095, 65535 …).
    """

    index: int
    time: float
    image: np.ndarray
    name: str = ""
    full_scale: int | None = None

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or self.image.dtype not in (np.uint8, np.uint16):
            raise InputError(
                f"must be [H, W] uint8 or uint16, is {list(self.image.shape)} {self.image.dtype}",
                where=f"image of frame {self.name or self.index}",
            )
        if self.full_scale is None:
            object.__setattr__(self, "full_scale", full_scale_of(self.image.dtype))


@runtime_checkable
class FrameSource(Protocol):
    """Frames in order; iterating again starts from the beginning.

    Attributes
    ----------
    name
        What to call the source in a message.
    count
        Number of frames, or None where only reading to the end would tell. `len(source)` gives the same and
        raises TypeError where it is None.
    full_scale
        Digital number at which the frames saturate; where the frames differ, that of the first one
        (`Frame.full_scale` is always right).
    """

    @property
    def name(self) -> str: ...

    @property
    def count(self) -> int | None: ...

    @property
    def full_scale(self) -> int: ...

    def __iter__(self) -> Iterator[Frame]: ...

    def __len__(self) -> int: ...


def full_scale_of(dtype: np.dtype | type) -> int:
    """Return the largest number that an unsigned integer type holds."""
    return int(np.iinfo(dtype).max)


def existing(path: str | os.PathLike[str]) -> Path:
    """Return `path` as a Path.

    Raises
    ------
    InputError
        When nothing is there, or it may not be looked at.
    """
    found = Path(path)
    try:
        found.stat()
    except OSError as error:
        reason = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise InputError(reason, where=found, remedy="check the path") from error
    return found
