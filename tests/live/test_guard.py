"""The guard: an hour of scripted events, and its rules in a watch."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from tests.live.conftest import Scripted, watched

from tapetum.errors import InputError
from tapetum.live.events import Events
from tapetum.live.guard import Guard
from tapetum.live.rules import load_rules, rules_from_text
from tapetum.live.state import Health, State
from tapetum.record.source import Frame
from tapetum.track.detections import Detections
from tapetum.track.rows import TrackedFrame, TrackRow

HEAD = "schema: tapetum/rules/1\n"
RULES = """schema: tapetum/rules/1
regions: {model: [-0.2, -0.2, 0.2, 0.2]}
rules:
  - {name: here, cooldown: 0 s}
  - {name: looks, when: {looks_at: model}, cooldown: 0 s}
"""
RATE, EVENTS, MISSED, NOISE = 10.0, 200, 0.1, 0.02


def test_an_hour_of_scripted_events_is_found_within_a_second_with_at_most_one_false_alert() -> None:
    """Tracks, not films: noise of the gaze, missed detections, and false tracks of some frames."""
    rng = np.random.default_rng(20261124)
    watch, guard = Events(rules_from_text(RULES).areas()), Guard(rules_from_text(RULES))
    # Every 36 s a camera comes for 20 s, and looks at the model for 8 s of these: two events.
    starts = 36.0 * np.arange(EVENTS // 2) + rng.uniform(2, 8, EVENTS // 2)
    due = [(start, "here") for start in starts] + [(start + 6, "looks") for start in starts]
    said: list[tuple[float, str]] = []
    false_until, false_track, nothing = -1.0, 1000, Detections.empty()
    for k in range(round(3600 * RATE)):
        time, rows = k / RATE, []
        for n in np.flatnonzero((starts <= time) & (time < starts + 20)).tolist():
            gaze = (0.0 if 6 <= time - starts[n] < 14 else 0.4) + rng.normal(0, NOISE)
            rows.append(row(k, time, n + 1, bool(rng.random() > MISSED), gaze))
        if rng.random() < 0.005:
            false_until, false_track = time + 0.3, false_track + 1
        if time < false_until:
            rows.append(row(k, time, false_track, True, 0.0))
        events = watch.update(TrackedFrame(k, time, "", tuple(rows), nothing, ()), round(time * 1e9))
        state = State("", k, round(time * 1e9), (640, 480), watch.cameras, Health())
        said += [(time, alert.rule) for alert in guard.update(state, events)]
    found = [
        next((one for one in said if one[1] == rule and 0 <= one[0] - at <= 1.0), None) for at, rule in due
    ]  # fmt: skip
    assert None not in found
    assert len(said) - EVENTS <= 1


def row(k: int, time: float, track: int, seen: bool, gaze: float) -> TrackRow:
    told = {"gaze_x": gaze, "gaze_y": 0.0, "applies": True} if seen else {}
    place = (50.0 + 10 * track, 40.0, 9.0 if seen else None, 50.0, 40.0, 5.0)
    return TrackRow(k, time, "", track, *place, seen, estimates=told)


def test_alerts_of_a_watch_are_events_and_go_to_whom_the_rule_names(some_seconds: list[Frame]) -> None:
    class Hears:
        def __init__(self, name: str) -> None:
            self.name, self.kinds = name, []

        def event(self, event) -> None:
            self.kinds.append(event.kind)

        def state(self, state: State) -> None: ...

        def close(self) -> None: ...

    one, other = Hears("one"), Hears("other")
    rules = rules_from_text(HEAD + "rules: [{name: here, tell: [one]}]")
    watch = watched(lambda: Scripted(some_seconds), guard=Guard(rules), listeners=[one, other])
    alerts = [event for event in watch.log.events() if event["kind"] == "alert"]
    assert [(event["detail"], event["picture"]) for event in alerts] == [("here", True)] * 2
    assert one.kinds.count("alert") == 2 and "alert" not in other.kinds and "seen" in other.kinds


def test_quiet_hours_hold_back_and_tell_at_their_end() -> None:
    guard = Guard(rules_from_text(HEAD + 'rules: [{name: here}]\nquiet: [{from: "22:00", to: "06:00"}]'))
    camera = watched_camera()
    at = lambda hour: State("", 0, round(hour * 3600e9), (1, 1), (camera,), Health())  # noqa: E731
    assert guard.update(at(23.0)) == [] == guard.update(at(29.9))
    assert [one.rule for one in guard.update(at(30.1))] == ["here"]
    assert guard.update(at(30.2)) == []


def watched_camera():
    events = Events(confirm=0.0)
    for k in range(2):
        frame = TrackedFrame(k, k / 10, "", (row(k, k / 10, 1, True, math.nan),), Detections.empty(), ())
        events.update(frame, k)
    return events.cameras[0]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("rules: []", "rules"),
        ("rules: [{name: a}, {name: a}]", "two rules are named 'a'"),
        ("rules: [{name: a, when: {looks_at: door}}]", "looks at 'door', which is no region"),
        ("rules: [{name: a, hold: -1 s}]", "hold"),
        ("rules: [{name: a}]\ntime_zone: Mars/Base", "Mars/Base"),
        ("rules: [{name: a}]\nregions: {door: [1, 0, 0, 1]}", "'door' encloses nothing"),
        ("rules: [{name: a, sound: loud}]", "sound"),
        ("more: 3", "rules"),
    ],
)
def test_bad_rules_name_file_and_field(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "guard.yaml"
    path.write_text(HEAD + text)
    with pytest.raises(InputError) as raised:
        load_rules(path)
    assert complaint in str(raised.value) and "guard.yaml" in str(raised.value)


def test_a_rule_that_tells_nobody_there_is_refused() -> None:
    with pytest.raises(InputError, match=r"there is no output 'pager'"):
        rules_from_text(HEAD + "rules: [{name: a, tell: [pager]}]").check_outputs({"osc"})
