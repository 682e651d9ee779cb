"""The traced double pass against sums over rays, a thin lens with the same aberration, and its own symmetries."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import Any

import pytest
import torch
import traced_cases
from traced_cases import (
    PROBE_FOCAL,
    WAVELENGTH,
    Case,
    K,
    along_y,
    bare,
    difference,
    energy,
    finer,
    huygens,
    picture,
    traced,
    with_mirror_at,
)

from tapetum.bench import PixelArray, TargetSensor, load_scene, with_values
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature
from tapetum.simulate import Camera, traced_pass
from tapetum.simulate.pupil_fits import TiltNodes, fit_pupils, values_at
from tapetum.simulate.sensor_plane import orders_of, reflectance_at
from tapetum.simulate.surfaces import Mask, Order, Surface
from tapetum.simulate.traced_pass import TracedGrids, TracedPass

SECTION = "Traced lenses"
PHONE = Case("phone-d", 6.0)
planned = functools.lru_cache(maxsize=16)(traced_cases.planned)
FAR_MENISCUS = Case("la1509", 1.2, f_number=100 / 6)


def irradiance_difference(field: torch.Tensor, like: torch.Tensor) -> float:
    """Largest difference of irradiance in fractions of the second one's peak."""
    one, other = field.abs() ** 2, like.abs() ** 2
    return float((one - other).abs().max() / other.max())


@pytest.mark.parametrize(
    ("case", "degrees", "samples", "tolerance"),
    [
        (PHONE, 0.0, (50, 150), 3e-3),
        (PHONE, 3.0, (50, 150), 1e-3),
        (Case("phone-b", 4.0, f_number=4.0), 2.0, (58, 190), 5e-3),
    ],
    ids=str,
)
def test_fields_against_sums_over_rays(
    case: Case, degrees: float, samples: tuple[int, int], tolerance: float, validated: Any
) -> None:
    """Rays to the exit pupil, then every exact distance to the sensor and back: no fits, no chirp, no interpolation."""
    focused, _ = traced(case)
    output = picture(case)
    # What is compared is the passes' formulas, at samples that the sums can afford.
    one = planned(case, output, 0.1).passes[0]
    # The sums leave out what lies beyond their window, which the pass adds: theirs is wider.
    half = 3 * one.grids.half_width
    want = huygens(
        focused, degrees, half_width=half, sensor=int(3.5 * one.grids.sensor), radial=samples[0], around=samples[1]
    ).image(output)
    ours = finer(one, output, 1.4).field(along_y(degrees))[0]
    what = f"field, {case}, {degrees:g}°"
    validated(SECTION, what, difference(ours, want), tolerance, "sums over rays with exact distances")


def thin_lens(case: Case, degrees: float, output: Grid, grids: TracedGrids) -> torch.Tensor:
    """Field of the thin lens's double pass (docs/conventions.md) whose pupil has the aberration of the traced one.

    With its curved side and its stop in front the plano-convex lens has its pupils in its principal planes: x is e on
    both ways, and z the distance of the sensor from the exit pupil.
    """
    focused, fits = traced(case)
    sines = along_y(degrees)
    tilt = fits.nodes.terms(sines[:, 1])
    chief = float((tilt @ fits.middle) / (tilt @ fits.radius))
    z = focused.image - focused.exit_pupil
    count = grids.pupil
    disc = disc_quadrature(case.lens.aperture_radius, count, count)
    places = torch.stack(torch.meshgrid(disc.x, disc.y, indexing="xy"), -1).reshape(1, -1, 2)
    path = values_at(fits.leaving, tilt, places)[0][0, 0].reshape(count, count)
    lens = disc.weights * phasor(K * torch.where(disc.weights != 0, path, torch.zeros_like(path)))
    sensor = math.ceil(1.2 * grids.sensor)
    step = 2 * grids.half_width / sensor
    v = (torch.arange(sensor, dtype=torch.float64) - (sensor - 1) / 2) * step
    square = v[None, :] ** 2 + v[:, None] ** 2
    fade = ((square.sqrt() - grids.flat) / (grids.half_width - grids.flat)).clamp(0, 1)
    spot = MatrixFourier(disc.x, disc.y, v, v, K / z)(lens) * torch.cos(fade * math.pi / 2) ** 2
    spot = spot * phasor(K * square / z) * phasor(2 * K * chief * v)[:, None]
    back = MatrixFourier(v, v, disc.x, disc.y, K / z)(spot) * step**2 / (1j * WAVELENGTH * z) ** 2
    shortened = output.y() * math.sqrt(1 - float(sines[0, 1]) ** 2)
    return MatrixFourier(disc.x, disc.y, output.x(), shortened, K / PROBE_FOCAL)(back * lens) / (
        1j * WAVELENGTH * PROBE_FOCAL
    )


