"""The matrix Fourier transform: a Fourier integral between any two sets of rows and columns, as two matrix products.

Soummer, Pueyo, Sivaramakrishnan and Vanderbei, "Fast computation of Lyot-style coronagraph propagation",
Opt. Express 15, 15935 (2007).
"""

from __future__ import annotations

import torch

__all__ = ["MatrixFourier", "naive_fourier", "phasor"]


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
