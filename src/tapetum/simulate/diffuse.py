"""Light that a target's sensor, or a layer before it, scatters back to the probe (paper, section 4.3).

A Lambertian plane at the image distance z turns the spot's irradiance S into the radiance L = albedo S/π. Written
around the chief ray, light from the sensor's point v that leaves the lens at x has the direction x(1/z - 1/f) - v/z,
whatever the gaze; it lands on the probe's sensor at q, f_p times that, and passes the probe's aperture R_p if
|x + d q/f_p| < R_p. Every point of the plane scatters for itself, so irradiances add:

    I(q) = 1/(λ z f_p)² ∫ L(v) |∫ P(x) exp(iφ_out(x)) w(x + d q/f_p) exp(-ik x·(v/z + q/f_p)) d²x|² d²v
    w(X) = 1/(iλd) ∫_{|X'| < R_p} exp(ik|X' - X|²/2d) d²X'

Without the probe's aperture, w = 1, this is a convolution, and its transform a product of two pupils' autocorrelations:
exact for scalar, paraxial light. What the aperture takes away is a factor, by the rays with |w|² in place of its edge.
The factor leaves out that neighbouring points of the pupil are coherent: in `tests/simulate/test_diffuse.py` it costs 1
to 3 % of the peak against the integral above, and cost up to 6 % on other scenes.
Light that fits the aperture by rays and to its first dark ring is taken as unclipped: its outer rings are then
not cut off. That cost up to 4 % of the peak, and 15 % in the very middle of the image for a target
focused on the probe and lit from there, where r² > λd.
"""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.special import j0

from tapetum.errors import InputError
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.radial import disc_transform
from tapetum.optics.sampling import DoublePassGeometry

__all__ = ["DiffuseProfile", "corner", "diffuse_profile", "diffuse_return", "speckle_return"]

Real = npt.NDArray[np.floating]

# Nodes of one panel of a Gauss-Legendre rule, and radians that its integrand may turn: π a sample is the limit.
_NODES, _RADIANS = 32, 36.0
# Exponent at which a Gaussian counts as nothing.
_NOTHING = 14.0
# Samples of the target's pupil along its radius, and of the probe's along its own, in the factor of the latter.
_FINEST, _STEPS = 48, 500
# Samples a side of a pixel larger than the image's detail.
_MOST_PARTS = 64
_MOST_BYTES = 3 << 29
_AT_ONCE = 1 << 21
# Radians between two samples of a pupil: π is the Nyquist limit.
_TURN = 1.5


@dataclass(frozen=True)
class _Plane:
    """A scattering plane behind the target's lens: its distance z, 1/z - 1/f + 1/R on the way in, 1/z - 1/f out."""

    wavelength: float
    radius: float
    lit: float
    z: float
    inward: float
    outward: float
    spread: float

    @property
    def wavenumber(self) -> float:
        return 2 * math.pi / self.wavelength

    @property
    def limit(self) -> float:
        """Largest distance of two points of the pupil between which scattered light is coherent, in metres."""
        if self.spread == 0:
            return 2 * self.lit
        return min(2 * self.lit, math.sqrt(2 * _NOTHING) * self.z / (self.wavenumber * self.spread))

    def reach(self, rings: float) -> float:
        """Half-angle of the light scattered back, by rays, with so many Airy rings, in radians."""
        rays = self.lit * abs(self.inward) + self.radius * abs(self.outward)
        return rays + math.sqrt(2 * _NOTHING) * self.spread / self.z + rings * self.wavelength / (2 * self.lit)

    def footprint(self, distance: float) -> float:
        """Radius that the scattered light fills at the probe, by rays and its first dark ring, in metres."""
        angle = self.lit * abs(self.inward) + 3 * self.spread / self.z + 0.61 * self.wavelength / self.lit
        return self.radius * abs(1 + self.outward * distance) + distance * angle

    def coherence(self, apart: Real) -> Real:
        """Transform of the scattering irradiance: what the spot's pupil and the spread leave at these distances."""
        spot = _autocorrelation(apart, self.lit, self.inward * self.wavenumber)
        return spot * np.exp(-((self.wavenumber * self.spread * apart / self.z) ** 2) / 2)


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
        The scene's lengths. The tilt and the window play no part: the image does not depend on the gaze.
    distance
        From the target's lens to the probe's, d, in metres.
    probe_radius
        Of the probe's aperture, R_p, in metres; `math.inf` where it stops nothing.
    output
        Pixels of the probe's sensor.
    albedo
        Power scattered over the half-space, in fractions of the power that arrives.
    spread
        Standard deviation of the place where light leaves the plane against where it arrived, in metres.
    image_distance
        z of the plane, reduced by the index of what lies between, in metres; the sensor's own for None.
    lit_radius
        Of the illuminating beam at the target, in metres, where it is narrower than the aperture.
    centre
        (x, y) of the image's middle on the probe's sensor, in metres.
    accuracy
        In fractions of the peak: decides how far out the light is followed, and how finely the aperture is sampled.

    Returns
    -------
    torch.Tensor
        [H, W] float64, W/m² for 1 W/m² at the target. Pixels larger than the image's detail hold their mean, others
        the value at their middle.

    Raises
    ------
    InputError
        For a number out of its range.

    Notes
    -----
    Without a clipping aperture the error is below `accuracy`; with one see the module's head.
    Small angles: at an F-number of 1.4 the lens collects sin² = 0.11 of the light, r²/z² = 0.13.
    The autocorrelation of a defocused pupil is that of H. H. Hopkins, Proc. R. Soc. Lond. A 231, 91 (1955).
    """
    if not all(map(math.isfinite, centre)):
        raise InputError(f"must be finite, is {centre}", where="centre", remedy="give two lengths in metres")
    profile = diffuse_profile(
        geometry,
        distance,
        probe_radius,
        corner(output, centre),
        albedo=albedo,
        spread=spread,
        image_distance=image_distance,
        lit_radius=lit_radius,
        accuracy=accuracy,
    )
    return profile.on(output, centre)


def corner(output: Grid, centre: tuple[float, float] = (0.0, 0.0)) -> float:
    """Distance of a picture's farthest corner from a place on it, in metres."""
    x, y = output.x() - centre[0], output.y() - centre[1]
    return math.hypot(float(x.abs().max()) + output.pitch / 2, float(y.abs().max()) + output.pitch / 2)


