"""The judge's thin lens: sums over points of its aperture, of the plane behind it, and of the probe's aperture.

Definitions, from docs/conventions.md ("What a thin lens is"): object space is literal, with exact distances on planes
that are tilted; the lens is the phase -k ρ²/2f and the linear phase that makes it free of distortion; image space is
Fresnel's integral with the distance z + a·u of the plane's own point u. By reciprocity the amplitude at a pixel q is
∫ U_in Arr U_q d²u over the plane, U_q being what the pixel would put there; the sums run in the order
pupil → plane → pupil → pixels, which is the same sum for all pixels at once.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .plane import Plane, Points, TooLargeError, points
from .quadrature import (
    Complex,
    Real,
    cardinals,
    folded,
    halved,
    interpolation,
    legendre,
    phasor,
    region_weights,
    times,
    unfolded,
)
from .way import Probe, along, through_aperture

__all__ = ["Beam", "Effort", "ThinLens", "TooLargeError", "amplitudes"]

# Seconds that the sum over one plane may take, points across the pupil, and exponentials at a time.
MOST_SECONDS, MOST_PUPIL = 12.0, 1500
_AT_ONCE = 1 << 21
# What the sum over a plane holds beyond the light by rays, at a window of 1: dark rings λz/2r, and Fresnel zones √(λz),
# for waves from opposite edges of the aperture turn against each other like k v²/z. Over the outer half it fades out.
_RINGS, _ZONES, _FLAT = 30.0, 1.7, 0.5


@dataclass(frozen=True)
class Effort:
    """Times the points of every sum, and times what the windows hold beyond the light by rays."""

    points: float = 1.0
    window: float = 1.0

    @staticmethod
    def of(accuracy: float) -> Effort:
        """What an error of so much of the peak takes, as a rule; `more` checks it."""
        return Effort(1.0, (1e-2 / min(accuracy, 3e-2)) ** 0.28)

    def more(self) -> Effort:
        """Twice the points of every plane, in a wider window."""
        return Effort(1.15 * self.points, 1.25 * self.window)

    def farther(self) -> Effort:
        """As many points in a window three times as wide."""
        return Effort(self.points, 3 * self.window)


@dataclass(frozen=True)
class Beam:
    """Light that meets the target: wavelength, the sines of its direction, 1/R, and the radius of the lit disc.

    The disc is round across the beam; a wave from a source widens with the distance.
    """

    wavelength: float
    sines: tuple[float, float]
    curvature: float = 0.0
    radius: float = math.inf


@dataclass(frozen=True)
class ThinLens:
    """Focal length at the light's wavelength, and radius of the aperture."""

    focal_length: float
    radius: float


