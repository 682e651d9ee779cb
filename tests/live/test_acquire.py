"""Reading of a source: its clock, what is left out, and a camera that goes and returns."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from tests.live.conftest import Scripted

from tapetum.errors import InputError
from tapetum.live.acquire import Acquisition
from tapetum.record.source import Frame

BLACK = np.zeros((8, 8), np.uint8)


def frames(*times: float) -> list[Frame]:
    return [Frame(k, t, BLACK) for k, t in enumerate(times)]


def test_all_leaves_out_none_of_a_stored_source() -> None:
    reading = Acquisition(lambda: Scripted(frames(*np.arange(200) / 20)), "all")
    reading.start()
    assert [one.index for one in reading] == list(range(200))
    assert (reading.arrived, reading.lost, reading.ended) == (200, 0, True)


def test_newest_keeps_the_newest_lit_and_dark_frame_and_counts_the_rest() -> None:
    many = [Frame(k, k * 1e-6, BLACK, lit=bool(k % 2)) for k in range(20)]
    reading = Acquisition(lambda: Scripted(many), "newest")
    reading.start()
    while not reading.ended:
        time.sleep(0.001)
    assert [(one.index, one.lit) for one in reading] == [(18, False), (19, True)]
    assert reading.lost == 18


def test_doubled_and_backward_times_are_refused_and_counted() -> None:
    reading = Acquisition(lambda: Scripted(frames(0.0, 0.1, 0.1, 0.05, 0.2)), "all")
    reading.start()
    assert [round(one.time, 3) for one in reading] == [0.0, 0.1, 0.2]
    assert reading.refused == 2


def test_a_driver_that_uses_its_buffer_again_does_not_change_what_was_taken() -> None:
    shared = np.zeros((8, 8), np.uint8)

    class Reusing(Scripted):
        def __iter__(self):
            for k in range(3):
                shared[:] = k
                yield Frame(k, k / 10, shared)

    reading = Acquisition(lambda: Reusing([]), "all")
    reading.start()
    assert [int(one.image[0, 0]) for one in reading] == [0, 1, 2]


def test_a_camera_that_goes_is_opened_again_and_both_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tapetum.live.acquire._RETRY", (0.01, 0.02))
    said: list[tuple[str, str]] = []
    opened = 0

    def opens() -> Scripted:
        nonlocal opened
        opened += 1
        if opened == 2:
            raise InputError("is not there", where="camera:0")
        # A camera's own clock is not used; each frame comes later than the one before.
        return Scripted(frames(0.0), live=True, fault=OSError("unplugged"))

    reading = Acquisition(opens, "all", lambda what, why: said.append((what, why)))
    reading.start()
    taken = []
    for one in reading:
        taken.append(one.time)
        if len(taken) == 2:
            break
    reading.close()
    assert said[:2] == [("lost", "unplugged"), ("returned", "scripted")]
    assert taken[0] < taken[1]


def test_a_source_that_cannot_be_opened_at_first_is_an_error() -> None:
    def opens() -> Scripted:
        raise InputError("is not there", where="camera:9")

    with pytest.raises(InputError, match="camera:9: is not there"):
        Acquisition(opens).start()


def test_a_full_queue_makes_a_stored_source_wait_and_a_camera_lose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tapetum.live.acquire._QUEUE", 3)
    many = frames(*np.arange(10) * 1e-6)
    camera = Acquisition(lambda: Scripted([replace(one, monotonic_ns=None) for one in many], live=True), "all")
    camera.start()
    while camera.connected or camera.arrived < 10:
        time.sleep(0.001)
    camera.close()
    assert camera.lost == 7


def test_a_stored_source_that_repeats_goes_on_in_time() -> None:
    said: list[str] = []
    reading = Acquisition(lambda: Scripted(frames(0.0, 0.1)), "all", lambda what, _: said.append(what), repeat=True)
    reading.start()
    times = [round(one.time, 3) for one, _ in zip(reading, range(5), strict=False)]
    reading.close()
    assert times == [0.0, 0.1, 0.15, 0.25, 0.3]
    assert said == []


def test_a_source_slower_than_real_time_slips_and_does_not_fall_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tapetum.live.acquire._SLIP", 0.01)

    class Slow(Scripted):
        def __iter__(self):
            for one in self.frames:
                time.sleep(0.03)
                yield one

    reading = Acquisition(lambda: Slow(frames(*np.arange(10) * 1e-3)), "newest")
    reading.start()
    delays = [(time.monotonic_ns() - (one.monotonic_ns or 0)) / 1e9 for one in reading]
    # Without it the last frame is 0.3 s late by its own clock.
    assert min(delays[-3:]) < 0.1
    assert reading.refused == 0