@dataclass(frozen=True, eq=False)
class DiffuseProfile:
    """Scattered light on the probe's sensor against the distance from its middle, wherever that lies.

    Parameters
    ----------
    radii
        [N] distances in metres, evenly spaced from 0.
    irradiance
        [N] in W/m² for 1 W/m² at the target.
    """

    radii: Real
    irradiance: Real

    def on(self, output: Grid, centre: tuple[float, float] = (0.0, 0.0)) -> torch.Tensor:
        """Return the picture [H, W] about a place (x, y) in metres, as `diffuse_return`."""
        x, y = output.x().numpy() - centre[0], output.y().numpy() - centre[1]
        return torch.from_numpy(_on_pixels(self.radii, self.irradiance, x, y, output.pitch))


def diffuse_profile(
    geometry: DoublePassGeometry,
    distance: float,
    probe_radius: float,
    reach: float,
    *,
    albedo: float,
    spread: float = 0.0,
    image_distance: float | None = None,
    lit_radius: float | None = None,
    accuracy: float = 1e-2,
) -> DiffuseProfile:
    """Scattered light by its distance from the middle: nearly all the work of `diffuse_return`, for many places.

    Parameters
    ----------
    reach
        How far from its middle the picture goes, in metres.
    geometry, distance, probe_radius, albedo, spread, image_distance, lit_radius, accuracy
        As for `diffuse_return`.

    Raises
    ------
    InputError
        For a number out of its range.
    """
    plane = _plane(geometry, distance, probe_radius, albedo, spread, image_distance, lit_radius)
    if not 1e-4 <= accuracy < 1:
        raise InputError(f"must be from 1e-4 to below 1, is {accuracy}", where="accuracy", remedy="ask for 1e-2")
    f_p = geometry.probe_focal_length
    # A ring's irradiance falls as the cube of its number: at this one the peak's `accuracy` is long past.
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
    return DiffuseProfile(angles * f_p, np.maximum(profile, 0.0) * albedo / math.pi / (plane.z * f_p) ** 2)


