"""From a camera's gaze to the point of a screen that it is pointed at.

The probe stands beside a screen and sees a camera that somebody points at it. Where the probe lies in its field
follows from where the camera points: by a projective map of the plane, as long as the camera turns in place without
roll. Looking at a few known marks finds that map (see `tapetum.live.guide`).
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import least_squares

from tapetum.checked import Checked, check, read_json
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.live.euro import OneEuro
from tapetum.live.state import CameraState

__all__ = ["Calibration", "Fix", "Pointed", "Pointer", "Screen", "fit"]

Array = NDArray[np.float64]

SCHEMA = "tapetum/pointer/1"
_LEAST = 3
# Residual, in widths of the screen, from which a mark counts less (Huber).
_FAR = 0.02
# Least spread of the gazes across their narrowest direction, in standard deviations of their errors.
_CLEAR = 6.0
# Of the pointer: see `OneEuro`; the unit of length is the screen's width.
_MIN_CUTOFF, _BETA = 0.8, 4.0


@dataclass(frozen=True)
class Screen:
    """A screen and how it is seen.

    Parameters
    ----------
    width, height
        In pixels.
    across, distance
        Its width, and the camera's distance from it, in metres: for angles; None where unknown.
    """

    width: int
    height: int
    across: float | None = None
    distance: float | None = None

    def __post_init__(self) -> None:
        for name in ("width", "height", "across", "distance"):
            value = getattr(self, name)
            if value is not None and not 0 < value < 1e6:
                raise InputError(f"must be positive, is {value}", where=f"screen.{name}")

    def degrees(self, pixels: float) -> float | None:
        """Return the angle of so many pixels in the screen's middle; None where its size or distance is unknown."""
        if self.across is None or self.distance is None:
            return None
        return math.degrees(math.atan(pixels * self.across / self.width / self.distance))


@dataclass(frozen=True)
class Fix:
    """A mark that was looked at.

    Parameters
    ----------
    x, y
        The mark, in pixels of the screen.
    gaze_x, gaze_y
        Mean gaze meanwhile, in fractions of the field from its centre.
    std
        Standard deviation of that mean in either direction.
    error
        Distance in pixels between the mark and where a calibration by the other marks alone puts its gaze; None where
        the others are too few.
    """

    x: float
    y: float
    gaze_x: float
    gaze_y: float
    std: float = 0.0
    error: float | None = None


@dataclass(frozen=True)
class Calibration:
    """A map from gaze to the pixels of a screen.

    Parameters
    ----------
    screen
        The screen.
    matrix
        [3][3]: homogeneous pixels of homogeneous gaze (x, y, 1).
    fixes
        The marks it was made of, each with its leave-one-out error.
    error, degrees
        Root mean square of these errors, in pixels, and as an angle at the camera where that is known.
    shift
        What is added to the gaze, (x, y), since a recalibration by one mark.
    utc_ns
        When it was made or shifted.
    """

    screen: Screen
    matrix: tuple[tuple[float, float, float], ...]
    fixes: tuple[Fix, ...]
    error: float | None
    degrees: float | None
    shift: tuple[float, float] = (0.0, 0.0)
    utc_ns: int = 0

    def point(self, x: float, y: float) -> tuple[float, float] | None:
        """Return the pixels of a gaze; None beyond the horizon of the map."""
        at = np.asarray(self.matrix) @ [x + self.shift[0], y + self.shift[1], 1.0]
        return (float(at[0] / at[2]), float(at[1] / at[2])) if at[2] > 1e-9 else None

    def gaze(self, x: float, y: float) -> tuple[float, float]:
        """Return the gaze of a point in pixels."""
        at = np.linalg.solve(np.asarray(self.matrix), [x, y, 1.0])
        return float(at[0] / at[2] - self.shift[0]), float(at[1] / at[2] - self.shift[1])

    def shifted(self, fix: Fix, utc_ns: int = 0) -> Calibration:
        """Return the calibration after the camera or the probe was moved a little: the fix's gaze meets its mark."""
        x, y = self.gaze(fix.x, fix.y)
        shift = self.shift[0] + x - fix.gaze_x, self.shift[1] + y - fix.gaze_y
        return Calibration(self.screen, self.matrix, self.fixes, self.error, self.degrees, shift, utc_ns)

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {"schema": SCHEMA, **asdict(self)}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a JSON file, whole or not at all."""
        import json

        with atomic_file(path) as part:
            part.write_text(json.dumps(self.as_json(), indent=1) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Calibration:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            When it is missing, damaged, or of a newer Tapetum.
        """
        remedy = "calibrate again"
        try:
            content = read_json(path)
        except (OSError, ValueError) as error:
            raise InputError(f"is no calibration of a pointer ({error})", where=path, remedy=remedy) from error
        read = check(_File, content, Path(path), remedy)
        matrix = np.array(read.matrix)
        if abs(np.linalg.det(matrix)) < 1e-12 * np.abs(matrix).max() ** 3:
            raise InputError("matrix: maps the field to a line", where=path, remedy=remedy)
        fixes = tuple(Fix(one.x, one.y, one.gaze_x, one.gaze_y, one.std, one.error) for one in read.fixes)
        rows = tuple((a, b, c) for a, b, c in read.matrix)
        screen = Screen(read.screen.width, read.screen.height, read.screen.across, read.screen.distance)
        shift = (read.shift[0], read.shift[1])
        return cls(screen, rows, fixes, read.error, read.degrees, shift, read.utc_ns)


