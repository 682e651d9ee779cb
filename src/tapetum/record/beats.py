"""Times of camera frames: clocks with jitter, drift and lost frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Beat", "CameraClock"]


@dataclass(frozen=True)
class Beat:
    """The frames that a camera kept: `times` [T] in seconds from the start, and how many were lost before each."""

    times: npt.NDArray[np.float64]
    dropped_before: npt.NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)


@dataclass(frozen=True)
class CameraClock:
    """When a camera takes its frames, and what its own clock says.

    Parameters
    ----------
    offset, jitter
        Delay of the first frame after the recording's start, and RMS deviation of frames from an even beat, in seconds.
    drift, loss
        Relative error of its monotonic clock, and probability that a frame is lost.
    """

    offset: float = 0.0
    jitter: float = 1.5e-3
    drift: float = 2e-5
    loss: float = 0.004

    def draw(self, count: int, rate: float, rng: np.random.Generator) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return the times of the frames that were kept, in seconds from the start, and the number lost before each."""
        times = self.offset + np.arange(count) / rate
        # At most a quarter of the frame interval, so that no two frames change places.
        times += np.clip(self.jitter * rng.standard_normal(count), -0.25 / rate, 0.25 / rate)
        kept = np.flatnonzero(np.r_[True, rng.random(count - 1) >= self.loss] if count else [])
        return times[kept], np.diff(kept, prepend=kept[:1]) - np.r_[0, np.ones(len(kept) - 1, int)]
