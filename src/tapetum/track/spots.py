"""Light above the background of a frame: maps of it at two scales where there may be any, and the spots in them.

One file of more than 400 lines: a spot is measured, claimed and joined to others on one set of masks.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.track.background import Ground, Picture, fit_ground, without_hot_pixels
from tapetum.track.screen import FINE, Part, blur, fine_in_windows, parts_of, reduced

__all__ = ["Maps", "Spot", "make_maps", "search"]

Window = tuple[slice, slice]
Covariance = tuple[float, float, float]  # xx, xy, yy

# Standard deviation of the wide smoothing, matched to a spot with fringes, and by how much a frame is reduced for it.
_WIDE, _REDUCE = 6.0, 4
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
    """A part of a frame of `shape` as the search sees it: pictures of the part, float32.

    `wide_noise` is that of the wide map, of the whole frame at a quarter of its size.
    """

    part: Part
    shape: tuple[int, int]
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


def make_maps(image: NDArray[Any], quantum: float, min_snr: float) -> list[Maps]:
    """Return maps of the parts of a frame that may hold spots above an SNR."""
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
        return []

    halo = math.ceil(3 * FINE) + 1
    close: list[tuple[Picture, Picture, Picture]] = []
    for part in parts:
        top, left = max(0, part.top - halo), max(0, part.left - halo)
        bottom, right = min(image.shape[0], part.bottom + halo), min(image.shape[1], part.right + halo)
        below, around = ground.at(slice(top, bottom), slice(left, right))
        above = cv2.subtract(image[top:bottom, left:right], below, dtype=cv2.CV_32F)
        above = without_hot_pixels(np.asarray(above, dtype=np.float32), around)
        inner = slice(part.top - top, part.bottom - top), slice(part.left - left, part.right - left)
        fine, own = blur(above, FINE)[inner], above[inner]
        close.append((own, fine, np.asarray(cv2.divide(fine, around[inner], scale=gain), dtype=np.float32)))
        # The means of the quarter know nothing of hot pixels, and clip too late.
        to = slice(part.top // _REDUCE, part.bottom // _REDUCE), slice(part.left // _REDUCE, part.right // _REDUCE)
        rows, columns = (_REDUCE * (one.stop - one.start) for one in to)
        size = columns // _REDUCE, rows // _REDUCE
        cut = np.asarray(cv2.min(own, 3 * around[inner]), dtype=np.float32)
        excess[to] = cv2.resize(own[:rows, :columns], size, interpolation=cv2.INTER_AREA)
        clipped[to] = cv2.resize(cut[:rows, :columns], size, interpolation=cv2.INTER_AREA)
    wide = blur(excess, sigma)
    wide_snr = np.asarray(cv2.divide(blur(clipped, sigma), least, scale=wide_gain), dtype=np.float32)
    wide_noise = np.asarray(least / np.float32(wide_gain), dtype=np.float32)
    return [
        Maps(
            part,
            image.shape,
            own,
            fine,
            fine_snr,
            _grown(wide, part),
            np.asarray(cv2.max(fine_snr, _grown(wide_snr, part)), np.float32),
            wide_noise,
        )
        for part, (own, fine, fine_snr) in zip(parts, close, strict=True)
    ]


def _grown(quarter: Picture, part: Part) -> Picture:
    """Return a part of a frame from its quarter, interpolated."""
    top, left = max(0, part.top // _REDUCE - 1), max(0, part.left // _REDUCE - 1)
    near = quarter[top : -(-part.bottom // _REDUCE) + 1, left : -(-part.right // _REDUCE) + 1]
    size = near.shape[1] * _REDUCE, near.shape[0] * _REDUCE
    whole = np.asarray(cv2.resize(near, size, interpolation=cv2.INTER_LINEAR), dtype=np.float32)
    rows, columns = part.bottom - _REDUCE * top, part.right - _REDUCE * left
    # A rest beyond the last whole quarter has its neighbour's value.
    down, across = max(0, rows - whole.shape[0]), max(0, columns - whole.shape[1])
    if down or across:
        whole = np.asarray(cv2.copyMakeBorder(whole, 0, down, 0, across, cv2.BORDER_REPLICATE), dtype=np.float32)
    return whole[part.top - _REDUCE * top : rows, part.left - _REDUCE * left : columns]


class _Place:
    """A part of a frame while it is searched; all coordinates count from the part's first pixel.

    Of its pixels, `free` belong to no spot yet, and of these `lit` and `lit_finely` are above half of the least SNR, of
    both scales and of the fine one; at `seeds` a spot may still be sought; `sharp` are above the least SNR of the fine
    scale. All are [h, w].
    """

    def __init__(self, maps: Maps, min_snr: float) -> None:
        self.maps, self.min_snr = maps, min_snr
        self.lit, self.lit_finely = maps.snr > 0.5 * min_snr, maps.fine_snr > 0.5 * min_snr
        self.seeds, self.sharp = maps.snr > min_snr, maps.fine_snr > min_snr
        self.free = np.ones(maps.snr.shape, bool)
        self.labels, self.stats = cv2.connectedComponentsWithStats(self.seeds.view(np.uint8), connectivity=8)[1:3]

    def ground(self, label: int) -> tuple[Window, NDArray[np.bool_]]:
        """Return the window around a labelled region, and where in there a spot of it may still be sought."""
        left, top, w, h = self.stats[label, :4].tolist()
        window = slice(top, top + h), slice(left, left + w)
        return window, (self.labels[window] == label) & self.seeds[window]

    def highest(self, label: int) -> tuple[float, int, int] | None:
        """Return height, row and column of the brightest pixel of a region where a spot may still be sought."""
        window, free = self.ground(label)
        if not free.any():
            return None
        heights = np.where(free, self.maps.fine[window], -np.inf)
        row, column = divmod(int(heights.argmax()), heights.shape[1])
        return float(heights[row, column]), window[0].start + row, window[1].start + column

    def window(self, x: float, y: float, reach_x: float, reach_y: float) -> Window:
        height, width = self.lit.shape
        return (
            slice(max(0, math.floor(y - reach_y)), min(height, math.ceil(y + reach_y) + 1)),
            slice(max(0, math.floor(x - reach_x)), min(width, math.ceil(x + reach_x) + 1)),
        )

    def inside(self, window: Window, x: float, y: float, covariance: Covariance, reach: float) -> NDArray[np.bool_]:
        """Return the pixels of a window within a spot's reach: an ellipse of so many standard deviations."""
        xx, xy, yy = covariance
        rows, columns = (np.arange(one.start, one.stop, one.step or 1, dtype=np.float64) for one in window)
        limit = reach**2 * max(xx * yy - xy * xy, 1e-3 * xx * yy)
        dx, dy = columns - x, (rows - y)[:, None]
        form = dy * (xx * dy) + (yy * dx * dx - limit)
        return np.asarray((form if xy == 0 else form - dy * (2 * xy * dx)) <= 0)

    def ends(self, lit: NDArray[np.bool_], window: Window, stride: int = 1) -> tuple[bool, bool]:
        """Return whether light reaches a window's border inside the part, and whether it reaches the frame's own."""
        rows, columns = window
        height, width = self.lit.shape
        part, (whole_height, whole_width) = self.maps.part, self.maps.shape
        sides = (
            (lit[0], rows.start < stride, part.top == 0),
            (lit[-1], rows.stop > height - stride, part.bottom == whole_height),
            (lit[:, 0], columns.start < stride, part.left == 0),
            (lit[:, -1], columns.stop > width - stride, part.right == whole_width),
        )
        within = any(not at_end and side.any() for side, at_end, _ in sides)
        return within, any(at_end and frames and side.any() for side, at_end, frames in sides)

    def claim(self, window: Window, inside: NDArray[np.bool_]) -> None:
        """No other spot is sought here, nor has light from here."""
        outside = ~inside
        for mask in (self.free, self.seeds, self.lit, self.lit_finely):
            mask[window] &= outside


