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
from tapetum.models.copy_prior import CopyPrior

__all__ = ["FROM_COPIES", "PENALTIES", "Correction", "LastLayer", "corrected", "folds_of", "single_folds"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Correction:
    """How a last layer is corrected.

    Parameters
    ----------
    penalty
        Of what the weights change by, in units of the features' mean variance times the number of frames. With `noise`
        it is the variance that weights have beside what copies differ by, over the features' mean variance.
    noise
        Variance of the targets, for a correction that begins from what copies add to this layer.
    """

    penalty: float
    noise: float | None = None

    def __str__(self) -> str:
        if self.noise is None:
            return f"{self.penalty:.3g}"
        return f"from what copies differ by, noise {self.noise:.3g}, further variance {self.penalty:.3g}"


PENALTIES = tuple(Correction(float(one)) for one in np.logspace(-4, 4, 17))
"""Corrections to choose among where nothing is known of copies."""
FROM_COPIES = tuple(Correction(more, noise) for more in (0.0, 1e-3, 1e-2) for noise in (1e-4, 1e-3, 1e-2))
"""Further ones where it is known what copies differ by."""
# Variance of the offset beside that of copies, in squares of the targets' standard deviation.
_OFFSET = 0.1

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


def corrected(
    before: LastLayer,
    features: Array,
    targets: Array,
    weights: Array | None,
    how: Correction,
    prior: CopyPrior | None = None,
) -> LastLayer:
    """Return a last layer corrected by regression on its residuals for some frames.

    By ridge regression: a strong penalty keeps its weights and changes only the offset; a weak one fits the weights to
    these frames. From what copies differ by: the most likely weights, which keep to those of some copy where these
    frames say nothing.

    Parameters
    ----------
    before
        The layer to correct.
    features, targets
        [n, width] and [n, K], standardised, of the frames.
    weights
        [n] of the frames, or None.
    how
        The kind of correction.
    prior
        What copies add to `before`, where `how` needs it.
    """
    left = targets - before(features)
    if how.noise is not None:
        assert prior is not None
        each = zip(left.T, prior.mean, prior.factors, strict=True)
        turn = np.stack([_most_likely(features, *one, weights, how) for one in each])
        return LastLayer(before.weight + turn[:, :-1], before.bias + turn[:, -1])
    alpha = how.penalty * float(features.var(axis=0).mean()) * len(features)
    ridge = Ridge(alpha=max(alpha, 1e-12)).fit(features, left, sample_weight=weights)
    turn = np.asarray(ridge.coef_, float).reshape(before.weight.shape)
    return LastLayer(before.weight + turn, before.bias + np.asarray(ridge.intercept_, float).ravel())


def _most_likely(
    features: Array, left: Array, mean: Array, factors: Array, weights: Array | None, how: Correction
) -> Array:
    """Return what is added to weights and bias [width + 1] for residuals [n] of one quantity.

    Weights are normal, about what copies add in the mean, with the covariance of copies, some variance of their own and
    a free offset. Solved for frames, of which there are fewer than features.
    """
    assert how.noise is not None
    shown = np.concatenate([features, np.ones((len(features), 1))], axis=1)
    centre = features.mean(axis=0)
    apart, more = features - centre, how.penalty / max(float(features.var(axis=0).mean()), 1e-12)
    known = shown @ factors
    covariance = known @ known.T + more * (apart @ apart.T) + _OFFSET
    noise = how.noise / (np.ones(len(left)) if weights is None else weights)
    pulled = np.linalg.solve(covariance + np.diag(noise), left - shown @ mean)
    added = mean + factors @ (known.T @ pulled)
    own = more * (apart.T @ pulled)
    added[:-1] += own
    added[-1] += _OFFSET * pulled.sum() - centre @ own
    return added


def single_folds(frames: int, count: int, seed: int) -> NDArray[np.int64]:
    """Return the fold of each frame, at random and of equal sizes: for frames that lie far apart."""
    return np.random.default_rng([seed, 12]).permutation(np.arange(frames) % count)


def single_frames(frames: int, count: int, seed: int) -> NDArray[np.bool_]:
    """Return which of the frames are `count` single ones at random."""
    chosen = np.zeros(frames, bool)
    chosen[np.random.default_rng([seed, 12]).permutation(frames)[:count]] = True
    return chosen


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
