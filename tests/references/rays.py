"""The judge's rays: surfaces by a prescription's numbers, Snell's law, and where the sensor stands.

Written from docs/conventions.md ("Real lenses"): it reads the dataclasses of `tapetum.bench` and calls none of the
functions that trace or focus.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from tapetum.bench import PrescriptionLens
from tapetum.bench.prescription import load_lens

from .quadrature import Real, legendre

__all__ = ["Bundle", "Traced", "focused", "index_of"]

# Sellmeier's B and C by SCHOTT and Malitson, and of PMMA the coefficients of powers of λ in micrometres (Kasarova).
_SELLMEIER = {
    "N-BK7": ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)),
    "N-SF11": ((1.73759695, 0.013188707), (0.313747346, 0.0623068142), (1.89878101, 155.23629)),
    "fused silica": ((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)),
}
_PMMA = ((2.399964, 0), (-8.308636e-2, 2), (-1.919569e-1, -2), (8.720608e-2, -4), (-1.666411e-2, -6), (1.169519e-3, -8))


def index_of(glass: str, wavelength: float) -> float:
    """Refractive index of a named glass."""
    square = (wavelength * 1e6) ** 2
    if glass == "PMMA":
        return math.sqrt(sum(c * square ** (power / 2) for c, power in _PMMA))
    return math.sqrt(1 + sum(b * square / (square - c) for b, c in _SELLMEIER[glass]))


def index_by_abbe(nd: float, vd: float, wavelength: float) -> float:
    """n = A + B/λ² + C/λ⁴ + Dλ² through n_d, n_F - n_C and the normal glass's partial dispersions (SCHOTT, TIE-29)."""

    def terms(nanometres: float) -> Real:
        square = (nanometres / 1000) ** 2
        return np.array([1 / square, 1 / square**2, square])

    f, d, c, g, s = 486.133, 587.562, 656.273, 435.834, 852.11
    rows = np.stack([terms(f) - terms(c), terms(g) - terms(f), terms(c) - terms(s)])
    mean = (nd - 1) / vd
    known = mean * np.array([1.0, 0.6438 - 0.001682 * vd, 0.4029 + 0.002331 * vd])
    return nd + float(np.linalg.solve(rows, known) @ (terms(wavelength * 1e9) - terms(d)))


@dataclass(frozen=True)
class Bundle:
    """Rays where they end: positions and directions [N, 3], path from where they began, the greatest height on their
    way (below 1 they pass), and positions in the stop [N, 3]."""

    position: Real
    direction: Real
    path: Real
    height: Real
    stop: Real


