"""A set made part by part: the same, however it was made."""

from __future__ import annotations

import json
import os
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from synth_plans import PIECE, digest, little_plan, little_scene

from tapetum.data import build_dataset, content_hash, open_dataset
from tapetum.data.dataset import EMBARGO, TEST, TRAIN
from tapetum.data.synth import Plan, focusing_plan, make_plan, synthesise
from tapetum.data.synth import work as working
from tapetum.data.synth.store import Made, Staging
from tapetum.data.synth.work import make_part, shot_of
from tapetum.data.write import CHUNK, Rules
from tapetum.durable import sole_writer
from tapetum.errors import InputError
from tapetum.record import film, label_recording
from tapetum.record.labels import NoLaserError
from tapetum.record.shot import Shot


class Stop:
    """A progress that presses Ctrl-C after some parts."""

    def __init__(self, after: int) -> None:
        self.left = after

    def __call__(self, items, what, *, total=None):
        for item in items:
            if self.left == 0:
                raise KeyboardInterrupt
            self.left -= 1
            yield item


def test_it_is_a_dataset_as_any_other(whole: Path):
    dataset = open_dataset(whole)
    assert dataset.tp.targets == ("gaze_x", "gaze_y")
    assert dataset.tp.hash == content_hash(dataset)
    assert dataset["image"].shape[1:] == (40, 40)
    assert 35 < dataset.sizes["frame"] <= 48
    told = dataset.tp.recordings
    assert [one["name"] for one in told] == ["rotation-1", "rotation-2"]
    for number, one in enumerate(told):
        assert one["used"] == int((dataset["recording"] == number).sum())
        assert one["used"] + sum(one["left_out"].values()) == one["frames"]
        assert one["parameters"]["seed"] == one["seed"]
        assert one["parameters"]["scene"]["target"]["sensor"]["pixels"] == [162, 122]
    assert dataset.attrs["synth"]["seed"] == 0
    assert [path.name for path in whole.parent.iterdir()] == ["whole.zarr"]


def test_it_keeps_where_the_target_really_looked(whole: Path):
    dataset, plan = open_dataset(whole), little_plan()
    for number, video in enumerate(plan.videos):
        own = dataset.isel(frame=np.flatnonzero(dataset["recording"].values == number))
        truth = shot_of(video.scene, video.session).truth().to_pandas()
        truth = truth[(truth["stream"] == "probe") & (truth["target"] == 0)].set_index("frame")
        for axis in "xy":
            looked = truth[f"gaze_{axis}"].loc[own["frame_index"].values]
            np.testing.assert_allclose(own[f"true_gaze_{axis}"].values, looked, rtol=0, atol=1e-6)
            # A label is near it, and not the same.
            apart = np.abs(own[f"gaze_{axis}"].values - looked.values)
            assert 0 < np.median(apart) < 0.02
    assert not {"true_gaze_x", "true_gaze_y"} & set(dataset.tp.targets)


def test_it_keeps_how_sure_each_label_is(whole: Path):
    dataset = open_dataset(whole)
    for axis in "xy":
        wide = dataset[f"gaze_{axis}_std"].values
        # Films of few spots keep labels wider than 0.005 too.
        assert (wide > 1e-5).all() and np.median(wide) < 0.0051
        error = np.abs(dataset[f"gaze_{axis}"].values - dataset[f"true_gaze_{axis}"].values)
        assert (error < 1.645 * wide).mean() > 0.6
    assert not {"gaze_x_std", "gaze_y_std"} & set(dataset.tp.targets)


def test_a_faster_target_camera_makes_better_labels(whole: Path, tmp_path: Path):
    plan = replace(little_plan(1), rules=Rules(side=40, test_fraction=0))
    assert plan.with_target_rate(60).digest != plan.digest
    fast = open_dataset(synthesise(plan.with_target_rate(60), tmp_path / "fast.zarr"))
    slow = open_dataset(whole)
    slow = slow.isel(frame=np.flatnonzero(slow["recording"].values == 0))
    assert np.isin(slow["frame_index"].values, fast["frame_index"].values).all()

    def rms(dataset):
        return float(np.sqrt(np.mean((dataset["gaze_x"].values - dataset["true_gaze_x"].values) ** 2)))

    assert rms(fast) < 0.5 * rms(slow)
    assert np.median(fast["gaze_x_std"].values) < np.median(slow["gaze_x_std"].values)


