"""What copies of a camera differ by, learned from many of them, carries a network over to a further one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from tests.models.conftest import pictures
from tests.models.test_own_layers import QUICK, copies_set

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import NetworkEstimator, ResNet18, adapt, load_model, save_model
from tapetum.models.copy_prior import FEWEST_COPIES, CopyPrior, fit_copy_prior
from tapetum.models.last_layer import FROM_COPIES, PENALTIES, Correction, LastLayer, corrected

pytestmark = pytest.mark.usefixtures("narrow")

WIDTH, NOISE = 24, 0.01
MIXED = np.random.default_rng(1).normal(size=(WIDTH, WIDTH)) / np.sqrt(WIDTH)
ALONG = np.random.default_rng(2).normal(size=(2, WIDTH + 1, 3)) * 0.3
MEAN = np.random.default_rng(3).normal(size=(2, WIDTH + 1)) * 0.1
NOTHING = LastLayer(np.zeros((2, WIDTH)), np.zeros(2))


def shown(frames: int, rng: np.random.Generator) -> np.ndarray:
    return np.maximum(rng.normal(size=(frames, WIDTH)) @ MIXED + 0.3, 0)


def copy(frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Features and targets of a copy that differs along three directions, and what it adds."""
    features = shown(frames, rng)
    added = MEAN + ALONG @ rng.normal(size=3)
    targets = features @ added[:, :-1].T + added[:, -1]
    return features, targets + NOISE * rng.normal(size=targets.shape), added


@pytest.fixture(scope="module")
def prior() -> CopyPrior:
    rng = np.random.default_rng(0)
    features, targets, _ = (np.stack(one) for one in zip(*(copy(30, rng) for _ in range(150)), strict=True))
    found = fit_copy_prior(features.reshape(-1, WIDTH), targets.reshape(-1, 2), np.repeat(np.arange(150), 30))
    assert found is not None
    return found


def test_mean_and_spread_of_copies_are_found(prior: CopyPrior) -> None:
    looks = np.concatenate([shown(500, np.random.default_rng(9)), np.ones((500, 1))], axis=1)
    for k in range(2):
        # Of what a copy adds to the estimates of frames: the mean, and the covariance of pairs of frames.
        spread = ALONG[k] @ ALONG[k].T
        size = np.sqrt(np.mean(np.diag(looks @ spread @ looks.T)))
        # 150 copies give the mean to 1/√150 of their spread, here along three directions.
        assert np.sqrt(np.mean(((prior.mean[k] - MEAN[k]) @ looks.T) ** 2)) < 0.2 * size
        wanted, found = (looks @ one @ looks.T for one in (spread, prior.factors[k] @ prior.factors[k].T))
        assert np.abs(found - wanted).mean() < 0.25 * np.abs(wanted).mean()


def test_few_frames_of_a_further_copy_are_enough(prior: CopyPrior) -> None:
    rng, errors = np.random.default_rng(5), {"copies": [], "ridge": []}
    for _ in range(20):
        features, targets, added = copy(12, rng)
        far = 2 * shown(200, rng)
        truth = far @ added[:, :-1].T + added[:, -1]

        def best(hows: tuple[Correction, ...]) -> float:
            layers = [corrected(NOTHING, features, targets, None, how, prior) for how in hows]  # noqa: B023
            return min(float(np.abs(layer(far) - truth).mean()) for layer in layers)  # noqa: B023

        errors["copies"].append(best(FROM_COPIES))
        errors["ridge"].append(best(PENALTIES))
    assert np.mean(errors["copies"]) < 0.15 * np.mean(errors["ridge"])


def test_many_frames_say_more_than_copies(prior: CopyPrior) -> None:
    """A camera that is like none of the copies."""
    rng = np.random.default_rng(6)
    features, own = shown(400, rng), rng.normal(size=(2, WIDTH + 1))
    targets = features @ own[:, :-1].T + own[:, -1]
    found = corrected(NOTHING, features, targets, None, Correction(1.0, 1e-6), prior)
    np.testing.assert_allclose(found.weight, own[:, :-1], atol=0.02)
    np.testing.assert_allclose(found.bias, own[:, -1], atol=0.02)


