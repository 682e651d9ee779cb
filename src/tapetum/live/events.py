"""From tracks to events: what begins, changes and ends with each camera, reported once, and only when it lasts.

The form is Frigate's: `new`, `update` and `end` share an id and carry the camera before and after. A camera is reported
once it was seen for some time (`confirm`); a change once it has lasted (`hold`), and not within `cooldown` of the last
change.

A little over 400 lines: a stay's frames, its look and its changes are one state.
"""

from __future__ import annotations

import math
import uuid
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Generic, TypeVar

from tapetum.errors import InputError
from tapetum.live.ignored import Ignored
from tapetum.live.look import resembles
from tapetum.live.state import CameraState
from tapetum.track.rows import TrackedFrame, TrackRow

__all__ = ["KINDS", "Event", "Events", "Ignored", "Region"]

KINDS = (
    *("seen", "gone", "imaging", "not imaging", "looks", "looks away", "device", "shutter opened", "alert"),
    *("source lost", "source returned", "source ended"),
)
"""Kinds of events."""
_NONE_OF_THESE = "none of these"
_LOOKS = 120  # that are kept of a camera: a minute
_LOOK_NOW, _LOOK_LATER = 0.1, 0.5  # s between two looks while they decide, and else
_LATEST, _FEWEST = 5, 3  # looks that decide, and the fewest that do
_RECENT, _UNLIKE = 1.0, 1.0  # s for which a look counts, and for which a camera of ours may look different
# Of so many estimates one may be far off; share of the estimates against a change that ends it.
_WRONG, _ENDS = 4, 0.4
# Most of its frames must show a new camera, and most of so many of the latest: a reflection that has gone does not come
# to that by a spot here and there. Where a camera is missed as rarely as a spot comes where none is, a majority of all
# frames since the first makes the camera the likelier; one that is hidden for a third of a second gets there soon.
_LATEST_FRAMES = 3
# A new camera that was unseen for so many frames and is found so many pixels away is another one.
_UNSEEN, _FAR = 2, 24.0
_TICK = 1e-6  # s, less than any frame: times are rounded
T = TypeVar("T")


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Parameters
    ----------
    id
        Of the camera's stay, the same for all its events; "source" for those of the source.
    type
        "new", "update" or "end" of that stay.
    kind
        What happened: one of `KINDS`.
    utc_ns
        When the frame was taken that showed it; of a shutter that opened, the first that showed it open.
    detail
        The region, the device, the rule of an alert, or why a source was lost.
    before, after
        The camera before and after; None before `new` and after `end`, and both for a source.
    """

    id: str
    type: str
    kind: str
    utc_ns: int
    detail: str = ""
    before: CameraState | None = None
    after: CameraState | None = None

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {"schema": "tapetum/event/1", **asdict(self)}


@dataclass(frozen=True)
class Region:
    """A part of a camera's field: name, left, top, right, bottom in fractions of the field from its centre."""

    name: str
    left: float
    top: float
    right: float
    bottom: float

    def __post_init__(self) -> None:
        if not (self.left < self.right and self.top < self.bottom):
            what = f"left {self.left}, right {self.right}, top {self.top}, bottom {self.bottom} enclose nothing"
            raise InputError(what, where=f"region {self.name}", remedy="give left < right and top < bottom")

    def holds(self, x: float, y: float) -> bool:
        """Return whether a gaze falls into it."""
        return self.left <= x <= self.right and self.top <= y <= self.bottom


