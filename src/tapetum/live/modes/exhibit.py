"""An exhibit: cameras point at a screen, and a guided calibration finds where."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass
from pathlib import Path

from tapetum.errors import InputError
from tapetum.live.guide import Guide, Step
from tapetum.live.pointer import Calibration, Pointer, Screen
from tapetum.live.state import CameraState, State

__all__ = ["Exhibit", "ExhibitState", "Mark", "Pointing"]

_MOST = 32  # cameras that point at a time
_OLD_NS = 2 * 10**9  # age of a gaze that points no longer


@dataclass(frozen=True)
class Pointing:
    """Where a camera points: x and y in fractions of the screen, and the half widths of their intervals."""

    camera: str
    x: float
    y: float
    half_x: float
    half_y: float
    inside: bool


@dataclass(frozen=True)
class Mark:
    """A mark of the calibration, in fractions of the screen, and its error in pixels when it is left out of the fit."""

    x: float
    y: float
    error: float | None


@dataclass(frozen=True)
class ExhibitState:
    """How an exhibit stands.

    Parameters
    ----------
    calibrated, screen
        Whether there is a calibration, and its screen.
    error, degrees
        Root mean square error of the calibration, in pixels and as an angle; None where unknown.
    marks
        Of the calibration.
    utc_ns, seconds
        When it was made, and how long that took.
    step
        Of a calibration under way.
    camera
        The camera that calibrates.
    fault
        Why the last calibration failed, or could not be kept.
    pointers
        Where cameras point now.
    """

    calibrated: bool = False
    screen: Screen | None = None
    error: float | None = None
    degrees: float | None = None
    marks: tuple[Mark, ...] = ()
    utc_ns: int = 0
    seconds: float | None = None
    step: Step | None = None
    camera: str = ""
    fault: str = ""
    pointers: tuple[Pointing, ...] = ()


class Exhibit:
    """Points of cameras on a screen; its functions may be called from any thread.

    Parameters
    ----------
    path
        Where the calibration is kept and read from, JSON; None: nowhere.

    Raises
    ------
    InputError
        When the file is there and holds no calibration.
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self._lock = threading.Lock()
        self._calibration = Calibration.load(path) if path is not None and path.exists() else None
        self._guide: Guide | None = None
        self._step: Step | None = None
        self._camera = self._fault = ""
        self._begun = 0.0
        self._seconds: float | None = None
        self._pointers: dict[str, Pointer] = {}
        # By camera: when the gaze was estimated that it points by, and where.
        self._last: dict[str, tuple[int, Pointing]] = {}
        self._points: tuple[Pointing, ...] = ()

    @property
    def calibration(self) -> Calibration | None:
        """The calibration, once there is one."""
        return self._calibration

    def begin(self, screen: Screen, marks: int = 9, camera: str = "") -> None:
        """Begin a calibration with so many marks by a camera; "": by the first that shows its gaze.

        Raises
        ------
        InputError
            For another number of marks than 1, 4 or 9; for one mark, without a calibration of the same screen.
        """
        with self._lock:
            before = self._calibration
            if (
                marks == 1
                and before is not None
                and (before.screen.width, before.screen.height)
                != (
                    screen.width,
                    screen.height,
                )
            ):
                raise InputError("the screen has changed since", where="marks", remedy="take 4 or 9")
            self._guide = Guide(screen, marks, before)
            self._step, self._camera, self._fault = None, camera, ""
            self._begun = time.monotonic()

    def cancel(self) -> None:
        """End a calibration under way; the one before stays."""
        with self._lock:
            self._guide = self._step = None

    def forget(self) -> None:
        """Drop the calibration, here and on the disk."""
        with self._lock:
            self._guide = self._step = self._calibration = None
            self._pointers, self._last, self._points, self._fault = {}, {}, (), ""
            if self.path is not None:
                self.path.unlink(missing_ok=True)

    def update(self, state: State) -> None:
        """Take a state of the watch."""
        now = state.utc_ns / 1e9
        with self._lock:
            if self._guide is not None:
                self._lead(self._guide, state, now)
            self._points = self._pointed(state, now)

    def state(self) -> ExhibitState:
        """Return how it stands."""
        with self._lock:
            made = self._calibration
            common = {"step": self._step, "camera": self._camera, "fault": self._fault}
            if made is None:
                return ExhibitState(screen=None if self._guide is None else self._guide.screen, **common)
            width, height = made.screen.width, made.screen.height
            return ExhibitState(
                True,
                made.screen,
                made.error,
                made.degrees,
                tuple(Mark(one.x / width, one.y / height, one.error) for one in made.fixes),
                made.utc_ns,
                self._seconds,
                pointers=self._points,
                **common,
            )

    def _lead(self, guide: Guide, state: State, now: float) -> None:
        camera = next((one for one in state.cameras if one.id == self._camera), None)
        if camera is None:
            # Where no camera was chosen, or it has gone, the first one that shows its gaze calibrates.
            camera = next((one for one in state.cameras if _gazes(one)), None)
            self._camera = self._camera if camera is None else camera.id
        self._step = guide.update(camera, now)
        if not guide.done:
            return
        self._guide = None
        try:
            self._calibration = guide.result(state.utc_ns)
            self._seconds = time.monotonic() - self._begun
            self._pointers, self._last = {}, {}
            if self.path is not None:
                self._calibration.save(self.path)
        except (InputError, OSError) as error:
            self._fault = str(error)

    def _pointed(self, state: State, now: float) -> tuple[Pointing, ...]:
        made = self._calibration
        if made is None:
            return ()
        here = [one for one in state.cameras if _gazes(one)][:_MOST]
        names = {one.id for one in state.cameras}
        self._pointers = {name: one for name, one in self._pointers.items() if name in names}
        points = []
        for one in here:
            estimated = one.estimated_utc_ns or state.utc_ns
            if state.utc_ns - estimated > _OLD_NS:
                continue
            last = self._last.get(one.id)
            if last is None or last[0] != estimated:
                at = self._pointers.setdefault(one.id, Pointer(made)).update(one, now)
                if at is None:
                    continue
                width, height = made.screen.width, made.screen.height
                halves = at.half_x / width, at.half_y / height
                last = estimated, Pointing(one.id, at.x / width, at.y / height, *halves, at.inside)
                self._last[one.id] = last
            points.append(last[1])
        self._last = {name: one for name, one in self._last.items() if name in names}
        return tuple(points)


def _gazes(camera: CameraState) -> bool:
    return camera.seen and camera.gaze_x is not None and camera.gaze_y is not None