@pytest.mark.parametrize(
    ("f_number", "distance", "degrees", "grids", "pixel"),
    [
        (100 / 6, math.inf, 0.0, TracedGrids(325, 462, 8.4e-4, 6.3e-4, 325), 2e-6),
        (100 / 6, math.inf, 0.5, TracedGrids(325, 462, 8.4e-4, 6.3e-4, 325), 2e-6),
        (100 / 3, 1.0, 0.0, TracedGrids(700, 330, 1.2e-3, 9e-4, 800), 1.1e-5),
        (100 / 3, 1.0, 0.3, TracedGrids(700, 330, 1.2e-3, 9e-4, 800), 1.1e-5),
    ],
)
def test_la1509_is_a_thin_lens_with_its_aberration(
    f_number: float, distance: float, degrees: float, grids: TracedGrids, pixel: float, validated: Any
) -> None:
    """At r = 3 mm and x_d = 1 m sine and tangent make the two differ, by 5e-3: there the lens is stopped to 1.5 mm."""
    case = Case("la1509", 1.2, distance, f_number=f_number)
    output = Grid(51, 51, pixel)
    ours = bare(traced(case)[1], grids, output).field(along_y(degrees))[0]
    want = thin_lens(case, degrees, output, grids)
    against = "thin lens's double pass with the same aberration"
    what = f"LA1509, r = {50 / f_number:.2g} mm, x_d = {distance:g} m, {degrees:g}°"
    validated(SECTION, f"irradiance, {what}", irradiance_difference(ours, want), 1e-3, against)
    validated(SECTION, f"field, {what}", difference(ours, want), 2e-3, against)


@pytest.mark.parametrize("azimuth", [45.0, 90.0, 217.0])
def test_the_azimuth_turns_the_return(azimuth: float, validated: Any) -> None:
    """Along a circle of the picture: the RR of a tilt in another direction is the first one turned."""
    output = picture(PHONE)
    base = finer(planned(PHONE, output).passes[0], output, 1.3)
    size, turn = math.sin(math.radians(3.0)), math.radians(azimuth)
    sines = size * torch.tensor([[0.0, 1.0], [math.cos(turn), math.sin(turn)]], dtype=torch.float64)
    angle = torch.arange(60, dtype=torch.float64) * 2 * math.pi / 60
    worst, peak = 0.0, float((base.field(sines[:1]).abs() ** 2).max())
    for ring in (0.0, 1.0, 2.5, 4.0):
        radius = ring * WAVELENGTH * PROBE_FOCAL / (2 * PHONE.lens.aperture_radius)
        values: list[torch.Tensor] = []
        for tilt, by in ((sines[:1], math.pi / 2), (sines[1:], turn)):
            pupil, x, y = base.exit_pupil(tilt)
            places = radius * torch.stack([torch.cos(angle + by), torch.sin(angle + by)], -1)
            values.append(at_places(pupil[0], x[0], y[0], tilt, places))
        worst = max(worst, float((values[0] - values[1]).abs().max()) / peak)
    what = f"a tilt at {azimuth:g}° returns the turned picture, {PHONE}, 3°"
    validated(SECTION, what, worst, 2e-3, "symmetry")


