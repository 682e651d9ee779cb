"""The judge's traced lens through the probe's aperture: Huygens' sums on rays' paths from every place to every place.

The light is cut where it is cut: at the stop itself. The field at a place v of the sensor is the sum over places s of
the stop of exp(ikW(s, v)), W being the path of the ray from the one to the other, times √|det ∂²W/∂s∂v|/iλ, by which
power is kept; the way back is the same sum (reciprocity), and so is the way from the stop through the surfaces before
it to a place of the probe's aperture. W is a polynomial in all four coordinates, fitted to the judge's own rays:
nothing here knows of a model of the lens, of its pupils, of mirrors' rays or of orders' rays. The stop alone must limit
the light. W is fitted in the frame whose y lies along the tilt; a plane with edges along rows and columns is summed in
its own frame, which must lie along the tilt's.

But for a function of s, one of v and s·Mv, whose exponentials are products, W varies by a few turns. So its
exponential is interpolated in v between a few places, and each costs four products of matrices.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import qmc

from .plane import Plane, TooLargeError, points
from .quadrature import Complex, Real, interpolation, legendre, phasor, region_weights
from .rays import Bundle, Traced
from .thin import Beam, Effort
from .way import Probe, along, points_of_aperture, seen

__all__ = ["Paths", "near_amplitudes"]

# Total degrees of W: that which most lenses need, and the highest. Rays that are fitted, and by which that is checked.
_USUAL_DEGREE, _DEGREE, _RAYS, _CHECKED = 9, 11, 16_000, 2_000
# What the sum over the sensor holds beyond the rays, fading out over the outer half: dark rings, or Fresnel zones of
# the way from the exit pupil, within which light that one side of the rim sends returns to the other in step.
_RINGS, _ZONES = 24.0, 1.6
# RMS in radians by which paths may differ from their polynomials: ripples of a thousandth change light far out of focus
# by half a percent.
_MISFIT = 3e-4
# Wavelength at which a lower degree has to keep to that.
_SHORTEST = 4e-7
# Points across the stop, and places in a row of the spot.
_MOST, _MOST_PLACES = 800, 2500
# Complex multiplications of a field, some two minutes.
_MOST_PRODUCTS = 1.5e11
# Of the mixed derivative's differences, in half widths.
_STEP = 1e-2
# Places along an axis between which exponentials are interpolated, and by how much that may be off.
_KNOTS, _OFF = (3, 5, 7, 9, 12, 16, 21, 28), 1e-4
# RMS of what is left out of exponentials as a short sum of products.
_FAINT = 3e-4
# Values along an axis that show a smooth function, and that show the path of the light that enters.
_FEW, _MORE = 12, 24
# Steps of the search for a ray through two places, and by how much of the second's width it may miss.
_STEPS, _MISSED = 8, 0.02


@dataclass(frozen=True)
class Paths:
    """W(s, v) in metres: s in a square of half width `reach` about the axis, v in one of `half` about `centre` [2].

    `factors` [K, K] go with products of two polynomials [K] of s/reach and of (v - centre)/half, up to a total
    `degree`. `misfit` is the RMS of W over rays that were not fitted, `mean` that of all.
    """

    reach: float
    centre: Real
    half: float
    degree: int
    factors: Real
    mean: float
    misfit: float

    @staticmethod
    def of(rays: Callable[[Real, Real], tuple[Real, Real, Real]], reach: float, centre: Real, half: float) -> Paths:
        """By rays from all of the one square to all of the other: `rays` has places s [N, 2] and v [N, 2] of those that
        it finds between about such places, and their paths [N]."""
        u = 2 * qmc.Halton(4, scramble=False).fast_forward(1).random(_RAYS + _CHECKED) - 1
        wanted_s, wanted_v = 1.01 * reach * u[:, :2], centre + 1.01 * half * u[:, 2:]
        s, v, path = rays(wanted_s, wanted_v)
        missed = max(float(np.abs(s - wanted_s).max()) / reach, float(np.abs(v - wanted_v).max()) / half)
        if not (np.isfinite(path).all() and missed <= _MISSED):
            raise TooLargeError("some rays from the stop do not get to all places")
        fitted, mean = np.arange(len(s)) < _RAYS, float(path.mean())

        def of_degree(degree: int) -> Paths:
            one, other = _terms(degree)
            matrix = _products(s / reach, degree)[:, one] * _products((v - centre) / half, degree)[:, other]
            some, wanted = matrix[fitted], path[fitted] - mean
            # Places are spread evenly, so that the polynomials are nearly orthogonal: least squares by their products.
            solved = np.linalg.solve(some.T @ some, some.T @ wanted)
            misfit = float((path - mean - matrix @ solved)[~fitted].std())
            factors = np.zeros((len(_planar(degree)),) * 2)
            factors[one, other] = solved
            return Paths(reach, centre, half, degree, factors, mean, misfit)

        found = of_degree(_USUAL_DEGREE)
        return found if found.misfit <= _MISFIT * _SHORTEST / (2 * math.pi) else of_degree(_DEGREE)

    def at(self, s: Real, v: Real) -> Real:
        """W [N, M] less `mean`, of places s [N, 2] and v [M, 2]."""
        of_s, of_v = _products(s / self.reach, self.degree), _products((v - self.centre) / self.half, self.degree)
        return of_s @ self.factors @ of_v.T

    def strength(self, s: Real, v: Real) -> Real:
        """√|det ∂²W/∂s∂v| [N, M] in 1/m; one of s and v is a single place."""
        h, g = _STEP * self.reach, _STEP * self.half
        mixed = np.empty((2, 2, len(s), len(v)))
        for i, of_s in enumerate(np.eye(2)):
            for j, of_v in enumerate(np.eye(2)):
                four = [
                    sign * other * self.at(s + sign * h * of_s, v + other * g * of_v)
                    for sign in (1, -1)
                    for other in (1, -1)
                ]
                mixed[i, j] = sum(four) / (4 * h * g)
        return np.sqrt(np.abs(mixed[0, 0] * mixed[1, 1] - mixed[0, 1] * mixed[1, 0]))


def near_amplitudes(lens: Traced, beam: Beam, plane: Plane, probe: Probe, pixels: Real, effort: Effort) -> Complex:
    """As `thin.amplitudes` for a lens that was focused, through the probe's aperture."""
    if probe.distance is None:
        raise TooLargeError("the far field is for the judge of plane waves")
    if any(plane.tilt):
        raise TooLargeError("a tilted plane takes paths of its own")
    k, sine, turn = 2 * math.pi / beam.wavelength, float(np.hypot(*beam.sines)), along(np.array(beam.sines))
    place, radius = lens.image - plane.depth / plane.index, lens.opening[lens.stop]
    edge, reach = _circle(radius, 73), 1.01 * radius
    light = _Light.of(lens, sine, beam.curvature)
    before = _before(lens, sine, probe.distance, probe.radius, reach)
    _check_rims(lens, light, probe, edge)
    # Where light lands by rays, with what the stop diffracts.
    first = _behind(lens, sine, reach, 0.02 * lens.focal_length, place)
    opening = float(np.abs(_slopes_by_v(first, edge)).max())
    ring = beam.wavelength / (2 * opening)
    e = light.through(edge)
    landing = _landing(lens.trace(*light.rays(e)[:2]), place)[0]
    zone = math.sqrt(beam.wavelength * min(abs(lens.image - lens.exit_pupil()), 3 * lens.focal_length))
    beside = effort.window * max(_RINGS * ring, _ZONES * zone)
    half = float(np.hypot(*(landing - first.centre).T).max()) + beside
    paths = _behind(lens, sine, reach, half, place)
    for one in (paths, before):
        if k * one.misfit > _MISFIT:
            raise TooLargeError(f"paths {one.misfit / beam.wavelength:.2g} waves from their polynomials")
    # By the steepest phases over the stop and over the spot.
    corners = half * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    behind = paths.at(edge, paths.centre + corners).T
    steep = max(
        _steepest(behind + light.path(edge)[0], edge),
        _steepest((behind[:, None] + before.at(edge, _circle(probe.radius, 9)).T).reshape(-1, len(edge)), edge),
    )
    count = math.ceil(effort.points * 1.1 * k * steep * radius) + 24
    if count > _MOST:
        raise TooLargeError(f"{count}² points of the stop")
    pixels = pixels @ turn.T
    p = probe.radius * legendre(points_of_aperture(float(np.hypot(*e.T).max()), k, probe, pixels, effort.points))[0]
    density = 2 * k * float(np.abs(_slopes_by_v(paths, edge, from_mean=False)).max())
    spot = _spot(plane, turn, paths.centre, half, beside / 2, density, effort.points)
    if spot is None:
        return np.zeros(len(pixels), np.complex128)
    u, v, weights = spot
    x = radius * legendre(count)[0]
    between, to_probe = _Between.of(paths, k, x, x, u, v), _Between.of(before, k, x, x, p, p)
    within = radius**2 * region_weights(count, 1.0)
    middle, origin = paths.centre[None], np.zeros((1, 2))
    of_s = _smooth(lambda s: paths.strength(s, middle)[:, 0], x, x) * within
    of_v = _smooth(lambda v: paths.strength(origin, v)[0], u, v) / paths.strength(origin, middle)[0, 0]
    path, power = _smooth(light.path, x, x, _MORE)
    coming = phasor(k * path) * np.sqrt(power) * of_s
    leaving = between.back(between.there(coming) * weights * (of_v / beam.wavelength) ** 2) * of_s
    # The distance to a layer has 2kt/n of its path in it already.
    phase = k * (2 * paths.mean - plane.path + 2 * plane.depth / plane.index)
    leaving = leaving * np.exp(1j * math.remainder(phase, 2 * math.pi))
    leaving = leaving * _smooth(lambda s: before.strength(s, origin)[:, 0], x, x)
    of_p = _smooth(lambda p: before.strength(origin, p)[0], p, p) / before.strength(origin, origin)[0, 0]
    return seen(to_probe.there(leaving) * of_p / (1j * beam.wavelength), p, k, probe, pixels)