def _moments(weight: Picture, window: Window) -> tuple[float, float, Covariance, float] | None:
    """Centroid, covariance and total of a weight [h, w] over a window; None where it is dark."""
    moments = cv2.moments(weight)
    total = moments["m00"]
    if total <= 0:
        return None
    x, y = moments["m10"] / total, moments["m01"] / total
    across, down = window[1].step or 1, window[0].step or 1
    # Add a pixel's own width, so that a spot of one pixel has one.
    # Noise below the background can make them negative.
    xx = max(moments["mu20"] / total * across**2, 0.0) + 1 / 12
    yy = max(moments["mu02"] / total * down**2, 0.0) + 1 / 12
    xy = moments["mu11"] / total * across * down
    return window[1].start + across * x, window[0].start + down * y, (xx, xy, yy), total


def _measure(place: _Place, row: int, column: int) -> Spot | None:
    """Measure the spot around a bright pixel: its moments, in an aperture that follows them."""
    maps = place.maps
    # Where fringes and lobes merge, a quarter of the height bounds the spot.
    level = np.float32(0.25 * maps.wide[row, column])
    # A small spot is bounded by the fine map: the wide one adds a halo of noise.
    gated = place.lit_finely if maps.fine_snr[row, column] >= place.min_snr else place.lit
    reach = 32.0
    while True:
        window = place.window(column, row, reach, reach)
        above = ((maps.wide[window] >= level) & place.lit[window]).view(np.uint8)
        at = row - window[0].start, column - window[1].start
        above[at] = 1
        labels = cv2.connectedComponents(above, connectivity=4)[1]
        region = labels == labels[at]
        if not place.ends(region, window)[0]:
            break
        reach *= 2
    found = _moments(maps.excess[window] * (region & gated[window]), window)
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
        part = slice(part[0].start, part[0].stop, stride), slice(part[1].start, part[1].stop, stride)
        lit = place.inside(part, x, y, (xx, xy, yy), _REACH)
        reached = np.count_nonzero(lit)
        lit &= gated[part]
        if np.count_nonzero(lit) < _EMPTY * reached:
            # The aperture ran away over neighbours, which are other spots.
            found, part, lit = first
            break
        after = _moments(maps.excess[part] * lit, part)
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
    return Spot(x, y, covariance, area, place.ends(lit, part, stride)[1], light)


