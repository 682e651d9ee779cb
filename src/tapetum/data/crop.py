"""Position of a retro-reflection in a frame, and the square cut out around it.

The paper centres every crop on the brightest point of the smoothed frame (section 5) and says no more; `CENTRING` is
our reading. Smoothing here is a 3 x 3 median, which removes hot pixels, followed by a Gaussian.

In a lit room that point may lie on a wall or a lamp behind the target. The probe, focused at infinity, blurs those by
its whole aperture, D f_p/d, while laser light from a lens has rings and lobes as fine as λ f_p/D. So light without fine
structure is not taken for an RR if light with it exists (`find_centre`). This departs from the paper, whose recordings
had no lit rooms. A little over 400 lines, as finding, centring and cutting share one smoothing.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tapetum.data.blocks import block_means
from tapetum.errors import InputError

__all__ = ["CENTRING", "SIGMA", "Peak", "crop", "crop_batch", "crops_of", "find_centre", "find_peak", "vertex"]

SIGMA = 20.0
"""Standard deviation in pixels of the smoothing Gaussian.

The paper gives none. It must be wider than the RR's rings and lobes, or noise decides which of them is the brightest:
on simulated RRs of an f = 100 mm, f/12.5 target the centre scatters by 16 px (median) at 4 px, 7 px at 12 px and 0.2 px
at 20 px.
"""

CENTRING = (
    "our reading of the paper's: the brightest point after a 3 x 3 median and a Gaussian, or that of what has fine "
    "structure where a broad light outshines it"
)
"""How crops are centred, for model cards and reports."""

# From this smoothing on, images are reduced by this factor: the maximum is as accurate at a tenth of the time.
_REDUCE_FROM, _REDUCE = 12.0, 4

# Edge in pixels of the blocks whose means make the background.
_BLOCK = 16

# Fine structure: three Gaussians of evenly spaced variances (width in pixels, weight) that cancel linear and quadratic
# variation, wide enough to be computed on an image of half the size.
_FINE, _HALVE = ((4.0, 1.0), (80**0.5, -2.0), (12.0, 1.0)), 2
# To move the centre, structure must exceed 8 times the noise (noise alone reached 6 beside a lamp), and twice that of
# the brightest point.
_NOISE, _CLEARLY = 8.0, 2.0
# Radius within which structure is searched, and smoothing of the subtracted background, in units of sigma.
_AROUND, _BROAD = 2.5, 3.0

# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
_MAD = 1.4826

# Longest side of a part that is smoothed by products of matrices, in pixels.
_SMALL = 400


@dataclass(frozen=True)
class Peak:
    """The brightest point of a smoothed frame.

    Parameters
    ----------
    x, y
        Sub-pixel place, (0, 0) at the centre of the first pixel.
    height
        Smoothed value there above the background, in the frame's units.
    background
        Of the frame or the part searched: the median of means over blocks.
    noise
        Robust standard deviation of the smoothed frame.
    """

    x: float
    y: float
    height: float
    background: float
    noise: float

    @property
    def snr(self) -> float:
        """Height over noise. Pure noise gives about 4; up to 8 where rounding hides it."""
        if self.height <= 0:
            return 0.0
        return self.height / self.noise if self.noise > 0 else math.inf


def _grey(image: NDArray[np.generic]) -> NDArray[np.generic]:
    array = np.asarray(image)
    if array.ndim != 2 or array.size == 0:
        raise InputError(f"expected a grey image [H, W], got shape {array.shape}", remedy="give one frame at a time")
    return array


def _checked(image: NDArray[np.generic]) -> NDArray[np.generic]:
    array = _grey(image)
    if array.dtype in (np.uint8, np.uint16):
        return array
    if array.dtype.kind not in "iuf":
        raise InputError(f"images of type {array.dtype} are not grey levels", remedy="give uint8, uint16 or float")
    array = array.astype(np.float32)
    if not np.isfinite(array).all():
        raise InputError("the image holds values that are not finite", remedy="replace NaN and infinite pixels")
    return array


def _smooth(image: NDArray[np.generic], sigma: float, products: bool = False) -> tuple[NDArray[np.float32], float, int]:
    """Return the smoothed image above its background, the background, and the factor of reduction.

    Small parts, of which a frame may have many, are smoothed in half the time by `products` of matrices. BLAS should
    then have one thread: several wait for each other far longer than one takes.
    """
    calm = _calm(image)
    background = _background(calm, products)
    step = _REDUCE if sigma >= _REDUCE_FROM and min(image.shape) >= _REDUCE else 1
    return _blurred(calm, background, sigma, step, products), background, step


def _noise(
    image: NDArray[np.generic], smooth: NDArray[np.float32], background: float, sigma: float, step: int
) -> float:
    """Return the noise of a smoothed image."""
    noise = _scatter(smooth)
    if image.dtype.kind in "iu":
        least = _rounding(sigma)
        if noise < 2 * least:
            # Where most pixels have the same count, the median hides the noise of the others.
            noise = max(noise, least, _scatter(_blurred(image.astype(np.float32), background, sigma, step)))
    return noise


def _calm(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Return the image after a 3 x 3 median."""
    return np.asarray(cv2.medianBlur(np.ascontiguousarray(image), 3), dtype=np.float32)  # type: ignore[arg-type]


