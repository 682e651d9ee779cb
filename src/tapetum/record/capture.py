"""Records from real sources: each is read in a thread of its own, and one hand writes."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from tapetum.errors import InputError
from tapetum.interrupts import interruptible
from tapetum.progress import Progress, quiet
from tapetum.record.live_sources import Shot, Source
from tapetum.record.writer import RecordingWriter

__all__ = ["Captured", "capture"]

WAITING = 24  # frames of a stream that may wait to be written
PATIENCE = 5.0  # s for a camera's last read to come back
IDLE = 0.002  # s


@dataclass(frozen=True)
class Captured:
    """How one stream of a recording went: frames, frames known to be lost, and why it ended before its time."""

    frames: int
    lost: int
    fault: InputError | None


class _Reader:
    """Reads one source in a thread."""

    def __init__(self, source: Source, seconds: float | None, stop: threading.Event) -> None:
        self.source, self.seconds, self.stop = source, seconds, stop
        self.waiting: queue.Queue[Shot] = queue.Queue(WAITING)
        self.fault: InputError | None = None
        self.missed = 0  # frames that found no room since the last that did
        self.lost = 0
        self.done = threading.Event()
        self.ended = threading.Event()  # by what it gave, while the others go on
        self.thread = threading.Thread(target=self._run, daemon=True)

    def start(self, monotonic_ns: int, utc_ns: int) -> None:
        self.begin = (monotonic_ns, utc_ns)
        self.thread.start()

    def _run(self) -> None:
        try:
            for shot in self.source.shots(*self.begin):
                late = self.seconds is not None and shot.monotonic_ns - self.begin[0] >= self.seconds * 1e9
                if self._over() or late or not self._offer(shot):
                    break
        except InputError as error:
            if not self._over():
                self.fault = error
        except Exception as error:
            # A driver may fail in any way; what was recorded until then must be kept.
            self.fault = InputError(f"cannot be read any more ({error})", where=self.source.name)
        finally:
            self.done.set()
            # Here and nowhere else: no other thread may close a camera while this one reads it.
            with contextlib.suppress(Exception):
                self.source.close()

    def _over(self) -> bool:
        return self.stop.is_set() or self.ended.is_set()

    def end(self, fault: InputError) -> None:
        """End this stream alone, for what it gave."""
        self.fault = self.fault or fault
        self.ended.set()

    def _offer(self, shot: Shot) -> bool:
        """Queue a frame; a live one is lost where there is no room. Return False when it is time to stop."""
        shot = replace(shot, dropped_before=shot.dropped_before + self.missed)
        while not self._over():
            try:
                self.waiting.put(shot, timeout=0 if self.source.live else 0.1)
            except queue.Full:
                if self.source.live:
                    self.missed += 1
                    return True
                continue
            self.lost += shot.dropped_before
            self.missed = 0
            return True
        return False


def capture(
    sources: Mapping[str, Source],
    out: str | os.PathLike[str],
    *,
    seconds: float | None = None,
    progress: Progress = quiet,
    overwrite: bool = False,
) -> dict[str, Captured]:
    """Record from several real sources at the same time, until all have ended, `seconds` are over, or Ctrl-C.

    A source that fails ends its own stream; the others go on, and everything is kept. All times count from one start,
    by one clock.

    Parameters
    ----------
    sources
        What to record, by the stream's name (`probe`, `target`).
    out
        The recording's folder, by custom `NAME.rec`.
    seconds
        Length; None records until the sources end or Ctrl-C is pressed.
    progress
        Shows the frames.
    overwrite
        Whether a recording at `out` may be replaced.

    Returns
    -------
    dict
        How each stream went.

    Raises
    ------
    InputError
        When the disk is full, something stands at `out`, or not one source gave a frame.
    """
    stop = threading.Event()
    readers = {name: _Reader(source, seconds, stop) for name, source in sources.items()}
    monotonic, utc = time.monotonic_ns(), time.time_ns()
    rates = [source.info.rate for source in sources.values() if source.info.rate]
    counts = dict.fromkeys(sources, 0)
    try:
        with RecordingWriter(
            Path(out),
            streams={name: source.info for name, source in sources.items()},
            rate=float(rates[0]) if rates else 15.0,
            hardware={name: source.hardware for name, source in sources.items()},
            start_utc_ns=utc,
            overwrite=overwrite,
        ) as writer:
            with interruptible(stop):
                for reader in readers.values():
                    reader.start(monotonic, utc)
                for name, shot in progress(_arriving(readers, stop), "recording"):
                    if (fault := _unfit(sources[name], shot)) is not None:
                        readers[name].end(fault)
                        continue
                    writer.write(
                        name,
                        shot.image,
                        monotonic_ns=shot.monotonic_ns,
                        utc_ns=shot.utc_ns,
                        dropped_before=shot.dropped_before,
                    )
                    counts[name] += 1
            if not any(counts.values()):
                faults = [reader.fault for reader in readers.values() if reader.fault]
                raise faults[0] if faults else InputError("nothing was recorded", where=out, remedy="record longer")
    finally:
        stop.set()
        for reader in readers.values():
            if reader.thread.ident:
                # A camera whose last read never comes back stays open: its thread alone may close it.
                reader.thread.join(PATIENCE)
            else:
                reader.source.close()
    return {name: Captured(counts[name], one.lost + one.missed, one.fault) for name, one in readers.items()}


def _arriving(readers: Mapping[str, _Reader], stop: threading.Event) -> Iterator[tuple[str, Shot]]:
    """Yield the frames of all readers as they come, until each is done and nothing waits."""
    while True:
        # Asked before the queues are looked into: what came before it was done is then still found.
        ended = all(reader.done.is_set() for reader in readers.values())
        came = False
        for name, reader in readers.items():
            with contextlib.suppress(queue.Empty):
                shot = reader.waiting.get_nowait()
                came = True
                if not reader.ended.is_set():
                    yield name, shot
        if not came:
            if ended or (stop.is_set() and all(reader.waiting.empty() for reader in readers.values())):
                return
            time.sleep(IDLE)


def _unfit(source: Source, shot: Shot) -> InputError | None:
    """Say why a frame does not belong to its source's stream; None where it does."""
    info = source.info
    if shot.image.shape == (info.height, info.width) and shot.image.dtype == info.dtype:
        return None
    given, wanted = f"{list(shot.image.shape)} {shot.image.dtype}", f"{[info.height, info.width]} {info.dtype}"
    return InputError(f"gives frames of {given} now, its first was {wanted}", where=source.name)
