"""Calibration of two cameras' clocks by the laser's blink code: lag, drift and what is left of both.

The words of the code are located in each stream separately. A frame shows the laser on or off by its brightness,
compared with the recent largest and smallest one; a word may begin at every time for which all frames but a few agree
with it, within the jitter of their time stamps. The posterior of the words' common beginning and period, computed over
a grid, gives both with their deviations. Where every flank falls at the same phase of the frames, as with bits that
last whole frames, further flanks add no information: the posterior stays wide, where a mean over words would not.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from tapetum.calibrate.page import write_calibration
from tapetum.calibrate.uncertainty import Measured
from tapetum.calibrate.verdict import Check, verdict
from tapetum.data.importing.align import brightness
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.progress import Progress, quiet
from tapetum.record.laser import BlinkCode
from tapetum.record.recording import Recording
from tapetum.report.figures._style import MODELS, QUIET, dress, legend, new_figure

__all__ = ["SyncCalibration", "Word", "calibrate_sync", "code_of"]

Array = NDArray[np.float64]
SCHEMA = "tapetum/sync/1"

_SURE, _ERROR, _LAG, _DRIFT = 0.8, 0.01, 0.25, 5e-3
_FOUND = 0.6  # correlation from which a word is one
_JITTER = 2e-3  # s, of a frame's time stamp
_FINE = 5e-4  # s
_SPAN = 1.0  # bits about a word's rough place in which it is sought
_WRONG = 0.02  # probability that a frame shows the opposite: a hand before the lens


@dataclass(frozen=True, eq=False)
class Word:
    """A word of the code in one stream: when it began (s), how surely, and how well it fits.

    Attributes
    ----------
    start, correlation
        Its beginning by the stream's clock, and the correlation of the light that is seen with the code that was sent.
    times, seen, sent
        [N] frames about the word: their times, what share of the light they show, and what the code says.
    places, misfit
        [G] beginnings that were tried, and the misfit of each in units of chance (minus its logarithm).
    """

    start: Measured
    correlation: float
    times: Array
    seen: Array
    sent: Array
    places: Array
    misfit: Array


@dataclass(frozen=True, eq=False)
class SyncCalibration:
    """How the target's clock relates to the probe's.

    Attributes
    ----------
    lag
        Seconds to add to the target's times.
    drift
        By how much the lag grows a second; None of a single word.
    residual
        RMS of the words' lags about the straight line, in seconds; None of fewer than three.
    probe, target
        The words that both streams show, in order.
    frame, seconds
        Median interval of the target's frames, and the length of the recording.
    """

    lag: Measured
    drift: Measured | None
    residual: float | None
    probe: tuple[Word, ...]
    target: tuple[Word, ...]
    frame: float
    seconds: float

    @property
    def verdict(self) -> str:
        """`good`, or which checks failed."""
        return verdict(self.checks())

    def checks(self) -> list[Check]:
        """Return what was checked."""
        least = min(word.correlation for word in (*self.probe, *self.target))
        most = _LAG * self.frame
        checks = [
            Check(
                "fit of the code",
                f"correlation {least:.2f} at least",
                f"{_SURE:g} or more",
                least >= _SURE,
                "check the code's number, keep the laser in both pictures, and let no other light change",
            ),
            Check(
                "uncertainty of the lag",
                f"{1e3 * self.lag.error:.1f} ms",
                f"{1e3 * _ERROR:g} ms or less",
                self.lag.error <= _ERROR,
                "send the code several times, or film at more frames a second",
            ),
            Check(
                "lag",
                f"{1e3 * self.lag.value:+.1f} ms",
                f"within {1e3 * most:.0f} ms (a quarter of the target's frame interval), or 2 errors",
                abs(self.lag.value) <= max(most, 2 * self.lag.error),
                f"put the target's clock right: tapetum record … --offset '{1e3 * self.lag.value:.1f} ms'",
            ),
        ]
        if self.drift is not None:
            grown = abs(self.drift.value) * self.seconds
            checks.append(
                Check(
                    "drift over the recording",
                    f"{1e3 * grown:.1f} ms",
                    f"within {1e3 * _DRIFT:g} ms, or 3 errors",
                    grown <= max(_DRIFT, 3 * self.drift.error * self.seconds),
                    "make shorter recordings, each with a code, or give both cameras one clock",
                )
            )
        return checks

    def numbers(self) -> list[tuple[str, str]]:
        """Return what was measured, with standard uncertainties, as text."""
        one = self.drift
        drift = "not measured: one word" if one is None else f"{Measured(1e6 * one.value, 1e6 * one.error)} µs/s"
        rest = "not measured: fewer than three words" if self.residual is None else f"{1e3 * self.residual:.2f} ms RMS"
        return [
            ("lag: to add to the target's times", f"{Measured(1e3 * self.lag.value, 1e3 * self.lag.error)} ms"),
            ("drift of the lag", drift),
            ("residual of the words", rest),
            ("words", str(len(self.probe))),
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return what was measured as plain values, in seconds."""

        def plain(one: Measured | None) -> dict[str, float] | None:
            return None if one is None else {"value": float(f"{one.value:.6g}"), "error": float(f"{one.error:.3g}")}

        return {
            "lag": plain(self.lag),
            "drift": plain(self.drift),
            "residual": None if self.residual is None else float(f"{self.residual:.3g}"),
            "words": len(self.probe),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the YAML file."""
        text = f"# Written by tapetum calibrate sync: seconds, to add to the target's times.\nschema: {SCHEMA}\n"
        content = {**self.as_dict(), "verdict": self.verdict}
        with atomic_file(path) as part:
            part.write_text(text + yaml.safe_dump(content, sort_keys=False), "utf-8")

    def figure(self) -> Figure:
        """Draw the first word in both streams, and the lag of every word."""
        figure = new_figure(10, 3.6)
        left, right = figure.subplots(1, 2, width_ratios=(2, 1))
        for name, words, colour, up in (("probe", self.probe, MODELS[0], 1.3), ("target", self.target, MODELS[1], 0.0)):
            word = words[0]
            left.step(word.times, word.sent + up, where="mid", color=QUIET, linewidth=0.8)
            left.plot(word.times, word.seen + up, "o", color=colour, markersize=3, label=name)
        left.set_yticks([])
        dress(
            left, title="The code in both streams, and as sent", x="time by the stream's clock, s", letter="a", grid="x"
        )
        legend(left, loc="upper right", ncols=2)
        starts = [word.start.value for word in self.probe]
        lags = [1e3 * (p.start.value - t.start.value) for p, t in zip(self.probe, self.target, strict=True)]
        errors = [1e3 * math.hypot(p.start.error, t.start.error) for p, t in zip(self.probe, self.target, strict=True)]
        right.errorbar(starts, lags, errors, fmt="o", color=MODELS[0], markersize=4, capsize=3)
        if self.drift is not None:
            middle = float(np.mean(starts))
            line = [1e3 * (self.lag.value + self.drift.value * (start - middle)) for start in starts]
            right.plot(starts, line, color=QUIET, linewidth=1)
        dress(right, title="Lag of each word", x="time, s", y="ms", letter="b")
        return figure

    def write_page(self, path: str | os.PathLike[str]) -> None:
        """Write the page: verdict, numbers, pictures and checks."""
        write_calibration(
            path,
            "Calibration of two cameras' clocks",
            self.checks(),
            self.numbers(),
            self.figure(),
            alt=f"The blink code in both streams, and the lag of {len(self.probe)} words.",
            caption="(a) Points: what share of the light each frame shows; lines: what the code sent, as placed. "
            "(b) The probe's time of each word less the target's.",
            notes=["A rolling shutter sees the laser at its row's time: such a lag is that of the row where it lies."],
        )


def code_of(recording: Recording) -> BlinkCode | None:
    """Return the blink code that a recording says it holds; None where it says nothing."""
    told = recording.meta.get("laser")
    known = (told or {}).get("code") if isinstance(told, dict) else None
    if not isinstance(known, dict):
        return None
    try:
        word = tuple(int(bit) for bit in known["word"])
        every = None if known.get("every") is None else float(known["every"])
        return BlinkCode(float(known["bit"]), len(word), word=word, start=float(known["start"]), every=every)
    except (KeyError, TypeError, ValueError):
        return None


def calibrate_sync(recording: Recording, code: BlinkCode | None = None, progress: Progress = quiet) -> SyncCalibration:
    """Measure lag and drift between the two streams of a recording by the laser's blink code.

    Parameters
    ----------
    recording
        With the streams `probe` and `target`.
    code
        What the laser sent; by default what the recording says. Its `start` is not used: the words are searched.
    progress
        Shown over the frames.

    Raises
    ------
    InputError
        When there is no such code, a stream is missing or too short, or no word is seen in both.
    """
    code = code or code_of(recording)
    if code is None:
        remedy = "give --blink N, the number of the code that the laser blinked"
        raise InputError("does not say which code was blinked", where=recording.path, remedy=remedy)
    start = int(recording.utc_ns("probe")[0])
    found = {}
    for name in ("probe", "target"):
        source = recording.source(name)
        times = (recording.utc_ns(name) - start) / 1e9
        _, levels = brightness(source, progress, f"looking at {name}")
        if len(levels) < 8:
            raise InputError(f"{name} has fewer than 8 frames", where=recording.path, remedy="record longer")
        known = [frame["exposure"] for frame in source.known if frame["exposure"] is not None]
        found[name] = _words(times[: len(levels)], levels, code, float(np.median(known)) if known else 0.0)
    probe, target, numbers, period = _paired(found["probe"], found["target"], code)
    if not numbers:
        counts = f"{len(found['probe'])} in probe, {len(found['target'])} in target"
        what = f"no word of the code is seen in both streams ({counts})"
        raise InputError(what, where=recording.path, remedy="check the code's number and bit, and blink it again")
    frame = float(np.median(np.diff((recording.utc_ns("target") - start) / 1e9)))
    (p, rate_p), (t, rate_t) = (_together(words, np.array(numbers), period) for words in (probe, target))
    lag = Measured(p.value - t.value, math.hypot(p.error, t.error))
    drift = None
    residual = None
    if len(numbers) > 1:
        drift = Measured((rate_p.value - rate_t.value) / period, math.hypot(rate_p.error, rate_t.error) / period)
        lags = np.array([one.start.value - other.start.value for one, other in zip(probe, target, strict=True)])
        steps = np.array(numbers) - np.mean(numbers)
        rest = lags - lag.value - drift.value * period * steps
        residual = float(np.sqrt(np.mean(rest**2))) if len(numbers) > 2 else None
    return SyncCalibration(lag, drift, residual, probe, target, frame, float(max(times[-1], 0.0)))


def _words(times: Array, levels: Array, code: BlinkCode, exposure: float) -> list[Word]:
    """Return the words that a stream shows, by the brightness, mean or spot, that fits them better."""
    frame = float(np.median(np.diff(times)))
    length = code.bit * len(code.sent)
    found = [_placed(times, _share(column, max(3, round(1.5 / frame))), code, exposure, length) for column in levels.T]
    return max(found, key=lambda words: sum(word.correlation for word in words))


def _share(levels: Array, width: int) -> Array:
    """Return levels as shares of the way between their running extremes, so that a slow change of light drops out."""
    low = minimum_filter1d(levels, 2 * width + 1, mode="nearest")
    high = maximum_filter1d(levels, 2 * width + 1, mode="nearest")
    span = high - low
    # Where the light hardly changes there is no code: it counts as on.
    return np.where(span > 0.3 * np.percentile(span, 90), (levels - low) / np.maximum(span, 1e-12), 1.0)


def _sent(code: BlinkCode, times: Array, starts: Array, exposure: float) -> Array:
    """Return the share of light [S, N] of frames at `times`, of a single word that begins at each of `starts`."""
    one = BlinkCode(code.bit, len(code.sent), word=code.sent, start=0.0)
    since = times[None] - starts[:, None]
    # The stamps' jitter rounds the flanks off, as a longer exposure does.
    return one.share(since, max(exposure, 2 * math.sqrt(3) * _JITTER))


def _placed(times: Array, seen: Array, code: BlinkCode, exposure: float, length: float) -> list[Word]:
    """Return every word in a stream, best first in its stretch, in order of time."""
    words: list[Word] = []
    margin = 1.5 * code.bit
    coarse = np.arange(times[0] - margin, times[-1] - 0.8 * length, code.bit / 8)
    scores = np.array([_correlation(times, seen, code, start, exposure, length, margin) for start in coarse])
    while len(coarse) and scores.max() > _FOUND:
        best = float(coarse[np.argmax(scores)])
        words.append(_refined(times, seen, code, best, exposure, length, margin))
        scores[np.abs(coarse - best) < 0.9 * length] = -1.0
    return sorted(words, key=lambda word: word.start.value)


def _correlation(
    times: Array, seen: Array, code: BlinkCode, start: float, exposure: float, length: float, margin: float
) -> float:
    here = (times > start - margin) & (times < start + length + margin)
    if here.sum() < len(code.sent) / 2:
        return -1.0
    wanted, given = _sent(code, times[here], np.array([start]), exposure)[0], seen[here]
    wanted, given = wanted - wanted.mean(), given - given.mean()
    # Not by numpy.corrcoef, whose covariance matrix takes longer than all the rest.
    size, other = math.sqrt(wanted @ wanted), math.sqrt(given @ given)
    if min(size, other) < 1e-3 * math.sqrt(len(given)):
        return -1.0
    return float(wanted @ given) / (size * other)


def _refined(
    times: Array, seen: Array, code: BlinkCode, start: float, exposure: float, length: float, margin: float
) -> Word:
    """Place a word: the middle and deviation of the posterior of its beginning."""
    here = (times > start - margin) & (times < start + length + margin)
    grid = np.arange(start - _SPAN * code.bit, start + _SPAN * code.bit, _FINE)
    # On or off at the middle of the exposure: brightness in between depends more on a hand and a turning camera than on
    # the flanks.
    lit = _sent(code, times[here], grid, 0.0)
    agrees = np.where(seen[here] > 0.5, lit, 1 - lit)
    total = -np.log(_WRONG + (1 - 2 * _WRONG) * agrees).sum(axis=1)
    chance = np.exp(-(total - total.min()))
    chance /= chance.sum()
    middle = float((chance * grid).sum())
    spread = math.sqrt(float((chance * (grid - middle) ** 2).sum()) + _FINE**2 / 12)
    best = _sent(code, times[here], np.array([middle]), exposure)[0]
    # The stamps of the frames at the flanks jitter, each on its own.
    flanks = max(1, int(np.count_nonzero(np.diff(code.sent)))) + 2
    error = math.hypot(spread, _JITTER / math.sqrt(flanks))
    fit = float(np.corrcoef(best, seen[here])[0, 1])
    return Word(Measured(middle, error), fit, times[here], seen[here], best, grid, total)


def _paired(
    probe: list[Word], target: list[Word], code: BlinkCode
) -> tuple[tuple[Word, ...], tuple[Word, ...], list[int], float]:
    """Return the words that both streams show, their numbers in the beat of the code, and its period in seconds.

    A target's word belongs to the probe's that is nearest; lags beyond half a period are ambiguous.
    """
    length = code.bit * len(code.sent)
    if not probe or not target:
        return (), (), [], length
    apart = np.diff([word.start.value for word in probe])
    period = code.every or (float(np.min(apart)) if len(apart) else 2 * length)
    first = probe[0].start.value
    own = {round((word.start.value - first) / period): word for word in probe}
    shift = np.median([(word.start.value - first + period / 2) % period - period / 2 for word in target])
    other = {round((word.start.value - first - shift) / period): word for word in target}
    numbers = sorted(set(own) & set(other))
    return tuple(own[n] for n in numbers), tuple(other[n] for n in numbers), numbers, period


def _together(words: tuple[Word, ...], numbers: NDArray[np.int64], period: float) -> tuple[Measured, Measured]:
    """Return the beginning of the middle of all words, and by how much a period is longer than `period`, in seconds."""
    steps = numbers - numbers.mean()
    starts = np.array([word.start.value for word in words])
    if len(words) == 1:
        return words[0].start, Measured(0.0, math.inf)
    span = float(np.ptp(steps))
    slope, _ = np.polyfit(steps, starts, 1)
    half = words[0].places[-1] - words[0].start.value
    places = np.arange(-half / 2, half / 2, 2 * _FINE)
    rates = np.linspace(-half / span, half / span, 161)
    middle = starts.mean()
    total = np.zeros((len(rates), len(places)))
    for word, step in zip(words, steps, strict=True):
        at = middle + slope * step + places[None] + rates[:, None] * step
        total += np.interp(at, word.places, word.misfit, word.misfit.max(), word.misfit.max())
    chance = np.exp(-(total - total.min()))
    chance /= chance.sum()
    jitter = _JITTER / math.sqrt(len(words))
    place = _moments(places, chance.sum(axis=0), jitter)
    # All periods have equal weight here; the true one may have the widest range: the error is no smaller than that.
    widest = chance[int(np.argmax(chance.sum(axis=1)))]
    place = Measured(place.value, max(place.error, _moments(places, widest / widest.sum(), jitter).error))
    rate = _moments(rates, chance.sum(axis=1), jitter / span)
    return Measured(middle + place.value, place.error), Measured(slope + rate.value - period, rate.error)


def _moments(values: Array, chance: Array, more: float) -> Measured:
    """Return mean and deviation of values of known chance, `more` and the grid's own step added."""
    mean = float((chance * values).sum())
    step = float(values[1] - values[0])
    return Measured(mean, math.sqrt(float((chance * (values - mean) ** 2).sum()) + step**2 / 12 + more**2))
