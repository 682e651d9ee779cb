"""Scattering planes of the target: how they are lit, and how coherent the light is that they return."""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Required, TypedDict

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.special import j0

from tapetum.errors import InputError
from tapetum.optics.sampling import DoublePassGeometry

__all__ = ["AT_ONCE", "NOTHING", "PlaneOptions", "Real", "ScatteringPlane", "autocorrelation", "legendre"]
__all__ += ["radiance", "scattering_plane", "transformed"]

Real = npt.NDArray[np.floating]

NOTHING = 14.0
"""Exponent beyond which a Gaussian is neglected: exp(-14) is 8e-7."""

AT_ONCE = 1 << 21
"""Numbers that are computed at once, to bound the memory."""

# Nodes of one panel of a Gauss-Legendre rule, and its largest phase in radians: the limit is π a sample.
_NODES, _RADIANS = 32, 36.0


@dataclass(frozen=True)
class ScatteringPlane:
    """A scattering plane behind the target's lens: its distance z, 1/z - 1/f + 1/R on the way in, 1/z - 1/f out."""

    wavelength: float
    radius: float
    lit: float
    z: float
    inward: float
    outward: float
    spread: float
    albedo: float

    @property
    def wavenumber(self) -> float:
        return 2 * math.pi / self.wavelength

    @property
    def limit(self) -> float:
        """Largest distance of two points of the pupil between which scattered light is coherent, in metres."""
        if self.spread == 0:
            return 2 * self.lit
        return min(2 * self.lit, math.sqrt(2 * NOTHING) * self.z / (self.wavenumber * self.spread))

    def reach(self, rings: float) -> float:
        """Half-angle of the light scattered back, by rays, with so many Airy rings, in radians."""
        rays = self.lit * abs(self.inward) + self.radius * abs(self.outward)
        return rays + math.sqrt(2 * NOTHING) * self.spread / self.z + rings * self.wavelength / (2 * self.lit)

    def footprint(self, distance: float) -> float:
        """Radius that the scattered light fills at the probe, by rays and its first dark ring, in metres."""
        angle = self.lit * abs(self.inward) + 3 * self.spread / self.z + 0.61 * self.wavelength / self.lit
        return self.radius * abs(1 + self.outward * distance) + distance * angle

    def coherence(self, apart: Real) -> Real:
        """Transform of the scattering irradiance at these distances, by the spot's pupil and the spread."""
        spot = autocorrelation(apart, self.lit, self.inward * self.wavenumber)
        return spot * np.exp(-((self.wavenumber * self.spread * apart / self.z) ** 2) / 2)


class PlaneOptions(TypedDict, total=False):
    """How a plane scatters: parameters of `diffuse_return`."""

    albedo: Required[float]
    spread: float
    image_distance: float | None
    lit_radius: float | None


def scattering_plane(
    geometry: DoublePassGeometry,
    distance: float,
    probe_radius: float,
    *,
    albedo: float,
    spread: float = 0.0,
    image_distance: float | None = None,
    lit_radius: float | None = None,
) -> ScatteringPlane:
    """Check the data of a plane: parameters and errors of `diffuse_return`."""
    z = geometry.image_distance if image_distance is None else image_distance
    for name, value in (("distance", distance), ("image_distance", z)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"must be positive and finite, is {value} m", where=name, remedy="give a length in metres")
    if not probe_radius > 0:
        what = f"must be positive, is {probe_radius} m"
        raise InputError(what, where="probe_radius", remedy="give a length in metres, or inf for no stop")
    if not 0 <= albedo <= 1:
        raise InputError(f"must be from 0 to 1, is {albedo}", where="albedo", remedy="give a share of the power")
    if not (math.isfinite(spread) and spread >= 0):
        raise InputError(f"must be 0 or more, is {spread} m", where="spread", remedy="give a length in metres, or 0")
    if lit_radius is not None and not lit_radius > 0:
        what = f"must be positive, is {lit_radius} m"
        raise InputError(what, where="lit_radius", remedy="give a length in metres, or None for the whole aperture")
    lit = geometry.radius if lit_radius is None else min(lit_radius, geometry.radius)
    outward = 1 / z - 1 / geometry.focal_length
    inward = outward + geometry.curvature
    return ScatteringPlane(geometry.wavelength, geometry.radius, lit, z, inward, outward, spread, albedo)


def autocorrelation(apart: Real, radius: float, bend: float) -> Real:
    """∫ P(x + Δ/2) P(x - Δ/2) exp(i bend x·Δ) d²x over a disc, for distances Δ in metres; bend in rad/m². In m²."""
    share = np.clip(apart / (2 * radius), 0.0, 1.0)
    turns = abs(bend) * radius**2
    nodes, weights = legendre(0.0, 1.0, turns)
    out = np.empty_like(share)
    block = max(1, AT_ONCE // len(nodes))
    for i in range(0, len(share), block):
        s = share[i : i + block, None]
        # a + Δ/2 = r cosθ removes the chord's root.
        angle = np.arccos(s) * nodes
        wave = np.cos(2 * bend * radius**2 * s * (np.cos(angle) - s))
        out[i : i + block] = 4 * radius**2 * ((np.sin(angle) ** 2 * wave) @ weights) * np.arccos(s[:, 0])
    return out


def legendre(low: float, high: float, turns: float) -> tuple[Real, Real]:
    """Composite Gauss-Legendre nodes and weights for an integrand whose phase covers so many radians."""
    panels = max(1, math.ceil(turns / _RADIANS))
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    width = (high - low) / panels
    starts = low + width * np.arange(panels)
    return (starts[:, None] + width * (nodes + 1) / 2).ravel(), np.tile(weights * width / 2, panels)


def transformed(values: Real, apart: Real, weights: Real, slopes: Real, wavenumber: float) -> Real:
    """∫ values(Δ) J0(kΔs) 2πΔ dΔ for the slopes s, by the rule given."""
    weighted = values * apart * weights * 2 * math.pi
    block = max(1, AT_ONCE // len(apart))
    parts = [j0(wavenumber * slopes[i : i + block, None] * apart) @ weighted for i in range(0, len(slopes), block)]
    return np.concatenate(parts)


def radiance(plane: ScatteringPlane, reach: float) -> CubicSpline:
    """L(v) up to v = reach, in W/m²."""
    k, z = plane.wavenumber, plane.z
    apart, weights = legendre(0.0, plane.limit, k * plane.limit * (reach / z + plane.lit * abs(plane.inward)))
    step = plane.wavelength * z / (12 * plane.limit)
    v = np.arange(math.ceil(reach / step) + 3) * step
    spot = transformed(plane.coherence(apart), apart, weights, v / z, k) / (plane.wavelength * z) ** 2
    return CubicSpline(v, spot * plane.albedo / math.pi)
