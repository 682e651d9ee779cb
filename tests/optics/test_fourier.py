"""The matrix Fourier transform against the sum it stands for."""

from __future__ import annotations

import math

import pytest
import torch

from tapetum.optics import fourier
from tapetum.optics.fourier import (
    BandLimitedFourier,
    FoldedKernel,
    MatrixFourier,
    fast_sums,
    folded,
    naive_fourier,
    phasor,
)


def _case(rows: int, columns: int, down: int, across: int) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(3)
    # Any order and spacing will do: the transform asks for no regular grid.
    x, y = (torch.randn(n, generator=generator, dtype=torch.float64) for n in (columns, rows))
    ux, uy = (torch.randn(n, generator=generator, dtype=torch.float64) for n in (across, down))
    field = torch.randn(2, rows, columns, generator=generator, dtype=torch.complex128)
    return field, x, y, ux, uy


def test_equals_the_naive_sum_whichever_product_comes_first() -> None:
    for shape in ((5, 40, 3, 4), (40, 5, 4, 3), (6, 6, 30, 30)):
        field, *axes = _case(*shape)
        fast, slow = MatrixFourier(*axes, 2.5)(field[0]), naive_fourier(field[0], *axes, 2.5)
        assert torch.allclose(fast, slow, rtol=0, atol=1e-12)


def test_adjoint_by_the_dot_product() -> None:
    field, *axes = _case(7, 9, 5, 6)
    transform = MatrixFourier(*axes, 1.7)
    other = torch.randn(2, 5, 6, generator=torch.Generator().manual_seed(4), dtype=torch.complex128)
    forward = torch.vdot(other.flatten(), transform(field).flatten())
    back = torch.vdot(transform.adjoint(other).flatten(), field.flatten())
    assert abs(forward - back) < 1e-12 * abs(forward)


def test_single_precision_keeps_large_phases() -> None:
    x = torch.linspace(-3e-3, 3e-3, 64, dtype=torch.float64)
    u = torch.linspace(-7e-4, 7e-4, 32, dtype=torch.float64)
    # 5e7 rad/m² as in a real scene: a phase of 100 radians at the corners, and 1e4 with an offset of both.
    kappa, x, u = 5e7, x + 0.1, u + 2e-3
    field = torch.ones(64, 64, dtype=torch.complex64)
    exact = MatrixFourier(x, x, u, u, kappa, torch.complex128)(field.to(torch.complex128))
    single = MatrixFourier(x, x, u, u, kappa, torch.complex64)(field)
    assert float((single - exact).abs().max()) < 1e-5 * 64 * 64


def test_phasor_matches_its_precision() -> None:
    assert phasor(torch.zeros(2, dtype=torch.float64)).dtype == torch.complex128
    assert phasor(torch.zeros(2, dtype=torch.float32)).dtype == torch.complex64


def _pairs(count: int, reach: float) -> torch.Tensor:
    """Places in pairs about zero, unevenly spaced."""
    return reach * torch.sin(torch.linspace(-1.4, 1.4, count, dtype=torch.float64))


@pytest.mark.parametrize(("columns", "rows"), [(40, 51), (51, 40)])
@pytest.mark.parametrize("middle", [0.0, 0.3])
@pytest.mark.parametrize("pixels", [7, 8, 150])
def test_pairs_of_samples_share_their_products(columns: int, rows: int, middle: float, pixels: int) -> None:
    """Few pixels are computed themselves, many by nodes; about the middle of the picture or beside it."""
    x, y = _pairs(columns, 1.0), _pairs(rows, 0.8)
    ux = torch.linspace(-1, 1, pixels, dtype=torch.float64) + middle
    generator = torch.Generator().manual_seed(5)
    field = torch.randn(2, rows, columns, generator=generator, dtype=torch.complex128)
    found = BandLimitedFourier(x, y, ux, ux.clone(), 9.0)(field)
    wanted = MatrixFourier(x, y, ux, ux, 9.0)(field)
    assert float((found - wanted).abs().max()) < 1e-10 * float(wanted.abs().max())


@pytest.mark.parametrize("shift", [0.0, 3e-4, 0.03])
def test_a_scaled_kernel_is_that_of_scaled_nodes(shift: float) -> None:
    """By derivatives for small changes of scale, by new waves for larger ones."""
    x, u = _pairs(33, 1.0), torch.linspace(-1, 1, 12, dtype=torch.float64)
    scale = 1 - shift * torch.tensor([1.0, 0.5], dtype=torch.float64)
    kernel = FoldedKernel(x, u, 40.0, torch.complex64)
    field = torch.randn(2, 33, 3, generator=torch.Generator().manual_seed(6), dtype=torch.complex64)
    found = kernel(folded(field), kernel.scaled(scale))
    wanted = phasor(-40.0 * scale[:, None, None] * u[:, None] * x) @ field.to(torch.complex128)
    assert float((found - wanted).abs().max()) < 1e-5 * float(wanted.abs().max())


def test_parts_of_the_pairs_add_up() -> None:
    x, u = _pairs(20, 1.0), torch.linspace(-1, 1, 6, dtype=torch.float64)
    kernel, field = FoldedKernel(x, u, 7.0, torch.complex128), torch.ones(20, 4, dtype=torch.complex128)
    halves = folded(field)
    parts = [kernel.partial(halves[:, rows], rows) for rows in (slice(0, 3), slice(3, 10))]
    assert torch.allclose(kernel.unfolded(parts[0] + parts[1]), kernel(halves), rtol=0, atol=1e-13)


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("dim", [-1, -2])
@pytest.mark.parametrize(("length", "count"), [(12, 5), (12, 12), (12, 30)])
def test_fast_sums_are_plain_ones_however_few_lines_are_summed_at_a_time(
    dim: int, sign: int, length: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    dice = torch.Generator().manual_seed(7)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.complex128, generator=dice)

    field = drawn(3, 11, 9)
    samples = field.shape[dim]
    before, after = drawn(3, samples), drawn(1, count)
    j, m = torch.arange(samples, dtype=torch.float64), torch.arange(count, dtype=torch.float64)
    kernel = phasor(sign * 2 * math.pi / length * j[:, None] * m) * after[0]
    want = ((field.movedim(dim, -1) * before[:, None]) @ kernel).movedim(-1, dim)
    for bytes_at_once in (1, 1500, 1 << 22):
        monkeypatch.setattr(fourier, "_BYTES_AT_ONCE", bytes_at_once)
        found = fast_sums(field, length, count, dim, sign, before=before, after=after)
        assert torch.allclose(found, want, rtol=0, atol=1e-12)
    kept = field.clone().requires_grad_()
    found = fast_sums(kept, length, count, dim, sign, before=before, after=after)
    assert torch.allclose(found, want, rtol=0, atol=1e-12)
