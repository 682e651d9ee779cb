"""Units: a catalogue entry is a model of a camera, and a recording films one copy of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from tapetum.bench.load import as_scene
from tapetum.bench.prescription import PrescriptionLens, load_lens
from tapetum.bench.scene import PhoneTarget, Scene, Target, ThinLens
from tapetum.bench.sensors import TargetSensor
from tapetum.bench.tolerances import (
    AngleTolerance,
    LengthTolerance,
    ShareTolerance,
    Tolerances,
    load_tolerances,
)
from tapetum.bench.zoom import focal_range
from tapetum.errors import InputError

__all__ = ["draw_unit", "usual_tolerances"]


def usual_tolerances(scene: Scene | str) -> Tolerances:
    """Return the bundled tolerances for the kind of a scene's target: `thin`, `traced` or `phone`."""
    target = as_scene(scene).target
    if isinstance(target, PhoneTarget):
        return load_tolerances("phone")
    return load_tolerances("thin" if isinstance(target.lens, ThinLens) else "traced")


def draw_unit(scene: Scene | str, tolerances: Tolerances | str | None, seed: int) -> Scene:
    """Return the scene with one copy of its camera and of its beam splitter, drawn from tolerances.

    The same arguments give the same copy. Every quantity has random numbers of its own, so that leaving one out of the
    tolerances does not change the others. Sensor and filter tilts, decentre and a phone's axes are drawn about 0, and
    replace those of the scene, which are one copy's; everything else is drawn about the scene's value.

    Parameters
    ----------
    scene
        The model: a scene, or as `load_scene` takes it.
    tolerances
        `Tolerances`, as `load_tolerances` takes them, or None for those of the kind of target.
    seed
        Of the copy; not negative.

    Raises
    ------
    InputError
        For a seed that is no whole number from 0 on, and as `load_scene` and `load_tolerances`.
    """
    scene = as_scene(scene)
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer) or seed < 0:
        raise InputError(f"must be a whole number from 0 on, is {seed!r}", where="seed", remedy="give 0 for example")
    if tolerances is None:
        tolerances = usual_tolerances(scene)
    elif isinstance(tolerances, str):
        tolerances = load_tolerances(tolerances)
    draw = _Draw(int(seed))
    target = _phone(scene.target, tolerances, draw) if isinstance(scene.target, PhoneTarget) else None
    if target is None:
        assert isinstance(scene.target, Target)
        lens = _lens(scene.target.lens, tolerances, draw)
        sensor = _sensor(scene.target.sensor, tolerances, draw)
        focus = _focused(scene.target, tolerances, draw)
        target = replace(scene.target, lens=lens, sensor=sensor, object_distance=focus)
    light = scene.illumination
    if light.second_beam is not None:
        beam, turn = light.second_beam, tolerances.beam_angle
        angle = tuple(one * draw.factor(f"beam_angle.{axis}", turn) for axis, one in zip("xy", beam.angle, strict=True))
        ratio = min(1.0, beam.ratio * draw.factor("beam_ratio", tolerances.beam_ratio))
        light = replace(light, second_beam=replace(beam, ratio=ratio, angle=(angle[0], angle[1])))
    return replace(scene, target=target, illumination=light)


@dataclass(frozen=True)
class _Draw:
    """Random numbers of one copy, by name."""

    seed: int
    prefix: str = ""

    def within(self, prefix: str) -> _Draw:
        return _Draw(self.seed, f"{self.prefix}{prefix}.")

    def __call__(self, name: str, tolerance: AngleTolerance | LengthTolerance | ShareTolerance | None) -> float:
        """Return a number of a normal distribution that is cut off at the tolerance's limits; 0 without one."""
        if tolerance is None:
            return 0.0
        key = [self.seed, *f"{self.prefix}{name}".encode()]
        most = tolerance.limit / tolerance.spread
        low, high = ndtr([-most, most])
        drawn = np.random.default_rng(np.random.SeedSequence(key)).uniform(low, high)
        return float(tolerance.spread * np.clip(ndtri(drawn), -most, most))

    def factor(self, name: str, tolerance: ShareTolerance | None) -> float:
        return 1 + self(name, tolerance)

    def pair(
        self, name: str, tolerance: AngleTolerance | LengthTolerance | None, usual: tuple[float, float]
    ) -> tuple[float, float]:
        if tolerance is None:
            return usual
        return self(f"{name}.x", tolerance), self(f"{name}.y", tolerance)


