"""The watch's loop: from frames to cameras, their events, and the listeners that get both."""

from __future__ import annotations

import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.live.acquire import Acquisition
from tapetum.live.events import Event, Events, Ignored, Region
from tapetum.live.guard import Guard
from tapetum.live.log import Log
from tapetum.live.look import LEAST, TOLERANCE, look
from tapetum.live.outputs.base import Counts
from tapetum.live.state import Health, State
from tapetum.record.source import Frame, Source, full_scale_of
from tapetum.track.pipeline import make_detector, seeing, track, usual_tracker
from tapetum.track.rows import TrackedFrame, TrackRow
from tapetum.track.turns import Turns

if TYPE_CHECKING:
    from tapetum.models import Predictor

__all__ = ["Listener", "Watch"]

_WIDTH = 1280  # of the picture of a frame, at most, in pixels
_THUMB = 64  # least side of the picture of an event, in pixels of the frame
_QUALITY = 80
_RECENT = 30  # frames over which rate and delay are averaged
_PATIENCE = 5.0
_EXPIRE_EVERY = 600.0
_FEWEST_LOOKS = 10  # of a camera that is to be known by them
_PAUSE = 0.2  # s after a frame that could not be searched


class Listener(Protocol):
    """A receiver of events and states, called from the loop's thread: none of its functions may wait."""

    def event(self, event: Event) -> None:
        """Take an event."""
        ...

    def state(self, state: State) -> None:
        """Take the state after a frame."""
        ...

    def close(self) -> None:
        """End."""
        ...


