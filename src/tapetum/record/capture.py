"""Recording from real sources: each is read in its own thread, and one thread writes."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from tapetum.errors import InputError
from tapetum.interrupts import interruptible
from tapetum.progress import Progress, quiet
from tapetum.record.reader import PATIENCE, Reader, arriving
from tapetum.record.source import Frame, Source
from tapetum.record.writer import RecordingWriter

__all__ = ["Captured", "capture"]


@dataclass(frozen=True)
class Captured:
    """Result of one stream: its frames, frames known to be lost, and the error that ended it early."""

    frames: int
    lost: int
    fault: InputError | None


def capture(
    sources: Mapping[str, Source],
    out: str | os.PathLike[str],
    *,
    seconds: float | None = None,
    progress: Progress = quiet,
    overwrite: bool = False,
    extra: Mapping[str, Any] | None = None,
    begun: Callable[[], None] | None = None,
) -> dict[str, Captured]:
    """Record from several sources at once, until all have ended, `seconds` are over, or Ctrl-C.

    A source that fails ends its own stream; the others continue, and everything is kept. All times count from one start
    by one clock. Returns the result of each stream.

    Parameters
    ----------
    sources, out
        Sources by stream name (`probe`, `target`), and the recording's folder, usually `NAME.rec`.
    seconds
        Length; None records until the sources end or Ctrl-C is pressed.
    progress, overwrite
        Shown over the frames; and whether a recording at `out` may be replaced.
    extra, begun
        Further content of `recording.json`; and what to call once the streams run.

    Raises
    ------
    InputError
        When the disk is full, something exists at `out`, or no source gave a frame.
    """
    stop = threading.Event()
    try:
        readers = {name: Reader(source, seconds, stop) for name, source in sources.items()}
    except InputError:
        # One gave no first frame; no thread reads the others yet.
        for source in sources.values():
            source.close()
        raise
    monotonic, utc = time.monotonic_ns(), time.time_ns()
    rates = [source.rate for source in sources.values() if source.rate]
    counts = dict.fromkeys(sources, 0)
    try:
        with RecordingWriter(
            out,
            streams={name: reader.info for name, reader in readers.items()},
            rate=float(rates[0]) if rates else 15.0,
            hardware={name: source.hardware for name, source in sources.items()},
            extra=dict(extra or {}),
            start_utc_ns=utc,
            overwrite=overwrite,
        ) as writer:
            with interruptible(stop):
                for reader in readers.values():
                    reader.start(monotonic, utc)
                if begun is not None:
                    begun()
                for name, frame in progress(arriving(readers, stop), "recording"):
                    if (fault := _unfit(readers[name], frame)) is not None:
                        readers[name].end(fault)
                        continue
                    writer.add(name, frame)
                    counts[name] += 1
            if not any(counts.values()):
                faults = [reader.fault for reader in readers.values() if reader.fault]
                raise faults[0] if faults else InputError("nothing was recorded", where=out, remedy="record longer")
    finally:
        stop.set()
        for reader in readers.values():
            if reader.thread.ident:
                # A camera whose last read never returns stays open: only its thread may close it.
                reader.thread.join(PATIENCE)
            else:
                reader.source.close()
    return {name: Captured(counts[name], one.lost + one.missed, one.fault) for name, one in readers.items()}


def _unfit(reader: Reader, frame: Frame) -> InputError | None:
    """Return the error of a frame whose format is not its stream's, else None."""
    info, (height, width) = reader.info, frame.image.shape
    given = (height, width, frame.image.dtype, frame.full_scale)
    if given == (info.height, info.width, info.dtype, info.full_scale):
        return None
    now = f"{frame.name or 'a frame'} is {width} x {height} px of {frame.image.dtype}, full scale {frame.full_scale}"
    first = f"{info.width} x {info.height} px of {info.dtype}, {info.full_scale}"
    remedy = "give frames of one size and depth"
    return InputError(f"{now}; the first was {first}", where=reader.source.name, remedy=remedy)