@dataclass(frozen=True)
class _Light:
    """Light from 1/curvature under a tilt along y, by rays that would go through places e of the entrance pupil.

    `scale` is how far e moves for a place in the stop, near the axis.
    """

    lens: Traced
    sine: float
    curvature: float
    scale: float

    @staticmethod
    def of(lens: Traced, sine: float, curvature: float) -> _Light:
        """With its scale."""
        step = 1e-3 * lens.opening[lens.stop]
        ends = lens.trace(*_Light(lens, sine, 0.0, 1.0).rays(np.array([[-step, 0.0], [step, 0.0]]))[:2])
        return _Light(lens, sine, curvature, 2 * step / float(ends.stop[1, 0] - ends.stop[0, 0]))

    def rays(self, e: Real) -> tuple[Real, Real, Real, Real]:
        """Places and directions [N, 3] through e [N, 2], the paths to there, and the power through a unit of e."""
        place, towards = np.concatenate([e, 0 * e[:, :1]], 1), np.array([0.0, self.sine, math.sqrt(1 - self.sine**2)])
        start = place + np.array([0.0, 0.0, self.lens.pupil])
        if self.curvature == 0:
            return start, np.tile(towards, (len(e), 1)), place @ towards, np.full(len(e), towards[2])
        away = 1 / self.curvature
        way = place + towards * away
        length, sign = np.linalg.norm(way, axis=1), math.copysign(1.0, away)
        path = sign * (2 * away * (place @ towards) + (place**2).sum(1)) / (length + abs(away))
        direction = sign * way / length[:, None]
        return start, direction, path, direction[:, 2] * (away / length) ** 2

    def through(self, s: Real) -> Real:
        """e [N, 2] of the rays through places s [N, 2] of the stop."""
        return _aimed(self.lens, lambda e: self.rays(e)[:2], s, self.scale)[0]

    def path(self, s: Real) -> Real:
        """Of the light at places s [N, 2] of the stop: its path, and the power through a unit of x and y, [2, N]."""
        e, step = self.through(s), _STEP * self.lens.opening[self.lens.stop]
        start, direction, path, power = self.rays(e)
        path = path + self.lens.trace(start, direction, self.lens.stop).path
        one, other = ((self.through(s + step * way) - self.through(s - step * way)) / (2 * step) for way in np.eye(2))
        return np.stack([path, power * np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])])


