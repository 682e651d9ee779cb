"""Several probes: places, clocks, weights, contradictions, and what is refused."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from tapetum.errors import InputError
from tapetum.track import read_tracks, track_schema, write_tracks
from tapetum.track.fuse import at_times, combine, fuse, fuse_tracks
from tapetum.track.kalman import NORMAL, Series
from tapetum.track.places import Places

WIDE = Places(((0, 0), (0.4, -0.1), (-0.3, 0.2)), 3.0, (np.radians(65), np.radians(52)), roll=0.2)


def test_places_agree_with_rotations():
    rng = np.random.default_rng(0)
    scale = 2 * np.tan(np.array(WIDE.field) / 2)
    pan, tilt = rng.uniform(-0.4, 0.4, (2, 50))
    # Lower-case letters turn about fixed axes: first the pan, then the tilt, then the roll back.
    camera = Rotation.from_euler("yxz", np.stack([pan, tilt, np.full(50, -WIDE.roll)], axis=1))
    gaze = []
    for x, y in WIDE.places:
        seen = camera.apply([x, y, WIDE.distance])
        gaze.append(seen[:, :2] / seen[:, 2:] / scale)
    for probe in (1, 2):
        assert np.allclose(WIDE.to_first(probe, gaze[probe]), gaze[0], atol=1e-12)
        assert np.allclose(WIDE.from_first(probe, gaze[0]), gaze[probe], atol=1e-12)


def test_a_probe_to_the_right_is_seen_to_the_right():
    small = Places(((0, 0), (0.24, 0.0)), 5.5, (np.radians(3.27), np.radians(2.45)))
    gaze = small.from_first(1, [[0.0, 0.0], [0.3, -0.2]])
    # 0.24 m at 5.5 m are 2.5 degrees of 3.27.
    assert gaze[0] == pytest.approx([0.24 / 5.5 / (2 * np.tan(np.radians(3.27) / 2)), 0], abs=1e-9)
    assert np.allclose(gaze[1] - gaze[0], [0.3, -0.2], atol=2e-3)
    assert np.isnan(small.to_first(1, [[np.nan, 0.1]])).all()


def test_weights_are_those_of_least_variance():
    rng = np.random.default_rng(1)
    value, deviation = rng.normal(size=(3, 40)), rng.uniform(1.0, 1.6, (3, 40))
    for rho in (0.0, 0.3, 0.5):
        told, spread = combine(value, deviation, rho)
        for n in range(40):
            inverse = np.linalg.inv(np.outer(deviation[:, n], deviation[:, n]) * (rho + (1 - rho) * np.eye(3)))
            weight = inverse.sum(axis=1) / inverse.sum()
            if (weight > 0).all():
                assert told[n] == pytest.approx(weight @ value[:, n], abs=1e-12)
                assert spread[n] ** 2 == pytest.approx(1 / inverse.sum(), rel=1e-12)


def test_a_correlation_of_one_is_safe():
    told, spread = combine(np.array([[1.0, 1.0], [2.0, 2.0]]), np.array([[0.1, 0.2], [0.3, 0.2]]), 1.0)
    assert told == pytest.approx([1.0, 1.5]) and spread == pytest.approx([0.1, 0.2])
    # Nor does a guessed correlation extrapolate from two that agree in sign of error.
    told, spread = combine(np.array([[1.0], [2.0]]), np.array([[0.1], [0.9]]), 0.6)
    assert told == pytest.approx([1.0]) and spread == pytest.approx([0.1])


def drawn(seed: int, count: int, probes: int, rho: float, sigma: float = 0.02) -> np.ndarray:
    """Errors [probes, count, 2] that go together."""
    rng = np.random.default_rng(seed)
    own, shared = rng.normal(size=(probes, count, 2)), rng.normal(size=(count, 2))
    return sigma * (np.sqrt(1 - rho) * own + np.sqrt(rho) * shared)


@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_fused_intervals_hold_the_truth(rho):
    errors = drawn(2, 4000, 3, rho)
    told = fuse(errors, errors - NORMAL * 0.02, errors + NORMAL * 0.02, correlation=rho)
    assert np.mean((told.lower <= 0) & (told.upper >= 0)) == pytest.approx(0.9, abs=0.012)
    assert told.value.std() == pytest.approx(0.02 * np.sqrt((1 + 2 * rho) / 3), rel=0.03)
    assert told.used.mean() > 0.999 and not told.disagree.any()
    if rho == 0:
        # The test's probabilities are even: 1 in 20 below 0.05.
        assert np.mean(told.consistency < 0.05) == pytest.approx(0.05, abs=0.012)
    else:
        assert np.mean(told.consistency < 0.05) < 0.01


def test_a_probe_that_disagrees_is_left_out_of_three_and_spanned_of_two():
    errors = drawn(3, 200, 3, 0.0)
    errors[1, :50, 0] += 0.5
    ends = errors - NORMAL * 0.02, errors + NORMAL * 0.02
    told = fuse(errors, *ends, correlation=0.0)
    assert not told.used[:50, 1].any() and told.used[:50, [0, 2]].all() and not told.disagree.any()
    assert told.used[50:].mean() > 0.99 and (told.consistency[:50] < 1e-9).all()
    assert np.abs(told.value[:50]).max() < 0.06
    two = fuse(errors[:2], ends[0][:2], ends[1][:2])
    assert two.disagree[:50].all() and not two.disagree[51:].any()
    assert (two.lower[:50, 0] < 0.03).all() and (two.upper[:50, 0] > 0.47).all()


def test_a_probe_that_is_lost_is_done_without():
    errors = drawn(4, 30, 2, 0.0)
    half = np.full(errors.shape, NORMAL * 0.02)
    errors[0, :10], half[1, 10:20] = np.nan, np.inf
    errors[:, 20:] = np.nan
    told = fuse(errors, errors - half, errors + half)
    assert np.allclose(told.value[:10], errors[1, :10]) and np.allclose(told.value[10:20], errors[0, 10:20])
    assert np.isnan(told.value[20:]).all() and np.isnan(told.consistency).all()
    assert told.used.sum(axis=0).tolist() == [10, 10]


def test_times_between_rows_are_met_and_gaps_are_not():
    times = np.array([0.0, 0.1, 0.2, 0.3, 1.3, 1.4])
    series = Series(times, 2 * times, 2 * times - 1, 2 * times + 1)
    value, lower, upper = at_times(series, np.array([-0.01, 0.0, 0.15, 0.3, 0.8, 1.35, 1.41]))
    assert np.allclose(value, [np.nan, 0, 0.3, 0.6, np.nan, 2.7, np.nan], equal_nan=True)
    assert np.nanmax(np.abs(upper - lower - 2)) < 1e-12
    assert np.isfinite(at_times(series, np.array([0.8]), 1.1)[0])


def table(times: np.ndarray, gaze: np.ndarray, *, half: float = 0.03, track: int = 1) -> pa.Table:
    rows = []
    for n, (time, (x, y)) in enumerate(zip(times, gaze, strict=True)):
        row = {"frame": n, "time": time, "track": track, "x": 300.0 + n, "y": 200.0, "snr": 30.0, "seen": True}
        for name, value in (("gaze_x", x), ("gaze_y", y)):
            row |= {name: value, f"{name}_low": value - half, f"{name}_high": value + half}
        rows.append({name: row.get(name) for name in track_schema().names})
    return pa.Table.from_pylist(rows, schema=track_schema())


def pair() -> tuple[list[pa.Table], Places, np.ndarray, np.ndarray]:
    """Two probes with clocks 5 s apart; each is lost for a while."""
    places = Places(((0, 0), (0.1, 0.05)), 5.5, (0.057, 0.043))
    times = np.arange(60) / 15
    truth = np.stack([0.3 * np.sin(times), 0.2 * np.cos(times)], axis=1)
    later = times + 0.02
    there = np.stack([0.3 * np.sin(later), 0.2 * np.cos(later)], axis=1)
    first, second = np.r_[0:20, 30:60], np.r_[0:45]
    tables = [table(times[first], truth[first]), table(later[second] - 5.0, places.from_first(1, there)[second])]
    return tables, places, times, truth


@pytest.mark.parametrize("suffix", [".parquet", ".csv", ".jsonl"])
def test_tables_are_fused_on_one_clock_and_come_back(tmp_path, suffix):
    tables, places, times, _ = pair()
    fused = fuse_tracks(tables, places, starts=[100.0, 105.0])
    told = fused.table
    assert told.num_rows == 60  # the first's 50, and 10 of the second while the first was lost
    assert fused.used == (50, 44) and (fused.dropped, fused.disagree) == (0, 0)
    at = told["time"].to_numpy()
    assert (np.diff(at) > 0).all() and at[-1] == times[-1]
    # Straight lines between rows: a fraction of a pixel of this gaze.
    assert np.abs(told["gaze_x"].to_numpy() - 0.3 * np.sin(at)).max() < 3e-4
    assert np.abs(told["gaze_y"].to_numpy() - 0.2 * np.cos(at)).max() < 3e-4
    half = (told["gaze_x_high"].to_numpy() - told["gaze_x_low"].to_numpy()) / 2
    assert half[told["probes"].to_numpy() == 2] == pytest.approx(0.03 * np.sqrt(0.75), rel=1e-2)
    assert half[told["probes"].to_numpy() == 1] == pytest.approx(0.03, rel=1e-2)
    assert told["consistency"].null_count == 26 and told["x"].to_numpy()[0] == 300.0
    path = tmp_path / f"fused{suffix}"
    write_tracks(told, path)
    assert read_tracks(path).equals(told)
    assert fuse_tracks([told, told], [(0, 0), (0, 0)]).table.num_rows == 60


def test_tables_that_know_utc_need_no_starts():
    tables, places, _, _ = pair()
    begun = 1_780_000_000_000_000_001
    dated = [
        one.set_column(
            one.column_names.index("utc_ns"),
            "utc_ns",
            pa.array([begun + round((time + later) * 1e9) for time in one["time"].to_pylist()], pa.int64()),
        )
        for one, later in zip(tables, (0.0, 5.0), strict=True)
    ]
    told, want = fuse_tracks(dated, places), fuse_tracks(tables, places, starts=[0.0, 5.0])
    assert told.used == want.used
    assert told.table["time"].to_numpy() == pytest.approx(want.table["time"].to_numpy(), abs=1e-6)
    assert told.table["utc_ns"][0].as_py() == begun
    # Where one has none nobody knows how much later it begins.
    with pytest.raises(InputError, match="has no UTC, which others have"):
        fuse_tracks([dated[0], tables[1]], places)


def test_an_unknown_roll_widens_what_stands_off():
    tables, places, _, _ = pair()
    rolled = Places(places.places, places.distance, places.field, roll_spread=0.05)
    sure, unsure = (fuse_tracks(tables, one, starts=[0, 5]).table for one in (places, rolled))
    for name, grown in (("gaze_x", 0.05 * 0.05 / 5.5 / 0.057), ("gaze_y", 0.05 * 0.1 / 5.5 / 0.043)):
        half = [(t[f"{name}_high"].to_numpy() - t[f"{name}_low"].to_numpy()) / 2 for t in (sure, unsure)]
        alone = slice(20, 30)  # the second probe's
        assert half[1][alone] == pytest.approx(np.hypot(half[0][alone], NORMAL * grown), rel=2e-2)


def test_what_cannot_be_fused_is_told():
    tables, places, times, truth = pair()
    with pytest.raises(InputError, match="a single probe"):
        fuse_tracks(tables[:1], Places(((0, 0),), 5.5, (0.05, 0.05)))
    with pytest.raises(InputError, match="do not overlap"):
        fuse_tracks(tables, places)
    with pytest.raises(InputError, match="2 places for 3 probes"):
        fuse_tracks([*tables, tables[0]], places)
    with pytest.raises(InputError, match="probe 2: no column speed"):
        fuse_tracks(
            [pa.table({**{n: tables[0][n] for n in tables[0].column_names}, **speed(tables[0])}), tables[1]],
            places,
            quantities=["speed"],
        )
    bare = tables[1].drop_columns(["gaze_x_low"]).drop_columns(["gaze_y_high"])
    with pytest.raises(InputError, match="probe 2: holds no estimates with intervals"):
        fuse_tracks([tables[0], bare], places, starts=[0, 5])
    crowd = pa.concat_tables([tables[0], table(times[:5], truth[:5], track=2)])
    with pytest.raises(InputError, match="several tracks at once"):
        fuse_tracks([crowd, tables[1]], places, starts=[0, 5])
    named = fuse_tracks([crowd, tables[1]], places, starts=[0, 5], tracks=[1, None])
    assert named.used == (50, 44)
    # One that only coasts beside the other is no second target.
    coasting = table(times[:5], truth[:5] + 0.3, track=2)
    coasting = coasting.set_column(coasting.column_names.index("seen"), "seen", pa.array([False] * 5))
    beside = fuse_tracks([pa.concat_tables([coasting, tables[0]]), tables[1]], places, starts=[0, 5])
    assert beside.table.equals(named.table)
    with pytest.raises(InputError, match="no track 7"):
        fuse_tracks([crowd, tables[1]], places, starts=[0, 5], tracks=[7, None])
    with pytest.raises(InputError, match="1 for 2 probes"):
        fuse_tracks(tables, places, starts=[0.0])
    with pytest.raises(InputError, match="both gaze_x and gaze_y"):
        fuse_tracks(tables, places, starts=[0, 5], quantities=["gaze_x"])
    with pytest.raises(InputError, match="correlation"):
        fuse_tracks(tables, places, starts=[0, 5], correlation=1.5)
    with pytest.raises(InputError, match="alone"):
        fuse(np.zeros((1, 3, 1)), np.zeros((1, 3, 1)), np.zeros((1, 3, 1)))
    for wrong in ({"distance": 0.0}, {"field": (4.0, 1.0)}, {"places": ((1.0, 0.0), (0.0, 0.0))}):
        with pytest.raises(InputError):
            Places(**{"places": ((0, 0), (1, 0)), "distance": 2.0, "field": (1.0, 1.0)} | wrong)


def speed(one: pa.Table) -> dict[str, pa.Array]:
    return {name: pa.array(np.ones(one.num_rows)) for name in ("speed", "speed_low", "speed_high")}
