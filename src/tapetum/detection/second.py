"""The second stage: a small network judges the few candidates with the largest weighted sum of features.

It is for pairs only. Its input is each candidate at the scale of its octave, in a near and a far view: the difference
and the dark frame in units of the candidate's own height, the difference in units of the noise around; and the
features. It was trained on drawn scenes only (scripts/train_second.py). For a few dozen candidates, products of NumPy
matrices are fast enough.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from importlib import resources

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from safetensors.numpy import load

from tapetum.detection.candidates import HALF, Cut

__all__ = ["STRIDES", "Second", "load_second", "views"]

Array = NDArray[np.float32]

STRIDES = (2, 1, 2)
"""Strides of a view's convolutions, in pixels, in order."""
_NEAR = 10
# Features are limited to so many standard deviations of the training scenes about their mean.
_FARTHEST = 3.0
# Multiple of the noise that is compressed to a half.
_NOISY = 6.0


@dataclass(frozen=True)
class Second:
    """A network of three convolutions of every view, and a hidden layer that joins them with the features.

    Parameters
    ----------
    weights
        By name: `near.1` to `near.3`, `far.1` to `far.3` [side, side, in, out] and `hidden`, `out` [in, out], each with
        its `.bias` [out]; `mean` and `spread` [features] of the features.
    """

    weights: dict[str, Array]

    def log_odds(self, near: Array, far: Array, looks: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log odds of being a camera, [N], from views [N, side, side, channels] and `looks` [N, features]."""
        own = np.clip((looks - self.weights["mean"]) / self.weights["spread"], -_FARTHEST, _FARTHEST)
        seen = [own.astype(np.float32)]
        for name, view in (("near", near), ("far", far)):
            for layer, stride in enumerate(STRIDES):
                view = self._convolved(view, f"{name}.{layer + 1}", stride)
            seen.append(view.reshape(len(view), -1))
        hidden = np.maximum(np.concatenate(seen, 1) @ self.weights["hidden"] + self.weights["hidden.bias"], 0)
        return (hidden @ self.weights["out"] + self.weights["out.bias"])[:, 0].astype(np.float64)

    def _convolved(self, view: Array, name: str, stride: int) -> Array:
        """Convolution without a rim, negative values set to 0: [N, rows, columns, out]."""
        kernel = self.weights[name]
        windows = sliding_window_view(view, kernel.shape[:2], axis=(1, 2))[:, ::stride, ::stride]
        windows = windows.transpose(0, 1, 2, 4, 5, 3)
        flat = windows.reshape(-1, kernel[..., 0].size) @ kernel.reshape(-1, kernel.shape[-1])
        flat += self.weights[f"{name}.bias"]
        return np.maximum(flat, 0, out=flat).reshape(*windows.shape[:3], -1)


@functools.cache
def load_second() -> Second:
    """Return the network for pairs of frames."""
    file = resources.files("tapetum.detection").joinpath("second-pair.safetensors")
    return Second({name: one.astype(np.float32) for name, one in load(file.read_bytes()).items()})


def views(cut: Cut, rows: NDArray[np.int64]) -> tuple[Array, Array]:
    """The network's input for a pair's candidates: [N, 21, 21, 3] near, and [N, 20, 20, 3] at half the scale.

    Channels are the difference and the dark frame, each about its surroundings' median, over the response of the
    difference of Gaussians; and the difference over the noise; compressed to lie between -1 and 1.
    """
    assert cut.dark is not None
    height = np.maximum(cut.answer[rows, HALF, HALF], 0.5)[:, None, None]
    difference = _level(cut.difference[rows])
    own, dark = difference / height, _level(cut.dark[rows]) / height
    both = np.stack([own, dark, difference / (_NOISY * cut.spread[rows, None, None])], -1).astype(np.float32)
    near = both[:, HALF - _NEAR : HALF + _NEAR + 1, HALF - _NEAR : HALF + _NEAR + 1]
    tall = both[:, 0:-1:2] + both[:, 1::2]
    far = np.asarray((tall[:, :, 0:-1:2] + tall[:, :, 1::2]) / 4, dtype=np.float32)
    return _drawn_in(near), _drawn_in(far)


def _level(patch: Array) -> Array:
    return patch - np.median(patch[:, ::2, ::2], axis=(1, 2))[:, None, None]


def _drawn_in(values: Array) -> Array:
    return np.asarray(values / (2 + np.abs(values)), dtype=np.float32)
