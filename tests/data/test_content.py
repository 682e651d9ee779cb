"""The hash of a set is that of what it holds: no other label, part, class or image goes by the same one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr

from tapetum.data import build_dataset, content_hash, dataset_from_arrays, open_dataset
from tapetum.data.content import DIGEST
from tapetum.errors import InputError
from tapetum.models import ResNet18, ZernikeRidge

pytestmark = pytest.mark.usefixtures("narrow")


@pytest.fixture
def small() -> xr.Dataset:
    rng = np.random.default_rng(3)
    images = rng.integers(0, 255, (24, 16, 16), dtype=np.uint8)
    labels = {"gaze_x": rng.uniform(-0.5, 0.5, 24), "device": ["phone-a", "phone-b"] * 12}
    return dataset_from_arrays(images, labels, split=[0] * 18 + [1] * 6, recording=np.arange(24) // 12)


def relabelled(dataset: xr.Dataset) -> xr.Dataset:
    return dataset.assign(gaze_x=dataset["gaze_x"] + 0.01)


def renamed(dataset: xr.Dataset) -> xr.Dataset:
    other = dataset.copy()
    other["device"] = other["device"].assign_attrs(classes=["phone-b", "phone-a"])
    return other


CHANGES = {
    "another label": relabelled,
    "other names of the classes": renamed,
    "a part": lambda one: one.isel(frame=slice(0, 20)),
    "another order": lambda one: one.isel(frame=[1, 0, *range(2, 24)]),
    "another split": lambda one: one.assign(split=("frame", np.zeros(24, np.int8))),
    "another recording": lambda one: one.assign(recording=one["recording"] + 1),
    "other images": lambda one: one.assign(image=one["image"] // 2),
    "another full scale": lambda one: one.assign_attrs(full_scale=300.0),
    "fewer targets": lambda one: one.assign_attrs(targets=["gaze_x"]),
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_what_differs_has_another_hash(small: xr.Dataset, change) -> None:
    assert change(small).tp.hash != small.tp.hash
    assert small.copy(deep=True).tp.hash == small.tp.hash == content_hash(small)


@pytest.mark.parametrize("change", list(CHANGES.values())[:1] + list(CHANGES.values())[2:8])
def test_so_it_is_with_a_set_on_disk(film, tmp_path: Path, change) -> None:
    stored = open_dataset(build_dataset([film(frames=24)], tmp_path / "a.zarr", side=16))
    other = stored if change is None else change(stored)
    assert other.tp.hash != stored.tp.hash
    assert other.tp.hash == content_hash(other)
    assert stored.tp.train.tp.hash == content_hash(stored.tp.train) == content_hash(stored.tp.train.load())


def test_a_stored_set_is_hashed_without_reading_its_images(film, tmp_path: Path, monkeypatch) -> None:
    stored = open_dataset(build_dataset([film()], tmp_path / "a.zarr", side=16))
    known = content_hash(stored.tp.test)
    monkeypatch.setattr("tapetum.data.dataset.image_batches", lambda *_: pytest.fail("read the images"))
    assert stored.tp.test.tp.hash == known


def test_a_set_of_an_earlier_version_opens_and_is_hashed_by_reading_it(film, tmp_path: Path) -> None:
    path = build_dataset([film()], tmp_path / "a.zarr", side=16)
    new = open_dataset(path)
    whole, part = new.tp.hash, new.tp.train.tp.hash
    group = zarr.open_group(str(path), mode="r+", zarr_format=3)
    del group[DIGEST]
    group.attrs["sha256"] = "0" * 64
    old = open_dataset(path)
    assert DIGEST not in old and (old.tp.hash, old.tp.train.tp.hash) == (whole, part)


@pytest.mark.parametrize("change", [relabelled, lambda one: one.isel(frame=slice(1, 24))])
def test_a_checkpoint_goes_on_with_its_own_labels_and_frames_only(small: xr.Dataset, tmp_path: Path, change) -> None:
    network = {"target": "gaze_x", "crop": 16, "size": 16, "batch": 8, "epochs": 1, "device": "cpu"}
    ResNet18(**network).fit(small, checkpoint=tmp_path / "c")
    with pytest.raises(InputError, match="other settings or other data"):
        ResNet18(**network).fit(change(small), checkpoint=tmp_path / "c", resume=True)
    ResNet18(**network).fit(small, checkpoint=tmp_path / "c", resume=True)


def test_a_model_names_the_frames_it_learned_from(small: xr.Dataset) -> None:
    ridge = ZernikeRidge("gaze_x", scales=(8, 16), order=3)
    whole = ridge.fit(small).data_hash_
    assert whole == ridge.fit(small.tp.train).data_hash_ == small.tp.train.tp.hash
    # What only tests does not change what was learned.
    tested = small.assign(gaze_x=small["gaze_x"] + np.float32(0.1) * small["split"])
    assert ridge.fit(tested).data_hash_ == whole
    assert ridge.fit(relabelled(small)).data_hash_ != whole