@dataclass(frozen=True)
class Traced:
    """A lens at one wavelength: places, curvatures, conics, aspheres and openings of its surfaces, indices from the
    object's side on, the entrance pupil's z and the sensor's."""

    z: tuple[float, ...]
    curvature: tuple[float, ...]
    conic: tuple[float, ...]
    asphere: tuple[tuple[tuple[int, float], ...], ...]
    opening: tuple[float, ...]
    index: tuple[float, ...]
    stop: int
    pupil: float = 0.0
    image: float = 0.0

    def sag(self, i: int, r2: Real) -> tuple[Real, Real]:
        """z of surface i at the squared distance r2 from the axis, and its derivative by r2."""
        c, root = self.curvature[i], np.sqrt(1 - (1 + self.conic[i]) * self.curvature[i] ** 2 * r2)
        value, slope = c * r2 / (1 + root), c / (2 * root)
        terms = dict(self.asphere[i])
        # By Horner's rule, even powers and odd ones apart: NumPy's powers of arrays take ten times as long.
        for odd in (0, 1):
            some = [power for power in terms if power % 2 == odd]
            if not some:
                continue
            sum_of, by_r2 = np.zeros_like(r2), np.zeros_like(r2)
            for power in range(max(some), 1, -2):
                sum_of = sum_of * r2 + terms.get(power, 0.0)
                by_r2 = by_r2 * r2 + terms.get(power, 0.0) * power / 2
            # The lowest power of the sums is 2, or 3 with one more distance.
            r = np.sqrt(r2) if odd else 1.0
            value, slope = value + sum_of * r2 * r, slope + by_r2 * r
        return value, slope

    def _way(self, i: int, p: Real, d: Real) -> Real:
        """Ways of rays [3, N] to surface i; NaN where they miss it."""
        way = (self.z[i] - p[2]) / d[2]
        if self.curvature[i]:
            # From the vertex's plane on, c (x² + y² + (1 + conic) z²) = 2 z: the root that a flat surface has too.
            bend, shape = self.curvature[i], self.curvature[i] * self.conic[i]
            x, y = p[0] + way * d[0], p[1] + way * d[1]
            r2 = bend * (x**2 + y**2)
            half = d[2] - bend * (x * d[0] + y * d[1])
            root = np.sqrt(half**2 - (bend + shape * d[2] ** 2) * r2)
            conic = way + r2 / (half + np.copysign(root, half))
            if not self.asphere[i]:
                return conic
            way = np.where(np.isnan(conic), way, conic)
        elif not self.asphere[i]:
            return way
        # Most rays are there after some steps; a few at the rim take many, and go on without the others. After a step
        # of 1e-11 m what is left is its square times the surface's curvature.
        start, along, far, left = p, d, way, np.arange(len(way))
        for _ in range(30):
            at = start + far * along
            value, slope = self.sag(i, np.maximum(at[0] ** 2 + at[1] ** 2, 1e-30))
            miss = at[2] - self.z[i] - value
            step = miss / (along[2] - 2 * slope * (at[0] * along[0] + at[1] * along[1]))
            far = far - step
            way[left] = far
            going = np.flatnonzero(np.abs(step) > 1e-11)
            if not len(going):
                break
            if len(going) < len(left) / 2:
                start, along, far, left = start[:, going], along[:, going], far[going], left[going]
        return way

    def trace(self, position: Real, direction: Real, stop_at: int | None = None) -> Bundle:
        """Rays [N, 3] through all surfaces; they may begin within the lens, as if there were none."""
        # Components first: each is summed over all rays.
        p, d, path = position.T.copy(), direction.T.copy(), np.zeros(len(position))
        height, stop = np.zeros(len(position)), p
        with np.errstate(invalid="ignore", divide="ignore"):
            for i in range(len(self.z)):
                way = self._way(i, p, d)
                path = path + self.index[i] * way
                p = p + way * d
                r2 = np.maximum(p[0] ** 2 + p[1] ** 2, 1e-30)
                height = np.fmax(height, r2 / self.opening[i] ** 2)
                if self.stop == i:
                    stop = p
                if stop_at == i:
                    return Bundle(p.T, d.T, path, height, stop.T)
                if self.index[i] == self.index[i + 1]:
                    continue
                _, slope = self.sag(i, r2)
                # The normal (n x, n y, 1)/length.
                n = -2 * slope
                length = np.sqrt(n**2 * r2 + 1)
                ratio = self.index[i] / self.index[i + 1]
                cosine = (n * (p[0] * d[0] + p[1] * d[1]) + d[2]) / length
                turn = (np.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) / length
                d = ratio * d
                d[:2] += turn * n * p[:2]
                d[2] += turn
        height = np.where(np.isfinite(p.sum(0) + d.sum(0)), height, np.inf)
        return Bundle(p.T, d.T, path, height, stop.T)

    def heights(self, start: Real) -> Real:
        """Paraxial heights and slopes of rays [2, m] that begin before the first surface: behind the last one."""
        state = start.copy()
        for i in range(len(self.z)):
            before, after = self.index[i], self.index[i + 1]
            bend = self.curvature[i] + 2 * sum(factor for power, factor in self.asphere[i] if power == 2)
            state[1] = (before * state[1] - (after - before) * bend * state[0]) / after
            if i + 1 < len(self.z):
                state[0] = state[0] + (self.z[i + 1] - self.z[i]) * state[1]
        return state

    @property
    def focal_length(self) -> float:
        """Paraxial."""
        return -1 / float(self.heights(np.array([[1.0], [0.0]]))[1, 0])

    def exit_pupil(self) -> float:
        """z of the stop's paraxial image by the surfaces from it on."""
        behind = Traced(
            **{
                name: getattr(self, name)[self.stop :]
                for name in ("z", "curvature", "conic", "asphere", "opening", "index")
            },
            stop=0,
        )
        height, slope = behind.heights(np.array([[0.0], [1.0]]))[:, 0]
        return float(self.z[-1] - height / slope)

    def entrance_pupil(self) -> float:
        """z of the stop's paraxial image by the surfaces before it."""
        state = np.array([[0.0, 1.0], [1.0, 0.0]])
        for i in range(self.stop):
            before, after = self.index[i], self.index[i + 1]
            bend = self.curvature[i] + 2 * sum(factor for power, factor in self.asphere[i] if power == 2)
            state[1] = (before * state[1] - (after - before) * bend * state[0]) / after
            state[0] = state[0] + (self.z[i + 1] - self.z[i]) * state[1]
        # A ray from the axis at z with the slope 1 has the height -z at the vertex; it must meet the stop's middle.
        return float(state[0, 0] / state[0, 1])


