"""Pixel arrays and masks: orders against closed forms, and against the same array sampled, through both engines."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.integrate import quad
from scipy.special import j0

from tapetum.bench import Microlens, PixelArray, SensorMask, TargetSensor
from tapetum.errors import InputError
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.grid_sampling import plan_double_pass
from tapetum.optics.sampling import DoublePassGeometry, disc_overlap, plan_round
from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.sensor_plane import _cell_of, _of_steps, orders_of, reflectance_at
from tapetum.simulate.surfaces import Order, Surface

SECTION = "Sensor plane"
WAVELENGTH, PROBE_FOCAL, PITCH = 640e-9, 0.2, 2.2e-6
K = 2 * math.pi / WAVELENGTH
Validated = Callable[..., None]


def sensor(
    array: PixelArray | None = None,
    microlens: Microlens | None = None,
    *,
    pitch: float = PITCH,
    pixels: tuple[int, int] = (649, 487),
    reflectance: float = 1.0,
) -> TargetSensor:
    """A sensor, by custom one with a photosite's centre on the axis."""
    return TargetSensor(reflectance, pixels, pitch, array, microlens)


def amplitudes(one: TargetSensor, most: int = 8, periods: int = 1) -> dict[tuple[int, int], complex]:
    """Orders by number, up to `most`; `periods` pitches make a period."""
    step = WAVELENGTH / (one.pitch * periods)
    orders = orders_of(one, WAVELENGTH, most * step)
    return {(round(o.direction[0] / step), round(o.direction[1] / step)): o.amplitude for o in orders}


def geometry(focal: float, radius: float, distance: float, sine: float, output: Grid) -> DoublePassGeometry:
    z, _ = lens_numbers(focal, distance)
    return DoublePassGeometry(
        WAVELENGTH, radius, focal, z, PROBE_FOCAL, math.hypot(output.width, output.height) / 2, sine
    )


def by_orders(g: DoublePassGeometry, output: Grid, orders: tuple[Order, ...], accuracy: float = 3e-3) -> RoundPass:
    plan = plan_round(g, accuracy, pixels=output.rows * output.columns)
    return RoundPass(g, plan, output, [Surface(g.image_distance, orders)], dtype=torch.complex128)


def by_samples(
    g: DoublePassGeometry, output: Grid, one: TargetSensor, finest: float, accuracy: float = 1e-2
) -> DoublePass:
    plan = plan_double_pass(g, accuracy, pixels=output.rows * output.columns, finest=finest)
    return DoublePass(g, plan, output, mask=reflectance_at(one, WAVELENGTH), dtype=torch.complex128)


def widest(g: DoublePassGeometry) -> float:
    """Orders whose light still finds the aperture, diffraction included."""
    return 1.35 * (g.return_radius + g.radius) / g.image_distance + 2 * g.tangent


# Array, microlens, pixels of the sensor, f, r, x_d, tilt, and what is special about it.
AGREEING = {
    "square photosites": (PixelArray(fill=0.5), None, (649, 487), 0.05, 0.8e-3, math.inf, (0.0, 0.0)),
    "square, tilted, out of focus": (PixelArray(fill=0.5), None, (648, 486), 0.05, 0.8e-3, 3.0, (0.003, 0.006)),
    "hexagons": (PixelArray(fill=0.6, shape="hexagon"), None, (648, 487), 0.05, 0.8e-3, 3.0, (0.003, 0.006)),
    "round, bright surround": (
        PixelArray(fill=0.6, shape="round", surround=0.3, phase=1.2),
        None,
        (648, 487),
        0.05,
        0.8e-3,
        3.0,
        (-0.005, 0.002),
    ),
    "Bayer": (PixelArray(fill=0.5, bayer=(1, 0.5, 0.4, 0.1)), None, (648, 486), 0.06, 0.6e-3, 2.0, (0.002, -0.003)),
    "microlenses": (PixelArray(fill=0.5), Microlens(150e-6, 0.95), (648, 486), 0.05, 0.8e-3, 3.0, (0.003, 0.006)),
}