def amplitudes(
    lens: ThinLens, beam: Beam, plane: Plane, probe: Probe, pixels: Real, effort: Effort | None = None
) -> Complex:
    """Complex amplitudes at pixels [Q, 2], counted in metres from where light that returns along its way lands.

    Squared moduli are W/m² on the probe's sensor for 1 W/m² across the beam at the target.
    """
    effort = effort or Effort()
    k = 2 * math.pi / beam.wavelength
    s, a = np.array(beam.sines), np.array(plane.tilt)
    cosine = math.sqrt(1 - s @ s)
    t = s / cosine
    z, f, r = plane.distance, lens.focal_length, lens.radius
    lit = min(r, beam.radius)

    # The window on the plane: the narrower of what comes and what a pixel would send, and the rings about it.
    widest = float(np.abs(pixels).max()) / probe.focal_length if len(pixels) else 0.0
    if probe.distance is not None:
        widest = (probe.radius + r) / probe.distance
    coming = lit * abs(1 - z / f + z * beam.curvature)
    going = r * abs(1 - z / f)
    ring = beam.wavelength * z / (2 * lit)
    # The fainter the picture the more those waves count: in focus, hardly.
    zones = _ZONES * math.sqrt(min(coming, going) / ring / _RINGS)
    zone = math.sqrt(beam.wavelength * z)
    rings = min(_RINGS * ring, 2.5 * zone)
    margin = effort.window * max(rings, min(zones, _ZONES) * zone)
    centre = t * z / (1 - a @ t)
    narrow, wide_one = min(coming, going), max(coming, going)
    flat = narrow + min(z * widest, wide_one - narrow + min(20 * ring, 2.5 * zone))
    flat += float(np.hypot(*a)) * (flat + 2 * ring) * r / z + _FLAT * margin
    half = flat + (1 - _FLAT) * margin
    cut = plane.cuts(centre, half * math.sqrt(2))
    frame = np.eye(2)
    if probe.distance is not None and plane.pattern is None and not cut:
        # Nothing has an edge along x or y: in the tilt's own frame nothing has to be turned later.
        frame = along(s)
        s, t, a, centre = (frame @ one for one in (s, t, a, centre))
        plane = plane.endless()
    reach = np.abs(centre) + half
    density = k * (2 * float(reach.max()) + 2 * r) / z + 2 * k * float(np.hypot(*a))

    # Points of the pupil: the steepest phase, coming and going.
    inward = r * abs(1 / z - 1 / f + beam.curvature) + half / z
    outward = r * abs(1 / z - 1 / f) + half / z + widest
    bent = float(np.hypot(*a)) * (float(reach.max()) + r) ** 2 / z**2
    count = math.ceil(effort.points * (1.1 * k * (max(inward, outward) + bent) * r)) + 24
    if count > MOST_PUPIL:
        raise TooLargeError(f"{count}² points of the pupil")
    found = points(plane, centre, half, flat, density, effort.points)
    if found is None:
        return np.zeros(len(pixels), np.complex128)
    kernel = _Kernel.of(found, plane, a, k, r)
    if kernel.seconds(count) > MOST_SECONDS:
        raise TooLargeError(f"{count}² points of the pupil, {found.u.shape} of the plane, {len(kernel.knots)} times")
    nodes = legendre(count)[0] * r
    field = _arriving(nodes, lens, beam, s, t, k)

    wide = probe.distance is not None and abs(s[0]) > 1e-12
    # Of a square that is turned the corners must lie in what is known.
    out = legendre(math.ceil(1.6 * count))[0] * r * math.sqrt(2) if wide else nodes
    exit_field = kernel.back(kernel.there(field, nodes), out)
    screen = phasor(-k / (2 * f) * out**2)
    exit_field *= screen[None, :] * screen[:, None]
    # Its carrier exp(-ik s·x) is left out for now.
    exit_field *= phasor(k * t[0] * out)[None, :] * phasor(k * t[1] * out)[:, None]
    exit_field *= np.exp(-1j * k * plane.path)
    if probe.distance is None:
        exit_field *= region_weights(count, r)
        return math.sqrt(cosine) * _far(exit_field, out, s, cosine, k, probe, pixels)
    if wide:
        # Into the frame that the tilt lies along, by the polynomials that the sums are exact for.
        frame = along(s)
        exit_field, s = _turned(exit_field, math.sqrt(2) * r, nodes, frame), frame @ s
    exit_field *= region_weights(count, r)
    exit_field *= phasor(-k * s[1] * nodes)[:, None]
    return through_aperture(exit_field, nodes, float(s[1]), k, probe, pixels @ frame.T, effort.points)


