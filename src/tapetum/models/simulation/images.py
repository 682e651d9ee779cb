"""Check of images against a scene's probe, and the window that a fit by simulation uses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import ProbeSensor
from tapetum.data.crop import crop, find_centre
from tapetum.errors import InputError

__all__ = ["checked", "looked_at"]

Array = NDArray[np.float64]


def checked(
    images: NDArray[np.generic], full_scale: float | None, sensor: ProbeSensor, window: int
) -> NDArray[np.generic]:
    """Return images [N, H, W]; raise an InputError if the scene's probe cannot have taken them."""
    (columns, rows), own, shape = sensor.pixels, 2**sensor.bits - 1, images.shape[1:]
    size, remedy = " x ".join(str(one) for one in shape[::-1]), "take the scene they were filmed of"
    if images.ndim != 3 or images.dtype.kind not in "iuf":
        what = f"expected grey images [H, W], got shape {shape} of {images.dtype}"
        remedy = "give crops [N, side, side] or frames [N, H, W]"
    elif full_scale is not None and full_scale != own:
        what = f"a full scale of {full_scale:g} is not that of the scene's probe, {own}"
    elif shape[0] > rows or shape[1] > columns:
        what = f"{size} pixels do not fit the scene's probe of {columns} x {rows}"
    elif shape != (rows, columns) and (shape[0] != shape[1] or shape[0] < window // 2):
        what = f"{size} pixels are neither a square crop of {window // 2} or more nor a whole frame"
        remedy = f"give crops, or frames of {columns} x {rows}"
    elif not np.isfinite(images).all() or (images.size and float(images.max()) > own):
        what = f"numbers beyond the probe's 0 to {own}, or not finite"
        remedy = "give the digital numbers as they were taken"
    else:
        return images
    raise InputError(what, where="images", remedy=remedy)


def looked_at(image: NDArray[np.generic], sensor: ProbeSensor, window: int) -> tuple[Array, Array]:
    """Return the pixels of the window, and its middle from the image's, in metres."""
    columns, rows = sensor.pixels
    height, width = image.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    # In a whole frame the RR may lie anywhere, in a crop it lies in the middle.
    centre = np.array(find_centre(image)) if (height, width) == (rows, columns) else middle
    side = min(window, height, width)
    left, top = (int(one) for one in np.clip(np.rint(centre - (side - 1) / 2), 0, [width - side, height - side]))
    cut = crop(image, (left + (side - 1) / 2, top + (side - 1) / 2), side)
    offset = np.array([left, top]) + (side - 1) / 2 - middle
    return cut.astype(np.float64), offset * sensor.pitch
