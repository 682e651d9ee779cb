"""A quick search of a whole frame for the few parts in which light may rise above the background.

A frame of five megapixels holds some tens of spots; to smooth all of it takes ten times as long as to measure them. So
the frame is reduced to half and a quarter of its size in integers, which keeps the SNR of spots of any size within a
third, and only blocks that may hold one are searched closely.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.track.background import Ground, Picture, without_hot_pixels

__all__ = ["BLOCK", "FINE", "Part", "Reduced", "blur", "fine_in_windows", "parts_of", "reduced"]

FINE = 1.5
"""Standard deviation of the smoothing that is matched to the smallest imaged spot, in pixels."""

BLOCK = 16
"""Side of the blocks that are looked at or left out, in pixels."""

# Rows that are reduced at a time, so that what lies between two steps stays in the processor's cache.
_ROWS = 128
# The mean of 4 x 4 pixels, at every second pixel, has at least so much of the SNR of the matched smoothing: least for a
# spot of two pixels that lies a pixel off the mean's middle.
_WORTH = 0.65
# Pixels around a block on which its smoothed values depend: smoothing, and a neighbour by which hot pixels are
# recognised.
_HALO = math.ceil(3 * FINE) + 1
# Most blocks that are looked at again before the whole frame is.
_MOST = 0.25


@dataclass(frozen=True)
class Reduced:
    """A frame's means over 2 x 2 pixels, in steps of `unit`, and over 4 x 4 pixels, in its own; rests are left out."""

    half: NDArray[Any]
    unit: float
    quarter: Picture


@dataclass(frozen=True)
class Part:
    """A rectangle of a frame [H, W]: rows from `top`, columns from `left`; whole blocks except at the frame's edge."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def window(self) -> tuple[slice, slice]:
        """The slices that cut it out of the frame."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