def _background(image: NDArray[np.float32], products: bool = False) -> float:
    """Return the median of means over blocks; the median of integer pixels could be half a count off."""
    height, width = image.shape
    size = max(1, width // _BLOCK), max(1, height // _BLOCK)
    base = float(cv2.mean(image)[0])
    # From values near zero, whose means are the most accurate.
    above = image - np.float32(base)
    means = block_means(above, *size[::-1]) if products else cv2.resize(above, size, interpolation=cv2.INTER_AREA)
    means = means.ravel()
    # The median, several times faster than numpy's for as few values.
    means.sort()
    return base + float((means[(means.size - 1) // 2] + means[means.size // 2]) / np.float32(2))


def _blurred(
    image: NDArray[np.float32], background: float, sigma: float, step: int, products: bool = False
) -> NDArray[np.float32]:
    """Return the reduced image above its background, smoothed by a Gaussian."""
    above = np.asarray(image - background, dtype=np.float32)
    if step > 1:
        rows, columns = (-(-size // step) * step for size in image.shape)
        down, across = rows - image.shape[0], columns - image.shape[1]
        wide = cv2.copyMakeBorder(above, 0, down, 0, across, cv2.BORDER_CONSTANT, value=[0.0])
        above = np.asarray(cv2.resize(wide, (columns // step, rows // step), interpolation=cv2.INTER_AREA), np.float32)
    # Padded with background: repeated border pixels would amplify their noise.
    if products:
        down, across = (_gaussian(size, sigma / step) for size in above.shape)
        return np.asarray(down @ above @ across, dtype=np.float32)
    return np.asarray(cv2.GaussianBlur(above, (0, 0), sigma / step, borderType=cv2.BORDER_CONSTANT), np.float32)


@functools.lru_cache(maxsize=64)
def _gaussian(size: int, sigma: float) -> NDArray[np.float32]:
    """Return a Gaussian smoothing as a symmetric matrix [size, size], which is faster on small images."""
    # As wide as OpenCV's.
    reach = round(8 * sigma + 1) // 2
    kernel = np.zeros(2 * size + 2 * reach + 1, np.float32)
    kernel[size : size + 2 * reach + 1] = cv2.getGaussianKernel(2 * reach + 1, sigma, cv2.CV_32F)[:, 0]
    places = np.arange(size)
    return kernel[places[:, None] - places + size + reach]


def _scatter(image: NDArray[np.float32]) -> float:
    """Return the robust standard deviation of an image."""
    sample = _thinned(image)
    return _MAD * float(_middle(np.abs(sample - _middle(sample))))


def _middle(values: NDArray[np.float32]) -> np.float32:
    """Return the median of finite values; NumPy's looks for others, which takes half as long again."""
    half = values.size // 2
    parted = np.partition(values, half, axis=None)
    return parted[half] if values.size % 2 else (parted[:half].max() + parted[half]) / np.float32(2)


def _thinned(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a regular sample of at most 512 x 512 pixels, enough for a median."""
    return image[:: -(-image.shape[0] // 512), :: -(-image.shape[1] // 512)]


def vertex(below: float, at: float, above: float) -> float:
    """Return the offset, in steps from the middle, of the maximum of the parabola through three values, or 0."""
    bend = below - 2 * at + above
    return 0.0 if bend >= 0 else min(max(0.5 * (below - above) / bend, -0.5), 0.5)


def _refine(smooth: NDArray[np.float32], row: int, column: int, span: float) -> tuple[float, float]:
    """Return the sub-pixel (x, y) of the maximum at (row, column), or the middle of its plateau."""
    height, width = smooth.shape
    # A saturated RR has a flat top, whose middle is the centre.
    flat = (smooth >= smooth[row, column] - 1e-4 * span).view(np.uint8)
    if cv2.countNonZero(flat) > 4:
        _, labels = cv2.connectedComponents(flat, connectivity=8)
        rows, columns = np.nonzero(labels == labels[row, column])
        if rows.size > 4:
            return float(columns.mean()), float(rows.mean())
    x, y = float(column), float(row)
    if 0 < column < width - 1:
        x += vertex(*(float(v) for v in smooth[row, column - 1 : column + 2]))
    if 0 < row < height - 1:
        y += vertex(*(float(v) for v in smooth[row - 1 : row + 2, column]))
    return x, y


def find_peak(
    image: NDArray[np.generic], sigma: float = SIGMA, *, near: tuple[float, float, float] | None = None
) -> Peak:
    """Find the brightest point of the smoothed image.

    Parameters
    ----------
    image
        [H, W], uint8, uint16 or float, grey.
    sigma
        Standard deviation of the smoothing Gaussian in pixels.
    near
        (x, y, radius) in pixels: search only this circle. Background and noise are then those of its surroundings.

    Returns
    -------
    Peak
        Always finite; a uniform image gives its middle with an SNR of 0.

    Raises
    ------
    InputError
        When the image is not grey or not finite, or the circle lies outside it.
    """
    x, y, height, (smooth, background, step), part = _brightest(image, sigma, near)
    return Peak(x, y, height, background, _noise(part, smooth, background, sigma, step))


_Smoothed = tuple[NDArray[np.float32], float, int]


def _brightest(
    image: NDArray[np.generic], sigma: float, near: tuple[float, float, float] | None
) -> tuple[float, float, float, _Smoothed, NDArray[np.generic]]:
    """Return x, y and height of `find_peak`, what it smoothed, and what was smoothed."""
    array = _checked(image)
    if not sigma > 0:
        raise InputError(f"must be positive, is {sigma}", where="sigma", remedy="give a width in pixels")
    height, width = array.shape
    left, top, right, bottom = 0, 0, width, height
    if near is not None:
        x, y, radius = near
        # A margin of 4 sigma makes the smoothed values those of the whole frame.
        reach = radius + 4 * sigma + 2
        left, right = max(0, math.floor(x - reach)), min(width, math.ceil(x + reach) + 1)
        top, bottom = max(0, math.floor(y - reach)), min(height, math.ceil(y + reach) + 1)
        if not (radius > 0 and -radius <= x <= width - 1 + radius and -radius <= y <= height - 1 + radius):
            what = f"circle ({x:g}, {y:g}), radius {radius:g} misses the image of {width} x {height}"
            raise InputError(what, where="near", remedy="give a place in the image, in pixels")
    part = array[top:bottom, left:right]
    smooth, background, step = _smooth(part, sigma, near is not None and max(part.shape) <= _SMALL)
    # Pixel n of a reduced image is centred on pixel n step + (step - 1)/2 of the whole one.
    shift = (step - 1) / 2
    if near is None:
        row, column = divmod(int(np.argmax(smooth)), smooth.shape[1])
    else:
        x, y = ((at - shift - first) / step for at, first in zip(near[:2], (left, top), strict=True))
        row, column = _highest_within(smooth, x, y, near[2] / step)
    rise = float(smooth[row, column])
    span = rise - float(smooth.min())
    if span <= 0:
        return (width - 1) / 2, (height - 1) / 2, 0.0, (smooth, background, step), part
    x, y = _refine(smooth, int(row), int(column), span)
    return x * step + shift + left, y * step + shift + top, rise, (smooth, background, step), part


def _highest_within(image: NDArray[np.float32], x: float, y: float, radius: float) -> tuple[int, int]:
    """Return row and column of an image's highest pixel in a circle, which lies in it at least in part."""
    # A circle smaller than a pixel may lie between pixels: the nearest one counts.
    rows, columns = (
        np.arange(max(0, min(math.floor(at - radius), size - 1)), min(size, max(math.ceil(at + radius), 0) + 1))
        for at, size in zip((y, x), image.shape, strict=True)
    )
    away = (columns - x) ** 2 + ((rows - y) ** 2)[:, None]
    part = image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    searched = np.where(away <= max(radius**2, float(away.min())), part, -np.inf)
    row, column = divmod(int(searched.argmax()), searched.shape[1])
    return int(rows[0]) + row, int(columns[0]) + column


def find_centre(
    image: NDArray[np.generic], sigma: float = SIGMA, *, near: tuple[float, float, float] | None = None
) -> tuple[float, float]:
    """Return (x, y) in pixels of the brightest point of the smoothed image that may be an RR's.

    It is that of `find_peak`, unless the image is smooth around that point and has clearly more fine structure
    elsewhere: then it is the brightest point near that structure, above the broad background. With `near` it is always
    that of `find_peak`, whose parameters and errors apply.
    """
    if near is not None:
        return _brightest(image, sigma, near)[:2]
    peak = find_peak(image, sigma)
    array = _checked(image)
    fine, noise = _fine_structure(array)
    # Centres of the reduced pixels in the whole image.
    y, x = (_HALVE * np.arange(size) + (_HALVE - 1) / 2 for size in fine.shape)
    around = (x - peak.x) ** 2 + (y[:, None] - peak.y) ** 2 <= max(_AROUND * sigma, 2.0 * _HALVE) ** 2
    here, most = float(fine[around].max(initial=-np.inf)), float(fine.max())
    if here >= _NOISE * noise or most < max(_CLEARLY * here, _NOISE * noise):
        return peak.x, peak.y
    row, column = np.unravel_index(int(np.argmax(fine)), fine.shape)
    near = (float(x[column]), float(y[row]), 2 * sigma)
    found = find_peak(array.astype(np.float32) - _broad(array, _BROAD * sigma), sigma, near=near)
    return found.x, found.y


def _broad(image: NDArray[np.generic], sigma: float) -> NDArray[np.float32]:
    """Return the image [H, W] after wide smoothing, computed on a small copy."""
    size = max(1, image.shape[1] // 8), max(1, image.shape[0] // 8)
    small = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    blurred = cv2.GaussianBlur(small, (0, 0), sigma / 8, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(blurred, image.shape[::-1], interpolation=cv2.INTER_LINEAR), dtype=np.float32)


def _fine_structure(image: NDArray[np.generic]) -> tuple[NDArray[np.float32], float]:
    """Return the structure [H/2, W/2] finer than a blurred room, and its noise."""
    calm = _calm(image)
    size = max(1, calm.shape[1] // _HALVE), max(1, calm.shape[0] // _HALVE)
    half = cv2.resize(calm, size, interpolation=cv2.INTER_AREA)
    fine = np.zeros(half.shape, np.float32)
    for width, weight in _FINE:
        fine += weight * cv2.GaussianBlur(half, (0, 0), width / _HALVE, borderType=cv2.BORDER_REPLICATE)
    noise = _scatter(fine)
    if image.dtype.kind in "iu":
        noise = max(noise, _rounding(_FINE[0][0]))
    return fine, noise


def _rounding(sigma: float) -> float:
    """Return the smoothed noise of rounding to integers, which uniform dark pixels hide."""
    return 1 / math.sqrt(12) / (2 * math.sqrt(math.pi) * sigma)


def crop(image: NDArray[np.generic], centre: tuple[float, float], side: int) -> NDArray[np.generic]:
    """Cut a square out of an image, to the nearest pixel, without interpolation.

    Parameters
    ----------
    image
        [H, W].
    centre
        (x, y) in pixels, which falls within half a pixel of the crop's middle, ``(side - 1)/2``.
    side
        Pixels along an edge.

    Returns
    -------
    ndarray
        [side, side], the image's type, a copy. Pixels outside the image get its median.

    Raises
    ------
    InputError
        When the centre is not finite or the side not positive.
    """
    return crops_of(image, np.array([centre], dtype=np.float64), side)[0]


def crops_of(image: NDArray[np.generic], centres: NDArray[np.floating], side: int) -> NDArray[np.generic]:
    """Cut squares [N, side, side] out of one image [H, W] around centres (x, y) [N, 2]; each is that of `crop`.

    The image's median, which costs more than many squares, is taken at most once.
    """
    array, places = _grey(image), np.asarray(centres, dtype=np.float64).reshape(-1, 2)
    if side < 1:
        raise InputError(f"must be positive, is {side}", where="side", remedy="give a number of pixels")
    height, width = array.shape
    cut = np.empty((len(places), side, side), array.dtype)
    fill: float | None = None
    for one, (x, y) in zip(cut, places.tolist(), strict=True):
        if not (math.isfinite(x) and math.isfinite(y)):
            raise InputError(f"must be finite, is {(x, y)}", where="centre", remedy="give (x, y) in pixels")
        left, top = (math.floor(at - (side - 1) / 2 + 0.5) for at in (x, y))
        x0, x1 = (min(max(at, 0), width) for at in (left, left + side))
        y0, y1 = (min(max(at, 0), height) for at in (top, top + side))
        if x1 - x0 < side or y1 - y0 < side:
            if fill is None:
                middle = _median(array)
                fill = float(np.rint(middle)) if array.dtype.kind in "iu" else middle
            one[:] = fill
        one[y0 - top : y1 - top, x0 - left : x1 - left] = array[y0:y1, x0:x1]
    return cut


def _median(image: NDArray[np.generic]) -> float:
    """Return the median of an image; of bytes from their counts, a hundred times faster than by sorting millions."""
    if image.dtype != np.uint8:
        return float(np.median(image.astype(np.float64)))
    below = (
        cv2.calcHist([np.ascontiguousarray(image, dtype=np.uint8)], [0], None, [256], [0, 256])
        .ravel()
        .cumsum(dtype=np.int64)
    )
    lower, upper = np.searchsorted(below, ((image.size + 1) // 2, image.size // 2 + 1))
    return (float(lower) + float(upper)) / 2


def crop_batch(images: NDArray[np.generic], centres: NDArray[np.floating], side: int) -> NDArray[np.generic]:
    """Cut a square [N, side, side] out of each image [N, H, W] around its centre (x, y) [N, 2]; raises as `crop`."""
    array, places = np.asarray(images), np.asarray(centres, dtype=np.float64)
    if array.ndim != 3 or places.shape != (len(array), 2):
        raise InputError(f"expected images [N, H, W] with centres [N, 2], got {array.shape} with {places.shape}")
    cut = [crop(image, (float(x), float(y)), side) for image, (x, y) in zip(array, places, strict=True)]
    return np.stack(cut) if cut else np.empty((0, side, side), array.dtype)