def test_the_last_fifth_of_every_video_tests(whole: Path):
    dataset = open_dataset(whole)
    for number, one in enumerate(dataset.tp.recordings):
        own = dataset.isel(frame=np.flatnonzero(dataset["recording"].values == number))
        index = own["frame_index"].values
        assert (np.diff(index) > 0).all()
        split = own["split"].values
        np.testing.assert_array_equal(split == TRAIN, index < 0.8 * one["frames"])
        # Labels reach over five target frames or so.
        assert 1 <= (split == EMBARGO).sum() == one["embargo"] <= 7
        assert index[split == EMBARGO].max() < index[split == TEST].min()


def test_parts_give_what_the_whole_recording_gives(whole: Path, tmp_path: Path):
    plan = little_plan()
    recording = film(plan.videos[0].scene, tmp_path / "a.rec", plan.videos[0].session)
    label_recording(recording)
    filmed = open_dataset(build_dataset([recording.path], tmp_path / "a.zarr", side=40))
    dataset = open_dataset(whole)
    own = dataset.isel(frame=np.flatnonzero(dataset["recording"].values == 0))
    assert int(own["frame_index"].max()) > PIECE
    for name in ("frame_index", "image", "split", "centre_x", "snr", "time"):
        np.testing.assert_array_equal(own[name].values, filmed[name].values, err_msg=name)
    for name in ("gaze_x", "gaze_y", "quality"):
        np.testing.assert_allclose(own[name].values, filmed[name].values, atol=1e-7, err_msg=name)


def test_labels_are_measured_not_known(whole: Path):
    plan = little_plan()
    truth = shot_of(plan.videos[0].scene, plan.videos[0].session).truth().to_pandas()  # type: ignore[attr-defined]
    truth = truth[truth["stream"] == "probe"].set_index("frame")
    dataset = open_dataset(whole)
    own = dataset.isel(frame=np.flatnonzero(dataset["recording"].values == 0))
    error = own["gaze_x"].values - truth.loc[own["frame_index"].values, "gaze_x"].to_numpy()
    assert 1e-5 < np.abs(error).mean() < 5e-3


def test_an_interrupted_set_is_carried_on_to_the_same_bytes(whole: Path, tmp_path: Path):
    out = tmp_path / "set.zarr"
    with pytest.raises(KeyboardInterrupt):
        synthesise(little_plan(), out, progress=Stop(2))
    assert [path.name for path in tmp_path.iterdir()] == ["set.zarr.part"]
    done = sorted((tmp_path / "set.zarr.part" / "done").iterdir())
    assert [file.name for file in done] == ["0000000.parquet", "0000001.parquet", "0000002.parquet"]
    made: list[int] = []

    def watch(items, what, *, total=None):
        made.append(total)
        yield from items

    synthesise(little_plan(), out, progress=watch)
    assert made == [1, 4]
    assert digest(out) == digest(whole)
    assert [path.name for path in tmp_path.iterdir()] == ["set.zarr"]


def test_another_set_is_not_mixed_in(tmp_path: Path):
    out = tmp_path / "set.zarr"
    with pytest.raises(KeyboardInterrupt):
        synthesise(little_plan(videos=1), out, progress=Stop(0))
    for plan, word in (
        (little_plan(videos=1, seed=1), "seed 0, not 1"),
        (replace(little_plan(videos=1), size="paper"), "size small, not paper"),
        (little_plan(videos=2), "other scenes"),
    ):
        with pytest.raises(InputError, match=word):
            synthesise(plan, out)
    (tmp_path / "set.zarr.part" / "plan.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="no set that was begun"):
        synthesise(little_plan(videos=1), out)


def test_a_damaged_part_is_told_by_its_name(tmp_path: Path):
    out = tmp_path / "set.zarr"
    plan = little_plan(videos=1)
    with pytest.raises(KeyboardInterrupt):
        synthesise(plan, out, progress=Stop(len(plan.parts)))
    file = tmp_path / "set.zarr.part" / "done" / "0000001.parquet"
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"0000001\.parquet: damaged"):
        synthesise(plan, out)
    assert not out.exists()
    file.unlink()
    with pytest.raises(InputError, match=r"0000001\.parquet: has been removed; run the same command again"):
        Staging(tmp_path / "set.zarr.part").read(plan.parts[1])
    synthesise(plan, out)
    assert content_hash(open_dataset(out)) == open_dataset(out).tp.hash