def at_places(
    pupil: torch.Tensor, x: torch.Tensor, y: torch.Tensor, sines: torch.Tensor, places: torch.Tensor
) -> torch.Tensor:
    """Irradiance [Q] at places [Q, 2] of the probe's sensor, by a plain sum over the field that leaves."""
    from tapetum.simulate.foreshortening import foreshortening

    _, triangle = foreshortening(sines)
    # The pupil's columns and rows are turned by R: e = R (x, y), and e·Mq = (x, y)·Tq.
    seen = places @ triangle[0].T
    columns = phasor(-K / PROBE_FOCAL * x[:, None] * seen[:, 0])
    rows = phasor(-K / PROBE_FOCAL * y[:, None] * seen[:, 1])
    value = (rows * (pupil.to(rows.dtype) @ columns)).sum(0)
    cosine = math.sqrt(1 - float((sines**2).sum()))
    scale = float((x[1] - x[0]) * (y[1] - y[0])) / (WAVELENGTH * PROBE_FOCAL) * math.sqrt(cosine)
    return value.abs() ** 2 * scale**2


def test_fields_between_the_traced_tilts(validated: Any) -> None:
    """Between its nodes the fits give what a bundle traced at that very tilt gives."""
    focused, fits = traced(PHONE)
    output = picture(PHONE)
    one = planned(PHONE, output).passes[0]
    tilt = along_y(2.3)
    ours = finer(one, output, 1.2).field(tilt)[0]
    # Chebyshev nodes of an odd number hold the middle of their range.
    there = fit_pupils(focused, float(2 * tilt[0, 1]), nodes=TiltNodes(float(2 * tilt[0, 1]), 5))
    assert float((there.nodes.sines - tilt[0, 1]).abs().min()) < 1e-12
    want = finer(one, output, 1.2, fits=there).field(tilt)[0]
    validated(SECTION, f"field between the traced tilts, {PHONE}, 2.3°", difference(ours, want), 2e-3, "one traced")
    validated(SECTION, f"misfit of the fits, {PHONE}", fits.misfit / WAVELENGTH, 1e-3, "its rays", "waves")


@pytest.mark.parametrize(("case", "tolerance"), [(PHONE, 1e-2), (Case("phone-b", 5.0), 3e-2)], ids=str)
def test_an_aligned_lens_hides_the_sign_of_the_gaze(case: Case, tolerance: float, validated: Any) -> None:
    output = picture(case)
    image = finer(planned(case, output).passes[0], output, 1.3).field(along_y(2.0))[0].abs() ** 2
    error = float((image - image.flip(0, 1)).abs().max() / image.max())
    validated(SECTION, f"I(q) = I(-q), {case}, 2°", error, tolerance, "symmetry to one part in the Fresnel number")
    # Not by symmetry alone: the wave's own asymmetry is there.
    assert error > 1e-6


def array() -> TargetSensor:
    return TargetSensor(pixels=(200, 200), pitch=2.2e-6, array=PixelArray(pitch=2.2e-6, fill=0.5))


@pytest.mark.parametrize("tilt", [(0.0, 0.0175), (0.012, -0.005)])
def test_orders_are_a_sampled_mask(tilt: tuple[float, float], validated: Any) -> None:
    """Orders as phases that turn slowly, against the array itself, sampled where the spot falls on it."""
    focused, fits = traced(PHONE)
    output, sensor = picture(PHONE), array()
    orders = orders_of(sensor, WAVELENGTH, 4 * fits.aperture[0])
    assert len(orders) > 1
    step = 2.2e-6 / 16
    # So late a fade has no bump, which only orders would have.
    grids = TracedGrids(360, 512, 256 * step, 200 * step, 360)
    sines = torch.tensor([tilt], dtype=torch.float64)
    ours = bare(fits, grids, output, Surface(focused.image, tuple(orders))).field(sines)[0]
    want = bare(fits, grids, output, mask=Mask(reflectance_at(sensor, WAVELENGTH))).field(sines)[0]
    what = f"field, pixels of 2.2 µm, {PHONE}, sines {tilt}"
    validated(SECTION, what, difference(ours, want), 1e-2, "a sampled mask")


