"""Several probes whose signal and illumination stay even over a volume (paper, end of section 3).

A camera near the probes stands in few cones and answers each of them strongly; one far away stands in many and answers
each weakly. Here: what a set of probes does at given points, and the design of such a set.

Axes of a room: x across, y up, z away from the probes' wall, in metres. Arrays over N points and P probes are [N, P].
The lasers are independent of each other, so irradiances add. People in the way are not modelled.
"""

# SciPy types its solvers in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import isotonic_regression, linprog
from scipy.stats import qmc

from tapetum.bench import Illumination, Probe, ProbeSensor, Scene, Target, ThinLens
from tapetum.bench.scene import STEEPEST
from tapetum.errors import InputError
from tapetum.simulate.budget import link_budget
from tapetum.simulate.exposure import gain_of
from tapetum.simulate.radiometry import dark_electrons

__all__ = [
    "Constellation",
    "Design",
    "Evenness",
    "OverlapLaw",
    "PlacedProbe",
    "ProbeKit",
    "Rail",
    "Signals",
    "Volume",
    "coverage",
    "design",
    "evenness",
    "irradiance",
    "overlap_law",
    "signal",
    "single_probe",
]

Array = npt.NDArray[np.float64]
# Of the lattice of links: distances a doubling, tilts a unit of their sine; and links that are computed one by one.
_A_DOUBLING, _A_SINE, _FEW = 16, 100, 200
_WIDE = 1.0
Point = tuple[float, float, float]


@dataclass(frozen=True)
class PlacedProbe:
    """A probe somewhere in the room; what it sees is what it lights, a cone.

    Parameters
    ----------
    position
        In metres.
    direction
        Unit vector of the cone's axis.
    divergence
        Full angle of the cone, in radians, below π/2.
    power
        Of its laser, in watts.
    focal_length, aperture_radius
        Of its lens, in metres.
    transmission
        Power that the way back keeps.
    """

    position: Point
    direction: Point
    divergence: float
    power: float
    focal_length: float = 0.2
    aperture_radius: float = 0.0125
    transmission: float = 0.5

    def __post_init__(self) -> None:
        _points([self.position], "probe.position")
        length = float(np.linalg.norm(_points([self.direction], "probe.direction")[0]))
        if abs(length - 1) > 1e-6:
            raise InputError(f"has length {length:g}", where="probe.direction", remedy="give a unit vector")
        _between("probe.divergence", self.divergence, 0, math.pi / 2)
        _between("probe.power", self.power, 0, math.inf, low_too=True)
        _between("probe.focal_length", self.focal_length, 0, math.inf)
        _between("probe.aperture_radius", self.aperture_radius, 0, math.inf)
        _between("probe.transmission", self.transmission, 0, 1, high_too=True)


@dataclass(frozen=True)
class Constellation:
    """Probes that work together, with equal sensors and lasers of one wavelength (metres)."""

    probes: tuple[PlacedProbe, ...]
    sensor: ProbeSensor
    wavelength: float = 640e-9

    def __post_init__(self) -> None:
        if not self.probes:
            raise InputError("has no probe", where="constellation.probes", remedy="give at least one")
        _between("constellation.wavelength", self.wavelength, 200e-9, 2e-6)

    def scaled(self, factor: float) -> Constellation:
        """The same probes with `factor` times the power."""
        _between("factor", factor, 0, math.inf)
        return replace(self, probes=tuple(replace(one, power=factor * one.power) for one in self.probes))


