"""Readings between samples: of waves, whose damping and copies are known, and of a window's transform."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from tapetum.optics.splines import read_between, undamped

SECTION = "Propagation"


def places(count: int, rows: int = 40, columns: int = 50) -> tuple[torch.Tensor, torch.Tensor]:
    """Columns and rows [1, h, w] between `count` samples, some way from their ends."""
    dice = torch.Generator().manual_seed(3)
    x, y = (3 + (count - 7) * torch.rand(1, rows, columns, generator=dice, dtype=torch.float64) for _ in range(2))
    return x, y


@pytest.mark.parametrize("turn", [0.2, 0.55, 1.05, 1.75])
def test_waves_are_read_but_for_their_copies(turn: float, validated: Any) -> None:
    number = torch.arange(60, dtype=torch.float64)
    samples = (torch.exp(1j * turn * number)[:, None] * torch.exp(-0.5j * turn * number))[None]
    x, y = places(60)
    found = read_between(samples, x, y) * undamped(torch.tensor(turn)) * undamped(torch.tensor(turn / 2))
    error = float((found - torch.exp(1j * turn * (y - 0.5 * x))).abs().max())
    # Two copies on either side of each wave, of which the nearer is by far the stronger.
    copy = (turn / (2 * math.pi - turn)) ** 4 + (turn / (2 * math.pi + turn)) ** 4
    copy += (turn / (4 * math.pi - turn)) ** 4 + (turn / (4 * math.pi + turn)) ** 4
    validated(SECTION, f"waves of {turn:g} rad a sample, read between samples", error, 1.15 * copy, "the wave",
              "its amplitude")  # fmt: skip
    assert error > 0.2 * copy


def test_the_transform_of_a_window_is_read_with_phase_and_all(validated: Any) -> None:
    """As the returning field is: damping is given back to the window's samples, each at its own place."""
    dice = torch.Generator().manual_seed(5)
    window = torch.randn(1, 31, 31, generator=dice, dtype=torch.complex128)
    # The window's edge turns by one radian a sample of its transform.
    v, number = torch.linspace(-1.0, 1.0, 31, dtype=torch.float64), torch.arange(60, dtype=torch.float64)
    kernel, given = torch.exp(1j * number[:, None] * v), undamped(v)
    x, y = places(60)
    found = read_between(kernel @ (window * given * given[:, None]) @ kernel.T, x, y)
    across, down = (torch.exp(1j * at.flatten()[:, None] * v) for at in (x, y))
    wanted = torch.einsum("pi,ij,pj->p", down, window[0], across).reshape(x.shape)
    error = float((found - wanted).abs().max() / wanted.abs().max())
    validated(SECTION, "the transform of a window, 1 rad a sample at its edge, read between samples", error, 1.5e-3,
              "its sums")  # fmt: skip


def test_places_are_read_alike_however_many_at_once() -> None:
    """In parts and shared among threads, and all together where gradients are wanted."""
    dice = torch.Generator().manual_seed(6)
    samples = torch.randn(3, 40, 50, generator=dice, dtype=torch.complex128)
    x, y = (torch.rand(3, 301, 260, generator=dice, dtype=torch.float64) * 60 - 5 for _ in range(2))
    together = read_between(samples, x.clone().requires_grad_(), y)
    torch.testing.assert_close(read_between(samples, x, y), together.detach())
    torch.testing.assert_close(read_between(samples[:, :, :30], x[:, :9, :9], y[:, :9, :9]),
                               read_between(samples[:, :, :30], x, y)[:, :9, :9])  # fmt: skip


def test_what_was_sampled_is_read_with_its_gradient() -> None:
    samples = torch.ones(1, 30, 30, dtype=torch.complex128)
    x, y = (one.requires_grad_() for one in places(30, 2, 3))
    assert torch.allclose(read_between(samples, x, y), torch.ones((), dtype=torch.complex128))
    ramp = (torch.arange(30, dtype=torch.float64) + 0j)[None, None].expand(1, 30, 30)
    found = read_between(ramp, x, y)
    torch.testing.assert_close(found.real, x)
    (slope,) = torch.autograd.grad(found.real.sum(), x)
    torch.testing.assert_close(slope, torch.ones_like(x))


def test_beyond_the_ends_all_is_as_there() -> None:
    samples = torch.full((1, 9, 9), 2j, dtype=torch.complex64)
    far = torch.tensor([[[-5.0, 20.0]]])
    assert torch.allclose(read_between(samples, far, far), torch.tensor(2j, dtype=torch.complex64))