class _ScreenFile(Checked):
    width: int = Field(gt=0, le=100_000)
    height: int = Field(gt=0, le=100_000)
    across: float | None = Field(None, gt=0)
    distance: float | None = Field(None, gt=0)


class _FixFile(Checked):
    x: float
    y: float
    gaze_x: float
    gaze_y: float
    std: float = Field(ge=0)
    error: float | None = Field(None, ge=0)


_Triple = Annotated[list[float], Field(min_length=3, max_length=3)]


class _File(Checked):
    schema_: Literal["tapetum/pointer/1"] = Field(alias="schema")
    screen: _ScreenFile
    matrix: Annotated[list[_Triple], Field(min_length=3, max_length=3)]
    fixes: Annotated[list[_FixFile], Field(max_length=100)]
    error: float | None = Field(None, ge=0)
    degrees: float | None = Field(None, ge=0)
    shift: Annotated[list[float], Field(min_length=2, max_length=2)]
    utc_ns: int = Field(ge=0)


def fit(screen: Screen, fixes: Sequence[Fix], utc_ns: int = 0) -> Calibration:
    """Fit a map from gaze to screen by least squares that a single wrong mark does not bend far (Huber's loss).

    Up to five marks give an affine map, from six on a homography. Every mark's error is that of the map fitted to the
    others.

    Raises
    ------
    InputError
        For fewer than three marks, where the gaze hardly changed between them or along a line only, and where most
        marks lie farther from where the others put them than half their RMS distance from the middle of all.
    """
    if len(fixes) < _LEAST:
        raise InputError(f"has {len(fixes)} marks", where="calibration", remedy=f"look at {_LEAST} or more")
    gazes = np.array([(one.gaze_x, one.gaze_y) for one in fixes])
    marks = np.array([(one.x, one.y) for one in fixes])
    if not (np.isfinite(gazes).all() and np.isfinite(marks).all()):
        raise InputError("holds a gaze or mark that is not finite", where="calibration", remedy="calibrate again")
    narrow = float(np.linalg.svd(gazes - gazes.mean(0), compute_uv=False)[-1]) / math.sqrt(len(fixes))
    noise = float(np.mean([one.std for one in fixes]))
    if narrow <= max(_CLEAR * noise, 1e-6):
        what = f"the gaze changed by {narrow:.2g} of the field between the marks, and its error is {noise:.2g}"
        remedy = "point the camera itself at each mark, from nearer or with a longer lens"
        raise InputError(what, where="calibration", remedy=remedy)
    matrix = _fitted(gazes, marks, screen.width)
    errors = _left_out(gazes, marks, screen.width)
    told = tuple(
        Fix(one.x, one.y, one.gaze_x, one.gaze_y, one.std, error) for one, error in zip(fixes, errors, strict=True)
    )
    known = [error for error in errors if error is not None]
    # Of marks looked at by chance most lie farther from where the others put them than half of this.
    away = float(np.sqrt(((marks - marks.mean(0)) ** 2).sum(axis=1).mean()))
    if known and (typical := float(np.median(known))) > away / 2:
        what = f"the marks contradict one another: each lies some {typical:.0f} pixels from where the others put it"
        raise InputError(what, where="calibration", remedy="calibrate again, and look at each mark while it is shown")
    error = math.sqrt(float(np.mean(np.square(known)))) if known else None
    rows = tuple((float(a), float(b), float(c)) for a, b, c in matrix)
    return Calibration(screen, rows, told, error, None if error is None else screen.degrees(error), utc_ns=utc_ns)


