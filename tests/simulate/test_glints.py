"""What a lens's own surfaces send back: closed forms of one surface and two, and waves off a plane mirror."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline
from traced_cases import along_y

from tapetum.bench import PrescriptionLens, Scene, Target, load_scene, with_values
from tapetum.bench.layers import Layer
from tapetum.bench.sensors import TargetSensor
from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens
from tapetum.optics.grid import Grid
from tapetum.optics.radial import disc_transform
from tapetum.optics.rays import Lens
from tapetum.simulate.budget import link_budget
from tapetum.simulate.camera import Camera
from tapetum.simulate.glints import Glints, GlintTable, glint_table, glint_tables
from tapetum.simulate.information import not_told
from tapetum.simulate.traced_information import TracedSlopes

SECTION = "Glints of lens surfaces"
WAVELENGTH, DISTANCE, APERTURE, FOCAL = 785e-9, 5.5, 5e-3, 0.1
PIXELS = Grid(160, 160, 2.2e-6)


@functools.cache
def focused(name: str) -> FocusedLens:
    return PrescriptionLens(name).focused(WAVELENGTH, math.inf)


@functools.cache
def tables_of(name: str) -> list[GlintTable]:
    return glint_tables(focused(name), WAVELENGTH)


def at(table: GlintTable, *degrees: float) -> tuple[torch.Tensor, torch.Tensor]:
    sines = torch.sin(torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))
    which, e, area = table.at(sines)
    assert which.tolist() == list(range(len(degrees)))
    return e, area


def glints(tables: list[GlintTable], reflectance: float = 1.0, output: Grid = PIXELS, accuracy: float = 1e-2) -> Glints:
    return Glints(
        tables,
        reflectance,
        output,
        wavelength=WAVELENGTH,
        distance=DISTANCE,
        probe_radius=APERTURE,
        probe_focal_length=FOCAL,
        accuracy=accuracy,
    )


def test_a_sphere_is_a_mirror_of_its_radius(validated: Any) -> None:
    """A first surface of radius R sends R²/4 a steradian, along the ray through its centre."""
    lens = focused("photo-50mm-f1.8")
    radius = 1 / float(lens.lens.curvature[0])
    degrees = (-7.0, 0.5, 4.0, 11.0)
    e, area = at(glint_table(lens, 0, WAVELENGTH), *degrees)
    centre = float(lens.lens.z[0]) + radius
    wanted = (lens.entrance_pupil - centre) * torch.tan(torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))
    validated(SECTION, "place of a sphere's glint", float((e - wanted).abs().max()) / radius, 1e-6, "its centre", "R")
    worst = float((area / (radius**2 / 4) - 1).abs().max())
    validated(SECTION, "brightness of a sphere's glint", worst, 1e-5, "R²/4", "relative")


def test_the_back_of_a_lens_is_a_mirror_seen_through_its_front(validated: Any) -> None:
    """LA1509 near its axis: parallel light through R1, t of glass, off the plane, and back, by 2 by 2 matrices."""
    lens = focused("la1509")
    n, power = float(lens.lens.index[1]), (float(lens.lens.index[1]) - 1) * float(lens.lens.curvature[0])
    thick = float(lens.lens.z[1] - lens.lens.z[0])
    # Refraction, there and back through the glass, refraction: what C makes of a height is an angle.
    once = torch.tensor([[1.0, 0.0], [-power, 1.0]], dtype=torch.float64)
    glass = torch.tensor([[1.0, 2 * thick / n], [0.0, 1.0]], dtype=torch.float64)
    bend = float((once @ glass @ once)[1, 0])
    _, area = at(glint_table(lens, 1, WAVELENGTH), 0.02)
    validated(
        SECTION, "brightness of LA1509's plane back", abs(float(area) * bend**2 - 1), 1e-4, "matrices", "relative"
    )


def test_a_lens_of_glass_has_a_glint_for_every_surface_in_air() -> None:
    doublet = tables_of("photo-50mm-f1.8")
    surfaces = focused("photo-50mm-f1.8").lens
    assert surfaces.stop not in [one.surface for one in doublet]
    # Plane plates before the sensor are its layers.
    phone = focused("phone-f")
    told = [one.surface for one in tables_of("phone-f")]
    assert len(phone.lens) - 1 not in told and len(phone.lens) - 2 not in told and 0 in told
    # The plane back of a lens is none.
    assert [one.surface for one in tables_of("la1509")] == [0, 1]


def test_each_glint_wanders_its_own_way_and_mirrored_gazes_have_mirrored_ones() -> None:
    tables = tables_of("phone-b")
    slopes: list[float] = []
    for table in tables:
        which, e, _ = table.at(along_y(0.5, 1.0)[:, 1])
        _, mirrored, _ = table.at(-along_y(0.5, 1.0)[:, 1])
        assert torch.allclose(torch.sort(e).values, torch.sort(-mirrored).values, atol=1e-9)
        if which.tolist() == [0, 1]:
            slopes.append(float(e[1] - e[0]))
    assert len(slopes) >= 8
    assert min(slopes) < 0 < max(slopes)


def test_a_glint_is_the_probe_s_aperture_out_of_focus(validated: Any) -> None:
    """All that the aperture takes of R dA/dΩ watts a steradian lands, in a disc of its shadow."""
    tables = tables_of("phone-b")[:1]
    one = glints(tables, 0.02, Grid(400, 400, 2.2e-6))
    sines = along_y(3.0)
    which, place, area = one.places(sines)
    assert which.tolist() == [0]
    image = one(sines)[0]
    wanted = 0.02 * float(area) * math.pi * APERTURE**2 / DISTANCE**2
    landed = float(image.sum()) * 2.2e-6**2
    validated(
        SECTION, "light of a glint on the probe's sensor", abs(landed / wanted - 1), 0.02, "its aperture", "relative"
    )
    moved = one(sines, torch.tensor([[44e-6, 0.0]], dtype=torch.float64))[0]
    assert torch.allclose(moved[:, 20:], image[:, :-20], atol=1e-6 * float(image.max()))
    y, x = (torch.arange(400) - 199.5) * 2.2e-6, (torch.arange(400) - 199.5) * 2.2e-6
    middle = float((image.sum(0) * x).sum() / image.sum()), float((image.sum(1) * y).sum() / image.sum())
    assert middle == pytest.approx(place[0].tolist(), abs=2e-7)


def test_only_rings_far_below_the_accuracy_are_left_out() -> None:
    tables, grid = tables_of("phone-b"), Grid(500, 500, 2.2e-6)
    tilts = along_y(3.0, 8.0)
    whole, drawn = (glints(tables, output=grid, accuracy=accuracy)(tilts) for accuracy in (1e-12, 0.1))
    count = len(tables)
    peak, apart = whole.amax((1, 2)), whole - drawn
    left, more = apart.amax((1, 2)) / peak, -apart.amin((1, 2)) / peak
    # Each glint may leave out a thousandth of the accuracy, of the brightest one's peak; what lies beyond one end of a
    # periodic picture comes in at the other, and is as faint.
    assert float(left.min()) > 0 and float(left.max()) < count * 1e-3 * 0.1
    assert float(more.max()) < 1e-3 * 0.1
    # Beside brighter light fewer rings count.
    beside = 30 * peak
    fewer = glints(tables, output=grid, accuracy=0.1)(tilts, None, beside)
    assert int((fewer > 0).sum()) < 0.5 * int((drawn > 0).sum())
    assert float(((whole - fewer).abs().amax((1, 2)) / beside).max()) < count * 3e-4 * 0.1


@pytest.mark.parametrize("grid", [Grid(241, 301, 2.2e-6), Grid(60, 45, 9e-6)], ids=["fine", "coarse"])
def test_glints_drawn_at_once_are_those_drawn_one_by_one(grid: Grid, validated: Any) -> None:
    """Against the profile of each glint at every pixel's distance; gazes of many glints, of few, and off the pixels."""
    tables = tables_of("phone-b")
    one = glints(tables, output=grid, accuracy=1e-2)
    sines = torch.cat([along_y(0.0, 3.0, 8.0, 80.0), along_y(5.0)])
    centres = 1e-4 * torch.tensor([[0, 0], [1.23, -2], [-0.7, 0.4], [0, 0], [4, 1]], dtype=torch.float64)
    k, finest = 2 * math.pi / WAVELENGTH, WAVELENGTH * FOCAL / (2 * APERTURE)
    values, step = disc_transform(APERTURE, k / (2 * DISTANCE), k / FOCAL, 2e-3, spacing=finest / 40)
    profile = np.abs(values) ** 2 / (DISTANCE * WAVELENGTH * FOCAL) ** 2
    drawn = CubicSpline(np.arange(len(values)) * step, profile)
    wanted = np.zeros((len(sines), grid.rows, grid.columns))
    which, places, areas = one.places(sines)
    for number, (x, y), area in zip(which.tolist(), places + centres[which], areas.tolist(), strict=True):
        across, down = grid.x().numpy() - float(x), grid.y().numpy() - float(y)
        wanted[number] += area * drawn(np.hypot(across[None, :], down[:, None]))
    # Where the brightest glint lies beside the pixels, only its rings are in the picture.
    peaks = profile.max() * torch.zeros(5, dtype=areas.dtype).scatter_reduce(0, which, areas, "amax").numpy()
    assert peaks[3] == 0 and not one(sines, centres)[3].any()
    lit = peaks > 0
    apart = np.abs(one(sines, centres).numpy() - wanted).max((1, 2))[lit] / peaks[lit]
    what = f"glints drawn at once on pixels of {grid.pitch * 1e6:g} um"
    validated(SECTION, what, float(apart.max()), 1.5e-4, "each glint's profile", "of the peak")


