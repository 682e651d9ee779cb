"""Light that a target's sensor, or a layer before it, scatters back to the probe (paper, section 4.3).

A Lambertian plane at the image distance z turns the spot's irradiance S into the radiance L = albedo S/π. Written
around the chief ray, light from the sensor's point v that leaves the lens at x has the direction x(1/z - 1/f) - v/z,
whatever the gaze; it lands on the probe's sensor at q, f_p times that, and passes the probe's aperture R_p if |x + d
q/f_p| < R_p. Points of the plane scatter independently, so irradiances add:

    I(q) = 1/(λ z f_p)² ∫ L(v) |∫ P(x) exp(iφ_out(x)) w(x + d q/f_p) exp(-ik x·(v/z + q/f_p)) d²x|² d²v
    w(X) = 1/(iλd) ∫_{|X'| < R_p} exp(ik|X' - X|²/2d) d²X'

Without the probe's aperture, w = 1, this is a convolution whose transform is a product of two pupils' autocorrelations:
exact for scalar, paraxial light. The aperture's loss is a factor, by rays with |w|² in place of its edge. The factor
neglects that neighbouring points of the pupil are coherent: against the integral above it errs by 1 to 3 % of the peak
in `tests/simulate/test_diffuse.py`, by up to 6 % on other scenes. Light that fits the aperture by rays and to its first
dark ring is treated as unclipped, outer rings included. That errs by up to 4 % of the peak, and by 15 % in the very
middle of the image of a target focused on the probe and lit from there, where r² > λd.
"""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Unpack

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.radial import disc_transform
from tapetum.optics.sampling import DoublePassGeometry
from tapetum.simulate.reflections import Scatterer
from tapetum.simulate.round_picture import RoundPicture
from tapetum.simulate.scattering import (
    AT_ONCE,
    NOTHING,
    PlaneOptions,
    Real,
    ScatteringPlane,
    autocorrelation,
    legendre,
    scattering_plane,
    transformed,
)

__all__ = ["DiffuseProfile", "ScatteredLight", "corner", "diffuse_profile", "diffuse_return"]

# Samples along the radius of the target's pupil, and of the probe's, in the factor of the probe's aperture.
_FINEST, _STEPS = 48, 500
# Samples a side of a pixel larger than the image's detail.
_MOST_PARTS = 64
# Steps in which the reach of the tables of `ScatteredLight` grows.
_FARTHER = 1.2


def diffuse_return(
    geometry: DoublePassGeometry,
    distance: float,
    probe_radius: float,
    output: Grid,
    *,
    albedo: float,
    spread: float = 0.0,
    image_distance: float | None = None,
    lit_radius: float | None = None,
    centre: tuple[float, float] = (0.0, 0.0),
    accuracy: float = 1e-2,
) -> torch.Tensor:
    """Expected irradiance that a scattering plane of the target sends onto the probe's sensor.

    Parameters
    ----------
    geometry
        The scene's lengths. Tilt and window are not used: the image does not depend on the gaze.
    distance
        From the target's lens to the probe's, d, in metres.
    probe_radius
        Of the probe's aperture, R_p, in metres; `math.inf` where it stops nothing.
    output
        Pixels of the probe's sensor.
    albedo
        Power scattered over the half-space, in fractions of the power that arrives.
    spread
        Standard deviation, in metres, of the distance between where light enters and leaves the plane.
    image_distance
        z of the plane in metres, reduced by the index of what lies between; default: the sensor's own.
    lit_radius
        Of an illuminating beam narrower than the aperture, at the target, in metres.
    centre
        (x, y) of the image's middle on the probe's sensor, in metres.
    accuracy
        In fractions of the peak: sets how far out the light is followed, and the sampling of the aperture. The error is
        below it without a clipping aperture; with one see the module's head.

    Returns
    -------
    torch.Tensor
        [H, W] float64, W/m² for 1 W/m² at the target. Pixels larger than the image's detail hold their mean, others the
        value at their middle.

    Raises
    ------
    InputError
        For a number out of its range.

    Notes
    -----
    Small angles: at an F-number of 1.4 the lens collects sin² = 0.11 of the light, r²/z² = 0.13. The autocorrelation of
    a defocused pupil is that of H. H. Hopkins, Proc. R. Soc. Lond. A 231, 91 (1955).
    """
    if not all(map(math.isfinite, centre)):
        raise InputError(f"must be finite, is {centre}", where="centre", remedy="give two lengths in metres")
    options = PlaneOptions(albedo=albedo, spread=spread, image_distance=image_distance, lit_radius=lit_radius)
    reach = corner(output, centre)
    return diffuse_profile(geometry, distance, probe_radius, reach, accuracy=accuracy, **options).on(output, centre)