def _aimed(lens: Traced, start: Callable[[Real], tuple[Real, Real]], s: Real, scale: float) -> tuple[Real, Bundle]:
    """e [N, 2] of the rays that meet the stop at s [N, 2], where `start` has places and directions of a ray through e,
    and these rays at the stop."""
    e = scale * s
    for _ in range(_STEPS):
        e = e + scale * (s - lens.trace(*start(e), lens.stop).stop[:, :2])
    return e, lens.trace(*start(e), lens.stop)


def _from_probe(lens: Traced, sine: float, distance: float, p: Real) -> Callable[[Real], tuple[Real, Real]]:
    """Rays through e from places p [N, 2] of the probe's aperture: where they begin, and their directions."""
    across, cosine = np.array([[1.0, 0.0, 0.0], [0.0, math.sqrt(1 - sine**2), -sine]]), math.sqrt(1 - sine**2)
    places = p @ across + np.array([0.0, -distance * sine, lens.pupil - distance * cosine])

    def start(e: Real) -> tuple[Real, Real]:
        way = np.concatenate([e, np.full((len(e), 1), lens.pupil)], 1) - places
        return places, way / np.linalg.norm(way, axis=1, keepdims=True)

    return start


@functools.lru_cache(maxsize=16)
def _before(lens: Traced, sine: float, distance: float, radius: float, reach: float) -> Paths:
    """Between the stop and the probe's aperture."""
    scale = _Light.of(lens, sine, 0.0).scale

    def rays(s: Real, p: Real) -> tuple[Real, Real, Real]:
        bundle = _aimed(lens, _from_probe(lens, sine, distance, p), s, scale)[1]
        return bundle.stop[:, :2], p, bundle.path

    return Paths.of(rays, reach, np.zeros(2), radius)