def test_unsure_labels_pull_less(prior: CopyPrior) -> None:
    rng = np.random.default_rng(7)
    features, targets, _ = copy(20, rng)
    wrong = targets.copy()
    wrong[:5] += 1.0
    sure = np.where(np.arange(20) < 5, 1e-4, 1.0)
    how = Correction(0.0, 1e-3)
    wanted, trusted, told = (
        corrected(NOTHING, features, one, weights, how, prior).weight
        for one, weights in ((targets, None), (wrong, None), (wrong, sure))
    )
    assert np.abs(told - wanted).max() < 0.1 * np.abs(trusted - wanted).max()


def test_a_layer_is_corrected_in_the_units_of_the_targets(prior: CopyPrior) -> None:
    features, targets, _ = copy(15, np.random.default_rng(8))
    by = np.array([3.0, 0.2])
    how = Correction(0.0, 1e-9)
    one = corrected(NOTHING, features, targets, None, how, prior)
    other = corrected(NOTHING, features, targets * by, None, how, prior.scaled(by))
    np.testing.assert_allclose(other.weight, one.weight * by[:, None], atol=1e-3 * np.abs(one.weight).max())


def test_a_handful_of_copies_says_nothing() -> None:
    rng, few = np.random.default_rng(0), FEWEST_COPIES - 1
    features = shown(10 * few, rng)
    assert fit_copy_prior(features, features[:, :2], np.repeat(np.arange(few), 10)) is None


def test_a_model_keeps_what_copies_differ_by(small: xr.Dataset, tmp_path: Path) -> None:
    copies = copies_set(FEWEST_COPIES, 6, 0.3)
    model = ResNet18(epochs=1, **QUICK).fit(small.tp.train, copies=copies)
    assert model.prior_ is not None and model.prior_.factors.shape[:2] == (2, model.network_.width + 1)
    save_model(model, tmp_path / "m")
    again = load_model(tmp_path / "m")
    assert isinstance(again, ResNet18) and again.prior_ is not None
    np.testing.assert_allclose(again.prior_.factors, model.prior_.factors, rtol=1e-6)
    # A model of an older version learns it without being trained.
    again.prior_, before = None, again.state()
    again.learn_copies(copies)
    np.testing.assert_allclose(again.prior_.mean, model.prior_.mean, atol=1e-3)  # type: ignore[union-attr]
    assert all(torch.equal(again.state()[name], one) for name, one in before.items())
    # Without copies nothing is kept of those of before.
    assert again.fit(small.tp.train.isel(frame=slice(0, 60))).prior_ is None


def moved_copies() -> xr.Dataset:
    """Copies whose fields are stretched and displaced, each in its own way."""
    data, rng = copies_set(30, 16, 0.0), np.random.default_rng(4)
    for name in ("gaze_x", "gaze_y"):
        stretch, by = (rng.normal(scale=0.3, size=30)[np.asarray(data["unit"].values)] for _ in range(2))
        data[name] = (1 + stretch) * data[name] + by / 3
    return data


def test_a_network_is_adapted_from_what_copies_differ_by(small: xr.Dataset) -> None:
    base = NetworkEstimator(epochs=4, **QUICK).fit(small.tp.train, copies=moved_copies())
    images, gaze = pictures(214, seed=11)
    labels = {"gaze_x": 0.6 * gaze[:, 0] + 0.15, "gaze_y": 1.5 * gaze[:, 1] - 0.1}
    data = dataset_from_arrays(images, labels, split=(np.arange(214) >= 14).astype(int))
    truth = data.tp.test.tp.values(("gaze_x", "gaze_y"))

    def adapted() -> tuple[float, str]:
        mine = adapt(base, data, epochs=1)
        chosen = (mine.training_ or {})["chosen"]["penalty"]
        return float(np.abs(mine.predict(data.tp.test, anyway=True).value - truth).mean()), chosen

    error, chosen = adapted()
    base.prior_ = None
    without, how = adapted()
    assert chosen.startswith("from what copies differ by") and not how.startswith("from")
    assert error < 0.97 * without


def test_weights_that_do_not_fit_are_refused(prior: CopyPrior) -> None:
    state = prior.state()
    assert CopyPrior.from_state({}, 2, WIDTH) is None
    with pytest.raises(InputError, match=r"copies\.mean of shape"):
        CopyPrior.from_state(state, 2, WIDTH + 1)
    with pytest.raises(InputError, match=r"copies\.mean .* missing"):
        CopyPrior.from_state({"copies.factors": state["copies.factors"]}, 2, WIDTH)
