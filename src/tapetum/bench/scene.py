"""What stands on the bench: a probe, the target it looks at, and the light between them. All values in SI units."""

from __future__ import annotations

import math
from typing import Annotated, Literal, TypeVar

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.quantity import Angle, Current, FocusDistance, Length, Power, Time, Vergence
from tapetum.bench.strict import STRICT, Positive, Share
from tapetum.bench.surfaces import Diffuse, Layer, Microlens, PixelArray, SensorMask

__all__ = [
    "SCHEMA",
    "Illumination",
    "Line",
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

S = TypeVar("S", "TargetSensor", "ProbeSensor")
Wavelength = Annotated[Length, Field(ge=200e-9, le=2e-6)]
SmallAngle = Annotated[Angle, Field(gt=-0.2, lt=0.2)]
Pixels = Annotated[tuple[int, int], Field(description="columns, rows")]


@dataclass(frozen=True, config=STRICT)
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
    angle: tuple[SmallAngle, SmallAngle]


@dataclass(frozen=True, config=STRICT)
class Line:
    """Light of a further wavelength from the same probe.

    Parameters
    ----------
    wavelength, power
        In metres and watts.
    """

    wavelength: Wavelength
    power: Power


@dataclass(frozen=True, config=STRICT)
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
    lines
        Light of further wavelengths, laid over the first.
    bandwidth
        Full width at half maximum of each line, in metres: 0 for a laser, some 20 nm for an LED.
    coherence_length
        Path over which two reflections still interfere, in metres. Left out, it follows from the bandwidth, λ²/Δλ.
    source_size
        Full angle of the source as the target sees it, in radians: 0 for a laser, an even disc for an LED.
    vergence
        1/R of the wave that reaches the target, in 1/m, in place of the mode's own: positive from a source at the
        distance R, negative for light that converges. Sweeping it scans a focus through the target (paper, section 6).
    """

    mode: Literal["collimated", "diverging", "fixed_area"] = "collimated"
    wavelength: Wavelength = 640e-9
    power: Power = 1e-3
    divergence: Annotated[Angle, Field(gt=0, lt=math.pi / 2)] | None = None
    diameter: Positive | None = None
    second_beam: SecondBeam | None = None
    lines: tuple[Line, ...] = ()
    bandwidth: Annotated[Length, Field(ge=0, le=200e-9)] = 0.0
    coherence_length: Positive | None = None
    source_size: Annotated[Angle, Field(ge=0, lt=0.2)] = 0.0
    vergence: Vergence | None = None

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
        shortest = min(self.wavelength, *(line.wavelength for line in self.lines), math.inf)
        if self.bandwidth >= 0.5 * shortest:
            raise ValueError(f"bandwidth {self.bandwidth:g} m is no line at {shortest:g} m; give a narrower one")
        return self


@dataclass(frozen=True, config=STRICT)
class ThinLens:
    """An ideal lens whose aperture stop lies in it.

    Parameters
    ----------
    focal_length, aperture_radius
        In metres.
    glass
        Its dispersion: one of the bench's glasses, or None for a lens of the same focal length in all light.
    design_wavelength
        At which the focal length holds, in metres, where there is a glass.
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


@dataclass(frozen=True, config=STRICT)
class TargetSensor:
    """The target's image sensor: what it reflects, and what it sees.

    Parameters
    ----------
    reflectance
        Power reflectance of its plane, taken as a mirror.
    pixels, pitch
        Columns and rows, and their distance in metres: together the field of view.
    array, microlens
        The photosites as a grating, and the lenses over them; a flat mirror without.
    mask
        Any complex reflectance in their place.
    diffuse
        A scattered share, besides.
    layers
        Further reflecting planes before the sensor.
    """

    reflectance: Share = 0.1
    # The paper's STC-MBA5MUSB3, 4 by 4 binned: 5.7 by 4.3 mm.
    pixels: Pixels = (648, 486)
    pitch: Positive = 8.8e-6
    array: PixelArray | None = None
    microlens: Microlens | None = None
    mask: SensorMask | None = None
    diffuse: Diffuse | None = None
    layers: tuple[Layer, ...] = ()

    @model_validator(mode="after")
    def _has_pixels(self) -> TargetSensor:
        if self.mask is not None and (self.array is not None or self.microlens is not None):
            raise ValueError("a mask takes the place of array and microlens; leave one of them out")
        if self.diffuse is not None and self.reflectance + self.diffuse.albedo > 1:
            total = self.reflectance + self.diffuse.albedo
            raise ValueError(f"reflectance and diffuse.albedo add up to {total:g}; keep them below 1")
        return _with_pixels(self)


@dataclass(frozen=True, config=STRICT)
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
        for layer in self.sensor.layers:
            if layer.depth / layer.index >= 0.9 * self.lens.focal_length:
                raise ValueError(f"a layer {layer.depth:g} m before the sensor lies in the lens; move it nearer")
        return self


@dataclass(frozen=True, config=STRICT)
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
        In electrons.
    gain
        Digital numbers an electron; where it is left out the digital range spans the full well.
    background
        Mean stray light a pixel and frame, in electrons.
    dark_current
        Electrons a pixel and second.
    offset
        Digital number of no light.
    hot_pixels
        Share of pixels with a dark current far above the others', at places that belong to the sensor.
    hot_current
        Mean of the hot pixels' dark current, exponentially distributed, in electrons a pixel and second.
    serial
        Number of the sensor: it decides where its hot pixels are.
    """

    pixels: Pixels = (256, 256)
    pitch: Positive = 2.2e-6
    bits: Annotated[int, Field(ge=1, le=16)] = 8
    exposure: Time = 1e-5
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] = 0.5
    # Inferred for the MT9P031, the likely sensor of the paper's cameras: not confirmed by its maker.
    full_well: Annotated[float, Field(ge=1, le=1e9)] = 6500.0
    read_noise: Annotated[float, Field(ge=0, le=1e6)] = 2.0
    background: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    dark_current: Current = 0.0
    offset: Annotated[float, Field(ge=0, le=65535)] = 0.0
    gain: Annotated[float, Field(gt=0, le=1e6)] | None = None
    hot_pixels: Share = 0.0
    hot_current: Current = 0.0
    serial: Annotated[int, Field(ge=0, lt=2**63)] = 0

    @model_validator(mode="after")
    def _has_pixels(self) -> ProbeSensor:
        return _with_pixels(self)


@dataclass(frozen=True, config=STRICT)
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


@dataclass(frozen=True, config=STRICT)
class Sampling:
    """How finely to compute.

    Parameters
    ----------
    accuracy
        Largest error of the irradiance, in fractions of the peak; the planner does the rest.
    pupil, sensor
        Samples a side forced by hand; refused where the field would alias.
    propagation
        From target to probe: `far field` (all light that returns is seen), `finite` (over the distance and through the
        probe's round aperture), or `auto`: finite where the returning beam overfills the aperture.
    """

    accuracy: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    pupil: Annotated[int, Field(gt=0)] | None = None
    sensor: Annotated[int, Field(gt=0)] | None = None
    propagation: Literal["auto", "far field", "finite"] = "auto"


@dataclass(frozen=True, config=STRICT)
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
