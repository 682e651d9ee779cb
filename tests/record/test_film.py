"""The virtual bench: reproducible, honest about its truth, and without leaks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.record import HandMotion, Session, Source, film, label_recording, open_recording
from tapetum.record.beats import CameraClock
from tapetum.record.clutter import draw_clutter
from tapetum.record.film import without_second_beam
from tapetum.record.laser import BlinkCode
from tapetum.record.room import Room
from tapetum.record.session import Placed
from tapetum.record.shot import Shot, probe_frames
from tapetum.record.stray import draw_stray
from tapetum.simulate import Camera, tilt_of_gaze


@pytest.fixture(scope="module")
def small() -> Scene:
    changes = {"probe.sensor.pixels": [160, 120], "probe.sensor.pitch": 8e-6, "target.sensor.pixels": [324, 243]}
    changes["target.sensor.pitch"] = 17.6e-6
    # A small aperture, whose images take a fifth of the time.
    changes["target.lens.aperture_radius"] = 2e-3
    # Larger pixels fill sooner.
    changes["probe.sensor.exposure"] = 4e-5
    return with_values(load_scene("hand-held"), changes)


def frames_of(path: Path, stream: str) -> np.ndarray:
    return np.stack([frame.image for frame in open_recording(path).source(stream)])


def test_the_same_seed_films_the_same_frames(small: Scene, tmp_path: Path) -> None:
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        film(small, tmp_path / f"{name}.rec", Session(0.6, seed=seed))
    for stream in ("probe", "target"):
        a, b, c = (frames_of(tmp_path / f"{name}.rec", stream) for name in "abc")
        assert np.array_equal(a, b)
        assert a.shape != c.shape or not np.array_equal(a, c)


def test_labels_find_the_bench_s_truth(small: Scene, tmp_path: Path) -> None:
    # A tremor of 10 Hz cannot be interpolated between frames 15 a second apart: here the finder is asked, not the hand.
    recording = film(small, tmp_path / "a.rec", Session(3.0, seed=3, motion=HandMotion(tremor=0.0)))
    summary = label_recording(recording)
    assert summary.labelled > 0.9 * summary.n
    labels, truth = recording.labels(), recording.truth()
    assert labels is not None
    assert truth is not None
    true = truth.filter(np.asarray(truth["stream"]) == "probe")
    found = np.stack([labels[n].to_numpy(zero_copy_only=False) for n in ("gaze_x", "gaze_y")], -1).astype(float)
    error = found - np.stack([true[n].to_numpy() for n in ("gaze_x", "gaze_y")], -1)
    pixels = error * np.array(small.target.sensor.pixels)
    assert np.sqrt(np.nanmean(pixels**2)) < 0.25


def test_clocks_drift_jitter_and_lose_frames() -> None:
    times, lost = CameraClock(offset=0.5, loss=0.1).draw(2000, 15.0, np.random.default_rng(0))
    assert (np.diff(times) > 0).all()
    assert len(times) + lost.sum() == pytest.approx(2000, abs=3)
    assert 100 < lost.sum() < 300
    assert times[0] == pytest.approx(0.5, abs=0.02)
    even = np.diff(times)[lost[1:] == 0]
    assert even.mean() == pytest.approx(1 / 15, rel=0.01)


def test_motion_covers_the_field_evenly_and_tells_nothing_by_place() -> None:
    hand = HandMotion().draw(4)
    times = np.arange(0, 2000, 0.5)
    where, sway = hand.gaze(times), hand.place(times)
    assert np.abs(where).max() < 0.5
    inner = (np.abs(where) < 0.24).mean()
    assert inner == pytest.approx(0.5, abs=0.08)
    assert sway.std() == pytest.approx(3e-3, rel=0.25)
    correlation = np.corrcoef(np.concatenate([where, sway], axis=1).T)[:2, 2:]
    assert np.abs(correlation).max() < 0.1


def test_a_frame_is_the_simulation_where_the_camera_is(small: Scene) -> None:
    """The film's patchwork against the whole frame computed at once, in the mean of many exposures."""
    gaze, place = np.array([[0.2, -0.1]]), np.array([[2e-3, -1e-3]])
    quiet = with_values(small, {"read_noise": 0.0, "background": 0.0, "probe.sensor.bits": 16})
    frame = next(iter(probe_frames(quiet, gaze, place, 0))).astype(float)
    centre = torch.from_numpy(place * 0.2 / 5.5)
    camera = Camera(quiet, 0.03)
    whole = camera(tilt_of_gaze(quiet, torch.from_numpy(gaze)), centre)[0].numpy()
    assert np.corrcoef(frame.ravel(), whole.ravel())[0, 1] > 0.99


def test_without_the_second_beam_its_light_is_gone(small: Scene) -> None:
    gaze = np.zeros((1, 2))
    with_beam = next(iter(probe_frames(small, gaze, gaze, 0))).astype(float)
    without = next(iter(probe_frames(without_second_beam(small), gaze, gaze, 0))).astype(float)
    assert with_beam.sum() > without.sum() * 1.02


def test_the_room_shows_the_laser_at_the_gaze() -> None:
    rng = np.random.default_rng(1)
    room = Room(200, 150, 3)
    gaze = np.array([0.2, -0.3])
    seen = room.picture(gaze, rng).astype(float) - room.picture(gaze, rng, laser=0.0).astype(float)
    row, column = np.unravel_index(seen.argmax(), seen.shape)
    assert abs(column - (99.5 + 40)) <= 1
    assert abs(row - (74.5 - 45)) <= 1


