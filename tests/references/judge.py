"""The judge: what a probe's pixels receive from a scene, by plain sums that share no code with the engine.

It reads a scene's numbers and calls nothing that computes light. Left out: scattered light and glints, which are
documented as incoherent approximations by rays.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from tapetum.bench import Layer, PrescriptionLens, Scene, TargetSensor, at_wavelength
from tapetum.bench.prescription import load_lens

from .plane import Cells, Mask, Plane, Rectangle
from .quadrature import Complex, Real, legendre
from .rays import index_of
from .thin import Beam, Effort, ThinLens, TooLargeError, amplitudes
from .traced import traced_amplitudes
from .way import Probe

__all__ = ["Effort", "TooLargeError", "judge", "pixel_places"]


def judge(scene: Scene, pixels: Real, finite: bool, effort: Effort | None = None) -> Real:
    """Irradiance in W/m² at places [Q, 2] in metres from the middle of the probe's sensor.

    Parameters
    ----------
    scene
        A camera as target, with a thin or a traced lens.
    pixels
        See `pixel_places`.
    finite
        Over the distance and through the probe's aperture; else to the far field.
    effort
        How much to sum; by the scene's accuracy where it is left out.
    """
    effort = effort or Effort.of(scene.sampling.accuracy)
    _check_focus(scene)
    probe_lens = scene.probe.lens
    probe = Probe(probe_lens.focal_length)
    if finite:
        probe = Probe(probe_lens.focal_length, scene.distance, probe_lens.aperture_radius)
    total = np.zeros(len(pixels))
    strength = scene.probe.transmission / (math.pi * _beam_radius(scene) ** 2)
    for wavelength, power in _spectrum(scene, effort):
        for sines, place, share in _directions(scene, wavelength, effort):
            beam = Beam(wavelength, sines, _curvature(scene), _beam_radius(scene))
            fields = [
                (plane.path, _field(scene, beam, plane, probe, pixels - place, effort))
                for plane in planes_of(scene, wavelength)
            ]
            total += strength * power * share * _summed(scene, fields)
    return total


def _check_focus(scene: Scene) -> None:
    """Refuse a lens that focuses otherwise than the judge's, which is moved as a whole."""
    lens = scene.target.lens
    if not isinstance(lens, PrescriptionLens) or math.isinf(scene.target.object_distance):
        return
    if (lens.focus or load_lens(lens.name).focus) != "unit":
        raise TooLargeError("the judge moves the whole lens to focus: this takes 'focus: unit'")


def pixel_places(columns: Real, rows: Real, pixels: tuple[int, int], pitch: float) -> Real:
    """Places [Q, 2] of pixels by column and row (0 is the upper left one's centre)."""
    return np.stack([(columns - (pixels[0] - 1) / 2) * pitch, (rows - (pixels[1] - 1) / 2) * pitch], 1)


def _field(scene: Scene, beam: Beam, plane: Plane, probe: Probe, pixels: Real, effort: Effort) -> Complex:
    lens = scene.target.lens
    if isinstance(lens, PrescriptionLens):
        return traced_amplitudes(scene, beam, plane, probe, pixels, effort)
    focal = lens.focal_length
    if lens.glass is not None:
        focal *= (index_of(lens.glass, lens.design_wavelength) - 1) / (index_of(lens.glass, beam.wavelength) - 1)
    return amplitudes(ThinLens(focal, lens.aperture_radius), beam, plane, probe, pixels, effort)


def _summed(scene: Scene, fields: list[tuple[float, Complex]]) -> Real:
    """Irradiance of planes, each pair of which interferes as far as its paths, there and back, let it."""
    total = np.zeros(len(fields[0][1])) if fields else np.zeros(0)
    for one, (path, field) in enumerate(fields):
        total += np.abs(field) ** 2
        for other_path, other in fields[:one]:
            total += _degree(scene, abs(path - other_path)) * 2 * (field * other.conj()).real
    return total


def _degree(scene: Scene, path: float) -> float:
    """Degree of coherence; what a bandwidth takes away shows in the sum over its wavelengths, until it has faded."""
    light = scene.illumination
    if light.bandwidth > 0 and path > 1.61 * light.wavelength**2 / light.bandwidth:
        return 0.0
    return 1.0 if light.coherence_length is None else max(0.0, 1 - path / light.coherence_length)


def planes_of(scene: Scene, wavelength: float) -> list[Plane]:
    """The planes that mirror, with the amplitude that reaches each and comes back from it."""
    sensor, found, passed = scene.target.sensor, list[Plane](), 1.0
    z = _sensor_distance(scene)
    for layer in sorted(sensor.layers, key=lambda one: -one.depth):
        reflectance = at_wavelength(layer.reflectance, wavelength)
        if reflectance > 0:
            found.append(
                Plane(
                    z - layer.depth / layer.index,
                    math.sqrt(reflectance) * passed,
                    2 * layer.index * layer.depth,
                    layer.tilt,
                    depth=layer.depth,
                    index=layer.index,
                )
            )
        passed *= _transmittance(layer, wavelength)
    if sensor.reflectance > 0:
        size = (sensor.pixels[0] * sensor.pitch, sensor.pixels[1] * sensor.pitch)
        middle = (-sensor.decentre[0], -sensor.decentre[1])
        found.append(
            Plane(
                z,
                math.sqrt(sensor.reflectance) * passed,
                0.0,
                sensor.tilt,
                Rectangle(middle, size),
                _pattern(sensor, middle, size, wavelength),
            )
        )
    return found