def test_glints_that_all_lie_beside_the_sensor_leave_it_dark() -> None:
    """As those of a phone's camera beside the one that a small sensor looks at."""
    one = glints(tables_of("phone-b"), output=Grid(64, 64, 2.2e-6))
    picture = one(along_y(0.0), torch.tensor([[0.05, 0.0]], dtype=torch.float64))
    assert picture.shape == (1, 64, 64) and not picture.any()


def mirror_scene(lens: PrescriptionLens, depth: float, **values: Any) -> Scene:
    """The bench of the phones with one camera, whose filter alone reflects, all of it."""
    scene = load_scene("phones")
    layers = (Layer(depth=depth, reflectance=1.0),) if depth else ()
    sensor = TargetSensor(pixels=(4000, 3000), pitch=1e-6, reflectance=0.0, layers=layers)
    light = replace(scene.illumination, second_beam=None)
    return replace(scene, target=Target(lens, DISTANCE, sensor=sensor), illumination=light, **values)


COATING = ((400e-9, 0.005), (785e-9, 0.02))
STEEPEST = math.sin(math.radians(13))


def coated(name: str) -> PrescriptionLens:
    return PrescriptionLens(name, coating=COATING)


@pytest.mark.parametrize(
    ("name", "depth"),
    [
        ("phone-e", 0.6e-3),
        pytest.param("phone-b", 0.6e-3, marks=pytest.mark.slow),
        pytest.param("phone-f", 0.66e-3, marks=pytest.mark.slow),
    ],
)
def test_waves_off_a_mirror_before_the_focus_are_its_glint(name: str, depth: float, validated: Any) -> None:
    """The double pass of waves off a plane mirror, over the distance, against the rays that meet it upright.

    Past the mirror's cut-off the lens's own glints are left, at the reflectance of the wavelength.
    """
    lens = coated(name)
    scene = mirror_scene(lens, depth)
    degrees = torch.tensor([[0.0, 2.0], [3.0, 0.0], [-3.0, 4.0], [7.0, -9.0]], dtype=torch.float64)
    sines = torch.sin(torch.deg2rad(degrees))
    image = Camera(scene, STEEPEST, output=PIXELS)(sines).double()
    at_focus = lens.focused(WAVELENGTH, DISTANCE)
    own = glints(glint_tables(at_focus, WAVELENGTH), 0.02, accuracy=scene.sampling.accuracy)(sines)
    scale = scene.probe.transmission * irradiance(scene)
    assert float(own[3].max()) > 0
    assert torch.allclose(image[3], own[3] * scale, rtol=1e-4, atol=1e-6 * float(own[3].max()) * scale)
    waves = image[:3] - own[:3] * scale
    rays = glints([glint_table(replace(at_focus, lens=with_mirror(at_focus, depth)), len(at_focus.lens), WAVELENGTH)])
    ray = rays(sines[:3]) * scale
    power = (waves.sum((1, 2)) / ray.sum((1, 2)) - 1).abs().max()
    validated(SECTION, f"power of a filter's return, {name}", float(power), 0.06, "rays", "relative")
    apart = (middles(waves) - middles(ray)).abs().max() / PIXELS.pitch
    validated(SECTION, f"place of a filter's return, {name}", float(apart), 0.6, "rays", "pixels")
    picture = (waves - ray).abs().amax((1, 2)) / waves.amax((1, 2))
    validated(SECTION, f"picture of a filter's return, {name}", float(picture.max()), 0.1, "rays")


