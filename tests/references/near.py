"""The judge's traced lens through the probe's aperture: Huygens' sums on rays' paths from every place to every place.

The field at a place v of the sensor is the sum over places e of the entrance pupil of exp(ikW(e, v)), W being the path
of the ray from the one to the other, times √|det ∂²W/∂e∂v|/iλ, by which power is kept; the way back is the same sum
(reciprocity). W is a polynomial in all four coordinates, fitted to the judge's own rays: nothing here knows of a model
of the lens, of mirrors' rays or of orders' rays. The lens's stop alone must limit its light, so that the pupil is an
ellipse in the plane in which its edge is sharp. W is fitted in the frame whose y lies along the tilt; a plane with
edges along rows and columns is summed in its own frame, which must lie along the tilt's.

But for a function of e, one of v and e·Mv, whose exponentials are products, W varies by a few turns. So its
exponential is interpolated in v between a few places, and each costs four products of matrices.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from .plane import Plane, TooLargeError, points
from .quadrature import Complex, Real, interpolation, legendre, phasor, region_weights
from .rays import Bundle, Traced
from .thin import Beam, Effort
from .way import Probe, along, through_aperture

__all__ = ["Flat", "Paths", "near_amplitudes"]

# Highest total degree of W, rays that are fitted, and rays by which the fit is checked.
_DEGREE, _RAYS, _CHECKED = 9, 12_000, 2_000
# Dark rings that the sum over the sensor holds beyond the rays; it fades out over the outer half.
_RINGS = 24.0
# RMS in radians by which paths may differ from their polynomials.
_MISFIT = 3e-3
# Points across the pupil, and places in a row of the spot.
_MOST, _MOST_PLACES = 700, 2500
# Complex multiplications of a field, some half a minute.
_MOST_PRODUCTS = 5e10
# Of the mixed derivative's differences, in half widths.
_STEP = 1e-2
# Places along an axis between which exponentials are interpolated, and by how much that may be off.
_KNOTS, _OFF = (3, 5, 7, 9, 12, 16, 21, 28), 1e-4
# Values along an axis that show a smooth function.
_FEW = 12
# How far the pupil may differ from a disc about the axis, and from an ellipse, as a share of its radius.
_ROUND, _ELLIPSE = 0.01, 1e-4
# By how much rays through one place of the edge turn, to see where they cross.
_BENT = 5e-3


@dataclass(frozen=True)
class Flat:
    """A plane before the lens: it lies this much behind the entrance pupil on the axis, and `slope`·y more at y."""

    axial: float
    slope: float

    def depth(self, e: Real) -> Real:
        """Of places [N, 2], [N, 1], in metres."""
        return self.axial + self.slope * e[:, 1:]

    def source(self, e: Real, sine: float, curvature: float) -> tuple[Real, Real, Real]:
        """Of light from 1/curvature under a tilt along y: directions [N, 3], paths, power through a unit of x and y."""
        towards, normal = np.array([0.0, sine, math.sqrt(1 - sine**2)]), np.array([0.0, -self.slope, 1.0])
        place = np.concatenate([e, self.depth(e)], 1)
        if curvature == 0:
            return np.tile(towards, (len(e), 1)), place @ towards, np.full(len(e), towards @ normal)
        away = 1 / curvature
        way = place + towards * away
        length, sign = np.linalg.norm(way, axis=1), math.copysign(1.0, away)
        path = sign * (2 * away * (place @ towards) + (place**2).sum(1)) / (length + abs(away))
        direction = sign * way / length[:, None]
        return direction, path, direction @ normal * (away / length) ** 2

    def through(self, lens: Traced, e: Real, sine: float, curvature: float) -> Bundle:
        """That light's rays through places of the plane."""
        return lens.trace(np.concatenate([e, lens.pupil + self.depth(e)], 1), self.source(e, sine, curvature)[0])


