"""What `tapetum detect` finds of cameras that are drawn into photographs of real places.

    python scripts/measure_photographs.py FOLDER [SEED] [--film]

The folder holds photographs without cameras in them. Each becomes a pair: lit by a lamp beside the lens, which lights
what is near the middle more, with two cameras of 3 to 9 pixels drawn in; and dark, as a hand that moved took it
(`shake` of make_detector.py). With `--film` the pictures are frames of one film in the order of their names, and the
dark picture is the next one: what moves between the two is real then. Both get noise and are stored as JPEG.

Textures, edges, noise and blocks are real; the lamp's light and the cameras are drawn, so that this says nothing of
what shines back besides. A camera's height is given over the standard deviation of what surrounds it.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from make_detector import shake
from photographs import SUFFIXES, read
from tapetum.detection import find_cameras
from tapetum.errors import InputError

RATES = (0.01, 0.1, 0.5, 1.0)
CAMERAS, AROUND = 2, 12
SIGMAS, HEIGHTS = (0.7, 2.2), (4.0, 30.0)


@dataclass(frozen=True)
class Camera:
    """A camera at x, y, how high it stands over what surrounds it, and the false alarms it costs to find it."""

    x: float
    y: float
    height: float
    cost: float = math.inf


def lit(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The photograph with a lamp's light added, and exposed for that."""
    h, w = image.shape
    y, x = np.mgrid[-0.5 : 0.5 : h * 1j, -0.5 : 0.5 : w * 1j].astype(np.float32)
    near = cv2.resize(rng.uniform(1, 1.5, (4, 5)).astype(np.float32), (w, h), interpolation=cv2.INTER_LINEAR)
    light = np.exp(-rng.uniform(1, 4) * (x**2 + y**2)) * near
    return image * (1 + rng.uniform(0.1, 0.7) * light) * rng.uniform(0.75, 1.0)


def drawn(image: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, list[Camera]]:
    """The photograph with cameras where it is not overexposed."""
    h, w = image.shape
    image, cameras = image.copy(), []
    smooth = cv2.GaussianBlur(image, (0, 0), 3)
    while len(cameras) < CAMERAS:
        x, y = rng.uniform((40, 40), (w - 40, h - 40))
        if smooth[int(y), int(x)] > 190 or any(math.hypot(x - one.x, y - one.y) < 60 for one in cameras):
            continue
        rows = slice(int(y) - AROUND, int(y) + AROUND + 1)
        columns = slice(int(x) - AROUND, int(x) + AROUND + 1)
        around = max(float(image[rows, columns].std()), 3.0)
        height = math.exp(rng.uniform(*np.log(HEIGHTS))) * around
        height = min(height, 255 - float(smooth[int(y), int(x)]))
        down, along = np.mgrid[rows, columns]
        width = rng.uniform(*SIGMAS)
        image[rows, columns] += height * np.exp(-((along - x) ** 2 + (down - y) ** 2) / (2 * width**2))
        cameras.append(Camera(x, y, height / around))
    return image, cameras


def exposed(image: np.ndarray, quality: int, rng: np.random.Generator) -> np.ndarray:
    noise = rng.normal(0, 1, image.shape) * np.sqrt(0.15 * np.clip(image, 1, 255) + 1)
    levels = np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)
    return cv2.imdecode(cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_GRAYSCALE)


def searched(image: np.ndarray, other: np.ndarray, rng: np.random.Generator) -> tuple[list[Camera], list[float]] | None:
    """The cameras of a pair with their costs, and what each false alarm costs; None where the pair is refused."""
    bright, cameras = drawn(lit(image, rng), rng)
    quality = int(rng.integers(85, 97))
    try:
        found = find_cameras(exposed(bright, quality, rng), exposed(other, quality, rng), false_alarms=max(RATES))
    except InputError as error:
        print(error, file=sys.stderr)
        return None
    false = np.ones(len(found), bool)
    told = []
    for one in cameras:
        near = np.hypot(found.x - one.x, found.y - one.y) < 5
        false &= ~near
        told.append(Camera(one.x, one.y, one.height, float(found.false_alarms[near].min(initial=math.inf))))
    return told, found.false_alarms[false].tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("seed", type=int, nargs="?", default=0)
    parser.add_argument("--film", action="store_true", help="the dark picture is the next frame")
    options = parser.parse_args()
    film, seed = options.film, options.seed
    if not options.folder.is_dir():
        parser.error(f"{options.folder}: no folder")
    paths = sorted(one for one in options.folder.iterdir() if one.suffix.lower() in SUFFIXES)
    cameras: list[Camera] = []
    alarms: list[list[float]] = []
    refused = 0
    for number, path in enumerate(paths[:-1] if film else paths):
        rng = np.random.default_rng([seed, number])
        image = read(path)
        told = searched(image, read(paths[number + 1]) if film else shake(image, rng), rng)
        if told is None:
            refused += 1
            continue
        cameras += told[0]
        alarms.append(told[1])
    print(f"{len(alarms)} pairs, {refused} refused\n")
    print("| asked | alarms a pair | found | of 8 and more times |\n|---|---|---|---|")
    high = [one for one in cameras if one.height >= 8]
    for rate in RATES:
        false = sum(one <= rate for some in alarms for one in some) / max(len(alarms), 1)
        shares = [f"{sum(one.cost <= rate for one in some)} of {len(some)}" for some in (cameras, high)]
        print(f"| {rate:g} | {false:.2f} | {' | '.join(shares)} |")


if __name__ == "__main__":
    main()
