"""The samples of the target's sensor about the spot, and how the field is brought to zero at their edge."""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

__all__ = ["RimLight", "SpotWindow"]

# Highest bump on a fade that begins later than at this share of the window's end: over a narrow fade far out the rim's
# light may turn by whole turns, and a bump on it adds next to nothing however high it is.
_LATE_FADE, _HIGHEST_BUMP = 0.75, 2.0
# Places at which the fade of the sensor's window is summed, and at which the light beyond is.
_FADE_SAMPLES, _BEYOND_SAMPLES = 2000, 200


@dataclass(frozen=True)
class RimLight:
    """What a pupil's rim spreads over the sensor.

    `chirp` is k C of both ways, in rad/m², `landing` how far from the spot's middle the rim's own rays land, in metres.
    """

    chirp: float
    landing: float

    def beyond(self, end: float) -> complex:
        """∫ exp(i chirp v²)/(v² - landing²) dv from `end` on, in 1/m: along the line on which the exponential falls."""
        way = complex(math.sqrt(0.5), math.sqrt(0.5))
        nodes, weights = np.polynomial.legendre.leggauss(_BEYOND_SAMPLES)
        # Dense near the end, from where most comes; at exp(-36) the rest is rounding.
        u, farthest = (nodes + 1) / 2, 6 / math.sqrt(self.chirp)
        v, step = end + way * farthest * u**3, way * farthest * 3 * u**2 * weights / 2
        return complex((np.exp(1j * self.chirp * v**2) / (v**2 - self.landing**2) * step).sum())


@dataclass(frozen=True)
class SpotWindow:
    """`count` samples a side over ±`half_width` metres; light farther out than `flat` metres is faded out."""

    count: int
    half_width: float
    flat: float

    @property
    def step(self) -> float:
        """Between two samples, in metres."""
        return 2 * self.half_width / self.count

    def places(self, device: torch.device | str = "cpu") -> torch.Tensor:
        """Columns or rows [n], in metres from the spot's middle."""
        return (torch.arange(self.count, dtype=torch.float64, device=device) - (self.count - 1) / 2) * self.step

    def fade(self, distance: torch.Tensor) -> torch.Tensor:
        """1 up to `flat`, then a raised cosine to 0."""
        # Nothing at all beyond the end: cos² of a rounded right angle would leave numbers so small that the processor
        # multiplies them a hundred times slower than others.
        return torch.where(distance < self.half_width, torch.cos(self._turn(distance) / 2) ** 2, 0.0)

    def fade_with_rim(self, distance: torch.Tensor, rim: RimLight) -> torch.Tensor:
        """The fade plus what the light beyond contributes to the rim's image.

        The pupil's edge, whose own rays land at b, spreads light over the sensor as 1/(v - b), and the mirror returns
        it to the opposite edge, at zero tilt, whose rays land at -b: as 1/(v² - b²). The light faded out or beyond the
        window would add ∫ (1 - W) exp(i chirp v²)/(v² - b²) dv to the light at the edge. A bump on the fade adds
        exactly this; without it the picture's error falls only as one over the rings kept.
        """
        low, high, square = self.flat, self.half_width, rim.landing**2
        if low <= rim.landing:
            return self.fade(distance)
        v = np.linspace(low, high, _FADE_SAMPLES + 2)[1:-1]
        turned = np.exp(1j * rim.chirp * v**2) / (v**2 - square) * (v[1] - v[0])
        share = math.pi * (v - low) / (high - low)
        bump = complex((np.sin(share / 2) ** 2 * turned).sum()) + rim.beyond(high)
        bump /= complex((np.sin(share) ** 2 * turned).sum())
        if low > _LATE_FADE * high and abs(bump) > _HIGHEST_BUMP:
            return self.fade(distance)
        edge = torch.where(distance < high, torch.sin(self._turn(distance)) ** 2, 0.0)
        return self.fade(distance) + bump * edge

    def _turn(self, distance: torch.Tensor) -> torch.Tensor:
        return math.pi * ((distance - self.flat) / (self.half_width - self.flat)).clamp(0, 1)
