"""What every receiver of a watch's messages has: a bounded queue and a thread of its own.

Handing over a message never waits. A slow or dead receiver loses its own messages, which are counted.
"""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Protocol

from tapetum.live.events import Event
from tapetum.live.state import State

__all__ = ["Counts", "Output", "Queued"]

_EVENTS = 1000
_IDLE = 1.0
_GRACE = 0.3  # s for a message under way to notice that its time is over


class Output(Protocol):
    """A receiver of events and states; none of its functions but `close` may wait."""

    name: str

    def event(self, event: Event) -> None:
        """Take an event."""
        ...

    def state(self, state: State) -> None:
        """Take the state after a frame."""
        ...

    def close(self) -> None:
        """End; what waits is sent, for some seconds at most."""
        ...


@dataclass(frozen=True)
class Counts:
    """Messages of an output.

    Parameters
    ----------
    sent, waiting
        Messages that were handed to the receiver, and those that wait.
    dropped
        Messages that were never tried, as the queue was full or the output was closed.
    failed
        Messages that were tried and could not be delivered.
    fault
        What the receiver answered last, or what is wrong with it; empty while all is well.
    """

    sent: int = 0
    waiting: int = 0
    dropped: int = 0
    failed: int = 0
    fault: str = ""


class Queued(ABC):
    """An output with a queue and a thread; a kind of output says how an event and a state are sent.

    Of a full queue the oldest message is dropped: what happens now matters more. States cannot push out events.

    Parameters
    ----------
    name
        For messages and the page; without passwords.
    events, states
        How many of each may wait. With `states` 1 only the newest one is kept, and a replaced one counts as no loss;
        with 0 none is taken.
    patience
        Seconds for which `close` waits for messages to be sent.
    """

    def __init__(self, name: str, *, events: int = _EVENTS, states: int = 0, patience: float = 2.0) -> None:
        self.name = name
        self._most = events, states
        self._events: deque[tuple[int, Event]] = deque()
        self._states: deque[tuple[int, State]] = deque()
        self._number = self._sent = self._dropped = self._failed = 0
        self._fault, self._patience = "", patience
        self._change = threading.Condition()
        self._until: float | None = None
        # Set once `close` waits: a pause between two trials then ends.
        self.closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"to {name}", daemon=True)

    def start(self) -> None:
        """Begin to send; called by `open_output`."""
        self._thread.start()

    def event(self, event: Event) -> None:
        """Take an event."""
        with self._change:
            if self._until is not None:
                return
            self._number += 1
            self._events.append((self._number, event))
            if len(self._events) > self._most[0]:
                self._events.popleft()
                self._dropped += 1
            self._change.notify()

    def state(self, state: State) -> None:
        """Take a state."""
        most = self._most[1]
        if not most:
            return
        with self._change:
            if self._until is not None:
                return
            self._number += 1
            self._states.append((self._number, state))
            if len(self._states) > most:
                self._states.popleft()
                self._dropped += most > 1
            self._change.notify()

    @property
    def counts(self) -> Counts:
        """What became of the messages so far."""
        with self._change:
            waiting = len(self._events) + len(self._states)
            return Counts(self._sent, waiting, self._dropped, self._failed, self._fault)

    def close(self) -> None:
        """End: what waits is sent for some seconds, what is left is dropped."""
        with self._change:
            if self._until is not None:
                return
            self._until = time.monotonic() + self._patience
            self._change.notify()
        self.closing.set()
        if self._thread.is_alive():
            self._thread.join(self._patience + _GRACE)
        with self._change:
            self._drop_all()

    def set_fault(self, fault: str) -> None:
        """Say what is wrong with the receiver, from any thread; empty when it is well again."""
        with self._change:
            self._fault = fault

    @property
    def hurried(self) -> bool:
        """Whether the time is over that `close` gives."""
        return self._until is not None and time.monotonic() > self._until

    @abstractmethod
    def send_event(self, event: Event) -> None:
        """Send an event; an exception says that it failed."""

    def send_state(self, state: State) -> None:
        """Send a state; an exception says that it failed."""
        del state

    def idle(self) -> None:
        """Do what is to do about every second while no message comes."""
        return

    def end(self) -> None:
        """Leave the receiver, after the last message."""
        return

    def _drop_all(self) -> None:
        self._dropped += len(self._events) + (len(self._states) if self._most[1] > 1 else 0)
        self._events.clear()
        self._states.clear()

    def _next(self) -> Event | State | None:
        """The oldest message; None when none came for a while, or at the end."""
        with self._change:
            if not self._events and not self._states and self._until is None:
                self._change.wait(_IDLE)
            if self.hurried:
                self._drop_all()
            queues = [queue for queue in (self._events, self._states) if queue]
            return min(queues, key=lambda queue: queue[0][0]).popleft()[1] if queues else None

    def _run(self) -> None:
        while True:
            message = self._next()
            try:
                if isinstance(message, Event):
                    self.send_event(message)
                elif message is not None:
                    self.send_state(message)
                elif self._until is None:
                    self.idle()
                else:
                    break
            except Exception as error:
                # Receivers fail in many ways; the next message may find this one well again.
                with self._change:
                    self._failed += message is not None
                    self._fault = str(error) or type(error).__name__
            else:
                with self._change:
                    self._sent += message is not None
                    if message is not None:
                        self._fault = ""
        try:
            self.end()
        except Exception as error:
            self.set_fault(str(error) or type(error).__name__)
