"""A scan: cameras looked for in an uploaded picture, a lit and a dark one, or a short film; and a map of a live one."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from tapetum.detection import find_cameras
from tapetum.errors import InputError, one_of
from tapetum.live.modes.coverage import Coverage, CoverageState
from tapetum.live.modes.uploads import KINDS, decoded
from tapetum.live.state import State
from tapetum.record.source import Frame
from tapetum.track.pipeline import make_detector, track, usual_tracker

__all__ = ["Candidate", "Scan", "ScanState", "Searched", "search"]

_KEPT = 6  # searches whose pictures are kept
_WAITING = 3
_SHOWN = 30  # candidates
_LIKELY = 1.0  # expected false alarms a picture above which nothing is shown
# The same of each frame of a film, where few false alarms last.
_FOLLOWED = 2.5
_CROP, _SIDE = 48, 160  # pixels of a candidate's picture, and of that on the page
_WIDTH = 960
_LASTING = 0.25  # of a film's frames
_FEWEST = 3  # frames of a film in which a candidate is seen


@dataclass(frozen=True)
class Candidate:
    """What may be a camera.

    Parameters
    ----------
    number
        From 1, the likeliest first.
    x, y, diameter
        In pixels of the picture.
    probability, false_alarms
        Probability that it is a camera; and how many things that are none score as high in a picture. None for a film.
    snr
        Its height over the spread of its surroundings.
    frames
        In how many frames of a film it was seen.
    likely
        Whether it is worth a look: less than one false alarm in a hundred pictures, or seen in a quarter of a film.
    """

    number: int
    x: float
    y: float
    diameter: float
    snr: float
    likely: bool
    probability: float | None = None
    false_alarms: float | None = None
    frames: int = 1


@dataclass(frozen=True)
class Searched:
    """A search of an upload: its state ("waiting", "searching", "done", "failed"), candidates and notes."""

    id: int
    kind: str
    state: str
    utc_ns: int
    width: int = 0
    height: int = 0
    frames: int = 0
    seconds: float = 0.0
    fault: str = ""
    note: str = ""
    candidates: tuple[Candidate, ...] = ()


@dataclass(frozen=True)
class ScanState:
    """Searches of uploads, the newest first, and the map of a live scan."""

    searches: tuple[Searched, ...] = ()
    coverage: CoverageState = field(default_factory=CoverageState)


@dataclass
class _Result:
    """A search with its pictures: the whole one, and each candidate's from the lit and the dark frame."""

    told: Searched
    whole: bytes = b""
    crops: dict[tuple[int, str], bytes] = field(default_factory=dict)


