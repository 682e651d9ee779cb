"""A vote by pointing cameras: zones, one vote a camera, a tally, and its replay."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, Literal

from pydantic import Field

from tapetum.checked import Checked, check
from tapetum.errors import InputError, one_of
from tapetum.live.events import Event, Region
from tapetum.live.pointer import Calibration
from tapetum.live.state import CameraState, State

__all__ = ["Ballot", "Tally", "Voice", "VoteFile", "Votes", "read_votes", "replay"]

SCHEMA = "tapetum/votes/1"
_MOST_ZONES = 12


@dataclass(frozen=True)
class Voice:
    """A camera's voice: when it was given, whose it is, and for which zone; "" where it was taken back."""

    utc_ns: int
    camera: str
    zone: str


@dataclass(frozen=True)
class Ballot:
    """What is voted on.

    Parameters
    ----------
    question
        What is asked.
    zones
        The answers, as parts of a plane that do not overlap: of a camera's field, in fractions from its centre, or of a
        screen, in fractions of its width and height from its upper left corner.
    plane
        "field" or "screen"; the latter needs a calibration of the pointer.
    dwell
        Seconds for which a camera must point at a zone before its voice counts.
    keep
        Whether the voice of a camera that goes stays. A camera that returns is a new one: kept voices let somebody who
        hides a camera vote twice.
    """

    question: str
    zones: tuple[Region, ...]
    plane: str = "field"
    dwell: float = 1.0
    keep: bool = False

    def __post_init__(self) -> None:
        one_of(self.plane, ("field", "screen"), "ballot.plane")
        if not 2 <= len(self.zones) <= _MOST_ZONES:
            raise InputError(f"has {len(self.zones)} zones", where="ballot.zones", remedy=f"give 2 to {_MOST_ZONES}")
        names = [one.name for one in self.zones]
        if len({*names, ""}) <= len(names):
            raise InputError(f"{', '.join(names)}: names must differ, and none be empty", where="ballot.zones")
        if not 0 <= self.dwell <= 60:
            raise InputError(f"must be 0 to 60 s, is {self.dwell}", where="ballot.dwell")
        for k, one in enumerate(self.zones):
            for other in self.zones[:k]:
                if (
                    one.left < other.right
                    and other.left < one.right
                    and one.top < other.bottom
                    and other.top < one.bottom
                ):
                    what = f"{other.name} and {one.name} overlap"
                    raise InputError(what, where="ballot.zones", remedy="leave a gap between them")


@dataclass(frozen=True)
class Tally:
    """How a vote stands: voices by zone, in the ballot's order, and cameras that are about to give theirs.

    `pending` holds (camera, zone, share of the dwell that has passed).
    """

    utc_ns: int
    voices: dict[str, int]
    pending: tuple[tuple[str, str, float], ...] = ()

    @property
    def count(self) -> int:
        """Return the number of voices."""
        return sum(self.voices.values())


