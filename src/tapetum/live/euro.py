"""The One-Euro filter: steady while what it follows is still, quick while it moves.

G. Casiez, N. Roussel, D. Vogel, "1€ filter: a simple speed-based low-pass filter for noisy input in interactive
systems", CHI 2012, pp. 2527-2530, https://doi.org/10.1145/2207676.2208639: equations (1) to (7) there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from tapetum.errors import InputError

__all__ = ["OneEuro"]


@dataclass
class OneEuro:
    """Filters one coordinate.

    Parameters
    ----------
    min_cutoff
        Cutoff frequency of a still value, in hertz: less jitter where it is lower.
    beta
        Hertz of cutoff for each unit a second of speed: less lag where it is higher.
    speed_cutoff
        Cutoff frequency of the speed, in hertz.
    longest
        Seconds without a value after which the filter begins again.
    """

    min_cutoff: float = 1.0
    beta: float = 0.0
    speed_cutoff: float = 1.0
    longest: float = 1.0
    _value: float = field(default=0.0, init=False, repr=False)
    _speed: float = field(default=0.0, init=False, repr=False)
    _time: float | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        for name, least in (("min_cutoff", "positive"), ("beta", "0 or more"), ("speed_cutoff", "positive")):
            value = getattr(self, name)
            if not (math.isfinite(value) and (value > 0 or (value == 0 and least != "positive"))):
                raise InputError(f"must be {least}, is {value}", where=name)

    def update(self, value: float, time: float) -> float:
        """Take a value at a time in seconds, and return it filtered; one that is not later changes nothing."""
        if self._time is None or time - self._time > self.longest:
            self._value, self._speed, self._time = value, 0.0, time
            return value
        step = time - self._time
        if step <= 0:
            return self._value
        # The speed is that of the raw value against the filtered one before, as in the authors' own code.
        speed = (value - self._value) / step
        self._speed += _share(self.speed_cutoff, step) * (speed - self._speed)
        cutoff = self.min_cutoff + self.beta * abs(self._speed)
        self._value += _share(cutoff, step) * (value - self._value)
        self._time = time
        return self._value


def _share(cutoff: float, step: float) -> float:
    """Weight of the new value: 1 / (1 + tau / Te) with tau = 1 / (2 pi fc)."""
    return 1 / (1 + 1 / (2 * math.pi * cutoff * step))