@dataclass(frozen=True)
class Paths:
    """W(e, v) in metres: e in a square of half width `reach` about the axis, v in one of `half` about `centre` [2].

    `factors` [K, K] go with products of two polynomials [K] of e/reach and of (v - centre)/half. `misfit` is the RMS of
    W over rays that were not fitted, `mean` that of all.
    """

    reach: float
    centre: Real
    half: float
    factors: Real
    mean: float
    misfit: float

    @staticmethod
    @functools.lru_cache(maxsize=16)
    def of(lens: Traced, sine: float, reach: float, half: float, place: float, flat: Flat) -> Paths:
        """By rays from all of the pupil's square to all of the square about where light of a tilt along y lands.

        `place` is the z of what it lands on.
        """

        def sent(e: Real, q: Real) -> tuple[Real, Real]:
            """Landings [N, 2] and paths of rays from e [N, 2] under the sines q [N, 2]."""
            start = np.concatenate([e, lens.pupil + flat.depth(e)], 1)
            rays = lens.trace(start, np.concatenate([q, np.sqrt(1 - (q**2).sum(1, keepdims=True))], 1))
            way = (place - rays.position[:, 2]) / rays.direction[:, 2]
            return rays.position[:, :2] + way[:, None] * rays.direction[:, :2], rays.path + way

        chief = np.array([[0.0, sine]])
        centre = sent(np.zeros((1, 2)), chief)[0][0]
        u = 2 * qmc.Halton(4, scramble=False).fast_forward(1).random(_RAYS + _CHECKED) - 1
        e, wanted = 1.01 * reach * u[:, :2], centre + 1.01 * half * u[:, 2:]
        q = np.tile(chief, (len(e), 1))
        for _ in range(5):
            v, _ = sent(e, q)
            q = q + (wanted - v) / lens.focal_length
        v, path = sent(e, q)
        if not np.isfinite(path).all() or float(np.abs(v - wanted).max()) > 0.02 * half:
            raise TooLargeError("some rays from the pupil do not get to the spot")
        one, other = _terms()
        matrix = _products(e / reach)[:, one] * _products((v - centre) / half)[:, other]
        fitted = np.arange(len(e)) < _RAYS
        mean = float(path.mean())
        some, wanted = matrix[fitted], path[fitted] - mean
        # Places are spread evenly, so that the polynomials are nearly orthogonal: least squares by their products.
        solved = np.linalg.solve(some.T @ some, some.T @ wanted)
        misfit = float((path - mean - matrix @ solved)[~fitted].std())
        factors = np.zeros((len(_planar()),) * 2)
        factors[one, other] = solved
        return Paths(reach, centre, half, factors, mean, misfit)

    def at(self, e: Real, v: Real) -> Real:
        """W [N, M] less `mean`, of places e [N, 2] and v [M, 2]."""
        return _products(e / self.reach) @ self.factors @ _products((v - self.centre) / self.half).T

    def strength(self, e: Real, v: Real) -> Real:
        """√|det ∂²W/∂e∂v| [N, M] in 1/m; one of e and v is a single place."""
        h, g = _STEP * self.reach, _STEP * self.half
        mixed = np.empty((2, 2, len(e), len(v)))
        for i, of_e in enumerate(np.eye(2)):
            for j, of_v in enumerate(np.eye(2)):
                four = [
                    sign * other * self.at(e + sign * h * of_e, v + other * g * of_v)
                    for sign in (1, -1)
                    for other in (1, -1)
                ]
                mixed[i, j] = sum(four) / (4 * h * g)
        return np.sqrt(np.abs(mixed[0, 0] * mixed[1, 1] - mixed[0, 1] * mixed[1, 0]))


