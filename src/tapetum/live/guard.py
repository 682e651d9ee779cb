"""A guard: applies rules to the states and events of a watch, and raises alerts."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

from tapetum.live.events import Event
from tapetum.live.rules import Rule, Rules
from tapetum.live.state import CameraState, State

__all__ = ["Alert", "Guard"]


@dataclass(frozen=True)
class Alert:
    """A rule that came true.

    Parameters
    ----------
    utc_ns
        When.
    rule
        Its name.
    camera
        The camera.
    tell
        Names of the outputs that get the alert; empty: all.
    """

    utc_ns: int
    rule: str
    camera: CameraState
    tell: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return asdict(self)

    def as_event(self) -> Event:
        """Return the alert as an event of its camera."""
        return Event(self.camera.id, "update", "alert", self.utc_ns, self.rule, self.camera, self.camera)


@dataclass
class _Known:
    """What events said of a camera: each holds once it held for a while, so that a flicker is no change."""

    camera: CameraState
    imaging: bool | None = None
    device: str | None = None
    regions: set[str] = field(default_factory=set)
    opened: bool = False


@dataclass
class _Stand:
    """How a rule stands for a camera: since when its conditions hold, and when its last alert was."""

    since: int | None = None
    alerted: int | None = None
    told: bool = False


class Guard:
    """Applies rules.

    An alert is raised once when a rule's conditions have held of a camera for its hold, and again only after they
    ceased. If they come true in quiet hours or within the cooldown, and still hold at their end, the alert is raised
    then.

    Parameters
    ----------
    rules
        The rules; their regions are to be those of the watch too.
    """

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self._known: dict[str, _Known] = {}
        self._stands: dict[tuple[str, str], _Stand] = {}

    @property
    def holding(self) -> tuple[tuple[str, str], ...]:
        """Rules and cameras of the alerts that still hold."""
        return tuple(pair for pair, one in self._stands.items() if one.told)

    def update(self, state: State, events: Iterable[Event] = ()) -> list[Alert]:
        """Take a state, and the events since the one before; return new alerts."""
        for event in events:
            self._learn(event)
        here = {one.id: one for one in state.cameras}
        for camera in here.values():
            # A guard that begins while the watch runs takes what it finds.
            known = self._known.setdefault(camera.id, _Known(camera, camera.active, camera.device, set(camera.regions)))
            known.camera = camera
        for gone in [one for one in self._known if one not in here]:
            del self._known[gone]
        self._stands = {pair: one for pair, one in self._stands.items() if pair[1] in here}
        told = []
        for rule in self.rules.rules:
            quiet = self.rules.is_quiet(rule, state.utc_ns)
            for camera, known in self._known.items():
                stand = self._stands.setdefault((rule.name, camera), _Stand())
                if self._holds(rule, known, stand, state.utc_ns) and not quiet:
                    stand.told, stand.alerted = True, state.utc_ns
                    told.append(Alert(state.utc_ns, rule.name, known.camera, rule.tell))
        for known in self._known.values():
            # A moment, which is over.
            known.opened = False
        return told

    def _learn(self, event: Event) -> None:
        camera = event.after
        if camera is None:
            self._known.pop(event.id, None)
            return
        known = self._known.setdefault(event.id, _Known(camera))
        if event.kind in ("imaging", "not imaging"):
            known.imaging = event.kind == "imaging"
        elif event.kind == "shutter opened":
            known.opened = True
        elif event.kind == "device":
            known.device = event.detail
        elif event.kind == "looks":
            known.regions.add(event.detail)
        elif event.kind == "looks away":
            known.regions.discard(event.detail)

    def _holds(self, rule: Rule, known: _Known, stand: _Stand, now: int) -> bool:
        """Return whether an alert is due now, quiet hours aside."""
        if not _true(rule, known):
            stand.since, stand.told = None, False
            return False
        if stand.since is None or stand.since > now:
            stand.since = now
        cool = stand.alerted is None or not 0 <= now - stand.alerted < rule.cooldown * 1e9
        return not stand.told and cool and now - stand.since >= rule.hold * 1e9


def _true(rule: Rule, known: _Known) -> bool:
    when = rule.when
    return (
        (when.imaging is None or known.imaging is when.imaging)
        and (when.shutter is None or known.opened)
        and (when.looks_at is None or when.looks_at in known.regions)
        and (not when.device or known.device in when.device)
        and (not when.not_device or (known.device is not None and known.device not in when.not_device))
    )
