"""Irradiance that depends only on the distance from one point: tabulated once, drawn anywhere."""

# SciPy types its splines in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch
from scipy.fft import next_fast_len
from scipy.interpolate import CubicSpline

from tapetum.optics.fourier import phasor

__all__ = ["BandLimitedDisc", "RoundPicture"]

# Entries of the table for each sample: linear interpolation errs by 1e-4 for detail of six samples' period.
_FINER = 32


class RoundPicture:
    """A radial profile, ready to be drawn on any pixels; differentiable by their places.

    `radii` [N] are distances in metres, evenly spaced from 0; beyond the last the picture is dark. `profile` [N] has
    any unit. Drawing in float32 takes half the time.
    """

    def __init__(
        self,
        radii: npt.NDArray[np.floating],
        profile: npt.NDArray[np.floating],
        dtype: torch.dtype = torch.float64,
    ) -> None:
        self.end, self._last = float(radii[-1]), _FINER * (len(radii) - 1) + 1
        values = CubicSpline(radii, profile)(np.linspace(0.0, self.end, self._last))
        table = torch.from_numpy(np.append(np.maximum(values, 0.0), [0.0, 0.0]))
        self._values, self._rises = table[:-1].to(dtype), table.diff().to(dtype)

    def at(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Values [len(y), len(x)] on columns x and rows y, in metres from the middle."""
        x, y = (one.to(self._values) * ((self._last - 1) / self.end) for one in (x, y))
        # The floor keeps the root's gradient finite in the very middle.
        place = torch.sqrt((x[None, :] ** 2 + y[:, None] ** 2).clamp_min(1e-12)).clamp_max(self._last)
        low = place.detach().long().flatten()
        picture = torch.addcmul(self._values.take(low), place.flatten() - low, self._rises.take(low))
        return picture.reshape(place.shape)


class BandLimitedDisc:
    """A round picture that holds no detail finer than a period, drawn many times at once by its Fourier transform.

    Parameters
    ----------
    radii, profile
        As for `RoundPicture`.
    pitch
        Of the pixels, in metres.
    finest
        Shortest period in the picture, in metres.
    dtype
        Of what is drawn.
    """

    def __init__(
        self,
        radii: npt.NDArray[np.floating],
        profile: npt.NDArray[np.floating],
        pitch: float,
        finest: float,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        self._picture, self._dtype = RoundPicture(radii, profile), dtype
        # Pixels too coarse for the picture hold its values at every so many samples.
        self._parts = math.ceil(2.2 * pitch / finest)
        self._step, self._finest = pitch / self._parts, finest
        self._transforms: dict[int, torch.Tensor] = {}

    def side(self, width: float) -> int:
        """Pixels a side of the next picture at least so many wide that transforms fast."""
        side = next_fast_len(max(math.ceil(width), 16), real=True)
        assert side is not None
        return side

    def samples(self, side: int) -> int:
        """Samples of a picture of so many pixels a side."""
        return (side * self._parts) ** 2

    def draw(
        self, side: int, weights: torch.Tensor, x: torch.Tensor, y: torch.Tensor, *, columns: int, rows: int
    ) -> torch.Tensor:
        """Weighted sums [B, rows, columns] of the picture about places x and y, [B, N] each, in pixels from the first.

        The sums repeat after `side` pixels, of which the first columns and rows are returned.
        """
        count, spectrum = side * self._parts, self._transform(side)
        turn = 2 * math.pi / side * torch.arange(spectrum.shape[1], dtype=torch.float64)
        dtype = self._dtype.to_complex()
        across = phasor(-turn * x[..., None], dtype)
        down = weights[..., None] * phasor(-turn * y[..., None])
        # The rows' negative frequencies, the lowest last, have the conjugate phasors.
        down = torch.cat([down, down[..., 1:].conj().flip(-1)], -1).to(dtype)
        sums = (down.mT @ across) * spectrum
        most = len(turn)
        lines = sums.new_zeros(len(x), count, most)
        lines[:, :most], lines[:, count - most + 1 :] = sums[:, :most], sums[:, most:]
        lines = torch.fft.ifft(lines, dim=1)[:, :: self._parts][:, :rows]
        return torch.fft.irfft(lines, n=count, dim=2)[..., :: self._parts][..., :columns].clamp_min(0)

    def _transform(self, side: int) -> torch.Tensor:
        """Real transform [2m - 1, m] of the picture about the first sample: rows 0 to m - 1 and 1 - m to -1."""
        if side not in self._transforms:
            count = side * self._parts
            places = torch.fft.fftfreq(count, 1 / (count * self._step), dtype=torch.float64)
            whole = torch.fft.rfft2(self._picture.at(places, places)).real
            most = min(math.ceil(count * self._step / self._finest) + 1, (count + 1) // 2)
            found = torch.cat([whole[:most, :most], whole[count - most + 1 :, :most]])
            self._transforms[side] = found.to(self._dtype)
        return self._transforms[side]
