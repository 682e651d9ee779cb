"""The paper's features against an independent fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tapetum.errors import InputError
from tapetum.models import feature_names, zernike_features
from tapetum.models.inputs import prepare
from tapetum.optics.zernike import disc_coordinates, nm_to_noll, zernike_basis


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (3, 60, 60), dtype=np.uint8)


@pytest.mark.parametrize(
    ("side", "dtype", "tolerance"),
    [(48, torch.float64, 1e-10), (47, torch.float64, 1e-10), (60, torch.float32, 2e-5)],
)
def test_agreement_with_the_zernike_packages_fit(images, side: int, dtype, tolerance: float):
    from zernike import RZern

    peer = RZern(8)
    x, y = disc_coordinates(side)
    peer.make_cart_grid(x.numpy(), y.numpy())
    # An odd crop cannot lie in the middle of an even image: there the first of the two middle places counts.
    edge = (60 - side) // 2
    cut = images[1, edge : edge + side, edge : edge + side]
    theirs = peer.fit_cart_grid(np.sqrt(cut.astype(float)))[0]
    places = [nm_to_noll(int(n), int(m)) - 1 for n, m in zip(peer.ntab, peer.mtab, strict=True)]
    ours = zernike_features(images, (side,), 8, (1,), dtype=dtype)[1, places]
    np.testing.assert_allclose(ours, theirs, atol=tolerance)


def test_coefficients_of_a_known_sum_come_back():
    x, y = disc_coordinates(50)
    wanted = np.zeros(15)
    wanted[[0, 2, 5, 10]] = 10, 0.5, -0.3, 0.2
    root = np.tensordot(wanted, zernike_basis(4, x, y).numpy(), 1).clip(0)
    found = zernike_features((root**2)[None], (50,), 4, (1,), full_scale=255, dtype=torch.float64)
    np.testing.assert_allclose(found[0], wanted, atol=1e-10)


def test_the_papers_1092_features_and_their_order():
    images = np.random.default_rng(1).integers(0, 256, (2, 400, 400), dtype=np.uint8)
    features = zernike_features(images)
    names = feature_names()
    assert features.shape == (2, 1092)
    assert len(set(names)) == 1092
    assert names[:2] == ["z(0,0)^1 at 100", "z(1,1)^1 at 100"]
    # Scale by scale, power by power.
    np.testing.assert_allclose(features[:, 91:182], features[:, :91] ** 2)
    np.testing.assert_allclose(features[:, 3 * 91 + 182 : 6 * 91], features[:, 3 * 91 : 4 * 91] ** 3)
    centre = zernike_features(images[:, 150:250, 150:250], (100,))
    np.testing.assert_allclose(features[:, :273], centre)
    assert names[273] == "z(0,0)^1 at 200"


def test_depth_does_not_matter(images):
    deep = images.astype(np.uint16) * 257
    ours = zernike_features(images, (60,), 4)
    np.testing.assert_allclose(zernike_features(deep, (60,), 4, full_scale=65535), ours, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(zernike_features(images / 255, (60,), 4, full_scale=1), ours, rtol=1e-4, atol=1e-5)


def test_batches_do_not_matter(images):
    many = np.tile(images, (30, 1, 1))
    features = zernike_features(many, (40, 60), 3)
    np.testing.assert_allclose(features[60:63], zernike_features(images, (40, 60), 3), rtol=1e-5, atol=1e-6)


def test_the_images_are_left_as_they_are():
    images = np.full((1, 20, 20), 0.25, dtype=np.float32)
    zernike_features(images, (20,), 2, full_scale=1)
    assert (images == 0.25).all()


def test_no_images_have_as_many_features():
    assert zernike_features(np.zeros((0, 60, 60), np.uint8), (40, 60), 3).shape == (0, 60)


@pytest.mark.parametrize("kind", [">u2", ">f4", ">f8"])
def test_another_byte_order_does_not_matter(images, kind: str):
    ours = zernike_features(images, (60,), 4)
    np.testing.assert_allclose(zernike_features(images.astype(kind), (60,), 4, full_scale=255), ours, rtol=1e-5)


@pytest.mark.filterwarnings("error")
def test_read_only_images_draw_no_warning(images):
    kept = images.copy()
    kept.setflags(write=False)
    np.testing.assert_array_equal(zernike_features(kept, (60,), 4), zernike_features(images, (60,), 4))
    assert np.array_equal(prepare(kept, 60, 30, 255), prepare(images, 60, 30, 255))


@pytest.mark.parametrize(
    ("images", "how", "word"),
    [
        (np.zeros((1, 30, 30), np.uint16), {}, "pass full_scale"),
        (np.zeros((1, 30, 20), np.uint8), {}, "square crops"),
        (np.zeros((1, 30, 30), np.uint8), {"scales": (40,)}, "does not fit crops of 30"),
        (np.zeros((1, 30, 30), np.uint8), {"scales": ()}, "scales"),
        (np.zeros((1, 30, 30), np.uint8), {"scales": (6,)}, "cannot separate 91 modes"),
        (np.full((1, 30, 30), -1.0), {"full_scale": 1, "scales": (30,)}, "not negative"),
        (np.full((1, 30, 30), np.nan), {"full_scale": 1, "scales": (30,)}, "finite"),
        (np.zeros((1, 30, 30), bool), {}, "grey levels"),
        (np.zeros((1, 30, 30), np.uint8), {"full_scale": 0}, "full_scale"),
        *((np.zeros((1, 30, 30), np.uint8), {"scales": (30,), "powers": one}, "powers") for one in ((0.5,), (0,), ())),
    ],
)
def test_bad_input_is_told(images, how, word: str):
    with pytest.raises(InputError, match=word):
        zernike_features(images, **how)
