"""The samples of the target's sensor about the spot, and how the field is brought to zero at their edge."""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import fresnel

__all__ = ["SpotWindow"]

# Latest start of the fade, over the window's end, at which rim light still counts as centred.
_LATEST_FADE = 0.75
# Places at which the fade of the sensor's window is summed.
_FADE_SAMPLES = 2000


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

    def fade_with_rim(self, distance: torch.Tensor, chirp: float) -> torch.Tensor:
        """The fade plus what the light beyond contributes to the rim's image; `chirp` is `Pupil.rim`.

        The pupil's edge spreads light over the sensor as 1/v, and the mirror returns it to its origin, at zero tilt
        the same edge: as 1/v² again. The light faded out or beyond the window would add ∫ (1 - W) exp(i chirp v²)/v² dv
        to the light at the edge. A bump on the fade adds exactly this; without it the picture's error falls only as
        one over the rings kept.
        """
        low, high = self.flat, self.half_width
        if low > _LATEST_FADE * high:
            return self.fade(distance)
        v = np.linspace(low, high, _FADE_SAMPLES + 2)[1:-1]
        turned = np.exp(1j * chirp * v**2) / v**2 * (v[1] - v[0])
        share = math.pi * (v - low) / (high - low)
        # ∫ exp(i chirp v²)/v² dv from the window's end on, by parts.
        sine, cosine = fresnel(high * math.sqrt(2 * chirp / math.pi))
        rest = 0.5 - cosine + 1j * (0.5 - sine)
        beyond = np.exp(1j * chirp * high**2) / high + 2j * chirp * math.sqrt(math.pi / (2 * chirp)) * rest
        bump = complex((np.sin(share / 2) ** 2 * turned).sum() + beyond) / complex((np.sin(share) ** 2 * turned).sum())
        edge = torch.where(distance < high, torch.sin(self._turn(distance)) ** 2, 0.0)
        return self.fade(distance) + bump * edge

    def _turn(self, distance: torch.Tensor) -> torch.Tensor:
        return math.pi * ((distance - self.flat) / (self.half_width - self.flat)).clamp(0, 1)