@functools.lru_cache(maxsize=16)
def _behind(lens: Traced, sine: float, reach: float, half: float, place: float) -> Paths:
    """Between the stop and a square about where light under a tilt along y lands through the stop's middle, at the z
    `place`."""
    names, light = ("z", "curvature", "conic", "asphere", "opening", "index"), _Light.of(lens, sine, 0.0)
    rest = Traced(**{name: getattr(lens, name)[lens.stop + 1 :] for name in names}, stop=-1)
    chief = light.rays(light.through(np.zeros((1, 2))))[:2]
    centre = _landing(lens.trace(*chief), place)[0][0]

    def sent(s: Real, q: Real) -> tuple[Real, Real]:
        """Landings [N, 2] and paths of rays that leave s [N, 2] under the sines q [N, 2]."""
        z = lens.z[lens.stop] + lens.sag(lens.stop, np.maximum((s**2).sum(1), 1e-30))[0]
        way = np.concatenate([q, np.sqrt(1 - (q**2).sum(1, keepdims=True))], 1)
        return _landing(rest.trace(np.concatenate([s, z[:, None]], 1), way), place)

    zero, step = np.zeros((2, 2)), 1e-4 * np.array([[0.0, -1.0], [0.0, 1.0]])
    by_s, by_q = (
        float(ends[1, 1] - ends[0, 1]) / 2e-4 / unit
        for ends, unit in ((sent(reach * step, zero)[0], reach), (sent(zero, step)[0], 1.0))
    )

    def rays(s: Real, v: Real) -> tuple[Real, Real, Real]:
        q = (v - by_s * s) / by_q
        for _ in range(_STEPS):
            q = q + (v - sent(s, q)[0]) / by_q
        found, path = sent(s, q)
        return s, found, path

    return Paths.of(rays, reach, centre, half)


def _landing(rays: Bundle, place: float) -> tuple[Real, Real]:
    """Where rays meet the plane at the z `place`, [N, 2], and their paths to there."""
    way = (place - rays.position[:, 2]) / rays.direction[:, 2]
    return rays.position[:, :2] + way[:, None] * rays.direction[:, :2], rays.path + way


