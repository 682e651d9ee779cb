"""The SNR of a crop against the formula, whatever the depth and the background."""

from __future__ import annotations

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.models import crop_snr


def spot(peak: float, noise: float, *, background: float = 40.0, seed: int = 0) -> np.ndarray:
    at = np.arange(64) - 31.5
    clean = background + peak * np.exp(-(at[:, None] ** 2 + at**2) / (2 * 4.0**2))
    return clean + np.random.default_rng(seed).normal(0, noise, clean.shape)


def test_a_gaussian_spot_has_the_snr_of_its_matched_filter():
    # The sum of squares of a Gaussian spot is pi s^2 peak^2; what lies under the gate of 4 deviations is left out.
    images = np.stack([spot(80, 2.0, seed=n) for n in range(20)])
    wanted = np.sqrt(np.pi * 16) * 80 / 2.0
    assert crop_snr(np.clip(images, 0, None), 255).mean() == pytest.approx(wanted, rel=0.03)


def test_neither_background_nor_depth_changes_it():
    faint, bright = spot(80, 2.0), spot(80, 2.0, background=90.0)
    same = crop_snr(np.rint(np.stack([faint, bright])).astype(np.uint8))
    assert same[0] == pytest.approx(same[1], rel=0.02)
    deep = crop_snr(np.rint(257 * faint).astype(np.uint16)[None], 65535)
    assert deep[0] == pytest.approx(same[0], rel=0.03)


def test_an_empty_picture_has_none_and_a_flat_one_is_no_division_by_zero():
    assert crop_snr(np.full((1, 32, 32), 7, np.uint8))[0] == 0
    assert crop_snr(np.clip(spot(0, 2.0), 0, None)[None], 255)[0] < 15


@pytest.mark.parametrize("level", [np.nan, np.inf, -1.0])
def test_levels_that_are_none_are_refused(level: float) -> None:
    images = np.full((1, 32, 32), 7.0)
    images[0, 3, 3] = level
    with pytest.raises(InputError, match="images: intensities must be finite and not negative"):
        crop_snr(images, 255)


def test_negative_whole_levels_are_refused() -> None:
    with pytest.raises(InputError, match="images: intensities must be finite and not negative"):
        crop_snr(np.full((1, 32, 32), -7), 255)


@pytest.mark.parametrize("side", [0, 1, 3])
def test_crops_without_corners_are_refused(side: int) -> None:
    with pytest.raises(InputError, match=f"images: crops of {side} x {side} pixels have no corners"):
        crop_snr(np.full((2, side, side), 7, np.uint8))
    assert crop_snr(np.full((2, 4, 4), 7, np.uint8)).tolist() == [0, 0]