@functools.lru_cache(maxsize=32)
def focused(lens: PrescriptionLens, wavelength: float, distance: float) -> Traced:
    """The lens at a wavelength, its sensor where it is in focus at the design wavelength, the whole lens moved."""
    design = _built(lens, lens.design_wavelength, 1.0)
    scale = lens.focal_length / design.focal_length
    design = _built(lens, lens.design_wavelength, scale)
    pupil = design.entrance_pupil()
    opening = list(design.opening)
    if lens.f_number is not None:
        edge = np.array([[0.0, design.focal_length / (2 * lens.f_number), pupil]])
        at = design.trace(edge, np.array([[0.0, 0.0, 1.0]]), stop_at=design.stop).position[0]
        opening[design.stop] = min(opening[design.stop], math.hypot(at[0], at[1]))
    design = Traced(**{**vars(design), "opening": tuple(opening), "pupil": pupil})
    real = _built(lens, wavelength, scale)
    # The pupil that the scene's geometry counts from is that of the light itself.
    return Traced(
        **{**vars(real), "opening": tuple(opening), "pupil": real.entrance_pupil(), "image": _image(design, distance)}
    )


def _built(lens: PrescriptionLens, wavelength: float, scale: float) -> Traced:
    given = load_lens(lens.name)
    assert len(given.states) == 1, "the judge knows prime lenses"
    gaps, openings = dict(given.states[0].thickness), dict(given.states[0].semi_diameter)
    z, index, places = 0.0, [1.0], list[float]()
    for i, one in enumerate(given.surfaces):
        places.append(z * scale)
        z += gaps.get(i, one.thickness)
        if one.nd is not None and one.vd is not None:
            index.append(index_by_abbe(one.nd, one.vd, wavelength))
        elif one.glass is not None:
            index.append(index_of(one.glass, wavelength))
        else:
            index.append(1.0 if one.index is None else one.index)
    return Traced(
        tuple(places),
        tuple(0.0 if one.radius is None else 1 / (one.radius * scale) for one in given.surfaces),
        tuple(one.conic for one in given.surfaces),
        tuple(tuple((p, a * scale ** (1 - p)) for p, a in one.asphere) for one in given.surfaces),
        tuple(openings.get(i, one.semi_diameter) * scale for i, one in enumerate(given.surfaces)),
        tuple(index),
        next(i for i, one in enumerate(given.surfaces) if one.stop),
    )


def _axial(lens: Traced, distance: float, heights: Real) -> tuple[Bundle, Real]:
    """Rays from a point on the axis through heights in the entrance pupil, and their path so far beyond the axis's."""
    zero = np.zeros(len(heights))
    position = np.stack([zero, heights, zero + lens.pupil], 1)
    if math.isinf(distance):
        return lens.trace(position, np.stack([zero, zero, zero + 1], 1)), zero
    length = np.hypot(heights, distance)
    direction = np.stack([zero, heights / length, distance / length], 1)
    return lens.trace(position, direction), heights**2 / (length + distance)


def _image(lens: Traced, distance: float) -> float:
    """Where the wavefront of an axial point has the least RMS over the pupil, evenly lit."""
    high = 2 * max(lens.opening)
    low = 0.0
    for _ in range(60):
        middle = (low + high) / 2
        bundle, _ = _axial(lens, distance, np.array([middle]))
        low, high = (middle, high) if bundle.height[0] <= 1 else (low, middle)
    nodes, weights = legendre(32)
    bundle, before = _axial(lens, distance, low * np.sqrt((nodes + 1) / 2))

    exit_pupil = lens.exit_pupil()

    def spread(z: float) -> float:
        centre = np.array([0.0, 0.0, z])
        along = ((centre - bundle.position) * bundle.direction).sum(1)
        # To the sphere about the image through the middle of the exit pupil.
        radius = z - exit_pupil
        miss = ((centre - bundle.position) ** 2).sum(1) - along**2
        path = (
            before + bundle.path + along + math.copysign(1.0, radius) * miss / (np.sqrt(radius**2 - miss) + abs(radius))
        )
        mean = (weights * path).sum() / 2
        return float((weights * (path - mean) ** 2).sum() / 2)

    # Rays near the axis say where to look.
    near, _ = _axial(lens, distance, np.array([low * 0.3]))
    start = float(near.position[0, 2] - near.position[0, 1] * near.direction[0, 2] / near.direction[0, 1])
    ends = (start - 0.03 * lens.focal_length, start + 0.03 * lens.focal_length)
    found = minimize_scalar(spread, bounds=ends, method="bounded", options={"xatol": 1e-11})
    return float(found.x)
