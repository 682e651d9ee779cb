"""The detector of rooms in tracking: lit frames are compared with the latest dark one where the laser is modulated."""

from __future__ import annotations

import math
from collections import Counter
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tapetum.data.crop import find_centre
from tapetum.detection import Found, find_cameras
from tapetum.detection.find import depth_of
from tapetum.detection.global_motion import MotionFinder
from tapetum.errors import InputError
from tapetum.record.source import Frame, full_scale_of
from tapetum.track.detections import Detections
from tapetum.track.ghosts import Ghost
from tapetum.track.tracker import Tracker

__all__ = ["CameraDetector"]

_EIGHT_BITS = 255.0
# Of a pair: how many times the false alarms that are allowed a spot may cost and still count in full towards the number
# of its track, up to how many a frame; how many times as many count for nothing; and up to how many a frame are kept at
# all. What chance shows rarely persists, so that tracks with a number that are none are far fewer. What shines back and
# is no camera does persist, which is why ten times is not more.
_FULL, _FULL_MOST, _NOTHING, _KEPT = 10.0, 0.5, 30.0, 3.0
# Height over the spread around it up to which a spot that costs more than that counts so, and above which it counts for
# nothing: what noise hides, other frames may show, but what is clear and looks like no camera will do so in each.
_DIM, _CLEAR = 8.0, 16.0
# A track gets its number once the evidence of its lit frames, of the latest so many, adds up to so much, less what each
# frame without it takes off: three spots that count in full give it, with one frame without; one more with three.
_ENOUGH, _FRAMES, _DOUBT = 2.5, 12, 0.5