def corner(output: Grid, centre: tuple[float, float] = (0.0, 0.0)) -> float:
    """Distance of a picture's farthest corner from a place on it, in metres."""
    x, y = output.x() - centre[0], output.y() - centre[1]
    return math.hypot(float(x.abs().max()) + output.pitch / 2, float(y.abs().max()) + output.pitch / 2)


@dataclass(frozen=True, eq=False)
class DiffuseProfile:
    """Scattered light on the probe's sensor by the distance from its middle.

    Parameters
    ----------
    radii
        [N] distances in metres, evenly spaced from 0.
    irradiance
        [N] in W/m² for 1 W/m² at the target.
    """

    radii: Real
    irradiance: Real

    @cached_property
    def _picture(self) -> RoundPicture:
        return RoundPicture(self.radii, self.irradiance)

    @cached_property
    def _single(self) -> RoundPicture:
        return RoundPicture(self.radii, self.irradiance, torch.float32)

    @cached_property
    def _width(self) -> float:
        """Half-width at half maximum, by the first place below it."""
        below = np.nonzero(self.irradiance < self.irradiance.max() / 2)[0]
        return float(self.radii[max(below[0], 1)]) if len(below) else self._picture.end

    def on(
        self, output: Grid, centre: tuple[float, float] = (0.0, 0.0), dtype: torch.dtype = torch.float64
    ) -> torch.Tensor:
        """Return the picture [H, W] about a place (x, y) in metres, as `diffuse_return`; float32 is faster."""
        x, y, pitch = output.x() - centre[0], output.y() - centre[1], output.pitch
        if pitch < self._width:
            return (self._picture if dtype == torch.float64 else self._single).at(x, y)
        parts = min(_MOST_PARTS, math.ceil(3 * pitch / self._width))
        offsets = ((torch.arange(parts, dtype=torch.float64) + 0.5) / parts - 0.5) * pitch
        columns, rows = ((one.abs() <= self._picture.end + pitch).nonzero()[:, 0] for one in (x, y))
        fine = [(one[:, None] + offsets).flatten() for one in (x[columns], y[rows])]
        image = torch.zeros(len(y), len(x), dtype=torch.float64)
        means = self._picture.at(*fine).reshape(len(rows), parts, len(columns), parts).mean((1, 3))
        image[rows[:, None], columns] = means
        return image.to(dtype)


