"""The loop on the drawn room, and what goes wrong in it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.live.conftest import Scripted, room_frames, watched

from tapetum.errors import InputError
from tapetum.live.events import Event, Ignored
from tapetum.live.guard import Guard
from tapetum.live.log import Log
from tapetum.live.loop import Watch
from tapetum.live.modes import Modes
from tapetum.live.outputs.base import Queued
from tapetum.live.rules import rules_from_text
from tapetum.live.state import State
from tapetum.record.drawn_room import DrawnRoom
from tapetum.record.source import Frame
from tapetum.track import Detections


def test_the_rooms_cameras_are_found_and_neither_its_lamp_nor_its_mirror(some_seconds: list[Frame]) -> None:
    watch = watched(lambda: Scripted(some_seconds))
    events = watch.log.events()
    assert [(one["kind"], one["picture"]) for one in events] == [
        *[("seen", True)] * 2,
        ("source ended", False),
        *[("gone", False)] * 2,
    ]
    assert watch.state.health.delay >= 0
    for one in events[:2]:
        place = one["after"]["x"], one["after"]["y"]
        assert any(math.dist(place, at) < 20 for at in DrawnRoom().places(1.0)), place
    assert watch.state.health.frames == 36 and watch.state.health.ended
    assert watch.state.size == (640, 480)
    number, picture = watch.picture()
    decoded = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert number == 35 and decoded is not None and decoded.shape == (480, 640)


def test_an_ignored_place_stays_ignored_in_the_next_watch(some_seconds: list[Frame], tmp_path: Path) -> None:
    log = Log(tmp_path / "log.db")
    log.ignore(Ignored(170, 150, 40))
    seen = [one for one in watched(lambda: Scripted(some_seconds), log=log).log.events() if one["kind"] == "seen"]
    assert len(seen) == 1 and seen[0]["after"]["x"] > 400


@pytest.mark.parametrize("fault", ["another size", "black", "white", "16 bit"])
def test_a_strange_frame_does_not_end_the_watch(some_seconds: list[Frame], fault: str) -> None:
    strange = {
        "another size": np.zeros((100, 120), np.uint8),
        "black": np.zeros((480, 640), np.uint8),
        "white": np.full((480, 640), 255, np.uint8),
        "16 bit": np.full((480, 640), 9000, np.uint16),
    }[fault]
    frames = [*some_seconds[:20], *(replace(one, image=strange) for one in some_seconds[20:22]), *some_seconds[22:]]
    watch = watched(lambda: Scripted([replace(one, full_scale=None) for one in frames]))
    events = [one for one in watch.log.events() if one["id"] != "source"]
    ids = {one["id"] for one in events}
    # A camera whose size changes may make its stays begin again; nothing that is none may appear.
    assert sum(one["kind"] == "gone" for one in events) == len(ids) <= 4
    assert watch.state.health.frames + (watch.state.health.fault != "") >= 34
    assert {one["kind"] for one in events[-2:]} == {"gone"}


def test_a_model_that_fails_is_shown_as_a_fault_and_the_frames_go_on(some_seconds: list[Frame]) -> None:
    class Failing:
        target_names = ("gaze_x",)
        calls = 0

        def predict(self, crops: np.ndarray, full_scale: float) -> None:
            self.calls += 1
            if self.calls < 3:
                raise RuntimeError("out of memory")
            raise RuntimeError("still")

    failing = Failing()
    watch = watched(lambda: Scripted(some_seconds[:12]), models=[failing])
    assert failing.calls >= 3 and watch.state.health.fault == "still" and watch.state.health.ended


def test_what_is_no_model_is_refused_before_the_watch_begins(some_seconds: list[Frame]) -> None:
    with pytest.raises(InputError, match=r"models\[0\]: has no predict: object"):
        watched(lambda: Scripted(some_seconds[:2]), models=[object()])


class States:
    """A listener that keeps the numbers of the frames, and may do something at each."""

    def __init__(self, each: Callable[[int], object] = lambda number: None) -> None:
        self.numbers: list[int] = []
        self.each = each

    def event(self, event: Event) -> None:
        return

    def state(self, state: State) -> None:
        if not state.health.ended:
            self.numbers.append(state.frame)
            self.each(state.frame)

    def close(self) -> None:
        return


def test_the_next_frame_is_searched_while_the_one_before_is_read(
    some_seconds: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each waits for the other; one after another they would wait for ever."""
    both = threading.Barrier(2, timeout=5)

    def find(frame: Frame) -> Detections:
        if frame.index:
            both.wait()
        return Detections.empty()

    monkeypatch.setattr("tapetum.live.loop.make_detector", lambda name: find)
    states = States(lambda number: both.wait() if number < 11 else None)
    watch = watched(lambda: Scripted(some_seconds[:12]), listeners=[states])
    assert states.numbers == list(range(12)) and watch.state.health.fault == ""


