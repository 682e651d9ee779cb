"""The dark frame, brought onto the lit one: where each pixel went, and what its brightness became.

A probe in the hand moves between two exposures: everything shifts by tens of pixels, near things more than far ones,
and people walk. A common shift comes first (phase correlation), then a dense optical flow (DIS: Kroeger et al., ECCV
2016), smoothed so that it cannot follow a spot a few pixels wide: a retro-reflection has no partner in the dark frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["Registered", "local_mean", "register"]

Array = NDArray[np.float32]

# Longest side at which the flow is sought: above it costs time and gains nothing, for it is smoothed anyway. Frames are
# halved until they fit, which is exact and fast.
_FLOW_SIDE = 1000
_SHIFT_SIDE = 512
# The details of two frames of one scene correlate by 0.6 to 0.99 after registration, in heavy noise by 0.3 to 0.46;
# those of unrelated frames by 0.2 to 0.4, for the flow bends anything a little. It then is rough: a tenth of its
# gradients exceeds 0.24 to 0.7 pixels a pixel, in frames of one scene 0.01 to 0.3, the most in heavy noise.
_SAME_SCENE, _ROUGH = 0.5, 0.4
_UNLIKE, _BENT = 0.35, 0.23
# Radius, in pixels, over which gain and offset of the two exposures are matched.
_MATCHED = 25.0
# Largest flow, in pixels, that may be left.
_STILL = 0.05
# Gains of 0.5 to 2 in bytes.
_UNIT = 127
_PRESET = cv2.DISOPTICAL_FLOW_PRESET_FAST


@dataclass(frozen=True)
class Registered:
    """A dark frame registered to a lit one.

    Parameters
    ----------
    dark
        [H, W] the dark frame at the lit frame's places and in its brightness, of the lit frame's type.
    coarse
        [h, w, 2] the flow, in pixels of the frame, on a grid that covers the frame evenly.
    correlation
        Of the details of both, from -1 to 1.
    """

    dark: NDArray
    coarse: Array
    correlation: float

    @property
    def flow(self) -> Array:
        """[H, W, 2] how far from each place of the lit frame its partner lies in the dark one, x and y, in pixels."""
        height, width = self.dark.shape
        return np.asarray(_resized(self.coarse, (width, height), cv2.INTER_LINEAR), dtype=np.float32)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """[H, W] where the dark frame shows the place at all."""
        height, width = self.dark.shape
        from_x, from_y = _partners(self.coarse, (width, height))
        return (from_x >= 0) & (from_y >= 0) & (from_x <= width - 1) & (from_y <= height - 1)


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
    share = 0.5 ** max(0, math.ceil(math.log2(max(height, width) / _FLOW_SIDE)))
    size = max(16, round(width * share)), max(16, round(height * share))
    small = [np.asarray(_resized(g, size), dtype=np.float32) for g in (lit, dark)]
    flow = _flow(*small)
    from_x, from_y = _partners(flow, size)
    seen = (from_x >= 0) & (from_y >= 0) & (from_x <= size[0] - 1) & (from_y <= size[1] - 1)
    a, b = (_details(g)[seen] for g in (small[0], _taken(small[1], from_x, from_y)))
    correlation = _correlation(a, b) if seen.sum() > 100 else 0.0
    flat = min(float(np.ptp(g)) for g in small) == 0
    rough = _roughness(flow)
    other = (correlation < _SAME_SCENE and rough > _ROUGH) or (correlation < _UNLIKE and rough > _BENT)
    if other and not flat:
        what = f"cannot be registered to the lit frame: their details correlate by {correlation:.2f}"
        remedy = "give a dark frame of the same scene, taken within a second, moved by less than a third of the frame"
        raise InputError(what, where="dark", remedy=remedy)
    coarse = flow * np.array([width / size[0], height / size[1]], np.float32)
    # A probe that stands still needs no resampling, which would cost as much as all the rest.
    moved = dark if np.abs(coarse).max() < _STILL else _taken(dark, *_partners(coarse, (width, height)))
    return Registered(_matched(lit, moved), coarse, correlation)


def local_mean(image: NDArray, radius: float = _MATCHED) -> Array:
    """Mean about each of a grid of places that covers an image [H, W] evenly: a Gaussian of that standard deviation."""
    height, width = image.shape
    step = max(1, int(radius / 3))
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


def _flow(lit: Array, dark: Array) -> Array:
    """Where each place of `lit` lies in `dark`, [H, W, 2], in pixels."""
    small = [_even(_blurred(g, 1.0)) for g in (lit, dark)]
    size = lit.shape[1], lit.shape[0]
    start = _shift(*small)
    moved = cv2.warpAffine(
        small[1],
        np.array([[1, 0, start[0]], [0, 1, start[1]]], np.float32),
        size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    found = cv2.DISOpticalFlow.create(_PRESET).calc(small[0], moved, None)  # pyright: ignore
    parts = [cv2.GaussianBlur(cv2.medianBlur(np.ascontiguousarray(found[..., n]), 5), (0, 0), 4) for n in (0, 1)]
    return np.dstack([part + start[n] for n, part in enumerate(parts)]).astype(np.float32)


def _roughness(flow: Array) -> float:
    """What a tenth of the flow's gradients along x exceeds, in pixels a pixel."""
    slopes = [cv2.Sobel(np.ascontiguousarray(flow[..., n]), cv2.CV_32F, 1, 0, scale=1 / 8) for n in (0, 1)]
    return float(np.quantile(np.hypot(*(slope[::2, ::2] for slope in slopes)), 0.9))


