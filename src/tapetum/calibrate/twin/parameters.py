"""What a twin may fit of a scene: names, units, how each is read and replaced, and how far copies usually differ.

Every parameter has a *coordinate*, in which frames change about linearly: the inverse of a distance or an F-number, the
value itself otherwise. Its *spread* is the usual standard deviation between cameras of one model, from the bundled
tolerances where these have it. A parameter whose deviation is not smaller than that is not determined by the recording.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import ValidationError

from tapetum.bench import PhoneTarget, PrescriptionLens, Scene
from tapetum.bench.copies import usual_tolerances
from tapetum.errors import InputError

__all__ = ["GROUPS", "Parameter", "chosen", "parameters_of", "placed"]

GROUPS = {
    "focus": "the target's object distance",
    "focal_length": "of the target's lens",
    "aperture": "radius of a thin lens's aperture, F-number of a traced lens",
    "tilt": "of the target's sensor: tilt_x, tilt_y",
    "decentre": "of the target's lens over its sensor: decentre_x, decentre_y",
    "array": "photosites: fill, surround",
    "microlens": "microlens_focal_length, microlens_fill, microlens_shift",
    "filter_depth": "of each layer before the sensor: filter_depth_0, …",
    "second_beam": "beam_ratio, beam_x, beam_y",
    "probe_scale": "focal length of the probe's lens",
    "probe_focus": "curvature of the light at the target, which stands for a probe that is not focused at infinity too",
    "background": "stray light",
    "light": "power of the laser; reflectance, transmission and quantum efficiency act as it does",
}
"""Names that `--free` takes besides those of single parameters."""

USUAL = tuple(name for name in GROUPS if name != "probe_focus")
"""Groups that are fitted where none are named, as far as the scene has them."""


@dataclass(frozen=True)
class Parameter:
    """One fitted value of a scene.

    Attributes
    ----------
    name, group, unit
        Its name, one of `GROUPS`, and the unit of its value.
    path
        Of the scene's field; numbers count the entries of lists and pairs.
    spread
        Usual difference between copies, in the coordinate.
    least, most
        Range of the coordinate.
    inverse
        Whether the coordinate is the value's inverse.
    step
        Of differences of pictures, in spreads. Over a tenth of a spread of the tilt derivatives change by a tenth, and
        pictures are computed in double precision, a traced lens's on the same samples: so small a step leaves 1e-3 of
        nonlinearity.
    """

    name: str
    group: str
    unit: str
    path: tuple[str | int, ...]
    spread: float
    least: float = -math.inf
    most: float = math.inf
    inverse: bool = False
    step: float = 3e-4

    def read(self, scene: Scene) -> float:
        """Return the coordinate in a scene."""
        value: Any = scene
        for step in self.path:
            value = value[step] if isinstance(step, int) else getattr(value, step)
        if self.name == "aperture" and self.inverse and (value is None or 1 / value > self.most):
            return self.most
        if self.name == "probe_focus" and value is None:
            return scene.illumination.curvature(scene.distance)
        return 1 / value if self.inverse else float(value)

    def write(self, scene: Scene, coordinate: float) -> Scene:
        """Return the scene with another coordinate; raises an InputError where that makes no scene."""
        try:
            return _with(scene, self.path, self.value(coordinate))
        except ValidationError as error:
            what = str(error.errors(include_url=False)[0]["msg"]).removeprefix("Value error, ")
            raise InputError(what, where=".".join(map(str, self.path)), remedy="leave it out of --free") from error

    def value(self, coordinate: float) -> float:
        """Return the value of a coordinate, in `unit`."""
        if not self.inverse:
            return coordinate
        return math.inf if coordinate <= 0 else 1 / coordinate

    def deviation(self, coordinate: float, deviation: float) -> float:
        """Return the value's standard deviation from that of the coordinate; infinite at infinity."""
        if not self.inverse:
            return deviation
        return math.inf if coordinate <= 0 else deviation / coordinate**2

    def clipped(self, coordinate: float) -> float:
        """Return the coordinate within its range."""
        return min(max(coordinate, self.least), self.most)


def placed(scene: Scene, parameters: Sequence[Parameter], coordinates: Sequence[float]) -> Scene:
    """Return the scene with the coordinates of some parameters."""
    for one, at in zip(parameters, coordinates, strict=True):
        scene = one.write(scene, at)
    return scene


