"""Zernike modes against their definition, closed forms and an independent package."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tapetum.errors import InputError
from tapetum.optics.zernike import (
    disc_coordinates,
    mode_count,
    nm_to_noll,
    noll_to_nm,
    zernike_basis,
    zernike_noll,
    zernike_radial,
)


def test_the_order_is_nolls_table():
    table = [
        (0, 0),
        (1, 1),
        (1, -1),
        (2, 0),
        (2, -2),
        (2, 2),
        (3, -1),
        (3, 1),
        (3, -3),
        (3, 3),
        (4, 0),
        (4, 2),
        (4, -2),
    ]
    assert [noll_to_nm(j) for j in range(1, 14)] == table


@given(st.integers(1, 2000))
def test_indices_go_there_and_back(j: int):
    n, m = noll_to_nm(j)
    assert nm_to_noll(n, m) == j
    assert abs(m) <= n
    assert (n - m) % 2 == 0


def test_low_modes_are_their_closed_forms():
    rho, phi = torch.rand(50, dtype=torch.float64), 6 * torch.rand(50, dtype=torch.float64)
    known = {
        1: torch.ones_like(rho),
        2: 2 * rho * torch.cos(phi),
        3: 2 * rho * torch.sin(phi),
        4: math.sqrt(3) * (2 * rho**2 - 1),
        6: math.sqrt(6) * rho**2 * torch.cos(2 * phi),
        7: math.sqrt(8) * (3 * rho**3 - 2 * rho) * torch.sin(phi),
        11: math.sqrt(5) * (6 * rho**4 - 6 * rho**2 + 1),
    }
    for j, expected in known.items():
        torch.testing.assert_close(zernike_noll(j, rho, phi), expected, rtol=1e-13, atol=1e-13)


def test_modes_are_orthonormal_over_the_disc():
    # Gauss-Legendre along t = rho^2 and equal steps in angle integrate polynomials of these orders exactly.
    nodes, weights = np.polynomial.legendre.leggauss(16)
    t, phi = torch.from_numpy((nodes + 1) / 2), torch.arange(32, dtype=torch.float64) * 2 * math.pi / 32
    rho = t.sqrt()[:, None].expand(16, 32)
    angle = phi.expand(16, 32)
    basis = zernike_basis(12, rho * torch.cos(angle), rho * torch.sin(angle)).reshape(91, -1)
    weight = torch.from_numpy(np.repeat(weights / 2, 32) / 32)
    torch.testing.assert_close((basis * weight) @ basis.T, torch.eye(91, dtype=torch.float64), rtol=0, atol=1e-12)


def test_the_recurrence_holds_at_high_orders():
    # R_n^m(1) = 1 and |R| <= 1 inside: a sum of factorials misses both by far at n = 60.
    rho = torch.linspace(0, 1, 400, dtype=torch.float64)
    for m in (0, 2, 30, 60):
        radial = zernike_radial(60, m, rho)
        assert abs(float(radial[-1]) - 1) < 1e-12
        assert float(radial.abs().max()) <= 1 + 1e-12


def test_the_basis_holds_the_modes_in_order():
    x, y = disc_coordinates(21)
    basis = zernike_basis(6, x, y)
    assert basis.shape == (mode_count(6), 21, 21)
    for j in (1, 2, 5, 17, 28):
        torch.testing.assert_close(basis[j - 1], zernike_noll(j, torch.hypot(x, y), torch.atan2(y, x)))


def test_pixel_centres_and_directions():
    x, y = disc_coordinates(4)
    assert x[0].tolist() == [-0.75, -0.25, 0.25, 0.75]
    assert y[:, 0].tolist() == [-0.75, -0.25, 0.25, 0.75]
    # Noll's mode 2 grows to the right, mode 3 downwards.
    tilts = zernike_basis(1, x, y)
    assert tilts[1, 0, 3] > tilts[1, 0, 0]
    assert tilts[2, 3, 0] > tilts[2, 0, 0]


def test_agreement_with_the_zernike_package():
    from zernike import RZern

    peer = RZern(12)
    x, y = disc_coordinates(48)
    peer.make_cart_grid(x.numpy(), y.numpy(), unit_circle=False)
    theirs = peer.ZZ.reshape(48, 48, -1, order="F")
    ours = zernike_basis(12, x, y).numpy()
    assert peer.nk == 91
    for k, (n, m) in enumerate(zip(peer.ntab, peer.mtab, strict=True)):
        inside = (x**2 + y**2 <= 1).numpy()
        np.testing.assert_allclose(ours[nm_to_noll(int(n), int(m)) - 1][inside], theirs[..., k][inside], atol=1e-10)


def test_modes_can_be_differentiated():
    rho = torch.tensor([0.2, 0.7], dtype=torch.float64, requires_grad=True)
    phi = torch.tensor([0.3, 2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r, p: zernike_noll(8, r, p), (rho, phi))


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: noll_to_nm(0), "starts at 1"),
        (lambda: nm_to_noll(2, 1), "n = 2, m = 1"),
        (lambda: mode_count(-1), "order"),
        (lambda: disc_coordinates(0), "side"),
        (lambda: zernike_radial(3, 2, torch.ones(1)), "n = 3, m = 2"),
        (lambda: zernike_basis(2, torch.ones(2), torch.ones(3)), "differ"),
    ],
)
def test_what_does_not_exist_is_refused(call, word: str):
    with pytest.raises(InputError, match=word):
        call()
