"""A track's estimates over time: a Kalman filter forwards, or a Rauch-Tung-Striebel smoother in both directions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize

from tapetum.errors import InputError
from tapetum.track.kalman import NORMAL, Filter, Motion, Series, backward, forward, judged, variance_of
from tapetum.track.tables import ENDS, as_table, check_columns, estimated

__all__ = ["LiveFilter", "Motion", "Series", "Smoothed", "calibrate", "fit_motion", "quantities_in", "series_of"]
__all__ += ["smooth", "smooth_tracks"]

Array = NDArray[np.float64]

# Rows in the likelihood: enough for two numbers, and a second's work.
_MOST_ROWS = 1200
_REMEDY = "give a table of tracks"


@dataclass(frozen=True)
class Smoothed(Series):
    """Filtered or smoothed rows.

    Parameters
    ----------
    times, value, lower, upper
        As of `Series`. Rows without a measurement have values too, with wider intervals, except before the first
        measurement, and where the value would be less certain than the quantity's own spread.
    rate
        [N] change of the value a second.
    deviation
        [N] standard deviation of the value, without the systematic part.
    trust
        [N] probability that the row's measurement is no outlier; NaN where there is none.
    """

    rate: Array
    deviation: Array
    trust: Array


def smooth(series: Series, motion: Motion, *, causal: bool = False) -> Smoothed:
    """Filter or smooth one quantity of one track.

    Parameters
    ----------
    series
        The estimates.
    motion
        How it moves: see `fit_motion`.
    causal
        Use no row after the estimated one, as a live view must. Else all rows, before and after.

    Raises
    ------
    InputError
        When no row measures.

    Notes
    -----
    The half-width of the interval is √(NORMAL² P + (systematic h)²) with the variance P of filter or smoother and the
    raw half-width h, between measurements that of the neighbours.
    """
    rows = np.flatnonzero(series.measured)
    if not len(rows):
        raise InputError("no row has an estimate with an interval", where="series", remedy="track with a model")
    first, times = int(rows[0]), series.times
    part = series.at(slice(first, None))
    passed = forward(part, motion)
    states, trust = passed.filtered, passed.trust
    if not causal:
        states = backward(part.times, passed)
        # Two more rounds, each row judged by both neighbours: a filter alone may reject the truth after a turn.
        for _ in range(2):
            trust = judged(part, motion, states, trust)
            states = backward(part.times, forward(part, motion, trust))
    known = np.array(states)
    deviation = np.sqrt(np.maximum(known[:, 2], 0.0))
    raw = np.interp(part.times, times[rows], series.half_width[rows])
    half = np.hypot(NORMAL * deviation, motion.systematic * raw)
    # Wider than the quantity's own range: after a track's end, or in too long a gap.
    known[~part.measured & (deviation > motion.spread)] = np.nan
    x, rate = known[:, :2].T
    columns = (x, x - half, x + half, rate, deviation, trust)
    return Smoothed(times, *(np.concatenate([np.full(first, np.nan), one]) for one in columns))


class LiveFilter:
    """The causal filter of one quantity of one track, a row at a time."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self._filter = Filter(motion)
        self._raw = math.nan

    def update(self, time: float, value: float, lower: float, upper: float) -> tuple[float, float, float]:
        """Take a row; return value, lower and upper as now known, NaN where `smooth` gives none.

        Parameters
        ----------
        time
            Seconds, not before the last row's.
        value, lower, upper
            An estimate and its interval; NaN, or an infinite interval, where there is none.

        Raises
        ------
        InputError
            When time runs backwards or is not finite.
        """
        half, begun = (upper - lower) / 2, self._filter.state is not None
        if (begun and not time >= self._filter.time) or not math.isfinite(time):
            what = f"{time} s follows {self._filter.time} s"
            raise InputError(what, where="time", remedy="give the rows in order")
        measures = math.isfinite(value) and math.isfinite(half) and half >= 0
        if not begun and not measures:
            return math.nan, math.nan, math.nan
        r = float(variance_of(np.array(half), self.motion)) if measures else math.nan
        _, state, _, _ = self._filter.update(time, value, r)
        self._raw = half if measures else self._raw
        if not measures and state.a > self.motion.spread**2:
            return math.nan, math.nan, math.nan
        wide = math.sqrt(NORMAL**2 * max(state.a, 0.0) + (self.motion.systematic * self._raw) ** 2)
        return state.x, state.x - wide, state.x + wide


