"""What a score costs in false alarms, from alarms whose rates are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

import make_detector
from make_detector import Alarms
from tapetum.detection.score import Score

# Alarms a frame above log odds of -4, at a clutter of -6; how steeply they fall; and how they rise with clutter.
_RATE, _FALL, _RISE = 4.0, 1.4, 0.4


def frames(scene: str, times: float, seed: int, count: int = 300) -> list[Alarms]:
    rng = np.random.default_rng(seed)
    found = []
    for clutter in rng.normal(-6, 1.5, count):
        rate = times * _RATE * math.exp(_RISE * (clutter + 6))
        found.append(Alarms(scene, -4 + rng.exponential(1 / _FALL, rng.poisson(rate)), float(clutter)))
    return found


def test_costs_of_high_scores_follow_the_tail_of_the_alarms() -> None:
    """Half-way between two groups that alarm at rates four times apart, and far beyond nearly all alarms.

    The slope of the tail rests on ten alarms of one group. Where it was that of the last two levels, the median was
    off by a factor of 70 at log odds of 4.
    """
    off: dict[float, list[float]] = {odds: [] for odds in (-3.0, -1.0, 1.0, 4.0)}
    for seed in range(10):
        levels, rates, usual, rises = make_detector.costs(frames("real", 2, seed), frames("drawn", 0.5, 100 + seed))
        score = Score((), 0.0, (tuple(levels), tuple(rates)), clutter=(usual, tuple(rises)))
        for odds, some in off.items():
            told = [float(score.false_alarms(odds, clutter)) for clutter in (-8.0, -6.0, -4.0)]
            true = [_RATE * math.exp(-_FALL * (odds + 4) + _RISE * (clutter + 6)) for clutter in (-8.0, -6.0, -4.0)]
            some += np.abs(np.log(np.divide(told, true))).tolist()
    for (odds, some), most in zip(off.items(), (0.1, 0.3, 0.6, 1.5), strict=True):
        assert np.median(some) < most, odds


def test_too_few_alarms_say_nothing() -> None:
    few = frames("real", 0.001, 1, 20)
    with pytest.raises(SystemExit, match="fewer than 10 false alarms"):
        make_detector.costs(few, frames("drawn", 1, 2))
