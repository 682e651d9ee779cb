"""Detection on photographs of beams and of the night sky that other people took.

The reference for the beams is the package laserbeamsize, with an aperture of twice the beam's diameter and
without the pixels below the noise (`mask_diameters=2, iso_noise=False`). Its defaults, three diameters and
negative pixels included, take in the smear columns and the second beams of these frames: five of the
seventeen then come out with a negative second moment, and others up to 14 px off.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import laserbeamsize
import numpy as np
import pytest

from tapetum.track import Detections, detect, track

DATA = Path(__file__).parents[2] / ".." / "shared" / "data"
BEAMS, STARS = DATA / "laser-spots", DATA / "star-fields"
GHOSTED = "sb_259mm_10"

needs_beams = pytest.mark.skipif(not BEAMS.is_dir(), reason="no folder shared/data/laser-spots beside the repository")
needs_stars = pytest.mark.skipif(not STARS.is_dir(), reason="no folder shared/data/star-fields beside the repository")


def picture(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None and image.ndim == 2
    return image


def reference(image: np.ndarray) -> tuple[float, float, float]:
    """Return x, y and the mean diameter that laserbeamsize gives."""
    x, y, major, minor, _ = laserbeamsize.beam_size(image, mask_diameters=2, iso_noise=False)
    assert minor is not None
    return float(x), float(y), (float(major) + float(minor)) / 2


def assert_same_place(found: Detections, n: int, x: float, y: float, diameter: float) -> None:
    assert math.dist((found.x[n], found.y[n]), (x, y)) <= max(3.0, 0.05 * diameter)


@needs_beams
@pytest.mark.parametrize("path", sorted(BEAMS.glob("*.pgm")), ids=lambda path: path.stem)
def test_each_frame_has_its_one_beam_where_laserbeamsize_sees_it(path: Path):
    if path.stem == GHOSTED:
        pytest.skip("holds two beams: the next test")
    image = picture(path)
    found = detect(image)
    assert len(found) == 1
    assert_same_place(found, 0, *reference(image))
    for name in Detections.names():
        assert np.isfinite(getattr(found, name)).all()


@needs_beams
def test_the_ghosted_frame_holds_two_beams_and_the_option_that_leaves_one():
    """Two beams of two lobes each, 327 px apart, the second with 31 % of the height of the first.

    Nothing in the one frame tells such a ghost from a second source, so by default both are reported,
    brighter first, each as one in spite of the dark line between its lobes. Who knows the ratio of the
    splitter gives it.
    """
    image = picture(BEAMS / f"{GHOSTED}.pgm")
    found = detect(image)
    assert len(found) == 2
    for n, (left, top, right, bottom) in enumerate([(570, 380, 740, 550), (560, 80, 720, 210)]):
        x, y, diameter = reference(image[top:bottom, left:right])
        assert_same_place(found, n, x + left, y + top, diameter)
    assert found.peak[1] / found.peak[0] == pytest.approx(0.31, abs=0.03)
    assert len(detect(image, ghost_ratio=0.4)) == 1


@needs_beams
def test_the_two_lobed_beam_is_one_whose_brightest_point_leans_to_a_lobe():
    """Smoothed, the lobes run into one another: the brightest point lies between the centroid and the brighter lobe."""
    found = detect(picture(BEAMS / "TEM01_200mm.pgm"))
    assert len(found) == 1
    lobe = math.dist((found.x[0], found.y[0]), (found.peak_x[0], found.peak_y[0]))
    assert 0.05 * found.diameter[0] < lobe < 0.4 * found.diameter[0]


@needs_beams
def test_the_saturated_beam_knows_that_it_is():
    image = picture(BEAMS / "FBWR_151.pgm")
    found = detect(image)
    assert found.saturated[0] == pytest.approx(np.count_nonzero(image == 255), rel=0.01)
    assert not detect(picture(BEAMS / "t-414mm.pgm")).saturated.any()


@needs_beams
def test_a_folder_of_photographs_of_any_kind_is_tracked(tmp_path):
    for n, (stem, kind) in enumerate(
        {"t-414mm": "png", "TEM01_200mm": "tif", "t-hene": "pgm", "FBWR_151": "png"}.items()
    ):
        cv2.imwrite(str(tmp_path / f"{n}-{stem}.{kind}"), picture(BEAMS / f"{stem}.pgm"))
    seen = list(track(tmp_path))
    assert [len(one.rows) for one in seen] == [1, 1, 1, 1]
    assert all(row.seen and math.isfinite(row.x + row.y) for one in seen for row in one.rows)
    seen = {one.name: len(one.detections) for one in track(BEAMS)}
    assert seen == {path.name: 1 + (path.stem == GHOSTED) for path in BEAMS.glob("*.pgm")}


@needs_stars
@pytest.mark.parametrize("path", sorted(STARS.glob("*.tiff")), ids=lambda path: path.stem[-13:])
def test_stars_fire_and_single_pixels_do_not(path: Path):
    """44 and 93 detections at an SNR of 6; of 20 and 36 bright single pixels none is among them."""
    image = picture(path)
    found = detect(image, ghost_ratio=0, stray=0, max_count=1000)
    rest = (image - cv2.medianBlur(image, 5).astype(float)).astype(np.float32)
    rest /= 1.4826 * np.median(np.abs(rest))
    ring = np.ones((3, 3), np.uint8)
    ring[1, 1] = 0
    beside = cv2.dilate(rest, ring)
    lit = cv2.filter2D((rest > 4).astype(np.float32), -1, ring.astype(np.float32), borderType=cv2.BORDER_CONSTANT)

    def nearest(mask: np.ndarray) -> np.ndarray:
        rows, columns = np.nonzero(mask)
        return np.hypot(found.x[:, None] - columns, found.y[:, None] - rows).min(axis=0)

    lone = nearest((rest > 8) & (beside < 3))
    assert len(lone) >= 20
    assert (lone > 2).all()
    points = nearest((rest > 12) & (rest >= beside) & (lit >= 4))
    assert len(points) >= 8
    # Two stars nearer than some 12 px count as one.
    assert (points < 3).mean() >= 0.8
    assert 25 <= len(found) <= 200