class Watch:
    """Watches a source in threads of its own.

    Parameters
    ----------
    opens
        Opens the source; called again when a camera was lost.
    name
        Of the source, for messages and the page.
    detector
        "cameras", in a room, or "spots", in the beam of a dark bench.
    models
        Estimators of gaze, focus or device.
    mode, repeat
        "newest", frames in real time, or "all", none of a stored source is left out; whether one begins again at its
        end (see `Acquisition`).
    log
        Where events go; default: memory.
    regions
        Parts of the cameras' fields to report on.
    listeners
        Receivers of events and states.
    guard
        Rules whose alerts are published as events of the kind "alert"; its regions are reported on too.
    activity
        Whether to say of each camera if it images (see `tapetum.track.activity`).
    budget
        Seconds that models may take for each frame; where cameras are too many for that, they are estimated by turns.
        None: all in every frame.
    timing
        Seconds `confirm`, `hold`, `cooldown` and `gone` of `Events`.

    Raises
    ------
    InputError
        When a name or a number is out of range, or a model is no estimator.

    Attributes
    ----------
    state
        After the latest frame.
    log, events
        Of the events; what makes them.
    """

    def __init__(
        self,
        opens: Callable[[], Source],
        *,
        name: str = "",
        detector: str = "cameras",
        models: Sequence[Predictor] = (),
        mode: str = "newest",
        repeat: bool = False,
        log: Log | None = None,
        regions: Iterable[Region] = (),
        listeners: Iterable[Listener] = (),
        guard: Guard | None = None,
        activity: bool = False,
        budget: float | None = None,
        timing: dict[str, float] | None = None,
    ) -> None:
        for number, model in enumerate(models):
            # Each frame would fail, and the watch begin again for ever.
            if not callable(getattr(model, "predict", None)):
                what = f"has no predict: {type(model).__name__}"
                raise InputError(what, where=f"models[{number}]", remedy="give what load_model or pretrained returns")
        self.acquisition = Acquisition(opens, mode, self._told_of_source, repeat=repeat)
        self.log = Log(":memory:") if log is None else log
        self.guard = guard
        regions = (*regions, *(() if guard is None else guard.rules.areas()))
        self.events = Events(regions, ignored=self.log.ignored(), **(timing or {}))
        self.listeners = list(listeners)
        self.state = State(name, -1, time.time_ns(), (0, 0), (), Health())
        self.models = tuple(models)
        self._detector, self._lock = detector, threading.Lock()
        self._activity = activity
        self._turns = None if budget is None else Turns(budget)
        # Checks the names before a thread starts.
        self._find = make_detector(detector)
        # Frames that were taken and are not done yet, in order, and the one that was done last or is under way.
        self._taken: deque[Frame] = deque()
        self._frame: Frame | None = None
        self._shown: Frame | None = None
        self._coded: tuple[int, bytes] = (-1, b"")
        self._times: deque[tuple[float, float]] = deque(maxlen=_RECENT)
        # Tracks' numbers go on after those before a fault.
        self._offset = self._last_track = self._frames = 0
        self._fault = ""
        self._expired = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Open the source and begin; InputError where it cannot be opened."""
        self.acquisition.start()
        self._thread.start()

    def join(self, seconds: float | None = None) -> bool:
        """Wait for the end of the source; return whether it has ended."""
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def close(self) -> None:
        """End: the cameras' stays end too, and the log is closed."""
        self.acquisition.close()
        self._thread.join(_PATIENCE)
        for listener in self.listeners:
            listener.close()
        self.log.close()

    def ignore(self, one: Ignored) -> None:
        """Ignore a camera that is ours, from now on and in later watches with this log."""
        self.log.ignore(one)
        self.events.ignored = self.log.ignored()

    def ignore_look(self, camera: str) -> None:
        """Ignore a camera that is followed now wherever it looks as it did in the last minute.

        Raises
        ------
        InputError
            When there is no such camera, or it showed too few looks.
        """
        found = next((one for one in self.state.cameras if one.id == camera), None)
        if found is None:
            raise InputError("is not here now", where=f"camera {camera}", remedy="choose one of the list")
        looks = self.events.looks_of(camera)
        if len(looks) < _FEWEST_LOOKS:
            if found.diameter < LEAST:
                what = f"its return is {found.diameter:.0f} pixels wide: returns below {LEAST:.0f} all look alike"
                raise InputError(what, where="look", remedy="ignore it by its place or device")
            what = f"{len(looks)} of {_FEWEST_LOOKS} looks were seen, or its return is saturated or faint"
            raise InputError(what, where="look", remedy="wait some seconds, or ignore it by its place or device")
        one = Ignored(looks=looks, tolerance=TOLERANCE)
        self.ignore(one)
        self.events.take_as(camera, one)

    def forget_ignored(self, one: Ignored | None = None) -> None:
        """Report on a camera of ours again, or on every one."""
        self.log.forget_ignored(one)
        self.events.ignored = self.log.ignored()

    @property
    def shown(self) -> Frame | None:
        """The latest frame that is shown; None before the first."""
        return self._shown

    def picture(self) -> tuple[int, bytes]:
        """Return the number of the latest frame that is shown, and the frame as JPEG, at most 1280 pixels wide.

        Where the source says which frames are lit, the lit ones are shown. Without a frame: (-1, b"").
        """
        frame = self._shown
        if frame is None:
            return -1, b""
        with self._lock:
            if self._coded[0] != frame.index:
                self._coded = frame.index, _jpeg(frame.image, frame.full_scale, _WIDTH)
            return self._coded

    def _run(self) -> None:
        while True:
            try:
                self._follow()
                break
            except Exception as error:
                # A frame that cannot be searched, or a model that fails, must not end the watch: the fault is shown,
                # and tracks begin again, with numbers of their own.
                self._fault = str(error) or type(error).__name__
                self._offset = self._last_track
                self._find = make_detector(self._detector)
                time.sleep(_PAUSE)
        ended = self.events.end_all(self.state.utc_ns)
        for event in ended:
            self._publish(event)
        if self.guard is not None:
            # No alert holds of a camera that is no longer watched.
            self.guard.update(replace(self.state, cameras=()), ended)
        self._set_state(self.state.utc_ns, ended=True)

    def _follow(self) -> None:
        """Track until the source ends; the next frame is searched while models see the one before."""
        follower, over = usual_tracker(self._find), threading.Event()
        tracking = track(
            self._frames_until(over),
            model=seeing(self.models, self.acquisition),
            tracker=follower,
            detector=self._find,
            batch=1,
            activity=self._activity,
            turns=self._turns,
            ahead=True,
        )
        try:
            for tracked in tracking:
                self._frame = self._taken[0]
                self._see(tracked, self._frame)
                self._taken.popleft()
        finally:
            over.set()

    def _see(self, tracked: TrackedFrame, frame: Frame) -> None:
        """Publish what a frame's tracks say."""
        self._frames += 1
        self._last_track = max([self._last_track, *(row.track + self._offset for row in tracked.rows)])
        if frame.lit is not False:
            self._shown = frame
        utc = frame.utc_ns or time.time_ns()
        looks = self._looks(frame, tracked.rows)
        made = self.events.update(tracked, utc, self._offset, looks)
        for event in made:
            self._publish(event)
        self._set_state(utc)
        if self.guard is not None:
            for alert in self.guard.update(self.state, made):
                self._publish(alert.as_event(), alert.tell)

    def _looks(self, frame: Frame, rows: Iterable[TrackRow]) -> dict[int, tuple[float, ...]]:
        """Measure the looks that are wanted, by the tracks' numbers."""
        scale, found = float(frame.full_scale or full_scale_of(frame.image.dtype)), {}
        for row in rows:
            if row.diameter is not None and row.diameter >= LEAST and self.events.wants_look(row, self._offset):
                one = look(frame.image, row.x, row.y, row.diameter, scale)
                if one is not None:
                    found[row.track + self._offset] = one
        return found

    def _frames_until(self, over: threading.Event) -> Iterator[Frame]:
        """Yield frames until the source ends or tracking does; after a fault those first that waited behind it."""
        waiting = list(self._taken)[1:]
        self._taken.clear()
        for frame in chain(waiting, self.acquisition.frames(over)):
            self._taken.append(frame)
            yield frame

    def _publish(self, event: Event, tell: Collection[str] = ()) -> None:
        """Log an event, and send it to the listeners with these names, or to all."""
        # Written before it is sent, so that receivers can read it.
        try:
            self.log.add(event, self._evidence(event))
        except sqlite3.Error as error:
            # Whatever is wrong with the log must not stop the watch.
            self._fault = f"the log cannot be written ({error})"
        for listener in self.listeners:
            if not tell or getattr(listener, "hears_all", False) or getattr(listener, "name", "") in tell:
                listener.event(event)

    def _evidence(self, event: Event) -> bytes | None:
        """The camera's surroundings in the latest shown frame, JPEG; None at the end of a stay."""
        frame, camera = self._shown, event.after
        if frame is None or camera is None:
            return None
        place = round(camera.x), round(camera.y)
        side = max(_THUMB, round(2 * camera.diameter))
        left, top = (
            max(0, min(at - side // 2, size - side)) for at, size in zip(place, frame.image.shape[::-1], strict=True)
        )
        return _jpeg(frame.image[top : top + side, left : left + side], frame.full_scale, _WIDTH)

    def _told_of_source(self, what: str, why: str) -> None:
        """Publish that the source was lost or returned; from the thread that reads."""
        now = time.time_ns()
        self._publish(Event("source", "update", f"source {what}", now, why))

    def _set_state(self, utc_ns: int, *, ended: bool = False) -> None:
        frame, reading = self._frame, self.acquisition
        now = time.monotonic()
        if frame is not None and frame.monotonic_ns is not None:
            self._times.append((now, now - frame.monotonic_ns / 1e9))
        rate = delay = 0.0
        if len(self._times) > 1:
            rate = (len(self._times) - 1) / max(self._times[-1][0] - self._times[0][0], 1e-9)
            delay = sum(one for _, one in self._times) / len(self._times)
        counts = self._frames, reading.lost, reading.refused
        unreached = tuple(filter(None, map(_unreached, self.listeners)))
        fault = "; ".join(filter(None, (self._fault, self.log.fault)))
        health = Health(rate, delay, *counts, reading.connected, ended, fault, unreached)
        size = (0, 0) if frame is None else frame.image.shape[::-1]
        number = -1 if frame is None else frame.index
        clocks = (None, None) if frame is None else (frame.monotonic_ns, frame.camera_time)
        self.state = State(self.state.source, number, utc_ns, size, self.events.cameras, health, *clocks)
        for listener in self.listeners:
            listener.state(self.state)
        if now - self._expired > _EXPIRE_EVERY:
            self._expired = now
            self.log.expire()


def _unreached(listener: Listener) -> str:
    """What did not reach a receiver, and why; empty where all did."""
    counts: Counts | None = getattr(listener, "counts", None)
    if counts is None or not (counts.dropped or counts.failed or counts.fault):
        return ""
    why = f" ({counts.fault})" if counts.fault else ""
    return f"{getattr(listener, 'name', '')}: {counts.dropped + counts.failed} messages lost{why}"


def _jpeg(image: NDArray[Any], full_scale: int | None, width: int) -> bytes:
    """An image as JPEG, at most so wide; deeper ones are scaled to 8 bits by the digital number that saturates."""
    if image.shape[1] > width:
        scale = width / image.shape[1]
        size = round(scale * image.shape[1]), round(scale * image.shape[0])
        # Means over whole pixels take a tenth of the time; what little is left is interpolated.
        whole = image.shape[1] // width
        rows, columns = (side // whole for side in image.shape)
        image = cv2.resize(image[: rows * whole, : columns * whole], (columns, rows), interpolation=cv2.INTER_AREA)
        image = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    if image.dtype != np.uint8 or (full_scale or 255) != 255:
        image = cv2.convertScaleAbs(image, alpha=255 / (full_scale or full_scale_of(image.dtype)))
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