@pytest.mark.parametrize("case", AGREEING)
def test_orders_agree_with_the_sampled_array(validated: Validated, case: str) -> None:
    array, lens, pixels, focal, radius, distance, tilt = AGREEING[case]
    one, output = sensor(array, lens, pitch=30e-6, pixels=pixels), Grid(40, 40, 8e-6)
    g = geometry(focal, radius, distance, math.hypot(*tilt), output)
    orders = orders_of(one, WAVELENGTH, widest(g))
    assert len(orders) >= 9
    sines = torch.tensor([tilt], dtype=torch.float64)
    got = by_orders(g, output, orders).field(sines)[0]
    want = by_samples(g, output, one, one.pitch / 5).field(sines)[0]
    # The grids leave out the mirror's own phase, the same for all orders.
    got = got * cmath.exp(-1j * K * g.image_distance * math.tan(math.asin(math.hypot(*tilt))) ** 2)
    peak = float(want.abs().max())
    lengths = f"p = 30 um, f = {focal * 1e3:g} mm, r = {radius * 1e3:g} mm, x_d = {distance:g} m"
    what = f"{case}, {lengths}, {len(orders)} orders"
    against = "the array sampled, double pass by grids"
    validated(SECTION, f"{what}: complex field", (got - want).abs().max() / peak, 1e-3, against)
    irradiance = (got.abs() ** 2 - want.abs() ** 2).abs().max() / peak**2
    validated(SECTION, f"{what}: irradiance", irradiance, 1e-3, against)
    # A mirror's picture is another one.
    mirror = by_orders(g, output, (Order(amplitude=orders[0].amplitude),)).field(sines)[0]
    assert float((mirror - want).abs().max()) > 0.02 * peak


def test_order_powers_of_square_photosites(validated: Validated) -> None:
    found, side = amplitudes(sensor(PixelArray(fill=0.5))), math.sqrt(0.5)
    against = "fill sinc(m w/p), w/p = √fill"
    validated(SECTION, "Fill 0.5: power in order 0", abs(abs(found[0, 0]) ** 2 - 0.25), 1e-12, against, "of the light")
    want = (0.5 * math.sin(math.pi * side) / (math.pi * side)) ** 2
    validated(SECTION, "Fill 0.5: power in order ±1", abs(abs(found[1, 0]) ** 2 - want), 1e-12, against, "of the light")
    assert abs(found[0, -1]) ** 2 == pytest.approx(want)
    # A lone mirror has one order; nothing is left of the others when the photosites fill the plane.
    assert amplitudes(sensor(PixelArray(fill=1.0), reflectance=0.3)) == {(0, 0): pytest.approx(math.sqrt(0.3))}
    assert orders_of(sensor(reflectance=0.3), WAVELENGTH, 0.5) == (Order(amplitude=math.sqrt(0.3)),)
    assert orders_of(sensor(PixelArray(), reflectance=0.0), WAVELENGTH, 0.5) == ()


def test_hexagons_against_quadrature(validated: Validated) -> None:
    """Row by row: of a row 2w wide ∫ cos(2πνx) dx is 2w sinc(2wν)."""
    corner = math.sqrt(2 * 0.6 / math.sqrt(27))

    def by_rows(across: int, down: int) -> float:
        def row(y: float) -> float:
            half = min(math.sqrt(3) / 2 * corner, math.sqrt(3) * (corner - y))
            return 4 * half * float(np.sinc(2 * half * across)) * math.cos(2 * math.pi * down * y)

        return quad(row, 0, corner, points=[corner / 2], limit=200)[0]

    found = amplitudes(sensor(PixelArray(fill=0.6, shape="hexagon")))
    error = max(abs(found[m] - by_rows(*m)) for m in ((0, 0), (1, 0), (0, 1), (2, 1), (1, -2), (3, 3)))
    validated(SECTION, "Hexagonal photosites, fill 0.6: amplitudes", error, 1e-9, "quadrature", "of the amplitude")
    with pytest.raises(ValueError, match=r"hexagon photosites fill at most 0\.65 of the plane"):
        PixelArray(fill=0.7, shape="hexagon")


