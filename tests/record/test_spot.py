"""The laser in the target's picture: found where it is, not found where it is not; labels made of it."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pytest
from spot_scenes import SCENES, H, Laser, W, expose

from tapetum.errors import InputError
from tapetum.record.blobs import Candidates
from tapetum.record.images import read_image
from tapetum.record.labels import label_recording
from tapetum.record.recording import Recording, RecordingWriter, StreamInfo, open_recording
from tapetum.record.spot import GOOD, LONGEST, find_spot, follow

START = 1_800_000_000_000_000_000
DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
T = TypeVar("T")


def scene(kind: str, rng: np.random.Generator) -> np.ndarray:
    """A scene from dim to bright; seeds here are none of the calibration's."""
    return SCENES[kind](rng) * rng.uniform(0.2, 1.2)


@pytest.mark.parametrize("kind", SCENES)
def test_present_and_absent(kind: str) -> None:
    errors, found, quiet = [], 0, 0
    for seed in range(8):
        rng = np.random.default_rng([77, seed])
        field, laser = scene(kind, rng), Laser.random(rng, low=120)
        spot = find_spot(expose(field + laser.drawn(), rng))
        error = np.hypot(spot.x - laser.x, spot.y - laser.y)
        found += bool(spot.quality > 0.5 and error < 1.5)
        errors.append(error)
        quiet += find_spot(expose(field, rng)).quality < 0.5
    assert found >= 7 and quiet >= 7
    # Grain as wide as the spot and an eighth as strong moves it by some 0.2 px; the others have none.
    assert np.median(errors) < (0.3 if kind in ("mixed", "glints") else 0.1)


@functools.cache
def moderate_scene(seed: int) -> np.ndarray:
    texture = cv2.GaussianBlur(np.random.default_rng([9, seed]).normal(size=(H, W)).astype(np.float32), (0, 0), 6)
    return 90 + 15 * texture / texture.std()


@pytest.mark.parametrize("amplitude", [100, 150, 600])
@pytest.mark.parametrize("sigma", [1.0, 1.2, 2.0, 3.0])
def test_a_tenth_of_a_pixel_on_a_moderate_scene(amplitude: float, sigma: float) -> None:
    errors = []
    for seed in range(6):
        rng, field = np.random.default_rng([10, seed]), moderate_scene(seed)
        # The ghost stands 10 px away on the left or on the right: it must not draw the spot over.
        laser = Laser(300 + rng.uniform(), 200 + rng.uniform(), amplitude, sigma, 0.1, 10.0, np.pi * (seed % 2))
        spot = find_spot(expose(field + laser.drawn(), rng))
        assert spot.quality > 0.5
        assert spot.sigma == pytest.approx(sigma, rel=0.25)
        if amplitude == 150:
            assert spot.peak == pytest.approx(150, rel=0.2)
        errors.append((spot.x - laser.x, spot.y - laser.y))
    assert np.sqrt(np.mean(np.square(errors))) < 0.1


def test_depth_scale_and_background_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    field, laser = scene("mixed", rng), Laser(400.3, 99.7, 150, 1.2)
    image = expose(field + laser.drawn(), rng)
    plain = find_spot(image)
    assert np.hypot(plain.x - laser.x, plain.y - laser.y) < 0.2
    twelve = find_spot(image.astype(np.uint16) * 16, full_scale=255 * 16)
    real = find_spot(image / 255, full_scale=1.0)
    for other, scale in ((twelve, 16), (real, 1 / 255)):
        assert (other.x, other.y) == pytest.approx((plain.x, plain.y), abs=1e-3)
        assert other.quality == pytest.approx(plain.quality, abs=1e-3)
        assert other.peak == pytest.approx(plain.peak * scale, rel=1e-3)
    weak = Laser(400.3, 99.7, 25, 1.2)
    image = expose(field + weak.drawn(), rng)
    helped = find_spot(image, background=expose(field, rng))
    assert helped.quality > max(0.5, find_spot(image).quality)
    assert np.hypot(helped.x - weak.x, helped.y - weak.y) < 0.5