def test_threads_change_nothing(whole: Path):
    plan, before = little_plan(), torch.get_num_threads()
    try:
        made = []
        for threads in (1, 2):
            torch.set_num_threads(threads)
            shot_of.cache_clear()
            made.append(make_part(plan.videos[0], plan.parts[1], plan.rules, []))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(made[0].crops, made[1].crops)
    assert made[0].columns == made[1].columns


def test_a_frame_of_the_target_is_made_once_for_all_parts(monkeypatch):
    plan, asked, target = little_plan(), list[int](), Shot.target

    def counted(shot: Shot, first: int, last: int):
        asked.extend(range(first, last))
        return target(shot, first, last)

    monkeypatch.setattr(Shot, "target", counted)
    own = [part for part in plan.parts if part.video == 0]
    assert len(own) > 1
    shot_of.cache_clear()
    together = [make_part(plan.videos[0], part, plan.rules, []) for part in own]
    assert len(asked) == len(set(asked)) > 0
    before = len(asked)
    shot_of.cache_clear()
    alone = make_part(plan.videos[0], own[-1], plan.rules, [])
    assert len(asked) > before
    np.testing.assert_array_equal(together[-1].crops, alone.crops)
    assert together[-1].columns == alone.columns


def test_labels_of_a_whole_video_stand_with_every_frame(tmp_path: Path):
    plan = focusing_plan(little_scene())
    videos = tuple(replace(one, session=replace(one.session, seconds=1.0)) for one in plan.videos[4:6])
    plan = replace(plan, videos=videos, rules=Rules(side=24, test_fraction=0))
    dataset = open_dataset(synthesise(plan, tmp_path / "set.zarr"))
    assert dataset.tp.targets == ("gaze_x", "gaze_y", "object_distance", "focal_length")
    distance = np.array([5.0, 5.5], np.float32)[dataset["recording"].values]
    np.testing.assert_array_equal(dataset["object_distance"].values, distance)
    np.testing.assert_allclose(dataset["focal_length"].values, 0.05, rtol=1e-6)


def test_devices_are_classes(tmp_path: Path):
    plan = replace(little_plan(seconds=1.0), rules=Rules(side=40, test_fraction=0))
    names = ("phone-02", "phone-01")
    videos = tuple(replace(one, labels=(("device", name),)) for one, name in zip(plan.videos, names, strict=True))
    dataset = open_dataset(synthesise(replace(plan, videos=videos), tmp_path / "set.zarr"))
    assert dataset.tp.targets == ("gaze_x", "gaze_y", "device")
    assert dataset.tp.classes == ("phone-01", "phone-02")
    np.testing.assert_array_equal(dataset["device"].values, 1 - dataset["recording"].values)


def test_a_set_without_any_frame_is_told_and_not_written(tmp_path: Path):
    plan = little_plan(videos=1, seconds=1.0)
    dark = replace(plan.videos[0], session=replace(plan.videos[0].session, laser=False))
    with pytest.raises(InputError, match="no frame has both"):
        synthesise(replace(plan, videos=(dark,)), tmp_path / "set.zarr")
    assert not (tmp_path / "set.zarr").exists()


def test_bad_arguments_are_told(whole: Path, tmp_path: Path):
    plan = little_plan(videos=1)
    with pytest.raises(InputError, match="exists already"):
        synthesise(plan, whole)
    for how, word in (
        ({"workers": 0}, "workers"),
        ({"processes": 0}, "processes"),
        ({"workers": 1, "cluster": "tcp://127.0.0.1:1"}, "two ways"),
        ({"workers": 1, "processes": 2}, "workers, processes: are two ways"),
    ):
        with pytest.raises(InputError, match=word):
            synthesise(plan, tmp_path / "set.zarr", **how)
    assert list(tmp_path.iterdir()) == []


def test_the_plan_in_the_part_folder_says_all(tmp_path: Path):
    plan: Plan = little_plan(videos=1)
    with pytest.raises(KeyboardInterrupt):
        synthesise(plan, tmp_path / "set.zarr", progress=Stop(0))
    told = json.loads((tmp_path / "set.zarr.part" / "plan.json").read_text(encoding="utf-8"))
    assert told["digest"] == plan.digest and told["videos"][0]["session"]["seed"] == plan.videos[0].session.seed