def test_round_photosites_and_microlenses_against_radial_integrals(validated: Validated) -> None:
    a = math.sqrt(0.4 / math.pi)

    def radial(upto: float, nu: float, bend: float) -> complex:
        def part(turn: float) -> float:
            return quad(lambda t: math.cos(bend * t**2 + turn) * j0(2 * math.pi * nu * t) * 2 * math.pi * t, 0, upto)[0]

        return complex(part(0.0), part(math.pi / 2))

    found = amplitudes(sensor(PixelArray(fill=0.4, shape="round")))
    error = max(abs(found[m] - radial(a, math.hypot(*m), 0)) for m in ((0, 0), (1, 0), (2, 1), (3, 3)))
    validated(SECTION, "Round photosites, fill 0.4: amplitudes", error, 1e-9, "radial quadrature", "of the amplitude")
    lens, bend = Microlens(6e-6, 0.9), K * PITCH**2 / 6e-6
    found, rim = amplitudes(sensor(None, lens)), cmath.exp(-1j * bend * 0.45**2)
    errors = []
    for m in ((0, 0), (1, 0), (2, 1), (3, 3)):
        # The disc's own chirp in place of the flat that goes on at its rim's height.
        flat = rim * ((m == (0, 0)) - radial(0.45, math.hypot(*m), 0))
        errors.append(abs(found[m] - flat - radial(0.45, math.hypot(*m), bend)))
    validated(SECTION, "Microlenses, f = 6 um, p = 2.2 um: amplitudes", max(errors), 1e-5, "radial quadrature", "of 1")


CELLS = {
    "square": (PixelArray(fill=0.5), None),
    "square, bright surround": (PixelArray(fill=0.5, surround=0.3, phase=-2.0), None),
    "round": (PixelArray(fill=0.5, shape="round", surround=0.2), None),
    "hexagons": (PixelArray(fill=0.6, shape="hexagon", surround=0.2), None),
    "Bayer": (PixelArray(fill=0.5, bayer=(1, 0.5, 0.4, 0.1), surround=0.1), None),
    "microlens": (None, Microlens(6e-6)),
    "all": (
        PixelArray(fill=0.5, shape="round", surround=0.1, phase=0.4, bayer=(1, 0.5, 0.4, 0.1)),
        Microlens(6e-6, 0.9),
    ),
}


@pytest.mark.parametrize("case", CELLS)
def test_sampled_cells_have_the_orders_coefficients(validated: Validated, case: str) -> None:
    """Fourier sums over one period of the plane in real space, with the place of the array's corner in them."""
    array, lens = CELLS[case]
    for pixels in ((649, 487), (648, 486)):
        one = sensor(array, lens, pixels=pixels, reflectance=0.3)
        period, count = (2 if case in ("Bayer", "all") else 1) * PITCH, 240
        place = torch.arange(count, dtype=torch.float64) / count * period
        x, y = place + 31.7e-6, place - 12.3e-6
        plane = reflectance_at(one, WAVELENGTH)(x, y)
        error = 0.0
        for order in orders_of(one, WAVELENGTH, 6.01 * WAVELENGTH / period):
            kernel = phasor(-K * (order.direction[0] * x[None, :] + order.direction[1] * y[:, None]))
            error = max(error, abs(complex((plane * kernel).mean()) - order.amplitude))
    validated(SECTION, f"Cell of {case}: amplitudes", error, 1e-5, "Fourier sums over the plane in real space", "of 1")


def test_fine_cells_have_converged(validated: Validated) -> None:
    errors = []
    for array, lens in ((PixelArray(shape="round"), None), (PixelArray(fill=0.6), Microlens(6e-6, 0.9))):
        cell, nu = _cell_of(sensor(array, lens), WAVELENGTH), np.arange(-12, 13) / 2
        assert cell is not None
        both = []
        for count in (512, 2048):
            edges, values = cell.fine(count)
            kernel = _of_steps(edges / cell.pitch, nu)
            both.append(kernel @ values @ kernel.T)
        errors.append(np.abs(both[0] - both[1]).max())
    validated(SECTION, "Cells of 512 samples a pitch: amplitudes", max(errors), 3e-5, "2048 samples a pitch", "of 1")


