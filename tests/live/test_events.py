"""Events: what is told, when, and what is not."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.live.events import Event, Events, Ignored, Region
from tapetum.track.cameras import CameraDetector
from tapetum.track.detections import Detections
from tapetum.track.rows import TrackedFrame, TrackRow

STEP = 0.125  # exact in binary, so that limits fall on frames


def row(k: int, track: int = 1, *, seen: bool = True, active: bool | None = None, **estimates: Any) -> TrackRow:
    return TrackRow(
        k, k * STEP, "", track, 50.0, 40.0, 9.0 if seen else None, 50.0, 40.0, 5.0, seen, active=active,
        estimates=estimates,
    )  # fmt: skip


def told(events: Events, rows: list[list[TrackRow]], start: int = 0, step: float = STEP) -> list[tuple[int, str, str]]:
    said = []
    for k, one in enumerate(rows, start):
        frame = TrackedFrame(k, k * step, "", tuple(one), Detections.empty(), ())
        said += [(k, event.kind, event.detail) for event in events.update(frame, k)]
    return said


def test_a_camera_is_told_of_once_it_was_followed_for_a_while_and_once_it_is_gone() -> None:
    events = Events()
    rows = [[row(k)] for k in range(20)] + [[] for _ in range(15)]
    assert told(events, rows) == [(4, "seen", ""), (28, "gone", "")]


def test_what_is_seen_for_a_moment_is_never_told_of() -> None:
    assert told(Events(), [[row(k)] for k in range(4)] + [[] for _ in range(30)]) == []


def moved(one: TrackRow, x: float) -> TrackRow:
    return replace(one, x=x, peak_x=x)


def test_two_reflections_that_a_track_joins_are_no_camera() -> None:
    """One for four frames, another for three, after two frames without; only then it stays."""
    rows = [[row(k, seen=k not in (4, 5))] for k in range(6)] + [[moved(row(k), 200.0)] for k in range(6, 12)]
    assert told(Events(), rows[:9]) == []
    assert told(Events(), rows) == [(10, "seen", "")]


def test_a_camera_that_the_track_of_a_reflection_takes_is_told_of_as_soon_as_any() -> None:
    rows = [[row(k, seen=k < 3 or k >= 9)] for k in range(16)]
    assert told(Events(), rows) == [(13, "seen", "")]


def test_a_camera_counts_from_when_it_was_first_detected() -> None:
    """The tracker gives a number to what persisted only."""
    rows = [[] for _ in range(2)] + [[replace(row(k), event="begun" if k == 2 else "", since=0.0)] for k in range(2, 9)]
    assert told(Events(), rows) == [(4, "seen", "")]
    # A track that goes on after its stay ended shows another camera.
    assert told(Events(), [[replace(row(k), since=0.0)] for k in range(20, 30)], 20) == [(24, "seen", "")]


def test_the_detections_that_gave_a_track_its_number_count_for_a_new_camera() -> None:
    """It is hidden right after them."""
    lately = (False, False, True, True, True)
    rows = [[] for _ in range(2)] + [[replace(row(2), event="begun", since=0.0, lately=lately)]]
    rows += [[row(k, seen=k > 5)] for k in range(3, 12)]
    assert told(Events(), rows) == [(7, "seen", "")]


def test_a_camera_that_is_hidden_as_it_comes_is_told_of_once_most_frames_show_it() -> None:
    lately = (True, False, False, True, True)
    rows = [[] for _ in range(4)] + [[replace(row(4), event="begun", since=0.0, lately=lately)]]
    rows += [[row(k, seen=k > 7)] for k in range(5, 14)]
    assert told(Events(), rows) == [(9, "seen", "")]


def test_a_camera_that_is_hidden_once_is_judged_by_the_other_frames() -> None:
    """Three frames show it, six hide it, and it is found at its place."""

    def said(seen: list[bool]) -> list[tuple[int, str, str]]:
        return told(Events(), [[replace(row(k, seen=one), time=k / 15)] for k, one in enumerate(seen)], step=1 / 15)

    assert said([k not in (*range(3, 9), 12) for k in range(20)]) == [(10, "seen", "")]
    # Not where no more than a reflection was seen that came back for a frame.
    assert said([k not in range(4, 9) for k in range(10)] + [False] * 20) == []


def test_a_camera_is_not_told_of_in_the_frame_in_which_it_seems_to_have_jumped() -> None:
    rows = [[moved(row(k), 200.0 if k == 4 else 50.0)] for k in range(8)]
    assert told(Events(), rows) == [(5, "seen", "")]
    # Where the probe turns every frame shows it somewhere else.
    assert told(Events(), [[moved(row(k), 40.0 * k)] for k in range(8)]) == [(4, "seen", "")]


def test_a_spot_before_a_reflection_elsewhere_makes_no_camera_of_it() -> None:
    """Before anything has a number, its track is taken to have jumped there."""
    tracker, events, happened = CameraDetector().tracker(), Events(), []
    for k in range(30):
        spots = [(27.0, 132.0)] if k == 5 else [(138.0, 405.0)] if 8 <= k < 13 else []
        frame = TrackedFrame.of(about(k), detections(spots), [{} for _ in spots], tracker)
        happened += [(k, one.kind) for one in events.update(frame, k)]
    assert happened == []


def test_a_camera_whose_track_a_reflection_took_goes_on_under_its_new_number() -> None:
    """A reflection begins beside it while it is missed, lasts three frames, and its track then coasts."""
    tracker, events, happened = CameraDetector().tracker(), Events(), []
    for k in range(60):
        spots = [(100.0, 300.0), *([] if k == 20 else [(300.0 + 0.4 * k, 200.0)])]
        spots += [(313.0, 204.0)] if k in (20, 21, 22) else []
        frame = TrackedFrame.of(about(k), detections(spots), [{} for _ in spots], tracker)
        happened += [(k, one.kind) for one in events.update(frame, k)]
    camera = next(one for one in events.cameras if one.y < 250)
    assert happened == [(7, "seen"), (7, "seen")]
    assert camera.track == 3 and camera.x == pytest.approx(323.6, abs=1)


def test_a_camera_goes_on_where_it_was_before_its_track_leapt_to_a_false_spot() -> None:
    """For one frame a false spot takes the track, which then coasts there: its last place is not the camera's."""
    rows = [[row(k)] for k in range(20)] + [[moved(row(20), 84.0)]]
    rows += [[moved(row(k, seen=False), 84.0), row(k, 2)] for k in range(21, 36)]
    assert told(Events(), rows) == [(4, "seen", "")]


