"""`tapetum simulate`: every kind of file, every kind of sweep."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr

from tapetum.bench import load_scene
from tapetum.cli.simulate import parse_sweep
from tapetum.errors import InputError
from tapetum.simulate import plan_scene, retroreflect

# The scene as it is, at a sixteenth of the pixels and a tenth of the accuracy.
SMALL = ("--set", "probe.sensor.pixels=[40, 32]", "--set", "sampling.accuracy=0.01")


def test_one_image_is_rows_by_columns(run, tmp_path: Path) -> None:
    out = tmp_path / "x.npy"
    ran = run("simulate", "thin-lens", "-o", out, *SMALL, "--set", "rotation=0.5")
    assert (ran.code, ran.err) == (0, "")
    assert "1 image of 40 x 32 pixels, error within 3.1e-02 of the peak (asked 0.01)" in ran.out
    assert "rings that the probe's aperture cuts off, which sampling.propagation=finite computes" in ran.out
    image = np.load(out)
    assert image.shape == (32, 40) and image.dtype == np.float64
    scene = load_scene("thin-lens", ["probe.sensor.pixels=[40, 32]", "sampling.accuracy=0.01"])
    assert np.array_equal(image, retroreflect(scene, 0.5).numpy()[0])


def test_a_picture_says_that_it_lacks_the_rims_light(run, tmp_path: Path) -> None:
    """Its stated error does not count it: `phones` leaves it out of its filters' light."""
    lacks = "of the peak, but for what the rim sends (sampling.rim_light)"
    for one, told in (("phones", True), ("rotation", False)):
        ran = run("simulate", one, "-o", tmp_path / f"{one}.npy", "--set", "probe.sensor.pixels=[40, 32]")
        assert ran.code == 0 and (lacks in ran.out) is told


def test_two_sweeps_make_a_grid(run, tmp_path: Path) -> None:
    sweeps = ("--sweep", "rotation=0,0.5,1", "--sweep", "object_distance=1,2.5,5")
    ran = run("simulate", "thin-lens", *sweeps, *SMALL, "-o", tmp_path / "x.npy", "--json")
    assert ran.code == 0 and ran.err == ""
    images, told = np.load(tmp_path / "x.npy"), json.loads(ran.out)
    assert images.shape == (9, 32, 40) and images.dtype == np.float64
    assert told["shape"] == [9, 32, 40] and told["axes"] == ["rotation", "object_distance"]
    assert told["sweep"] == {"rotation": [0, 0.5, 1], "object_distance": [1, 2.5, 5]}
    assert told["rotation_deg"] == [[0, pytest.approx(r)] for r in (0, 0.5, 1)] * 3
    assert np.allclose(told["peak"], images.max((1, 2)))
    # The first sweep runs along the columns: image 4 is 0.5 degrees at 2.5 m.
    changes = ["object_distance=2.5", "probe.sensor.pixels=[40, 32]", "sampling.accuracy=0.01"]
    alone = retroreflect(load_scene("thin-lens", changes), [0, 0.5, 1]).numpy()[1]
    assert np.abs(images[4] - alone).max() < 1e-6 * alone.max()


def test_the_grid_as_a_picture(run, tmp_path: Path) -> None:
    out = tmp_path / "fig4.png"
    sweeps = ("--sweep", "rotation=0,0.5,1", "--sweep", "object_distance=1,2.5,5")
    ran = run("simulate", "thin-lens", *sweeps, *SMALL, "-o", out)
    assert ran.code == 0 and "9 images" in ran.out
    picture = cv2.imread(str(out))
    assert picture is not None and min(picture.shape[:2]) > 200 and len(np.unique(picture)) > 20
    assert [path.name for path in tmp_path.iterdir()] == ["fig4.png"]


def test_one_image_as_a_picture(run, tmp_path: Path) -> None:
    assert run("simulate", "thin-lens", *SMALL, "-o", tmp_path / "x.png").code == 0
    picture = cv2.imread(str(tmp_path / "x.png"), cv2.IMREAD_UNCHANGED)
    assert picture is not None and picture.shape == (32, 40) and picture.max() == 255


def test_a_range_into_tiff_and_zarr(run, tmp_path: Path) -> None:
    for name in ("x.npy", "x.tif", "x.zarr"):
        ran = run("simulate", "thin-lens", "--sweep", "rotation=0:1:3", *SMALL, "-o", tmp_path / name)
        assert ran.code == 0, ran.err
    images = np.load(tmp_path / "x.npy")
    assert images.shape == (3, 32, 40)
    ok, pages = cv2.imreadmulti(str(tmp_path / "x.tif"), flags=cv2.IMREAD_UNCHANGED)
    assert ok and np.array_equal(np.stack(pages), images.astype(np.float32))
    group = zarr.open_group(tmp_path / "x.zarr", mode="r")
    assert np.array_equal(np.asarray(group["irradiance"]), images)
    assert group.attrs["units"] == "W/m^2" and group.attrs["pitch_m"] == 2.2e-6


