"""Frames as a probe takes them, made up: fringed spots on a dim, uneven, noisy ground, hot pixels."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

HEIGHT, WIDTH = 480, 640


def hot_pixels(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and heights of defects that stand alone."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, HEIGHT, count), rng.integers(0, WIDTH, count), rng.uniform(10, 200, count)


def add_spot(
    light: np.ndarray, x: float, y: float, width: float, height: float, phase: float = 0, angle: float = 0
) -> None:
    """Add a Gaussian spot of a D4 sigma diameter `width`, with two and a half fringes across."""
    sigma = width / 4
    rows = np.arange(max(0, int(y - 5 * sigma)), max(0, min(light.shape[0], int(y + 5 * sigma) + 2)))
    columns = np.arange(max(0, int(x - 5 * sigma)), max(0, min(light.shape[1], int(x + 5 * sigma) + 2)))
    if not (rows.size and columns.size):
        return
    dx, dy = (columns - x)[None, :], (rows - y)[:, None]
    fringes = 0.5 + 0.5 * np.cos(2 * np.pi * (dx * np.cos(angle) + dy * np.sin(angle)) * 2.5 / width + phase)
    light[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += (
        height * np.exp(-(dx**2 + dy**2) / (2 * sigma**2)) * fringes
    )


@functools.cache
def uneven() -> np.ndarray:
    """Return the shape of the ground: darker at the top, brighter at both sides."""
    y, x = np.mgrid[-1 : 1 : HEIGHT * 1j, -1 : 1 : WIDTH * 1j]
    return (1 + 0.3 * x**2 + 0.2 * y).astype(np.float32)


def probe_frame(
    rng: np.random.Generator,
    spots: Sequence[tuple[float, ...]] = (),
    hot: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    ground: float = 6.0,
) -> np.ndarray:
    """Return [480, 640] uint8: `spots` of (x, y, width, height, phase, angle), shot and read noise."""
    light = ground * uneven()
    for spot in spots:
        add_spot(light, *spot)
    light += np.sqrt(light / 4 + np.float32(1.5**2)) * rng.standard_normal(light.shape, dtype=np.float32)
    if hot is not None:
        light[hot[0], hot[1]] += hot[2]
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)
