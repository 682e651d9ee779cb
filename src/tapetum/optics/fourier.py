"""The matrix Fourier transform: a Fourier integral between any two sets of rows and columns, as two matrix products.

Soummer, Pueyo, Sivaramakrishnan and Vanderbei, "Fast computation of Lyot-style coronagraph propagation",
Opt. Express 15, 15935 (2007).
"""

from __future__ import annotations

import math

import torch

__all__ = ["BandLimitedFourier", "MatrixFourier", "naive_fourier", "phasor"]


def phasor(phase: torch.Tensor) -> torch.Tensor:
    """exp(i phase) as a complex tensor of the matching precision (phase in radians, any real shape).

    The phase should be formed in float64: a float32 phase of 1e3 radians is off by 1e-4.
    """
    return torch.complex(torch.cos(phase), torch.sin(phase))


class MatrixFourier:
    """F(u) = Σ_ji field[j, i] exp(-i kappa (x_i u_x + y_j u_y)), for chosen x, y, u_x, u_y.

    Holding the instance is the cache: the two kernels are formed once.

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

    Notes
    -----
    Neither quadrature weights nor constants are included: they belong to the integral, not to the transform.
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
    """The same transform onto pixels much finer than its own detail.

    A field confined to an aperture has a transform without detail finer than the aperture's Airy disc. Where the wanted
    pixels are finer than that, the integral is taken at few nodes only, and Chebyshev interpolation, exact to rounding
    for such functions, carries it on to the pixels: fewer multiplications, by the square of pixels a node.

    Parameters
    ----------
    x, y, ux, uy, kappa, dtype
        As for `MatrixFourier`.
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
        self.columns = phasor(-kappa * x.double()[:, None] * self.ux[None, :]).to(dtype)
        self.rows = phasor(-kappa * self.uy[:, None] * y.double()[None, :]).to(dtype)

    def at_nodes(self, field: torch.Tensor, start: int = 0) -> torch.Tensor:
        """What the rows of `field` from `start` on add to the transform at the nodes: [..., Y', X] to [..., V', U']."""
        return self.rows[:, start : start + field.shape[-2]] @ (field @ self.columns)

    def lift(self, nodes: torch.Tensor) -> torch.Tensor:
        """From the nodes to the pixels wanted, [..., V', U'] to [..., V, U]."""
        if self._lift_y is not None:
            nodes = self._lift_y.to(nodes.dtype) @ nodes
        return nodes if self._lift_x is None else nodes @ self._lift_x.to(nodes.dtype).T

    def __call__(self, field: torch.Tensor) -> torch.Tensor:
        """Transform [..., Y, X] to [..., V, U]."""
        return self.lift(self.at_nodes(field))


def _nodes(
    x: torch.Tensor, u: torch.Tensor, kappa: float, dtype: torch.dtype
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Where to take the transform, and the matrix that carries it to `u`; None where `u` itself are few enough."""
    half = float(u.max() - u.min()) / 2
    reach = float(x.detach().abs().max())
    phase = kappa * reach * half
    # Chebyshev coefficients of exp(i phase t) are Bessel functions J_n(phase): nothing is left this far past n = phase.
    spare = 10.0 if dtype == torch.complex128 else 5.5
    count = math.ceil(phase + spare * max(phase, 1.0) ** (1 / 3)) + 3
    if count > 0.75 * len(u):
        return u, None
    angle = math.pi * (torch.arange(count, dtype=torch.float64, device=u.device) + 0.5) / count
    nodes, middle = torch.cos(angle), float(u.max() + u.min()) / 2
    # Barycentric interpolation (Berrut and Trefethen, SIAM Review 46, 501 (2004)).
    weights = torch.sin(angle) * (1 - 2 * (torch.arange(count, device=u.device) % 2))
    apart = ((u - middle) / half)[:, None] - nodes[None, :]
    exact = apart == 0
    ratio = weights / torch.where(exact, torch.ones_like(apart), apart)
    lift = ratio / ratio.sum(1, keepdim=True)
    lift = torch.where(exact.any(1, keepdim=True), exact.to(lift.dtype), lift)
    return nodes * half + middle, lift.to(dtype)


def naive_fourier(
    field: torch.Tensor,
    x: torch.Tensor,
    y: torch.Tensor,
    ux: torch.Tensor,
    uy: torch.Tensor,
    kappa: float,
) -> torch.Tensor:
    """The same sum as MatrixFourier, term by term: slow, and there to be compared with."""
    phase = uy[:, None, None, None] * y[:, None] + ux[None, :, None, None] * x[None, :]
    return (phasor(-kappa * phase) * field).sum(dim=(-2, -1))
