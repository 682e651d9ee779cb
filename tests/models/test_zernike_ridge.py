"""Zernike + ridge: it learns, it keeps to its training frames, it orders real beams by focus."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.stats import spearmanr
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from tapetum.data import crop, dataset_from_arrays, find_centre
from tapetum.errors import InputError
from tapetum.models import ZernikeRidge, zernike_features
from tapetum.models.zernike_ridge import ridge_residuals

SPOTS = Path(__file__).parents[2] / ".." / "shared" / "data" / "laser-spots"
SMALL = {"scales": (20, 40), "order": 5}


def test_it_is_ridge_on_the_features(small):
    model = ZernikeRidge(**SMALL).fit(small)
    images, gaze = small["image"].values, small.tp.values(("gaze_x", "gaze_y"))
    features = zernike_features(images, **SMALL)
    peer = Ridge(alpha=1e-6, solver="svd").fit(features[:200], gaze[:200])
    prediction = model.predict(small.tp.test, anyway=True)
    np.testing.assert_allclose(prediction.value, peer.predict(features[200:]), atol=1e-6)
    assert np.isinf(prediction.upper).all()


@pytest.mark.parametrize("how", [{}, {"standardise": True, "alpha": "cv"}])
def test_it_learns_and_its_intervals_cover(small, how):
    model = ZernikeRidge(**SMALL, **how, calibration_fraction=0.1).fit(small)
    test = small.tp.test
    truth = test.tp.values(("gaze_x", "gaze_y"))
    prediction = model.predict(test, anyway=True)
    error = np.abs(prediction.value - truth).mean()
    mean = np.abs(truth - small.tp.train.tp.values(("gaze_x", "gaze_y")).mean(0)).mean()
    assert error < 0.3 * mean
    inside = (prediction.lower <= truth) & (truth <= prediction.upper)
    assert 0.75 < inside.mean() <= 1
    np.testing.assert_allclose(prediction.upper - prediction.value, np.tile(model.intervals_.half_width[0], (60, 1)))


def test_arrays_and_datasets_give_the_same(small):
    model = ZernikeRidge(**SMALL).fit(small)
    images = small.tp.test["image"].values
    np.testing.assert_allclose(model.predict(images).value, model.predict(small.tp.test).value)
    assert len(model.predict(images[0])) == 1
    with pytest.raises(InputError, match="pass full_scale"):
        model.predict(images.astype(np.uint16))


def test_no_crops_have_no_estimates(small):
    model = ZernikeRidge(scales=(20, 40), order=3).fit(small.tp.train)
    assert model.predict(np.zeros((0, 40, 40), np.uint8)).value.shape == (0, 2)


def test_cross_validation_asks_for_more_penalty_when_there_is_more_noise():
    images = np.random.default_rng(0).integers(0, 255, (120, 20, 20), dtype=np.uint8)
    features = zernike_features(images, (20,), 2)
    truth = features[:, 1]
    noise = np.random.default_rng(1).normal(0, 10 * truth.std(), 120)

    def chosen(target: np.ndarray) -> float:
        dataset = dataset_from_arrays(images, {"a": target})
        model = ZernikeRidge("a", scales=(20,), order=2, standardise=True, alpha="cv", calibration_fraction=0)
        return model.fit(dataset).alpha_

    assert chosen(truth) < 1 < chosen(noise)


def test_a_feature_that_never_changes_is_harmless():
    images = np.random.default_rng(0).integers(0, 255, (20, 12, 12), dtype=np.uint8)
    images[:, 2:10, 2:10] = 9  # the smaller scale sees nothing else
    dataset = dataset_from_arrays(images, {"a": np.arange(20)})
    model = ZernikeRidge("a", scales=(6, 12), order=1, standardise=True, alpha=1.0).fit(dataset)
    assert np.isfinite(model.predict(images).value).all()


@pytest.mark.skipif(not SPOTS.is_dir(), reason="the laser-spots data are not beside the repository")
def test_real_beams_come_out_in_the_order_of_their_focus():
    """Twelve photographs of one beam, z = 168 ... 770 mm: each is left out once, the others predict its z."""
    files = {int(m[1]): p for p in SPOTS.glob("t-*mm.pgm") if (m := re.search(r"t-(\d+)mm", p.name))}
    z = np.array(sorted(files)) / 1000
    images = []
    for millimetres in sorted(files):
        picture = cv2.imread(str(files[millimetres]), cv2.IMREAD_UNCHANGED)
        assert picture is not None
        # At half size the paper's crops span the whole picture of 800 pixels.
        half = cv2.resize(picture, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        images.append(crop(half, find_centre(half), 400))
    stack = np.stack(images)

    def order_of(**how) -> float:
        found = []
        for k in range(len(z)):
            rest = np.arange(len(z)) != k
            model = ZernikeRidge("z", calibration_fraction=0, **how).fit(
                dataset_from_arrays(stack[rest], {"z": z[rest]})
            )
            found.append(model.predict(stack[k])["z"][0])
        return float(np.asarray(spearmanr(found, z))[0])

    # Measured: 0.87. The first and last are extrapolated, which costs most of what is missing.
    assert order_of() > 0.85


@pytest.mark.parametrize(
    ("how", "word"),
    [
        ({"alpha": 0}, "alpha"),
        ({"alpha": "x"}, "alpha"),
        ({"scales": ()}, "scales"),
        ({"powers": (0,)}, "powers"),
        ({"powers": (1.5,)}, "powers: must be a whole number from 1 to 100, is 1.5"),
    ],
)
def test_bad_parameters_are_told(how, word: str):
    with pytest.raises(InputError, match=word):
        ZernikeRidge(**how)


def test_errors_on_frames_left_out_are_those_of_ridges_of_the_others() -> None:
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(40, 6)) * np.logspace(0, 3, 6), rng.normal(size=(40, 2))
    y += x[:, :2]
    fits = np.arange(0, 20), np.arange(20, 35)
    asides = np.arange(22, 40), np.arange(0, 18)
    found = ridge_residuals(x, y, list(zip(fits, asides, strict=True)))
    assert np.isnan(found[18:22]).all()
    errors = []
    for alpha in np.logspace(-6, 6, 25):
        error = np.full_like(y, np.nan)
        for fit, aside in zip(fits, asides, strict=True):
            ridge = make_pipeline(StandardScaler(), Ridge(alpha=alpha)).fit(x[fit], y[fit])
            error[aside] = y[aside] - ridge.predict(x[aside])
        errors.append(error)
    best = min(errors, key=lambda one: np.nanmean(np.abs(one)))
    np.testing.assert_allclose(found, best, atol=1e-8)
