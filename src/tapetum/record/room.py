"""Images of the target's camera: a furnished room with the probe's laser in it, generated from a seed."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.record.patch import add_patch, bell

__all__ = ["Room", "Trail", "furnish"]

_SPOT_REACH = 12
# How far from the wall's middle the laser may stand, in parts of the image: past a shelf's height, so that what lies
# under the spot has edges along every direction.
_ASIDE = 1 / 6


@dataclass(frozen=True, eq=False)
class Trail:
    """The laser's path over the target's field during a frame.

    Attributes
    ----------
    moments, gaze
        [S] s from the frame's time, the middle of its middle row's exposure, and the laser's places then, [S, 2] in
        fractions of the field.
    step
        Time from one moment to the next, in seconds.
    exposure, readout
        Exposure time, and time from the exposure of the first row to that of the last, in seconds.
    """

    moments: npt.NDArray[np.float64]
    gaze: npt.NDArray[np.float64]
    step: float
    exposure: float
    readout: float

    def light(self, moment: float, rows: npt.NDArray[np.int64], height: int) -> npt.NDArray[np.float64]:
        """Return the share [R] of their exposure that rows [R] of `height` collect around a moment."""
        middle = self.readout * (rows - (height - 1) / 2) / height
        inside = np.clip((self.exposure / 2 - np.abs(moment - middle)) / self.step + 0.5, 0, 1)
        return inside * self.step / self.exposure


class Room:
    """A textured wall larger than the target's field, with the probe's laser on it.

    `columns` and `rows` are those of the target's image; `seed` draws furniture, texture and the laser's place on them.
    `spot_sigma` is the width of the laser's image in pixels, `spot_peak` its height above the scene at full power in
    digital numbers.
    """

    def __init__(
        self, columns: int, rows: int, seed: int, *, spot_sigma: float = 1.2, spot_peak: float = 320.0
    ) -> None:
        self.columns, self.rows = columns, rows
        self.spot_sigma, self.spot_peak = spot_sigma, spot_peak
        aside = round(_ASIDE * columns)
        width, height = 2 * (columns + aside) + 64, 2 * (rows + aside) + 64
        self._wall = furnish(width, height, np.random.default_rng([seed, 2]))
        drawn = np.random.default_rng([seed, 2, 1]).uniform(-aside, aside, 2)
        self._laser = np.array([width, height]) / 2 + drawn

    def picture(
        self,
        gaze: npt.NDArray[np.float64],
        rng: np.random.Generator,
        *,
        roll: float = 0.0,
        nearer: float = 1.0,
        laser: float = 1.0,
        exposure: float = 1.0,
        second: tuple[float, float, float] | None = None,
        trail: Trail | None = None,
    ) -> npt.NDArray[np.uint8]:
        """Return the target's noisy 8-bit image of the room, [rows, columns].

        `gaze` [2] is the laser's place in fractions of the field, `rng` draws the noise. `roll` rotates the camera
        about its axis, in radians from x to y; `nearer` magnifies the room. `laser` and `exposure` are relative to
        their usual values. `second` is the offset (x, y) of the second beam's spot in pixels, at no roll, and its
        relative height. `trail` is the laser's path during the exposure, of which the spot is the mean; None where it
        stands. Only the spot shows that path: the room stands still during an exposure.
        """
        x = (self.columns - 1) / 2 + gaze[0] * self.columns
        y = (self.rows - 1) / 2 + gaze[1] * self.rows
        c, s = math.cos(roll), math.sin(roll)
        matrix = nearer * np.array([[c, s], [-s, c]])
        matrix = np.column_stack([matrix, (x, y) - matrix @ self._laser])
        size = (self.columns, self.rows)
        moved = cv2.warpAffine(self._wall, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        scene = np.asarray(moved, np.float32)
        if laser:
            dx, dy, ratio = second or (0.0, 0.0, 0.0)
            for aside, share in (((0.0, 0.0), 1.0), ((c * dx + s * dy, -s * dx + c * dy), ratio)):
                if share:
                    self._add_spot(scene, (x, y), aside, self.spot_peak * (share * laser), trail)
        if exposure != 1:
            scene *= np.float32(exposure)
        # Shot noise of a full well of 6500 electrons at 8 bits, and 2 electrons of read noise.
        scale = 255 / 6500
        noise = rng.standard_normal(scene.shape, dtype=np.float32)
        noise *= np.sqrt(scene * np.float32(scale) + np.float32((2 * scale) ** 2))
        scene += noise
        np.rint(scene, out=scene)
        return np.clip(scene, 0, 255, out=scene).astype(np.uint8)

    def _add_spot(
        self,
        scene: npt.NDArray[np.float32],
        place: tuple[float, float],
        aside: tuple[float, float],
        height: float,
        trail: Trail | None,
    ) -> None:
        """Add a spot `aside` of the laser's place, both in pixels, or its mean over a trail."""
        if trail is None:
            spot = (place[0] + aside[0], place[1] + aside[1])
            add_patch(scene, bell(spot, height, self.spot_sigma, _SPOT_REACH), 1.0)
            return
        middle, size = (self.columns - 1) / 2, np.array([self.columns, self.rows])
        places = np.array([middle, (self.rows - 1) / 2]) + trail.gaze * size + np.array(aside)
        for moment, spot in zip(trail.moments, places, strict=True):
            patch = bell(spot, height, self.spot_sigma, _SPOT_REACH)
            share = trail.light(float(moment), patch.top + np.arange(len(patch.light)), self.rows)
            if share.any():
                add_patch(scene, patch._replace(light=patch.light * share[:, None].astype(np.float32)), 1.0)


def furnish(width: int, height: int, rng: np.random.Generator) -> npt.NDArray[np.float32]:
    """Return a lit wall with shelves, books, frames and fine texture; mean about 70 of 255."""
    wall = np.full((height, width), 80.0, np.float32)
    wall += np.linspace(-18, 18, width, dtype=np.float32) * rng.choice([-1, 1])
    for _ in range(14):
        x, y = rng.integers(0, width), rng.integers(0, height)
        w, h = rng.integers(width // 20, width // 5), rng.integers(height // 20, height // 5)
        tone = float(rng.uniform(30, 140))
        cv2.rectangle(wall, (int(x), int(y)), (int(x + w), int(y + h)), tone, -1)
        cv2.rectangle(wall, (int(x), int(y)), (int(x + w), int(y + h)), tone * 0.6, 3)
    for shelf in np.linspace(0.12, 0.9, 5):
        base, x = int(shelf * height), int(rng.integers(0, 60))
        cv2.rectangle(wall, (0, base), (width, base + 6), 45.0, -1)
        while x < width:
            book, tall = int(rng.integers(8, 30)), int(rng.integers(40, 90))
            if rng.random() < 0.7:
                cv2.rectangle(wall, (x, base - tall), (x + book, base - 1), float(rng.uniform(25, 150)), -1)
                cv2.line(wall, (x + book, base - tall), (x + book, base), 20.0, 1)
            x += book + int(rng.integers(1, 8))
    for _ in range(12):
        centre = (int(rng.integers(0, width)), int(rng.integers(0, height)))
        cv2.circle(wall, centre, int(rng.integers(4, 40)), float(rng.uniform(30, 170)), -1)
    for octave, strength in ((64, 10.0), (16, 6.0), (4, 3.0)):
        grain = rng.standard_normal((height // octave + 2, width // octave + 2)).astype(np.float32)
        wall += strength * cv2.resize(grain, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.asarray(cv2.GaussianBlur(wall, (0, 0), 0.8), np.float32), 2, 200)