class Scan:
    """Searches of uploads, one after the other in a thread, and a live scan; may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._results: OrderedDict[int, _Result] = OrderedDict()
        self._worker = ThreadPoolExecutor(1, "scan")
        self._number = self._busy = 0
        self._coverage: Coverage | None = None
        self._running = False
        self._before = 0.0
        self._shown = -1

    @property
    def full(self) -> bool:
        """Whether no further upload is taken now."""
        return self._busy >= _WAITING

    def begin(self, content: bytes, kind: str, first: int = 0) -> int:
        """Search an upload; return the number of the search.

        Raises
        ------
        InputError
            For another kind than `KINDS`, and while too many wait.
        """
        one_of(kind, KINDS, "kind")
        with self._lock:
            if self.full:
                raise InputError("too many uploads wait", where="scan", remedy="wait until one is searched")
            self._busy += 1
            self._number += 1
            number = self._number
            self._results[number] = _Result(Searched(number, kind, "waiting", time.time_ns()))
            while len(self._results) > _KEPT + self._busy:
                self._results.popitem(last=False)
        self._worker.submit(self._search, number, content, kind, first)
        return number

    def picture(self, number: int, candidate: int = 0, which: str = "lit") -> bytes | None:
        """Return a search's whole picture, or that of a candidate, JPEG; None where there is none."""
        with self._lock:
            found = self._results.get(number)
            if found is None:
                return None
            return found.whole or None if candidate == 0 else found.crops.get((candidate, which))

    def start(self) -> None:
        """Begin the map of a live scan again."""
        with self._lock:
            self._coverage, self._running = None, True

    def stop(self) -> None:
        """End the live scan; its map stays."""
        with self._lock:
            self._running = False

    def update(self, state: State, frame: Frame | None) -> None:
        """Take a state of the watch, and its latest lit frame."""
        with self._lock:
            # Between two lit frames the same one is shown.
            if not self._running or frame is None or frame.index == self._shown:
                return
            self._shown = frame.index
            size = frame.image.shape[1], frame.image.shape[0]
            if min(size) < 16:
                return
            if self._coverage is None or self._coverage.size != size:
                self._coverage = Coverage(size)
            step = min(0.5, max(0.0, state.utc_ns / 1e9 - self._before))
            self._before = state.utc_ns / 1e9
            self._coverage.update(frame.image, frame.time)
            for one in state.cameras:
                if one.seen:
                    at = (one.x + 0.5) / size[0], (one.y + 0.5) / size[1]
                    self._coverage.see(one.id, *at, one.snr, one.device, step)

    def state(self) -> ScanState:
        """Return how all stands."""
        with self._lock:
            live = CoverageState() if self._coverage is None else self._coverage.state(running=self._running)
            if self._coverage is None and self._running:
                live = CoverageState(True, advice="hold still")
            return ScanState(tuple(one.told for one in reversed(self._results.values())), live)

    def close(self) -> None:
        """End; a search under way is waited for no longer."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _search(self, number: int, content: bytes, kind: str, first: int) -> None:
        def tell(**said: Any) -> None:
            with self._lock:
                if number in self._results:
                    result = self._results[number]
                    result.told = Searched(**{**vars(result.told), **said})

        begun = time.monotonic()
        tell(state="searching")
        try:
            found = search(content, kind, first)
            with self._lock:
                if number in self._results:
                    self._results[number].whole, self._results[number].crops = found.whole, found.crops
            said = {name: getattr(found.told, name) for name in ("width", "height", "frames", "candidates", "note")}
            tell(state="done", seconds=time.monotonic() - begun, **said)
        except InputError as error:
            tell(state="failed", fault=str(error), seconds=time.monotonic() - begun)
        except Exception as error:
            # What a search fails at must not end the thread that searches.
            tell(state="failed", fault=f"the search failed ({type(error).__name__})", seconds=time.monotonic() - begun)
        finally:
            with self._lock:
                self._busy -= 1


def search(content: bytes, kind: str, first: int = 0) -> _Result:
    """Decode an upload and look for cameras in it.

    Raises
    ------
    InputError
        As `decoded`; and where the two pictures of a pair differ in size or show different scenes.
    """
    frames = decoded(content, kind, first)
    return _of_film(frames) if kind == "film" else _of_pictures(list(frames))


def _of_pictures(frames: list[Frame]) -> _Result:
    lit, dark = frames[0].image, frames[1].image if len(frames) > 1 else None
    found = find_cameras(lit, dark, false_alarms=_LIKELY)
    note = ""
    if found.swapped:
        note = "the two pictures seem to be swapped: the second one is lit"
    result = _Result(Searched(0, "", "", 0, lit.shape[1], lit.shape[0], len(frames), note=note), _jpeg(lit, _WIDTH))
    candidates = []
    for k in range(min(len(found), _SHOWN)):
        x, y, diameter = float(found.x[k]), float(found.y[k]), float(found.diameter[k])
        alarms = float(found.false_alarms[k])
        candidates.append(
            Candidate(
                k + 1,
                x,
                y,
                diameter,
                float(found.snr[k]),
                alarms <= 0.01,
                float(found.probability[k]),
                alarms,
            )
        )
        result.crops[k + 1, "lit"] = _crop(lit, x, y, diameter)
        if dark is not None:
            result.crops[k + 1, "dark"] = _crop(dark, x, y, diameter)
    result.told = Searched(**{**vars(result.told), "candidates": tuple(candidates)})
    return result


@dataclass
class _Seen:
    """A track of a film: how often it was seen, and its best frame."""

    frames: int = 0
    snr: float = -1.0
    x: float = 0.0
    y: float = 0.0
    diameter: float = 0.0
    picture: bytes = b""


def _of_film(frames: Iterator[Frame]) -> _Result:
    """Candidates of a film: what the tracker follows through several frames, in its best one."""
    find = make_detector("cameras", {"false_alarms": _FOLLOWED})
    now: list[Frame] = []

    def taken() -> Iterator[Frame]:
        for frame in frames:
            now[:] = [frame]
            yield frame

    seen: dict[int, _Seen] = {}
    count, middle = 0, b""
    size = (0, 0)
    for tracked in track(taken(), detector=find, tracker=usual_tracker(find)):
        image = now[0].image
        count += 1
        size = image.shape[1], image.shape[0]
        if count % 20 == 1:
            middle = _jpeg(image, _WIDTH)
        for row in tracked.rows:
            if not row.seen:
                continue
            one = seen.setdefault(row.track, _Seen())
            one.frames += 1
            if (row.snr or 0.0) > one.snr:
                one.snr, one.x, one.y, one.diameter = row.snr or 0.0, row.x, row.y, row.diameter or 0.0
                one.picture = _crop(image, row.x, row.y, one.diameter)
    lasting = sorted((one for one in seen.values() if one.frames >= _FEWEST), key=lambda one: -one.frames * one.snr)
    note = "" if count >= _FEWEST else "the film is too short: a candidate must be seen in three frames"
    result = _Result(Searched(0, "", "", 0, *size, count, note=note), middle)
    candidates = []
    for k, one in enumerate(lasting[:_SHOWN], 1):
        likely = one.frames >= max(_FEWEST, _LASTING * count)
        candidates.append(Candidate(k, one.x, one.y, one.diameter, one.snr, likely, frames=one.frames))
        result.crops[k, "lit"] = one.picture
    result.told = Searched(**{**vars(result.told), "candidates": tuple(candidates)})
    return result


def _crop(image: npt.NDArray[np.uint8], x: float, y: float, diameter: float) -> bytes:
    """The surroundings of a place, enlarged, JPEG."""
    side = min(max(_CROP, round(3 * diameter)), *image.shape)
    left, top = (
        max(0, min(round(at) - side // 2, size - side)) for at, size in zip((x, y), image.shape[::-1], strict=True)
    )
    part = image[top : top + side, left : left + side]
    return _jpeg(np.asarray(cv2.resize(part, (_SIDE, _SIDE), interpolation=cv2.INTER_CUBIC), np.uint8), _SIDE)


def _jpeg(image: npt.NDArray[np.uint8], width: int) -> bytes:
    if image.shape[1] > width:
        scale = width / image.shape[1]
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
