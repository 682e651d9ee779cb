"""The SNR of a crop against the formula, whatever the depth and the background."""

from __future__ import annotations

import numpy as np
import pytest

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
