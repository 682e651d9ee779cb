"""Whether a camera images now, from the look of its return (the paper's section 4.5).

The filter before a phone's sensor returns a beam wider than the probe's aperture, which it fills evenly: the probe sees
a round disc with concentric rings, at any gaze. A sensor that images adds light of many diffraction orders, which
breaks that symmetry. So a departure from the mean over circles shows that the sensor is in use. Without one, the camera
is idle only if its filter lets the sensor's light pass, which it has shown once it was seen imaging. Until then the
answer is that it is unknown.

This holds for cameras whose filter overfills the probe's aperture, as those of phones do. A large lens near the probe
returns a narrower beam, whose shape it cuts itself: there the answer would be wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import cv2
import numpy as np
import numpy.typing as npt

__all__ = ["EDGES", "Activity", "Asymmetry", "asymmetry"]

Array = npt.NDArray[np.float64]

# Smoothing of the noise, and of the spot while it is looked for, in pixels.
_FINE, _COARSE = 1.5, 4.0
# Least height of the smoothed spot over its noise, and share of that height that still counts as the spot.
_LEAST_SNR, _SPOT = 10.0, 0.2
# Disc's radius in pixels after reduction, and part of it that is compared: its rim is blurred.
_RADIUS, _INNER = 30.0, 0.95
# Sectors of the disc, and those that count: the second beam's ghost covers one or two.
_SECTORS, _COUNTED = 8, 5
# Share of saturated pixels beyond which the outline is measured in place of what it holds.
_MOST_SATURATED = 0.25

# Edges of classes of the asymmetry, and how often each occurs: of an idle camera, of one whose sensor is seen through a
# clear filter, and of one whose filter passes some percent. Measured on six phones of the virtual bench at 640 and 785
# nm (scripts/measure_activity.py), which are not those that the result was judged on.
EDGES = (0.6e-3, 2.5e-3, 6e-3)
_IDLE = (0.88, 0.10, 0.015, 0.005)
_SEEN = {"clear": (0.005, 0.02, 0.08, 0.895), "faint": (0.12, 0.41, 0.26, 0.21), "blocked": _IDLE}
_CLEAR = list(_SEEN).index("clear")
# Mean time between changes of the state, in seconds.
_STAYS = 20.0
# Mean time, in seconds, after which a sensor that hid may show: a camera turns, and stands before the probe otherwise.
# Without it every idle second, in which a camera that shows its sensor might have begun to image, counts for one that
# never does: after minutes at rest hardly any return could prove the contrary.
_SHOWS = 600.0
# Neighbouring frames resemble each other: so many of them count as one.
_ALIKE = 2.0
# Probability from which a state is stated, and from which it is certain.
_SURE, _CERTAIN = 0.95, 0.999


@dataclass(frozen=True)
class Asymmetry:
    """How far a return departs from concentric rings.

    Parameters
    ----------
    value
        Energy of the amplitude's departure from its mean over circles, over that of the whole, less the noise's. Where
        most of the disc is saturated: the square of the relative deviation of its outline's radius.
    saturated
        Share of the disc that is saturated.
    radius
        Of the disc, in pixels.
    """

    value: float
    saturated: float
    radius: float


def asymmetry(crop: npt.NDArray[np.generic], full_scale: float = math.inf) -> Asymmetry | None:
    """Measure how far the brightest return in a crop departs from concentric rings; None where it is too faint.

    Parameters
    ----------
    crop
        [H, W] digital numbers about a return, with a margin of background.
    full_scale
        Digital number at which a pixel is saturated.
    """
    image = crop.astype(np.float32)
    rim = max(2, min(image.shape) // 16)
    edge = np.concatenate([image[:rim].ravel(), image[-rim:].ravel()])
    noise = float(edge.std()) + 0.1
    light = image - float(edge.mean())
    smooth = cv2.GaussianBlur(light, (0, 0), _COARSE)
    # A few bright places, so that no single pixel decides.
    top = float(np.partition(smooth.ravel(), -100)[-100:].mean())
    floor = noise / (2 * _COARSE * math.sqrt(math.pi))
    if top < _LEAST_SNR * floor:
        return None
    _, labels = cv2.connectedComponents((smooth > max(_SPOT * top, _LEAST_SNR / 2 * floor)).astype(np.uint8))
    spot = labels == labels[np.unravel_index(int(smooth.argmax()), smooth.shape)]
    rows, columns = np.nonzero(spot)
    radius = math.sqrt(len(rows) / math.pi)
    clipped = cv2.dilate((image >= full_scale).astype(np.uint8), np.ones((5, 5), np.uint8))
    saturated = float(clipped[spot].mean())
    if saturated > _MOST_SATURATED:
        return Asymmetry(_outline(clipped & spot.astype(np.uint8)), saturated, radius)
    fine = noise / (2 * _FINE * math.sqrt(math.pi))
    amplitude = np.sqrt(np.maximum(cv2.GaussianBlur(light, (0, 0), _FINE), 0) + fine**2)
    # The square about the disc, reduced.
    half = math.ceil(radius) + 3
    left, top_row = round(float(columns.mean())) - half, round(float(rows.mean())) - half
    square = tuple(
        cv2.copyMakeBorder(one, half, half, half, half, cv2.BORDER_REFLECT)[
            top_row + half : top_row + 3 * half + 1, left + half : left + 3 * half + 1
        ]
        for one in (amplitude, clipped)
    )
    scale = min(1.0, _RADIUS / radius)
    size = max(9, round(scale * square[0].shape[0]))
    scale = size / square[0].shape[0]
    seen = cv2.resize(square[0], (size, size), interpolation=cv2.INTER_AREA).astype(np.float64)
    used = cv2.resize(square[1].astype(np.float32), (size, size), interpolation=cv2.INTER_AREA) == 0
    middle = (scale * (float(columns.mean()) - left + 0.5) - 0.5, scale * (float(rows.mean()) - top_row + 0.5) - 0.5)
    value = _departure(seen, used, middle, _INNER * scale * radius)
    # A pixel's noise in the amplitude, by its slope; few pixels of the reduced disc share it.
    noise_share = float((fine**2 / (4 * np.maximum(seen, fine) ** 2) * seen**2)[used].sum() / (seen[used] ** 2).sum())
    return Asymmetry(max(0.0, value - noise_share) if value is not None else math.nan, saturated, radius)


def _outline(mask: npt.NDArray[np.uint8]) -> float:
    """Square of the relative deviation of the radius of a mask's convex hull."""
    places = np.argwhere(mask)[:, ::-1].astype(np.int32)
    drawn = cv2.fillConvexPoly(np.zeros_like(mask), cv2.convexHull(places), 1)
    outlines, _ = cv2.findContours(drawn, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    around = outlines[0][:, 0].astype(np.float64)
    radius = np.hypot(*(around - np.argwhere(drawn)[:, ::-1].mean(0)).T)
    return float((radius.std() / radius.mean()) ** 2)


def _departure(seen: Array, used: npt.NDArray[np.bool_], middle: tuple[float, float], radius: float) -> float | None:
    """Least share of energy beside the mean over circles, over centres near the middle (column, row)."""
    grid = np.indices(seen.shape, dtype=np.float64)

    def at(x: float, y: float, rounds: int) -> float:
        dy, dx = grid - np.array([y, x])[:, None, None]
        distance = np.hypot(dx, dy)
        inside = used & (distance < radius)
        if np.count_nonzero(inside) < 60:
            return math.nan
        values, away = seen[inside], distance[inside]
        ring = away.astype(np.int64)
        outer = away - ring
        count = int(ring.max()) + 2

        def gathered(of: Array) -> Array:
            near = np.bincount(ring, (1 - outer) * of, count).astype(np.float64)
            return near + np.bincount(ring + 1, outer * of, count)

        weight = gathered(np.ones_like(values)) + 1e-9
        profile, left = np.zeros(count, dtype=np.float64), values.copy()
        # The mean over circles, linear between whole radii, by repeated correction.
        for _ in range(rounds):
            profile = profile + gathered(left) / weight
            left = values - ((1 - outer) * profile[ring] + outer * profile[ring + 1])
        sector = ((np.arctan2(dy, dx)[inside] / (2 * math.pi) + 0.5) * _SECTORS).astype(np.int64) % _SECTORS
        energy = np.bincount(sector, left**2, _SECTORS) / np.maximum(np.bincount(sector, values**2, _SECTORS), 1e-9)
        return float(np.sort(energy)[:_COUNTED].mean())

    (x, y), step = middle, 1.0
    best = at(x, y, 2)
    if math.isnan(best):
        return None
    while step > 0.1:
        tried = [(at(x + a * step, y + b * step, 2), a, b) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        found, a, b = min(tried, key=lambda one: math.inf if math.isnan(one[0]) else one[0])
        if found < best:
            best, x, y = found, x + a * step, y + b * step
        else:
            step /= 2
    return at(x, y, 7)


@dataclass
class Activity:
    """Follows whether one camera images: a filter over its state, and over how well its sensor is seen.

    Attributes
    ----------
    time
        Of the latest return, in seconds; None before the first.
    opened
        When a shutter last opened on the sensor of a camera that was idle, in seconds: the first of the returns that
        show it. None where that was not seen.
    """

    time: float | None = None
    opened: float | None = None
    # Joint probability of imaging or idle (rows), and of each way in which its sensor is seen.
    _joint: Array = field(default_factory=lambda: np.full((2, len(_SEEN)), 0.5 / len(_SEEN)))
    _stated: bool | None = None
    # Evidence for imaging since it began to outweigh that for idle, and since when (Page, Biometrika 41, 100 (1954)).
    _evidence: float = 0.0
    _began: float | None = None

    @property
    def imaging(self) -> float:
        """Probability that it images, by the returns so far."""
        return float(self._joint[0].sum())

    @property
    def certain(self) -> bool:
        """Whether what the latest return says is beyond doubt: 99.9 % sure, where an answer takes 95 %."""
        return max(self.imaging, float(self._joint[1, _CLEAR])) >= _CERTAIN

    def update(self, asymmetry: float | None, time: float) -> bool | None:
        """Take the asymmetry of a return at a time in seconds; None or NaN where none was seen.

        Returns True for imaging, False for idle, and None where it is unknown.
        """
        passed = 0.0 if self.time is None else max(0.0, time - self.time)
        stays = 0.5 + 0.5 * math.exp(-2 * passed / _STAYS)
        self._joint = stays * self._joint + (1 - stays) * self._joint[::-1]
        # Never the other way: that a filter is clear stays known.
        shows = self._joint * -math.expm1(-passed / _SHOWS)
        self._joint = self._joint - shows
        self._joint[:, _CLEAR] += shows.sum(1)
        self.time = time
        seen = asymmetry is not None and math.isfinite(asymmetry)
        if asymmetry is not None and seen:
            kind = int(np.searchsorted(EDGES, asymmetry))
            likely = np.array([[chances[kind] for chances in _SEEN.values()], [_IDLE[kind]] * len(_SEEN)])
            self._weigh(likely, time)
            self._joint = self._joint * likely ** (1 / _ALIKE)
        self._joint = self._joint / self._joint.sum()
        if not seen:
            return None
        if self.imaging >= _SURE:
            if self._stated is False:
                self.opened = time if self._began is None else self._began
            self._stated = True
            return True
        if self._joint[1, _CLEAR] >= _SURE:
            self._stated = False
            return False
        # Behind a filter that passes some percent the sensor shows at some gazes only.
        return None

    def _weigh(self, likely: Array, time: float) -> None:
        """Follow since when returns speak for imaging; this one is so likely for each state and way [2, ways]."""
        ways = self._joint.sum(0) / self._joint.sum()
        imaging, idle = likely @ ways
        self._evidence = max(0.0, self._evidence + math.log(imaging / idle))
        if self._evidence == 0:
            self._began = None
        elif self._began is None:
            self._began = time
