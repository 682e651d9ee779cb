"""The matrix Fourier transform: a Fourier integral between any two sets of rows and columns, as two matrix products.

Soummer, Pueyo, Sivaramakrishnan and Vanderbei, "Fast computation of Lyot-style coronagraph propagation",
Opt. Express 15, 15935 (2007).
"""

from __future__ import annotations

import math

import torch

__all__ = ["BandLimitedFourier", "MatrixFourier", "chebyshev_lift", "naive_fourier", "phasor"]


def phasor(phase: torch.Tensor, dtype: torch.dtype | None = None) -> torch.Tensor:
    """exp(i phase) as a complex tensor, by default of the matching precision; phase in radians, of any real shape.

    Form the phase in float64: a float32 phase of 1e3 radians is off by 1e-4. Whole turns are removed before the
    conversion to complex64, whose error is then 2e-7.
    """
    if dtype == torch.complex64 and phase.dtype == torch.float64:
        turns = phase * (0.5 / math.pi)
        phase = (turns - turns.round()).float() * (2 * math.pi)
    found = torch.complex(torch.cos(phase), torch.sin(phase))
    return found if dtype is None else found.to(dtype)


# Rows longer than the first are summed in blocks of the second: fewer products, slightly more memory traffic.
_LONG, _BLOCK = 1500, 64


class MatrixFourier:
    """F(u) = Σ_ji field[j, i] exp(-i kappa (x_i u_x + y_j u_y)), for chosen x, y, u_x, u_y.

    The two kernels are computed once, with the instance. Quadrature weights and constants belong to the integral and
    are not included.

    Parameters
    ----------
    x, y
        Input columns [X] and rows [Y], in metres.
    ux, uy
        Output columns [U] and rows [V], in metres.
    kappa
        Radians per square metre: k/z for a propagation over z. Negative for the conjugate kernel.
    dtype
        complex64 or complex128, of the kernels; their phase is formed in float64 either way.
    """

    def __init__(
        self,
        x: torch.Tensor,
        y: torch.Tensor,
        ux: torch.Tensor,
        uy: torch.Tensor,
        kappa: float | torch.Tensor,
        dtype: torch.dtype = torch.complex128,
    ) -> None:
        self.columns = phasor(-kappa * x.double()[:, None] * ux.double()[None, :]).to(dtype)
        self.rows = phasor(-kappa * uy.double()[:, None] * y.double()[None, :]).to(dtype)

    def __call__(self, field: torch.Tensor) -> torch.Tensor:
        """Transform [..., Y, X] to [..., V, U]."""
        x, u = self.columns.shape
        v, y = self.rows.shape
        # The order of the two products that costs fewer multiplications.
        if v * y * x + v * x * u <= y * x * u + v * y * u:
            return (self.rows @ field) @ self.columns
        return self.rows @ (field @ self.columns)

    def adjoint(self, field: torch.Tensor) -> torch.Tensor:
        """Conjugate transpose, [..., V, U] to [..., Y, X]: <F a, b> = <a, F* b>. It is not the inverse."""
        return self.rows.mH @ (field @ self.columns.mH)


class BandLimitedFourier:
    """The same transform onto pixels much finer than its own detail; parameters as for `MatrixFourier`.

    A field confined to an aperture has a transform without detail finer than the aperture's Airy disc. Where the pixels
    are finer, the integral is taken at a few nodes only, and Chebyshev interpolation to the pixels is exact to
    rounding. Multiplications fall by the square of the number of pixels a node.
    """

    def __init__(
        self,
        x: torch.Tensor,
        y: torch.Tensor,
        ux: torch.Tensor,
        uy: torch.Tensor,
        kappa: float | torch.Tensor,
        dtype: torch.dtype = torch.complex128,
    ) -> None:
        kappa_now = abs(float(torch.as_tensor(kappa).detach()))
        self.ux, self._lift_x = _nodes(x.double(), ux.double(), kappa_now, dtype)
        self.uy, self._lift_y = _nodes(y.double(), uy.double(), kappa_now, dtype)
        self.rows = phasor(-kappa * self.uy[:, None] * y.double()[None, :]).to(dtype)
        self._kappa, self._blocks = kappa, None
        self._places = x.double()
        if len(x) > _LONG:
            self._blocks = _Blocks(self._places, self.ux, kappa, dtype)
            self._places = self._blocks.places
        self.columns = phasor(-kappa * self._places[:, None] * self.ux[None, :]).to(dtype)

    def across(self, field: torch.Tensor, scale: torch.Tensor | None = None) -> torch.Tensor:
        """The sum over columns alone, [..., Y, X] to [..., Y, U']; each of a batch with its own `scale` [B] of u_x."""
        if self._blocks is not None:
            field = self._blocks(field)
        if scale is None:
            return field @ self.columns
        places = -self._kappa * scale[:, None, None] * self._places[:, None]
        return field @ phasor(places * self.ux[None, :], field.dtype)

    def at_nodes(self, field: torch.Tensor, start: int = 0) -> torch.Tensor:
        """Contribution of the rows of `field` from `start` on to the nodes: [..., Y', X] to [..., V', U']."""
        return self.rows[:, start : start + field.shape[-2]] @ self.across(field)

    def lift(
        self, nodes: torch.Tensor, down: torch.Tensor | None = None, across: torch.Tensor | None = None
    ) -> torch.Tensor:
        """From the nodes to the pixels wanted, [..., V', U'] to [..., V, U]; times factors of rows and columns."""
        if self._lift_x is not None:
            nodes = _lifted(self._lift_x, nodes.mT).mT
        if across is not None:
            nodes = nodes * across[..., None, :]
        if self._lift_y is not None:
            nodes = _lifted(self._lift_y, nodes)
        return nodes if down is None else nodes * down[..., :, None]

    def lift_squared(self, nodes: torch.Tensor) -> torch.Tensor:
        """Absolute square of `lift`, real [..., V, U]."""
        if self._lift_x is not None:
            nodes = _lifted(self._lift_x, nodes.mT).mT
        # Real parts beside each other, then imaginary ones: the squares are then of contiguous numbers.
        parts = torch.cat([nodes.real, nodes.imag], -1)
        if self._lift_y is not None:
            parts = self._lift_y @ parts
        parts = parts.square() if parts.requires_grad else parts.square_()
        return parts[..., : nodes.shape[-1]] + parts[..., nodes.shape[-1] :]

    def __call__(self, field: torch.Tensor) -> torch.Tensor:
        """Transform [..., Y, X] to [..., V, U]."""
        return self.lift(self.at_nodes(field))


