"""What reflects behind a lens: planes, the diffraction orders that each of them returns, and masks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import torch

from tapetum.optics.fourier import phasor

__all__ = ["Mask", "Order", "PlaceSeries", "Reflectance", "Surface"]

# Of places x [..., n] and y [..., m], in metres from the optical axis: complex amplitudes [..., m, n].
Reflectance = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


@dataclass(frozen=True, eq=False)
class PlaceSeries:
    """An amplitude that depends on the place u of the spot: Σ c_b exp(iκ b·u), b = -n to n.

    `coefficients` are c, [2n + 1, 2n + 1], rows and columns; `wavenumber` is κ, in 1/m.
    """

    coefficients: npt.NDArray[np.complex128]
    wavenumber: float

    def __call__(self, places: torch.Tensor) -> torch.Tensor:
        """Amplitudes [B] at places [B, 2] from the optical axis, in metres."""
        most = len(self.coefficients) // 2
        turns = self.wavenumber * torch.arange(-most, most + 1, dtype=torch.float64, device=places.device)
        down, across = phasor(places[:, 1:2] * turns), phasor(places[:, 0:1] * turns)
        return ((down @ torch.as_tensor(self.coefficients, device=places.device)) * across).sum(-1)


@dataclass(frozen=True)
class Order:
    """A diffraction order of a sensor plane.

    Parameters
    ----------
    direction
        Its sines (τ_x, τ_y), (m_x, m_y) λ/p for a grating; a plane tilted by a adds 2a.
    amplitude
        Complex; with a `series`, that on the optical axis.
    series
        Its amplitude by the place of the spot, where it depends on it.
    """

    direction: tuple[float, float] = (0.0, 0.0)
    amplitude: complex = 1.0
    series: PlaceSeries | None = None

    def scaled(self, factor: float) -> Order:
        """The same order with its amplitude times this factor."""
        if factor == 1:
            return self
        series = self.series and replace(self.series, coefficients=self.series.coefficients * factor)
        return replace(self, amplitude=self.amplitude * factor, series=series)

    @property
    def largest(self) -> float:
        """What its amplitude's modulus nowhere exceeds."""
        return abs(self.amplitude) if self.series is None else float(abs(self.series.coefficients).sum())

    def at(self, places: torch.Tensor) -> torch.Tensor | complex:
        """Its amplitude; [B] where it depends on the places [B, 2] of the spot."""
        return self.amplitude if self.series is None else self.series(places)


@dataclass(frozen=True)
class Surface:
    """A plane that reflects.

    Parameters
    ----------
    image_distance
        z, its distance from the lens in metres, reduced by the index of what lies between. A tensor carries gradients.
    orders
        What it returns; a mirror has one order of direction 0.
    phase
        Of its reflection against the others', in radians: -k times twice the optical path by which it is nearer.
    depth, index
        Distance before the sensor, in metres, and the refractive index between. For a thin lens image_distance and
        phase follow from them; a traced lens uses them directly.
    tilt
        Of its plane, a in radians, which the orders' directions already hold (2a). At the spot u0 the plane lies a·u0
        farther (17 um for half a degree and 2 mm), and each gaze is computed with that change of focus.
    """

    image_distance: torch.Tensor | float
    orders: tuple[Order, ...] = (Order(),)
    phase: float = 0.0
    depth: float = 0.0
    index: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Mask:
    """A plane that is sampled: its complex `reflectance` by place, and its `finest` detail in metres, if it has one."""

    reflectance: Reflectance
    finest: float = math.inf
