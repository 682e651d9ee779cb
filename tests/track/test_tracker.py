"""Following spots whose motion is known."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from probe_frames import WIDTH, hot_pixels, probe_frame

from tapetum.errors import InputError
from tapetum.record.source import Frame
from tapetum.track import Detections, Tracker, detect, track

OUT_OF_RANGE: list[dict[str, Any]] = [
    {"gate": 0},
    {"noise": math.inf},
    {"ghost_radius": -1},
    {"max_coast": math.nan},
]


def spots(*places: tuple[float, ...], diameter: float = 20.0) -> Detections:
    """Return detections at (x, y) or (x, y, peak)."""
    full = [(*place, 100.0)[:3] for place in places]
    columns = {name: np.full(len(full), 10.0) for name in Detections.names()}
    columns |= {"x": np.array([p[0] for p in full]), "y": np.array([p[1] for p in full])}
    columns |= {"peak": np.array([p[2] for p in full]), "diameter": np.full(len(full), diameter)}
    columns["evidence"] = np.ones(len(full))
    return Detections.of(columns | dict.fromkeys(("ghost", "edge"), np.zeros(len(full), bool)))


def test_two_that_cross_keep_their_numbers():
    tracker, rng = Tracker(), np.random.default_rng(0)
    number, velocity = 0, (0.0, 0.0)
    for n in range(60):
        wobble = rng.normal(0, 0.3, 4)
        places = [
            (100 + 5 * n + wobble[0], 100 + 2 * n + wobble[1]),
            (400 - 5 * n + wobble[2], 220 - 2 * n + wobble[3]),
        ]
        order = [0, 1] if n % 2 else [1, 0]
        points = tracker.update(spots(*(places[k] for k in order)), n / 15)
        if n == 0:
            number = min(points, key=lambda point: point.x).track
        assert len(points) == 2
        mine = next(point for point in points if point.track == number)
        # Within a pixel of each other nobody can distinguish them; before and after they are themselves.
        assert math.dist((mine.x, mine.y), places[0]) < (2 if n == 30 else 1e-9)
        velocity = mine.vx, mine.vy
    assert velocity == pytest.approx((75, 30), abs=6)


def test_a_track_coasts_and_comes_back_by_its_number_whatever_the_gap_in_time():
    tracker = Tracker()
    times = [0.0, 0.07, 0.13, 0.2, 0.5, 0.52, 1.3, 1.4]  # jitter and lost frames
    unseen = {0.5, 0.52}
    for time in times:
        place = (100 + 90 * time, 200 - 40 * time)
        (point,) = tracker.update(spots() if time in unseen else spots(place), time)
        assert point.track == 1
        assert point.seen is (time not in unseen)
        assert math.dist((point.x, point.y), place) < 8


def test_a_track_ends_and_the_next_one_has_a_new_number():
    tracker = Tracker(max_coast=0.5)
    for n in range(10):
        tracker.update(spots((50, 60)), n / 10)
    alive = [len(tracker.update(spots(), 1 + n / 10)) for n in range(10)]
    assert alive == [1] * 5 + [0] * 5
    assert [point.track for point in tracker.update(spots((50, 60)), 3)] == [2]
    tracker.reset()
    assert [point.track for point in tracker.update(spots((50, 60)), 0)] == [1]


def test_what_was_seen_once_does_not_coast():
    tracker = Tracker()
    assert [point.seen for point in tracker.update(spots((50, 60)), 0.0)] == [True]
    assert tracker.update(spots(), 0.1) == []


def test_a_ghost_left_alone_neither_takes_the_track_nor_begins_one():
    tracker = Tracker()
    for n in range(10):
        tracker.update(spots((100 + n, 60, 200.0)), n / 15)
    for n in range(10, 15):
        (point,) = tracker.update(spots((160 + n, 80, 20.0)), n / 15)
        assert (point.track, point.seen) == (1, False)
    (point,) = tracker.update(spots((115, 60, 200.0), (175, 80, 20.0)), 1.0)
    assert (point.track, point.seen) == (1, True)
    assert len(Tracker(ghost_ratio=0).update(spots((115, 60, 200.0), (175, 80, 20.0)), 1.0)) == 2


def test_the_number_of_the_detection_counts_marked_ghosts_too():
    found = spots((10, 10), (300, 300))
    columns = {name: getattr(found, name) for name in Detections.names()} | {"ghost": np.array([True, False])}
    (point,) = Tracker().update(Detections.of(columns), 0.0)
    assert point.detection == 1 and point.x == 300


def test_bad_input_is_told():
    tracker = Tracker()
    tracker.update(spots(), 1.0)
    tracker.update(spots(), 1.0)
    for time in (0.9, math.nan):
        with pytest.raises(InputError, match="time"):
            tracker.update(spots(), time)
    for options in OUT_OF_RANGE:
        with pytest.raises(InputError, match=next(iter(options))):
            Tracker(**options)


def film(rng: np.random.Generator, fade: range, count: int = 100):
    """Yield frames of a camera that wanders, with its ghost, and its true place and brightness."""
    hot = hot_pixels(3)
    for n in range(count):
        x, y = 120 + 3.5 * n, 240 + 60 * math.sin(n / 12)
        width, height = 40 + 20 * math.sin(n / 9), 0.0 if n in fade else 110.0
        look = (0.3 * n, 0.4 + 0.02 * n)
        image = probe_frame(rng, [(x, y, width, height, *look), (x + 55, y + 18, width, 0.1 * height, *look)], hot)
        yield Frame(n, n / 15 + rng.uniform(0, 0.02), image), x, y


def test_one_camera_with_a_ghost_is_one_track_through_a_fade():
    fade = range(50, 60)
    filmed = list(film(np.random.default_rng(1), fade))
    assert max(x for _, x, _ in filmed) < WIDTH
    for tracked, (_, x, y) in zip(track([frame for frame, _, _ in filmed]), filmed, strict=True):
        (row,) = tracked.rows
        assert row.track == 1
        assert row.seen is (tracked.frame not in fade)
        off = math.dist((row.x, row.y), (x, y))
        assert off < (0.1 * row.diameter if row.diameter else 40)


def test_a_ghost_that_outlives_its_fading_spot_begins_no_track():
    """The spot leaves through the frame's edge while its ghost is still in view."""
    rng, numbers = np.random.default_rng(2), set()
    tracker = Tracker()
    for n in range(40):
        x = 560 + 3 * n
        image = probe_frame(rng, [(x, 200, 40, 200), (x - 60, 230, 40, 20)])
        numbers |= {point.track for point in tracker.update(detect(image), n / 15)}
    assert numbers == {1}