def test_registration() -> None:
    """Odd counts put a photosite's centre on the axis, even ones a corner; Bayer begins in the upper left corner."""
    array = PixelArray(fill=0.25)
    place = torch.tensor([-0.05, 0.0, 0.05], dtype=torch.float64) * PITCH
    assert float(reflectance_at(sensor(array), WAVELENGTH)(place, place).abs()[1, 1]) == pytest.approx(1, abs=1e-9)
    even = reflectance_at(sensor(array, pixels=(648, 486)), WAVELENGTH)
    assert float(even(place, place).abs()[1, 1]) == pytest.approx(0, abs=1e-9)
    colours = (1.0, 0.64, 0.36, 0.16)
    one = sensor(PixelArray(fill=0.5, bayer=colours), pixels=(6, 4))
    for row in range(4):
        for column in range(6):
            x, y = place + (column - 2.5) * PITCH, place + (row - 1.5) * PITCH
            got = complex(reflectance_at(one, WAVELENGTH)(x, y)[1, 1])
            assert got == pytest.approx(math.sqrt(colours[2 * (row % 2) + column % 2]), abs=1e-9)
    # A binned sensor's photosites are finer than its pixels, and share its corner.
    binned = TargetSensor(1.0, (3, 3), 4 * PITCH, PixelArray(pitch=PITCH, fill=0.25))
    assert float(reflectance_at(binned, WAVELENGTH)(place, place).abs()[1, 1]) == pytest.approx(0, abs=1e-9)


def test_parseval(validated: Validated) -> None:
    """The orders carry what the plane reflects; of sharp edges the sum converges slowly, like 1/m."""
    found = amplitudes(sensor(PixelArray(fill=0.5, surround=0.2, phase=1.0)), most=60)
    total = sum(abs(c) ** 2 for c in found.values())
    want = 0.5 + 0.5 * 0.2
    validated(SECTION, "Sum of all orders' powers, |m| <= 60", abs(total - want), 6e-3, "mean |Arr|²", "of the light")
    lens = sum(abs(c) ** 2 for c in amplitudes(sensor(None, Microlens(6e-6)), most=25).values())
    validated(SECTION, "Microlenses: sum of all orders' powers, |m| <= 25", abs(lens - 1), 5e-4, "1", "of the light")


@pytest.mark.parametrize(("number", "count"), [(1.4, 21), (1.9, 9), (2.8, 5)])
def test_order_counts_of_phones(validated: Validated, number: float, count: int) -> None:
    found = orders_of(sensor(PixelArray(fill=0.4)), WAVELENGTH, 1 / number)
    what = f"Orders that overlap the aperture, p = 2.2 um, f/{number}"
    validated(SECTION, what, abs(len(found) - count), 0, f"|m| λ/p < 1/F: {count}", "orders")
    assert all(math.hypot(*order.direction) < 1 / number for order in found)


def grating(order: float) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
    """One order of pitch 40 um along y, alone."""
    return lambda x, y: phasor(K * order * WAVELENGTH / 40e-6 * y[..., :, None]) * torch.ones_like(x[..., None, :])


@pytest.mark.parametrize("distance", [math.inf, 1.5])
def test_an_order_is_displaced_and_leaves_at_its_angle(validated: Validated, distance: float) -> None:
    """Sampled, as one sinusoidal phase: displaced by mλz/p, and leaving at -mλ x_i/(p f), so together in focus."""
    focal, radius, m, p = 0.05, 3e-3, 1, 40e-6
    output = Grid(8, 8, 10e-6)
    g = geometry(focal, radius, distance, 0.0, output)
    z, excess = lens_numbers(focal, distance)
    plan = plan_double_pass(g, 1e-3, finest=p / 4)
    one = DoublePass(g, plan, output, mask=grating(m), dtype=torch.complex128)
    field = one.exit_pupil(torch.zeros(1, 2, dtype=torch.float64))[0][0] / one.pupil.exit.abs().clamp_min(1e-30)
    inside = one.pupil.exit.abs() > 1e-3 * one.pupil.exit.abs().max()
    shift = m * WAVELENGTH * z / p
    # Of two discs, r and the returning one, the far edge of the overlap is the aperture's: take the near edge.
    column = int(one.pupil.x.abs().argmin())
    profile = torch.where(inside, field.abs() ** 2, torch.zeros(()))[:, column]
    order = one.pupil.y.argsort()
    y, lit = one.pupil.y[order], profile[order]
    near = float(y[int((lit > 0.25 * float(lit.median())).nonzero()[0])])
    got = near + g.return_radius
    what = f"Order 1 of p = 40 um, f = 50 mm, x_d = {distance:g} m"
    validated(SECTION, f"{what}: displacement", abs(got - shift) / radius, 0.02, "mλz/p", "of r")
    # Around the middle of the beam, where the ray through the lens' middle comes back.
    some = (one.pupil.y - shift).abs() < 0.6e-3
    phase = np.unwrap(np.angle(field[some][:, column].numpy()))
    slope = np.polyfit((one.pupil.y[some] - shift).numpy(), phase, 2)[1] / K
    want = -m * WAVELENGTH * excess / (p * focal)
    validated(SECTION, f"{what}: exit angle", abs(slope - want), 1e-8, "-mλ x_i/(p f)", "rad")


