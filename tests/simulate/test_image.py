"""Images on disk, and what the sensor makes of them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import zarr

from tapetum.bench import ProbeSensor, load_scene
from tapetum.errors import InputError
from tapetum.simulate import Image, expose, sign_dprime
from tapetum.simulate.exposure import digitise
from tapetum.simulate.radiometry import electrons


@pytest.fixture
def image() -> Image:
    values = torch.arange(24, dtype=torch.float32).reshape(2, 3, 4)
    return Image(values, 2e-6, {"wavelength": 640e-9, "rotation_deg": [(0.0, 0.0), (0.0, 1.0)]})


def test_npy_is_float64_and_drops_a_batch_of_one(image: Image, tmp_path: Path) -> None:
    many = np.load(image.save(tmp_path / "a.npy"), allow_pickle=False)
    assert many.dtype == np.float64
    assert np.array_equal(many, image.numpy())
    one = Image(image.irradiance[:1], image.pitch)
    assert np.load(one.save(tmp_path / "b.npy"), allow_pickle=False).shape == (3, 4)


def test_tif_has_a_page_an_image(image: Image, tmp_path: Path) -> None:
    read, pages = cv2.imreadmulti(str(image.save(tmp_path / "a.tif")), flags=cv2.IMREAD_UNCHANGED)
    assert read
    assert np.array_equal(np.stack(pages), image.numpy().astype(np.float32))


def test_png_is_stretched_to_its_peak(image: Image, tmp_path: Path) -> None:
    picture = cv2.imread(str(image.save(tmp_path / "a.png")), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    assert picture.shape == (3, 8)
    assert picture.max() == 255
    assert picture[0, 0] == 0


def test_zarr_carries_units_and_replaces_a_store_when_asked(image: Image, tmp_path: Path) -> None:
    image.save(tmp_path / "a.zarr")
    with pytest.raises(InputError, match="exists already"):
        image.save(tmp_path / "a.zarr")
    group = zarr.open_group(image.save(tmp_path / "a.zarr", overwrite=True), mode="r")
    assert group.attrs["units"] == "W/m^2"
    assert group.attrs["pitch_m"] == 2e-6
    assert np.array_equal(np.asarray(group["irradiance"]), image.numpy())


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_something_else_is_never_replaced(image: Image, tmp_path: Path, overwrite: bool) -> None:
    other = tmp_path / "a.zarr"
    zarr.create_group(other, attributes={"pitch_m": 1e-6})
    (other / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"exists already|no store of images that may be replaced"):
        image.save(other, overwrite=overwrite)
    assert (other / "notes.txt").read_text() == "mine"


def test_an_unknown_type_is_refused_and_nothing_is_written(image: Image, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"unknown image type '\.bmp'"):
        image.save(tmp_path / "a.bmp")
    assert not list(tmp_path.iterdir())


def test_watts_to_electrons() -> None:
    """1 W/m² on 2.2 µm pixels for 1 ms at 640 nm and 50 %: 4.84e-15 J, 15 594 photons, 7797 electrons."""
    sensor = ProbeSensor(exposure=1e-3, quantum_efficiency=0.5, background=3.0, dark_current=1000.0)
    assert float(electrons(torch.ones(()), sensor, 640e-9)) == pytest.approx(7797 + 3 + 1, rel=1e-3)


def test_noise_has_the_stated_mean_and_variance() -> None:
    sensor = ProbeSensor(bits=16, full_well=65535.0, read_noise=5.0, offset=100.0)
    frames = digitise(torch.full((400, 400), 50.0), sensor, np.random.default_rng(1)).astype(float)
    # One electron is one digital number here; rounding adds a twelfth.
    assert frames.mean() == pytest.approx(150, abs=0.15)
    assert frames.var() == pytest.approx(50 + 25 + 1 / 12, rel=0.02)


def test_a_full_well_saturates_and_the_dark_stays_at_zero() -> None:
    sensor = ProbeSensor(bits=8, full_well=1000.0, read_noise=2.0)
    bright = digitise(torch.full((20, 20), 5000.0), sensor, np.random.default_rng(1))
    assert bright.dtype == np.uint8
    assert (bright == 255).all()
    assert digitise(torch.zeros(20, 20), sensor, np.random.default_rng(1)).max() <= 2


def test_the_seed_decides_the_frame(image: Image) -> None:
    probe = load_scene("thin-lens", ["probe.sensor.pitch=2 um"]).probe
    assert np.array_equal(expose(image, probe, 1), expose(image, probe, 1))
    assert not np.array_equal(expose(image, probe, 1), expose(image, probe, 2))


def test_the_sign_is_harder_to_tell_near_the_axis_and_easier_with_a_second_beam() -> None:
    from tapetum.record.film import without_second_beam

    scene = load_scene("hand-held")
    gaze = torch.tensor([[0.005, 0.0], [0.1, 0.0]], dtype=torch.float64)
    with_beam = sign_dprime(scene, gaze, accuracy=3e-3)
    without = sign_dprime(without_second_beam(scene), gaze, accuracy=3e-3)
    assert float(with_beam[0]) < float(with_beam[1])
    assert (with_beam > without).all()
    assert torch.isfinite(with_beam).all()


def test_an_array_of_an_image_is_a_copy_where_one_is_asked_for(image: Image) -> None:
    doubles = Image(image.irradiance.double(), image.pitch, image.metadata)
    shared = np.asarray(doubles)
    for copied in (np.array(doubles), np.array(doubles, dtype=np.float32), doubles.to_xarray().values, np.array(image)):
        copied[:] = -1
        assert np.array_equal(doubles.numpy(), image.irradiance)
    assert np.shares_memory(shared, doubles.irradiance.numpy())
    assert np.shares_memory(np.asarray(doubles, copy=False), shared)
    with pytest.raises(InputError, match=r"image: is torch\.float32 on cpu, no float64 array without a copy"):
        np.asarray(image, copy=False)