def with_mirror(focused: FocusedLens, depth: float) -> Lens:
    """The lens with a plane behind it, before its sensor."""
    lens = focused.lens
    plane = torch.tensor([focused.image - depth], dtype=torch.float64)
    nothing, wide = torch.zeros(1, dtype=torch.float64), torch.full((1,), 3e-3, dtype=torch.float64)
    return replace(
        lens,
        z=torch.cat([lens.z, plane]),
        curvature=torch.cat([lens.curvature, nothing]),
        conic=torch.cat([lens.conic, nothing]),
        asphere=torch.cat([lens.asphere, nothing.expand(1, lens.asphere.shape[1])]),
        semi_diameter=torch.cat([lens.semi_diameter, wide]),
        index=torch.cat([lens.index, lens.index[-1:]]),
    )


def irradiance(scene: Scene) -> float:
    """Of the beam's even disc at the target, in W/m²."""
    light = scene.illumination
    assert light.divergence is not None
    return light.power / (math.pi * (scene.distance * light.divergence / 2) ** 2)


def middles(images: torch.Tensor) -> torch.Tensor:
    share = images / images.sum((1, 2), keepdim=True)
    x, y = PIXELS.x(), PIXELS.y()
    return torch.stack([(share.sum(1) * x).sum(-1), (share.sum(2) * y).sum(-1)], -1)


