"""Reflecting surfaces inside a target: its sensor plane and the layers in front of it."""

from __future__ import annotations

import itertools
import math
import zipfile
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import numpy.typing as npt
from pydantic import Field, PlainSerializer, PlainValidator, WithJsonSchema, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.quantity import Angle, Length, to_si
from tapetum.bench.strict import STRICT, Positive, Share
from tapetum.errors import InputError
from tapetum.optics.photosites import SHAPES, Shape

__all__ = ["Diffuse", "Layer", "Microlens", "PixelArray", "SensorMask", "SmallTilt", "Spectrum", "at_wavelength"]

SmallTilt = Annotated[Angle, Field(ge=-0.1, le=0.1)]


def _spectrum(value: object) -> float | tuple[tuple[float, float], ...]:
    """A fraction of the light: one number, or [wavelength, fraction] pairs of rising wavelength."""
    if not isinstance(value, list | tuple):
        return _share(value)
    pairs: list[tuple[float, float]] = []
    for pair in value:
        if not isinstance(pair, list | tuple) or len(pair) != 2:
            raise ValueError(f"{pair!r} is no pair; write [[500 nm, 0.1], [700 nm, 0.9]]")
        wavelength = to_si(pair[0], "m")
        if not 0 < wavelength < 1e-3:
            raise ValueError(f"{pair[0]!r} is no wavelength; give for example '640 nm'")
        pairs.append((wavelength, _share(pair[1])))
    if not pairs or any(b[0] <= a[0] for a, b in itertools.pairwise(pairs)):
        raise ValueError(f"{value!r} has no rising wavelengths; write [[500 nm, 0.1], [700 nm, 0.9]]")
    return tuple(pairs)


def _share(value: object) -> float:
    try:
        share = float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError) as error:
        raise ValueError(f"{value!r} is no number; give one from 0 to 1") from error
    if isinstance(value, bool) or not 0 <= share <= 1:
        raise ValueError(f"{value!r} is out of range; give 0 to 1")
    return share


Spectrum = Annotated[
    float | tuple[tuple[float, float], ...],
    PlainValidator(_spectrum),
    PlainSerializer(lambda value: value),
    WithJsonSchema(
        {
            "anyOf": [{"type": "number", "minimum": 0, "maximum": 1}, {"type": "array"}],
            "description": "from 0 to 1, or [[wavelength, share], ...]",
        }
    ),
]


def at_wavelength(spectrum: float | Sequence[tuple[float, float]], wavelength: float) -> float:
    """The fraction at a wavelength in metres: linear between the pairs, constant outside them."""
    if isinstance(spectrum, int | float):
        return float(spectrum)
    return float(np.interp(wavelength, *np.transpose(spectrum)))


@dataclass(frozen=True, config=STRICT)
class Diffuse:
    """A Lambertian part of a reflection (paper, section 4.3).

    Parameters
    ----------
    albedo
        Power scattered back over all directions, in fractions of the incident power.
    spread
        Standard deviation of the lateral distance between entry and exit of light, in metres: paper and cardboard
        scatter light below their surface.
    """

    albedo: Share
    spread: Annotated[Length, Field(ge=0, le=1)] = 0.0


@dataclass(frozen=True, config=STRICT)
class PixelArray:
    """Photosites in rows and columns, which make the sensor a grating.

    Parameters
    ----------
    pitch
        Of the photosites, in metres; by default the sensor's.
    fill, shape
        Fill factor by area, and `square`, `round` or `hexagon` photosites.
    surround, phase
        Power reflectance of the area between photosites over that of a photosite, and the phase of its reflection
        against theirs, in radians: a step in height.
    bayer
        Power reflectance of the four colours of a 2 by 2 cell, row by row, over the sensor's reflectance.
    """

    pitch: Positive | None = None
    fill: Annotated[float, Field(gt=0, le=1)] = 0.5
    shape: Shape = "square"
    surround: Share = 0.0
    phase: Annotated[float, Field(ge=-math.pi, le=math.pi)] = 0.0
    bayer: Annotated[tuple[Share, Share, Share, Share] | None, Field(description="row by row")] = None

    @model_validator(mode="after")
    def _fits(self) -> PixelArray:
        most = SHAPES[self.shape].largest
        if self.fill > most:
            what = f"{self.shape} photosites fill at most {most:.3g} of the plane, fill is {self.fill:g}"
            raise ValueError(f"{what}; use a square")
        return self


