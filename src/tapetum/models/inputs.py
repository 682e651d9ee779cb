"""Preparation of crops as network input."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from tapetum.errors import InputError

__all__ = ["BACKGROUNDS", "SOFTENING", "area_average", "central", "prepare", "root_over_background"]

BACKGROUNDS = ("root", "level")
SOFTENING = 2 / 255
"""Fraction of full scale (two 8-bit counts) below which the root becomes linear, to limit background noise."""


def central(images: NDArray[np.generic], crop: int) -> NDArray[np.generic]:
    """Return the central [N, crop, crop] of crops; raise an InputError for smaller, negative or non-finite ones."""
    side = images.shape[1]
    if crop > side:
        what = f"the model looks at {crop} pixels, the crops have {side}"
        raise InputError(what, where="images", remedy=f"cut crops of at least {crop} pixels")
    edge = (side - crop) // 2
    # Writable, as torch warns of others.
    cut = np.require(images[:, edge : edge + crop, edge : edge + crop], requirements=["C", "W"])
    if cut.dtype.kind != "u" and not (np.isfinite(cut).all() and cut.min(initial=0) >= 0):
        raise InputError("intensities must be finite and not negative", where="images", remedy="clip them at 0")
    return cut


def area_average(side: int, size: int) -> Tensor:
    """Return the matrix [size, side] of torch's "area" interpolation: means over whole pixels that may overlap."""
    return F.interpolate(torch.eye(side, dtype=torch.float64)[None], size=size, mode="area")[0].T


def prepare(
    images: NDArray[np.generic], crop: int, size: int, full_scale: float, hide: int = 0, background: str = "level"
) -> Tensor:
    """Return crops [N, side, side] (counts) as float32 network input [N, 1, size, size], about -0.1 ... 1.

    The central `crop` x `crop` pixels are averaged to `size` x `size`, divided by `full_scale` and passed to
    `root_over_background`. The RR's brightness, which depends on its distance from the axis, is kept.
    """
    cut = central(images, crop)
    cut = cut if cut.dtype == np.uint8 else cut.astype(np.float32)
    small = F.interpolate(torch.from_numpy(cut)[:, None].float(), size=(size, size), mode="area") / full_scale
    middle = small.flatten(1).median(dim=1).values[:, None, None, None]
    return root_over_background(small, middle, crop, hide, background)


def root_over_background(small: Tensor, middle: Tensor, crop: int, hide: int, background: str) -> Tensor:
    """Return the square root of intensities `small` [N, 1, size, size] above their median `middle` [N, 1, 1, 1].

    The root gives shot noise the same spread everywhere. With `background` "level" the median is subtracted before a
    signed root, so an RR looks the same over any background, except for noise. "root" (legacy) subtracts the root of
    the median from the root, which weakens faint parts of an RR over a bright background. A central disc of radius
    `hide` (crop pixels) is filled with the background. The ONNX export traces this function.
    """
    size = small.shape[-1]
    if background == "level":
        out = small - middle
        root = out.sign() * ((out.abs() + SOFTENING).sqrt() - SOFTENING**0.5)
    else:
        root = small.sqrt() - middle.sqrt()
    if hide:
        at = (torch.arange(size) - (size - 1) / 2) * crop / size
        root = root.masked_fill(at[:, None] ** 2 + at**2 <= hide**2, 0.0)
    return root