class _Held(Generic[T]):
    """A value that changes only when a new one has lasted for some seconds, and some seconds after the last change.

    A new value lasts while most frames give it: one estimate in `_WRONG` may be far off without ending that.
    """

    def __init__(self, value: T, hold: float, cooldown: float) -> None:
        self.value, self.hold, self.cooldown = value, hold, cooldown
        self._other: T = value
        self._since = self._changed = -math.inf
        self._for = self._against = 0

    def update(self, value: T, time: float, certain: bool = False) -> bool:
        """Return whether the value changes now; one that is certain need not last."""
        if value == self._other:
            self._for += 1
        else:
            self._against += 1
            # A reported value needs no share of frames: any other value may be the beginning of a change. One that is
            # far off ends none, not even as the second.
            if self._other == self.value or self._against > max(1, _ENDS * (self._for + self._against)):
                self._other, self._since, self._for, self._against = value, time, 1, 0
        if value != self._other or value == self.value or self._against * _WRONG > self._for + self._against:
            return False
        if (time - self._since < self.hold and not certain) or time - self._changed < self.cooldown:
            return False
        self.value, self._changed = value, time
        return True


class _Stay:
    """A camera's stay before the probe."""

    def __init__(self, camera: CameraState, row: TrackRow, hold: float, cooldown: float) -> None:
        self.camera, self.told = camera, False
        # A track that goes on after its stay ended shows another camera.
        begun = row.since is not None and row.event == "begun"
        # The detections that gave the track its number count.
        lately = row.lately[row.lately.index(True) :] if begun and True in row.lately else (True,)
        self.begins(row, row.since if begun and row.since is not None else row.time, lately)
        self.looks: deque[tuple[float, tuple[float, ...]]] = deque(maxlen=_LOOKS)
        # What it is taken for by its look, and since when it does not look so any more.
        self.ours: Ignored | None = None
        self.unlike: float | None = None
        self.published = camera
        # Stated only where it is 95 % sure, which takes some frames already.
        self.active = _Held[bool | None](None, hold / 2, cooldown)
        self.device = _Held[str | None](None, hold, cooldown)
        self.regions: dict[str, _Held[bool]] = {}
        self.opened = -math.inf

    def begins(self, row: TrackRow, first: float, lately: Sequence[bool] = (True,)) -> None:
        """Begin to count the frames that show it; `lately` are those since the first."""
        self.first, self.last = first, row.time
        # Where it was first and last seen: the place of a track that coasts goes on.
        self.began = self.place = row.x, row.y
        # And before the latest frame that shows it, where that one shows it far from there: a false spot, which is not
        # its place, may have taken its track.
        self.leapt_from: tuple[float, float] | None = None
        self.frames, self.shown, self.unseen = len(lately), sum(lately), 0
        # Most frames in a row that hid it before it was found again, and whether this frame shows it somewhere else: a
        # lone camera that is missed as a reflection begins is taken to have moved there, until the next frame.
        self.hidden, self.jumped = 0, False
        # When the latest frame was that counts, and the least time between two.
        self.counted, self.between = row.time, math.inf
        self.latest: deque[bool] = deque(lately, maxlen=_LATEST_FRAMES)

    def saw(self, row: TrackRow, before: CameraState, dark: bool, confirm: float) -> None:
        """Take whether a frame shows it; one without the probe's light says nothing where it does not.

        The track of something that went may have come upon another: one that is new begins anew then.
        """
        if row.seen and not self.told:
            away = math.dist((row.x, row.y), (before.x, before.y)) > max(_FAR, 2 * before.diameter)
            if (away and self.unseen >= _UNSEEN) or row.time - self.last > confirm:
                self.begins(row, row.time)
                return
            self.jumped = away and not self.jumped
        if row.seen:
            leapt = math.dist((row.x, row.y), self.place) > max(_FAR, 2 * before.diameter)
            self.leapt_from = self.place if leapt else None
            self.last, self.place = row.time, (row.x, row.y)
            if self.unseen >= _UNSEEN:
                self.hidden = max(self.hidden, self.unseen)
        if row.seen or not dark:
            self.counted, self.between = row.time, min(self.between, row.time - self.counted)
            self.unseen = 0 if row.seen else self.unseen + 1
            self.frames, self.shown = self.frames + 1, self.shown + row.seen
            self.latest.append(row.seen)

    def stands(self, confirm: float) -> bool:
        """Return whether a camera that is new was there for so many seconds, by when and by how many frames show it."""
        # It came on average half a frame before the first that shows it.
        between = self.between if math.isfinite(self.between) else 0.0
        if self.jumped or self.last - self.first + between / 2 < confirm - _TICK:
            return False
        # One that was hidden and is found at its place is judged by the other frames, if it was seen in most frames of
        # that time.
        enough = 2 * self.shown * between > confirm + between
        most = 2 * self.shown > self.frames - (self.hidden if enough else 0)
        return most and 2 * sum(self.latest) > len(self.latest)


