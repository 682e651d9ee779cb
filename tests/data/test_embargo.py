"""Training, calibration and test frames of one video share no measurement of their labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import xarray as xr

from tapetum.data import build_dataset, open_dataset
from tapetum.data.corners import read_corners
from tapetum.data.dataset import EMBARGO, TEST, TRAIN
from tapetum.data.embargo import meeting
from tapetum.data.leaks import find_leaks, score_leaks
from tapetum.errors import InputError
from tapetum.models.base import training_part
from tapetum.record import join
from tapetum.record.recording import Recording, RecordingWriter, StreamInfo, open_recording

HEIGHT, WIDTH, FRAMES = 48, 60, 180


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A probe at 15 frames a second, a target at 12 whose spots are each off by an error of its own."""
    path, rng = tmp_path_factory.mktemp("film") / "a.rec", np.random.default_rng(0)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    info = StreamInfo(HEIGHT, WIDTH)
    with RecordingWriter(path, streams={"probe": info, "target": info}, rate=15.0, start_utc_ns=10**18) as writer:
        for name, rate, later in (("probe", 15.0, 0.5), ("target", 12.0, 0.0)):
            for n in range(FRAMES):
                image = 10 + 200 * np.exp(-((columns - 30) ** 2 + (rows - 24) ** 2) / 50) + rng.normal(0, 1, rows.shape)
                moment = round(1e9 * (n / rate + later + 0.002 * rng.standard_normal()))
                writer.write(name, image.astype(np.uint8), monotonic_ns=moment, utc_ns=10**18 + moment)
    made = open_recording(path)
    spots = rng.normal(size=(FRAMES, 2))
    gaze = join(made).interpolate(spots)
    table = {"frame": np.arange(FRAMES), "gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}
    # As labels were kept before they said how far they reach.
    made.write_labels(pa.table({**table, "how": ["laser-spot"] * FRAMES, "quality": np.ones(FRAMES)}))
    return made


@pytest.fixture(scope="module")
def dataset(recording: Recording) -> xr.Dataset:
    out = recording.path.with_name("set.zarr")
    return open_dataset(build_dataset([recording.path], out, side=32))


def shared(recording: Recording, one: np.ndarray, other: np.ndarray) -> int:
    """How many spots have a say in labels of both groups of frames."""
    says = np.nan_to_num(join(recording).interpolate(np.eye(FRAMES))) != 0
    return int((says[one].any(axis=0) & says[other].any(axis=0)).sum())


def test_no_spot_labels_both_training_and_test(recording: Recording, dataset: xr.Dataset) -> None:
    frames, split = dataset["frame_index"].values, dataset["split"].values
    assert shared(recording, frames[split == TRAIN], frames[split == TEST]) == 0
    # All of the training part stays; what is taken out comes from the beginning of the test part, and no more of it
    # than one frame beyond what shares a spot.
    assert frames[split == TRAIN].max() == 143 and 1 <= (split == EMBARGO).sum() <= 7
    taken = frames[split == EMBARGO]
    assert taken.min() == 144 and shared(recording, frames[split == TRAIN], taken) > 0
    assert shared(recording, frames[split == TRAIN], taken[:-2]) > 0
    assert dataset.tp.recordings[0]["embargo"] == len(taken)


def test_no_spot_labels_both_fit_and_calibration(recording: Recording, dataset: xr.Dataset) -> None:
    part = training_part(dataset, ("gaze_x",), 0.2)
    frames = part.dataset["frame_index"].values
    assert shared(recording, frames[part.fit], frames[part.calibrate]) == 0
    assert part.summary["embargo"] == len(frames) - len(part.fit) - len(part.calibrate) > 0
    assert len(training_part(dataset, ("gaze_x",), 0.0).fit) == len(frames)


def test_the_leak_is_reported_before_and_not_after(dataset: xr.Dataset) -> None:
    corners = read_corners(dataset)
    before = dataset.copy()
    before["split"] = dataset["split"].copy(data=np.where(dataset["split"].values == EMBARGO, TEST, dataset["split"]))
    found = [leak for leak in find_leaks(before, corners) if leak.name == "label smoothing"]
    assert [leak.target for leak in found] == ["gaze_x", "gaze_y"] and "can be read from label smoothing" in str(
        found[0]
    )
    assert not [leak for leak in find_leaks(dataset, corners) if leak.name == "label smoothing"]
    old = dataset.drop_vars(["label_back", "label_ahead"])
    told = [leak for leak in score_leaks(old, corners) if leak.name == "label smoothing"]
    assert {leak.verdict for leak in told} == {"untested"} and "does not say how far" in told[0].why


def test_an_embargo_can_be_asked_for(recording: Recording, tmp_path: Path) -> None:
    wide = open_dataset(build_dataset([recording.path], tmp_path / "wide.zarr", side=32, embargo=1.0))
    time, split = wide["time"].values, wide["split"].values
    assert time[split == TEST].min() - time[split == TRAIN].max() >= 1.0
    with pytest.raises(InputError, match="36 share measurements"):
        build_dataset([recording.path], tmp_path / "none.zarr", side=32, embargo=9.0)


def test_meeting_spans_by_brute_force() -> None:
    rng = np.random.default_rng(1)
    span = np.sort(rng.uniform(0, 10, (200, 2)), axis=1)
    span[:, 1] = span[:, 0] + 0.1 * (span[:, 1] - span[:, 0])
    recording, part = rng.integers(0, 2, 200), rng.integers(0, 3, 200)
    found = meeting(span, recording, part == 0, part == 1)
    for n in range(200):
        others = (part == 1) & (recording == recording[n])
        own = (span[others, 0] < span[n, 1]) & (span[others, 1] > span[n, 0])
        assert found[n] == (part[n] == 0 and own.any())
    assert 20 < found.sum() < 60
