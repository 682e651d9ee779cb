"""What can be set in the playground: one table, with the field of the scene that each value sets.

To add a slider, write a line in `SETTINGS`; one that sets more than the number at a path needs code in `apply` too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch

from tapetum.bench import (
    PhoneTarget,
    PrescriptionLens,
    Scene,
    Target,
    ThinLens,
    lens_names,
    load_lens,
    phone_names,
    with_values,
)
from tapetum.bench.zoom import focal_range
from tapetum.errors import InputError
from tapetum.simulate.gaze import gaze_of, tilt_of_gaze

__all__ = ["MIRROR", "SETTINGS", "THIN", "Setting", "Value", "apply", "limits_of_lens", "settings_of"]

Value = float | str

THIN = "thin lens"
MIRROR = "none"
_SHAPES = ("square", "round", "hexagon")
_COARSEST = 0.03
"""Accuracy, in fractions of the peak, asked for when a catalogue lens is put into a scene: finer takes seconds."""
_FARTHEST = 1000.0


@dataclass(frozen=True)
class Setting:
    """One value that may be set.

    Parameters
    ----------
    name, label, group
        As in requests and links; as on the page, and under which heading.
    unit
        Of the value as set and shown.
    low, high, step
        Range in that unit, and the step of the keyboard; a `log` one is stepped by a factor.
    path
        Field of the scene; "" for values that `apply` puts together.
    factor
        SI units in one of `unit`.
    log
        Whether a slider runs over the logarithm.
    choices
        Words in place of numbers.
    infinite
        Whether the highest value stands for infinity.
    """

    name: str
    label: str
    group: str
    unit: str = ""
    low: float = 0.0
    high: float = 1.0
    step: float = 0.01
    path: str = ""
    factor: float = 1.0
    log: bool = False
    choices: tuple[str, ...] = ()
    infinite: bool = False

    def checked(self, value: object) -> Value:
        """Return a value in range; InputError names this setting, the value and the range."""
        if self.choices:
            if value not in self.choices:
                remedy = f"use {', '.join(self.choices)}"
                raise InputError(f"unknown value {value!r:.60}", where=self.name, remedy=remedy)
            return str(value)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(
                f"must be a number, is {value!r:.60}", where=self.name, remedy=f"give {self.unit or 'one'}"
            )
        slack = 1e-9 * max(abs(self.low), abs(self.high))
        if not self.low - slack <= value <= self.high + slack:
            remedy = f"give {self.low:g} to {self.high:g} {self.unit}"
            raise InputError(f"{value:g} is out of range", where=self.name, remedy=remedy)
        return float(value)


_TARGET, _LIGHT, _PROBE, _SENSOR = "Target", "Light", "Probe", "Target's sensor"

SETTINGS: tuple[Setting, ...] = (
    Setting("gaze_x", "gaze x", _TARGET, "of field", -0.5, 0.5, 0.005),
    Setting("gaze_y", "gaze y", _TARGET, "of field", -0.5, 0.5, 0.005),
    Setting(
        "focus", "focused at", _TARGET, "m", 0.2, _FARTHEST, 0.01, "target.object_distance", log=True, infinite=True
    ),
    Setting("lens", "lens", _TARGET, choices=(THIN, *lens_names())),
    Setting("focal_length", "focal length", _TARGET, "mm", 2, 300, 0.01, log=True, factor=1e-3),
    Setting("f_number", "F-number", _TARGET, "", 1.2, 64, 0.02, log=True),
    Setting("phone", "phone", _TARGET, choices=tuple(phone_names())),
    Setting("imaging", "camera app", _TARGET, choices=("open", "closed")),
    Setting("distance", "distance", _TARGET, "m", 0.3, 100, 0.01, "distance", log=True),
    Setting("tilt_x", "tilt x", _SENSOR, "deg", -2, 2, 0.01, factor=math.pi / 180),
    Setting("tilt_y", "tilt y", _SENSOR, "deg", -2, 2, 0.01, factor=math.pi / 180),
    Setting("reflectance", "reflectance", _SENSOR, "", 0, 1, 0.01, "target.sensor.reflectance"),
    Setting("photosites", "photosites", _SENSOR, choices=(MIRROR, *_SHAPES)),
    Setting("photosite_pitch", "their pitch", _SENSOR, "µm", 0.8, 12, 0.02, factor=1e-6, log=True),
    Setting("fill", "their fill", _SENSOR, "", 0.05, 1, 0.01),
    Setting("filter", "filter reflects", _SENSOR, "", 0, 1, 0.01),
    Setting("filter_depth", "its distance", _SENSOR, "mm", 0.05, 5, 0.02, factor=1e-3, log=True),
    Setting("wavelength", "wavelength", _LIGHT, "nm", 405, 1000, 1, "illumination.wavelength", 1e-9),
    Setting("power", "power", _LIGHT, "mW", 1e-4, 100, 0.02, "illumination.power", 1e-3, log=True),
    Setting("mode", "beam", _LIGHT, choices=("collimated", "diverging")),
    Setting("divergence", "divergence", _LIGHT, "deg", 0.05, 10, 0.02, factor=math.pi / 180, log=True),
    Setting("second_beam", "second beam", _LIGHT, "", 0, 1, 0.01),
    Setting("second_x", "its angle x", _LIGHT, "mrad", -3, 3, 0.05, factor=1e-3),
    Setting("second_y", "its angle y", _LIGHT, "mrad", -3, 3, 0.05, factor=1e-3),
    Setting("exposure", "exposure", _PROBE, "ms", 1e-3, 100, 0.02, "probe.sensor.exposure", 1e-3, log=True),
    Setting("background", "stray light", _PROBE, "e⁻", 0, 500, 1, "probe.sensor.background"),
    Setting("read_noise", "read noise", _PROBE, "e⁻", 0, 50, 0.5, "probe.sensor.read_noise"),
    Setting("probe_aperture", "aperture", _PROBE, "mm", 2, 50, 0.02, "probe.lens.aperture_radius", 0.5e-3, log=True),
    Setting("accuracy", "accuracy", _PROBE, "of peak", 1e-3, 0.3, 0.2, "sampling.accuracy", log=True),
)
"""All settings, in the order of the page."""

_BY_NAME = {one.name: one for one in SETTINGS}


def settings_of(scene: Scene) -> dict[str, Value]:
    """Return the values of the settings that a scene has; those beyond a slider's range as they are.

    A gaze is left out where the scene's rotation lies beyond the target's field.
    """
    target, light = scene.target, scene.illumination
    found: dict[str, Value] = {}
    try:
        gaze = gaze_of(scene, torch.sin(torch.tensor(target.rotation, dtype=torch.float64)))
        found |= {"gaze_x": float(gaze[0]), "gaze_y": float(gaze[1])}
    except InputError:
        pass
    found["focus"] = min(target.object_distance, _FARTHEST)
    if isinstance(target, PhoneTarget):
        found |= {"phone": target.name, "imaging": "open" if target.imaging else "closed"}
    else:
        found |= _of_lens_and_sensor(target)
    second, divergence = light.second_beam, light.divergence
    angle = (0.9e-3, 0.4e-3) if second is None else second.angle
    found |= {"mode": light.mode, "divergence": 0.5 if divergence is None else math.degrees(divergence)}
    found |= {"second_beam": 0.0 if second is None else second.ratio}
    found |= {"second_x": angle[0] * 1e3, "second_y": angle[1] * 1e3}
    for one in SETTINGS:
        if one.path and one.name not in found and not (isinstance(target, PhoneTarget) and "target." in one.path):
            value: Any = scene
            for step in one.path.split("."):
                value = getattr(value, step)
            found[one.name] = value / one.factor
    return {one.name: found[one.name] for one in SETTINGS if one.name in found}


def _of_lens_and_sensor(target: Any) -> dict[str, Value]:
    lens, sensor = target.lens, target.sensor
    array, layer = sensor.array, sensor.layers[0] if sensor.layers else None
    pitch = sensor.pitch if array is None or array.pitch is None else array.pitch
    return {
        "lens": lens.name if isinstance(lens, PrescriptionLens) else THIN,
        "focal_length": lens.focal_length * 1e3,
        "f_number": lens.focal_length / (2 * lens.aperture_radius),
        "tilt_x": math.degrees(sensor.tilt[0]),
        "tilt_y": math.degrees(sensor.tilt[1]),
        "photosites": MIRROR if array is None else array.shape,
        "photosite_pitch": pitch * 1e6,
        "fill": 0.5 if array is None else array.fill,
        "filter": 0.0 if layer is None or not isinstance(layer.reflectance, float) else layer.reflectance,
        "filter_depth": 1.0 if layer is None else layer.depth * 1e3,
    }


def apply(base: Scene, values: Mapping[str, object], *, thin: bool = False) -> Scene:
    """Return a scene with some settings changed, checked again as a whole.

    The gaze is set last: it stays where focus or lens change. A setting that the scene has not, as a phone's lens, is
    refused, as are values out of range; what the bench or the engine refuses is said in their words. With `thin` a
    traced lens becomes a thin one of its focal length and aperture before that, and no ray is traced for the gaze.

    Raises
    ------
    InputError
        With the setting's name, its value, and what to give.
    """
    own = settings_of(base)
    given: dict[str, Any] = {}
    for name, value in values.items():
        if name not in _BY_NAME:
            raise InputError("there is no such setting", where=f"{name:.60}", remedy=f"use {', '.join(_BY_NAME)}")
        if name not in own and not name.startswith("gaze_"):
            raise InputError("this scene has no such setting", where=name, remedy="leave it out")
        given[name] = _BY_NAME[name].checked(value)
    changes = {_BY_NAME[name].path: _in_si(name, given[name]) for name in given if _BY_NAME[name].path}
    for part in (_lens, _phone, _sensor, _light):
        changes |= part(base, given, {**own, **given})
    scene = with_values(base, changes, where="bench") if changes else base
    lens = scene.target.lens
    if thin and isinstance(scene.target, Target) and isinstance(lens, PrescriptionLens):
        scene = replace(scene, target=replace(scene.target, lens=ThinLens(lens.focal_length, lens.aperture_radius)))
    if "gaze_x" in given or "gaze_y" in given:
        wanted = [given.get(name, own.get(name, 0.0)) for name in ("gaze_x", "gaze_y")]
        sines = tilt_of_gaze(scene, torch.tensor(wanted, dtype=torch.float64)).tolist()
        rotation = [f"{math.asin(max(-1.0, min(1.0, sine)))!r} rad" for sine in sines]
        scene = with_values(scene, {"target.rotation": rotation}, where="bench")
    return scene


def _in_si(name: str, value: float) -> float:
    one = _BY_NAME[name]
    return math.inf if one.infinite and value >= one.high else value * one.factor


def _lens(base: Scene, given: Mapping[str, Any], all_of: Mapping[str, Any]) -> dict[str, Any]:
    if isinstance(base.target, PhoneTarget) or not {"lens", "focal_length", "f_number"} & set(given):
        return {}
    name, own = all_of["lens"], base.target.lens
    if name == THIN:
        focal = all_of["focal_length"] * 1e-3
        plain = {"kind": "thin", "focal_length": focal, "aperture_radius": focal / (2 * all_of["f_number"])}
        if not isinstance(own, PrescriptionLens) and own.glass is not None:
            plain |= {"glass": own.glass, "design_wavelength": own.design_wavelength}
        return {"target.lens": plain}
    real: dict[str, Any] = {"kind": "prescription", "name": name}
    same = isinstance(own, PrescriptionLens) and own.name == name
    if "focal_length" in given or same:
        real["focal_length"] = all_of["focal_length"] * 1e-3
    elif len(states := limits_of_lens(name)[0]) > 1:
        real["focal_length"] = math.sqrt(states[0] * states[-1])
    if "f_number" in given:
        # A slider at its end means wide open.
        real["f_number"] = max(given["f_number"], limits_of_lens(name)[1])
    elif same and isinstance(own, PrescriptionLens) and own.f_number is not None:
        real["f_number"] = own.f_number
    if same and isinstance(own, PrescriptionLens):
        real |= {"design_wavelength": own.design_wavelength}
    coarser = {"sampling.accuracy": max(base.sampling.accuracy, _COARSEST)} if "accuracy" not in given else {}
    return {"target.lens": real, **coarser}


def _phone(base: Scene, given: Mapping[str, Any], all_of: Mapping[str, Any]) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if "phone" in given:
        changes["target.name"] = given["phone"]
    if "imaging" in given:
        changes["target.imaging"] = given["imaging"] == "open"
    return changes


def _sensor(base: Scene, given: Mapping[str, Any], all_of: Mapping[str, Any]) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if {"tilt_x", "tilt_y"} & set(given):
        changes["target.sensor.tilt"] = [math.radians(all_of[name]) for name in ("tilt_x", "tilt_y")]
    if {"photosites", "photosite_pitch", "fill"} & set(given):
        array = None
        if all_of["photosites"] != MIRROR:
            now = base.target.sensor.array
            kept = {} if now is None else {"surround": now.surround, "phase": now.phase}
            pitch = all_of["photosite_pitch"] * 1e-6
            array = {"pitch": pitch, "fill": all_of["fill"], "shape": all_of["photosites"], **kept}
        changes["target.sensor.array"] = array
    if {"filter", "filter_depth"} & set(given):
        rest = base.target.sensor.layers[1:]
        if rest:
            what = f"this scene has {len(rest) + 1} layers, which one slider cannot set separately"
            raise InputError(what, where="filter", remedy="change them in a scene file")
        depth, share = all_of["filter_depth"] * 1e-3, all_of["filter"]
        changes["target.sensor.layers"] = [{"depth": depth, "reflectance": share}] if share > 0 else []
    return changes


def _light(base: Scene, given: Mapping[str, Any], all_of: Mapping[str, Any]) -> dict[str, Any]:
    changes: dict[str, Any] = {}
    if {"mode", "divergence"} & set(given):
        spreads = all_of["mode"] == "diverging"
        changes["illumination.mode"] = all_of["mode"]
        changes["illumination.divergence"] = math.radians(all_of["divergence"]) if spreads else None
        if spreads:
            changes["illumination.diameter"] = None
    if {"second_beam", "second_x", "second_y"} & set(given):
        angle = [all_of["second_x"] * 1e-3, all_of["second_y"] * 1e-3]
        ratio = all_of["second_beam"]
        changes["illumination.second_beam"] = {"ratio": ratio, "angle": angle} if ratio > 0 else None
    return changes


def limits_of_lens(name: str) -> tuple[tuple[float, ...], float]:
    """Return the focal lengths of a catalogue lens's states, in metres, and the F-number at which it is wide open."""
    found = _LIMITS.get(name)
    if found is None:
        lens = PrescriptionLens(name, focal_length=focal_range(load_lens(name), _DESIGN)[0])
        found = focal_range(load_lens(name), _DESIGN), lens.focal_length / (2 * lens.aperture_radius)
        _LIMITS[name] = found
    return found


_DESIGN = 587.56e-9
_LIMITS: dict[str, tuple[tuple[float, ...], float]] = {}
