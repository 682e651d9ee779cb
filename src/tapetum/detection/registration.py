"""The dark frame, brought onto the lit one: where each pixel went, and what its brightness became.

A probe in the hand moves between two exposures: everything shifts by tens of pixels, near things more than far ones,
and people walk. A common shift comes first (phase correlation), then a dense optical flow (DIS: Kroeger et al., ECCV
2016), smoothed so that it cannot follow a spot a few pixels wide: a retro-reflection has no partner in the dark frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["Registered", "local_mean", "register"]

Array = NDArray[np.float32]

# Longest side at which the flow is sought: above it costs time and gains nothing, for it is smoothed anyway.
_FLOW_SIDE = 1024
_SHIFT_SIDE = 512
# The details of two frames of one scene correlate by 0.6 to 0.99 after registration, in heavy noise by 0.46; those of
# unrelated frames by 0.2 to 0.45, for the flow bends anything a little. It then is rough: a tenth of its gradients
# exceeds 0.47 pixels a pixel, in frames of one scene that correlate as little 0.41.
_SAME_SCENE = 0.5
_ROUGH = 0.45
# Radius, in pixels, over which gain and offset of the two exposures are matched.
_MATCHED = 25.0


@dataclass(frozen=True)
class Registered:
    """A dark frame registered to a lit one.

    Parameters
    ----------
    dark
        [H, W] the dark frame at the lit frame's places and in its brightness.
    flow
        [H, W, 2] how far from each place of the lit frame its partner lies in the dark one, x and y, in pixels.
    seen
        [H, W] where the dark frame shows the place at all.
    correlation
        Of the details of both, from -1 to 1.
    """

    dark: Array
    flow: Array
    seen: NDArray[np.bool_]
    correlation: float


def register(lit: Array, dark: Array) -> Registered:
    """Register a dark frame to a lit one.

    Parameters
    ----------
    lit, dark
        [H, W] grey levels as float32.

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
    flow = _flow(lit, dark)
    height, width = lit.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    from_x, from_y = x + flow[..., 0], y + flow[..., 1]
    seen = (from_x >= 0) & (from_y >= 0) & (from_x <= width - 1) & (from_y <= height - 1)
    moved = np.asarray(
        cv2.remap(dark, from_x, from_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.float32
    )
    a, b = (_details(g)[seen] for g in (lit, moved))
    correlation = float(np.corrcoef(a, b)[0, 1]) if seen.sum() > 100 and a.std() > 0 and b.std() > 0 else 0.0
    flat = min(float(np.ptp(lit)), float(np.ptp(dark))) == 0
    if correlation < _SAME_SCENE and _roughness(flow) > _ROUGH and not flat:
        what = f"cannot be registered to the lit frame: their details correlate by {correlation:.2f}"
        remedy = "give a dark frame of the same scene, taken within a second, moved by less than a third of the frame"
        raise InputError(what, where="dark", remedy=remedy)
    return Registered(_matched(lit, moved), flow, seen, correlation)


def local_mean(image: Array, radius: float = _MATCHED) -> Array:
    """Mean of an image [H, W] about each pixel: a Gaussian of the given standard deviation, on a coarser grid."""
    height, width = image.shape
    step = max(1, int(radius / 4))
    size = max(1, width // step), max(1, height // step)
    return _resized(np.asarray(cv2.GaussianBlur(_resized(image, size), (0, 0), radius / step)), (width, height), 1)


def _flow(lit: Array, dark: Array) -> Array:
    """Where each place of `lit` lies in `dark`, [H, W, 2], in pixels."""
    height, width = lit.shape
    share = min(1.0, _FLOW_SIDE / max(height, width))
    size = max(16, round(width * share)), max(16, round(height * share))
    small = [_even(_blurred(_resized(g, size), 1.0)) for g in (lit, dark)]
    start = _shift(*small)
    moved = cv2.warpAffine(
        small[1],
        np.array([[1, 0, start[0]], [0, 1, start[1]]], np.float32),
        size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    found = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(small[0], moved, None)  # pyright: ignore
    parts = [cv2.GaussianBlur(cv2.medianBlur(np.ascontiguousarray(found[..., n]), 5), (0, 0), 4) for n in (0, 1)]
    flow = np.dstack([part + start[n] for n, part in enumerate(parts)]).astype(np.float32)
    scale = np.array([width / size[0], height / size[1]], np.float32)
    return _resized(flow, (width, height), cv2.INTER_LINEAR) * scale


def _roughness(flow: Array) -> float:
    """What a tenth of the flow's gradients along x exceeds, in pixels a pixel."""
    slopes = [cv2.Sobel(np.ascontiguousarray(flow[..., n]), cv2.CV_32F, 1, 0, scale=1 / 8) for n in (0, 1)]
    return float(np.quantile(np.hypot(*slopes)[::2, ::2], 0.9))


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


def _resized(image: NDArray, size: tuple[int, int], how: int = cv2.INTER_AREA) -> NDArray:
    return image if image.shape[1::-1] == size else np.asarray(cv2.resize(image, size, interpolation=how))


def _even(image: Array) -> NDArray[np.uint8]:
    """The frame with equal mean and contrast everywhere, so that light and shadow do not pass for motion."""
    mean = cv2.GaussianBlur(image, (0, 0), 12)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((image - mean) ** 2, (0, 0), 12), 0)) + 4
    return np.clip(128 + 48 * (image - mean) / spread, 0, 255).astype(np.uint8)


def _details(image: Array) -> Array:
    band = _blurred(image, 2) - _blurred(image, 8)
    return np.asarray(band / np.sqrt(cv2.GaussianBlur(band * band, (0, 0), 16) + 0.5), dtype=np.float32)


def _matched(lit: Array, dark: Array) -> Array:
    """The dark frame with the local mean and contrast of the lit one: the laser lights walls too."""

    of_lit, of_dark = local_mean(lit), local_mean(dark)
    shared, own = local_mean(lit * dark) - of_lit * of_dark, local_mean(dark * dark) - of_dark**2
    gain = np.clip((shared + 25) / (own + 25), 0.5, 2)
    return np.asarray(of_lit + gain * (dark - of_dark), dtype=np.float32)
