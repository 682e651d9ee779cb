"""The round pass against closed forms, other methods, and its own gradients."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import j0, roots_legendre

from tapetum.bench import Scene, load_scene, with_values
from tapetum.optics import grid_sampling
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.propagate import fresnel
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.sampling import (
    DoublePassGeometry,
    RoundEffort,
    disc_overlap,
    plan_round,
    plan_round_with,
    through_aperture,
)
from tapetum.simulate import Camera, DoublePass
from tapetum.simulate.foreshortening import flattest
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.surfaces import Order, Surface

WAVELENGTH, PROBE_FOCAL = 640e-9, 0.2
K = 2 * math.pi / WAVELENGTH
PAPER = "r = 3 mm, f = 100 mm"


def geometry(
    focal: float = 0.1, radius: float = 3e-3, distance: float = math.inf, sine: float = 0.0, **other: float
) -> DoublePassGeometry:
    """The lengths of a scene by its numbers."""
    z, _ = lens_numbers(focal, distance)
    return replace(DoublePassGeometry(WAVELENGTH, radius, focal, z, PROBE_FOCAL, 4e-4, sine), **other)


def sines(*degrees: tuple[float, float]) -> torch.Tensor:
    """Sines of tilts about y and about x."""
    return torch.sin(torch.deg2rad(torch.tensor(degrees, dtype=torch.float64)))


def along(degrees: float) -> torch.Tensor:
    """Sines of a tilt in a direction of its own."""
    sine = math.sin(math.radians(degrees))
    return torch.tensor([[0.6 * sine, -0.8 * sine]], dtype=torch.float64)


def without_phase(field: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """The field times the one phase that brings it nearest to another."""
    overlap = (field.conj() * like).sum()
    return field * (overlap / overlap.abs())


@pytest.mark.parametrize("accuracy", [1e-2, 1e-3])
def test_a_tiny_lens_head_on(accuracy: float, validated: Any) -> None:
    """The plane's integral in closed form leaves two of the aperture, each of one radius."""
    f, r, z = 66e-6, 19.5e-6, 240e-6
    output = Grid(25, 25, 1.5e-3)
    g = DoublePassGeometry(WAVELENGTH, r, f, z, 0.06, 18e-3 * math.sqrt(2))
    found = RoundPass(g, plan_round(g, accuracy), output)(torch.zeros(1, 2, dtype=torch.float64))[0].double().numpy()
    x, weights = roots_legendre(400)
    x, weights = (x + 1) / 2 * r, weights / 2 * r
    lens = np.exp(0.5j * K * x**2 * (1 / (2 * z) - 1 / f)) * weights * x
    leaving = lens * (j0(K / (2 * z) * np.outer(x, x)) @ lens)
    places = np.hypot(output.x().numpy(), output.y().numpy()[:, None]).ravel()
    field = 2 * math.pi**2 / (WAVELENGTH**2 * z * g.probe_focal_length) * (
        leaving @ j0(K / g.probe_focal_length * np.outer(x, places))
    )  # fmt: skip
    want = (np.abs(field) ** 2).reshape(found.shape)
    error = np.abs(found - want).max() / want.max()
    what = f"r = 20 µm, f = 66 µm, x_d = 90 µm, accuracy {accuracy:g}"
    validated("Double pass", what, error, 0.1 * accuracy, "two Hankel transforms")


@pytest.mark.parametrize(
    ("distance", "tilt"), [(math.inf, (0.0, 0.0)), (5.0, (0.0, 0.5)), (1.0, (0.4, 0.9)), (0.6, (0.0, 0.0))]
)
def test_fields_against_the_sampled_sensor(distance: float, tilt: tuple[float, float], validated: Any) -> None:
    """Two ways that share no grid: through a table of one radius, and through a sampled sensor plane."""
    g = geometry(distance=distance, sine=math.sin(math.radians(math.hypot(*tilt))))
    output = Grid(48, 48, 10e-6)
    at = sines(tilt)
    ours = RoundPass(g, plan_round(g, 1e-4), output, dtype=torch.complex128).field(at)[0]
    # About as fine as the ladder's finest effort: the two differ by a third of what is allowed here at most, and the
    # reference's window and slopes would cost many times as much.
    effort = replace(grid_sampling.REFERENCE, rings=150, ray_radians=1.1, radians=2.2, widths=1.6, spread=1.5)
    plan = grid_sampling.plan_with(g, effort)
    other = DoublePass(g, plan, output, dtype=torch.complex128).field(at)[0]
    error = (without_phase(ours, other) - other).abs().max() / other.abs().max()
    what = f"field, {PAPER}, x_d = {distance:g} m, tilt ({tilt[0]:g}°, {tilt[1]:g}°)"
    validated("Double pass", what, error, 5e-4, "double pass on a sampled sensor plane")


