"""What the probe's source sends: wavelengths, and directions."""

from __future__ import annotations

import math

from tapetum.bench import Illumination
from tapetum.errors import InputError

__all__ = ["coherence_length", "directions", "wavelengths"]

# Full width at half maximum of a Gaussian, in standard deviations.
_FWHM = 2 * math.sqrt(2 * math.log(2))
_REACH = 2.5
_MOST_WAVELENGTHS, _MOST_DIRECTIONS = 65, 4096


def wavelengths(light: Illumination, detail: float = 10.0) -> list[tuple[float, float]]:
    """Wavelengths in metres that stand for the source's spectrum, each with its power in watts.

    Parameters
    ----------
    light
        Its lines, each a Gaussian of its bandwidth.
    detail
        Rings of the RR: the pattern grows with the wavelength, so the outermost ring decides how finely a line is
        divided.

    Notes
    -----
    The samples lie at equal distances, a quarter of the outermost ring or less, out to 2.5 standard deviations.
    """
    lines = [(light.wavelength, light.power), *((line.wavelength, line.power) for line in light.lines)]
    if light.bandwidth == 0:
        return lines
    sigma = light.bandwidth / _FWHM
    found: list[tuple[float, float]] = []
    for middle, power in lines:
        span = 2 * _REACH * sigma
        count = min(max(5, 2 * math.ceil(2 * detail * span / middle) + 1), _MOST_WAVELENGTHS)
        steps = [(i / (count - 1) - 0.5) * span for i in range(count)]
        weights = [math.exp(-((step / sigma) ** 2) / 2) for step in steps]
        found += [(middle + s, power * w / math.fsum(weights)) for s, w in zip(steps, weights, strict=True)]
    return found


def coherence_length(light: Illumination) -> float:
    """Path difference up to which two reflections are summed as fields, in metres: λ²/Δλ, or what the scene says."""
    if light.coherence_length is not None:
        return light.coherence_length
    return math.inf if light.bandwidth == 0 else light.wavelength**2 / light.bandwidth


def directions(light: Illumination, airy_angle: float) -> list[tuple[float, float, float]]:
    """Directions from which the source's light comes, as angles in radians against its middle, each with its share.

    Parameters
    ----------
    light
        Its `source_size`.
    airy_angle
        λ/2r of the target: directions nearer than half of it give the same picture, blurred by nothing.

    Raises
    ------
    InputError
        For a source so wide that its directions are too many.
    """
    if light.source_size == 0:
        return [(0.0, 0.0, 1.0)]
    radius = light.source_size / 2
    # A disc of equal shares, on a square lattice.
    side = max(3, math.ceil(light.source_size / (airy_angle / 2)))
    step = light.source_size / side
    places = [(i - (side - 1) / 2) * step for i in range(side)]
    inside = [(x, y) for y in places for x in places if math.hypot(x, y) <= radius]
    if len(inside) > _MOST_DIRECTIONS:
        widest = airy_angle / 2 * math.sqrt(_MOST_DIRECTIONS / (math.pi / 4))
        raise InputError(
            f"{light.source_size:g} rad are {len(inside)} directions",
            where="illumination.source_size",
            remedy=f"make it smaller than {widest:.2g} rad, or stop the target down",
        )
    return [(x, y, 1 / len(inside)) for x, y in inside]
