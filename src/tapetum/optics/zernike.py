"""Zernike circle polynomials in Noll's order, each of unit variance over the unit disc.

Ordering and normalisation follow R. J. Noll, "Zernike polynomials and atmospheric turbulence", J. Opt. Soc.
Am. 66, 207 (1976): ``mean of Z_i Z_j over the disc = delta_ij``, even j carry cosines, odd j sines. The angle
phi is measured from +x towards +y, so in an image (x right, y down) it runs clockwise.
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from tapetum.errors import InputError

__all__ = [
    "disc_coordinates",
    "mode_count",
    "nm_to_noll",
    "noll_to_nm",
    "zernike_basis",
    "zernike_noll",
    "zernike_radial",
]


def mode_count(order: int) -> int:
    """Number of modes of radial order n <= `order` (91 for the paper's 12)."""
    if order < 0:
        raise InputError(f"must not be negative, is {order}", where="order", remedy="give a radial order of 0 or more")
    return (order + 1) * (order + 2) // 2


@lru_cache(maxsize=4096)
def noll_to_nm(j: int) -> tuple[int, int]:
    """Radial order n and signed azimuthal order m of Noll's mode j, from 1 (piston).

    m > 0 is ``cos(m phi)``, m < 0 ``sin(|m| phi)``.

    Raises
    ------
    InputError
        When j is below 1.

    Examples
    --------
    >>> [noll_to_nm(j) for j in (1, 2, 3, 4, 11)]
    [(0, 0), (1, 1), (1, -1), (2, 0), (4, 0)]
    """
    if j < 1:
        raise InputError(f"Noll's index starts at 1, is {j}", where="j", remedy="give j of 1 or more")
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2 - 1  # 0 ... n within the row, |m| never falling along it
    magnitude = 2 * (place // 2) + 1 if n % 2 else 2 * ((place + 1) // 2)
    return n, magnitude if j % 2 == 0 else -magnitude


@lru_cache(maxsize=4096)
def nm_to_noll(n: int, m: int) -> int:
    """Noll's index of the mode of radial order n and signed azimuthal order m.

    Raises
    ------
    InputError
        When there is no such mode: abs(m) > n, or n and m of different parity.
    """
    if n < 0 or abs(m) > n or (n - m) % 2:
        raise InputError(f"no mode has n = {n}, m = {m}", remedy="|m| must not exceed n, and n - m must be even")
    first = n * (n + 1) // 2 + 1
    return next(j for j in range(first, first + n + 1) if noll_to_nm(j) == (n, m))


def _radial_family(m: int, rho: Tensor, terms: int) -> list[Tensor]:
    """R_n^m for n = m, m + 2, ... (`terms` of them), each 1 at rho = 1.

    ``R_n^m(rho) = rho^m P_k^(0,m)(2 rho^2 - 1)`` with k = (n - m)/2, by the three-term recurrence of the Jacobi
    polynomials (DLMF 18.9.2), which unlike the sum of factorials is accurate at high orders.
    """
    t = 2 * rho * rho - 1
    family = [torch.ones_like(rho)]
    for k in range(1, terms):
        if k == 1:  # apart, because the general form is 0/0 here for m = 0
            family.append(((m + 2) * t - m) / 2)
            continue
        c = 2 * k + m
        scale = 2 * k * (k + m) * (c - 2)
        slope, offset = (c - 1) * c * (c - 2) / scale, (c - 1) * m * m / scale
        back = 2 * (k - 1) * (k + m - 1) * c / scale
        family.append((slope * t - offset) * family[-1] - back * family[-2])
    if m == 0:
        return family
    power = rho**m
    return [power * value for value in family]


def zernike_radial(n: int, m: int, rho: Tensor) -> Tensor:
    """The radial polynomial R_n^m, which is 1 at rho = 1; differentiable, of the shape and type of `rho`.

    Parameters
    ----------
    n, m
        Orders, 0 <= m <= n, n - m even.
    rho
        Radius, 0 ... 1, any shape; a floating type.

    Raises
    ------
    InputError
        When there is no such polynomial.
    """
    if not 0 <= m <= n or (n - m) % 2:
        raise InputError(f"no radial polynomial has n = {n}, m = {m}", remedy="0 <= m <= n, and n - m must be even")
    return _radial_family(m, rho, (n - m) // 2 + 1)[-1]


def zernike_noll(j: int, rho: Tensor, phi: Tensor) -> Tensor:
    """Noll's mode j, of unit variance over the unit disc, in the shape of the broadcast arguments.

    Parameters
    ----------
    j
        Noll's index, from 1.
    rho
        Radius in units of the disc's; values above 1 follow the polynomial.
    phi
        Angle from +x towards +y in radians; broadcasts with `rho`.
    """
    n, m = noll_to_nm(j)
    radial = math.sqrt(n + 1) * zernike_radial(n, abs(m), rho)
    if m == 0:
        return radial * torch.ones_like(phi)
    angular = torch.cos(m * phi) if m > 0 else torch.sin(-m * phi)
    return math.sqrt(2) * radial * angular


def disc_coordinates(side: int, *, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """x and y of the pixel centres of a square whose inscribed circle is the unit disc.

    Parameters
    ----------
    side
        Pixels along an edge. The square's edges lie at -1 and 1, so pixel centres at ``(2 i + 1)/side - 1``: a pixel
        belongs to the disc when its centre does.
    dtype
        Floating type.

    Returns
    -------
    x, y : Tensor
        [side, side] each, x along the last axis, y down.
    """
    if side < 1:
        raise InputError(f"must be positive, is {side}", where="side", remedy="give a number of pixels")
    at = (2 * torch.arange(side, dtype=dtype) + 1) / side - 1
    y, x = torch.meshgrid(at, at, indexing="ij")
    return x, y


def zernike_basis(order: int, x: Tensor, y: Tensor) -> Tensor:
    """All modes n <= `order` at points (x, y), as [modes, ...]: row j - 1 is Noll's mode j.

    Parameters
    ----------
    order
        Highest radial order.
    x, y
        Cartesian coordinates in units of the disc's radius, same shape.
    """
    if x.shape != y.shape:
        raise InputError(
            f"x of shape {tuple(x.shape)} and y of shape {tuple(y.shape)} differ",
            remedy="give one of each a point",
        )
    rho, phi = torch.hypot(x, y), torch.atan2(y, x)
    # Filled in place: at 400 x 400 pixels a list of modes and its stack would double the memory.
    basis = torch.empty((mode_count(order), *x.shape), dtype=x.dtype, device=x.device)
    for m in range(order + 1):
        turns = [(m, torch.cos(m * phi)), (-m, torch.sin(m * phi))] if m else [(0, None)]
        for k, radial in enumerate(_radial_family(m, rho, (order - m) // 2 + 1)):
            n = m + 2 * k
            for signed, angular in turns:
                scaled = math.sqrt(n + 1) * radial
                basis[nm_to_noll(n, signed) - 1] = scaled if angular is None else math.sqrt(2) * scaled * angular
    return basis
