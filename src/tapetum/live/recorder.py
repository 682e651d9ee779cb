"""Recording of what a watch reads, by a button on its page; the thread that writes never delays the watch."""

from __future__ import annotations

import datetime as dt
import shutil
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from tapetum.errors import InputError
from tapetum.record.layout import StreamInfo
from tapetum.record.source import Frame
from tapetum.record.writer import RecordingWriter

__all__ = ["RecordState", "Recorder"]

_QUEUE_BYTES = 256 << 20
_LEAST_FREE = 200 << 20  # bytes that a recording leaves on the disk
_LOOK = 0.2
_CHECK_EVERY = 2.0
_PATIENCE = 10.0


@dataclass(frozen=True)
class RecordState:
    """How a recording stands.

    Parameters
    ----------
    possible
        Whether there is a folder for recordings.
    running, name, frames, lost, seconds
        Of the present or latest recording; `lost` counts frames that could not be written in time or did not fit.
    fault
        Why it ended by itself.
    """

    possible: bool = False
    running: bool = False
    name: str = ""
    frames: int = 0
    lost: int = 0
    seconds: float = 0.0
    fault: str = ""


class Recorder:
    """Writes the frames it is handed into recordings in a folder.

    Parameters
    ----------
    folder
        Where recordings go, as `watch-DATE-TIME.rec`; None: there are none.
    least_free
        Bytes of the disk below which a recording ends by itself.
    """

    def __init__(self, folder: Path | None = None, *, least_free: int = _LEAST_FREE) -> None:
        self.folder, self.least_free = folder, least_free
        self._change = threading.Condition()
        self._waiting: deque[Frame] = deque()
        self._bytes = 0
        self._running = False
        self._thread: threading.Thread | None = None
        self._state = RecordState(folder is not None)
        self._lost = 0

    @property
    def state(self) -> RecordState:
        """How the recording stands."""
        return self._state

    def start(self) -> str:
        """Begin a recording with the next frame; return its name.

        Raises
        ------
        InputError
            Without a folder, while one runs, and when the disk is nearly full.
        """
        if self.folder is None:
            raise InputError("there is no folder for recordings", where="record", remedy="serve with --folder")
        with self._change:
            if self._running or (self._thread is not None and self._thread.is_alive()):
                raise InputError("a recording is under way", where="record", remedy="stop it first")
            self._check_space()
            name = f"watch-{dt.datetime.now(dt.UTC):%Y%m%d-%H%M%S-%f}.rec"
            self._waiting.clear()
            self._bytes = self._lost = 0
            self._running = True
            self._state = RecordState(True, True, name)
            self._thread = threading.Thread(target=self._run, args=(name,), name="record", daemon=True)
            self._thread.start()
        return name

    def stop(self) -> None:
        """End the recording; what waits is written."""
        with self._change:
            self._running = False
            self._change.notify_all()
            thread = self._thread
        if thread is not None:
            thread.join(_PATIENCE)

    def offer(self, frame: Frame) -> None:
        """Take a frame of the source, at once; one that would fill the memory is left out and counted."""
        if not self._running:
            return
        with self._change:
            if self._bytes + frame.image.nbytes > _QUEUE_BYTES:
                self._lost += 1
                return
            self._waiting.append(frame)
            self._bytes += frame.image.nbytes
            self._change.notify_all()

    def _next(self) -> Frame | None:
        with self._change:
            while not self._waiting:
                if not self._running:
                    return None
                self._change.wait(_LOOK)
            frame = self._waiting.popleft()
            self._bytes -= frame.image.nbytes
            return frame

    def _run(self, name: str) -> None:
        assert self.folder is not None
        fault = ""
        try:
            first = self._next()
            if first is not None:
                self._write(self.folder / name, first)
        except (InputError, OSError) as error:
            fault = "; ".join([str(error), *getattr(error, "__notes__", [])])
        with self._change:
            self._running = False
            self._waiting.clear()
            self._bytes = 0
        self._state = RecordState(True, False, name, self._state.frames, self._lost, self._state.seconds, fault)

    def _write(self, path: Path, first: Frame) -> None:
        height, width = first.image.shape
        scale = int(first.full_scale or 255)
        info = StreamInfo(height, width, scale.bit_length(), scale)
        begun = checked = time.monotonic()
        # Frames that the source lost before are stated with the next one.
        dropped = 0
        with RecordingWriter(path, streams={"probe": info}, start_utc_ns=first.utc_ns or time.time_ns()) as writer:
            frame: Frame | None = first
            while frame is not None:
                now = time.monotonic()
                if now - checked > _CHECK_EVERY:
                    checked = now
                    self._check_space()
                if frame.image.shape != first.image.shape or frame.image.dtype != info.dtype:
                    self._lost += 1
                    dropped += 1
                else:
                    writer.write(
                        "probe",
                        frame.image,
                        monotonic_ns=frame.monotonic_ns or time.monotonic_ns(),
                        utc_ns=frame.utc_ns or time.time_ns(),
                        dropped_before=(frame.lost if frame is not first else 0) + dropped,
                        exposure=frame.exposure,
                        lit=frame.lit,
                    )
                    dropped = 0
                count = writer.counts["probe"]
                self._state = RecordState(True, self._running, path.name, count, self._lost, now - begun)
                frame = self._next()

    def _check_space(self) -> None:
        assert self.folder is not None
        try:
            free = shutil.disk_usage(self.folder).free
        except OSError as error:
            raise InputError(f"cannot be used ({error.strerror})", where=self.folder) from error
        if free < self.least_free:
            what = f"the disk has {free >> 20} MB left"
            raise InputError(what, where=self.folder, remedy=f"free it; recordings leave {self.least_free >> 20} MB")
