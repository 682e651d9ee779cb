"""What a folder is taken for, before a person has said so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tapetum.data.importing import common_root, look_into, propose
from tapetum.data.importing.guess import constants, depth, looks_centred, meaning
from tapetum.errors import InputError
from tapetum.record.video import VideoWriter


def video(path: Path, count: int = 4) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with VideoWriter(path, (20, 24)) as writer:
        for n in range(count):
            writer.write(np.full((20, 24), n, np.uint8))


def test_names_and_values_are_understood():
    names = {
        "Gaze_X": "gaze_x",
        "set/xd": "object_distance",
        "phone": "device",
        "filename": "names",
        "f_t": "focal_length",
    }
    assert {name: meaning(name) for name in names} == names
    assert meaning("temperature") is None
    assert constants("Focusing/50mm/xd_3.5m.mp4") == {"object_distance": "3.5 m", "focal_length": "50 mm"}
    assert constants("video_1/probe.avi") == {}
    for top, kind, scale in ((200, np.uint8, 255), (900, np.uint16, 1023), (0.8, np.float32, 1), (90, np.float32, 255)):
        assert depth([np.full((2, 2), top, kind)]) == scale
    spot = np.zeros((41, 41), np.uint8)
    spot[18:23, 18:23] = 200
    assert looks_centred([spot]) and not looks_centred([np.roll(spot, 12, axis=0)])
    assert not looks_centred([spot[:, 4:-4]])


def test_probe_and_target_videos_are_paired_and_named_apart(tmp_path: Path):
    for name in ("Rotation/video_1", "Rotation/video_2", "Phones/video_1"):
        video(tmp_path / name / "probe.mkv")
        video(tmp_path / name / "target.mkv")
    (tmp_path / "Phones" / "video_1" / "times.csv").write_text("probe_s,target_s\n" + "1.0,1.1\n" * 4)
    proposal = propose(look_into([tmp_path]))
    pairs = proposal.mapping("here").videos
    assert [(pair.probe, pair.align) for pair in pairs] == [
        ("Phones/video_1/probe.mkv", "timestamps"),
        ("Rotation/video_1/probe.mkv", "same start"),
        ("Rotation/video_2/probe.mkv", "same start"),
    ]
    assert [pair.name for pair in pairs] == ["Phones-video_1", "Rotation-video_1", ""]
    assert "# guess: Rotation/video_1/probe.mkv: both videos begin at the same moment" in proposal.text


def test_what_a_proposal_leaves_out_is_said(tmp_path: Path):
    for name in ("day1/probe", "day1/target", "day2/probe", "extra"):
        video(tmp_path / f"{name}.mkv")
    np.save(tmp_path / "notes.npy", np.zeros(7))
    proposal = propose(look_into([tmp_path]))
    assert [pair.probe for pair in proposal.mapping("here").videos] == ["day1/probe.mkv"]
    assert "# left out: day2/probe.mkv: no target video of the same name" in proposal.text
    assert "# left out: extra.mkv: not in a pair" in proposal.text
    assert "# left out: notes.npy" in proposal.text and "day1/target.mkv:" not in proposal.text


def test_an_array_that_means_nothing_is_said_to_be_left_out(tmp_path: Path):
    np.save(tmp_path / "images.npy", np.zeros((9, 16, 16), np.uint8))
    np.save(tmp_path / "gaze.npy", np.zeros((9, 2)))
    np.save(tmp_path / "weather.npy", np.zeros(5))
    told = propose(look_into([tmp_path])).text
    assert "# left out: weather.npy" in told and "# left out: gaze.npy" not in told


def test_arrays_find_the_labels_of_their_own_name(tmp_path: Path):
    for n in (1, 2):
        np.save(tmp_path / f"v{n}_images.npy", np.zeros((9, 16, 16), np.uint8))
        np.save(tmp_path / f"v{n}_gaze.npy", np.full((9, 2), n / 10))
    np.save(tmp_path / "focal_length.npy", np.full(9, 50.0))
    stacks = propose(look_into([tmp_path])).content["stacks"]
    for n, stack in enumerate(stacks, 1):
        assert stack["images"]["file"] == f"v{n}_images.npy"
        assert stack["labels"]["gaze_x"]["file"] == f"v{n}_gaze.npy"
        assert stack["labels"]["focal_length"] == {"file": "focal_length.npy", "unit": "mm"}


def test_pictures_without_labels_leave_a_gap(tmp_path: Path):
    np.save(tmp_path / "images.npy", np.zeros((9, 16, 16), np.uint8))
    proposal = propose(look_into([tmp_path]))
    assert "# missing: no labels were found for images.npy (9 pictures)" in proposal.text
    with pytest.raises(InputError, match="no mapping could be made: no labels were found"):
        proposal.mapping("here")


def test_recordings_and_datasets_need_no_import(film, tmp_path: Path):
    film()
    (tmp_path / "set.zarr").mkdir()
    (tmp_path / "set.zarr" / "zarr.json").write_text("{}")
    found = look_into([tmp_path])
    assert found.recordings == ["a.rec"] and not found.videos and not found.tables
    with pytest.raises(InputError, match=r"no pictures were found \(recording a\.rec: cut it with"):
        propose(found)


def test_the_root_is_the_folder_that_holds_all(tmp_path: Path):
    video(tmp_path / "a" / "one.mkv")
    video(tmp_path / "b" / "two.mkv")
    assert common_root([tmp_path / "a" / "one.mkv"]) == tmp_path / "a"
    assert common_root([tmp_path / "a", tmp_path / "b" / "two.mkv"]) == tmp_path
    found = look_into([tmp_path / "a", tmp_path / "b" / "two.mkv"])
    assert [one.path for one in found.videos] == ["a/one.mkv", "b/two.mkv"]


def test_columns_that_nothing_uses_are_said_to_be_left_out(tmp_path: Path):
    np.save(tmp_path / "rotation.npy", np.zeros((6, 16, 16), np.uint8))
    (tmp_path / "rotation.csv").write_text("x,y,mood\n" + "0.1,0.2,1\n" * 6)
    (tmp_path / "other.csv").write_text("x,y\n" + "0.1,0.2\n" * 4)
    (tmp_path / "notes.docx").write_bytes(b"x")
    found = look_into([tmp_path])
    assert "1 file of other kinds: notes.docx" in found.lines
    dropped = propose(found).dropped
    assert "mood of rotation.csv: its name or its number of rows fits no pictures" in dropped
    assert "other.csv (4 rows): its name or its number of rows fits no pictures" in dropped
    assert not [line for line in dropped if line.startswith(("x", "rotation.npy"))]
