"""The judge's way from the target's lens plane through the probe's round aperture: exact distances.

The lens plane is tilted, so its points x stand at (x_1, x_2 cosθ, d + x_2 sinθ) before the aperture's (a_1, a_2, 0).
The wave exp(ikρ)/ρ between two points depends on x_1 and a_1 through b = (x_1 - a_1)² alone. Interpolated in b at
enough points that the error is rounding, it is a short sum of products, and each costs two matrix products.
`plain_sum` does the same point by point; a test compares them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .plane import TooLargeError
from .quadrature import Complex, Real, folded, halved, interpolation, legendre, phasor, region_weights, times

_MOST_APERTURE = 900

__all__ = ["Probe", "along", "plain_sum", "points_of_aperture", "seen", "through_aperture"]


@dataclass(frozen=True)
class Probe:
    """Its focal length; to carry light over a distance the distance and the radius of its aperture, in metres."""

    focal_length: float
    distance: float | None = None
    radius: float = math.inf


def along(vector: Real) -> Real:
    """The turn that puts a vector [2] along +y."""
    length = float(np.hypot(*vector))
    if length == 0:
        return np.eye(2)
    x, y = vector / length
    return np.array([[y, -x], [x, y]])


def through_aperture(
    exit_field: Complex, nodes: Real, sine: float, k: float, probe: Probe, pixels: Real, effort: float = 1.0
) -> Complex:
    """Amplitudes at pixels [Q, 2] for a field [y, x] on a lens plane tilted by a sine along y, weights in it.

    The field is power-normalised: squared moduli are W/m² of the plane.
    """
    assert probe.distance is not None
    count = points_of_aperture(float(np.abs(nodes).max()), k, probe, pixels, effort)
    places = legendre(count)[0] * probe.radius
    return seen(_at_aperture(exit_field, nodes, places, sine, k, probe.distance), places, k, probe, pixels)


def points_of_aperture(reach: float, k: float, probe: Probe, pixels: Real, effort: float) -> int:
    """Points across the probe's aperture for light that leaves the lens up to `reach` from its middle."""
    assert probe.distance is not None
    widest = float(np.abs(pixels).max()) / probe.focal_length
    steep = k * ((probe.radius + reach) / probe.distance * (1 + (probe.radius + reach) / probe.distance) + widest)
    count = math.ceil(effort * 1.1 * steep * probe.radius) + 24
    if count > _MOST_APERTURE:
        raise TooLargeError(f"{count}² points of the probe's aperture")
    return count


def seen(field: Complex, places: Real, k: float, probe: Probe, pixels: Real) -> Complex:
    """Amplitudes at pixels [Q, 2] for a field [a_2, a_1] at Gauss-Legendre places across the probe's aperture."""
    field = field * region_weights(len(places), probe.radius)
    across = phasor(-k / probe.focal_length * np.outer(pixels[:, 0], places))
    down = times(halved(k / probe.focal_length * pixels[:, 1], places), folded(field))
    return (down * across).sum(1) * (k / (2 * math.pi * probe.focal_length))


def _at_aperture(exit_field: Complex, x: Real, a: Real, sine: float, k: float, distance: float) -> Complex:
    """Field [a_2, a_1] at the aperture: Huygens' waves with the cosine of the direction in which each leaves."""
    cosine, y = math.sqrt(1 - sine**2), x[:, None]
    square = (y * cosine - a) ** 2 + (distance + y * sine) ** 2
    # From the point of the lens plane to that of the aperture, along the plane's normal.
    normal = distance * cosine + a * sine
    most = (float(np.abs(x).max()) + float(np.abs(a).max())) ** 2
    b = (y - a) ** 2
    turning = k * most / 2 * float(np.abs(1 / np.sqrt(square.min()) - 1 / distance)) + k * most**2 / (8 * distance**3)
    count = 12 + math.ceil(0.7 * turning)
    knots, shares = interpolation(0.0, most, count, b)
    chirp = phasor(k * b / (2 * distance))
    total = np.zeros((len(a), len(a)), np.complex128)
    for knot, share in zip(knots, shares, strict=True):
        length = np.sqrt(square + knot)
        # √cosine/ρ of a power-normalised field, phases without the way's own k d.
        path = (square - distance**2 + knot) / (length + distance) - knot / (2 * distance)
        down = phasor(k * path) * np.sqrt(np.abs(normal) / length) / length
        part = exit_field @ (chirp * share)
        total += down.T @ part
    return total * (k / (2j * math.pi))


def plain_sum(exit_field: Complex, x: Real, a: Real, sine: float, k: float, distance: float) -> Complex:
    """What `through_aperture` puts on the aperture, point by point: [a_2, a_1]."""
    cosine = math.sqrt(1 - sine**2)
    x1, x2 = (one.ravel() for one in np.meshgrid(x, x))
    found = np.empty((len(a), len(a)), np.complex128)
    for i, a2 in enumerate(a):
        for j, a1 in enumerate(a):
            length = np.sqrt((x1 - a1) ** 2 + (x2 * cosine - a2) ** 2 + (distance + x2 * sine) ** 2)
            normal = distance * cosine + a2 * sine
            wave = phasor(k * (length - distance)) * np.sqrt(normal / length) / length
            found[i, j] = (wave * exit_field.ravel()).sum()
    return found * (k / (2j * math.pi))
