"""Reading of a source for a watch, in a thread of its own that never waits for the steps after it.

Frames get times on the watch's clock. A camera that was lost is opened again until it returns; both are reported.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

from tapetum.errors import one_of
from tapetum.record.source import Frame, Source

__all__ = ["MODES", "Acquisition"]

MODES = ("newest", "all")
_QUEUE = 24
_RETRY = (0.5, 5.0)  # s between two trials to open a camera again: at first, and at most
_PATIENCE = 2.0
_LOOK = 0.1
_SLIP = 0.25  # s that a stored frame may come late before the clock waits for it
_GAP = 0.05  # s between two rounds of a source that repeats

Told = Callable[[str, str], None]


class Acquisition:
    """Reads a source in a thread and hands its frames out, each a copy.

    Parameters
    ----------
    opens
        Opens the source; called again when a camera was lost.
    mode
        "newest": of the frames that wait, only the newest lit and the newest dark one are kept (a lit frame is compared
        with a dark one); stored frames come at the rate they were recorded. "all": no stored frame is dropped, reading
        waits instead; of a camera's frames a few wait and the rest are lost.
    told
        Called with "lost", "returned" or "ended", and a reason, from the thread that reads.
    repeat
        Whether a stored source begins again at its end.

    Attributes
    ----------
    arrived, lost, refused
        Frames read; frames lost by the source or because there was no time for them; frames whose time was not after
        that of the frame before.
    taps
        Functions that get every frame that is not refused, called from the thread that reads: none of them may wait.
    marks
        Of what the source shows (`tapetum.record.marks`), once it is open.
    connected, ended
        Whether the source gives frames, and whether it is at its end.
    """

    def __init__(
        self, opens: Callable[[], Source], mode: str = "newest", told: Told | None = None, *, repeat: bool = False
    ) -> None:
        self._opens, self.mode = opens, one_of(mode, MODES, "mode")
        self.repeat = repeat
        self._told: Told = told or (lambda what, why: None)
        self.taps: list[Callable[[Frame], None]] = []
        self.arrived = self.lost = self.refused = 0
        self.connected = self.ended = False
        self._waiting: deque[Frame] = deque()
        self._change = threading.Condition()
        self._over = threading.Event()
        self._source: Source | None = None
        self.marks: frozenset[str] = frozenset()
        self._thread = threading.Thread(target=self._run, name="acquire", daemon=True)

    def start(self) -> None:
        """Open the source and begin; InputError where it cannot be opened at first."""
        self._source = self._opens()
        self.marks = getattr(self._source, "marks", frozenset())
        self._round = 0.0
        self._begin, self._utc, self._last = time.monotonic_ns(), time.time_ns(), -1.0
        self._thread.start()

    def close(self) -> None:
        """End; wait a little for a read under way."""
        self._over.set()
        with self._change:
            self._change.notify_all()
        # The drawn room waits for its next frame until it is closed; a camera is closed by the thread that reads it.
        self._thread.join(_PATIENCE)

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames until the source's end or `close`."""
        return self.frames(threading.Event())

    def frames(self, over: threading.Event) -> Iterator[Frame]:
        """Yield frames until the source's end, `close`, or until nobody wants more: then none is taken."""
        while True:
            with self._change:
                while not self._waiting or over.is_set():
                    if over.is_set() or self._over.is_set() or self.ended:
                        return
                    self._change.wait(_LOOK)
                frame = self._waiting.popleft()
                self._change.notify_all()
            yield frame

    def _run(self) -> None:
        source, pause = self._source, _RETRY[0]
        while not self._over.is_set():
            why = ""
            try:
                if source is None:
                    source = self._opens()
                for frame in self._paced(source):
                    if not self.connected:
                        self.connected, pause = True, _RETRY[0]
                        if self.arrived:
                            self._told("returned", source.name)
                    self._offer(frame, source.live)
                    if self._over.is_set():
                        break
            except Exception as error:
                # Drivers fail in many ways; the watch goes on.
                why = str(error) or type(error).__name__
            live = source is None or source.live
            if source is not None:
                with suppress(Exception):
                    source.close()
            if self._over.is_set():
                break
            again = self.repeat and not live and not why
            if not again and (self.connected or (why and not live)):
                self._told("lost" if live or why else "ended", why or ("it gives no more frames" if live else ""))
            self.connected &= again
            if not live and not again:
                break
            source = None
            if again:
                # The next round's first frame comes after this one's last.
                self._round = self._last + _GAP
                continue
            self._over.wait(pause)
            pause = min(2 * pause, _RETRY[1])
        with self._change:
            self.ended, self.connected = True, False
            self._change.notify_all()

    def _paced(self, source: Source) -> Iterator[Frame]:
        """Yield frames on the watch's clock: seconds since its start, monotonic and UTC time."""
        for frame in source:
            if source.live:
                moment = time.monotonic_ns() if frame.monotonic_ns is None else frame.monotonic_ns
                # A camera's clock of its own kind says nothing of this machine's.
                if not 0 <= moment - self._begin <= time.monotonic_ns() - self._begin:
                    moment = time.monotonic_ns()
            else:
                moment = self._begin + round((self._round + frame.time) * 1e9)
                if self.mode == "newest":
                    early = (moment - time.monotonic_ns()) / 1e9
                    if self._over.wait(max(0.0, early)):
                        return
                    if early < -_SLIP:
                        # Frames that are read or computed slower than they were taken delay all that follow.
                        self._round -= early
                        moment -= round(early * 1e9)
            since = moment - self._begin
            # Of a recording that is read faster than it was filmed, delays count from the reading.
            taken = time.monotonic_ns() if self.mode == "all" and not source.live else moment
            own = frame.time
            yield replace(frame, time=since / 1e9, monotonic_ns=taken, utc_ns=self._utc + since, camera_time=own)

    def _offer(self, frame: Frame, live: bool) -> None:
        self.arrived += 1
        self.lost += frame.lost
        if frame.time <= self._last:
            self.refused += 1
            return
        self._last = frame.time
        # A driver may use its buffer again.
        frame = replace(frame, index=self.arrived - 1, image=frame.image.copy())
        for tap in self.taps:
            tap(frame)
        with self._change:
            if self.mode == "newest":
                kept = [one for one in self._waiting if one.lit != frame.lit]
                self.lost += len(self._waiting) - len(kept)
                self._waiting = deque([*kept, frame])
            else:
                while len(self._waiting) >= _QUEUE and not live and not self._over.is_set():
                    self._change.wait(_LOOK)
                if len(self._waiting) >= _QUEUE:
                    self.lost += 1
                else:
                    self._waiting.append(frame)
            self._change.notify_all()
