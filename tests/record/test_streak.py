"""The spot's streak: where the laser stood, and how well that is known."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from scipy.ndimage import gaussian_filter

from tapetum.record import labels
from tapetum.record.blobs import find_candidates
from tapetum.record.labels import ALONE, _about, _look, _sharp, _Sight, label_recording
from tapetum.record.patch import add_patch, bell
from tapetum.record.recording import Recording, RecordingWriter, StreamInfo, open_recording
from tapetum.record.source import Frame
from tapetum.record.streak import HALF, patch_of, sharpened, unsaturated


def drawn(
    streak: tuple[float, float], place: tuple[float, float], seed: int, edge: float = 0.0, height: float = 150.0
) -> np.ndarray:
    """An 8-bit frame of a wall of 60 with noise of 2, lighter by `edge` right of the spot, and a spot that moves over a
    line in the exposure."""
    frame = np.full((80, 96), 60.0, np.float32)
    frame += edge * np.clip(np.arange(96, dtype=np.float32) - place[0] - 0.5, 0, 1)
    for part in (np.arange(24) + 0.5) / 24 - 0.5:
        spot = bell((place[0] + part * streak[0], place[1] + part * streak[1]), height / 24, 1.2, 12)
        add_patch(frame, spot, 1.0)
    noise = 2.0 * np.random.default_rng(seed).standard_normal(frame.shape)
    return np.clip(np.rint(frame + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("streak", [(0.0, 0.0), (4.0, 0.0), (0.0, -5.0), (4.0, 3.0)])
def test_a_streak_is_found_and_leaves_noise_alone(streak: tuple[float, float]) -> None:
    rng = np.random.default_rng(4)
    places = np.array([48.0, 40.0]) + rng.uniform(-0.5, 0.5, (40, 2))
    frames = [drawn(streak, (float(x), float(y)), seed) for seed, (x, y) in enumerate(places)]
    found = [find_candidates(frame) for frame in frames]
    round_ones = np.array([(one.x[0], one.y[0]) for one in found])
    patches = np.stack([patch_of(frame, *at) for frame, at in zip(frames, round_ones, strict=True)])
    sigmas = np.array([one.sigma[0] for one in found])
    fits = sharpened(patches, round_ones, sigmas, np.full(40, 255.0))
    assert fits.holds.all()
    errors = np.sqrt(((fits.places - places) ** 2).mean(axis=0))
    # The residual is the noise, which neighbours do not share.
    assert np.median(fits.noise) == pytest.approx(2 / 150, rel=0.15)
    assert np.median(fits.shared) < 2 / 150 / 3
    length = float(np.hypot(*streak))
    assert (errors < (0.8 + 0.5 * length) * 2 / 150 * 1.3).all()
    if length > 3:
        # The round fit leaves the streak itself, and so knows its place far better than it says.
        assert np.median([one.snr[0] for one in found]) < 25


def test_patches_at_the_edge_and_spots_that_cannot_be_fitted() -> None:
    frame = drawn((0.0, 0.0), (2.0, 40.0), 1)
    patch = patch_of(frame, 2.0, 40.0)
    assert patch.shape == (2 * HALF + 1, 2 * HALF + 1)
    assert np.isnan(patch[:, : HALF - 2]).all() and np.isfinite(patch[:, HALF - 2 :]).all()
    assert np.isnan(patch_of(frame, -100.0, 40.0)).all()
    given = np.array([[2.0, 40.0], [300.0, 40.0]])
    empty = np.full_like(patch, np.nan)
    fits = sharpened(np.stack([patch, empty]), given, np.array([1.2, 1.2]), np.full(2, 255.0))
    assert fits.holds.tolist() == [True, False]
    assert np.abs(fits.places[0] - given[0]).max() < 0.1
    assert (fits.places[1] == given[1]).all()


def swinging(
    path: Path, axis: int, count: int, edge: float = 0.0, height: float = 150.0, rate: float = 5.0
) -> np.ndarray:
    """Record a laser that swings along one axis, in frames of 60 a second of which every fourth is the probe's moment;
    return its true places [N, 2]."""
    times, turn = np.arange(count) / 60, 2 * np.pi * rate
    swing = np.zeros((count, 2))
    swing[:, axis] = 8 * np.sin(turn * times)
    streak = np.zeros_like(swing)
    streak[:, axis] = 8 * turn * np.cos(turn * times) * 0.015
    middle = np.array([48.0, 40.0])
    streams = {"probe": StreamInfo(20, 20), "target": StreamInfo(80, 96, rate=60.0)}
    with RecordingWriter(path, streams=streams, rate=15, start_utc_ns=0) as writer:
        # The mean over the exposure.
        shown = middle + swing * np.sinc(rate * 0.015)
        for n, (moment, place) in enumerate(zip(times, shown, strict=True)):
            at = {"monotonic_ns": n, "utc_ns": round(moment * 1e9)}
            image = drawn(tuple(streak[n]), tuple(place), n, edge, height)
            writer.write("target", image, exposure=0.015, **at)
            if n % 4 == 0:
                writer.write("probe", np.zeros((20, 20), np.uint8), **at)
    return middle + swing


Quick = tuple[Recording, pa.Table, np.ndarray]


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Quick]:
    """The recording of a hand that swings along an axis, its labels and the true places in the probe's frames."""

    @functools.cache
    def made(axis: int) -> Quick:
        path = tmp_path_factory.mktemp("quick") / "swing.rec"
        truth = swinging(path, axis, 120)[::4]
        recording = open_recording(path)
        label_recording(recording)
        table = recording.labels()
        assert table is not None
        return recording, table, truth

    return made


