"""The modes of the page: what they make of states and events, and what they keep when something fails."""

from __future__ import annotations

import datetime as dt
import json
import math
import resource
import time
from dataclasses import replace
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from tests.live.conftest import Scripted, watched

from tapetum.errors import InputError
from tapetum.live.events import Event, Region
from tapetum.live.guard import Guard
from tapetum.live.log import Log
from tapetum.live.modes import Modes
from tapetum.live.modes.desk import Desk
from tapetum.live.modes.exhibit import Exhibit
from tapetum.live.modes.poll import Poll
from tapetum.live.pointer import Screen
from tapetum.live.rules import rules_from_text
from tapetum.live.state import CameraState, Health, State
from tapetum.live.vote import Ballot, read_votes
from tapetum.record.source import Frame

SCREEN = Screen(1600, 900, 1.2, 2.0)
BALLOT = Ballot("Which?", (Region("left", 0.02, -0.5, 0.45, 0.5), Region("right", -0.45, -0.5, -0.02, 0.5)), dwell=0.5)
BASE = 1_750_000_000_000_000_000


def state(seconds: float, *gazes: tuple[float, float], old: float = 0.0) -> State:
    """A state in which cameras look so, estimated `old` seconds ago."""
    now = BASE + round(seconds * 1e9)
    cameras = tuple(
        CameraState(
            f"c{k}", k, 100, 100, 9, True, BASE, now, gaze_x=(x, x - 0.01, x + 0.01), gaze_y=(y, y - 0.01, y + 0.01),
            estimated_utc_ns=now - round(old * 1e9),
        )
        for k, (x, y) in enumerate(gazes)
    )  # fmt: skip
    return State("test", round(seconds * 20), now, (640, 480), cameras, Health())


def looking(mark: tuple[float, float], rng: np.random.Generator) -> tuple[float, float]:
    """The gaze of a camera that points at a mark, turned a little, with noise."""
    x, y = -0.7 * (mark[0] - 0.5), -0.5 * (mark[1] - 0.5)
    x, y = x * math.cos(0.1) - y * math.sin(0.1), x * math.sin(0.1) + y * math.cos(0.1)
    return (x + 0.002 * rng.standard_normal(), y + 0.002 * rng.standard_normal())


def calibrated(exhibit: Exhibit, marks: int, rng: np.random.Generator, begin: float = 0.0) -> float:
    """Look at every mark in turn; return the seconds that took."""
    exhibit.begin(SCREEN, marks)
    at = (0.5, 0.5)
    for k in range(1000):
        exhibit.update(state(begin + k / 15, looking(at, rng)))
        step = exhibit.state().step
        if step is None or step.mark is None:
            return k / 15
        at = step.mark
    raise AssertionError("the calibration did not end")


@pytest.mark.parametrize(("marks", "longest"), [(4, 9.0), (9, 20.0)])
def test_a_calibration_takes_less_than_twenty_seconds_and_the_pointer_follows(
    tmp_path: Path, marks: int, longest: float
) -> None:
    rng = np.random.default_rng(1)
    exhibit = Exhibit(tmp_path / "pointer.json")
    assert calibrated(exhibit, marks, rng) <= longest
    made = exhibit.state()
    assert made.calibrated and made.error is not None and made.degrees is not None and not made.fault
    assert made.error < 25 and made.degrees == pytest.approx(SCREEN.degrees(made.error))
    for k in range(30):
        exhibit.update(state(40 + k / 15, looking((0.8, 0.3), rng)))
    (point,) = exhibit.state().pointers
    assert math.hypot(point.x - 0.8, point.y - 0.3) < 0.02 and point.inside
    # Another server reads what this one kept.
    again = Exhibit(tmp_path / "pointer.json").state()
    assert again.calibrated and again.error == pytest.approx(made.error)
    exhibit.forget()
    assert not exhibit.state().calibrated and not (tmp_path / "pointer.json").exists()


