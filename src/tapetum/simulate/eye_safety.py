"""Is the illumination safe to look into? An aid to planning after IEC 60825-1:2014; never a certificate.

Only continuous light of 400 to 1400 nm is handled. Unknown quantities take their worst case: the source is a point,
light only spreads, air and optics lose nothing. The limits are in
[`tapetum.simulate.eye_limits`][tapetum.simulate.eye_limits].
"""

# SciPy types its root finders in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from scipy.optimize import brentq

from tapetum.errors import InputError
from tapetum.simulate.eye_beam import NEAREST, PUPIL_AREA, Beam, beam_of, irradiance_at
from tapetum.simulate.eye_limits import PUPIL, SMALL_SOURCE, ael, checked_exposure, mpe, nanometres, visible

__all__ = ["NOT_A_CERTIFICATE", "AtDistance", "Beam", "EyeSafety", "beam_of", "eye_safety", "irradiance_at"]

NOT_A_CERTIFICATE = "An aid to planning, not a certificate; classification needs measurement by a competent person."

TELESCOPE, TELESCOPE_DISTANCE = 50e-3, 2.0  # m: condition 1, a 50 mm objective at 2 m (table 10, 400 to 1400 nm)
_ROUNDING = 1 + 1e-12  # 1 mW is within a limit of 1 mW, whatever the last binary digit says

_STEPS = 500  # distances at which an extended source is tried

LaserClass = Literal["1", "1M", "2", "2M", "3R", "3B", "4"]


@dataclass(frozen=True)
class AtDistance:
    """Light at an eye at `distance` (m): `irradiance` averaged over 7 mm, and the `mpe` there, both in W/m²."""

    distance: float
    irradiance: float
    mpe: float

    @property
    def safe(self) -> bool:
        """Whether the naked eye may look for the assumed time."""
        return self.irradiance <= self.mpe * _ROUNDING


@dataclass(frozen=True)
class EyeSafety:
    """Result of [`eye_safety`][tapetum.simulate.eye_safety.eye_safety].

    Parameters
    ----------
    beam
        As given.
    exposure, class_exposure
        Seconds assumed for the MPE and NOHD, and for the limits of Class 1 (and of 3R beyond 700 nm).
    nearest
        Irradiance and MPE at the nearest point a viewer reaches.
    at
        The same at each distance asked for.
    naked_distance
        Where condition 3 is evaluated, in metres: 0.1, or where an extended source is worst.
    emission
        Accessible emission in watts under condition `3` (naked eye) and `1` (telescope).
    limits
        AEL in watts of Classes `1`, `2` (visible light only), `3R` and `3B` under condition 3.
    telescope_limits
        The same under condition 1, for a point source.
    laser_class
        The class these give.
    nohd, aided_nohd
        Nominal ocular hazard distance in metres, for the naked eye and through a 50 mm telescope: 0 where always safe,
        `inf` where never.
    """

    beam: Beam
    exposure: float
    class_exposure: float
    nearest: AtDistance
    at: tuple[AtDistance, ...]
    naked_distance: float
    emission: dict[str, float]
    limits: dict[str, float]
    telescope_limits: dict[str, float]
    laser_class: LaserClass
    nohd: float
    aided_nohd: float

    def lines(self) -> list[str]:
        """Result and assumptions as text; the last line states that it is no certificate."""
        beam, near = self.beam, self.nearest
        spread = f"spreading {beam.divergence:.3g} rad" if beam.divergence else "parallel"
        width = f"{beam.diameter * 1e3:.3g} mm wide" if beam.diameter else "from a point"
        naked, aided = (_milliwatts(self.emission[condition]) for condition in ("3", "1"))
        found = [
            f"Beam: {beam.power * 1e3:.3g} mW at {nanometres(beam.wavelength):g} nm, {width}, {spread}, continuous.",
            f"Exposure assumed: {self.exposure:g} s ({self._why_exposure()}).",
            *(self._compare(place) for place in dict.fromkeys((near, *self.at))),
            f"Through a 7 mm pupil at {self.naked_distance:.3g} m: {naked}; limits {_limits(self.limits)}.",
            f"Through a 50 mm telescope at 2 m: {aided}; limits {_limits(self.telescope_limits)}.",
            f"Class {self.laser_class} by calculation: {_MEANING[self.laser_class]}.",
            f"NOHD, naked eye: {_metres(self.nohd)}; through a 50 mm telescope: {_metres(self.aided_nohd)}.",
            *self._explain(),
            "Taken at its worst: nothing is lost on the way, "
            + ("the source is a point." if beam.source_angle <= SMALL_SOURCE else "the source shrinks with distance."),
        ]
        return [*found, NOT_A_CERTIFICATE]

    def _why_exposure(self) -> str:
        if self.exposure > 100:
            return "looking into it on purpose"
        looks_away = self.exposure == 0.25 and visible(self.beam.wavelength)
        return "visible light: the viewer looks away" if looks_away else "an unintended look"

    def _compare(self, place: AtDistance) -> str:
        share = place.irradiance / place.mpe
        verdict = "within the limit" if place.safe else "TOO MUCH"
        return (
            f"At {place.distance:g} m: {place.irradiance:.3g} W/m² over 7 mm, {share:.3g} times the limit (MPE) of "
            f"{place.mpe:.3g} W/m²: {verdict} for the naked eye."
        )

    def _explain(self) -> list[str]:
        said: list[str] = []
        total, own = self.beam.power, self.laser_class
        if total > self.limits["3R"] and own in ("1", "1M", "2", "2M"):
            said.append(
                f"All {_milliwatts(total)} in one pupil would be Class {'3B' if total <= 0.5 else '4'}; but the beam "
                f"is wide, and the class counts what passes 7 mm: {_milliwatts(self.emission['3'])}."
            )
        if own in ("1M", "2M"):
            said.append("The M: a telescope or binoculars gather more than the eye may take; keep them off this beam.")
        if own in ("3R", "3B", "4") and self.nohd == 0:
            said.append("The naked eye is within its limit everywhere; the class comes from what a telescope gathers.")
        elif own in ("3R", "3B", "4") and math.isfinite(self.nohd):
            said.append(
                f"The class is set near the exit. From {_metres(self.nohd)} on the irradiance is within the limit for "
                "the naked eye, yet the class stays: it belongs to the apparatus, not to a place."
            )
        if own in ("1", "1M", "2", "2M") and not self.nearest.safe and self.exposure <= (0.25 if "2" in own else 100):
            said.append(
                "Class and MPE part here because the standard rounds its class limits, by a few hundredths: 1 mW in "
                "7 mm is 26 W/m², where the MPE is 25.5 W/m²."
            )
        if math.isinf(self.nohd):
            said.append("Parallel light never thins out in this model: a measured divergence gives a finite NOHD.")
        if self.exposure > 0.25 and own in ("2", "2M"):
            said.append("Class 2 rests on looking away within 0.25 s: nobody may be asked to look into it.")
        return said