def search(
    maps: list[Maps],
    image: NDArray[Any],
    full_scale: float,
    min_snr: float,
    max_count: int,
    largest: float = math.inf,
) -> list[Spot]:
    """The spots of a frame in its `maps`, brightest first, without those wider than `largest` pixels."""
    places = [_Place(one, min_snr) for one in maps]
    queue: list[tuple[float, int, int, int, int]] = []

    def enqueue(number: int, label: int) -> None:
        highest = places[number].highest(label)
        if highest is not None:
            heapq.heappush(queue, (-highest[0], number, label, *highest[1:]))

    for number, place in enumerate(places):
        for label in range(1, len(place.stats)):
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
    maps, part = place.maps, place.maps.part
    reach = (_CLAIM * math.sqrt(spot.covariance[n]) for n in (0, 2))
    window = place.window(spot.x, spot.y, *reach)
    # Without what belongs to other spots; at an eighth of the size, for what is looked for is wider.
    size = tuple(max(1, (one.stop - one.start) // _SHADE_STEP) for one in window[::-1])
    free = place.free[window].astype(np.float32)
    both = np.asarray(maps.excess[window] * free), free
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
    height, width = maps.wide_noise.shape
    noise = float(maps.wide_noise[min(row, height - 1), min(column, width - 1)])
    return varies < _SHADE_NOISE * noise


def _taken(place: _Place, spot: Spot, image: NDArray[Any], full_scale: float) -> Spot | None:
    """Claim a spot's area; return the spot, in the frame's coordinates, or None where its light is too little."""
    maps, part = place.maps, place.maps.part
    xx, xy, yy = spot.covariance
    own = xx + FINE**2, xy, yy + FINE**2
    window = place.window(spot.x, spot.y, _CLAIM * math.sqrt(own[0]), _CLAIM * math.sqrt(own[2]))
    inside = place.inside(window, spot.x, spot.y, own, _CLAIM)
    new = inside & place.free[window]
    snr = float(maps.snr[window].max(initial=0.0, where=new))
    peak = float(maps.fine[window].max(initial=0.0, where=new))
    rows, columns = (
        slice(one.start + first, one.stop + first) for one, first in zip(window, (part.top, part.left), strict=True)
    )
    saturated = int(np.count_nonzero((image[rows, columns] >= full_scale) & new))
    place.claim(window, inside)
    # The wide smoothing carries a bright spot's light beyond its area; alone it is no sign of another spot there.
    carried = _CARRIED * _WIDE
    window = place.window(spot.x, spot.y, _CLAIM * math.sqrt(own[0]) + carried, _CLAIM * math.sqrt(own[2]) + carried)
    reach = _CLAIM + carried / math.sqrt(max(own[0], own[2]))
    place.seeds[window] &= ~(place.inside(window, spot.x, spot.y, own, reach) & ~place.sharp[window])
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
