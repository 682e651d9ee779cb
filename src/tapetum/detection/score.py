"""How likely a candidate is a camera: a weighted sum of its looks, and how many false alarms a score costs.

The weights for a pair are those of a logistic regression (scripts/make_detector.py), fitted on lit and dark frames of
real cat-eyes outdoors and on the same frames shaken as in the hand; weights.json says on which, and what
cross-validation by scene found. For one frame alone six scenes are too few to fit weights: three looks count the same,
and only the scale of their sum is fitted.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapetum.detection.looks import OF_A_FRAME, OF_A_PAIR

__all__ = ["Score", "load_score"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """Log odds of being a camera, and the false alarms that they cost.

    Parameters
    ----------
    weights
        Of each look, in the order of `looks`.
    offset
        Log odds of a candidate whose looks are all zero.
    alarms
        Two numbers a, b: a frame has exp(a - b s) false alarms of log odds above s.
    """

    weights: tuple[float, ...]
    offset: float
    alarms: tuple[float, float]

    def log_odds(self, looks: Array) -> Array:
        """Log odds of candidates whose looks are [N, features]: [N]."""
        return looks @ np.array(self.weights) + self.offset

    def false_alarms(self, log_odds: ArrayLike) -> Array:
        """Expected false alarms a frame of at least these log odds, [N]."""
        a, b = self.alarms
        return np.exp(np.minimum(a - b * np.asarray(log_odds, dtype=np.float64), 50.0))


@functools.cache
def load_score(pair: bool) -> Score:
    """Return the weights for a pair of frames, or for one frame alone."""
    text = resources.files("tapetum.detection").joinpath("weights.json").read_text(encoding="utf-8")
    known = json.loads(text)["pair" if pair else "frame"]
    names = OF_A_FRAME + (OF_A_PAIR if pair else ())
    a, b = known["alarms"]
    return Score(tuple(known["weights"][name] for name in names), known["offset"], (a, b))
