"""The judge's traced lens through the probe's aperture: Huygens' sums on rays' paths from every place to every place.

The field at a place v of the sensor is the sum over places e of the entrance pupil of exp(ikW(e, v)), W being the path
of the ray from the one to the other, times √|det ∂²W/∂e∂v|/iλ, by which power is kept; the way back is the same sum
(reciprocity). W is a polynomial in all four coordinates, fitted to the judge's own rays: nothing here knows of a model
of the lens, of mirrors' rays or of orders' rays. The lens's stop alone must limit its light, so that the pupil is a
disc, and the tilt lies along y.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.stats import qmc

from .plane import TooLargeError
from .quadrature import Complex, Real, legendre, phasor, region_weights
from .rays import Traced
from .way import Probe, through_aperture

__all__ = ["Paths", "near_amplitudes"]

# Highest total degree of W, rays that are fitted, and rays by which the fit is checked.
_DEGREE, _RAYS, _CHECKED = 9, 12_000, 2_000
# Dark rings that the sum over the sensor holds beyond the rays; it fades out over the outer half.
_RINGS = 24.0
_MOST, _AT_ONCE = 520, 1 << 21
# Of the mixed derivative's differences, in half widths.
_STEP = 1e-2


@dataclass(frozen=True)
class Paths:
    """W(e, v) in metres: e in a square of half width `reach` about the axis, v in one of `half` about `centre` [2].

    `factors` [K, K] go with products of two polynomials [K] of e/reach and of (v - centre)/half. `misfit` is the RMS of
    W over rays that were not fitted.
    """

    reach: float
    centre: Real
    half: float
    factors: Real
    misfit: float

    @staticmethod
    def of(lens: Traced, sine: float, reach: float, half: float) -> Paths:
        """By rays from all of the pupil's square to all of the square about where light of a tilt along y lands."""

        def sent(e: Real, q: Real) -> tuple[Real, Real]:
            """Landings [N, 2] and paths of rays from e [N, 2] under the sines q [N, 2]."""
            start = np.concatenate([e, np.full((len(e), 1), lens.pupil)], 1)
            rays = lens.trace(start, np.concatenate([q, np.sqrt(1 - (q**2).sum(1, keepdims=True))], 1))
            way = (lens.image - rays.position[:, 2]) / rays.direction[:, 2]
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
        solved = np.linalg.lstsq(matrix[fitted], path[fitted] - mean, rcond=None)[0]
        misfit = float((path - mean - matrix @ solved)[~fitted].std())
        factors = np.zeros((len(_planar()),) * 2)
        factors[one, other] = solved
        return Paths(reach, centre, half, factors, misfit)

    def at(self, e: Real, v: Real) -> Real:
        """W [N, M] but for a constant, of places e [N, 2] and v [M, 2]."""
        return _products(e / self.reach) @ self.factors @ _products((v - self.centre) / self.half).T

    def strength(self, e: Real, v: Real) -> Real:
        """√|det ∂²W/∂e∂v| [N, M] in 1/m; one of e and v is a single place."""
        h, g = _STEP * self.reach, _STEP * self.half
        mixed = np.empty((2, 2, len(e), len(v)))
        for i, along in enumerate(np.eye(2)):
            for j, across in enumerate(np.eye(2)):
                four = [
                    sign * other * self.at(e + sign * h * along, v + other * g * across)
                    for sign in (1, -1)
                    for other in (1, -1)
                ]
                mixed[i, j] = sum(four) / (4 * h * g)
        return np.sqrt(np.abs(mixed[0, 0] * mixed[1, 1] - mixed[0, 1] * mixed[1, 0]))