def exit_power(one: DoublePass | RoundPass, sines: torch.Tensor) -> torch.Tensor:
    """Power that leaves the lens, in fractions of what enters."""
    outside = one(sines)
    return outside.sum((1, 2)) * one.output.pitch**2 / (math.pi * one.geometry.radius**2)


@pytest.mark.parametrize("share", [0.5, 1.0, 1.9, 2.2])
def test_an_order_passes_by_its_f_number(validated: Validated, share: float) -> None:
    """At F/# = p/(2λ) the order's centre meets the lens' rim, at p/λ nothing of it passes."""
    focal, p = 0.05, 40e-6
    radius = focal / (2 * share * p / (2 * WAVELENGTH))
    output = Grid(64, 64, 0.05 * WAVELENGTH * PROBE_FOCAL / radius * 2)
    g = geometry(focal, radius, math.inf, 0.0, output)
    plan = plan_double_pass(g, 3e-3, finest=p / 4)
    one = DoublePass(g, plan, output, mask=grating(1), dtype=torch.complex128)
    field = one.exit_pupil(torch.zeros(1, 2, dtype=torch.float64))[0][0]
    density = field.abs() ** 2 / one.pupil.exit.abs().clamp_min(1e-30)
    power = float(density.sum()) * (WAVELENGTH * PROBE_FOCAL) ** 2 / (math.pi * radius**2)
    what = f"Order 1 at F/# = {share:g} p/2λ, in focus: power that passes the lens"
    want = disc_overlap(radius, radius, WAVELENGTH * focal / p)
    validated(SECTION, what, abs(power - want), 0.02, "the area that discs mλz/p apart share", "of the order's")


def test_littrow(validated: Validated) -> None:
    """At s = -mλ/2p order m comes back as from a mirror head on: a camera answers past the mirror's cut-off."""
    focal, radius, p = 4e-3, 0.5e-3, 2.2e-6
    sine = WAVELENGTH / (2 * p)
    assert sine > 1.1 * radius / focal
    output = Grid(96, 96, 12e-6)
    g = geometry(focal, radius, math.inf, sine, output)
    one = sensor(PixelArray(fill=0.5), pitch=p)
    orders = orders_of(one, WAVELENGTH, 2 * (radius / focal + sine))
    sines = torch.tensor([[-sine, 0.0]], dtype=torch.float64)
    head_on = exit_power(by_orders(geometry(focal, radius, math.inf, 0.0, output), output, (Order(),)), 0 * sines)
    want = amplitudes(one)[1, 0]
    grating_power = exit_power(by_orders(g, output, orders), sines)
    ratio = float(grating_power / head_on) / abs(want) ** 2
    what = "Littrow, p = 2.2 um, f/4: returned power at s = -λ/2p"
    validated(SECTION, what, abs(ratio - 1), 0.03, "|c_1|² of a mirror's head on", "of it")
    mirror = float(exit_power(by_orders(g, output, (Order(),)), sines) / head_on)
    assert mirror < 1e-2 * abs(want) ** 2


