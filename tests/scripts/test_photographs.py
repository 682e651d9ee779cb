"""Photographs with cameras drawn in, and what of their candidates the detector of one frame alone learns from."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

import make_detector
import photographs
from tapetum.detection.measured import candidates_with_looks


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    rng = np.random.default_rng(3)
    return cv2.GaussianBlur(rng.uniform(0, 255, (400, 500)).astype(np.float32), (0, 0), 9)


def test_cameras_stand_out_where_they_are_said_to_be(picture: np.ndarray) -> None:
    higher: dict[str, list[float]] = {"cameras": [], "elsewhere": []}
    for seed in range(12):
        scene = photographs.posed(picture, np.random.default_rng(seed), 3)
        assert scene.frame.dtype == np.uint8 and scene.places.shape == (3, 2)
        elsewhere = np.random.default_rng(seed).uniform(12, 280, (3, 2))
        for name, places in (("cameras", scene.places), ("elsewhere", elsewhere)):
            for x, y in places.astype(int):
                near = scene.frame[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
                around = scene.frame[max(0, y - 12) : y + 13, max(0, x - 12) : x + 13]
                higher[name].append(float(near.max()) - float(np.median(around)))
    assert np.median(higher["cameras"]) > 2 * np.median(higher["elsewhere"]) > 0
    assert np.mean(np.array(higher["cameras"]) > np.median(higher["elsewhere"])) > 0.9
    same = photographs.posed(picture, np.random.default_rng(11), 3)
    assert (same.frame == scene.frame).all()


def test_what_is_learned_from_a_photograph(picture: np.ndarray) -> None:
    rng = np.random.default_rng(5)
    scene = photographs.posed(picture, rng, 3)
    found, _ = candidates_with_looks(scene.frame, None)
    one = make_detector._learned("wall", scene, found, rng)
    away = np.hypot(*(one.places[:, None] - scene.places).transpose(2, 0, 1)).min(1)
    assert 1 <= one.camera.sum() <= 3 == one.glints
    assert (away[one.camera] < 9).all() and (away[one.counted & ~one.camera] > 8).all()
    assert one.counted.sum() <= make_detector.BEST + make_detector.OTHERS + 3


def test_pictures_are_read_grey_and_a_folder_with_too_few_is_refused(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    cv2.imwrite(str(tmp_path / "in" / "a.png"), np.full((400, 500, 3), (30, 60, 90), np.uint8))
    (tmp_path / "note.txt").write_text("no picture")
    (path,) = photographs.paths_in(tmp_path)
    assert photographs.read(path) == pytest.approx(60)
    with pytest.raises(SystemExit, match="holds 1 photographs; 5 are the fewest"):
        make_detector.of_photographs(tmp_path)
