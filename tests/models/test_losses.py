"""Labels weigh by their standard deviation."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import xarray as xr

from tapetum.data import dataset_from_arrays
from tapetum.models import ZernikeRidge
from tapetum.models.base import training_part
from tapetum.models.losses import MixedLoss


def some(wide: np.ndarray | None) -> xr.Dataset:
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (40, 24, 24), dtype=np.uint8)
    dataset = dataset_from_arrays(images, {"gaze_x": np.linspace(-0.4, 0.4, 40), "gaze_y": rng.uniform(-0.4, 0.4, 40)})
    return dataset if wide is None else dataset.assign({f"gaze_{a}_std": ("frame", wide) for a in "xy"})


def test_weights_fall_with_the_deviation_and_are_one_in_the_mean() -> None:
    wide = np.full(40, 1e-4, np.float32)
    wide[:10] = 0.02
    weights = training_part(some(wide), ("gaze_x", "gaze_y"), 0.0).weights
    assert weights is not None
    assert np.allclose(weights.mean(axis=0), 1)
    assert (weights[:10] < 0.1 * weights[10:].max()).all() and np.ptp(weights[10:], axis=0).max() < 1e-6
    assert training_part(some(None), ("gaze_x", "gaze_y"), 0.0).weights is None


def test_a_weighted_loss_is_that_of_the_sure_labels() -> None:
    output, target = torch.tensor([[0.3, 0.1], [0.0, 0.9]]), torch.tensor([[0.0, 0.1], [0.4, 0.1]])
    ones = torch.ones(2, 2)
    plain = MixedLoss(2)(output, target)
    assert MixedLoss(2, True)(output, torch.cat([target, ones], 1)) == pytest.approx(float(plain))
    sure = torch.tensor([[2.0, 2.0], [0.0, 0.0]])
    alone = MixedLoss(2)(output[:1], target[:1])
    assert MixedLoss(2, True)(output, torch.cat([target, sure], 1)) == pytest.approx(float(alone))


@pytest.mark.parametrize("weighted", [False, True])
def test_a_class_is_the_last_column(weighted: bool) -> None:
    output, quantities = torch.tensor([[0.3, 0.1, 0.2, 1.5, -0.4]]), torch.tensor([[0.0, 0.1]])
    columns = [quantities, torch.full((1, 2), 0.7), torch.tensor([[1.0]])]
    wanted = torch.cat(columns if weighted else [columns[0], columns[2]], 1)
    alone = MixedLoss(2, weighted)(output[:, :2], wanted[:, :-1])
    score = torch.nn.functional.cross_entropy(output[:, 2:], torch.tensor([1]))
    assert float(MixedLoss(2, weighted)(output, wanted)) == pytest.approx(float(alone + score))


def test_the_ridge_follows_sure_labels() -> None:
    """Wrong labels of wide deviation pull the fit aside only where they are not known to be wide."""
    rng = np.random.default_rng(1)
    level = rng.uniform(20, 200, 60)
    images = np.repeat(level, 24 * 24).reshape(60, 24, 24).astype(np.uint8)
    true = (level - 110) / 250
    labels, wide = true.copy(), np.full(60, 1e-4, np.float32)
    labels[:20], wide[:20] = -0.3, 0.3
    errors = []
    for known in (False, True):
        dataset = dataset_from_arrays(images, {"gaze_x": labels, "gaze_y": true})
        if known:
            dataset = dataset.assign({f"gaze_{a}_std": ("frame", wide) for a in "xy"})
        model = ZernikeRidge(scales=(24,), order=2, powers=(1,)).fit(dataset)
        errors.append(np.abs(model.predict(images)["gaze_x"] - true).mean())
    alone = ZernikeRidge(scales=(24,), order=2, powers=(1,)).fit(
        dataset_from_arrays(images[20:], {"gaze_x": labels[20:], "gaze_y": true[20:]})
    )
    assert errors[1] < 0.3 * errors[0]
    assert errors[1] == pytest.approx(np.abs(alone.predict(images)["gaze_x"] - true).mean(), rel=0.15)
