"""Light above the background of a frame: maps of it at two scales where there may be any, and the spots in them.

One file of more than 400 lines: a spot is measured, claimed and joined to others on one set of masks.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.track.background import Ground, Picture, fit_ground, without_hot_pixels
from tapetum.track.screen import FINE, Part, blur, fine_in_windows, parts_of, reduced
from tapetum.track.sheet import Window, laid_out

__all__ = ["Maps", "Spot", "make_maps", "search"]

Covariance = tuple[float, float, float]  # xx, xy, yy

# Standard deviation of the wide smoothing, matched to a spot with fringes, and by how much a frame is reduced for it.
_WIDE, _REDUCE = 6.0, 4
# Pixels around a part, and reduced ones, on which its maps depend: smoothing, and the neighbours by which hot pixels
# are recognised or between which reduced ones are interpolated. Of the first a multiple of the reduction.
_AROUND = -(-(math.ceil(3 * FINE) + 1) // _REDUCE) * _REDUCE
_CLEAR = math.ceil(3 * _WIDE / _REDUCE) + 1
# Standard deviations that belong to a spot. 3: an aperture of 1.5 times the D4 sigma diameter. ISO 11146-1 takes 3
# times, which would include the second beam of a beam splitter.
_REACH = 3.0
# Largest factor by which smoothing reduces noise: no background is more even than a twelfth of its noise, so wide and
# faint light must exceed half of the noise for an SNR of 6.
_EVEN = 12.0
# Where many pixels read the lowest number, black is clipped: the noise is skewed upwards, and its tail is longer than
# its standard deviation implies.
_TAIL = 1.25
# Least share of a spot's aperture that is lit: a faint spot's is a seventh, a fringed one's half.
_EMPTY = 0.05
# A spot's own area, in standard deviations (its own and the smoothing's), where no other spot is sought.
_CLAIM = 3.75
# How far around that the wide smoothing still carries the spot's light, in its standard deviations.
_CARRIED = 2.0
# Smallest ratio of heights between fringes of one spot; dimmer light is a ghost or another spot.
_LIKE = 0.2
_MAD = 1.4826
# Diameter of a spot from which it may be an unevenness of the background, and the standard deviation over which such a
# one hardly varies. The light of a defocused lens ends at an edge, and has fringes.
_BROAD, _SHADE, _SHADE_STEP = 70.0, 24.0, 8
# Up to how often the noise that variation is noise: of some thousand places the highest stands 3.5 times as high.
_SHADE_NOISE = 5.0
# The frame's edge cuts what is broad.
_BROAD_AT_EDGE = 30.0
# Side of the windows, and most of them along an axis, whose smoothed noise stands for the frame's.
_SAMPLE, _SAMPLES = 48, 7


@dataclass(frozen=True)
class Maps:
    """Parts of a frame of `shape` as the search sees them: pictures on one sheet, float32, and their `windows` in it.

    `wide_noise` is that of the wide map, of the whole frame at a quarter of its size.
    """

    shape: tuple[int, int]
    parts: Sequence[Part]
    windows: Sequence[Window]
    excess: Picture
    fine: Picture
    fine_snr: Picture
    wide: Picture
    snr: Picture
    wide_noise: Picture


@dataclass(frozen=True)
class Spot:
    x: float
    y: float
    covariance: Covariance
    area: int
    edge: bool
    light: float
    snr: float = 0.0
    peak: float = 0.0
    saturated: int = 0

    @property
    def diameter(self) -> float:
        return 2 * math.sqrt(2) * math.sqrt(self.covariance[0] + self.covariance[2])


def _spread(smooth: Picture, noise: Picture, gain: float) -> float:
    """Return how far a smoothed frame's noise exceeds that of smoothed white noise; at least 1."""
    sample = (gain * smooth / noise).ravel()
    return max(1.0, _MAD * _middle(np.abs(sample - _middle(sample))))


