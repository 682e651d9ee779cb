"""A guard's desk: the rules as they are now, and the alerts, until somebody acknowledges them."""

from __future__ import annotations

import datetime as dt
import sqlite3
import threading
from dataclasses import dataclass

from tapetum.errors import InputError
from tapetum.live.events import Event
from tapetum.live.guard import Guard
from tapetum.live.log import Log
from tapetum.live.rules import DAYS, Quiet, Rule
from tapetum.live.state import State

__all__ = ["AlertSeen", "Desk", "DeskState", "RuleSeen"]

_MOST = 50
_LOOK_NS = 10**9  # between two looks at the quiet hours


@dataclass(frozen=True)
class RuleSeen:
    """A rule: its name, its conditions and quiet hours in words, whether it is quiet now, and who gets its alerts."""

    name: str
    when: str
    hours: tuple[str, ...]
    quiet_now: bool
    hold: float
    cooldown: float
    tell: tuple[str, ...]


@dataclass(frozen=True)
class AlertSeen:
    """An alert: number of its event, when it came, its rule and camera, and whether it holds still.

    `acknowledged_utc_ns` is None until somebody acknowledges it.
    """

    number: int
    utc_ns: int
    rule: str
    camera: str
    holds: bool
    picture: bool
    acknowledged_utc_ns: int | None = None


@dataclass(frozen=True)
class DeskState:
    """Rules and alerts, newest first; `waiting` counts those that nobody acknowledged."""

    rules: tuple[RuleSeen, ...] = ()
    time_zone: str = "UTC"
    local: str = ""
    alerts: tuple[AlertSeen, ...] = ()
    waiting: int = 0
    fault: str = ""


class Desk:
    """The desk of a watch with a guard, or with none; its functions may be called from any thread.

    Parameters
    ----------
    guard
        Whose rules are shown.
    log
        Of the watch's events.
    """

    def __init__(self, guard: Guard | None, log: Log) -> None:
        self.guard, self.log = guard, log
        self._lock = threading.Lock()
        self._holding: frozenset[tuple[str, str]] = frozenset()
        self._rules: tuple[RuleSeen, ...] = ()
        self._looked = -_LOOK_NS
        self._local = self._fault = ""
        self._alerts: list[AlertSeen] = []
        self._waiting = 0
        self._read()

    def event(self, event: Event) -> None:
        """Take an event of the watch."""
        if event.kind == "alert":
            self._read()

    def update(self, state: State) -> None:
        """Take a state of the watch, from the thread that runs the guard."""
        if self.guard is None:
            return
        holding = frozenset(self.guard.holding)
        with self._lock:
            self._holding = holding
            if not 0 <= state.utc_ns - self._looked < _LOOK_NS:
                self._looked = state.utc_ns
                rules = self.guard.rules
                self._local = f"{dt.datetime.fromtimestamp(state.utc_ns / 1e9, rules.zone):%a %H:%M}"
                self._rules = tuple(
                    RuleSeen(
                        one.name,
                        _words(one),
                        tuple(_hours(quiet) for quiet in (rules.quiet if one.quiet is None else one.quiet)),
                        rules.is_quiet(one, state.utc_ns),
                        one.hold,
                        one.cooldown,
                        one.tell,
                    )
                    for one in rules.rules
                )

    def acknowledge(self, number: int | None, utc_ns: int) -> None:
        """Acknowledge an alert by the number of its event, or all.

        Raises
        ------
        InputError
            When there is no such alert, or the log cannot be written.
        """
        try:
            done = self.log.acknowledge(number, utc_ns)
        except sqlite3.Error as error:
            raise InputError(f"the log cannot be written ({error})", where="alert", remedy="free the disk") from error
        if number is not None and not done:
            raise InputError(
                f"there is no alert {number}", where="number", remedy="give the number of an alert's event"
            )
        self._read()

    def state(self) -> DeskState:
        """Return the rules and alerts."""
        with self._lock:
            alerts = tuple(
                AlertSeen(
                    one.number,
                    one.utc_ns,
                    one.rule,
                    one.camera,
                    (one.rule, one.camera) in self._holding,
                    one.picture,
                    one.acknowledged_utc_ns,
                )
                for one in self._alerts
            )
            zone = "UTC" if self.guard is None else self.guard.rules.time_zone
            return DeskState(self._rules, zone, self._local, alerts, self._waiting, self._fault)

    def _read(self) -> None:
        try:
            found, waiting = self.log.alerts(_MOST)
        except sqlite3.Error as error:
            self._fault = f"the log cannot be read ({error})"
            return
        alerts = [
            AlertSeen(one["number"], one["utc_ns"], one["detail"], one["id"], False, one["picture"], done)
            for one, done in found
        ]
        with self._lock:
            self._alerts, self._waiting, self._fault = alerts, waiting, ""


def _words(rule: Rule) -> str:
    """The conditions of a rule as a sentence's end."""
    when = rule.when
    said = []
    if when.device:
        said.append(f"it is taken for {' or '.join(when.device)}")
    if when.not_device:
        said.append(f"it is taken for something else than {', '.join(when.not_device)}")
    if when.imaging is not None:
        said.append("it images" if when.imaging else "it does not image")
    if when.shutter is not None:
        said.append("its shutter opens")
    if when.looks_at is not None:
        said.append(f"it looks at {when.looks_at}")
    return "a camera is here" + "".join(f", {one}" for one in said)


def _hours(quiet: Quiet) -> str:
    days = quiet.days
    if len(days) == len(DAYS):
        named = "every day"
    else:
        places = [DAYS.index(one) for one in days]
        row = len(places) > 2 and places == list(range(min(places), max(places) + 1))
        named = f"{DAYS[min(places)]} to {DAYS[max(places)]}" if row else ", ".join(days)
    return f"{quiet.from_:%H:%M} to {quiet.to:%H:%M}, {named}"