class CameraDetector:
    """Finds cameras in frames of a room; a `Detector`.

    Where a source says of its frames whether the laser was on, each lit frame is compared with the latest dark one,
    whichever of the two comes first; dark frames hold no retro-reflection. Frames of which that is unknown are searched
    each alone, which finds far less.

    Parameters
    ----------
    false_alarms
        Expected false alarms a frame among tracks that have their number. Of a frame alone what scores lower is left
        out. Of a pair, spots that cost more count too, the less the more they cost, as they must persist.
    largest
        Largest diameter of a spot in pixels.
    min_snr
        Smallest height of a spot over the spread of its surroundings.
    known_ghost
        Of the probe's beam splitter, where it was calibrated.
    ghosts
        "drop" leaves ghosts out, "mark" returns them with ``ghost`` set.
    most
        Most places of a frame that are looked at closely, as of `find_cameras`.
    apart
        Seconds that a dark frame may be older than the lit one.

    Attributes
    ----------
    notes
        How many frames were searched alone though a dark one was wanted, by reason.

    Raises
    ------
    InputError
        When an option is out of range.
    """

    usual_largest: ClassVar[float] = 60.0

    def __init__(
        self,
        *,
        false_alarms: float = 0.01,
        largest: float = usual_largest,
        min_snr: float = 1.0,
        known_ghost: Ghost | None = None,
        ghosts: str = "drop",
        most: int | None = None,
        apart: float = 0.5,
    ) -> None:
        for name, value in (("false_alarms", false_alarms), ("largest", largest), ("min_snr", min_snr)):
            if not value > 0:
                raise InputError(f"must be positive, is {value}", where=name)
        if ghosts not in ("drop", "mark"):
            raise InputError(f"unknown value {ghosts!r}", where="ghosts", remedy="use one of drop, mark")
        self.false_alarms, self.largest, self.min_snr = false_alarms, largest, min_snr
        self.known_ghost, self.ghosts, self.most, self.apart = known_ghost, ghosts, most, apart
        self.notes: Counter[str] = Counter()
        # Of 16-bit frames whose source does not know at which level they saturate.
        self._depth = 0
        self._dark: tuple[float, NDArray[np.generic]] | None = None
        self._motions = MotionFinder()

    def tracker(self) -> Tracker:
        """Return a tracker for a room, where there are false alarms.

        A track gets its number when the evidence of its spots suffices, and its end is an event. The tracker's own
        guard against ghosts is not used: it is for detectors that drop ghosts by their brightness alone, on a bench.
        """
        return Tracker(ghost_ratio=0.0, persist=(_ENOUGH, _FRAMES), doubt=_DOUBT, endings=True)

    def __call__(self, frame: Frame, /) -> Detections:
        image = self._levels(frame)
        if frame.lit is False:
            self._dark = frame.time, image
            return Detections.empty(self._moved(image))
        found = self._found(frame, image)
        return self._detections(frame, found[found.snr >= self.min_snr], self._moved(image))

    def _found(self, frame: Frame, image: NDArray[np.generic]) -> Found:
        dark = None
        if frame.lit and self._dark is not None:
            time, dark = self._dark
            reason = ""
            if dark.shape != image.shape or dark.dtype != image.dtype:
                reason = "the dark frame has another size or type"
            elif not 0 <= frame.time - time <= self.apart:
                reason = f"the latest dark frame is more than {self.apart:g} s old"
            if reason:
                self.notes[reason], dark, self._dark = self.notes[reason] + 1, None, None
        elif frame.lit:
            self.notes["no dark frame came before"] += 1
        try:
            return self._search(image, dark, self.false_alarms if dark is None else self._kept)
        except InputError as error:
            if dark is None or error.where != "dark":
                raise
            self.notes["the dark frame cannot be registered"] += 1
            return self._search(image, None, self.false_alarms)

    @property
    def _full(self) -> float:
        return max(self.false_alarms, min(_FULL * self.false_alarms, _FULL_MOST))

    @property
    def _kept(self) -> float:
        return max(self.false_alarms, min(_NOTHING * self._full, _KEPT))

    def _evidence(self, found: Found) -> NDArray[np.float64]:
        costs = found.false_alarms / self._full
        rare = np.clip(1 - np.log(np.maximum(costs, 1.0)) / math.log(_NOTHING), 0, 1)
        return np.where(costs <= 1, 1.0, rare * np.clip((_CLEAR - found.snr) / (_CLEAR - _DIM), 0, 1))

    def _full_scale(self, frame: Frame) -> float:
        scale = float(frame.full_scale or _EIGHT_BITS)
        if frame.image.dtype == np.uint16 and scale == full_scale_of(np.uint16):
            self._depth = max(self._depth, depth_of(frame.image))
            return float(self._depth)
        return scale

    def _levels(self, frame: Frame) -> NDArray[np.generic]:
        """The frame's image with its own full scale at 255: uint8 as it is, others as float32."""
        scale = self._full_scale(frame)
        if frame.image.dtype == np.uint8 and scale == _EIGHT_BITS:
            return frame.image
        return frame.image.astype(np.float32) * np.float32(_EIGHT_BITS / scale)

    def _moved(self, image: NDArray[np.generic]) -> NDArray[np.float64] | None:
        return self._motions(image)

    def _search(self, image: NDArray[np.generic], dark: NDArray[np.generic] | None, false_alarms: float) -> Found:
        return find_cameras(
            image,
            dark,
            swaps=False,
            false_alarms=false_alarms,
            largest=self.largest,
            most=self.most,
            full_scale=_EIGHT_BITS,
        )

    def _detections(self, frame: Frame, found: Found, motion: NDArray[np.float64] | None) -> Detections:
        image = frame.image
        scale = self._full_scale(frame) / _EIGHT_BITS
        sigma = np.maximum(found.diameter / 4, 0.5)
        peak = scale * found.flux / (2 * math.pi * sigma**2)
        reach = np.maximum(4.0, 0.75 * found.diameter)
        near = zip(found.x.tolist(), found.y.tolist(), reach.tolist(), strict=True)
        centres = np.array([find_centre(image, near=one) for one in near]).reshape(-1, 2)
        height, width = image.shape
        margin = np.minimum.reduce([found.x, found.y, width - 1 - found.x, height - 1 - found.y])
        ghost = np.zeros(len(found), bool)
        if self.known_ghost is not None:
            ghost = self.known_ghost.among(found.x, found.y, peak, found.saturated)
        columns = {
            "x": found.x,
            "y": found.y,
            "peak_x": centres[:, 0],
            "peak_y": centres[:, 1],
            "snr": found.snr,
            "peak": peak,
            "diameter": found.diameter,
            "area": np.ceil(math.pi / 4 * found.diameter**2).astype(np.int64),
            "saturated": found.saturated.astype(np.int64),
            "edge": margin < found.diameter / 2,
            "ghost": ghost,
            "evidence": self._evidence(found),
        }
        # Brightest first.
        spots = Detections.of(columns, motion)[np.argsort(-peak, kind="stable")]
        return spots if self.ghosts == "mark" else spots.without_ghosts
