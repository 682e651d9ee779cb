"""What stands on the bench: a probe, the target it looks at, and the light between them. All values in SI units."""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeVar

from pydantic import ConfigDict, Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.quantity import Angle, Current, FocusDistance, Length, Power, Time

__all__ = [
    "SCHEMA",
    "Illumination",
    "Probe",
    "ProbeSensor",
    "Sampling",
    "Scene",
    "SecondBeam",
    "Target",
    "TargetSensor",
    "ThinLens",
]

SCHEMA = "tapetum/scene/1"
_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False, ser_json_inf_nan="strings")

Positive = Annotated[Length, Field(gt=0)]
S = TypeVar("S", "TargetSensor", "ProbeSensor")
Pixels = Annotated[tuple[int, int], Field(description="columns, rows")]


@dataclass(frozen=True, config=_STRICT)
class SecondBeam:
    """The probe's dim second beam, from an imperfect beam splitter (paper, section 5).

    Parameters
    ----------
    ratio
        Its power over the first beam's, as seen in the RR.
    angle
        Its direction against the first beam's, along x and y, in radians.
    """

    ratio: Annotated[float, Field(ge=0, le=1)]
    angle: tuple[Angle, Angle]


@dataclass(frozen=True, config=_STRICT)
class Illumination:
    """The probe's laser (paper, section 3).

    Parameters
    ----------
    mode
        `collimated`: a plane wave of `diameter`. `diverging`: a spherical wave from the probe with a full angle
        `divergence`. `fixed_area`: a spherical wave from the probe that fills `diameter` at any distance.
    wavelength, power
        In metres and watts; the power leaves the probe.
    divergence
        Full angle in radians.
    diameter
        Of the lit disc at the target, in metres.
    second_beam
        None for an ideal beam splitter.
    """

    mode: Literal["collimated", "diverging", "fixed_area"] = "collimated"
    wavelength: Annotated[Length, Field(ge=200e-9, le=2e-6)] = 640e-9
    power: Power = 1e-3
    divergence: Annotated[Angle, Field(gt=0, lt=math.pi / 2)] | None = None
    diameter: Positive | None = None
    second_beam: SecondBeam | None = None

    @model_validator(mode="after")
    def _fits_its_mode(self) -> Illumination:
        if self.mode == "diverging" and self.divergence is None:
            raise ValueError("mode 'diverging' needs a divergence; add for example 'divergence: 0.5 deg'")
        if self.mode == "fixed_area" and self.diameter is None:
            raise ValueError("mode 'fixed_area' needs a diameter; add for example 'diameter: 50 mm'")
        if self.mode != "diverging" and self.divergence is not None:
            remedy = "leave it out or use mode 'diverging'"
            raise ValueError(f"divergence has no meaning in mode '{self.mode}'; {remedy}")
        if self.mode == "diverging" and self.diameter is not None:
            raise ValueError("diameter has no meaning in mode 'diverging'; leave it out or use mode 'fixed_area'")
        return self


@dataclass(frozen=True, config=_STRICT)
class ThinLens:
    """An ideal lens whose aperture stop lies in it.

    Parameters
    ----------
    focal_length, aperture_radius
        In metres.
    """

    focal_length: Positive
    aperture_radius: Positive
    kind: Literal["thin"] = "thin"


@dataclass(frozen=True, config=_STRICT)
class TargetSensor:
    """The target's image sensor: what it reflects, and what it sees.

    Parameters
    ----------
    reflectance
        Power reflectance of its plane, taken as a mirror.
    pixels, pitch
        Columns and rows, and their distance in metres: together the field of view.
    """

    reflectance: Annotated[float, Field(ge=0, le=1)] = 0.1
    # The paper's STC-MBA5MUSB3, 4 by 4 binned: 5.7 by 4.3 mm.
    pixels: Pixels = (648, 486)
    pitch: Positive = 8.8e-6

    @model_validator(mode="after")
    def _has_pixels(self) -> TargetSensor:
        return _with_pixels(self)


