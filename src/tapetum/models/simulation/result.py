"""The result of a fit by simulation to one crop: values, their uncertainty, and rival maxima."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.models.simulation.search import Top

__all__ = ["Mode", "SimulationFitResult", "result_of", "same_top"]

Array = NDArray[np.float64]
# Half width of a normal distribution's middle 90 %, in standard deviations.
_NINETY, _SHARE = 1.645, 0.9


@dataclass(frozen=True)
class Mode:
    """A maximum of the likelihood that was found from one of the starts.

    Parameters
    ----------
    values
        [P] of the result's parameters.
    log_likelihood
        Without constants: differences count.
    """

    values: Array
    log_likelihood: float


@dataclass(frozen=True)
class SimulationFitResult:
    """What one crop says.

    Parameters
    ----------
    names
        Of the parameters, P.
    values
        [P], in SI units and fractions of the field, where the likelihood is largest.
    covariance
        [P, P] the inverse of Fisher's information there, the nuisances being unknown, times the misfit where that is
        above 1.
    lower, upper
        [P] ends of 90 % intervals: 1.645 standard deviations to either side, of all modes it takes to make up 90 %.
    log_likelihood
        At the maximum, without constants.
    misfit
        Mean squared residual of the pixels, in their variances: 1 where the scene is true.
    starts
        Starts tried, and what each led to.
    modes
        Rival maxima, the best first: of the starts, and of the photosites' periods.
    converged
        Whether the search came to rest.
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
        """The estimate of one parameter."""
        if name not in self.names:
            raise InputError(f"no estimate of {name!r}", remedy=f"there are: {', '.join(self.names)}")
        return float(self.values[self.names.index(name)])


def result_of(
    names: tuple[str, ...], periods: list[Top], rivals: list[Top], starts: int, middle: Array
) -> SimulationFitResult:
    """Sum up one crop's maxima: of its photosites' periods, the best one first, and the `rivals` of other starts.

    `middle` is that of the pixels looked at from the image's, [2] in metres.
    """
    best = periods[0]
    misfit = max(1.0, best.misfit)
    chosen = [best.names.index(name) for name in names]
    covariance = best.covariance[np.ix_(chosen, chosen)] * misfit
    modes = [Mode(_values(one, names, middle), one.log_likelihood) for one in (*periods, *rivals)]
    # Modes that together make up 90 %; far ones, of other starts, as well.
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
    """Whether two climbs came to the same maximum, by the gaze."""
    apart = np.array(one.pose.gaze) + one.slow - other.pose.gaze - other.slow
    return bool((np.abs(apart) < 5 * np.sqrt(np.maximum(other.covariance.diagonal()[:2], 0.0))).all())


def _values(top: Top, names: tuple[str, ...], middle: Array) -> Array:
    pose = top.pose
    gaze, place = np.array(pose.gaze) + top.slow, np.array(pose.place) + middle
    found = {"gaze_x": gaze[0], "gaze_y": gaze[1], "place_x": place[0], "place_y": place[1]}
    return np.array([found[name] if name in found else getattr(pose, name) for name in names], np.float64)