def _arriving(nodes: Real, lens: ThinLens, beam: Beam, s: Real, t: Real, k: float) -> Complex:
    """Field [y, x] behind the lens, with the weights of a sum over what is lit of its aperture."""
    x, y = nodes[None, :], nodes[:, None]
    dot, rho = s[0] * x + s[1] * y, x**2 + y**2
    cosine = math.sqrt(1 - s @ s)
    if beam.curvature == 0:
        path, strength = dot, np.full(rho.shape, math.sqrt(cosine))
    else:
        # From a source at the distance R, or towards a point at it: sqrt(R² + 2R s·x + ρ²) - R without the difference.
        away = 1 / beam.curvature
        length = np.sqrt(away**2 + 2 * away * dot + rho)
        path = math.copysign(1.0, away) * (2 * away * dot + rho) / (length + abs(away))
        # Power through the tilted plane: (R/ρ)² times the cosine of the local direction, cosθ R/ρ.
        strength = np.sqrt(cosine * (abs(away) / length) ** 3)
    phase = k * (path - rho / (2 * lens.focal_length) + (t[0] - s[0]) * x + (t[1] - s[1]) * y)
    weights = region_weights(len(nodes), lens.radius)
    if beam.radius < lens.radius * (1 + 1e-12):
        weights = region_weights(len(nodes), lens.radius, lambda v: _lit(v, lens.radius, beam, s), 6 * len(nodes) + 200)
    return phasor(phase) * (weights * strength)


def _lit(v: Real, radius: float, beam: Beam, s: Real) -> tuple[Real, Real]:
    """Chords of what is lit of the aperture: distance from the beam's axis ρ² - (s·x)² within its growing radius."""
    high = np.sqrt(np.maximum(radius**2 - v**2, 0.0))
    low = -high
    b, g = beam.radius, beam.curvature
    # (1 - s_x²) u² - 2 s_x s_y v u + (1 - s_y²) v² = b² (1 + g (s_x u + s_y v))².
    w = b * b
    qa = 1 - s[0] ** 2 - w * g**2 * s[0] ** 2
    qb = -2 * s[0] * s[1] * v - 2 * w * g * s[0] * (1 + g * s[1] * v)
    qc = (1 - s[1] ** 2) * v**2 - w * (1 + g * s[1] * v) ** 2
    root = qb**2 - 4 * qa * qc
    inside = root > 0
    root = np.sqrt(np.maximum(root, 0.0))
    left, right = (-qb - root) / (2 * qa), (-qb + root) / (2 * qa)
    low, high = np.maximum(low, left), np.minimum(high, right)
    return np.where(inside, low, 0.0), np.where(inside, np.maximum(high, low), 0.0)