def _check_rims(lens: Traced, light: _Light, probe: Probe, edge: Real) -> None:
    """Raise TooLargeError where another rim than the stop's cuts rays that enter, or that go to the probe."""
    assert probe.distance is not None
    opening = list(lens.opening)
    opening[lens.stop] = math.inf
    opened = replace(lens, opening=tuple(opening))
    enters = opened.trace(*light.rays(light.through(edge))[:2]).height
    s, p = (one.reshape(-1, 2) for one in np.broadcast_arrays(edge[:, None], _circle(probe.radius, 9)[None]))
    leaves = _aimed(opened, _from_probe(lens, light.sine, probe.distance, p), s, light.scale)[1].height
    if not max(float(enters.max()), float(leaves.max())) < 1:
        raise TooLargeError("light that another rim than the stop's cuts")


def _circle(radius: float, count: int) -> Real:
    """Places [count, 2] along a circle about the axis, the last one the first."""
    turn = np.linspace(0, 2 * math.pi, count)
    return radius * np.stack([np.cos(turn), np.sin(turn)], 1)


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
class _Between:
    """Sums over exp(ikW) between the stop's places [y, x] and others [v, u].

    But for s·Mv, whose exponentials are `across` [x, u] and `down` [y, v], and for what depends on v alone, `of_spot`
    [v, u], they are a short sum of products: `of_stop` [modes, y, x] and `shares` [modes, v, u].
    """

    of_stop: Complex
    shares: Complex
    across: Complex
    down: Complex
    of_spot: Complex

    @staticmethod
    def of(paths: Paths, k: float, x: Real, y: Real, u: Real, v: Real) -> _Between:
        """Places of the stop, and others."""
        at, centre = paths.at, paths.centre
        g, h = _STEP * paths.half, _STEP * paths.reach
        slopes = []
        for one in np.eye(2):
            s, places = np.stack([h * one, -h * one]), centre + np.stack([g * one, -g * one])
            four = at(s, places)
            slopes.append(float(four[0, 0] - four[0, 1] - four[1, 0] + four[1, 1]) / (4 * h * g))
        middle, origin = centre[None], np.zeros((1, 2))
        own = at(origin, _grid(u, v))[0] - at(origin, middle)[0, 0]

        def rest(s: Real, places: Real) -> Complex:
            """The exponential of what neither s nor v alone nor their product has, [N, M]; and all of s."""
            left = at(s, places) - (at(origin, places) - at(origin, middle)) - (s * slopes) @ (places - centre).T
            return phasor(k * left)

        # As many places as a few thousand pairs need.
        draw = 2 * qmc.Halton(4, scramble=False).fast_forward(1).random(4000) - 1
        some = paths.reach * draw[:, :2]
        places = centre + draw[:40, 2:] * [np.ptp(u) / 2, np.ptp(v) / 2]
        places += np.array([(u.max() + u.min()) / 2 - centre[0], (v.max() + v.min()) / 2 - centre[1]])
        for count in _KNOTS:
            knots_u, shares_u = interpolation(float(u.min()), float(u.max()), count, places[:, 0])
            knots_v, shares_v = interpolation(float(v.min()), float(v.max()), count, places[:, 1])
            knots = _grid(knots_u, knots_v)
            shares = np.stack([one * other for other in shares_v for one in shares_u])
            of_knots = rest(some, knots)
            if float(np.abs(of_knots @ shares - rest(some, places)).max()) < _OFF:
                break
        else:
            raise TooLargeError("paths vary too much over the spot")
        # Neighbouring knots have nearly the same exponentials, so that few combinations of them hold almost all.
        parts, modes = np.linalg.eigh(of_knots.conj().T @ of_knots / len(some))
        modes = modes[:, np.cumsum(parts) > _FAINT**2]
        if 2 * modes.shape[1] * len(v) * len(y) * (len(x) + len(u)) > _MOST_PRODUCTS:
            raise TooLargeError(
                f"{modes.shape[1]} times {len(y)} x {len(x)} points of the stop and {len(v)} x {len(u)} of the spot"
            )
        of_stop = np.stack([(rest(_grid(x, one[None]), knots) @ modes).T for one in y], 1)
        by_u, by_v = (np.stack(interpolation(float(one.min()), float(one.max()), count, one)[1]) for one in (u, v))
        of_modes = by_v.T @ modes.conj().T.reshape(-1, count, count) @ by_u
        across, down = (
            phasor(k * slope * np.outer(places_of_stop, of_spot - mid))
            for slope, places_of_stop, of_spot, mid in zip(slopes, (x, y), (u, v), centre, strict=True)
        )
        return _Between(of_stop, of_modes, across, down, phasor(k * own).reshape(len(v), len(u)))

    def there(self, field: Complex) -> Complex:
        """At the others [v, u] of a field [y, x] over the stop."""
        total = np.zeros(self.of_spot.shape, np.complex128)
        for mode, share in zip(self.of_stop, self.shares, strict=True):
            total += share * ((self.down.T @ (mode * field)) @ self.across)
        return total * self.of_spot

    def back(self, field: Complex) -> Complex:
        """At the stop [y, x] of a field [v, u] over the others."""
        field, total = field * self.of_spot, np.zeros(self.of_stop.shape[1:], np.complex128)
        for mode, share in zip(self.of_stop, self.shares, strict=True):
            total += mode * (self.down @ (field * share) @ self.across.T)
        return total


