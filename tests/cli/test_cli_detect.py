"""`tapetum detect`: what it says of what it found."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest


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
