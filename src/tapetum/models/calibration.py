"""Calibrated probabilities: one temperature for all of a network's class scores."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax, softmax

__all__ = ["fit_temperature", "probabilities"]

# Limits of the temperature's logarithm: a few frames without an error must not make a network certain.
_RANGE = (-2.0, 4.0)


def probabilities(scores: NDArray[np.float64], temperature: float) -> NDArray[np.float64]:
    """Return softmax(scores / temperature), [N, C]."""
    return np.asarray(softmax(scores / temperature, axis=1))


def fit_temperature(scores: NDArray[np.float64], classes: NDArray[np.integer]) -> float:
    """Return the temperature of least cross-entropy (C. Guo et al., ICML 2017) for scores [n, C]; 1 if n is 0."""
    if not len(scores):
        return 1.0
    own = np.arange(len(scores)), classes
    # Laplace's rule: one wrong frame is added, because a few frames without an error would give certainty.
    count = len(scores)

    def loss(log: float) -> float:
        log_p = np.asarray(log_softmax(scores / np.exp(log), axis=1))
        return float((count * -log_p[own].mean() - log_p.mean(axis=1).mean()) / (count + 1))

    best: Any = minimize_scalar(loss, bounds=_RANGE, method="bounded")
    return float(np.exp(best.x))
