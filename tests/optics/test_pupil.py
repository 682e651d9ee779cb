"""Quadrature over the pupil against integrals in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.special import j1

from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.pupil import disc_quadrature

RADIUS = 3e-3


def test_area_and_moments() -> None:
    disc = disc_quadrature(RADIUS, 40, 40)
    assert float(disc.weights.sum()) == pytest.approx(math.pi * RADIUS**2, rel=1e-6)
    second = float((disc.weights * disc.rho_squared()).sum())
    assert second == pytest.approx(math.pi * RADIUS**4 / 2, rel=1e-6)
    along_x = float((disc.weights * disc.x**2).sum())
    along_y = float((disc.weights * disc.y[:, None] ** 2).sum())
    assert along_x == pytest.approx(along_y, rel=1e-6)
    odd = float((disc.weights * disc.x[None] * disc.y[:, None] ** 2).sum())
    assert abs(odd) < 1e-12 * second


def test_airy_amplitude_in_every_direction() -> None:
    """∫ exp(-iκ x·u) over the disc is 2πr² J1(κru)/(κru)."""
    disc = disc_quadrature(RADIUS, 96, 140)
    u = torch.linspace(-1, 1, 41, dtype=torch.float64)
    kappa = 40 / RADIUS
    got = MatrixFourier(disc.x, disc.y, u, u, kappa)(disc.weights.to(torch.complex128))
    argument = kappa * RADIUS * np.hypot(*np.meshgrid(u.numpy(), u.numpy()))
    argument[argument == 0] = 1e-12
    want = 2 * math.pi * RADIUS**2 * j1(argument) / argument
    # At the corners the field turns 56 radians over the radius: 1.2 a step, 0.37 of the Nyquist limit.
    assert np.abs(got.numpy() - want).max() < 3e-5 * math.pi * RADIUS**2


def test_defocused_disc_on_its_axis() -> None:
    """∫ exp(iaρ²) over the disc is π (exp(iar²) - 1)/(ia)."""
    turns = 60.0
    disc = disc_quadrature(RADIUS, 240, 340)
    a = turns / RADIUS**2
    got = (disc.weights * phasor(a * disc.rho_squared())).sum()
    want = math.pi * (np.exp(1j * turns) - 1) / (1j * a)
    assert abs(complex(got) - want) < 5e-4 * abs(want)


def test_the_edge_converges_fast() -> None:
    """Twice the samples, and the error falls by far more than the 4 of area-weighted pixels."""
    u = torch.tensor([0.9], dtype=torch.float64)
    kappa = 30 / RADIUS
    want = 2 * math.pi * RADIUS**2 * j1(27.0) / 27.0

    def error(columns: int) -> float:
        disc = disc_quadrature(RADIUS, columns, 200)
        zero = torch.zeros(1, dtype=torch.float64)
        got = MatrixFourier(disc.x, disc.y, u, zero, kappa)(disc.weights.to(torch.complex128))
        return abs(complex(got[0, 0]) - want)

    assert error(80) < error(40) / 16
