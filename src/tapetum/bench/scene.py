"""A scene: a probe, its target and the illumination, in SI units."""

from __future__ import annotations

import html
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Discriminator, Field, PlainValidator, Tag, WithJsonSchema, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.faults import build
from tapetum.bench.illumination import Illumination, Line, SecondBeam, Wavelength
from tapetum.bench.measured import sensor_values
from tapetum.bench.phone import CameraUnit, Phone, load_phone
from tapetum.bench.prescription import PrescriptionLens, check_layers
from tapetum.bench.quantity import Angle, FocusDistance
from tapetum.bench.sensors import ProbeSensor, TargetSensor
from tapetum.bench.strict import STRICT, Positive

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "SCHEMA",
    "STEEPEST",
    "Illumination",
    "Line",
    "PhoneTarget",
    "Probe",
    "ProbeSensor",
    "Sampling",
    "Scene",
    "SecondBeam",
    "Target",
    "TargetSensor",
    "ThinLens",
    "outside_of_model",
]

SCHEMA = "tapetum/scene/1"
# Rotations from which a target of each kind is refused, in radians.
STEEPEST = {"thin": math.pi / 6, "prescription": math.pi / 3}


def outside_of_model(rotation: tuple[float, float], kind: str) -> str | None:
    """Return why a rotation about y and about x, in radians, is refused for a kind of lens; None where it is not.

    The laser's direction has the sines of both angles as its components along x and y.
    """
    sine = math.hypot(*(math.sin(angle) for angle in rotation))
    quarter = max(abs(angle) for angle in rotation) >= math.pi / 2 or sine >= 1
    angle = math.pi / 2 if quarter else math.asin(sine)
    if angle < STEEPEST[kind]:
        return None
    model = "the model of a thin lens" if kind == "thin" else "what any lens sees here"
    most = math.degrees(STEEPEST[kind])
    turned = ", ".join(f"{math.degrees(one):.4g}" for one in rotation)
    met = "90 deg or more" if quarter else f"{math.degrees(angle):.4g} deg"
    return f"a rotation of ({turned}) deg meets the light under {met}, outside {model}; stay below {most:.0f} deg"


@dataclass(frozen=True, config=STRICT)
class ThinLens:
    """An ideal lens with the aperture stop in its plane.

    Parameters
    ----------
    focal_length, aperture_radius
        In metres.
    glass
        Its dispersion: one of the bench's glasses, or None for the same focal length at all wavelengths.
    design_wavelength
        At which the focal length holds, in metres, if there is a glass.
    """

    focal_length: Positive
    aperture_radius: Positive
    kind: Literal["thin"] = "thin"
    glass: Literal["N-BK7", "N-SF11", "fused silica", "PMMA"] | None = None
    design_wavelength: Wavelength = 587.56e-9

    @model_validator(mode="after")
    def _is_a_lens(self) -> ThinLens:
        if self.aperture_radius > self.focal_length:
            number = self.focal_length / (2 * self.aperture_radius)
            raise ValueError(f"an F-number of {number:.2g} is that of no lens; keep aperture_radius below focal_length")
        return self


def _by_kind(usual: str) -> Discriminator:
    """The discriminator of a union; a file may omit the default kind."""
    return Discriminator(
        lambda value: str(value.get("kind", usual) if isinstance(value, dict) else getattr(value, "kind", usual))
    )


Lens = Annotated[Annotated[ThinLens, Tag("thin")] | Annotated[PrescriptionLens, Tag("prescription")], _by_kind("thin")]


@dataclass(frozen=True, config=STRICT)
class Target:
    """The camera that the probe illuminates.

    Parameters
    ----------
    lens, sensor
        Its optics.
    object_distance
        x_d, where it is focused, in metres; `inf` for infinity.
    rotation
        About y and about x, in radians: positive values put the probe's laser at a positive gaze, right and down.
    """

    lens: Lens
    object_distance: FocusDistance
    rotation: tuple[Angle, Angle] = (0.0, 0.0)
    sensor: TargetSensor = Field(default_factory=TargetSensor)
    kind: Literal["camera"] = "camera"

    @model_validator(mode="after")
    def _can_focus_and_look(self) -> Target:
        if self.object_distance <= self.lens.focal_length:
            what = f"object_distance {self.object_distance:g} m is not beyond the focal length"
            raise ValueError(f"{what} {self.lens.focal_length:g} m; focus farther away or shorten the focal length")
        if too_steep := outside_of_model(self.rotation, self.lens.kind):
            raise ValueError(too_steep)
        if isinstance(self.lens, PrescriptionLens):
            check_layers(self.lens, self.sensor.layers, self.object_distance)
            return self
        for layer in self.sensor.layers:
            if layer.depth / layer.index >= 0.9 * self.lens.focal_length:
                raise ValueError(f"a layer {layer.depth:g} m before the sensor lies in the lens; move it nearer")
        return self


