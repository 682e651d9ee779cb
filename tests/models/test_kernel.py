"""Interpolated residuals: beside scikit-learn's Gaussian process, near and far from labelled frames, read back."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF

from tapetum.errors import InputError
from tapetum.models import kernel as module
from tapetum.models.kernel import ResidualKernel, fit_kernel, interpolated, left_out, small_area, small_pictures

Array = NDArray[np.float64]


def frames(count: int, seed: int = 0) -> tuple[Array, torch.Tensor, Array]:
    """Features [N, 5], images [N, 1, 24, 24] and residuals [N, 2] that change with two hidden numbers."""
    rng = np.random.default_rng(seed)
    hidden = rng.uniform(-1, 1, (count, 2))
    features = np.tanh(hidden @ np.random.default_rng(1).normal(size=(2, 5)))
    lines = torch.linspace(-1, 1, 24, dtype=torch.float64)
    at = torch.from_numpy(hidden)
    looks = torch.exp(-((lines[None, :, None] - at[:, 1, None, None]) ** 2) - (lines - at[:, 0, None, None]) ** 2)
    left = np.stack([np.sin(3 * hidden[:, 0]), hidden[:, 0] * hidden[:, 1]], axis=1)
    return features, looks[:, None].float(), left


def fitted(count: int = 200, weights: Array | None = None, unit: float = 1.0) -> ResidualKernel:
    found = fit_kernel(*frames(count), weights, unit)
    assert found is not None
    return found


def test_it_is_a_gaussian_process_as_scikit_learn_has_it() -> None:
    weights = np.random.default_rng(2).uniform(0.3, 3, 150)
    features, looks, left = frames(150)
    kernel = fit_kernel(features, looks, left, weights)
    assert kernel is not None
    # Its covariance and noise are those of the kernel: nothing is left to fit.
    peer: Any = GaussianProcessRegressor(RBF(1.0, "fixed"), alpha=3e-3 / weights).fit(kernel.references, left)
    new, seen, _ = frames(40, seed=3)
    described = np.concatenate(
        [new / kernel.units[0], small_pictures(seen.double(), small_area(24)).numpy() / kernel.units[1]], axis=1
    )
    mean, deviation = peer.predict(described, return_std=True)
    added, own = kernel(new, seen)
    np.testing.assert_allclose(added, mean, atol=1e-8)
    np.testing.assert_allclose(own, deviation[:, 0], rtol=1e-5)


def test_residuals_of_frames_that_look_alike_are_carried_over_and_nothing_far_away() -> None:
    kernel, (features, looks, left) = fitted(unit=0.05), frames(300, seed=4)
    added, deviation = kernel(features, looks)
    assert np.abs(left - added).mean() < 0.05 * np.abs(left).mean()
    away, far = kernel(features + 100, looks)
    assert np.abs(away).max() < 1e-12
    np.testing.assert_allclose(far, 1 / 0.05)
    assert deviation.max() < 0.5 * far.min()


def test_the_deviation_says_where_it_errs() -> None:
    """Of frames at one side of the field only, those of the other side."""
    features, looks, left = frames(400)
    near = features[:, 0] < np.median(features[:, 0])
    kernel = fit_kernel(features[near], looks[torch.from_numpy(near)], left[near])
    assert kernel is not None
    new, seen, truth = frames(300, seed=5)
    added, deviation = kernel(new, seen)
    wrong, sure = np.abs(truth - added).mean(axis=1), deviation < np.median(deviation)
    assert wrong[~sure].mean() > 10 * wrong[sure].mean()


def test_both_descriptions_count() -> None:
    """Neither features alone nor pictures alone say that frames are alike."""
    kernel, (features, looks, _) = fitted(), frames(20, seed=6)
    same = kernel(features, looks)[1]
    assert (kernel(features[::-1].copy(), looks)[1] > same).mean() > 0.8
    assert (kernel(features, looks.flip(0))[1] > same).mean() > 0.8


def test_it_is_read_back_also_from_half_precision() -> None:
    kernel, (features, looks, _) = fitted(unit=0.3), frames(50, seed=7)
    state = kernel.state()
    half = state | {"kernel.references": state["kernel.references"].half()}
    for one in (state, half):
        again = ResidualKernel.from_state(one, 2, 5)
        assert again is not None
        for mine, its in zip(kernel(features, looks), again(features, looks), strict=True):
            np.testing.assert_array_equal(mine, its)
    assert ResidualKernel.from_state({}, 2, 5) is None


@pytest.mark.parametrize("name", ["units", "references", "coefficients", "noise", "unit"])
def test_a_damaged_state_is_refused(name: str) -> None:
    state = fitted().state()
    whole = f"kernel.{name}"
    bad = [state[whole] * torch.nan, state[whole][..., :-1]]
    if name in ("units", "noise", "unit"):
        bad.append(state[whole] * 0)
    for one in bad:
        with pytest.raises(InputError, match="kernel"):
            ResidualKernel.from_state(state | {whole: one}, 2, 5)


def test_what_is_kept_takes_all_frames_and_counts_its_deviation_in_that_of_those_left_out() -> None:
    features, looks, rest = frames(90)
    fit, at, weights = np.arange(60), np.arange(60, 90), np.linspace(0.5, 2, 90)
    left = left_out(features, looks, rest, fit, at, weights)
    own = fit_kernel(features[:60], looks[:60], rest[:60], weights[:60])
    assert own is not None
    added, deviation = own(features[60:], looks[60:])
    np.testing.assert_allclose(left.plain, rest[60:])
    np.testing.assert_allclose(left.carried, rest[60:] - added)
    np.testing.assert_allclose(left.deviation, deviation)
    kernel, why = interpolated(left, left, features, looks, rest, weights)
    assert kernel is not None and why.startswith("interpolated")
    assert len(kernel.references) == 90 and kernel.unit == np.median(deviation)
    np.testing.assert_allclose(kernel.noise * weights, kernel.noise[0] * weights[0])
    np.testing.assert_allclose(left.under(kernel)[1], deviation / np.median(deviation))
    # Residuals that are noise are worth nothing.
    noise = np.random.default_rng(8).normal(size=rest.shape)
    left = left_out(features, looks, noise, fit, at)
    kernel, why = interpolated(left, left, features, looks, noise)
    assert kernel is None and why.startswith("not interpolated")
    np.testing.assert_array_equal(left.under(None)[0], noise[60:])


def test_few_frames_and_equal_ones_have_none() -> None:
    features, looks, left = frames(25)
    assert fit_kernel(features[:19], looks[:19], left[:19]) is None
    assert fit_kernel(np.zeros_like(features), looks, left) is None
    assert fit_kernel(features, torch.zeros_like(looks), left) is None


def test_of_many_frames_some_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_MOST", 30)
    kernel = fitted(100)
    assert kernel.references.shape == (30, 5 + 144) and kernel.coefficients.shape == (30, 2)
