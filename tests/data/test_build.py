"""From recordings to a dataset and back."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tapetum.data import build_dataset, content_hash, open_dataset
from tapetum.data.crop import crop, find_centre
from tapetum.errors import InputError
from tapetum.record.recording import open_recording


def place(n: int) -> tuple[float, float]:
    return 30 + 1.3 * n, 36 + 4 * np.sin(n)


def test_crops_labels_and_places(film, tmp_path: Path):
    recording = film()
    dataset = open_dataset(build_dataset([recording], tmp_path / "set.zarr", side=32))
    assert dataset["image"].dims == ("frame", "y", "x")
    assert dataset["image"].shape == (20, 32, 32)
    assert dataset["image"].dtype == np.uint8
    np.testing.assert_allclose(dataset["gaze_x"], np.arange(20) / 100, rtol=1e-6)
    np.testing.assert_allclose(dataset["gaze_y"], -np.arange(20) / 100, rtol=1e-6)
    assert dataset["gaze_x"].attrs["units"] == "fraction of the field of view"
    np.testing.assert_allclose(dataset["time"], np.arange(20) / 15, atol=1e-6)
    assert float(dataset["snr"].min()) > 6
    for frame in open_recording(recording).source("probe"):
        n = frame.index
        centre = float(dataset["centre_x"][n]), float(dataset["centre_y"][n])
        assert math.dist(centre, place(n)) < 0.5
        np.testing.assert_array_equal(dataset["image"][n], crop(frame.image, find_centre(frame.image), 32))


def test_the_last_fifth_of_every_video_tests(film, tmp_path: Path):
    two = [film("a.rec"), film("b.rec", frames=10, seed=1)]
    dataset = open_dataset(build_dataset(two, tmp_path / "set.zarr", side=16))
    assert dataset["split"].values.tolist() == [0] * 16 + [1] * 4 + [0] * 8 + [1] * 2
    assert dataset["split"].attrs["flag_meanings"] == "train test embargo"
    assert dataset.tp.train["frame_index"].values.tolist() == [*range(16), *range(8)]
    assert dataset.tp.test["recording"].values.tolist() == [0] * 4 + [1] * 2
    assert [r["name"] for r in dataset.tp.recordings] == ["a.rec", "b.rec"]
    assert dataset.tp.recordings[1]["uuid"] == open_recording(two[1]).meta["uuid"]


def test_left_out_frames_are_counted_and_do_not_move_the_split(film, tmp_path: Path):
    recording = film(dark=(2, 3), unlabelled=(5,), poor=(17,))
    dataset = open_dataset(build_dataset([recording], tmp_path / "set.zarr", side=16))
    kept = [n for n in range(20) if n not in (2, 3, 5, 17)]
    assert dataset["frame_index"].values.tolist() == kept
    assert dataset["split"].values.tolist() == [int(n >= 16) for n in kept]
    told = dataset.tp.recordings[0]
    assert told["left_out"] == {"no label": 1, "poor label": 1, "no visible RR": 2}
    assert (told["frames"], told["used"]) == (20, 16)


def test_more_frames_than_a_chunk_come_back_in_order(film, tmp_path: Path):
    recording = film(frames=40)
    from tapetum.data import build

    assert build.CHUNK == 64
    two = [recording, film("b.rec", frames=40)]
    dataset = open_dataset(build_dataset(two, tmp_path / "set.zarr", side=8))
    assert sum(len(batch) for batch in dataset.tp.images(7)) == 80
    np.testing.assert_array_equal(np.concatenate(list(dataset.tp.images(7))), dataset["image"].values)
    assert dataset["frame_index"].values.tolist() == [*range(40), *range(40)]


def test_deep_frames_stay_deep(film, tmp_path: Path):
    dataset = open_dataset(build_dataset([film(bits=12)], tmp_path / "set.zarr", side=16))
    assert dataset["image"].dtype == np.uint16
    assert dataset.tp.full_scale == 4095
    assert dataset["image"].values.max() > 2000


def test_the_hash_is_of_the_contents(film, tmp_path: Path):
    recording = film()
    first = open_dataset(build_dataset([recording], tmp_path / "a.zarr", side=16))
    again = open_dataset(build_dataset([recording], tmp_path / "b.zarr", side=16))
    other = open_dataset(build_dataset([recording], tmp_path / "c.zarr", side=17))
    assert first.tp.hash == again.tp.hash == content_hash(first)
    assert other.tp.hash != first.tp.hash
    assert len({one.tp.hash for one in (first, first.tp.train, first.tp.test)}) == 3


def test_anyone_can_open_it(film, tmp_path: Path):
    path = build_dataset([film()], tmp_path / "set.zarr", side=16)
    dataset = xr.open_zarr(path, consolidated=False, chunks=None)
    assert dataset["image"].dtype == np.uint8
    assert dataset.attrs["format"] == "tapetum-dataset"


def test_images_are_read_only_when_used(film, tmp_path: Path):
    dataset = open_dataset(build_dataset([film()], tmp_path / "set.zarr", side=16))
    assert not dataset["image"].variable._in_memory
    assert not dataset.tp.test["image"].variable._in_memory


def test_whole_videos_may_train_or_test(film, tmp_path: Path):
    recording = film()
    assert (
        len(open_dataset(build_dataset([recording], tmp_path / "a.zarr", side=8, test_fraction=0)).tp.test.frame) == 0
    )
    assert (
        len(open_dataset(build_dataset([recording], tmp_path / "b.zarr", side=8, test_fraction=1)).tp.train.frame) == 0
    )


@pytest.mark.parametrize(
    ("films", "how", "word"),
    [
        ([], {}, "no recording given"),
        ([{"columns": None}], {}, "no labels"),
        ([{"columns": ("left", "right")}], {}, "expected columns"),
        ([{}, {"bits": 12}], {}, "differ in depth"),
        ([{}, {"columns": ("object_distance", "focal_length")}], {}, "different quantities"),
        ([{"dark": tuple(range(20))}], {}, "no frame has both"),
        ([{"dark": tuple(range(16, 20))}], {}, "no frame is left to test"),
        ([{}], {"side": 0}, "side"),
        ([{}], {"test_fraction": 1.5}, "test_fraction"),
        ([{}], {"test_fraction": float("nan")}, "test_fraction"),
        ([{}], {"min_snr": float("nan")}, "min_snr: must be finite, is nan"),
        ([{}], {"min_quality": float("nan")}, "min_quality: must be finite, is nan"),
        ([{}], {"embargo": -1}, "embargo: must be 0 or more, is -1"),
        ([{}], {"embargo": float("nan")}, "embargo: must be 0 or more, is nan"),
    ],
)
def test_bad_input_is_told_and_nothing_is_written(film, tmp_path: Path, films, how, word: str):
    recordings = [film(f"{n}.rec", **one) for n, one in enumerate(films)]
    with pytest.raises(InputError, match=word):
        build_dataset(recordings, tmp_path / "set.zarr", **{"side": 8, **how})
    assert [p for p in tmp_path.iterdir() if p.suffix != ".rec"] == []


def test_a_recording_given_twice_is_told(film, tmp_path: Path):
    recording = film()
    with pytest.raises(InputError, match="given twice"):
        build_dataset([recording, recording], tmp_path / "set.zarr", side=8)


def test_recordings_may_be_open_and_any_iterable(film, tmp_path: Path):
    first, second = film("a.rec", seed=1), film("b.rec", seed=2)
    paths = build_dataset([first, second], tmp_path / "paths.zarr", side=8)
    mixed = build_dataset((one for one in (open_recording(first), str(second))), tmp_path / "mixed.zarr", side=8)
    assert open_dataset(mixed).tp.hash == open_dataset(paths).tp.hash
    alone = build_dataset(open_recording(first), tmp_path / "alone.zarr", side=8)
    assert open_dataset(alone).attrs["recordings"].count('"uuid"') == 1
    with pytest.raises(InputError, match="given twice"):
        build_dataset([first, open_recording(first)], tmp_path / "twice.zarr", side=8)
    with pytest.raises(InputError, match=r"recordings\[1\]: is of type int; give its folder"):
        build_dataset([first, 3], tmp_path / "odd.zarr", side=8)  # type: ignore[list-item]
    with pytest.raises(InputError, match="recordings: is None"):
        build_dataset(None, tmp_path / "odd.zarr", side=8)  # type: ignore[arg-type]


def test_nothing_is_overwritten_unasked(film, tmp_path: Path):
    recording = film()
    path = build_dataset([recording], tmp_path / "set.zarr", side=8)
    with pytest.raises(InputError, match="exists already"):
        build_dataset([recording], path, side=8)
    build_dataset([recording], path, side=10, overwrite=True)
    assert open_dataset(path).tp.side == 10


def test_a_folder_of_something_else_is_never_replaced(film, tmp_path: Path):
    other = tmp_path / "set.zarr"
    other.mkdir()
    (other / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="no tapetum-dataset that may be replaced"):
        build_dataset([film()], other, side=8, overwrite=True)
    assert (other / "notes.txt").read_text() == "mine"


def test_an_interrupted_build_leaves_nothing(film, tmp_path: Path):
    def stop(items, what, *, total=None):
        for n, item in enumerate(items):
            if n == 5:
                raise KeyboardInterrupt
            yield item

    recording = film()
    with pytest.raises(KeyboardInterrupt):
        build_dataset([recording], tmp_path / "set.zarr", side=8, progress=stop)
    assert [p.name for p in tmp_path.iterdir()] == ["a.rec"]


def test_a_simulated_recording_is_known_as_one(tmp_path: Path, film):
    from synth_plans import little_scene, shortened

    from tapetum.record import Session, label_recording, open_recording
    from tapetum.record import film as film_scene
    from tapetum.report.evaluation.outcome import _covariates, _simulated

    recording = film_scene(little_scene(), tmp_path / "sim.rec", shortened(Session(seed=4), 1.2))
    label_recording(recording)
    for path, simulated in ((recording.path, True), (film("real.rec"), None)):
        dataset = open_dataset(build_dataset([path], path.with_suffix(".zarr"), side=40))
        assert _simulated(dataset, dataset.tp.recordings) is simulated
    one = open_dataset(recording.path.with_suffix(".zarr"))
    assert one.tp.recordings[0]["hardware"]["bench"] == open_recording(recording.path).meta["hardware"]["bench"]
    assert set(_covariates(one, one.tp.recordings, one["recording"].values)) == {"distance", "exposure"}
