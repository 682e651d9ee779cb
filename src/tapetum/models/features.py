"""The paper's features (section 5): powers of Zernike coefficients of the root of the intensity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tapetum.errors import InputError, whole
from tapetum.optics.zernike import mode_count, noll_to_nm, zernike_basis

__all__ = [
    "ORDER",
    "POWERS",
    "SCALES",
    "as_images",
    "check_levels",
    "checked_powers",
    "feature_names",
    "root_intensity",
    "zernike_features",
]

SCALES = (100, 200, 300, 400)
ORDER = 12
POWERS = (1, 2, 3)

# Parity down and across (True: even), in the order in which `_folded` returns its quadrants.
_WAYS = ((True, True), (True, False), (False, True), (False, False))

# Frames at a time: 32 of 400 x 400 pixels are 20 MB, so that the fit's matrices (15 MB) are not read too often.
_BATCH = 32
_HIGHEST = 100


def as_images(
    images: NDArray[np.generic], full_scale: float | None, *, where: str = "images"
) -> tuple[NDArray[np.generic], float]:
    """Return crops as [N, side, side] in the machine's byte order, and the count of a saturated pixel.

    That is 255 by default for uint8. `images` are [N, side, side] or [side, side], integers or floats; `where` names
    them in messages. Raises an InputError when shape or type do not fit, or `full_scale` is missing or not positive.
    """
    array = np.asarray(images)
    if array.ndim == 2:
        array = array[None]
    if array.ndim != 3 or array.shape[1] != array.shape[2]:
        raise InputError(f"expected square crops [N, side, side], got shape {array.shape}", where=where)
    if array.dtype.kind not in "iuf":
        what = f"images of type {array.dtype} are not grey levels"
        raise InputError(what, where=where, remedy="give uint8, uint16 or float")
    if full_scale is None:
        if array.dtype != np.uint8:
            remedy = "pass full_scale, for example 4095 for a 12-bit camera"
            raise InputError(f"the depth of {array.dtype} images cannot be known", where=where, remedy=remedy)
        full_scale = 255.0
    if not 0 < full_scale < math.inf:
        remedy = "give the largest count of a pixel"
        raise InputError(f"must be positive and finite, is {full_scale}", where="full_scale", remedy=remedy)
    # torch reads no other byte order, which FITS files have.
    return array.astype(array.dtype.newbyteorder("="), copy=False), float(full_scale)


def check_levels(images: NDArray[np.generic]) -> None:
    """Raise an InputError for negative or NaN levels of images of any shape."""
    if images.dtype.kind != "u" and not (np.isfinite(images).all() and images.min(initial=0) >= 0):
        raise InputError("intensities must be finite and not negative", where="images", remedy="clip them at 0")


def root_intensity(images: NDArray[np.generic], full_scale: float, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return the root of the intensity in 8-bit counts, 0 ... 16; raise an InputError for negative or NaN floats."""
    check_levels(images)
    if images.dtype == np.uint16 or images.dtype.kind == "f":
        # torch has few operations on uint16; float32 holds its values exactly.
        images = images.astype(np.float64 if dtype == torch.float64 else np.float32)
    # Writable, as torch warns of others.
    root = torch.from_numpy(np.require(images, requirements=["C", "W"])).to(dtype, copy=True)
    return root.mul_(255.0 / full_scale).sqrt_()