def near_amplitudes(
    lens: Traced, beam: Beam, plane: Plane, probe: Probe, pixels: Real, effort: Effort, *, radius: float
) -> Complex:
    """As `thin.amplitudes` for a lens that was focused, through the probe's aperture.

    `radius` is that of the entrance pupil on the axis; rays tell its edge under the beam's tilt.
    """
    if probe.distance is None:
        raise TooLargeError("the far field is for the judge of plane waves")
    if any(plane.tilt):
        raise TooLargeError("a tilted plane takes paths of its own")
    k, sine, turn = 2 * math.pi / beam.wavelength, float(np.hypot(*beam.sines)), along(np.array(beam.sines))
    place = lens.image - plane.depth / plane.index
    disc = _Disc.of(lens, sine, beam.curvature, radius)
    edge, reach, flat = disc.edge(73), 1.01 * radius, disc.flat
    # Where light lands by rays, with what the rim diffracts.
    first = Paths.of(lens, sine, reach, 0.02 * lens.focal_length, place, flat)
    opening = float(np.abs(_slopes_by_v(first, edge)).max())
    ring = beam.wavelength / (2 * opening)
    rays = flat.through(lens, edge, sine, beam.curvature)
    landing = rays.position + ((place - rays.position[:, 2]) / rays.direction[:, 2])[:, None] * rays.direction
    half = float(np.hypot(*(landing[:, :2] - first.centre).T).max()) + effort.window * _RINGS * ring
    paths = Paths.of(lens, sine, reach, half, place, flat)
    if k * paths.misfit > _MISFIT:
        raise TooLargeError(f"paths {paths.misfit / beam.wavelength:.2g} waves from their polynomials")
    # By the steepest phases over the pupil and over the spot.
    corners = paths.centre + half * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    inwards = flat.source(edge, sine, beam.curvature)[1]
    outwards = paths.at(edge, corners).T + flat.source(edge, sine, 0.0)[1]
    steep = max(
        _steepest(paths.at(edge, corners).T + inwards, edge),
        _steepest(outwards, edge) + (probe.radius + radius) / probe.distance,
    )
    count = math.ceil(effort.points * 1.1 * k * steep * radius) + 24
    if count > _MOST:
        raise TooLargeError(f"{count}² points of the pupil")
    pixels = pixels @ turn.T
    # Before the long sums: whether the aperture's points are too many.
    rim = np.array([-radius, radius])
    through_aperture(np.zeros((2, 2), np.complex128), rim, sine, k, probe, pixels, effort.points)
    density = 2 * k * float(np.abs(_slopes_by_v(paths, edge, from_mean=False)).max())
    spot = _spot(plane, turn, paths.centre, half, effort.window * _RINGS * ring / 2, density, effort.points)
    if spot is None:
        return np.zeros(len(pixels), np.complex128)
    u, v, weights = spot
    nodes = legendre(count)[0]
    x, y = disc.half[0] * nodes, disc.centre + disc.half[1] * nodes
    between = _Between.of(paths, k, x, y, u, v)
    within = disc.half[0] * disc.half[1] * region_weights(count, 1.0)
    _, path, power = flat.source(_grid(x, y), sine, beam.curvature)
    middle, origin = paths.centre[None], np.zeros((1, 2))
    of_e = _smooth(lambda e: paths.strength(e, middle)[:, 0], x, y) * within
    of_v = _smooth(lambda v: paths.strength(origin, v)[0], u, v) / paths.strength(origin, middle)[0, 0]
    coming = (phasor(k * path) * np.sqrt(power)).reshape(count, count) * of_e
    leaving = between.back(between.there(coming) * weights * (of_v / beam.wavelength) ** 2) * of_e
    # The distance to a layer has 2kt/n of its path in it already.
    phase = k * (2 * paths.mean - plane.path + 2 * plane.depth / plane.index)
    field = leaving * np.exp(1j * math.remainder(phase, 2 * math.pi))
    rows = y, flat.depth(_grid(x[:1], y))[:, 0], flat.slope
    return through_aperture(field, x, sine, k, probe, pixels, effort.points, rows=rows)


def _spot(
    plane: Plane, turn: Real, centre: Real, half: float, fade: float, density: float, effort: float
) -> tuple[Real, Real, Complex] | None:
    """Places u and v of the spot in the tilt's frame, to which `turn` takes the plane's, and weights [v, u]."""
    if plane.pattern is None and not plane.cuts(turn.T @ centre, half * math.sqrt(2)):
        # Nothing has an edge along x or y: the tilt's frame does.
        plane, turn = plane.endless(), np.eye(2)
    elif float(np.abs(turn).max()) < 1 - 1e-9:
        raise TooLargeError("rows and columns that do not lie along the tilt")
    found = points(plane, turn.T @ centre, half, half - fade, density, effort)
    if found is None:
        return None
    if not found.product or max(found.u.shape) > _MOST_PLACES:
        raise TooLargeError(f"{found.u.shape} points of the spot")
    u, v = found.u[0], found.v
    if abs(turn[0, 0]) < 0.5:
        return turn[0, 1] * v, turn[1, 0] * u, found.weights.T
    return turn[0, 0] * u, turn[1, 1] * v, found.weights


