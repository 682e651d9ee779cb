"""Photographs as the lit frames of a probe, with cameras drawn in: what the detector of one frame alone learns from.

Drawn scenes do not serve for that: what is drawn is brighter and sharper than what stands in real frames, so that being
bright and sharp means less to a detector than it should. In photographs all that is no camera is real. A camera is a
round spot, a Gaussian with or without a halo, a disc or an Airy pattern, as high over what surrounds it as chance has
it; three in ten are so bright that they saturate.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.special import j1

__all__ = ["SUFFIXES", "Posed", "paths_in", "posed", "read"]

SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp")
LONGEST = 1600
"""Longest side: larger photographs are reduced."""
SIGMAS = (0.55, 3.5)
"""Least and largest standard deviation of a camera's spot, in pixels."""
HEIGHTS, LOWEST = (3.0, 30.0), 15.0
"""Height of a spot over what varies around it, and least height in grey levels."""
SATURATED, BRIGHT = 0.3, (150.0, 900.0)
"""Share of the cameras that are bright, and their heights in grey levels."""
MARGIN = 2
"""Least distance of a camera from the frame's edge."""


@dataclass(frozen=True)
class Posed:
    """A frame [H, W], uint8; x and y of its cameras, [N, 2]; standard deviations of their spots in pixels, [N]."""

    frame: np.ndarray
    places: np.ndarray
    sigma: np.ndarray


def paths_in(folder: Path) -> list[Path]:
    """The pictures in a folder and those below, in the order of their names."""
    return sorted(one for one in folder.rglob("*") if one.suffix.lower() in SUFFIXES)


def read(path: Path) -> np.ndarray:
    """The photograph's grey levels, [H, W] float32."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        sys.exit(f"error: {path}: is no picture")
    grey = image.mean(2).astype(np.float32)
    share = LONGEST / max(grey.shape)
    return grey if share >= 1 else cv2.resize(grey, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)


def posed(image: np.ndarray, rng: np.random.Generator, cameras: int) -> Posed:
    """A part of a photograph [H, W], taken anew by a probe's camera, with so many cameras in it.

    It is enlarged or reduced, turned about, exposed, veiled and blurred by chance; then come noise, the combing of an
    interlaced video and the blocks of JPEG.
    """
    image = _taken(image, rng)
    h, w = image.shape
    noise = _log(rng, 0.5, 8)
    places, sigma = np.zeros((cameras, 2)), np.zeros(cameras)
    for n in range(cameras):
        y, x = rng.integers(MARGIN, h - MARGIN), rng.integers(MARGIN, w - MARGIN)
        sigma[n] = _log(rng, *SIGMAS)
        spot, half = _spot(rng, float(sigma[n]))
        around = float(image[max(0, y - 10) : y + 11, max(0, x - 10) : x + 11].std())
        height = max(_log(rng, *HEIGHTS) * math.hypot(noise / max(1, sigma[n]), around), LOWEST)
        if rng.random() < SATURATED:
            height = rng.uniform(*BRIGHT)
        top, low, left, right = max(0, y - half), min(h, y + half + 1), max(0, x - half), min(w, x + half + 1)
        image[top:low, left:right] += height * spot[top - y + half : low - y + half, left - x + half : right - x + half]
        places[n] = x, y
    if rng.random() < 0.3:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 0.9))
    image = image + rng.normal(0, 1, image.shape) * noise
    if rng.random() < 0.25:
        image[1::2] = np.roll(image[1::2], rng.integers(-1, 2), 1)
    frame = np.clip(np.rint(image), 0, 255).astype(np.uint8)
    if rng.random() < 0.6:
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(60, 98))]
        frame = cv2.imdecode(cv2.imencode(".jpg", frame, quality)[1], cv2.IMREAD_GRAYSCALE)
    return Posed(frame, places, sigma)


def _taken(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    scale = _log(rng, 0.7, 2.2)
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=way)
    h, w = (min(int(rng.integers(300, most)), side) for most, side in zip((580, 740), image.shape, strict=True))
    top, left = rng.integers(0, image.shape[0] - h + 1), rng.integers(0, image.shape[1] - w + 1)
    image = image[top : top + h, left : left + w].astype(np.float32)
    if rng.random() < 0.5:
        image = image[:, ::-1]
    image = 255 * (np.clip(image, 0, 255) / 255) ** rng.uniform(0.7, 1.6)
    gain, veil = _log(rng, 0.15, 1.2), rng.uniform(0, 60) if rng.random() < 0.6 else 0.0
    image = np.clip(image * gain + veil, 0, 255)
    return cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.6)) if rng.random() < 0.5 else image


def _spot(rng: np.random.Generator, sigma: float) -> tuple[np.ndarray, int]:
    """A spot of height 1, [2 half + 1, 2 half + 1], off the middle by up to half a pixel."""
    half = min(int(12 * sigma + 4), 50)
    y, x = np.mgrid[-half : half + 1, -half : half + 1] - rng.uniform(-0.5, 0.5, (2, 1, 1))
    turn, squeeze = rng.uniform(0, math.pi), rng.uniform(0.75, 1)
    along, across = x * math.cos(turn) + y * math.sin(turn), (y * math.cos(turn) - x * math.sin(turn)) / squeeze
    r = np.hypot(along, across) / sigma
    kind = rng.integers(4)
    if kind == 0:
        spot = np.exp(-(r**2) / 2)
    elif kind == 1:
        spot = np.exp(-(r**2) / 2) + 0.08 * np.exp(-r / 2.5)
    elif kind == 2:
        spot = 1 / (1 + np.exp(4 * (r - 1.6)))
    else:
        ring = np.maximum(1.5 * r, 1e-6)
        spot = cv2.GaussianBlur((2 * j1(ring) / ring) ** 2, (0, 0), 0.6)
    return spot / spot.max(), half


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))
