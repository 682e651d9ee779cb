"""Intervals hold what they promise, and hang on the SNR where the error does."""

from __future__ import annotations

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.models.intervals import Intervals, conformal_half_width, fit_intervals


def test_conformal_intervals_cover_what_they_promise():
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(2000):
        residuals = rng.standard_t(3, (30, 1))
        inside.append(abs(residuals[29]) <= conformal_half_width(residuals[:29]))
    # 29 frames: the 27th of 30 places, exactly 90 %.
    assert np.mean(inside) == pytest.approx(0.9, abs=0.02)


def test_too_few_frames_promise_nothing():
    assert np.isinf(conformal_half_width(np.zeros((8, 2)))).all()
    assert np.isfinite(conformal_half_width(np.zeros((9, 2)))).all()


def errors(count: int, seed: int, *, hangs_on_snr: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals [N, 1] and SNR [N]; the error falls with the SNR, or does not."""
    rng = np.random.default_rng(seed)
    snr = rng.uniform(10, 1000, count)
    spread = 1 / snr if hangs_on_snr else np.full(count, 0.01)
    return (spread * rng.normal(size=count))[:, None], snr


def test_faint_frames_get_wide_intervals_where_they_need_them():
    fitted = fit_intervals(*errors(3000, 0, hangs_on_snr=True))
    assert fitted.conditional
    residuals, snr = errors(20000, 1, hangs_on_snr=True)
    inside = np.abs(residuals) <= fitted.at(snr)
    faint = snr < np.quantile(snr, 0.2)
    assert inside.mean() == pytest.approx(0.9, abs=0.02)
    assert inside[faint].mean() == pytest.approx(0.9, abs=0.05)
    # One width for all leaves the faint ones out.
    plain = np.abs(residuals) <= conformal_half_width(errors(3000, 0, hangs_on_snr=True)[0])
    assert plain[faint].mean() < 0.75
    assert float(fitted.at(np.array([20.0]))[0, 0]) > 3 * float(fitted.at(np.array([900.0]))[0, 0])


def test_intervals_stay_plain_where_the_snr_does_not_matter():
    for seed in range(5):
        assert not fit_intervals(*errors(600, seed, hangs_on_snr=False)).conditional


def test_few_frames_are_not_divided():
    assert not fit_intervals(*errors(80, 0, hangs_on_snr=True)).conditional
    none = fit_intervals(np.empty((0, 2)), np.empty(0))
    assert np.isinf(none.at(np.array([5.0]))).all()


@pytest.mark.parametrize("hangs", [False, True])
def test_intervals_come_back(hangs: bool):
    fitted = fit_intervals(*errors(1000, 0, hangs_on_snr=hangs))
    again = Intervals.from_state(fitted.state("scaling."), 1, "scaling.")
    np.testing.assert_array_equal(again.half_width, fitted.half_width)
    np.testing.assert_array_equal(again.edges, fitted.edges)


def test_intervals_of_another_model_are_told():
    state = fit_intervals(*errors(1000, 0, hangs_on_snr=True)).state()
    with pytest.raises(InputError, match="half_width of 2 quantities"):
        Intervals.from_state(state, 2)
    with pytest.raises(InputError, match="half_width of 1 quantities and 1 classes"):
        Intervals.from_state({"half_width": state["half_width"]}, 1)
    with pytest.raises(InputError, match="half_width"):
        Intervals.from_state({}, 1)