def parameters_of(scene: Scene) -> tuple[Parameter, ...]:
    """Return all that a twin may fit of a scene.

    Raises an InputError for a phone and for a mask.
    """
    target = scene.target
    if isinstance(target, PhoneTarget):
        what = "a phone, of which several cameras answer at once, has no twin"
        raise InputError(what, where="scene.target", remedy="take one of its cameras for the target")
    lens, sensor, light = target.lens, target.sensor, scene.illumination
    usual = usual_tolerances(scene)

    def spread(name: str, other: float) -> float:
        found = getattr(usual, name)
        return other if found is None else found.spread

    f, number = lens.focal_length, lens.focal_length / (2 * lens.aperture_radius)
    site = sensor.pitch if sensor.array is None or sensor.array.pitch is None else sensor.array.pitch
    found: list[Parameter] = []

    def add(name: str, group: str, unit: str, path: tuple[str | int, ...], spread: float, **more: Any) -> None:
        found.append(Parameter(name, group, unit, path, spread, **more))

    near = spread("focus", 0.25) * number * site / f**2
    # A target is focused at infinity at the farthest, and ten focal lengths away at the nearest.
    add("object_distance", "focus", "m", ("target", "object_distance"), near, least=0.0, most=0.1 / f, inverse=True)
    long = spread("focal_length", 0.005) * f
    add("focal_length", "focal_length", "m", ("target", "lens", "focal_length"), long, least=0.8 * f, most=1.25 * f)
    wide = spread("aperture", 0.02)
    if isinstance(lens, PrescriptionLens):
        open_wide = replace(lens, f_number=None)
        # Just below: fully open, light is cut by other surfaces than the stop, and the pictures change by a step.
        most = 2 * open_wide.aperture_radius / open_wide.focal_length * (1 - 1e-4)
        path = ("target", "lens", "f_number")
        # Which rays pass changes with the aperture one by one, and with them a little what is fitted to them.
        add("aperture", "aperture", "F-number", path, wide / number, least=most / 20, most=most, inverse=True, step=0.6)
    else:
        r = lens.aperture_radius
        add("aperture", "aperture", "m", ("target", "lens", "aperture_radius"), wide * r, least=r / 2, most=2 * r)
    for number, axis in enumerate("xy"):
        tilt = spread("sensor_tilt", 3.5e-3)
        add(f"tilt_{axis}", "tilt", "rad", ("target", "sensor", "tilt", number), tilt, least=-0.09, most=0.09)
        half = sensor.pixels[number] * sensor.pitch / 4
        off = spread("decentre", 1.25e-4)
        path = ("target", "sensor", "decentre", number)
        add(f"decentre_{axis}", "decentre", "m", path, off, least=-half, most=half)
    if sensor.array is not None:
        array = ("target", "sensor", "array")
        most = 0.98 if sensor.array.shape == "square" else min(0.98, max(0.75, sensor.array.fill))
        add("fill", "array", "of the area", (*array, "fill"), 0.1, least=0.02, most=most)
        add("surround", "array", "of a photosite's", (*array, "surround"), 0.1, least=0.0, most=0.98)
    if sensor.microlens is not None:
        own, one = ("target", "sensor", "microlens"), sensor.microlens
        short = one.focal_length
        path = (*own, "focal_length")
        add("microlens_focal_length", "microlens", "m", path, 0.1 * short, least=short / 3, most=3 * short)
        add("microlens_fill", "microlens", "of the pitch", (*own, "fill"), 0.05, least=0.1, most=1.0)
        shift = spread("microlens_shift", 0.05) * max(abs(one.shift), 1e-4)
        add("microlens_shift", "microlens", "m a metre of height", (*own, "shift"), shift, least=-0.049, most=0.049)
    for number, layer in enumerate(sensor.layers):
        deep, depth = spread("filter_depth", 5e-5), layer.depth
        path = ("target", "sensor", "layers", number, "depth")
        add(f"filter_depth_{number}", "filter_depth", "m", path, deep, least=depth / 2, most=2 * depth)
    if light.second_beam is not None and light.second_beam.ratio > 0:
        beam, own = ("illumination", "second_beam"), light.second_beam
        share = spread("beam_ratio", 0.2) * own.ratio
        add("beam_ratio", "second_beam", "of the first beam", (*beam, "ratio"), share, least=0.0, most=1.0)
        turn = spread("beam_angle", 0.1) * math.hypot(*own.angle)
        for number, axis in enumerate("xy"):
            add(f"beam_{axis}", "second_beam", "rad", (*beam, "angle", number), turn, least=-0.19, most=0.19)
    long = scene.probe.lens.focal_length
    path = ("probe", "lens", "focal_length")
    add("probe_focal_length", "probe_scale", "m", path, 0.01 * long, least=0.8 * long, most=1.25 * long)
    add("probe_focus", "probe_focus", "1/m", ("illumination", "vergence"), 0.02, least=-2.0, most=2.0)
    stray = max(10.0, scene.probe.sensor.background)
    path = ("probe", "sensor", "background")
    add("background", "background", "electrons", path, 0.2 * stray, least=0.0, most=1e6)
    power = light.power
    add("power", "light", "W", ("illumination", "power"), 0.2 * power, least=1e-3 * power, most=1e3 * power)
    if sensor.mask is not None:
        what = "each gaze sees another piece of a mask, which leaves nothing to fit"
        raise InputError(what, where="scene.target.sensor.mask", remedy="use an array for a mask")
    return tuple(found)


def chosen(scene: Scene, free: Sequence[str] | None) -> tuple[Parameter, ...]:
    """Return the parameters that names of groups or of single parameters choose; the usual ones for None.

    Raises an InputError for a name that is unknown, given twice, or of something that the scene does not have.
    """
    every = parameters_of(scene)
    if free is None:
        return tuple(one for one in every if one.group in USUAL)
    names = {one.name for one in every}
    wanted: list[str] = []
    for name in free:
        own = [one.name for one in every if one.group == name] if name in GROUPS else [name]
        if name in GROUPS and not own:
            what = f"the scene has nothing that {name!r} names ({GROUPS[name]})"
            raise InputError(what, where="--free", remedy="leave it out, or give the scene one")
        if name not in GROUPS and name not in names:
            others = ", ".join([*GROUPS, *sorted(names - set(GROUPS))])
            raise InputError(f"unknown name {name!r}", where="--free", remedy=f"use some of {others}")
        if twice := set(own) & set(wanted):
            raise InputError(f"names {sorted(twice)[0]!r} twice", where="--free", remedy="name each once")
        wanted += own
    if not wanted:
        raise InputError("names nothing", where="--free", remedy="name what to fit, or leave --free out")
    return tuple(one for one in every if one.name in wanted)


def _with(item: Any, path: Sequence[str | int], value: Any) -> Any:
    """Return a dataclass, tuple or number with the value at a path replaced; dataclasses check themselves."""
    if not path:
        return value
    step, rest = path[0], path[1:]
    if isinstance(step, int):
        return (*item[:step], _with(item[step], rest, value), *item[step + 1 :])
    return replace(item, **{step: _with(getattr(item, step), rest, value)})
