"""The Kalman filter of one quantity of a track: a value and its rate, which white noise accelerates.

A row measures the value with the variance that its interval speaks of; a row without an interval measures nothing.
Written out for two states this is shorter than the set-up of a general library would be, and quicker than its small
matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["NORMAL", "Motion", "Series", "State", "backward", "begin", "correct", "forward", "judged", "predict"]
__all__ += ["trust_in", "variance_of"]

Array = NDArray[np.float64]

NORMAL = 1.6448536269514722
"""Half-width of an interval that holds 90 % of a normal distribution, in standard deviations."""

# Of the unknown rate at the start: so many times the quantity's own spread in a second.
_FASTEST = 4.0
_TINY = 1e-300


@dataclass(frozen=True)
class Series:
    """One quantity of one track.

    Parameters
    ----------
    times
        [N] seconds, never falling.
    value, lower, upper
        [N] estimates and the ends of their 90 % intervals, in the quantity's unit. NaN where there is none.

    Raises
    ------
    InputError
        When shapes differ, or times are not finite or run backwards.
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
    """How a quantity changes, and what its errors are like.

    Parameters
    ----------
    acceleration
        Spectral density of the white noise that accelerates it, in its unit² / s³.
    spread
        Standard deviation of the quantity itself: an outlier may lie anywhere within.
    noise
        Share of the intervals' variance that is new in every row. Only this averages out.
    systematic
        Share of the raw interval's half-width that stays however many rows are averaged, for the errors of
        neighbouring frames resemble each other. 1, the default, keeps every interval at least as wide as it was;
        `calibrate` finds less where less is true.
    outliers
        Share of rows that say nothing of the truth (a gaze of the wrong sign).

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
    # The probabilistic data association filter's update, with no rival (Bar-Shalom and Tse, Automatica 11 (1975)).
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
    """Return the variances of measurement that half-widths speak of."""
    # An interval without width would divide by zero.
    return np.maximum(motion.noise * (half / NORMAL) ** 2, (1e-6 * motion.spread) ** 2)


def _variances(series: Series, motion: Motion) -> list[float]:
    """Return those of every row; NaN where it measures nothing."""
    return np.where(series.measured, variance_of(series.half_width, motion), np.nan).tolist()


def forward(series: Series, motion: Motion, trusted: Array | None = None) -> Forward:
    """Filter from the first measurement on. Where `trusted` is given it divides the variances, else each is judged."""
    times, values, variances = series.times.tolist(), series.value.tolist(), _variances(series, motion)
    trust = np.full(len(times), np.nan)
    predicted: list[State] = []
    filtered: list[State] = []
    state, likelihood, before = None, 0.0, 0.0
    for n, (time, y, r) in enumerate(zip(times, values, variances, strict=True)):
        if state is None:
            trust[n] = 1.0 if trusted is None else trusted[n]
            # Of a first row that is wrong nothing is left but that the quantity is somewhere.
            state = ahead = begin(y, min(r / max(float(trust[n]), 1e-9), r + motion.spread**2), motion)
        else:
            state = ahead = predict(state, time - before, motion.acceleration)
            if r == r:
                if trusted is None:
                    trust[n], density = trust_in(y - state.x, state.a + r, motion)
                    likelihood += density
                    state = correct(state, y, r, float(trust[n]))
                else:
                    trust[n] = trusted[n]
                    state = correct(state, y, r / max(float(trusted[n]), 1e-9), 1.0)
        before = time
        predicted.append(ahead)
        filtered.append(state)
    return Forward(predicted, filtered, trust, likelihood)


def backward(times: list[float], passed: Forward) -> list[State]:
    """Smooth (Rauch, Tung and Striebel, AIAA J. 3, 1445 (1965))."""
    after = passed.filtered[-1]
    smoothed = [after]
    for n in range(len(times) - 2, -1, -1):
        s, p, dt = passed.filtered[n], passed.predicted[n + 1], times[n + 1] - times[n]
        det = max(p.a * p.c - p.b * p.b, _TINY)
        f00, f01, f10, f11 = s.a + s.b * dt, s.b, s.b + s.c * dt, s.c
        g00, g01 = (f00 * p.c - f01 * p.b) / det, (f01 * p.a - f00 * p.b) / det
        g10, g11 = (f10 * p.c - f11 * p.b) / det, (f11 * p.a - f10 * p.b) / det
        dx, dv, da, db, dc = (one - other for one, other in zip(after, p, strict=True))
        after = State(
            s.x + g00 * dx + g01 * dv,
            s.v + g10 * dx + g11 * dv,
            max(s.a + g00 * g00 * da + 2 * g00 * g01 * db + g01 * g01 * dc, 0.0),
            s.b + g00 * g10 * da + (g00 * g11 + g01 * g10) * db + g01 * g11 * dc,
            max(s.c + g10 * g10 * da + 2 * g10 * g11 * db + g11 * g11 * dc, 0.0),
        )
        smoothed.append(after)
    return smoothed[::-1]


def judged(series: Series, motion: Motion, smoothed: list[State], trust: Array) -> Array:
    """Return each measurement's trust by what all others say of it, before and after."""
    found = np.full(len(series), np.nan)
    for n, (s, y, r) in enumerate(zip(smoothed, series.value.tolist(), _variances(series, motion), strict=True)):
        if r == r:
            own, all_told = float(trust[n]) / r, 1 / max(s.a, _TINY)
            # Of what is known, take away what the row itself has told.
            left = all_told - own
            if left > 1e-6 * all_told:
                found[n], _ = trust_in(y - (s.x * all_told - own * y) / left, r + 1 / left, motion)
            else:
                # It stands alone: nobody can judge it.
                found[n] = 1.0
    return found
