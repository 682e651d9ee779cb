"""Verdicts on numbers in words, computed in one place so that text and tables agree."""

from __future__ import annotations

from tapetum.models.prediction import COVERAGE

__all__ = ["MEAN", "NARROW", "NOT_TO_USE", "against_mean", "intervals", "warnings"]

MEAN = "the training mean"
NOT_TO_USE, NARROW = "do not use such estimates", "too narrow"

# Improvements by less than this factor are not reported.
_WORTH = 1.1
# Coverage this close to the nominal one counts as right: errors of a video's frames are correlated, so the coverage of
# one video scatters by some hundredths.
_NEAR = 0.05


def against_mean(
    mae: float, guess_mae: float | None, rmse: float | None = None, guess_rmse: float | None = None
) -> str | None:
    """Compare errors with those of predicting the training part's mean, in words; None without such a guess.

    If RMSEs are given, a model that is worse by either measure counts as worse.
    """
    if guess_mae is None:
        return None
    ratios = [guess_mae / max(mae, 1e-300)]
    if rmse is not None and guess_rmse is not None:
        ratios.append(guess_rmse / max(rmse, 1e-300))
    least = min(ratios)
    words = "worse than" if least < 1 else "hardly better than" if least < _WORTH else "better than"
    return f"{words} {MEAN}"


def intervals(held: float, wanted: float = COVERAGE) -> str:
    """Compare the coverage of intervals with the nominal one, in words."""
    if held < wanted - _NEAR:
        return NARROW
    return "wider than they need be" if held > wanted + _NEAR else "as wide as they should be"


def warnings(verdict: str | None) -> str:
    """Return the remedy for a verdict of `against_mean`; empty if none is needed."""
    return "" if verdict is None or verdict.startswith("better") else NOT_TO_USE
