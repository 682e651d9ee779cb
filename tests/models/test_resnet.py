"""ResNet-18: the network against a peer, the estimator against what it promises."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import ResNet18, ResNet18Network, crop_snr, kernel, load_model, network, save_model
from tapetum.models.base import training_part
from tapetum.models.inputs import prepare
from tapetum.models.network import NetworkEstimator
from tapetum.models.training import CHECKPOINT, HISTORY, Augmentation, augment
from tapetum.progress import quiet

TINY = {"crop": 36, "size": 24, "epochs": 2, "batch": 20, "device": "cpu"}


def test_the_network_is_monais_with_torchvisions_names():
    from monai.networks.nets.resnet import resnet18

    ours = ResNet18Network(3, seed=1).eval()
    theirs = resnet18(
        spatial_dims=2,
        n_input_channels=1,
        num_classes=3,
        conv1_t_size=7,
        conv1_t_stride=2,
        bias_downsample=False,
    ).eval()
    # Statistics and scales that are not 0 and 1, so that a misplaced normalisation shows.
    generator = torch.Generator().manual_seed(0)
    for name, tensor in ours.state_dict().items():
        if ("bn" in name or "downsample.1" in name) and tensor.dtype.is_floating_point:
            tensor.copy_(0.5 + torch.rand(tensor.shape, generator=generator))
    assert set(ours.state_dict()) == set(theirs.state_dict())
    theirs.load_state_dict(ours.state_dict())
    images = torch.randn(2, 1, 96, 96, generator=generator)
    with torch.inference_mode():
        features = []
        for network in (ours, theirs):
            found = []
            handles = [
                getattr(network, f"layer{k}").register_forward_hook(lambda *a, found=found: found.append(a[2]))
                for k in (1, 2, 3, 4)
            ]
            found.append(network(images))
            for handle in handles:
                handle.remove()
            features.append(found)
    assert len(features[0]) == 5
    for mine, peer in zip(*features, strict=True):
        torch.testing.assert_close(mine, peer, rtol=1e-4, atol=1e-4)


def test_torchvisions_shapes():
    state = ResNet18Network(2).state_dict()
    assert state["conv1.weight"].shape == (64, 1, 7, 7)
    assert state["layer1.0.conv1.weight"].shape == (64, 64, 3, 3)
    assert state["layer2.0.downsample.0.weight"].shape == (128, 64, 1, 1)
    assert state["fc.weight"].shape == (2, 512)
    assert sum(p.numel() for p in ResNet18Network(1000, channels=3).parameters()) == 11_689_512


def test_the_seed_decides_and_nobody_elses_numbers_move():
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    first, again, other = ResNet18Network(2, seed=5), ResNet18Network(2, seed=5), ResNet18Network(2, seed=6)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(first.conv1.weight, again.conv1.weight)
    assert torch.equal(first.fc.weight, again.fc.weight)
    assert not torch.equal(first.conv1.weight, other.conv1.weight)


def test_preparing_keeps_brightness_and_drops_the_background():
    rng = np.random.default_rng(0)
    spot = np.zeros((40, 40))
    spot[15:25, 15:25] = 100
    images = np.stack([spot, spot + 50, 2 * spot]) + rng.uniform(0, 1, (3, 40, 40))
    out = prepare(images, 36, 12, 255)
    assert out.shape == (3, 1, 12, 12)
    background = out[:, 0, 0]
    assert float(background.abs().max()) < 0.03
    # The middle is 100 and 200 above nothing: roots in the ratio of sqrt 2.
    assert float(out[2, 0, 6, 6] / out[0, 0, 6, 6]) == pytest.approx(2**0.5, rel=0.1)


def test_a_background_taken_off_first_leaves_no_trace():
    at = np.arange(40) - 19.5
    spot = 100 * np.exp(-(at[:, None] ** 2 + at**2) / 80)
    dim, bright = (prepare((spot + level)[None], 36, 12, 255, background="level") for level in (20, 90))
    torch.testing.assert_close(dim, bright, atol=1e-5, rtol=1e-5)
    # Its root taken off afterwards pales the faint parts.
    dim, bright = (prepare((spot + level)[None], 36, 12, 255, background="root") for level in (20, 90))
    assert float((dim - bright).abs().max()) > 0.1
    # Dark pixels scatter about 0: neither cut off nor blown up.
    noise = np.random.default_rng(0).normal(50, 3, (1, 40, 40))
    dark = prepare(noise, 36, 36, 255, background="level")
    assert abs(float(dark.mean())) < 0.01 and 0.02 < float(dark.std()) < 0.1


def test_preparing_does_not_depend_on_depth_or_place():
    images = np.random.default_rng(0).integers(0, 256, (2, 40, 40), dtype=np.uint8)
    deep = prepare(images.astype(np.uint16) * 257, 36, 12, 65535)
    torch.testing.assert_close(deep, prepare(images, 36, 12, 255))
    torch.testing.assert_close(prepare(images[:, 2:38, 2:38], 36, 12, 255), prepare(images, 36, 12, 255))


def test_augmentation_shifts_scales_and_adds_noise():
    image = torch.zeros(64, 1, 21, 21)
    image[:, :, 10, 10] = 1
    generator = torch.Generator().manual_seed(0)
    moved = augment(image, Augmentation(gain=0, shift=1.5, noise=0), generator)[:, 0]
    at = torch.arange(21.0) - 10
    x, y = (moved.sum(1) * at).sum(1), (moved.sum(2) * at).sum(1)
    torch.testing.assert_close(moved.sum((1, 2)), torch.ones(64), rtol=1e-4, atol=1e-4)
    for axis in (x, y):
        assert 1.0 < float(axis.abs().max()) <= 1.5 + 1e-4
        assert axis.min() < 0 < axis.max()
    gains = augment(image, Augmentation(gain=0.2, shift=0, noise=0), generator).amax((1, 2, 3)).log()
    assert 0.15 < float(gains.abs().max()) <= 0.2
    noisy = augment(torch.zeros(64, 1, 21, 21), Augmentation(gain=0, shift=0, noise=0.3), generator)
    assert float(noisy.std()) == pytest.approx(0.3, rel=0.02)
    assert torch.equal(augment(image, Augmentation(0, 0, 0), generator), image)


@pytest.fixture(scope="module")
def few(small):
    """66 images to train with, and the test images."""
    return small.isel(frame=slice(100, None, 2)).isel(frame=slice(0, 66))


@pytest.fixture(scope="module")
def whole(few, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return ResNet18(**TINY).fit(few, checkpoint=folder), folder


# From here on: a narrow network learns, stops and goes on as the whole one does.
@pytest.mark.usefixtures("narrow")
def test_it_learns(small):
    model = ResNet18(**{**TINY, "epochs": 8, "batch": 10, "shift": 0.5}).fit(small.tp.train)
    test = small.tp.test
    truth = test.tp.values(("gaze_x", "gaze_y"))
    prediction = model.predict(test)
    assert np.abs(prediction.value - truth).mean() < 0.6 * np.abs(truth - truth.mean(0)).mean()
    assert np.isfinite(prediction.lower).all()
    widths = np.tile(2 * model.intervals_.half_width[0], (60, 1))
    np.testing.assert_allclose(prediction.upper - prediction.lower, widths)
    assert model.history_[-1].loss < model.history_[0].loss


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_it_trains_alike_in_any_mode_of_the_caller(few, whole, mode):
    with mode():
        model = ResNet18(**TINY).fit(few)
    assert model.history_[-1].loss == whole[0].history_[-1].loss


@pytest.mark.parametrize("architecture", ["resnet18", "convnext-pico"])
def test_the_callers_default_precision_changes_nothing(few, tmp_path: Path, architecture: str):
    made = {"architecture": architecture, **TINY, "size": 32, "epochs": 1}
    plain = NetworkEstimator(**made).fit(few)
    torch.set_default_dtype(torch.float64)
    try:
        model = NetworkEstimator(**made).fit(few)
        loaded = load_model(save_model(model, tmp_path / "model"))
        found = loaded.predict(few).value
    finally:
        torch.set_default_dtype(torch.float32)
    assert {one.dtype for one in loaded.network_.parameters()} == {torch.float32}
    np.testing.assert_array_equal(found, plain.predict(few).value)


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("patience", [None, 4])
def test_residuals_are_interpolated_where_that_is_asked_for_and_pays(
    small, tmp_path: Path, patience: int | None, monkeypatch: pytest.MonkeyPatch
):
    asked = {**TINY, "epochs": 4, "calibration_fraction": 0.2, "patience": patience}
    plain = ResNet18(**asked).fit(small.tp.train)
    given, left, fit, judge = [], [], network.fit_intervals, network.interpolated
    with monkeypatch.context() as seen:
        seen.setattr(network, "fit_intervals", lambda errors, *rest: given.append(errors) or fit(errors, *rest))
        seen.setattr(network, "interpolated", lambda *all: left.append(all[:2]) or judge(*all))
        model = ResNet18(**asked, interpolate=True).fit(small.tp.train, checkpoint=tmp_path / "run")
    ((judged, calibrating),) = left
    wanted = calibrating.carried / (calibrating.deviation / np.median(calibrating.deviation))[:, None]
    np.testing.assert_allclose(given[0], wanted * model.scaling[1])
    # With patience those that chose the epoch decide.
    assert (judged is calibrating) == (patience is None)
    assert model.kernel_ is not None and plain.kernel_ is None
    why = (model.training_ or {})["chosen"]["residuals"]
    assert why.startswith("interpolated") and "residuals" not in (plain.training_ or {})["chosen"]
    truth = small.tp.test.tp.values(("gaze_x", "gaze_y"))
    found, before = (one.predict(small.tp.test, anyway=True) for one in (model, plain))
    assert np.abs(found.value - truth).mean() < 0.9 * np.abs(before.value - truth).mean()
    held = ((found.lower <= truth) & (truth <= found.upper)).mean()
    assert 0.75 <= held <= 0.99
    save_model(model, tmp_path / "m")
    again = load_model(tmp_path / "m")
    np.testing.assert_allclose(again.predict(small.tp.test, anyway=True).upper, found.upper, rtol=1e-6)
    assert again.parameters() == model.parameters() and again.parameters()["interpolate"] is True
    # What does not pay is not kept. That is decided after the training, which is not done again.
    monkeypatch.setattr(kernel, "_WORTH", 0.0)
    left = ResNet18(**asked, interpolate=True).fit(small.tp.train, checkpoint=tmp_path / "run", resume=True)
    assert left.kernel_ is None and (left.training_ or {})["chosen"]["residuals"].startswith("not interpolated")
    np.testing.assert_allclose(left.predict(small.tp.test, anyway=True).upper, before.upper, rtol=1e-6)


def test_what_cannot_be_interpolated_is_told():
    with pytest.raises(InputError, match="interpolate: needs frames held out"):
        ResNet18("gaze", calibration_fraction=0.0, interpolate=True)
    with pytest.raises(InputError, match="interpolate: has no meaning for a device"):
        ResNet18("device", interpolate=True)


def test_a_broken_run_ends_as_an_unbroken_one(few, whole, tmp_path: Path):
    unbroken, _ = whole
    folder = tmp_path / "run"

    def stop(items, what, *, total=None):
        for n, item in enumerate(items):
            if what.startswith("epoch 2") and n == 1:
                raise KeyboardInterrupt
            yield item

    with pytest.raises(KeyboardInterrupt):
        ResNet18(**TINY).fit(few, checkpoint=folder, progress=stop)
    assert sorted(p.name for p in folder.iterdir()) == [CHECKPOINT, HISTORY]
    assert [e["epoch"] for e in json.loads((folder / HISTORY).read_text())["epochs"]] == [1]
    seen = []
    resumed = ResNet18(**TINY).fit(few, checkpoint=folder, resume=True, on_epoch=seen.append)
    assert [report.epoch for report in seen] == [2]
    assert [report.epoch for report in resumed.history_] == [1, 2]
    test = few.tp.test
    np.testing.assert_allclose(resumed.predict(test).value, unbroken.predict(test).value, atol=1e-4)


def test_a_finished_run_resumes_to_itself(few, whole):
    model, folder = whole
    again = ResNet18(**TINY).fit(few, checkpoint=folder, resume=True, on_epoch=lambda report: pytest.fail("trained"))
    np.testing.assert_allclose(again.predict(few.tp.test).value, model.predict(few.tp.test).value, atol=1e-6)


@pytest.mark.parametrize("change", [{"seed": 1}, {"learning_rate": 1e-4}, {"crop": 30}])
def test_a_checkpoint_of_another_training_is_refused(few, whole, change):
    with pytest.raises(InputError, match="other settings or other data"):
        ResNet18(**{**TINY, **change}).fit(few, checkpoint=whole[1], resume=True)


def test_a_checkpoint_of_other_data_is_refused(few, whole):
    other = dataset_from_arrays(few["image"].values[:50], {n: few[n].values[:50] for n in ("gaze_x", "gaze_y")})
    with pytest.raises(InputError, match="other data"):
        ResNet18(**TINY).fit(other, checkpoint=whole[1], resume=True)


def test_a_damaged_checkpoint_is_told(few, whole, tmp_path: Path):
    data = (whole[1] / CHECKPOINT).read_bytes()
    (tmp_path / CHECKPOINT).write_bytes(data[: len(data) // 2])
    with pytest.raises(InputError, match="damaged checkpoint"):
        ResNet18(**TINY).fit(few, checkpoint=tmp_path, resume=True)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: ResNet18(size=96, crop=48), "size"),
        (lambda: ResNet18(epochs=0), "epochs"),
        (lambda: ResNet18(batch=1), "batch"),
        (lambda: ResNet18(noise=-1), "noise"),
        (lambda: ResNet18(device="moon"), "device"),
        (lambda: ResNet18(background="none"), "root, level"),
        (lambda: ResNet18Network(0), "outputs"),
    ],
)
def test_bad_parameters_are_told(call, word: str):
    with pytest.raises(InputError, match=word):
        call()


def test_unfit_data_are_told(small, whole):
    model, _ = whole
    with pytest.raises(InputError, match="looks at 36 pixels, the crops have 20"):
        model.predict(small["image"].values[:2, :20, :20])
    with pytest.raises(InputError, match="resume needs"):
        ResNet18(**TINY).fit(small, resume=True)
    still = dataset_from_arrays(small["image"].values[:50], {"a": np.ones(50)})
    with pytest.raises(InputError, match="a never changes in the one recording"):
        ResNet18("a", **TINY).fit(still)
    blank = dataset_from_arrays(np.full((50, 40, 40), 9, np.uint8), {"a": np.arange(50)})
    with pytest.raises(InputError, match="blank"):
        ResNet18("a", **TINY).fit(blank)


def test_a_card_that_does_not_name_the_background_means_the_root(whole):
    model, _ = whole
    assert model.background == "level"
    old = {name: value for name, value in model.parameters().items() if name != "background"}
    assert ResNet18.from_state(old, model.state()).background == "root"
    assert ResNet18.from_state(model.parameters(), model.state()).background == "level"


def test_the_snr_is_that_of_the_frames_that_calibrate(small: xr.Dataset) -> None:
    """Only theirs is computed; it takes longer than all else of reading."""
    model = ResNet18(epochs=1, crop=40, size=24, device="cpu")
    part = training_part(small, model.target_names, 0.1)
    images, snr = model._read_part(part, quiet)
    data = part.dataset
    assert torch.equal(images, model._prepared(data["image"].values, data.tp.full_scale))
    wanted = crop_snr(data["image"].values, data.tp.full_scale)
    np.testing.assert_array_equal(snr[part.calibrate], wanted[part.calibrate])
    assert np.isnan(np.delete(snr, part.calibrate)).all() and 0 < len(part.calibrate) < len(snr) / 5
