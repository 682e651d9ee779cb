"""A guided calibration: which mark to look at next, and when the camera has looked at it steadily."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from tapetum.errors import InputError
from tapetum.live.pointer import Calibration, Fix, Screen, fit
from tapetum.live.state import CameraState

__all__ = ["MARKS", "Guide", "Step"]

_NEAR, _MID, _FAR = 0.1, 0.5, 0.9
MARKS: dict[int, tuple[tuple[float, float], ...]] = {
    1: ((_MID, _MID),),
    4: ((_NEAR, _NEAR), (_FAR, _NEAR), (_FAR, _FAR), (_NEAR, _FAR)),
    9: tuple((x, y) for y in (_NEAR, _MID, _FAR) for x in ((_NEAR, _MID, _FAR) if y != _MID else (_FAR, _MID, _NEAR))),
}
"""Marks in the order they are shown, in fractions of the screen's width and height; 1 shifts an earlier calibration."""

_SETTLE = 0.6  # s that the eye and hand take to reach a new mark, at least
_WINDOW = 0.8  # s for which the gaze must rest
_LONGEST = 4.0  # s over which so many samples may be spread
_SAMPLES = 6
_FEWEST = 3  # samples that do, once their mean is known as well as `_ENOUGH`
_ENOUGH = 0.002  # of the field: standard deviation of a mark's mean gaze; the hand's slow tremble is as large
_REST = 0.004  # of the field: standard deviation of a resting gaze, at most, where its intervals allow no more
_DRIFT = 3.0  # standard errors between the halves of the window, at most
_AWAY = 4.0  # standard errors from the gaze at the mark before, at least
_SIGMA = 1.645  # standard deviations in half a 90 % interval


@dataclass(frozen=True)
class Step:
    """How a calibration stands.

    Parameters
    ----------
    mark
        Where to look, in fractions of the screen; None at the end.
    number, count
        Of the mark, from 1, and how many there are.
    progress
        Of the present mark, 0 to 1.
    say
        What to say to the person: "look", "hold still", "no camera", "no gaze", "next", "done".
    """

    mark: tuple[float, float] | None
    number: int
    count: int
    progress: float
    say: str


class Guide:
    """A calibration under way.

    Parameters
    ----------
    screen
        The screen.
    marks
        9, 4, or 1 to shift `before`.
    before
        An earlier calibration of the same screen, for one mark.
    """

    def __init__(self, screen: Screen, marks: int = 9, before: Calibration | None = None) -> None:
        if marks not in MARKS:
            raise InputError(f"must be 1, 4 or 9, is {marks}", where="marks")
        if marks == 1 and before is None:
            raise InputError("one mark shifts a calibration, and there is none", where="marks", remedy="take 4 or 9")
        self.screen, self.marks, self.before = screen, MARKS[marks], before
        self.fixes: list[Fix] = []
        self._since: float | None = None
        self._estimated: int | None = None
        # Time, gaze and its standard deviation.
        self._window: deque[tuple[float, float, float, float]] = deque(maxlen=1000)

    @property
    def done(self) -> bool:
        """Whether all marks were looked at."""
        return len(self.fixes) == len(self.marks)

    def update(self, camera: CameraState | None, time: float) -> Step:
        """Take the camera's state at a time in seconds."""
        if self.done:
            return Step(None, len(self.marks), len(self.marks), 1.0, "done")
        if self._since is None:
            self._since = time
        if camera is None or not camera.seen:
            return self._step(0.0, "no camera")
        if camera.gaze_x is None or camera.gaze_y is None:
            self._window.clear()
            return self._step(0.0, "no gaze")
        known = camera.estimated_utc_ns is not None and camera.estimated_utc_ns == self._estimated
        self._estimated = camera.estimated_utc_ns
        if known or time - self._since < _SETTLE or (self._window and time <= self._window[-1][0]):
            return self._step(self._rested(time), "look")
        std = max(camera.gaze_x[2] - camera.gaze_x[1], camera.gaze_y[2] - camera.gaze_y[1]) / 2 / _SIGMA
        self._window.append((time, camera.gaze_x[0], camera.gaze_y[0], std))
        # Of a slow watch the window is longer, so that it holds as many samples.
        while self._window[0][0] < time - (_WINDOW if len(self._window) > _SAMPLES else _LONGEST) - 1e-9:
            self._window.popleft()
        return self._judge(time)

    def result(self, utc_ns: int = 0) -> Calibration:
        """Return the calibration.

        Raises
        ------
        InputError
            Before the end, and where the gazes do not fix a map (see `fit`).
        """
        if not self.done:
            what = f"{len(self.fixes)} of {len(self.marks)} marks were looked at"
            raise InputError(what, where="calibration", remedy="look at all of them")
        if self.before is not None and len(self.marks) == 1:
            return self.before.shifted(self.fixes[0], utc_ns)
        return fit(self.screen, self.fixes, utc_ns)

    def _judge(self, time: float) -> Step:
        """Take the mark when the window is full and the gaze rested in it."""
        samples = np.array(self._window)
        gazes = samples[:, 1:3]
        middle = np.median(gazes, axis=0)
        # A single wild estimate is no movement: the spread is the median's.
        spread = float(np.max(1.4826 * np.median(np.abs(gazes - middle), axis=0)))
        own = float(np.median(samples[:, 3]))
        # That of few samples is large by chance more often.
        allowed = max(_REST, own) * (1 + 3 / len(samples))
        if spread > allowed:
            self._pass_over()
            return self._step(0.0, "hold still")
        known = 1.25 * max(spread, own) / math.sqrt(len(samples)) <= _ENOUGH
        if time - samples[0, 0] < _WINDOW * 0.8 or len(samples) < (_FEWEST if known else _SAMPLES):
            return self._step(self._rested(time), "look")
        half = len(samples) // 2
        drift = float(np.max(np.abs(np.median(gazes[:half], axis=0) - np.median(gazes[half:], axis=0))))
        # Medians of a few samples scatter by 1.25 standard deviations over the root of their number; the spread of few
        # is small by chance, where the estimates' own intervals are not.
        error = 1.25 * max(spread, min(max(own, _REST / 4), _REST / 2)) / math.sqrt(half)
        if drift > _DRIFT * math.sqrt(2) * error:
            self._pass_over()
            return self._step(0.0, "hold still")
        error /= math.sqrt(2)
        if self.fixes and math.dist(middle, (self.fixes[-1].gaze_x, self.fixes[-1].gaze_y)) < _AWAY * math.hypot(
            error, self.fixes[-1].std
        ):
            # Still at the mark before.
            return self._step(0.0, "look")
        x, y = self.marks[len(self.fixes)]
        place = x * self.screen.width, y * self.screen.height
        self.fixes.append(Fix(*place, float(middle[0]), float(middle[1]), error))
        self._since = None
        self._window.clear()
        return Step(None, len(self.marks), len(self.marks), 1.0, "done") if self.done else self._step(0.0, "next")

    def _pass_over(self) -> None:
        """Of a slow watch, whose window is long, leave out the sample that was taken on the way here."""
        if _FEWEST < len(self._window) <= _SAMPLES:
            self._window.popleft()

    def _rested(self, time: float) -> float:
        return min(1.0, (time - self._window[0][0]) / _WINDOW) if self._window else 0.0

    def _step(self, progress: float, say: str) -> Step:
        return Step(self.marks[len(self.fixes)], len(self.fixes) + 1, len(self.marks), progress, say)
