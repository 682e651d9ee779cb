"""How likely a candidate is a camera: a weighted sum of its features, and how many false alarms a score costs.

The weights for a pair are those of a logistic regression (scripts/make_detector.py), fitted on lit and dark frames of
real cat-eyes outdoors and on the same frames shaken as in the hand; weights.json says on which, and what
cross-validation by scene found. The log odds of the third stage (third.py) are added to their sum, which is limited
first: the real frames show little that moves, which the networks were trained on. Probabilities are calibrated on those
frames, each scene left out once. The weights for one frame alone are fitted to photographs with cameras drawn in, and
to none of the labelled frames, of which there are too few scenes for that; a second stage that was trained for it found
fewer of the real cameras and is left out. What a score costs in false alarms was counted on the labelled frames, on
photographs and on drawn scenes without cameras, and rises with a frame's clutter.
"""

from __future__ import annotations

import functools
import json
import math
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapetum.detection.features import OF_A_FRAME, OF_A_PAIR

__all__ = ["Score", "load_score"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """Log odds of being a camera, and the false alarms that they cost.

    Parameters
    ----------
    weights
        Of each feature, in the order of `looks`.
    offset
        Log odds of a candidate whose features are all zero.
    alarms
        Log odds, rising, and how many false alarms a frame of the usual clutter has above each. The logarithm of these
        is joined by straight lines, which go on beyond both ends.
    networks
        How much the networks' log odds count; 0 where there are none.
    limits
        Least and largest log odds that the features alone may give where there are networks.
    clutter
        The usual clutter, and by how much the logarithm of the false alarms at each of those log odds rises with it.
    calibration
        Two numbers k, c: on frames that the weights were not fitted to, the log odds of a camera are k s + c.
    """

    weights: tuple[float, ...]
    offset: float
    alarms: tuple[tuple[float, ...], tuple[float, ...]]
    networks: float = 0.0
    limits: tuple[float, float] = (-math.inf, math.inf)
    clutter: tuple[float, tuple[float, ...]] | None = None
    calibration: tuple[float, float] = (1.0, 0.0)

    def log_odds(self, looks: Array) -> Array:
        """Log odds of candidates from their features (`looks`, [N, features]), without the networks: [N]."""
        return looks @ np.array(self.weights) + self.offset

    def joined(self, log_odds: Array, networks: Array) -> Array:
        """Log odds from the features and the networks together, [N]."""
        return np.clip(log_odds, *self.limits) + self.networks * networks

    def probability(self, log_odds: ArrayLike, clutter: float | None = None) -> Array:
        """Probability of being a camera, [N], where the share of cameras among candidates is as in the fit.

        In a frame of other than the usual clutter the odds fall as the false alarms rise.
        """
        k, c = self.calibration
        odds = np.asarray(log_odds, dtype=np.float64)
        rises = 0.0
        if clutter is not None and self.clutter is not None:
            rises = np.interp(odds, self.alarms[0], self.clutter[1]) * (clutter - self.clutter[0])
        return 1 / (1 + np.exp(-np.clip(k * odds + c - rises, -500, 500)))

    def false_alarms(self, log_odds: ArrayLike, clutter: float | None = None) -> Array:
        """Expected false alarms of at least these log odds, [N], in a frame of so much clutter; None: of the usual."""
        at, rate = np.array(self.alarms[0]), np.log(self.alarms[1])
        odds = np.asarray(log_odds, dtype=np.float64)
        slope = np.diff(rate)[[0, -1]] / np.diff(at)[[0, -1]]
        if clutter is not None and self.clutter is not None:
            usual, rises = self.clutter
            # Higher odds never cost more.
            rate = np.minimum.accumulate(rate + np.array(rises) * (clutter - usual))
        beyond = slope[0] * np.minimum(odds - at[0], 0) + slope[1] * np.maximum(odds - at[-1], 0)
        return np.exp(np.minimum(np.interp(odds, at, rate) + beyond, 50.0))


@functools.cache
def load_score(pair: bool) -> Score:
    """Return the weights for a pair of frames, or for one frame alone."""
    text = resources.files("tapetum.detection").joinpath("weights.json").read_text(encoding="utf-8")
    known = json.loads(text)["pair" if pair else "frame"]
    names = OF_A_FRAME + (OF_A_PAIR if pair else ())
    at, rate = known["alarms"]
    clutter = known.get("clutter")
    weights = tuple(known["weights"].get(name, 0.0) for name in names)
    limits = (-math.inf, math.inf) if known["limits"] is None else tuple(known["limits"])
    return Score(
        weights,
        known["offset"],
        (tuple(at), tuple(rate)),
        known["networks"],
        limits,
        None if clutter is None else (clutter[0], tuple(clutter[1])),
        tuple(known["calibration"]),
    )
