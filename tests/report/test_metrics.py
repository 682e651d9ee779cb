from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tapetum.errors import InputError
from tapetum.report import (
    coverage,
    error_by_distance,
    mae,
    predict_mean,
    rmse,
    score_gaze,
    score_labels,
    sign_right,
    wilson_interval,
)


def test_mae_and_rmse_of_known_errors() -> None:
    truth = np.zeros((4, 2))
    predicted = np.array([[0.1, 0.0], [-0.1, 0.0], [0.3, 0.0], [-0.3, 0.4]])
    assert mae(truth, predicted) == pytest.approx([0.2, 0.1])
    assert rmse(truth, predicted) == pytest.approx([np.sqrt(0.05), 0.2])


@given(st.integers(1, 30), st.integers(0, 2**31))
@settings(max_examples=15, deadline=None)
def test_rmse_is_never_below_mae_and_both_agree_with_scikit_learn(count: int, seed: int) -> None:
    from sklearn.metrics import mean_absolute_error, mean_squared_error

    a, b = np.random.default_rng(seed).normal(size=(2, count, 2))
    assert np.all(rmse(a, b) >= mae(a, b) - 1e-12)
    assert mae(a, b) == pytest.approx(mean_absolute_error(a, b, multioutput="raw_values"))
    assert rmse(a, b) ** 2 == pytest.approx(mean_squared_error(a, b, multioutput="raw_values"))


@pytest.mark.parametrize(
    ("truth", "predicted", "said"),
    [
        ([0.0, np.nan], [0.0, 0.0], "1 of 2 values are not finite"),
        ([], [], "holds no frame"),
        ([0.0], [0.0, 1.0], "equal shapes"),
    ],
)
def test_bad_input_is_named(truth: list[float], predicted: list[float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        mae(truth, predicted)


def test_gaze_scores_of_a_hand_made_case() -> None:
    truth = np.array([[0.1, 0.0], [-0.2, 0.0], [0.4, 0.3], [0.0, -0.02]])
    predicted = truth + np.array([[0.03, 0.04], [0.3, 0.0], [0.0, 0.0], [0.0, 0.0]])
    scores = score_gaze(truth, predicted, sign_threshold=0.05)
    assert scores.count == 4
    assert scores.mae == pytest.approx((0.0825, 0.01))
    assert scores.mae_overall == pytest.approx(0.04625)
    assert scores.radial == pytest.approx((0.05 + 0.3) / 4)
    assert scores.radial_rms == pytest.approx(np.sqrt(2) * scores.rmse_overall)
    # -0.2 became +0.1: one of three signs in x is wrong; -0.02 in y is too near the axis to count.
    assert scores.sign_right == (pytest.approx(2 / 3), 1.0)
    assert scores.sign_count == (3, 1)
    assert [third.count for third in scores.thirds] == [2, 1, 1]
    assert scores.thirds[1].mae == pytest.approx(0.15)
    assert scores.thirds[2].mae == 0.0


def test_an_empty_third_says_none_and_scores_fit_json() -> None:
    scores = score_gaze(np.full((3, 2), 0.01), np.zeros((3, 2)))
    assert scores.thirds[2].mae is None
    assert scores.sign_right == (None, None)
    table = json.loads(json.dumps(scores.to_dict(), allow_nan=False))
    assert table["thirds"][2] == {"inner": 1 / 3, "outer": None, "count": 0, "mae": None, "rmse": None}


def test_gaze_needs_two_columns() -> None:
    with pytest.raises(InputError, match=r"\[N, 2\]"):
        score_gaze(np.zeros((3, 3)), np.zeros((3, 3)))


@pytest.mark.parametrize("threshold", [np.nan, np.inf, -0.1])
def test_a_threshold_that_is_no_distance_is_refused(threshold: float) -> None:
    with pytest.raises(InputError, match="sign_threshold: must be 0 or more, is"):
        score_gaze(np.zeros((3, 2)), np.zeros((3, 2)), sign_threshold=threshold)


def test_predicting_zero_tells_no_sign() -> None:
    assert sign_right([0.2, -0.2, 0.01], [0.0, -0.1, 5.0]) == (1, 2)


def test_mean_baseline_repeats_the_training_mean() -> None:
    assert predict_mean([[0.0, 1.0], [1.0, 2.0]], 3).tolist() == [[0.5, 1.5]] * 3


def test_coverage_counts_closed_intervals_and_infinite_ends() -> None:
    truth = np.array([[0.0, 0.0], [1.0, 1.0]])
    low = np.array([[0.0, -np.inf], [2.0, -np.inf]])
    assert coverage(truth, low, np.full((2, 2), np.inf)).tolist() == [0.5, 1.0]
    with pytest.raises(InputError, match="without NaN"):
        coverage(truth, np.full((2, 2), np.nan), low)


def test_wilson_interval_agrees_with_scipy() -> None:
    from scipy.stats import binomtest

    expected = binomtest(43, 50).proportion_ci(method="wilson")
    assert wilson_interval(43, 50, z=1.959963984540054) == pytest.approx((expected.low, expected.high))
    with pytest.raises(InputError):
        wilson_interval(0, 0)


def test_label_scores_leave_out_frames_without_a_spot() -> None:
    true = np.zeros((4, 2))
    found = np.array([[3.0, 4.0], [np.nan, np.nan], [0.0, 1.0], [0.0, -1.0]])
    scores = score_labels(found, true)
    assert (scores.count, scores.total) == (3, 4)
    assert (scores.median, scores.largest) == (1.0, 5.0)
    assert scores.rms == pytest.approx(3.0)
    assert scores.bias == pytest.approx((1.0, 4 / 3))
    with pytest.raises(InputError, match="none of 4 frames"):
        score_labels(np.full((4, 2), np.nan), true)


def test_rings_average_to_the_overall_error_and_hold_their_bars() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(-0.5, 0.5, (600, 2))
    predicted = truth + 0.1 * rng.normal(size=truth.shape)
    rings = error_by_distance(truth, predicted, seed=1)
    assert rings.count.sum() == 600
    assert float(np.average(rings.mae, weights=rings.count)) == pytest.approx(score_gaze(truth, predicted).mae_overall)
    assert np.all((rings.low <= rings.mae) & (rings.mae <= rings.high))
    again = error_by_distance(truth, predicted, seed=1)
    assert np.array_equal(rings.low, again.low)


def test_rings_bars_are_wider_where_neighbours_share_their_error() -> None:
    rng = np.random.default_rng(2)
    truth = np.full((900, 2), 0.1)
    shared = np.repeat(0.1 * rng.normal(size=(60, 2)), 15, axis=0)
    edges = [0.0, 0.5]
    blocks = error_by_distance(truth, truth + shared, edges=edges, block=15)
    single = error_by_distance(truth, truth + shared, edges=edges, block=1)
    assert (blocks.high - blocks.low)[0] > 2.5 * (single.high - single.low)[0]


def test_an_empty_ring_is_not_a_number_that_says_so() -> None:
    rings = error_by_distance([[0.1, 0.0]], [[0.2, 0.0]], edges=[0.0, 0.2, 0.4])
    assert rings.count.tolist() == [1, 0]
    assert rings.mae[0] == pytest.approx(0.05)
    assert np.isnan([rings.mae[1], rings.low[1], rings.high[1]]).all()
    with pytest.raises(InputError, match="must rise"):
        error_by_distance([[0.1, 0.0]], [[0.2, 0.0]], edges=[0.4, 0.2])
