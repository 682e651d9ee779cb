"""What the last layers of copies of a camera have in common: where a correction for a further copy begins."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tapetum.models.state import checked_state

__all__ = ["FEWEST_COPIES", "CopyPrior", "fit_copy_prior"]

Array = NDArray[np.float64]

FEWEST_COPIES = 20
"""Fewer copies cannot say how copies differ."""

_STATE = "copies."
# Directions of the features and of what copies add to the last layer that are kept, at most.
_FEATURES, _FACTORS = 128, 64
_STEPS = 40
# Standard deviations at the start, of the targets' own: of what copies add along each direction, and of what is left.
_ADDED, _LEFT = 0.35, 0.035


@dataclass(frozen=True)
class CopyPrior:
    """What a copy adds to the weights and the bias of a last layer, as a normal distribution.

    Parameters
    ----------
    mean
        [K, width + 1], the bias last.
    factors
        [K, width + 1, R]: the covariance is their product with their transpose.
    """

    mean: Array
    factors: Array

    def scaled(self, by: Array) -> CopyPrior:
        """Return it for quantities counted in units that give numbers `by` [K] times as large."""
        return CopyPrior(self.mean * by[:, None], self.factors * by[:, None, None])

    def state(self) -> dict[str, Tensor]:
        """Return the learned tensors by name."""
        return {f"{_STATE}{name}": torch.from_numpy(getattr(self, name)).float() for name in ("mean", "factors")}

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], quantities: int, width: int) -> CopyPrior | None:
        """Rebuild from what `state` returned; None where a model has none."""
        factors = state.get(f"{_STATE}factors")
        if factors is None:
            return None
        shape = quantities, width + 1
        shapes = {"mean": shape, "factors": (*shape, factors.shape[-1] if factors.ndim else 0)}
        return cls(**checked_state(state, shapes, _STATE))


def fit_copy_prior(features: Array, left: Array, number: NDArray[np.integer]) -> CopyPrior | None:
    """Learn what copies add to a last layer, by maximum likelihood over all copies.

    A linear mixed model: what the last layer leaves of a copy's targets is linear in the features, with weights drawn
    for each copy, and noise (N. M. Laird, J. H. Ware, Biometrics 38, 963 (1982); fitted by expectation and
    maximisation).

    Parameters
    ----------
    features
        [n, width] of frames of all copies.
    left
        [n, K], targets less what the last layer says.
    number
        [n], the copy that each frame shows.

    Returns
    -------
    CopyPrior
        None with fewer than `FEWEST_COPIES` copies.
    """
    names = np.unique(number)
    if len(names) < FEWEST_COPIES:
        return None
    centre = features.mean(axis=0)
    values, vectors = np.linalg.eigh(np.cov((features - centre).T))
    # Those along which features hardly vary say nothing.
    kept = np.flatnonzero(values > 1e-9 * values[-1])[::-1][:_FEATURES]
    turn = vectors[:, kept] / np.sqrt(values[kept])
    shown = np.concatenate([(features - centre) @ turn, np.ones((len(features), 1))], axis=1)
    parts = [shown[number == name] for name in names]
    mean, factors = [], []
    for wanted in left.T:
        middle, covariance = _mixed(parts, [wanted[number == name] for name in names], float(wanted.std()))
        sizes, axes = np.linalg.eigh(covariance)
        best = slice(-min(_FACTORS, len(names)), None)
        mean.append(_weights(middle[:, None], turn, centre)[:, 0])
        factors.append(_weights(axes[:, best] * np.sqrt(np.maximum(sizes[best], 0)), turn, centre))
    return CopyPrior(np.stack(mean), np.stack(factors))


def _weights(of_turned: Array, turn: Array, centre: Array) -> Array:
    """Return weights and bias [width + 1, R] for features, from those for turned features and 1."""
    weights = turn @ of_turned[:-1]
    return np.concatenate([weights, of_turned[-1:] - centre @ weights])


def _mixed(shown: list[Array], wanted: list[Array], size: float) -> tuple[Array, Array]:
    """Return mean [p] and covariance [p, p] of the weights of copies, each with features [n, p] and targets [n]."""
    squares = [(z.T @ z, z.T @ y, float(y @ y)) for z, y in zip(shown, wanted, strict=True)]
    p, frames = shown[0].shape[1], sum(map(len, wanted))
    mean, covariance, noise = np.zeros(p), (_ADDED * size) ** 2 * np.eye(p), (_LEFT * size) ** 2
    for _ in range(_STEPS):
        inverse, left = np.linalg.inv(covariance), 0.0
        means, spreads = [], np.zeros((p, p))
        for gram, meets, own in squares:
            spread = np.linalg.inv(inverse + gram / noise)
            weights = spread @ (inverse @ mean + meets / noise)
            means.append(weights)
            spreads += spread
            left += own - 2 * weights @ meets + weights @ gram @ weights + float((spread * gram).sum())
        found = np.stack(means)
        mean, noise = found.mean(axis=0), max(left / frames, 1e-9 * size**2)
        away = found - mean
        covariance = (spreads + away.T @ away) / len(found) + 1e-10 * size**2 * np.eye(p)
    return mean, covariance
