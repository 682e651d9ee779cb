"""The judge's rays and traced lenses on what has a closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.special import j0

from tapetum.bench import PrescriptionLens
from tapetum.bench.load import scene_from_dict
from tapetum.optics.grid import Grid
from tapetum.simulate.pupil_fits import fit_pupils
from tapetum.simulate.traced_light import followed, traced_scene

from .plane import Plane
from .quadrature import Complex, Real
from .rays import Traced, focused, index_by_abbe, index_of
from .thin import Beam, Effort, ThinLens
from .thin import amplitudes as thin_amplitudes
from .traced import rim_curvatures, traced_amplitudes
from .way import Probe

WAVELENGTH, PROBE = 640e-9, 0.1
LIGHT = Beam(WAVELENGTH, (0.0, 0.0))
SECTION = "The judge of the 200 scenes"


def amplitudes(
    pixels: Real,
    plane: Plane,
    name: str = "la1509",
    focal_length: float = 0.02,
    f_number: float = 12.0,
    distance: float = math.inf,
) -> Complex:
    """Of a plano-convex lens at f/12, f = 20 mm: next to a perfect one; or of another."""
    target = {
        "lens": {
            "kind": "prescription",
            "name": name,
            "focal_length": focal_length,
            "f_number": f_number,
            "design_wavelength": WAVELENGTH,
        },
        "object_distance": distance,
    }
    probe = {"lens": {"focal_length": PROBE, "aperture_radius": 0.01}}
    scene = scene_from_dict({"schema": "tapetum/scene/1", "distance": 1.0, "target": target, "probe": probe})
    return traced_amplitudes(scene, LIGHT, plane, Probe(PROBE), pixels, Effort())


def test_indices_are_the_makers_own() -> None:
    # SCHOTT's data sheets: n_d of N-BK7 and N-SF11; by n_d and V alone it is known to 1e-4.
    assert index_of("N-BK7", 587.562e-9) == pytest.approx(1.5168, abs=1e-5)
    assert index_of("N-SF11", 587.562e-9) == pytest.approx(1.78472, abs=1e-5)
    assert index_by_abbe(1.5168, 64.17, 640e-9) == pytest.approx(index_of("N-BK7", 640e-9), abs=1e-4)


def test_one_surface_images_a_point_without_error() -> None:
    # A conic of constant -1/n² from air to glass focuses parallel light to a point n R/(n - 1) behind it: Descartes.
    n, radius = 1.5, 10e-3
    lens = Traced((0.0,), (1 / radius,), (-1 / n**2,), ((),), (5e-3,), (1.0, n), 0)
    heights = np.linspace(0.5e-3, 4e-3, 8)
    zero = np.zeros(8)
    rays = lens.trace(np.stack([zero, heights, zero - 1e-3], 1), np.stack([zero, zero, zero + 1], 1))
    focus = n * radius / (n - 1)
    way = (focus - rays.position[:, 2]) / rays.direction[:, 2]
    assert np.abs(rays.position[:, 1] + way * rays.direction[:, 1]).max() < 1e-12
    total = rays.path + n * way
    assert np.ptp(total) < 1e-12


def test_an_asphere_is_where_its_polynomial_says() -> None:
    lens = Traced((1e-3,), (50.0,), (0.3,), (((4, 2e4), (6, -3e8)),), (5e-3,), (1.0, 1.0), 0)
    rays = lens.trace(np.array([[1.2e-3, -0.7e-3, 0.0]]), np.array([[0.0, 0.0, 1.0]]))
    r2 = 1.2e-3**2 + 0.7e-3**2
    sag = 50 * r2 / (1 + math.sqrt(1 - 1.3 * 2500 * r2)) + 2e4 * r2**2 - 3e8 * r2**3
    assert rays.position[0, 2] == pytest.approx(1e-3 + sag, abs=1e-14)


def test_a_nearly_perfect_traced_lens_is_a_thin_one(validated) -> None:
    radius = 0.02 / 24
    ring = WAVELENGTH * PROBE / (2 * radius)
    x = np.array([0.0, 0.5, 1.0, 1.5]) * ring
    pixels = np.stack([x, 0.3 * x], 1)
    thin = np.abs(thin_amplitudes(ThinLens(0.02, radius), LIGHT, Plane(0.02), Probe(PROBE), pixels)) ** 2
    traced = np.abs(amplitudes(pixels, Plane(0.0))) ** 2
    error = float(np.abs(traced - thin).max() / thin.max())
    validated(SECTION, "a plano-convex lens at f/12 by rays, head on", error, 1e-3, "a thin lens, by the judge")


@pytest.mark.parametrize("distance", [0.2, pytest.param(0.08, marks=pytest.mark.slow)])
def test_edges_stand_in_the_image_of_the_stop(distance: float, validated) -> None:
    """Collins's integral from the pupil to the mirror and back by Gaussian numbers, of a lens next to telecentric.

    With edges sharp one focal length before the sensor, as those of a thin lens are, it differs by up to 0.1.
    """
    name, focal, number = "cmount-12mm-f1.4", 3.8e-3, 8.0
    lens = PrescriptionLens(name, focal_length=focal, f_number=number, design_wavelength=WAVELENGTH)
    near, far = (focused(lens, WAVELENGTH, one) for one in (distance, math.inf))
    moved = near.image - far.image
    # The pupil lies q behind the front focus: there and back again from it, [[a, b], [c, a]].
    q = focal**2 / (far.image - far.exit_pupil())
    a, b = -1 - 2 * moved * q / focal**2, 2 * q + 2 * moved * q**2 / focal**2
    # 1000 nodes in 25 pieces; ten pieces give the same to 1e-14.
    nodes, weights = np.polynomial.legendre.leggauss(40)
    nodes = ((np.arange(25)[:, None] * 2 + 1 + nodes) / 25 - 1).ravel()
    weights = np.tile(weights / 25, 25)
    radius = focal / (2 * number)
    e, area = (nodes + 1) / 2 * radius, weights * (nodes + 1)
    k = 2 * math.pi / WAVELENGTH
    chirp = np.exp(1j * k * a / (2 * b) * e**2)
    field = [(chirp * area * j0(k * e * one / b)).sum() for one in e]
    expected = abs((chirp * np.array(field) * area).sum() * k * radius**2 / (4 * b)) ** 2 / 4
    ideal = (math.pi * radius**2 / (WAVELENGTH * PROBE)) ** 2
    found = abs(amplitudes(np.zeros((1, 2)), Plane(0.0), name, focal, number, distance)[0]) ** 2 / ideal
    what = f"a defocused traced lens head on, x_d = {distance:g} m"
    validated(SECTION, what, abs(found - expected), 0.01, "Collins's integral", "of a sharp mirror's peak")


@pytest.mark.parametrize(
    ("name", "focal_length", "f_number"),
    [("phone-f", None, 5.2), ("compact-6mm-f1.9", None, 2.0), ("cmount-12mm-f1.4", 3.8e-3, 1.6)],
)
def test_the_engine_bends_the_light_of_the_rim_as_rays_from_there_do(
    name: str, focal_length: float | None, f_number: float, validated
) -> None:
    """Not as from the stop's paraxial image: there it is 0.003, 0.035 and 0.15 less."""
    given = {} if focal_length is None else {"focal_length": focal_length}
    lens = PrescriptionLens(name, f_number=f_number, design_wavelength=WAVELENGTH, **given)
    engine = lens.focused(WAVELENGTH, math.inf)
    fits = fit_pupils(engine, 0.02)
    scene = traced_scene(engine, fits, Grid(5, 5, 1e-5), wavelength=WAVELENGTH, probe_focal_length=PROBE)
    light = followed(scene, 0.05).fits
    expected = rim_curvatures(focused(lens, WAVELENGTH, math.inf), np.zeros(2), 8)
    error = float(np.abs(light.bend / expected - 1).max())
    validated(SECTION, f"curvature of the rim's light, {name} f/{f_number:g}", error, 1e-3,
              "the judge's rays from its stop", "relative")  # fmt: skip


def test_planes_of_a_traced_lens_differ_in_phase_by_their_path() -> None:
    middle = np.zeros((1, 2))
    for index, depth in ((1.0, 10e-6), (1.8, 12.34e-6)):
        layer = Plane(0.0, path=2 * index * depth, depth=depth, index=index)
        turned = amplitudes(middle, layer)[0] / amplitudes(middle, Plane(0.0))[0]
        # The way beyond the axis's own: rays at f/12 meet the nearer plane under up to 1/24, half of that squared.
        expected = np.exp(-2j * math.pi / WAVELENGTH * 2 * index * depth)
        assert abs(np.angle(turned / expected)) < 2 * math.pi / WAVELENGTH * depth / index / 24**2 * 1.2
