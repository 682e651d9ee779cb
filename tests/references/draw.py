"""Random scenes over what a scene file admits, small enough for the judge: each kind has its turn.

`draw(seed, number)` is scene `number` of a seed: its kind and its plain values. Sizes are drawn by what decides
a picture (F-number, Fresnel number, defocus in dark rings, tilt in fractions of where the return ends), not by the
engine's own limits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["KINDS", "draw"]

Plain = dict[str, Any]

KINDS = (
    "mirror",
    "mirror, steep",
    "mirror, finite",
    "mirror, finite, diverging",
    "mirror, near",
    "focused just beyond f",
    "tilted sensor",
    "tilted sensor, finite",
    "sensor's edge",
    "layers",
    "tilted layers",
    "square photosites",
    "round photosites",
    "colours",
    "microlenses",
    "mask",
    "second beam",
    "colours of light",
    "narrow beam or wide source",
    "vergence",
    "traced",
    "traced, sensor",
    "traced, layers",
    "all at once",
    "traced, mask",
    "traced, near",
    "traced, far out",
)
_LENSES = (
    ("compact-6mm-f1.9", None),
    ("phone-a", None),
    ("phone-b", None),
    ("phone-c", None),
    ("phone-d", None),
    ("phone-e", None),
    ("phone-f", None),
    ("cmount-12mm-f1.4", 3.8e-3),
    ("cmount-12mm-f1.4", None),
    ("photo-50mm-f1.8", 12e-3),
    ("la1509", 20e-3),
)


class _Dice:
    """Random numbers by the names that the drawing needs."""

    def __init__(self, seed: int, number: int) -> None:
        self.generator = np.random.default_rng([seed, number])

    def even(self, low: float, high: float) -> float:
        return float(self.generator.uniform(low, high))

    def log(self, low: float, high: float) -> float:
        return float(math.exp(self.generator.uniform(math.log(low), math.log(high))))

    def chance(self, share: float) -> bool:
        return bool(self.generator.random() < share)

    def one(self, values: Any) -> Any:
        return values[int(self.generator.integers(len(values)))]

    def pair(self, most: float) -> list[float]:
        return [self.even(-most, most), self.even(-most, most)]


def draw(seed: int, number: int, folder: Path, kinds: Sequence[str] = KINDS) -> tuple[str, Plain]:
    """Kind and plain values of a scene; a mask's file goes into the folder.

    Kinds take turns: of a seed from before the newest ones, a number is the scene that it was with the `kinds` of then.
    """
    dice, kind = _Dice(seed, number), kinds[number % len(kinds)]
    if kind.startswith("traced"):
        return kind, _traced(dice, kind, folder)
    every = kind == "all at once"
    patterned = kind in ("square photosites", "colours", "mask") or (every and dice.chance(0.4))
    curved = kind in ("round photosites", "microlenses")
    finite = kind in ("mirror, finite", "mirror, finite, diverging", "tilted sensor, finite", "mirror, near") or (
        kind in ("layers", "second beam", "vergence", "square photosites") and dice.chance(0.25)
    )
    finite = finite or (every and dice.chance(0.4))

    wavelength = dice.even(450e-9, 950e-9)
    f_number = dice.log(1.2, 2.8) if kind == "mirror, steep" else dice.log(1.2, 16)
    # Fresnel's number r²/λf decides what the judge's sums cost.
    just = kind == "focused just beyond f"
    largest = 10.0 if just else 40.0 if curved else 100.0 if finite or patterned or "tilted" in kind else 300.0
    fresnel = dice.log(4 if just else 15 if curved else 25 if largest <= 100 else 40, largest)
    radius = 2 * f_number * wavelength * fresnel
    focal = 2 * f_number * radius
    defocus = dice.log(0.05, 4 if curved else 8 if patterned else 30)
    distance = 2 * radius**2 / (wavelength * defocus)
    if dice.chance(0.2):
        distance = math.inf
    if just:
        distance = focal * dice.log(1.08, 4)
    distance = max(distance, 1.05 * focal)
    z = 1 / (1 / focal - 1 / distance)
    away = dice.log(0.3, 0.7) if kind == "mirror, near" else dice.log(0.3, 20)
    accuracy = dice.one((3e-2, 1e-2) if curved else (3e-2, 1e-2, 1e-2, 3e-3, 3e-3, 1e-3))

    # Beyond this nothing of a mirror's return finds the pupil again.
    ends = math.atan(radius / z)
    tilt = ends * dice.even(0.3 if kind == "mirror, steep" else 0.0, 0.6 if curved else 1.15 if patterned else 0.95)
    if kind == "mask":
        tilt *= 0.25
    tilt, turn = min(tilt, math.radians(29.5)), dice.even(0, 2 * math.pi)
    tilts = [math.asin(math.sin(tilt) * math.cos(turn)), math.asin(math.sin(tilt) * math.sin(turn))]
    spot = z * math.tan(tilt)

    lens: Plain = {"kind": "thin", "focal_length": focal, "aperture_radius": radius}
    sensor: Plain = {"reflectance": dice.even(0.05, 0.5)}
    ring = wavelength * z / (2 * radius)
    # Mostly the sensor holds the spot with many rings; a spot near its edge is a kind of its own.
    half = spot * dice.even(1.0, 2.0) + 1.3 * radius * abs(z / focal - 1) + dice.log(40, 400) * ring
    if kind == "sensor's edge" or dice.chance(0.05):
        half = max(spot * dice.even(0.97, 1.15), 4 * ring)
    pitch = max(dice.log(1e-6, 9e-6), half / 8000)
    count = max(4, math.ceil(2 * half / pitch))
    sensor["pitch"], sensor["pixels"] = pitch, [count + int(dice.chance(0.5)), count]
    light: Plain = {"mode": "collimated", "wavelength": wavelength, "power": dice.log(1e-5, 1e-2)}
    light["diameter"] = 2 * radius * dice.even(1.25, 4)
    if kind in ("mirror, finite, diverging", "mirror, near") or (every and dice.chance(0.5)) or dice.chance(0.15):
        del light["diameter"]
        light["mode"] = "diverging"
        light["divergence"] = min(2 * math.atan(radius * dice.even(1.3, 6) / away), 1.2)
    elif dice.chance(0.15):
        light["mode"] = "fixed_area"

    if kind in ("tilted sensor", "tilted sensor, finite", "sensor's edge") or (every and dice.chance(0.5)):
        sensor["tilt"] = dice.pair(dice.log(1e-3, 0.03))
    if kind in ("sensor's edge", "tilted sensor") or (every and dice.chance(0.5)):
        sensor["decentre"] = dice.pair(0.2 * half)
    if kind in ("layers", "tilted layers") or (every and dice.chance(0.5)):
        sensor["layers"] = _layers(dice, kind, wavelength, f_number, focal)
        if dice.chance(0.5):
            light["coherence_length"] = dice.log(2e-5, 3e-3)
    if kind in ("square photosites", "round photosites", "colours", "microlenses") or (
        every and patterned and not finite
    ):
        sensor["array"] = _array(dice, kind, wavelength * f_number, curved)
    if kind == "microlenses":
        p = sensor["array"]["pitch"]
        sensor["microlens"] = {"focal_length": p**2 / (4 * wavelength * dice.even(0.2, 1.5)), "fill": dice.even(0.6, 1)}
        if dice.chance(0.35):
            sensor["microlens"]["shift"] = dice.even(-0.02, 0.02)
        if dice.chance(0.3):
            del sensor["array"]
            sensor["pitch"], sensor["pixels"] = p, [math.ceil(2 * half / p)] * 2
    if kind == "mask":
        sensor["mask"] = _mask(dice, folder, wavelength * f_number)
        sensor.pop("tilt", None)
    if kind == "second beam" or (every and dice.chance(0.5)):
        light["second_beam"] = {"ratio": dice.log(0.03, 1), "angle": dice.pair(dice.log(1e-4, 6e-3))}
    if kind == "colours of light" or (every and dice.chance(0.3)):
        light["wavelength"] = wavelength = dice.even(500e-9, 900e-9)
        if dice.chance(0.6):
            light["lines"] = [{"wavelength": dice.even(480e-9, 950e-9), "power": light["power"] * dice.even(0.2, 1)}]
        if dice.chance(0.5):
            light["bandwidth"] = dice.log(1e-9, 3e-8)
        if dice.chance(0.6):
            lens["glass"] = dice.one(("N-BK7", "N-SF11", "fused silica", "PMMA"))
            lens["design_wavelength"] = dice.even(550e-9, 700e-9)
    if kind == "narrow beam or wide source":
        if dice.chance(0.6):
            light = {
                **light,
                "mode": dice.one(("collimated", "fixed_area")),
                "diameter": 2 * radius * dice.even(0.4, 1),
            }
            light.pop("divergence", None)
        else:
            light["source_size"] = wavelength / (2 * radius) * dice.log(0.3, 4)
    if kind == "vergence":
        light["vergence"] = dice.one((-1, 1)) * dice.log(0.02, 20) * min(1.0, 30 * wavelength / radius**2 / 20)

    # The probe's picture holds the returning light by rays, and some rings.
    curvature = light.get("vergence", 0.0 if light["mode"] == "collimated" else 1 / away)
    slope_in = 1 / focal - curvature
    gain = 1 - 2 * z * slope_in
    leaves = radius / max(1.0, abs(gain)) * abs(slope_in + gain / focal)
    if kind in ("layers", "tilted layers"):
        leaves = min(leaves, 12 * wavelength / (2 * radius))
    probe_focal = dice.log(0.03, 0.2)
    angle = leaves * dice.even(1.0, 1.4) + dice.even(3, 8) * wavelength / (2 * radius)
    pixels = int(dice.generator.integers(29, 42))
    # Fresnel's number of the probe's aperture decides what the judge's sum over it costs.
    opening = radius * (math.sqrt(0.25 + dice.log(4, 30) * wavelength * away / radius**2) - 0.5)
    opening = min(opening, 220 * wavelength / (2 * math.pi * angle))
    probe = {
        "lens": {"focal_length": probe_focal, "aperture_radius": opening},
        "sensor": {"pixels": [pixels, pixels + 1], "pitch": 2 * probe_focal * math.tan(angle) / pixels},
        "transmission": dice.even(0.2, 1),
    }
    if light["mode"] == "collimated" and dice.chance(0.1) and opening > 1.2 * radius:
        light.pop("diameter", None)
    way = dice.one(("finite", "auto")) if finite else "far field"
    if kind == "mirror" and dice.chance(0.5):
        way = "auto"
    return kind, {
        "schema": "tapetum/scene/1",
        "distance": away,
        "illumination": light,
        "target": {"lens": lens, "object_distance": distance, "rotation": tilts, "sensor": sensor},
        "probe": probe,
        "sampling": {"accuracy": accuracy, "propagation": way},
    }


def _layers(dice: _Dice, kind: str, wavelength: float, f_number: float, focal: float) -> list[Plain]:
    found = []
    for _ in range(dice.one((1, 1, 2, 3))):
        index = dice.one((1.0, 1.5, 1.52, 1.8))
        # Out of focus by some dark rings: depth/n = rings λ N².
        depth = index * min(dice.log(0.5, 12) * 2 * wavelength * f_number**2, 0.3 * focal)
        layer: Plain = {"depth": depth, "index": index, "reflectance": dice.even(0.005, 0.3)}
        if dice.chance(0.3):
            layer["transmittance"] = dice.even(0.1, 0.7)
        if dice.chance(0.3):
            layer["reflectance"] = [[500e-9, dice.even(0, 0.3)], [800e-9, dice.even(0, 0.3)]]
            layer.pop("transmittance", None)
        if kind == "tilted layers":
            layer["tilt"] = dice.pair(dice.log(1e-3, 0.02))
        found.append(layer)
    return found


def _array(dice: _Dice, kind: str, unit: float, curved: bool) -> Plain:
    array: Plain = {"pitch": unit * (dice.log(2.5, 6) if curved else dice.log(1, 8)), "fill": dice.even(0.2, 1)}
    if kind == "round photosites" or (kind == "microlenses" and dice.chance(0.3)):
        array["shape"], array["fill"] = "round", dice.even(0.2, 0.78)
    if dice.chance(0.7):
        array["surround"], array["phase"] = dice.even(0, 1), dice.even(-math.pi, math.pi)
    if kind == "colours" or dice.chance(0.2):
        array["bayer"] = [dice.even(0, 1) for _ in range(4)]
    return array


def _mask(dice: _Dice, folder: Path, unit: float) -> Plain:
    side = int(dice.generator.integers(30, 60))
    values = dice.generator.random((side, side)) * np.exp(2j * math.pi * dice.generator.random((side, side)))
    if dice.chance(0.5):
        values = np.sign(dice.generator.random((side, side)) - 0.3) * (1 + 0j)
    pitch = unit * dice.log(1, 5)
    file = folder / f"mask-{dice.generator.integers(1 << 40):x}.npy"
    np.save(file, values)
    return {"file": str(file), "pitch": pitch}


def _traced(dice: _Dice, kind: str, folder: Path) -> Plain:
    name, focal = dice.one(_LENSES)
    wavelength = dice.even(530e-9, 850e-9)
    own = {"compact-6mm-f1.9": 6.0e-3, "cmount-12mm-f1.4": 12e-3, "photo-50mm-f1.8": 12e-3, "la1509": 20e-3}
    length = focal or own.get(name, 4.5e-3)
    least = {"compact-6mm-f1.9": 2.0, "cmount-12mm-f1.4": 1.5, "photo-50mm-f1.8": 1.9, "la1509": 4.5}.get(name, 3.6)
    number = dice.log(least, 8)
    lens: Plain = {
        "kind": "prescription",
        "name": name,
        "f_number": number,
        "focus": "unit",
        "design_wavelength": 587.56e-9,
    }
    if focal is not None:
        lens["focal_length"] = focal
    if dice.chance(0.5):
        lens["design_wavelength"] = wavelength
    radius = length / (2 * number)
    distance = math.inf if dice.chance(0.3) else max(2 * radius**2 / (wavelength * dice.log(0.05, 6)), 20 * length)
    tilt, turn = dice.even(0, 0.7 * math.atan(0.5 / number)), dice.even(0, 2 * math.pi)
    away = dice.log(0.5, 10)
    sensor: Plain = {"reflectance": dice.even(0.05, 0.5), "pixels": [2000, 1500], "pitch": 2.2e-6}
    if kind == "traced, sensor":
        if dice.chance(0.6):
            sensor["array"] = _array(dice, "square photosites", wavelength * number, False)
        if dice.chance(0.6):
            sensor["tilt"] = dice.pair(dice.log(1e-3, 0.02))
        sensor["decentre"] = dice.pair(2e-4)
    if kind == "traced, layers":
        sensor["layers"] = _layers(dice, "tilted layers" if dice.chance(0.4) else "layers", wavelength, number, length)
        for layer in sensor["layers"]:
            layer["depth"] = min(layer["depth"], 2e-4)
    if kind == "traced, mask":
        # On the mask, and seldom beside it.
        tilt *= 0.25
        sensor["mask"] = _mask(dice, folder, wavelength * number)
    if kind == "traced, near":
        return _near(dice, lens, wavelength, length)
    if kind == "traced, far out":
        return _far_out(dice, lens, wavelength, length)
    light: Plain = {"mode": "collimated", "wavelength": wavelength, "power": 1e-3, "diameter": 4 * length}
    if dice.chance(0.3):
        del light["diameter"]
        light |= {"mode": "diverging", "divergence": min(2 * math.atan(1.5 * length / away), 1.2)}
    if dice.chance(0.2):
        light["second_beam"] = {"ratio": dice.log(0.03, 1), "angle": dice.pair(1e-3)}
    probe_focal = dice.log(0.05, 0.2)
    leaves = 2 * radius / (distance + length) if math.isfinite(distance) else 0.0
    angle = leaves * 1.2 + dice.even(3, 7) * wavelength / (2 * radius)
    rotation = [tilt * math.cos(turn), tilt * math.sin(turn)]
    target = {"lens": lens, "object_distance": distance, "rotation": rotation, "sensor": sensor}
    opening = math.sqrt(dice.log(2, 20) * wavelength * away)
    return _seen(dice, away, light, target, (probe_focal, opening, angle), "far field")


def _near(dice: _Dice, lens: Plain, wavelength: float, length: float) -> Plain:
    """A traced lens seen through the probe's aperture: stopped down, so that its pupil is a disc, and often before an
    array, whose rows lie along the tilt then."""
    number = lens["f_number"] = max(lens["f_number"], dice.log(3.5, 16))
    radius = length / (2 * number)
    away = dice.log(0.3, 3)
    # By Fresnel's zones, of an infinite focus those of the way to the probe.
    focused = math.inf if dice.chance(0.15) else max(radius**2 / (wavelength * dice.log(0.5, 12)), 20 * length)
    tilt, turn = dice.even(0, 0.8 * math.atan(0.5 / number)), dice.even(0, 2 * math.pi)
    sensor: Plain = {"reflectance": dice.even(0.05, 0.5), "pixels": [3000, 2500], "pitch": 2.2e-6}
    if dice.chance(0.6):
        turn = dice.one((0, 1, 2, 3)) * math.pi / 2
        sensor["array"] = _array(dice, "square photosites", wavelength * number, False)
    if dice.chance(0.3):
        sensor["layers"] = _layers(dice, "layers", wavelength, number, length)
        for layer in sensor["layers"]:
            layer["depth"] = min(layer["depth"], 2e-4)
    light: Plain = {"mode": "collimated", "wavelength": wavelength, "power": 1e-3, "diameter": 4 * length}
    if dice.chance(0.7):
        del light["diameter"]
        light |= {"mode": "diverging", "divergence": min(2 * math.atan(1.5 * length / away), 1.2)}
    probe_focal, opening = dice.log(0.05, 0.2), math.sqrt(dice.log(2, 20) * wavelength * away)
    shift = abs(1 / away - (0.0 if math.isinf(focused) else 1 / focused))
    angle = 1.4 * radius * shift + dice.even(3, 7) * wavelength / (2 * min(radius, opening))
    # Along rows or columns to the last digit.
    rotation = [tilt * round(math.cos(turn), 15), tilt * round(math.sin(turn), 15)]
    target = {"lens": lens, "object_distance": focused, "rotation": rotation, "sensor": sensor}
    return _seen(dice, away, light, target, (probe_focal, opening, angle), "finite")


def _far_out(dice: _Dice, lens: Plain, wavelength: float, length: float) -> Plain:
    """A traced lens with a mirror, stopped down, so far out of focus that most of its light misses the aperture."""
    number = lens["f_number"] = max(lens["f_number"], dice.log(3.5, 16))
    radius = length / (2 * number)
    away = dice.log(0.3, 3)
    focused = max(radius**2 / (wavelength * dice.log(5, 30)), 4 * length)
    tilt, turn = dice.even(0, 0.6 * math.atan(0.5 / number)), dice.even(0, 2 * math.pi)
    light: Plain = {"mode": "diverging", "wavelength": wavelength, "power": 1e-3}
    light["divergence"] = min(2 * math.atan(1.5 * length / away), 1.2)
    opening = dice.log(0.2, 3) * radius
    # By rays to the aperture, or of all that returns, and some dark rings.
    angle = min(1.4 * radius * abs(1 / away - 1 / focused), (opening + radius) / away)
    angle += dice.even(3, 7) * wavelength / (2 * min(radius, opening))
    rotation = [tilt * math.cos(turn), tilt * math.sin(turn)]
    sensor: Plain = {"reflectance": dice.even(0.05, 0.5), "pixels": [3000, 2500], "pitch": 2.2e-6}
    target = {"lens": lens, "object_distance": focused, "rotation": rotation, "sensor": sensor}
    return _seen(dice, away, light, target, (dice.log(0.05, 0.2), opening, angle), "finite")


def _seen(dice: _Dice, away: float, light: Plain, target: Plain, probe: tuple[float, float, float], way: str) -> Plain:
    """A traced lens's scene; of the probe the focal length, the aperture's radius and half of the picture's angle."""
    focal, opening, angle = probe
    return {
        "schema": "tapetum/scene/1",
        "distance": away,
        "illumination": light,
        "target": target,
        "probe": {
            "lens": {"focal_length": focal, "aperture_radius": opening},
            "sensor": {"pixels": [33, 33], "pitch": 2 * focal * angle / 33},
        },
        "sampling": {"accuracy": dice.one((0.01, 0.03, 0.05)), "propagation": way},
    }
