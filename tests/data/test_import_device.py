"""The class label `device`: from recordings and arrays to a dataset and back."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tapetum.data import build_dataset, content_hash, dataset_from_arrays, open_dataset
from tapetum.errors import InputError
from tapetum.record.recording import open_recording


def named(recording: Path, name: str) -> Path:
    opened = open_recording(recording)
    table = opened.labels()
    assert table is not None
    opened.write_labels(table.append_column("device", pa.array([name] * len(table))))
    return recording


def test_recordings_of_two_devices_become_classes(film, tmp_path: Path):
    two = [named(film("a.rec"), "phone-02"), named(film("b.rec", frames=10, seed=1), "phone-01")]
    dataset = open_dataset(build_dataset(two, tmp_path / "set.zarr", side=16))
    assert dataset.tp.targets == ("gaze_x", "gaze_y", "device")
    assert dataset.tp.classes == ("phone-01", "phone-02")
    assert dataset["device"].dtype == np.int32
    assert dataset["device"].values.tolist() == [1] * 20 + [0] * 10
    assert dataset.tp.values(("device",))[[0, -1], 0].tolist() == [1.0, 0.0]
    assert content_hash(dataset) == dataset.tp.hash


def test_no_device_no_classes(film, tmp_path: Path):
    dataset = open_dataset(build_dataset([film()], tmp_path / "set.zarr", side=16))
    assert dataset.tp.targets == ("gaze_x", "gaze_y")
    assert dataset.tp.classes == ()


def test_arrays_with_names():
    images = np.zeros((3, 8, 8), np.uint8)
    dataset = dataset_from_arrays(images, {"device": ["b", "a", "b"]})
    assert dataset["device"].values.tolist() == [1, 0, 1]
    assert dataset.tp.classes == ("a", "b")
    with pytest.raises(InputError, match="expected 3 names"):
        dataset_from_arrays(images, {"device": [0, 1, 2]})


def test_numbers_without_names_are_told(film, tmp_path: Path):
    store = build_dataset([named(film(), "phone-01")], tmp_path / "set.zarr", side=16)
    file = store / "device" / "zarr.json"
    meta = json.loads(file.read_text())
    meta["attributes"]["classes"] = []
    file.write_text(json.dumps(meta))
    with pytest.raises(InputError, match="device lacks names for its numbers"):
        open_dataset(store)