@dataclass(frozen=True)
class _Disc:
    """The entrance pupil under a tilt along y: an ellipse of these half widths about (0, centre), in metres.

    It lies in the plane in which its edge is sharp: where rays cross that meet the edge in other directions. Elsewhere
    an edge's waves come from another depth than the plane's, which shows in the middle of a picture out of focus.
    """

    half: tuple[float, float]
    centre: float
    flat: Flat

    @staticmethod
    def of(lens: Traced, sine: float, curvature: float, radius: float) -> _Disc:
        """By where rays meet the edge of the stop."""
        turn = np.linspace(0, 2 * math.pi, 16, endpoint=False)
        spokes, level = np.stack([np.cos(turn), np.sin(turn)], 1), Flat(0.0, 0.0)

        def met(flat: Flat, curvature: float) -> Real:
            """Places [N, 2] of rays through the edge."""

            def beyond(share: Real) -> Real:
                """How far out the rays through shares of the radius come, less the edge."""
                return np.sqrt(flat.through(lens, radius * share[:, None] * spokes, sine, curvature).height) - 1

            share, step = np.ones(len(turn)), 1e-4
            for _ in range(6):
                share = share - beyond(share) * 2 * step / (beyond(share + step) - beyond(share - step))
            if not float(np.abs(beyond(share)).max()) < 1e-7 or float(np.abs(share - 1).max()) > _ROUND:
                raise TooLargeError("a pupil that is no disc about the axis")
            return radius * share[:, None] * spokes

        ends = [(one, met(level, one)) for one in (curvature, curvature + _BENT / radius)]
        ways = [level.source(e, sine, one)[0] for one, e in ends]
        slopes = [(way[:, :2] / way[:, 2:] * spokes).sum(1) for way in ways]
        crossed = ((ends[1][1] - ends[0][1]) * spokes).sum(1) / (slopes[0] - slopes[1])
        columns = np.stack([np.ones(len(turn)), ends[0][1][:, 1]], 1)
        flat = Flat(*np.linalg.lstsq(columns, crossed, rcond=None)[0].tolist())
        # (x/a)² + ((y - c)/b)² = 1, but for c².
        x, y = met(flat, curvature).T / radius
        columns = np.stack([x**2, y**2, y], 1)
        terms = np.linalg.lstsq(columns, np.ones(len(turn)), rcond=None)[0]
        if float(np.abs(columns @ terms - 1).max()) > 2 * _ELLIPSE:
            raise TooLargeError("a pupil that is no ellipse")
        half = radius / math.sqrt(terms[0]), radius / math.sqrt(terms[1])
        return _Disc(half, -radius * float(terms[2] / (2 * terms[1])), flat)

    def edge(self, count: int) -> Real:
        """Places [count, 2] along the edge, the last one the first."""
        turn = np.linspace(0, 2 * math.pi, count)
        return np.stack([self.half[0] * np.cos(turn), self.centre + self.half[1] * np.sin(turn)], 1)


@dataclass(frozen=True)
class _Between:
    """Sums over exp(ikW) between the pupil's places [y, x] and the spot's [v, u].

    `of_knots` [knots, y, x] are the exponentials for places of the spot between which they are interpolated, but for
    e·Mv, whose are `across` [x, u] and `down` [y, v]; `shares` what each place adds, along u and along v; `of_spot`
    [v, u] is what depends on the spot's place alone.
    """

    of_knots: Complex
    across: Complex
    down: Complex
    shares: list[tuple[Real, Real]]
    of_spot: Complex

    @staticmethod
    def of(paths: Paths, k: float, x: Real, y: Real, u: Real, v: Real) -> _Between:
        """Places of the pupil and of the spot."""
        at, centre = paths.at, paths.centre
        g, h = _STEP * paths.half, _STEP * paths.reach
        slopes = []
        for one in np.eye(2):
            e, places = np.stack([h * one, -h * one]), centre + np.stack([g * one, -g * one])
            four = at(e, places)
            slopes.append(float(four[0, 0] - four[0, 1] - four[1, 0] + four[1, 1]) / (4 * h * g))
        middle, origin = centre[None], np.zeros((1, 2))
        own = at(origin, _grid(u, v))[0] - at(origin, middle)[0, 0]

        def rest(e: Real, places: Real) -> Real:
            """What neither e nor v alone nor their product has, [N, M]; and all of e."""
            return at(e, places) - (at(origin, places) - at(origin, middle)) - (e * slopes) @ (places - centre).T

        # As many places as a few thousand pairs need.
        draw = 2 * qmc.Halton(4, scramble=False).fast_forward(1).random(4000) - 1
        e, places = paths.reach * draw[:, :2], centre + draw[:, 2:] * [np.ptp(u) / 2, np.ptp(v) / 2]
        places += np.array([(u.max() + u.min()) / 2 - centre[0], (v.max() + v.min()) / 2 - centre[1]])
        some = 40
        for count in _KNOTS:
            knots_u, shares_u = interpolation(float(u.min()), float(u.max()), count, places[:some, 0])
            knots_v, shares_v = interpolation(float(v.min()), float(v.max()), count, places[:some, 1])
            knots = _grid(knots_u, knots_v)
            shares = np.stack([one * other for other in shares_v for one in shares_u])
            want = np.exp(1j * k * rest(e, places[:some]))
            if float(np.abs(np.exp(1j * k * rest(e, knots)) @ shares - want).max()) < _OFF:
                break
        else:
            raise TooLargeError("paths vary too much over the spot")
        if 2 * count**2 * len(v) * len(y) * (len(x) + len(u)) > _MOST_PRODUCTS:
            raise TooLargeError(
                f"{count}² times {len(y)} x {len(x)} points of the pupil and {len(v)} x {len(u)} of the spot"
            )
        of_knots = phasor(k * rest(_grid(x, y), knots).T).reshape(-1, len(y), len(x))
        shares_u, shares_v = (interpolation(float(one.min()), float(one.max()), count, one)[1] for one in (u, v))
        across, down = (
            phasor(k * slope * np.outer(of_pupil, of_spot - mid))
            for slope, of_pupil, of_spot, mid in zip(slopes, (x, y), (u, v), centre, strict=True)
        )
        shares = [(one, other) for other in shares_v for one in shares_u]
        return _Between(of_knots, across, down, shares, phasor(k * own).reshape(len(v), len(u)))

    def there(self, field: Complex) -> Complex:
        """At the spot [v, u] of a field [y, x] over the pupil."""
        total = np.zeros(self.of_spot.shape, np.complex128)
        for knot, (of_u, of_v) in zip(self.of_knots, self.shares, strict=True):
            part = (self.down.T @ (knot * field)) @ self.across
            total += part * of_u * of_v[:, None]
        return total * self.of_spot

    def back(self, field: Complex) -> Complex:
        """At the pupil [y, x] of a field [v, u] over the spot."""
        field, total = field * self.of_spot, np.zeros(self.of_knots.shape[1:], np.complex128)
        for knot, (of_u, of_v) in zip(self.of_knots, self.shares, strict=True):
            total += knot * (self.down @ (field * of_u * of_v[:, None]) @ self.across.T)
        return total


