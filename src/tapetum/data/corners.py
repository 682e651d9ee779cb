"""Level, noise and fixed pattern of a crop's four corners, far from its retro-reflection.

An RR's rings and the diffraction at its edges fall off as a power of the distance and reach the corners. So each corner
comes with its *halo*: by how much a patch of the same size on the same diagonal, 1.75 times nearer to the middle, is
brighter. The RR's light in the corner is at most a share `FALL_OFFS` of that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.data.dataset import TEST, TRAIN, image_batches
from tapetum.progress import Progress, quiet

__all__ = ["FALL_OFFS", "MOST_TEST", "MOST_TRAIN", "CornerReader", "Corners", "evenly", "read_corners"]

_NEARER = 1.75
FALL_OFFS: tuple[float, ...] = (0.0, *(1 / (_NEARER**power - 1) for power in (4, 3, 2, 1.5)))
"""Shares of a halo that may be the RR's light in the corner: none, or for a fall-off with the 4th, 3rd (the rings of a
round pupil), 2nd (spikes of straight edges, wide scatter) or 1.5th power of the distance."""

MOST_TRAIN, MOST_TEST = 2000, 1000
"""Most frames of each part that are searched for leaks, evenly spread; more would not change the result."""

_LARGEST = 32
# A hot pixel exceeds its neighbours by this many standard deviations and by this many counts.
_HOT, _HOT_COUNTS = 10.0, 4.0
# Limit of a pixel in the fixed pattern, in standard deviations, so that no single pixel dominates.
_LOUDEST = 30.0


@dataclass(frozen=True)
class Corners:
    """The corners of every frame."""

    # [N, 6]: mean of the upper left, upper right, lower left and lower right corner (counts), variance of their pixels
    # (counts squared), share of hot ones.
    level: NDArray[np.float64]
    # [N, 6]: by how much the same is larger nearer to the RR; 0 for hot pixels.
    halo: NDArray[np.float64]
    # Standard deviation of a pixel, counts.
    noise: float
    # [M] numbers of the frames that `pattern` and `hot` show.
    frames: NDArray[np.int64]
    # [M, P] pixels of the corners over the median of their neighbours, in standard deviations: hot pixels and the
    # sensor's fixed pattern, without level and shading.
    pattern: NDArray[np.float32]
    # [M, H]: 10 (standard deviations) where the frame has a hot pixel at each of H places of the probe's frame, else 0;
    # H = 0 where there are none or the crops' places are unknown.
    hot: NDArray[np.float32]


def evenly(numbers: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return at most `most` of the numbers, spread evenly."""
    return numbers[np.linspace(0, len(numbers) - 1, min(most, len(numbers))).round().astype(int)]


