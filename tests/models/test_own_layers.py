"""Copies of the camera train the layers before the last; what the model says stays that of its own camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from tests.models.conftest import pictures

from tapetum.data import dataset_from_arrays
from tapetum.data.dataset import UNIT, class_variable
from tapetum.errors import InputError
from tapetum.models import ResNet18, load_model, save_model
from tapetum.models.losses import MixedLoss
from tapetum.models.own_layers import OwnLayers, beside_copies, targets_beside, without_copies

QUICK = {"crop": 40, "size": 24, "batch": 20, "device": "cpu"}


def copies_set(copies: int, each: int, moved: float) -> xr.Dataset:
    """Copies whose gaze is that of `pictures`, moved along x."""
    images, gaze = pictures(copies * each, seed=5)
    number = np.repeat(np.arange(copies), each)
    labels = {"gaze_x": gaze[:, 0] + moved, "gaze_y": gaze[:, 1]}
    data = dataset_from_arrays(images, labels, recording=number)
    return data.assign({UNIT: class_variable([f"copy-{one}" for one in number.tolist()])})


@pytest.mark.parametrize("weighted", [False, True])
def test_the_loss_is_that_of_each_camera(weighted: bool) -> None:
    generator = torch.Generator().manual_seed(0)
    output = torch.randn(5, 6, generator=generator)
    own, weights = torch.randn(2, 2, generator=generator), torch.tensor([[0.5, 1.5], [1.5, 0.5]])
    labels, number = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]), np.array([1, 2, 2])
    wanted = targets_beside(torch.cat([own, weights], 1) if weighted else own, labels, number)
    assert wanted.shape == (5, 5 if weighted else 3) and wanted[:, -1].tolist() == [0, 0, 1, 2, 2]
    found = output[:, :2].clone()
    found[2] += output[2, 2:4]
    found[3:] += output[3:, 4:]
    targets = torch.cat([own, torch.from_numpy(labels).float()])
    if weighted:
        targets = torch.cat([targets, torch.cat([weights, torch.ones(3, 2)])], 1)
    assert float(OwnLayers(2, weighted)(output, wanted)) == pytest.approx(float(MixedLoss(2, weighted)(found, targets)))


def test_copies_start_alike_and_go() -> None:
    network = beside_copies("resnet18", 2, 3, seed=0).eval()
    images = torch.randn(2, 1, 24, 24, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        found = network(images)
        assert found.shape == (2, 8) and not found[:, 2:].any() and found[:, :2].any()
        torch.testing.assert_close(without_copies(network, 2)(images), found[:, :2])
    assert network.head.out_features == 2


@pytest.mark.usefixtures("narrow")
def test_labels_of_copies_do_not_move_the_cameras_own(small: xr.Dataset, tmp_path: Path) -> None:
    """Where copies share the last layer, gazes between theirs and the camera's own come out."""
    copies, test = copies_set(2, 120, 0.3), small.tp.test
    model = ResNet18(epochs=8, **QUICK).fit(small.tp.train, copies=copies)
    found = model.predict(test, anyway=True)
    error = found["gaze_x"] - np.asarray(test["gaze_x"].values)
    assert abs(float(error.mean())) < 0.05
    assert model.training_ is not None and model.training_["copies"] == {"copies": 2, "frames": 240}
    assert model.network_.head.out_features == 2
    save_model(model, tmp_path / "m")
    np.testing.assert_allclose(load_model(tmp_path / "m").predict(test, anyway=True).value, found.value, atol=1e-5)


def test_other_copies_do_not_go_on_with_a_training(small: xr.Dataset, tmp_path: Path) -> None:
    def stop(_: object) -> None:
        raise KeyboardInterrupt

    model, train = ResNet18(epochs=2, **QUICK), small.tp.train.isel(frame=slice(0, 60))
    with pytest.raises(KeyboardInterrupt):
        model.fit(train, copies=copies_set(2, 10, 0.1), checkpoint=tmp_path / "c", on_epoch=stop)
    for other in (copies_set(2, 10, 0.2), None):
        with pytest.raises(InputError, match="other data"):
            model.fit(train, copies=other, checkpoint=tmp_path / "c", resume=True)
    model.fit(train, copies=copies_set(2, 10, 0.1), checkpoint=tmp_path / "c", resume=True)


def test_frames_that_are_no_copies_are_refused(small: xr.Dataset) -> None:
    model, copies = ResNet18(epochs=1, **QUICK), copies_set(2, 10, 0.1)
    for wrong, match in (
        (copies.drop_vars(UNIT), "copy of the camera is known"),
        (copies.isel(frame=slice(0, 0)), "copy of the camera is known"),
        (copies.drop_vars("gaze_x"), "gaze_x"),
        (copies.assign(gaze_x=copies["gaze_x"].where(copies["gaze_x"] > 0)), "not numbers"),
        ("copies.zarr", "copies"),
    ):
        with pytest.raises(InputError, match=match):
            model.fit(small, copies=wrong)  # type: ignore[arg-type]
    devices = small.assign(device=class_variable(["a", "b"] * 130))
    with pytest.raises(InputError, match="recognises devices"):
        ResNet18("phone", epochs=1, **QUICK).fit(devices, copies=copies)