def test_numbers_are_never_used_twice():
    tracker, rng = Tracker(), np.random.default_rng(3)
    last: dict[int, int] = {}
    for n in range(80):
        places = [tuple(place) for place in rng.uniform(0, 600, (rng.integers(0, 4), 2))]
        for point in tracker.update(spots(*places), n / 15):
            assert n - last.get(point.track, n) <= 1
            last[point.track] = n
    assert sorted(last) == list(itertools.chain(range(1, max(last) + 1)))


def test_a_hand_that_turns_around_sharply_keeps_its_track():
    """Centroids of a hand-held target on the virtual bench: 26 pixels a frame upwards, stopped within eight frames."""
    path = [
        (371, 216), (378, 191), (385, 164), (390, 142), (393, 121), (395, 104), (394, 91), (390, 82),
        (384, 77), (376, 77), (364, 82), (351, 89), (335, 101), (318, 116), (301, 132), (284, 151),
    ]  # fmt: skip
    tracker = Tracker()
    numbers = {
        point.track for n, place in enumerate(path) for point in tracker.update(spots(place, diameter=60), n / 15)
    }
    assert numbers == {1}


def crossing(devices: bool) -> list[set[int]]:
    """The tracks that a phone and a webcam get, which look alike, meet on the way down, and turn back or go on."""
    tracker = Tracker(ghost_ratio=0, shake=0)
    got: list[set[int]] = [set(), set()]
    for n in range(60):
        # They bounce off each other at frame 30: by their motion alone each becomes the other.
        apart = 0.7 * abs(n - 30.5)
        places = [(300 - apart, 3.0 * n), (300 + apart, 3.0 * n)]
        columns = dict.fromkeys(Detections.names(), np.zeros(2))
        columns |= {"x": [p[0] for p in places], "y": [p[1] for p in places]}
        columns |= {"peak": np.full(2, 100.0), "diameter": np.full(2, 4.0), "evidence": np.ones(2)}
        # One answer in ten is wrong, and one in ten is none.
        said: list[str | None] = ["phone", "webcam"]
        said = said[::-1] if n % 10 == 5 else [None, None] if n % 10 == 7 else said
        for point in tracker.update(Detections.of(columns), n / 30, devices=said if devices else None):
            if point.detection is not None:
                got[point.detection].add(point.track)
    return got


