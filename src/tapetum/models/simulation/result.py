"""Result of a fit by simulation to one crop: values, their uncertainty, and other maxima."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.models.simulation.search import Top

__all__ = ["Mode", "SimulationFitResult", "result_of", "same_top", "values_of"]

Array = NDArray[np.float64]
# Half-width of a normal distribution's central 90 % in standard deviations, and the share itself.
_NINETY, _SHARE = 1.645, 0.9


@dataclass(frozen=True)
class Mode:
    """A local maximum: `values` [P] of the result's parameters, and `log_likelihood` without constants."""

    values: Array
    log_likelihood: float


@dataclass(frozen=True)
class SimulationFitResult:
    """Estimates from one crop.

    Parameters
    ----------
    names, values
        P parameters, and their values [P] at the maximum, in SI units and fractions of the field.
    covariance
        [P, P] inverse Fisher information with unknown nuisances, times the misfit where that is above 1; with the
        squares of the systematic deviations.
    lower, upper
        [P] ends of 90 % intervals: 1.645 standard deviations around the modes that make up 90 % of the likelihood.
    log_likelihood
        At the maximum, without constants.
    misfit
        Mean squared residual of the pixels in their variances: 1 for a true scene.
    starts
        Starts tried.
    modes
        Local maxima, best first: of the starts, and of the photosite periods.
    converged
        Whether the search converged.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    lower: Array
    upper: Array
    log_likelihood: float
    misfit: float
    starts: int
    modes: tuple[Mode, ...]
    converged: bool

    def __getitem__(self, name: str) -> float:
        """Return the estimate of one parameter."""
        if name not in self.names:
            raise InputError(f"no estimate of {name!r}", remedy=f"there are: {', '.join(self.names)}")
        return float(self.values[self.names.index(name)])


def result_of(
    names: tuple[str, ...],
    periods: list[Top],
    rivals: list[Top],
    starts: int,
    middle: Array,
    systematic: Mapping[str, float],
) -> SimulationFitResult:
    """Return the result of one crop: maxima of its photosite `periods`, best first, and the `rivals` of other starts.

    `middle` [2] is that of the fitted window from the image's, in metres; `systematic` are further standard deviations
    of some parameters.
    """
    best = periods[0]
    misfit = max(1.0, best.misfit)
    chosen = [best.names.index(name) for name in names]
    covariance = best.covariance[np.ix_(chosen, chosen)] * misfit
    covariance = covariance + np.diag([systematic.get(name, 0.0) ** 2 for name in names])
    modes = [Mode(values_of(one, names, middle), one.log_likelihood) for one in (*periods, *rivals)]
    # The interval covers the most likely modes up to 90 % of the total likelihood.
    share = np.exp(np.minimum([(one.log_likelihood - best.log_likelihood) / misfit for one in modes], 0.0))
    order = np.argsort(-share)
    needed = int(np.searchsorted(np.cumsum(share[order]) / share.sum(), _SHARE - 1e-9)) + 1
    within = np.array([modes[n].values for n in order[:needed]])
    half = _NINETY * np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    return SimulationFitResult(
        names,
        modes[0].values,
        covariance,
        within.min(0) - half,
        within.max(0) + half,
        best.log_likelihood,
        best.misfit,
        starts,
        tuple(sorted(modes, key=lambda one: -one.log_likelihood)),
        best.settled,
    )


def same_top(one: Top, other: Top) -> bool:
    """Return whether two searches found the same gaze, within five standard deviations."""
    apart = np.array(one.pose.gaze) + one.slow - other.pose.gaze - other.slow
    return bool((np.abs(apart) < 5 * np.sqrt(np.maximum(other.covariance.diagonal()[:2], 0.0))).all())


def values_of(top: Top, names: tuple[str, ...], middle: Array) -> Array:
    """Return the values [P] of parameters at a maximum; `middle` [2] is added to places, in metres."""
    pose = top.pose
    gaze, place = np.array(pose.gaze) + top.slow, np.array(pose.place) + middle
    found = {"gaze_x": gaze[0], "gaze_y": gaze[1], "place_x": place[0], "place_y": place[1]}
    return np.array([found[name] if name in found else getattr(pose, name) for name in names], np.float64)
