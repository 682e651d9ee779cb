"""Centres and crops, on images whose answer is known."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapetum.data import crop, crop_batch, find_centre, find_peak
from tapetum.data.crop import crops_of
from tapetum.errors import InputError


def spot(x: float, y: float, *, shape=(120, 160), sigma=6.0, height=150.0, background=12.0, noise=2.0, seed=0):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    image = background + height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))
    image = image + np.random.default_rng(seed).normal(0, noise, shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@settings(max_examples=25, deadline=None)
@given(st.floats(20, 140), st.floats(20, 100))
def test_the_centre_is_found_to_a_fraction_of_a_pixel(x: float, y: float):
    found = find_centre(spot(x, y))
    assert math.dist(found, (x, y)) < 0.5


def test_a_saturated_spot_is_centred_on_its_middle():
    image = spot(70, 50, sigma=20, height=4000)
    assert (image == 255).sum() > 2000
    assert math.dist(find_centre(image), (70, 50)) < 1


def test_a_hot_pixel_is_not_a_retro_reflection():
    image = spot(70, 50, height=25, noise=1)
    image[20, 120] = 255
    assert math.dist(find_centre(image), (70, 50)) < 2


def lit_room(rr: float, seed: int = 0) -> np.ndarray:
    """A blurred lamp at (480, 60), and at (250, 300) an RR of rings so high, as a fast lens returns it far off axis."""
    rows, columns = np.mgrid[:500, :600]
    lamp = 9 * np.exp(-((columns - 480.0) ** 2 + (rows - 60.0) ** 2) / (2 * 70**2))
    away = np.hypot(columns - 250.0, rows - 300.0)
    rings = rr * np.cos(away / 5) ** 2 * np.exp(-((away / 30) ** 2))
    counts = 4 + lamp + rings + np.random.default_rng(seed).normal(0, 0.3, rows.shape)
    return np.clip(np.rint(counts), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("rr", [3, 5, 12])
def test_a_lit_room_is_not_a_retro_reflection(rr: float):
    image = lit_room(rr)
    brightest = find_peak(image)
    assert math.dist((brightest.x, brightest.y), (480, 60)) < 40
    assert math.dist(find_centre(image), (250, 300)) < 6


def test_what_is_smooth_is_centred_where_there_is_nothing_else():
    peak = find_peak(lit_room(0))
    assert find_centre(lit_room(0)) == (peak.x, peak.y)


def test_near_looks_only_there_and_sees_the_same_image():
    image = np.maximum(spot(40, 60, height=200), spot(120, 60, height=80, seed=1))
    assert math.dist(find_centre(image), (40, 60)) < 0.5
    x, y = find_centre(image, near=(118, 62, 15))
    assert math.dist((x, y), (120, 60)) < 0.5
    # Around the brightest point both ways agree exactly: the window does not change the smoothing.
    assert find_centre(image, near=(42, 58, 20)) == pytest.approx(find_centre(image), abs=1e-3)


def test_snr_tells_a_spot_from_noise():
    noise = np.array([find_peak(spot(0, 0, height=0, seed=s)).snr for s in range(20)])
    assert np.median(noise) < 5
    assert noise.max() < 6
    assert find_peak(spot(80, 60, height=12)).snr > 6


@pytest.mark.parametrize("mean", [1.6, 3.0, 3.3, 3.5])
def test_a_background_between_two_counts_is_no_signal(mean: float):
    # Hardly any noise but that of rounding: the median of the pixels is a whole number, up to half a count beside it.
    rng = np.random.default_rng(1)
    for noise in (0.1, 0.3, 0.5):
        dark = np.rint(rng.normal(mean, noise, (400, 400))).astype(np.uint8)
        peak = find_peak(dark, 4.0)
        assert peak.snr < 10
        assert peak.height < 0.4


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_a_blank_image_has_no_signal_and_no_nan(dtype):
    peak = find_peak(np.full((30, 41), 7, dtype=dtype))
    assert (peak.x, peak.y, peak.snr) == (20, 14.5, 0)


def test_depths_agree():
    image = spot(70, 50)
    assert find_centre(image.astype(np.uint16) * 256) == pytest.approx(find_centre(image), abs=1e-3)
    assert find_centre(image / 255) == pytest.approx(find_centre(image), abs=1e-3)


@settings(max_examples=50, deadline=None)
@given(st.floats(-10, 60), st.floats(-10, 50), st.integers(1, 70))
def test_a_crop_is_the_image_around_its_centre(x: float, y: float, side: int):
    image = np.arange(40 * 50, dtype=np.uint16).reshape(40, 50)
    cut = crop(image, (x, y), side)
    assert cut.shape == (side, side)
    assert cut.dtype == image.dtype
    left, top = math.floor(x - (side - 1) / 2 + 0.5), math.floor(y - (side - 1) / 2 + 0.5)
    assert abs(left + (side - 1) / 2 - x) <= 0.5 + 1e-9
    for row in range(0, side, 7):
        for column in range(0, side, 5):
            inside = 0 <= top + row < 40 and 0 <= left + column < 50
            expected = image[top + row, left + column] if inside else round(float(np.median(image)))
            assert cut[row, column] == expected


def test_a_crop_is_a_copy():
    image = np.zeros((9, 9), np.uint8)
    crop(image, (4, 4), 3)[:] = 1
    assert not image.any()


def test_a_batch_is_its_crops():
    images = np.random.default_rng(0).integers(0, 255, (3, 20, 30), dtype=np.uint8)
    centres = np.array([[3.2, 4.0], [15, 10], [29, 19]])
    cut = crop_batch(images, centres, 8)
    for n in range(3):
        np.testing.assert_array_equal(cut[n], crop(images[n], tuple(centres[n]), 8))


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: find_centre(np.zeros((4, 4, 3), np.uint8)), "grey image"),
        (lambda: find_centre(np.full((9, 9), np.nan)), "not finite"),
        (lambda: find_centre(np.zeros((9, 9), np.uint8), sigma=0), "sigma"),
        (lambda: find_centre(np.zeros((9, 9), np.uint8), near=(90, 4, 3)), "near"),
        (lambda: find_centre(np.zeros((9, 9), dtype=bool)), "grey levels"),
        (lambda: crop(np.zeros((9, 9), np.uint8), (math.nan, 1), 4), "finite"),
        (lambda: crop(np.zeros((9, 9), np.uint8), (1, 1), 0), "side"),
        (lambda: crop_batch(np.zeros((2, 9, 9), np.uint8), np.zeros((3, 2)), 4), "centres"),
    ],
)
def test_bad_input_is_told(call, word: str):
    with pytest.raises(InputError, match=word):
        call()


@pytest.mark.parametrize("shape", [(6, 7), (5, 5), (1, 2)])
def test_what_lies_outside_gets_the_exact_median(shape: tuple[int, int]):
    """Of bytes it is found from their counts; of an even number it is the rounded mean of the two in the middle."""
    rng = np.random.default_rng(2)
    for top in (2, 40, 256):
        image = rng.integers(0, top, shape).astype(np.uint8)
        assert crop(image, (-50, -50), 3).tolist() == [[int(np.rint(np.median(image)))] * 3] * 3


def test_squares_of_one_image_share_its_median(monkeypatch: pytest.MonkeyPatch):
    """A median of five megapixels takes longer than many squares."""
    asked = []
    monkeypatch.setattr(
        importlib.import_module("tapetum.data.crop"), "_median", lambda image: asked.append(image.shape) or 7.0
    )
    image = np.random.default_rng(0).integers(0, 255, (40, 60), np.uint8)
    places = np.array([[1.0, 1.0], [30.2, 19.7], [58.0, 39.0], [-100.0, 5.0]])
    cut = crops_of(image, places, 9)
    assert asked == [(40, 60)]
    for one, (x, y) in zip(cut, places.tolist(), strict=True):
        assert (one == crop(image, (x, y), 9)).all()
    assert crops_of(image, np.empty((0, 2)), 9).shape == (0, 9, 9)
