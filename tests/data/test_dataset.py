"""Opening datasets: what is whole, and what is not."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tapetum.data import build_dataset, dataset_from_arrays, image_batches, open_dataset
from tapetum.errors import InputError


@pytest.fixture
def store(film, tmp_path: Path) -> Path:
    return build_dataset([film()], tmp_path / "set.zarr", side=16)


def change(store: Path, **attributes) -> None:
    meta = json.loads((store / "zarr.json").read_text())
    meta["attributes"].update(attributes)
    (store / "zarr.json").write_text(json.dumps(meta))


def test_nothing_there(tmp_path: Path):
    with pytest.raises(InputError, match="does not exist"):
        open_dataset(tmp_path / "none.zarr")


def test_not_a_store(tmp_path: Path):
    (tmp_path / "x").mkdir()
    with pytest.raises(InputError, match="not a dataset"):
        open_dataset(tmp_path / "x")


@pytest.mark.parametrize(
    ("attributes", "word"),
    [
        ({"format": "other"}, "not a Tapetum dataset"),
        ({"version": 2}, "update Tapetum"),
        ({"version": "x"}, "update Tapetum"),
        ({"full_scale": None}, "full_scale"),
        ({"targets": ["gaze_x", "gaze_z"]}, "lacks gaze_z"),
    ],
)
def test_foreign_newer_or_damaged_attributes(store: Path, attributes, word: str):
    change(store, **attributes)
    with pytest.raises(InputError, match=word):
        open_dataset(store)


def test_broken_metadata(store: Path):
    (store / "zarr.json").write_text("{")
    with pytest.raises(InputError, match="not a readable Zarr"):
        open_dataset(store)


def test_a_missing_variable(store: Path):
    shutil.rmtree(store / "split")
    with pytest.raises(InputError, match="lacks split"):
        open_dataset(store)


def test_a_missing_chunk_is_not_read_as_zeros(store: Path):
    next(p for p in (store / "image").rglob("*") if p.is_file() and p.name != "zarr.json").unlink()
    with pytest.raises(InputError, match="parts of image are missing"):
        open_dataset(store)


@pytest.mark.parametrize("name", ["image", "gaze_x"])
def test_a_flipped_bit_is_noticed(store: Path, name: str):
    chunk = next(p for p in (store / name).rglob("*") if p.is_file() and p.name != "zarr.json")
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(data)
    with pytest.raises(InputError, match=rf"set\.zarr: damaged: {name} cannot be read"):
        list(open_dataset(store).tp.train.tp.images())


def test_a_label_that_is_not_there(store: Path):
    with pytest.raises(InputError, match=r"no label 'focal_length'.*it has: gaze_x, gaze_y"):
        open_dataset(store).tp.values(("focal_length",))


def test_arrays_make_a_dataset():
    images = np.random.default_rng(0).integers(0, 255, (6, 8, 8), dtype=np.uint8)
    dataset = dataset_from_arrays(images, {"focal_length": np.arange(6) / 10}, split=[0, 0, 0, 0, 1, 1])
    assert dataset.tp.targets == ("focal_length",)
    assert dataset["focal_length"].attrs["units"] == "m"
    assert dataset.tp.train.sizes["frame"] == 4
    np.testing.assert_array_equal(np.concatenate(list(image_batches(dataset.tp.test, 1))), images[4:])
    same = dataset_from_arrays(images, {"focal_length": np.arange(6) / 10}, split=[0, 0, 0, 0, 1, 1])
    assert same.tp.hash == dataset.tp.hash
    assert dataset_from_arrays(images, {"focal_length": np.arange(6) / 10}).tp.hash != dataset.tp.hash


@pytest.mark.parametrize(
    ("images", "targets", "how", "word"),
    [
        (np.zeros((2, 3, 4), np.uint8), {}, {}, "square crops"),
        (np.zeros((2, 4, 4), np.uint16), {}, {}, "depth"),
        (np.zeros((2, 4, 4), np.uint8), {"a": [1, np.nan]}, {}, "finite"),
        (np.zeros((2, 4, 4), np.uint8), {"a": [1]}, {}, "finite values"),
        (np.zeros((2, 4, 4), np.uint8), {"a": [1, 2]}, {"split": [0, 7]}, "split"),
    ],
)
def test_bad_arrays_are_told(images, targets, how, word: str):
    with pytest.raises(InputError, match=word):
        dataset_from_arrays(images, targets, **how)


def test_batches_are_cut_from_what_is_read_at_once() -> None:
    """Four batches are read at once, and the last of them may be short."""
    images = np.arange(11 * 8 * 8, dtype=np.uint16).reshape(11, 8, 8)
    labels = {"gaze_x": np.zeros(11), "gaze_y": np.zeros(11)}
    dataset = dataset_from_arrays(images, labels, full_scale=65535)
    for size in (1, 2, 3, 64):
        batches = list(image_batches(dataset, size))
        assert [len(one) for one in batches] == [size] * (11 // size) + ([11 % size] if 11 % size else [])
        np.testing.assert_array_equal(np.concatenate(batches), images)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"full_scale": math.inf}, "full_scale: must be positive and finite"),
        ({"full_scale": -1.0}, "full_scale: must be positive and finite"),
        ({"split": [0.5, 0]}, "split: expected 2 values"),
        ({"split": [257, 0]}, "split: expected 2 values"),
        ({"split": ["train", "train"]}, "split: expected 2 values"),
        ({"recording": [1.2, 1.9]}, "recording: expected 2 values"),
        ({"targets": {"gaze_x": ["a", "b"]}}, "gaze_x: holds no numbers"),
        ({"targets": {"device": [None, "b"]}}, "device: the name of image 0 is None"),
        ({"targets": {"device": np.array(["a", np.nan], object)}}, "device: the name of image 1 is nan"),
        ({"targets": {"image": [1, 2]}}, "image: is the name of a variable"),
        ({"images": np.zeros((2, 8, 8), complex)}, "images: images of type complex128"),
    ],
)
def test_arrays_that_make_no_set(changes: dict[str, Any], words: str) -> None:
    usual: dict[str, Any] = {"images": np.zeros((2, 8, 8), np.uint8), "targets": {"gaze_x": [0.0, 0.1]}}
    given = {**usual, **changes}
    with pytest.raises(InputError, match=re.escape(words)):
        dataset_from_arrays(given.pop("images"), given.pop("targets"), **given)


def test_only_targets_are_labels() -> None:
    """A model was trained on the spots' SNR, or stopped in scikit-learn for images."""
    dataset = dataset_from_arrays(np.zeros((2, 8, 8), np.uint8), {"gaze_x": [0.0, 0.1]})
    for name in ("image", "recording"):
        with pytest.raises(InputError, match=f"has no label '{name}'; it has: gaze_x"):
            dataset.tp.values((name,))