def _lifted(matrix: torch.Tensor, field: torch.Tensor) -> torch.Tensor:
    """A real matrix [V, V'] times complex fields [..., V', U]: half the multiplications of a complex one."""
    parts = matrix @ torch.view_as_real(field.contiguous()).flatten(-2)
    return torch.view_as_complex(parts.reshape(*parts.shape[:-1], field.shape[-1], 2))


class _Blocks:
    """Very long rows, summed block by block: within a block the kernel needs few terms."""

    def __init__(self, x: torch.Tensor, u: torch.Tensor, kappa: float | torch.Tensor, dtype: torch.dtype) -> None:
        count = math.ceil(len(x) / _BLOCK)
        self._padding = count * _BLOCK - len(x)
        step = (x[-1] - x[0]) / (len(x) - 1)
        within = (torch.arange(_BLOCK, dtype=torch.float64, device=x.device) - (_BLOCK - 1) / 2) * step.detach()
        middle = u.detach().abs().max()
        phase = float(torch.as_tensor(kappa).detach() * within.abs().max() * middle)
        nodes = _chebyshev(abs(phase), dtype, x.device) * within.abs().max()
        self._gather = _barycentric(within, nodes).to(dtype)
        starts = x[0] + torch.arange(count, dtype=torch.float64, device=x.device) * (_BLOCK * step) - within[0]
        self.places = (starts[:, None] + nodes[None, :] * (step / step.detach())).flatten()

    def __call__(self, field: torch.Tensor) -> torch.Tensor:
        """From samples [..., Y, X] to their equivalents at the blocks' nodes, [..., Y, places]."""
        padded = torch.nn.functional.pad(field, (0, self._padding)) if self._padding else field
        blocks = padded.reshape(*field.shape[:-1], -1, _BLOCK)
        return (blocks @ self._gather).flatten(-2)


def _chebyshev(phase: float, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Nodes in -1 … 1 that carry exp(i phase t) to rounding: its Chebyshev coefficients are Bessel functions J_n."""
    spare = 10.0 if dtype == torch.complex128 else 5.5
    count = math.ceil(phase + spare * max(phase, 1.0) ** (1 / 3)) + 3
    return torch.cos(math.pi * (torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count)


def _barycentric(at: torch.Tensor, nodes: torch.Tensor) -> torch.Tensor:
    """Matrix from values at Chebyshev nodes to values at other places (Berrut and Trefethen, SIAM Review 46, 501)."""
    count = len(nodes)
    angle = math.pi * (torch.arange(count, dtype=torch.float64, device=nodes.device) + 0.5) / count
    weights = torch.sin(angle) * (1 - 2 * (torch.arange(count, device=nodes.device) % 2))
    apart = at[:, None] - nodes[None, :]
    exact = apart == 0
    ratio = weights / torch.where(exact, torch.ones_like(apart), apart)
    matrix = ratio / ratio.sum(1, keepdim=True)
    return torch.where(exact.any(1, keepdim=True), exact.to(matrix.dtype), matrix)


def chebyshev_lift(places: torch.Tensor, turn: float, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Nodes that resolve a phase of ±`turn` radians over places, and the matrix [places, nodes] back from them."""
    error, count, left = 1e-12 if dtype == torch.complex128 else 1e-6, 1, turn
    # With n nodes the error of exp(i turn t) is below 2 (turn/2)ⁿ/n!.
    while left > error:
        count += 1
        left *= turn / (2 * count)
    nodes = torch.cos(math.pi * (torch.arange(count, dtype=torch.float64, device=places.device) + 0.5) / count)
    at = nodes * (places.max() - places.min()) / 2 + (places.max() + places.min()) / 2
    return at, _barycentric(places, at)


def _nodes(
    x: torch.Tensor, u: torch.Tensor, kappa: float, dtype: torch.dtype
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Nodes of the transform and the matrix from them to `u`; None where `u` itself is short enough."""
    half = float(u.max() - u.min()) / 2
    reach = float(x.detach().abs().max())
    nodes = _chebyshev(kappa * reach * half, dtype, u.device)
    if len(nodes) > 0.75 * len(u):
        return u, None
    places = nodes * half + float(u.max() + u.min()) / 2
    return places, _barycentric(u, places).to(dtype.to_real())


def naive_fourier(
    field: torch.Tensor,
    x: torch.Tensor,
    y: torch.Tensor,
    ux: torch.Tensor,
    uy: torch.Tensor,
    kappa: float,
) -> torch.Tensor:
    """The same sum as MatrixFourier, term by term: a slow reference."""
    phase = uy[:, None, None, None] * y[:, None] + ux[None, :, None, None] * x[None, :]
    return (phasor(-kappa * phase) * field).sum(dim=(-2, -1))
