"""Estimates over time: what the filter and the smoother promise, and what they refuse."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from tapetum.errors import InputError
from tapetum.track import read_tracks, track_schema, write_tracks
from tapetum.track.kalman import NORMAL, Motion, Series
from tapetum.track.smooth import (
    LiveFilter,
    calibrate,
    fit_motion,
    quantities_in,
    series_of,
    smooth,
    smooth_tracks,
)

RATE = 15.0


def wander(seed: int, count: int, *, rate: float = RATE, extent: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Times and a gaze that sweeps the field at less than 0.3 Hz."""
    rng = np.random.default_rng(seed)
    times = np.arange(count) / rate
    waves = zip(rng.uniform(0.03, 0.3, 12), rng.uniform(0, 2 * np.pi, 12), strict=True)
    return times, extent / np.sqrt(6) * sum(np.cos(2 * np.pi * f * times + phase) for f, phase in waves)


def read(times: np.ndarray, value: np.ndarray, sigma: float) -> Series:
    return Series(times, value, value - NORMAL * sigma, value + NORMAL * sigma)


def rmse(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(error))))


def holds(told: Series, truth: np.ndarray) -> float:
    return float(np.mean((told.lower <= truth) & (truth <= told.upper)))


def test_the_smoother_is_the_posterior_of_an_accelerated_value():
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.02, 0.3, 30))
    sigma = rng.uniform(0.5, 2.0, 30)
    sigma[[7, 8, 20]] = np.inf  # rows that measure nothing
    y = rng.normal(size=30)
    motion = Motion(3.0, 1.0, noise=0.6, systematic=0.0, outliers=0.0)
    series = Series(times, y, y - NORMAL * sigma, y + NORMAL * sigma)
    told, live = smooth(series, motion), smooth(series, motion, causal=True)

    # The same without recursion: the covariance of an integrated Wiener process, and of the start.
    variance = 0.6 * sigma**2
    t = times - times[0]
    early, late = np.minimum.outer(t, t), np.maximum.outer(t, t)
    prior = 3.0 * early**2 * (3 * late - early) / 6 + variance[0] + 4.0**2 * np.outer(t, t)
    good = np.flatnonzero(np.isfinite(sigma))[1:]

    def posterior(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gain = prior[:, rows] @ np.linalg.inv(prior[np.ix_(rows, rows)] + np.diag(variance[rows]))
        return y[0] + gain @ (y[rows] - y[0]), np.diag(prior - gain @ prior[rows])

    mean, spread = posterior(good)
    assert np.allclose(told.value, mean, atol=1e-8)
    assert np.allclose(told.deviation**2, spread, atol=1e-8)
    for n in (1, 7, 12, 29):
        mean, spread = posterior(good[good <= n])
        assert live.value[n] == pytest.approx(mean[n], abs=1e-8)
        assert live.deviation[n] ** 2 == pytest.approx(spread[n], abs=1e-8)


def test_a_row_that_measures_nothing_changes_nothing():
    times, truth = wander(2, 80)
    series = read(times, truth + np.random.default_rng(2).normal(0, 0.02, 80), 0.02)
    motion = fit_motion([series])
    between = np.insert(times, 40, times[39] + 0.01)
    more = Series(between, *(np.insert(one, 40, np.nan) for one in (series.value, series.lower, series.upper)))
    told = smooth(more, motion)
    assert np.allclose(np.delete(told.value, 40), smooth(series, motion).value, atol=1e-9)
    assert np.isnan(told.trust[40]) and abs(told.value[40] - truth[40]) < 0.04


def test_a_gap_is_bridged_with_wider_intervals():
    times, truth = wander(3, 120)
    series = read(times, truth + np.random.default_rng(3).normal(0, 0.01, 120), 0.01)
    for column in (series.value, series.lower, series.upper):
        column[:4] = np.nan
        column[60:70] = np.nan
    told = smooth(series, fit_motion([series]))
    assert np.isnan(told.value[:4]).all() and np.isfinite(told.value[4:]).all()
    assert told.half_width[65] > 1.5 * told.half_width[50]
    assert holds(Series(times[60:70], told.value[60:70], told.lower[60:70], told.upper[60:70]), truth[60:70]) == 1


def test_what_is_anybodys_guess_is_left_out():
    times, truth = wander(7, 100)
    series = read(times, truth + np.random.default_rng(7).normal(0, 0.01, 100), 0.01)
    motion = fit_motion([series])
    for column in (series.value, series.lower, series.upper):
        column[30:] = np.nan
    live = LiveFilter(motion)
    rows = [live.update(*row) for row in zip(series.times, series.value, series.lower, series.upper, strict=True)]
    for told in (smooth(series, motion), smooth(series, motion, causal=True)):
        assert np.isfinite(told.value[:35]).all() and np.isnan(told.value[90:]).all()
        assert np.isnan(told.lower[90:]).all() and np.nanmax(np.abs(told.value - truth)) < 3 * motion.spread
        assert np.array_equal(np.isnan(told.value), np.isnan(np.array(rows)[:, 0]))


def test_white_noise_averages_out_and_is_told_from_motion():
    times, truth = wander(4, 900)
    # The intervals speak of twice the noise that there is.
    series = read(times, truth + np.random.default_rng(4).normal(0, 0.01, 900), 0.02)
    motion = fit_motion([series])
    assert motion.noise == pytest.approx(0.25, rel=0.25)
    told = smooth(series, replace(motion, systematic=0.0))
    assert rmse(told.value - truth) < 0.6 * rmse(series.value - truth)
    assert holds(told, truth) == pytest.approx(0.9, abs=0.05)
    causal = smooth(series, motion, causal=True)
    assert rmse(told.value - truth) < rmse(causal.value - truth) < 0.95 * rmse(series.value - truth)


def test_gazes_of_the_wrong_sign_are_found():
    times, truth = wander(5, 600)
    rng = np.random.default_rng(5)
    value = truth + rng.normal(0, 0.01, 600)
    flipped = (rng.random(600) < 0.03) & (np.abs(truth) > 0.06)
    value[flipped] *= -1
    series = read(times, value, 0.01)
    told = smooth(series, fit_motion([series]))
    assert flipped.sum() > 8
    assert (told.trust[flipped] < 0.5).all() and (told.trust[~flipped] < 0.5).mean() < 0.01
    assert rmse(series.value - truth) > 0.04
    assert rmse(told.value - truth) < 0.01
    causal = smooth(series, fit_motion([series]), causal=True)
    assert rmse(causal.value - truth) < 0.015


def test_a_wrong_first_row_does_not_mislead():
    times, truth = wander(6, 60)
    value = truth + np.random.default_rng(6).normal(0, 0.01, 60)
    value[0] += 0.6
    told = smooth(read(times, value, 0.01), Motion(0.1, 0.2))
    assert told.trust[0] < 0.1 and abs(told.value[0] - truth[0]) < 0.05


def slow_errors(seed: int, count: int) -> tuple[Series, np.ndarray]:
    """A gaze with errors of 0.012 that hang on the gaze itself, as a model's do, and noise of 0.009."""
    times, truth = wander(seed, count)
    rng = np.random.default_rng(seed + 100)
    error = 0.012 * np.sqrt(2) * np.sin(40 * truth) + rng.normal(0, 0.009, count)
    return read(times, truth + error, 0.015), truth


def test_calibrated_intervals_hold_the_truth_though_errors_go_together():
    series, truth = slow_errors(10, 900)
    found = fit_motion([series])
    fresh = [slow_errors(seed, 900) for seed in (11, 12)]
    for causal in (False, True):
        motion = calibrate(found, [(series, truth)], causal=causal)
        assert 0.3 < motion.systematic < 1.1
        told = [smooth(one, motion, causal=causal) for one, _ in fresh]
        held = np.mean([holds(one, right) for one, (_, right) in zip(told, fresh, strict=True)])
        assert held == pytest.approx(0.9, abs=0.04)
        bold = [smooth(one, replace(motion, systematic=0.0), causal=causal) for one, _ in fresh]
        assert np.mean([holds(one, right) for one, (_, right) in zip(bold, fresh, strict=True)]) < 0.8


def test_uncalibrated_intervals_are_no_narrower_than_they_were():
    series, _ = slow_errors(13, 200)
    assert (smooth(series, fit_motion([series])).half_width >= series.half_width).all()


def test_the_live_filter_is_the_causal_one_row_by_row():
    series, _ = slow_errors(14, 120)
    series.value[50:55] = np.nan
    series.upper[80] = np.inf
    motion = fit_motion([series])
    told = smooth(series, motion, causal=True)
    live = LiveFilter(motion)
    rows = [live.update(*row) for row in zip(series.times, series.value, series.lower, series.upper, strict=True)]
    assert np.allclose(np.array(rows)[:, 0], told.value, atol=1e-12)
    measured = series.measured
    assert np.allclose(np.array(rows)[measured, 2], told.upper[measured], atol=1e-12)
    with pytest.raises(InputError, match="follows"):
        live.update(0.0, 0.1, 0.0, 0.2)
    assert np.isnan(LiveFilter(motion).update(0.0, np.nan, np.nan, np.nan)).all()
    # And no later row takes part.
    cut = Series(*(one[:60] for one in (series.times, series.value, series.lower, series.upper)))
    assert np.array_equal(smooth(cut, motion, causal=True).value, told.value[:60])


def a_table() -> tuple[pa.Table, np.ndarray]:
    """Two tracks, row about row; the first coasts for three frames; depth has no intervals."""
    times, truth = wander(20, 90)
    rng = np.random.default_rng(20)
    rows = []
    for n, time in enumerate(times):
        for track, sign in ((1, 1.0), (2, -1.0)):
            seen = not (track == 1 and n in (40, 41, 42))
            row = {"frame": n, "time": time, "track": track, "x": 1.0, "y": 2.0, "seen": seen}
            for name in ("gaze_x", "gaze_y"):
                value = sign * truth[n] + rng.normal(0, 0.01)
                if seen:
                    row |= {name: value, f"{name}_low": value - 0.0165, f"{name}_high": value + 0.0165, "depth": 2.0}
            rows.append(row)
    schema = track_schema(["depth"])
    return pa.Table.from_pylist([{name: row.get(name) for name in schema.names} for row in rows], schema=schema), truth


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_tables_are_smoothed_track_by_track(tmp_path, suffix):
    table, truth = a_table()
    assert quantities_in(table) == ("gaze_x", "gaze_y")
    told = smooth_tracks(table)
    assert told.schema == table.schema and told.num_rows == table.num_rows
    for name in table.column_names:
        if not name.startswith("gaze"):
            assert told[name].equals(table[name])
    for number, sign in ((1, 1.0), (2, -1.0)):
        series, before = series_of(told, "gaze_y")[number], series_of(table, "gaze_y")[number]
        known = before.measured
        assert rmse(series.value - sign * truth) < 0.8 * rmse((before.value - sign * truth)[known])
        assert np.isfinite(series.value).all()
    path = tmp_path / f"t{suffix}"
    write_tracks(told, path)
    assert read_tracks(path).equals(told)
    one = smooth_tracks(table, quantities=["gaze_x"])
    assert one["gaze_y"].equals(table["gaze_y"]) and not one["gaze_x"].equals(table["gaze_x"])


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_a_data_frame_is_a_table_too(tmp_path, suffix):
    table, _ = a_table()
    frame = table.to_pandas()
    assert smooth_tracks(frame[frame.frame >= 0]).equals(smooth_tracks(table))
    write_tracks(frame, tmp_path / f"t{suffix}")
    write_tracks(table, tmp_path / f"u{suffix}")
    assert read_tracks(tmp_path / f"t{suffix}").equals(read_tracks(tmp_path / f"u{suffix}"))
    with pytest.raises(InputError, match="table: is of type list; give an Arrow table"):
        write_tracks([{"track": 1}], tmp_path / "v.csv")
    with pytest.raises(InputError, match="table: is None"):
        smooth_tracks(None)


def test_what_cannot_be_smoothed_is_told():
    table, _ = a_table()
    with pytest.raises(InputError, match="no column speed with speed_low"):
        smooth_tracks(table, quantities=["speed"])
    with pytest.raises(InputError, match="depth has no intervals"):
        smooth_tracks(table, quantities=["depth"])
    bare = table.select([name for name in table.column_names if not name.startswith("gaze")])
    with pytest.raises(InputError, match="holds no estimates with intervals"):
        smooth_tracks(bare)
    with pytest.raises(InputError, match="no column track"):
        smooth_tracks(table.drop_columns(["track"]))
    with pytest.raises(InputError, match="run backwards"):
        smooth_tracks(table.take(list(range(table.num_rows))[::-1]))
    with pytest.raises(InputError, match="fewer than 3"):
        smooth_tracks(table.slice(0, 2))
    words = table.set_column(table.column_names.index("gaze_x_low"), "gaze_x_low", pa.array(["a"] * table.num_rows))
    with pytest.raises(InputError, match="gaze_x_low holds no numbers"):
        smooth_tracks(words)


def test_numbers_out_of_range_are_told():
    times, truth = wander(1, 8)
    series = read(times, truth, 0.01)
    with pytest.raises(InputError, match="alike"):
        Series(times, truth[:3], truth, truth)
    with pytest.raises(InputError, match="no row"):
        smooth(Series(times, truth, truth - np.inf, truth + np.inf), Motion(1.0, 1.0))
    for wrong in ({"acceleration": 0.0}, {"noise": -1.0}, {"systematic": -0.1}, {"outliers": 0.7}):
        with pytest.raises(InputError, match=next(iter(wrong))):
            replace(Motion(1.0, 1.0), **wrong)
    with pytest.raises(InputError, match="only 8 rows"):
        calibrate(Motion(1.0, 1.0), [(series, truth)])
    with pytest.raises(InputError, match="truth of shape"):
        calibrate(Motion(1.0, 1.0), [(series, truth[:3])])


def test_series_are_found_by_one_sort_however_many_tracks_there_are(monkeypatch) -> None:
    rng = np.random.default_rng(2)
    numbers = rng.permutation(np.repeat(np.arange(300), 4))
    value = rng.normal(size=len(numbers))
    table = pa.table(
        {"time": np.arange(len(numbers)) / 30.0, "track": numbers, "g": value, "g_low": value - 1, "g_high": value + 1}
    )
    looked: list[int] = []
    find = np.flatnonzero
    monkeypatch.setattr(np, "flatnonzero", lambda rows: looked.append(np.size(rows)) or find(rows))
    runs = series_of(table, "g")
    # Nothing is searched through again for every track.
    assert sum(looked) <= 2 * len(numbers)
    monkeypatch.undo()
    for number in (0, 7, 299):
        np.testing.assert_array_equal(runs[number].value, value[numbers == number])
    assert series_of(table.slice(0, 0), "g") == {}