@pytest.mark.parametrize("axis", [0, 1])
def test_labels_of_a_quick_hand_state_how_far_they_are_off(axis: int, quick: Callable[[int], Quick]) -> None:
    _, table, truth = quick(axis)
    for n, name in enumerate("xy"):
        spot, stated = (table[one].to_numpy() for one in (f"spot_{name}", f"gaze_{name}_std"))
        error = np.sqrt(np.nanmean((spot - truth[:, n]) ** 2))
        said = float(np.sqrt(np.nanmean(stated**2))) * (96, 80)[n]
        assert error < said < 4 * error, name
        assert error < 0.025, name


def test_an_edge_under_the_spot_is_taken_off_before_labels_are_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = swinging(tmp_path / "swing.rec", 1, 100, 60.0)[::4]
    recording, off = open_recording(tmp_path / "swing.rec"), []
    for rounds in (0, labels.ROUNDS):
        monkeypatch.setattr(labels, "ROUNDS", rounds)
        label_recording(recording)
        table = recording.labels()
        assert table is not None
        off.append(float(np.nanmean(table["spot_x"].to_numpy() - truth[:, 0])))
    stated = float(np.nanmedian(table["gaze_x_std"].to_numpy())) * 96
    assert abs(off[0]) > 0.1 and abs(off[1]) < 0.3 * abs(off[0])
    assert abs(off[1]) < 2.5 * stated < 0.15


def test_a_bright_spot_of_which_hardly_a_pixel_is_not_saturated_is_labelled(tmp_path: Path) -> None:
    """No nine pixels side by side are left to say what neighbours share."""
    truth = swinging(tmp_path / "swing.rec", 0, 60, height=1000.0, rate=1.0)[::4]
    recording = open_recording(tmp_path / "swing.rec")
    assert label_recording(recording).labelled == 15
    table = recording.labels()
    assert table is not None
    assert np.abs(table["spot_x"].to_numpy() - truth[:, 0]).max() < 0.05
    assert np.nanmax(table["gaze_x_std"].to_numpy()) * 96 < 0.1


def test_labels_do_not_depend_on_how_many_spots_are_fitted_at_once(
    quick: Callable[[int], Quick], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, table, _ = quick(0)
    assert labels.BATCH > 120
    monkeypatch.setattr(labels, "BATCH", 64)
    label_recording(recording)
    other = recording.labels()
    assert other is not None
    for name in ("gaze_x", "gaze_y", "gaze_x_std", "gaze_y_std"):
        np.testing.assert_allclose(other[name].to_numpy(), table[name].to_numpy(), atol=1e-7)


def test_an_edge_under_the_spot_shows_in_what_neighbours_leave_alike() -> None:
    shares, errors = [], []
    for edge in (0.0, 40.0):
        frames = [drawn((0.0, 0.0), (48.2, 40.1), seed).astype(np.float32) for seed in range(20)]
        for frame in frames:
            frame[:, 49:] += edge
        at = np.tile([48.0, 40.0], (20, 1))
        patches = np.stack([patch_of(frame, 48.0, 40.0) for frame in frames])
        fits = sharpened(unsaturated(patches, np.full(20, 300.0)), at, np.full(20, 1.2), np.full(20, 300.0))
        assert fits.holds.all()
        shares.append(float(np.median(fits.shared)))
        errors.append(float(np.abs(fits.places[:, 0].mean() - 48.2)))
    assert errors[0] < 0.01 and errors[1] > 0.05
    assert shares[1] > 3 * shares[0]
    assert 0.2 < errors[1] / (ALONE * shares[1]) < 4


def test_dark_frames_of_a_laser_that_blinks_do_not_count() -> None:
    wall = gaussian_filter(120 * np.random.default_rng(6).standard_normal((80, 96)), 2.5)
    looks: dict[tuple[int, float], _Sight] = {}
    stated = []
    for every in (1, 3):
        lit = np.arange(48) % every == 0
        for n, height in enumerate(np.where(lit, 150.0, 0.0).tolist()):
            if (n, height) not in looks:
                frame = drawn((0.0, 0.0), (48.2, 40.1), n, 0.0, height) + wall
                looks[n, height] = _look(Frame(n, n / 60, frame.clip(0, 255).astype(np.uint8)))
        own = [looks[n, 150.0 if on else 0.0] for n, on in enumerate(lit)]
        stated.append(np.median(_sharp(own, lit)[2][lit], axis=0))
    # Fewer frames show less of the wall.
    assert (stated[1] > stated[0]).all()
    assert (stated[1] < 2 * stated[0]).all()


def test_what_stands_about_the_spot_counts_where_it_stands() -> None:
    # Four seconds of a camera of 60 frames a second; in the third the spot crosses the edge of a book, in one frame a
    # reflection.
    times = np.arange(240) / 60
    shared = np.where((times > 2) & (times < 3), 5.0, 1.0)
    shared[30] = 90.0
    at = np.array([-1.0, 0.5, 1.0, 1.8, 2.2, 2.8, 3.2, 9.0])
    np.testing.assert_array_equal(_about(times, shared, at, 60.0), [1, 1, 1, 1, 5, 5, 1, 1])
    # Few frames a second still have five about each label.
    slow = np.where(np.arange(20) == 7, 90.0, 1.0)
    assert (_about(np.arange(20) / 10, slow, times, 10.0) == 1).all()