@lru_cache(maxsize=8)
def _projection(side: int, order: int, dtype: torch.dtype) -> tuple[tuple[Tensor, Tensor], ...]:
    """Return, for each parity of `_WAYS`, the indices of its modes and the matrix [half*half, modes] that fits them.

    The matrix is a pseudo-inverse, zero outside the disc, and applies to a quadrant of `_folded`: every mode is even or
    odd in x and in y. The modes are not quite orthogonal on pixels, so modes of equal parity are separated by solving
    with their Gram matrix (condition about 1.03 at 400 pixels).
    """
    half = (side + 1) // 2
    at = (2 * torch.arange(side // 2, side, dtype=torch.float64) + 1) / side - 1  # the centres at 0 and right of it
    y, x = torch.meshgrid(at, at, indexing="ij")
    inside = (x * x + y * y <= 1).reshape(-1)
    modes = mode_count(order)
    basis = zernike_basis(order, x.reshape(-1)[inside], y.reshape(-1)[inside])
    twice = 2.0 - (at == 0).to(torch.float64)  # rows or columns of the square that fold onto one
    weight = torch.outer(twice, twice).reshape(-1)[inside]
    azimuthal = torch.tensor([noll_to_nm(j)[1] for j in range(1, modes + 1)])
    down = azimuthal >= 0
    across = (azimuthal % 2 == 0) == down
    found: list[tuple[Tensor, Tensor]] = []
    for even_down, even_across in _WAYS:
        alike = torch.nonzero((down == even_down) & (across == even_across)).reshape(-1)
        own = basis[alike]
        gram = (own * weight) @ own.T
        if int(torch.linalg.matrix_rank(gram, hermitian=True)) < len(alike):
            what = f"a crop of {side} pixels cannot separate {modes} modes"
            raise InputError(what, where="scales", remedy="use larger crops or a lower order")
        quadrant = torch.zeros(half * half, len(alike), dtype=torch.float64)
        quadrant[inside] = torch.linalg.solve(gram, own).T
        found.append((alike, quadrant.to(dtype)))
    return tuple(found)


def _folded(squares: Tensor) -> list[Tensor]:
    """Fold squares [N, side, side] onto their lower right quadrants, [N, half, half] for each of `_WAYS`."""
    side = squares.shape[-1]
    parts = [squares]
    for axis in (1, 2):
        # The middle row or column of an odd side has no counterpart.
        near = [one.narrow(axis, side // 2, (side + 1) // 2) for one in parts]
        far = [one.narrow(axis, 0, side // 2).flip(axis) for one in parts]
        if side % 2:
            far = [torch.cat([torch.zeros_like(one.narrow(axis, 0, 1)), one], axis) for one in far]
        parts = [folded for a, b in zip(near, far, strict=True) for folded in (a + b, a - b)]
    return parts


def _middle(images: Tensor, side: int) -> Tensor:
    """Return the central [N, side, side] of images."""
    edge = (images.shape[-1] - side) // 2
    return images[:, edge : edge + side, edge : edge + side]


def _checked_scales(scales: Sequence[int], side: int) -> tuple[int, ...]:
    if not scales or min(scales) < 1:
        raise InputError(f"must be positive, are {tuple(scales)}", where="scales", remedy="give sides in pixels")
    if max(scales) > side:
        remedy = f"build the dataset with side={max(scales)} or choose smaller scales"
        raise InputError(f"a scale of {max(scales)} pixels does not fit crops of {side}", where="scales", remedy=remedy)
    return tuple(scales)


def checked_powers(powers: Sequence[int]) -> tuple[int, ...]:
    """Return the powers of coefficients as ints; raise an InputError unless there are some, all 1 or more."""
    given = tuple(powers)
    if not given:
        raise InputError("are none", where="powers", remedy="the paper's are 1, 2 and 3")
    # A root of a negative coefficient is no number.
    return tuple(whole(one, "powers", "the paper's are 1, 2 and 3", least=1, most=_HIGHEST) for one in given)


def feature_names(scales: Sequence[int] = SCALES, order: int = ORDER, powers: Sequence[int] = POWERS) -> list[str]:
    """Name the columns of `zernike_features` in order: scale by scale, power by power, mode by mode."""
    modes = [noll_to_nm(j) for j in range(1, mode_count(order) + 1)]
    return [f"z({n},{m})^{power} at {scale}" for scale in scales for power in powers for n, m in modes]


def zernike_features(
    images: NDArray[np.generic],
    scales: Sequence[int] = SCALES,
    order: int = ORDER,
    powers: Sequence[int] = POWERS,
    *,
    full_scale: float | None = None,
    dtype: torch.dtype = torch.float32,
) -> NDArray[np.float64]:
    """Compute the paper's features of centred crops.

    For every scale s, the modes n <= `order` are fitted by least squares to the square root of the intensity (8-bit
    counts) of the central s x s pixels, over the pixels whose centre lies in the inscribed disc. Each coefficient is
    raised to every power.

    Parameters
    ----------
    images
        [N, side, side] crops centred on the RR, uint8, uint16 or float counts; no background is subtracted.
    scales
        Sides of the squares in pixels, at most `side`.
    order, powers
        Highest radial order; powers of the coefficients.
    full_scale
        Largest count of the camera; 255 by default for uint8.
    dtype
        Precision of the fit: float32 agrees with float64 to about 1e-6 of the largest coefficient.

    Returns
    -------
    ndarray
        [N, len(scales) * len(powers) * modes], 1092 columns by default, in the order of `feature_names`.
    """
    array, depth = as_images(images, full_scale)
    sides = _checked_scales(scales, array.shape[1])
    powers, modes = checked_powers(powers), mode_count(order)
    features = np.empty((len(array), len(sides), len(powers), modes))
    # Outside inference mode, because autograd refuses cached inference tensors.
    projections = {side: _projection(side, order, dtype) for side in sides}
    # Each parity of side is folded once: a smaller crop's quadrant is a corner of the largest one's.
    largests = {max(one for one in sides if one % 2 == side % 2) for side in sides}
    with torch.inference_mode():
        for start in range(0, len(array), _BATCH):
            root = root_intensity(array[start : start + _BATCH], depth, dtype)
            folded = {largest % 2: _folded(_middle(root, largest)) for largest in largests}
            for k, side in enumerate(sides):
                half, fitted = (side + 1) // 2, np.empty((len(root), modes))
                for whole, (alike, projection) in zip(folded[side % 2], projections[side], strict=True):
                    quadrant = whole[:, :half, :half].reshape(len(root), -1)
                    fitted[:, alike.numpy()] = (quadrant @ projection).numpy()
                for p, power in enumerate(powers):
                    features[start : start + _BATCH, k, p] = fitted**power
    return features.reshape(len(array), len(sides) * len(powers) * modes)
