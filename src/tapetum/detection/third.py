"""The third stage: each candidate of a pair is judged beside everything else that its frame shows.

The weighted features and the second stage (second.py) judge one candidate at a time. How much that is worth depends on
the frame: where decoys, which are no cameras, look as much like cameras, as where people walk or leaves swing, a
candidate has to be better than where nothing moved. The input is a candidate's features, the second stage's log odds,
and numbers of the frame: how its best decoys do, and how high ordinary places stand. Up to forty cameras in one frame
do not change these. It was trained on drawn scenes only (scripts/train_third.py), several times over from different
random starts, whose mean is taken.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load

__all__ = ["FARTHEST", "OF_THE_FRAME", "SUREST", "Third", "Told", "load_third", "third_input"]

Array = NDArray[np.float64]

# Of decoys by their clear height and by the second stage, and of candidates by their clear height: ranks from 0.
_DECOYS, _DECOYS_AGAIN, _ORDINARY = (0, 1, 2, 5, 10), (0, 1, 2, 5), (40, 60, 80)
OF_THE_FRAME = (
    *(f"decoy {rank + 1}, clear" for rank in _DECOYS),
    *(f"decoy {rank + 1}, second stage" for rank in _DECOYS_AGAIN),
    *(f"candidate {rank + 1}, clear" for rank in _ORDINARY),
)
"""Numbers of a frame: logarithms of clear heights, and log odds by the second stage."""
SUREST = 9.0
"""Limit of the log odds that the second and the third stage give; what they do not look at gets the lowest."""
# Logarithm of a clear height where there are fewer places.
_LOWEST = -3.0
FARTHEST = 4.0
"""Inputs are limited to so many standard deviations of the training scenes about their mean."""


@dataclass(frozen=True)
class Third:
    """Networks of two hidden layers, and the scale of their input.

    Parameters
    ----------
    weights
        By name: `1`, `2`, `3` [networks, in, out], each with its `.bias` [networks, 1, out]; `mean` and `spread`
        [features] of the input.
    """

    weights: dict[str, NDArray[np.float32]]

    def log_odds(self, features: Array) -> Array:
        """Log odds of being a camera, [N], from `third_input`, [N, features]: the networks' mean, within `SUREST`."""
        own = np.clip((features - self.weights["mean"]) / self.weights["spread"], -FARTHEST, FARTHEST)
        values = own.astype(np.float32)
        for layer in "12":
            values = np.maximum(values @ self.weights[layer] + self.weights[f"{layer}.bias"], 0)
        odds = (values @ self.weights["3"] + self.weights["3.bias"])[..., 0].mean(0).astype(np.float64)
        return np.clip(odds, -SUREST, SUREST)


@functools.cache
def load_third() -> Third:
    """Return the networks for pairs of frames."""
    file = resources.files("tapetum.detection").joinpath("third-pair.safetensors")
    return Third({name: one.astype(np.float32) for name, one in load(file.read_bytes()).items()})


@dataclass(frozen=True)
class Told:
    """What the first two stages say of candidates, or of decoys: `looks` [N, looks], `clear` heights [N], and `again`,
    the second stage's log odds, [N]."""

    looks: Array
    clear: Array
    again: Array


def third_input(found: Told, decoys: Told) -> Array:
    """The input of `Third` for a pair's candidates, [N, features]: looks, the second stage's log odds, and the numbers
    `OF_THE_FRAME`."""
    heights, others = (np.log(np.maximum(one.clear, math.exp(_LOWEST))) for one in (found, decoys))
    frame = [*_ranked(others, _DECOYS, _LOWEST), *_ranked(decoys.again, _DECOYS_AGAIN, -SUREST)]
    frame += _ranked(heights, _ORDINARY, _LOWEST)
    return np.concatenate([found.looks, found.again[:, None], np.tile(frame, (len(found.looks), 1))], axis=1)


def _ranked(values: Array, ranks: tuple[int, ...], missing: float) -> list[float]:
    """The values of some ranks from 0, highest first."""
    falling = np.sort(values)[::-1]
    return [float(falling[rank]) if rank < len(falling) else missing for rank in ranks]