def numbered(value: int, count: int = CHUNK + 4) -> Made:
    crops = [np.full((40, 40), value + n, np.uint8) for n in range(count)]
    return Made(crops, {"gaze_x": [0.0] * count}, {"used": count, "frames": 60, "left_out": {}}, None)


def test_a_part_that_lost_bytes_is_told_and_not_black(tmp_path: Path) -> None:
    plan = little_plan(1)
    staging, part = Staging.begin(tmp_path / "s.zarr", plan), plan.parts[0]
    made = numbered(7)
    made.crops[5] = np.random.default_rng(0).integers(0, 255, (40, 40)).astype(np.uint8)
    staging.keep(part, made)
    np.testing.assert_array_equal(staging.read(part).crops, made.crops)
    assert staging.read(part).columns == made.columns and staging.read(part).told == made.told
    (file,) = (tmp_path / "s.zarr.part" / "done").iterdir()
    whole = file.read_bytes()
    for place in np.linspace(8, len(whole) - 9, 25).astype(int):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        try:
            found = staging.read(part)
        except InputError as error:
            assert "damaged" in str(error) and "remove this file" in str(error)
        else:
            # Bits of the file's description that say nothing of the crops may change.
            np.testing.assert_array_equal(found.crops, made.crops)
            assert found.columns == made.columns
    middle = len(whole) // 3
    file.write_bytes(whole[:middle] + bytes(64) + whole[middle + 64 :])
    with pytest.raises(InputError, match="damaged"):
        staging.read(part)
    file.write_bytes(whole)
    assert len(staging.read(part).crops) == CHUNK + 4


def test_a_part_is_on_the_disk_before_it_counts_as_done(tmp_path: Path, monkeypatch) -> None:
    if not Path("/proc/self/fd").exists():
        pytest.skip("asks Linux which file was flushed")
    plan = little_plan(1)
    staging, part = Staging.begin(tmp_path / "s.zarr", plan), plan.parts[0]
    flushed: list[tuple[str, bool]] = []
    flush = os.fsync

    def fsync(handle: int) -> None:
        flushed.append((str(Path(f"/proc/self/fd/{handle}").readlink()), staging.has(part)))
        flush(handle)

    monkeypatch.setattr(os, "fsync", fsync)
    staging.keep(part, numbered(7))
    # The file is flushed under its temporary name, then the folder that lists it.
    done = tmp_path / "s.zarr.part" / "done"
    (first, early), *rest = flushed
    assert Path(first).parent == done and first.endswith(".parquet") and not early
    assert (str(done), True) in rest


def test_only_a_missing_laser_means_no_label(monkeypatch) -> None:
    plan = little_plan(1, 2.0)
    asked = (plan.videos[0], plan.parts[0], plan.rules, plan.classes)

    def fails(error: InputError):
        def label(clip) -> None:
            raise error

        return label

    monkeypatch.setattr(working, "label_recording", fails(NoLaserError("no laser spot found")))
    assert make_part(*asked).told["used"] == 0
    monkeypatch.setattr(working, "label_recording", fails(InputError("UTC of stream target does not rise")))
    with pytest.raises(InputError, match="does not rise"):
        make_part(*asked)


def test_frames_after_the_target_s_last_have_no_label() -> None:
    """One frame is left for the last part of a video, and the target's camera ended 30 ms before it."""
    plan = make_plan("rotation", "small", seed=2)
    video = plan.videos[1]
    beats = shot_of(video.scene, video.session).beats
    count = len(beats["probe"].times)
    assert beats["probe"].times[-1] > beats["target"].times[-1]
    made = make_part(video, replace(plan.parts[-1], video=1, first=count - 1, last=count), plan.rules, plan.classes)
    assert made.told["used"] == 0 and made.told["left_out"] == {"no label": 1}


def test_of_two_commands_that_make_one_set_one_is_refused(tmp_path: Path) -> None:
    told: list[str] = []

    def second() -> None:
        with pytest.raises(InputError) as raised:
            synthesise(little_plan(), tmp_path / "s.zarr")
        told.append(str(raised.value))

    with sole_writer(tmp_path / "s.zarr"):
        thread = threading.Thread(target=second)
        thread.start()
        thread.join()
    assert "is being written by process" in told[0] and not list(tmp_path.iterdir())