@dataclass(frozen=True)
class Volume:
    """A box, sheared upwards by the rake of the floor; `look_at` is where its cameras point.

    Parameters
    ----------
    low, high
        Corners in metres; y is the height above the floor.
    rake
        Rise of the floor per metre of z, from `low`'s z on.
    look_at
        A point in metres, or None for cameras that turn to whichever probe looks at them.
    """

    low: Point
    high: Point
    rake: float = 0.0
    look_at: Point | None = None

    def __post_init__(self) -> None:
        low, high = _points([self.low], "volume.low")[0], _points([self.high], "volume.high")[0]
        if not (low < high).all():
            raise InputError(f"{self.high} is not above {self.low}", where="volume.high", remedy="swap or widen")
        _between("volume.rake", self.rake, -2, 2, low_too=True, high_too=True)
        if self.look_at is not None:
            _points([self.look_at], "volume.look_at")

    def place(self, fractions: npt.ArrayLike) -> Array:
        """Points [N, 3] in metres at `fractions` (0 to 1) of the box."""
        low = np.asarray(self.low)
        points = low + _points(fractions, "fractions") * (np.asarray(self.high) - low)
        points[:, 1] += self.rake * (points[:, 2] - low[2])
        return points

    def sample(self, count: int, seed: int = 0) -> Array:
        """Points [count, 3], spread evenly (scrambled Halton sequence); the same seed gives the same."""
        _whole("count", count)
        return self.place(qmc.Halton(3, rng=np.random.default_rng(seed)).random(count))

    def facing(self, points: npt.ArrayLike) -> Array | None:
        """Unit vectors [N, 3] from `points` to `look_at`; None where cameras turn to the probes."""
        if self.look_at is None:
            return None
        ray = np.asarray(self.look_at) - _points(points, "points")
        return ray / np.linalg.norm(ray, axis=1, keepdims=True)


def coverage(constellation: Constellation, points: npt.ArrayLike, *, margin: float = 0.0) -> npt.NDArray[np.bool_]:
    """Which probes light, and so see, which points.

    Parameters
    ----------
    constellation
        P probes.
    points
        [N, 3], in metres.
    margin
        Metres by which the cones are taken wider (negative: narrower), square to their edge.

    Returns
    -------
    numpy.ndarray
        bool, [N, P].
    """
    depth, reach, half = _geometry(constellation, points)
    across = np.sqrt(np.maximum(reach**2 - depth**2, 0.0))
    # A billionth is for rounding: the axis of a narrow cone must lie in it.
    edge = depth * np.tan(half) + margin / np.cos(half) + 1e-9 * reach
    return (depth > 0) & (across <= edge)


def irradiance(
    constellation: Constellation, points: npt.ArrayLike, facing: npt.ArrayLike | None = None, *, margin: float = 0.0
) -> Array:
    """Irradiance from each probe, in W/m²; its sum over the last axis is the illumination.

    As in `radiometry.irradiance_at_target` the power spreads evenly over the lit disc of radius z tan(divergence/2)
    square to the beam's axis, at the depth z along it; so the flux density along a ray at the angle γ from the axis
    is P/(π z² tan²(divergence/2) cosγ), and its integral over any plane that cuts the whole cone is P.

    Parameters
    ----------
    constellation, points, margin
        As for `coverage`.
    facing
        Unit normals [N, 3] or [3] of a surface turned to the probes. None: square to each ray, the most an eye or a
        camera there can get.

    Returns
    -------
    numpy.ndarray
        [N, P].
    """
    depth, reach, half = _geometry(constellation, points)
    power = np.array([probe.power for probe in constellation.probes])
    lit = coverage(constellation, points, margin=margin)
    safe = np.where(lit, depth, 1.0)
    flux = np.where(lit, power * reach / (math.pi * safe**3 * np.tan(half) ** 2), 0.0)
    return flux if facing is None else flux * _cosine(constellation, points, facing)


@dataclass(frozen=True)
class Signals:
    """What each probe's sensor gets from a camera at each point, all [N, P].

    Parameters
    ----------
    electrons
        Mean photo-electrons of the RR in a frame.
    noise
        Variance in electrons² of what is not the RR's own shot noise: background, dark current, readout and rounding,
        over the RR's pixels.
    pixels
        That the RR covers.
    saturated
        Where an evenly spread RR would overfill a pixel.
    """

    electrons: Array
    noise: Array
    pixels: Array
    saturated: npt.NDArray[np.bool_]

    @property
    def snr(self) -> Array:
        """Each probe's own, [N, P]: S/√(S + noise)."""
        return self.electrons / np.sqrt(self.electrons + self.noise)

    @property
    def combined(self) -> Array:
        """Of all probes together, [N]: √Σ SNR².

        What the best linear combination of the probes' independent sums reaches; a probe that does not see the camera
        adds nothing.
        """
        return np.sqrt((self.snr**2).sum(axis=1))


