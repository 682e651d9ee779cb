"""How well devices are classified, and whether probabilities mean what they say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.metrics import accuracy_score, confusion_matrix, roc_auc_score

from tapetum.errors import InputError

__all__ = ["BINS", "Reliability", "brier_score", "confusion", "novelty_auroc", "reliability", "top_1"]

BINS = 15
"""Bins of the expected calibration error."""

Array = NDArray[np.float64]


def top_1(truth: Sequence[str], predicted: Sequence[str]) -> float:
    """Return the share of frames whose class is predicted correctly.

    Raises
    ------
    InputError
        When there is no frame or the lengths differ.
    """
    _check(len(truth), len(predicted))
    return float(accuracy_score(list(truth), list(predicted)))


def confusion(truth: Sequence[str], predicted: Sequence[str], names: Sequence[str]) -> NDArray[np.int64]:
    """Count frames by true class (rows) and predicted class (columns), [C, C] in the order of `names`.

    Raises
    ------
    InputError
        When a class is not among the names, or the lengths differ.
    """
    _check(len(truth), len(predicted))
    strange = sorted((set(truth) | set(predicted)) - set(names))
    if strange:
        raise InputError(
            f"{strange[0]!r} is not among the classes", where="confusion", remedy=f"use {', '.join(names)}"
        )
    return np.asarray(confusion_matrix(list(truth), list(predicted), labels=list(names)), dtype=np.int64)


@dataclass(frozen=True)
class Reliability:
    """How often a model is right when it says so with a certain probability.

    Parameters
    ----------
    confidence
        [B] mean probability of the predicted class in each bin.
    accuracy
        [B] share of frames predicted correctly.
    count
        [B] frames.
    """

    confidence: Array
    accuracy: Array
    count: NDArray[np.int64]

    @property
    def error(self) -> float:
        """The expected calibration error: mean over the frames of |accuracy - confidence| of their bins."""
        return float(np.average(np.abs(self.accuracy - self.confidence), weights=self.count))


def reliability(probability: ArrayLike, right: ArrayLike, *, bins: int = BINS) -> Reliability:
    """Sort frames by the probability of their predicted class into bins of equal numbers of frames.

    Bins of equal width (C. Guo et al., ICML 2017) would put nearly all frames of a good model into the last one; of
    equal mass, all count alike (K. Nguyen, B. O'Connor, EMNLP 2015). Frames of exactly the same probability share one
    accuracy, wherever a bin ends among them.

    Parameters
    ----------
    probability
        [N] of the predicted class.
    right
        [N] whether it is the true one.
    bins
        At most so many; one a frame where there are fewer.
    """
    sure, hit = np.asarray(probability, dtype=np.float64), np.asarray(right, dtype=np.float64)
    _check(len(hit), len(sure))
    if bins < 1 or not np.isfinite(sure).all() or sure.min() < 0 or sure.max() > 1 + 1e-9:
        raise InputError(f"expected probabilities and at least one bin, got {bins} bins", where="reliability")
    levels, place, size = np.unique(sure, return_inverse=True, return_counts=True)
    hit = (np.bincount(place, weights=hit, minlength=len(levels)) / size)[place]
    order = np.argsort(sure, kind="stable")
    parts = np.array_split(order, min(bins, len(order)))
    return Reliability(
        np.array([sure[part].mean() for part in parts]),
        np.array([hit[part].mean() for part in parts]),
        np.array([len(part) for part in parts], dtype=np.int64),
    )


def brier_score(probability: ArrayLike, truth: Sequence[str], names: Sequence[str]) -> float:
    """Return the mean over frames of the squared distance of the probabilities [N, C] from the truth: 0 best, 2 worst.

    Source: G. W. Brier, Mon. Weather Rev. 78, 1 (1950), summed over the classes.
    """
    shares = np.asarray(probability, dtype=np.float64)
    _check(len(truth), len(shares))
    hot = np.array(truth)[:, None] == np.array(names)
    return float(np.square(shares - hot).sum(axis=1).mean())


def novelty_auroc(novelty: ArrayLike, unknown: ArrayLike) -> float | None:
    """Return how well novelty tells unknown devices from known ones: the area under the ROC curve.

    Parameters
    ----------
    novelty
        [N], larger for stranger frames.
    unknown
        [N] whether the device was unknown to the model.

    Returns
    -------
    float or None
        0.5 is a guess, 1 is perfect; None where all frames are known, or none is.
    """
    strange = np.asarray(unknown, dtype=bool)
    if strange.all() or not strange.any():
        return None
    return float(roc_auc_score(strange, np.asarray(novelty, dtype=np.float64)))


def _check(one: int, other: int) -> None:
    if one != other or not one:
        raise InputError(f"expected two columns of one length, got {one} and {other}", where="classes")
