"""Pairs of videos become labelled recordings on one clock, and a dataset."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tapetum.data import open_dataset
from tapetum.data.importing import import_dataset
from tapetum.data.importing.mapping import mapping_from_dict
from tapetum.errors import InputError
from tapetum.record import find_spot, open_recording
from tapetum.record.room import Room
from tapetum.record.video import VideoWriter, read_video

RATE, SECONDS, LATE = 15.0, 6.0, 1.46
SIZE = (120, 160)
WORD = np.r_[np.random.default_rng(4).integers(0, 2, 16), np.ones(90, int)]
BIT = 0.2


def gaze(t: float) -> np.ndarray:
    return np.array([0.3 * np.sin(0.9 * t), 0.25 * np.cos(0.7 * t)])


def laser(t: float) -> int:
    return int(WORD[int(t / BIT)])


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A probe's video and a target's that starts LATE seconds later, of one blinking laser; times of their frames."""
    folder = tmp_path_factory.mktemp("two")
    rng, room = np.random.default_rng(0), Room(SIZE[1], SIZE[0], 2)
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    probe_times = np.arange(0, SECONDS, 1 / RATE)
    target_times = np.arange(LATE, SECONDS, 1 / RATE)
    with VideoWriter(folder / "walk_probe.mkv", SIZE, RATE) as video:
        for t in probe_times:
            bell = np.exp(-((columns - 80 - 5 * np.sin(t)) ** 2 + (rows - 60) ** 2) / 60)
            image = 12 + 180 * laser(t) * bell + rng.normal(0, 2, SIZE)
            video.write(np.clip(np.rint(image), 0, 255).astype(np.uint8), t)
    with VideoWriter(folder / "walk_target.mkv", SIZE, RATE) as video:
        for t in target_times:
            video.write(room.picture(gaze(t), rng, laser=laser(t)), t - LATE)
    lines = ["probe_time,target_time"]
    count = min(len(probe_times), len(target_times))
    lines += [f"{1e3 * p:.3f},{1e3 * t:.3f}" for p, t in zip(probe_times[:count], target_times[:count], strict=True)]
    (folder / "short.csv").write_text("\n".join(lines) + "\n")
    (folder / "probe.csv").write_text("time\n" + "".join(f"2026-05-04T10:00:{t:09.6f}+02:00\n" for t in probe_times))
    (folder / "target.csv").write_text("time\n" + "".join(f"2026-05-04T10:00:{t:09.6f}+02:00\n" for t in target_times))
    return folder


def mapping(**pair: Any) -> Any:
    both = {"probe": "walk_probe.mkv", "target": "walk_target.mkv", **pair}
    return mapping_from_dict({"side": 64, "videos": [both]})


TIMES = {
    "align": "timestamps",
    "probe_times": {"file": "probe.csv", "column": "time"},
    "target_times": {"file": "target.csv", "column": "time"},
}


PAIRS: dict[str, dict[str, Any]] = {"blink": {"align": "blink"}, "times": TIMES, "same": {"offset": LATE}}


@pytest.fixture(scope="module")
def imported(two: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], tuple[Path, list[str]]]:
    """The folder of a set from the two videos, aligned as one of `PAIRS`, and what was told of it; made once."""

    @functools.cache
    def made(how: str) -> tuple[Path, list[str]]:
        folder = tmp_path_factory.mktemp(how)
        pair = mapping(**PAIRS[how], labels={"device": "phone-01", "object_distance": "4 m"})
        return folder, import_dataset(pair, two, folder / "s.zarr")

    return made


@pytest.mark.parametrize(("how", "frames"), [("blink", 1.0), ("times", 0.0), ("same", 0.0)], ids=list(PAIRS))
def test_the_gaze_is_right_however_the_clocks_are_aligned(how: str, frames: float, two: Path, imported):
    folder, told = imported(how)
    assert len(told) == 1 and told[0].startswith("walk.rec: ")
    recording = open_recording(folder / "s-recordings" / "walk.rec")
    assert recording.finished
    starts = [recording.utc_ns(name)[0] / 1e9 for name in ("probe", "target")]
    assert abs(starts[1] - starts[0] - LATE) <= (frames + 0.01) / RATE
    copied = list(read_video(recording.video("probe")))
    np.testing.assert_array_equal(copied, list(read_video(two / "walk_probe.mkv")))
    dataset = open_dataset(folder / "s.zarr")
    assert dataset.tp.targets == ("gaze_x", "gaze_y", "object_distance", "device")
    assert dataset.tp.classes == ("phone-01",)
    assert dataset.sizes["frame"] > 40
    wanted = np.array([gaze(t) for t in dataset["time"].values])
    # A frame's error of the clock is at most the motion within it.
    off = np.abs(dataset.tp.values(("gaze_x", "gaze_y")) - wanted)
    assert np.median(off) < 0.004 + 0.27 * frames / RATE


def test_dates_become_the_recordings_utc(imported):
    folder, _ = imported("times")
    recording = open_recording(folder / "s-recordings" / "walk.rec")
    assert recording.meta["start_utc"] == "2026-05-04T08:00:00.000000Z"
    assert recording.meta["imported"]["align"] == "timestamps"


def refused(two: Path, tmp_path: Path, chosen: Any) -> str:
    with pytest.raises(InputError) as told:
        import_dataset(chosen, two, tmp_path / "out" / "s.zarr")
    assert not (tmp_path / "out").exists()
    return str(told.value)


def test_faults_leave_nothing_behind(two: Path, tmp_path: Path):
    short = {"file": "short.csv", "unit": "ms"}
    times = {"probe_times": {**short, "column": "probe_time"}, "target_times": {**short, "column": "target_time"}}
    line = refused(two, tmp_path, mapping(align="timestamps", **times))
    assert "short.csv: probe_time: has 69 times for the 90 frames" in line
    assert "clocks of probe and target do not overlap" in refused(two, tmp_path, mapping(offset=100))
    line = refused(two, tmp_path, mapping(probe="walk_target.mkv", target="walk_probe.mkv", name="turned"))
    assert ".part" not in line
    big = mapping_from_dict({"side": 400, "videos": [{"probe": "walk_probe.mkv", "target": "walk_target.mkv"}]})
    assert "smaller than the crops of 400 px" in refused(two, tmp_path, big)


def test_a_half_copied_target_is_refused(two: Path, tmp_path: Path):
    for name in ("walk_probe.mkv", "walk_target.mkv"):
        data = (two / name).read_bytes()
        (tmp_path / name).write_bytes(data if "probe" in name else data[: len(data) // 2])
    line = refused(tmp_path, tmp_path, mapping(align="blink"))
    assert "walk_target.mkv: the video is truncated" in line
    (tmp_path / "walk_target.mkv").write_bytes(b"")
    assert "walk_target.mkv: the video is truncated or damaged: 0 frames" in refused(tmp_path, tmp_path, mapping())


def test_recordings_that_stand_there_are_not_replaced(two: Path, tmp_path: Path):
    mine = tmp_path / "s-recordings"
    mine.mkdir()
    (mine / "notes.txt").write_text("mine")
    for overwrite in (False, True):
        with pytest.raises(InputError, match="s-recordings: exists already"):
            import_dataset(mapping(), two, tmp_path / "s.zarr", overwrite=overwrite)
    assert (mine / "notes.txt").read_text() == "mine"


def test_the_laser_in_this_room_is_found():
    # What the tests above rest on.
    picture = Room(SIZE[1], SIZE[0], 3).picture(np.array([0.1, 0.1]), np.random.default_rng(0))
    assert find_spot(picture).quality > 0.5
