"""Image sensors: the target's, which reflects, and the probe's, which counts photons. All values in SI units."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.layers import Diffuse, Layer, Microlens, PixelArray, SensorMask, SmallTilt
from tapetum.bench.quantity import Current, Length, Time
from tapetum.bench.strict import STRICT, Positive, Share

__all__ = ["ProbeSensor", "TargetSensor"]


def _in_range(pixels: tuple[int, int]) -> tuple[int, int]:
    if min(pixels) < 1 or max(pixels) > 16384:
        raise ValueError(f"pixels {list(pixels)} are out of range; give 1 to 16384 a side")
    return pixels


Pixels = Annotated[tuple[int, int], Field(description="columns, rows"), AfterValidator(_in_range)]
Offset = Annotated[Length, Field(ge=-0.01, le=0.01)]


@dataclass(frozen=True, config=STRICT)
class TargetSensor:
    """The target's image sensor, as reflector and as camera.

    Parameters
    ----------
    reflectance
        Power reflectance of its plane, treated as a mirror.
    pixels, pitch
        Columns and rows, and their pitch in metres: together the field of view.
    array, microlens
        The photosites as a grating, and the lenses over them; a plane mirror without.
    mask
        A complex reflectance in place of both.
    diffuse
        An additional scattered part.
    layers
        Further reflecting planes in front of the sensor.
    tilt
        Of its plane against the lens's image plane, (a_x, a_y) in radians: at the place u from the lens's axis it lies
        a·u behind it. Layers have their own tilts. A tilt of the whole lens is equivalent to the opposite tilt of these
        planes and a change of gaze, so it has no field of its own.
    decentre
        Where the lens's axis meets the sensor, (x, y) in metres from its centre. Gaze counts from the sensor's centre.
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
    tilt: tuple[SmallTilt, SmallTilt] = (0.0, 0.0)
    decentre: tuple[Offset, Offset] = (0.0, 0.0)

    @model_validator(mode="after")
    def _can_be_built(self) -> TargetSensor:
        if self.mask is not None and (self.array is not None or self.microlens is not None):
            raise ValueError("a mask takes the place of array and microlens; leave one of them out")
        if self.mask is not None and self.tilt != (0.0, 0.0):
            raise ValueError("a mask is not tilted by itself; multiply it by exp(2ik a·u) and leave tilt out")
        for name, axis, offset in zip("xy", self.pixels, self.decentre, strict=True):
            if abs(offset) > axis * self.pitch / 2:
                raise ValueError(f"decentre {offset:g} m puts the lens's axis off the sensor along {name}; lower it")
        if self.diffuse is not None and self.reflectance + self.diffuse.albedo > 1:
            total = self.reflectance + self.diffuse.albedo
            raise ValueError(f"reflectance and diffuse.albedo add up to {total:g}; keep them below 1")
        return self


@dataclass(frozen=True, config=STRICT)
class ProbeSensor:
    """The probe's image sensor, from photons to digital numbers.

    Parameters
    ----------
    pixels, pitch
        Columns and rows, and their pitch in metres.
    fill
        Share of a pixel's area that is sensitive to light, a square in its middle: a picture holds the mean over it. A
        real sensor with lenses over its pixels has nearly 1. 0, the default and the paper's model: a point.
    bits, offset
        Bit depth, and digital number without light.
    exposure
        In seconds.
    quantum_efficiency
        Electrons per photon.
    full_well, read_noise
        In electrons.
    gain
        Digital numbers per electron; by default the digital range spans the full well.
    background, dark_current
        Mean stray light in electrons per pixel and frame; dark current in electrons per pixel and second.
    hot_pixels, hot_current, serial
        Share of pixels with a much larger dark current, its mean (exponentially distributed) in electrons per pixel and
        second, and the number of the sensor, which decides where they are.
    """

    pixels: Pixels = (256, 256)
    pitch: Positive = 2.2e-6
    fill: Share = 0.0
    bits: Annotated[int, Field(ge=1, le=16)] = 8
    exposure: Time = 1e-5
    quantum_efficiency: Annotated[float, Field(gt=0, le=1)] = 0.5
    # Inferred for the MT9P031, the likely sensor of the paper's cameras; not confirmed by the manufacturer.
    full_well: Annotated[float, Field(ge=1, le=1e9)] = 6500.0
    read_noise: Annotated[float, Field(ge=0, le=1e6)] = 2.0
    background: Annotated[float, Field(ge=0, le=1e9)] = 0.0
    dark_current: Current = 0.0
    offset: Annotated[float, Field(ge=0, le=65535)] = 0.0
    gain: Annotated[float, Field(gt=0, le=1e6)] | None = None
    hot_pixels: Share = 0.0
    hot_current: Current = 0.0
    serial: Annotated[int, Field(ge=0, lt=2**63)] = 0