def test_a_calibration_that_fails_says_why_and_the_earlier_one_stays() -> None:
    rng = np.random.default_rng(2)
    exhibit = Exhibit()
    with pytest.raises(InputError, match="one mark shifts a calibration"):
        exhibit.begin(SCREEN, 1)
    calibrated(exhibit, 4, rng)
    error = exhibit.state().error
    # The camera moves along a line only.
    exhibit.begin(SCREEN, 4)
    for k in range(600):
        exhibit.update(state(100 + k / 15, (0.2 * (k // 40 % 2), 0.0)))
    now = exhibit.state()
    assert "the gaze changed by" in now.fault and now.calibrated and now.error == error
    with pytest.raises(InputError, match="the screen has changed"):
        exhibit.begin(Screen(800, 600), 1)


def test_gazes_of_earlier_frames_are_counted_once() -> None:
    """With models by turns a state repeats an estimate: it is no further sample, no voice, and points no longer."""
    exhibit, rng = Exhibit(), np.random.default_rng(3)
    calibrated(exhibit, 4, rng)
    exhibit.begin(SCREEN, 4)
    for k in range(100):
        one = state(60 + k / 15, (0.1, 0.1))
        cameras = tuple(replace(camera, estimated_utc_ns=BASE) for camera in one.cameras)
        exhibit.update(replace(one, cameras=cameras))
    step = exhibit.state().step
    assert step is not None and step.number == 1
    exhibit.cancel()
    assert exhibit.state().pointers == ()
    poll = Poll()
    poll.begin(BALLOT)
    for k in range(40):
        poll.update(state(k / 10, (0.2, 0.0), old=0.3), ())
    assert poll.state().voices == {"left": 0, "right": 0}


def test_a_vote_is_counted_kept_and_replayed(tmp_path: Path) -> None:
    poll = Poll(tmp_path)
    assert poll.state().ballot is None and poll.replayed() == []
    poll.begin(BALLOT)
    for k in range(20):
        poll.update(state(k / 10, (0.2, 0.0), (-0.2, 0.1)), ())
    now = poll.state()
    assert now.is_open and now.voices == {"left": 1, "right": 1} and now.given == {"c0": "left", "c1": "right"}
    for k in range(20, 30):
        poll.update(state(k / 10, (-0.2, 0.0), (-0.2, 0.1)), ())
    poll.end()
    for k in range(30, 60):
        poll.update(state(k / 10, (0.2, 0.0)), ())
    now = poll.state()
    assert not now.is_open and now.voices == {"left": 0, "right": 2} and now.changes == 3
    assert [one.voices for one in poll.replayed()][-1] == {"left": 0, "right": 2}
    ballot, voices = read_votes(tmp_path / now.file)
    assert ballot == BALLOT and [one.zone for one in voices] == ["left", "right", "right"]


def test_a_full_disk_ends_the_votes_file_and_not_the_vote(tmp_path: Path) -> None:
    poll = Poll(tmp_path)
    poll.begin(BALLOT)
    path = tmp_path / poll.state().file
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with pytest.MonkeyPatch.context() as patch:
            import signal

            patch.setattr(signal, "SIGXFSZ", signal.SIGXFSZ)
            old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 100, before[1]))
            for k in range(200):
                poll.update(state(k / 10, (0.2 if k // 10 % 2 else -0.2, 0.0)), ())
            signal.signal(signal.SIGXFSZ, old)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    now = poll.state()
    assert "the vote is kept no longer" in now.fault and now.changes > 5
    # What was written before can be read.
    assert len(read_votes(path)[1]) >= 1


# A day that is neither today nor tomorrow, so that no quiet hour silences what the tests wait for.
DAY = (dt.datetime.now(ZoneInfo("Europe/Berlin")) + dt.timedelta(days=3)).strftime("%a").lower()
RULES = f"""
schema: tapetum/rules/1
time_zone: Europe/Berlin
quiet: [{{from: "08:00", to: "18:00", days: [{DAY}]}}]
rules:
  - {{name: a camera is here, cooldown: 0 s, tell: [pager]}}
  - {{name: it images, when: {{imaging: true, not_device: [phone-03]}}, quiet: []}}
"""


def test_the_desk_shows_rules_and_alerts_until_they_are_acknowledged(some_seconds: list[Frame], tmp_path: Path) -> None:
    guard = Guard(rules_from_text(RULES))
    log = Log(tmp_path / "log.db")
    desks: list[Desk] = []

    class Hears:
        name, hears_all = "page", True

        def event(self, event: Event) -> None:
            desks[0].event(event)

        def state(self, state: State) -> None:
            desks[0].update(state)

        def close(self) -> None: ...

    desks.append(Desk(guard, log))
    watched(lambda: Scripted(some_seconds), log=log, guard=guard, listeners=[Hears()])
    now = desks[0].state()
    assert now.waiting == 2 and [one.rule for one in now.alerts] == ["a camera is here"] * 2
    assert not now.alerts[0].holds and now.alerts[0].picture
    first, second = now.rules
    assert first.hours == (f"08:00 to 18:00, {DAY}",) and first.tell == ("pager",)
    assert second.when == "a camera is here, it is taken for something else than phone-03, it images"
    assert not second.quiet_now and now.local and now.time_zone == "Europe/Berlin"
    desks[0].acknowledge(now.alerts[0].number, 5)
    with pytest.raises(InputError, match="there is no alert 1"):
        desks[0].acknowledge(1, 6)
    assert desks[0].state().waiting == 1 and desks[0].state().alerts[0].acknowledged_utc_ns == 5
    # A server that is started again knows it.
    log.close()
    again = Desk(guard, Log(tmp_path / "log.db"))
    assert again.state().waiting == 1
    again.acknowledge(None, 7)
    assert again.state().waiting == 0
    assert {one.acknowledged_utc_ns for one in again.state().alerts} == {5, 7}


def test_the_page_hears_alerts_that_rules_tell_to_others_only(some_seconds: list[Frame], tmp_path: Path) -> None:
    from tapetum.live.loop import Watch

    watch = Watch(lambda: Scripted(some_seconds), mode="all", guard=Guard(rules_from_text(RULES)))
    modes = Modes(watch, tmp_path)
    watch.start()
    assert watch.join(60)
    assert modes.now().guard.waiting == 2
    told = json.loads(modes.text())
    assert told["type"] == "modes" and told["guard"]["waiting"] == 2 and told["hands"] == 0
    assert modes.text() is modes.text()
    time.sleep(0.05)
    assert modes.text() is modes.text()
    watch.close()
