"""Diffuse returns against power, the integral over every scattering point, speckle, and the paper's section 4.3."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from tapetum.errors import InputError
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.radial import spot_field
from tapetum.optics.sampling import DoublePassGeometry, plan_round, through_aperture
from tapetum.simulate.diffuse import corner, diffuse_profile, diffuse_return
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.speckle import speckle_return

WAVELENGTH, PROBE_FOCAL = 640e-9, 0.1
K = 2 * math.pi / WAVELENGTH
SECTION = "Diffuse returns"


def geometry(
    focal: float = 0.02, radius: float = 2e-3, distance: float = math.inf, curvature: float = 0.0
) -> DoublePassGeometry:
    """The lengths of a scene by its numbers."""
    z, _ = lens_numbers(focal, distance)
    return DoublePassGeometry(WAVELENGTH, radius, focal, z, PROBE_FOCAL, 1e-3, 0.0, curvature)


def every_point(
    g: DoublePassGeometry, distance: float, probe_radius: float, places: torch.Tensor, rings: int = 30
) -> torch.Tensor:
    """The irradiance at places along x for an albedo of 1: a sum over a grid of points of a sensor without spread.

    The field of each point comes through the lens, and the probe's aperture, as a wave.
    """
    z, bend = g.image_distance, 1 / g.image_distance - 1 / g.focal_length
    half = g.spot_radius + rings * g.airy_step
    side = 2 * math.ceil(2 * half / g.airy_step)
    sensor = Grid(side, side, 2 * half / side)
    v = sensor.x()
    spot, step = spot_field(WAVELENGTH, g.radius, z, g.curvature - 1 / g.focal_length, 1.5 * half)
    radiance = CubicSpline(np.arange(len(spot)) * step, np.abs(spot) ** 2 / math.pi)(torch.hypot(v[None], v[:, None]))
    pupil = disc_quadrature(g.radius, 200, 240)
    onto_sensor = MatrixFourier(pupil.x, pupil.y, v, v, K / z)
    wave = pupil.weights * phasor(K / 2 * bend * pupil.rho_squared())
    farthest = 1.1 * g.radius + distance * float(places.max()) / PROBE_FOCAL
    clipped = math.isfinite(probe_radius)
    edge, step = spot_field(WAVELENGTH, probe_radius, distance, 0.0, farthest) if clipped else (np.ones(8), 1.0)
    window = CubicSpline(np.arange(len(edge)) * step, edge)
    found: list[torch.Tensor] = []
    for q in places:
        angle = q / PROBE_FOCAL
        field = wave * phasor(-K * angle * pupil.x)
        if clipped:
            at = torch.hypot(pupil.x[None, :] + distance * angle, pupil.y[:, None])
            field = field * torch.from_numpy(window(at)) * phasor(K / (2 * distance) * at**2)
        found.append((onto_sensor(field).abs() ** 2 * torch.from_numpy(radiance)).sum())
    return torch.stack(found) * sensor.pitch**2 / (WAVELENGTH * z * PROBE_FOCAL) ** 2


@pytest.mark.parametrize(("distance", "spread"), [(math.inf, 0.0), (1.0, 0.0), (math.inf, 20e-6)])
def test_power_is_conserved(distance: float, spread: float, validated: Any) -> None:
    g = geometry(distance=distance)
    # Rings fall as the cube of their number: so many hold all but some tenths of a percent.
    output = Grid(501, 501, WAVELENGTH * PROBE_FOCAL / (2 * g.radius))
    image = diffuse_return(g, 2.0, math.inf, output, albedo=0.5, spread=spread, accuracy=1e-3)
    want = 0.5 * math.pi * g.radius**2 * (g.radius / g.image_distance) ** 2
    error = abs(float(image.sum()) * output.pitch**2 / want - 1)
    what = f"power, f = 20 mm, r = 2 mm, x_d = {distance:g} m, spread {spread * 1e6:g} µm, nothing clipped"
    validated(SECTION, what, error, 5e-3, "albedo π r² (r/z)²", "of the power")


@pytest.mark.parametrize(
    ("g", "distance", "probe_radius", "tolerance"),
    [
        (geometry(), 2.0, math.inf, 1e-3),
        (geometry(distance=1.0), 2.0, math.inf, 1e-3),
        (geometry(distance=2.0, curvature=0.5), 2.0, math.inf, 1e-3),
        (geometry(distance=0.3), 2.0, 4e-3, 0.03),
        (geometry(distance=0.3), 4.0, 4e-3, 0.03),
        (geometry(0.004, 1e-3, 0.3), 1.5, 6e-3, 0.04),
        (geometry(0.05, 3e-3, 1.0), 2.0, 4e-3, 0.05),
    ],
)
def test_against_the_sum_over_every_point(
    g: DoublePassGeometry, distance: float, probe_radius: float, tolerance: float, validated: Any
) -> None:
    clipped = math.isfinite(probe_radius)
    far = 1.3 * (probe_radius + g.radius) / distance if clipped else 2 * g.spot_radius / g.image_distance + 2e-3
    output = Grid(1, 24, far * PROBE_FOCAL / 24, (far * PROBE_FOCAL / 2, 0.0))
    ours = diffuse_return(g, distance, probe_radius, output, albedo=1.0)[0]
    theirs = every_point(g, distance, probe_radius, output.x())
    error = float((ours - theirs).abs().max() / theirs.max())
    focus = "∞" if g.image_distance == g.focal_length else f"{1 / (1 / g.focal_length - 1 / g.image_distance):.3g} m"
    probe = f"probe of {2e3 * probe_radius:g} mm at {distance:g} m" if clipped else "nothing clipped"
    lit = ", lit from 2 m" if g.curvature else ""
    what = f"irradiance, f = {g.focal_length * 1e3:g} mm, r = {g.radius * 1e3:g} mm, x_d = {focus}{lit}, {probe}"
    validated(SECTION, what, error, tolerance, "waves of every scattering point, summed")


def diameter(image: torch.Tensor, x: torch.Tensor, level: float) -> float:
    """Diameter where the image falls to a share of its plateau's mean, from a row that begins in the middle."""
    height = level * image[: len(image) // 2].mean()
    last = int(torch.nonzero(image > height).max())
    share = (image[last] - height) / (image[last] - image[last + 1])
    return 2 * float(x[last] + share * (x[last + 1] - x[last]))


def test_overfilling_return_takes_the_shape_of_the_probes_aperture(validated: Any) -> None:
    """The paper's diffuse returns (section 4.3): as large as the probe's aperture looks, and smaller from afar."""
    g, probe_radius = geometry(radius=0.3e-3), 6e-3
    sizes: list[float] = []
    for distance in (1.0, 2.0, 4.0, 8.0):
        wide = 1.5 * probe_radius / distance * PROBE_FOCAL
        output = Grid(1, 600, wide / 600, (wide / 2, 0.0))
        image = diffuse_return(g, distance, probe_radius, output, albedo=0.8, spread=0.4e-3)[0]
        # A lens of less than √(λd) is as good as a point: its shadow's edge lies at a quarter of the height.
        sizes.append(diameter(image, output.x(), 0.25))
        want = 2 * probe_radius * PROBE_FOCAL / distance
        what = f"diameter of the diffuse RR, d = {distance:g} m, r = 0.3 mm, probe of 12 mm"
        validated(SECTION, what, abs(sizes[-1] / want - 1), 0.05, "D_p f_p/d", "of the diameter")
    slope = float(np.polyfit(np.log([1, 2, 4, 8]), np.log(sizes), 1)[0])
    what = "exponent of the diffuse RR's diameter over d = 1 to 8 m"
    validated(SECTION, what, abs(slope + 1), 0.03, "-1", "absolute")


def test_specular_return_keeps_its_size(validated: Any) -> None:
    """The other half of section 4.3, for the same lens and probe."""
    g = geometry()
    output = Grid(48, 48, 4e-6)
    images = [
        RoundPass(
            g,
            plan_round(through_aperture(g, distance, 12e-3)),
            output,
            distance=distance,
            probe_radius=12e-3,
            dtype=torch.complex128,
        )(torch.zeros(1, 2, dtype=torch.float64))[0]
        for distance in (1.0, 4.0)
    ]
    error = float((images[0] - images[1]).abs().max() / images[0].max())
    what = "specular RR at d = 1 m and 4 m, f = 20 mm, r = 2 mm, probe of 24 mm"
    validated(SECTION, what, error, 0.02, "each other")


def test_a_filter_before_the_sensor_also_shows_the_probes_aperture(validated: Any) -> None:
    """So a size that falls as 1/d does not prove scattering: the filter's mirror image diverges by itself."""
    z, _ = lens_numbers(0.004, math.inf)
    g = DoublePassGeometry(WAVELENGTH, 1e-3, 0.004, z - 0.3e-3, PROBE_FOCAL, 1e-3)
    probe_radius = 6e-3
    for distance in (1.0, 2.0):
        wide = 1.5 * probe_radius / distance * PROBE_FOCAL
        output = Grid(1, 300, wide / 300, (wide / 2, 0.0))
        plan = plan_round(through_aperture(g, distance, probe_radius), 1e-2)
        passing = RoundPass(g, plan, output, distance=distance, probe_radius=probe_radius)
        image = passing(torch.zeros(1, 2, dtype=torch.float64))[0, 0].double()
        # A shadow's edge in coherent light lies at a quarter of the height.
        size = diameter(image, output.x(), 0.25)
        # Light diverges from a point some centimetres from the lens: to a probe focused at infinity, a disc.
        want = 2 * probe_radius * PROBE_FOCAL / distance
        what = f"diameter of a specular filter's RR, 0.3 mm before f = 4 mm, r = 1 mm, d = {distance:g} m"
        validated(SECTION, what, abs(size / want - 1), 0.06, "D_p f_p/d", "of the diameter")


@pytest.mark.parametrize(("probe_radius", "name"), [(math.inf, "nothing clipped"), (4e-3, "probe of 8 mm at 2 m")])
def test_speckle_averages_to_the_expectation(probe_radius: float, name: str, validated: Any) -> None:
    g, count = geometry(radius=1e-3), 150
    wide = 4e-3 / 2 * PROBE_FOCAL
    # A pixel's distance apart speckles are other speckles.
    output = Grid(9, 9, 1.6 * wide / 9)
    options: dict[str, Any] = {"albedo": 0.5, "spread": 40e-6}
    patterns = speckle_return(g, 2.0, probe_radius, output, seed=7, count=count, rings=10, **options)
    want = diffuse_return(g, 2.0, probe_radius, output, **options)
    level = float((patterns.mean(0) / want).mean() - 1)
    what = f"mean of {count} speckle patterns over 81 pixels, f = 20 mm, r = 1 mm, spread 40 µm, {name}"
    validated(SECTION, what, abs(level), 0.04, "the expectation", "of the mean")
    one = float(((patterns.mean(0) / want - 1) ** 2).mean().sqrt()) * math.sqrt(count)
    what = f"noise of that mean times √{count}, {name}"
    validated(SECTION, what, abs(one - 1), 0.15, "1 (negative exponential)", "absolute")


def test_speckle_is_fully_developed(validated: Any) -> None:
    g = geometry(radius=1e-3)
    output = Grid(7, 7, 60e-6)
    patterns = speckle_return(g, 2.0, math.inf, output, albedo=0.5, spread=20e-6, seed=3, count=300, rings=8)
    scaled = (patterns / patterns.mean(0)).flatten()
    validated(SECTION, "contrast of 14 700 speckle samples", abs(float(scaled.std()) - 1), 0.05, "1", "absolute")
    brighter = abs(float((scaled > 1).double().mean()) - math.exp(-1))
    validated(SECTION, "share of speckle brighter than its mean", brighter, 0.02, "1/e", "absolute")


def test_speckle_repeats_by_its_seed() -> None:
    args = (geometry(radius=0.5e-3), 2.0, 3e-3, Grid(8, 8, 2e-5))
    one, same, other = (speckle_return(*args, albedo=0.5, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.allclose(one, other)


def test_linear_in_the_albedo_and_round() -> None:
    g, output = geometry(distance=0.5), Grid(33, 33, 12e-6)
    dim, bright = (diffuse_return(g, 2.0, 4e-3, output, albedo=a, spread=1e-5) for a in (0.2, 0.8))
    assert torch.allclose(4 * dim, bright, rtol=1e-12)
    assert torch.allclose(bright, bright.flip(0), rtol=1e-9)
    assert torch.allclose(bright, bright.T, rtol=1e-9)
    assert torch.equal(diffuse_return(g, 2.0, 4e-3, output, albedo=0.0), torch.zeros(33, 33, dtype=torch.float64))


def test_centre_moves_the_image() -> None:
    g, output = geometry(), Grid(33, 33, 12e-6)
    still = diffuse_return(g, 2.0, math.inf, output, albedo=0.5)
    moved = diffuse_return(g, 2.0, math.inf, output, albedo=0.5, centre=(36e-6, -24e-6))
    assert torch.allclose(moved[:-2, 3:], still[2:, :-3], rtol=1e-6, atol=1e-6 * float(still.max()))


@pytest.mark.parametrize("probe_radius", [4e-3, math.inf])
def test_a_profile_serves_every_place_within_its_reach(probe_radius: float) -> None:
    g, output, pitch = geometry(distance=0.5), Grid(33, 33, 12e-6), 12e-6
    profile = diffuse_profile(g, 2.0, probe_radius, corner(output) + pitch, albedo=0.5, spread=1e-5)
    for centre in ((0.0, 0.0), (0.4 * pitch, -0.3 * pitch), (-0.5 * pitch, 0.5 * pitch)):
        alone = diffuse_return(g, 2.0, probe_radius, output, albedo=0.5, spread=1e-5, centre=centre)
        apart = float((profile.on(output, centre) - alone).abs().max())
        assert apart < 1e-4 * float(alone.max())


def test_a_narrow_beam_lights_a_wider_spot() -> None:
    """What a beam of half the aperture scatters leaves through all of it; as an aperture of its own it would not."""
    g, output = geometry(), Grid(201, 201, 16e-6)
    narrow, full = (diffuse_return(g, 2.0, math.inf, output, albedo=0.5, lit_radius=lit) for lit in (1e-3, None))
    assert float(narrow.sum() / full.sum()) == pytest.approx(0.25, rel=0.02)
    patterns = speckle_return(g, 2.0, math.inf, Grid(1, 1, 1e-6), albedo=0.5, lit_radius=1e-3, seed=2, count=300)
    assert float(patterns.mean()) == pytest.approx(float(narrow.max()), rel=0.2)


def test_pixels_larger_than_the_image_keep_its_power(validated: Any) -> None:
    g = geometry()
    output = Grid(9, 9, 400e-6)
    image = diffuse_return(g, 2.0, math.inf, output, albedo=0.5)
    want = 0.5 * math.pi * g.radius**2 * (g.radius / g.image_distance) ** 2
    error = abs(float(image.sum()) * output.pitch**2 / want - 1)
    validated(SECTION, "power on pixels 25 times the Airy ring's width", error, 0.02, "albedo π r² (r/z)²",
              "of the power")  # fmt: skip


def test_a_layer_is_a_plane_of_its_own() -> None:
    g, output = geometry(), Grid(33, 33, 12e-6)
    layer = diffuse_return(g, 2.0, math.inf, output, albedo=0.5, image_distance=0.0195)
    direct = DoublePassGeometry(WAVELENGTH, g.radius, g.focal_length, 0.0195, PROBE_FOCAL, 1e-3)
    assert torch.equal(layer, diffuse_return(direct, 2.0, math.inf, output, albedo=0.5))
    assert float(layer.max()) < 0.1 * float(diffuse_return(g, 2.0, math.inf, output, albedo=0.5).max())


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"distance": 0.0}, "distance"),
        ({"distance": math.nan}, "distance"),
        ({"probe_radius": -1.0}, "probe_radius"),
        ({"probe_radius": math.nan}, "probe_radius"),
        ({"albedo": 1.5}, "albedo"),
        ({"albedo": math.nan}, "albedo"),
        ({"spread": -1e-6}, "spread"),
        ({"image_distance": math.inf}, "image_distance"),
        ({"accuracy": 0.0}, "accuracy"),
        ({"centre": (math.nan, 0.0)}, "centre"),
    ],
)
def test_refuses_what_cannot_be(change: dict[str, Any], field: str) -> None:
    good: dict[str, Any] = {"distance": 2.0, "probe_radius": 4e-3, "output": Grid(4, 4, 1e-5), "albedo": 0.5}
    with pytest.raises(InputError, match=field):
        diffuse_return(geometry(), **{**good, **change})


def test_speckle_refuses_what_it_cannot_hold() -> None:
    with pytest.raises(InputError, match="speckle"):
        speckle_return(geometry(), 2.0, 0.05, Grid(4, 4, 1e-5), albedo=0.5, seed=1)
    with pytest.raises(InputError, match="count"):
        speckle_return(geometry(), 2.0, 4e-3, Grid(4, 4, 1e-5), albedo=0.5, seed=1, count=0)
    with pytest.raises(InputError, match="rings"):
        speckle_return(geometry(), 2.0, 4e-3, Grid(4, 4, 1e-5), albedo=0.5, seed=1, rings=math.nan)