def test_glints_want_a_probe_of_finite_size() -> None:
    scene = with_values(mirror_scene(coated("phone-e"), 0.0), {"sampling.propagation": "far field"})
    with pytest.raises(InputError, match=r"sampling\.propagation: glints"):
        Camera(scene, STEEPEST, output=PIXELS)(along_y(1.0))


def test_glints_are_carried_over_the_distance_whatever_the_return() -> None:
    """A sensor in focus sends back no more than the probe's aperture takes: its lens's glints still do."""
    lens = "target.lens={kind: prescription, name: la1509, f_number: 16, coating: 0.01}"
    scene = load_scene("rotation", [lens, "probe.lens.aperture_radius=40 mm"])
    auto = with_values(scene, {"sampling.propagation": "auto"})
    bare = with_values(auto, {"target.lens.coating": 0.0})
    assert Camera(auto, 0.01, output=PIXELS).finite and not Camera(bare, 0.01, output=PIXELS).finite


def test_the_gradient_of_the_tilt_is_that_of_differences() -> None:
    one = glints(tables_of("phone-b")[:2])
    weights = torch.linspace(0, 1, PIXELS.columns, dtype=torch.float64)
    tilt = torch.tensor([[0.02, 0.05]], dtype=torch.float64, requires_grad=True)
    (one(tilt)[0] * weights).sum().backward()
    assert tilt.grad is not None
    step = 1e-5
    for axis in (0, 1):
        move = torch.zeros(1, 2, dtype=torch.float64)
        move[0, axis] = step
        with torch.no_grad():
            more, less = ((one(tilt + sign * move)[0] * weights).sum() for sign in (1, -1))
        assert float(tilt.grad[0, axis]) == pytest.approx(float(more - less) / (2 * step), rel=2e-2)


def test_limits_of_focus_are_refused_behind_a_coated_lens() -> None:
    """Its glints would be taken not to move."""
    scene = load_scene("rotation", ["target.lens.coating=0.01", "sampling.propagation=auto"])
    assert "lens surfaces" in (not_told(scene, "object_distance") or "")
    assert not_told(scene, "gaze_x") is None
    with pytest.raises(InputError, match="off lens surfaces"):
        TracedSlopes(scene, ["object_distance"], torch.zeros(1, 2))
    assert "the glints of the lens's surfaces are not counted" in link_budget(scene).notes


def test_a_coating_is_a_share() -> None:
    with pytest.raises(ValueError, match="out of range"):
        PrescriptionLens("phone-d", coating=1.2)