def _grid(x: Real, y: Real) -> Real:
    """Places [N, 2] in rows."""
    return np.stack([one.ravel() for one in np.meshgrid(x, y)], 1)


def _smooth(value: Callable[[Real], Real], x: Real, y: Real, few: int = _FEW) -> Real:
    """A function [..., N] of places [N, 2] on a grid, [..., y, x], where a few of its values show it all."""
    (at_x, by_x), (at_y, by_y) = (interpolation(float(one.min()), float(one.max()), few, one) for one in (x, y))
    values = value(_grid(at_x, at_y))
    return np.stack(by_y, 1) @ values.reshape(*values.shape[:-1], few, few) @ np.stack(by_x)


def _slopes_by_v(paths: Paths, s: Real, *, from_mean: bool = True) -> Real:
    """∂W/∂v at the middle of the spot, less their mean, [N, 2]."""
    g = _STEP * paths.half
    after, before = ([paths.at(s, paths.centre + sign * g * one[None])[:, 0] for one in np.eye(2)] for sign in (1, -1))
    slopes = (np.stack(after, 1) - np.stack(before, 1)) / (2 * g)
    return slopes - slopes.mean(0) if from_mean else slopes


def _steepest(path: Real, edge: Real) -> float:
    """Largest change of paths [..., N] along the stop's edge and across it, roughly, less their mean slope."""
    wide = 2 * float(np.abs(edge).max())
    flat = path - path.mean(-1, keepdims=True)
    opposite = np.abs(flat - np.roll(flat[..., :-1], len(edge) // 2, -1).take(range(len(edge)), -1, mode="wrap"))
    along = np.abs(np.diff(path, axis=-1)).max() / float(np.hypot(*np.diff(edge, axis=0).T).max())
    return max(float(along), float(opposite.max()) / wide)


@functools.cache
def _planar(degree: int) -> tuple[tuple[int, int], ...]:
    return tuple((i, j) for i in range(degree + 1) for j in range(degree + 1 - i))


@functools.cache
def _terms(degree: int) -> tuple[list[int], list[int]]:
    """Pairs of planar products, by number, up to the total degree and even across the tilt together."""
    pairs = [
        (m, n)
        for m, (i, j) in enumerate(_planar(degree))
        for n, (p, q) in enumerate(_planar(degree))
        if i + j + p + q <= degree and (i + p) % 2 == 0
    ]
    return [m for m, _ in pairs], [n for _, n in pairs]


def _products(u: Real, degree: int) -> Real:
    """Products [N, K] of Chebyshev polynomials of u [N, 2]."""
    values = np.polynomial.chebyshev.chebvander(u, degree)
    return values[:, 0][:, [i for i, _ in _planar(degree)]] * values[:, 1][:, [j for _, j in _planar(degree)]]