def test_a_phone_does_not_become_another_camera():
    assert crossing(devices=False)[0] != {1}
    assert crossing(devices=True) == [{1}, {2}]


def test_a_wrong_answer_ends_no_track():
    tracker = Tracker()
    numbers = set()
    for n in range(30):
        columns = dict.fromkeys(Detections.names(), np.full(1, 50.0)) | {"ghost": np.zeros(1), "evidence": np.ones(1)}
        said: list[str | None] = ["phone" if n % 3 else "webcam"]
        numbers |= {point.track for point in tracker.update(Detections.of(columns), n / 30, devices=said) if point.seen}
    assert numbers == {1}


def test_a_track_that_could_be_anywhere_takes_no_spot_from_one_that_is_there():
    """A glint near a camera was seen three times; its track coasts, and the camera is missed once."""
    tracker = Tracker(ghost_ratio=0.0, persist=(3, 5))
    for n in range(40):
        # Its centroid errs a little in the frame after.
        camera = [] if n == 20 else [(500.0 - 8 * n / 15, 137.5 if n == 21 else 135.0)]
        glint = [(500.0, 193.0)] if 5 <= n < 8 else []
        points = tracker.update(spots(*camera, *glint, diameter=6.0), n / 15)
        if n > 2 and camera:
            assert [one.track for one in points if one.seen and one.y < 150] == [1], n


def test_weak_spots_continue_a_track_and_give_it_no_number():
    for plain, begins in (([], None), ([1, 4], None), ([1, 4, 5], 5), ([0, 1, 2], 2), ([0, 1, 5], None)):
        tracker = Tracker(ghost_ratio=0.0, persist=(3, 5))
        for n in range(12):
            points = tracker.update(replace(spots((50.0, 40.0)), evidence=np.array([n in plain])), n / 15)
            assert bool(points) == (begins is not None and n >= begins), (plain, n)
            assert all(one.seen and one.since == plain[0] / 15 for one in points)


def test_a_jump_to_a_glint_is_taken_back():
    """The only camera is missed in the frame in which a glint of its look appears elsewhere."""
    tracker = Tracker(ghost_ratio=0.0, persist=(3, 5))
    for n in range(30):
        camera = [] if n == 20 else [(140.0, 352.0)]
        glint = [(268.0, 302.0)] if 20 <= n < 24 else []
        points = tracker.update(spots(*camera, *glint, diameter=6.0), n / 15)
        if n > 21:
            assert [(one.track, round(one.x)) for one in points if one.seen and one.x < 200] == [(1, 140)], n