def fit_motion(runs: Sequence[Series], *, systematic: float = 1.0, outliers: float = 0.02) -> Motion:
    """Fit a quantity's motion, and the share of its errors that is new in every row, by maximum likelihood.

    Parameters
    ----------
    runs
        Tracks of the same quantity, without truth. Of long ones the first rows are enough.
    systematic, outliers
        As of `Motion`.

    Raises
    ------
    InputError
        When fewer than 3 rows measure.
    """
    used: list[Series] = []
    left = _MOST_ROWS
    for run in runs:
        rows = np.flatnonzero(run.measured)[:left]
        left -= len(rows)
        if len(rows) > 1:
            used.append(run.at(rows))
    if sum(map(len, used)) < 3:
        raise InputError("fewer than 3 rows have an estimate with an interval", where="series", remedy="track longer")
    values, halves = np.concatenate([run.value for run in used]), np.concatenate([run.half_width for run in used])
    spread = max(float(values.std()), float(np.median(halves)), 1e-12)

    def motion(free: ArrayLike) -> Motion:
        log_q, log_noise = (float(one) for one in np.clip(np.asarray(free), [-14.0, -12.0], [14.0, 4.0]))
        return Motion(math.exp(log_q) * spread**2, spread, math.exp(log_noise), systematic, outliers)

    def cost(free: ArrayLike) -> float:
        return -sum(forward(run, motion(free)).likelihood for run in used)

    # The likelihood may have a second maximum, all noise and no motion: start at the higher one.
    start = min(((q, noise) for q in (-9.0, -4.0, 0.0, 4.0) for noise in (-6.0, -3.0, 0.0)), key=cost)
    corners = np.array([start, (start[0] + 1.5, start[1]), (start[0], start[1] - 1.0)])
    options = {"xatol": 0.05, "fatol": 0.05, "maxfev": 90, "initial_simplex": corners}
    found = minimize(cost, start, method="Nelder-Mead", options=options)
    return motion(found.x)


def calibrate(
    motion: Motion, runs: Sequence[tuple[Series, ArrayLike]], *, causal: bool = False, coverage: float = 0.9
) -> Motion:
    """Find the share of the raw intervals that must stay, on recordings with known truth.

    Parameters
    ----------
    motion
        As `fit_motion` found it.
    runs
        Tracks with their truth [N], NaN where it is unknown.
    causal
        Which of the two is calibrated: see `smooth`.
    coverage
        Share of true values that the intervals are to hold.

    Returns
    -------
    Motion
        With `systematic` set. More than 1 where the raw intervals were too narrow.

    Raises
    ------
    InputError
        When too few rows have a truth (9 for 90 %), or shapes differ.

    Notes
    -----
    Split-conformal: intervals grow with `systematic`, so each row has the least value at which its interval holds the
    truth, √(e² − NORMAL² P)/h, and the ``ceil((n + 1) coverage)``-th smallest of n is taken. The guarantee is for
    exchangeable rows; rows of a video are correlated, so here, as for the raw intervals, it is a guide only.
    """
    needed: list[Array] = []
    for series, given in runs:
        truth = np.asarray(given, dtype=np.float64)
        if truth.shape != series.times.shape:
            what = f"truth of shape {truth.shape} for {len(series)} rows"
            raise InputError(what, where="calibrate", remedy="give one true value a row, NaN where unknown")
        told = smooth(series, replace(motion, systematic=0.0), causal=causal)
        half = series.half_width
        good = series.measured & np.isfinite(truth) & np.isfinite(told.value) & (half > 0)
        error, own = truth[good] - told.value[good], NORMAL * told.deviation[good]
        needed.append(np.sqrt(np.maximum(error**2 - own**2, 0.0)) / half[good])
    scores = np.sort(np.concatenate(needed)) if needed else np.empty(0)
    rank = math.ceil((len(scores) + 1) * coverage)
    if rank > len(scores):
        what = f"only {len(scores)} rows have an estimate, an interval and a truth"
        raise InputError(what, where="calibrate", remedy="calibrate on a longer recording")
    return replace(motion, systematic=float(scores[rank - 1]))


