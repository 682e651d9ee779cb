"""The Kalman filter of one quantity of a track: a value and its rate, driven by white-noise acceleration.

A row measures the value with the variance of its interval; a row without an interval measures nothing. The forward
filter is written out for two states, which is faster than small matrices: a fit runs it a hundred times.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["NORMAL", "Filter", "Motion", "Series", "backward", "forward", "judged", "variance_of"]

Array = NDArray[np.float64]

NORMAL = 1.6448536269514722
"""Half-width of an interval that holds 90 % of a normal distribution, in standard deviations."""

# Initial standard deviation of the rate: so many of the quantity's own spread a second.
_FASTEST = 4.0
_TINY = 1e-300
# Places of the covariance in a state.
_MATRIX = np.array([[2, 3], [3, 4]])


@dataclass(frozen=True)
class Series:
    """One quantity of one track, as N rows.

    `times` [N] are in seconds, never falling; `value`, `lower` and `upper` [N] are estimates and the ends of their 90 %
    intervals, in the quantity's unit, NaN where there is none. InputError when shapes differ, or times are not finite
    or run backwards.
    """

    times: Array
    value: Array
    lower: Array
    upper: Array

    def __post_init__(self) -> None:
        for name in ("times", "value", "lower", "upper"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
        if self.times.ndim != 1 or not self.times.shape == self.value.shape == self.lower.shape == self.upper.shape:
            shapes = ", ".join(str(one.shape) for one in (self.times, self.value, self.lower, self.upper))
            raise InputError(f"times, value, lower and upper must be [N] alike, are {shapes}", where="series")
        if not np.isfinite(self.times).all() or (np.diff(self.times) < 0).any():
            raise InputError("times are not finite or run backwards", where="series", remedy="sort the rows by time")

    def __len__(self) -> int:
        return len(self.times)

    def at(self, rows: NDArray[np.intp] | slice) -> Series:
        """Return some of the rows."""
        return Series(self.times[rows], self.value[rows], self.lower[rows], self.upper[rows])

    @property
    def half_width(self) -> Array:
        """Half the intervals' widths [N]; infinite or NaN where a row measures nothing."""
        return (self.upper - self.lower) / 2

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Which rows measure: [N]."""
        half = self.half_width
        return np.isfinite(self.value) & np.isfinite(half) & (half >= 0)


@dataclass(frozen=True)
class Motion:
    """How a quantity changes, and the statistics of its errors.

    Parameters
    ----------
    acceleration
        Spectral density of the white-noise acceleration, in its unit² / s³.
    spread
        Standard deviation of the quantity itself: an outlier may lie anywhere within.
    noise
        Share of the intervals' variance that is new in every row. Only this averages out.
    systematic
        Share of the raw interval's half-width that stays however many rows are averaged, because errors of neighbouring
        frames are correlated. 1, the default, keeps every interval at least as wide as it was; `calibrate` finds a
        smaller value where the truth allows it.
    outliers
        Share of rows without information on the truth (a gaze of the wrong sign).

    Raises
    ------
    InputError
        When a number is out of range.
    """

    acceleration: float
    spread: float
    noise: float = 1.0
    systematic: float = 1.0
    outliers: float = 0.02

    def __post_init__(self) -> None:
        for name in ("acceleration", "spread", "noise"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InputError(f"must be positive, is {getattr(self, name)}", where=f"Motion.{name}")
        if not (math.isfinite(self.systematic) and self.systematic >= 0):
            raise InputError(f"must not be negative, is {self.systematic}", where="Motion.systematic")
        if not 0 <= self.outliers < 0.5:
            raise InputError(f"must lie from 0 to 0.5, is {self.outliers}", where="Motion.outliers")


class State(NamedTuple):
    """Value and rate with their covariance [[a, b], [b, c]]."""

    x: float
    v: float
    a: float
    b: float
    c: float


def begin(y: float, r: float, motion: Motion) -> State:
    return State(y, 0.0, r, 0.0, (_FASTEST * motion.spread) ** 2)


def predict(s: State, dt: float, q: float) -> State:
    return State(
        s.x + s.v * dt,
        s.v,
        s.a + dt * (2 * s.b + dt * (s.c + q * dt / 3)),
        s.b + dt * (s.c + q * dt / 2),
        s.c + q * dt,
    )


def trust_in(off: float, variance: float, motion: Motion) -> tuple[float, float]:
    """Return the probability of no outlier, and the logarithm of the density of both cases together."""
    good = _log_normal(off, variance) + math.log1p(-motion.outliers)
    if motion.outliers == 0:
        return 1.0, good
    bad = _log_normal(off, variance + motion.spread**2) + math.log(motion.outliers)
    both = max(good, bad) + math.log1p(math.exp(-abs(good - bad)))
    return math.exp(good - both), both


def _log_normal(off: float, variance: float) -> float:
    return -0.5 * (off * off / variance + math.log(2 * math.pi * variance))


def correct(s: State, y: float, r: float, trust: float) -> State:
    """Take a measurement that is good with a probability: mean and covariance of the two cases' mixture."""
    # Update of the probabilistic data association filter without rivals (Bar-Shalom and Tse, Automatica 11 (1975)).
    variance, off = s.a + r, y - s.x
    k0, k1 = s.a / variance, s.b / variance
    gain = trust * (variance - (1 - trust) * off * off)
    return State(
        s.x + trust * k0 * off,
        s.v + trust * k1 * off,
        s.a - k0 * k0 * gain,
        s.b - k0 * k1 * gain,
        s.c - k1 * k1 * gain,
    )