def signal(
    constellation: Constellation,
    target: Target,
    points: npt.ArrayLike,
    facing: npt.ArrayLike | None = None,
    *,
    margin: float = 0.0,
) -> Signals:
    """Photo-electrons a frame that a camera at each point returns to each probe.

    Every pair of a point and a probe is a scene whose `link_budget` says what returns: its sensor's reflectance in the
    mirror's direction, layers, overlap of the pupils, the part of the return inside the probe's aperture, and the
    sensor's noise. Layers' own returns and higher orders are not counted, as there. Of many pairs those on a lattice
    of distances and tilts are computed; what lies between is interpolated, within 2 % where it is bright.

    Parameters
    ----------
    constellation, points, margin
        As for `coverage`.
    target
        The camera; its own rotation is not used.
    facing
        Unit vectors [N, 3] or [3] where the cameras point. None: at the probe that looks.

    Raises
    ------
    InputError
        When a point is nearer to a probe than ten focal lengths of the target, where the paraxial return fails.
    """
    reach = _geometry(constellation, points)[1]
    lens, sensor = target.lens, constellation.sensor
    if (reach < 10 * lens.focal_length).any():
        raise InputError(
            f"a point is {reach.min():.3g} m from a probe", where="points", remedy="keep ten focal lengths away"
        )
    sine = np.zeros_like(reach)
    if facing is not None:
        sine = np.sqrt(np.clip(1 - np.clip(_cosine(constellation, points, facing), 0.0, 1.0) ** 2, 0.0, 1.0))
    lit = irradiance(constellation, points, margin=margin)
    area = math.pi * lens.aperture_radius**2
    count, pixels, full = (np.zeros_like(reach) for _ in range(3))
    for p, probe in enumerate(constellation.probes):
        optics = Probe(ThinLens(probe.focal_length, probe.aperture_radius), sensor, probe.transmission)
        links = _links(target, optics, constellation.wavelength, reach[:, p], sine[:, p])
        # A beam narrower than the aperture goes in whole.
        entering = np.minimum(lit[:, p], probe.power / (area * np.sqrt(1 - sine[:, p] ** 2).clip(1e-9)))
        count[:, p], full[:, p] = links[:, 0] * entering, links[:, 1] * entering
        # Near the cut-off what returns spreads without end.
        pixels[:, p] = np.minimum(np.exp(links[:, 2]), math.prod(sensor.pixels))
    most = min(sensor.full_well, (2**sensor.bits - 1 - sensor.offset) / gain_of(sensor)) - dark_electrons(sensor)
    one = dark_electrons(sensor) + sensor.read_noise**2 + 1 / (12 * gain_of(sensor) ** 2)
    return Signals(count, pixels * max(one, 1e-12), pixels, full > most)


def _links(target: Target, probe: Probe, wavelength: float, reach: Array, sine: Array) -> Array:
    """Electrons and those of the brightest pixel for 1 W/m², and the logarithm of the pixels, [N, 3]."""
    pairs = np.stack([np.log(reach) * _A_DOUBLING / math.log(2), sine * _A_SINE], 1)
    own, back = np.unique(np.stack([reach, sine], 1), axis=0, return_inverse=True)
    if len(own) <= _FEW:
        return np.array([_link(target, probe, wavelength, *map(float, one)) for one in own])[back.reshape(-1)]
    low = np.floor(pairs)
    part = pairs - low
    found = np.zeros((len(pairs), 3))
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        nodes, back = np.unique(low + corner, axis=0, return_inverse=True)
        values = [_link(target, probe, wavelength, 2 ** (a / _A_DOUBLING), b / _A_SINE) for a, b in nodes]
        weights = np.prod(np.where(corner, part, 1 - part), axis=1)
        found += weights[:, None] * np.array(values)[back.reshape(-1)]
    return found