def quantities_in(table: pa.Table, wanted: Sequence[str] | None = None, *, where: object = "tracks") -> tuple[str, ...]:
    """The quantities of a table of tracks that have estimates with intervals.

    Parameters
    ----------
    table
        Of tracks.
    wanted
        Those that must be among them; default: all there are.
    where
        Name of the table in messages.

    Raises
    ------
    InputError
        When there are none, or a wanted one is missing or has no interval.
    """
    check_columns(table, ("time", "track"), where, _REMEDY)
    found = estimated(table.column_names)
    for name in wanted or ():
        if name not in found:
            has = ", ".join(found) or "none"
            raise InputError(f"no column {name} with {name}_low and {name}_high", where=where, remedy=f"it has {has}")
    asked = [name for name in found if wanted is None or name in wanted]
    told = [name for name in asked if any(one.measured.any() for one in series_of(table, name).values())]
    if lacking := [name for name in wanted or () if name not in told]:
        raise InputError(f"{', '.join(lacking)} has no intervals", where=where, remedy="track with a calibrated model")
    if not told:
        remedy = "track with --model, one whose intervals are calibrated"
        raise InputError("holds no estimates with intervals", where=where, remedy=remedy)
    return tuple(told)


def series_of(table: pa.Table, name: str) -> dict[int, Series]:
    """One quantity of every track in a table, by the track's number.

    Raises
    ------
    InputError
        When a column is missing, or times run backwards.
    """
    columns = ("time", *(name + end for end in ENDS))
    check_columns(table, ("track", *columns), "tracks", _REMEDY)
    values = [_floats(table, one) for one in columns]
    return {number: Series(*(one[at] for one in values)) for number, at in _rows_of(table).items()}


def _rows_of(table: pa.Table) -> dict[int, NDArray[np.intp]]:
    """Return the places of every track's rows, in their order; sorted once, however many tracks there are."""
    numbers = table["track"].to_numpy()
    order = np.argsort(numbers, kind="stable")
    found, starts = np.unique(numbers[order], return_index=True)
    parts = np.split(order, starts[1:]) if len(found) else []
    return {int(number): part for number, part in zip(found, parts, strict=True)}


def _floats(table: pa.Table, name: str) -> Array:
    try:
        return table[name].cast(pa.float64()).to_numpy(zero_copy_only=False)
    except pa.ArrowException as error:
        raise InputError(f"column {name} holds no numbers", where="tracks", remedy=_REMEDY) from error


def smooth_tracks(
    table: Any,
    motions: Mapping[str, Motion] | None = None,
    *,
    causal: bool = False,
    systematic: float = 1.0,
    quantities: Sequence[str] | None = None,
) -> pa.Table:
    """Smooth every estimated quantity of every track in a table.

    Parameters
    ----------
    table
        Of tracks, of Arrow or pandas.
    motions
        By quantity, calibrated ones for instance. Default: fitted to the table itself.
    causal
        Use no later row: see `smooth`.
    systematic
        As of `Motion`, for fitted ones.
    quantities
        What to smooth; default: all that have intervals. Others stay as they are.

    Returns
    -------
    pyarrow.Table
        With the same rows and columns. Rows in which a track coasts have estimates too.

    Raises
    ------
    InputError
        When no quantity has estimates with intervals, or a named one has none.
    """
    table = as_table(table)
    for name in quantities_in(table, quantities):
        runs = series_of(table, name)
        motion = (motions or {}).get(name) or fit_motion(list(runs.values()), systematic=systematic)
        rows = _rows_of(table)
        columns = {end: np.full(len(table), np.nan) for end in ENDS}
        for number, series in runs.items():
            if series.measured.any():
                told = smooth(series, motion, causal=causal)
                for end, values in zip(ENDS, (told.value, told.lower, told.upper), strict=True):
                    columns[end][rows[number]] = values
        for end, values in columns.items():
            place = table.column_names.index(name + end)
            table = table.set_column(place, name + end, pa.array(values, pa.float64(), from_pandas=True))
    return table
