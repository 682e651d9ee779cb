"""Prescriptions from the catalogue, from YAML files and from Zemax's."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from tapetum.bench.faults import first_fault
from tapetum.bench.lens_data import Prescription
from tapetum.bench.plain_yaml import field_paths, read_mapping
from tapetum.bench.quantity import to_si
from tapetum.errors import InputError

__all__ = ["LENS_SCHEMA", "lens_names", "load_lens", "prescription_from_dict"]

LENS_SCHEMA = "tapetum/lens/1"
_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "inch": 25.4e-3}
_LENGTHS = ("semi_diameter", "radius", "thickness")


def lens_names() -> list[str]:
    """Names of the lenses that come with the package."""
    return list(_names())


def load_lens(source: str) -> Prescription:
    """A prescription by its name in the catalogue, or from a `.yaml` or `.zmx` file.

    Raises
    ------
    InputError
        For an unknown name (with the nearest ones), a file that cannot be read, and a lens that cannot be built: with
        the file, the field, its value and the remedy.
    MissingExtraError
        For a `.zmx` file without the extra `zemax`.
    """
    if source in _names():
        return _bundled(source)
    path = Path(source)
    if not path.is_file():
        near = difflib.get_close_matches(source, lens_names(), n=3, cutoff=0.4)
        known = f"did you mean {' or '.join(near)}?" if near else f"use a file, or one of {', '.join(lens_names())}"
        raise InputError("no such lens", where=source, remedy=known)
    stat = path.stat()
    return _from_file(source, stat.st_mtime_ns, stat.st_size)


def prescription_from_dict(content: Mapping[str, Any], where: str = "lens") -> Prescription:
    """A prescription from nested mappings, as its YAML holds them.

    Numbers without a unit are in the content's `unit`; coefficients of r^p are in unit^(1 - p).

    Raises
    ------
    InputError
        As `load_lens`.
    """
    plain = dict(content)
    unit = plain.pop("unit", "m")
    if unit not in _UNITS:
        raise InputError(f"unknown value {unit!r}", where=f"{where}: unit", remedy=f"use {', '.join(_UNITS)}")
    try:
        plain["surfaces"] = _in_metres(plain.get("surfaces"), _UNITS[unit], f"{where}: surfaces")
        plain["states"] = _states(plain.get("states"), _UNITS[unit], f"{where}: states")
    except ValueError as error:
        raise error if isinstance(error, InputError) else InputError(str(error), where=where) from error
    try:
        return _adapter().validate_python(plain)
    except ValidationError as error:
        raise first_fault(error, where, tuple(field_paths(Prescription))) from error


@functools.cache
def _names() -> tuple[str, ...]:
    folder = resources.files("tapetum.bench") / "lenses"
    return tuple(sorted(one.name.removesuffix(".yaml") for one in folder.iterdir() if one.name.endswith(".yaml")))


@functools.cache
def _adapter() -> TypeAdapter[Prescription]:
    return TypeAdapter(Prescription)


@functools.cache
def _bundled(name: str) -> Prescription:
    text = (resources.files("tapetum.bench") / "lenses" / f"{name}.yaml").read_text(encoding="utf-8")
    return prescription_from_dict(read_mapping(text, LENS_SCHEMA, name), name)


@functools.lru_cache(maxsize=64)
def _from_file(name: str, changed: int, size: int) -> Prescription:
    """The file as it was then: the two numbers tell a changed one from it."""
    if name.lower().endswith(".zmx"):
        from tapetum.bench.zemax import read_zemax

        return prescription_from_dict(read_zemax(name), name)
    try:
        text = Path(name).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read as text ({error})", where=name, remedy="give a YAML or .zmx file") from error
    return prescription_from_dict(read_mapping(text, LENS_SCHEMA, name), name)


def _in_metres(surfaces: object, unit: float, where: str) -> object:
    if not isinstance(surfaces, list):
        return surfaces
    return [_surface(one, unit, f"{where}.{i}") for i, one in enumerate(surfaces)]


def _surface(surface: object, unit: float, where: str) -> object:
    if not isinstance(surface, dict):
        return surface
    plain: dict[Any, Any] = dict(surface)
    for key in _LENGTHS:
        if plain.get(key) is not None:
            plain[key] = _length(plain[key], unit, f"{where}.{key}")
    asphere = plain.get("asphere")
    if isinstance(asphere, dict):
        terms: list[tuple[int, float]] = []
        for power, coefficient in asphere.items():
            if not str(power).isdigit() or isinstance(coefficient, bool):
                remedy = "write it as {4: -1.2e-3, 6: 3.4e-5}"
                raise InputError(f"{power!r}: {coefficient!r} is no term", where=f"{where}.asphere", remedy=remedy)
            try:
                # YAML takes 1e-5, without a point, for text.
                terms.append((int(power), float(coefficient) * unit ** (1 - int(power))))
            except (TypeError, ValueError, OverflowError) as error:
                what = f"coefficient {coefficient!r} of r^{power} is no number"
                raise InputError(what, where=f"{where}.asphere", remedy="give one, as 1.2e-3") from error
        plain["asphere"] = terms
    return plain


def _states(states: object, unit: float, where: str) -> object:
    """The moves of a state are written as mappings from a surface's number to the value."""
    if not isinstance(states, list):
        return states
    plain: list[object] = []
    for i, state in enumerate(states):
        if isinstance(state, dict):
            state = dict(state)
            for key in ("thickness", "semi_diameter"):
                moves = state.get(key)
                if isinstance(moves, dict):
                    state[key] = [
                        (number, _length(value, unit, f"{where}.{i}.{key}.{number}")) for number, value in moves.items()
                    ]
        plain.append(state)
    return plain


def _length(value: object, unit: float, where: str) -> float:
    """In metres: a bare number is in the file's unit, a text may carry its own."""
    try:
        return float(value) * unit  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError):
        pass
    except OverflowError as error:
        raise InputError("is out of range", where=where, remedy="give a length") from error
    try:
        return to_si(value, "m")
    except ValueError as error:
        what, _, remedy = str(error).partition("; ")
        raise InputError(what, where=where, remedy=remedy or None) from error