@functools.lru_cache(maxsize=1 << 16)
def _link(target: Target, probe: Probe, wavelength: float, reach: float, sine: float) -> tuple[float, float, float]:
    """A row of `_links`."""
    steepest = math.sin(STEEPEST[target.lens.kind]) * (1 - 1e-9)
    if sine >= steepest:
        return 0.0, 0.0, 0.0
    # Any beam wider than the aperture: the link does not depend on the probe's own.
    light = Illumination("diverging", wavelength, 1.0, _WIDE)
    turned = replace(target, rotation=(math.asin(sine), 0.0))
    found = link_budget(Scene(distance=reach, target=turned, probe=probe, illumination=light))
    lit = found.irradiance_at_target
    return found.electrons / lit, found.peak_electrons / lit, math.log(found.rr_pixels)


@dataclass(frozen=True)
class Evenness:
    """Smallest, largest and mean of something over a volume; `ratio` is largest over smallest."""

    low: float
    high: float
    mean: float

    @property
    def ratio(self) -> float:
        return self.high / self.low if self.low > 0 else math.inf


def evenness(values: npt.ArrayLike) -> Evenness:
    """How even finite, non-negative `values` are."""
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0 or not np.isfinite(array).all() or (array < 0).any():
        raise InputError("must be finite and not negative, and at least one", where="values", remedy="check them")
    return Evenness(float(array.min()), float(array.max()), float(array.mean()))


@dataclass(frozen=True)
class OverlapLaw:
    """By distance: beams, illumination and summed signal, each 1 at the nearest, and the combined SNR."""

    beams: Array
    illumination: Array
    signal: Array
    snr: Array


def overlap_law(
    distance: npt.ArrayLike, nearest: float, electrons_nearest: float, noise: float, *, exponent: float = 2.0
) -> OverlapLaw:
    """What n(d) = (d/nearest)^exponent equal overlapping diverging beams do, in closed form.

    Each beam gives E ∝ 1/d² and, while the return fits the probe's aperture, S = S₀ (nearest/d)². So

        illumination, ΣS ∝ n/d²          constant for n ∝ d²
        SNR² = n S²/(S + B)              n S → constant for n ∝ d² where S ≫ B (shot noise)
                                         n S²/B → falls as 1/d² for n ∝ d² where S ≪ B (readout, stray light)

    Illumination, summed signal and SNR are constant at once under shot noise only. Against a constant noise B a
    constant SNR needs n ∝ d⁴, and then the illumination grows as d².

    Parameters
    ----------
    distance
        In metres, any shape, not below `nearest`.
    nearest
        Where one beam lights the camera, in metres.
    electrons_nearest
        S₀, in electrons a frame.
    noise
        B, variance in electrons² of a probe's noise other than the RR's shot noise.
    exponent
        Of the beams' number.
    """
    _between("nearest", nearest, 0, math.inf)
    _between("electrons_nearest", electrons_nearest, 0, math.inf)
    _between("noise", noise, 0, math.inf, low_too=True)
    d = np.asarray(distance, dtype=np.float64)
    if d.size == 0 or not np.isfinite(d).all() or (d < nearest).any():
        raise InputError(f"reaches below {nearest:g} m or is not finite", where="distance", remedy="start there")
    beams = (d / nearest) ** exponent
    fall = (nearest / d) ** 2
    each = electrons_nearest * fall
    return OverlapLaw(beams, beams * fall, beams * fall, np.sqrt(beams * each**2 / (each + noise)))