_MEANING = {
    "1": "within the limit for the eye, also with a telescope",
    "1M": "within the limit for the naked eye, not with a telescope",
    "2": "visible; within the limit where the viewer looks away within 0.25 s",
    "2M": "visible; within the limit for the naked eye that looks away within 0.25 s, not with a telescope",
    "3R": "above the limit for the eye, by at most five times",
    "3B": "a danger to the eye in the direct beam",
    "4": "a danger to eye and skin, also by scattered light",
}


def eye_safety(
    beam: Beam,
    distances: Iterable[float] = (),
    *,
    exposure: float | None = None,
    nearest: float = NEAREST,
    looked_into: bool = False,
) -> EyeSafety:
    """Exposure, class and hazard distance of a continuous beam, after IEC 60825-1:2014.

    The class follows subclause 5.3 with the conditions of table 10 for 400 to 1400 nm: condition 3 is 7 mm at 100 mm
    from the exit, condition 1 is 50 mm at 2 m. The edition of 2014 no longer has the loupe of condition 2. Condition 1
    takes a point source (the default evaluation, 5.4.2), condition 3 the beam's own, where it is worst (5.4.3).

    Parameters
    ----------
    beam
        The light.
    distances
        Further distances at which to compare irradiance and MPE, in metres.
    exposure
        In seconds. Default: 0.25 for visible light; 100 for infrared, which triggers no aversion; 30000 where
        `looked_into`.
    nearest
        Smallest distance of a viewer's eye from the exit, in metres, at least 0.1. It does not change the class.
    looked_into
        Whether people look into the light for long by design; the time base of Class 1 is then 30000 s, not 100 s.

    Raises
    ------
    InputError
        When an argument is out of its range.
    """
    if not NEAREST <= nearest < math.inf:
        remedy = "give at least 0.1 m: the eye focuses no nearer"
        raise InputError(f"{nearest:g} m is too near or not a distance", where="nearest", remedy=remedy)
    distances = tuple(distances)
    for distance in distances:
        if not 0 < distance < math.inf:
            raise InputError(f"must be positive, is {distance:g} m", where="distances", remedy="give metres")
    usual = 3e4 if looked_into else 0.25 if visible(beam.wavelength) else 100.0
    seconds = checked_exposure(usual if exposure is None else exposure)
    base = 3e4 if looked_into else 100.0
    names = ("1", "2", "3R", "3B") if visible(beam.wavelength) else ("1", "3R", "3B")
    telescope = {name: ael(name, beam.wavelength, base) for name in names}
    positions = _positions(beam)
    worst = max(positions, key=lambda z: beam.through(PUPIL, z) / ael("1", beam.wavelength, base, beam.angle_at(z)))
    emission = {"3": beam.through(PUPIL, worst), "1": beam.through(TELESCOPE, TELESCOPE_DISTANCE)}
    return EyeSafety(
        beam=beam,
        exposure=seconds,
        class_exposure=base,
        nearest=_at(beam, nearest, seconds),
        at=tuple(_at(beam, float(distance), seconds) for distance in distances),
        naked_distance=worst,
        emission=emission,
        limits={name: ael(name, beam.wavelength, base, beam.angle_at(worst)) for name in names},
        telescope_limits=telescope,
        laser_class=_classify(beam, base, emission["1"], telescope, positions),
        nohd=_nohd(beam, seconds),
        aided_nohd=beam.reach(TELESCOPE, mpe(beam.wavelength, seconds) * PUPIL_AREA),
    )