class Events:
    """Makes events of tracked frames.

    Parameters
    ----------
    regions
        Parts of the cameras' fields that events report on.
    confirm, hold, cooldown, gone
        Seconds since a camera was first detected after which it is reported, if most of its frames show it; for
        which a change must last, where one frame in four may differ; between two changes of a kind; and unseen before
        it is gone.
    ignored
        Cameras that are ours: nothing about them is reported, and no event begins with them.
    """

    def __init__(
        self,
        regions: Iterable[Region] = (),
        *,
        confirm: float = 0.5,
        hold: float = 0.4,
        cooldown: float = 1.0,
        gone: float = 1.0,
        ignored: Iterable[Ignored] = (),
    ) -> None:
        for name, value in (("confirm", confirm), ("hold", hold), ("cooldown", cooldown), ("gone", gone)):
            if not 0 <= value < math.inf:
                raise InputError(f"must be 0 or more seconds, is {value}", where=name)
        self.regions, self.ignored = tuple(regions), tuple(ignored)
        self.confirm, self.hold, self.cooldown, self.gone = confirm, hold, cooldown, gone
        self._stays: dict[int, _Stay] = {}
        self._live: set[int] = set()  # the numbers of the latest frame's tracks

    @property
    def cameras(self) -> tuple[CameraState, ...]:
        """The cameras that were reported."""
        return tuple(stay.camera for stay in self._stays.values() if stay.told)

    def wants_look(self, row: TrackRow, offset: int = 0) -> bool:
        """Return whether the look of a row is to be measured: often while it decides, else now and then."""
        stay = self._stays.get(row.track + offset)
        if stay is None or not row.seen or row.diameter is None:
            return False
        decides = (stay.ours is not None or not stay.told) and any(one.looks for one in self.ignored)
        return not stay.looks or row.time - stay.looks[-1][0] >= (_LOOK_NOW if decides else _LOOK_LATER)

    def looks_of(self, camera: str) -> tuple[tuple[float, ...], ...]:
        """Return the looks of the last minute of a camera that was reported; empty where there are none."""
        # Copies, for another thread asks.
        stay = next((one for one in list(self._stays.values()) if one.camera.id == camera and one.told), None)
        return () if stay is None else tuple(look for _, look in stay.looks.copy())

    def take_as(self, camera: str, ours: Ignored) -> None:
        """Take a camera for one of ours by its look; its stay ends with its next frame."""
        for stay in list(self._stays.values()):
            if stay.camera.id == camera:
                stay.ours = ours

    def update(
        self,
        tracked: TrackedFrame,
        utc_ns: int,
        offset: int = 0,
        looks: Mapping[int, tuple[float, ...]] | None = None,
    ) -> list[Event]:
        """Take a frame's tracks, whose numbers begin after `offset`, and return what happened.

        `looks` holds those of this frame that were measured, by the tracks' numbers.
        """
        told: list[Event] = []
        for number, one in (looks or {}).items():
            if (stay := self._stays.get(number)) is not None:
                stay.looks.append((tracked.time, one))
        dark = tracked.moment.get("lit") is False
        self._live = {row.track + offset for row in tracked.rows}
        for row in tracked.rows:
            told += self._row(row, row.track + offset, utc_ns, dark)
        for number, stay in list(self._stays.items()):
            if tracked.time - stay.last > self.gone:
                told += self._end(number, utc_ns)
        return told

    def end_all(self, utc_ns: int) -> list[Event]:
        """End all stays, as when the source is lost for good."""
        return [event for number in list(self._stays) for event in self._end(number, utc_ns)]

    def _row(self, row: TrackRow, number: int, utc_ns: int, dark: bool) -> list[Event]:
        stay = self._stays.get(number)
        camera = _camera(row, number, utc_ns, None if stay is None else stay.camera, dark)
        if any(one.holds(camera) for one in self.ignored):
            # Not reported, and no cooldown begins; a stay that was reported ends.
            return [] if stay is None else self._end(number, utc_ns)
        if stay is None:
            if row.seen:
                self._stays[number] = _Stay(camera, row, self.hold, self.cooldown)
            return []
        stay.saw(row, stay.camera, dark, self.confirm)
        stay.camera = camera
        if stay.ours is not None and self._still_ours(stay, row.time):
            return self._silenced(stay, utc_ns)
        if not stay.told:
            if not row.seen or not stay.stands(self.confirm):
                return []
            if self._taken_for_ours(stay, row.time):
                return []
            former = self._former(stay)
            if former is not None:
                stay = self._goes_on(former, number, row, utc_ns, dark)
                told = []
            else:
                stay.told = True
                told = [self._event(stay, "new", "seen", utc_ns)]
        else:
            told = []
        return told + self._changes(stay, row, utc_ns)

    def _former(self, stay: _Stay) -> int | None:
        """Number of the track under which a new camera was reported before; None where it was not.

        A reflection that begins beside a camera while that is missed may take its track, and the camera gets another.
        One camera has then not gone, nor another come, at that place: the old track shows nothing any more.
        """
        near: list[tuple[float, int]] = []
        for number, other in self._stays.items():
            away = other.told and (other.unseen >= _UNSEEN or number not in self._live)
            # Where the one was last seen and the other first; or now, where both moved with the probe meanwhile.
            coasts = other.camera.x, other.camera.y
            before = other.place if other.leapt_from is None else other.leapt_from
            far = min(math.dist(stay.began, place) for place in (other.place, before))
            far = min(far, math.dist(stay.place, coasts))
            if away and other is not stay and far <= max(_FAR, 2 * other.camera.diameter):
                near.append((far, number))
        return min(near)[1] if near else None

    def _goes_on(self, former: int, number: int, row: TrackRow, utc_ns: int, dark: bool) -> _Stay:
        """Let a reported stay go on under another track's number."""
        stay, new = self._stays.pop(former), self._stays[number]
        stay.begins(row, new.first)
        stay.looks.extend(new.looks)
        stay.camera = _camera(row, number, utc_ns, replace(stay.camera, track=number), dark)
        self._stays[number] = stay
        return stay

    def _taken_for_ours(self, stay: _Stay, time: float) -> bool:
        """Return whether a new camera is taken for one of ours by its look; one camera at a time is."""
        latest = [look for _, look in list(stay.looks)[-_LATEST:]]
        for one in self.ignored:
            taken = any(other.ours == one and time - other.last <= self.gone for other in self._stays.values())
            if one.looks and not taken and len(latest) >= _FEWEST and resembles(latest, one.known, one.tolerance):
                stay.ours = one
                return True
        return False

    def _still_ours(self, stay: _Stay, time: float) -> bool:
        """Return whether a camera that was taken for one of ours still is, until it looks different for a while."""
        ours = stay.ours
        if ours is None or ours not in self.ignored:
            stay.ours = stay.unlike = None
            return False
        latest = [look for at, look in list(stay.looks)[-_LATEST:] if time - at <= _RECENT]
        if not latest or resembles(latest, ours.known, ours.tolerance):
            stay.unlike = None
        elif stay.unlike is None:
            stay.unlike = time
        elif time - stay.unlike >= max(self.hold, _UNLIKE):
            stay.ours = stay.unlike = None
            return False
        return True

    def _silenced(self, stay: _Stay, utc_ns: int) -> list[Event]:
        """End the reported stay of a camera that is taken for ours from now on; it is followed without reports."""
        if not stay.told:
            return []
        stay.told = False
        ended = Event(stay.camera.id, "end", "gone", utc_ns, "", stay.camera, None)
        # If it is reported again, that is another stay.
        stay.camera = replace(stay.camera, id=uuid.uuid4().hex)
        stay.published = stay.camera
        return [ended]

    def _changes(self, stay: _Stay, row: TrackRow, utc_ns: int) -> list[Event]:
        told: list[Event] = []
        if row.active is not None and stay.active.update(row.active, row.time, row.certain):
            told.append(self._event(stay, "update", "imaging" if row.active else "not imaging", utc_ns))
        if row.opened is not None and row.time - stay.opened >= self.cooldown:
            opened = utc_ns - round((row.time - row.opened) * 1e9)
            stay.opened, stay.camera = row.time, replace(stay.camera, opened_utc_ns=opened)
            told.append(self._event(stay, "update", "shutter opened", opened))
        device = stay.camera.device
        asked = row.seen and _asked(row)
        if asked and device is not None and stay.device.update(device, row.time):
            told.append(self._event(stay, "update", "device", utc_ns, device))
        gaze = stay.camera.gaze_x, stay.camera.gaze_y
        if asked and gaze[0] is not None and gaze[1] is not None:
            for region in self.regions:
                held = stay.regions.setdefault(region.name, _Held(False, self.hold, self.cooldown))
                if held.update(region.holds(gaze[0][0], gaze[1][0]), row.time):
                    names = tuple(name for name, one in stay.regions.items() if one.value)
                    stay.camera = replace(stay.camera, regions=names)
                    told.append(
                        self._event(stay, "update", "looks" if held.value else "looks away", utc_ns, region.name)
                    )
        return told

    def _event(self, stay: _Stay, type_: str, kind: str, utc_ns: int, detail: str = "") -> Event:
        before, stay.published = stay.published, stay.camera
        return Event(stay.camera.id, type_, kind, utc_ns, detail, None if type_ == "new" else before, stay.camera)

    def _end(self, number: int, utc_ns: int) -> list[Event]:
        stay = self._stays.pop(number)
        return [Event(stay.camera.id, "end", "gone", utc_ns, "", stay.camera, None)] if stay.told else []


