"""Tracks of targets whose truth is known: common motion of a probe in the hand, false alarms, misses, crossings."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tapetum import Session, load_scene
from tapetum.bench import with_values
from tapetum.errors import InputError
from tapetum.record import HandMotion, Placed, ProbeShake
from tapetum.record.shot import Shot
from tapetum.record.source import Frame
from tapetum.track import Detections, Tracker, track
from tapetum.track.ghosts import Ghost
from tapetum.track.metrics import TrackScores, score_tracks
from tapetum.track.motion import common_motion

SECTION = "Following (made positions, 2592 × 1944, noise of 0.2 px, 1 % missed, a false alarm in two frames)"
TRUTH = "the truth of what was made"
WIDTH, HEIGHT, RATE = 2592, 1944, 30.0


def hand(rng: np.random.Generator, frames: int, rms: float) -> np.ndarray:
    """Shake of a hand, 8 to 12 Hz, of that root mean square over both axes together, [frames, 2]."""
    t = np.arange(frames) / RATE
    sway = np.zeros((frames, 2))
    for axis in (0, 1):
        for _ in range(12):
            sway[:, axis] += np.sin(2 * np.pi * rng.uniform(8, 12) * t + rng.uniform(0, 2 * np.pi))
    return sway * rms / math.sqrt((sway**2).sum(1).mean()) if rms else sway * 0


def filmed(
    rng: np.random.Generator, targets: int, rms: float, frames: int = 150, missed: float = 0.01, false: float = 0.5
) -> tuple[list[tuple[np.ndarray, np.ndarray]], list[Detections]]:
    """Places of targets in frames, and what a detector says: noise, misses and false alarms in random order."""
    place = rng.uniform((200, 200), (WIDTH - 200, HEIGHT - 200), (targets, 2))
    velocity = rng.normal(0, 40, (targets, 2))
    bright, wide = rng.uniform(20, 230, targets), rng.uniform(3, 12, targets)
    sway = hand(rng, frames, rms)
    truth, found = [], []
    for n in range(frames):
        at = place + velocity * n / RATE + sway[n]
        truth.append((np.arange(targets), at))
        there = rng.random(targets) >= missed
        chance = rng.poisson(false)
        # What is no target shakes along only where it is of the scene: here it is noise and stands anywhere.
        x = np.concatenate([at[there, 0] + rng.normal(0, 0.2, there.sum()), rng.uniform(0, WIDTH, chance)])
        y = np.concatenate([at[there, 1] + rng.normal(0, 0.2, there.sum()), rng.uniform(0, HEIGHT, chance)])
        peak = np.concatenate([bright[there] * np.exp(rng.normal(0, 0.1, there.sum())), rng.uniform(15, 60, chance)])
        diameter = np.concatenate([wide[there], rng.uniform(3, 12, chance)])
        order = rng.permutation(len(x))
        columns = dict.fromkeys(Detections.names(), np.zeros(len(x))) | {"x": x, "y": y, "peak": peak}
        columns["evidence"] = np.ones(len(x))
        columns |= {"diameter": diameter, "snr": peak}
        found.append(Detections.of(columns)[order])
    return truth, found


def followed(found: list[Detections], **options) -> list[tuple[list[int], list[tuple[float, float]]]]:
    tracker = Tracker(ghost_ratio=0, **options)
    tracks = []
    for n, one in enumerate(found):
        points = tracker.update(one, n / RATE)
        tracks.append(([point.track for point in points], [(point.x, point.y) for point in points]))
    return tracks


def scored(targets: int, rms: float, seeds: int = 3, **options) -> list[TrackScores]:
    scores = []
    for seed in range(seeds):
        truth, found = filmed(np.random.default_rng(seed), targets, rms)
        scores.append(score_tracks(truth, followed(found, persist=(3, 5), **options), reach=20))
    return scores


@pytest.mark.parametrize("rms", [0.0, 5.0, 60.0])
@pytest.mark.parametrize(("targets", "least"), [(1, 0.98), (5, 0.97), (30, 0.93)])
def test_identities_hold_in_the_hand(targets: int, least: float, rms: float, validated) -> None:
    # One film of thirty shows as many places as six of five.
    scores = scored(targets, rms, 1 if targets == 30 else 3)
    what = f"identities (1 - IDF1) of {targets} target{'s' if targets > 1 else ''}, common motion of {rms:g} px RMS"
    validated(SECTION, what, 1 - np.mean([one.idf1 for one in scores]), 1 - least, TRUTH, "of the places")
    validated(
        SECTION, f"changes of identity of {targets} at {rms:g} px", sum(one.changes for one in scores), 0, TRUTH, ""
    )


def test_it_is_the_common_motion_that_holds_them() -> None:
    assert scored(30, 60.0, 1, shake=0.0)[0].idf1 < 0.2


def test_thirty_under_a_perfect_detector_never_change(validated) -> None:
    for seed in range(5):
        truth, found = filmed(np.random.default_rng(seed), 30, 60.0, frames=60, missed=0.0, false=0.0)
        changes = score_tracks(truth, followed(found), reach=20).changes
        validated(SECTION, "changes of identity of 30 in 60 frames at 60 px, no miss", changes, 0, TRUTH, "")
    truth, found = filmed(np.random.default_rng(9), 30, 60.0, missed=0.0, false=0.0)
    scores = score_tracks(truth, followed(found), reach=20)
    assert (scores.changes, scores.missed, scores.false) == (0, 0, 0)
    assert scores.idf1 == scores.mota == 1.0


def test_a_roll_and_a_step_forward_are_common_motion_too() -> None:
    rng = np.random.default_rng(4)
    places = rng.uniform(0, 1000, (12, 2))
    turn = 0.03
    moved = 1.02 * places @ np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]) + (70, -40)
    found = np.vstack([moved[rng.permutation(12)[:10]], rng.uniform(0, 1000, (6, 2))])
    motion = common_motion(places, found, np.ones((12, 16), bool), 300)
    assert motion is not None
    assert np.abs(places @ motion[:, :2].T + motion[:, 2] - moved).max() < 8


def test_where_nothing_is_shared_nothing_is_taken_out() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        places, found = rng.uniform(0, 2000, (8, 2)), rng.uniform(0, 2000, (8, 2))
        assert common_motion(places, found, np.ones((8, 8), bool), 300) is None


def spots(*places: tuple[float, float], peak: float = 100.0) -> Detections:
    columns = dict.fromkeys(Detections.names(), np.zeros(len(places))) | {"evidence": np.ones(len(places))}
    columns |= {"x": [p[0] for p in places], "y": [p[1] for p in places]}
    return Detections.of(columns | {"peak": np.full(len(places), peak), "diameter": np.full(len(places), 8.0)})


def test_only_what_persists_gets_a_number() -> None:
    tracker = Tracker(persist=(3, 5))
    seen = [True, False, True, False, False, True, True, False, True, True]
    numbers = []
    for n, there in enumerate(seen):
        points = tracker.update(spots((100, 100)) if there else spots(), n / 30)
        numbers.append([(point.track, point.event) for point in points])
    # In frame 6 it was seen three times in five for the first time.
    assert numbers[:6] == [[]] * 6
    assert numbers[6:] == [[(1, "begun")], [(1, "unseen")], [(1, "found again")], [(1, "")]]
    # Once in four frames is never enough.
    tracker = Tracker(persist=(3, 5))
    assert not any(tracker.update(spots((100, 100)) if n % 4 == 0 else spots(), n / 30) for n in range(40))


def test_births_gaps_and_ends_have_a_reason() -> None:
    tracker = Tracker(max_coast=0.2, endings=True)
    told = []
    for n in range(20):
        there = n < 6 or 8 <= n < 10
        told += [(n, point.event) for point in tracker.update(spots((50, 50)) if there else spots(), n / 30)]
    assert told[0] == (0, "begun") and dict(told)[6] == "unseen" and dict(told)[8] == "found again"
    assert told[-1] == (16, "ended: unseen for 0.23 s")


def test_a_track_that_left_is_not_said_to_be_beyond_the_picture() -> None:
    """A camera that moves out of the frame at 10 px a frame; another stays."""
    tracker = Tracker(max_coast=0.4, endings=True)
    told = []
    for n in range(40):
        x, stays = 150.0 + 10.0 * n, (100.0, 80.0)
        places = spots((x, 60.0), stays) if x < 200 else spots(stays)
        told += [point for point in tracker.update(places, n / 30, size=(200, 120)) if point.track == 1]
    assert all(0 <= point.x <= 199 and 0 <= point.y <= 119 for point in told)
    unseen = [point for point in told if not point.seen]
    assert len(unseen) > 10 and {point.event for point in unseen[:-1]} == {"out of the picture"}
    assert unseen[-1].event == "ended: out of the picture for 0.43 s"


def test_a_shake_brings_a_track_back_into_the_picture() -> None:
    """Four cameras; one stands near the edge, and a shake of the probe moves it out for some frames."""
    others = np.array([[300.0, 300.0], [500.0, 200.0], [400.0, 450.0]])
    tracker, told = Tracker(), []
    for n in range(30):
        sway = np.array([-60.0 if n % 10 in (4, 5, 6) else 0.0, 0.0])
        every = np.vstack([[40.0, 240.0], others]) + sway
        there = [tuple(place) for place in every.tolist() if place[0] >= 0]
        told.append(tracker.update(spots(*there), n / 30, size=(640, 480)))
    assert {point.track for points in told for point in points} == {1, 2, 3, 4}
    assert min(point.x for points in told for point in points) == 0.0


def test_two_that_become_one_are_said_to_merge() -> None:
    tracker = Tracker(max_coast=0.3, endings=True)
    told = {}
    for n in range(60):
        a, b = (100 + 2.0 * n, 100.0), (200.0, 100.0)
        places = [a, b] if n < 48 else [b]
        for point in tracker.update(spots(*places), n / 30):
            told[point.track, n] = point.event
    assert "hidden by track 2" in told.values()
    (last,) = [event for event in told.values() if event.startswith("ended")]
    assert last.startswith("ended: merged with track 2 for ")


def test_persistence_must_be_k_of_n() -> None:
    with pytest.raises(InputError, match=r"Tracker\.persist: must be K of N"):
        Tracker(persist=(4, 3))


def line(number: int, frames: int, y: float = 0.0) -> list[tuple[list[int], list[list[float]]]]:
    return [([number], [[10.0 * n, y]]) for n in range(frames)]


def test_perfect_tracks_score_one() -> None:
    scores = score_tracks(line(3, 10), line(7, 10), reach=10)
    assert (scores.hota, scores.idf1, scores.mota, scores.changes) == (1.0, 1.0, 1.0, 0)


def test_a_track_in_two_halves_scores_as_in_closed_form() -> None:
    """All ten places are found, five under each number: DetA 1, AssA 5/10, HOTA sqrt(1/2), IDF1 10/20, one change."""
    scores = score_tracks(line(3, 10), line(7, 10)[:5] + line(8, 10)[5:], reach=10)
    assert scores.deta == pytest.approx(1) and scores.assa == pytest.approx(0.5)
    assert scores.hota == pytest.approx(math.sqrt(0.5))
    assert (scores.idf1, scores.changes, scores.mota) == (0.5, 1, 0.9)


def test_misses_and_false_places_score_as_in_closed_form() -> None:
    """Six of ten found, four false elsewhere: DetA 6/14, AssA 6/14, IDF1 12/20, MOTA 1 - 8/10."""
    ours = line(7, 6) + [([7], [[10.0 * n, 500.0]]) for n in range(6, 10)]
    scores = score_tracks(line(3, 10), ours, reach=10)
    assert scores.hota == pytest.approx(6 / 14) and scores.deta == scores.assa == pytest.approx(6 / 14)
    assert (scores.missed, scores.false) == (4, 4)
    assert scores.idf1 == pytest.approx(12 / 20) and scores.mota == pytest.approx(0.2)


def test_a_constant_offset_counts_up_to_its_likeness() -> None:
    """A likeness of 0.7 passes the thresholds 0.05 to 0.70: 14 of 19."""
    scores = score_tracks(line(3, 10), line(7, 10, y=3.0), reach=10)
    assert scores.hota == pytest.approx(14 / 19) and scores.mota == scores.idf1 == 1.0


def test_nothing_scores_nothing() -> None:
    empty = [([], np.empty((0, 2)))] * 10
    scores = score_tracks(line(3, 10), empty, reach=10)
    assert (scores.hota, scores.idf1, scores.mota, scores.missed) == (0, 0, 0, 10)
    with pytest.raises(InputError, match="10 frames of truth and 3 of tracks"):
        score_tracks(line(3, 10), empty[:3], reach=10)
    with pytest.raises(InputError, match="twice"):
        score_tracks([([1, 1], np.zeros((2, 2)))], [([], [])], reach=1)


@pytest.mark.parametrize("shake", [0.0, 30.0])
def test_three_cameras_of_the_virtual_bench_keep_their_numbers(shake: float) -> None:
    """Cameras whose gaze wanders, each now bright and now dim, before a probe that stands or shakes in the hand."""
    scene = with_values(
        load_scene("hand-held"), {"target.lens.aperture_radius": 2e-3, "probe.sensor.pixels": [640, 512]}
    )
    motion = HandMotion(extent=0.25, sway=1e-3)
    places = [(-0.008, 0.006), (0.009, -0.005)]
    others = tuple(Placed(place, motion=motion, seed=n) for n, place in enumerate(places))
    # Of 30 px.
    held = ProbeShake(shake * scene.probe.sensor.pitch / scene.probe.lens.focal_length) if shake else None
    shot = Shot(scene, Session(3.0, 15.0, 8, motion=motion, others=others, shake=held))
    frames = list(shot.cameras["probe"])
    truth: list[tuple[list[int], list[tuple[float, float]]]] = [([], []) for _ in frames]
    for row in shot.truth().to_pylist():
        if row["stream"] == "probe":
            truth[row["frame"]][0].append(row["target"])
            truth[row["frame"]][1].append((row["x"], row["y"]))
    options = {"known_ghost": Ghost.of(scene)}
    tracker = Tracker(ghost_ratio=0.0, persist=(3, 5))
    followed_ = track(frames, detect_options=options, tracker=tracker)
    tracks = [
        ([row.track for row in one.rows if row.seen], [(row.x, row.y) for row in one.rows if row.seen])
        for one in followed_
    ]
    # The truth is the centre of the pupil, from which a vignetted spot may lie 26 px.
    scores = score_tracks(truth, tracks, reach=60)
    assert scores.changes == 0 and scores.idf1 >= 0.95, scores
    # None of the cameras is lost as the ghost of a brighter one: by their heights alone a third of the places is.
    assert scores.missed <= 0.07 * sum(len(names) for names, _ in truth), scores


def test_lobes_and_smeared_ghosts_of_one_camera_are_no_cameras() -> None:
    """The demo's camera alone: out of focus its picture has lobes, and its ghost is smeared."""
    scene = load_scene("hand-held")
    images = Shot(scene, Session(20.0, 15.0, 7)).probe(68, 96)
    frames = [Frame(n, n / 15.0, image) for n, image in enumerate(images)]
    tracked = track(frames, detect_options={"known_ghost": Ghost.of(scene)})
    assert {row.track for one in tracked for row in one.rows} == {1}
