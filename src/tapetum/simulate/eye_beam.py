"""The probe's beam for eye safety: its width, and the power that passes an opening."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from tapetum.bench import Scene
from tapetum.errors import InputError, one_of
from tapetum.simulate.eye_limits import PUPIL, checked_angle, nanometres
from tapetum.simulate.radiometry import beam_radius

__all__ = ["NEAREST", "PUPIL_AREA", "Beam", "beam_of", "irradiance_at"]

NEAREST = 0.1  # m: where condition 3 measures (table 10); the eye focuses no nearer
PUPIL_AREA = math.pi * PUPIL**2 / 4  # m²


@dataclass(frozen=True)
class Beam:
    """A continuous beam that leaves the apparatus, widening in proportion to the distance.

    Parameters
    ----------
    wavelength, power
        In metres and watts: all the power that leaves.
    diameter
        Full width where it leaves, in metres; 0 for light from a point.
    divergence
        Full angle in radians, 0 for parallel light.
    source_angle
        Angle that the apparent source subtends at 100 mm, in radians; farther away it shrinks with the distance. Up to
        1.5 mrad it is a point, the strictest case.
    profile
        `tophat`: evenly lit over the full width, as Tapetum lights the disc. `gaussian`: diameter and divergence are
        taken where the irradiance falls to 1/e of its peak (d63 of the standard, the 1/e² width over √2).
    continuous, pulse_duration, repetition_rate
        Anything but continuous light is refused.

    Raises
    ------
    InputError
        For a value out of its range, and for pulses or modulation.
    """

    wavelength: float
    power: float
    diameter: float
    divergence: float = 0.0
    source_angle: float = 0.0
    profile: Literal["tophat", "gaussian"] = "tophat"
    continuous: bool = True
    pulse_duration: float | None = None
    repetition_rate: float | None = None

    def __post_init__(self) -> None:
        if not self.continuous or self.pulse_duration is not None or self.repetition_rate is not None:
            field = "continuous" if not self.continuous else "pulse_duration"
            field = "repetition_rate" if self.continuous and self.pulse_duration is None else field
            raise InputError(
                f"{getattr(self, field)!r}: pulsed and modulated light is not handled, its limits are lower",
                where=field,
                remedy="describe a continuous beam, or consult a laser safety officer",
            )
        nanometres(self.wavelength)
        if not 0 < self.power < math.inf:
            raise InputError(f"must be positive, is {self.power:g} W", where="power", remedy="give watts")
        if not 0 <= self.diameter < math.inf:
            raise InputError(f"must not be negative, is {self.diameter:g} m", where="diameter", remedy="give metres")
        if not 0 <= self.divergence < math.pi:
            remedy = "give the full angle in radians, 0 for parallel light"
            raise InputError(f"must lie from 0 to below π, is {self.divergence:g}", where="divergence", remedy=remedy)
        checked_angle(self.source_angle)
        one_of(self.profile, ("tophat", "gaussian"), "profile")

    def width(self, distance: float) -> float:
        """Diameter at a distance from the exit, in metres."""
        return self.diameter + 2 * distance * math.tan(self.divergence / 2)

    def through(self, aperture: float, distance: float) -> float:
        """Power through a centred round aperture, in watts; aperture and distance in metres."""
        width = self.width(distance)
        if width == 0:
            return self.power
        if self.profile == "gaussian":
            return self.power * -math.expm1(-((aperture / width) ** 2))
        return self.power * min(1.0, (aperture / width) ** 2)

    def angle_at(self, distance: float) -> float:
        """Angle, in radians, that the source subtends at a distance; constant within 100 mm."""
        return self.source_angle * NEAREST / max(distance, NEAREST)

    def reach(self, aperture: float, limit: float) -> float:
        """Distance in metres from which on at most `limit` watts pass the aperture; `inf` where more always passes."""
        if self.power <= limit:
            return 0.0
        if self.profile == "gaussian":
            width = aperture / math.sqrt(-math.log1p(-limit / self.power))
        else:
            width = aperture * math.sqrt(self.power / limit)
        if width <= self.diameter:
            return 0.0
        return (width - self.diameter) / (2 * math.tan(self.divergence / 2)) if self.divergence > 0 else math.inf


def beam_of(scene: Scene) -> Beam:
    """The beam that a scene's probe sends out, in the worst case.

    Collimated light keeps its width. Diverging light starts from a point at the probe, and so does that of
    `fixed_area`, with the angle that fills the disc at the target. The second beam's power is added to the first's.
    Light with a bandwidth counts as one full bandwidth shorter, where every limit is lower, but invisible light never
    as visible. A `vergence` other than 0 may focus anywhere: such light counts as a thin parallel ray that enters any
    eye whole. The source counts as a point, whatever `source_size`, and the light as continuous, for a scene has no
    pulses.

    Raises
    ------
    InputError
        When the wavelength is outside 400 to 1400 nm, the power is not positive, or the light has several wavelengths,
        whose hazards add up.
    """
    light = scene.illumination
    if light.lines:
        raise InputError(
            f"{1 + len(light.lines)} wavelengths at once are not handled, their hazards add up",
            where="illumination.lines",
            remedy="ask a laser safety officer; one wavelength alone can be judged here, not their sum",
        )
    wavelength = light.wavelength - light.bandwidth
    if nanometres(light.wavelength) >= 700:
        wavelength = max(wavelength, 700e-9)
    power = light.power * (1 + (light.second_beam.ratio if light.second_beam else 0))
    radius = beam_radius(scene)
    if light.vergence:
        return Beam(wavelength, power, 0.0)
    if light.curvature(scene.distance) == 0:
        return Beam(wavelength, power, 2 * radius)
    return Beam(wavelength, power, 0.0, 2 * math.atan(radius / scene.distance))


def irradiance_at(beam: Beam, distance: float) -> float:
    """Irradiance at a distance from the exit (m), averaged over a 7 mm pupil on the axis, in W/m²."""
    return beam.through(PUPIL, distance) / PUPIL_AREA
