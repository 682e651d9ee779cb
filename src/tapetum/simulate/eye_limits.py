"""Limits of exposure and emission for continuous laser light of 400 to 1400 nm, after IEC 60825-1:2014.

Tables are cited as in the standard: 3 and 4 (Class 1, small and extended sources), 5 (Class 2), 6 and 7 (Class 3R), 8
(Class 3B), 9 (factors), A.1 and A.2 (exposure of the eye), A.5 (of the skin). ICNIRP's guidelines of 2013 (Health Phys.
105(3):271-295) hold the same exposure limits, under the names C_A (C4), C_B (C3), C_E (C6) and C_C (C7). Wavelengths
and angles are in metres and radians here, in nanometres and milliradians in the tables.

Some limits are higher for a source wider than the cone of measurement (γ of 11 to 110 mrad for blue light, 100 mrad for
heat). This relief is not used: the limits here are the stricter ones.
"""

from __future__ import annotations

import math

from tapetum.errors import InputError

__all__ = [
    "PUPIL",
    "SMALL_SOURCE",
    "ael",
    "c3",
    "c4",
    "c6",
    "c7",
    "mpe",
    "nanometres",
    "t2",
    "visible",
]

PUPIL = 7e-3  # m: the limiting aperture of the eye, 400 to 1400 nm (table 10, condition 3)
SMALL_SOURCE = 1.5e-3  # rad: alpha_min of table 9; the eye images no source smaller
_LARGEST = 0.1  # rad: alpha_max of table 9 from 0.25 s on
_SKIN = 3.5e-3  # m: the limiting aperture of the skin
_SHORTEST, _LONGEST = 0.25, 3e4  # s


def nanometres(wavelength: float) -> float:
    """The wavelength in nm, checked to lie from 400 nm up to, not including, 1400 nm.

    Raises InputError outside that range, where other organs and other tables apply.
    """
    # Multiplying rounds 400e-9 m to just below 400 nm: undo the last binary digit.
    value = round(wavelength * 1e9, 6) if math.isfinite(wavelength) else math.nan
    if not 400 <= value < 1400:
        raise InputError(
            f"{wavelength * 1e9:g} nm is outside 400 to 1400 nm (1400 excluded), where these limits hold",
            where="wavelength",
            remedy="give metres (640e-9), or ask a laser safety officer about ultraviolet and far infrared light",
        )
    return value


def visible(wavelength: float) -> bool:
    """Whether the standard counts the wavelength, in metres, as visible: 400 nm up to, not including, 700 nm."""
    return nanometres(wavelength) < 700


def c3(wavelength: float) -> float:
    """C3, the smaller hazard of blue light at longer wavelengths; 400 to 600 nm (table 9)."""
    return 10 ** (0.02 * max(nanometres(wavelength) - 450, 0))


def c4(wavelength: float) -> float:
    """C4, the smaller absorption of the retina beyond 700 nm (table 9)."""
    return 10 ** (0.002 * min(max(nanometres(wavelength) - 700, 0), 350)) if nanometres(wavelength) < 1050 else 5.0


def c6(source_angle: float) -> float:
    """C6, the larger limit of an extended source, for exposures of 0.25 s and more (table 9)."""
    return min(max(source_angle, SMALL_SOURCE), _LARGEST) / SMALL_SOURCE


def c7(wavelength: float) -> float:
    """C7, the absorption by the eye's water beyond 1150 nm (table 9; the edition of 2007 stopped at 8)."""
    nm = nanometres(wavelength)
    if nm < 1150:
        return 1.0
    return 10 ** (0.018 * (nm - 1150)) if nm < 1200 else 8 + 10 ** (0.04 * (nm - 1250))


def t2(source_angle: float) -> float:
    """T2 in seconds, after which a source of that size heats the retina no further (table 9)."""
    angle = min(max(source_angle, SMALL_SOURCE), _LARGEST)
    return 10 * 10 ** ((angle - SMALL_SOURCE) / (_LARGEST - SMALL_SOURCE))


