"""Alignment of two videos of one blinking laser: the offset between their clocks, and its reliability."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d
from scipy.signal import correlate

from tapetum.data.crop import vertex
from tapetum.errors import InputError
from tapetum.progress import Progress, quiet
from tapetum.record.source import Source

__all__ = ["Alignment", "align_blink", "brightness"]

SPOT = 1.5
"""Standard deviation in pixels of the smoothing that detects a laser spot."""

_SLOW = 4.0  # s, slower changes come from the hand and the lamps, not from the code
_LEAST_OVERLAP = 0.3  # of the shorter video
_CODE = 12.0  # s, length of the stretch in which a single code is searched
_SURE, _RIVAL = 0.6, 0.75

Levels = NDArray[np.float64]
Series = tuple[Levels, Levels]
"""Times in seconds, [N], and levels, [N] or [N, 2]."""


@dataclass(frozen=True)
class Alignment:
    """How a target's clock relates to the probe's."""

    offset: float  # seconds to add to the target's times
    correlation: float  # of the two brightnesses during the overlap: 1 is perfect
    rival: float  # score of the best other offset relative to this one: near 1 the code repeats itself
    overlap: float  # seconds in both videos

    @property
    def text(self) -> str:
        """The alignment for people."""
        told = f"correlation {self.correlation:.2f} over {self.overlap:.1f} s, next best {self.rival:.0%} of it"
        return f"target {self.offset:+.4f} s ({told})"


def brightness(source: Source, progress: Progress = quiet, what: str = "looking for the blinking") -> Series:
    """Return the frames' times and brightness: the mean, and the brightest small spot above the median."""
    times, levels = [], []
    for frame in progress(iter(source), what, total=source.count):
        image = frame.image.astype(np.float32)
        spot = cv2.GaussianBlur(image, (0, 0), SPOT)
        times.append(frame.time)
        levels.append((float(image.mean()), float(spot.max()) - float(np.median(spot[::4, ::4]))))
    return np.array(times), np.array(levels).reshape(-1, 2)


def _steady(levels: Levels, width: int) -> Levels:
    """Return levels without slow changes, of unit variance; zeros where nothing changes."""
    fast = levels - uniform_filter1d(levels, min(width, len(levels)) | 1, mode="nearest")
    spread = fast.std()
    return fast / spread if spread > 1e-6 * max(1.0, float(np.abs(levels).max())) else np.zeros_like(fast)


def _scores(a: Levels, b: Levels) -> tuple[Levels, Levels]:
    """Return correlation and number of common samples for every shift of b, from -(len(b) - 1) on."""

    def both(x: Levels, y: Levels) -> Levels:
        return np.asarray(correlate(x, y, mode="full", method="fft"))

    ones_a, ones_b = np.ones_like(a), np.ones_like(b)
    n = np.maximum(np.rint(both(ones_a, ones_b)), 1)
    mean_a, mean_b = both(a, ones_b) / n, both(ones_a, b) / n
    # The lower limit keeps nearly constant parts from correlating by chance.
    variance_a = np.maximum(both(a * a, ones_b) / n - mean_a**2, 0.05)
    variance_b = np.maximum(both(ones_a, b * b) / n - mean_b**2, 0.05)
    return (both(a, b) / n - mean_a * mean_b) / np.sqrt(variance_a * variance_b), n


def _best(probe: Series, target: Series) -> Alignment | None:
    """Align two series (times, levels); return None where one of them is constant."""
    frame = max(float(np.median(np.diff(times))) for times, _ in (probe, target))
    step = frame / 4
    series = []
    for times, levels in (probe, target):
        # Resampled on an even grid from the nearest frame.
        grid = np.arange(times[0], times[-1] + step / 2, step)
        nearest = levels[np.searchsorted((times[1:] + times[:-1]) / 2, grid)]
        series.append(_steady(nearest, round(_SLOW / step)))
    a, b = series
    if not (a.any() and b.any()):
        return None
    found = _aligned(a, b, step, frame)
    length = round(_CODE / step)
    if length < len(a):
        # Noise of a long video may hide a single code, so the stretch with most changes is also compared alone.
        power = np.r_[0.0, np.cumsum(a**2)]
        start = int(np.argmax(power[length:] - power[:-length]))
        part = _aligned(a[start : start + length], b, step, frame)
        found = max(found, replace(part, offset=part.offset + start * step), key=_merit)
    return replace(found, offset=found.offset + float(probe[0][0]) - float(target[0][0]))


def _merit(found: Alignment) -> float:
    return found.correlation * (1 - found.rival)


def _aligned(a: Levels, b: Levels, step: float, frame: float) -> Alignment:
    """Align two series on one grid; the offset applies to the second one's times, both beginning at 0."""
    correlation, n = _scores(a / max(a.std(), 1e-12), b)
    shortest = min(len(a), len(b))
    # A longer overlap is better evidence for the same correlation.
    score = np.where(n >= max(_LEAST_OVERLAP * shortest, 4), correlation * np.sqrt(np.minimum(n / shortest, 1)), -1.0)
    top = int(np.argmax(score))
    others = np.delete(score, np.arange(*_lobe(score, top, least=round(2 * frame / step))))
    rival = max(float(others.max(initial=0.0)), 0.0) / max(float(score[top]), 1e-9)
    shift = float(top - (len(b) - 1))
    # Offsets with too short an overlap score -1 and have no part in the refinement.
    if 0 < top < len(score) - 1 and min(around := score[top - 1 : top + 2].tolist()) >= 0:
        shift += vertex(*around)
    return Alignment(shift * step, float(correlation[top]), rival, float(n[top]) * step)


def _lobe(score: Levels, top: int, least: int) -> tuple[int, int]:
    """Return begin and end of the main peak: down to half of its height, plus as much again."""
    low = np.flatnonzero(score < 0.5 * score[top])
    left = top - int(low[low < top].max(initial=0))
    right = int(low[low > top].min(initial=len(score) - 1)) - top
    reach = max(least, round(1.5 * max(left, right))) if max(left, right) < len(score) // 4 else least
    return max(0, top - reach), min(len(score), top + reach + 1)


def align_blink(probe: Series, target: Series, where: str) -> Alignment:
    """Find the offset between two videos from the blinking that both show.

    Their `brightness` without slow changes is correlated at every offset, for the mean and the brightest spot of the
    frames; the most reliable pair decides. Raises an InputError about the pair `where` when a video is too short or
    does not blink, or when the best offset is unlikely (correlation below 0.6) or ambiguous (another one scores 75 % of
    it, as with a regular blinking).
    """
    if min(len(probe[0]), len(target[0])) < 8:
        raise InputError("has fewer than 8 frames to align by", where=where, remedy="use align 'same start'")
    found = [
        one
        for p in range(probe[1].shape[1])
        for t in range(target[1].shape[1])
        if (one := _best((probe[0], probe[1][:, p]), (target[0], target[1][:, t]))) is not None
    ]
    if not found:
        raise InputError("a video's brightness never changes", where=where, remedy="use align 'timestamps'")
    best = max(found, key=_merit)
    remedy = "blink an irregular code of some ten seconds into both, or use align 'timestamps' or 'same start'"
    if best.correlation < _SURE:
        what = f"no blinking is seen by both videos (best correlation {best.correlation:.2f}, needed {_SURE})"
        raise InputError(what, where=where, remedy=remedy)
    if best.rival > _RIVAL:
        what = f"the blinking fits at several offsets (next best {best.rival:.0%} of {best.correlation:.2f})"
        raise InputError(what, where=where, remedy=remedy)
    return best