def _camera(row: TrackRow, number: int, utc_ns: int, before: CameraState | None, dark: bool) -> CameraState:
    """The camera of a row; what this frame does not show stays as it was."""
    if before is None:
        before = CameraState(uuid.uuid4().hex, number, row.x, row.y, row.diameter or 0.0, row.seen, utc_ns, utc_ns)
    said: dict[str, Any] = {"x": row.x, "y": row.y, "seen": row.seen or (dark and before.seen), "active": row.active}
    if row.seen:
        said |= {"seen_utc_ns": utc_ns, "snr": row.snr, "diameter": row.diameter}
    # Where it was another camera's turn, what was estimated before stands, with its age.
    if row.seen and _asked(row):
        said["estimated_utc_ns"] = utc_ns
        said |= {name: _interval(row.estimates, name) for name in ("gaze_x", "gaze_y")}
        device = row.estimates.get("device")
        if device is not None:
            likely = row.estimates.get("device_probability")
            said |= {"device": None if device == _NONE_OF_THESE else device, "device_probability": _finite(likely)}
    return replace(before, **said)


def _asked(row: TrackRow) -> bool:
    """Return whether models were asked about a row: where they take turns, others' rows hold no more than looks."""
    return any(name != "asymmetry" for name in row.estimates)


def _interval(estimates: Mapping[str, Any], name: str) -> tuple[float, float, float] | None:
    """An estimate and its interval; None where there is none."""
    if estimates.get("applies") is False:
        return None
    value = _finite(estimates.get(name))
    if value is None:
        return None
    low, high = (_finite(estimates.get(f"{name}_{end}")) for end in ("low", "high"))
    return value, value if low is None else low, value if high is None else high


def _finite(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