def test_a_tilt_and_its_opposite_are_each_other_turned(validated: Any) -> None:
    g = geometry(distance=2.0, sine=0.02)
    one = RoundPass(g, plan_round(g), Grid(65, 65, 8e-6), dtype=torch.complex128)
    plus, minus = one(torch.tensor([[0.006, 0.011], [-0.006, -0.011]], dtype=torch.float64))
    error = (plus - minus.flip(0, 1)).abs().max() / plus.max()
    validated("Double pass", f"θ → −θ turns the image by 180°, {PAPER}, x_d = 2 m", error, 1e-6, "symmetry")


def test_the_azimuth_turns_the_image(validated: Any) -> None:
    g = geometry(distance=2.0, sine=0.02)
    one = RoundPass(g, plan_round(g, 3e-4), Grid(65, 65, 8e-6), dtype=torch.complex128)
    upright, lying = one(torch.tensor([[0.0, 0.012], [0.012, 0.0]], dtype=torch.float64))
    error = (upright - lying.T).abs().max() / upright.max()
    validated("Double pass", f"azimuth of 90° turns the image, {PAPER}, x_d = 2 m", error, 2e-4, "symmetry")


def test_single_precision_agrees_with_double(validated: Any) -> None:
    worst = 0.0
    for distance in (1.0, math.inf):
        g = geometry(distance=distance, sine=0.02)
        single, double = (
            RoundPass(g, plan_round(g, 3e-4), Grid(64, 64, 8e-6), dtype=dtype)(sines((0.3, 0.6)))
            for dtype in (torch.complex64, torch.complex128)
        )
        worst = max(worst, float((single - double).abs().max() / double.max()))
    validated("Double pass", f"complex64, {PAPER}, x_d = 1 m and ∞", worst, 1e-4, "complex128")


@pytest.mark.parametrize("degrees", [0.3, 0.8, 1.3])
def test_returned_power_is_the_overlap_of_two_discs(degrees: float, validated: Any) -> None:
    g = geometry(sine=math.sin(math.radians(degrees)))
    field, _, _, weights = RoundPass(g, plan_round(g), Grid(8, 8, 1e-5)).exit_pupil(sines((0, degrees)))
    power = float((field.abs() ** 2 * weights).sum()) / (math.pi * g.radius**2)
    want = disc_overlap(g.radius, g.radius, 2 * 0.1 * math.tan(math.radians(degrees)))
    validated("Closed forms", f"returned power, {PAPER}, {degrees}°", abs(power - want), 0.01, "overlap of two discs",
              "of the entering power")  # fmt: skip


@pytest.mark.parametrize("degrees", [10.0, 20.0])
def test_the_returning_pupil_is_displaced(degrees: float, validated: Any) -> None:
    """What leaves is the overlap, its middle half as far out. At 20° tangent and sine are 6 % apart."""
    g = geometry(0.02, 9e-3, sine=math.sin(math.radians(degrees)))
    field, _, y, weights = RoundPass(g, plan_round(g, 1e-2), Grid(8, 8, 1e-5)).exit_pupil(sines((0, degrees)))
    power = field[0].abs() ** 2 * weights
    middle = float((power * y[:, None]).sum() / power.sum())
    want = 2 * 0.02 * math.tan(math.radians(degrees))
    validated("Closed forms", f"displacement of the returning pupil, f = 20 mm, {degrees}°: {want * 1e3:.3f} mm",
              abs(2 * middle / want - 1), 6e-3, "2 z tanθ", "relative")  # fmt: skip


