"""Reading of sources in their own threads, so that a live one never waits for the consumer."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from tapetum.errors import InputError, of_type
from tapetum.record.layout import StreamInfo
from tapetum.record.source import Frame, Source

__all__ = ["PATIENCE", "WAITING", "Reader", "arriving", "taken"]

WAITING = 24  # frames of a stream that may wait
PATIENCE = 5.0  # s for a camera's last read to come back
IDLE = 0.002  # s


class Reader:
    """Reads one source in its own thread.

    Parameters
    ----------
    source, seconds
        What to read, and how long (None: to its end); the source is closed afterwards.
    stop
        Set from outside to end all readers.

    Attributes
    ----------
    info, fault
        Format of its frames, and the error that ended it early.
    lost, missed
        Frames lost among those taken, and frames that found no room since the last that did.
    """

    def __init__(self, source: Source, seconds: float | None, stop: threading.Event) -> None:
        self.source, self.seconds, self.stop = source, seconds, stop
        self.info = StreamInfo.of(source)
        self.waiting: queue.Queue[Frame] = queue.Queue(WAITING)
        self.fault: InputError | None = None
        self.lost = self.missed = 0
        self.done = threading.Event()
        self.ended = threading.Event()  # by what it gave, while the others go on
        self.thread = threading.Thread(target=self._run, daemon=True)

    def start(self, monotonic_ns: int, utc_ns: int) -> None:
        """Begin; stored frames are dated as if they were taken from now on."""
        self.begin = (monotonic_ns, utc_ns)
        self.thread.start()

    def _run(self) -> None:
        try:
            for frame in self._stamped():
                moment = (frame.monotonic_ns or 0) - self.begin[0]
                late = self.seconds is not None and moment >= self.seconds * 1e9
                if self._over() or late or not self._offer(frame):
                    break
        except InputError as error:
            if not self._over():
                self.fault = error
        except Exception as error:
            # Drivers fail in many ways; what was recorded until then must be kept.
            self.fault = InputError(f"cannot be read any more ({error})", where=self.source.name)
        finally:
            self.done.set()
            # Only this thread may close the camera that it reads.
            with contextlib.suppress(Exception):
                self.source.close()

    def _stamped(self) -> Iterator[Frame]:
        """Yield frames on the common clock of all streams; stored ones begin with the recording."""
        start, utc = self.begin
        last = -1
        for frame in self.source:
            if self.source.live:
                last = (time.monotonic_ns() if frame.monotonic_ns is None else frame.monotonic_ns) - start
            else:
                # Stamps of files may repeat; a recording's clock rises.
                last = max(last + 1, round(frame.time * 1e9))
            yield replace(frame, monotonic_ns=start + last, utc_ns=utc + last)

    def _over(self) -> bool:
        return self.stop.is_set() or self.ended.is_set()

    def end(self, fault: InputError) -> None:
        """End this stream alone because of a fault."""
        self.fault = self.fault or fault
        self.ended.set()

    def _offer(self, frame: Frame) -> bool:
        """Queue a frame, or drop a live one without room; return False when it is time to stop."""
        frame = replace(frame, lost=frame.lost + self.missed)
        while not self._over():
            try:
                self.waiting.put(frame, timeout=0 if self.source.live else 0.1)
            except queue.Full:
                if self.source.live:
                    self.missed += 1
                    return True
                continue
            self.lost += frame.lost
            self.missed = 0
            return True
        return False


def arriving(readers: Mapping[str, Reader], stop: threading.Event) -> Iterator[tuple[str, Frame]]:
    """Yield the frames of all readers as they arrive, until each is done and none is queued."""
    while True:
        # Read before the queues, so that frames queued before the end are still found.
        ended = all(reader.done.is_set() for reader in readers.values())
        came = False
        for name, reader in readers.items():
            with contextlib.suppress(queue.Empty):
                frame = reader.waiting.get_nowait()
                came = True
                if not reader.ended.is_set():
                    yield name, frame
        if not came:
            if ended or (stop.is_set() and all(reader.waiting.empty() for reader in readers.values())):
                return
            time.sleep(IDLE)


def taken(source: Source | Iterable[Frame], stop: threading.Event, seconds: float | None = None) -> Iterator[Frame]:
    """Yield frames for so long, or until `stop`; those that a live source drops are counted.

    Raises
    ------
    InputError
        When the source fails or what it gives is no frame, after the frames that came before.
    """
    if not isinstance(source, Source) or not source.live:
        for number, frame in enumerate(source):
            of_type(frame, Frame, f"source[{number}]", "give Frames: Frame(n, time, image) for an image of an array")
            if stop.is_set() or (seconds is not None and frame.time >= seconds):
                return
            yield frame
        return
    reader = Reader(source, seconds, stop)
    reader.start(time.monotonic_ns(), time.time_ns())
    try:
        for _, frame in arriving({source.name: reader}, stop):
            yield frame
    finally:
        reader.ended.set()
        reader.thread.join(PATIENCE)
    if reader.fault is not None:
        raise reader.fault