def near_amplitudes(
    lens: Traced,
    sine: float,
    curvature: float,
    wavelength: float,
    reflected: Callable[[Real], Complex],
    probe: Probe,
    pixels: Real,
    *,
    radius: float,
    points: float = 1.0,
    window: float = 1.0,
    steepest: float = 0.0,
) -> Complex:
    """Amplitudes at pixels [Q, 2] for light of 1 W/m² that comes from the distance 1/curvature under a tilt along y.

    Parameters
    ----------
    lens
        Focused.
    sine
        Of the tilt along y.
    curvature
        Of the light that enters, in 1/m.
    wavelength
        In metres.
    reflected
        The plane's amplitudes at places [M, 2] from the axis, even in x.
    probe
        With its distance and radius.
    pixels
        Counted in metres from where light that returns along its way lands.
    radius
        Of the entrance pupil.
    points, window
        Times the points of all sums, and the dark rings of the spot.
    steepest
        Sine of the steepest order of the plane that returns.
    """
    if probe.distance is None:
        raise TooLargeError("the far field is for the judge of plane waves")
    k = 2 * math.pi / wavelength
    # Where light lands by rays, with what the rim diffracts.
    turn = np.linspace(0, 2 * math.pi, 73)
    edge = radius * np.stack([np.cos(turn), np.sin(turn)], 1)
    first = Paths.of(lens, sine, radius, 0.02 * lens.focal_length)
    opening = float(np.abs(_slopes_by_v(first, edge)).max())
    ring = wavelength / (2 * opening)
    blur = _blur(lens, sine, curvature, edge, first.centre)
    half = blur + window * _RINGS * ring
    paths = Paths.of(lens, sine, radius, half)
    # By the steepest phases over the pupil and over the spot.
    corners = paths.centre + half * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    inwards = _source(edge, sine, curvature)[0]
    outwards = paths.at(edge, corners).T + sine * edge[:, 1]
    steep = max(
        _steepest(paths.at(edge, corners).T + inwards, edge),
        _steepest(outwards, edge) + (probe.radius + radius) / probe.distance,
    )
    count = math.ceil(points * 1.1 * k * steep * radius) + 24
    side = math.ceil(points * 1.1 * k * (2 * opening + steepest) / 2 * half) + 24
    if max(count, side) > _MOST:
        raise TooLargeError(f"{count}² points of the pupil, {side}² of the spot")
    # Before the long sums: whether the aperture's points are too many.
    through_aperture(np.zeros((2, 2), np.complex128), np.array([-radius, radius]), sine, k, probe, pixels, points)
    nodes, weights = legendre(side)
    x, line = legendre(count)[0] * radius, nodes * half
    e = np.stack([one.ravel() for one in np.meshgrid(x, x)], 1)
    v = paths.centre + np.stack([one.ravel() for one in np.meshgrid(line, line)], 1)
    away = np.hypot(*(v - paths.centre).T)
    t = np.clip((half - away) / (window * _RINGS * ring / 2), 0.0, 1.0)
    area = np.outer(weights, weights).ravel() * half**2 * (t**3 * (10 - 15 * t + 6 * t**2))
    disc = region_weights(count, radius)
    path, power = _source(e, sine, curvature)
    of_e = paths.strength(e, paths.centre[None])[:, 0]
    of_v = paths.strength(np.zeros((1, 2)), v)[0]
    of_v = of_v / paths.strength(np.zeros((1, 2)), paths.centre[None])[0, 0] / wavelength
    coming = phasor(k * path) * (np.sqrt(power) * of_e * disc.ravel())
    spot = _summed(paths, k, e, v, coming, side) * of_v
    spot = np.asarray(spot * reflected(v) * area * of_v, np.complex128)
    leaving = _summed(paths, k, v, e, spot, count, back=True) * of_e
    field = leaving.reshape(count, count) * disc
    return through_aperture(field, x, sine, k, probe, pixels, points)


def _summed(
    paths: Paths, k: float, here: Real, there: Real, field: Complex, columns: int, *, back: bool = False
) -> Complex:
    """Σ exp(ikW) of a field, from e to v or back, at places in rows of `columns`; both are even in x."""
    number = np.arange(len(there)).reshape(-1, columns)
    half = number[:, columns // 2 :].ravel()
    e, v = (there[half], here) if back else (here, there[half])
    one = torch.from_numpy(_products(e / paths.reach) @ paths.factors * (k / (2 * math.pi)))
    other = torch.from_numpy(_products((v - paths.centre) / paths.half))
    to, own = (one, other) if back else (other, one)
    amplitude = torch.from_numpy(field).to(torch.complex64)
    found = torch.empty(len(half), dtype=torch.complex128)
    step = max(1, _AT_ONCE // len(here))
    for i in range(0, len(half), step):
        turns = to[i : i + step] @ own.T
        # Whole turns go before single precision.
        phase = (turns - turns.round()).float() * (2 * math.pi)
        found[i : i + step] = (torch.complex(torch.cos(phase), torch.sin(phase)) @ amplitude).to(torch.complex128)
    right = found.numpy().reshape(len(number), -1)
    left = right[:, columns % 2 :][:, ::-1]
    return np.concatenate([left, right], 1).ravel()


def _source(e: Real, sine: float, curvature: float) -> tuple[Real, Real]:
    """Path at places e [N, 2] of the entrance pupil, and power through a unit area there."""
    cosine = math.sqrt(1 - sine**2)
    if curvature == 0:
        return e[:, 1] * sine, np.full(len(e), cosine)
    away = 1 / curvature
    square = (e**2).sum(1)
    length = np.sqrt(away**2 + 2 * away * e[:, 1] * sine + square)
    path = math.copysign(1.0, away) * (2 * away * e[:, 1] * sine + square) / (length + abs(away))
    return path, cosine * (abs(away) / length) ** 3


def _blur(lens: Traced, sine: float, curvature: float, edge: Real, centre: Real) -> float:
    """Farthest landing, from the spot's middle, of the source's rays through the pupil's edge."""
    start = np.concatenate([edge, np.full((len(edge), 1), lens.pupil)], 1)
    towards = np.array([0.0, sine, math.sqrt(1 - sine**2)])
    way = np.tile(towards, (len(edge), 1))
    if curvature:
        way = np.concatenate([edge, np.zeros((len(edge), 1))], 1) + towards / curvature
        way = way / np.linalg.norm(way, axis=1, keepdims=True)
    rays = lens.trace(0.98 * start + 0.02 * start * [0.0, 0.0, 1.0], way)
    if float(rays.height.max()) > 1:
        raise TooLargeError("other rims than the stop's limit this light")
    rays = lens.trace(start, way)
    at = rays.position + ((lens.image - rays.position[:, 2]) / rays.direction[:, 2])[:, None] * rays.direction
    return float(np.hypot(*(at[:, :2] - centre).T).max())


def _slopes_by_v(paths: Paths, e: Real) -> Real:
    """∂W/∂v at the middle of the spot, less that of light from the pupil's middle, [N, 2]."""
    g = _STEP * paths.half
    after, before = ([paths.at(e, paths.centre + sign * g * one[None])[:, 0] for one in np.eye(2)] for sign in (1, -1))
    slopes = (np.stack(after, 1) - np.stack(before, 1)) / (2 * g)
    return slopes - slopes.mean(0)


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
