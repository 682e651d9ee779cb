"""Round fields by one fast Fourier transform, against a Hankel transform by quadrature, and their derivatives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.special import j0, j1, roots_legendre

from tapetum.optics.grid import lens_numbers
from tapetum.optics.radial import disc_transform, returning_field, spot_field
from tapetum.optics.sampling import DoublePassGeometry, Fade, plan_round

WAVELENGTH = 640e-9
K = 2 * math.pi / WAVELENGTH


def hankel(radius: float, chirp: float, kappa: float, xi: np.ndarray, nodes: int) -> np.ndarray:
    """2π ∫ J0(κξρ) exp(i chirp ρ²) ρ dρ by Gauss-Legendre quadrature."""
    x, w = roots_legendre(nodes)
    rho, weight = (x + 1) * radius / 2, w * radius / 2
    waves = np.exp(1j * chirp * rho**2) * rho * weight
    return 2 * np.pi * np.array([j0(kappa * one * rho) @ waves for one in xi])


@pytest.mark.parametrize(("radius", "nodes"), [(0.5e-3, 400), (3e-3, 1200), (12.7e-3, 5000)])
def test_disc_transform_against_quadrature(radius: float, nodes: int, validated: Any) -> None:
    z, f = lens_numbers(0.1, 1.0)[0], 0.1
    chirp, kappa = K / 2 * (1 / (2 * z) - 1 / f), K / (2 * z)
    values, step = disc_transform(radius, chirp, kappa, radius + 2 * z * 0.0175)
    places = np.linspace(0, len(values) - 3, 33).astype(int)
    want = hankel(radius, chirp, kappa, places * step, nodes)
    error = np.abs(values[places] - want).max() / np.abs(want).max()
    validated("Round fields", f"returning field, f = 100 mm, x_d = 1 m, r = {radius * 1e3:g} mm", error, 2e-6,
              "Hankel transform by quadrature")  # fmt: skip


def test_without_a_chirp_it_is_airys(validated: Any) -> None:
    values, step = disc_transform(1e-3, 0.0, K / 0.1, 4e-4)
    argument = np.maximum(K / 0.1 * 1e-3 * step * np.arange(len(values)), 1e-12)
    want = math.pi * 1e-6 * 2 * j1(argument) / argument
    validated("Round fields", "transform of a disc without chirp", np.abs(values - want).max() / want[0], 1e-8,
              "2 J1(v)/v")  # fmt: skip


@pytest.mark.parametrize("chirp", [3e6, -3e6])
def test_derivatives_along_the_radius(chirp: float) -> None:
    values, step, first, second = disc_transform(1e-3, chirp, 5e7, 5e-4, spacing=1e-7, moments=True)
    scale = np.abs(first).max()
    assert np.abs(np.gradient(values, step)[1:-1] - first[1:-1]).max() < 2e-3 * scale
    assert np.abs(np.gradient(first, step)[1:-1] - second[1:-1]).max() < 2e-3 * np.abs(second).max()


@pytest.mark.parametrize(
    ("name", "change"), [("image_distance", 1e-8), ("vergence", 1e-5), ("radius", 1e-9), ("wavenumber", 10.0)]
)
@pytest.mark.parametrize("radius", [0.5e-3, 3e-3])
def test_partial_derivatives_of_the_table(name: str, change: float, radius: float) -> None:
    z = lens_numbers(0.1, 1.0)[0]
    start = {"image_distance": z, "vergence": -9.8, "radius": radius, "wavenumber": K}

    def table(**values: float) -> Any:
        v = {**start, **values}
        lengths = 2 * math.pi / v["wavenumber"], v["radius"], v["image_distance"], v["vergence"]
        return returning_field(*lengths, 3 * radius, (0.012, 0.025), partials=True)

    places = torch.linspace(0, 2.5 * radius, 60, dtype=torch.float64)

    def at(one: Any) -> torch.Tensor:
        return one.smooth(places / one.step)

    up, down = (table(**{name: start[name] + sign * change}) for sign in (1, -1))
    numeric = (at(up) - at(down)) / (2 * change)
    told = table()
    ours = type(told)(told.partials[name], told.step, {}).smooth(places / told.step)
    # A filter of fixed slopes is not quite the same filter in another light.
    assert float((ours - numeric).abs().max() / numeric.abs().max()) < 2e-3


@pytest.mark.parametrize(
    ("radius", "focal_length", "image_distance", "accuracy"),
    [
        (20e-6, 66e-6, 240e-6, 1e-3),
        (2e-6, 94e-6, 94e-6, 1e-2),
        (21e-6, 2.6e-3, 2.6e-3, 1e-3),
        (0.16e-3, 5e-3, 6.6e-3, 1e-4),
    ],
)
def test_tables_of_small_apertures(
    radius: float, focal_length: float, image_distance: float, accuracy: float, validated: Any
) -> None:
    """Their plans keep rings to slopes that their light does not have."""
    f, z = focal_length, image_distance
    plan = plan_round(DoublePassGeometry(WAVELENGTH, radius, f, z, 0.05, 0.0), accuracy)
    table = returning_field(WAVELENGTH, radius, z, -1 / f, 1.05 * radius, (plan.flat_slope, plan.end_slope))
    places = torch.linspace(0, radius, 41, dtype=torch.float64)
    light = hankel(radius, K / 2 * (1 / (2 * z) - 1 / f), K / (2 * z), places.numpy(), 400)
    want = np.exp(-0.25j * K / z * places.numpy() ** 2) / (2j * WAVELENGTH * z) * light
    error = np.abs(table.smooth(places / table.step).numpy() - want).max() / np.abs(want).max()
    validated("Round fields", f"returning field, r = {radius * 1e6:g} µm, f = {f * 1e3:g} mm, z = {z * 1e3:g} mm",
              error, 1e-6, "Hankel transform by quadrature")  # fmt: skip


def test_a_table_of_next_to_no_aperture_takes_little_memory() -> None:
    plan = plan_round(DoublePassGeometry(WAVELENGTH, 0.4e-6, 70e-6, 70e-6, 0.05, 0.0), 1e-4)
    fade = Fade.of((plan.flat_slope, plan.end_slope), WAVELENGTH, 0.4e-6, 70e-6, 0.42e-6)
    assert fade.end < 0.1 * plan.end_slope
    table = returning_field(WAVELENGTH, 0.4e-6, 70e-6, -1 / 70e-6, 0.42e-6, (plan.flat_slope, plan.end_slope))
    assert len(table.values) < 1 << 16


def test_nearest_and_smooth_agree() -> None:
    table = returning_field(WAVELENGTH, 3e-3, 0.11, -10.0, 6e-3, (0.012, 0.025))
    steps = torch.rand(4000, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 5e-3 / table.step
    apart = (table.smooth(steps) - table.nearest(steps.clone())).abs()
    assert float(apart.max()) < 0.01 * float(table.values.abs().max())
    whole = torch.arange(0, 4000, dtype=torch.float64)
    assert torch.allclose(table.smooth(whole), table.values[:4000], atol=1e-12)


def test_the_spot_holds_the_light(validated: Any) -> None:
    """Parseval: the power on the sensor is that which entered, but for the rings beyond the table."""
    z = lens_numbers(0.1, 2.0)[0]
    field, step = spot_field(WAVELENGTH, 2e-3, z, -10.0, 6e-3)
    power = np.trapezoid(np.abs(field) ** 2 * 2 * np.pi * step * np.arange(len(field)), dx=step)
    validated("Round fields", "power of the spot on the sensor, r = 2 mm, x_d = 2 m",
              abs(power / (math.pi * 4e-6) - 1), 3e-3, "the power that entered", "relative")  # fmt: skip
