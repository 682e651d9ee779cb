"""Refractive indices of a few glasses, and the focal length of thin lenses made of them.

Indices are relative to air at 20 °C, as their sources state them.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from tapetum.errors import InputError

__all__ = ["GLASSES", "Glass", "abbe_number", "focal_length_at", "index_from_abbe", "refractive_index"]

_MICRON = 1e-6
# Fraunhofer's lines F, d and C, in metres.
_F_LINE, _D_LINE, _C_LINE = 486.133e-9, 587.562e-9, 656.273e-9
# Mercury's g and caesium's s: the ends of SCHOTT's two normal lines.
_G_LINE, _S_LINE = 435.834e-9, 852.11e-9
# Mercury's h and t lines: the range of the two-number formula.
_SHORTEST, _LONGEST = 404.66e-9, 1013.98e-9


@dataclass(frozen=True)
class Glass:
    """A dispersion formula and its range. Coefficients are for wavelengths in micrometres, as published.

    Parameters
    ----------
    sellmeier
        Pairs (B, C) of n² - 1 = Σ B λ²/(λ² - C).
    powers
        Pairs (coefficient, power) of n² = Σ c λ^power, in place of a Sellmeier formula.
    shortest, longest
        Wavelengths between which the formula holds, in metres.
    source
        Who published it.
    """

    sellmeier: tuple[tuple[float, float], ...]
    powers: tuple[tuple[float, int], ...]
    shortest: float
    longest: float
    source: str

    def index(self, wavelength: float) -> float:
        """n at a wavelength in metres, unchecked."""
        square = (wavelength / _MICRON) ** 2
        if self.powers:
            return math.sqrt(sum(c * square ** (power / 2) for c, power in self.powers))
        return math.sqrt(1 + sum(b * square / (square - c) for b, c in self.sellmeier))


GLASSES = {
    "N-BK7": Glass(
        ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
        (),
        0.31e-6,
        2.325e-6,
        "SCHOTT, data sheet N-BK7 517642.251",
    ),
    "N-SF11": Glass(
        ((1.73759695, 0.013188707), (0.313747346, 0.0623068142), (1.89878101, 155.23629)),
        (),
        0.37e-6,
        2.325e-6,
        "SCHOTT, data sheet N-SF11 785257.322",
    ),
    "fused silica": Glass(
        ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
        (),
        0.21e-6,
        3.71e-6,
        "I. H. Malitson, J. Opt. Soc. Am. 55, 1205 (1965)",
    ),
    "PMMA": Glass(
        (),
        (
            (2.399964, 0),
            (-8.308636e-2, 2),
            (-1.919569e-1, -2),
            (8.720608e-2, -4),
            (-1.666411e-2, -6),
            (1.169519e-3, -8),
        ),
        0.4358e-6,
        1.052e-6,
        "S. N. Kasarova et al., Opt. Mater. 29, 1481 (2007)",
    ),
}


def refractive_index(glass: str, wavelength: float) -> float:
    """Refractive index against air of one of `GLASSES`, the names of a scene's `lens.glass`.

    The wavelength is in air, in metres.

    Raises
    ------
    InputError
        For an unknown glass, or a wavelength at which its source gives no formula.
    """
    if glass not in GLASSES:
        raise InputError(f"unknown glass {glass!r}", where="glass", remedy=f"use {', '.join(GLASSES)}")
    known = GLASSES[glass]
    # Written so that NaN is refused too. A hundredth of a picometre allows for the rounding of 435.8e-9.
    slack = 1e-14
    if not known.shortest - slack <= wavelength <= known.longest + slack:
        raise InputError(
            f"{wavelength * 1e9:.6g} nm is outside of the formula of {glass}",
            where="wavelength",
            remedy=f"stay within {known.shortest * 1e9:g} to {known.longest * 1e9:g} nm, or leave the glass out",
        )
    return known.index(wavelength)


def abbe_number(glass: str) -> float:
    """(n_d - 1)/(n_F - n_C) of one of `GLASSES`: the larger, the smaller its dispersion."""
    n_f, n_d, n_c = (refractive_index(glass, line) for line in (_F_LINE, _D_LINE, _C_LINE))
    return (n_d - 1) / (n_f - n_c)


def focal_length_at(focal_length: float, glass: str | None, design_wavelength: float, wavelength: float) -> float:
    """Focal length of a thin lens at another wavelength: f (n₀ - 1)/(n - 1), by the lens maker's formula.

    Parameters
    ----------
    focal_length
        At the design wavelength, in metres.
    glass
        One of `GLASSES`, or None for a lens without dispersion.
    design_wavelength, wavelength
        In metres.

    Raises
    ------
    InputError
        As `refractive_index`.
    """
    if glass is None or wavelength == design_wavelength:
        return focal_length
    return focal_length * (refractive_index(glass, design_wavelength) - 1) / (refractive_index(glass, wavelength) - 1)


@functools.lru_cache(maxsize=4096)
def index_from_abbe(nd: float, vd: float, wavelength: float) -> float:
    """Refractive index, at a wavelength in metres, of a glass known by n_d and Abbe number, as patents state them.

    Raises
    ------
    InputError
        For an index or an Abbe number of no glass, or a wavelength beyond 405 to 1014 nm.

    Notes
    -----
    n = A + B/λ² + C/λ⁴ + Dλ², through n_d, n_F - n_C, and a normal glass's partial dispersions P_gF = 0.6438 - 0.001682
    V and P_Cs = 0.4029 + 0.002331 V (SCHOTT, TIE-29). At 640 and 785 nm it is within 8e-5 of the formulas of N-BK7,
    N-SF11 and fused silica, and within 6e-4 of PMMA's, whose own source is stated to 1e-3. Cauchy's two terms err by
    1.2e-3 for N-SF11, one Sellmeier term by 4e-4 for all.
    """
    if not (1 < nd < 5 and 10 <= vd <= 120):
        what = f"n_d = {nd:g} with an Abbe number of {vd:g} is no glass"
        raise InputError(what, where="nd, vd", remedy="give for example nd: 1.5168, vd: 64.2")
    if not _SHORTEST <= wavelength <= _LONGEST:
        what = f"{wavelength * 1e9:.6g} nm is outside the range that n_d and the Abbe number describe"
        raise InputError(what, where="wavelength", remedy="stay within 405 to 1013 nm")
    mean = (nd - 1) / vd
    steps = [_terms(_F_LINE) - _terms(_C_LINE), _terms(_G_LINE) - _terms(_F_LINE), _terms(_C_LINE) - _terms(_S_LINE)]
    differences = mean * np.array([1.0, 0.6438 - 0.001682 * vd, 0.4029 + 0.002331 * vd])
    return nd + float(np.linalg.solve(np.stack(steps), differences) @ (_terms(wavelength) - _terms(_D_LINE)))


def _terms(wavelength: float) -> np.ndarray:
    square = (wavelength / _MICRON) ** 2
    return np.array([1 / square, 1 / square**2, square])