def test_power_swings_with_the_spots_place_in_a_pixel(validated: Validated) -> None:
    """In focus at f/1.4, 21 orders interfere: period p/f of gaze, photosites bright and gaps dark."""
    focal, p = 4e-3, PITCH
    output, radius = Grid(48, 48, 6e-6), 4e-3 / 2.8
    one = sensor(PixelArray(fill=0.4), pitch=p)
    turns = torch.arange(5, dtype=torch.float64) / 4
    sines = torch.stack([turns * p / focal, torch.zeros(5).double()], -1)
    g = geometry(focal, radius, math.inf, float(sines.max()), output)
    orders = exit_power(by_orders(g, output, orders_of(one, WAVELENGTH, widest(g))), sines)
    samples = exit_power(by_samples(g, output, one, p / 5), sines)
    what = "f/1.4, p = 2.2 um, in focus, five places in a pixel: returned power"
    validated(
        SECTION, what, ((orders - samples).abs() / samples.max()).max(), 3e-3, "the array sampled", "of the largest"
    )
    assert float(orders[0] / orders[2]) > 2
    repeats = abs(float(orders[4] / orders[0]) - 1)
    validated(SECTION, "f/1.4, p = 2.2 um: returned power a pixel on", repeats, 0.01, "period p/f of gaze", "of it")


def mask_of(values: np.ndarray, path: Path, pitch: float = 1e-6, reflectance: float = 1.0) -> TargetSensor:
    np.save(path, values)
    return TargetSensor(reflectance, mask=SensorMask(str(path), pitch))


def test_files_are_interpolated_and_end(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    values = rng.uniform(0, 0.7, (5, 8)) * np.exp(1j * rng.uniform(-3, 3, (5, 8)))
    plane = reflectance_at(mask_of(values, tmp_path / "a.npy", reflectance=0.49), WAVELENGTH)
    # Steps so fine that nothing is smoothed.
    x, y = (torch.arange(3).double() * 1e-10 + at for at in (0.3e-6, -0.8e-6))
    column, row = 0.3 + 3.5, -0.8 + 2.0
    i, j, across, down = 3, 1, column - 3, row - 1
    want = (1 - down) * ((1 - across) * values[j, i] + across * values[j, i + 1]) + down * (
        (1 - across) * values[j + 1, i] + across * values[j + 1, i + 1]
    )
    assert abs(complex(plane(x, y)[0, 0]) - 0.7 * want) < 1e-3
    # The middle on the axis, and nothing outside, however far.
    wide = torch.linspace(-12e-6, 12e-6, 241).double()
    whole = plane(wide, wide)
    assert max(float(w.abs().max()) for w in (whole[:, wide.abs() > 5e-6], whole[wide.abs() > 3.6e-6])) < 1e-9
    assert float(plane(wide + 1.0, wide - 3.0).abs().max()) == 0
    total = complex(whole.sum()) * (0.1e-6) ** 2
    assert abs(total - 0.7 * values.sum() * 1e-12) < 1e-3 * abs(total)
    batch = plane(torch.stack([wide, wide + 1e-6]), torch.stack([wide, wide]))
    assert batch.shape == (2, 241, 241)
    assert torch.allclose(batch[1, :, :-10], batch[0, :, 10:], atol=1e-9)


def test_a_file_of_photosites_is_the_array(validated: Validated, tmp_path: Path) -> None:
    """An array written out finely: files and arrays go the same way."""
    focal, radius, output, p = 0.05, 0.8e-3, Grid(24, 24, 12e-6), 30e-6
    one = sensor(PixelArray(fill=0.5), pitch=p)
    fine = (torch.arange(480).double() - 239.5) * 1.5e-6
    masked = mask_of(reflectance_at(one, WAVELENGTH)(fine, fine).numpy() * 0.9, tmp_path / "a.npy", 1.5e-6)
    g = geometry(focal, radius, math.inf, 0.0, output)
    sines = torch.zeros(1, 2, dtype=torch.float64)
    plan = plan_double_pass(g, 1e-2, finest=6e-6)
    got, want = (
        DoublePass(g, plan, output, mask=reflectance_at(s, WAVELENGTH), dtype=torch.complex128)(sines)
        for s in (masked, one)
    )
    error = (got / 0.81 - want).abs().max() / want.max()
    validated(SECTION, "Photosites of 30 um from a .npy of 1.5 um: irradiance", error, 1e-2, "the array itself")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros(4, complex), "holds complex128 of shape (4,); give complex amplitudes [rows, columns]"),
        (np.zeros((0, 4), complex), "of shape (0, 4)"),
        (np.array([["a", "b"]]), "holds <U1 of shape (1, 2); give complex amplitudes"),
        (np.array([[1.0, math.nan]]), "holds values that are not finite; replace them"),
        (np.array([[1.0, 1j * math.inf]]), "holds values that are not finite; replace them"),
        (np.array([[2.0, 0.0]]), "reflects 4 of the light at its brightest; scale its amplitudes"),
        (np.array([[None, 1j]], dtype=object), "is no .npy of plain numbers; write it with numpy.save"),
    ],
)
def test_files_that_are_no_mask_are_refused(values: np.ndarray, words: str, tmp_path: Path) -> None:
    path = tmp_path / "mask.npy"
    np.save(path, values, allow_pickle=True)
    with pytest.raises(InputError) as raised:
        reflectance_at(TargetSensor(mask=SensorMask(str(path), 1e-6), reflectance=1.0), WAVELENGTH)
    line = str(raised.value)
    assert line.startswith(f"target.sensor.mask.file: {path}") and words in line and raised.value.remedy


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no file .*none\.npy; give the path of a \.npy file"):
        reflectance_at(TargetSensor(mask=SensorMask(str(tmp_path / "none.npy"), 1e-6)), WAVELENGTH)
    for name, content in (("text.npy", b"no numbers"), ("short.npy", b"\x93NUMPY\x01\x00"), ("empty.npy", b"")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"{name} is no \.npy of plain numbers"):
            reflectance_at(TargetSensor(mask=SensorMask(str(tmp_path / name), 1e-6)), WAVELENGTH)
    with pytest.raises(InputError, match=r"is no \.npy"):
        reflectance_at(TargetSensor(mask=SensorMask(str(tmp_path), 1e-6)), WAVELENGTH)
    np.savez(tmp_path / "many.npz", a=np.zeros(3))
    with pytest.raises(InputError, match="several arrays; write one"):
        reflectance_at(TargetSensor(mask=SensorMask(str(tmp_path / "many.npz"), 1e-6)), WAVELENGTH)


