"""Two videos of one blinking laser: how far one clock lies behind the other, and how sure that is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from tapetum.errors import InputError
from tapetum.progress import Progress, quiet
from tapetum.record.source import Source

__all__ = ["Alignment", "align_blink", "brightness"]

SPOT = 1.5
"""Standard deviation in pixels of the smoothing under which a laser's spot stands out."""

_SLOW = 4.0  # s, changes slower than this are the hand's and the lamps', not the code's
_LEAST_OVERLAP = 0.3  # of the shorter video
_CODE = 12.0  # s, a code at a video's beginning is looked for in stretches of this length
_SURE, _RIVAL = 0.6, 0.75


@dataclass(frozen=True)
class Alignment:
    """How a target's clock relates to the probe's.

    Attributes
    ----------
    offset
        Seconds to add to the target's times.
    correlation
        Of the two brightnesses at that offset, over the part that both filmed: 1 is perfect.
    rival
        The best other offset's score over this one's: near 1 the code repeats itself.
    overlap
        Seconds that both filmed.
    """

    offset: float
    correlation: float
    rival: float
    overlap: float

    @property
    def text(self) -> str:
        """The alignment for people."""
        told = f"correlation {self.correlation:.2f} over {self.overlap:.1f} s, next best {self.rival:.0%} of it"
        return f"target {self.offset:+.4f} s ({told})"


def brightness(
    source: Source, progress: Progress = quiet, what: str = "looking for the blinking"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure how bright each frame is, in two ways.

    Returns
    -------
    times
        Seconds, [N].
    levels
        [N, 2]: the frame's mean, and its brightest small spot above its median.
    """
    times, levels = [], []
    for frame in progress(iter(source), what, total=source.count):
        image = frame.image.astype(np.float32)
        spot = cv2.GaussianBlur(image, (0, 0), SPOT)
        times.append(frame.time)
        levels.append((float(image.mean()), float(spot.max()) - float(np.median(spot[::4, ::4]))))
    return np.array(times), np.array(levels).reshape(-1, 2)


def _steady(levels: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Levels without their slow changes, of unit variance; zeros where nothing changes."""
    width = min(width, len(levels)) | 1
    padded = np.pad(levels, width // 2, mode="edge")
    slow = np.convolve(padded, np.full(width, 1 / width), mode="valid")[: len(levels)]
    fast = levels - slow
    spread = fast.std()
    return fast / spread if spread > 1e-6 * max(1.0, float(np.abs(levels).max())) else np.zeros_like(fast)


def _on_grid(times: NDArray[np.float64], levels: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Each moment of an even grid takes the level of the nearest frame."""
    grid = np.arange(times[0], times[-1] + step / 2, step)
    return levels[np.searchsorted((times[1:] + times[:-1]) / 2, grid)]


def _scores(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Correlation coefficient and number of common samples at every shift of b against a, from -(len(b) - 1) on."""
    ones_a, ones_b = np.ones_like(a), np.ones_like(b)

    def both(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(correlate(x, y, mode="full", method="fft"))

    n = np.maximum(np.rint(both(ones_a, ones_b)), 1)
    sum_a, sum_b = both(a, ones_b), both(ones_a, b)
    covariance = both(a, b) / n - sum_a * sum_b / n**2
    variance_a = np.maximum(both(a * a, ones_b) / n - (sum_a / n) ** 2, 0)
    variance_b = np.maximum(both(ones_a, b * b) / n - (sum_b / n) ** 2, 0)
    # A part in which hardly anything changes says nothing, however alike it looks.
    floor = 0.05
    return covariance / np.sqrt(np.maximum(variance_a, floor) * np.maximum(variance_b, floor)), n


def _best(
    probe: tuple[NDArray[np.float64], NDArray[np.float64]], target: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> Alignment | None:
    """Align two series (times, levels); None where one of them does not change."""
    frame = min(float(np.median(np.diff(times))) for times, _ in (probe, target))
    step = frame / 4
    series = [_steady(_on_grid(times, levels, step), round(_SLOW / step)) for times, levels in (probe, target)]
    if not all(one.any() for one in series):
        return None
    whole = _aligned(series[0], series[1], step, frame)
    start, length = _liveliest(series[0], round(_CODE / step))
    if length == len(series[0]):
        found = whole
    else:
        # A code that was blinked once drowns in the noise of a long video: its stretch is compared alone, too.
        part = _aligned(series[0][start : start + length], series[1], step, frame)
        part = replace(part, offset=part.offset + start * step)
        found = max(whole, part, key=_merit)
    return replace(found, offset=found.offset + float(probe[0][0]) - float(target[0][0]))


def _merit(found: Alignment) -> float:
    return found.correlation * (1 - found.rival)


def _liveliest(levels: NDArray[np.float64], length: int) -> tuple[int, int]:
    """Begin and length of the stretch in which most changes."""
    length = min(length, len(levels))
    power = np.r_[0.0, np.cumsum(levels**2)]
    return int(np.argmax(power[length:] - power[:-length])), length


def _aligned(a: NDArray[np.float64], b: NDArray[np.float64], step: float, frame: float) -> Alignment:
    """Align two series on one grid: what to add to the second one's times, both beginning at 0."""
    series = (a, b)
    correlation, n = _scores(a / max(a.std(), 1e-12), b)
    shortest = min(map(len, series))
    allowed = n >= max(_LEAST_OVERLAP * shortest, 4)
    # A longer overlap is better evidence for the same correlation.
    score = np.where(allowed, correlation * np.sqrt(np.minimum(n / shortest, 1)), -1.0)
    top = int(np.argmax(score))
    lobe = _lobe(score, top, least=round(2 * frame / step))
    others = np.delete(score, np.arange(*lobe))
    rival = max(float(others.max(initial=0.0)), 0.0) / max(float(score[top]), 1e-9)
    shift = top - (len(series[1]) - 1) + _vertex(score, top)
    return Alignment(shift * step, float(correlation[top]), rival, float(n[top]) * step)


def _lobe(score: NDArray[np.float64], top: int, least: int) -> tuple[int, int]:
    """Where the main peak begins and ends: down to half of its height, and as much again."""
    low = np.flatnonzero(score < 0.5 * score[top])
    left = top - int(low[low < top].max(initial=0))
    right = int(low[low > top].min(initial=len(score) - 1)) - top
    reach = max(least, round(1.5 * max(left, right))) if max(left, right) < len(score) // 4 else least
    return max(0, top - reach), min(len(score), top + reach + 1)


def _vertex(score: NDArray[np.float64], top: int) -> float:
    if not 0 < top < len(score) - 1:
        return 0.0
    below, at, above = score[top - 1 : top + 2]
    bend = below - 2 * at + above
    return 0.0 if bend >= 0 or below < 0 or above < 0 else float(0.5 * (below - above) / bend)


def align_blink(
    probe: tuple[NDArray[np.float64], NDArray[np.float64]],
    target: tuple[NDArray[np.float64], NDArray[np.float64]],
    where: str,
) -> Alignment:
    """Find the offset between two videos from the blinking that both show.

    The brightness of each, without its slow changes, is laid over the other's at every offset; the one with the
    highest correlation counts. Mean and brightest spot of the frames are tried; the surer pair decides.

    Parameters
    ----------
    probe, target
        Times and levels of the frames, from `brightness`.
    where
        What to call the pair in a message.

    Raises
    ------
    InputError
        When a video is too short or does not blink, or when the best offset is unlikely (correlation below 0.6) or
        ambiguous (another one scores 75 % of it, as with a regular blinking).
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
