"""Where a probe that is carried through a room has looked: its turns are summed, and the directions that it saw are
marked on a map.

Consecutive pictures are compared by phase correlation on a small copy; the map counts seconds in cells of a fraction of
the picture. It is a map of directions from one place: for a person who walks, near and far things move differently, so
that the map drifts. It shows where nobody has looked yet, not where a camera stands.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.errors import InputError

__all__ = ["Coverage", "CoverageState", "Sighting"]

_COLUMNS = 96  # of the small copy
_CELLS = 8  # cells across a picture
_REACH = 64  # cells from the middle of the map to its edge
_ENOUGH = 1.0  # s for which a cell must have been seen
_LEAST = 0.04  # response of the correlation below which the pictures do not show the same
_LONGEST, _COUNTED = 2.0, 0.5  # s between two pictures that are compared, and that a picture may count for
_STEP = 0.45  # of the picture: the largest turn between two pictures
_TURNED = 0.15  # of the picture: the turn after which the next one is compared with a new picture
_NEAR = 0.08  # of the picture: sightings this close are one
_MOST = 60

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sighting:
    """A camera that was seen: its place on the map in pictures from where the scan began, and how it was last seen."""

    camera: str
    x: float
    y: float
    seconds: float
    snr: float | None
    device: str | None


@dataclass(frozen=True)
class CoverageState:
    """The progress of a scan.

    Parameters
    ----------
    running
        Whether it goes on.
    seconds
        Since it began.
    columns, rows, cells
        Of the map's part that was seen at all; and a byte a cell, in base64: 0 not seen, 255 for long enough.
    cells_across, cells_down, aspect
        Cells that a picture is wide and high, and its height over its width.
    left, top
        The map's upper left corner, in pictures from the middle of the one where the scan began.
    x, y
        Where the probe looks now, in pictures from where the scan began.
    share
        Of the cells seen at all, those seen for long enough.
    advice
        What to do: "hold still", "go slower", "go back", "go on", "light on and off".
    sightings
        Cameras seen on the way.
    """

    running: bool = False
    seconds: float = 0.0
    columns: int = 0
    rows: int = 0
    cells: str = ""
    cells_across: int = _CELLS
    cells_down: int = _CELLS
    aspect: float = 0.75
    left: float = 0.0
    top: float = 0.0
    x: float = 0.0
    y: float = 0.0
    share: float = 0.0
    advice: str = ""
    sightings: tuple[Sighting, ...] = ()


class Coverage:
    """The map of one scan; not safe for several threads.

    Parameters
    ----------
    size
        Columns and rows of the pictures.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        if min(size) < 16:
            raise InputError(f"has {size[0]} x {size[1]} pixels", where="picture")
        self.size = size
        self.rows = max(1, round(_CELLS * size[1] / size[0]))
        self.place: Array = np.zeros(2)
        self.map = np.zeros((2 * _REACH, 2 * _REACH), np.float32)
        self.sightings: dict[str, Sighting] = {}
        self.advice = "hold still"
        self._begun: float | None = None
        self._time = 0.0
        # What the pictures are compared with, when it was taken and where the probe looked; the window shortens small
        # shifts, so that it is kept until the probe has turned far enough.
        self._key: npt.NDArray[np.float32] | None = None
        self._key_place: Array = np.zeros(2)
        self._window: Any = None

    def update(self, image: npt.NDArray[Any], time: float) -> None:
        """Take a picture [H, W] at a time in seconds."""
        small = self._small(image)
        self._begun = time if self._begun is None else self._begun
        step = time - self._time
        self._time = time
        if self._key is None or self._key.shape != small.shape or not 0 < step <= _LONGEST:
            lost = self._key is not None and step > 0
            self._key, self._key_place = small, self.place
            self.advice = "go slower" if lost else self.advice
            return
        (dx, dy), response = cv2.phaseCorrelate(self._key, small, self._window)
        turn = np.array([-dx / small.shape[1], -dy / small.shape[0]])
        if response < _LEAST or np.abs(turn).max() > _STEP:
            # Where it looks now is not known: the map goes on from the last place that was.
            self._key, self._key_place = small, self.place
            self.advice = "go slower"
            return
        limit = _REACH / _CELLS - 1
        before, self.place = self.place, np.clip(self._key_place + turn, -limit, limit)
        if np.abs(turn).max() > _TURNED:
            self._key, self._key_place = small, self.place
        self._mark(min(step, _COUNTED))
        speed = float(np.hypot(*(self.place - before))) / step
        here = float(self.map[self._cells()].mean())
        self.advice = "go slower" if speed > 0.5 else "go on" if here >= _ENOUGH else "hold still"

    def see(self, camera: str, x: float, y: float, snr: float | None, device: str | None, step: float) -> None:
        """Take a camera at (x, y) in fractions of the picture, seen for `step` seconds more."""
        at = self.place + (np.array([x, y]) - 0.5)
        known = self.sightings.get(camera)
        if known is None:
            # A camera that was seen before, and returns with another id.
            known = next((one for one in self.sightings.values() if math.dist((one.x, one.y), at) < _NEAR), None)
            if known is not None:
                del self.sightings[known.camera]
        before = 0.0 if known is None else known.seconds
        self.sightings[camera] = Sighting(camera, float(at[0]), float(at[1]), before + step, snr, device)
        while len(self.sightings) > _MOST:
            del self.sightings[next(iter(self.sightings))]

    def state(self, *, running: bool) -> CoverageState:
        """Return how far it has come."""
        seen = self.map > 0
        seconds = 0.0 if self._begun is None else self._time - self._begun
        sightings = tuple(self.sightings.values())
        if not seen.any():
            return CoverageState(running, seconds, advice=self.advice, sightings=sightings)
        rows, columns = (np.flatnonzero(seen.any(axis)) for axis in (1, 0))
        part = self.map[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        cells = np.rint(np.clip(part / _ENOUGH, 0, 1) * 255).astype(np.uint8)
        # A cell that was seen for a moment differs from one that was never seen.
        cells = np.where((part > 0) & (cells == 0), 1, cells)
        return CoverageState(
            running,
            seconds,
            part.shape[1],
            part.shape[0],
            base64.b64encode(cells.astype(np.uint8).tobytes()).decode(),
            _CELLS,
            self.rows,
            self.size[1] / self.size[0],
            (int(columns[0]) - _REACH) / _CELLS,
            (int(rows[0]) - _REACH) / self.rows,
            float(self.place[0]),
            float(self.place[1]),
            float((self.map[seen] >= _ENOUGH).mean()),
            self.advice,
            sightings,
        )

    def _small(self, image: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
        rows = max(16, round(_COLUMNS * image.shape[0] / image.shape[1]))
        small = cv2.resize(image, (_COLUMNS, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
        # A bright lamp must not decide alone.
        small = np.sqrt(small)
        if self._window is None or self._window.shape != small.shape:
            self._window = cv2.createHanningWindow((small.shape[1], small.shape[0]), cv2.CV_32F)
        return (small - small.mean()).astype(np.float32)

    def _cells(self) -> tuple[slice, slice]:
        """The cells that the probe looks at."""
        column = round(self.place[0] * _CELLS) + _REACH - _CELLS // 2
        row = round(self.place[1] * self.rows) + _REACH - self.rows // 2
        return slice(max(0, row), max(0, row + self.rows)), slice(max(0, column), max(0, column + _CELLS))

    def _mark(self, step: float) -> None:
        self.map[self._cells()] += step
