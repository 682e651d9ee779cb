"""What the probe's aperture cuts off a return that fits through it by rays: rings and edge waves, and their picture.

Head on everything is round. The wave that leaves the target, of radius ρ and curvature κ, meets the probe's aperture R
at the distance d as

    u(X) = k/d exp(ikX²/2d) ∫_0^ρ exp(ik(1/d - κ)x²/2) J0(kxX/d) x dx

and a probe that is focused at infinity sees ∫_0^R u(X) J0(kqX) X dX in the direction q; without the aperture it sees
∫_0^ρ exp(-ikκx²/2) J0(kqx) x dx. Both are summed, and compared over the picture. That the sensor's spot is cut off by
nothing but the target's lens is neglected.
"""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import functools
import math

import numpy as np
import numpy.typing as npt
from scipy.special import j0

from tapetum.optics.sampling import DoublePassGeometry

__all__ = ["cut_by_aperture"]

# Directions for each ring, rings beyond the rays, and nodes for each turn of the phase and besides.
_FOR_A_RING, _RINGS, _FOR_A_TURN, _MORE = 4, 6, 2.2, 24
# Nodes of one Gauss-Legendre rule, and most products of nodes that are summed.
_RULE, _MOST = 64, 1e7
# Least radius of the returning wave, over the target's: where all rays return through one point.
_LEAST = 1e-3

_Real = npt.NDArray[np.float64]


@functools.lru_cache(maxsize=256)
def cut_by_aperture(geometry: DoublePassGeometry, distance: float, probe_radius: float) -> float:
    """The largest change of a head-on picture by the probe's aperture, in fractions of the peak.

    Parameters
    ----------
    geometry
        The scene's lengths; tilt and window are not used.
    distance, probe_radius
        From the target's lens to the probe's aperture, and its radius, in metres.

    Returns
    -------
    float
        Within a factor of two of what pictures with and without the aperture differ by, head on and under tilts. Where
        the sums would be too long (a near probe with a wide aperture) a bound, of waves from the aperture's edge.
    """
    k, f, z = 2 * math.pi / geometry.wavelength, geometry.focal_length, geometry.image_distance
    slope = 1 / f - geometry.curvature
    gain = 1 - 2 * z * slope
    gain = math.copysign(max(abs(gain), _LEAST), gain)
    # A ray that entered at x returns at gain·x, with the slope -slope·x, and the lens bends it once more.
    radius = min(geometry.radius, min(geometry.radius, geometry.lit_radius) * abs(gain))
    bend = (slope + gain / f) / gain
    ring = geometry.wavelength / (2 * radius)
    widest = abs(bend) * radius + _RINGS * ring
    meets = k * radius * probe_radius / distance
    # Phases as if they grew everywhere as fast as at the ends.
    x = _nodes(radius, k * radius**2 * (abs(bend) + 1 / distance) + meets)
    beyond = _nodes(probe_radius, k * probe_radius**2 / distance + meets + k * probe_radius * widest)
    q = np.linspace(0, widest, math.ceil(_FOR_A_RING * widest / ring) + 1)
    if len(beyond[0]) * max(len(x[0]), len(q)) > _MOST:
        return min(
            1.0, 4 * math.sqrt(2 / (math.pi * meets)) * (1 / meets + abs(bend) * distance * radius / probe_radius)
        )
    (at, weight), (place, share) = x, beyond
    wave = np.exp(-0.5j * k * bend * at**2) * at * weight
    whole = j0(k * np.outer(q, at)) @ wave
    met = j0(k / distance * np.outer(place, at)) @ (wave * np.exp(0.5j * k * at**2 / distance))
    met = k / distance * np.exp(0.5j * k * place**2 / distance) * met
    cut = j0(k * np.outer(q, place)) @ (met * place * share)
    seen, left = np.abs(whole) ** 2, np.abs(cut) ** 2
    return float(np.abs(seen - left).max() / max(seen.max(), left.max()))


def _nodes(end: float, phase: float) -> tuple[_Real, _Real]:
    """Gauss-Legendre places and weights from 0 to an end, for a phase in radians."""
    parts = math.ceil((_FOR_A_TURN * phase / (2 * math.pi) + _MORE) / _RULE)
    nodes, weights = np.polynomial.legendre.leggauss(_RULE)
    half = end / parts / 2
    middles = half * (2 * np.arange(parts) + 1)
    return (middles[:, None] + half * nodes).ravel(), np.tile(half * weights, parts)
