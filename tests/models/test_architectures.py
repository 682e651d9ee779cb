"""Every architecture in the registry trains, comes back from its folder, and says the same as its exported file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import NetworkEstimator, ResNet18, load_model, save_model
from tapetum.models.architectures import ARCHITECTURES


@pytest.fixture(scope="module")
def frames() -> tuple[np.ndarray, np.ndarray]:
    """Spots whose place is their gaze: [60, 48, 48] and [60, 2]."""
    rng = np.random.default_rng(4)
    gaze = rng.uniform(-0.4, 0.4, (60, 2))
    y, x = np.mgrid[:48, :48]
    spots = [200 * np.exp(-((x - 24 - 30 * a) ** 2 + (y - 24 - 30 * b) ** 2) / 20) for a, b in gaze]
    return (np.stack(spots) + rng.uniform(5, 8, (60, 48, 48))).astype(np.uint8), gaze


@pytest.mark.parametrize("name", sorted(ARCHITECTURES))
def test_a_network_is_trained_kept_and_exported(name: str, frames, tmp_path: Path) -> None:
    images, gaze = frames
    dataset = dataset_from_arrays(images, {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]})
    model = NetworkEstimator(architecture=name, crop=48, size=32, epochs=1, batch=16, device="cpu").fit(dataset)
    save_model(model, tmp_path / "model")
    loaded = load_model(tmp_path / "model")
    want = model.predict(images, anyway=True)
    assert loaded.kind == name and isinstance(loaded, ResNet18) == (name == "resnet18")
    assert np.array_equal(loaded.predict(images, anyway=True).value, want.value)
    pytest.importorskip("onnxruntime")
    from tapetum.models.fast import FastResNet18

    fast = FastResNet18(model, threads=1).predict(images, anyway=True)
    assert np.abs(fast.value - want.value).max() < 1e-4 * np.abs(want.value).max()


@pytest.mark.parametrize("name", sorted(ARCHITECTURES))
def test_equal_seeds_draw_equal_weights_and_leave_torchs_numbers_alone(name: str) -> None:
    torch.manual_seed(1)
    want = torch.rand(3)
    torch.manual_seed(1)
    first, again, other = (ARCHITECTURES[name](2, seed=seed).eval() for seed in (5, 5, 6))
    assert torch.equal(torch.rand(3), want)
    x = torch.rand(2, 1, 64, 64, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        assert first.features(x).shape == (2, first.width)
        assert torch.equal(first(x), again(x)) and not torch.equal(first(x), other(x))


def test_convnext_has_timms_weights() -> None:
    """As timm 1.0 counts and names them in convnext_pico."""
    network = ARCHITECTURES["convnext-pico"](1000, channels=3)
    assert sum(one.numel() for one in network.parameters()) == 9_045_672
    names = set(network.state_dict())
    assert {"stem.1.weight", "stages.2.blocks.5.mlp.fc1.weight", "stages.3.blocks.1.gamma", "head.fc.bias"} <= names
    assert "stages.0.downsample.0.weight" not in names and "stages.1.downsample.0.weight" in names


def test_an_unknown_architecture_is_told() -> None:
    with pytest.raises(InputError, match="architecture"):
        NetworkEstimator(architecture="vgg")