def test_a_fault_loses_its_frame_and_not_the_one_that_waits_behind_it(some_seconds: list[Frame]) -> None:
    def fails(number: int) -> None:
        if number == 5:
            raise RuntimeError("failed")

    states = States(fails)
    watch = watched(lambda: Scripted(some_seconds[:12]), listeners=[states])
    assert states.numbers == list(range(12)) and watch.state.health.fault == "failed"


def test_a_full_disk_stops_the_log_and_not_the_watch(some_seconds: list[Frame], tmp_path: Path) -> None:
    log = Log(tmp_path / "log.db")
    log._base.execute(f"PRAGMA max_page_count={log._base.execute('PRAGMA page_count').fetchone()[0]}")
    while not log.fault:
        log.add(Event("a", "new", "seen", 1), b"x")
    before = log.newest
    told: list[Event] = []

    class Hears:
        def event(self, event: Event) -> None:
            told.append(event)

        def state(self, state: State) -> None: ...

        def close(self) -> None: ...

    guard = Guard(rules_from_text("schema: tapetum/rules/1\nrules: [{name: here}]"))
    watch = Watch(lambda: Scripted(some_seconds), mode="all", log=log, listeners=[Hears()], guard=guard)
    modes = Modes(watch)
    watch.start()
    assert watch.join(60)
    assert "the log cannot be written (database or disk is full)" in watch.state.health.fault
    assert watch.state.health.frames == 36 and len(told) == 7
    # The page has them too, each with its picture.
    assert len(log.events(after=before)) == 7
    alerts = modes.desk.state().alerts
    assert [one.rule for one in alerts] == ["here"] * 2 and all(log.picture(one.number) for one in alerts)


def test_a_receiver_that_is_down_is_named_with_its_losses(some_seconds: list[Frame]) -> None:
    class Down(Queued):
        def send_event(self, event: Event) -> None:
            raise OSError("nobody answers")

    down = Down("osc://there:9000")
    down.start()
    watch = watched(lambda: Scripted(some_seconds), listeners=[down])
    assert watch.state.health.frames == 36
    down.close()
    assert down.counts.failed == 5
    watch._set_state(0)
    assert watch.state.health.receivers == ("osc://there:9000: 5 messages lost (nobody answers)",)


def test_a_camera_that_is_unplugged_for_a_moment_is_told_and_its_stay_goes_on_or_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("tapetum.live.acquire._RETRY", (0.01, 0.02))
    opened: list[Scripted] = []

    def opens() -> Scripted:
        if len(opened) == 3:
            # The end of the test: what is stored ends the watch.
            opened.append(Scripted([]))
        else:
            opened.append(Scripted(room_frames(0.2), live=True, fault=OSError("unplugged")))
        return opened[-1]

    watch = watched(opens)
    kinds = [(one["kind"], one["detail"]) for one in watch.log.events() if one["id"] == "source"]
    assert kinds[:3] == [("source lost", "unplugged"), ("source returned", "scripted"), ("source lost", "unplugged")]
    assert all(one.closed.is_set() for one in opened[:3])
