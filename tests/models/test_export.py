"""ResNet-18 as ONNX: the same numbers as torch's, one file that stands alone, one line for what is wrong."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError, MissingExtraError
from tapetum.models import ResNet18, ZernikeRidge, save_model
from tapetum.models.architectures import ResNet18Network
from tapetum.models.export import export_onnx, onnx_bytes, onnx_card
from tapetum.models.fast import FastResNet18
from tapetum.models.kernel import fit_kernel

pytestmark = pytest.mark.usefixtures("narrow")

DEVICES = ("a phone", "another", "a third")


@lru_cache
def made(
    target: str = "gaze",
    *,
    crop: int = 36,
    size: int = 24,
    hide: int = 0,
    background: str = "root",
    conditional: bool = True,
) -> ResNet18:
    """A model with random weights and statistics, as after a training."""
    model = ResNet18(target, crop=crop, size=size, hide=hide, background=background, device="cpu")
    k, classes = len(model.quantities), DEVICES if "device" in model.target_names else ()
    random = torch.Generator().manual_seed(3)
    network = ResNet18Network(k + len(classes), seed=1)
    state = network.state_dict()
    for name, tensor in state.items():
        if name.endswith("running_mean"):
            tensor.normal_(0, 0.3, generator=random)
        elif name.endswith("running_var") or (".bn" in name and name.endswith("weight")):
            tensor.uniform_(0.4, 1.6, generator=random)
        elif name.startswith("fc."):
            tensor.normal_(0, 0.05, generator=random)
    state |= {
        "scaling.unit": torch.tensor([0.07], dtype=torch.float64),
        "scaling.centre": torch.tensor([0.02, 3.0][:k], dtype=torch.float64),
        "scaling.spread": torch.tensor([0.3, 1.7][:k], dtype=torch.float64),
        "scaling.half_width": torch.tensor([0.1, 0.2][:k], dtype=torch.float64),
    }
    if conditional:
        state["scaling.half_width"] = torch.arange(1.0, 1 + 3 * k, dtype=torch.float64).reshape(3, k)
        state["scaling.snr_edges"] = torch.tensor([300.0, 900.0], dtype=torch.float64)
    if classes:
        state["scaling.temperature"] = torch.tensor([1.7], dtype=torch.float64)
        state["novelty.means"] = torch.randn(len(classes), ResNet18Network.width, generator=random, dtype=torch.float64)
        state["novelty.whitening"] = torch.randn(ResNet18Network.width, ResNet18Network.width, generator=random) / 10
        state["novelty.unit"] = torch.tensor([20.0], dtype=torch.float64)
    return ResNet18.from_state(model.parameters(), state, classes)


@lru_cache
def fast(model: ResNet18) -> FastResNet18:
    """The same on one thread of ONNX Runtime."""
    return FastResNet18(model, threads=1)


def crops(count: int, side: int = 40) -> np.ndarray:
    """Spots with a companion over a background, uint8 [N, side, side]; the first black, the last the brightest."""
    rng = np.random.default_rng(0)
    at = (np.arange(side) - (side - 1) / 2) * 40 / side
    images = np.empty((count, side, side))
    for n, (gain, (x, y)) in enumerate(zip(np.linspace(0, 1, count), rng.uniform(-8, 8, (count, 2)), strict=True)):
        spot = 200 * np.exp(-(at[:, None] ** 2 + at**2) / 18)
        companion = 60 * np.exp(-((at[:, None] - y) ** 2 + (at - x) ** 2) / 12)
        images[n] = gain * (spot + companion + rng.normal(20, 3, (side, side)))
    return np.clip(np.rint(images), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("count", [1, 7])
@pytest.mark.parametrize(
    "options",
    [
        {"target": "phone"},
        {"target": "phone", "crop": 38, "hide": 3, "conditional": False},  # areas that overlap
        {"target": "focus", "crop": 35, "size": 35},  # of an odd number of pixels
        {"target": "device"},
        {"target": "gaze", "background": "level"},
    ],
    ids=["phone", "overlapping areas, centre hidden", "focus, no reduction", "device", "background off first"],
)
def test_the_numbers_are_torchs(options: dict[str, Any], count: int):
    model = made(**options)
    for images, depth in (
        (crops(count), None),
        (crops(count).astype(np.uint16) * 16, 4095.0),
        (np.random.default_rng(0).gamma(0.5, 300, (count, 36 + 2, 36 + 2)), 1000.0),
    ):
        ours, wanted = (one.predict(images, full_scale=depth, anyway=True) for one in (fast(model), model))
        assert (ours.names, ours.classes) == (wanted.names, wanted.classes)
        for name in ("value", "lower", "upper"):
            np.testing.assert_allclose(getattr(ours, name), getattr(wanted, name), rtol=0, atol=1e-5)
        if model.classes():
            np.testing.assert_allclose(ours.probability, wanted.probability, rtol=0, atol=1e-5)
            np.testing.assert_allclose(ours.novelty, wanted.novelty, rtol=1e-5)
            assert ours.device == wanted.device


@pytest.mark.parametrize("sizes", [{"crop": 36, "size": 24}, {"crop": 35, "size": 35}], ids=["24", "35 pixels a side"])
def test_interpolated_residuals_are_added_and_widen_the_intervals(sizes: dict[str, int]):
    plain = made(**sizes)
    features, looks = _as_seen(plain, crops(40))
    left = np.random.default_rng(4).normal(0, 0.5, (40, 2))
    kernel = fit_kernel(features, looks, left, unit=0.2)
    assert kernel is not None
    model = ResNet18.from_state(plain.parameters(), plain.state() | kernel.state())
    # Frames that it knows and others, of which some look like none.
    images = np.concatenate([crops(40)[::5], crops(9)[:, ::-1], 255 - crops(3)])
    wanted = model.predict(images, anyway=True)
    for name in ("value", "lower", "upper"):
        ours = getattr(FastResNet18(model, threads=1).predict(images, anyway=True), name)
        np.testing.assert_allclose(ours, getattr(wanted, name), rtol=1e-4, atol=2e-4)
    before = plain.predict(images, anyway=True)
    added, deviation = kernel(*_as_seen(model, images))
    np.testing.assert_allclose(wanted.value - before.value, added * model.scaling[1], atol=1e-6)
    assert np.abs(added[:8]).max() > 0.1 and np.ptp(deviation) > 1
    widths = (wanted.upper - wanted.lower) / (before.upper - before.lower)
    np.testing.assert_allclose(widths, np.stack([deviation, deviation], axis=1))


def _as_seen(model: ResNet18, images: np.ndarray) -> tuple[np.ndarray, torch.Tensor]:
    looks = model._prepared(images, 255.0) / model.unit
    return model.run(model.network_.eval().features, looks, torch.device("cpu")), looks


def test_images_differ_in_what_they_give():
    """Else equal numbers would mean nothing."""
    given = fast(made(target="phone")).predict(crops(7), anyway=True)
    assert np.ptp(given.value, axis=0).min() > 1e-3 and np.ptp(given.novelty) > 1e-3
    assert len(np.unique(given.upper - given.value)) > 2  # several classes of SNR


def test_the_file_is_plain_onnx():
    content = onnx.load_from_string(onnx_bytes(made("phone", crop=38, size=24)))
    onnx.checker.check_model(content, full_check=True)
    assert [one.version for one in content.opset_import] == [18] and not content.opset_import[0].domain
    assert [one.name for one in content.graph.input] == ["counts", "full_scale"]
    assert [one.name for one in content.graph.output] == ["value", "probability", "novelty"]
    assert not any(node.op_type == "BatchNormalization" for node in content.graph.node)


def test_a_dataset_and_no_image_at_all():
    model, images = made(target="gaze"), crops(19)
    labels = {"gaze_x": np.linspace(-0.5, 0.5, 19), "gaze_y": np.zeros(19)}
    read = fast(model).predict(dataset_from_arrays(images, labels))
    np.testing.assert_array_equal(read.value, fast(model).predict(images).value)  # more than one batch
    for model in (made(target="gaze"), made(target="phone"), made(target="device")):
        nothing = fast(model).predict(images[:0])
        assert len(nothing) == 0 and nothing.classes == model.classes()


def test_images_that_threads_share_come_in_their_order():
    model, images = made(target="gaze"), crops(9)
    one, shared = (each.predict(images, anyway=True).value for each in (fast(model), FastResNet18(model, threads=3)))
    np.testing.assert_allclose(shared, one, rtol=0, atol=1e-5)
    assert np.abs(np.diff(one, axis=0)).max() > 1e-3


def test_widths_that_are_not_known_stay_infinite():
    model = made.__wrapped__("gaze", conditional=False)
    model.intervals_ = replace(model.intervals_, half_width=np.full((1, 2), np.inf))
    assert onnx_card(model)["half_width"] == [[None, None]]
    assert np.isinf(FastResNet18(model, threads=1).predict(crops(1), anyway=True).upper).all()


def test_what_cannot_be_exported(tmp_path: Path):
    ridge = ZernikeRidge("gaze")
    with pytest.raises(InputError, match="only networks become ONNX, this one is zernike"):
        onnx_bytes(ridge)
    with pytest.raises(InputError, match="not fitted"):
        export_onnx(ResNet18(), tmp_path / "m.onnx")
    with pytest.raises(InputError, match=r"m\.pt: unknown kind of export '\.pt'; name it NAME\.onnx"):
        export_onnx(made(target="gaze"), tmp_path / "m.pt")
    assert not list(tmp_path.iterdir())


def test_a_folder_is_as_good_as_a_file(small, tmp_path: Path):
    model = made(target="gaze")
    saved = save_model(model, tmp_path / "net")
    ours, wanted = (one.predict(crops(3), anyway=True).value for one in (FastResNet18(saved), model))
    np.testing.assert_allclose(ours, wanted, atol=1e-5)
    ridge = save_model(ZernikeRidge(scales=(20,), order=2).fit(small), tmp_path / "ridge")
    with pytest.raises(InputError, match="ridge: only networks have a fast path, this one is zernike"):
        FastResNet18(ridge)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    model = made(target="gaze")
    content = onnx_bytes(model)
    assert content
    for module, use in (("onnx", lambda: onnx_bytes(model)), ("onnxruntime", lambda: FastResNet18(model))):
        with monkeypatch.context() as without:
            without.setitem(sys.modules, module, None)
            with pytest.raises(MissingExtraError, match=rf"{module} is not .*pip install 'tapetum\[fast\]'"):
                use()


def test_files_that_are_not_ours(tmp_path: Path):
    path = export_onnx(made(target="gaze"), tmp_path / "m.onnx")
    whole = path.read_bytes()
    with pytest.raises(InputError, match="there is no such model"):
        FastResNet18(tmp_path / "none.onnx")
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"m\.onnx: cannot be read as ONNX"):
        FastResNet18(path)
    for change, words in (
        (lambda card: None, "is an ONNX file, but not one of Tapetum"),
        (lambda card: {"format": "other"}, "not one of Tapetum"),
        (lambda card: card | {"version": 9}, "has version 9 of the format, this Tapetum reads up to 1; update"),
        (lambda card: {k: v for k, v in card.items() if k != "crop"}, "its card lacks crop"),
        (lambda card: card | {"half_width": [[1, 2, 3]]}, "the intervals on its card cannot be read"),
    ):
        content = onnx.load_from_string(whole)
        card = change(json.loads(content.metadata_props[0].value))
        onnx.helper.set_model_props(content, {} if card is None else {"tapetum": json.dumps(card)})
        path.write_bytes(content.SerializeToString())
        with pytest.raises(InputError, match=words) as told:
            FastResNet18(path)
        assert "\n" not in str(told.value) and str(path) in str(told.value)


def test_images_that_do_not_fit():
    fitted = fast(made(target="gaze"))
    with pytest.raises(InputError, match="the model looks at 36 pixels, the crops have 30"):
        fitted.predict(crops(1, side=30))
    with pytest.raises(InputError, match="finite and not negative"):
        fitted.predict(np.full((1, 40, 40), -1.0), full_scale=1)
    with pytest.raises(InputError, match="depth of uint16"):
        fitted.predict(crops(1).astype(np.uint16))
    with pytest.raises(InputError, match="threads: must be at least 1"):
        FastResNet18(made(target="gaze"), threads=0)