@pytest.mark.parametrize("place", [(0, 0), (2.2, 300.4), (W - 2.6, H - 3.1), (W - 1, 100)])
def test_at_the_edge(place: tuple[float, float]) -> None:
    rng = np.random.default_rng(4)
    laser = Laser(*place, 180, 1.5)
    spot = find_spot(expose(60 + laser.drawn(), rng))
    assert spot.quality > 0.5
    assert np.hypot(spot.x - laser.x, spot.y - laser.y) < 0.3


def test_pictures_without_anything() -> None:
    for image in (
        np.zeros((40, 50), np.uint8),
        np.full((40, 50), 255, np.uint8),
        np.full((40, 50), 7, np.uint16),
    ):
        assert find_spot(image).quality < 0.5
    flat = find_spot(np.zeros((40, 50), np.float32))
    assert (flat.x, flat.y, flat.quality) == (24.5, 19.5, 0.0)


def test_bad_images() -> None:
    with pytest.raises(InputError, match=r"must be \[H, W\]"):
        find_spot(np.zeros((40, 50, 3), np.uint8))
    with pytest.raises(InputError, match="13 x 13"):
        find_spot(np.zeros((12, 50), np.uint8))
    with pytest.raises(InputError, match="NaN"):
        find_spot(np.full((40, 50), np.nan))
    with pytest.raises(InputError, match="background"):
        find_spot(np.zeros((40, 50), np.uint8), np.zeros((50, 40), np.uint8))


@pytest.mark.skipif(not DATA.is_dir(), reason="the real frames of ../shared/data are not here")
def test_a_laser_drawn_into_real_frames() -> None:
    for name in ("t-348mm.pgm", "t-480mm.pgm", "t-770mm.pgm", "t-hene.pgm"):
        real, _ = read_image(DATA / "laser-spots" / name)
        rng = np.random.default_rng(1)
        laser = Laser(150.4, 620.7, 150, 1.3)
        light = laser.drawn((real.shape[0], real.shape[1]))
        image = np.clip(real + light, 0, 255).astype(np.uint8)
        spot = find_spot(image)
        assert np.hypot(spot.x - laser.x, spot.y - laser.y) < 0.15, name
        assert spot.quality > 0.5, name
        # The beams themselves are wide: none is taken for a small spot.
        assert find_spot(real).quality < 0.5, name
        del rng


def path_of(seconds: np.ndarray) -> np.ndarray:
    """Where the laser is, [N, 2] px: a sweep as slow as a hand's."""
    x = 150 + 80 * np.sin(2 * np.pi * seconds / 5)
    return np.stack([x, 110 + 50 * np.cos(2 * np.pi * seconds / 4)], axis=1)


SMALL = (220, 300)


def filmed(folder: Path, *, dark: Iterable[int] = (), decoys: Iterable[int] = (), laser: bool = True) -> Recording:
    """Film 45 frames: probe on the beat, target 20 ms later on average with jitter.

    In the target frames `dark` the laser is away; in `decoys` a like spot stands somewhere else instead.
    """
    rng = np.random.default_rng(11)
    probe = np.arange(45) / 15
    target = np.arange(-1, 46) / 15 + 0.02 + rng.uniform(-0.008, 0.008, 47)
    y, x = np.mgrid[: SMALL[0], : SMALL[1]]
    texture = cv2.GaussianBlur(rng.normal(size=(400, 500)).astype(np.float32), (0, 0), 4)
    texture = 80 + 20 * texture / texture.std()
    streams = {"probe": StreamInfo(20, 20), "target": StreamInfo(*SMALL)}
    with RecordingWriter(folder / "a.rec", streams=streams, rate=15, start_utc_ns=START) as writer:
        for number, moment in enumerate(probe):
            image = np.zeros((20, 20), np.uint8)
            writer.write("probe", image, monotonic_ns=number, utc_ns=START + round(moment * 1e9))
        for number, (moment, place) in enumerate(zip(target, path_of(target), strict=True)):
            light = texture[number : number + SMALL[0], number : number + SMALL[1]].copy()
            if number in decoys:
                place = place + np.array([70, -40])
            if laser and number not in dark:
                light += 150 * np.exp(-((x - place[0]) ** 2 + (y - place[1]) ** 2) / (2 * 1.2**2))
            utc = START + round(moment * 1e9)
            writer.write("target", expose(light, rng), monotonic_ns=number, utc_ns=utc)
    return open_recording(folder / "a.rec")


