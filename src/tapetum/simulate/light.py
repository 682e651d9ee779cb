"""What the probe's source sends: wavelengths, and directions."""

from __future__ import annotations

import math

import numpy as np
from scipy.special import erfcinv  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from tapetum.bench import Illumination
from tapetum.errors import InputError

__all__ = ["degree_of_coherence", "directions", "reach_of_interference", "shortest", "wavelengths"]

# Full width at half maximum of a Gaussian, in standard deviations.
_FWHM = 2 * math.sqrt(2 * math.log(2))
# Of the accuracy, the share of a line's power that is left out at its ends, and the widest that ends may be over λ.
_LEFT_OUT, _WIDEST = 0.1, 0.6
# Paths over λ²/Δλ at which a Gaussian line's degree of coherence, exp(-(π x)²/(4 ln 2)), is 1e-4.
_FADED = 1.61
_MOST_WAVELENGTHS, _MOST_DIRECTIONS = 257, 4096


def wavelengths(
    light: Illumination, spread: float = 0.0, path: float = 0.0, accuracy: float = 1e-2
) -> list[tuple[float, float]]:
    """Wavelengths in metres that sample the source's spectrum, each with its power in watts.

    Each Gaussian line is summed at Gauss-Legendre points. Where the phase of what interferes changes by 2ω over the
    line, these converge exponentially from ω/2 points on.

    Parameters
    ----------
    light
        The source.
    spread
        The largest difference of paths between light of one plane that meets in the picture, in metres: the target's
        aperture times the picture's half angle.
    path
        The largest difference of paths between planes that interfere, in metres.
    accuracy
        Of the picture, in fractions of its peak.

    Raises
    ------
    InputError
        For a line that would need too many.
    """
    lines = [(light.wavelength, light.power), *((line.wavelength, line.power) for line in light.lines)]
    if light.bandwidth == 0:
        return lines
    sigma = light.bandwidth / _FWHM
    found: list[tuple[float, float]] = []
    for middle, power in lines:
        reach = min(math.sqrt(2) * float(erfcinv(_LEFT_OUT * accuracy)) * sigma, _WIDEST * middle)
        omega = 2 * math.pi * (spread + path) * reach / middle**2
        count = math.ceil(0.55 * omega) + 3 + math.ceil(1.5 * math.log10(1 / accuracy))
        # The middle is one of them.
        count += 1 - count % 2
        if count > _MOST_WAVELENGTHS:
            raise InputError(
                f"a line {light.bandwidth:.3g} m wide takes {count} wavelengths, more than {_MOST_WAVELENGTHS}",
                where="illumination.bandwidth",
                remedy="narrow it, focus the target nearer to the probe, or leave thick layers out",
            )
        nodes, weights = np.polynomial.legendre.leggauss(count)
        shares = weights * np.exp(-((reach / sigma * nodes) ** 2) / 2)
        shares *= power / shares.sum()
        found += [(float(middle + reach * node), float(one)) for node, one in zip(nodes, shares, strict=True)]
    return found


def reach_of_interference(light: Illumination, wavelength: float) -> float:
    """Path difference in metres beyond which two reflections add as irradiance; infinite for a laser line.

    It is the `coherence_length`, or 1.61 λ²/Δλ of a line with a bandwidth, where the degree of coherence is 1e-4: of
    the line that is nearest to the wavelength, so that all of a line's wavelengths have one reach.
    """
    given = math.inf if light.coherence_length is None else light.coherence_length
    middle = min((light.wavelength, *(line.wavelength for line in light.lines)), key=lambda one: abs(one - wavelength))
    return given if light.bandwidth == 0 else min(given, _FADED * middle**2 / light.bandwidth)


def degree_of_coherence(light: Illumination, path: float) -> float:
    """|γ| of light of one wavelength after a path difference in metres: 1 - path/L for a `coherence_length` L.

    This belongs to a line of shape sinc², 0.89 λ²/L wide at half its height. Without a coherence length it is 1: the
    sum over `wavelengths` then includes the effect of the bandwidth.
    """
    return 1.0 if light.coherence_length is None else max(0.0, 1 - abs(path) / light.coherence_length)


def shortest(light: Illumination) -> float:
    """The shortest wavelength of which there is light to count, in metres."""
    middle = min(light.wavelength, *(line.wavelength for line in light.lines), math.inf)
    return middle - min(3 * light.bandwidth / _FWHM, _WIDEST * middle)


def directions(light: Illumination, airy_angle: float) -> list[tuple[float, float, float]]:
    """Directions of an extended source's light, in radians from its middle, each with its share of the power.

    `airy_angle` is λ/2r of the target at the shortest wavelength, the width of the picture's finest fringes. Raises
    InputError for a source so wide that it needs too many directions.
    """
    if light.source_size == 0:
        return [(0.0, 0.0, 1.0)]
    radius = light.source_size / 2
    # The phase of the finest fringes, those between two ends of the pupil, changes by this from the source's middle to
    # its rim. A few circles of directions, at Gaussian nodes of the area, resolve it.
    turn = 2 * math.pi * radius / airy_angle
    circles, around = math.ceil(turn / math.pi) + 1, math.ceil(turn) + 5
    if circles * around > _MOST_DIRECTIONS:
        widest = airy_angle / math.pi * math.sqrt(_MOST_DIRECTIONS * math.pi)
        raise InputError(
            f"{light.source_size:g} rad are {circles * around} directions",
            where="illumination.source_size",
            remedy=f"make it smaller than {0.9 * widest:.2g} rad, or stop the target down",
        )
    nodes, weights = np.polynomial.legendre.leggauss(circles)
    found: list[tuple[float, float, float]] = []
    for circle, (node, weight) in enumerate(zip(nodes, weights, strict=True)):
        away = radius * math.sqrt((node + 1) / 2)
        for i in range(around):
            # Rotate every second circle by half a step.
            angle = 2 * math.pi * (i + circle % 2 / 2) / around
            found.append((away * math.cos(angle), away * math.sin(angle), float(weight) / 2 / around))
    return found
