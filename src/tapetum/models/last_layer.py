"""The last layer of a network, corrected by few frames, and the folds by which such a correction is judged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray
from sklearn.linear_model import Ridge

from tapetum.data.embargo import reach_of
from tapetum.models.architectures import Network

__all__ = ["PENALTIES", "LastLayer", "corrected", "folds_of", "single_folds"]

Array = NDArray[np.float64]

PENALTIES = np.logspace(-4, 4, 17)
"""Penalties to choose among, in units of the features' mean variance times the number of frames."""

# Most stretches of film that a fold is made of, and how long one is at least, in times of a label's reach.
_STRETCHES, _LONG = 5, 4


@dataclass
class LastLayer:
    """A last layer for standardised quantities: weights [K, width] and biases [K]."""

    weight: Array
    bias: Array

    def __call__(self, features: Array) -> Array:
        return features @ self.weight.T + self.bias

    def put(self, network: Network) -> None:
        with torch.no_grad():
            network.head.weight.copy_(torch.from_numpy(self.weight))
            network.head.bias.copy_(torch.from_numpy(self.bias))


def corrected(before: LastLayer, features: Array, targets: Array, weights: Array | None, penalty: float) -> LastLayer:
    """Return a last layer corrected by ridge regression on its residuals for some frames.

    A strong penalty keeps its weights and changes only the offset; a weak one fits the weights to these frames.

    Parameters
    ----------
    before
        The layer to correct.
    features, targets
        [n, width] and [n, K], standardised, of the frames.
    weights
        [n] of the frames, or None.
    penalty
        In units of the features' mean variance times n.
    """
    alpha = penalty * float(features.var(axis=0).mean()) * len(features)
    left = targets - before(features)
    ridge = Ridge(alpha=max(alpha, 1e-12)).fit(features, left, sample_weight=weights)
    turn = np.asarray(ridge.coef_, float).reshape(before.weight.shape)
    return LastLayer(before.weight + turn, before.bias + np.asarray(ridge.intercept_, float).ravel())


def single_folds(frames: int, count: int, seed: int) -> NDArray[np.int64]:
    """Return the fold of each frame, at random and of equal sizes: for frames that lie far apart."""
    return np.random.default_rng([seed, 12]).permutation(np.arange(frames) % count)


def folds_of(dataset: xr.Dataset, count: int) -> NDArray[np.int64]:
    """Return the fold of each frame: every recording is cut into stretches of time, which the folds take in turn.

    Stretches are long compared with a label's reach; otherwise the embargo between folds would leave no frame to fit.
    """
    recording, span = np.asarray(dataset["recording"].values), reach_of(dataset)
    folds = np.empty(len(recording), np.int64)
    for number in np.unique(recording):
        places = np.flatnonzero(recording == number)
        stretches = _STRETCHES
        if span is not None:
            own = span[places]
            reach = float(np.median(own[:, 1] - own[:, 0]))
            lasts = float(own[:, 1].max() - own[:, 0].min())
            stretches = int(np.clip(lasts / (_LONG * max(reach, 1e-9)) / count, 1, _STRETCHES))
        pieces = min(count * stretches, len(places))
        folds[places] = (np.arange(len(places)) * pieces // len(places)) % count
    return folds
