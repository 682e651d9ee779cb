"""What training makes small, where a network predicts quantities and a class at once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["MixedLoss"]


@dataclass(frozen=True)
class MixedLoss:
    """Smooth L1 on standardised quantities, and cross-entropy on the class.

    Parameters
    ----------
    quantities
        How many of the outputs are quantities; the others are the scores of the classes, whose number is the last
        column of the targets.
    """

    quantities: int

    def __call__(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean loss of outputs [n, K + C] for targets [n, K] or [n, K + 1]."""
        k = self.quantities
        parts: list[Tensor] = []
        if k:
            parts.append(F.smooth_l1_loss(output[:, :k], target[:, :k], beta=0.1))
        if output.shape[1] > k:
            parts.append(F.cross_entropy(output[:, k:], target[:, k].long()))
        return torch.stack(parts).sum()
