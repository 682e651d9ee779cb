"""What the detector of a dark bench takes for retro-reflections in frames that hold none.

    python scripts/measure_empty.py [FIRST [COUNT]]

COUNT frames (100) of each of ten kinds of background, seeds from FIRST on (91000); it prints a row a kind. Nothing here
is a photograph.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import cv2
import numpy as np

from tapetum.track import detect

Array = np.ndarray
SHAPE = (972, 1296)


def _grid(rng: np.random.Generator) -> tuple[Array, Array]:
    y, x = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j].astype(np.float32)
    return y + np.float32(rng.uniform(-0.3, 0.3)), x + np.float32(rng.uniform(-0.3, 0.3))


def _level(rng: np.random.Generator, low: float, high: float) -> Array:
    return np.full(SHAPE, np.exp(rng.uniform(np.log(low), np.log(high))), np.float32)


def dark(rng: np.random.Generator) -> Array:
    return _level(rng, 1, 6)


def bright(rng: np.random.Generator) -> Array:
    return _level(rng, 20, 200)


def slope(rng: np.random.Generator) -> Array:
    y, x = _grid(rng)
    return _level(rng, 5, 60) * (1 + rng.uniform(-0.4, 0.4) * x + rng.uniform(-0.4, 0.4) * y)


def vignette(rng: np.random.Generator) -> Array:
    y, x = _grid(rng)
    return _level(rng, 10, 120) / (1 + rng.uniform(0.2, 1.0) * (x**2 + y**2)) ** 2


def stray(rng: np.random.Generator) -> Array:
    """Light scattered in the probe: a wide glow, brightest somewhere."""
    y, x = _grid(rng)
    return _level(rng, 2, 10) + rng.uniform(5, 80) * np.exp(-(x**2 + y**2) / rng.uniform(0.15, 1.0))


def columns(rng: np.random.Generator) -> Array:
    return _level(rng, 3, 60) + rng.normal(0, rng.uniform(0.3, 2), (1, SHAPE[1])).astype(np.float32)


def banding(rng: np.random.Generator) -> Array:
    return _level(rng, 3, 60) + rng.normal(0, rng.uniform(0.3, 2), (SHAPE[0], 1)).astype(np.float32)


def pattern(rng: np.random.Generator) -> Array:
    """Photosites that differ in gain and offset."""
    gain = 1 + rng.normal(0, rng.uniform(0.005, 0.03), SHAPE).astype(np.float32)
    return _level(rng, 5, 120) * gain + rng.normal(0, rng.uniform(0.2, 1.5), SHAPE).astype(np.float32)


def hot(rng: np.random.Generator) -> Array:
    """Stuck photosites, one by one."""
    picture = _level(rng, 2, 40)
    count = int(rng.integers(20, 400))
    picture[rng.integers(0, SHAPE[0], count), rng.integers(0, SHAPE[1], count)] += rng.uniform(10, 250, count)
    return picture


def walls(rng: np.random.Generator) -> Array:
    """The room behind the bench, dim and out of focus."""
    picture = _level(rng, 2, 10)
    for _ in range(int(rng.integers(2, 9))):
        x, y, w, h = rng.uniform(0, SHAPE[1]), rng.uniform(0, SHAPE[0]), *rng.uniform(450, 900, 2)
        cv2.rectangle(picture, (int(x - w), int(y - h)), (int(x + w), int(y + h)), float(rng.uniform(2, 14)), -1)
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 60))


KINDS: dict[str, Callable[[np.random.Generator], Array]] = {
    "dark": dark,
    "bright, even": bright,
    "slope": slope,
    "vignette": vignette,
    "stray glow": stray,
    "columns": columns,
    "banding": banding,
    "pattern of photosites": pattern,
    "stuck photosites": hot,
    "room out of focus": walls,
}


def frame(kind: str, seed: int) -> Array:
    """A frame of a kind of background, [H, W], uint8, with shot and read noise."""
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    light = np.maximum(KINDS[kind](rng), 0)
    gain, read = rng.uniform(0.01, 0.08), rng.uniform(0.3, 2.0)
    noise = rng.standard_normal(SHAPE, np.float32) * np.sqrt(np.float32(read**2) + np.float32(gain) * light)
    return np.clip(np.rint(light + noise), 0, 255).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int, nargs="?", default=91000, help="seed of the first frame of each kind")
    parser.add_argument("count", type=int, nargs="?", default=100, help="frames of each kind")
    options = parser.parse_args()
    first, count = options.first, options.count
    print("| background | frames | frames with a spot | spots |\n|---|---|---|---|")
    total = [0, 0, 0]
    for kind in KINDS:
        found = [len(detect(frame(kind, seed), largest=400)) for seed in range(first, first + count)]
        row = [count, sum(one > 0 for one in found), sum(found)]
        total = [a + b for a, b in zip(total, row, strict=True)]
        print(f"| {kind} | {row[0]} | {row[1]} | {row[2]} |", flush=True)
    print(f"| all | {total[0]} | {total[1]} | {total[2]} |")


if __name__ == "__main__":
    main()
