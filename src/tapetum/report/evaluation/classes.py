"""Accuracy of the device classification and calibration of its probabilities."""

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
    """Accuracy as a function of the predicted probability, in B bins.

    Parameters
    ----------
    confidence, accuracy, count
        [B] mean probability of the predicted class, share of frames predicted correctly, number of frames.
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

    Bins of equal width (C. Guo et al., ICML 2017) would hold nearly all frames of a good model in the last one; bins of
    equal mass (K. Nguyen, B. O'Connor, EMNLP 2015) weigh the same. Frames of exactly equal probability share one
    accuracy, even across the edge of a bin.

    Parameters
    ----------
    probability, right
        [N] probability of the predicted class, and whether that class is the true one.
    bins
        Largest number of bins; with fewer frames, one bin per frame.
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
    """Return the mean over frames of the squared distance of the probabilities [N, C] from the truth (0 to 2).

    Source: G. W. Brier, Mon. Weather Rev. 78, 1 (1950), summed over the classes.
    """
    shares = np.asarray(probability, dtype=np.float64)
    _check(len(truth), len(shares))
    hot = np.array(truth)[:, None] == np.array(names)
    return float(np.square(shares - hot).sum(axis=1).mean())


def novelty_auroc(novelty: ArrayLike, unknown: ArrayLike) -> float | None:
    """Return the area under the ROC curve for telling unknown devices from known ones by novelty.

    Parameters
    ----------
    novelty, unknown
        [N] novelty, larger for stranger frames, and whether the device was unknown to the model.

    Returns
    -------
    float or None
        0.5 is chance, 1 is perfect; None where all frames are known, or none is.
    """
    strange = np.asarray(unknown, dtype=bool)
    if strange.all() or not strange.any():
        return None
    return float(roc_auc_score(strange, np.asarray(novelty, dtype=np.float64)))


def _check(one: int, other: int) -> None:
    if one != other or not one:
        raise InputError(f"expected two columns of one length, got {one} and {other}", where="classes")
