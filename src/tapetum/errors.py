"""Errors in one line: where, what is wrong, and what to do about it."""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import Any

__all__ = ["InputError", "MissingExtraError", "StoppedError", "TapetumError", "need", "of_type", "one_of"]


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


def one_of(value: Any, allowed: tuple[str, ...], where: str) -> str:
    """Return `value` when it is one of `allowed`, else raise an InputError that lists them."""
    if value in allowed:
        return str(value)
    raise InputError(f"unknown value {value!r}", where=where, remedy=f"use one of {', '.join(allowed)}")