def diffuse_profile(
    geometry: DoublePassGeometry,
    distance: float,
    probe_radius: float,
    reach: float,
    *,
    accuracy: float = 1e-2,
    **options: Unpack[PlaneOptions],
) -> DiffuseProfile:
    """Scattered light by its distance from the middle: most of the work of `diffuse_return`, reused for many places.

    Parameters
    ----------
    reach
        Largest distance from the middle, in metres.
    geometry, distance, probe_radius, accuracy, **options
        As for `diffuse_return`.

    Raises
    ------
    InputError
        For a number out of its range.
    """
    plane = scattering_plane(geometry, distance, probe_radius, **options)
    if not 1e-4 <= accuracy < 1:
        raise InputError(f"must be from 1e-4 to below 1, is {accuracy}", where="accuracy", remedy="ask for 1e-2")
    f_p = geometry.probe_focal_length
    # A ring's irradiance falls as the cube of its number: here it is far below `accuracy` of the peak.
    rings = 30 * accuracy ** (-1 / 3)
    end = min(reach / f_p, plane.reach(rings))
    step = plane.wavelength / (6 * plane.limit)
    clipped = plane.footprint(distance) > probe_radius
    if clipped:
        end = min(end, _lit_at_probe(plane, distance, probe_radius, accuracy) / distance)
        step = min(step, end / (2 * _STEPS))
    angles = np.arange(math.ceil(end / step) + 5) * step
    profile = _unclipped(plane, angles)
    if clipped:
        profile = profile * _passing(plane, distance, probe_radius, angles, accuracy)
    return DiffuseProfile(angles * f_p, np.maximum(profile, 0.0) * plane.albedo / math.pi / (plane.z * f_p) ** 2)


def _unclipped(plane: ScatteringPlane, angles: Real) -> Real:
    """∫ S(v) |p̂(v/z + angle)|² d²v/λ², exact: the product of the autocorrelations, transformed. In m² W."""
    k = plane.wavenumber
    turns = k * plane.limit * (angles[-1] + plane.lit * abs(plane.inward) + plane.radius * abs(plane.outward))
    apart, weights = legendre(0.0, plane.limit, turns)
    product = plane.coherence(apart) * autocorrelation(apart, plane.radius, plane.outward * k)
    return transformed(product, apart, weights, angles, k) / plane.wavelength**2