def test_a_camera_that_moved_far_and_stayed_there_is_not_the_one_that_comes_where_it_was() -> None:
    rows = [[row(k)] for k in range(20)] + [[moved(row(k), 84.0)] for k in (20, 21)]
    rows += [[moved(row(k, seen=False), 84.0), row(k, 2)] for k in range(22, 28)]
    assert told(Events(), rows) == [(4, "seen", ""), (26, "seen", "")]


def test_a_second_camera_beside_one_that_is_seen_is_told_of() -> None:
    events = Events()
    rows = [[row(k), *([moved(row(k, 2), 60.0)] if k >= 10 else [])] for k in range(20)]
    assert told(events, rows) == [(4, "seen", ""), (14, "seen", "")]
    assert [one.track for one in events.cameras] == [1, 2]


def about(k: int) -> dict[str, Any]:
    return {"frame": k, "time": k / 15, "name": "", "moment": {}}


def detections(spots: list[tuple[float, float]]) -> Detections:
    x, y = np.array(spots).reshape(-1, 2).T
    known = {"x": x, "y": y, "peak_x": x, "peak_y": y, "peak": 0 * x + 100, "snr": 0 * x + 12, "diameter": 0 * x + 6}
    return Detections.of({**dict.fromkeys(Detections.names(), 0 * x), **known, "evidence": 0 * x + 1})


def test_one_estimate_far_off_at_its_beginning_does_not_put_a_change_off() -> None:
    events = Events([Region("screen", 0.2, -0.1, 0.4, 0.1)])
    rows = [[row(k, **gaze(0.3 if k >= 10 and k != 12 else 0.0))] for k in range(20)]
    assert told(events, rows) == [(4, "seen", ""), (14, "looks", "screen")]


def test_an_estimate_far_off_as_the_second_does_not_put_a_change_off() -> None:
    events = Events([Region("screen", 0.2, -0.1, 0.4, 0.1)])
    rows = [[row(k, **gaze(0.3 if k >= 10 and k != 11 else 0.0))] for k in range(20)]
    assert told(events, rows) == [(4, "seen", ""), (14, "looks", "screen")]


def test_a_change_that_is_certain_need_not_last() -> None:
    rows = [[replace(row(k, active=True if k >= 8 else None), certain=k == 8)] for k in range(12)]
    assert told(Events(), rows) == [(4, "seen", ""), (8, "imaging", "")]