def _pattern(
    sensor: TargetSensor, middle: tuple[float, float], size: tuple[float, float], wavelength: float
) -> Cells | Mask | None:
    if sensor.mask is not None:
        return Mask.read(sensor.mask.file, sensor.mask.pitch, middle)
    array, lens = sensor.array, sensor.microlens
    if array is None and lens is None:
        return None
    pitch = sensor.pitch if array is None or array.pitch is None else array.pitch
    side, radius, surround, tiles = pitch, None, 1.0 + 0j, np.ones((1, 1))
    if array is not None:
        assert array.shape in ("square", "round"), array.shape
        round_sites = array.shape == "round"
        side = None if round_sites else pitch * math.sqrt(array.fill)
        radius = pitch * math.sqrt(array.fill / math.pi) if round_sites else None
        surround = math.sqrt(array.surround) * complex(math.cos(array.phase), math.sin(array.phase))
        if array.bayer is not None:
            tiles = np.sqrt(np.array(array.bayer).reshape(2, 2))
    corner = (middle[0] - size[0] / 2, middle[1] - size[1] / 2)
    lenses = None if lens is None else (lens.focal_length, lens.fill * pitch / 2, lens.shift)
    return Cells(corner, pitch, side, radius, surround, tiles, 2 * math.pi / wavelength, lenses, middle)


def _transmittance(layer: Layer, wavelength: float) -> float:
    """Power of one passage; there and back that is its amplitude, once."""
    if layer.transmittance is not None:
        return at_wavelength(layer.transmittance, wavelength)
    scattered = 0.0 if layer.diffuse is None else layer.diffuse.albedo
    return max(0.0, 1 - at_wavelength(layer.reflectance, wavelength) - scattered)


def _sensor_distance(scene: Scene) -> float:
    target = scene.target
    return 1 / (1 / target.lens.focal_length - 1 / target.object_distance)


def _beam_radius(scene: Scene) -> float:
    light = scene.illumination
    if light.mode == "diverging":
        assert light.divergence is not None
        return scene.distance * math.tan(light.divergence / 2)
    return scene.probe.lens.aperture_radius if light.diameter is None else light.diameter / 2


def _curvature(scene: Scene) -> float:
    light = scene.illumination
    if light.vergence is not None:
        return light.vergence
    return 0.0 if light.mode == "collimated" else 1 / scene.distance


def _lines(scene: Scene) -> list[tuple[float, float]]:
    light = scene.illumination
    return [(light.wavelength, light.power), *((line.wavelength, line.power) for line in light.lines)]


def _spectrum(scene: Scene, effort: Effort) -> Iterator[tuple[float, float]]:
    """Wavelengths and powers: each line a Gaussian of the bandwidth, by Gauss-Hermite points."""
    if scene.illumination.bandwidth == 0:
        yield from _lines(scene)
        return
    sigma = scene.illumination.bandwidth / (2 * math.sqrt(2 * math.log(2)))
    nodes, weights = np.polynomial.hermite.hermgauss(round(11 * effort.points))
    for middle, power in _lines(scene):
        for node, weight in zip(nodes, weights / weights.sum(), strict=True):
            yield middle + math.sqrt(2) * sigma * float(node), power * float(weight)


def _directions(scene: Scene, wavelength: float, effort: float) -> Iterator[tuple[tuple[float, float], Real, float]]:
    """Sines at the target, place of the return on the probe's sensor, and power, of every direction of the light.

    A beam that leaves the probe at an angle δ to its axis meets the target turned by it: angles add, not sines.
    """
    light = scene.illumination
    about_y, about_x = scene.target.rotation
    towards = _sines(about_y, about_x)
    beams = [(0.0, 0.0, 1.0)]
    if light.second_beam is not None and light.second_beam.ratio > 0:
        beams.append((*light.second_beam.angle, light.second_beam.ratio))
    for x, y, ratio in beams:
        for dx, dy, share in _source(scene, wavelength, effort):
            tangents = np.tan(np.array([x + dx, y + dy]))
            sines = _turned(np.array(towards), tangents)
            yield (float(sines[0]), float(sines[1])), -scene.probe.lens.focal_length * tangents, ratio * share


def _sines(about_y: float, about_x: float) -> tuple[float, float]:
    return math.sin(about_y), math.sin(about_x)


def _turned(sines: Real, tangents: Real) -> Real:
    """Sines of the direction L + e_1 t_1 + e_2 t_2 about L; e_1 and e_2 lie in the target's plane but for the tilt."""
    square = float(sines @ sines)
    if not tangents.any():
        return sines
    cosine = math.sqrt(1 - square)
    moved = tangents - (0.0 if square == 0 else (1 - cosine) / square * (tangents @ sines)) * sines
    return (sines + moved) / math.sqrt(1 + float(tangents @ tangents))


def _source(scene: Scene, wavelength: float, effort: Effort) -> list[tuple[float, float, float]]:
    """An even disc of directions: Gauss-Legendre points in the square of the radius, equal steps about it."""
    size = scene.illumination.source_size
    if size == 0:
        return [(0.0, 0.0, 1.0)]
    across = size / (wavelength / (2 * scene.target.lens.aperture_radius))
    rings, spokes = math.ceil(effort.points * (2 + 0.6 * across)), math.ceil(effort.points * (6 + 2.5 * across))
    nodes, weights = legendre(rings)
    found = []
    for node, weight in zip(nodes, weights, strict=True):
        away = size / 2 * math.sqrt((float(node) + 1) / 2)
        for i in range(spokes):
            turn = 2 * math.pi * (i + 0.5) / spokes
            found.append((away * math.cos(turn), away * math.sin(turn), float(weight) / 2 / spokes))
    return found
