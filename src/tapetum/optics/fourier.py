"""The matrix Fourier transform: a Fourier integral between any two sets of rows and columns, as two matrix products.

Soummer, Pueyo, Sivaramakrishnan and Vanderbei, "Fast computation of Lyot-style coronagraph propagation",
Opt. Express 15, 15935 (2007).
"""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import torch

__all__ = ["BandLimitedFourier", "FoldedKernel", "MatrixFourier", "chebyshev_lift", "folded", "naive_fourier", "paired"]
__all__ += ["fast_beats_products", "fast_sums", "phasor", "real_times"]

# Operations of a matrix product in the time of one of a fast transform.
_SLOWER = 10.0


def fast_beats_products(length: int, lines: float, products: float) -> bool:
    """Whether fast transforms of `length` samples on so many lines take less time than products of real numbers."""
    return _SLOWER * lines * 5 * length * math.log2(max(length, 2)) < products


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


# Largest change of a phase, in radians, for which a kernel's second derivative suffices: the third adds 1e-6.
_SMALL_TURN = 0.02
# Bytes of lines that are transformed at a time.
_BYTES_AT_ONCE = 1 << 22


def fast_sums(
    field: torch.Tensor,
    length: int,
    count: int,
    dim: int,
    sign: int,
    *,
    before: torch.Tensor | None = None,
    after: torch.Tensor | None = None,
) -> torch.Tensor:
    """Σ_j field[j] exp(sign 2πi jm/length) along a dimension, for m from 0 to count - 1; they repeat after `length`.

    `before` [B or 1, samples] are factors of the field's samples along the dimension, `after` [B or 1, count] of the
    sums, for a field [B, rows, columns].
    """
    if field.shape[dim] > length:
        # A shorter transform leaves out what it does not hold.
        raise ValueError(f"{field.shape[dim]} samples do not fit into a transform of {length}")
    lines = field.movedim(dim, -1)

    def summed(lines: torch.Tensor) -> torch.Tensor:
        if before is not None:
            lines = lines * before[:, None]
        transforms: Any = torch.fft
        if sign < 0:
            sums: torch.Tensor = transforms.fft(lines, length)
        else:
            sums = transforms.ifft(lines, length, norm="forward")
        if count > length:
            sums = sums.index_select(-1, torch.arange(count, device=field.device) % length)
        return sums[..., :count] if after is None else sums[..., :count] * after[:, None]

    if field.device.type != "cpu" or any(one is not None and one.requires_grad for one in (field, before, after)):
        return summed(lines).movedim(-1, dim)
    # Some lines at a time, side by side in memory: what a transform pads, and what is dropped of it, then fit into the
    # processor's caches.
    found = lines.new_empty(*lines.shape[:-1], count)
    line = length * field.element_size() * math.prod(lines.shape[:-2])
    some = max(1, _BYTES_AT_ONCE // line)
    for i in range(0, lines.shape[-2], some):
        found[..., i : i + some, :] = summed(lines[..., i : i + some, :].contiguous())
    return found.movedim(-1, dim)


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

    Columns x and rows y lie in pairs about zero, `x[j] = -x[-1 - j]`; see `FoldedKernel`.
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
        self.across, self._lift_x = _nodes(x.double(), ux.double(), kappa, dtype)
        self.down, self._lift_y = _nodes(y.double(), uy.double(), kappa, dtype)
        self.ux, self.uy = self.across.u, self.down.u

    def at_nodes(self, pairs: torch.Tensor) -> torch.Tensor:
        """From a field whose rows are in pairs, as of `folded`, to the nodes, [..., V', U']."""
        return self.across(folded(self.down(pairs).mT)).mT

    def lift(
        self, nodes: torch.Tensor, down: torch.Tensor | None = None, across: torch.Tensor | None = None
    ) -> torch.Tensor:
        """From the nodes to the pixels wanted, [..., V', U'] to [..., V, U]; times factors of rows and columns."""
        if self._lift_x is not None:
            nodes = real_times(self._lift_x, nodes.mT).mT
        if across is not None:
            nodes = nodes * across[..., None, :]
        if self._lift_y is not None:
            nodes = real_times(self._lift_y, nodes)
        return nodes if down is None else nodes * down[..., :, None]

    def lift_pairs(self, nodes: torch.Tensor, across: torch.Tensor | None = None) -> torch.Tensor:
        """`lift` to rows in pairs about zero: their sums and differences as of `folded`, [..., 2, (V + 1) // 2, U]."""
        if self._lift_x is not None:
            nodes = real_times(self._lift_x, nodes.mT).mT
        if across is not None:
            nodes = nodes * across[..., None, :]
        return folded(nodes) if self._lift_y is None else real_times(self._pairs_y, folded(nodes))

    @cached_property
    def _pairs_y(self) -> torch.Tensor:
        """The rows' lift for sums and differences of nodes in pairs, [2, (V + 1) // 2, (V' + 1) // 2]."""
        assert self._lift_y is not None
        count = self._lift_y.shape[1]
        upper, half = self._lift_y[: (len(self._lift_y) + 1) // 2], (count + 1) // 2
        near, far = upper[:, :half], upper.flip(1)[:, :half]
        both = torch.stack([near + far, near - far])
        # A node in the middle is its own partner.
        return both * _halved_last(half, both) if count % 2 else both

    @property
    def lifts_columns(self) -> bool:
        """Whether columns are interpolated from nodes."""
        return self._lift_x is not None

    def lift_squared(self, nodes: torch.Tensor) -> torch.Tensor:
        """Absolute square of `lift`, real [..., V, U]."""
        if self._lift_x is not None:
            nodes = real_times(self._lift_x, nodes.mT).mT
        # Real parts beside each other, then imaginary ones: the squares are then of contiguous numbers.
        parts = torch.cat([nodes.real, nodes.imag], -1)
        if self._lift_y is not None:
            parts = self._lift_y @ parts
        parts = parts.square() if parts.requires_grad else parts.square_()
        return parts[..., : nodes.shape[-1]] + parts[..., nodes.shape[-1] :]

    def __call__(self, field: torch.Tensor) -> torch.Tensor:
        """Transform [..., Y, X] to [..., V, U]."""
        return self.lift(self.at_nodes(folded(field)))


class FoldedKernel:
    """One of the two products: G(u) = Σ_j field[j] exp(-i kappa x_j u), for places that lie in pairs about zero.

    The sum of a pair's fields meets the kernel's cosine and their difference its sine, both real, and nodes in pairs
    share them: a quarter of the multiplications.

    Parameters
    ----------
    x
        Places [X] in metres, `x[j] = -x[-1 - j]`.
    u
        Nodes [U'], in metres.
    kappa
        Radians per square metre.
    dtype
        complex64 or complex128, of the fields.
    """

    def __init__(self, x: torch.Tensor, u: torch.Tensor, kappa: float | torch.Tensor, dtype: torch.dtype) -> None:
        self.u, self._kappa, self._dtype = u, kappa, dtype
        self._x, self._odd = x[: (len(x) + 1) // 2], len(x) % 2 == 1
        half = len(u) // 2
        paired = torch.allclose(u, -u.flip(0), rtol=0, atol=1e-12 * float(u.abs().max()))
        # A node in the middle is its own partner.
        self._half, self._paired = (u[: len(u) - half], half) if paired else (u, 0)
        # Largest phase of the kernel, and its first two derivatives with respect to a scale of the nodes, once needed.
        self._turn = float((self._kappa * self._half).detach().abs().max() * self._x.detach().abs().max())
        self._derivatives: tuple[torch.Tensor, torch.Tensor] | None = None

    @cached_property
    def _kernel(self) -> torch.Tensor:
        return self._waves(self._kappa * self._half)

    def scaled(self, scale: torch.Tensor | None = None) -> torch.Tensor:
        """Cosines and sines, [..., 2, U'/2, X/2]; each of a batch with its own `scale` [B] of the nodes."""
        if scale is None:
            return self._kernel
        shift = scale - 1
        if self._dtype == torch.complex64 and self._turn * float(shift.detach().abs().max()) < _SMALL_TURN:
            kept = self._kernel
            if not (kept.is_cuda or kept.requires_grad or scale.requires_grad):
                if self._derivatives is None:
                    phase = (self._kappa * self._half[:, None] * self._x).to(kept)
                    slope = torch.stack([-phase * kept[1], phase * kept[0]])
                    self._derivatives = slope, -(phase**2) * kept / 2
                first, second = self._derivatives
                by = shift.to(kept)[:, None, None, None]
                return torch.addcmul(torch.addcmul(kept, by, first), by**2, second)
        return self._waves(self._kappa * self._half * scale[:, None])

    def _waves(self, along: torch.Tensor) -> torch.Tensor:
        """Cosines and sines of `along` [..., U'/2], in radians a metre, times the places."""
        wave = phasor(along[..., :, None] * self._x, self._dtype)
        both = torch.stack([wave.real, wave.imag], -3)
        # A place in the middle is its own partner.
        return both * _halved_last(len(self._x), both) if self._odd else both

    def partial(
        self, halves: torch.Tensor, places: slice | None = None, kernel: torch.Tensor | None = None
    ) -> torch.Tensor:
        """What some `places` of the first half and their partners, [..., 2, X', N] from `paired`, add to the halves.

        These halves, [..., 2, U'/2, N], are those of the nodes, see `unfolded`; `kernel` is one of `scaled`.
        """
        kernel = self._kernel if kernel is None else kernel
        if places is not None:
            kernel = kernel[..., places]
        return real_times(kernel, halves)

    def unfolded(self, halves: torch.Tensor) -> torch.Tensor:
        """From halves [..., 2, U'/2, N] to the nodes `self.u`, [..., U', N]."""
        even, odd = halves[..., 0, :, :], halves[..., 1, :, :]
        upper = torch.sub(even, odd, alpha=1j)
        if not self._paired:
            return upper
        lower = torch.add(even[..., : self._paired, :], odd[..., : self._paired, :], alpha=1j)
        return torch.cat([upper, lower.flip(-2)], -2)

    def __call__(self, halves: torch.Tensor, kernel: torch.Tensor | None = None) -> torch.Tensor:
        """From a whole field in halves [..., 2, X/2, N] to the nodes, [..., U', N]."""
        return self.unfolded(self.partial(halves, None, kernel))


def _halved_last(count: int, like: torch.Tensor) -> torch.Tensor:
    weights = torch.ones(count, dtype=like.dtype, device=like.device)
    weights[-1] = 0.5
    return weights


def folded(field: torch.Tensor) -> torch.Tensor:
    """Sums and differences of each row of [..., Y, X] and its partner from the other end, [..., 2, (Y + 1) // 2, X]."""
    half = (field.shape[-2] + 1) // 2
    return paired(field[..., :half, :], field.flip(-2)[..., :half, :])


def paired(upper: torch.Tensor, lower: torch.Tensor) -> torch.Tensor:
    """Sums and differences of rows [..., Y/2, X] and of their partners in the same order, [..., 2, Y/2, X]."""
    if upper.requires_grad or lower.requires_grad:
        return torch.stack([upper + lower, upper - lower], -3)
    both = upper.new_empty(*upper.shape[:-2], 2, *upper.shape[-2:])
    torch.add(upper, lower, out=both[..., 0, :, :])
    torch.sub(upper, lower, out=both[..., 1, :, :])
    return both


def real_times(matrix: torch.Tensor, field: torch.Tensor) -> torch.Tensor:
    """A real matrix [..., V, Y] times complex fields [..., Y, X]: half the multiplications of a complex one."""
    parts = matrix @ torch.view_as_real(field.contiguous()).flatten(-2)
    return torch.view_as_complex(parts.reshape(*parts.shape[:-1], field.shape[-1], 2))


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
    x: torch.Tensor, u: torch.Tensor, kappa: float | torch.Tensor, dtype: torch.dtype
) -> tuple[FoldedKernel, torch.Tensor | None]:
    """The product onto nodes, and the matrix from them to `u`; None where `u` itself is short enough."""
    half = float(u.max() - u.min()) / 2
    reach, kappa_now = float(x.detach().abs().max()), abs(float(torch.as_tensor(kappa).detach()))
    nodes = _chebyshev(kappa_now * reach * half, dtype, u.device)
    if len(nodes) > 0.75 * len(u):
        return FoldedKernel(x, u, kappa, dtype), None
    places = nodes * half + float(u.max() + u.min()) / 2
    return FoldedKernel(x, places, kappa, dtype), _barycentric(u, places).to(dtype.to_real())


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