def test_an_order_returns_to_its_source_where_littrow_says(validated: Any) -> None:
    """Past the mirror's cut-off: order τ at s_c = -τ/2 returns what a mirror returns head on, and at +τ/2 nothing."""
    focused, fits = traced(PHONE)
    output = picture(PHONE)
    tilt = fits.nodes.terms(along_y(5.5)[:, 1])
    chief = float((tilt @ fits.middle) / (tilt @ fits.radius))
    base = planned(PHONE, output).passes[0]
    shares: list[float] = []
    for tau, at in ((0.0, 0.0), (-2 * chief, 5.5), (2 * chief, 5.5)):
        surface = Surface(focused.image, (Order((0.0, tau)),))
        one = finer(base, output, 1.6, window=1.6, surface=surface)
        entering = float(along_energy(one, at))
        shares.append(float(energy(one, along_y(at))[0]) / entering)
    assert shares[2] < 1e-3
    validated(SECTION, f"share returned by an order at Littrow's angle, {PHONE}, 5.5°", abs(shares[1] / shares[0] - 1),
              0.02, "the mirror's, head on", "relative")  # fmt: skip


def along_energy(one: TracedPass, degrees: float) -> float:
    """Power that enters for 1 W/m² of light, in W, by the fits of the way out and their edge."""
    from tapetum.simulate.pupil_fits import on_grid, open_share

    sines = along_y(degrees)
    tilt = one.fits.nodes.terms(sines[:, 1])
    x, y, _, even, _, inside = on_grid(one.fits.leaving, tilt, torch.tensor([[0.0, 1.0]], dtype=torch.float64), 400)
    cell = float((x[0, 1] - x[0, 0]) * (y[0, 1] - y[0, 0]))
    return float((open_share(even[:, 2:], inside) ** 2).sum()) * cell * math.sqrt(1 - float(sines[0, 1]) ** 2)


def test_a_layer_is_the_sensor_moved(validated: Any) -> None:
    """Through air a layer is a sensor that stands nearer; through glass, nearer by its reduced depth."""
    depth, output, tilt = 30e-6, picture(PHONE), along_y(2.0)
    focused, _ = traced(PHONE)
    grids = TracedGrids(260, 190, 6e-5, 5e-5, 420)
    nearer = fit_pupils(with_mirror_at(focused, depth), PHONE.steepest)
    want = bare(nearer, grids, output).field(tilt)[0]
    for index, at in ((1.0, depth), (1.5, 1.5 * depth)):
        surface = Surface(focused.image - depth, depth=at, index=index)
        error = irradiance_difference(planned(PHONE, output, 1e-2, surface, pictures=1).field(tilt)[0], want)
        what = f"a layer {at * 1e6:g} µm before the sensor, n = {index:g}, {PHONE}, 2°"
        validated(SECTION, what, error, 2e-2, "the sensor moved by its reduced depth")


def test_a_tilted_layer_is_the_tilted_sensor_moved(validated: Any) -> None:
    """Where the light on it is out of focus."""
    depth, a, output, tilt = 50e-6, (0.004, -0.003), picture(PHONE), along_y(2.0)
    focused, _ = traced(PHONE)
    orders = (Order((2 * a[0], 2 * a[1])),)
    layered = planned(PHONE, output, 3e-2, Surface(focused.image - depth, orders, depth=depth, tilt=a), pictures=1)
    nearer = fit_pupils(with_mirror_at(focused, depth), PHONE.steepest)
    moved = bare(nearer, layered.passes[0].grids, output, Surface(focused.image - depth, orders, tilt=a))
    want = moved.field(tilt)[0]
    what = f"a layer tilted by (4, -3) mrad 50 µm before the sensor, {PHONE}, 2°"
    error = irradiance_difference(layered.field(tilt)[0], want)
    validated(SECTION, what, error, 1e-3, "the tilted sensor moved there")
    straight = planned(PHONE, output, 3e-2, Surface(focused.image - depth, depth=depth), pictures=1).field(tilt)[0]
    assert irradiance_difference(straight, want) > 0.1


