"""Errors in one line: where, what is wrong, and what to do about it."""

from __future__ import annotations

import contextlib
import importlib
import math
import operator
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

__all__ = [
    "InputError",
    "MissingExtraError",
    "StoppedError",
    "TapetumError",
    "need",
    "noted",
    "number",
    "of_type",
    "one_of",
    "whole",
]


class TapetumError(Exception):
    """Base of every error that Tapetum raises on purpose."""


class StoppedError(TapetumError):
    """Work that Ctrl-C ended after part of it was kept: says what is kept and how to go on. Exit code 130."""


class InputError(TapetumError, ValueError):
    """Input that cannot be used: exit code 2 on the command line.

    Parameters
    ----------
    what
        What is wrong, with the value that is.
    where
        The file, field or argument it was found in.
    remedy
        What to do about it.

    Examples
    --------
    >>> str(InputError("must be positive, is -3 mm", where="target.lens.aperture_radius", remedy="give a radius"))
    'target.lens.aperture_radius: must be positive, is -3 mm; give a radius'
    """

    def __init__(self, what: str, *, where: object = None, remedy: str | None = None) -> None:
        self.what, self.where, self.remedy = what, where, remedy
        line = what if where is None else f"{where}: {what}"
        super().__init__(" ".join((line if remedy is None else f"{line}; {remedy}").split()))


class MissingExtraError(InputError):
    """A feature was asked for whose optional packages are not installed."""


@contextlib.contextmanager
def noted(note: Callable[[], str], *kinds: type[BaseException]) -> Iterator[None]:
    """Add a note, unless it is empty, to errors of these kinds: what interrupted work has kept by then."""
    try:
        yield
    except kinds as error:
        if said := note():
            error.add_note(said)
        raise


def need(module: str, extra: str) -> ModuleType:
    """Import an optional `module`, or say which extra of Tapetum brings it.

    Raises
    ------
    MissingExtraError
        When the module is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        remedy = f"pip install 'tapetum[{extra}]'"
        raise MissingExtraError(f"{module} is not installed", remedy=remedy) from error


def of_type(value: object, kinds: type | tuple[type, ...], where: str, remedy: str) -> None:
    """Raise an InputError, with the type that was given, unless `value` is one of `kinds`."""
    if not isinstance(value, kinds):
        given = "None" if value is None else f"of type {type(value).__name__}"
        raise InputError(f"is {given}", where=where, remedy=remedy)


def number(
    value: Any, where: str, remedy: str, *, least: float = -math.inf, most: float = math.inf, above: float = -math.inf
) -> float:
    """Return a finite number from `least` to `most` and above `above`; an int stays one.

    Raises an InputError for any other, for NaN, for what is no number, and for a bool.
    """
    try:
        plain = value if type(value) in (int, float) else float(value)
    except (TypeError, ValueError):
        plain = math.nan
    if isinstance(value, (bool, str)) or not (math.isfinite(plain) and least <= plain <= most and plain > above):
        bounds = [f"above {above:g}"] if above > -math.inf else []
        bounds += [f"{least:g} or more"] if least > -math.inf else []
        bounds += [f"at most {most:g}"] if most < math.inf else []
        raise InputError(f"must be {' and '.join(bounds) or 'finite'}, is {value!r}", where=where, remedy=remedy)
    return plain


def whole(value: Any, where: str, remedy: str, *, least: int, most: int) -> int:
    """Return a whole number from `least` to `most` as an int; raise an InputError for any other, and for a bool."""
    try:
        plain = operator.index(value)
    except TypeError:
        plain = least - 1
    if isinstance(value, bool) or not least <= plain <= most:
        raise InputError(f"must be a whole number from {least} to {most}, is {value!r}", where=where, remedy=remedy)
    return plain


def one_of(value: Any, allowed: tuple[str, ...], where: str) -> str:
    """Return `value` when it is one of `allowed`, else raise an InputError that lists them."""
    if value in allowed:
        return str(value)
    raise InputError(f"unknown value {value!r}", where=where, remedy=f"use one of {', '.join(allowed)}")