def test_other_refusals(tmp_path: Path) -> None:
    masked = mask_of(np.ones((3, 3)), tmp_path / "a.npy")
    with pytest.raises(InputError, match=r"target\.sensor\.mask: has no diffraction orders; sample it"):
        orders_of(masked, WAVELENGTH, 0.1)
    with pytest.raises(InputError, match=r"array\.pitch: a pitch of 100 um sends .* orders .*; stop the target"):
        orders_of(sensor(PixelArray(), pitch=100e-6), WAVELENGTH, 1.0)
    one = torch.zeros(1, dtype=torch.float64)
    with pytest.raises(InputError, match="two columns and rows or more"):
        reflectance_at(masked, WAVELENGTH)(one, one)


def test_a_window_cuts_the_pattern_itself() -> None:
    """What samples see of photosites up to an edge adds up to their integral, wherever the edge cuts them."""
    one = sensor(PixelArray(pitch=2e-6, fill=0.5, surround=0.2))
    x = torch.linspace(-10e-6, 11e-6, 176, dtype=torch.float64)
    y = torch.linspace(-7e-6, 6e-6, 131, dtype=torch.float64)
    area = float((x[1] - x[0]) * (y[1] - y[0]))
    plain = reflectance_at(one, WAVELENGTH)
    cut, multiplied = [], []
    for right in np.arange(5e-6, 7e-6, 0.13e-6):
        window = (-7.3e-6, float(right), -5.12e-6, 4.4e-6)
        # By midpoints that tile the window.
        fine_x = window[0] + (torch.arange(2000, dtype=torch.float64) + 0.5) * (window[1] - window[0]) / 2000
        fine_y = window[2] + (torch.arange(952, dtype=torch.float64) + 0.5) * 10e-9
        want = complex(plain(fine_x, fine_y).mean()) * (window[1] - window[0]) * (window[3] - window[2])
        cut.append(abs(complex(reflectance_at(one, WAVELENGTH, window)(x, y).sum()) * area / want - 1))
        product = plain(x, y) * reflectance_at(sensor(), WAVELENGTH, window)(x, y)
        multiplied.append(abs(complex(product.sum()) * area / want - 1))
    assert max(cut) < 2e-4
    # Two means multiplied are not the mean of the product.
    assert max(multiplied) > 10 * max(cut)