def test_planes_interfere() -> None:
    output, tilt = picture(PHONE), along_y(1.0)
    focused, fits = traced(PHONE)
    mirror = Surface(focused.image)

    def total(depth: float) -> float:
        nearer = Surface(focused.image - depth, depth=depth)
        return float((planned(PHONE, output, 0.1, mirror, nearer, pictures=1).field(tilt).abs() ** 2).sum())

    alone = float((planned(PHONE, output, pictures=1).field(tilt).abs() ** 2).sum())
    # A quarter of a wave nearer is dark, a half bright: at the angle of the chief ray.
    terms = fits.nodes.terms(tilt[:, 1])
    cosine = math.sqrt(1 - float((terms @ fits.middle) / (terms @ fits.radius)) ** 2)
    dark, bright = total(WAVELENGTH / 4 / cosine), total(WAVELENGTH / 2 / cosine)
    assert dark < 0.01 * alone
    assert bright == pytest.approx(4 * alone, rel=0.01)


def test_gradients_of_the_tilt(validated: Any) -> None:
    output = Grid(7, 7, picture(PHONE).pitch * 4)
    one = bare(traced(PHONE)[1], TracedGrids(90, 90, 3e-5, 2.2e-5, 200), output)

    def image(tilt: torch.Tensor) -> torch.Tensor:
        return one.field(tilt).abs() ** 2

    tilt = torch.tensor([[0.012, 0.021]], dtype=torch.float64, requires_grad=True)
    weights = torch.linspace(-1, 1, 49, dtype=torch.float64).reshape(7, 7)
    (ours,) = torch.autograd.grad((image(tilt) * weights).sum(), tilt)
    step = 1e-5
    want = torch.zeros_like(tilt)
    for i in (0, 1):
        move = torch.zeros_like(tilt)
        move[0, i] = step
        with torch.no_grad():
            want[0, i] = ((image(tilt + move) - image(tilt - move)) * weights).sum() / (2 * step)
    error = float((ours - want).abs().max() / want.abs().max())
    validated(
        SECTION, f"gradient of the irradiance in the tilt, {PHONE}", error, 1e-3, "finite differences", "relative"
    )


