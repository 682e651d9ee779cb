"""Which images a scene's probe may have taken, and what of them a fit by simulation looks at."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.bench import ProbeSensor
from tapetum.data.crop import crop, find_centre
from tapetum.errors import InputError
from tapetum.models.base import Data

__all__ = ["checked", "images_of", "looked_at"]

Array = NDArray[np.float64]


def checked(
    images: NDArray[np.generic], full_scale: float | None, sensor: ProbeSensor, window: int
) -> NDArray[np.generic]:
    """Refuse what the scene's probe cannot have taken."""
    columns, rows = sensor.pixels
    own = 2**sensor.bits - 1
    if images.ndim != 3 or images.dtype.kind not in "iuf":
        what = f"expected grey images [H, W], got shape {images.shape[1:]} of {images.dtype}"
        raise InputError(what, where="images", remedy="give crops [N, side, side] or frames [N, H, W]")
    if full_scale is not None and full_scale != own:
        what = f"a full scale of {full_scale:g} is not that of the scene's probe, {own}"
        raise InputError(what, where="images", remedy="take the scene they were filmed of")
    height, width = images.shape[1:]
    if height > rows or width > columns:
        what = f"{width} x {height} pixels do not fit the scene's probe of {columns} x {rows}"
        raise InputError(what, where="images", remedy="take the scene they were filmed of")
    if (height, width) != (rows, columns) and (height != width or height < window // 2):
        what = f"{width} x {height} pixels are neither a square crop of {window // 2} or more nor a whole frame"
        raise InputError(what, where="images", remedy=f"give crops, or frames of {columns} x {rows}")
    if not np.isfinite(images).all() or (images.size and float(images.max()) > own):
        what = f"numbers beyond the probe's 0 to {own}, or not finite"
        raise InputError(what, where="images", remedy="give the digital numbers as they were taken")
    return images


def looked_at(image: NDArray[np.generic], sensor: ProbeSensor, window: int) -> tuple[Array, Array]:
    """The pixels that are looked at, and their middle from the image's, in metres."""
    columns, rows = sensor.pixels
    height, width = image.shape
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    # A whole frame shows its RR anywhere; a crop in its middle.
    centre = np.array(find_centre(image)) if (height, width) == (rows, columns) else middle
    side = min(window, height, width)
    left, top = (int(one) for one in np.clip(np.rint(centre - (side - 1) / 2), 0, [width - side, height - side]))
    cut = crop(image, (left + (side - 1) / 2, top + (side - 1) / 2), side)
    offset = np.array([left, top]) + (side - 1) / 2 - middle
    return cut.astype(np.float64), offset * sensor.pitch


def images_of(data: Data, full_scale: float | None) -> Iterator[tuple[NDArray[np.generic], float | None]]:
    """Images one by one, each with its full scale."""
    if isinstance(data, xr.Dataset):
        depth = data.tp.full_scale if full_scale is None else full_scale
        for images in data.tp.images(16):
            yield from ((one, depth) for one in images)
        return
    array = np.asarray(data)
    for one in array[None] if array.ndim == 2 else array:
        yield one, full_scale
