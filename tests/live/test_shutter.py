"""A shutter that opens: on a film of the virtual bench, from the frames to the event, its alert and who is told."""

from __future__ import annotations

import json

import pytest
from tests.live.conftest import Scripted, watched

from tapetum.bench import load_scene, with_values
from tapetum.errors import InputError
from tapetum.live.events import Event, Events
from tapetum.live.guard import Guard
from tapetum.live.modes.desk import Desk
from tapetum.live.outputs.home_assistant import discovery
from tapetum.live.rules import rules_from_text
from tapetum.live.state import State
from tapetum.record.imaging import Imaging
from tapetum.record.motion import HandMotion
from tapetum.record.session import Session
from tapetum.record.shot import Shot
from tapetum.simulate.phone import phone_scenes
from tapetum.track import Detections
from tapetum.track.rows import TrackedFrame, TrackRow

RULES = "schema: tapetum/rules/1\nrules: [{name: a picture is taken, when: {shutter: opened}, cooldown: 0 s}]"
CLOSES, OPENS, SECONDS = 0.8, 2.2, 3.4


class Hears:
    def __init__(self) -> None:
        self.events: list[Event] = []

    def event(self, event: Event) -> None:
        self.events.append(event)

    def state(self, state: State) -> None: ...

    def close(self) -> None: ...


def test_a_shutter_that_opens_on_the_bench_is_an_event_of_that_moment_and_an_alert() -> None:
    changes = {"target.name": "phone-01", "illumination.wavelength": "640 nm", "probe.sensor.pixels": [240, 240]}
    phone = with_values(load_scene("phones"), {**changes, "sampling.accuracy": 0.3})
    own = next(unit for unit in phone_scenes(phone) if unit.place == (0.0, 0.0))
    imaging = Imaging((CLOSES, OPENS), at_first=True)
    film = Shot(own.scene, Session(SECONDS, 10.0, 7, imaging=imaging, motion=HandMotion(extent=0.05)))
    frames, hears = list(film.cameras["probe"]), Hears()
    guard = Guard(rules_from_text(RULES))
    options = {"detector": "spots", "activity": True, "guard": guard, "listeners": [hears]}
    watch = watched(lambda: Scripted(frames), **options)
    told = [one for one in hears.events if one.kind in ("imaging", "not imaging", "shutter opened", "alert")]
    # It imaged at first: nobody saw that shutter open.
    assert [one.kind for one in told] == ["imaging", "not imaging", "shutter opened", "alert", "imaging"]
    opened, alert = told[2], told[3]
    begin = watch.acquisition._utc
    # The first frame that showed it, and not the one in which it was noticed.
    assert (opened.utc_ns - begin) / 1e9 == pytest.approx(OPENS, abs=0.11)
    assert opened.type == "update" and opened.after is not None and opened.after.opened_utc_ns == opened.utc_ns
    assert alert.detail == "a picture is taken" and 0 < (alert.utc_ns - begin) / 1e9 - OPENS < 0.5
    written = json.loads(json.dumps(opened.as_json()))
    assert written["kind"] == "shutter opened" and written["after"]["opened_utc_ns"] == opened.utc_ns
    desk = Desk(guard, watch.log)
    desk.update(watch.state)
    assert "its shutter opens" in desk.state().rules[0].when


def row(k: int, opened: float | None = None) -> TrackedFrame:
    one = TrackRow(k, k / 8, "", 1, 50.0, 40.0, 9.0, 50.0, 40.0, 5.0, True, active=True, opened=opened)
    return TrackedFrame(k, k / 8, "", (one,), Detections.empty(), ())


def test_openings_within_the_cooldown_are_one() -> None:
    events = Events()
    times = {8: 0.875, 10: 1.125, 24: 2.75}
    told = [(k, one.utc_ns) for k in range(40) for one in events.update(row(k, times.get(k)), k * 125_000_000)
            if one.kind == "shutter opened"]  # fmt: skip
    assert told == [(8, 875_000_000), (24, 2_750_000_000)]


@pytest.mark.parametrize(
    ("rule", "complaint"),
    [
        ("{name: a, hold: 1 s, when: {shutter: opened}}", "leave hold out"),
        ("{name: a, when: {shutter: opened, imaging: true}}", "leave imaging out"),
        ("{name: a, when: {shutter: closed}}", "shutter"),
    ],
)
def test_a_moment_does_not_last(rule: str, complaint: str) -> None:
    with pytest.raises(InputError, match=complaint):
        rules_from_text(f"schema: tapetum/rules/1\nrules: [{rule}]")


@pytest.mark.parametrize(
    ("when", "remedy"),
    [
        ("{shutter: opened}", "add --activity"),
        ("{imaging: false}", "add --activity"),
        ("{looks_at: door}", "add a --model of gaze"),
        ("{not_device: phone-01}", "add a --model of devices"),
    ],
)
def test_a_rule_that_could_never_come_true_is_refused(when: str, remedy: str) -> None:
    text = f"schema: tapetum/rules/1\nregions: {{door: [-1, -1, 1, 1]}}\nrules: [{{name: a, when: {when}}}]"
    rules = rules_from_text(text)
    with pytest.raises(InputError, match=rf"guard\.yaml: rules\.0\.when: rule 'a' asks for .*{remedy}"):
        rules.check_abilities(False, (), "guard.yaml")
    rules.check_abilities(True, ("gaze_x", "gaze_y", "device"), "guard.yaml")


def test_home_assistant_knows_the_kind() -> None:
    _, content = discovery("tapetum")
    assert "shutter opened" in content["components"]["event"]["event_types"]
