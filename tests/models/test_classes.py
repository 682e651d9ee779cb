"""Devices: which, how sure, or none of these."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import NONE_OF_THESE, Prediction, ResNet18, ZernikeRidge, load_model, save_model
from tapetum.models.base import training_part
from tapetum.models.calibration import fit_temperature, probabilities
from tapetum.models.novelty import fit_novelty

pytestmark = pytest.mark.usefixtures("narrow")

TINY = {"crop": 36, "size": 24, "epochs": 10, "batch": 20, "device": "cpu", "shift": 0.5}
NAMES = ("ring", "pair", "spot", "cross")


def pictures(count: int, kinds: tuple[str, ...], seed: int = 0) -> tuple[np.ndarray, list[str], np.ndarray]:
    """Return images [N, 40, 40], the device each shows, and a gaze [N] that makes it longer."""
    rng = np.random.default_rng(seed)
    at = np.arange(40) - 19.5
    x, y = at[None, :], at[:, None]
    names = [kinds[n % len(kinds)] for n in range(count)]
    gaze = rng.uniform(-0.5, 0.5, count)
    images = np.empty((count, 40, 40))
    for n, (name, g) in enumerate(zip(names, gaze, strict=True)):
        u = x / (1 + g)
        r = np.hypot(u, y)
        shape = {
            "ring": np.exp(-((r - 9) ** 2) / 4),
            "pair": np.exp(-((np.abs(u) - 6) ** 2 + y**2) / 8),
            "spot": np.exp(-(r**2) / 30),
            "cross": np.exp(-(np.minimum(np.abs(u), np.abs(y)) ** 2) / 3) * (r < 14),
        }[name]
        images[n] = 10 + 150 * shape
    images += rng.normal(0, 3, images.shape)
    return np.clip(np.rint(images), 0, 255).astype(np.uint8), names, gaze


@pytest.fixture(scope="module")
def phones() -> xr.Dataset:
    images, names, gaze = pictures(330, NAMES[:3])
    split = (np.arange(330) >= 270).astype(int)
    made = dataset_from_arrays(images, {"device": names, "gaze_x": gaze, "gaze_y": gaze[::-1]}, split=split)
    # As the bench labels its sets: their weights once stood where the loss looked for the device.
    wide = np.random.default_rng(1).uniform(1e-4, 1e-3, 330).astype(np.float32)
    return made.assign({f"gaze_{axis}_std": ("frame", wide) for axis in "xy"})


@pytest.fixture(scope="module")
def model(phones) -> ResNet18:
    return ResNet18(("gaze_x", "device"), **TINY).fit(phones)


def test_it_tells_devices_and_gaze_together(phones, model):
    found, test = model.predict(phones.tp.test), phones.tp.test
    truth = [phones.tp.classes[k] for k in test["device"].values]
    assert found.names == ("gaze_x",)
    assert found.classes == ("pair", "ring", "spot")
    assert found.probability is not None
    np.testing.assert_allclose(found.probability.sum(axis=1), 1)
    named = [found.classes[k] for k in found.probability.argmax(axis=1)]
    assert np.mean([a == b for a, b in zip(named, truth, strict=True)]) > 0.95
    gaze = test["gaze_x"].values
    assert np.abs(found["gaze_x"] - gaze).mean() < 0.7 * np.abs(gaze - gaze.mean()).mean()
    assert set(found.columns()) == {"gaze_x", "gaze_x_low", "gaze_x_high", "device", "device_probability"} | {
        "applies",
        "reason",
    }


def test_what_it_never_saw_is_none_of_these(phones, model):
    known = model.predict(phones.tp.test).novelty
    other = model.predict(pictures(60, ("cross",), seed=3)[0])
    assert known is not None
    assert other.novelty is not None
    assert np.mean(known < 1) > 0.85
    assert np.mean(other.novelty[:, None] > known) > 0.95
    assert other.device.count(NONE_OF_THESE) > 45


def test_a_model_of_devices_comes_back(phones, model, tmp_path: Path):
    loaded = load_model(save_model(model, tmp_path / "m"))
    one, two = model.predict(phones.tp.test), loaded.predict(phones.tp.test)
    assert loaded.classes() == ("pair", "ring", "spot")
    assert one.device == two.device
    np.testing.assert_allclose(one.probability, two.probability, atol=1e-6)
    np.testing.assert_allclose(one.novelty, two.novelty, rtol=1e-5)


def test_no_frames_are_no_trouble(model):
    empty = model.predict(np.empty((0, 40, 40), np.uint8))
    assert (len(empty), empty.device, empty.classes) == (0, [], ("pair", "ring", "spot"))


def test_only_devices_that_are_there_count(phones):
    two = phones.isel(frame=np.flatnonzero(phones["device"].values != phones.tp.classes.index("ring")))
    part = training_part(two, ("device",), 0.1)
    assert part.classes == ("pair", "spot")
    assert set(part.camera.tolist()) == {0, 1}
    one = phones.isel(frame=np.flatnonzero(phones["device"].values == 0))
    with pytest.raises(InputError, match="all frames show one device, pair"):
        ResNet18("device", **TINY).fit(one)


def test_devices_need_their_label_and_their_model(small):
    with pytest.raises(InputError, match="no label 'device'"):
        ResNet18("device", **TINY).fit(small)
    with pytest.raises(InputError, match="does not recognise devices"):
        ZernikeRidge("device")
    value = np.zeros((2, 1))
    plain = Prediction(("gaze_x",), value, value, value)
    with pytest.raises(InputError, match="knows no devices"):
        _ = plain.device


def test_probabilities_become_those_that_come_true():
    # Scores three times too sure of themselves: the temperature that was left out is found.
    rng = np.random.default_rng(0)
    honest = rng.normal(0, 2, (4000, 5))
    classes = np.array([rng.choice(5, p=p) for p in probabilities(honest, 1.0)])
    assert fit_temperature(3 * honest, classes) == pytest.approx(3, rel=0.1)
    # Never wrong on few frames is no reason to be sure beyond all measure.
    always = 20.0 * np.eye(5)[np.arange(50) % 5]
    sure = probabilities(always, fit_temperature(always, np.arange(50) % 5)).max(axis=1)
    assert 0.9 < sure.mean() < 0.9999
    assert fit_temperature(np.empty((0, 3)), np.empty(0, int)) == 1.0


def test_distances_are_in_deviations_of_the_classes():
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(6, 6))
    classes = np.arange(3000) % 2
    means = np.array([[5.0] * 6, [-5.0] * 6])
    features = means[classes] + rng.normal(size=(3000, 6)) @ spread
    novelty = fit_novelty(features, classes, 2, means[classes][:500] + rng.normal(size=(500, 6)) @ spread)
    fresh = means[classes] + rng.normal(size=(3000, 6)) @ spread
    assert np.mean(novelty(fresh) < 1) == pytest.approx(0.98, abs=0.015)
    # The farthest of 98 in 100 of a normal distribution in six dimensions lies at 3.87 deviations.
    assert novelty.unit == pytest.approx(3.87, rel=0.05)
