"""Writing of recordings, which stay readable however the writing ends."""

from __future__ import annotations

import contextlib
import importlib.metadata
import math
import os
import platform
import re
import shutil
import uuid
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import av
import numpy as np

from tapetum.durable import clean_leftovers, sole_writer, sync
from tapetum.errors import InputError
from tapetum.files import free_name, replace_folder, told_when_full
from tapetum.record import layout
from tapetum.record.layout import FRAMES, JOURNAL, META, StreamInfo, write_table
from tapetum.record.source import Frame
from tapetum.record.video import VideoWriter

__all__ = ["RecordingWriter"]


def software() -> dict[str, str]:
    """Return the versions of the software."""
    return {
        "tapetum": importlib.metadata.version("tapetum"),
        "python": platform.python_version(),
        "av": av.__version__,
        "system": platform.system(),
    }


def _switched(lit: object, where: str) -> bool | None:
    """Return whether the laser was on as a bool, or None; a 0 or 1 of any integer type is taken as well."""
    if lit is None:
        return None
    if not isinstance(lit, (int, np.integer, np.bool_)) or lit not in (0, 1):
        raise InputError(f"lit cannot be {lit!r}", where=where, remedy="give True, False or None")
    return bool(lit)


class RecordingWriter:
    """Writes a recording; use it in a `with` block.

    Each frame goes to its video and its clocks to the journal at once, so that a killed program loses at most the
    newest frame of every stream. An exception in the block keeps the frames, marked as unfinished, or removes an empty
    folder. A recording to be replaced stays until the new one is complete, which is written beside it as
    `NAME.unfinished.rec` and stays there if unfinished.

    Parameters
    ----------
    path
        The folder to make, usually `NAME.rec`.
    streams, rate
        Formats by stream name (`probe`, `target`), and nominal frames per second.
    hardware, extra
        Cameras, lenses, serial numbers; and further fields of recording.json (a scene, seeds), under names that it does
        not use itself. JSON values.
    start_utc_ns
        UTC of the recording's start, nanoseconds since 1970.
    overwrite
        Whether a recording at `path` may be replaced once this one is complete. Nothing else ever is.

    Raises
    ------
    InputError
        When something exists at `path`, another command is recording to it, the arguments cannot be written, or the
        disk is full.

    Attributes
    ----------
    place
        The folder that the frames go to.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        streams: Mapping[str, StreamInfo],
        rate: float = 15.0,
        hardware: Mapping[str, Any] | None = None,
        extra: Mapping[str, Any] | None = None,
        start_utc_ns: int,
        overwrite: bool = False,
    ) -> None:
        self.path = Path(path)
        if not streams:
            raise InputError("no stream to record", where=self.path, remedy="give at least one")
        for name in streams:
            # The name is used for a file and in the journal.
            if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]*", name):
                what = f"cannot name a stream {name!r}"
                raise InputError(what, where=self.path, remedy="use letters, digits, - and _")
        self.streams = {name: replace(info, rate=info.rate or rate) for name, info in streams.items()}
        self.meta: dict[str, Any] = {
            "format": layout.FORMAT,
            "version": layout.VERSION,
            "uuid": str(uuid.uuid4()),
            "start_utc": layout.iso(start_utc_ns),
            "start_utc_ns": int(start_utc_ns),
            "rate": rate,
            "finished": False,
            "hardware": dict(hardware or {}),
            "streams": {
                name: {"file": f"{name}.mkv", "codec": "ffv1", **asdict(info)} for name, info in self.streams.items()
            },
            "clock": {
                "utc": "nanoseconds since 1970-01-01, at mid-exposure where the source knows it",
                "monotonic_ns": "a clock that is never set, for durations within this recording",
            },
            "software": software(),
        }
        if taken := sorted(set(extra or {}) & set(self.meta)):
            raise InputError(f"{', '.join(taken)} is a name of {META}'s own", where=f"{self.path} extra")
        self.meta.update(extra or {})
        self._closed = False
        self._last: dict[str, int] = {}
        self._videos: dict[str, VideoWriter] = {}
        self._lock = contextlib.ExitStack()
        self.place, self._made = self._free_place(overwrite), False
        try:
            with told_when_full(self.path):
                self.path.absolute().parent.mkdir(parents=True, exist_ok=True)
                self._lock.enter_context(sole_writer(self.path))
                clean_leftovers(self.path)
                # Checked again under the lock.
                self.place = self._free_place(overwrite)
                self.place.mkdir()
                self._made = True
                # Unbuffered, so that each line reaches the operating system at once.
                self._journal = (self.place / JOURNAL).open("wb", buffering=0)
            self._write_meta()
            for name, info in self.streams.items():
                size, rate_ = (info.height, info.width), float(info.rate or rate)
                video = VideoWriter(self.place / f"{name}.mkv", size, rate_, info.dtype, info.full_scale)
                self._videos[name] = video
        except BaseException:
            self._abandon()
            raise

    def _free_place(self, overwrite: bool) -> Path:
        """Return the folder to write: the path itself, or a free name beside a recording that will be replaced."""
        if not self.path.exists() and not self.path.is_symlink():
            return self.path
        if not overwrite:
            raise InputError("exists already", where=self.path, remedy="choose another name or remove it first")
        # Only recordings may be replaced.
        layout.read_meta(self.path)
        return free_name(self.path, "unfinished")

    def _write_meta(self) -> None:
        """Write the present recording.json."""
        try:
            layout.write_json(self.place / META, self.meta)
        except (TypeError, ValueError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"JSON cannot hold it ({error})", where=f"{self.path} hardware or extra") from error

    @property
    def counts(self) -> dict[str, int]:
        """Frames written so far, by stream."""
        return {name: video.count for name, video in self._videos.items()}

    def write(
        self,
        stream: str,
        image: np.ndarray,
        *,
        monotonic_ns: int,
        utc_ns: int,
        dropped_before: int = 0,
        exposure: float | None = None,
        lit: bool | None = None,
    ) -> None:
        """Append one frame to a stream.

        Parameters
        ----------
        stream, image
            One of the writer's streams, and [H, W] of its size; uint8 up to 8 bit, uint16 above.
        monotonic_ns, utc_ns
            The frame's time by a rising monotonic clock, and in UTC since 1970, in nanoseconds.
        dropped_before
            Frames known to be lost since the one before.
        exposure, lit
            Exposure time in seconds, and whether the probe's laser was on; None where unknown.

        Raises
        ------
        InputError
            When the frame does not fit its stream, its clock does not rise, `lit` is something else, or the disk is
            full.
        """
        if self._closed:
            raise InputError("the recording is closed already", where=self.path)
        if stream not in self._videos:
            raise InputError(f"no stream {stream!r}", where=self.path, remedy=f"it has {', '.join(self._videos)}")
        video, here = self._videos[stream], f"{self.path} {stream}[{self._videos[stream].count}]"
        first = self._last.setdefault(f"{stream} first", monotonic_ns)
        if video.count and monotonic_ns <= self._last[stream]:
            what = f"the monotonic clock does not rise ({self._last[stream]} then {monotonic_ns} ns)"
            raise InputError(what, where=here)
        if dropped_before < 0:
            raise InputError(f"dropped_before must not be negative, is {dropped_before}", where=here)
        if exposure is not None and not 0 <= exposure < math.inf:
            raise InputError(f"exposure must not be negative, is {exposure}", where=here)
        lit = _switched(lit, here)
        times = (int(monotonic_ns), int(utc_ns), int(dropped_before))
        line = layout.journal_line(stream, video.count, *times, exposure, lit)
        video.write(image, (monotonic_ns - first) / 1e9)
        with told_when_full(self.path):
            # A nearly full disk may accept only part of a line.
            while line:
                line = line[self._journal.write(line) or 0 :]
        self._last[stream] = monotonic_ns

    def add(self, stream: str, frame: Frame) -> None:
        """Append a frame with known times to a stream: see `write`."""
        if frame.monotonic_ns is None or frame.utc_ns is None:
            what = f"utc_ns is {frame.utc_ns} and monotonic_ns is {frame.monotonic_ns}"
            remedy = "give frames with both times, or write(..., utc_ns=..., monotonic_ns=...)"
            raise InputError(what, where=f"frame {frame.name or frame.index}", remedy=remedy)
        times = {"monotonic_ns": frame.monotonic_ns, "utc_ns": frame.utc_ns, "dropped_before": frame.lost}
        self.write(stream, frame.image, **times, exposure=frame.exposure, lit=frame.lit)

    def close(self) -> None:
        """Finish the recording: the videos' indexes, frames.parquet, and finally `"finished": true`.

        Raises an InputError when the disk is full; the recording then stays readable, marked as unfinished.
        """
        if self._closed:
            return
        self._closed = True
        with self._lock, told_when_full(self.path):
            for name, video in self._videos.items():
                video.close()
                # Everything must be on disk before "finished" is written.
                sync(self.place / f"{name}.mkv")
            self._journal.close()
            write_table(self.place / FRAMES, layout.read_journal(self.place / JOURNAL))
            for name, count in self.counts.items():
                self.meta["streams"][name]["frames"] = count
            self.meta["finished"] = True
            self._write_meta()
            # Last, so that a complete list of frames always exists.
            (self.place / JOURNAL).unlink()
            if self.place != self.path:
                replace_folder(self.place, self.path)
                self.place = self.path
            sync(self.path.absolute().parent)

    def _abandon(self) -> str:
        """Close all files without errors, remove a folder without frames, and return a note on what is kept."""
        self._closed = True
        for video in self._videos.values():
            with contextlib.suppress(OSError, InputError):
                video.close()
        journal = getattr(self, "_journal", None)
        if journal is not None:
            with contextlib.suppress(OSError):
                journal.close()
        kept = [f"{count} {name} frames" for name, count in self.counts.items() if count]
        if self._made and not kept:
            shutil.rmtree(self.place, ignore_errors=True)
        self._lock.close()
        return f"{' and '.join(kept)} are kept in {self.place}, marked as unfinished" if kept else ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
            return
        if kept := self._abandon():
            error.add_note(kept)
