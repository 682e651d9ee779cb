"""A mask on the sensor whose picture may be faint: a spot beside the mask, or a mask that returns next to nothing.

The planner's errors are fractions of what a mirror returns. A picture that is far fainter than that is computed again
at a finer effort, and how far the two differ is its error.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from tapetum.errors import InputError

__all__ = ["MaskedPass"]

Pass = Callable[[torch.Tensor, torch.Tensor | None], torch.Tensor]

# Peak over a mirror's below which a picture counts as faint.
_FAINT = 1e-3


class MaskedPass:
    """Irradiance of a mask at gazes, as `DoublePass` gives it.

    Parameters
    ----------
    usual
        The mask, at the effort planned.
    mirror
        Irradiance at tilts, with a mirror of the sensor's reflectance in the mask's place.
    finer
        Makes the mask's pass at a finer effort. Raises InputError where that is too large.
    """

    def __init__(self, usual: Pass, mirror: Callable[[torch.Tensor], torch.Tensor], finer: Callable[[], Pass]) -> None:
        self._usual, self._mirror, self._make = usual, mirror, finer
        self._bright: float | None = None
        self._finer: Pass | None = None
        self.missed = 0.0
        """Largest error of a faint picture so far, in fractions of its peak; infinite where it is not known."""

    def __call__(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Irradiance [B, H, W] at tilts [B, 2]; `centres` as for `DoublePass`."""
        image = self._usual(sines, centres)
        if self._bright is None:
            self._bright = float(self._mirror(torch.zeros_like(sines[:1])).detach().max())
        peak = image.detach().amax((1, 2))
        faint = (peak > 0) & (peak < _FAINT * self._bright)
        if not bool(faint.any()):
            return image
        try:
            self._finer = self._finer or self._make()
        except InputError:
            self.missed = math.inf
            return image
        better = self._finer(sines, centres)
        apart = (better - image).detach().abs().amax((1, 2)) / better.detach().amax((1, 2)).clamp_min(1e-300)
        self.missed = max(self.missed, float(apart[faint].max()))
        return torch.where(faint[:, None, None], better, image)