def _passing(plane: ScatteringPlane, distance: float, probe_radius: float, angles: Real, accuracy: float) -> Real:
    """Share of the light of each angle that the probe's aperture lets through, by rays and |w|²."""
    r = plane.radius
    end = min(angles[-1] * distance, _lit_at_probe(plane, distance, probe_radius, accuracy))
    # The following is smooth on this scale, in metres at the probe: finer fringes average out.
    fine = max(r / _FINEST, end / _STEPS)
    places = np.arange(math.ceil(end / fine) + 3) * fine
    grid, power = _window(plane.wavelength, probe_radius, distance, fine, places[-1] + r + 4 * fine)
    pupil = disc_quadrature(r, 2 * _FINEST, _FINEST)
    # Rows are symmetric about the line through both middles: one half suffices.
    half = _FINEST // 2
    x, y, w = pupil.x.numpy(), pupil.y.numpy()[:half], 2 * pupil.weights.numpy()[:half]
    radiance = _smooth_radiance(plane, r / _FINEST, places[-1] / distance + 1.1 * r * abs(plane.outward))
    across, weights = (a.ravel() for a in np.broadcast_arrays(x[None, :], w))
    down = np.broadcast_to(y[:, None] ** 2, w.shape).ravel()
    used = weights != 0
    across, down, weights = across[used], down[used], weights[used]
    shares = np.empty_like(places)
    block = max(1, AT_ONCE // len(across))
    for i in range(0, len(places), block):
        at = places[i : i + block, None]
        light = radiance(np.sqrt((plane.outward * across - at / distance) ** 2 + plane.outward**2 * down)) * weights
        seen = np.interp(np.sqrt((across + at) ** 2 + down), grid, power)
        shares[i : i + block] = (light * seen).sum(1) / np.maximum(light.sum(1), 1e-300)
    shares = np.where(np.isfinite(shares), np.maximum(shares, 0.0), 0.0)
    inside = np.minimum(angles * distance, places[-1])
    return np.where(angles * distance <= places[-1], CubicSpline(places, shares)(inside), 0.0)


def _lit_at_probe(plane: ScatteringPlane, distance: float, probe_radius: float, accuracy: float) -> float:
    """Distance from the axis, in metres, beyond which light is neglected: edge waves fall as its inverse."""
    return probe_radius + plane.radius + math.sqrt(plane.wavelength * distance / accuracy)


def _window(wavelength: float, radius: float, distance: float, fine: float, reach: float) -> tuple[Real, Real]:
    """Distances from the axis up to X = reach, in metres, and |w|² of a round aperture there, as means over `fine`."""
    k = 2 * math.pi / wavelength
    values, step = disc_transform(radius, k / (2 * distance), k / distance, reach + 5 * fine)
    x = np.arange(len(values)) * step
    # Weighted by area: the middle's bright point is small.
    area = x + step / 4
    power = gaussian_filter1d(np.abs(values) ** 2 * area, fine / step, mode="mirror")
    return x, power / gaussian_filter1d(area, fine / step, mode="mirror") / (wavelength * distance) ** 2


def _smooth_radiance(plane: ScatteringPlane, fine: float, reach: float) -> CubicSpline:
    """The scattered light by slope, any unit, with the pupil's own diffraction and what samples `fine` apart need."""
    k, r = plane.wavenumber, plane.radius
    blur = plane.spread / plane.z
    wide = math.hypot(blur, abs(plane.outward) * fine)
    limit = min(2 * plane.lit, math.sqrt(2 * NOTHING) / (k * wide) if wide > 0 else math.inf)
    apart, weights = legendre(0.0, limit, k * limit * (reach + plane.lit * abs(plane.inward)))
    spot = autocorrelation(apart, plane.lit, plane.inward * k) * autocorrelation(apart, r, 0.0)
    spot = spot * np.exp(-((k * wide * apart) ** 2) / 2)
    step = plane.wavelength / (10 * limit)
    slopes = np.arange(math.ceil(reach / step) + 3) * step
    values = transformed(spot, apart, weights, slopes, k)
    return CubicSpline(slopes, np.maximum(values, values[0] * 1e-12 if values[0] > 0 else 0.0))


class ScatteredLight:
    """Light of a scene's scattering planes about any places, by profiles that are computed once.

    Parameters
    ----------
    output, pitch
        Samples of the probe's sensor, and the width of its pixels in metres.
    distance, probe_radius
        As for `diffuse_return`.
    beam_radius
        Of the light at the target, in metres.
    dtype
        Of the pictures.
    """

    def __init__(
        self, output: Grid, pitch: float, distance: float, probe_radius: float, beam_radius: float, dtype: torch.dtype
    ) -> None:
        self._output, self._near, self._dtype = output, corner(output) + pitch, dtype
        self._distance, self._probe_radius, self._beam_radius = distance, probe_radius, beam_radius
        self._profiles: dict[tuple[float, Scatterer, int], DiffuseProfile] = {}

    def __call__(self, geometry: DoublePassGeometry, scatterer: Scatterer, centres: torch.Tensor) -> torch.Tensor:
        """Expected irradiance [B or 1, H, W] of a plane about centres [B, 2], for 1 W/m² at the target at no tilt."""
        places = [(float(x), float(y)) for x, y in centres.detach().cpu()]
        if len(set(places)) == 1:
            places = places[:1]
        return torch.stack(
            [self._profile(geometry, scatterer, place).on(self._output, place, self._dtype) for place in places]
        )

    def _profile(
        self, geometry: DoublePassGeometry, scatterer: Scatterer, place: tuple[float, float]
    ) -> DiffuseProfile:
        """The profile about a place; those about as far from the picture's corners share it."""
        # Rounded up to a step, so that what is kept does not depend on which place came first.
        steps = max(0, math.ceil(math.log(corner(self._output, place) / self._near) / math.log(_FARTHER)))
        key = (geometry.wavelength, scatterer, steps)
        if key not in self._profiles:
            self._profiles[key] = diffuse_profile(
                geometry,
                self._distance,
                self._probe_radius,
                self._near * _FARTHER**steps,
                albedo=scatterer.diffuse.albedo * scatterer.transmittance,
                spread=scatterer.diffuse.spread,
                image_distance=scatterer.image_distance,
                lit_radius=min(geometry.radius, self._beam_radius),
            )
        return self._profiles[key]