def test_a_wrong_velocity_of_a_track_alone_does_not_last():
    """A spot that is none gave the track a speed; each frame then looks like a jump back."""
    tracker = Tracker(ghost_ratio=0.0)
    for n in range(20):
        if n == 10:
            tracker._tracks[0].state[1] = 290.0, 583.0
        tracker.update(spots((488.0, 125.0), diameter=6.0), n / 15)
    (point,) = tracker.update(spots(), 20 / 15)
    assert math.dist((point.x, point.y), (488, 125)) < 3


def test_a_camera_alone_that_stands_does_not_become_a_reflection():
    """It is missed in the frame in which one like it begins elsewhere, which a shaking probe would look like."""
    tracker = Tracker(ghost_ratio=0.0)
    for n in range(20):
        tracker.update(spots((488.0, 125.0), diameter=6.0), n / 15)
    points = tracker.update(spots((360.0, 240.0), diameter=6.0), 20 / 15)
    assert [(point.track, point.seen) for point in points] == [(1, False), (2, True)]
    points = tracker.update(spots((488.0, 125.0), (360.0, 240.0), diameter=6.0), 21 / 15)
    assert [(point.track, round(point.x)) for point in points] == [(1, 488), (2, 360)]


def test_a_probe_that_begins_to_shake_finds_a_camera_alone_again():
    tracker = Tracker(ghost_ratio=0.0)
    for n in range(20):
        tracker.update(spots((488.0, 125.0), diameter=6.0), n / 15)
    sway = 60.0 * np.sin(2 * np.pi * 9.0 * np.arange(40) / 15)
    last = [tracker.update(spots((488.0 + by, 125.0 + by), diameter=6.0), (20 + n) / 15) for n, by in enumerate(sway)]
    assert any(point.track == 1 and point.seen for point in last[-1])


def test_a_track_knows_when_it_began_to_persist():
    tracker = Tracker(persist=(3, 5))
    # Two alone, and then every frame: the first two lie outside the five that gave the number.
    there = [True, False, False, True, False, False, True, True, True]
    points = [tracker.update(spots((50.0, 50.0)) if one else spots(), n / 10) for n, one in enumerate(there)]
    assert [len(one) for one in points] == [0] * 7 + [1, 1]
    assert {one[0].since for one in points[7:]} == {0.3}
    assert points[7][0].lately == (True, False, False, True, True)
    assert points[8][0].lately == (False, False, True, True, True)


def test_a_camera_alone_is_followed_in_the_hand_where_the_picture_says_how_it_moved() -> None:
    """Lit frames show it, and one of two, a glint that stays where the sensor is; dark frames show nothing."""
    rng, numbers = np.random.default_rng(3), set()
    places = np.cumsum(rng.normal(0, 60, (60, 2)), axis=0) % 200 + 200
    for known in (True, False):
        tracker, numbers = Tracker(ghost_ratio=0.0, max_distance=20.0), set()
        for n, (x, y) in enumerate(places.tolist()):
            shift = places[n] - places[max(n - 1, 0)]
            motion = np.column_stack([np.eye(2), shift]) if known else None
            found = spots(*([] if n % 2 == 0 else [(x, y)]), *([(500.0, 60.0)] if n % 4 == 1 else []), diameter=6.0)
            points = tracker.update(replace(found, motion=motion), n / 30, dark=n % 2 == 0)
            numbers |= {one.track for one in points if one.seen and one.x < 450}
            if known and n > 1 and n % 2 == 0:
                assert any(math.dist((one.x, one.y), (x, y)) < 1 for one in points if one.event == "dark")
        assert (len(numbers) == 1) == known


def test_a_turn_of_the_picture_turns_what_moves_in_it() -> None:
    tracker = Tracker(ghost_ratio=0.0, shake=0.0)
    for n in range(20):
        tracker.update(spots((100.0 + 6 * n, 200.0), diameter=6.0), n / 30)
    quarter = np.array([[0.0, -1.0, 500.0], [1.0, 0.0, 0.0]])
    (point,) = tracker.update(replace(spots(), motion=quarter), 20 / 30)
    # It was at (214, 200) and moved by 6 along x.
    assert math.dist((point.x, point.y), (300.0, 220.0)) < 1.5
    assert math.dist((point.vx, point.vy), (0.0, 180.0)) < 20