@dataclass
class Votes:
    """A vote under way: takes the states of a watch and its events, and gives voices.

    Parameters
    ----------
    ballot
        What is voted on.
    calibration
        Of the pointer, for zones of a screen.
    """

    ballot: Ballot
    calibration: Calibration | None = None
    voices: dict[str, Voice] = field(default_factory=dict, init=False)
    _at: dict[str, tuple[str, int]] = field(default_factory=dict, init=False, repr=False)
    _now: int = field(default=0, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.ballot.plane == "screen" and self.calibration is None:
            remedy = "calibrate the pointer first, or take zones of the field"
            raise InputError("zones of a screen need a calibration", where="ballot.plane", remedy=remedy)

    def update(self, state: State, events: Iterable[Event] = ()) -> list[Voice]:
        """Take a state, and the events since the one before; return the voices that were given or taken back."""
        self._now = state.utc_ns
        told = []
        here = {one.id for one in state.cameras}
        gone = {one.id for one in events if one.kind == "gone"}
        for camera in [one for one in {*self._at, *self.voices} if one in gone or one not in here]:
            self._at.pop(camera, None)
            if camera in self.voices and not self.ballot.keep:
                del self.voices[camera]
                told.append(Voice(state.utc_ns, camera, ""))
        for camera in state.cameras:
            told += self._point(camera, state.utc_ns)
        return told

    def tally(self) -> Tally:
        """Return how the vote stands."""
        dwell = round(self.ballot.dwell * 1e9)
        pending = tuple(
            (camera, zone, min(1.0, (self._now - since) / dwell) if dwell else 1.0)
            for camera, (zone, since) in self._at.items()
            if camera not in self.voices or self.voices[camera].zone != zone
        )
        return _counted(self._now, [one.name for one in self.ballot.zones], self.voices.values(), pending)

    def _point(self, camera: CameraState, utc_ns: int) -> list[Voice]:
        """Count the dwell of a camera; a frame without its gaze neither counts nor breaks it."""
        if not camera.seen or camera.gaze_x is None or camera.gaze_y is None:
            return []
        if camera.estimated_utc_ns not in (None, utc_ns):
            # Its gaze is of an earlier frame.
            return []
        zone = self._zone(camera.gaze_x[0], camera.gaze_y[0])
        if zone is None:
            self._at.pop(camera.id, None)
            return []
        if self._at.get(camera.id, ("", 0))[0] != zone:
            self._at[camera.id] = zone, utc_ns
        given = self.voices.get(camera.id)
        if (given is not None and given.zone == zone) or utc_ns - self._at[camera.id][1] < self.ballot.dwell * 1e9:
            return []
        voice = self.voices[camera.id] = Voice(utc_ns, camera.id, zone)
        return [voice]

    def _zone(self, x: float, y: float) -> str | None:
        if self.ballot.plane == "screen" and self.calibration is not None:
            at = self.calibration.point(x, y)
            if at is None:
                return None
            x, y = at[0] / self.calibration.screen.width, at[1] / self.calibration.screen.height
        return next((one.name for one in self.ballot.zones if one.holds(x, y)), None)


def _counted(
    utc_ns: int, zones: Sequence[str], voices: Iterable[Voice], pending: tuple[tuple[str, str, float], ...] = ()
) -> Tally:
    counts = dict.fromkeys(zones, 0)
    for one in voices:
        counts[one.zone] += 1
    return Tally(utc_ns, counts, pending)


def replay(ballot: Ballot, voices: Iterable[Voice]) -> Iterator[Tally]:
    """Yield the tally after each voice of a stored vote."""
    given: dict[str, Voice] = {}
    zones = [one.name for one in ballot.zones]
    for one in voices:
        if one.zone:
            given[one.camera] = one
        else:
            given.pop(one.camera, None)
        yield _counted(one.utc_ns, zones, given.values())


class VoteFile:
    """A stored vote: JSON Lines, the ballot first, then a line a voice, written as it is given."""

    def __init__(self, path: str | os.PathLike[str], ballot: Ballot, utc_ns: int = 0) -> None:
        self.path = Path(path)
        try:
            self._file: IO[str] = self.path.open("x", encoding="utf-8")
        except FileExistsError as error:
            raise InputError("exists", where=self.path, remedy="name another file") from error
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror})", where=self.path) from error
        self._line({"schema": SCHEMA, "utc_ns": utc_ns, "ballot": asdict(ballot)})

    def add(self, voices: Iterable[Voice]) -> None:
        """Write voices; they are with the system when this returns."""
        for one in voices:
            self._line(asdict(one))

    def close(self) -> None:
        """End the file."""
        self._file.close()

    def _line(self, content: dict[str, Any]) -> None:
        self._file.write(json.dumps(content) + "\n")
        self._file.flush()


class _ZoneLine(Checked):
    name: str = Field(min_length=1, max_length=200)
    left: float
    top: float
    right: float
    bottom: float


class _BallotLine(Checked):
    question: str = Field(max_length=1000)
    zones: list[_ZoneLine] = Field(max_length=_MOST_ZONES)
    plane: Literal["field", "screen"]
    dwell: float
    keep: bool


class _HeadLine(Checked):
    schema_: Literal["tapetum/votes/1"] = Field(alias="schema")
    utc_ns: int = Field(ge=0)
    ballot: _BallotLine


class _VoiceLine(Checked):
    utc_ns: int = Field(ge=0)
    camera: str = Field(min_length=1, max_length=200)
    zone: str = Field(max_length=200)


def read_votes(path: str | os.PathLike[str]) -> tuple[Ballot, tuple[Voice, ...]]:
    """Read a stored vote; a last line that a crash left unfinished is left out.

    Raises
    ------
    InputError
        When it is missing or no vote, with the first line that does not fit.
    """
    remedy = "name a file that a vote wrote"
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read ({error})", where=path, remedy=remedy) from error
    whole = text[: text.rfind("\n") + 1].splitlines()
    if not whole:
        raise InputError("holds no vote", where=path, remedy=remedy)
    head = check(_HeadLine, _json(whole[0], path, 1), f"{path}, line 1", remedy).ballot
    zones = tuple(Region(one.name, one.left, one.top, one.right, one.bottom) for one in head.zones)
    ballot = Ballot(head.question, zones, head.plane, head.dwell, head.keep)
    names = {"", *(one.name for one in zones)}
    voices = []
    for number, line in enumerate(whole[1:], 2):
        where = f"{path}, line {number}"
        read = check(_VoiceLine, _json(line, path, number), where, remedy)
        if read.zone not in names:
            raise InputError(f"zone: {read.zone!r:.40} is none of the ballot's", where=where, remedy=remedy)
        voices.append(Voice(read.utc_ns, read.camera, read.zone))
    return ballot, tuple(voices)


def _json(line: str, path: str | os.PathLike[str], number: int) -> object:
    try:
        return json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InputError("is no JSON", where=f"{path}, line {number}") from error