# --- design ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rail:
    """The line on which probes may stand: its ends in metres, how many mounts are tried, and the least spacing."""

    start: Point
    end: Point
    mounts: int = 5
    spacing: float = 0.1

    def __post_init__(self) -> None:
        _points([self.start, self.end], "rail")
        _whole("rail.mounts", self.mounts)
        _between("rail.spacing", self.spacing, 0, math.inf)
        if self.length <= 0:
            raise InputError("has no length", where="rail.end", remedy="give another end")

    @property
    def length(self) -> float:
        return math.dist(self.start, self.end)

    def at(self, along: npt.ArrayLike) -> Array:
        """Points [N, 3] at `along` [N] metres from the start."""
        along = np.asarray(along, dtype=np.float64)[:, None] / self.length
        return np.asarray(self.start) * (1 - along) + np.asarray(self.end) * along


@dataclass(frozen=True)
class ProbeKit:
    """What probes can be built of: the sensor, and a lens whose field is the cone.

    The shorter side of the sensor spans the cone, f = side/(2 tan(divergence/2)); the aperture is the largest that
    neither `aperture_radius` (metres) nor the fastest `f_number` forbids. So a wide probe has a small aperture.
    """

    sensor: ProbeSensor
    wavelength: float = 640e-9
    aperture_radius: float = 0.0125
    f_number: float = 1.4
    transmission: float = 0.5

    def __post_init__(self) -> None:
        _between("kit.aperture_radius", self.aperture_radius, 0, math.inf)
        _between("kit.f_number", self.f_number, 0, math.inf)

    def probe(self, position: npt.ArrayLike, aim: npt.ArrayLike, divergence: float, power: float = 1.0) -> PlacedProbe:
        """A probe at `position` whose cone of full angle `divergence` points to `aim`."""
        _between("divergence", divergence, 0, math.pi / 2)
        here, there = _points(np.stack([np.asarray(position), np.asarray(aim)]), "position, aim")
        ray = there - here
        if not ray.any():
            raise InputError("is the probe's own position", where="aim", remedy="aim elsewhere")
        focal = min(self.sensor.pixels) * self.sensor.pitch / (2 * math.tan(divergence / 2))
        aperture = min(self.aperture_radius, focal / (2 * self.f_number))
        x, y, z = (ray / np.linalg.norm(ray)).tolist()
        px, py, pz = here.tolist()
        return PlacedProbe((px, py, pz), (x, y, z), divergence, power, focal, aperture, self.transmission)

    def constellation(self, probes: Sequence[PlacedProbe]) -> Constellation:
        """These probes with the kit's sensor and wavelength."""
        return Constellation(tuple(probes), self.sensor, self.wavelength)


@dataclass(frozen=True)
class Design:
    """A constellation and how far it is from constant: illumination and SNR² were fitted to 1 ± `deviation`.

    The deviation of the illumination is that of cones narrower and wider by the margin, so it also bounds points that
    near a sample and aims that far off, up to the change of the range.
    """

    constellation: Constellation
    deviation: float
    candidates: int