@dataclass(frozen=True, config=_STRICT)
class Target:
    """The camera looked at.

    Parameters
    ----------
    lens, sensor
        Its optics.
    object_distance
        x_d, where it is focused, in metres; `inf` for infinity.
    rotation
        About y and about x, in radians: positive values put the probe's laser at a positive gaze, right and down.
    """

    lens: ThinLens
    object_distance: FocusDistance
    rotation: tuple[Angle, Angle] = (0.0, 0.0)
    sensor: TargetSensor = Field(default_factory=TargetSensor)

    @model_validator(mode="after")
    def _can_focus_and_look(self) -> Target:
        if self.object_distance <= self.lens.focal_length:
            raise ValueError(
                f"object_distance {self.object_distance:g} m is not beyond the focal length "
                f"{self.lens.focal_length:g} m; focus farther away or shorten the focal length"
            )
        angle = math.hypot(*self.rotation)
        if angle >= math.pi / 6:
            raise ValueError(
                f"rotation of {math.degrees(angle):.4g} deg is outside the paraxial model; stay below 30 deg"
            )
        return self


@dataclass(frozen=True, config=_STRICT)
class ProbeSensor:
    """The probe's image sensor, from photons to digital numbers.

    Parameters
    ----------
    pixels, pitch
        Columns and rows, and their distance in metres.
    bits
        Of a digital number.
    exposure
        In seconds.
    quantum_efficiency
        Electrons a photon.
    full_well, read_noise
        In electrons; the digital range spans the full well.
    background
        Mean stray light a pixel and frame, in electrons.
    dark_current
        Electrons a pixel and second.
    offset
        Digital number of no light.
    """

    pixels: Pixels = (256, 256)
    pitch: Positive = 2.2e-6
    bits: Annotated[int, Field(ge=1, le=16)] = 8
    exposure: Time = 1e-5
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] = 0.5
    # Inferred for the MT9P031, the likely sensor of the paper's cameras: not confirmed by its maker.
    full_well: Annotated[float, Field(gt=0)] = 6500.0
    read_noise: Annotated[float, Field(ge=0)] = 2.0
    background: Annotated[float, Field(ge=0)] = 0.0
    dark_current: Current = 0.0
    offset: Annotated[float, Field(ge=0)] = 0.0

    @model_validator(mode="after")
    def _has_pixels(self) -> ProbeSensor:
        return _with_pixels(self)


@dataclass(frozen=True, config=_STRICT)
class Probe:
    """The laser's companion: a camera focused at infinity behind the same aperture.

    Parameters
    ----------
    lens, sensor
        Its optics.
    transmission
        Power that the way back keeps, beam splitter included.
    """

    lens: ThinLens
    sensor: ProbeSensor = Field(default_factory=ProbeSensor)
    transmission: Annotated[float, Field(gt=0, le=1)] = 0.5


@dataclass(frozen=True, config=_STRICT)
class Sampling:
    """How finely to compute.

    Parameters
    ----------
    accuracy
        Largest error of the irradiance, in fractions of the peak; the planner does the rest.
    pupil, sensor
        Samples a side forced by hand; refused where the field would alias.
    """

    accuracy: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    pupil: Annotated[int, Field(gt=0)] | None = None
    sensor: Annotated[int, Field(gt=0)] | None = None


@dataclass(frozen=True, config=_STRICT)
class Scene:
    """Everything that decides a retro-reflection.

    Parameters
    ----------
    distance
        From probe to target, in metres.
    illumination, target, probe, sampling
        The parts.
    """

    distance: Positive
    target: Target
    probe: Probe
    illumination: Illumination = Field(default_factory=Illumination)
    sampling: Sampling = Field(default_factory=Sampling)
    schema: Literal["tapetum/scene/1"] = SCHEMA


def _with_pixels(sensor: S) -> S:
    if min(sensor.pixels) < 1 or max(sensor.pixels) > 16384:
        raise ValueError(f"pixels {list(sensor.pixels)} are out of range; give 1 to 16384 a side")
    return sensor
