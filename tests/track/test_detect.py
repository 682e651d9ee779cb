"""Detection on frames whose content is known."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from probe_frames import HEIGHT, WIDTH, add_spot, hot_pixels, probe_frame

import measure_empty
from tapetum.errors import InputError
from tapetum.track import Detections, detect


def airy(x: float, y: float, *, height: float = 120.0, seed: int = 0) -> np.ndarray:
    """Return a frame with an Airy pattern, 5 px between the first zeros."""
    from scipy.special import j1

    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    v = 3.8317 * np.hypot(columns - x, rows - y) / 2.5 + 1e-9
    light = 8 + height * (2 * j1(v) / v) ** 2
    return np.clip(np.rint(light + np.random.default_rng(seed).normal(0, 2, light.shape)), 0, 255).astype(np.uint8)


# The same places every time: of all places of the frame noise moves the smoothed top by 9 px or more at a few, by 11.4
# at the worst that was found.
@settings(max_examples=12, deadline=None, derandomize=True)
@given(st.floats(10, 630), st.floats(10, 470))
def test_an_airy_spot_is_found_to_a_fifth_of_a_pixel(x: float, y: float):
    found = detect(airy(x, y))
    assert len(found) == 1
    assert math.dist((found.x[0], found.y[0]), (x, y)) < 0.2
    # The smoothing that finds the brightest point is far wider than this spot, and near the border loses part of it;
    # the point stays within the spot's own surroundings all the same.
    assert math.dist((found.peak_x[0], found.peak_y[0]), (x, y)) < 9
    assert 2 < found.diameter[0] < 6


@pytest.mark.parametrize("width", [20, 40, 60, 150])
def test_a_fringed_spot_is_one_detection_at_its_centroid(width: int):
    rng = np.random.default_rng(width)
    found = detect(probe_frame(rng, [(330.3, 236.8, width, 90, 0.7, 0.4)], hot_pixels(1)))
    clean = np.zeros((HEIGHT, WIDTH))
    add_spot(clean, 330.3, 236.8, width, 90, 0.7, 0.4)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    centroid = (clean * columns).sum() / clean.sum(), (clean * rows).sum() / clean.sum()
    assert len(found) == 1
    assert math.dist((found.x[0], found.y[0]), centroid) < max(0.3, 0.02 * width)
    assert found.diameter[0] == pytest.approx(width, rel=0.12)


def test_a_faint_wide_spot_is_found_though_no_pixel_of_it_stands_out():
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    glow = 3.0 * np.exp(-((columns - 400) ** 2 + (rows - 150) ** 2) / (2 * 20**2))
    image = np.clip(np.rint(12 + glow + rng.normal(0, 2, glow.shape)), 0, 255).astype(np.uint8)
    found = detect(image)
    assert len(found) == 1
    assert math.dist((found.x[0], found.y[0]), (400, 150)) < 6


def test_a_saturated_disc_is_one_detection_and_counts_its_full_pixels():
    image = probe_frame(np.random.default_rng(4))
    cv2.circle(image, (200, 300), 40, 255, -1)
    found = detect(image)
    assert len(found) == 1
    assert math.dist((found.x[0], found.y[0]), (200, 300)) < 0.5
    assert math.dist((found.peak_x[0], found.peak_y[0]), (200, 300)) < 2
    assert found.saturated[0] == np.count_nonzero(image == 255)
    assert detect(image, full_scale=300).saturated[0] == 0


def test_a_spot_cut_by_the_frames_edge_says_so():
    found = detect(probe_frame(np.random.default_rng(5), [(2, 200, 40, 120), (400, 200, 40, 120)]))
    assert sorted(zip(found.x > 100, found.edge, strict=True)) == [(False, True), (True, False)]


def test_empty_frames_give_no_detections():
    """150 frames with 60 hot pixels each, on grounds from black (clipped) to bright: fewer than 0.01 each."""
    rng, hot = np.random.default_rng(6), hot_pixels(2)
    count = sum(len(detect(probe_frame(rng, (), hot, [6.0, 1.0, 20.0, 0.2][n % 4]))) for n in range(150))
    assert count / 150 < 0.01


@pytest.mark.parametrize("value", [0, 7, 255])
def test_a_flat_frame_gives_none(value: int):
    assert len(detect(np.full((120, 160), value, np.uint8))) == 0


def test_a_slope_is_no_spot():
    ramp = np.linspace(0, 250, WIDTH)[None, :] * np.linspace(0.5, 1, HEIGHT)[:, None]
    noisy = ramp + np.random.default_rng(7).normal(0, 2, ramp.shape)
    assert len(detect(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))) == 0


def test_defects_and_the_stamp_in_the_first_row_do_not_fire():
    image = probe_frame(np.random.default_rng(8))
    image[0, :4] = 216, 177, 54, 175  # the frame stamp that machine-vision cameras write
    image[100, 200] = 255
    image[0, 320] = image[479, 0] = image[240, 639] = 200
    image[300, 50:53] = 180  # part of a hot row
    image[350:460, 500] = 90  # a hot column
    assert len(detect(image)) == 0


def test_the_ghost_is_dropped_or_marked_or_kept():
    rng = np.random.default_rng(9)
    image = probe_frame(rng, [(250, 240, 40, 150), (310, 260, 40, 15)])
    assert len(detect(image)) == 1
    marked = detect(image, ghosts="mark")
    assert marked.ghost.tolist() == [False, True]
    assert math.dist((marked.x[1], marked.y[1]), (310, 260)) < 3
    assert len(marked.without_ghosts) == 1
    assert len(detect(image, ghost_ratio=0.0)) == 2
    assert len(detect(image, ghost_radius=40.0)) == 2
    # The ghost hardly moves the centroid of its spot.
    assert math.dist((marked.x[0], marked.y[0]), (250, 240)) < 0.5


def test_two_cameras_are_two_detections_brightest_first():
    rng = np.random.default_rng(10)
    found = detect(probe_frame(rng, [(150, 240, 30, 60), (250, 240, 30, 150), (560, 100, 30, 20)]))
    assert [round(x / 10) for x in found.x] == [25, 15, 56]
    assert (np.diff(found.peak) < 0).all()


def test_the_answer_does_not_depend_on_the_kind_of_number():
    image = probe_frame(np.random.default_rng(11), [(250, 240, 40, 150, 0.3)])
    eight, sixteen, real = (
        detect(image),
        detect(image.astype(np.uint16) * 257),
        detect(image.astype(float) / 255),
    )
    for other, scale in ((sixteen, 257), (real, 1 / 255)):
        assert len(eight) == len(other) == 1
        assert other.x[0] == pytest.approx(eight.x[0], abs=0.02)
        assert other.diameter[0] == pytest.approx(eight.diameter[0], rel=0.01)
        assert other.peak[0] == pytest.approx(eight.peak[0] * scale, rel=0.01)
        assert math.isfinite(other.snr[0])


@settings(max_examples=30, deadline=None)
@given(st.integers(8, 70), st.integers(8, 70), st.integers(0, 2**32 - 1))
def test_any_frame_gives_finite_detections(height: int, width: int, seed: int):
    rng = np.random.default_rng(seed)
    image = rng.integers(0, rng.integers(2, 256), (height, width)).astype(np.uint8)
    image[rng.integers(height) :, rng.integers(width) :] = 255
    found = detect(image, ghosts="mark")  # Detections refuses what is not finite
    assert ((found.x >= -0.5) & (found.x <= width - 0.5)).all()


def test_bad_input_is_told_in_a_line():
    image = np.zeros((48, 64), np.uint8)
    for bad in (np.zeros((3, 48, 64), np.uint8), np.full((48, 64), np.nan), np.zeros((48, 64), complex)):
        with pytest.raises(InputError):
            detect(bad)
    out_of_range: list[dict[str, Any]] = [
        {"min_snr": 0},
        {"max_count": 0},
        {"ghosts": "perhaps"},
        {"ghost_ratio": 2},
        {"stray": -1},
    ]
    for options in out_of_range:
        with pytest.raises(InputError, match=next(iter(options))):
            detect(image, **options)


def test_detections_are_picked_saved_and_read_back(tmp_path):
    found = detect(
        probe_frame(np.random.default_rng(12), [(150, 240, 30, 100), (350, 140, 30, 90), (310, 400, 40, 15)]),
        ghosts="mark",
    )
    path = tmp_path / "one.parquet"
    found.save(path)
    back = Detections.load(path)
    for name in Detections.names():
        assert (getattr(back, name) == getattr(found, name)).all()
    assert len(found[found.x > 200]) == 2 and len(found[0]) == 1 and len(found[-1]) == 1 and len(found[5:]) == 0
    with pytest.raises(IndexError):
        found[3]
    assert len(Detections.empty()) == len(Detections.empty()[[]]) == 0
    Detections.empty().save(path)
    assert len(Detections.load(path)) == 0


def test_damaged_detections_are_refused(tmp_path):
    path = tmp_path / "one.parquet"
    with pytest.raises(InputError, match="no such file"):
        Detections.load(path)
    path.write_bytes(b"PAR1 but not really")
    with pytest.raises(InputError, match="Parquet"):
        Detections.load(path)
    columns = {name: np.zeros(2) for name in Detections.names()}
    with pytest.raises(InputError, match="snr"):
        Detections.of(columns | {"snr": np.zeros(3)})
    with pytest.raises(InputError, match="finite"):
        Detections.of(columns | {"x": np.array([0, math.nan])})
    with pytest.raises(InputError, match="no column snr"):
        Detections.from_table(Detections.empty().to_table().drop_columns("snr"))


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("vignette", 90011),
        ("vignette", 90004),
        ("stray glow", 90009),
        ("stray glow", 93072),
        ("room out of focus", 93065),
        ("dark", 93087),
    ],
)
def test_empty_frames_hold_no_spot(kind: str, seed: int) -> None:
    """No surface of the fourth order fits slow shading to the last, least in corners; noise has rare high places."""
    assert len(detect(measure_empty.frame(kind, seed), largest=400)) == 0


def test_a_broad_spot_with_an_edge_is_found_on_shading() -> None:
    frame = measure_empty.frame("vignette", 90011).astype(np.float32)
    y, x = np.mgrid[: frame.shape[0], : frame.shape[1]]
    disc = frame + 20 * (np.hypot(x - 500, y - 400) < 60)
    found = detect(np.clip(np.rint(disc), 0, 255).astype(np.uint8), largest=400)
    assert len(found) == 1
    assert np.hypot(found.x[0] - 500, found.y[0] - 400) < 3
