"""Joining two streams by their clocks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.record.clocks import join
from tapetum.record.recording import Recording, RecordingWriter, StreamInfo, open_recording

START = 1_800_000_000_000_000_000
T = 1 / 15


def recorded(path: Path, probe: np.ndarray, target: np.ndarray) -> Recording:
    """A recording of tiny frames at the given moments (seconds from START by UTC)."""
    streams = {"probe": StreamInfo(4, 4), "target": StreamInfo(4, 4)}
    with RecordingWriter(path / "a.rec", streams=streams, rate=15, start_utc_ns=START) as writer:
        for stream, times in (("probe", probe), ("target", target)):
            for number, seconds in enumerate(times):
                utc = START + round(seconds * 1e9)
                writer.write(stream, np.zeros((4, 4), np.uint8), monotonic_ns=number, utc_ns=utc)
    return open_recording(path / "a.rec")


def test_brackets_weights_and_interpolation_with_jitter(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    probe = np.arange(40) * T + rng.uniform(-0.01, 0.01, 40)
    target = np.arange(-2, 45) * T + 0.021 + rng.uniform(-0.01, 0.01, 47)
    joined = join(recorded(tmp_path, probe, target))
    assert len(joined) == 40 and joined.found.all()
    for number, moment in enumerate(probe):
        before = int(np.flatnonzero(target <= moment)[-1])
        assert (joined.before[number], joined.after[number]) == (before, before + 1)
        expected = (moment - target[before]) / (target[before + 1] - target[before])
        assert joined.weight[number] == pytest.approx(expected, abs=1e-6)
        nearest = min(moment - target[before], target[before + 1] - moment)
        assert joined.gap[number] == pytest.approx(nearest, abs=1e-8)
    # What is linear in time comes back as it was, in every column.
    values = np.stack([3 * target - 1, -target], axis=1)
    assert np.allclose(joined.interpolate(values), np.stack([3 * probe - 1, -probe], axis=1), atol=1e-6)
    assert np.allclose(joined.interpolate(values[:, 0]), 3 * probe - 1, atol=1e-6)


def test_a_hands_path_is_followed_round_its_corners(tmp_path: Path) -> None:
    probe = np.arange(60) * T + 0.02
    target = np.delete(np.arange(64) * T + 0.001, [30, 31])
    joined = join(recorded(tmp_path, probe, target))
    path = np.stack([np.sin(2 * np.pi * 0.8 * target), np.cos(2 * np.pi * 0.8 * target)], axis=1)
    true = np.stack([np.sin(2 * np.pi * 0.8 * probe), np.cos(2 * np.pi * 0.8 * probe)], axis=1)
    error = np.abs(joined.interpolate(path) - true).max(axis=1)
    # A straight line is off by an eighth of the acceleration over an interval: 0.014 at the worst.
    # (Where only one frame lies beyond, at the beginning, it is one.)
    assert error[0] > 0.01 and np.nanmax(np.delete(error, [0, *range(26, 34)])) < 1e-3
    # Beside the frames that were lost it is a straight line again, and not a wild cubic.
    assert np.nanmax(error) < 0.06
    # One frame without a spot straightens its neighbours, and spoils no other.
    path[20] = np.nan
    lame = joined.interpolate(path)
    assert np.isnan(lame[:, 0]).sum() == np.isnan(joined.interpolate(true[:1].repeat(62, 0))[:, 0]).sum() + 2
    assert np.abs(lame[:17] - true[:17])[1:].max() < 1e-3


def test_the_same_moment_needs_no_second_frame(tmp_path: Path) -> None:
    times = np.arange(5) * T
    joined = join(recorded(tmp_path, times, times))
    assert joined.before.tolist() == joined.after.tolist() == [0, 1, 2, 3, 4]
    assert (joined.weight == 0).all() and (joined.gap == 0).all()
    values = np.array([0.0, np.nan, 2, 3, 4])
    assert np.array_equal(joined.interpolate(values), values, equal_nan=True)


def test_no_partner_outside_and_in_wide_gaps(tmp_path: Path) -> None:
    probe = np.arange(12) * T
    target = np.array([2, 3, 4, 8, 9, 10]) * T + 0.3 * T
    recording = recorded(tmp_path, probe, target)
    joined = join(recording)
    # 0, 1 and 2 come before the target's first frame, 11 after its last; 6 and 7 lie far within the gap.
    assert np.flatnonzero(joined.found).tolist() == [3, 4, 5, 8, 9, 10]
    assert joined.before.tolist() == [-1, -1, -1, 0, 1, 2, -1, -1, 2, 3, 4, -1]
    assert joined.after[8] == 3 and joined.after[5] == 3
    assert np.isinf(joined.gap[[0, 6, 11]]).all() and (joined.weight[[0, 6, 11]] == 0).all()
    assert np.isnan(joined.interpolate(target)[[0, 6, 11]]).all()
    assert np.flatnonzero(join(recording, tolerance=0.31 * T).found).tolist() == [3, 4, 8, 9, 10]
    assert join(recording, tolerance=1.0).found[3:11].all()


def test_an_offset_is_taken_out(tmp_path: Path) -> None:
    probe = np.arange(10) * T
    recording = recorded(tmp_path, probe, probe + 3600)
    assert join(recording, offset=-3600).before.tolist() == list(range(10))
    assert join(recording, "target", "probe", offset=3600).before.tolist() == list(range(10))


def test_clocks_that_do_not_overlap(tmp_path: Path) -> None:
    recording = recorded(tmp_path, np.arange(15) * T, np.arange(15) * T + 3600)
    with pytest.raises(InputError) as caught:
        join(recording)
    assert str(caught.value) == (
        f"{recording.path}: the clocks of probe and target do not overlap: "
        "2027-01-15T08:00:00.000Z to 2027-01-15T08:00:00.933Z and "
        "2027-01-15T09:00:00.000Z to 2027-01-15T09:00:00.933Z; "
        "set both cameras by one clock and record again, or give the offset between them"
    )


def test_a_clock_that_was_set_back_and_a_stream_without_frames(tmp_path: Path) -> None:
    recording = recorded(tmp_path, np.array([0, 1, 0.5]), np.arange(3) * 0.5)
    with pytest.raises(InputError, match="UTC of stream probe does not rise at frame 2"):
        join(recording)
    (tmp_path / "b").mkdir()
    with pytest.raises(InputError, match="stream target holds no frames"):
        join(recorded(tmp_path / "b", np.arange(3) * T, np.array([])))


def test_a_single_target_frame(tmp_path: Path) -> None:
    joined = join(recorded(tmp_path, np.array([0, T, 2 * T]), np.array([T])))
    assert joined.before.tolist() == [-1, 0, -1]