def test_labels_follow_the_laser(tmp_path: Path) -> None:
    recording = filmed(tmp_path, dark=(20, 21, 22, 23, 24), decoys=(33,))
    seen: list[str] = []

    def progress(items: Iterable[T], what: str, *, total: int | None = None) -> Iterator[T]:
        seen.append(f"{what} {total}")
        yield from items

    summary = label_recording(recording, progress)
    assert seen == ["finding the laser 47"]
    labels = recording.labels()
    assert labels is not None
    names = ["frame", "gaze_x", "gaze_y", "spot_x", "spot_y", "how", "quality", "reach_back", "reach_ahead"]
    names += ["gaze_x_std", "gaze_y_std"]
    assert labels.column_names == names
    assert labels["frame"].to_pylist() == list(range(45)) and set(labels["how"].to_pylist()) == {"laser-spot"}
    spot = np.array([labels["spot_x"].to_numpy(), labels["spot_y"].to_numpy()]).T
    truth = path_of(np.arange(45) / 15)
    there = np.isfinite(spot[:, 0])
    # Probe frame n lies between target frames n and n + 1.
    missing = {n for n in range(45) if {n, n + 1} & {20, 21, 22, 23, 24, 33}}
    assert set(np.flatnonzero(~there)) == missing
    assert labels["gaze_x"].null_count == len(missing)
    errors = spot[there] - truth[there]
    assert np.sqrt((errors**2).mean()) < 0.25
    gaze = np.array([labels["gaze_x"].to_numpy(), labels["gaze_y"].to_numpy()]).T[there]
    assert np.allclose(gaze, (spot[there] - [149.5, 109.5]) / [300, 220])
    quality = labels["quality"].to_numpy()
    assert (quality[there] > 0.5).all() and (quality[~there] < 0.5).all()
    assert (summary.n, summary.labelled, summary.no_spot, summary.no_partner) == (
        45,
        there.sum(),
        len(missing),
        0,
    )
    assert (summary.target_frames, summary.spots) == (47, 41) and summary.median_quality > 0.5


def test_a_target_video_without_the_laser(tmp_path: Path) -> None:
    recording = filmed(tmp_path, laser=False)
    with pytest.raises(InputError, match=r"target\.mkv: no laser spot found \(in 0 of 47 frames\); aim"):
        label_recording(recording)
    assert recording.labels() is None


def _seen(places: np.ndarray, odds: np.ndarray) -> list[Candidates]:
    one = np.ones(1)
    return [
        Candidates(x=at[:1], y=at[1:], odds=np.array([odd]), peak=one, snr=one, sigma=one)
        for at, odd in zip(places, odds, strict=True)
    ]


def test_streaks_of_a_fast_gaze_confirm_each_other() -> None:
    # A sweep of 800 px/s with a tremor of 4 px, at 60 fps; streaks are no round spots.
    times = np.arange(60) / 60
    path = np.stack([40 + 800 * times + 4 * np.sin(60 * times), 200 + 80 * times], axis=1)
    fast = slice(20, 38)
    odds = np.full(60, 3.0)
    odds[fast] = -2.0
    place, quality = follow(times, _seen(path, odds))
    assert (quality >= GOOD).all()
    np.testing.assert_array_equal(place, path)
    # One that is no candidate at all is not taken for the laser, the others are.
    odds[25] = -9.0
    assert np.flatnonzero(follow(times, _seen(path, odds))[1] < GOOD).tolist() == [25]


@pytest.mark.parametrize("off", ["elsewhere", "scattered", "too long"])
def test_what_stands_for_a_laser_that_is_off_is_not_confirmed(off: str) -> None:
    times = np.arange(90) / 60
    path = np.stack([100 + 300 * times, 200 + 80 * times], axis=1)
    dark = slice(20, 20 + (LONGEST + 1 if off == "too long" else 18))
    odds = np.full(90, 3.0)
    odds[dark] = -2.0
    if off == "elsewhere":
        # A lamp that moves with the room, as the laser did.
        path[dark] += [40.0, -25.0]
    if off == "scattered":
        path[dark] = np.random.default_rng(0).uniform(0, 400, path[dark].shape)
    quality = follow(times, _seen(path, odds))[1]
    assert (quality[dark] < GOOD).all()
