"""Intervals for a copy of the camera that the model was not trained on, calibrated on several such copies."""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import UNIT
from tapetum.data.marks import marks_of
from tapetum.errors import InputError
from tapetum.models.base import Estimator
from tapetum.models.intervals import Intervals
from tapetum.models.prediction import COVERAGE
from tapetum.progress import Progress, quiet

__all__ = ["FEWEST_UNITS", "calibrate_units", "fit_unit_intervals", "grouped_half_width"]

Array = NDArray[np.float64]

FEWEST_UNITS = 10
"""Fewer copies cannot support an interval of 90 %."""

# Quantiles of the distance within which a model answers that may divide its intervals.
_DIVISIONS = ((), (0.5,), (1 / 3, 2 / 3))
# A division must lower the interval score by this share.
_GAIN = 0.02


def grouped_half_width(residuals: Array, unit: NDArray[np.integer], coverage: float = COVERAGE) -> Array:
    """Return the half-width of intervals for a frame of a copy that is none of these.

    The errors of frames of one copy are alike, so copies are counted and not frames: every copy has the same weight,
    which its frames share, and the new copy has the same weight, with an infinite residual. The interval is the
    `coverage` quantile of the absolute residuals with these weights: hierarchical conformal prediction (Y. Lee, R. F.
    Barber, R. Willett, arXiv:2306.06342 (2023)). A frame of a new copy, exchangeable with these, falls inside with at
    least that probability.

    Parameters
    ----------
    residuals
        [n, K], true minus estimated.
    unit
        [n], the copy that each frame shows.
    coverage
        Wanted probability.

    Returns
    -------
    ndarray
        [K]; infinite with too few copies for the coverage (fewer than 9 for 90 %).
    """
    _, number, count = np.unique(unit, return_inverse=True, return_counts=True)
    weight = 1 / count[number] / (len(count) + 1)
    widths = np.full(residuals.shape[1], np.inf)
    for k, one in enumerate(np.abs(residuals).T):
        order = np.argsort(one, kind="stable")
        # Rounding must not ask for one frame more.
        enough = np.flatnonzero(np.cumsum(weight[order]) >= coverage - 1e-12)
        if len(enough):
            widths[k] = one[order[enough[0]]]
    return widths


def fit_unit_intervals(
    residuals: Array, distance: Array, unit: NDArray[np.integer], *, coverage: float = COVERAGE
) -> Intervals:
    """Calibrate intervals on frames of several copies, divided by their distance from the training frames.

    Frames that the model would refuse (distance above 1) have a width of their own, so that they do not widen those of
    the frames that it answers. The latter are divided further by distance where that lowers the interval score of
    copies left out in turn.

    Parameters
    ----------
    residuals, distance, unit
        [n, K] true minus estimated, [n] distances of `tapetum.models.domain.Domain` (0 for a model without one), and
        [n] numbers of copies.
    coverage
        Wanted probability.

    Returns
    -------
    Intervals
        Whose edges are distances.

    Raises
    ------
    InputError
        With fewer than `FEWEST_UNITS` copies among the frames that the model answers.
    """
    answered = distance <= 1
    have = len(np.unique(unit[answered]))
    if have < FEWEST_UNITS:
        what = f"{have} copies with frames that the model answers are too few, at least {FEWEST_UNITS} are needed"
        raise InputError(what, where="units", remedy="film more copies, or draw them from tolerances on the bench")
    best, least = np.empty(0), np.inf
    for shares in _DIVISIONS:
        edges = np.unique(np.quantile(distance[answered], shares))
        score = _score(residuals[answered], distance[answered], unit[answered], edges, coverage)
        if score < least * (1 - _GAIN):
            best, least = edges, score
    edges = np.append(best, 1.0) if (~answered).any() else best
    # At a distance of exactly 1 the model still answers.
    return _divided(residuals, distance, unit, np.nextafter(edges, np.inf), coverage)


def _divided(residuals: Array, distance: Array, unit: NDArray[np.integer], edges: Array, coverage: float) -> Intervals:
    place = np.searchsorted(edges, distance, side="right")
    widths = [grouped_half_width(residuals[place == k], unit[place == k], coverage) for k in range(len(edges) + 1)]
    return Intervals(edges, np.stack(widths))


def _score(residuals: Array, distance: Array, unit: NDArray[np.integer], edges: Array, coverage: float) -> float:
    """Return the mean interval score of copies left out in turn, each quantity over its mean absolute error."""
    size = np.maximum(np.abs(residuals).mean(axis=0), np.finfo(float).tiny)
    scores = []
    for one in np.unique(unit):
        out = unit == one
        width = _divided(residuals[~out], distance[~out], unit[~out], edges, coverage).at(distance[out])
        beyond = np.maximum(np.abs(residuals[out]) - width, 0)
        scores.append(float(((2 * width + 2 / (1 - coverage) * beyond) / size).mean()))
    return float(np.mean(scores))


def calibrate_units(model: Estimator, dataset: xr.Dataset, *, progress: Progress = quiet) -> Estimator:
    """Give a model intervals for copies of its camera that it was not trained on; nothing else of it changes.

    Parameters
    ----------
    model
        A fitted network or ridge of quantities; it is changed.
    dataset
        Frames of at least `FEWEST_UNITS` other copies, which `unit` names. Training frames calibrate where there are
        any, so that test frames stay apart.
    progress
        Shown over the frames.

    Returns
    -------
    Estimator
        The model.

    Raises
    ------
    InputError
        For a set that does not distinguish copies, lacks a label, shows a copy that the model was trained on, or has
        too few copies; and for a model that estimates no quantity.

    Examples
    --------
    >>> from tapetum.data import open_dataset
    >>> from tapetum.models import load_model, save_model
    >>> model = calibrate_units(load_model("mine"), open_dataset("copies.zarr"))  # doctest: +SKIP
    >>> save_model(model, "mine-for-copies")  # doctest: +SKIP
    """
    where = dataset.tp.source
    if not model.quantities:
        raise InputError("estimates no quantity", where="model", remedy="only quantities have intervals")
    if UNIT not in dataset:
        remedy = "film copies with `tapetum dataset synth KIND --units N`, or name a scene"
        raise InputError("does not distinguish copies of its camera", where=where, remedy=remedy)
    data = dataset.tp.train if dataset.tp.train.sizes["frame"] else dataset
    trained = set((model.training_ or {}).get("units") or ()) & set(data.tp.units)
    if trained or any(marks & model.marks for marks in marks_of(data)):
        named = f": {', '.join(sorted(trained))}" if trained else ""
        what = f"shows a copy that the model was trained on{named}"
        raise InputError(what, where=where, remedy="give other copies, or train it with --split unit")
    truth = data.tp.values(model.quantities)
    found = model.predict(data, progress=progress, anyway=True, unit="own")
    distance = np.zeros(len(truth)) if found.distance is None else found.distance
    names, unit = np.unique(np.asarray(data[UNIT].values), return_inverse=True)
    model.others_ = fit_unit_intervals(truth - found.value, distance, unit)
    told = {"copies": len(names), "frames": len(truth)}
    model.training_ = {**(model.training_ or {}), "other_units": told}
    return model
