"""`tapetum detect`: what it says of what it found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tapetum.errors import InputError


@pytest.mark.parametrize(("count", "doubted"), [(1, False), (9, True)])
def test_so_many_at_once_are_doubted(run, tmp_path: Path, count: int, doubted: bool) -> None:
    rng = np.random.default_rng(4)
    dark = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)), (0, 0), 4) * 3 - 320
    lit = dark.copy()
    for n in range(count):
        x, y = 60 + 90 * (n % 3), 50 + 70 * (n // 3)
        lit[y : y + 3, x : x + 3] += 100
    for name, picture in (("lit", lit), ("dark", dark)):
        levels = np.clip(picture + rng.normal(0, 2, picture.shape), 0, 255).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"{name}.png"), levels)
    ran = run("detect", tmp_path / "lit.png", "--dark", tmp_path / "dark.png", "-o", tmp_path / "found.csv")
    assert ran.code == 0 and f"{count} found" in ran.out
    assert ("seldom all cameras" in ran.err) == doubted


@pytest.fixture
def pair(tmp_path: Path) -> list[np.ndarray]:
    """A lit and a dark picture of 8 bits with a camera at (61, 81)."""
    rng = np.random.default_rng(4)
    dark = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)), (0, 0), 4) * 3 - 320
    lit = dark.copy()
    lit[80:83, 60:63] += 100
    return [np.clip(one + rng.normal(0, 2, one.shape), 0, 255).astype(np.uint8) for one in (lit, dark)]


def _pgm(path: Path, image: np.ndarray, maximum: int) -> Path:
    head = f"P5 {image.shape[1]} {image.shape[0]} {maximum}\n".encode()
    path.write_bytes(head + image.astype(">u2").tobytes())
    return path


def test_a_file_says_at_which_level_it_saturates(run, tmp_path: Path, pair: list[np.ndarray]) -> None:
    paths = [_pgm(tmp_path / f"{n}.pgm", one.astype(np.uint16) * 4, 1023) for n, one in enumerate(pair)]
    ran = run("detect", paths[0], "--dark", paths[1], "-o", tmp_path / "found.csv")
    assert ran.code == 0 and "1 found" in ran.out and "x 61." in ran.out


def test_a_picture_is_searched_as_it_is_shown(run, tmp_path: Path, pair: list[np.ndarray]) -> None:
    """A phone stores its sensor's rows, and how to turn them."""
    from PIL import Image

    kept = Image.fromarray(np.rot90(pair[0]))
    tag = kept.getexif()
    tag[0x0112] = 6
    kept.save(tmp_path / "lit.jpg", quality=97, exif=tag)
    cv2.imwrite(str(tmp_path / "dark.png"), pair[1])
    given = ("detect", tmp_path / "lit.jpg", "--dark", tmp_path / "dark.png", "-o", tmp_path / "found.csv")
    ran = run(*given, "--picture", tmp_path / "found.png")
    assert ran.code == 0 and "x 61." in ran.out
    assert cv2.imread(str(tmp_path / "found.png")).shape[:2] == (240, 320)


def test_errors_name_the_file(run, tmp_path: Path, pair: list[np.ndarray]) -> None:
    cv2.imwrite(str(tmp_path / "lit.png"), pair[0])
    cv2.imwrite(str(tmp_path / "small.png"), pair[1][:-8])
    given = ("detect", tmp_path / "lit.png", "-o", tmp_path / "found.csv")
    ran = run(*given, "--dark", tmp_path / "small.png")
    assert ran.code == 2 and "small.png" in ran.complaint and "320 x 232" in ran.complaint
    ran = run(*given, "--channel", "red")
    assert ran.code == 2 and "lit.png" in ran.complaint and "no channel 'red'" in ran.complaint
    assert not (tmp_path / "found.csv").exists()


def test_without_its_picture_no_table_has_its_name(run, tmp_path: Path, pair: list[np.ndarray], monkeypatch) -> None:
    from tapetum.detection import draw

    def fails(*_: object) -> None:
        raise InputError("no room left on the disk", where="found.png")

    cv2.imwrite(str(tmp_path / "lit.png"), pair[0])
    monkeypatch.setattr(draw, "draw_found", fails)
    given = ("detect", tmp_path / "lit.png", "-o", tmp_path / "found.csv", "--picture", tmp_path / "found.png")
    ran = run(*given)
    assert ran.code == 2 and not (tmp_path / "found.csv").exists()
    monkeypatch.undo()
    assert run(*given).code == 0
