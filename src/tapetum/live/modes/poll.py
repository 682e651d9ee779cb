"""A vote on the page: one at a time, its tally as it grows, and its replay."""

from __future__ import annotations

import datetime as dt
import threading
import time
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tapetum.errors import InputError
from tapetum.live.events import Event
from tapetum.live.pointer import Calibration
from tapetum.live.state import State
from tapetum.live.vote import Ballot, Tally, Voice, VoteFile, Votes, replay

__all__ = ["Pending", "Poll", "PollState"]

_MOST = 10_000  # voices that are kept for the replay on the page; a file has all


@dataclass(frozen=True)
class Pending:
    """A camera that is about to give its voice: for which zone, and the share of the dwell that has passed."""

    camera: str
    zone: str
    share: float


@dataclass(frozen=True)
class PollState:
    """How a vote stands.

    Parameters
    ----------
    ballot, is_open
        What is voted on, and whether it still is; without a vote None and False.
    voices
        By zone.
    given
        The zone that each camera gave its voice to.
    pending
        Cameras that are about to give theirs.
    begun_utc_ns, changes
        When it began, and how many voices were given, changed or taken back.
    file, fault
        Name of the file that keeps it, in the page's folder; and why it could not.
    """

    ballot: Ballot | None = None
    is_open: bool = False
    voices: dict[str, int] | None = None
    given: dict[str, str] | None = None
    pending: tuple[Pending, ...] = ()
    begun_utc_ns: int = 0
    changes: int = 0
    file: str = ""
    fault: str = ""


class Poll:
    """The vote of a page; its functions may be called from any thread.

    Parameters
    ----------
    folder
        Where votes are kept, one file each; None: nowhere.
    """

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = folder
        self._lock = threading.Lock()
        self._votes: Votes | None = None
        self._file: VoteFile | None = None
        self._open = False
        self._name = self._fault = ""
        self._begun = self._changes = 0
        self._told: deque[Voice] = deque(maxlen=_MOST)

    def begin(self, ballot: Ballot, calibration: Calibration | None = None) -> None:
        """Begin a vote; the one before ends.

        Raises
        ------
        InputError
            When the zones are those of a screen and there is no calibration.
        """
        votes = Votes(ballot, calibration)
        with self._lock:
            self._close()
            self._votes, self._open, self._fault, self._name = votes, True, "", ""
            self._begun, self._changes = time.time_ns(), 0
            self._told.clear()
            if self.folder is not None:
                moment = dt.datetime.fromtimestamp(self._begun / 1e9, dt.UTC)
                path = self.folder / f"vote-{moment:%Y%m%d-%H%M%S-%f}.jsonl"
                try:
                    self._file = VoteFile(path, ballot, self._begun)
                    self._name = path.name
                except (InputError, OSError) as error:
                    self._fault = f"the vote is not kept ({error})"

    def end(self) -> None:
        """Take no more voices; the tally stays until the next vote."""
        with self._lock:
            self._close()

    def update(self, state: State, events: Iterable[Event]) -> None:
        """Take a state of the watch, and the events since the one before."""
        with self._lock:
            if self._votes is None or not self._open:
                return
            told = self._votes.update(state, events)
            self._told.extend(told)
            self._changes += len(told)
            if told and self._file is not None:
                try:
                    self._file.add(told)
                except OSError as error:
                    # What was written stays; a full disk must not stop the vote.
                    self._fault = f"the vote is kept no longer ({error.strerror})"
                    self._file = None

    def state(self) -> PollState:
        """Return how it stands."""
        with self._lock:
            if self._votes is None:
                return PollState()
            tally = self._votes.tally()
            return PollState(
                self._votes.ballot,
                self._open,
                tally.voices,
                {camera: one.zone for camera, one in self._votes.voices.items()},
                tuple(Pending(*one) for one in tally.pending) if self._open else (),
                self._begun,
                self._changes,
                self._name,
                self._fault,
            )

    def replayed(self) -> list[Tally]:
        """Return the tally after each voice of the latest vote."""
        with self._lock:
            votes, told = self._votes, tuple(self._told)
        return [] if votes is None else list(replay(votes.ballot, told))

    def _close(self) -> None:
        self._open = False
        if self._file is not None:
            self._file.close()
            self._file = None