def test_the_room_turns_against_the_camera_and_grows_as_it_comes_near() -> None:
    room, gaze = Room(200, 150, 3), np.array([0.1, 0.1])
    still = room.picture(gaze, np.random.default_rng(1), laser=0.0).astype(np.float32)
    moved = room.picture(gaze, np.random.default_rng(2), laser=0.0, roll=0.3, nearer=1.1).astype(np.float32)
    # The picture itself, turned the other way and enlarged about the laser, must be the new one.
    c, s = 1.1 * np.cos(0.3), 1.1 * np.sin(0.3)
    about = np.array([99.5 + 20, 74.5 + 15])
    matrix = np.array([[c, s], [-s, c]])
    expected = cv2.warpAffine(still, np.column_stack([matrix, about - matrix @ about]), (200, 150))
    middle = (slice(50, 130), slice(70, 170))
    assert np.corrcoef(moved[middle].ravel(), expected[middle].ravel())[0, 1] > 0.95
    assert np.corrcoef(moved[middle].ravel(), still[middle].ravel())[0, 1] < 0.7


def test_a_recording_says_all_that_was_drawn(small: Scene, tmp_path: Path) -> None:
    session = Session(
        0.4,
        seed=2,
        motion=HandMotion(roll=0.02, walk=(5.0, 4.5)),
        code=BlinkCode(seed=5),
        clutter=draw_clutter(small, 1),
        stray=draw_stray(small, 1),
        others=(Placed((0.01, 0.0)),),
    )
    recording = film(small, tmp_path / "a.rec", session)
    meta, truth = recording.meta, recording.truth()
    assert meta["laser"]["code"]["word"] == list(BlinkCode(seed=5).sent)
    assert meta["motion"]["walk"] == [5.0, 4.5]
    assert len(meta["clutter"]) == len(meta["stray"]) == 3
    assert meta["others"][0]["offset"] == [0.01, 0.0]
    assert truth is not None
    assert {"roll", "distance", "exposure", "laser", "target", "x", "y"} <= set(truth.column_names)
    shot = Shot(small, session)
    assert np.array_equal(frames_of(tmp_path / "a.rec", "probe"), shot.probe(0, len(shot.beats["probe"])))


def test_a_camera_of_the_bench_is_a_source_like_any_other(small: Scene, tmp_path: Path) -> None:
    session = Session(0.4, seed=2, code=BlinkCode(seed=5))
    recorded = list(film(small, tmp_path / "a.rec", session).source("target"))
    camera = Shot(small, session).cameras["target"]
    assert isinstance(camera, Source) and not camera.live and len(camera) == len(recorded)
    for ours, kept in zip(camera, recorded, strict=True):
        assert np.array_equal(ours.image, kept.image)
        assert (ours.utc_ns, ours.monotonic_ns, ours.exposure) == (kept.utc_ns, kept.monotonic_ns, kept.exposure)
        assert (ours.index, ours.lit, ours.lost) == (kept.index, kept.lit, kept.lost)
        assert ours.time == pytest.approx(kept.time, abs=2e-9)


@pytest.mark.parametrize("seed", [True, None, 1.0, "1", -1, 2**63])
def test_a_seed_that_a_recording_cannot_keep_is_refused(seed) -> None:
    with pytest.raises(InputError, match=r"seed: must be a whole number from 0 to \d+, is"):
        Session(seed=seed)
    with pytest.raises(InputError, match="seed"):
        Placed((0.0, 0.0), seed=seed)


def test_a_seed_of_any_whole_type_films(small: Scene, tmp_path: Path) -> None:
    film(small, tmp_path / "a.rec", Session(0.2, seed=np.int64(3)))  # type: ignore[arg-type]
    assert open_recording(tmp_path / "a.rec").meta["seed"] == 3


@pytest.mark.parametrize("name", ["seconds", "rate"])
@pytest.mark.parametrize("value", [0, -1.0, np.nan, np.inf, 1e7, None, True, "15"])
def test_lengths_and_rates_out_of_range_are_refused(name: str, value) -> None:
    with pytest.raises(InputError, match=f"^{name}: must be above 0 and at most"):
        Session(**{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("loss", value) for value in (-0.1, 1.0, np.nan)),
        *((name, value) for name in ("jitter", "readout") for value in (-1e-3, np.nan, np.inf)),
        *((name, value) for name in ("drift", "rate_error", "offset") for value in (np.nan, -np.inf, 1e7)),
    ],
)
def test_a_clock_out_of_range_is_refused(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"^clock {name}: must be "):
        CameraClock(**{name: value})


def test_a_session_without_frames_and_a_name_taken_are_refused(small: Scene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seconds"):
        film(small, tmp_path / "a.rec", Session(0.01))
    with pytest.raises(InputError, match="motion"):
        film(small, tmp_path / "a.rec", Session(0.2, motion=HandMotion(walk=(0.2, 0.1))))
    assert not (tmp_path / "a.rec").exists()
    film(small, tmp_path / "a.rec", Session(0.2))
    with pytest.raises(InputError, match=r"a\.rec"):
        film(small, tmp_path / "a.rec", Session(0.2))
