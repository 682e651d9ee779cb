"""The probes' places, and conversion of one probe's gaze to another's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError

__all__ = ["Places"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Places:
    """The probes' places, as the target sees them.

    Parameters
    ----------
    places
        Of each probe from the first one, in metres: x to the right and y down in the upright target's own picture. The
        first is (0, 0).
    distance
        Of the target from the probes' plane, in metres.
    field
        The target's field of view, whole width and height, in radians.
    roll
        Roll of the target about its optical axis, in radians from x to y: its picture then shows the probes' places
        turned back by as much. Usually unknown.
    roll_spread
        Standard deviation of that roll. It widens the intervals of all probes but the first.

    Raises
    ------
    InputError
        When a number is out of range.
    """

    places: tuple[tuple[float, float], ...]
    distance: float
    field: tuple[float, float]
    roll: float = 0.0
    roll_spread: float = 0.0

    def __post_init__(self) -> None:
        numbers = [*np.ravel(self.places), self.distance, *self.field, self.roll, self.roll_spread]
        if not np.isfinite(numbers).all() or self.distance <= 0 or self.roll_spread < 0:
            what = "places, roll and a positive distance must be finite numbers"
            raise InputError(what, where="Places", remedy="give metres and radians")
        if not all(0 < one < math.pi for one in self.field):
            raise InputError(f"the field {self.field} must lie between 0 and π", where="Places", remedy="give radians")
        if not self.places or any(self.places[0]):
            raise InputError(
                "the first probe must stand at (0, 0)", where="Places", remedy="count from the first probe"
            )

    def to_first(self, probe: int, gaze: ArrayLike) -> Array:
        """The gaze that the first probe sees where probe number `probe`, from 0, sees `gaze`.

        Both are [..., 2], in fractions of the field; NaN stays NaN.
        """
        return self._between(self.places[probe], (0.0, 0.0), np.asarray(gaze, dtype=np.float64))

    def from_first(self, probe: int, gaze: ArrayLike) -> Array:
        """Return the gaze that `probe` sees where the first one sees `gaze`, both [..., 2]."""
        return self._between((0.0, 0.0), self.places[probe], np.asarray(gaze, dtype=np.float64))

    def _between(self, source: tuple[float, float], goal: tuple[float, float], gaze: Array) -> Array:
        """Rotate the target until it sees `source` at `gaze`; return where it then sees `goal`."""
        scale = 2 * np.tan(np.array(self.field) / 2)
        seen = np.concatenate([gaze * scale, np.ones((*gaze.shape[:-1], 1))], axis=-1)
        seen /= np.linalg.norm(seen, axis=-1, keepdims=True)
        cos, sin = math.cos(self.roll), math.sin(self.roll)
        # Of the upright camera: pan about y, then tilt about x. Both are to be found.
        upright = np.stack([cos * seen[..., 0] - sin * seen[..., 1], sin * seen[..., 0] + cos * seen[..., 1]], axis=-1)
        ux, uy, uz = upright[..., 0], upright[..., 1], seen[..., 2]
        (sx, sy, sz), (gx, gy, gz) = (_direction(place, self.distance) for place in (source, goal))
        # A tilt keeps x, and a pan y.
        pan = np.arcsin(np.clip(ux / math.hypot(sx, sz), -1, 1)) - math.atan2(sx, sz)
        depth = np.sqrt(np.maximum(1 - ux**2 - sy**2, 0.0))
        tilt = np.arctan2(uy, uz) - np.arctan2(sy, depth)
        x, far = gx * np.cos(pan) + gz * np.sin(pan), gz * np.cos(pan) - gx * np.sin(pan)
        y, z = gy * np.cos(tilt) + far * np.sin(tilt), far * np.cos(tilt) - gy * np.sin(tilt)
        back = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
        return back / z[..., None] / scale


def _direction(place: tuple[float, float], distance: float) -> tuple[float, float, float]:
    length = math.hypot(*place, distance)
    return place[0] / length, place[1] / length, distance / length
