"""Errors of pictures of sampled planes that are far fainter than a mirror's, as from a spot beside the sensor or its
mask.

The planned errors are fractions of a mirror's return. A far fainter picture is computed again with finer sampling; the
difference of the two is its error.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from tapetum.errors import InputError

__all__ = ["FAINT", "FaintPass", "Pass"]

Pass = Callable[..., torch.Tensor]
"""Of tilts [B, 2] and places [B, 2] or None, to irradiances [B, H, W]; traced lenses also take a roll [B]."""

# Peak over a mirror's below which a picture counts as faint: there a mirror's error counts 30 times.
FAINT = 1e-3


class FaintPass:
    """A pass whose faint pictures are computed again with finer sampling.

    `usual` returns the irradiance [B, H, W] at tilts [B, 2] and places [B, 2] of the RR as planned, `mirror` the same
    for a mirror in the plane's place. `finer` makes the finer pass; it, or that pass, may raise InputError where it is
    too large.
    """

    def __init__(self, usual: Pass, mirror: Pass, finer: Callable[[], Pass]) -> None:
        self._usual, self._mirror, self._make_finer = usual, mirror, finer
        self._bright: float | None = None
        self._finer: Pass | None = None
        self.missed = 0.0
        """Largest error of a faint picture so far, in fractions of its peak; infinite where it is not known."""

    def __call__(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Irradiance as of the pass."""
        image = self._usual(sines, centres)
        if self._bright is None:
            self._bright = float(self._mirror(torch.zeros_like(sines[:1]), None).detach().max())
        peak = image.detach().amax((1, 2))
        faint = (peak > 0) & (peak < FAINT * self._bright)
        which = torch.nonzero(faint)[:, 0]
        if not len(which):
            return image
        given = sines[which.to(sines.device)], None if centres is None else centres[which.to(centres.device)]
        try:
            self._finer = self._finer or self._make_finer()
            better = self._finer(*given)
        except InputError:
            self.missed = math.inf
            return image
        apart = (better - image[which]).detach().abs().amax((1, 2)) / better.detach().amax((1, 2)).clamp_min(1e-300)
        self.missed = max(self.missed, float(apart.max()))
        return image.index_put((which,), better)