class Forward(NamedTuple):
    predicted: list[State]
    filtered: list[State]
    trust: Array
    likelihood: float


def variance_of(half: Array, motion: Motion) -> Array:
    """Variances of measurement that correspond to half-widths."""
    # An interval without width would divide by zero.
    return np.maximum(motion.noise * (half / NORMAL) ** 2, (1e-6 * motion.spread) ** 2)


def _variances(series: Series, motion: Motion) -> list[float]:
    """Variance of every row; NaN where it measures nothing."""
    return np.where(series.measured, variance_of(series.half_width, motion), np.nan).tolist()


class Filter:
    """The filter forward, a row at a time."""

    def __init__(self, motion: Motion) -> None:
        self.motion = motion
        self.state: State | None = None
        self.time = 0.0

    def update(
        self, time: float, y: float, r: float, trusted: float | None = None
    ) -> tuple[State, State, float, float]:
        """Take a row that measures `y` with the variance `r`, NaN for nothing; the first row measures.

        Returns the states before and after, the trust in the measurement and the logarithm of its density. `trusted`,
        where given, divides the variance; else the row is judged by the state before it.
        """
        motion, trust, density = self.motion, math.nan, 0.0
        if self.state is None:
            trust = 1.0 if trusted is None else trusted
            # A wrong first row leaves only the quantity's own spread.
            ahead = after = begin(y, min(r / max(trust, 1e-9), r + motion.spread**2), motion)
        else:
            ahead = after = predict(self.state, time - self.time, motion.acceleration)
            if math.isnan(r):
                pass
            elif trusted is None:
                trust, density = trust_in(y - ahead.x, ahead.a + r, motion)
                after = correct(ahead, y, r, trust)
            else:
                trust, after = trusted, correct(ahead, y, r / max(trusted, 1e-9), 1.0)
        self.state, self.time = after, time
        return ahead, after, trust, density


def forward(series: Series, motion: Motion, trusted: Array | None = None) -> Forward:
    """Filter from the first measurement on. Where `trusted` is given it divides the variances, else each is judged."""
    step = Filter(motion).update
    given = [None] * len(series) if trusted is None else trusted.tolist()
    rows = zip(series.times.tolist(), series.value.tolist(), _variances(series, motion), given, strict=True)
    told = [step(*row) for row in rows]
    predicted, filtered = [row[0] for row in told], [row[1] for row in told]
    return Forward(predicted, filtered, np.array([row[2] for row in told]), sum(row[3] for row in told))


def backward(times: Array, passed: Forward) -> list[State]:
    """Smooth (Rauch, Tung and Striebel, AIAA J. 3, 1445 (1965))."""
    filtered, predicted = np.array(passed.filtered), np.array(passed.predicted)[1:]
    mean, covariance = filtered[:, :2], filtered[:, _MATRIX]
    ahead, wide = predicted[:, :2], predicted[:, _MATRIX]
    step = np.tile(np.eye(2), (len(ahead), 1, 1))
    step[:, 0, 1] = np.diff(times)
    gain = np.linalg.solve(wide, step @ covariance[:-1]).transpose(0, 2, 1)
    for n in range(len(ahead) - 1, -1, -1):
        mean[n] += gain[n] @ (mean[n + 1] - ahead[n])
        covariance[n] += gain[n] @ (covariance[n + 1] - wide[n]) @ gain[n].T
    a, b, c = np.maximum(covariance[:, 0, 0], 0.0), covariance[:, 0, 1], np.maximum(covariance[:, 1, 1], 0.0)
    return [State(*row) for row in np.column_stack([mean, a, b, c]).tolist()]


def judged(series: Series, motion: Motion, smoothed: list[State], trust: Array) -> Array:
    """Each measurement's trust, from all other rows before and after."""
    found = np.full(len(series), np.nan)
    for n, (s, y, r) in enumerate(zip(smoothed, series.value.tolist(), _variances(series, motion), strict=True)):
        if not math.isnan(r):
            own, all_told = float(trust[n]) / r, 1 / max(s.a, _TINY)
            # Subtract the row's own contribution from the estimate.
            left = all_told - own
            if left > 1e-6 * all_told:
                found[n], _ = trust_in(y - (s.x * all_told - own * y) / left, r + 1 / left, motion)
            else:
                # An isolated row: no other can judge it.
                found[n] = 1.0
    return found