def test_double_precision(run, tmp_path: Path) -> None:
    for name, more in (("a.npy", ()), ("b.npy", ("--double",))):
        assert run("simulate", "thin-lens", *SMALL, "-o", tmp_path / name, *more).code == 0
    single, double = np.load(tmp_path / "a.npy"), np.load(tmp_path / "b.npy")
    assert 0 < np.abs(single - double).max() < 1e-4 * double.max()
    # Single precision cannot hold what double computed.
    assert not np.array_equal(double, double.astype(np.float32))


def test_other_fields_and_units(run, tmp_path: Path) -> None:
    out = tmp_path / "x.npy"
    ran = run("simulate", "thin-lens", "--sweep", "wavelength=532 nm,640 nm", *SMALL, "-o", out)
    assert ran.code == 0
    green, red = np.load(out)
    changes = ["wavelength=532e-9", *SMALL[1::2]]
    assert np.array_equal(green, retroreflect(load_scene("thin-lens", changes)).numpy()[0])
    assert np.abs(green - red).max() > 0.1 * red.max()


def test_a_grid_forced_by_hand_claims_no_error(run, tmp_path: Path) -> None:
    plan = plan_scene(load_scene("thin-lens", SMALL[1::2]), 0.0)
    forced = ("--set", f"sampling.pupil={plan.columns - 2}")
    ran = run("simulate", "thin-lens", *SMALL, *forced, "-o", tmp_path / "x.npy", "--json")
    assert ran.code == 0 and json.loads(ran.out)["expected_error"] is None
    ran = run("simulate", "thin-lens", *SMALL, *forced, "-o", tmp_path / "x.npy", "--overwrite")
    assert "error unknown" in ran.out and "cut-off" not in ran.out


def test_beyond_the_cut_off(run, tmp_path: Path) -> None:
    ran = run("simulate", "thin-lens", *SMALL, "--set", "rotation=2", "-o", tmp_path / "x.npy")
    assert ran.code == 0 and "nothing returns beyond the cut-off" in ran.out


def test_sweeps_are_read() -> None:
    assert parse_sweep("rotation = 0, 0.5").values == (0, 0.5)
    assert parse_sweep("object_distance=1:2:5").values == (1, 1.25, 1.5, 1.75, 2)
    assert parse_sweep("distance=5 m,600 cm").values == ("5 m", "600 cm")
    assert parse_sweep("rotation=0,1").labels() == ["rotation 0°", "rotation 1°"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rotation", "is no sweep"),
        ("rotation=", "is no sweep"),
        ("rotation=0,,1", "empty value"),
        ("rotation=0:1:0", "is no range"),
        ("rotation=0:b:3", "is no range"),
        ("rotation=0:1:100000000", "is no range"),
        ("rotatoin=0,1", "did you mean target.rotation"),
        ("focal_length=1,2", "target.lens.focal_length or .* or probe.lens.focal_length"),
    ],
)
def test_sweeps_that_cannot_be_read(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_sweep(text)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-o", "x.jpeg"], "unknown image type '.jpeg'; use .png, .tif, .tiff, .npy, .zarr"),
        (["-o", "x.npy", *["--sweep", "rotation=0,1"] * 2], "swept twice"),
        (["-o", "x.npy", *["--sweep", "distance=1,2"] * 3], "3 sweeps"),
        (["-o", "x.npy", "--sweep", "pitch=1um,2um"], "names more than one field"),
        (["-o", "x.npy", "--sweep", "probe.sensor.pitch=1um,2um"], "pitch of the probe's pixels"),
        (["-o", "x.npy", "--sweep", "rotation=0,40"], "--sweep: target: a rotation of (0, 40) deg"),
        (["-o", "x.npy", "--sweep", "object_distance=1,0.05"], "not beyond the focal length"),
        (["-o", "x.npy", "--sweep", "rotation=0:1:90000", "--set", "probe.sensor.pixels=[640, 480]"], "memory"),
    ],
)
def test_sweeps_that_cannot_be_made(run, tmp_path: Path, monkeypatch, arguments: list[str], words: str) -> None:
    monkeypatch.chdir(tmp_path)
    ran = run("simulate", "thin-lens", *SMALL, *arguments)
    assert ran.code == 2 and words in ran.complaint
    assert not list(tmp_path.iterdir())


def test_a_folder_is_never_replaced(run, tmp_path: Path) -> None:
    kept = tmp_path / "set.zarr"
    kept.mkdir()
    (kept / "mine").write_text("dear")
    ran = run("simulate", "thin-lens", *SMALL, "-o", kept)
    assert ran.code == 2 and "exists already" in ran.complaint
    ran = run("simulate", "thin-lens", *SMALL, "-o", kept, "--overwrite")
    assert ran.code == 2 and "is no store of images that may be replaced" in ran.complaint
    assert (kept / "mine").read_text() == "dear"
