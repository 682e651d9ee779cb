"""Where a model applies: it answers what it was trained for, and nothing else, with a reason."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from numpy.typing import NDArray

import tapetum as tp
from tapetum.data import dataset_from_arrays
from tapetum.models import Prediction, ResNet18, ZernikeRidge, load_model, save_model
from tapetum.models.domain import FALSE_REFUSALS, Domain, fit_domain, judged, magnitudes
from tapetum.models.fast import FastResNet18
from tapetum.optics.zernike import mode_count, zernike_basis

pytestmark = pytest.mark.usefixtures("narrow")

SIDE = 128
COARSE = (f"probe.sensor.pixels=[{SIDE}, {SIDE}]", "sampling.accuracy=0.05", "probe.sensor.pitch=4.4 um")


@lru_cache(maxsize=16)
def filmed(
    count: int, seed: int, *changes: str, reach: float = 0.45
) -> tuple[NDArray[np.generic], NDArray[np.float64]]:
    """Frames of the hand-held scene with noise, at gazes drawn over the field, and the gazes."""
    scene = tp.load_scene("hand-held", [*COARSE, *changes])
    rng = np.random.default_rng(seed)
    width = scene.target.sensor.pitch * np.array(scene.target.sensor.pixels)
    gaze = rng.uniform(-reach, reach, (count, 2))
    turns = np.degrees(np.arctan(gaze * width / scene.target.lens.focal_length))
    images = tp.retroreflect(scene, rotation=turns)
    return np.asarray(tp.expose(images, scene.probe, seed=seed)), gaze


def walls(count: int) -> NDArray[np.uint8]:
    """Rectangles with soft edges, of any brightness."""
    rng = np.random.default_rng(5)
    at = np.arange(SIDE) - (SIDE - 1) / 2

    def edge() -> NDArray[np.float64]:
        wide, soft = rng.uniform(20, 160), rng.uniform(1, 20)
        return 1 / (1 + np.exp(np.clip((np.abs(at) - wide / 2) / soft, -50, 50)))

    pictures = [4 + rng.uniform(20, 240) * np.outer(edge(), edge()) for _ in range(count)]
    return np.clip(np.rint(pictures + rng.normal(0, 1, (count, SIDE, SIDE))), 0, 255).astype(np.uint8)


def lamps(count: int) -> NDArray[np.uint8]:
    """Discs, full or nearly so."""
    rng = np.random.default_rng(6)
    at = np.arange(SIDE) - (SIDE - 1) / 2
    away = np.hypot(at, at[:, None])
    pictures = [
        4 + rng.uniform(100, 250) / (1 + np.exp(np.clip((away - rng.uniform(5, 50)) / 1.5, -50, 50)))
        for _ in range(count)
    ]
    return np.clip(np.rint(pictures + rng.normal(0, 1, (count, SIDE, SIDE))), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def trained() -> xr.Dataset:
    images, gaze = filmed(200, 1)
    return dataset_from_arrays(images, {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}, recording=np.arange(200) // 100)


@pytest.fixture(scope="module", params=["zernike", "resnet18"])
def model(request, trained) -> ZernikeRidge | ResNet18:
    if request.param == "zernike":
        return ZernikeRidge(scales=(64, 128)).fit(trained)
    return ResNet18(crop=128, size=32, epochs=1).fit(trained)


def test_it_answers_frames_like_those_it_learned_from(model):
    found = model.predict(filmed(120, 2)[0])
    assert found.described
    assert found.applies.mean() > 0.94
    assert np.isfinite(found.value[found.applies]).all()


def test_a_lens_that_gives_the_same_pictures_is_answered_too(model):
    # The return through a thin lens depends on where the spot falls on the sensor, not on the focal length.
    assert model.predict(filmed(60, 3, "target.lens.focal_length=50 mm")[0]).applies.mean() > 0.9


@pytest.mark.parametrize(
    "changes",
    [
        ("target.lens.aperture_radius=2 mm",),
        ("distance=2.5 m", "target.object_distance=2.5 m"),
        ("target.object_distance=3 m",),
        pytest.param(
            ("target.lens={kind: prescription, name: phone-f}", "sampling.accuracy=0.2"), marks=pytest.mark.slow
        ),
    ],
    ids=["aperture", "distance", "focus", "phone"],
)
def test_another_camera_is_not_answered(model, changes):
    # Nearer to the field's middle, so that no wide spot crosses the sensor's edge, which takes a second a frame.
    found = model.predict(filmed(40, 4, *changes, reach=0.25)[0])
    assert found.applies.mean() < 0.1
    assert np.isnan(found.value[~found.applies]).all()
    assert np.isnan(found.lower[~found.applies]).all()
    assert all(why.startswith("unlike the training frames") for why in found.reason if why)


@pytest.mark.parametrize("pictures", [walls, lamps], ids=["walls", "lamps"])
def test_what_is_no_camera_is_not_answered(model, pictures):
    assert not model.predict(pictures(50)).applies.any()


def test_it_answers_anyway_when_told_to(model):
    quiet, loud = model.predict(walls(3)), model.predict(walls(3), anyway=True)
    assert np.isnan(quiet.value).all()
    assert np.isfinite(loud.value).all()
    assert loud.reason == quiet.reason
    assert quiet.columns()["applies"] == [False] * 3


def test_the_description_is_saved_and_exported(model, tmp_path: Path):
    frames = np.concatenate([filmed(20, 7)[0], filmed(20, 8, "target.object_distance=4.5 m")[0], walls(5)])
    loaded = load_model(save_model(model, tmp_path / "model"))
    wanted = model.predict(frames)
    assert loaded.predict(frames).reason == wanted.reason
    if isinstance(model, ResNet18):
        fast = FastResNet18(model, threads=1).predict(frames)
        np.testing.assert_array_equal(fast.applies, wanted.applies)
        assert fast.described


def test_a_model_without_description_does_not_know(trained, tmp_path: Path):
    model = ZernikeRidge(scales=(64,)).fit(trained.isel(frame=slice(0, 30)))
    assert model.domain_ is None
    found = load_model(save_model(model, tmp_path / "model")).predict(walls(4))
    assert not found.described
    assert set(found.columns()["applies"]) <= {None, False}


def test_so_many_like_frames_are_refused_as_it_says():
    rng = np.random.default_rng(0)
    domain = fit_domain(rng.normal(size=(2000, 20)), np.zeros(2000, int))
    assert domain is not None
    refused = float((domain(rng.normal(size=(20000, 20))) > 1).mean())
    assert 0.4 * FALSE_REFUSALS < refused < 1.6 * FALSE_REFUSALS


def test_what_is_rare_among_the_training_frames_is_answered_and_what_lies_amid_them_is_not():
    """Frames of a film lie on a curved surface: far from its mean, and the rare ones farther than the rest."""
    rng = np.random.default_rng(3)

    def ring(count: int) -> NDArray[np.float64]:
        angle = rng.uniform(0, 2 * np.pi, count)
        return np.stack([np.cos(angle), np.sin(angle)], axis=1) + rng.normal(0, 0.02, (count, 2))

    def rare(count: int) -> NDArray[np.float64]:
        return 6.0 + rng.normal(0, 0.02, (count, 2))

    # Of 1000 frames, 8 in different places of the film: fewer than are refused.
    features = ring(1000)
    features[60::125] = rare(8)
    domain = fit_domain(features, np.zeros(1000, int))
    assert domain is not None
    assert (domain(rare(20)) <= 1).mean() > 0.9
    assert (domain(ring(200)) <= 1).mean() > 0.95
    assert (domain(np.array([[0.0, 0.0], [0.2, -0.1], [3.0, 3.0]])) > 1).all()


def test_a_model_saved_without_training_frames_judges_by_the_distance_from_their_mean():
    rng = np.random.default_rng(4)
    domain = fit_domain(rng.normal(size=(100, 3)), np.zeros(100, int))
    assert domain is not None
    state = domain.state()
    del state["domain.references"]
    older = Domain.from_state(state, 3)
    assert older is not None
    seen = rng.normal(size=(5, 3))
    wanted = np.linalg.norm((seen - domain.mean) @ domain.whitening, axis=1) / domain.unit
    np.testing.assert_allclose(older(seen), wanted)


@pytest.mark.parametrize("wrong", [torch.zeros(4, 2), torch.zeros(0, 3), torch.tensor(1.0), torch.full((4, 3), np.nan)])
def test_training_frames_of_a_damaged_model_are_refused(wrong: torch.Tensor):
    domain = fit_domain(np.random.default_rng(4).normal(size=(100, 3)), np.zeros(100, int))
    assert domain is not None
    with pytest.raises(tp.InputError, match=r"domain\.references"):
        Domain.from_state({**domain.state(), "domain.references": wrong}, 3)


def test_of_many_training_frames_some_are_kept():
    features = np.random.default_rng(5).normal(size=(9001, 4))
    domain = fit_domain(features, np.arange(9001) // 3000)
    assert domain is not None
    assert domain.references.shape == (8000, 4)
    assert (domain(features) > 1).mean() < 2 * FALSE_REFUSALS


def test_magnitudes_do_not_change_when_the_picture_turns():
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, 4000), np.sqrt(rng.uniform(0, 1, 4000))

    def of(turned: float) -> NDArray[np.float64]:
        x, y = radius * np.cos(angle + turned), radius * np.sin(angle + turned)
        basis = zernike_basis(8, torch.from_numpy(x), torch.from_numpy(y)).numpy()
        picture = np.exp(-((radius * np.cos(angle) - 0.3) ** 2 + (radius * np.sin(angle)) ** 2) / 0.1)
        return np.linalg.lstsq(basis.T, picture, rcond=None)[0][None]

    straight, turned = of(0.0), of(0.7)
    assert straight.shape == (1, mode_count(8))
    assert np.abs(straight - turned).max() > 0.02
    np.testing.assert_allclose(magnitudes(straight, 8), magnitudes(turned, 8), atol=1e-9)


def test_no_estimate_lies_outside_the_field():
    value = np.array([[0.2, 0.1], [1.57, 0.0], [0.51, -0.2], [-0.7, 0.3]])
    half = np.array([[0.05, 0.05], [0.01, 0.01], [0.02, 0.02], [np.inf, np.inf]])
    found = judged(Prediction(("gaze_x", "gaze_y"), value, value - half, value + half), None).withheld()
    assert found.applies.tolist() == [True, False, True, False]
    assert found.reason[1] == "gaze_x 1.57 lies outside the field of view"
    np.testing.assert_allclose(found.value[2], [0.5, -0.2])
    assert np.isnan(found.value[[1, 3]]).all()
    assert found.columns()["applies"] == [None, False, None, False]