def _shift(lit: NDArray[np.uint8], dark: NDArray[np.uint8]) -> tuple[float, float]:
    """The common shift in x and y where there is a clear one that brings the two closer, else none."""
    step = max(1, round(max(lit.shape) / _SHIFT_SIDE))
    size = lit.shape[1] // step, lit.shape[0] // step
    # phaseCorrelate may overwrite its inputs: copies are fresh here.
    a, b = (_resized(g, size).astype(np.float32) - 128 for g in (lit, dark))
    (x, y), response = cv2.phaseCorrelate(a, b, cv2.createHanningWindow(size, cv2.CV_32F))
    x, y = x * step, y * step
    if not (np.isfinite([x, y]).all() and response > 0.05 and np.hypot(x, y) > 2):
        return 0.0, 0.0
    moved = cv2.warpAffine(
        dark,
        np.array([[1, 0, x], [0, 1, y]], np.float32),
        lit.shape[::-1],
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    closer = cv2.absdiff(moved, lit).mean() < cv2.absdiff(dark, lit).mean()
    return (x, y) if closer else (0.0, 0.0)


def _blurred(image: NDArray, sigma: float) -> Array:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)


def _far_blurred(image: Array, sigma: float) -> Array:
    """Blurred by many pixels, [H, W]: on a coarser grid, where that takes few."""
    return _resized(local_mean(image, sigma), (image.shape[1], image.shape[0]), cv2.INTER_LINEAR)


def _resized(image: NDArray, size: tuple[int, int], how: int = cv2.INTER_AREA) -> NDArray:
    # Halving is several times faster than one step to a small size.
    while image.shape[0] >= 2 * size[1] and image.shape[1] >= 2 * size[0]:
        image = np.asarray(cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA))
    return image if image.shape[1::-1] == size else np.asarray(cv2.resize(image, size, interpolation=how))


def _even(image: Array) -> NDArray[np.uint8]:
    """The frame with equal mean and contrast everywhere, so that light and shadow do not pass for motion."""
    mean = _far_blurred(image, 12)
    spread = np.sqrt(_far_blurred(np.square(image - mean), 12)) + 4
    return np.clip(128 + 48 * (image - mean) / spread, 0, 255).astype(np.uint8)


def _details(image: Array) -> Array:
    band = _blurred(image, 2) - _far_blurred(image, 8)
    return np.asarray(band / np.sqrt(_far_blurred(np.square(band), 16) + 0.5), dtype=np.float32)


def _matched(lit: NDArray, dark: NDArray) -> NDArray:
    """The dark frame with the local mean and contrast of the lit one: the laser lights walls too."""
    height, width = lit.shape
    step = max(1, int(_MATCHED / 6))
    small = [_resized(g, (max(1, width // step), max(1, height // step))).astype(np.float32) for g in (lit, dark)]

    def mean(image: Array) -> Array:
        return local_mean(image, _MATCHED / step)

    of_lit, of_dark = (mean(g) for g in small)
    shared, own = mean(small[0] * small[1]) - of_lit * of_dark, mean(small[1] * small[1]) - of_dark**2
    gain = np.clip((shared + 25) / (own + 25), 0.5, 2)
    # Whole numbers stay whole: an eighth of the time, and a rounded level is less than the frames' own noise.
    if whole := lit.dtype == np.uint8:
        gain = np.round(_UNIT * gain).astype(np.uint8)
    offset = of_lit - gain / (_UNIT if whole else 1) * of_dark
    if whole:
        offset = np.clip(np.round(offset + 128), 0, 255).astype(np.uint8)
    wide, base = (_resized(one, (width, height), cv2.INTER_LINEAR) for one in (gain, offset))
    even = cv2.multiply(dark, wide, scale=1 / _UNIT if whole else 1)
    return np.asarray(cv2.addWeighted(even, 1, base, 1, -128) if whole else cv2.add(even, base))