@pytest.mark.parametrize("engine", ["round", "sampled"])
@pytest.mark.parametrize("degrees", [0.0, 10.0, 20.0, 30.0])
def test_the_pictures_power_is_what_the_tilted_lens_takes_in_and_lets_out(
    degrees: float, engine: str, validated: Any
) -> None:
    """Summed over the picture: E π r² cosθ times the overlap of two pupils 2z tanθ apart, to the edge's diffraction."""
    g = geometry(4e-3, 3.6e-3, sine=math.sin(math.radians(degrees)))
    output = Grid(256, 256, 8e-6)
    g = replace(g, window=math.hypot(output.width, output.height) / 2)
    if engine == "round":
        one = RoundPass(g, plan_round(g), output)
    else:
        one = DoublePass(g, grid_sampling.plan_double_pass(g, 1e-3, pixels=256**2), output)
    power = float(one(along(degrees)).sum()) * output.pitch**2
    share = disc_overlap(g.radius, g.radius, 2 * g.image_distance * math.tan(math.radians(degrees)))
    want = math.pi * g.radius**2 * math.cos(math.radians(degrees)) * share
    validated("Closed forms", f"power in the picture, {engine} pass, f/0.56, f = 4 mm, {degrees}°",
              abs(power / want - 1), 0.015, "E π r² cosθ × overlap(2 z tanθ)", "of it")  # fmt: skip


