"""Common interface of all sources of frames: grey images in order, with their times and exposure."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np

from tapetum.errors import InputError

__all__ = ["Arrival", "Frame", "FrameSource", "Live", "Source", "Stored", "existing", "full_scale_of"]


@dataclass(frozen=True)
class Frame:
    """One grey image of a stream; unknown values are None.

    Attributes
    ----------
    index, time
        Number of the frame in its source, from 0, and seconds from the first one by the source's own clock.
    image, full_scale
        Digital numbers, [H, W], uint8 or uint16, and the one at which this frame saturates (255, 4095, 65535 …).
    name
        Name for messages: a file name, or `probe[12]`.
    utc_ns, monotonic_ns
        When it was taken, in nanoseconds since 1970, and by this machine's monotonic clock.
    exposure, lit
        Exposure time in seconds, and whether the probe's laser was on.
    lost
        Frames known to be lost since the one before.
    camera_time
        Seconds by the source's own clock, where `time` is by another one.
    """

    index: int
    time: float
    image: np.ndarray
    name: str = ""
    full_scale: int | None = None
    utc_ns: int | None = None
    monotonic_ns: int | None = None
    exposure: float | None = None
    lit: bool | None = None
    lost: int = 0
    camera_time: float | None = None

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or self.image.dtype not in (np.uint8, np.uint16):
            what = f"must be [H, W] uint8 or uint16, is {list(self.image.shape)} {self.image.dtype}"
            raise InputError(what, where=f"image of frame {self.name or self.index}")
        if self.full_scale is not None and not self.full_scale > 0:
            what = f"must be positive, is {self.full_scale}"
            raise InputError(what, where=f"full_scale of frame {self.name or self.index}", remedy="255 is usual")
        if self.full_scale is None:
            object.__setattr__(self, "full_scale", full_scale_of(self.image.dtype))


@runtime_checkable
class Source(Protocol):
    """Frames in order. Stored frames can be iterated again from the beginning; a camera continues from now.

    Attributes
    ----------
    name, hardware
        Name for messages, and what is known of the camera or file, as JSON values.
    live
        Whether frames arrive at their own pace, and are lost unless they are taken.
    count
        Number of frames, or None where only reading to the end would show it; `len(source)` then raises TypeError.
    full_scale
        Digital number at which the first frame saturates (`Frame.full_scale` is right for each).
    rate
        Nominal frames per second, or None.
    """

    @property
    def name(self) -> str: ...

    @property
    def live(self) -> bool: ...

    @property
    def count(self) -> int | None: ...

    @property
    def full_scale(self) -> int: ...

    @property
    def rate(self) -> float | None: ...

    @property
    def hardware(self) -> dict[str, Any]: ...

    def first(self) -> Frame:
        """Return a frame that shows the stream's size and depth; iterating still gives every frame."""
        ...

    def __iter__(self) -> Iterator[Frame]: ...

    def __len__(self) -> int: ...

    def close(self) -> None:
        """Release the camera; files need no closing."""
        ...


FrameSource = Source


class Arrival(NamedTuple):
    """An image from a camera, its moment by the monotonic clock in ns, and what else the camera says of it.

    `number` is the camera's own, from which lost frames are counted; `exposure` in seconds. None where unknown.
    """

    image: np.ndarray
    moment: int
    number: int | None = None
    exposure: float | None = None


class Live:
    """Common part of cameras: frames come by themselves, from when they are asked for."""

    live, count = True, None
    name: str
    full_scale: int
    _seen: np.ndarray

    def first(self) -> Frame:
        """Return the image that the camera gave when it was opened."""
        return Frame(0, 0.0, self._seen, self.name, self.full_scale)

    def __len__(self) -> int:
        raise TypeError(f"{self.name} is a camera: it has no number of frames")

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames from now on, with those lost before each; raise an InputError when the camera stops."""
        # UTC is read once and continued by the monotonic clock.
        start_utc, start = time.time_ns(), time.monotonic_ns()
        begin = before = None
        index = 0
        for image, moment, number, exposure in self._arrivals(start_utc - start):
            if moment < start:
                # Buffered before now.
                continue
            begin = moment if begin is None else begin
            lost = 0 if before is None or number is None else max(0, number - before - 1)
            yield Frame(
                index,
                (moment - begin) / 1e9,
                image,
                f"{self.name}[{index}]",
                self.full_scale,
                utc_ns=start_utc + moment - start,
                monotonic_ns=moment,
                exposure=exposure,
                lost=lost,
            )
            before, index = number, index + 1

    def _arrivals(self, utc_ahead: int) -> Iterator[Arrival]:
        """Yield images without end; UTC is `utc_ahead` ns ahead of the monotonic clock."""
        raise NotImplementedError


class Stored:
    """Common part of sources of stored frames."""

    @property
    def live(self) -> bool:
        """False: stored frames wait."""
        return False

    @property
    def hardware(self) -> dict[str, Any]:
        """The file's name, and the origin of its times."""
        return {"file": Path(cast(Source, self).name).name, "time": "the file's own"}

    def first(self) -> Frame:
        """Return the first frame; raise an InputError when there is none or it cannot be read."""
        source = cast(Source, self)
        with contextlib.closing(cast("Generator[Frame]", iter(source))) as frames:
            found = next(frames, None)
        if found is None:
            raise InputError("holds no frame", where=source.name, remedy="give another file, or copy it again")
        return found

    def __len__(self) -> int:
        source = cast(Source, self)
        if source.count is None:
            raise TypeError(f"{source.name} does not state its number of frames")
        return source.count

    def close(self) -> None:
        """Do nothing: files close themselves."""


def full_scale_of(dtype: np.dtype | type) -> int:
    """Return the largest number that an unsigned integer type holds."""
    return int(np.iinfo(dtype).max)


def existing(path: str | os.PathLike[str]) -> Path:
    """Return `path` as a Path; raise an InputError when it does not exist or is not accessible."""
    found = Path(path)
    try:
        found.stat()
    except OSError as error:
        reason = "does not exist" if isinstance(error, FileNotFoundError) else f"cannot be read ({error.strerror})"
        raise InputError(reason, where=found, remedy="check the path") from error
    return found
