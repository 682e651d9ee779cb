"""What the probe's aperture cuts off a return that fits through it by rays: rings and edge waves, and their picture.

Head on everything is round, and the double pass of a thin lens and a mirror is a chain of Hankel transforms: from the
pupil to the spot on the sensor, back to the pupil, over the distance to the aperture R, and to the direction q that a
probe focused at infinity looks in. Its last two,

    u(X) = k/d exp(ikX²/2d) ∫_0^r E(x) exp(ikx²/2d) J0(kxX/d) x dx     and     ∫_0^R u(X) J0(kqX) X dX

are compared with ∫_0^r E(x) J0(kqx) x dx, which has no aperture. Under a tilt light leaves by the part of the lens that
the returning beam meets; a smaller round pupil, as wide as it is along the tilt, stands for it.
"""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.special import j0

from tapetum.optics.sampling import DoublePassGeometry

__all__ = ["cut_by_aperture", "cut_up_to"]

# Directions for each ring, rings beyond the rays in the picture and on the sensor, nodes for each turn of the phase and
# besides.
_FOR_A_RING, _RINGS, _ON_SENSOR, _FOR_A_TURN, _MORE = 4, 6, 6, 2.2, 24
# Nodes of one Gauss-Legendre rule, and most products of nodes that are summed.
_RULE, _MOST = 64, 1e7
# Tilts that are tried, and the narrowest pupil over the lens's radius: beyond, hardly any light returns. A pupil that
# is as good as whole, and the least of the aperture's radius that is left beside the light.
_TILTS, _NARROWEST, _WHOLE, _NEAREST = 6, 0.05, 0.98, 0.3

_Real = npt.NDArray[np.float64]


def cut_up_to(geometry: DoublePassGeometry, distance: float, probe_radius: float, steepest: float) -> float:
    """The largest change of a picture by the probe's aperture, head on and up to a tilt, in fractions of its own peak.

    Parameters
    ----------
    geometry, distance, probe_radius
        As for `cut_by_aperture`.
    steepest
        Sine of the steepest tilt.

    Notes
    -----
    Tilts in between are tried too, for waves from the aperture's edges meet in step or not. What leaves beside the
    pupil's middle also lands beside the aperture's, and is nearer to its edge by as much. Of tilts that leave less than
    a twentieth of the pupil's width nothing is said.
    """
    g, radius = geometry, geometry.radius
    slope = 1 / g.focal_length - g.curvature
    gain = 1 - 2 * g.image_distance * slope
    back = min(radius, g.lit_radius) * abs(gain)
    # Where rays from beside the middle land, over where they leave.
    lands = abs(1 - distance * (slope + gain / g.focal_length) / math.copysign(max(abs(gain), _NARROWEST), gain))
    worst = 0.0
    for shift in np.linspace(
        0, 2 * g.image_distance * math.tan(math.asin(steepest)), _TILTS if steepest else 1
    ).tolist():
        low, high = max(shift - back, -radius), min(shift + back, radius)
        half, middle = (high - low) / 2, (high + low) / 2
        if shift and half < _NARROWEST * radius:
            break
        one = replace(g, radius=half, lit_radius=half) if half < _WHOLE * min(back, radius) else g
        worst = max(worst, cut_by_aperture(one, distance, max(probe_radius - middle * lands, _NEAREST * probe_radius)))
    return worst


@functools.lru_cache(maxsize=1024)
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
        Exact for a thin lens and a mirror. Where the sums would be too long (a near probe with a wide aperture) a
        bound, of waves from the aperture's edge.
    """
    g, k = geometry, 2 * math.pi / geometry.wavelength
    radius, lit, z = g.radius, min(g.radius, g.lit_radius), g.image_distance
    bent_in, bent_out = 1 / z - 1 / g.focal_length + g.curvature, 1 / z - 1 / g.focal_length
    ring = g.wavelength / (2 * radius)
    widest = g.exit_angle + _RINGS * ring
    meets = k * radius * probe_radius / distance
    # What meets the aperture's edge comes from as many rings of the spot as lie between it and the axis.
    rays = abs(bent_in) * z * lit
    spot = rays + _ON_SENSOR * (1 + meets / (2 * math.pi)) * g.wavelength * z / (2 * lit)
    # Phases as if they grew everywhere as fast as at the ends.
    into = _nodes(lit, k * lit * (abs(bent_in) * lit + spot / z))
    on = _nodes(spot, k * spot * (2 * spot + lit + radius) / z)
    out = _nodes(radius, k * radius * (abs(bent_out) * radius + radius / distance + spot / z + widest) + meets)
    beyond = _nodes(probe_radius, k * probe_radius * (probe_radius / distance + widest) + meets)
    q = np.linspace(0, widest, math.ceil(_FOR_A_RING * widest / ring) + 1)
    chain = [len(one[0]) for one in (into, on, out, beyond)]
    if max(a * b for a, b in zip(chain, [*chain[1:], len(q)], strict=True)) > _MOST:
        bend = g.exit_angle / radius
        return min(1.0, 4 * math.sqrt(2 / (math.pi * meets)) * (1 / meets + bend * distance * radius / probe_radius))
    x, v, y, place = (nodes for nodes, _ in (into, on, out, beyond))
    wave = np.exp(0.5j * k * bent_in * x**2) * x * into[1]
    wave = (j0(k / z * np.outer(v, x)) @ wave) * np.exp(1j * k * v**2 / z) * v * on[1]
    # The window on the sensor fades out, so that it has no edge of its own.
    wave = wave * np.cos(math.pi / 2 * np.clip(2 * (v - rays) / (spot - rays) - 1, 0, 1)) ** 2
    wave = (j0(k / z * np.outer(y, v)) @ wave) * np.exp(0.5j * k * bent_out * y**2) * y * out[1]
    whole = j0(k * np.outer(q, y)) @ wave
    met = j0(k / distance * np.outer(place, y)) @ (wave * np.exp(0.5j * k * y**2 / distance))
    met = k / distance * np.exp(0.5j * k * place**2 / distance) * met
    cut = j0(k * np.outer(q, place)) @ (met * place * beyond[1])
    seen, left = np.abs(whole) ** 2, np.abs(cut) ** 2
    return float(np.abs(seen - left).max() / max(seen.max(), left.max()))


def _nodes(end: float, phase: float) -> tuple[_Real, _Real]:
    """Gauss-Legendre places and weights from 0 to an end, for a phase in radians."""
    parts = math.ceil((_FOR_A_TURN * phase / (2 * math.pi) + _MORE) / _RULE)
    nodes, weights = np.polynomial.legendre.leggauss(_RULE)
    half = end / parts / 2
    middles = half * (2 * np.arange(parts) + 1)
    return (middles[:, None] + half * nodes).ravel(), np.tile(half * weights, parts)
