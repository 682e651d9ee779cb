"""The probe's light over time: its power, and a blink code that aligns two videos."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from tapetum.errors import InputError
from tapetum.record.motion import Waves

__all__ = ["BlinkCode", "Exposure"]

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BlinkCode:
    """Blink code of the laser: a word of bits, sent once or periodically.

    Parameters
    ----------
    bit
        Duration of a bit in seconds: two frames or more, so that one frame lies wholly within each bit.
    bits, seed
        Length and seed of a random word, which other light does not resemble.
    word
        The word itself, 1 for on, in place of a random one: (1, 0) blinks evenly.
    start, every
        Beginning of the first word, and period in seconds; None for a single word. Between words the laser is on.
    """

    bit: float = 0.2
    bits: int = 32
    seed: int = 1
    word: tuple[int, ...] | None = None
    start: float = 0.5
    every: float | None = None

    def __post_init__(self) -> None:
        if not self.bit > 0:
            raise InputError(f"must be positive, is {self.bit} s", where="code.bit", remedy="give seconds")
        if len(self.sent) < 2 or not set(self.sent) <= {0, 1}:
            raise InputError(f"cannot be {self.sent}", where="code.word", remedy="give two or more bits, each 0 or 1")
        if self.every is not None and self.every < self.bit * len(self.sent) * (1 - 1e-9):
            what = f"words of {self.bit * len(self.sent):g} s do not fit into {self.every:g} s"
            raise InputError(what, where="code.every", remedy="send them less often, or shorten the bits")

    @cached_property
    def sent(self) -> tuple[int, ...]:
        """The word: 0 off, 1 on."""
        if self.word is not None:
            return self.word
        # It begins and ends with off, for a flank at each end.
        drawn = np.random.default_rng([self.seed, 0x60DE]).integers(0, 2, max(0, self.bits - 2))
        return (0, *(int(one) for one in drawn), 0)

    def share(self, times: Array, exposure: float = 0.0) -> Array:
        """Return the share [T] of exposures around times [T] (seconds) in which the laser is on."""
        if exposure <= 0:
            return np.array((*self.sent, 1), float)[self._index(times)]
        dark = (self._dark(times + exposure / 2) - self._dark(times - exposure / 2)) / exposure
        # Rounded, so that an exposure wholly in the dark has a share of exactly 0.
        return 1 - np.clip(np.round(dark, 6), 0, 1)

    def _phase(self, times: Array) -> Array:
        since = times - self.start
        return since if self.every is None else np.where(since >= 0, since % self.every, since)

    def _index(self, times: Array) -> npt.NDArray[np.int64]:
        index = np.floor(self._phase(times) / self.bit).astype(np.int64)
        return np.where((index < 0) | (index >= len(self.sent)), len(self.sent), index)

    def _dark(self, times: Array) -> Array:
        """Return the seconds without light since the first word began."""
        off = np.r_[0.0, np.cumsum(1 - np.array(self.sent))] * self.bit
        words = 0.0 if self.every is None else np.maximum(0, np.floor((times - self.start) / self.every))
        return np.interp(self._phase(times), np.arange(len(off)) * self.bit, off) + words * off[-1]


@dataclass(frozen=True)
class Exposure:
    """Changes of a camera's exposure, and of all the light in its frames, over a recording.

    Parameters
    ----------
    factor
        Exposure time relative to the scene's.
    drift, band
        RMS of its logarithm, as of an automatic exposure, and its frequencies in Hz.
    follow
        How far an automatic exposure compensates the target's distance in diverging light, 0 to 1.
    """

    factor: float = 1.0
    drift: float = 0.0
    band: tuple[float, float] = (0.02, 0.2)
    follow: float = 0.0

    def __post_init__(self) -> None:
        if not self.factor > 0 or self.drift < 0 or not 0 <= self.follow <= 1:
            what = f"factor {self.factor}, drift {self.drift} and follow {self.follow} are out of range"
            raise InputError(what, where="exposure", remedy="give a factor above 0, a drift from 0, a follow of 0 to 1")

    def at(self, times: Array, rng: np.random.Generator, light: Array | float = 1.0) -> Array:
        """Return exposures at times [T] (seconds) relative to the scene's, following relative light [T]."""
        return self.factor * light**-self.follow * np.exp(self.drift * Waves.draw(rng, self.band)(times)[:, 0])