def _at(beam: Beam, distance: float, exposure: float) -> AtDistance:
    return AtDistance(distance, irradiance_at(beam, distance), mpe(beam.wavelength, exposure, beam.angle_at(distance)))


def _positions(beam: Beam) -> list[float]:
    # An extended source is judged where it is worst (5.4.3). Its limits shrink with the distance until it is a point;
    # beyond that only the light through the pupil changes, and decreases.
    end = NEAREST * beam.source_angle / SMALL_SOURCE
    if end <= NEAREST:
        return [NEAREST]
    return [*np.geomspace(NEAREST, end, _STEPS, endpoint=False).tolist(), end * _ROUNDING]


def _classify(beam: Beam, base: float, aided: float, telescope: dict[str, float], positions: list[float]) -> LaserClass:
    def meets(naked: str, with_telescope: str) -> bool:
        if naked not in telescope or aided > telescope[with_telescope] * _ROUNDING:
            return False
        limits = (ael(naked, beam.wavelength, base, beam.angle_at(place)) for place in positions)
        return all(
            beam.through(PUPIL, place) <= limit * _ROUNDING for place, limit in zip(positions, limits, strict=True)
        )

    # The M classes apply their own limit to the naked eye and Class 3B's to the telescope.
    order: tuple[tuple[LaserClass, str, str], ...] = (
        ("1", "1", "1"),
        ("1M", "1", "3B"),
        ("2", "2", "2"),
        ("2M", "2", "3B"),
        ("3R", "3R", "3R"),
        ("3B", "3B", "3B"),
    )
    for name, naked, with_telescope in order:
        if meets(naked, with_telescope):
            return name
    return "4"


def _nohd(beam: Beam, exposure: float) -> float:
    # A point source's distance is an upper bound. An extended source keeps its higher limit only while it subtends
    # more than 1.5 mrad; there the irradiance falls as 1/width² and the limit as about 1/distance, so that their ratio
    # may rise before it falls: the last crossing counts.
    bound = beam.reach(PUPIL, mpe(beam.wavelength, exposure) * PUPIL_AREA)
    small_from = NEAREST * beam.source_angle / SMALL_SOURCE
    if bound == 0 or bound >= small_from:
        return bound
    start = min(NEAREST, bound)
    grid = np.geomspace(start, bound, _STEPS + 1).tolist()
    unsafe = [i for i, distance in enumerate(grid) if not _at(beam, distance, exposure).safe]
    if not unsafe:
        # Nearer than 100 mm the eye cannot focus; the source counts as at 100 mm.
        limit = mpe(beam.wavelength, exposure, beam.source_angle) * PUPIL_AREA
        return min(beam.reach(PUPIL, limit), start)
    if unsafe[-1] == _STEPS:
        return bound

    def excess(distance: float) -> float:
        place = _at(beam, distance, exposure)
        return place.irradiance / place.mpe - _ROUNDING

    low, high = grid[unsafe[-1] : unsafe[-1] + 2]
    return cast(float, brentq(excess, low, high, xtol=1e-15))


def _milliwatts(power: float) -> str:
    return f"{power * 1e3:.3g} mW"


def _limits(limits: dict[str, float]) -> str:
    return ", ".join(f"Class {name} {_milliwatts(value)}" for name, value in limits.items())


def _metres(distance: float) -> str:
    if distance == 0:
        return "0 m (always within the limit)"
    return "no end" if math.isinf(distance) else f"{distance:.3g} m"