def blur(image: Picture, sigma: float) -> Picture:
    """Smooth by a Gaussian; beyond the border all is zero: a mirrored one would count the noise there twice."""
    size = 2 * math.ceil(3 * sigma) + 1
    return np.asarray(cv2.GaussianBlur(image, (size, size), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)


def reduced(image: NDArray[Any]) -> Reduced:
    """Reduce a frame [H, W] of uint8, uint16 or float32."""
    height, width = (size // 2 for size in image.shape)
    even = image[: 2 * height, : 2 * width]
    if image.dtype == np.uint8:
        half, unit = _half_of_bytes(even), 1 / 256
    else:
        half, unit = cv2.resize(even.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA), 1.0
    return Reduced(half, unit, np.asarray(_halved(half), dtype=np.float32) * np.float32(unit))


def _halved(image: NDArray[Any], down: int = 0, across: int = 0) -> NDArray[Any]:
    """Return the means over 2 x 2 pixels, from a row and a column on; a rest is left out."""
    height, width = (image.shape[0] - down) // 2, (image.shape[1] - across) // 2
    even = image[down : down + 2 * height, across : across + 2 * width]
    return cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA)


def _half_of_bytes(image: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the means over 2 x 2 pixels of an image with even sides, times 256: those over 4 x 4 are exact, too."""
    height, width = image.shape
    half = np.empty((height // 2, width // 2), np.uint16)
    # A zero before each byte, as the lower one, makes it a number 256 times as large.
    low, high = (0, 1) if sys.byteorder == "little" else (1, 0)
    pair = [np.zeros((_ROWS, width), np.uint8)] * 2
    both = np.empty((_ROWS, width, 2), np.uint8)
    for top in range(0, height, _ROWS):
        rows = min(_ROWS, height - top)
        pair[low], pair[high] = pair[low][:rows], image[top : top + rows]
        cv2.merge(pair, both[:rows])
        wide = both[:rows].view(np.uint16)[..., 0]
        cv2.resize(wide, (width // 2, rows // 2), half[top // 2 : (top + rows) // 2], interpolation=cv2.INTER_AREA)
    return half


def _largest(image: NDArray[Any], side: int, shape: tuple[int, int]) -> Picture:
    """Return the largest value of each block of `side` pixels, a power of two; blocks at the end may be smaller."""
    whole = image.shape[0] // side * side
    rows = [image[:whole].reshape(-1, side, image.shape[1]).max(axis=1)]
    if whole < image.shape[0]:
        rows.append(image[whole:].max(axis=0, keepdims=True))
    high = np.concatenate(rows)
    down, across = shape[0] - len(high), shape[1] * side - image.shape[1]
    high = np.pad(high, ((0, down), (0, across)), mode="edge") if down or across else high
    while high.shape[1] > shape[1]:
        high = np.maximum(high[:, ::2], high[:, 1::2])
    return high.astype(np.float32)


def fine_in_windows(
    image: NDArray[Any], ground: Ground, top: NDArray[np.intp], left: NDArray[np.intp], side: int
) -> tuple[Picture, Picture]:
    """Return the smoothed excess of square windows [N, side, side], without hot pixels, and its noise there.

    All windows lie within the frame. What lies around one counts as zero, as it does around the frame.
    """
    reach = np.arange(side)
    rows, columns = top[:, None] + reach, left[:, None] + reach
    level, noise = ground.at(rows, columns)
    windows = np.lib.stride_tricks.sliding_window_view(image, (side, side))[top, left]
    # Zeros between windows that stand one above the other, so that one call smooths all of them.
    count, apart = len(top), math.ceil(3 * FINE)
    excess = np.zeros((count, side + apart, side), np.float32)
    np.subtract(windows, level, out=excess[:, :side], dtype=np.float32)
    spread = np.ones_like(excess)
    spread[:, :side] = noise
    flat = without_hot_pixels(excess.reshape(-1, side), spread.reshape(-1, side))
    return blur(flat, FINE).reshape(count, side + apart, side)[:, :side], noise


def parts_of(
    image: NDArray[Any],
    small: Reduced,
    ground: Ground,
    wide_snr: Picture,
    gain: float,
    min_snr: float,
) -> list[Part]:
    """Find the parts of a frame that may hold a spot.

    Parameters
    ----------
    image
        [H, W], uint8, uint16 or float32.
    small, ground
        Of this frame.
    wide_snr
        [H//4, W//4] SNR of light that is smoothed widely.
    gain
        By which the fine smoothing divides the noise.
    min_snr
        Least SNR of a spot.

    Returns
    -------
    list of Part
        They do not meet, and hold all pixels above `min_snr` with what belongs to them.
    """
    height, width = image.shape
    shape = (-(-small.half.shape[0] // (BLOCK // 2)), -(-small.half.shape[1] // (BLOCK // 2)))
    # The mean of 4 x 4 pixels at every second pixel: those at even and at odd ones, in both directions.
    means = _halved(small.half)
    for down, across in ((0, 1), (1, 0), (1, 1)):
        others = _halved(small.half, down, across)
        same = means[: others.shape[0], : others.shape[1]]
        np.maximum(same, others, out=same)
    highest = _largest(means, BLOCK // 4, shape) * np.float32(small.unit)
    middle = [
        np.minimum(BLOCK * np.arange(n) + (BLOCK - 1) / 2, size - 1)
        for n, size in zip(shape, (height, width), strict=True)
    ]
    level, noise = ground.at(*middle)
    slope = sum(np.abs(np.gradient(level, axis=axis)) for axis in (0, 1) if shape[axis] > 1)
    # A mean of 16 pixels has a quarter of their noise; where the background slopes a block's ends lie off its middle.
    fine = (highest - level + slope / 2) / noise * np.float32(min(4.0, 0.75 * gain)) >= _WORTH * min_snr
    wide = _largest(wide_snr, BLOCK // 4, shape)
    strong = wide > min_snr
    unsure = fine & ~strong
    if np.count_nonzero(unsure) <= _MOST * unsure.size:
        strong |= _confirmed(image, ground, unsure, gain, min_snr)
    else:
        strong |= fine
    # Faint surroundings belong to a spot down to half of its least SNR.
    near = np.asarray(cv2.connectedComponents(((wide > 0.5 * min_snr) | strong).astype(np.uint8), connectivity=8)[1])
    near = near.astype(np.intp, copy=False)
    kept = np.zeros(int(near.max()) + 1, bool)
    kept[near[strong]] = True
    kept[0] = False
    around = cv2.dilate(kept[near].astype(np.uint8), np.ones((3, 3), np.uint8))
    return [
        Part(
            BLOCK * top,
            height if top + h == shape[0] else BLOCK * (top + h),
            BLOCK * left,
            width if left + w == shape[1] else BLOCK * (left + w),
        )
        for left, top, w, h in _boxes(np.asarray(around, dtype=np.uint8))
    ]


def _confirmed(
    image: NDArray[Any], ground: Ground, unsure: NDArray[np.bool_], gain: float, min_snr: float
) -> NDArray[np.bool_]:
    """Return which of the unsure blocks do hold a pixel above the least SNR."""
    found = np.zeros_like(unsure)
    side = min(BLOCK + 2 * _HALO, *image.shape)
    row, column = np.nonzero(unsure)
    if len(row):
        top = np.clip(BLOCK * row - _HALO, 0, image.shape[0] - side)
        left = np.clip(BLOCK * column - _HALO, 0, image.shape[1] - side)
        smooth, noise = fine_in_windows(image, ground, top, left, side)
        snr = smooth * np.float32(gain) / noise
        found[row, column] = snr.max(axis=(1, 2)) > min_snr
    return found


def _boxes(mask: NDArray[np.uint8]) -> list[tuple[int, int, int, int]]:
    """Return rectangles (left, top, width, height) that cover a mask and do not meet."""
    while True:
        count, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        boxes = [(int(x), int(y), int(w), int(h)) for x, y, w, h, _ in stats[1:]]
        filled = np.zeros_like(mask)
        for x, y, w, h in boxes:
            filled[y : y + h, x : x + w] = 1
        if cv2.connectedComponents(filled, connectivity=8)[0] == count:
            return boxes
        mask = filled