def test_an_event_of_a_change_has_the_camera_before_and_after() -> None:
    events = Events()
    made: list[Event] = []
    for k in range(30):
        frame = TrackedFrame(k, k * STEP, "", (row(k, active=k >= 15),), Detections.empty(), ())
        made += events.update(frame, k)
    new, off, on = made
    assert (new.type, new.before, off.kind, on.type, on.kind) == ("new", None, "not imaging", "update", "imaging")
    assert on.id == new.id and on.before is not None and on.after is not None
    assert (on.before.active, on.after.active) == (False, True)
    assert on.as_json()["schema"] == "tapetum/event/1"


def test_a_state_that_flickers_is_not_told_of() -> None:
    rows = [[row(k, active=True)] for k in range(20)] + [[row(k, active=bool(k % 3))] for k in range(20, 60)]
    assert told(Events(), rows) == [(4, "seen", ""), (6, "imaging", "")]


def gaze(x: float) -> dict[str, Any]:
    return {"gaze_x": x, "gaze_x_low": x - 0.01, "gaze_x_high": x + 0.01, "gaze_y": 0.0, "applies": True}


def test_a_gaze_in_a_region_is_told_of_and_one_where_the_model_does_not_apply_is_not() -> None:
    events = Events([Region("screen", 0.2, -0.1, 0.4, 0.1)])
    rows = [[row(k, **gaze(0.0))] for k in range(10)] + [[row(k, **gaze(0.3))] for k in range(10, 30)]
    assert told(events, rows) == [(4, "seen", ""), (14, "looks", "screen")]
    assert events.cameras[0].regions == ("screen",)
    assert events.cameras[0].gaze_x == pytest.approx((0.3, 0.29, 0.31))
    strange = [[row(k, **{**gaze(0.0), "applies": False})] for k in range(30, 50)]
    assert told(events, strange, 30) == []
    assert events.cameras[0].gaze_x is None


def test_nothing_is_told_of_an_ignored_camera_and_one_that_was_told_of_ends() -> None:
    events = Events()
    assert told(events, [[row(k), row(k, 2, device="ours")] for k in range(8)]) == [(4, "seen", ""), (4, "seen", "")]
    events.ignored = (Ignored(device="ours"),)
    both = [[row(k), row(k, 2, device="ours")] for k in range(8, 30)]
    assert told(events, both, 8) == [(8, "gone", "")]
    assert Ignored(48, 41, 5).holds(events.cameras[0]) and not Ignored(58, 41, 5).holds(events.cameras[0])


def test_one_wild_estimate_does_not_put_a_change_off_and_many_do() -> None:
    events = Events([Region("screen", 0.2, -0.1, 0.4, 0.1)], hold=1.0)
    where = [0.0] * 8 + [0.3 if k != 5 else -0.4 for k in range(20)]
    assert told(events, [[row(k, **gaze(x))] for k, x in enumerate(where)]) == [
        (4, "seen", ""),
        (16, "looks", "screen"),
    ]
    events = Events([Region("screen", 0.2, -0.1, 0.4, 0.1)], hold=1.0)
    where = [0.0] * 8 + [0.3 if k % 3 else -0.4 for k in range(40)]
    assert told(events, [[row(k, **gaze(x))] for k, x in enumerate(where)]) == [(4, "seen", "")]


def test_a_glint_that_comes_back_is_no_camera() -> None:
    """Its track coasts between two flashes: it was followed for a while, and hardly seen."""
    rows = [[row(k, seen=k < 2 or k >= 7)] for k in range(9)] + [[] for _ in range(20)]
    assert told(Events(), rows) == []


def test_a_model_that_knows_no_device_names_none() -> None:
    events = Events()
    rows = [[row(k, device="none of these", device_probability=float("nan"))] for k in range(20)]
    assert told(events, rows) == [(4, "seen", "")]
    assert events.cameras[0].device is None and events.cameras[0].device_probability is None


@pytest.mark.parametrize("name", ["confirm", "hold", "cooldown", "gone"])
def test_a_time_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: must be 0 or more seconds, is nan"):
        Events(**{name: float("nan")})  # pyright: ignore[reportArgumentType]


def test_a_region_that_encloses_nothing_is_refused() -> None:
    with pytest.raises(InputError, match=r"region door: left 0\.4, right 0\.2"):
        Region("door", 0.4, 0, 0.2, 1)
