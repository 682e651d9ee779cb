"""Split-conformal intervals: they hold the truth with the stated probability, and widen at low SNR."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.model_selection import KFold

from tapetum.errors import InputError
from tapetum.models.prediction import COVERAGE
from tapetum.models.state import MISMATCH

__all__ = ["OTHER", "Intervals", "conformal_half_width", "fit_intervals", "has_intervals"]

OTHER = "other_unit."
"""Prefix in a model's state of its intervals for a copy of its camera that it was not trained on."""

# Names in the state of what divides the intervals; those for another copy are divided by another quantity.
_EDGES = {OTHER: "distance_edges"}

# Most classes of SNR, and fewest frames to calibrate one.
_MOST_BINS = 6
_FEWEST = 60
_FOLDS = 5
# A division by SNR must lower the interval score by this share, or all frames get the same width.
_GAIN = 0.02


def conformal_half_width(residuals: NDArray[np.float64], coverage: float = COVERAGE) -> NDArray[np.float64]:
    """Return the half-width of split-conformal intervals.

    This is the ``ceil((n + 1) coverage)``-th smallest absolute residual of n held-out frames. New frames *exchangeable*
    with those fall inside with at least that probability (Lei et al., J. Am. Stat. Assoc. 113, 1094 (2018)). Frames of
    one video are correlated, so the coverage is not guaranteed for other videos.

    Parameters
    ----------
    residuals
        [n, K], true minus estimated.
    coverage
        Wanted probability.

    Returns
    -------
    ndarray
        [K]; infinite where n is too small for the coverage (n < 9 for 90 %).
    """
    rank = int(np.ceil((len(residuals) + 1) * coverage))
    if rank > len(residuals):
        return np.full(residuals.shape[1], np.inf)
    return np.sort(np.abs(residuals), axis=0)[rank - 1]


@dataclass(frozen=True)
class Intervals:
    """Half-widths of intervals, for each class of SNR, or of what else divides frames.

    Parameters
    ----------
    edges
        [B - 1] ascending limits of the SNR between the classes; empty where all frames have the same width.
    half_width
        [B, K].
    """

    edges: NDArray[np.float64]
    half_width: NDArray[np.float64]

    def __post_init__(self) -> None:
        if self.half_width.ndim != 2 or self.edges.shape != (len(self.half_width) - 1,):
            what = f"{self.edges.shape} edges do not divide widths of shape {self.half_width.shape}"
            raise InputError(what, where="intervals", remedy="train the model again")

    @property
    def conditional(self) -> bool:
        """Whether the width depends on the SNR."""
        return len(self.edges) > 0

    def at(self, snr: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the half-widths [N, K] at SNRs [N]."""
        return self.half_width[np.searchsorted(self.edges, snr, side="right")]

    def state(self, prefix: str = "") -> dict[str, torch.Tensor]:
        """Return both as tensors; without classes of SNR only the half-widths [K]."""
        if not self.conditional:
            return {f"{prefix}half_width": torch.from_numpy(self.half_width[0])}
        edges, widths = torch.from_numpy(self.edges), torch.from_numpy(self.half_width)
        return {f"{prefix}half_width": widths, prefix + _EDGES.get(prefix, "snr_edges"): edges}

    @classmethod
    def from_state(cls, state: Mapping[str, torch.Tensor], quantities: int, prefix: str = "") -> Intervals:
        """Rebuild the intervals from `state`; raise an InputError when they are missing, misshapen or NaN."""
        widths = state.get(f"{prefix}half_width", torch.full((1, quantities + 1), torch.nan)).double().numpy()
        edges = state.get(prefix + _EDGES.get(prefix, "snr_edges"), torch.empty(0)).double().numpy()
        widths = widths[None] if widths.ndim == 1 else widths
        shaped = widths.shape == (len(edges) + 1, quantities)
        if not shaped or np.isnan(widths).any() or np.isnan(edges).any():
            what = f"expected {prefix}half_width of {quantities} quantities and {len(edges) + 1} classes of frames"
            raise InputError(what, where="weights", remedy=MISMATCH)
        return cls(edges, widths)


def has_intervals(state: Mapping[str, torch.Tensor], prefix: str) -> bool:
    """Whether a model's state holds intervals under a prefix."""
    return f"{prefix}half_width" in state


def fit_intervals(residuals: NDArray[np.float64], snr: NDArray[np.float64], *, coverage: float = COVERAGE) -> Intervals:
    """Calibrate intervals on held-out frames.

    Frames are divided into classes of equal count by SNR and each class is calibrated separately (Mondrian conformal
    prediction: V. Vovk, Proc. ACML (2012)). The number of classes is the one with the least interval score (T.
    Gneiting, A. E. Raftery, J. Am. Stat. Assoc. 102, 359 (2007)) in cross-validation over contiguous fifths. Widths so
    depend on the SNR only where the error does.

    Parameters
    ----------
    residuals
        [n, K], true minus estimated.
    snr
        [n], of `tapetum.models.snr.crop_snr`.
    coverage
        Wanted probability.
    """
    plain = Intervals(np.empty(0), conformal_half_width(residuals, coverage)[None])
    most = min(_MOST_BINS, len(residuals) // _FEWEST)
    best, least = plain, _score(residuals, snr, 1, coverage) * (1 - _GAIN)
    for bins in range(2, most + 1):
        score = _score(residuals, snr, bins, coverage)
        if score < least:
            best, least = _divided(residuals, snr, bins, coverage), score
    return best


def _divided(residuals: NDArray[np.float64], snr: NDArray[np.float64], bins: int, coverage: float) -> Intervals:
    edges = np.quantile(snr, np.arange(1, bins) / bins)
    places = np.searchsorted(edges, snr, side="right")
    widths = [conformal_half_width(residuals[places == k], coverage) for k in range(bins)]
    return Intervals(edges, np.stack(widths))


def _score(residuals: NDArray[np.float64], snr: NDArray[np.float64], bins: int, coverage: float) -> float:
    """Return the cross-validated interval score, each quantity divided by its mean absolute error."""
    if len(residuals) < 2 * _FOLDS:
        return float("inf")
    unit = np.maximum(np.abs(residuals).mean(axis=0), np.finfo(float).tiny)
    total = 0.0
    for rest, fold in KFold(_FOLDS).split(residuals):
        width = _divided(residuals[rest], snr[rest], bins, coverage).at(snr[fold])
        beyond = np.maximum(np.abs(residuals[fold]) - width, 0)
        total += float(((2 * width + 2 / (1 - coverage) * beyond) / unit).sum())
    return total