def speckle_return(
    geometry: DoublePassGeometry,
    distance: float,
    probe_radius: float,
    output: Grid,
    *,
    albedo: float,
    seed: int,
    spread: float = 0.0,
    image_distance: float | None = None,
    lit_radius: float | None = None,
    centre: tuple[float, float] = (0.0, 0.0),
    count: int = 1,
    rings: float = 12.0,
) -> torch.Tensor:
    """Speckle patterns of a scattering plane of the target: coherent light off a rough plane, one at a time.

    Parameters
    ----------
    geometry, distance, probe_radius, output, albedo, spread, image_distance, lit_radius, centre
        As for `diffuse_return`, which is the mean of many.
    seed
        Of the plane's roughness; the same seed gives the same patterns.
    count
        Number of patterns.
    rings
        Airy rings of the spot that scatter, beyond its geometric radius. What lies outside is left out: about
        0.2/rings of the light.

    Returns
    -------
    torch.Tensor
        [count, H, W] float64, W/m² for 1 W/m² at the target, at the middle of each pixel.

    Raises
    ------
    InputError
        For a number out of its range, or where the grids exceed the memory allowed.

    Notes
    -----
    The plane's field is circular Gaussian white noise of the variance λ² L(v)/dv² (J. W. Goodman, Speckle Phenomena in
    Optics, 2007, sections 2.2 and 4.5); samples at half the Airy ring's width make its coherence on the pupil exact.
    A clipped pattern goes over the probe's aperture in two matrix Fourier transforms. Polarisation is left out: where
    scattering mixes it, half as many patterns again are seen, and the contrast is 1/√2.
    """
    plane = _plane(geometry, distance, probe_radius, albedo, spread, image_distance, lit_radius)
    if count < 1:
        raise InputError(f"must be at least 1, is {count}", where="count", remedy="ask for one pattern or more")
    if not rings > 0:
        raise InputError(f"must be positive, is {rings}", where="rings", remedy="leave it out")
    k, r, z, f_p = plane.wavenumber, plane.radius, plane.z, geometry.probe_focal_length
    q_x, q_y = output.x() - centre[0], output.y() - centre[1]
    image = max(float(q_x.abs().max()), float(q_y.abs().max())) / f_p
    airy = plane.wavelength * z / (2 * r)
    half = z * plane.lit * abs(plane.inward) + rings * airy * r / plane.lit + 4 * spread
    side = 2 * math.ceil(2 * half / airy)
    sensor = Grid(side, side, 2 * half / side)
    bend = r * abs(plane.outward)
    clipped = math.isfinite(probe_radius)
    # The steepest slope of the field on the target's pupil against what it goes to, and on the probe's.
    onward = r / distance + probe_radius / distance if clipped else image
    columns = max(48, math.ceil(2 * r * k * (half / z + bend + onward) / _TURN))
    stop = math.ceil(2 * probe_radius * k * ((r + probe_radius) / distance + image) / _TURN) if clipped else 0
    stop = max(48, stop) if clipped else 0
    grids = side**2 + 1.2 * (columns**2 + stop**2) + side * columns + columns * stop + 2 * output.rows * output.columns
    if 16 * 3 * grids > _MOST_BYTES:
        what = f"speckle needs {side}² samples of the sensor, {columns}² of its pupil and {stop}² of the probe's"
        remedy = "take a smaller aperture or spread, or the expected image of `diffuse_return`"
        raise InputError(what, where="speckle", remedy=remedy)

    v = sensor.x()
    distances = torch.hypot(v[None, :], v[:, None]).numpy()
    radiance = torch.from_numpy(_radiance(plane, albedo, half * math.sqrt(2))(distances)).clamp_min(0)
    amplitude = (radiance / 2).sqrt() * plane.wavelength * sensor.pitch
    pupil = disc_quadrature(r, columns, math.ceil(1.2 * columns))
    phase = k / 2 * plane.outward * pupil.rho_squared()
    onto_pupil = MatrixFourier(v, v, pupil.x, pupil.y, k / z)
    scale = 1 / (plane.wavelength * z) / (plane.wavelength * f_p)
    if clipped:
        aperture = disc_quadrature(probe_radius, stop, math.ceil(1.2 * stop))
        exit_pupil = pupil.weights * phasor(phase + k / (2 * distance) * pupil.rho_squared())
        onto_stop = MatrixFourier(pupil.x, pupil.y, aperture.x, aperture.y, k / distance)
        chirp = aperture.weights * phasor(k / (2 * distance) * aperture.rho_squared())
        chirp = chirp / (plane.wavelength * distance)
        onto_image = MatrixFourier(aperture.x, aperture.y, q_x, q_y, k / f_p)
    else:
        exit_pupil = pupil.weights * phasor(phase)
        onto_stop, chirp = None, None
        onto_image = MatrixFourier(pupil.x, pupil.y, q_x, q_y, k / f_p)
    random = torch.Generator().manual_seed(seed)
    patterns: list[torch.Tensor] = []
    for _ in range(count):
        noise = torch.randn(2, side, side, generator=random, dtype=torch.float64)
        field = onto_pupil(torch.complex(noise[0], noise[1]) * amplitude) * exit_pupil * scale
        if onto_stop is not None and chirp is not None:
            field = onto_stop(field) * chirp
        u = onto_image(field)
        patterns.append(u.real**2 + u.imag**2)
    return torch.stack(patterns)


