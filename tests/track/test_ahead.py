"""Detection ahead of what follows: the order stays, few frames wait, and whatever ends it ends all of it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record.source import Frame
from tapetum.track import Detections, track
from tapetum.track.ahead import found_ahead, found_next
from tapetum.track.cameras import CameraDetector

IMAGE = np.zeros((48, 64), np.uint8)
IMAGE[20:25, 30:35] = 200


def frames(count: int, read: list[int] | None = None, error: BaseException | None = None) -> Iterator[Frame]:
    try:
        for n in range(count):
            if read is not None:
                read.append(n)
            yield Frame(n, n / 30, IMAGE)
        if error is not None:
            raise error
    finally:
        if read is not None:
            read.append(-1)


def nothing(frame: Frame) -> Detections:
    return Detections.empty()


def test_frames_come_in_order_however_long_each_takes() -> None:
    rng = np.random.default_rng(0)
    naps = rng.uniform(0, 0.004, 60)

    def slow(frame: Frame) -> Detections:
        time.sleep(naps[frame.index])
        return nothing(frame)

    assert [frame.index for frame, _ in found_ahead(frames(60), slow)] == list(range(60))


@pytest.mark.parametrize("ahead", [found_ahead, found_next])
def test_the_next_frame_is_searched_while_somebody_works_on_the_one_before(ahead: Callable[..., Any]) -> None:
    """Each waits for the other; one after another they would wait for ever."""
    both = threading.Barrier(2, timeout=5)

    def together(frame: Frame) -> Detections:
        if frame.index:
            both.wait()
        return nothing(frame)

    seen = 0
    for frame, _ in ahead(frames(10), together):
        seen += 1
        if frame.index < 9:
            both.wait()
    assert seen == 10


def test_few_frames_wait() -> None:
    read: list[int] = []
    found = found_ahead(frames(1000, read), nothing)
    next(found)
    time.sleep(0.3)
    assert len(read) <= 8
    found.close()  # type: ignore[attr-defined]
    # The source was closed, and nothing runs on.
    assert read[-1] == -1 and not any(thread.name.startswith(("read", "detect")) for thread in threading.enumerate())


def test_of_a_watched_camera_one_frame_waits() -> None:
    """Ahead of a slow model frames would grow old: the newest is taken when the one before it is asked about."""
    read: list[int] = []
    found = found_next(frames(1000, read), nothing)
    for n in range(3):
        assert next(found)[0].index == n
        time.sleep(0.05)
        assert read == list(range(n + 2))
    found.close()  # type: ignore[attr-defined]
    assert not any(thread.name.startswith("detect") for thread in threading.enumerate())


@pytest.mark.parametrize("ahead", [found_ahead, found_next])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), InputError("cannot be read", where="frame 7")])
def test_what_ends_the_frames_comes_after_them(error: BaseException, ahead: Callable[..., Any]) -> None:
    seen = []
    with pytest.raises(type(error)):
        for frame, _ in ahead(frames(7, error=error), nothing):
            seen.append(frame.index)
    assert seen == list(range(7))


def test_a_frame_that_cannot_be_searched_ends_it_at_its_turn() -> None:
    read: list[int] = []

    def picky(frame: Frame) -> Detections:
        if frame.index == 5:
            raise InputError("is damaged", where="frame 5")
        return nothing(frame)

    seen = []
    with pytest.raises(InputError, match="is damaged"):
        for frame, _ in found_ahead(frames(1000, read), picky):
            seen.append(frame.index)
    assert seen == list(range(5)) and read[-1] == -1


def test_a_detector_that_remembers_gets_one_frame_after_another() -> None:
    """A list is read ahead; the detector of rooms compares each lit frame with the dark one before it."""
    calls: list[int] = []

    class Remembering(CameraDetector):
        def __call__(self, frame: Frame, /) -> Detections:
            calls.append(frame.index)
            time.sleep(0.002 * (frame.index % 3))
            calls.append(frame.index)
            return Detections.empty()

    assert len(list(track(list(frames(12)), detector=Remembering()))) == 12
    assert calls == [n for n in range(12) for _ in (0, 1)]


def test_a_list_gives_what_frames_on_demand_give() -> None:
    ahead, asked = (
        [[(row.track, row.x, row.y) for row in one.rows] for one in track(some)]
        for some in (list(frames(20)), frames(20))
    )
    assert ahead == asked and len(ahead) == 20


def test_frames_on_demand_are_asked_for_one_by_one() -> None:
    """Who makes frames in answer to what was tracked must not be asked ahead."""
    read: list[int] = []
    tracked = track(frames(10, read))
    next(tracked)
    assert read == [0]
    next(tracked)
    assert read == [0, 1]