def test_an_unknown_motion_between_two_known_ones_is_sought_from_the_spots() -> None:
    rng = np.random.default_rng(5)
    places = rng.uniform((100, 100), (900, 700), (8, 2))
    tracker, numbers = Tracker(ghost_ratio=0.0), set()
    for n in range(30):
        shift = rng.normal(0, 40, 2) if n else np.zeros(2)
        places = places + shift
        motion = None if n % 7 == 3 else np.column_stack([np.eye(2), shift])
        points = tracker.update(replace(spots(*map(tuple, places.tolist()), diameter=6.0), motion=motion), n / 30)
        numbers |= {one.track for one in points if one.seen}
        assert sum(one.seen for one in points) == 8
    assert numbers == set(range(1, 9))


def test_evidence_adds_up_and_absence_takes_it_off() -> None:
    def begins(counts: list[float | None], doubt: float = 0.0) -> int | None:
        tracker = Tracker(ghost_ratio=0.0, persist=(2.5, 12), doubt=doubt)
        for n, one in enumerate(counts):
            found = spots() if one is None else replace(spots((50.0, 40.0)), evidence=np.array([one]))
            if tracker.update(found, n / 15):
                return n
        return None

    assert begins([1.0] * 6, doubt=0.5) == 2
    assert begins([0.5] * 6, doubt=0.5) == 4
    assert begins([1.0, None, 1.0, 1.0, 1.0], doubt=0.5) == 3
    assert begins([1.0, None, 1.0, 1.0, 1.0]) == 3
    # In every second frame.
    assert begins([1.0, None] * 8) == 4 and begins([1.0, None] * 8, doubt=0.5) == 6
    # Nothing is left after two frames without it, so that another track begins: three frames then.
    assert begins([1.0, None, None, 1.0, 1.0, 1.0, 1.0], doubt=0.5) == 5
    # What lies before the latest twelve frames does not count.
    assert begins([0.2] * 40, doubt=0.5) is None and begins([0.21] * 40, doubt=0.5) == 11


def test_detections_refuse_evidence_and_motion_that_make_no_sense() -> None:
    for wrong in (-0.1, 1.5):
        with pytest.raises(InputError, match=rf"Detections\.evidence: must be from 0 to 1, is {wrong:g}"):
            replace(spots((50.0, 40.0)), evidence=np.array([wrong]))
    for motion in (np.eye(2), np.full((2, 3), np.nan)):
        with pytest.raises(InputError, match=r"Detections\.motion: must be a finite matrix"):
            Detections.empty(motion)


def test_all_that_is_remembered_of_a_picture_moves_with_it() -> None:
    """The place last seen, where it would be had it not jumped, and spots that no track took yet."""
    tracker = Tracker(ghost_ratio=0.0)
    for n in range(10):
        tracker.update(spots((300.0, 200.0), diameter=6.0), n / 30)
    (track,) = tracker._tracks
    track.home, track.homing = track.state.copy(), 4
    tracker._loose = np.array([[100.0, 50.0]])
    turned = np.array([[0.0, -1.0, 500.0], [1.0, 0.0, 20.0]])
    tracker._move_all(turned)
    assert track.home is not None
    for place in (track.state[0], track.last, track.home[0]):
        assert place == pytest.approx(turned @ (300, 200, 1), abs=1)
    assert tracker._loose.tolist() == [[450.0, 120.0]]


def test_a_track_ends_when_no_evidence_is_left() -> None:
    tracker, points = Tracker(ghost_ratio=0.0, persist=(2.5, 12), doubt=0.5), []
    for n, seen in enumerate([True, False, False, True, True, True]):
        points = tracker.update(spots((50.0, 40.0)) if seen else spots(), n / 15)
    assert [one.since for one in points] == [3 / 15]
