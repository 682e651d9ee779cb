"""What reflects inside a target: the plane of its sensor and the layers before it."""

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
    """A share of light: one number, or [wavelength, share] pairs of rising wavelength."""
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
    """The share at a wavelength in metres: linear between the pairs, constant beyond the outer ones."""
    if isinstance(spectrum, int | float):
        return float(spectrum)
    return float(np.interp(wavelength, *np.transpose(spectrum)))


@dataclass(frozen=True, config=STRICT)
class Diffuse:
    """A Lambertian share of a reflection (paper, section 4.3).

    Parameters
    ----------
    albedo
        Power scattered back over all directions, in fractions of the power that arrives.
    spread
        Standard deviation of the place where light leaves against the place where it arrived, in metres: paper and
        cardboard carry light sideways before they scatter it back.
    """

    albedo: Share
    spread: Annotated[Length, Field(ge=0, le=1)] = 0.0


@dataclass(frozen=True, config=STRICT)
class PixelArray:
    """Photosites in rows and columns: what makes a sensor a grating.

    Parameters
    ----------
    pitch
        Distance of photosites, in metres; the sensor's own where it is left out.
    fill
        Area of the photosites over the whole.
    shape
        `square`, `round` or `hexagon` photosites.
    surround
        Power reflectance of what lies between them, over that of a photosite.
    phase
        Of the surround's reflection against the photosites', in radians: a step in height.
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
    """A lens over every photosite: its phase, passed twice.

    Parameters
    ----------
    focal_length
        Of one microlens, in metres.
    fill
        Diameter over the pitch; between the lenses light passes a flat.
    shift
        How far a microlens stands off its photosite towards the sensor's middle, in metres a metre of image height.
        For a gap g of index n between them and an exit pupil R before the sensor, g/(nR) lets chief rays meet the
        photosites.
    """

    focal_length: Positive
    fill: Annotated[float, Field(gt=0, le=1)] = 1.0
    shift: Annotated[float, Field(ge=-0.05, le=0.05)] = 0.0


@dataclass(frozen=True, config=STRICT)
class SensorMask:
    """Any complex reflectance of the sensor plane, from a file.

    Parameters
    ----------
    file
        A `.npy` of complex amplitudes, [rows, columns], read without pickle. Its middle lies on the optical axis;
        outside of it nothing is reflected.
    pitch
        Distance of its samples, in metres.
    """

    file: str
    pitch: Positive

    def amplitudes(self, reflectance: float) -> npt.NDArray[np.complex128]:
        """Complex amplitudes [rows, columns] over the square root of the sensor's power reflectance.

        Raises an InputError for what is no such file, and where the mask would reflect more than all light.
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
    """A plane before the sensor that reflects: cover glass, filter, the tops of microlenses.

    Parameters
    ----------
    depth
        Its distance from the sensor, in metres.
    index
        Refractive index of what lies between it and the sensor.
    reflectance
        Power reflectance, one number or by wavelength.
    transmittance
        Power transmittance of one passage; what is not reflected where it is left out.
    diffuse
        A scattered share, besides.
    tilt
        Of its plane against the lens's image plane, (a_x, a_y) in radians: at the place u from the lens's axis it lies
        a·u farther from the lens. What it reflects turns, what passes does not.
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