class CornerReader:
    """Reads the corners of image batches: `add` every batch, then `read`."""

    def __init__(self, dataset: xr.Dataset) -> None:
        count, side = dataset.sizes["frame"], dataset.tp.side
        self._size = int(np.clip(side // 8, 2, _LARGEST))
        split = np.asarray(dataset["split"].values)
        parts = ((TRAIN, MOST_TRAIN), (TEST, MOST_TEST))
        self._frames = np.sort(np.concatenate([evenly(np.flatnonzero(split == p), n) for p, n in parts]))
        self._row = np.full(count, -1)
        self._row[self._frames] = np.arange(len(self._frames))
        self._level, self._halo = np.zeros((2, count, 6))
        self._pattern = np.zeros((len(self._frames), 4 * self._size**2), dtype=np.float32)
        self._noise: list[float] = []
        self._hot: list[tuple[int, int, int]] = []
        self._corner = _patches(side, self._size, 1.0)
        self._inner = _patches(side, self._size, _NEARER)
        self._origin: NDArray[np.int64] | None = None
        if "centre_x" in dataset and "centre_y" in dataset:
            # As `crop` cuts.
            centre = np.stack([dataset["centre_x"].values, dataset["centre_y"].values], axis=1).astype(np.float64)
            self._origin = np.floor(centre - (side - 1) / 2 + 0.5).astype(np.int64)

    def add(self, start: int, images: NDArray[np.generic]) -> None:
        """Add the images [n, side, side] of the frames from number `start` on."""
        rows = slice(start, start + len(images))
        corner, inner = (_cut(images, places, self._size) for places in (self._corner, self._inner))
        self._level[rows, :4], self._level[rows, 4] = corner.mean((2, 3)), _variance(corner)
        self._halo[rows, :4], self._halo[rows, 4] = inner.mean((2, 3)), _variance(inner)
        self._halo[rows, :5] -= self._level[rows, :5]
        noise = _noise(corner)
        self._noise.append(noise)
        for n, patches in enumerate(corner, start):
            above = np.stack([patch - cv2.medianBlur(patch, 3) for patch in patches])
            hot = above > max(_HOT * noise, _HOT_COUNTS)
            self._level[n, 5] = hot.mean()
            row = self._row[n]
            if row < 0:
                continue
            above -= above.mean(axis=(1, 2), keepdims=True)
            self._pattern[row] = np.clip(above / noise, -_LOUDEST, _LOUDEST).ravel()
            if self._origin is not None:
                for which, y, x in np.argwhere(hot).tolist():
                    top, left = self._corner[which]
                    self._hot.append((row, int(self._origin[n, 0]) + left + x, int(self._origin[n, 1]) + top + y))

    def read(self) -> Corners:
        """Return the corners of all batches."""
        noise = float(np.median(self._noise))
        return Corners(self._level, self._halo, noise, self._frames, self._pattern, self._hot_places())

    def _hot_places(self, most: int = 500) -> NDArray[np.float32]:
        """Return [M, H] for the places of the probe's frame that were hot most often, in three frames or more."""
        if not self._hot:
            return np.zeros((len(self._frames), 0), dtype=np.float32)
        found = np.asarray(self._hot)
        _, which, counts = np.unique(found[:, 1:], axis=0, return_inverse=True, return_counts=True)
        kept = np.argsort(-counts, kind="stable")[:most]
        kept = kept[counts[kept] >= 3]
        column = np.full(len(counts), -1)
        column[kept] = np.arange(len(kept))
        shown = np.zeros((len(self._frames), len(kept)), dtype=np.float32)
        good = column[which] >= 0
        shown[found[good, 0], column[which][good]] = _HOT
        return shown


def read_corners(dataset: xr.Dataset, progress: Progress = quiet) -> Corners:
    """Read the corners of every frame of a dataset."""
    reader, start = CornerReader(dataset), 0
    total = -(-dataset.sizes["frame"] // 64)
    for images in progress(image_batches(dataset, 64), "reading the corners", total=total):
        reader.add(start, images)
        start += len(images)
    return reader.read()


def _patches(side: int, size: int, nearer: float) -> list[tuple[int, int]]:
    """Return row and column of four square patches on the diagonals, `nearer` times nearer to the middle."""
    low = round((side - size) / 2 * (1 - 1 / nearer))
    high = side - size - low
    return [(low, low), (low, high), (high, low), (high, high)]


def _cut(images: NDArray[np.generic], places: list[tuple[int, int]], size: int) -> NDArray[np.float32]:
    cut = np.stack([images[:, y : y + size, x : x + size] for y, x in places], axis=1)
    return np.nan_to_num(cut.astype(np.float32))


def _variance(patches: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the variance of a pixel from the differences of neighbours, which excludes shading."""
    return np.square(np.diff(patches, axis=-1)).mean(axis=(1, 2, 3), dtype=np.float64) / 2


def _noise(patches: NDArray[np.float32]) -> float:
    """Return the standard deviation of a pixel without hot ones, at least that of rounding."""
    apart = np.abs(np.diff(patches, axis=-1))
    return max(float(np.quantile(apart, 0.6827)) / math.sqrt(2), 1 / math.sqrt(12))