def _plane(
    geometry: DoublePassGeometry,
    distance: float,
    probe_radius: float,
    albedo: float,
    spread: float,
    image_distance: float | None,
    lit_radius: float | None,
) -> _Plane:
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
    return _Plane(geometry.wavelength, geometry.radius, lit, z, outward + geometry.curvature, outward, spread)


def _autocorrelation(apart: Real, radius: float, bend: float) -> Real:
    """∫ P(x + Δ/2) P(x - Δ/2) exp(i bend x·Δ) d²x over a disc, for distances Δ in metres; bend in rad/m². In m²."""
    share = np.clip(apart / (2 * radius), 0.0, 1.0)
    turns = abs(bend) * radius**2
    nodes, weights = _legendre(0.0, 1.0, turns)
    out = np.empty_like(share)
    block = max(1, _AT_ONCE // len(nodes))
    for i in range(0, len(share), block):
        s = share[i : i + block, None]
        # a + Δ/2 = r cosθ: the chord's root is gone.
        angle = np.arccos(s) * nodes
        wave = np.cos(2 * bend * radius**2 * s * (np.cos(angle) - s))
        out[i : i + block] = 4 * radius**2 * ((np.sin(angle) ** 2 * wave) @ weights) * np.arccos(s[:, 0])
    return out


def _legendre(low: float, high: float, turns: float) -> tuple[Real, Real]:
    """Composite Gauss-Legendre nodes and weights for an integrand that turns by so many radians."""
    panels = max(1, math.ceil(turns / _RADIANS))
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    width = (high - low) / panels
    starts = low + width * np.arange(panels)
    return (starts[:, None] + width * (nodes + 1) / 2).ravel(), np.tile(weights * width / 2, panels)


def _transformed(values: Real, apart: Real, weights: Real, slopes: Real, wavenumber: float) -> Real:
    """∫ values(Δ) J0(kΔs) 2πΔ dΔ for the slopes s, by the rule given."""
    weighted = values * apart * weights * 2 * math.pi
    block = max(1, _AT_ONCE // len(apart))
    parts = [j0(wavenumber * slopes[i : i + block, None] * apart) @ weighted for i in range(0, len(slopes), block)]
    return np.concatenate(parts)


def _unclipped(plane: _Plane, angles: Real) -> Real:
    """∫ S(v) |p̂(v/z + angle)|² d²v/λ², exact: the product of the autocorrelations, transformed. In m² W."""
    k = plane.wavenumber
    turns = k * plane.limit * (angles[-1] + plane.lit * abs(plane.inward) + plane.radius * abs(plane.outward))
    apart, weights = _legendre(0.0, plane.limit, turns)
    product = plane.coherence(apart) * _autocorrelation(apart, plane.radius, plane.outward * k)
    return _transformed(product, apart, weights, angles, k) / plane.wavelength**2


def _radiance(plane: _Plane, albedo: float, reach: float) -> CubicSpline:
    """L(v) up to v = reach, in W/m²."""
    k, z = plane.wavenumber, plane.z
    apart, weights = _legendre(0.0, plane.limit, k * plane.limit * (reach / z + plane.lit * abs(plane.inward)))
    step = plane.wavelength * z / (12 * plane.limit)
    v = np.arange(math.ceil(reach / step) + 3) * step
    spot = _transformed(plane.coherence(apart), apart, weights, v / z, k) / (plane.wavelength * z) ** 2
    return CubicSpline(v, spot * albedo / math.pi)


def _passing(plane: _Plane, distance: float, probe_radius: float, angles: Real, accuracy: float) -> Real:
    """Share of the light of each angle that the probe's aperture lets through, by rays and |w|²."""
    r = plane.radius
    end = min(angles[-1] * distance, _lit_at_probe(plane, distance, probe_radius, accuracy))
    # What follows is smooth on this scale, in metres at the probe: finer fringes than these average out.
    fine = max(r / _FINEST, end / _STEPS)
    places = np.arange(math.ceil(end / fine) + 3) * fine
    grid, power = _window(plane.wavelength, probe_radius, distance, fine, places[-1] + r + 4 * fine)
    pupil = disc_quadrature(r, 2 * _FINEST, _FINEST)
    # Rows lie symmetric about the line through both middles: one half does.
    half = _FINEST // 2
    x, y, w = pupil.x.numpy(), pupil.y.numpy()[:half], 2 * pupil.weights.numpy()[:half]
    radiance = _smooth_radiance(plane, r / _FINEST, places[-1] / distance + 1.1 * r * abs(plane.outward))
    across, weights = (a.ravel() for a in np.broadcast_arrays(x[None, :], w))
    down = np.broadcast_to(y[:, None] ** 2, w.shape).ravel()
    used = weights != 0
    across, down, weights = across[used], down[used], weights[used]
    shares = np.empty_like(places)
    block = max(1, _AT_ONCE // len(across))
    for i in range(0, len(places), block):
        at = places[i : i + block, None]
        light = radiance(np.sqrt((plane.outward * across - at / distance) ** 2 + plane.outward**2 * down)) * weights
        seen = np.interp(np.sqrt((across + at) ** 2 + down), grid, power)
        shares[i : i + block] = (light * seen).sum(1) / np.maximum(light.sum(1), 1e-300)
    shares = np.where(np.isfinite(shares), np.maximum(shares, 0.0), 0.0)
    inside = np.minimum(angles * distance, places[-1])
    # Beyond the last place nothing is left.
    return np.where(angles * distance <= places[-1], CubicSpline(places, shares)(inside), 0.0)


def _lit_at_probe(plane: _Plane, distance: float, probe_radius: float, accuracy: float) -> float:
    """Distance from the axis, in metres, beyond which no light counts: edge waves die away as its inverse."""
    return probe_radius + plane.radius + math.sqrt(plane.wavelength * distance / accuracy)


def _window(wavelength: float, radius: float, distance: float, fine: float, reach: float) -> tuple[Real, Real]:
    """Distances from the axis up to X = reach, in metres, and |w|² of a round aperture there, as means over `fine`."""
    k = 2 * math.pi / wavelength
    values, step = disc_transform(radius, k / (2 * distance), k / distance, reach + 5 * fine)
    x = np.arange(len(values)) * step
    # By area: the middle's bright point is small.
    area = x + step / 4
    power = gaussian_filter1d(np.abs(values) ** 2 * area, fine / step, mode="mirror")
    return x, power / gaussian_filter1d(area, fine / step, mode="mirror") / (wavelength * distance) ** 2


def _smooth_radiance(plane: _Plane, fine: float, reach: float) -> CubicSpline:
    """The scattered light by slope, any unit, with the pupil's own diffraction and what samples `fine` apart need."""
    k, r = plane.wavenumber, plane.radius
    blur = plane.spread / plane.z
    wide = math.hypot(blur, abs(plane.outward) * fine)
    limit = min(2 * plane.lit, math.sqrt(2 * _NOTHING) / (k * wide) if wide > 0 else math.inf)
    apart, weights = _legendre(0.0, limit, k * limit * (reach + plane.lit * abs(plane.inward)))
    spot = _autocorrelation(apart, plane.lit, plane.inward * k) * _autocorrelation(apart, r, 0.0)
    spot = spot * np.exp(-((k * wide * apart) ** 2) / 2)
    step = plane.wavelength / (10 * limit)
    slopes = np.arange(math.ceil(reach / step) + 3) * step
    values = _transformed(spot, apart, weights, slopes, k)
    return CubicSpline(slopes, np.maximum(values, values[0] * 1e-12 if values[0] > 0 else 0.0))


def _on_pixels(radii: Real, profile: Real, x: Real, y: Real, pitch: float) -> Real:
    """The profile at the pixels' middles, or its mean over pixels larger than its detail: [len(y), len(x)]."""
    spline, end = CubicSpline(radii, profile), radii[-1]
    # Half-width at half maximum, by the first place below it.
    below = np.nonzero(profile < profile.max() / 2)[0]
    width = radii[max(below[0], 1)] if len(below) else end
    parts = 1 if pitch < width else min(_MOST_PARTS, math.ceil(3 * pitch / width))
    offsets = ((np.arange(parts) + 0.5) / parts - 0.5) * pitch
    image = np.zeros((len(y), len(x)))
    distance = np.hypot(y[:, None], x[None, :])
    lit = np.argwhere(distance <= end + pitch)
    block = max(1, _AT_ONCE // parts**2)
    for i in range(0, len(lit), block):
        rows, columns = lit[i : i + block].T
        at = np.sqrt((y[rows, None, None] + offsets[:, None]) ** 2 + (x[columns, None, None] + offsets[None, :]) ** 2)
        values = np.where(at <= end, np.maximum(spline(np.minimum(at, end)), 0.0), 0.0)
        image[rows, columns] = values.mean((1, 2))
    return image