def _whole_phone(value: object) -> Phone | None:
    if value is None or isinstance(value, Phone):
        return value
    if not isinstance(value, dict):
        raise ValueError(f"{value!r:.60} is no phone; give the fields of a phone's file")
    return build(Phone, {key: one for key, one in value.items() if key != "schema"}, "built")


# Opaque to the short names of a scene's fields: a phone's own `wavelength` must not make another one ambiguous.
AnyPhone = Annotated[
    Any,
    PlainValidator(_whole_phone),
    WithJsonSchema({"anyOf": [{"type": "object"}, {"type": "null"}], "description": "a phone, as in its file"}),
]


@dataclass(frozen=True, config=STRICT)
class PhoneTarget:
    """A phone as target: one of its cameras is pointed at the scene, all of them reflect.

    Parameters
    ----------
    name
        Of the catalogue, or the path of a YAML file.
    object_distance
        Where its cameras are focused, in metres; `inf` for infinity.
    kind
        Distinguishes it from a single camera.
    camera, imaging
        Name of the camera whose field the gaze is in (by default the first), and whether it is imaging (its app is
        open). Sensors reflect while they image, filters always.
    rotation
        As of a `Target`.
    built
        The whole phone as in its file, where this copy differs from the catalogue's: see `draw_unit`.
    """

    name: str
    object_distance: FocusDistance
    kind: Literal["phone"]
    camera: str | None = None
    imaging: bool = True
    rotation: tuple[Angle, Angle] = (0.0, 0.0)
    built: AnyPhone = None

    @model_validator(mode="after")
    def _is_a_phone(self) -> PhoneTarget:
        if self.built is not None and self.built.name != load_phone(self.name).name:
            raise ValueError(f"built describes {self.built.name!r}, not {self.name!r}; leave it out or name that phone")
        names = [unit.name for unit in self.phone.cameras]
        if self.camera is not None and self.camera not in names:
            raise ValueError(f"{self.name} has no camera {self.camera!r}; use {' or '.join(names)}")
        # Every camera must be able to focus there.
        self.cameras()
        return self

    @property
    def phone(self) -> Phone:
        """The phone itself."""
        return load_phone(self.name) if self.built is None else self.built

    @property
    def unit(self) -> CameraUnit:
        """The camera whose field the gaze is in."""
        return next(unit for unit in self.phone.cameras if self.camera in (None, unit.name))

    @property
    def lens(self) -> PrescriptionLens:
        """That camera's lens."""
        return self.unit.lens

    @property
    def sensor(self) -> TargetSensor:
        """That camera's sensor, as while imaging."""
        return self.unit.sensor

    def cameras(self) -> tuple[tuple[Target, tuple[float, float]], ...]:
        """Every camera as a target, and its position on the back plate relative to the camera that defines the gaze."""
        gazing, found = self.unit, list[tuple[Target, tuple[float, float]]]()
        for unit in self.phone.cameras:
            images = self.imaging and unit.name == gazing.name
            sensor = unit.sensor
            if not images:
                sensor = replace(sensor, reflectance=0.0, array=None, microlens=None, mask=None, diffuse=None)
            place = (unit.position[0] - gazing.position[0], unit.position[1] - gazing.position[1])
            # Gaze counts from the axis of its camera; the other axes are offset from it.
            rotation = tuple(
                angle + (own - its) for angle, own, its in zip(self.rotation, unit.axis, gazing.axis, strict=True)
            )
            found.append((Target(unit.lens, self.object_distance, (rotation[0], rotation[1]), sensor), place))
        return tuple(found)


AnySensor = Annotated[ProbeSensor, BeforeValidator(sensor_values, json_schema_input_type=ProbeSensor | str)]
AnyTarget = Annotated[Annotated[Target, Tag("camera")] | Annotated[PhoneTarget, Tag("phone")], _by_kind("camera")]


@dataclass(frozen=True, config=STRICT)
class Probe:
    """The camera beside the laser, focused at infinity behind the same aperture.

    Parameters
    ----------
    lens, sensor
        Its optics; for the sensor, a file of `tapetum calibrate probe` may be named.
    transmission
        Power transmission of the return path, beam splitter included.
    """

    lens: ThinLens
    sensor: AnySensor = Field(default_factory=ProbeSensor)
    transmission: Annotated[float, Field(gt=0, le=1)] = 0.5

    @model_validator(mode="after")
    def _is_achromatic(self) -> Probe:
        if self.lens.glass is not None:
            raise ValueError("the probe's lens has one focal length for all light; leave lens.glass out")
        return self


