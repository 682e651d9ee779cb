"""Light above the background of a frame: maps of it at two scales, and the spots in them."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.track.background import clean

__all__ = ["Maps", "Spot", "make_maps", "search"]

Picture = NDArray[np.float32]
Window = tuple[slice, slice]

# Standard deviations of the two smoothings: matched to the smallest imaged spot, and to one with fringes.
_FINE, _WIDE = 1.5, 6.0
_REDUCE = 4
# Standard deviations that belong to a spot. 3: an aperture of 1.5 times the D4 sigma diameter. ISO 11146-1 takes 3
# times, which would include the second beam of a beam splitter.
_REACH = 3.0
# Largest factor by which smoothing reduces noise: no background is more even than a twelfth of its noise, so wide and
# faint light must exceed half of the noise for an SNR of 6.
_EVEN = 12.0
# Where many pixels read the lowest number, black is clipped: the noise is skewed upwards, and its tail is longer than
# its standard deviation implies.
_TAIL = 1.25
# A spot's own area, in standard deviations (its own and the smoothing's), where no other spot is sought.
_CLAIM = 3.75
# Smallest ratio of heights between fringes of one spot; dimmer light is a ghost or another spot.
_LIKE = 0.2
_MAD = 1.4826


@dataclass(frozen=True)
class Maps:
    """A frame as the search sees it, all [H, W] float32."""

    excess: Picture
    fine: Picture
    fine_snr: Picture
    wide: Picture
    snr: Picture


@dataclass(frozen=True)
class Spot:
    x: float
    y: float
    covariance: tuple[float, float, float]  # xx, xy, yy
    area: int
    edge: bool
    light: float
    snr: float = 0.0
    peak: float = 0.0
    saturated: int = 0

    @property
    def diameter(self) -> float:
        return 2 * math.sqrt(2) * math.sqrt(self.covariance[0] + self.covariance[2])


def _blur(image: Picture, sigma: float) -> Picture:
    # Zero beyond the frame: a mirrored border would count the noise at the edge twice.
    size = 2 * math.ceil(3 * sigma) + 1
    return np.asarray(cv2.GaussianBlur(image, (size, size), sigma, borderType=cv2.BORDER_CONSTANT), dtype=np.float32)


def _in_noise(smooth: Picture, noise: Picture, sigma: float, tail: float) -> Picture:
    """Divide a smoothed frame by its noise: that of smoothed white noise, or more where it is not white."""
    gain = min(2 * math.sqrt(math.pi) * sigma, _EVEN) / tail
    thin = max(1, math.isqrt(smooth.size // 20000))
    sample = gain * smooth[::thin, ::thin] / noise[::thin, ::thin]
    spread = _MAD * float(np.median(np.abs(sample - np.median(sample))))
    return np.asarray(cv2.divide(smooth, noise, scale=gain / max(1.0, spread)), dtype=np.float32)


def make_maps(image: NDArray[np.generic], quantum: float) -> Maps:
    excess, noise = clean(image, quantum)
    sparse = image[::4, ::4]
    tail = _TAIL if np.count_nonzero(sparse == sparse.min()) > 0.2 * sparse.size else 1.0
    height, width = excess.shape
    fine = _blur(excess, _FINE)
    fine_snr = _in_noise(fine, noise, _FINE, tail)
    small = (max(1, width // _REDUCE), max(1, height // _REDUCE))

    def reduced(full: Picture) -> Picture:
        return np.asarray(cv2.resize(full, small, interpolation=cv2.INTER_AREA), dtype=np.float32)

    def grown(reduced: Picture) -> Picture:
        return np.asarray(cv2.resize(reduced, (width, height), interpolation=cv2.INTER_LINEAR), dtype=np.float32)

    sigma = _WIDE / _REDUCE
    wide = grown(_blur(reduced(excess), sigma))
    # Clipped, so that the wide map finds faint wide light, not the halo of bright small light.
    clipped = reduced(np.asarray(cv2.min(excess, 3 * noise), dtype=np.float32))
    wide_snr = grown(_in_noise(_blur(clipped, sigma), reduced(noise / np.float32(_REDUCE)), sigma, tail))
    return Maps(excess, fine, fine_snr, wide, np.asarray(cv2.max(fine_snr, wide_snr), dtype=np.float32))


def _window(maps: Maps, x: float, y: float, reach_x: float, reach_y: float) -> Window:
    height, width = maps.excess.shape
    return (
        slice(max(0, math.floor(y - reach_y)), min(height, math.ceil(y + reach_y) + 1)),
        slice(max(0, math.floor(x - reach_x)), min(width, math.ceil(x + reach_x) + 1)),
    )


def _moments(
    weight: Picture, rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> tuple[float, float, float, float, float, float] | None:
    """Centroid, covariance and total of a weight as x, y, xx, xy, yy, total; None where it is dark."""
    total = float(weight.sum(dtype=np.float64))
    if total <= 0:
        return None
    along_x, along_y = weight.sum(0, dtype=np.float64), weight.sum(1, dtype=np.float64)
    x, y = float(along_x @ columns) / total, float(along_y @ rows) / total
    dx, dy = columns - x, rows - y
    xx, yy = float(along_x @ dx**2) / total, float(along_y @ dy**2) / total
    xy = float(dy @ weight.astype(np.float64) @ dx) / total
    # Add a pixel's own width, so that a spot of one pixel has one.
    # Noise below the background can make them negative.
    return x, y, max(xx, 0) + 1 / 12, xy, max(yy, 0) + 1 / 12, total


def _inside(
    rows: NDArray[np.float64],
    columns: NDArray[np.float64],
    x: float,
    y: float,
    cov: tuple[float, float, float],
    reach: float = _REACH,
) -> NDArray[np.bool_]:
    """Return the pixels within the reach of a spot: an ellipse of so many standard deviations."""
    xx, xy, yy = cov
    determinant = max(xx * yy - xy * xy, 1e-3 * xx * yy)
    dx, dy = (columns - x)[None, :], (rows - y)[:, None]
    return yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy <= reach**2 * determinant


def _borders(lit: NDArray[np.bool_], window: Window, shape: tuple[int, int], stride: int = 1) -> tuple[bool, bool]:
    """Tell whether light reaches a window's border inside the frame, and whether it reaches the frame's own border."""
    rows, columns = window
    sides = (
        (lit[0], rows.start < stride),
        (lit[-1], rows.stop > shape[0] - stride),
        (lit[:, 0], columns.start < stride),
        (lit[:, -1], columns.stop > shape[1] - stride),
    )
    reached = {at_frame for side, at_frame in sides if side.any()}
    return False in reached, True in reached


def _measure(maps: Maps, row: int, column: int, claimed: NDArray[np.uint8], min_snr: float) -> Spot | None:
    """Measure the spot around a bright pixel: its moments, in an aperture that follows them."""
    height, width = maps.excess.shape
    # Where fringes and lobes merge, a quarter of the height bounds the spot.
    level = np.float32(0.25 * maps.wide[row, column])
    # A small spot is bounded by the fine map: the wide one adds a halo of noise.
    gate, least = (maps.fine_snr if maps.fine_snr[row, column] >= min_snr else maps.snr), 0.5 * min_snr
    reach = 32.0
    while True:
        window = _window(maps, column, row, reach, reach)
        lit = (maps.snr[window] > least) & (claimed[window] == 0)
        above = ((maps.wide[window] >= level) & lit).astype(np.uint8)
        above[row - window[0].start, column - window[1].start] = 1
        _, labels = cv2.connectedComponents(above, connectivity=4)
        region = labels == labels[row - window[0].start, column - window[1].start]
        if not _borders(region, window, maps.excess.shape)[0]:
            break
        reach *= 2
    rows, columns = np.arange(height, dtype=np.float64), np.arange(width, dtype=np.float64)
    region &= gate[window] > least
    found = _moments(np.where(region, maps.excess[window], 0), rows[window[0]], columns[window[1]])
    if found is None:
        return None
    area, touches = int(region.sum()), False
    for _ in range(20):
        x, y, xx, xy, yy, _ = found
        window = _window(maps, x, y, _REACH * math.sqrt(xx), _REACH * math.sqrt(yy))
        if window[0].start >= window[0].stop or window[1].start >= window[1].stop:
            return None
        # Wide spots are subsampled: 160 points across give the moments far better than to a pixel.
        stride = max(1, int(max(window[0].stop - window[0].start, window[1].stop - window[1].start) // 160))
        part = slice(window[0].start, window[0].stop, stride), slice(window[1].start, window[1].stop, stride)
        where = rows[part[0]], columns[part[1]]
        lit = _inside(*where, x, y, (xx, xy, yy)) & (gate[part] > least) & (claimed[part] == 0)
        area = int(lit.sum()) * stride**2
        after = _moments(np.where(lit, maps.excess[part], 0), *where)
        touches = _borders(lit, part, maps.excess.shape, stride)[1]
        if after is None:
            break
        step = max(abs(a - b) for a, b in zip(after[:2], found[:2], strict=True))
        growth = abs(math.sqrt(after[2] + after[4]) - math.sqrt(xx + yy))
        found = after
        if step < 0.02 and growth < 0.02:
            break
    x, y, xx, xy, yy, light = found
    return Spot(x, y, (xx, xy, yy), area, touches, light)


def search(
    maps: Maps, full: NDArray[np.bool_], min_snr: float, max_count: int, largest: float = math.inf
) -> list[Spot]:
    """The spots, brightest first, without those wider than `largest` pixels."""
    height, width = maps.excess.shape
    mask = (maps.snr > min_snr).astype(np.uint8)
    # Labelling is the main cost; most of a frame holds nothing to label.
    first_x, first_y, w, h = cv2.boundingRect(mask)
    if w == 0:
        return []
    part = np.ascontiguousarray(mask[first_y : first_y + h, first_x : first_x + w])
    _, labels, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8, ltype=cv2.CV_32S)
    claimed = np.zeros((height, width), np.uint8)
    queue: list[tuple[float, int, int, int]] = []

    def ground(label: int) -> tuple[Window, NDArray[np.bool_]]:
        """Return the window around a labelled region, and its pixels in there."""
        left, top, w, h, _ = (int(v) for v in stats[label])
        window = slice(top + first_y, top + first_y + h), slice(left + first_x, left + first_x + w)
        return window, labels[top : top + h, left : left + w] == label

    def enqueue(label: int) -> None:
        window, mine = ground(label)
        free = mine & (claimed[window] == 0)
        if free.any():
            heights = np.where(free, maps.fine[window], -np.inf)
            row, column = (int(n) for n in np.unravel_index(int(heights.argmax()), heights.shape))
            heapq.heappush(queue, (-float(heights.max()), label, window[0].start + row, window[1].start + column))

    for label in range(1, len(stats)):
        enqueue(label)
    found: list[Spot] = []
    # A smear or a halo breaks into pieces; they are dim and come last, so their number is limited.
    for _ in range(4 * max_count):
        if not queue or len(found) >= max_count:
            break
        _, label, row, column = heapq.heappop(queue)
        if claimed[row, column]:
            enqueue(label)
            continue
        spot = _measure(maps, row, column, claimed, min_snr)
        if spot is not None and spot.diameter > largest:
            # A wall's surroundings belong to no spot.
            window, mine = ground(label)
            claimed[window][mine] = 1
            continue
        if spot is not None and 0 <= round(spot.x) < width and 0 <= round(spot.y) < height:
            xx, xy, yy = spot.covariance
            wider = (xx + _FINE**2, xy, yy + _FINE**2)
            window = _window(maps, spot.x, spot.y, _CLAIM * math.sqrt(wider[0]), _CLAIM * math.sqrt(wider[2]))
            rows = np.arange(window[0].start, window[0].stop, dtype=np.float64)
            columns = np.arange(window[1].start, window[1].stop, dtype=np.float64)
            inside = _inside(rows, columns, spot.x, spot.y, wider, _CLAIM)
            new = inside & (claimed[window] == 0)
            snr = float(np.where(new, maps.snr[window], 0).max(initial=0.0))
            peak = float(np.where(new, maps.fine[window], 0).max(initial=0.0))
            claimed[window][inside] = 1
            if snr >= min_snr and spot.area >= 4:
                saturated = int(np.count_nonzero(full[window] & new))
                found.append(replace(spot, snr=snr, peak=peak, saturated=saturated))
        claimed[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3] = 1
        enqueue(label)
    return sorted(_joined(found), key=lambda spot: -spot.peak)


def _joined(spots: list[Spot]) -> list[Spot]:
    """Join the fringes of one spot: neighbours of like height, nearer to each other than their diameter."""
    rest = sorted(spots, key=lambda spot: -spot.peak)
    done: list[Spot] = []
    while rest:
        one = rest.pop(0)
        other = next((other for other in rest if _belongs(other, one)), None)
        if other is None:
            done.append(one)
        else:
            rest.remove(other)
            # The sum may reach others that its parts did not reach.
            rest.insert(0, _sum(one, other))
    return done


def _belongs(other: Spot, one: Spot) -> bool:
    near = math.hypot(one.x - other.x, one.y - other.y) < 0.5 * (one.diameter + other.diameter)
    return near and other.peak > _LIKE * one.peak


def _sum(one: Spot, other: Spot) -> Spot:
    """Return two spots as one: moments of the light of both."""
    light = one.light + other.light
    share = other.light / light
    dx, dy = other.x - one.x, other.y - one.y
    cov = zip(one.covariance, other.covariance, (dx * dx, dx * dy, dy * dy), strict=True)
    xx, xy, yy = (a + share * (b - a) + share * (1 - share) * c for a, b, c in cov)
    return Spot(
        one.x + share * dx,
        one.y + share * dy,
        (xx, xy, yy),
        one.area + other.area,
        one.edge or other.edge,
        light,
        max(one.snr, other.snr),
        max(one.peak, other.peak),
        one.saturated + other.saturated,
    )