def _left_out(gazes: Array, marks: Array, width: int) -> list[float | None]:
    """Distance of each mark from where the others alone put it; None where these do not fix a map."""
    errors: list[float | None] = []
    for left in range(len(gazes)):
        others = np.arange(len(gazes)) != left
        rest = gazes[others] - gazes[others].mean(0)
        if len(rest) < _LEAST or np.linalg.svd(rest, compute_uv=False)[-1] < 1e-9:
            errors.append(None)
            continue
        at = _fitted(gazes[others], marks[others], width) @ [*gazes[left], 1.0]
        errors.append(float(math.dist(at[:2] / at[2], marks[left])) if at[2] > 1e-9 else None)
    return errors


def _fitted(gazes: Array, marks: Array, width: int) -> Array:
    """The map [3, 3] of gazes [N, 2] to marks [N, 2]."""
    # About their mean and in units of their spread, so that all parameters are of the order of one.
    middle, spread = gazes.mean(0), float(gazes.std()) or 1.0
    own = np.column_stack([(gazes - middle) / spread, np.ones(len(gazes))])
    goal = marks / width
    affine = np.linalg.lstsq(own, goal, rcond=None)[0].T
    start = affine.ravel() if len(gazes) < 6 else np.concatenate([affine.ravel(), [0.0, 0.0]])

    def off(parameters: Array) -> Array:
        below = 1.0 + own[:, :2] @ parameters[6:] if len(parameters) > 6 else np.ones(len(own))
        at = own @ parameters[:6].reshape(2, 3).T / np.maximum(below, 0.05)[:, None]
        return (at - goal).ravel()

    found = least_squares(off, start, loss="huber", f_scale=_FAR).x
    whole = np.eye(3)
    whole[:2] = found[:6].reshape(2, 3) * width
    whole[2, :2] = found[6:] if len(found) > 6 else 0.0
    return whole @ np.array([[1 / spread, 0, -middle[0] / spread], [0, 1 / spread, -middle[1] / spread], [0, 0, 1.0]])


@dataclass(frozen=True)
class Pointed:
    """A point of the screen: pixels, whether it lies on the screen, and the half widths of its interval in pixels."""

    x: float
    y: float
    inside: bool
    half_x: float
    half_y: float


class Pointer:
    """The point that one camera is pointed at, filtered.

    Parameters
    ----------
    calibration
        From gaze to screen.
    min_cutoff, beta
        Of the filter (see `OneEuro`), with the screen's width as the unit of length.
    """

    def __init__(self, calibration: Calibration, *, min_cutoff: float = _MIN_CUTOFF, beta: float = _BETA) -> None:
        self.calibration = calibration
        self._filters = OneEuro(min_cutoff, beta), OneEuro(min_cutoff, beta)

    def update(self, camera: CameraState, time: float) -> Pointed | None:
        """Take a camera's state at a time in seconds; None without a gaze, or where it points beyond the horizon."""
        if not camera.seen or camera.gaze_x is None or camera.gaze_y is None:
            return None
        calibration, screen = self.calibration, self.calibration.screen
        at = calibration.point(camera.gaze_x[0], camera.gaze_y[0])
        if at is None:
            return None
        corners = [calibration.point(x, y) for x in camera.gaze_x[1:] for y in camera.gaze_y[1:]]
        known = np.array([one for one in corners if one is not None] or [at])
        half = (known.max(0) - known.min(0)) / 2
        x, y = (
            one.update(value / screen.width, time) * screen.width for one, value in zip(self._filters, at, strict=True)
        )
        inside = 0 <= x < screen.width and 0 <= y < screen.height
        return Pointed(x, y, inside, float(half[0]), float(half[1]))