def mpe(wavelength: float, exposure: float, source_angle: float = 0.0) -> float:
    """Maximum permissible exposure of the eye, as irradiance at the cornea in W/m², averaged over 7 mm.

    It is the lowest of the retina's limits for heat and blue light and of the skin's limit, which protects the front of
    the eye (the standard's note to table A.1). The skin's limit applies over 3.5 mm; a quarter of it is used, so that
    light within 7 mm keeps it however narrow the beam is.

    Parameters
    ----------
    wavelength
        In metres, 400 nm to below 1400 nm.
    exposure
        In seconds, 0.25 to 30000, of light that does not change.
    source_angle
        Angle that the apparent source subtends at the eye, in radians; up to 1.5 mrad it counts as a point.

    Raises
    ------
    InputError
        When an argument is out of its range.
    """
    nm, t = nanometres(wavelength), checked_exposure(exposure)
    checked_angle(source_angle)
    spectral = c4(wavelength) * c7(wavelength)
    if t < t2(source_angle):
        thermal = 18 * t**-0.25 * c6(source_angle) * spectral  # A.1 and A.2: 18 t^0.75 C4 C6 C7 J/m²
    elif source_angle <= SMALL_SOURCE:
        thermal = 10 * spectral  # A.1
    else:
        thermal = 18 * c6(source_angle) * spectral * t2(source_angle) ** -0.25  # A.2
    skin = 2000 if t >= 10 else 1.1e4 * t**-0.75  # A.5, times C4
    limits = [thermal, skin * c4(wavelength) * (_SKIN / PUPIL) ** 2]
    if _blue_counts(nm, t):
        limits.append(c3(wavelength) * max(100 / t, 1))  # A.1 and A.2: 100 C3 J/m², from 100 s on C3 W/m²
    return min(limits)


def ael(laser_class: str, wavelength: float, exposure: float = 100.0, source_angle: float = 0.0) -> float:
    """Accessible emission limit of a class, in watts through the measuring aperture.

    Parameters
    ----------
    laser_class
        `1` (also 1M), `2` (also 2M), `3R` or `3B`.
    wavelength, source_angle
        As for [`mpe`][tapetum.simulate.eye_limits.mpe].
    exposure
        The time base of Class 1 and of Class 3R beyond 700 nm, in seconds, at least 100: 100 where nobody means to look
        into the light, 30000 where that is its purpose (subclause 4.3 e). Visible Classes 2 and 3R use 0.25 s.

    Raises
    ------
    InputError
        For another class, Class 2 of invisible light, or a value out of its range.
    """
    nm, t = nanometres(wavelength), checked_exposure(exposure)
    checked_angle(source_angle)
    if t < 100:
        raise InputError(
            f"a time base of {t:g} s is too short", where="exposure", remedy="classify with 100 or 30000 s"
        )
    if laser_class == "3B":
        return 0.5  # table 8, 315 nm and more, from 0.25 s on
    if laser_class == "2" and visible(wavelength):
        return 1e-3 * c6(source_angle)  # table 5
    if laser_class == "3R" and visible(wavelength):
        return 5e-3 * c6(source_angle)  # tables 6 and 7
    if laser_class not in ("1", "3R"):
        remedy = "use 1, 2 (visible light only), 3R or 3B"
        raise InputError(f"no limit of Class {laser_class} at {nm:g} nm", where="laser_class", remedy=remedy)
    spectral = c4(wavelength) * c7(wavelength)
    if source_angle <= SMALL_SOURCE:
        thermal = (3.9e-4 if laser_class == "1" else 2e-3) * spectral  # tables 3 and 6
    else:
        start = 7e-4 if laser_class == "1" else 3.5e-3  # tables 4 and 7
        thermal = start * c6(source_angle) * spectral * t2(source_angle) ** -0.25
    # The standard limits Classes 1 and 3R by Class 3B; the stricter amendment A11:2021 also by the skin's limit.
    skin = 2000 * c4(wavelength) * math.pi * _SKIN**2 / 4
    limits = [thermal, skin, 0.5]
    if laser_class == "1" and _blue_counts(nm, t):
        limits.append(3.9e-5 * c3(wavelength))  # tables 3 and 4, from 100 s on
    return min(limits)


def checked_exposure(exposure: float) -> float:
    """The exposure when it lies in 0.25 to 30000 s, else an InputError."""
    if not _SHORTEST <= exposure <= _LONGEST:
        remedy = "use 0.25 s (visible light, looking away), 10, 100 or 30000 s"
        raise InputError(f"{exposure:g} s is outside 0.25 to 30000 s", where="exposure", remedy=remedy)
    return exposure


def checked_angle(source_angle: float) -> float:
    """The source's angle when it lies in 0 to π, else an InputError."""
    if not 0 <= source_angle <= math.pi:
        remedy = "give radians, 0 for a point (the strictest)"
        raise InputError(f"{source_angle:g} rad is no apparent source", where="source_angle", remedy=remedy)
    return source_angle


def _blue_counts(nm: float, exposure: float) -> bool:
    # From 10 s on; below 484 nm from 1 s on, as a note asks for sources of 1.5 to 82 mrad. Used for all sources: for
    # small ones heat sets the lower limit anyway.
    return nm < 600 and exposure >= (1 if nm < 484 else 10)