@pytest.mark.parametrize("degrees", [0.4, 1.0])
def test_the_return_leaves_along_the_light_that_came(degrees: float, validated: Any) -> None:
    """Exit tilt −θ: with it taken out, the mean direction of the leaving light is that of the optical axis."""
    g = geometry(sine=math.sin(math.radians(degrees)))
    field, _, y, _ = RoundPass(g, plan_round(g), Grid(8, 8, 1e-5), dtype=torch.complex128).exit_pupil(
        sines((0, degrees))
    )
    column = field[0, :, field.shape[2] // 2]
    middle = (y.abs() - 2 * 0.1 * g.sine / 2).abs() < 0.3e-3
    phase = np.unwrap(np.angle(column[middle & (y > 0)].numpy()))
    slope = np.polyfit(y[middle & (y > 0)].numpy(), phase, 1)[0] / K
    validated("Closed forms", f"exit tilt, {PAPER}, in focus, {degrees}°", abs(slope), 5e-5, "−θ, unrolled", "rad")


def test_orders_are_tilted_mirrors() -> None:
    """An order of direction τ is the mirror seen from the tilt s + τ/2, times a phase."""
    g = geometry(distance=3.0, sine=0.02)
    tau, output = (0.004, -0.006), Grid(33, 33, 12e-6)
    grating = RoundPass(g, plan_round(g), output, [Surface(g.image_distance, (Order(tau, 0.5 + 0.2j),))])
    mirror = RoundPass(g, plan_round(g), output)
    at = torch.tensor([[0.003, 0.005]], dtype=torch.float64)
    seen = at + torch.tensor([tau], dtype=torch.float64) / 2
    assert torch.allclose(
        grating(at), abs(0.5 + 0.2j) ** 2 * mirror(seen), rtol=1e-3, atol=1e-5 * float(mirror(seen).max())
    )


def test_planes_interfere() -> None:
    """A thin cover: the sum of two fields, whose fringes follow the cover's thickness."""
    g, output = geometry(distance=5.0, sine=0.01), Grid(33, 33, 12e-6)
    z, at = g.image_distance, sines((0.1, 0.2))
    plan = plan_round(g)

    def total(*surfaces: Surface) -> float:
        return float(RoundPass(g, plan, output, surfaces)(at).sum())

    apart = total(Surface(z)) + total(Surface(z - 1e-7))
    bright = total(Surface(z), Surface(z - 1e-7, phase=0.0))
    dark = total(Surface(z), Surface(z - 1e-7, phase=math.pi))
    assert bright + dark == pytest.approx(2 * apart, rel=1e-3)
    assert dark < 0.01 * bright


@pytest.mark.parametrize("distance", [2.0, 8.0])
def test_a_wide_aperture_cuts_off_nothing(distance: float, validated: Any) -> None:
    """Over the distance and through an aperture that holds the beam the image is that of the far field."""
    g = geometry(0.05, 2e-3, 6.0, sine=0.01)
    output, at, radius = Grid(40, 40, 12e-6), sines((0.1, 0.3)), 25e-3
    far = RoundPass(g, plan_round(g), output, dtype=torch.complex128).field(at)[0]
    planned = plan_round(through_aperture(g, distance, radius))
    near = RoundPass(g, planned, output, distance=distance, probe_radius=radius, dtype=torch.complex128).field(at)[0]
    # An object elsewhere than in the front focal plane gives its transform a bend, which no image sees.
    q_squared = output.x()[None, :] ** 2 + output.y()[:, None] ** 2
    near = near * phasor(K * distance * q_squared / (2 * PROBE_FOCAL**2))
    error = (without_phase(near, far) - far).abs().max() / far.abs().max()
    what = f"distance invariance: field, f = 50 mm, r = 2 mm, d = {distance:g} m, probe of 50 mm"
    validated("Propagation to the probe", what, error, 6e-3, "the far field")


def test_vignetting_against_a_plain_fresnel_integral(validated: Any) -> None:
    """Half the beam misses the aperture: the field in it by `fresnel` from a fine grid, then a plain transform."""
    g = geometry(0.1, 2e-3, 1.0, sine=0.004)
    distance, radius, at = 3.0, 6e-3, torch.tensor([[0.001, 0.003]], dtype=torch.float64)
    output = Grid(32, 32, 12e-6)
    plan = plan_round(through_aperture(g, distance, radius))
    ours = RoundPass(g, plan, output, distance=distance, probe_radius=radius, dtype=torch.complex128).field(at)[0]
    # The same exit pupil on an even grid, by the table, then everything else without our quadrature.
    count = 900
    source = Grid(count, count, 2 * g.radius / count * 1.0001)
    lens = RoundPass(g, plan, output, dtype=torch.complex128)
    returning, offset = (
        lens._surfaces[0].tables.only,
        2 * g.image_distance * at[0] / math.sqrt(1 - float((at**2).sum())),
    )
    away = torch.hypot(source.x()[None, :] - offset[0], source.y()[:, None] - offset[1])
    table = returning.smooth(away / returning.step)
    rho = source.x()[None, :] ** 2 + source.y()[:, None] ** 2
    bend = K / 2 * (1 / g.image_distance - 1 / g.focal_length) * rho
    pupil = table * phasor(bend) * _covered(rho, g.radius, source.pitch)
    across = Grid(700, 700, 2 * radius / 700)
    arriving = fresnel(pupil, source, WAVELENGTH, distance, across)
    aperture = _covered(across.x()[None, :] ** 2 + across.y()[:, None] ** 2, radius, across.pitch)
    to_image = MatrixFourier(across.x(), across.y(), output.x(), output.y(), K / PROBE_FOCAL)
    plain = to_image(arriving * aperture) * across.pitch**2 / (1j * WAVELENGTH * PROBE_FOCAL)
    error = (without_phase(ours, plain) - plain).abs().max() / plain.abs().max()
    validated("Propagation to the probe", "vignetted field, f = 100 mm, r = 2 mm, x_d = 1 m, probe of 12 mm at 3 m",
              error, 1e-2, "`fresnel` on even grids")  # fmt: skip
    whole = RoundPass(g, plan_round(g), output)(at)[0]
    assert float((ours.abs() ** 2 - whole).abs().max()) > 0.1 * float(whole.max())


def test_a_spherical_wave_meets_a_foreshortened_pupil(validated: Any) -> None:
    """Huygens' sum of a source 0.2 m away over the lens, under 14°, to points of the pupil that returns."""
    tilt, curvature, radius = torch.tensor([[0.14, 0.2]], dtype=torch.float64), 1 / 0.2, 0.55e-3
    g = geometry(1.6e-3, radius, 0.2, sine=0.25, curvature=curvature)
    field, x, y, weights = RoundPass(g, plan_round(g, 1e-4), Grid(4, 4, 1e-5), dtype=torch.complex128).exit_pupil(tilt)
    slope = tilt[0] / torch.sqrt(1 - (tilt**2).sum())
    disc = disc_quadrature(radius, 1700, 1750)
    across, down = disc.x, disc.y[:, None]
    along, square = across * tilt[0, 0] + down * tilt[0, 1], across**2 + down**2
    sphere = (torch.sqrt(1 + 2 * curvature * along + curvature**2 * square) - 1) / curvature
    path = sphere - along + across * slope[0] + down * slope[1] - square / (2 * g.focal_length)
    # Of the way |at - place|²/4z what mixes both separates into columns and rows.
    light = phasor(K * (path + square / (4 * g.image_distance))) * disc.weights
    rows = (torch.linspace(0.05, 0.95, 6) * (len(y) - 1)).long()
    columns = (torch.linspace(0.1, 0.9, 5) * (len(x) - 1)).long()
    turn = -K / (2 * g.image_distance)
    light = phasor(turn * y[rows, None] * disc.y) @ light @ phasor(turn * disc.x[:, None] * x[columns])
    bend = 1 / (4 * g.image_distance) - 1 / (2 * g.focal_length)
    leaving = K * (x[columns] * slope[0] + y[rows, None] * slope[1] + bend * (x[columns] ** 2 + y[rows, None] ** 2))
    light = light * phasor(leaving) / (2 * WAVELENGTH * g.image_distance)
    inside = weights[rows][:, columns] != 0
    got, known = field[0][rows][:, columns][inside], light[inside] * (1 - float((tilt**2).sum())) ** 0.25
    error = (without_phase(got, known) - known).square().abs().mean().sqrt() / known.abs().max()
    what = "field (RMS), f/1.5, f = 1.6 mm, 14°, source at 0.2 m"
    validated("Double pass", what, error, 8e-3, "Huygens' sum by exact distances")


@pytest.mark.parametrize("curvature", [1 / 0.3])
def test_the_way_to_a_near_probe_goes_by_exact_distances(curvature: float, validated: Any) -> None:
    """Huygens' sum from the tilted lens to the probe's aperture, point by point, over 30 cm and under 5.7°."""
    tilt, distance, radius = torch.tensor([[0.06, 0.08]], dtype=torch.float64), 0.3, 1e-3
    output = Grid(20, 20, 14e-6)
    g = geometry(4e-3, 0.7e-3, 0.6, sine=0.1, curvature=curvature)
    ours = RoundPass(g, plan_round(through_aperture(g, distance, radius), 3e-3), output, distance=distance,
                     probe_radius=radius, dtype=torch.complex128)(tilt)[0]  # fmt: skip
    plan = plan_round(through_aperture(g, distance, radius), 1e-2)
    field, x, y, weights = RoundPass(g, plan, output, dtype=torch.complex128).exit_pupil(tilt)
    kept = weights != 0
    place = torch.stack([x.expand(len(y), -1)[kept], y[:, None].expand(-1, len(x))[kept]], -1)
    beam = (field[0] * weights)[kept]
    cosine = math.sqrt(1 - float((tilt**2).sum()))
    matrix = torch.eye(2, dtype=torch.float64) - tilt.T @ tilt / (1 + cosine)
    farther, seen = distance + place @ tilt[0], place @ matrix
    stop = disc_quadrature(radius, 80, 85)
    inside = stop.weights != 0
    far = torch.stack([stop.x.expand(85, -1)[inside], stop.y[:, None].expand(-1, 80)[inside]], -1)
    arriving = []
    for some in far.split(256):
        square = torch.cdist(some, seen) ** 2
        length = torch.sqrt(farther**2 + square)
        arriving.append(phasor(K * square / (length + farther)) * (distance / length) @ beam)
    light = torch.cat(arriving) * stop.weights[inside]
    across, down = (phasor(-K / PROBE_FOCAL * far[:, i, None] * axis) for i, axis in ((0, output.x()), (1, output.y())))
    want = (down * light[:, None]).mT @ across
    want = cosine * (want.abs() / (WAVELENGTH**2 * distance * PROBE_FOCAL)) ** 2
    error = (ours - want).abs().max() / want.max()
    what = f"image, f/2.9, f = 4 mm, 5.7°, probe of 2 mm at 0.3 m, 1/R = {curvature:.2g}/m"
    validated("Propagation to the probe", what, error, 3e-3, "a sum by exact distances")


def _covered(rho_squared: torch.Tensor, radius: float, pitch: float) -> torch.Tensor:
    """Share of a pixel inside a disc, near enough."""
    return ((radius - rho_squared.sqrt()) / pitch + 0.5).clamp(0, 1)


def test_gradients_of_every_continuous_parameter() -> None:
    """Gradcheck in double precision. The grids stay as planned: a planner that follows would move its error too."""
    g = geometry(0.1, 0.5e-3, 3.0, sine=0.01, curvature=0.2)
    plan, output = plan_round_with(g, RoundEffort(1.0, 30, 1.5, 3.0)), Grid(2, 3, 30e-6)

    def image(tilt: torch.Tensor, **values: torch.Tensor) -> torch.Tensor:
        z = 1 / (1 / values["focal_length"] - 1 / values.pop("object_distance"))
        return RoundPass(g, plan, output, [Surface(z)], dtype=torch.complex128, **values)(tilt)

    names = ("object_distance", "focal_length", "radius", "curvature", "probe_focal_length")
    start = {"object_distance": 3.0, "focal_length": 0.1, "radius": 0.5e-3, "curvature": 0.2,
             "probe_focal_length": 0.2}  # fmt: skip
    tilt = torch.tensor([[0.0009, 0.0017], [-0.0017, 0.0003]], dtype=torch.float64, requires_grad=True)
    # In units of their own size, so that one step suits all.
    ones = [torch.ones((), dtype=torch.float64, requires_grad=True) for _ in names]

    def scaled(tilt: torch.Tensor, *shares: torch.Tensor) -> torch.Tensor:
        values = {name: share * start[name] for name, share in zip(names, shares, strict=True)}
        return image(tilt * 1e-3, **values)

    assert torch.autograd.gradcheck(
        scaled, ((tilt.detach() * 1e3).requires_grad_(), *ones), eps=1e-6, atol=1e-6, rtol=2e-3
    )

    def by_wavelength(share: torch.Tensor) -> torch.Tensor:
        z = torch.tensor(g.image_distance, dtype=torch.float64)
        at = tilt.detach()
        return RoundPass(g, plan, output, [Surface(z)], dtype=torch.complex128, wavelength=share * WAVELENGTH)(at)

    one = torch.ones((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(by_wavelength, (one,), eps=1e-6, atol=1e-6, rtol=2e-3)


def test_gradient_of_the_focal_length_behind_a_tilted_sensor() -> None:
    """What the weights of the tables behind tilted planes change and what the tables change nearly cancel in it."""
    light = "illumination={mode: collimated, diameter: 30 mm, wavelength: 640 nm, power: 1 mW}"
    values = {"distance": 2.5, "object_distance": 2.5, "target.lens.aperture_radius": 2e-3, "sampling.accuracy": 1e-3}
    values |= {"target.sensor.tilt": [-4e-3, -0.6e-3], "probe.sensor.pixels": [96, 96], "probe.sensor.pitch": 3.5e-6}
    light = {"mode": "collimated", "diameter": 30e-3, "wavelength": 640e-9, "power": 1e-3}
    values |= {"illumination": light, "sampling.propagation": "far field"}
    scene = with_values(load_scene("thin-lens"), values)
    tilt, focal = torch.tensor([[0.005, 0.0024]], dtype=torch.float64), 16e-3

    def image(length: torch.Tensor | float) -> torch.Tensor:
        return Camera(scene, 0.01, focal_length=length, dtype=torch.complex128, device="cpu")(tilt)[0]

    weights = image(focal) / image(focal).max()
    varied = torch.tensor(focal, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad((image(varied) * weights).sum(), varied)
    step = 1e-6 * focal
    want = float(((image(focal + step) - image(focal - step)) * weights).sum()) / (2 * step)
    assert float(slope) == pytest.approx(want, rel=1e-4)


def test_gradient_of_the_distance_through_the_aperture() -> None:
    g = geometry(0.1, 0.5e-3, 3.0, sine=0.01)
    output, at = Grid(3, 4, 30e-6), sines((0.05, 0.1))
    plan = plan_round(through_aperture(g, 4.0, 1e-3), 1e-2)

    def image(distance: torch.Tensor) -> torch.Tensor:
        return RoundPass(g, plan, output, distance=4.0 * distance, probe_radius=1e-3, dtype=torch.complex128)(at)

    one = torch.ones((), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(image, (one,), eps=1e-6, atol=1e-6, rtol=1e-3)


def test_a_beam_narrower_than_the_aperture() -> None:
    """Light of half the radius: a quarter of the power comes back, head on."""
    g, output = geometry(), Grid(200, 200, 8e-6)
    whole, narrow = (RoundPass(g, plan_round(g), output, lit_radius=lit)(sines((0, 0))).sum() for lit in (3e-3, 1.5e-3))
    assert float(narrow / whole) == pytest.approx(0.25, rel=0.03)


def test_a_batch_is_its_parts_and_centres_move_the_picture() -> None:
    g = geometry(0.1, 2e-3, 4.0, sine=0.01)
    one = RoundPass(g, plan_round(g), Grid(64, 64, 4e-6), dtype=torch.complex128)
    many = sines((0, 0.1), (0.2, 0.3), (-0.4, 0.2))
    together = one(many)
    apart = torch.cat([one(many[i : i + 1]) for i in range(3)])
    assert torch.allclose(together, apart, atol=1e-9 * float(apart.max()))
    step = one.output.pitch
    moved = one(many, torch.tensor([[2 * step, -3 * step]] * 3, dtype=torch.float64))
    assert torch.allclose(moved[:, :-3, 2:], together[:, 3:, :-2], atol=1e-9 * float(apart.max()))


def about_the_threshold(engine: str, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """A coarse pass's images of tilts just below and above that from which foreshortening counts: alone, and together.

    The threshold is that of single precision.
    """
    g = geometry(0.1, 4e-3, 5.5, sine=0.05)
    output = Grid(96, 96, 4e-6)
    if engine == "round":
        one, single = (RoundPass(g, plan_round(g, 1e-2), output, dtype=d) for d in (dtype, torch.complex64))
    else:
        plan = grid_sampling.plan_double_pass(g, 1e-2, pixels=96**2)
        one, single = (DoublePass(g, plan, output, dtype=d) for d in (dtype, torch.complex64))
    flat = math.sqrt(flattest(single if isinstance(single, RoundPass) else single.pupil))
    tilts = torch.tensor([[(1 - 1e-6) * flat, 0.0], [(1 + 1e-6) * flat, 0.0]], dtype=torch.float64)
    return torch.cat([one(tilt[None]) for tilt in tilts]), one(tilts)


@pytest.mark.parametrize("engine", ["round", "sampled"])
def test_an_image_does_not_depend_on_the_gazes_drawn_with_it(engine: str) -> None:
    """A fit compares images of gazes drawn alone with those of many."""
    alone, together = about_the_threshold(engine, torch.complex64)
    assert (alone - together).abs().max() < 1e-5 * alone.max()


def test_double_precision_leaves_nothing_out_by_a_jump() -> None:
    """What is left out within the asked error, from a threshold on, would pass for a difference of what is fitted."""
    (below, above), _ = about_the_threshold("round", torch.complex128)
    jump = (below - above).abs().max() / below.max()
    (below, above), _ = about_the_threshold("round", torch.complex64)
    assert jump < 1e-5 < 1e-4 < (below - above).abs().max() / below.max()


def test_bands_of_rows_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    from tapetum.simulate import round_pass

    g = geometry(0.1, 2e-3, 4.0, sine=0.01)
    one, at = RoundPass(g, plan_round(g), Grid(32, 32, 8e-6)), sines((0.1, 0.2), (0.3, 0.4))
    whole = one(at)
    monkeypatch.setattr(round_pass, "_SAMPLES_AT_ONCE", 2000)
    assert torch.allclose(one(at), whole, rtol=1e-3, atol=1e-5 * float(whole.max()))


@pytest.mark.slow
def test_the_full_aperture_of_the_papers_lens_fits_into_memory() -> None:
    """LA1509-B: r = 12.7 mm, focused at 1 m."""
    scene: Scene = with_values(
        load_scene("thin-lens"),
        {"target.lens.aperture_radius": 12.7e-3, "target.object_distance": 1.0,
         # A sensor that holds the whole spot: one across an edge is sampled, and takes more than is allowed.
         "target.sensor.pixels": [4096, 4096]},
    )  # fmt: skip
    camera = Camera(scene, math.sin(math.radians(1.0)))
    assert camera.plan.bytes_needed(1, 256**2) < 1.5e9
    # A coarser picture does, to see that it is one.
    image = Camera(scene, math.sin(math.radians(1.0)), accuracy=1e-2)(sines((0.0, 1.0)))[0]
    assert bool(torch.isfinite(image).all())
    assert float(image.max()) > 0


def test_orders_of_magnitude_of_the_table() -> None:
    """What is looked up lies between the table's entries: nothing reads beyond its end."""
    g = geometry(sine=0.02)
    one = RoundPass(g, plan_round(g), Grid(4, 4, 1e-5))
    table = one._surfaces[0].tables.only
    farthest = 2 * g.image_distance * g.sine + g.radius
    assert (len(table.values) - 1) * table.step >= farthest
    assert np.isfinite(table.values.numpy()).all()