def design(
    volume: Volume,
    target: Target,
    kit: ProbeKit,
    rail: Rail,
    *,
    cap: float,
    probes: int = 32,
    divergences: Sequence[float] = (0.35, 0.52, 0.79, 1.05, 1.4),
    aims: tuple[int, int] = (5, 10),
    samples: int = 500,
    margin: float = 0.4,
    snr_weight: float = 1.0,
    seed: int = 0,
) -> Design:
    """Choose number, places, aims, divergences and powers of probes so that illumination and SNR are even.

    Candidates are all mounts × aims × divergences. With their powers p ≥ 0 as unknowns, the illumination at the samples
    is linear, A p, and a linear program finds the p that minimises δ in 1 - δ ≤ A p ≤ 1 + δ; this is the least ratio
    of the largest to the smallest, (1 + δ)/(1 - δ). The cones' edges are sharp, so the lower bound takes them narrower
    by `margin` and the upper bound wider. SNR² = Σ g²p²/(gp + B) joins as Σ w p with w = g·S/(S + B) of the
    last solution, M - 2δ/weight ≤ Σ w p ≤ M + 2δ/weight around a free level M. Then few probes: re-weighted least sums
    (Candès, Wakin and Boyd, J. Fourier Anal. Appl. 14, 877 (2008)) thin the solution out, the strongest are
    spread along the rail by the least shifts that keep its spacing, and their powers are solved for again.

    Parameters
    ----------
    volume, target, kit, rail
        Where cameras are, what they are, what probes are made of and where they may stand.
    cap
        The illumination not to exceed at the samples, nor at twenty times as many other points, in W/m².
    probes
        At most so many.
    divergences
        Full angles to choose from, in radians.
    aims
        Points to aim at, across and in depth, at the volume's middle height.
    samples, margin
        How many points stand for the volume, and how far (metres) around them the cones' edges are kept off.
    snr_weight
        0 leaves the SNR free; 1 asks as much of it as of the illumination.
    seed
        Of the samples.

    Raises
    ------
    InputError
        When an argument is out of range, or no choice of these candidates lights every sample and the points between.
    """
    _between("cap", cap, 0, math.inf)
    _between("margin", margin, 0, math.inf, low_too=True)
    _between("snr_weight", snr_weight, 0, math.inf, low_too=True)
    for name, value in (("probes", probes), ("aims", min(aims)), ("samples", samples)):
        _whole(name, value)
    if (probes - 1) * rail.spacing > rail.length:
        raise InputError(
            f"{probes} do not fit on {rail.length:g} m", where="probes", remedy="take fewer or a longer rail"
        )
    points = volume.sample(samples, seed)
    across, deep = np.meshgrid(*((np.arange(n) + 0.5) / n for n in aims))
    goals = volume.place(np.stack([across.ravel(), np.full(across.size, 0.5), deep.ravel()], axis=1))
    along = (np.arange(rail.mounts) + 0.5) / rail.mounts * rail.length
    choices = [(t, goal, angle) for t in along.tolist() for goal in goals for angle in divergences]
    tried = kit.constellation([kit.probe(rail.at([t])[0], goal, angle) for t, goal, angle in choices])
    problem = _Problem(tried, target, points, volume.facing(points), margin, snr_weight, cap)
    power, deviation = problem.solve(np.arange(len(choices)))
    _lights_all(deviation, len(choices))
    power = problem.thin(power, deviation)
    chosen = np.flatnonzero(power > 1e-6 * power.max())
    chosen = chosen[np.argsort(-power[chosen])][:probes]
    # Neighbours on the rail keep their order, ties broken by where they aim.
    chosen = chosen[np.lexsort([[choices[i][1][0] for i in chosen], [choices[i][0] for i in chosen]])]
    steps = rail.spacing * np.arange(len(chosen))
    wanted = np.array([choices[i][0] for i in chosen])
    places = np.clip(isotonic_regression(wanted - steps).x, 0.0, max(rail.length - steps[-1], 0.0)) + steps
    spots = rail.at(places)
    built = [kit.probe(spot, choices[i][1], choices[i][2]) for spot, i in zip(spots, chosen, strict=True)]
    final = _Problem(kit.constellation(built), target, points, volume.facing(points), margin, snr_weight, cap)
    power, deviation = final.solve(np.arange(len(built)))
    _lights_all(deviation, len(built))
    power = final.capped(power)
    dense = irradiance(final.probes, volume.sample(20 * samples, seed + 1)) @ power
    if not (dense > 0).all():
        raise InputError(
            f"{(dense == 0).mean():.2g} of the volume is dark between the samples",
            where="design",
            remedy="take more samples or a wider margin",
        )
    power = power * min(1.0, cap / float(dense.max()))
    lit = [replace(probe, power=float(p)) for probe, p in zip(built, power, strict=True) if p > 1e-6 * power.max()]
    return Design(kit.constellation(lit), deviation, len(choices))


