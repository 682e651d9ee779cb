"""The judge on what has a closed form, and each of its shorter ways on the plain sum that it stands for."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import j1

from tapetum.bench.load import scene_from_dict

from .judge import judge, pixel_places
from .plane import Cells, Mask, Plane, Rectangle, points
from .quadrature import Real, cardinals, legendre, phasor, region_weights
from .thin import Beam, Effort, ThinLens, _Kernel, amplitudes
from .way import Probe, _at_aperture, plain_sum

WAVELENGTH, FOCAL, RADIUS, PROBE = 640e-9, 8e-3, 0.8e-3, 0.1
K = 2 * math.pi / WAVELENGTH
RING = WAVELENGTH * PROBE / (2 * RADIUS)
LENS = ThinLens(FOCAL, RADIUS)
SECTION = "The judge of the 200 scenes"


def beam(tilt: tuple[float, float] = (0.0, 0.0), curvature: float = 0.0) -> Beam:
    return Beam(WAVELENGTH, (math.sin(tilt[0]), math.sin(tilt[1])), curvature)


def cross(half: float, count: int) -> Real:
    """A cross of places on the probe's sensor."""
    line = np.linspace(-half, half, count)
    zero = np.zeros(count)
    return np.concatenate([np.stack([line, zero], 1), np.stack([zero, line], 1), np.stack([line, 0.7 * line], 1)])


def square(half: float, count: int) -> tuple[Real, float]:
    line = np.linspace(-half, half, count)
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel()], 1), (line[1] - line[0]) ** 2


def irradiance(plane: Plane, light: Beam, pixels: Real, probe: Probe | None = None, **other: Any) -> Real:
    return np.abs(amplitudes(other.pop("lens", LENS), light, plane, probe or Probe(PROBE), pixels, **other)) ** 2


def close(one: Real, other: Real) -> float:
    """Largest difference over the other's peak."""
    return float(np.abs(one - other).max() / other.max())


def test_disc_weights_integrate_a_wave_exactly() -> None:
    nodes, weights = legendre(60)[0] * 2, region_weights(60, 2.0)
    for turn in (3.0, 9.0, 18.0):
        found = (weights * np.cos(turn * nodes)[None, :]).sum()
        assert abs(found - 4 * math.pi * j1(2 * turn) / turn) < 1e-9 * 4 * math.pi


def test_weights_of_a_region_hold_its_area_and_moments() -> None:
    # The half disc x < 0: area π/2, mean of x -4/(3π).
    weights = region_weights(40, 1.0, lambda v: (-np.sqrt(np.maximum(1 - v**2, 0)), 0 * v), 400)
    nodes = legendre(40)[0]
    assert abs(weights.sum() - math.pi / 2) < 1e-9
    assert abs((weights * nodes[None, :]).sum() + 2 / 3) < 1e-9


def test_focused_head_on_is_airys(validated) -> None:
    pixels = cross(4 * RING, 31)
    v = math.pi * np.hypot(*pixels.T) / RING
    airy = np.where(v > 0, 2 * j1(v) / np.where(v > 0, v, 1), 1) ** 2
    peak = (math.pi * RADIUS**2 / (WAVELENGTH * PROBE)) ** 2
    small = close(irradiance(Plane(FOCAL), beam(), pixels, effort=Effort(1, 2)), airy * peak)
    # The edge's diffraction over 2z is real: it goes with the root of the Fresnel number.
    wide = ThinLens(4 * FOCAL, 4 * RADIUS)
    large = close(irradiance(Plane(4 * FOCAL), beam(), pixels / 4, lens=wide), airy * peak * 256)
    validated(SECTION, "focused, head on, f/5, r²/λz = 125", small, 0.06, "Airy's pattern")
    validated(SECTION, "focused, head on, f/5, r²/λz = 500", large, 0.03, "Airy's pattern")
    assert large == pytest.approx(small / 2, rel=0.2)


@pytest.mark.parametrize("degrees", [0.0, 2.0, 4.0])
def test_power_is_the_overlap_of_two_pupils_and_their_cosine(degrees: float, validated) -> None:
    tilt = math.radians(degrees)
    lens = ThinLens(FOCAL, 2 * RADIUS)
    ring = RING / 2
    pixels, area = square(24 * ring, 97)
    found = irradiance(Plane(FOCAL), beam((0.0, tilt)), pixels, lens=lens).sum() * area
    apart = FOCAL * math.tan(tilt) / (2 * RADIUS)
    share = 2 / math.pi * (math.acos(apart) - apart * math.sqrt(1 - apart**2))
    closed = math.pi * (2 * RADIUS) ** 2 * math.cos(tilt) * share
    # What lies beyond 24 rings: 1.2 % of an Airy pattern, more of a narrower pupil's.
    what = f"power that returns at {degrees:g}°, in focus, within 24 rings"
    validated(SECTION, what, abs(1 - found / closed), 0.03, "π r² cosθ times the overlap of discs", "of it")


