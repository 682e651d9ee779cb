"""The judge's traced lens: rays to the stop's image before the sensor, and from there waves with exact distances.

In the stop's image the pupil's edge is sharp; on any other plane it has fringes, which rays know nothing of. The image
has aberrations: each ray has its own, where it crosses the ray beside it from the same place in the stop.
Light from the probe, and light that a pixel of the probe would send, are each a bundle of rays of their own through the
whole lens. Rays are laid out by their azimuth and distance from the pupil's middle up to the edge that the surfaces
leave. What each pixel receives is the sum of both fields' product over the sensor (reciprocity).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np

from tapetum.bench import PrescriptionLens, Scene

from .near import near_amplitudes
from .plane import Plane, Points, TooLargeError, points
from .quadrature import Complex, Real, interpolation, legendre, phasor
from .rays import Bundle, Traced, focused
from .thin import Beam, Effort
from .way import Probe

__all__ = ["rim_curvatures", "traced_amplitudes"]

# Dark rings that the sum over the sensor holds beyond the rays, at a window of 1; it fades out over the outer half.
_RINGS = 14.0
_MOST_RAYS, _MOST_POINTS = 30_000, 700_000
_AT_ONCE = 1 << 17
# Differences are taken over so many focal lengths, and over such sines.
_STEP = 1e-4


@dataclass(frozen=True)
class _Wave:
    """Rays in the exit pupil [N, 3], their directions, phases (rad) and strengths with weights."""

    position: Real
    direction: Real
    path: Real
    strength: Real


def traced_amplitudes(scene: Scene, beam: Beam, plane: Plane, probe: Probe, pixels: Real, effort: Effort) -> Complex:
    """As `thin.amplitudes`, for a prescription."""
    assert isinstance(scene.target.lens, PrescriptionLens)
    lens = focused(scene.target.lens, beam.wavelength, scene.target.object_distance)
    if probe.distance is not None:
        if beam.radius < 1.2 * _outer(lens, beam.sines):
            raise TooLargeError("a beam that does not fill the lens is not laid out here")
        return near_amplitudes(lens, beam, plane, probe, pixels, effort)
    k = 2 * math.pi / beam.wavelength
    s = np.array(beam.sines)
    cosine = math.sqrt(1 - s @ s)
    shift = plane.depth / plane.index
    place = lens.image - shift
    a = np.array(plane.tilt)
    if not 0 < place - lens.exit_pupil() < 50 * lens.focal_length:
        raise TooLargeError("an exit pupil behind the sensor, or far away, is no plane to sum from here")
    # Few rays first: where they land, how steep they are.
    coarse = _few(lens, _pair(s), beam.curvature, k)
    landing, spread = _landing(coarse, place)
    if math.hypot(*(beam.sines)) > 0 and beam.radius < 1.2 * _outer(lens, _pair(s)):
        raise TooLargeError("a beam that does not fill the lens is not laid out in rays here")
    aperture = float(np.abs(coarse.direction[:, :2] - coarse.direction[:, :2].mean(0)).max())
    ring = beam.wavelength / (2 * aperture)
    steepest = float(np.abs(coarse.direction[:, :2]).max())
    square = float(s @ s)
    turned = pixels / probe.focal_length
    if square > 0:
        turned = turned - (1 - cosine) / square * np.outer(turned @ s, s)
    others = [_landing(_few(lens, _pair(s - one), 0.0, k), place) for one in turned[:: max(1, len(turned) // 4)]]
    margin = effort.window * _RINGS * ring
    flat = min(spread, *(one[1] for one in others)) + max(
        min(float(np.hypot(*(one[0] - landing))), 8 * ring + abs(spread - one[1])) for one in others
    )
    flat += margin / 2 + float(np.hypot(*a)) * 2 * flat
    half = flat + margin / 2
    density = 2 * k * steepest + 2 * k * float(np.hypot(*a))
    found = points(plane, landing, half, flat, density, effort.points)
    if found is None:
        return np.zeros(len(pixels), np.complex128)
    widest = max(spread, *(one[1] for one in others)) + half
    turns = k * aperture * widest
    spokes = math.ceil(effort.points * (1.15 * turns + 24))
    rings = math.ceil(effort.points * (0.6 * turns + 10))
    # Whoever asks for a wide window waits for it.
    more = max(1.0, effort.window / 2) ** 2
    if not found.product or spokes * rings > more * _MOST_RAYS or found.u.size > more * _MOST_POINTS:
        raise TooLargeError(f"{spokes} x {rings} rays, {found.u.shape} points of the plane")
    coming = _at(found, _wave(lens, s, beam.curvature, spokes, rings, k), place, a, landing, k) * found.weights
    amplitudes = [
        (coming * _at(found, _wave(lens, s - one, 0.0, spokes, rings, k), place, a, landing, k)).sum() for one in turned
    ]
    # The distance to a layer has 2kt/n of its path in it already.
    phase = -k * (plane.path - 2 * shift)
    return np.array(amplitudes) * (np.exp(1j * phase) * k / (2 * math.pi * probe.focal_length))


def _started(lens: Traced, s: Real, curvature: float, e: Real) -> tuple[Real, Real, Real, Real]:
    """Rays through places e [N, 2] of the entrance pupil: positions, directions, path so far, power of a unit area."""
    cosine = math.sqrt(1 - s @ s)
    position = np.concatenate([e, np.full((len(e), 1), lens.pupil)], 1)
    towards = np.array([s[0], s[1], cosine])
    if curvature == 0:
        return position, np.broadcast_to(towards, position.shape), e @ s, np.full(len(e), cosine)
    away = 1 / curvature
    from_source = np.concatenate([e, np.zeros((len(e), 1))], 1) + away * towards
    length = np.linalg.norm(from_source, axis=1)
    sign = math.copysign(1.0, away)
    path = sign * (2 * away * (e @ s) + (e**2).sum(1)) / (length + abs(away))
    return position, sign * from_source / length[:, None], path, cosine * (abs(away) / length) ** 3


def _edges(lens: Traced, s: Real, curvature: float, spokes: int) -> tuple[Real, Real]:
    """A place within the pupil and the distance of its edge from there along each spoke."""
    turn = 2 * math.pi * np.arange(spokes) / spokes
    rays = np.stack([np.cos(turn), np.sin(turn)], 1)
    reach, middle = _outer(lens, _pair(s)), _middle(lens, _pair(s), curvature)
    if middle is None:
        return np.zeros(2), np.zeros(spokes)
    # The first of equal steps that is stopped, then halves.
    steps = np.linspace(0, 1.6 * reach, 49)
    every = (middle + rays[:, None, :] * steps[:, None]).reshape(-1, 2)
    stopped = (_height(lens, s, curvature, every) > 1).reshape(spokes, -1)
    first = np.maximum(stopped.argmax(1), 1)
    low, high = steps[first - 1], steps[first]
    for _ in range(24):
        at = (low + high) / 2
        out = _height(lens, s, curvature, middle + rays * at[:, None]) > 1
        low, high = np.where(out, low, at), np.where(out, at, high)
    return middle, low


# The same directions are asked for with few rays and with many, for every plane, and with more effort.
@functools.lru_cache(maxsize=512)
def _outer(lens: Traced, sines: tuple[float, float]) -> float:
    """Half width of a square that holds the pupil."""
    reach = lens.focal_length
    line = np.linspace(-reach, reach, 201)
    zero = np.zeros_like(line)
    e = np.concatenate([np.stack([line, zero], 1), np.stack([zero, line], 1)])
    inside = _height(lens, np.array(sines), 0.0, e) <= 1
    if not inside.any():
        return reach / 10
    return 1.3 * float(np.abs(e[inside]).max()) + 2 * reach / 200


@functools.lru_cache(maxsize=512)
def _middle(lens: Traced, sines: tuple[float, float], curvature: float) -> Real | None:
    """Mean place within the pupil; None where no ray gets through."""
    line = np.linspace(-1, 1, 61) * _outer(lens, sines)
    x, y = (one.ravel() for one in np.meshgrid(line, line))
    e = np.stack([x, y], 1)
    inside = _height(lens, np.array(sines), curvature, e) <= 1
    return e[inside].mean(0) if inside.any() else None


@functools.lru_cache(maxsize=512)
def _few(lens: Traced, sines: tuple[float, float], curvature: float, k: float) -> _Wave:
    """As `_wave`, with rays enough to tell where they land and how steep they are."""
    return _wave(lens, np.array(sines), curvature, 12, 5, k)


def _pair(s: Real) -> tuple[float, float]:
    return float(s[0]), float(s[1])


def _height(lens: Traced, s: Real, curvature: float, e: Real) -> Real:
    return _through(lens, s, curvature, e).height


def _through(lens: Traced, s: Real, curvature: float, e: Real) -> Bundle:
    """Rays through the whole lens, with their path so far."""
    position, direction, before, _ = _started(lens, s, curvature, e)
    rays = lens.trace(position, direction)
    return replace(rays, path=before + rays.path)


def _wave(lens: Traced, s: Real, curvature: float, spokes: int, rings: int, k: float) -> _Wave:
    """Rays in their images of the stop; where these lie within the lens, as if they did not."""
    middle, edge = _edges(lens, s, curvature, spokes)
    nodes, weights = legendre(rings)
    away = edge[:, None] * (nodes + 1) / 2
    turn = (2 * math.pi * np.arange(spokes) / spokes)[:, None]
    e = np.stack([middle[0] + away * np.cos(turn), middle[1] + away * np.sin(turn)], -1).reshape(-1, 2)
    area = (away * edge[:, None] / 2 * weights * (2 * math.pi / spokes)).ravel()
    toward = np.stack([np.cos(turn), np.sin(turn)], -1).repeat(rings, 1).reshape(-1, 2)
    h = _STEP * lens.focal_length
    beside = [[_through(lens, s, curvature, e + sign * h * one) for sign in (1, -1)] for one in np.eye(2)]
    reference = _stop_images(lens, s, curvature, e, toward, beside)

    def ends(rays: Bundle) -> tuple[Real, Real, Real]:
        way = (reference - rays.position[:, 2]) / rays.direction[:, 2]
        return rays.position + way[:, None] * rays.direction, rays.direction, rays.path + way

    position, direction, path = ends(_through(lens, s, curvature, e))
    # ∂(place on the plane)/∂e by differences: what area a bundle takes there.
    dx, dy = ((ends(after)[0] - ends(before)[0]) / (2 * h) for after, before in beside)
    grown = np.abs(dx[:, 0] * dy[:, 1] - dx[:, 1] * dy[:, 0])
    _, _, _, power = _started(lens, s, curvature, e)
    # √(power · area · cosine of the ray on both planes): of a power-normalised wave.
    strength = area * np.sqrt(power * grown) * direction[:, 2]
    good = np.isfinite(path + strength) & (area > 0)
    return _Wave(position[good], direction[good], path[good], strength[good])


def _stop_images(
    lens: Traced, s: Real, curvature: float, e: Real, toward: Real, beside: list[list[Bundle]] | None = None
) -> Real:
    """z where each ray crosses the one from the same place in the stop under a direction turned `toward` [N, 2].

    `beside` are the rays from places _STEP focal lengths after and before e along x, and along y.
    A place in the sensor beside another by v is reached from there by a way longer by s·v + v²/2R, R the distance of
    this crossing: the paraxial image of the stop gives it for the light near the axis only.
    """
    paraxial = lens.exit_pupil()

    def ray(end: Bundle) -> Real:
        """Place in the stop, place on the paraxial image's plane and slopes, [N, 6]."""
        slope = end.direction[:, :2] / end.direction[:, 2:]
        place = end.position[:, :2] + (paraxial - end.position[:, 2:]) * slope
        return np.concatenate([end.stop[:, :2], place, slope], 1)

    def changes(ends: list[list[Bundle]], step: float) -> Real:
        """By differences along x and y: [N, 6, 2]."""
        return np.stack([(ray(after) - ray(before)) / (2 * step) for after, before in ends], -1)

    h, both = _STEP * lens.focal_length, (1, -1)
    if beside is None:
        beside = [[_through(lens, s, curvature, e + sign * h * one) for sign in both] for one in np.eye(2)]
    turned = [[_through(lens, s + sign * _STEP * one, curvature, e) for sign in both] for one in np.eye(2)]
    by_place, by_turn = changes(beside, h), changes(turned, _STEP)
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b, c, d = by_place[:, 0, 0], by_place[:, 0, 1], by_place[:, 1, 0], by_place[:, 1, 1]
        x, y = -np.einsum("nij,nj->in", by_turn[:, :2], toward)
        moved = np.stack([d * x - b * y, a * y - c * x], 1) / (a * d - b * c)[:, None]
        change = np.einsum("nij,nj->ni", by_place[:, 2:], moved) + np.einsum("nij,nj->ni", by_turn[:, 2:], toward)
        place, slope = change[:, :2], change[:, 2:]
        # Curvatures from a fifth of the paraxial image's to three times it: beyond, rays hardly cross.
        away = lens.image - paraxial
        nearer = (place * slope).sum(1) / (slope**2).sum(1)
        return lens.image - away / np.clip(away / (away + nearer), 0.2, 3.0)