def single_probe(volume: Volume, kit: ProbeKit, position: Point, *, cap: float, seed: int = 0) -> Constellation:
    """The baseline: one diverging probe whose narrowest cone holds the volume and whose peak there is `cap` (W/m²).

    Raises
    ------
    InputError
        When the volume spans 90° or more from there.
    """
    corners = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0]), axis=-1).reshape(-1, 3)
    rays = volume.place(corners) - np.asarray(position)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    axis = rays.mean(axis=0)
    # Badoiu and Clarkson's walk to the middle of the smallest ball: a step of 1/n towards the farthest.
    for step in range(2, 2000):
        axis += (rays[np.argmin(rays @ axis)] - axis) / step
    axis /= np.linalg.norm(axis)
    half = math.acos(float(np.clip((rays @ axis).min(), -1.0, 1.0)))
    if half >= math.pi / 4:
        raise InputError("sees the volume under 90° or more", where="position", remedy="step back")
    one = kit.constellation([kit.probe(position, np.asarray(position) + axis, min(2 * half + 1e-6, 1.57))])
    points = np.concatenate([volume.place(corners), volume.sample(4000, seed)])
    return one.scaled(cap / float(irradiance(one, points).sum(axis=1).max()))


def _lights_all(deviation: float, count: int) -> None:
    if deviation >= 0.999:
        raise InputError(
            f"{count} probes of these angles leave a part of the volume dark",
            where="design",
            remedy="allow more probes, more aims or wider divergences",
        )


class _Problem:
    """The linear program over the powers of fixed probes of 1 W each."""

    def __init__(
        self,
        probes: Constellation,
        target: Target,
        points: Array,
        facing: Array | None,
        margin: float,
        snr_weight: float,
        cap: float,
    ) -> None:
        self.probes, self.cap, self.weight = probes, cap, snr_weight
        # Around 1 in the solver, whose tolerances are absolute.
        self.low = irradiance(probes, points, margin=-margin)
        self.high = irradiance(probes, points, margin=margin)
        self.unit = float(self.high.max()) or 1.0
        self.low, self.high = self.low / self.unit, self.high / self.unit
        seen = signal(probes, target, points, facing)
        self.gain, self.noise = seen.electrons, seen.noise

    def capped(self, power: Array) -> Array:
        """Powers in watts of which the largest illumination, with the wider cones, is the cap."""
        return power * (self.cap / (self.unit * float((self.high @ power).max())))

    def solve(self, chosen: npt.NDArray[np.intp], rounds: int = 3) -> tuple[Array, float]:
        """Relative powers of the `chosen` (zero elsewhere) and the deviation δ."""
        power, deviation = self._even(chosen, None)
        if self.weight > 0 and deviation < 0.999:
            for _ in range(rounds):
                power, deviation = self._even(chosen, self._rows(power))
        return power, deviation

    def thin(self, power: Array, deviation: float, slack: float = 0.03, rounds: int = 4) -> Array:
        """Powers of fewer probes, whose deviation is at most `slack` more."""
        rows = self._rows(power) if self.weight > 0 else None
        matrix, bound, columns = self._constraints(np.arange(len(power)), rows)
        bound = bound - matrix[:, columns] * (deviation + slack)
        matrix = matrix[:, :columns]
        weight = np.ones(columns)
        # The free level M costs nothing.
        weight[len(power) :] = 0
        for _ in range(rounds):
            found = linprog(weight, A_ub=matrix, b_ub=bound, method="highs").x
            if found is None:
                return power
            power = found[: self.low.shape[1]]
            weight[: len(power)] = 1 / (power / power.max() + 0.01)
        return power

    def _even(self, chosen: npt.NDArray[np.intp], rows: Array | None) -> tuple[Array, float]:
        matrix, bound, columns = self._constraints(chosen, rows)
        cost = np.zeros(columns + 1)
        cost[-1] = 1
        found = linprog(cost, A_ub=matrix, b_ub=bound, method="highs")
        if found.x is None or found.x[-1] >= 0.999:
            return np.zeros(self.low.shape[1]), 1.0
        power = np.zeros(self.low.shape[1])
        power[chosen] = found.x[: len(chosen)]
        return power, float(found.x[-1])

    def _constraints(self, chosen: npt.NDArray[np.intp], rows: Array | None) -> tuple[Array, Array, int]:
        """Unknowns: powers, M where the SNR counts, δ. Returns matrix, bound, and the number of unknowns before δ."""
        ones = np.ones((len(self.low), 1))
        zeros = [] if rows is None else [0 * ones]
        light = [np.hstack([self.high[:, chosen], *zeros, -ones]), np.hstack([-self.low[:, chosen], *zeros, -ones])]
        bound = [ones[:, 0], -ones[:, 0]]
        if rows is not None:
            part = rows[:, chosen]
            light += [np.hstack([part, -ones, -2 / self.weight * ones])]
            light += [np.hstack([-part, ones, -2 / self.weight * ones])]
            # M between a half and twice the last level, or darkness would be even too.
            free = np.zeros((2, light[0].shape[1]))
            free[:, -2] = 1, -1
            light.append(free)
            bound += [0 * ones[:, 0], 0 * ones[:, 0], np.array([2.0, -0.5])]
        return np.vstack(light), np.concatenate(bound), len(chosen) + len(zeros)

    def _rows(self, power: Array) -> Array:
        """SNR² per relative power of each probe, its own noise as at `power`; of mean 1 there."""
        watts = self.capped(power)
        # Probes that are off are judged as if they had the power of those that are on.
        usual = float(np.median(watts[watts > 1e-6 * watts.max()]))
        counts = self.gain * np.where(watts > 1e-6 * watts.max(), watts, usual)
        rows = self.gain * counts / (counts + self.noise)
        return rows / float((rows @ power).mean())