def _grid(x: Real, y: Real) -> Real:
    """Places [N, 2] in rows."""
    return np.stack([one.ravel() for one in np.meshgrid(x, y)], 1)


def _smooth(value: Callable[[Real], Real], x: Real, y: Real) -> Real:
    """A function [N] of places [N, 2] on a grid, [y, x], where a few of its values show it all."""
    (at_x, by_x), (at_y, by_y) = (interpolation(float(one.min()), float(one.max()), _FEW, one) for one in (x, y))
    return np.stack(by_y, 1) @ value(_grid(at_x, at_y)).reshape(_FEW, _FEW) @ np.stack(by_x)


def _slopes_by_v(paths: Paths, e: Real, *, from_mean: bool = True) -> Real:
    """∂W/∂v at the middle of the spot, less their mean, [N, 2]."""
    g = _STEP * paths.half
    after, before = ([paths.at(e, paths.centre + sign * g * one[None])[:, 0] for one in np.eye(2)] for sign in (1, -1))
    slopes = (np.stack(after, 1) - np.stack(before, 1)) / (2 * g)
    return slopes - slopes.mean(0) if from_mean else slopes


def _steepest(path: Real, edge: Real) -> float:
    """Largest change of paths [..., N] along a pupil's edge and across it, roughly, less their mean slope."""
    wide = 2 * float(np.abs(edge).max())
    flat = path - path.mean(-1, keepdims=True)
    opposite = np.abs(flat - np.roll(flat[..., :-1], len(edge) // 2, -1).take(range(len(edge)), -1, mode="wrap"))
    along = np.abs(np.diff(path, axis=-1)).max() / float(np.hypot(*np.diff(edge, axis=0).T).max())
    return max(float(along), float(opposite.max()) / wide)


@functools.cache
def _planar() -> tuple[tuple[int, int], ...]:
    return tuple((i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i))


@functools.cache
def _terms() -> tuple[list[int], list[int]]:
    """Pairs of planar products, by number, up to the total degree and even across the tilt together."""
    pairs = [
        (m, n)
        for m, (i, j) in enumerate(_planar())
        for n, (p, q) in enumerate(_planar())
        if i + j + p + q <= _DEGREE and (i + p) % 2 == 0
    ]
    return [m for m, _ in pairs], [n for _, n in pairs]


def _products(u: Real) -> Real:
    """Products [N, K] of Chebyshev polynomials of u [N, 2]."""
    values = np.polynomial.chebyshev.chebvander(u, _DEGREE)
    return values[:, 0][:, [i for i, _ in _planar()]] * values[:, 1][:, [j for _, j in _planar()]]