def test_nothing_returns_beyond_the_displacement_of_the_pupil() -> None:
    pixels = cross(6 * RING, 21)
    head_on = irradiance(Plane(FOCAL), beam(), pixels).max()
    within = irradiance(Plane(FOCAL), beam((0.0, math.atan(0.9 * RADIUS / FOCAL))), pixels).max()
    beyond = irradiance(Plane(FOCAL), beam((0.0, math.atan(1.1 * RADIUS / FOCAL))), pixels).max()
    assert within > 1e-3 * head_on
    assert beyond < 1e-4 * head_on


def test_leaving_light_meets_at_half_of_xd_plus_f(validated) -> None:
    # Exit curvature 2/(x_d + f): a pinhole on the axis sees most light there; large Fresnel numbers shift it little.
    far = 0.15
    z = 1 / (1 / FOCAL - 1 / far)
    middle = np.zeros((1, 2))
    distances = np.linspace(0.07, 0.09, 7)
    seen = [
        float(irradiance(Plane(z), beam(), middle, Probe(PROBE, d, 20e-6), effort=Effort(1, 0.7))[0]) for d in distances
    ]
    top = int(np.argmax(seen))
    bend = np.polyfit(distances[top - 1 : top + 2], seen[top - 1 : top + 2], 2)
    best = -bend[1] / (2 * bend[0])
    validated(SECTION, "where leaving light meets", abs(best / ((far + FOCAL) / 2) - 1), 0.02, "(x_d + f)/2", "of it")


def test_reciprocity(validated) -> None:
    z = 1 / (1 / FOCAL - 1 / 0.4)
    tilt, plane = np.array([0.01, -0.02]), Plane(z, tilt=(0.01, 0.004))
    worst = []
    for pixel in np.array([[3.0, 1.0], [-2.0, 4.0]]) * RING:
        there = irradiance(plane, Beam(WAVELENGTH, tuple(tilt)), pixel[None])[0]
        back = irradiance(plane, Beam(WAVELENGTH, tuple(tilt - pixel / PROBE)), -pixel[None])[0]
        worst.append(abs(there / back - 1))
    # Sines and tangents are distinguished in one direction only; to this order the two pixels see the same.
    validated(SECTION, "I(q; s) = I(-q; s - q/f_p), sensor tilted", max(worst), 5e-3, "reciprocity", "of it")


def test_a_sensor_that_faces_the_light_sends_it_straight_back(validated) -> None:
    tilt = 0.05
    tangent = math.tan(tilt)
    # At its spot z tanθ the sensor must be in focus: z - a·u0 with a = -tanθ.
    plane = Plane(FOCAL * (1 + tangent**2), tilt=(0.0, -tangent))
    pixels = cross(3 * RING, 15)
    head_on = irradiance(Plane(FOCAL), beam(), pixels)
    facing = irradiance(plane, beam((0.0, tilt)), pixels * [1, 1 / math.cos(tilt)])
    validated(
        SECTION, "a sensor tilted to face the light", close(facing / math.cos(tilt) ** 2, head_on), 0.02, "head on"
    )


def test_a_layer_is_a_mirror_nearer_to_the_lens() -> None:
    pixels = cross(20 * RING, 21)
    one = irradiance(Plane(FOCAL - 1e-4, path=3e-4), beam((0.01, 0.02)), pixels)
    other = irradiance(Plane(FOCAL - 1e-4), beam((0.01, 0.02)), pixels)
    assert close(one, other) < 1e-9


def test_what_fits_the_probe_does_not_depend_on_the_distance(validated) -> None:
    pixels = cross(3 * RING, 15)
    far = irradiance(Plane(FOCAL), beam((0.01, 0.02)), pixels)
    near = irradiance(Plane(FOCAL), beam((0.01, 0.02)), pixels, Probe(PROBE, 0.3, 3e-3))
    # The aperture takes the rings beyond the 25th.
    validated(SECTION, "over 0.3 m through a wide aperture", close(near, far), 1e-2, "the far field")


def test_the_way_through_the_aperture_is_the_plain_sum() -> None:
    generator = np.random.default_rng(1)
    x, a = legendre(9)[0] * 1.5e-3, legendre(7)[0] * 4e-3
    field = generator.normal(size=(9, 9)) + 1j * generator.normal(size=(9, 9))
    for sine in (0.0, 0.3):
        short = _at_aperture(field, x, a, sine, K, 0.3)
        plain = plain_sum(field, x, a, sine, K, 0.3)
        assert np.abs(short - plain).max() < 1e-8 * np.abs(plain).max()


