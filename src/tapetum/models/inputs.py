"""From a crop to what a network sees."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from tapetum.errors import InputError

__all__ = ["BACKGROUNDS", "SOFTENING", "central", "prepare", "root_over_background"]

BACKGROUNDS = ("root", "level")
SOFTENING = 2 / 255
"""In fractions of full scale, two counts of an 8-bit camera: below it the root of what stands out turns into a line, so
that the noise of a dim background does not outgrow the RR."""


def central(images: NDArray[np.generic], crop: int) -> NDArray[np.generic]:
    """Return the central `crop` x `crop` pixels of crops [N, side, side].

    Raises
    ------
    InputError
        When the crops are smaller, negative or not finite.
    """
    side = images.shape[1]
    if crop > side:
        what = f"the model looks at {crop} pixels, the crops have {side}"
        raise InputError(what, where="images", remedy=f"cut crops of at least {crop} pixels")
    edge = (side - crop) // 2
    cut = np.ascontiguousarray(images[:, edge : edge + crop, edge : edge + crop])
    if cut.dtype.kind != "u" and not (np.isfinite(cut).all() and cut.min(initial=0) >= 0):
        raise InputError("intensities must be finite and not negative", where="images", remedy="clip them at 0")
    return cut


def prepare(
    images: NDArray[np.generic], crop: int, size: int, full_scale: float, hide: int = 0, background: str = "level"
) -> Tensor:
    """Turn crops into what the network sees.

    The central `crop` x `crop` pixels, averaged over areas to `size` x `size`, less the image's median, and the square
    root of the intensity (shot noise then has the same spread everywhere). The brightness of the RR, which depends on
    its distance from the axis, stays.

    Parameters
    ----------
    images
        [N, side, side], counts.
    crop, size
        Pixels along an edge, of what is used and of what comes out.
    full_scale
        Count that becomes 1.
    hide
        Radius in pixels of a disc about the centre, where the brightest spot lies, that is filled with the background.
    background
        "root" subtracts the root of the median after the root (legacy): the background becomes 0, but faint parts of an
        RR are weaker where the background is bright. "level" subtracts the median before the root, which then keeps
        its sign: an RR looks alike over any background, but for the noise.

    Returns
    -------
    Tensor
        [N, 1, size, size], float32, about -0.1 ... 1.

    Raises
    ------
    InputError
        When the crops are smaller than `crop`, negative or not finite.
    """
    cut = central(images, crop)
    cut = cut if cut.dtype == np.uint8 else cut.astype(np.float32)
    small = F.interpolate(torch.from_numpy(cut)[:, None].float(), size=(size, size), mode="area") / full_scale
    middle = small.flatten(1).median(dim=1).values[:, None, None, None]
    return root_over_background(small, middle, crop, hide, background)


def root_over_background(small: Tensor, middle: Tensor, crop: int, hide: int, background: str) -> Tensor:
    """Return the root of what stands out of the background, see `prepare`; an export to ONNX traces it.

    Parameters
    ----------
    small
        [N, 1, size, size] intensities, 1 at full scale.
    middle
        [N, 1, 1, 1] their median.
    crop, hide, background
        As of `prepare`.
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
