"""Zemax's `.zmx` files, read by optiland (extra `zemax`) into the catalogue's own form."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from tapetum.errors import InputError, need

__all__ = ["read_zemax"]

_UNITS = {"MM": "mm", "CM": "cm", "METER": "m", "IN": "inch"}
_LINES = {"F": 0.486133, "d": 0.587562, "C": 0.656273}
# Power of r of a surface's first coefficient, and the step to the next.
_POWERS = {"standard": (2, 2), "even_asphere": (2, 2), "odd_asphere": (1, 1)}


def read_zemax(name: str) -> dict[str, Any]:
    """Return the first configuration of a file, as nested mappings for `prescription_from_dict`.

    Glasses come as n_d and Abbe number of the file's catalogue; semi-diameters are the file's own, its apertures where
    it has them. Raises an InputError for a file that optiland cannot read, mirrors, and surfaces that are tilted or not
    rotationally symmetric; a MissingExtraError without optiland.
    """
    parser = need("optiland.fileio.zemax.reader.parser", "zemax")
    try:
        model = parser.ZemaxDataParser(name).parse()
    except Exception as error:
        # Its parser raises errors of any kind on unexpected lines.
        what = f"optiland cannot read it ({type(error).__name__}: {error})"
        raise InputError(what, where=name, remedy="give a sequential .zmx file, saved as text") from error
    numbers = sorted(model.surfaces)
    if len(numbers) < 3:
        raise InputError("holds no surface between object and image", where=name, remedy="give a lens")
    surfaces = [_surface(model.surfaces[i], f"{name}: surface {i}") for i in numbers[1:-1]]
    # Planes in air before and behind the lens only set distances of the drawing.
    while len(surfaces) > 1 and _empty(surfaces[0]):
        surfaces.pop(0)
    state: dict[str, Any] = {"name": "prime", "half_field": _half_field(model.fields)}
    return {
        "name": Path(name).stem,
        "source": f"Zemax file {Path(name).name}",
        "assumed": ["semi-diameters as in the file", "glasses by n_d and Abbe number, between them a normal glass"],
        "unit": _unit(name),
        "states": [state],
        "surfaces": surfaces,
    }


def _surface(raw: dict[str, Any], where: str) -> dict[str, Any]:
    kind = raw.get("type", "standard")
    if kind not in _POWERS:
        raise InputError(f"is of the type {kind}", where=where, remedy="use standard, even and odd aspheres only")
    thickness, radius = float(raw.get("thickness", 0.0)), float(raw.get("radius", math.inf))
    if not math.isfinite(thickness):
        raise InputError("lies at infinity", where=where, remedy="give it a thickness")
    first, step = _POWERS[kind]
    asphere: dict[int, float] = {}
    for k in range(8 if kind != "standard" else 0):
        coefficient = float(raw.get(f"param_{k}", 0.0))
        if coefficient and first + step * k < 2:
            raise InputError(f"has a cone, r^1 of {coefficient:g}", where=where, remedy="use powers from 2 on")
        if coefficient:
            asphere[first + step * k] = coefficient
    aperture = raw.get("aperture")
    semi_diameter = float(raw.get("diameter", 0.0) if aperture is None else aperture.r_max)
    if not semi_diameter > 0:
        raise InputError("has no semi-diameter", where=where, remedy="save the file with its DIAM lines")
    return {
        "radius": None if math.isinf(radius) else radius,
        "thickness": thickness,
        "semi_diameter": semi_diameter,
        "conic": float(raw.get("conic", 0.0)),
        "asphere": asphere,
        "stop": bool(raw.get("is_stop", False)),
        **_medium(raw, where),
    }


def _medium(raw: dict[str, Any], where: str) -> dict[str, float]:
    material = raw.get("material", "air")
    if material == "air":
        return {}
    if material == "mirror":
        raise InputError("is a mirror", where=where, remedy="use a lens of refracting surfaces")
    if type(material).__name__ == "AbbeMaterial":
        if raw.get("index") is None or raw.get("abbe") is None:
            remedy = "write its index and Abbe number in the file"
            raise InputError("names an unknown glass", where=where, remedy=remedy)
        return {"nd": float(raw["index"]), "vd": float(raw["abbe"])}
    n = {line: float(material.n(wavelength).item()) for line, wavelength in _LINES.items()}
    return {"nd": n["d"], "vd": (n["d"] - 1) / (n["F"] - n["C"])}


def _empty(surface: dict[str, Any]) -> bool:
    return surface["radius"] is None and not surface["stop"] and "nd" not in surface and not surface["asphere"]


def _half_field(fields: dict[str, Any]) -> float | None:
    """The largest angle of the file's fields, where they are angles."""
    if fields.get("type") != "angle":
        return None
    largest = max((math.hypot(x, y) for x, y in zip(fields["x"], fields["y"], strict=True)), default=0.0)
    return math.radians(largest) if 0 < largest < 90 else None


def _unit(name: str) -> str:
    """The file's unit of length, which optiland ignores."""
    content = Path(name).read_bytes()
    text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1", errors="replace")
    for line in text.splitlines():
        words = line.split()
        if len(words) > 1 and words[0] == "UNIT":
            if words[1] not in _UNITS:
                raise InputError(f"has the unit {words[1]}", where=name, remedy=f"use {', '.join(_UNITS)}")
            return _UNITS[words[1]]
    return "mm"
