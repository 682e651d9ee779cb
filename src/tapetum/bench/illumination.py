"""The probe's light. To add a mode of illumination, write its class here and name it in `ModeName` and `MODES`."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, model_validator
from pydantic.dataclasses import dataclass

from tapetum.bench.measured import beam_values
from tapetum.bench.quantity import Angle, Length, Power, Vergence
from tapetum.bench.strict import STRICT, Positive

__all__ = ["MODES", "Illumination", "Line", "SecondBeam"]

Wavelength = Annotated[Length, Field(ge=200e-9, le=2e-6)]
SmallAngle = Annotated[Angle, Field(gt=-0.2, lt=0.2)]
ModeName = Literal["collimated", "diverging", "fixed_area"]
"""What `illumination.mode` may be."""


class Collimated:
    """A plane wave of `diameter`, or as wide as the probe's aperture.

    Attributes
    ----------
    takes, needs
        Which of the fields `divergence` and `diameter` apply, and which are required, with an example.
    spherical, spreads
        Whether the curvature is 1/distance, from a point at the probe; and whether the irradiance falls as 1/distance².
    """

    takes: ClassVar[tuple[str, ...]] = ("diameter",)
    needs: ClassVar[dict[str, str]] = {}
    spherical: ClassVar[bool] = False
    spreads: ClassVar[bool] = False

    @staticmethod
    def radius(divergence: float | None, diameter: float | None, distance: float, aperture_radius: float) -> float:
        """Radius of the illuminated disc at a distance from the probe, in metres (angles in radians)."""
        return aperture_radius if diameter is None else diameter / 2


class Diverging(Collimated):
    """A spherical wave from the probe with a full angle `divergence`."""

    takes = ("divergence",)
    needs: ClassVar[dict[str, str]] = {"divergence": "0.5 deg"}
    spherical = spreads = True

    @staticmethod
    def radius(divergence: float | None, diameter: float | None, distance: float, aperture_radius: float) -> float:
        assert divergence is not None
        return distance * math.tan(divergence / 2)


class FixedArea(Collimated):
    """A spherical wave from the probe that fills `diameter` at any distance."""

    needs: ClassVar[dict[str, str]] = {"diameter": "50 mm"}
    spherical = True


MODES: dict[str, type[Collimated]] = {"collimated": Collimated, "diverging": Diverging, "fixed_area": FixedArea}


@dataclass(frozen=True, config=STRICT)
class SecondBeam:
    """The probe's weak second beam, from an imperfect beam splitter (paper, section 5).

    Parameters
    ----------
    ratio
        Its power over the first beam's, as seen in the RR.
    angle
        Its direction against the first beam's, along x and y, in radians.
    """

    ratio: Annotated[float, Field(ge=0, le=1)]
    angle: tuple[SmallAngle, SmallAngle]


AnyBeam = Annotated[SecondBeam, BeforeValidator(beam_values, json_schema_input_type=SecondBeam | str)]


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
    divergence, diameter
        Full angle in radians, and that of the illuminated disc at the target in metres.
    second_beam
        None for an ideal beam splitter; a file of `tapetum calibrate ghost` may be named.
    lines
        Further wavelengths, added incoherently.
    bandwidth
        Full width at half maximum of each line, in metres: 0 for a laser, about 20 nm for an LED.
    coherence_length
        Path difference, in metres, from which two reflections no longer interfere; their degree of coherence falls
        linearly to 0 there. By default the bandwidth alone decides.
    source_size
        Full angle of the source seen from the target, in radians: 0 for a laser, a uniform disc for an LED.
    vergence
        1/R of the wave at the target, in 1/m, in place of the mode's own: positive from a source at the distance R,
        negative for converging light. Sweeping it scans a focus through the target (paper, section 6).
    """

    mode: ModeName = "collimated"
    wavelength: Wavelength = 640e-9
    power: Power = 1e-3
    divergence: Annotated[Angle, Field(gt=0, lt=math.pi / 2)] | None = None
    diameter: Positive | None = None
    second_beam: AnyBeam | None = None
    lines: tuple[Line, ...] = ()
    bandwidth: Annotated[Length, Field(ge=0, le=200e-9)] = 0.0
    coherence_length: Positive | None = None
    source_size: Annotated[Angle, Field(ge=0, lt=0.2)] = 0.0
    vergence: Vergence | None = None

    @model_validator(mode="after")
    def _fits_its_mode(self) -> Illumination:
        for name, given in (("divergence", self.divergence), ("diameter", self.diameter)):
            example = self.wave.needs.get(name)
            if given is None and example is not None:
                raise ValueError(f"mode '{self.mode}' needs a {name}; add for example '{name}: {example}'")
            if given is not None and name not in self.wave.takes:
                other = next(word for word, wave in MODES.items() if name in wave.needs)
                raise ValueError(f"{name} has no meaning in mode '{self.mode}'; leave it out or use mode '{other}'")
        shortest = min(self.wavelength, *(line.wavelength for line in self.lines), math.inf)
        if self.bandwidth >= 0.5 * shortest:
            raise ValueError(f"bandwidth {self.bandwidth:g} m is no line at {shortest:g} m; give a narrower one")
        return self

    @property
    def wave(self) -> type[Collimated]:
        """The mode's rules for the spread of the light."""
        return MODES[self.mode]

    @property
    def follows_distance(self) -> bool:
        """Whether the curvature at the target changes with its distance."""
        return self.vergence is None and self.wave.spherical

    def curvature(self, distance: float) -> float:
        """1/R of the wave at a distance (metres) from the probe, in 1/m, positive from a source at R."""
        if self.vergence is not None:
            return self.vergence
        return 1 / distance if self.wave.spherical else 0.0

    def radius(self, distance: float, aperture_radius: float) -> float:
        """Illuminated radius at a distance from a probe of an aperture's radius, in metres (paper, figure 3)."""
        return self.wave.radius(self.divergence, self.diameter, distance, aperture_radius)

    def spread(self, distance: Any, usual: Any) -> Any:
        """Irradiance at a distance over that at the usual one; both in metres, numbers, arrays or tensors."""
        return (usual / distance) ** (2 if self.wave.spreads else 0)