@pytest.mark.parametrize(
    "pattern", [None, Cells((0.0, 0.0), 5e-6, 3e-6, None, 0.5, np.ones((1, 1)), K, (2e-5, 2e-6, 0.01))]
)
def test_the_way_to_a_tilted_plane_is_the_plain_sum(pattern: Cells | None) -> None:
    tilt = np.array([0.08, -0.05])
    plane = Plane(FOCAL, tilt=(0.08, -0.05), pattern=pattern)
    found = points(plane, np.array([2e-4, 1e-4]), 1.2e-5, 1e-5, 1e5, 1.0)
    assert found is not None
    x = legendre(11)[0] * RADIUS
    generator = np.random.default_rng(2)
    field = generator.normal(size=(11, 11)) + 1j * generator.normal(size=(11, 11))
    short = _Kernel.of(found, plane, tilt, K, RADIUS)
    u, v = found.u.ravel(), np.repeat(found.v, found.u.shape[1])
    away = plane.distance + tilt[0] * u + tilt[1] * v
    px, py = (one.ravel() for one in np.meshgrid(x, x))
    wave = phasor(K * ((u[:, None] - px) ** 2 + (v[:, None] - py) ** 2) / (2 * away[:, None]))
    wave *= (phasor(K * (away - FOCAL)) / (1j * WAVELENGTH * away))[:, None]
    plain = (wave @ field.ravel()) * found.weights.ravel()
    plain = (wave.T @ plain).reshape(11, 11)
    there_and_back = short.back(short.there(field, x), x)
    assert np.abs(there_and_back - plain).max() < 1e-8 * np.abs(plain).max()


def test_a_region_turned_by_polynomials_is_itself() -> None:
    nodes = legendre(30)[0]
    places = np.linspace(-0.9, 0.9, 7)
    assert np.abs(cardinals(30, places) @ np.exp(5j * nodes) - np.exp(5j * places)).max() < 1e-9


def test_arrays_that_have_closed_forms() -> None:
    pixels, light = cross(5 * RING, 11), beam((0.001, 0.002))
    edge = Rectangle((0.0, 0.0), (96e-6, 96e-6))
    mirror = irradiance(Plane(FOCAL, edge=edge), light, pixels)
    ones = np.ones((1, 1))

    def of(**values: Any) -> Real:
        cells = Cells((-48e-6, -48e-6), 4e-6, 3e-6, None, 1.0, ones, K)
        return irradiance(Plane(FOCAL, edge=edge, pattern=replace(cells, **values)), light, pixels)

    # Photosites that differ in nothing from what surrounds them, square and round, with lenses that do not bend.
    assert close(of(), mirror) < 1e-4
    assert close(of(side=None, radius=1.5e-6, lens=(1e3, 1.5e-6, 0.0), pitch=8e-6), mirror) < 1e-4
    # A pitch below λN/2 sends no order back but the mean's.
    site = 0.49
    fine = of(pitch=1.2e-6, side=1.2e-6 * math.sqrt(site), surround=0.3j)
    assert close(fine, mirror * abs(site + 0.3j * (1 - site)) ** 2) < 1e-4
    colours = np.array([[1.0, 0.5], [0.25, 0.0]])
    fine = of(pitch=0.8e-6, side=0.8e-6, tiles=colours)
    assert close(fine, mirror * colours.mean() ** 2) < 1e-4


def test_a_mask_of_ones_is_a_mirror_of_its_size() -> None:
    pixels, light = cross(5 * RING, 11), beam((0.004, 0.002))
    size = 200e-6
    # Linear from 1 to 0 over the outer pitch: as wide as a mirror of 200 um, but for its edge.
    mask = Mask(np.ones((200, 200), np.complex128), 1e-6)
    edge = Rectangle((0.0, 0.0), (size, size))
    mirror = irradiance(Plane(FOCAL, edge=edge), light, pixels)
    assert close(irradiance(Plane(FOCAL, pattern=mask), light, pixels), mirror) < 1e-3


def test_a_mask_is_linear_between_its_points() -> None:
    values = np.arange(6.0).reshape(2, 3) * (1 + 0.5j)
    mask = Mask(values, 2.0, (10.0, 0.0))
    assert mask(np.array([10.0]), np.array([-1.0]))[0] == pytest.approx(values[0, 1])
    assert mask(np.array([11.0]), np.array([0.0]))[0] == pytest.approx(values[:, 1:].mean())
    assert mask(np.array([13.0]), np.array([1.0]))[0] == pytest.approx(values[1, 2] / 2)
    assert mask(np.array([14.1]), np.array([1.0]))[0] == 0


def test_irradiance_follows_power_and_distance() -> None:
    scene = {
        "schema": "tapetum/scene/1",
        "distance": 1.0,
        "illumination": {"mode": "diverging", "divergence": 0.02, "power": 1e-3, "vergence": 0.0},
        "target": {"lens": {"focal_length": FOCAL, "aperture_radius": RADIUS}, "object_distance": 1.0},
        "probe": {"lens": {"focal_length": PROBE, "aperture_radius": 0.01}},
    }
    pixels = pixel_places(np.array([127.0, 130.0]), np.array([127.0, 120.0]), (256, 256), 2.2e-6)
    one = judge(scene_from_dict(scene), pixels, False)
    two = judge(scene_from_dict({**scene, "distance": 2.0}), pixels, False)
    assert two / one == pytest.approx([0.25, 0.25])
