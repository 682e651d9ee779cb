"""Registration of the dark frame to the lit one: displacement and brightness change of each pixel.

A probe in the hand moves between two exposures: everything shifts by tens of pixels, near things more than far ones,
and people walk. A common shift comes first (phase correlation), then a dense optical flow (DIS: Kroeger et al., ECCV
2016), smoothed so that it cannot follow a spot a few pixels wide: a retro-reflection has no partner in the dark frame.
Where the two then match poorly, the probe may have turned or stepped forward: a common turn and scale, from matched
corners (ORB: Rublee et al., ICCV 2011), is tried in place of the shift. One file of a little over 400 lines, because
all steps share the frames' sizes and patches.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["MATCHED", "Registered", "common_shift", "common_turn", "evened", "local_mean", "register"]

Array = NDArray[np.float32]

# Longest side at which the flow is sought: above it costs time and gains nothing, for it is smoothed anyway. Frames are
# halved until they fit, which is exact and fast.
_FLOW_SIDE, _FINE_SIDE = 500, 1000
_SHIFT_SIDE = 512
# Of the correction: the standard deviation of its window in pixels, and what keeps it small where frames show little.
_AROUND, _EVEN, _LEAST_POWER = 8.0, 0.03, 0.2
# The flow bends any frame a little onto another, so that details of unrelated frames correlate too, by 0.1 to 0.6, and
# the more the rougher it is: what a tenth of its gradients exceeds, in pixels a pixel. Of 247 unrelated pairs, drawn
# and real, all but one correlated by less than 0.1 above that, of 190 pairs of one scene one, in heavy noise.
_SAME_SCENE = 0.1
# Correlation of details below which a turn and a scale are tried, and how many matched corners must agree on them,
# within so many pixels: of 137 pairs of unrelated photographs 10 do at most.
_POOR, _AGREED, _WITHIN = 0.9, 20, 4.0
_CORNERS = 800
# Spread of details over that of single pixels, up to which a frame shows noise alone: white noise has 0.16.
_BLANK = 0.21
# Radius, in pixels, over which gain and offset of the two exposures are matched.
MATCHED = 25.0
# Largest flow, in pixels, that may be left.
_STILL = 0.05
# Gains of 0.5 to 2 in bytes.
_UNIT = 127
_PRESET = cv2.DISOPTICAL_FLOW_PRESET_FAST


@dataclass(frozen=True)
class Registered:
    """A dark frame registered to a lit one.

    The frame itself is resampled only where it is asked for: a search needs it whole at half size alone.

    Parameters
    ----------
    taken
        [H, W] the dark frame as it was taken.
    grid
        [h, w, 4] on a grid that covers the frame evenly: the flow in x and y, in pixels of the frame; and the gain and
        the offset, in grey levels, from the dark frame's brightness to the lit one's.
    correlation
        Of the details of both, from -1 to 1.
    """

    taken: NDArray
    grid: Array
    correlation: float

    @property
    def coarse(self) -> Array:
        """[h, w, 2] the flow, in pixels of the frame, on a grid that covers the frame evenly."""
        return self.grid[..., :2]

    @property
    def flow(self) -> Array:
        """[H, W, 2] how far from each place of the lit frame its partner lies in the dark one, x and y, in pixels."""
        height, width = self.taken.shape
        return np.asarray(_resized(self.coarse, (width, height), cv2.INTER_LINEAR), dtype=np.float32)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[H, W] where the dark frame shows the place at all."""
        height, width = self.taken.shape
        from_x, from_y = _partners(self.coarse, (width, height))
        return (from_x >= 0) & (from_y >= 0) & (from_x <= width - 1) & (from_y <= height - 1)

    @functools.cached_property
    def still(self) -> bool:
        """Whether nothing moved, so that the dark frame need not be resampled."""
        return bool(np.abs(self.coarse).max() < _STILL)

    @functools.cached_property
    def dark(self) -> NDArray:
        """[H, W] the dark frame at the lit frame's places and in its brightness, of the lit frame's type."""
        return self.moved(self.taken)[0]

    def moved(self, *images: NDArray) -> list[NDArray]:
        """The dark frame, or smaller copies of it of one size [h, w], at the lit frame's places and brightness."""
        size = images[0].shape[1], images[0].shape[0]
        if not self.still:
            over = np.array(size) / self.taken.shape[::-1]
            maps = _partners(self.coarse * over.astype(np.float32), size)
            images = tuple(_taken(one, *maps) for one in images)
        gain, offset = (np.ascontiguousarray(self.grid[..., n]) for n in (2, 3))
        # Whole numbers stay whole: an eighth of the time, and a rounded level is less than the frames' own noise.
        if whole := self.taken.dtype == np.uint8:
            gain = np.round(_UNIT * gain).astype(np.uint8)
            offset = np.clip(np.round(offset + 128), 0, 255).astype(np.uint8)
        wide, base = (_resized(one, size, cv2.INTER_LINEAR) for one in (gain, offset))
        even = (cv2.multiply(one, wide, scale=1 / _UNIT if whole else 1) for one in images)
        return [np.asarray(cv2.addWeighted(one, 1, base, 1, -128) if whole else cv2.add(one, base)) for one in even]

    def patches(self, image: NDArray, x: NDArray[np.int64], y: NDArray[np.int64], half: int) -> Array:
        """Squares of what `moved` makes of an image about places of the lit one, [N, 2·half + 1, 2·half + 1].

        Outside, the image's edges are continued.
        """
        (height, width), (rows, columns) = image.shape, self.grid.shape[:2]
        # The flow is smooth: every few pixels it is looked up, and straight lines are drawn between.
        knots = np.linspace(-half, half, 2 + half // 2, dtype=np.float32)
        step = np.arange(-half, half + 1, dtype=np.float32)
        on_x, on_y = (
            ((at[:, None] + knots + 0.5) * (n / of) - 0.5).astype(np.float32)
            for at, n, of in ((x, columns, width), (y, rows, height))
        )
        # A row of the map for each patch, as the sides of a map are limited.
        rows_x, rows_y = (one.reshape(len(x), -1) for one in np.broadcast_arrays(on_x[:, None], on_y[:, :, None]))
        flow = _taken(self.coarse, rows_x, rows_y).reshape(len(x), len(knots), len(knots), 2)
        flow = flow * np.float32(width / self.taken.shape[1])
        between = np.maximum(1 - np.abs(step[:, None] - knots) / (knots[1] - knots[0]), 0).astype(np.float32)
        from_x, from_y = (between @ flow[..., n] @ between.T for n in (0, 1))
        from_x += x[:, None, None].astype(np.float32) + step
        from_y += y[:, None, None].astype(np.float32) + step[:, None]
        found = _taken(image, from_x.reshape(len(x), -1), from_y.reshape(len(x), -1)).reshape(from_x.shape)
        # The light varies over more than a patch.
        middle = slice(len(knots) // 2, len(knots) // 2 + 1)
        gain, offset = _taken(self.grid[..., 2:], on_x[:, middle], on_y[:, middle])[:, 0].T[:, :, None, None]
        return np.asarray(found * gain + offset, dtype=np.float32)


def register(lit: NDArray, dark: NDArray) -> Registered:
    """Register a dark frame to a lit one.

    Parameters
    ----------
    lit, dark
        [H, W] grey levels from 0 to 255, both uint8 or both float32.

    Returns
    -------
    Registered

    Raises
    ------
    InputError
        When the two differ in size, or show different scenes.
    """
    if lit.shape != dark.shape:
        sizes = " and ".join(f"{a.shape[1]} x {a.shape[0]}" for a in (lit, dark))
        raise InputError(f"lit and dark have {sizes} pixels", where="dark", remedy="give two frames of one camera")
    height, width = lit.shape
    fine, size = (_fitted(width, height, side) for side in (_FINE_SIDE, _FLOW_SIDE))
    small = [np.asarray(_resized(g, fine), dtype=np.float32) for g in (lit, dark)]
    smaller = [_resized(g, size) for g in small]
    even = [_even(_blurred(g, 1.0)) for g in smaller]
    found = _matched(small, smaller, even, common_shift(*even), width / fine[0])
    if found.correlation < _POOR and (turned := common_turn(*even)) is not None:
        found = max(found, _matched(small, smaller, even, turned, width / fine[0]), key=lambda one: one.correlation)
    if found.correlation < found.rough + _SAME_SCENE and not any(_blank(g) for g in smaller):
        what = f"cannot be registered to the lit frame: their details correlate by {found.correlation:.2f}"
        remedy = "give a dark frame of the same scene, taken within a second, moved by less than a third of the frame"
        raise InputError(what, where="dark", remedy=remedy)
    coarse = (found.flow * (np.array([width, height]) / fine)).astype(np.float32)
    light = [_resized(one, coarse.shape[1::-1]) for one in found.light]
    return Registered(dark, np.dstack([coarse, *light]), found.correlation)


@dataclass(frozen=True)
class _Match:
    """A flow [h, w, 2] in pixels of the fine copies, gain and offset [H, W] each, and how well the frames match.

    `rough` is the roughness of what the flow adds to the common motion that it started from, in pixels a pixel.
    """

    flow: Array
    light: list[NDArray]
    correlation: float
    rough: float


def _matched(
    small: list[Array], smaller: list[NDArray], even: list[NDArray[np.uint8]], start: Array, over: float
) -> _Match:
    """The flow between fine and coarse copies of two frames that begins with a common motion, a matrix [2, 3].

    `over` is how many pixels of the frame one of the fine copies has.
    """
    fine, size = (np.array(one[0].shape[1::-1]) for one in (small, smaller))
    flow, rough = _flow(even[0], even[1], start)
    flow = (flow * (fine / size)).astype(np.float32)
    shape = int(fine[0]), int(fine[1])
    moved = _taken(small[1], *_partners(flow, shape))
    light = [_resized(one, shape, cv2.INTER_LINEAR) for one in _light(small[0], moved, over)]
    flow = _refined(flow, small[0], light[0] * moved + light[1])
    from_x, from_y = _partners((flow * (size / fine)).astype(np.float32), (int(size[0]), int(size[1])))
    seen = (from_x >= 0) & (from_y >= 0) & (from_x <= size[0] - 1) & (from_y <= size[1] - 1)
    a, b = (_details(g)[seen] for g in (smaller[0], _taken(smaller[1], from_x, from_y)))
    return _Match(flow, light, _correlation(a, b) if seen.sum() > 100 else 0.0, rough)


def local_mean(image: NDArray, radius: float = MATCHED) -> Array:
    """Mean about each of a grid of places that covers an image [H, W] evenly: a Gaussian of that standard deviation."""
    height, width = image.shape
    step = 2 ** max(0, int(math.log2(radius / 3)))
    size = max(1, width // step), max(1, height // step)
    return _blurred(_resized(image, size).astype(np.float32), radius / step)


def _partners(flow: Array, size: tuple[int, int]) -> tuple[Array, Array]:
    """Where in the dark frame each pixel lies, x and y, [H, W] each, by a flow on any grid."""
    rows, columns = flow.shape[:2]
    over = size[0] / columns, size[1] / rows
    places = np.meshgrid(*((np.arange(n) + 0.5) * k - 0.5 for n, k in zip((columns, rows), over, strict=True)))
    from_x, from_y = (
        np.asarray(_resized((place + flow[..., n]).astype(np.float32), size, cv2.INTER_LINEAR))
        for n, place in enumerate(places)
    )
    # Between the outermost places of the grid and the frame's edge the same flow goes on.
    for map_, rim in ((from_x, math.ceil(over[0] / 2)), (from_y.T, math.ceil(over[1] / 2))):
        away = np.arange(rim, 0, -1, dtype=np.float32)
        map_[:, :rim] = map_[:, rim, None] - away
        map_[:, -rim:] = map_[:, -rim - 1, None] + away[::-1]
    return from_x, from_y


def _taken(image: NDArray, from_x: Array, from_y: Array) -> NDArray:
    return np.asarray(cv2.remap(image, from_x, from_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _correlation(a: Array, b: Array) -> float:
    a, b = a - a.mean(), b - b.mean()
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / math.sqrt(power) if power > 0 else 0.0


def _flow(lit: NDArray[np.uint8], dark: NDArray[np.uint8], start: Array) -> tuple[Array, float]:
    """Where places of `lit` lie in `dark`, [H / 2, W / 2, 2], in pixels of the two; and how rough that is.

    `start` [2, 3] takes places of one to the other's nearly; the roughness is that of the rest.
    """
    size = lit.shape[1], lit.shape[0]
    found = cv2.DISOpticalFlow.create(_PRESET).calc(lit, _by(start, dark), None)  # pyright: ignore
    # The preset seeks it on every fourth pixel: half the grid holds it all.
    half = cv2.split(_resized(found, (max(8, size[0] // 2), max(8, size[1] // 2))))
    rest = np.dstack([cv2.GaussianBlur(cv2.medianBlur(one, 3), (0, 0), 2) for one in half]).astype(np.float32)
    rough = _roughness(rest) * rest.shape[1] / size[0]
    columns, rows = (
        (np.arange(n, dtype=np.float32) + 0.5) * (whole / n) - 0.5
        for n, whole in zip(rest.shape[1::-1], size, strict=True)
    )
    x, y = rest[..., 0] + columns, rest[..., 1] + rows[:, None]
    on_x, on_y = (a * x + b * y + c for a, b, c in start)
    return np.dstack([on_x - columns, on_y - rows[:, None]]).astype(np.float32), rough


def _by(motion: Array, image: NDArray) -> NDArray:
    """The image at the places to which a motion [2, 3] takes its own."""
    size = image.shape[1], image.shape[0]
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(image, motion, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _refined(flow: Array, lit: Array, moved: Array) -> Array:
    """The flow [h, w, 2] between two frames [H, W], corrected by what is left between one and the other, moved by it.

    One step of least squares about each place (Lucas and Kanade 1981). A retro-reflection has no partner: no difference
    counts more than a pixel's motion explains.
    """
    slopes = [cv2.Sobel(moved, cv2.CV_32F, 1 - n, n, scale=1 / 8) for n in (0, 1)]
    limit = np.abs(slopes[0]) + np.abs(slopes[1]) + 1
    left = np.clip(moved - lit, -limit, limit)
    xx, xy, yy, x, y = (
        local_mean(np.asarray(cv2.multiply(a, b)), _AROUND)
        for a, b in [(slopes[0], slopes[0]), slopes, (slopes[1], slopes[1]), *((one, left) for one in slopes)]
    )
    # Along an edge nothing is known: there a little power holds the flow.
    held = _EVEN * (xx + yy) + _LEAST_POWER
    xx, yy = xx + held, yy + held
    power = xx * yy - xy * xy
    step = np.dstack([(xy * y - yy * x) / power, (xy * x - xx * y) / power])
    return flow + _resized(np.clip(step, -1, 1), (flow.shape[1], flow.shape[0]), cv2.INTER_LINEAR)


def _roughness(flow: Array) -> float:
    """90th percentile of the flow's gradient along x, in pixels a pixel."""
    slopes = [cv2.Sobel(np.ascontiguousarray(flow[..., n]), cv2.CV_32F, 1, 0, scale=1 / 8) for n in (0, 1)]
    return float(np.quantile(np.hypot(*(slope[::2, ::2] for slope in slopes)), 0.9))


def common_turn(lit: NDArray[np.uint8], dark: NDArray[np.uint8]) -> Array | None:
    """The common turn, scale and shift of two even frames [H, W], a matrix [2, 3] that takes places of the first to the
    second; None where too few corners of the two agree on one.
    """
    finder = cv2.ORB.create(_CORNERS, fastThreshold=8)
    (of_lit, told), (of_dark, others) = (finder.detectAndCompute(one, None) for one in (lit, dark))  # pyright: ignore
    if min(len(of_lit), len(of_dark)) < _AGREED:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(told, others)
    a = np.array([of_lit[one.queryIdx].pt for one in pairs], np.float32).reshape(-1, 2)
    b = np.array([of_dark[one.trainIdx].pt for one in pairs], np.float32).reshape(-1, 2)
    if len(pairs) < _AGREED:
        return None
    motion, agreed = cv2.estimateAffinePartial2D(a, b, ransacReprojThreshold=_WITHIN)
    return None if motion is None or int(agreed.sum()) < _AGREED else motion.astype(np.float32)


def common_shift(lit: NDArray[np.uint8], dark: NDArray[np.uint8]) -> Array:
    """The shift of most of a picture between two even frames [H, W], a matrix [2, 3] that takes places of the first to
    the second; no shift where there is no clear one that brings the two closer.
    """
    step = max(1, math.ceil(max(lit.shape) / _SHIFT_SIDE))
    size = lit.shape[1] // step, lit.shape[0] // step
    # phaseCorrelate may overwrite its inputs: copies are fresh here.
    a, b = (_resized(g, size).astype(np.float32) - 128 for g in (lit, dark))
    (x, y), response = cv2.phaseCorrelate(a, b, _window(size))
    x, y = x * step, y * step
    none = np.eye(2, 3, dtype=np.float32)
    if not (np.isfinite([x, y]).all() and response > 0.05 and np.hypot(x, y) > 2):
        return none
    shift = np.array([[1, 0, x], [0, 1, y]], np.float32)
    closer = cv2.absdiff(_by(shift, dark), lit).mean() < cv2.absdiff(dark, lit).mean()
    return shift if closer else none


@functools.cache
def _window(size: tuple[int, int]) -> NDArray:
    return np.asarray(cv2.createHanningWindow(size, cv2.CV_32F))


def _blurred(image: NDArray, sigma: float) -> Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def _far_blurred(image: Array, sigma: float) -> Array:
    """Blurred by many pixels, [H, W]: on a coarser grid, where that takes few."""
    return _resized(local_mean(image, sigma), (image.shape[1], image.shape[0]), cv2.INTER_LINEAR)


def evened(image: NDArray) -> NDArray[np.uint8]:
    """A small copy of a frame [H, W] of grey levels, halved to 500 pixels or less, of even mean and contrast."""
    small = _resized(image, _fitted(image.shape[1], image.shape[0], _FLOW_SIDE))
    return _even(_blurred(small.astype(np.float32), 1.0))


def _fitted(width: int, height: int, side: int) -> tuple[int, int]:
    """A frame's size, halved until its longest side fits."""
    share = 0.5 ** max(0, math.ceil(math.log2(max(height, width) / side)))
    return max(16, round(width * share)), max(16, round(height * share))


def _resized(image: NDArray, size: tuple[int, int], how: int = cv2.INTER_AREA) -> NDArray:
    # Halving is several times faster than one step to a small size.
    while image.shape[0] >= 2 * size[1] and image.shape[1] >= 2 * size[0]:
        image = np.asarray(cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA))
    return image if image.shape[1::-1] == size else np.asarray(cv2.resize(image, size, interpolation=how))


def _even(image: Array) -> NDArray[np.uint8]:
    """The frame with equal mean and contrast everywhere, so that light and shadow do not pass for motion."""
    mean = _far_blurred(image, 12)
    apart = image - mean
    scale = 48 / (np.sqrt(local_mean(np.square(apart), 12)) + 4)
    apart *= _resized(scale, (image.shape[1], image.shape[0]), cv2.INTER_LINEAR)
    return np.clip(128 + apart, 0, 255).astype(np.uint8)


def _details(image: Array) -> Array:
    band = _blurred(image, 2) - _far_blurred(image, 8)
    return np.asarray(band / np.sqrt(_far_blurred(np.square(band), 16) + 0.5), dtype=np.float32)


def _blank(image: Array) -> bool:
    """Whether a frame shows nothing but noise, as a bare wall or a dark room: it is subtracted without registration."""
    band = np.median(np.abs(_blurred(image, 2) - _far_blurred(image, 8)))
    return bool(band <= _BLANK * np.median(np.abs(image - _blurred(image, 1))))


def _light(lit: Array, dark: Array, over: float) -> tuple[Array, Array]:
    """Gain and offset that give the dark frame the local mean and contrast of the lit one: the laser lights walls too.

    Both are small copies of the frames, whose pixels are `over` of the frame's; the answers lie on a coarser grid.
    """
    step = max(1, int(MATCHED / 6))
    share = max(1.0, step / over)
    size = max(1, int(lit.shape[1] / share)), max(1, int(lit.shape[0] / share))
    small = [_resized(g, size).astype(np.float32) for g in (lit, dark)]
    of_lit, of_dark, product, square = (
        local_mean(one, MATCHED / max(step, over)) for one in (*small, small[0] * small[1], small[1] * small[1])
    )
    gain = np.clip((product - of_lit * of_dark + 25) / (square - of_dark**2 + 25), 0.5, 2)
    return gain.astype(np.float32), (of_lit - gain * of_dark).astype(np.float32)