def _geometry(constellation: Constellation, points: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Depth along each axis and range, [N, P] in metres, and the half angles [P]."""
    ray, axes = _rays(constellation, points)
    half = np.array([probe.divergence / 2 for probe in constellation.probes])
    return np.einsum("npi,pi->np", ray, axes), np.linalg.norm(ray, axis=-1), half


def _rays(constellation: Constellation, points: npt.ArrayLike) -> tuple[Array, Array]:
    places = np.array([probe.position for probe in constellation.probes])
    axes = np.array([probe.direction for probe in constellation.probes])
    return _points(points, "points")[:, None] - places, axes


def _cosine(constellation: Constellation, points: npt.ArrayLike, facing: npt.ArrayLike) -> Array:
    """Cosine between `facing` and the way to each probe, [N, P]; 0 where it is behind."""
    ray, _ = _rays(constellation, points)
    normal = np.broadcast_to(_points(np.atleast_2d(facing), "facing"), (len(ray), 3))
    length = np.linalg.norm(normal, axis=1)
    if (np.abs(length - 1) > 1e-6).any():
        raise InputError(
            f"has length {length[np.argmax(abs(length - 1))]:g}", where="facing", remedy="give unit vectors"
        )
    reach = np.maximum(np.linalg.norm(ray, axis=-1), np.finfo(np.float64).tiny)
    return np.maximum(-np.einsum("npi,ni->np", ray, normal) / reach, 0.0)


def _points(values: npt.ArrayLike, where: str) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[1:] != (3,) or len(array) == 0:
        raise InputError(f"has shape {array.shape}", where=where, remedy="give [N, 3]")
    if not np.isfinite(array).all():
        raise InputError("is not finite", where=where, remedy="remove NaN and infinity")
    return array


def _between(
    where: str, value: float, low: float, high: float, *, low_too: bool = False, high_too: bool = False
) -> None:
    above = value >= low if low_too else value > low
    below = value <= high if high_too else value < high
    # Infinity passes no bound, and NaN no comparison.
    if not (above and below and math.isfinite(value)):
        remedy = f"give one {'from' if low_too else 'above'} {low:g} {'to' if high_too else 'and below'} {high:g}"
        raise InputError(f"is {value:g}", where=where, remedy=remedy)


def _whole(where: str, value: int) -> None:
    if value < 1:
        raise InputError(f"is {value}", where=where, remedy="give at least 1")