@dataclass(frozen=True, config=STRICT)
class Microlens:
    """A lens over every photosite, passed twice as a phase.

    Parameters
    ----------
    focal_length
        Of one microlens, in metres.
    fill
        Diameter over the pitch; the area between the lenses is plane.
    shift
        Shift of a microlens from its photosite towards the sensor's centre, in metres per metre of image height. For a
        gap g of index n between them and an exit pupil R before the sensor, g/(nR) centres chief rays on the
        photosites.
    """

    focal_length: Positive
    fill: Annotated[float, Field(gt=0, le=1)] = 1.0
    shift: Annotated[float, Field(ge=-0.05, le=0.05)] = 0.0


@dataclass(frozen=True, config=STRICT)
class SensorMask:
    """A complex reflectance of the sensor plane from a file, behind a thin or a traced lens; seen in the far field.

    Parameters
    ----------
    file
        A `.npy` of complex amplitudes, [rows, columns], read without pickle. Its centre lies on the optical axis;
        outside it nothing is reflected.
    pitch
        Of its samples, in metres.
    """

    file: str
    pitch: Positive

    def amplitudes(self, reflectance: float) -> npt.NDArray[np.complex128]:
        """Return complex amplitudes [rows, columns] relative to the square root of the sensor's power reflectance.

        Raises an InputError for an invalid file, and for a mask that would reflect more than all light.
        """
        where, path = "target.sensor.mask.file", self.file
        try:
            values = np.load(path, allow_pickle=False)
        except FileNotFoundError as error:
            raise InputError(f"there is no file {path}", where=where, remedy="give the path of a .npy file") from error
        except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
            remedy = "write it with numpy.save, as complex numbers"
            raise InputError(f"{path} is no .npy of plain numbers", where=where, remedy=remedy) from error
        if not isinstance(values, np.ndarray):
            raise InputError(f"{path} holds several arrays", where=where, remedy="write one with numpy.save")
        if values.dtype.kind not in "fciu" or values.ndim != 2 or values.size == 0:
            what = f"{path} holds {values.dtype} of shape {values.shape}"
            raise InputError(what, where=where, remedy="give complex amplitudes [rows, columns]")
        values = values.astype(np.complex128)
        if not np.isfinite(values).all():
            what = f"{path} holds values that are not finite"
            raise InputError(what, where=where, remedy="replace them, by 0 for example")
        largest = float(np.abs(values).max())
        if reflectance * largest**2 > 1 + 1e-6:
            what = f"{path} reflects {reflectance * largest**2:.3g} of the light at its brightest"
            raise InputError(what, where=where, remedy="scale its amplitudes, or lower the sensor's reflectance")
        return values


@dataclass(frozen=True, config=STRICT)
class Layer:
    """A reflecting plane in front of the sensor: cover glass, filter, the tops of microlenses.

    Parameters
    ----------
    depth, index
        Its distance from the sensor, in metres, and the refractive index between them.
    reflectance, transmittance
        Power reflectance and single-pass power transmittance, one number or by wavelength; the transmittance is 1 minus
        the reflectance by default.
    diffuse
        An additional scattered part.
    tilt
        Of its plane against the lens's image plane, (a_x, a_y) in radians: at the place u from the lens's axis it lies
        a·u farther from the lens. It deflects what the layer reflects, not what passes.
    """

    depth: Positive
    reflectance: Spectrum = 0.04
    transmittance: Spectrum | None = None
    index: Annotated[float, Field(ge=1, le=5)] = 1.0
    diffuse: Diffuse | None = None
    tilt: tuple[SmallTilt, SmallTilt] = (0.0, 0.0)

    @model_validator(mode="after")
    def _keeps_energy(self) -> Layer:
        scattered = 0.0 if self.diffuse is None else self.diffuse.albedo
        shares = {
            "reflectance": self.reflectance,
            "transmittance": self.transmittance or 0.0,
            "diffuse.albedo": scattered,
        }
        tables = [share for share in shares.values() if isinstance(share, tuple)]
        for wavelength in [w for table in tables for w, _ in table] or [640e-9]:
            total = math.fsum(at_wavelength(share, wavelength) for share in shares.values())
            if total > 1 + 1e-9:
                names = " and ".join(name for name, share in shares.items() if share)
                raise ValueError(f"{names} add up to {total:g} at {wavelength * 1e9:g} nm; lower one of them")
        return self
