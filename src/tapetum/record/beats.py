"""Frame times of the virtual bench's cameras: clocks with lag, jitter, drift and lost frames, and rolling shutters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from tapetum.errors import InputError, number

__all__ = ["Beat", "CameraClock"]

# Generous limits: of times in seconds, and of relative errors of a clock or rate.
_LONGEST, _LARGEST = 1e6, 0.5


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
        An offset of None is drawn evenly over a frame interval, as of a camera without a trigger.
    drift, loss
        Relative error of its monotonic clock, and probability that a frame is lost.
    rate_error
        Largest relative deviation of its frame rate from the nominal one; each recording draws its own.
    readout
        Time from the exposure of the first row to that of the last, in seconds; 0 for a global shutter. A frame's time
        is that of its middle row. It is at most 0.9 of the frame interval.
    """

    offset: float | None = 0.0
    jitter: float = 1.5e-3
    drift: float = 2e-5
    loss: float = 0.004
    rate_error: float = 0.0
    readout: float = 0.0

    def __post_init__(self) -> None:
        bounds = {"offset": (-_LONGEST, _LONGEST), "jitter": (0, _LONGEST), "readout": (0, _LONGEST), "loss": (0, 1)}
        bounds |= dict.fromkeys(("drift", "rate_error"), (-_LARGEST, _LARGEST))
        for name, (least, most) in bounds.items():
            if name == "offset" and self.offset is None:
                continue
            remedy = "give seconds" if most == _LONGEST else "give a part of one"
            value = number(getattr(self, name), f"clock {name}", remedy, least=least, most=most)
            object.__setattr__(self, name, value)
        if self.loss == 1:
            raise InputError("must be below 1, is 1", where="clock loss", remedy="a camera keeps some of its frames")

    def drawn(self, rate: float, rng: np.random.Generator) -> Self:
        """Return the clock of one recording at a nominal rate in Hz, with everything random drawn."""
        lag, error = rng.uniform(0, 1 / rate), rng.uniform(-self.rate_error, self.rate_error)
        offset = lag if self.offset is None else self.offset
        return replace(self, offset=offset, rate_error=error, readout=min(self.readout, 0.9 / rate))

    def draw(self, count: int, rate: float, rng: np.random.Generator) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        """Return the times of the frames that were kept, in seconds from the start, and the number lost before each.

        An offset of None counts as 0: see `drawn`.
        """
        times = (self.offset or 0.0) + np.arange(count) / (rate * (1 + self.rate_error))
        # At most a quarter of the frame interval, so that no two frames change places.
        times += np.clip(self.jitter * rng.standard_normal(count), -0.25 / rate, 0.25 / rate)
        kept = np.flatnonzero(np.r_[True, rng.random(count - 1) >= self.loss] if count else [])
        return times[kept], np.diff(kept, prepend=kept[:1]) - np.r_[0, np.ones(len(kept) - 1, int)]
