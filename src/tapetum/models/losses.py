"""What training minimises: smooth L1 on quantities, cross-entropy on a class."""

from __future__ import annotations

from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor

__all__ = ["MixedLoss", "SmoothL1"]


@dataclass(frozen=True)
class SmoothL1:
    """Loss that is quadratic below `beta` and linear above, averaged over images and targets."""

    beta: float = 0.1

    def __call__(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the loss of outputs [N, K] for targets [N, K]."""
        return F.smooth_l1_loss(output, target, beta=self.beta)


@dataclass(frozen=True)
class MixedLoss:
    """Smooth L1 on standardised quantities, plus cross-entropy on the class.

    The first `quantities` outputs are quantities, the others class scores; the last target column is the class number.
    With `weighted` the targets' columns after the quantities are the weights of these.
    """

    quantities: int
    weighted: bool = False

    def __call__(self, output: Tensor, target: Tensor) -> Tensor:
        """Return the mean loss of outputs [n, K + C] for targets [n, K] or [n, K + 1].

        Weights are K columns more, before the class.
        """
        k = self.quantities
        quantities = output.new_zeros(())
        if k and self.weighted:
            each = F.smooth_l1_loss(output[:, :k], target[:, :k], beta=SmoothL1().beta, reduction="none")
            quantities = (each * target[:, k : 2 * k]).mean()
        elif k:
            quantities = SmoothL1()(output[:, :k], target[:, :k])
        if output.shape[1] == k:
            return quantities
        return quantities + F.cross_entropy(output[:, k:], target[:, -1].long())
