"""Prescriptions from the catalogue, from YAML files and from Zemax's."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any

from tapetum.bench.catalogue import Catalogue
from tapetum.bench.faults import build
from tapetum.bench.lens_data import Prescription
from tapetum.errors import InputError

__all__ = ["LENS_SCHEMA", "lens_names", "load_lens", "prescription_from_dict"]

LENS_SCHEMA = "tapetum/lens/1"
_LENSES = Catalogue("lens", LENS_SCHEMA, "lenses", "YAML or .zmx", likeness=0.4)
_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "inch": 25.4e-3}


def lens_names() -> list[str]:
    """Names of the lenses that come with the package."""
    return list(_LENSES.names)


def load_lens(source: str) -> Prescription:
    """Load a prescription by its name in the catalogue, or from a `.yaml` or `.zmx` file.

    Raises
    ------
    InputError
        For an unknown name (with the nearest ones), an unreadable file, or a lens that cannot be built: with the file,
        the field, its value and the remedy.
    MissingExtraError
        For a `.zmx` file without the extra `zemax`.
    """
    if source in _LENSES.names:
        return _loaded(source, 0, 0)
    stat = _LENSES.path(source).stat()
    return _loaded(source, stat.st_mtime_ns, stat.st_size)


def prescription_from_dict(content: Mapping[str, Any], where: str = "lens") -> Prescription:
    """Build a prescription from nested mappings, as read from YAML; raises as `load_lens`.

    Numbers without a unit are in the content's `unit`; coefficients of r^p are in unit^(1 - p).
    """
    plain = dict(content)
    unit = plain.pop("unit", "m")
    if unit not in _UNITS:
        raise InputError(f"unknown value {unit!r}", where=f"{where}: unit", remedy=f"use {', '.join(_UNITS)}")
    return build(Prescription, plain, where, unit=_UNITS[unit])


@functools.lru_cache(maxsize=64)
def _loaded(source: str, changed: int, size: int) -> Prescription:
    """Cached by the file's modification time and size, so that a changed file is read again."""
    if source.lower().endswith(".zmx"):
        from tapetum.bench.zemax import read_zemax

        return prescription_from_dict(read_zemax(source), source)
    return prescription_from_dict(_LENSES.read(source), source)
