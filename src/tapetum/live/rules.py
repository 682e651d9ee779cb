"""Rules of a guard: what raises an alert, when, and who gets it. A YAML file, checked before a watch begins."""

from __future__ import annotations

import datetime as dt
import functools
import os
import zoneinfo
from collections.abc import Collection, Mapping
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, TypeAdapter, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.faults import first_fault
from tapetum.bench.plain_yaml import field_paths, read_mapping
from tapetum.bench.quantity import to_si
from tapetum.bench.strict import STRICT
from tapetum.errors import InputError
from tapetum.files import read_text
from tapetum.live.events import Region

__all__ = ["SCHEMA", "Conditions", "Quiet", "Rule", "Rules", "load_rules", "rules_from_text"]

SCHEMA = "tapetum/rules/1"
DAYS = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
Day = Literal["mon", "tue", "wed", "thu", "fri", "sat", "sun"]
_DAY = dt.timedelta(days=1)
_MOST = 1000


def _clock(value: object) -> object:
    """A time of day. YAML 1.1 takes 22:00 without quotes for the number 1320, its minutes."""
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 24 * 60:
        return dt.time(value // 60, value % 60)
    if isinstance(value, str):
        try:
            return dt.datetime.strptime(value, "%H:%M").time()
        except ValueError:
            pass
    if value == "24:00" or value == 24 * 60:
        return dt.time(0, 0)
    raise ValueError(f"{value!r} is no time of day; write hours and minutes, for example '22:00'")


def _zone(value: str) -> str:
    try:
        zoneinfo.ZoneInfo(value)
    except (ValueError, OSError, zoneinfo.ZoneInfoNotFoundError):
        remedy = "write for example 'Europe/Berlin', or pip install tzdata where all are unknown"
        raise ValueError(f"{value!r} is no known time zone; {remedy}") from None
    return value


def _sides(value: object) -> object:
    if not isinstance(value, list | tuple) or len(value) != 4:
        raise ValueError(f"must be left, top, right, bottom, is {value!r}; write for example [-0.2, -0.1, 0.2, 0.1]")
    return tuple(value)


def _listed(value: object) -> object:
    """One name in place of a list of names."""
    return _list([value] if isinstance(value, str) else value)


def _list(value: object) -> object:
    if not isinstance(value, list | tuple):
        raise ValueError(f"must be a list, is {value!r}; write each item on a line of its own, after '- '")
    return tuple(value)


def _some(value: object) -> object:
    listed = _list(value)
    if listed == ():
        raise ValueError("is empty; give one or more")
    return listed


def _by_name(value: object) -> object:
    if not isinstance(value, Mapping):
        raise ValueError(f"must be a mapping, is {value!r}; write for example 'door: [-0.2, -0.1, 0.2, 0.1]'")
    return value


Clock = Annotated[dt.time, BeforeValidator(_clock)]
Wait = Annotated[float, BeforeValidator(lambda value: to_si(value, "s")), Field(ge=0, le=86400)]
Name = Annotated[str, Field(min_length=1, max_length=100)]
Names = Annotated[tuple[Name, ...], BeforeValidator(_listed), Field(max_length=_MOST)]
Side = Annotated[float, Field(ge=-10, le=10)]
Sides = Annotated[tuple[Side, Side, Side, Side], BeforeValidator(_sides)]


@dataclass(frozen=True, config=STRICT)
class Quiet:
    """Hours without alerts: from a time of day to another, on the days on which they begin, also past midnight."""

    from_: Clock = Field(alias="from")  # pyright: ignore[reportGeneralTypeIssues]
    to: Clock = Field()
    days: Annotated[tuple[Day, ...], BeforeValidator(_listed), Field(min_length=1)] = DAYS

    def holds(self, local: dt.datetime) -> bool:
        """Return whether a local time falls into them; the same time twice means a whole day."""
        now, day = local.time(), DAYS[local.weekday()]
        if self.from_ < self.to:
            return day in self.days and self.from_ <= now < self.to
        before = DAYS[(local - _DAY).weekday()]
        return (day in self.days and now >= self.from_) or (before in self.days and now < self.to)


@dataclass(frozen=True, config=STRICT)
class Conditions:
    """What must hold of one camera, all at once; without any, that a camera is here."""

    # Whether it images; false: it is known not to.
    imaging: bool | None = None
    # That a shutter opens on its sensor, while it was idle: a moment.
    shutter: Literal["opened"] | None = None
    # Name of a region of its field that the probe must lie in.
    looks_at: Name | None = None
    # It is taken for one of these, or for something else than these.
    device: Names = ()
    not_device: Names = ()

    @model_validator(mode="after")
    def _one(self) -> Conditions:
        if self.device and self.not_device:
            raise ValueError("has device and not_device; leave one of them out")
        if self.shutter is not None and self.imaging is not None:
            raise ValueError("has shutter and imaging; leave imaging out: it is known half a second later")
        return self


@dataclass(frozen=True, config=STRICT)
class Rule:
    """When an alert is raised, and who gets it."""

    name: Name
    when: Conditions = Field(default_factory=Conditions)
    # For so long all conditions must hold, beyond what the watch's events wait themselves.
    hold: Wait = 0.0
    # Least time between two alerts of this rule about one camera.
    cooldown: Wait = 10.0
    # In place of the quiet hours of all rules; []: none.
    quiet: Annotated[tuple[Quiet, ...], BeforeValidator(_list)] | None = None
    # Names of outputs; none named: all.
    tell: Names = ()

    @model_validator(mode="after")
    def _moment(self) -> Rule:
        if self.when.shutter is not None and self.hold:
            raise ValueError("has a shutter that opens, which is a moment, and hold; leave hold out")
        return self


@dataclass(frozen=True, config=STRICT)
class Rules:
    """All rules of a guard."""

    rules: Annotated[tuple[Rule, ...], BeforeValidator(_some), Field(max_length=_MOST)]
    # Left, top, right, bottom in fractions of the field from its centre.
    regions: Annotated[dict[Name, Sides], BeforeValidator(_by_name), Field(max_length=_MOST)] = Field(
        default_factory=dict
    )
    # Of the quiet hours.
    time_zone: Annotated[str, AfterValidator(_zone)] = "UTC"
    quiet: Annotated[tuple[Quiet, ...], BeforeValidator(_list)] = ()

    @model_validator(mode="after")
    def _agree(self) -> Rules:
        names = [one.name for one in self.rules]
        if twice := next((one for one in names if names.count(one) > 1), None):
            raise ValueError(f"two rules are named {twice!r}; give each its own name")
        for one in self.rules:
            where = one.when.looks_at
            if where is not None and where not in self.regions:
                known = ", ".join(self.regions) or "there is none"
                raise ValueError(
                    f"rule {one.name!r} looks at {where!r}, which is no region; add it to regions: {known}"
                )
        for name, (left, top, right, bottom) in self.regions.items():
            if not (left < right and top < bottom):
                raise ValueError(f"region {name!r} encloses nothing; give left < right and top < bottom")
        return self

    @functools.cached_property
    def zone(self) -> zoneinfo.ZoneInfo:
        """The time zone of the quiet hours."""
        return zoneinfo.ZoneInfo(self.time_zone)

    def areas(self) -> tuple[Region, ...]:
        """Return the regions as a watch takes them."""
        return tuple(Region(name, *sides) for name, sides in self.regions.items())

    def is_quiet(self, rule: Rule, utc_ns: int) -> bool:
        """Return whether a rule is silent at a time."""
        hours = self.quiet if rule.quiet is None else rule.quiet
        if not hours:
            return False
        local = dt.datetime.fromtimestamp(utc_ns / 1e9, self.zone)
        return any(one.holds(local) for one in hours)

    def check_abilities(self, activity: bool, targets: Collection[str], where: str = "rules") -> None:
        """Raise an InputError where a rule asks for what the watch does not estimate: its alert would never come.

        Parameters
        ----------
        activity
            Whether the watch says of cameras if they image.
        targets
            What its models estimate.
        where
            The rules' file.
        """
        for k, rule in enumerate(self.rules):
            when = rule.when
            wants = (
                ("imaging", when.imaging is not None, activity, "add --activity"),
                ("shutter", when.shutter is not None, activity, "add --activity"),
                ("looks_at", when.looks_at is not None, "gaze_x" in targets, "add a --model of gaze"),
                ("device", bool(when.device or when.not_device), "device" in targets, "add a --model of devices"),
            )
            for name, asked, able, remedy in wants:
                if asked and not able:
                    what = f"rule {rule.name!r} asks for {name}, which this watch does not estimate"
                    raise InputError(what, where=f"{where}: rules.{k}.when", remedy=remedy)

    def check_outputs(self, names: Collection[str], where: str = "rules") -> None:
        """Raise an InputError where a rule names an output that does not exist."""
        for k, rule in enumerate(self.rules):
            for name in rule.tell:
                if name not in names:
                    remedy = f"use one of {', '.join(sorted(names))}" if names else "add an output, or leave tell out"
                    raise InputError(f"there is no output {name!r}", where=f"{where}: rules.{k}.tell", remedy=remedy)


def load_rules(path: str | os.PathLike[str]) -> Rules:
    """Read rules from a YAML file.

    Raises
    ------
    InputError
        When the file is missing, no YAML, of another schema, or holds an unknown key or a wrong value.
    """
    return rules_from_text(read_text(path, "give a YAML file"), str(path))


def rules_from_text(text: str, where: str = "rules") -> Rules:
    """Read rules from YAML text; see `load_rules`."""
    content: dict[str, Any] = read_mapping(text, SCHEMA, where)
    try:
        return _adapter().validate_python(content)
    except ValidationError as error:
        # `from` is a word of Python; its field is not named so.
        paths = tuple(tuple(step.rstrip("_") for step in path) for path in field_paths(Rules))
        raise first_fault(error, where, paths) from error


@functools.cache
def _adapter() -> TypeAdapter[Rules]:
    return TypeAdapter(Rules)
