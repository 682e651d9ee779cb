"""All modes of a page together: they get what a watch publishes, and give their states."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tapetum.errors import InputError
from tapetum.live.events import Event
from tapetum.live.loop import Watch
from tapetum.live.modes.desk import Desk, DeskState
from tapetum.live.modes.exhibit import Exhibit, ExhibitState
from tapetum.live.modes.poll import Poll, PollState
from tapetum.live.modes.scan import Scan, ScanState
from tapetum.live.recorder import Recorder, RecordState
from tapetum.live.state import State

__all__ = ["Modes", "ModesState"]

CALIBRATION = "pointer.json"
_EVENTS = 1000
_EVERY = 0.04  # s between two messages to the pages


@dataclass(frozen=True)
class ModesState:
    """How the modes of a page stand; the socket sends it as `{"type": "modes", ...}`.

    Parameters
    ----------
    exhibit, vote, guard, scan, record
        Each mode.
    hands
        How many simulated hands can be led by `POST /api/hand`.
    """

    exhibit: ExhibitState = field(default_factory=ExhibitState)
    vote: PollState = field(default_factory=PollState)
    guard: DeskState = field(default_factory=DeskState)
    scan: ScanState = field(default_factory=ScanState)
    record: RecordState = field(default_factory=RecordState)
    hands: int = 0

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)


class Modes:
    """The modes of a watch; a `Listener` that hears every alert.

    Parameters
    ----------
    watch
        The watch. It is listened to from now on.
    folder
        Where recordings, votes and the pointer's calibration go; None: they end with the server.
    hands
        How many simulated hands can be led.

    Raises
    ------
    InputError
        When the folder cannot be used, or holds a calibration that cannot be read.
    """

    name = "page"
    hears_all = True

    def __init__(self, watch: Watch, folder: Path | None = None, hands: int = 0) -> None:
        if folder is not None:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"cannot be made ({error.strerror})", where=folder, remedy="name another") from error
        self.watch, self.hands = watch, hands
        self.exhibit = Exhibit(None if folder is None else folder / CALIBRATION)
        self.poll, self.desk = Poll(folder), Desk(watch.guard, watch.log)
        self.scan, self.recorder = Scan(), Recorder(folder)
        self._lock = threading.Lock()
        self._events: list[Event] = []
        self._text = ""
        self._made = 0.0
        watch.acquisition.taps.append(self.recorder.offer)
        watch.listeners.append(self)

    def event(self, event: Event) -> None:
        """Take an event; some come from the thread that reads."""
        with self._lock:
            if len(self._events) < _EVENTS:
                self._events.append(event)
        self.desk.event(event)

    def state(self, state: State) -> None:
        """Take a state."""
        with self._lock:
            events, self._events = self._events, []
        self.exhibit.update(state)
        self.poll.update(state, events)
        self.desk.update(state)
        self.scan.update(state, self.watch.shown)

    def close(self) -> None:
        """End: what is recorded is finished."""
        self.recorder.stop()
        self.poll.end()
        self.scan.close()

    def now(self) -> ModesState:
        """Return how all stand."""
        return ModesState(
            self.exhibit.state(),
            self.poll.state(),
            self.desk.state(),
            self.scan.state(),
            self.recorder.state,
            self.hands,
        )

    def text(self) -> str:
        """Return the message that the socket sends: made for all clients at once, and the same while nothing is new."""
        with self._lock:
            now = time.monotonic()
            if now - self._made >= _EVERY:
                self._made = now
                made = json.dumps({"type": "modes", **self.now().as_json()})
                self._text = self._text if made == self._text else made
            return self._text
