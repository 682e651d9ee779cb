"""Through the probe's round aperture to its pixels: a quadrature over the disc, its rows in pairs about the middle.

Rows that lie in pairs stay sums and differences on the whole way, as the product that follows wants them. Where that
is faster, columns are summed by a fast transform: their step is then chosen so that pixels are steps of it.
"""

from __future__ import annotations

import math

import torch

from tapetum.optics.fourier import BandLimitedFourier, fast_beats_products, fast_sums, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.propagate import fast_length
from tapetum.optics.pupil import disc_quadrature

__all__ = ["ApertureCrossing"]


class ApertureCrossing:
    """The aperture's samples, and the way from there to the pixels of `output`.

    Parameters
    ----------
    output
        Pixels of the probe's sensor.
    radius
        Of the aperture, in metres.
    samples
        Columns and rows over its diameter, at least.
    bend
        Phase added in the aperture, in radians per m².
    to_pixels
        k/f of the probe's lens, in radians per m²; tensors carry gradients, as for `bend`.
    dtype, device
        Of the fields.
    """

    def __init__(
        self,
        output: Grid,
        radius: float,
        samples: tuple[int, int],
        *,
        bend: torch.Tensor,
        to_pixels: torch.Tensor | float,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.dtype = dtype
        columns, rows = samples
        pixels = output.x(device=device), output.y(device=device)
        scale = torch.as_tensor(to_pixels)
        # Samples of the transform whose steps are pixels.
        length = fast_length(math.ceil(2 * math.pi * columns / (2 * radius * float(scale.detach()) * output.pitch)))
        step = 2 * math.pi / (length * float(scale.detach()) * output.pitch)
        # Pixels coarser than the aperture's finest detail would need a transform shorter than its samples.
        holds = length * step >= 2 * radius
        fast = holds and not scale.requires_grad and fast_beats_products(length, rows, _spared(samples, output))
        disc = disc_quadrature(radius, columns, rows, step=step if fast else None)
        self.x, self.y = disc.x.to(device), disc.y.to(device)
        self._second = BandLimitedFourier(self.x, self.y, *pixels, to_pixels, dtype)
        self._length = length if fast and not self._second.lifts_columns else None
        passed = disc.weights.to(device) * phasor(bend * disc.rho_squared().to(device))
        # Of rows in pairs: each has what its partner has.
        passed = passed[: (len(self.y) + 1) // 2]
        if self._length is not None:
            # Samples i and pixels m count from the first: exp(-2πi (i - a)(m - b)/N) has a ramp of each beside im/N.
            number = torch.arange(len(self.x), dtype=torch.float64, device=device)
            passed = passed * phasor(math.pi * (output.columns - 1) / length * number)
            pixel = torch.arange(output.columns, dtype=torch.float64, device=device)
            middle = (len(self.x) - 1) / 2
            self._after = phasor(2 * math.pi / length * middle * (pixel - (output.columns - 1) / 2), dtype)
        self._passed = passed.to(dtype)

    def __call__(
        self,
        first: BandLimitedFourier,
        nodes: torch.Tensor,
        down: torch.Tensor | None = None,
        across: torch.Tensor | None = None,
        *,
        squared: bool = False,
    ) -> torch.Tensor:
        """Field on the pixels, or its square, [B, H, W], of the field at the nodes of `first`, a transform to the disc.

        `down` [B, rows] and `across` [B, columns] are phases' factors in the disc; of rows y and -y conjugate ones.
        """
        pairs = first.lift_pairs(nodes, across)
        if down is not None:
            # Of w = c + is at y: w u + w* l and w u - w* l, of u + l and u - l.
            wave = down[:, : pairs.shape[-2], None]
            even, odd = pairs.unbind(-3)
            c, s = wave.real, torch.complex(torch.zeros_like(wave.imag), wave.imag)
            pairs = torch.stack([c * even + s * odd, c * odd + s * even], -3)
        pairs = pairs * self._passed
        second = self._second
        if self._length is None:
            found = second.at_nodes(pairs)
        else:
            sums = fast_sums(pairs, self._length, len(self._after), -1, -1)
            found = second.down(sums)
            if not squared:
                found = found * self._after
        return second.lift_squared(found) if squared else second.lift(found)


def _spared(samples: tuple[int, int], output: Grid) -> float:
    """Operations of products that a fast transform of the columns spares."""
    columns, rows = samples
    if columns <= output.columns:
        return 0.0
    return 2.0 * output.rows * (rows * (columns - output.columns) + columns * output.columns)
