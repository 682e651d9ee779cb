"""Distance of an image from every class that a network was trained on, to recognise unknown devices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tapetum.models.state import checked_state

__all__ = ["Novelty", "fit_novelty"]

_KNOWN = 0.98
# Share of the mean variance added to each direction: directions with little variance by chance would dominate.
_SHRINKAGE = 1e-3


@dataclass(frozen=True)
class Novelty:
    """Mahalanobis distance to the nearest class, in a network's last features.

    K. Lee et al., NeurIPS 31 (2018): each class is normally distributed about its own mean, with one covariance for
    all.

    Parameters
    ----------
    means
        [C, F] whitened mean features of each class.
    whitening
        [F, F] matrix that turns the covariance within classes into the unit matrix.
    unit
        Distance that counts as 1; 98 % of held-out frames of known devices stay below.
    """

    means: NDArray[np.float64]
    whitening: NDArray[np.float64]
    unit: float

    def __call__(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances [N] of features [N, F] from the nearest class, in `unit`."""
        return _distances(features @ self.whitening, self.means) / self.unit

    def state(self) -> dict[str, torch.Tensor]:
        """Return everything as tensors; the large whitening matrix in float32."""
        return {
            "novelty.means": torch.from_numpy(self.means),
            "novelty.whitening": torch.from_numpy(self.whitening).float(),
            "novelty.unit": torch.tensor([self.unit], dtype=torch.float64),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, torch.Tensor], classes: int, features: int) -> Novelty:
        """Rebuild the novelty from `state`; raises as `checked_state`."""
        shapes = {"means": (classes, features), "whitening": (features, features), "unit": (1,)}
        found = checked_state(state, shapes, "novelty.")
        return cls(found["means"], found["whitening"], float(found["unit"][0]))


def _distances(whitened: NDArray[np.float64], means: NDArray[np.float64]) -> NDArray[np.float64]:
    square = (whitened**2).sum(1)[:, None] - 2 * whitened @ means.T + (means**2).sum(1)
    return np.sqrt(np.maximum(square, 0).min(axis=1))


def fit_novelty(
    features: NDArray[np.float64], classes: NDArray[np.integer], count: int, aside: NDArray[np.float64]
) -> Novelty:
    """Fit the class means, their covariance and the unit of distance.

    Parameters
    ----------
    features, classes
        [n, F] features of fitted frames, and [n] their class numbers below `count`.
    count
        Number of classes; each must have a frame.
    aside
        [m, F] features of held-out frames of known classes, which set the unit. If empty, the fitted frames set it.
    """
    means = np.stack([features[classes == k].mean(axis=0) for k in range(count)])
    within = features - means[classes]
    covariance = within.T @ within / max(1, len(features) - count)
    floor = _SHRINKAGE * max(np.trace(covariance) / len(covariance), np.finfo(float).tiny)
    values, vectors = np.linalg.eigh(covariance)
    # Rounded to float32, as stored, so that a loaded model gives the same distances.
    whitening = (vectors / np.sqrt(np.maximum(values, 0) + floor)).astype(np.float32).astype(np.float64)
    whitened = means @ whitening
    known = _distances((aside if len(aside) else features) @ whitening, whitened)
    return Novelty(whitened, whitening, max(float(np.quantile(known, _KNOWN)), np.finfo(float).tiny))