@dataclass(frozen=True)
class _Kernel:
    """Fresnel's integral between the pupil and points of a plane that lies z + a·u behind it.

    exp(ik|u - x|²/2ζ) depends on ζ through 1/ζ alone. Interpolated in it at so many Chebyshev points that the error is
    rounding, it is a short sum of products of a function of x and one of y. A plane without a tilt has one.
    """

    found: Points
    k: float
    knots: Real
    shares: list[Real]
    factor: Complex

    @staticmethod
    def of(found: Points, plane: Plane, a: Real, k: float, radius: float) -> _Kernel:
        """For the points of a plane with the tilt a."""
        z = plane.distance
        farther = a[0] * found.u + a[1] * found.v[:, None]
        # Twice the kernel's 1/(iλζ), and the way to a place that lies farther.
        factor = -((k / (2 * math.pi * (z + farther))) ** 2) * found.weights
        if not a.any():
            return _Kernel(found, k, np.array([1 / z]), [np.ones((1, 1))], factor)
        inverse = 1 / (z + farther)
        low, high = float(inverse.min()), float(inverse.max())
        most = (float(np.abs(found.u).max()) + radius) ** 2 + (float(np.abs(found.v).max()) + radius) ** 2
        turning = k * most / 4 * (high - low)
        knots, shares = interpolation(low, high, 10 + math.ceil(1.1 * turning), inverse)
        return _Kernel(found, k, knots, shares, factor * phasor(2 * k * farther))

    @functools.cached_property
    def alike(self) -> list[tuple[Real, npt.NDArray[np.intp]]]:
        """Places in a row, and the rows that have the same: all of a product, one of every period of an array."""
        u = self.found.u
        if self.found.product:
            return [(u[0], np.arange(len(u)))]
        # To 1e-14 m: what rounding makes of a period.
        _, first, which = np.unique(np.round(u * 1e14), axis=0, return_index=True, return_inverse=True)
        order = np.argsort(which.ravel(), kind="stable")
        ends = np.cumsum(np.bincount(which.ravel()))[:-1]
        return [(u[i], rows) for i, rows in zip(first, np.split(order, ends), strict=True)]

    def seconds(self, count: int) -> float:
        """Roughly, on one core: 5e-10 s a product of two complex numbers, 2e-8 s an exponential."""
        rows, places = self.found.u.shape
        one = rows * count * (count + places) * 5e-10 + len(self.alike) * places * count * 2.2e-8
        return 2 * len(self.knots) * one

    def there(self, field: Complex, x: Real) -> Complex:
        """At the plane's points, with weights and amplitudes in it, of a field [y, x] with weights in it.

        The places x stand in pairs about 0, here and on the way back.
        """
        total = np.zeros(self.found.u.shape, np.complex128)
        for knot, share in zip(self.knots, self.shares, strict=True):
            own, turns = self._own(x, knot), self.k * knot
            rows = times(halved(turns * self.found.v, x), folded(field * own * own[:, None]))
            columns = folded(rows.T)
            part = np.empty_like(total)
            for u, some in self.alike:
                part[some] = times(halved(turns * u, x), columns[:, some]).T * self._own(u, knot)
            total += part * (self._own(self.found.v, knot)[:, None] * share)
        return total * self.factor

    def back(self, reflected: Complex, x: Real) -> Complex:
        """At the pupil's points [y, x]."""
        total = np.zeros((len(x), len(x)), np.complex128)
        for knot, share in zip(self.knots, self.shares, strict=True):
            own, turns = self._own(x, knot), self.k * knot
            part = reflected * (self._own(self.found.v, knot)[:, None] * share)
            columns = np.empty((len(x), len(self.found.v)), np.complex128)
            for u, some in self.alike:
                columns[:, some] = times(halved(turns * u, x).T, (part[some] * self._own(u, knot)).T)
            rows = times(halved(turns * self.found.v, x).T, unfolded(columns).T)
            total += unfolded(rows) * own * own[:, None]
        return total

    def _own(self, u: Real, knot: float) -> Complex:
        """What exp(ik|u - x|²/2ζ) has of u alone; of both it has exp(-ik u·x/ζ)."""
        return phasor(self.k / 2 * knot * u**2)


def _far(exit_field: Complex, nodes: Real, s: Real, cosine: float, k: float, probe: Probe, pixels: Real) -> Complex:
    """To directions: waves of -s + Mq/f_p, M shortened by the cosine along the tilt."""
    directions = pixels / probe.focal_length
    square = float(s @ s)
    if square > 0:
        directions = directions - (1 - cosine) / square * np.outer(directions @ s, s)
    down = times(halved(k * directions[:, 1], nodes), folded(exit_field))
    return (down * phasor(-k * np.outer(directions[:, 0], nodes))).sum(1) * (k / (2 * math.pi * probe.focal_length))


def _turned(field: Complex, half: float, nodes: Real, turn: Real) -> Complex:
    """A field known at Gauss-Legendre points over [-half, half]² at the points of a frame turned against it."""
    x, y = np.meshgrid(nodes, nodes)
    places = np.stack([x.ravel(), y.ravel()], 1) @ turn
    count = len(field)
    found = np.empty(len(places), np.complex128)
    step = max(1, _AT_ONCE // count)
    for i in range(0, len(places), step):
        some = slice(i, i + step)
        down, across = cardinals(count, places[some, 1] / half), cardinals(count, places[some, 0] / half)
        found[some] = ((down @ field) * across).sum(1)
    return found.reshape(len(nodes), len(nodes))