def rim_curvatures(lens: Traced, s: Real, spokes: int) -> Real:
    """C along s, in 1/m, of the path from places of the pupil's rim to the sensor: s·v + C v²/2."""
    middle, edge = _edges(lens, s, 0.0, spokes)
    turn = 2 * math.pi * np.arange(spokes) / spokes
    toward = np.stack([np.cos(turn), np.sin(turn)], 1)
    e = middle + edge[:, None] * toward
    cosine = _through(lens, s, 0.0, e).direction[:, 2]
    return cosine**3 / (lens.image - _stop_images(lens, s, 0.0, e, toward))


def _landing(wave: _Wave, place: float) -> tuple[Real, float]:
    """Mean place of rays on the sensor, and their largest distance from it."""
    way = (place - wave.position[:, 2]) / wave.direction[:, 2]
    at = wave.position[:, :2] + way[:, None] * wave.direction[:, :2]
    if not len(at):
        raise TooLargeError("no ray gets through")
    return at.mean(0), float(np.hypot(*(at - at.mean(0)).T).max())


def _at(found: Points, wave: _Wave, place: float, a: Real, centre: Real, k: float) -> Complex:
    """Huygens' sum at points of a plane that lies a·u farther at u.

    ρ² between a ray's end and a point is X(u) + Y(v) but for 2 a_x a_y u v, taken in at the mean distance. exp(ikρ) is
    interpolated in X at so many points that the error is rounding; then rows and columns are summed apart.
    """
    u, v = found.u[0] - centre[0], found.v - centre[1]
    p = wave.position
    far = place + a @ centre - p[:, 2]
    ax, ay = centre[0] - p[:, 0], centre[1] - p[:, 1]
    # Phases are absolute: planes at different depths interfere.
    mean = float(np.sqrt(ax**2 + ay**2 + far**2).mean())
    total = np.zeros((len(v), len(u)), np.complex128)
    step = max(1, _AT_ONCE // (len(u) + len(v)))
    for i in range(0, len(p), step):
        some = slice(i, i + step)
        x0, d0 = ax[some, None], far[some, None]
        y0 = ay[some, None]
        # Against the middle: X - X0 and Y - Y0.
        X = 2 * (x0 + d0 * a[0]) * u + (1 + a[0] ** 2) * u**2
        Y = 2 * (y0 + d0 * a[1]) * v + (1 + a[1] ** 2) * v**2
        R2 = x0**2 + y0**2 + d0**2
        R = np.sqrt(R2)
        low, high = X.min(1, keepdims=True), X.max(1, keepdims=True)
        middle, half = (low + high) / 2, (high - low) / 2
        turning = float((k * (half**2 / (4 * R2 * R) + half * np.abs(Y).max() / (4 * R2 * R))).max())
        # A single column has no width.
        scaled = (X - middle) / np.where(half > 0, half, 1.0)
        knots, shares = interpolation(-1.0, 1.0, 5 + math.ceil(1.5 * turning), scaled)
        across = phasor(k * X / (2 * R))
        strength = (wave.strength[some] * (k / (2 * math.pi)))[:, None]
        for knot, share in zip(knots, shares, strict=True):
            at = middle + half * knot
            length = np.sqrt((R2 + at) + Y)
            phase = k * (length + (wave.path[some, None] - at / (2 * R)))
            down = phasor(phase) * (strength / length)
            total += down.T @ (across * share)
    cross = phasor(k * a[0] * a[1] / mean * np.outer(v, u)) if a.all() else 1.0
    return total * cross * -1j