def _lens(lens: ThinLens | PrescriptionLens, tolerances: Tolerances, draw: _Draw) -> ThinLens | PrescriptionLens:
    longer, wider = draw.factor("focal_length", tolerances.focal_length), draw.factor("aperture", tolerances.aperture)
    if isinstance(lens, ThinLens):
        return replace(lens, focal_length=lens.focal_length * longer, aperture_radius=lens.aperture_radius * wider)
    changed: dict[str, Any] = {}
    if tolerances.focal_length is not None:
        # A zoom has a range; a prime lens is scaled.
        own = focal_range(load_lens(lens.name), lens.design_wavelength)
        length = lens.focal_length * longer
        changed["focal_length"] = min(max(length, own[0]), own[-1]) if len(own) > 1 else length
    if tolerances.aperture is not None:
        open_wide = replace(lens, f_number=None, **changed)
        fastest = open_wide.focal_length / (2 * open_wide.aperture_radius)
        number = lens.focal_length / (2 * lens.aperture_radius) / wider
        # Where it is wide open it opens no farther.
        changed["f_number"] = number if number > fastest else None
    if tolerances.coating is not None:
        changed["coating"] = _scaled(lens.coating, draw.factor("coating", tolerances.coating))
    return replace(lens, **changed)


def _scaled(spectrum: Any, factor: float) -> Any:
    if isinstance(spectrum, int | float):
        return min(1.0, spectrum * factor)
    return tuple((wavelength, min(1.0, share * factor)) for wavelength, share in spectrum)


def _sensor(sensor: TargetSensor, tolerances: Tolerances, draw: _Draw) -> TargetSensor:
    # A mask is a plane of its own, which has no tilt.
    tilt = (0.0, 0.0) if sensor.mask is not None else draw.pair("sensor_tilt", tolerances.sensor_tilt, sensor.tilt)
    most = 0.0 if sensor.diffuse is None else sensor.diffuse.albedo
    layers = []
    for number, layer in enumerate(sensor.layers):
        own = draw.within(f"layer-{number}")
        depth = layer.depth + own("filter_depth", tolerances.filter_depth)
        # A filter does not come nearer than half its distance, whatever the tolerance.
        depth = max(depth, layer.depth / 2)
        layers.append(replace(layer, depth=depth, tilt=own.pair("filter_tilt", tolerances.filter_tilt, layer.tilt)))
    microlens = sensor.microlens
    if microlens is not None:
        microlens = replace(
            microlens, shift=microlens.shift * draw.factor("microlens_shift", tolerances.microlens_shift)
        )
    return replace(
        sensor,
        tilt=tilt,
        decentre=draw.pair("decentre", tolerances.decentre, sensor.decentre),
        reflectance=min(1 - most, sensor.reflectance * draw.factor("reflectance", tolerances.reflectance)),
        layers=tuple(layers),
        microlens=microlens,
    )


def _focused(target: Target, tolerances: Tolerances, draw: _Draw) -> float:
    """Return the object distance, in metres, at which the displaced sensor is in focus."""
    if tolerances.focus is None:
        return target.object_distance
    lens, sensor = target.lens, target.sensor
    site = sensor.pitch if sensor.array is None or sensor.array.pitch is None else sensor.array.pitch
    depth = lens.focal_length / (2 * lens.aperture_radius) * site
    # A displacement δ of the sensor is a vergence δ/f² at the lens.
    vergence = 1 / target.object_distance - draw("focus", tolerances.focus) * depth / lens.focal_length**2
    # No scene is focused beyond infinity, and none nearer than twice the focal length is meant.
    return math.inf if vergence <= 0 else max(1 / vergence, 2 * lens.focal_length)


def _phone(target: PhoneTarget, tolerances: Tolerances, draw: _Draw) -> PhoneTarget:
    cameras = []
    for unit in target.phone.cameras:
        own = draw.within(unit.name)
        lens = _lens(unit.lens, tolerances, own)
        assert isinstance(lens, PrescriptionLens)
        sensor = _sensor(unit.sensor, tolerances, own)
        cameras.append(replace(unit, lens=lens, sensor=sensor, axis=own.pair("axis", tolerances.axis, unit.axis)))
    # One object distance for all cameras: that of the one which looks.
    gazing = target.unit
    looking = Target(gazing.lens, target.object_distance, sensor=gazing.sensor)
    focus = _focused(looking, tolerances, draw.within(gazing.name))
    built = replace(target.phone, cameras=tuple(cameras))
    return replace(target, built=built, object_distance=focus)