@dataclass(frozen=True, config=STRICT)
class Sampling:
    """Accuracy and sampling of the simulation.

    Parameters
    ----------
    accuracy
        Largest error of the irradiance, in fractions of the peak; the planner does the rest.
    pupil, sensor
        Samples a side set by hand; refused where the field would alias.
    propagation
        From target to probe: `far field` (the aperture passes all returning light), `finite` (over the distance and
        through the probe's round aperture), or `auto`: finite where the returning beam overfills the aperture, or where
        this cuts off rings that change the picture by more than 0.02 of the peak and more than the accuracy; smaller
        changes are part of the stated error.
    rim_light
        Of light far out of focus behind a traced lens, most of whose rays miss the probe: whether to keep what the
        pupil's rim sends there. False follows the rays that reach the probe alone, on tens of times fewer samples. The
        picture then lacks the rim's light, which no stated error counts: where it was measured, 0.05 to 0.3 of the
        peak.
    """

    accuracy: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    pupil: Annotated[int, Field(gt=0)] | None = None
    sensor: Annotated[int, Field(gt=0)] | None = None
    propagation: Literal["auto", "far field", "finite"] = "auto"
    rim_light: bool = True


@dataclass(frozen=True, config=STRICT)
class Scene:
    """All parameters of a retro-reflection.

    Parameters
    ----------
    distance
        From probe to target, in metres.
    illumination, target, probe, sampling
        The parts.
    """

    distance: Positive
    target: AnyTarget
    probe: Probe
    illumination: Illumination = Field(default_factory=Illumination)
    sampling: Sampling = Field(default_factory=Sampling)
    schema: Literal["tapetum/scene/1"] = SCHEMA

    def __repr__(self) -> str:
        return f"<Scene: {self._words()}>"

    def _words(self) -> str:
        light, target = self.illumination, self.target
        return (
            f"{_named(target)}, {self.distance:g} m from the probe, focused at {target.object_distance:g} m;"
            f" {light.mode} light of {light.wavelength * 1e9:g} nm, {light.power * 1e3:g} mW"
        )

    def _repr_html_(self) -> str:
        """The scene as HTML for a notebook: one line, and all values in a folded list."""
        from tapetum.bench.load import scene_yaml

        words, values = html.escape(self._words()), html.escape(scene_yaml(self))
        return f"<details><summary>Scene: {words}</summary><pre>{values}</pre></details>"

    def plot(self) -> Figure:
        """Draw the bench from the side, heights not to scale: probe, target, and where the target is focused.

        The figure belongs to no window: a notebook shows it, `savefig` writes it.
        """
        from matplotlib.figure import Figure

        figure = Figure(figsize=(7, 2.2), layout="constrained")
        axis = figure.add_subplot()
        place, focus = self.distance, self.distance - self.target.object_distance
        axis.plot([0, 0], [-1, 1], color="C0", linewidth=4, solid_capstyle="butt")
        axis.plot([place, place], [-0.5, 0.5], color="C1", linewidth=4, solid_capstyle="butt")
        axis.plot([0, place], [0, 0], color="0.6", linewidth=1)
        style: Any = {"textcoords": "offset points", "ha": "center"}
        diameter = 2e3 * self.probe.lens.aperture_radius
        axis.annotate(f"probe\n{diameter:g} mm wide", (0, 1), (0, 3), **style)
        axis.annotate(_named(self.target), (place, 0.5), (0, 3), **style)
        if math.isfinite(focus) and focus != 0:
            axis.plot([focus], [0], "x", color="C1")
            axis.annotate("its focus", (focus, 0), (0, -14), **style)
        axis.set_ylim(-1.6, 2.2)
        axis.margins(x=0.2)
        axis.set_yticks([])
        axis.set_xlabel("distance from the probe, m")
        axis.spines[["left", "right", "top"]].set_visible(False)
        return figure


def _named(target: Target | PhoneTarget) -> str:
    if isinstance(target, PhoneTarget):
        return f"{target.name}{', ' + target.camera if target.camera else ''}"
    lens = target.lens
    if isinstance(lens, PrescriptionLens):
        return f"lens {lens.name} at {lens.focal_length * 1e3:g} mm"
    stop = lens.focal_length / (2 * lens.aperture_radius)
    return f"thin lens f = {lens.focal_length * 1e3:g} mm, f/{stop:.3g}"