def _middle(values: Picture) -> float:
    """Return the median of many values, several times faster than numpy's."""
    return float(np.partition(values, len(values) // 2)[len(values) // 2])


def _thinned(picture: Picture) -> Picture:
    thin = max(1, math.isqrt(picture.size // 20000))
    return picture[::thin, ::thin]


def _sampled(image: NDArray[Any], ground: Ground, gain: float) -> float:
    """Return the `_spread` of the fine smoothing, from windows all over the frame."""
    side, halo = min(_SAMPLE, *image.shape), math.ceil(3 * FINE) if min(image.shape) >= _SAMPLE else 0
    places = [np.linspace(0, size - side, min(_SAMPLES, max(1, size // side))).astype(np.intp) for size in image.shape]
    top, left = (one.ravel() for one in np.meshgrid(*places, indexing="ij"))
    smooth, noise = fine_in_windows(image, ground, top, left, side)
    # Neighbours are smoothed alike: every second pixel gives as much.
    thin = slice(halo, side - halo, 2)
    return _spread(smooth[:, thin, thin], noise[:, thin, thin], gain)


def make_maps(image: NDArray[Any], quantum: float, min_snr: float) -> Maps | None:
    """Return maps of the parts of a frame that may hold spots above an SNR; None where there are none."""
    small = reduced(image)
    ground = fit_ground(image, small.quarter, quantum)
    sparse = image[::4, ::4]
    tail = _TAIL if np.count_nonzero(sparse == sparse.min()) > 0.2 * sparse.size else 1.0
    gain = min(2 * math.sqrt(math.pi) * FINE, _EVEN) / tail
    gain /= _sampled(image, ground, gain)

    sigma = _WIDE / _REDUCE
    level, noise = ground.at(*(_REDUCE * np.arange(n) + (_REDUCE - 1) / 2 for n in small.quarter.shape))
    excess = np.asarray(cv2.max(cv2.subtract(small.quarter, level), -5 * noise), dtype=np.float32)
    # Clipped, so that the wide map finds faint wide light, not the halo of bright small light.
    clipped = np.asarray(cv2.min(excess, 3 * noise), dtype=np.float32)
    least = noise / np.float32(_REDUCE)
    wide_gain = min(2 * math.sqrt(math.pi) * sigma, _EVEN) / tail
    smooth = blur(clipped, sigma)
    wide_gain /= _spread(_thinned(smooth), _thinned(least), wide_gain)
    wide_snr = np.asarray(cv2.divide(smooth, least, scale=wide_gain), dtype=np.float32)
    parts = parts_of(image, small, ground, wide_snr, gain, min_snr)
    if not parts:
        return None
    windows, own, fine, around = _close(image, ground, parts)
    fine_snr = np.asarray(cv2.divide(fine, around, scale=gain), dtype=np.float32)
    # The means of the quarter know nothing of hot pixels, and clip too late.
    shape = own.shape[1] // _REDUCE, own.shape[0] // _REDUCE
    cut = np.asarray(cv2.min(own, 3 * around), dtype=np.float32)
    for whole, quarter in ((own, excess), (cut, clipped)):
        means = cv2.resize(whole, shape, interpolation=cv2.INTER_AREA)
        for part, place in zip(parts, windows, strict=True):
            quarter[_reduced(part.window)] = means[_reduced(place)]
    wide, snr = _wide(parts, windows, (excess, clipped, least), own.shape)
    snr *= np.float32(wide_gain)
    cv2.max(fine_snr, snr, snr)
    return Maps(image.shape, parts, windows, own, fine, fine_snr, wide, snr, least / np.float32(wide_gain))


def _close(
    image: NDArray[Any], ground: Ground, parts: Sequence[Part]
) -> tuple[list[Window], Picture, Picture, Picture]:
    """Return where the parts are on a sheet, and the sheet: their excess, its smoothed one and its noise.

    Each part lies there with its surroundings in the frame.
    """
    sizes = [(one.bottom - one.top + 2 * _AROUND, one.right - one.left + 2 * _AROUND) for one in parts]
    places, shape = laid_out(sizes, _REDUCE)
    above, noise = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    windows = [_grown(one, -_AROUND) for one in places]
    for part, window in zip(parts, windows, strict=True):
        frame = _grown(part.window, _AROUND, image.shape)
        sheet = _moved(frame, part.window, window)
        below, noise[sheet] = ground.at(*frame)
        np.subtract(image[frame], below, out=above[sheet])
    above = without_hot_pixels(above, noise)
    return windows, above, blur(above, FINE), noise


def _wide(
    parts: Sequence[Part], windows: Sequence[Window], quarters: tuple[Picture, Picture, Picture], shape: tuple[int, int]
) -> tuple[Picture, Picture]:
    """Smooth what surrounds the parts widely; return sheets of the excess, and of the clipped one over the noise.

    `quarters` are the frame's excess, the clipped one and the noise of its means; `windows` are the parts' places in
    sheets of `shape`.
    """
    size = quarters[0].shape
    inner = [_reduced(one.window, up=True) for one in parts]
    places, around = laid_out([(h.stop - h.start + 2 * _CLEAR, w.stop - w.start + 2 * _CLEAR) for h, w in inner])
    places = [_grown(one, -_CLEAR) for one in places]
    # Beyond the frame all is zero, its noise one.
    sheets = [np.full(around, beyond, np.float32) for beyond in (0, 0, 1)]
    for one, place in zip(inner, places, strict=True):
        frame = _grown(one, _CLEAR, size)
        sheet = _moved(frame, one, place)
        for picture, quarter in zip(sheets, quarters, strict=True):
            picture[sheet] = quarter[frame]
    smooth, clipped = (blur(one, _WIDE / _REDUCE) for one in sheets[:2])
    grown = []
    for picture in (smooth, np.asarray(cv2.divide(clipped, sheets[2]))):
        small = np.zeros((shape[0] // _REDUCE, shape[1] // _REDUCE), np.float32)
        for one, place, window in zip(inner, places, windows, strict=True):
            # With the neighbours between which pixels lie; beyond the frame's whole quarters the last one is repeated.
            all_of_it, frame = _grown(one, 1), _grown(one, 1, size)
            near = picture[_moved(frame, one, place)]
            if frame != all_of_it:
                (top, bottom), (left, right) = (
                    (b.start - a.start, a.stop - b.stop) for a, b in zip(all_of_it, frame, strict=True)
                )
                near = cv2.copyMakeBorder(near, top, bottom, left, right, cv2.BORDER_REPLICATE)
            small[_moved(all_of_it, one, _reduced(window))] = near
        grown.append(np.asarray(cv2.resize(small, shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32))
    return grown[0], grown[1]


def _reduced(window: Window, *, up: bool = False) -> Window:
    """Return the whole quarters in a window that begins with one, or all that it touches."""
    rest = _REDUCE - 1 if up else 0
    rows, columns = (slice(one.start // _REDUCE, (one.stop + rest) // _REDUCE) for one in window)
    return rows, columns


def _grown(window: Window, around: int, shape: tuple[int, int] | None = None) -> Window:
    """Return a window with, or for a negative number without, pixels around it; not beyond a frame of a shape."""
    rows, columns = (slice(one.start - around, one.stop + around) for one in window)
    if shape is None:
        return rows, columns
    return (
        slice(max(0, rows.start), min(shape[0], rows.stop)),
        slice(max(0, columns.start), min(shape[1], columns.stop)),
    )


def _moved(part: Window, window: Window, to: Window) -> Window:
    """Return where a part of a frame lies on a sheet on which a window of the frame lies at another place."""
    down, across = to[0].start - window[0].start, to[1].start - window[1].start
    rows, columns = part
    return slice(rows.start + down, rows.stop + down), slice(columns.start + across, columns.stop + across)


class _Masks:
    """What is known of the pixels of all parts while they are searched, on the maps' sheet.

    Of its pixels, `free` belong to no spot yet, and of these `lit` and `lit_finely` are above half of the least SNR, of
    both scales and of the fine one; at `seeds` a spot may still be sought; `sharp` are above the least SNR of the fine
    scale.
    """

    def __init__(self, maps: Maps, min_snr: float) -> None:
        self.free = np.zeros(maps.snr.shape, bool)
        for window in maps.windows:
            self.free[window] = True
        self.lit, self.lit_finely = maps.snr > 0.5 * min_snr, maps.fine_snr > 0.5 * min_snr
        self.seeds, self.sharp = maps.snr > min_snr, maps.fine_snr > min_snr
        # A part's surroundings on the sheet belong to others, or to none.
        self.seeds &= self.free
        seeds = self.seeds.view(np.uint8)
        _, self.labels, stats, _ = cv2.connectedComponentsWithStats(seeds, connectivity=8)
        # Of each region in which a spot may be: left, top, width, height, and the number of its part.
        corners = np.array([(one[0].start, one[1].start, one[0].stop, one[1].stop) for one in maps.windows])
        left, top, width, height = stats[1:, :4].T
        within = (top[:, None] >= corners[:, 0]) & (top[:, None] < corners[:, 2])
        within &= (left[:, None] >= corners[:, 1]) & (left[:, None] < corners[:, 3])
        part = within.argmax(1)
        columns = (left - corners[part, 1], top - corners[part, 0], width, height, part)
        self.regions = np.stack(columns, axis=1).tolist() if len(stats) > 1 else []


class _Place:
    """A part of a frame while it is searched; all coordinates count from the part's first pixel.

    Its pictures are those of `Maps`, its masks those of `_Masks`, [h, w].
    """

    def __init__(self, maps: Maps, masks: _Masks, number: int, min_snr: float) -> None:
        self.part, self.frame, self.min_snr = maps.parts[number], maps.shape, min_snr
        self.wide_noise, self.regions = maps.wide_noise, masks.regions
        at = maps.windows[number]
        self.excess, self.fine, self.fine_snr = maps.excess[at], maps.fine[at], maps.fine_snr[at]
        self.wide, self.snr = maps.wide[at], maps.snr[at]
        self.free, self.lit, self.lit_finely = masks.free[at], masks.lit[at], masks.lit_finely[at]
        self.seeds, self.sharp, self.labels = masks.seeds[at], masks.sharp[at], masks.labels[at]
        self.rows, self.columns = (np.arange(size, dtype=np.float64) for size in self.snr.shape)

    def ground(self, label: int) -> tuple[Window, NDArray[np.bool_]]:
        """Return the window around a labelled region, and where in there a spot of it may still be sought."""
        left, top, w, h, _ = self.regions[label - 1]
        window = slice(top, top + h), slice(left, left + w)
        return window, (self.labels[window] == label) & self.seeds[window]

    def highest(self, label: int) -> tuple[float, int, int] | None:
        """Return height, row and column of the brightest pixel of a region where a spot may still be sought."""
        window, free = self.ground(label)
        if not np.count_nonzero(free):
            return None
        _, height, _, (column, row) = cv2.minMaxLoc(self.fine[window], free.view(np.uint8))
        return height, window[0].start + row, window[1].start + column

    def window(self, x: float, y: float, reach_x: float, reach_y: float) -> Window:
        height, width = self.lit.shape
        return (
            slice(max(0, math.floor(y - reach_y)), min(height, math.ceil(y + reach_y) + 1)),
            slice(max(0, math.floor(x - reach_x)), min(width, math.ceil(x + reach_x) + 1)),
        )

    def inside(self, window: Window, x: float, y: float, covariance: Covariance, reach: float) -> NDArray[np.bool_]:
        """Return the pixels of a window within a spot's reach: an ellipse of so many standard deviations."""
        xx, xy, yy = covariance
        area = xx * yy - xy * xy
        # In each row the pixels not farther from the ellipse's middle there than its half width.
        away = self.rows[window[0]] - y
        off = (self.columns[window[1]] - x) - ((xy / yy) * away)[:, None]
        np.multiply(off, off, out=off)
        np.multiply(away, away, out=away)
        away *= -area / (yy * yy)
        away += reach**2 * max(area, 1e-3 * xx * yy) / yy
        return np.asarray(off <= away[:, None])

    def goes_on(self, lit: NDArray[np.bool_], window: Window) -> bool:
        """Return whether light reaches a window's border inside the part."""
        rows, columns = window
        height, width = self.lit.shape
        return bool(
            (rows.start > 0 and np.count_nonzero(lit[0]))
            or (rows.stop < height and np.count_nonzero(lit[-1]))
            or (columns.start > 0 and np.count_nonzero(lit[:, 0]))
            or (columns.stop < width and np.count_nonzero(lit[:, -1]))
        )

    def at_edge(self, lit: NDArray[np.bool_], window: Window, stride: int) -> bool:
        """Return whether light in a window reaches the frame's own border."""
        rows, columns = window
        height, width = self.lit.shape
        part, (whole_height, whole_width) = self.part, self.frame
        return bool(
            (part.top == 0 and rows.start < stride and np.count_nonzero(lit[0]))
            or (part.bottom == whole_height and rows.stop > height - stride and np.count_nonzero(lit[-1]))
            or (part.left == 0 and columns.start < stride and np.count_nonzero(lit[:, 0]))
            or (part.right == whole_width and columns.stop > width - stride and np.count_nonzero(lit[:, -1]))
        )

    def claim(self, window: Window, inside: NDArray[np.bool_]) -> None:
        """No other spot is sought here, nor has light from here."""
        outside = ~inside
        for mask in (self.free, self.seeds, self.lit, self.lit_finely):
            mask[window] &= outside

    def moments(self, lit: NDArray[np.bool_], window: Window) -> tuple[float, float, Covariance, float] | None:
        """Centroid, covariance and total of the light in a window where it is lit; None where it is dark."""
        across, down = window[1].step or 1, window[0].step or 1
        excess = self.excess[window]
        moments = cv2.moments(cv2.copyTo(excess, lit.view(np.uint8)) if across == 1 else excess * lit)
        total = moments["m00"]
        if total <= 0:
            return None
        x, y = moments["m10"] / total, moments["m01"] / total
        # Add a pixel's own width, so that a spot of one pixel has one.
        # Noise below the background can make them negative.
        xx = max(moments["mu20"] / total * across**2, 0.0) + 1 / 12
        yy = max(moments["mu02"] / total * down**2, 0.0) + 1 / 12
        xy = moments["mu11"] / total * across * down
        return window[1].start + across * x, window[0].start + down * y, (xx, xy, yy), total


def _measure(place: _Place, row: int, column: int) -> Spot | None:
    """Measure the spot around a bright pixel: its moments, in an aperture that follows them."""
    # Where fringes and lobes merge, a quarter of the height bounds the spot.
    level = np.float32(0.25 * place.wide[row, column])
    # A small spot is bounded by the fine map: the wide one adds a halo of noise.
    gated = place.lit_finely if place.fine_snr[row, column] >= place.min_snr else place.lit
    reach = 32.0
    while True:
        window = place.window(column, row, reach, reach)
        region = place.wide[window] >= level
        region &= place.lit[window]
        at = row - window[0].start, column - window[1].start
        region[at] = True
        # What hangs together with the pixel becomes 2.
        cv2.floodFill(region.view(np.uint8), None, at[::-1], 2, flags=4)
        region = region.view(np.uint8) == 2
        if not place.goes_on(region, window):
            break
        reach *= 2
    found = place.moments(region & gated[window], window)
    if found is None:
        return None
    first = found, window, region
    part, lit = window, region
    for _ in range(20):
        x, y, (xx, xy, yy), _ = found
        part = place.window(x, y, _REACH * math.sqrt(xx), _REACH * math.sqrt(yy))
        if part[0].start >= part[0].stop or part[1].start >= part[1].stop:
            return None
        # Wide spots are subsampled: 160 points across give the moments far better than to a pixel.
        stride = max(1, max(part[0].stop - part[0].start, part[1].stop - part[1].start) // 160)
        if stride > 1:
            part = slice(part[0].start, part[0].stop, stride), slice(part[1].start, part[1].stop, stride)
        lit = place.inside(part, x, y, (xx, xy, yy), _REACH)
        reached = np.count_nonzero(lit)
        lit &= gated[part]
        if np.count_nonzero(lit) < _EMPTY * reached:
            # The aperture ran away over neighbours, which are other spots.
            found, part, lit = first
            break
        after = place.moments(lit, part)
        if after is None:
            break
        step = max(abs(after[0] - x), abs(after[1] - y))
        growth = abs(math.sqrt(after[2][0] + after[2][2]) - math.sqrt(xx + yy))
        found = after
        if step < 0.02 and growth < 0.02:
            break
    x, y, covariance, light = found
    stride = part[0].step or 1
    area = int(np.count_nonzero(lit)) * stride**2
    return Spot(x, y, covariance, area, place.at_edge(lit, part, stride), light)


def search(
    maps: Maps | None,
    image: NDArray[Any],
    full_scale: float,
    min_snr: float,
    max_count: int,
    largest: float = math.inf,
) -> list[Spot]:
    """The spots of a frame in its `maps`, brightest first, without those wider than `largest` pixels."""
    if maps is None:
        return []
    masks = _Masks(maps, min_snr)
    places = [_Place(maps, masks, number, min_snr) for number in range(len(maps.parts))]
    queue: list[tuple[float, int, int, int, int]] = []

    def enqueue(number: int, label: int) -> None:
        highest = places[number].highest(label)
        if highest is not None:
            heapq.heappush(queue, (-highest[0], number, label, *highest[1:]))

    for label, (*_, number) in enumerate(masks.regions, 1):
        enqueue(number, label)
    found: list[Spot] = []
    # A smear or a halo breaks into pieces; they are dim and come last, so their number is limited.
    for _ in range(4 * max_count):
        if not queue or len(found) >= max_count:
            break
        _, number, label, row, column = heapq.heappop(queue)
        place = places[number]
        if place.seeds[row, column]:
            spot = _measure(place, row, column)
            if spot is not None and spot.diameter > largest:
                # A wall's surroundings belong to no spot.
                window, mine = place.ground(label)
                place.claim(window, mine)
                continue
            height, width = place.lit.shape
            if spot is not None and 0 <= round(spot.x) < width and 0 <= round(spot.y) < height:
                shade = spot.diameter > (_BROAD_AT_EDGE if spot.edge else _BROAD) and _shade(place, spot)
                whole = _taken(place, spot, image, full_scale)
                if whole is not None and not shade:
                    found.append(whole)
            near = place.window(column, row, 2, 2)
            place.claim(near, np.ones(place.seeds[near].shape, bool))
        enqueue(number, label)
    return sorted(_joined(found), key=lambda spot: -spot.peak)


def _shade(place: _Place, spot: Spot) -> bool:
    """Return whether a broad spot varies so slowly that it may be the rest of the background, which no surface fits
    exactly."""
    part = place.part
    reach = (_CLAIM * math.sqrt(spot.covariance[n]) for n in (0, 2))
    window = place.window(spot.x, spot.y, *reach)
    # Without what belongs to other spots; at an eighth of the size, for what is looked for is wider.
    size = tuple(max(1, (one.stop - one.start) // _SHADE_STEP) for one in window[::-1])
    free = place.free[window].astype(np.float32)
    both = np.asarray(place.excess[window] * free), free
    small = [cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in both]
    if min(size) < 2 or not small[1].any():
        return False
    # Mirrored about its end a slope goes straight on: there it is no more bent than elsewhere.
    beyond = math.ceil(3 * _SHADE / _SHADE_STEP)
    light = np.pad(small[0], beyond, mode="reflect", reflect_type="odd")
    share = np.pad(small[1], beyond, mode="reflect")
    one, other = (
        cv2.GaussianBlur(light, (0, 0), width) / np.maximum(cv2.GaussianBlur(share, (0, 0), width), 0.05)
        for width in (_WIDE / _SHADE_STEP, _SHADE / _SHADE_STEP)
    )
    rest = np.abs(one - other)[beyond:-beyond, beyond:-beyond] * (small[1] > 0.5)
    rim = [int(_SHADE / _SHADE_STEP) if n > 4 * _SHADE / _SHADE_STEP else 0 for n in rest.shape]
    varies = float(rest[rim[0] : rest.shape[0] - rim[0], rim[1] : rest.shape[1] - rim[1]].max())
    row, column = ((first + int(at)) // _REDUCE for first, at in ((part.top, spot.y), (part.left, spot.x)))
    height, width = place.wide_noise.shape
    noise = float(place.wide_noise[min(row, height - 1), min(column, width - 1)])
    return varies < _SHADE_NOISE * noise


def _taken(place: _Place, spot: Spot, image: NDArray[Any], full_scale: float) -> Spot | None:
    """Claim a spot's area; return the spot, in the frame's coordinates, or None where its light is too little."""
    part = place.part
    xx, xy, yy = spot.covariance
    own = xx + FINE**2, xy, yy + FINE**2
    window = place.window(spot.x, spot.y, _CLAIM * math.sqrt(own[0]), _CLAIM * math.sqrt(own[2]))
    inside = place.inside(window, spot.x, spot.y, own, _CLAIM)
    new = inside & place.free[window]
    snr, peak = (max(0.0, cv2.minMaxLoc(one[window], new.view(np.uint8))[1]) for one in (place.snr, place.fine))
    rows, columns = (
        slice(one.start + first, one.stop + first) for one, first in zip(window, (part.top, part.left), strict=True)
    )
    own_part = image[rows, columns]
    saturated = int(np.count_nonzero((own_part >= full_scale) & new)) if own_part.max() >= full_scale else 0
    place.claim(window, inside)
    # The wide smoothing carries a bright spot's light beyond its area; alone it is no sign of another spot there.
    carried = _CARRIED * _WIDE
    window = place.window(spot.x, spot.y, _CLAIM * math.sqrt(own[0]) + carried, _CLAIM * math.sqrt(own[2]) + carried)
    reach = _CLAIM + carried / math.sqrt(max(own[0], own[2]))
    place.seeds[window] &= place.sharp[window] | ~place.inside(window, spot.x, spot.y, own, reach)
    if snr < place.min_snr or spot.area < 4:
        return None
    return replace(spot, x=spot.x + part.left, y=spot.y + part.top, snr=snr, peak=peak, saturated=saturated)


def _joined(spots: list[Spot]) -> list[Spot]:
    """Join the fringes of one spot: neighbours of like height, nearer to each other than their diameter."""
    rest = sorted(spots, key=lambda spot: -spot.peak)
    done: list[Spot] = []
    while rest and _any_belong(rest):
        one = rest.pop(0)
        other = next((other for other in rest if _belongs(other, one)), None)
        if other is None:
            done.append(one)
        else:
            rest.remove(other)
            # The sum may reach others that its parts did not reach.
            rest.insert(0, _sum(one, other))
    return done + rest


def _any_belong(spots: list[Spot]) -> bool:
    """Return whether any of the spots belongs to one before it."""
    x, y, peak, diameter = np.array([(one.x, one.y, one.peak, one.diameter) for one in spots]).T
    near = np.hypot(x[:, None] - x, y[:, None] - y) < 0.5 * (diameter[:, None] + diameter)
    return bool((np.tril(near, -1) & (peak[:, None] > _LIKE * peak)).any())


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
