"""What the probe's source sends: wavelengths, and directions."""

from __future__ import annotations

import math

import numpy as np

from tapetum.bench import Illumination
from tapetum.errors import InputError

__all__ = ["degree_of_coherence", "directions", "reach_of_interference", "wavelengths"]

# Full width at half maximum of a Gaussian, in standard deviations.
_FWHM = 2 * math.sqrt(2 * math.log(2))
_REACH = 2.5
# Paths over λ²/Δλ at which a Gaussian line's degree of coherence, exp(-(π x)²/(4 ln 2)), is 1e-4.
_FADED = 1.61
_MOST_WAVELENGTHS, _MOST_DIRECTIONS = 65, 4096


def wavelengths(light: Illumination, detail: float = 10.0, path: float = 0.0) -> list[tuple[float, float]]:
    """Wavelengths in metres that sample the source's spectrum, each with its power in watts.

    The RR grows with the wavelength, so its outermost ring, number `detail`, sets the spacing: equal steps of a quarter
    of that ring or less, out to 2.5 standard deviations of each Gaussian line. Equally spaced samples make interference
    repeat with the path difference; the spacing is so fine that it has faded at `path`, the largest difference in
    metres between planes that interfere, before it repeats.
    """
    lines = [(light.wavelength, light.power), *((line.wavelength, line.power) for line in light.lines)]
    if light.bandwidth == 0:
        return lines
    sigma = light.bandwidth / _FWHM
    found: list[tuple[float, float]] = []
    for middle, power in lines:
        span = 2 * _REACH * sigma
        repeats = (path + _FADED * middle**2 / light.bandwidth) / middle**2 if path else 0.0
        half = max(2, math.ceil(2 * detail * span / middle), math.ceil(repeats * span / 2))
        count = min(2 * half + 1, _MOST_WAVELENGTHS)
        steps = [(i / (count - 1) - 0.5) * span for i in range(count)]
        weights = [math.exp(-((step / sigma) ** 2) / 2) for step in steps]
        found += [(middle + s, power * w / math.fsum(weights)) for s, w in zip(steps, weights, strict=True)]
    return found


def reach_of_interference(light: Illumination) -> float:
    """Path difference in metres beyond which two reflections add as irradiance; infinite for a laser line.

    It is the `coherence_length`, or 1.61 λ²/Δλ of a line with a bandwidth, where the degree of coherence is 1e-4.
    """
    given = math.inf if light.coherence_length is None else light.coherence_length
    return given if light.bandwidth == 0 else min(given, _FADED * light.wavelength**2 / light.bandwidth)


def degree_of_coherence(light: Illumination, path: float) -> float:
    """|γ| of light of one wavelength after a path difference in metres: 1 - path/L for a `coherence_length` L.

    This belongs to a line of shape sinc², 0.89 λ²/L wide at half its height. Without a coherence length it is 1: the
    sum over `wavelengths` then includes the effect of the bandwidth.
    """
    return 1.0 if light.coherence_length is None else max(0.0, 1 - abs(path) / light.coherence_length)


def directions(light: Illumination, airy_angle: float) -> list[tuple[float, float, float]]:
    """Directions of an extended source's light, in radians from its middle, each with its share of the power.

    `airy_angle` is λ/2r of the target, the width of the picture's finest fringes. Raises InputError for a source so
    wide that it needs too many directions.
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
