"""Light that each probe sends to points of the room, its return from a camera there, and how even both are."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from tapetum.bench import Illumination, Probe, Scene, Target, ThinLens
from tapetum.bench.scene import STEEPEST
from tapetum.errors import InputError
from tapetum.simulate.budget import link_budget
from tapetum.simulate.constellation.room import Array, Constellation, between, points_of
from tapetum.simulate.exposure import most_electrons, readout_variance
from tapetum.simulate.radiometry import dark_electrons

__all__ = ["Evenness", "OverlapLaw", "Signals", "coverage", "evenness", "irradiance", "overlap_law", "signal"]

# Lattice of links: distances a doubling, tilts a unit of their sine; and the most links computed one by one.
_A_DOUBLING, _A_SINE, _FEW = 16, 100, 200
_WIDE = 1.0


def coverage(constellation: Constellation, points: npt.ArrayLike, *, margin: float = 0.0) -> npt.NDArray[np.bool_]:
    """Which probes light, and so see, which points: bool, [N, P].

    Parameters
    ----------
    constellation
        P probes.
    points
        [N, 3], in metres.
    margin
        Metres by which the cones are taken wider (negative: narrower), square to their edge.
    """
    depth, reach, half = _geometry(constellation, points)
    across = np.sqrt(np.maximum(reach**2 - depth**2, 0.0))
    # A billionth for rounding: a narrow cone must contain its axis.
    edge = depth * np.tan(half) + margin / np.cos(half) + 1e-9 * reach
    return (depth > 0) & (across <= edge)


def irradiance(
    constellation: Constellation, points: npt.ArrayLike, facing: npt.ArrayLike | None = None, *, margin: float = 0.0
) -> Array:
    """Irradiance from each probe, [N, P] in W/m²; its sum over the last axis is the illumination.

    As in `radiometry.irradiance_at_target` the power spreads evenly over the lit disc of radius z tan(divergence/2)
    square to the beam's axis, at the depth z along it; so the flux density along a ray at the angle γ from the axis is
    P/(π z² tan²(divergence/2) cosγ), and its integral over any plane that cuts the whole cone is P.

    Parameters
    ----------
    constellation, points, margin
        As for `coverage`.
    facing
        Unit normals [N, 3] or [3] of a surface turned to the probes. None: square to each ray, the largest irradiance
        of an eye or a camera there.
    """
    depth, reach, half = _geometry(constellation, points)
    power = np.array([probe.power for probe in constellation.probes])
    lit = coverage(constellation, points, margin=margin)
    safe = np.where(lit, depth, 1.0)
    flux = np.where(lit, power * reach / (math.pi * safe**3 * np.tan(half) ** 2), 0.0)
    return flux if facing is None else flux * _cosine(constellation, points, facing)


@dataclass(frozen=True)
class Signals:
    """Signals of each probe's sensor from a camera at each point, all [N, P].

    Parameters
    ----------
    electrons
        Mean photo-electrons of the RR in a frame.
    noise
        Variance in electrons² apart from the RR's shot noise: background, dark current, readout and rounding, over the
        RR's pixels.
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
        """SNR of all probes together, [N]: √Σ SNR², that of the best linear combination of their independent sums.

        A probe that does not see the camera adds nothing.
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

    Every pair of a point and a probe is a scene with a `link_budget`: the sensor's reflectance in the mirror's
    direction, layers, overlap of the pupils, the part of the return inside the probe's aperture, and the sensor's
    noise. Layers' own returns and higher orders are not counted, as there. Many pairs are interpolated from a lattice
    of distances and tilts, within 2 % where it is bright.

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
    reach = paraxial_reach(constellation, target, points)
    lens, sensor = target.lens, constellation.sensor
    sine = np.zeros_like(reach)
    if facing is not None:
        sine = np.sqrt(np.clip(1 - np.clip(_cosine(constellation, points, facing), 0.0, 1.0) ** 2, 0.0, 1.0))
    lit = irradiance(constellation, points, margin=margin)
    area = math.pi * lens.aperture_radius**2
    count, pixels, full = (np.zeros_like(reach) for _ in range(3))
    for p, probe in enumerate(constellation.probes):
        optics = Probe(ThinLens(probe.focal_length, probe.aperture_radius), sensor, probe.transmission)
        links = _links(target, optics, constellation.wavelength, reach[:, p], sine[:, p])
        # A beam narrower than the aperture enters whole.
        entering = np.minimum(lit[:, p], probe.power / (area * np.sqrt(1 - sine[:, p] ** 2).clip(1e-9)))
        count[:, p], full[:, p] = links[:, 0] * entering, links[:, 1] * entering
        # Near the cut-off the return's spread diverges.
        pixels[:, p] = np.minimum(np.exp(links[:, 2]), math.prod(sensor.pixels))
    dark = dark_electrons(sensor)
    noise = pixels * max(dark + readout_variance(sensor), 1e-12)
    return Signals(count, noise, pixels, full > most_electrons(sensor) - dark)


def paraxial_reach(constellation: Constellation, target: Target, points: npt.ArrayLike) -> Array:
    """Distances of points and probes, [N, P]; InputError where a point is too near for a paraxial return."""
    reach = _geometry(constellation, points)[1]
    if (reach < 10 * target.lens.focal_length).any():
        raise InputError(
            f"a point is {reach.min():.3g} m from a probe", where="points", remedy="keep ten focal lengths away"
        )
    return reach


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
    # Any beam wider than the aperture gives the same link.
    light = Illumination("diverging", wavelength, 1.0, _WIDE)
    turned = replace(target, rotation=(math.asin(sine), 0.0))
    found = link_budget(Scene(distance=reach, target=turned, probe=probe, illumination=light))
    lit = found.irradiance_at_target
    return found.electrons / lit, found.peak_electrons / lit, math.log(found.rr_pixels)


def _geometry(constellation: Constellation, points: npt.ArrayLike) -> tuple[Array, Array, Array]:
    """Depth along each axis and range, [N, P] in metres, and the half angles [P]."""
    ray, axes = _rays(constellation, points)
    half = np.array([probe.divergence / 2 for probe in constellation.probes])
    return np.einsum("npi,pi->np", ray, axes), np.linalg.norm(ray, axis=-1), half


def _rays(constellation: Constellation, points: npt.ArrayLike) -> tuple[Array, Array]:
    places = np.array([probe.position for probe in constellation.probes])
    axes = np.array([probe.direction for probe in constellation.probes])
    return points_of(points, "points")[:, None] - places, axes


def _cosine(constellation: Constellation, points: npt.ArrayLike, facing: npt.ArrayLike) -> Array:
    """Cosine between `facing` and the way to each probe, [N, P]; 0 where it is behind."""
    ray, _ = _rays(constellation, points)
    normal = np.broadcast_to(points_of(np.atleast_2d(facing), "facing"), (len(ray), 3))
    length = np.linalg.norm(normal, axis=1)
    if (np.abs(length - 1) > 1e-6).any():
        raise InputError(
            f"has length {length[np.argmax(abs(length - 1))]:g}", where="facing", remedy="give unit vectors"
        )
    reach = np.maximum(np.linalg.norm(ray, axis=-1), np.finfo(np.float64).tiny)
    return np.maximum(-np.einsum("npi,ni->np", ray, normal) / reach, 0.0)


@dataclass(frozen=True)
class Evenness:
    """Smallest, largest and mean of a quantity over a volume; `ratio` is largest over smallest."""

    low: float
    high: float
    mean: float

    @property
    def ratio(self) -> float:
        return self.high / self.low if self.low > 0 else math.inf


def evenness(values: npt.ArrayLike) -> Evenness:
    """Evenness of finite, non-negative `values`."""
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
    """Illumination and SNR of n(d) = (d/nearest)^exponent equal, overlapping, diverging beams, in closed form.

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
    between("nearest", nearest, 0, math.inf)
    between("electrons_nearest", electrons_nearest, 0, math.inf)
    between("noise", noise, 0, math.inf, low_too=True)
    d = np.asarray(distance, dtype=np.float64)
    if d.size == 0 or not np.isfinite(d).all() or (d < nearest).any():
        raise InputError(f"reaches below {nearest:g} m or is not finite", where="distance", remedy="start there")
    beams = (d / nearest) ** exponent
    fall = (nearest / d) ** 2
    each = electrons_nearest * fall
    return OverlapLaw(beams, beams * fall, beams * fall, np.sqrt(beams * each**2 / (each + noise)))