@pytest.mark.parametrize("fast", [False, True])
def test_a_batch_is_its_parts_and_centres_move_the_picture(fast: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    output = picture(PHONE)

    def beats(*_: float) -> bool:
        return fast

    monkeypatch.setattr(traced_pass, "fast_beats_products", beats)
    one = bare(traced(PHONE)[1], TracedGrids(90, 70, 3e-5, 2.2e-5, 160), output)
    many = torch.cat([along_y(0.0, 2.0, 4.0), torch.tensor([[0.02, -0.01], [-0.03, 0.0]], dtype=torch.float64)])
    together = one.field(many)
    apart = torch.cat([one.field(many[i : i + 1]) for i in range(len(many))])
    assert torch.allclose(together, apart, atol=1e-9 * float(apart.abs().max()))
    assert bool((one.field(along_y(9.0)) == 0).all())
    centres = torch.tensor([[2.0, -3.0]], dtype=torch.float64).expand(len(many), 2) * output.pitch
    aside, middle = one(many, centres)[:, :-3, 2:], one(many)[:, 3:, :-2]
    assert torch.allclose(aside, middle, rtol=0, atol=1e-9 * float(middle.max()))


def test_tilts_that_return_nothing_are_dark_among_others() -> None:
    """Nothing is computed past the last tilt that the pupils were fitted for, and the others do not change."""
    case = Case("phone-d", 5.0)
    one = planned(case, picture(case)).passes[0]
    last = math.degrees(math.asin(one.fits.nodes.steepest))
    mixed = one.field(along_y(last + 1, 2.0, last + 5, 4.0))
    assert float(mixed[0].abs().max()) == 0 and float(mixed[2].abs().max()) == 0
    assert torch.allclose(mixed[1::2], one.field(along_y(2.0, 4.0)))
    nothing = one.field(along_y(last + 1))
    assert nothing.shape == mixed[:1].shape and float(nothing.abs().max()) == 0


def test_single_precision_agrees_with_double(validated: Any) -> None:
    output = picture(PHONE)
    single = planned(PHONE, output).passes[0]
    double = bare(single.fits, single.grids, output)
    tilt = along_y(0.0, 3.0)
    error = irradiance_difference(single.field(tilt).to(torch.complex128), double.field(tilt))
    validated(SECTION, f"complex64, {PHONE}", error, 1e-4, "complex128")


def test_no_number_is_too_small_to_be_multiplied_quickly() -> None:
    """Subnormal numbers are exact, and a hundred times slower: none may be left where the window ends."""
    one = planned(PHONE, picture(PHONE)).passes[0]
    shares = torch.view_as_real(one._window).abs()
    kept = shares[shares > 0]
    assert 0 < len(kept) < shares.numel()
    assert kept.min() > 1e-20 * kept.max()


@pytest.mark.parametrize("orders", [(Order((0.0, 0.0), 1.0),), (Order((0.0, 0.0), 0.6), Order((0.03, -0.02), 0.5))])
def test_fast_transforms_give_what_products_give(
    orders: tuple[Order, ...], monkeypatch: pytest.MonkeyPatch, validated: Any
) -> None:
    """In the same directions: of a mirror on one side of the middle, of orders in all; past the transform's end too."""
    monkeypatch.setattr(traced_pass, "fast_beats_products", lambda *_: True)  # pyright: ignore[reportUnknownLambdaType]
    focused, fits = traced(PHONE)
    # The coarser the spot's samples, the sooner the transform repeats.
    one = bare(fits, TracedGrids(60, 24, 3e-5, 2.2e-5, 60), picture(PHONE), Surface(focused.image, orders))
    at = one.pupil.gazes(torch.cat([along_y(0.0, 3.0), torch.tensor([[0.02, -0.01]], dtype=torch.float64)]), False)
    leaving = at.leaving()
    assert leaving.length is not None and leaving.mirrored == (len(orders) == 1)
    assert leaving.rows.shape[1] > leaving.length
    dice = torch.Generator().manual_seed(1)
    spot = torch.randn(3, 24, 12 if leaving.mirrored else 24, dtype=torch.complex128, generator=dice)
    fast, products = (one._back(way)(spot) for way in (leaving, replace(leaving, length=None)))
    error = float((fast - products).abs().max() / products.abs().max())
    what = f"returning light of {len(orders)} orders by fast transforms"
    validated(SECTION, what, error, 1e-11, "matrix products, phase and all")


def test_shifted_microlenses_may_return_more_beside_the_axis_than_on_it() -> None:
    """The check of the power that returns goes by the strongest amplitude of each order at any place of the spot."""
    array = {"pitch": 4.4e-6, "fill": 0.562, "shape": "round", "surround": 0.4288, "phase": -0.9795}
    sensor = {"reflectance": 0.3, "pixels": [648, 486], "pitch": 8.8e-6, "array": array}
    sensor["microlens"] = {"focal_length": 8.8e-6, "fill": 0.9, "shift": 0.01}
    lens = {"kind": "prescription", "name": "la1509", "f_number": 16, "design_wavelength": 640e-9}
    scene = with_values(
        load_scene("rotation"),
        {
            "target": {"lens": lens, "object_distance": 5.5, "sensor": sensor},
            "probe.sensor.pixels": [64, 64],
            "sampling.accuracy": 0.03,
        },
    )
    image = Camera(scene, 0.0)(torch.zeros(1, 2, dtype=torch.float64))
    assert bool((image >= 0).all()) and float(image.max()) > 0
