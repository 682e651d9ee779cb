"""Parameters of Fisher information, and which of them have no limit in a scene."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from tapetum.bench import PhoneTarget, PrescriptionLens, Scene
from tapetum.errors import InputError
from tapetum.simulate.radiometry import beam_radius
from tapetum.simulate.reflections import only_sensor

__all__ = ["NUISANCES", "PARAMETERS", "PHOTOSITES", "TRACED", "check_names", "checked_parameters"]
__all__ += ["has_photosites", "not_told"]

PARAMETERS = {
    "gaze_x": "fraction of the field",
    "gaze_y": "fraction of the field",
    "object_distance": "m",
    "focal_length": "m",
    "distance": "m",
    "power": "W",
    "place_x": "m on the probe's sensor",
    "place_y": "m on the probe's sensor",
}
"""What the frame of a thin lens is differentiated by, with units."""

TRACED = tuple(name for name in PARAMETERS if name != "distance")
"""What a traced lens's frame is differentiated by."""

NUISANCES = {
    "roll": "rad",
    "photosite_x": "m on the target's sensor",
    "photosite_y": "m on the target's sensor",
}
"""What else may be unknown of a traced lens: the turn of the target about the line of sight, from x to y, and where
among the photosites its sensor's spot falls, the gaze left as it is."""

PHOTOSITES = {"photosite_x", "photosite_y"}


def has_photosites(scene: Scene) -> bool:
    """Whether the target's sensor is more than a mirror."""
    return scene.target.sensor.array is not None or scene.target.sensor.microlens is not None


def not_told(scene: Scene, name: str) -> str | None:
    """Why there is no limit for a parameter in a scene; None where there is one."""
    refused = _refusal(scene, name)
    return refused and refused[0]


def checked_parameters(scene: Scene, parameters: Sequence[str], known: Iterable[str] = PARAMETERS) -> tuple[str, ...]:
    """Parameters of `fisher`, checked against the `known` ones; refuse those without a limit in the scene."""
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    check_names(names, "parameters", known)
    if not names or len(set(names)) < len(names):
        raise InputError(f"{list(names)} names none, or one twice", where="parameters", remedy="name each once")
    for name in names:
        if (refused := _refusal(scene, name)) is not None:
            why, other = refused
            raise InputError(f"{name}: {why}", where="parameters", remedy=f"leave {name} out, or {other}")
    return names


def check_names(names: Iterable[str], where: str, known: Iterable[str] = PARAMETERS) -> None:
    """Raise an InputError for a parameter that is not among the `known` ones."""
    all_known = tuple(known)
    for name in names:
        if name not in all_known:
            raise InputError(f"unknown parameter {name!r}", where=where, remedy=f"use {', '.join(all_known)}")


def _refusal(scene: Scene, name: str) -> tuple[str, str] | None:
    """Why a parameter has no limit, and what would give it one."""
    target, sensor, light = scene.target, scene.target.sensor, scene.illumination
    if isinstance(target, PhoneTarget):
        why = "not computed for a phone, of which several cameras may answer"
        return why, "take one of its cameras for the target"
    if name == "object_distance" and math.isinf(target.object_distance):
        return "the target is focused at infinity", "focus where it is not infinite"
    if isinstance(target.lens, PrescriptionLens):
        if sensor.mask is not None:
            return "light off a mask is not differentiated behind a traced lens", "take a thin lens, or an array"
        if name not in TRACED and name not in NUISANCES:
            return "not differentiated through a traced lens", "take a thin lens"
        if name in PHOTOSITES and not has_photosites(scene):
            return "the target's sensor is a mirror without photosites", "give the sensor an array"
        if name in ("object_distance", "focal_length") and not only_sensor(scene):
            why = "light off layers, off lens surfaces or scattered is not followed as a traced lens changes focus"
            return why, "take a thin lens, or layers, diffuse and coating out of the scene"
        return None
    scatters = any(
        one is not None and one.albedo > 0 for one in (sensor.diffuse, *(la.diffuse for la in sensor.layers))
    )
    if scatters and name not in ("gaze_x", "gaze_y", "power"):
        return "how scattered light changes with it is not differentiated", "leave diffuse out of the scene"
    if name != "distance":
        return None
    if light.wave.spreads and beam_radius(scene) < target.lens.aperture_radius:
        why = "the beam does not fill the target, and how its edge moves with the distance is not differentiated"
        return why, "widen illumination.divergence"
    if sensor.mask is not None and light.follows_distance:
        why = "how light off a mask changes with the distance of its source is not differentiated"
        return why, "give illumination.vergence"
    return None
