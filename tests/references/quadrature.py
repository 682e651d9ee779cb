"""Points and weights of the judge's sums: products of Gauss-Legendre points, panels, and weights of a disc."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import roots_legendre

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

# Chords of a region at a height: (lower ends, upper ends); empty where the upper one is not above the lower one.
Chords = Callable[[Real], tuple[Real, Real]]
# Places at a time whose polynomials stay in the processor's cache.
_SLAB = 1 << 14


def phasor(phase: Real) -> Complex:
    """exp(i phase)."""
    # Torch's sine and cosine are vectorised, NumPy's complex exponential is not.
    turned = torch.from_numpy(np.ascontiguousarray(phase, np.float64))
    # Of angles beyond some 2e4 they take three times as long; what rounding makes of those is as much as this does.
    if turned.numel() and max(map(abs, map(float, turned.aminmax()))) > 1e4:
        turned = turned * (0.5 / math.pi)
        turned -= turned.round()
        turned *= 2 * math.pi
    return torch.complex(torch.cos(turned), torch.sin(turned)).numpy()


def halved(turns: Real, x: Real) -> Real:
    """Cosines, then sines, of turns · x for one of each pair ±x that the places x [N] stand in: [..., N].

    With them a sum over exp(-i turns · x) takes half the multiplications, for these factors are real:
    Σ exp(-i turns x) f(x) = times(halved(turns, x), folded(f)), and the other way round
    Σ exp(-i turns x) g(turns) = unfolded(times(halved(turns, x).T, g)).
    """
    middle = len(x) // 2
    phase = torch.from_numpy(np.multiply.outer(turns, x[middle:]))
    found = np.empty((*turns.shape, len(x)))
    cosines, sines = torch.from_numpy(found).split((len(x) - middle, middle), -1)
    torch.cos(phase, out=cosines)
    # An odd number of places has one of its own in the middle, where the sine is 0.
    torch.sin(phase[..., len(x) % 2 :], out=sines)
    return found


def folded(field: Complex) -> Complex:
    """Sums of a field's rows at x and -x, the middle one first, then their differences by -i."""
    count, middle = len(field), len(field) // 2
    upper, lower = field[count - middle :], field[:middle][::-1]
    found = np.empty(field.shape, np.complex128)
    found[: count - middle] = field[middle:]
    found[count - 2 * middle : count - middle] += lower
    np.multiply(upper - lower, -1j, out=found[count - middle :])
    return found


def unfolded(halves: Complex) -> Complex:
    """Rows at all x of sums by the cosine and the sine of those that are not below the middle."""
    count, middle = len(halves), len(halves) // 2
    even, odd = halves[count - 2 * middle : count - middle], 1j * halves[count - middle :]
    found = np.empty(halves.shape, np.complex128)
    found[middle : count - middle] = halves[: count - 2 * middle]
    found[count - middle :] = even - odd
    found[:middle] = (even + odd)[::-1]
    return found


def times(matrix: Real, field: Complex) -> Complex:
    """A real matrix times a complex one."""
    both = np.ascontiguousarray(field).view(np.float64)
    return (matrix @ both).view(np.complex128)


@functools.lru_cache(maxsize=256)
def legendre(count: int) -> tuple[Real, Real]:
    """Gauss-Legendre points and weights on [-1, 1]."""
    nodes, weights = roots_legendre(count)
    return np.asarray(nodes), np.asarray(weights)


def panels(edges: Real, count: int) -> tuple[Real, Real]:
    """Gauss-Legendre points of so many to each interval between neighbouring edges [..., m], and weights."""
    nodes, weights = legendre(count)
    low, high = edges[..., :-1, None], edges[..., 1:, None]
    half = (high - low) / 2
    points, shares = (high + low) / 2 + half * nodes, half * weights
    return points.reshape(*edges.shape[:-1], -1), shares.reshape(*edges.shape[:-1], -1)


def round_panels(edges: Real, count: int) -> tuple[Real, Real]:
    """The same for integrands that end like a circle's chords: x = middle + half sin φ, even in φ."""
    nodes, weights = legendre(count)
    low, high = edges[..., :-1, None], edges[..., 1:, None]
    half, turn = (high - low) / 2, math.pi / 2 * nodes
    points = (high + low) / 2 + half * np.sin(turn)
    shares = half * weights * (math.pi / 2 * np.cos(turn))
    return points.reshape(*edges.shape[:-1], -1), shares.reshape(*edges.shape[:-1], -1)


def _polynomials(count: int, x: Real) -> Real:
    """Legendre polynomials of degrees below count, [count, N]."""
    found = np.empty((count, len(x)))
    found[0] = 1.0
    if count > 1:
        found[1] = x
    for m in range(1, count - 1):
        found[m + 1] = ((2 * m + 1) * x * found[m] - m * found[m - 1]) / (m + 1)
    return found


@functools.lru_cache(maxsize=64)
def _cardinal(count: int) -> Real:
    """Coefficients over Legendre polynomials of the functions that are 1 at one point and 0 at the others."""
    nodes, weights = legendre(count)
    return _polynomials(count, nodes) * weights * (np.arange(count)[:, None] + 0.5)


def cardinals(count: int, x: Real) -> Real:
    """Those functions at places x in [-1, 1], [N, count]."""
    return _polynomials(count, x).T @ _cardinal(count)


def region_weights(count: int, radius: float, chords: Chords | None = None, fine: int | None = None) -> Real:
    """Weights [rows y, columns x] of the product of Gauss-Legendre points over [-radius, radius]² for a region in it.

    The sum is exact for what is a polynomial of degrees below count in x and y: each weight is the integral, over the
    region, of the polynomial that is 1 at its point and 0 at all others. The disc of the radius when no chords are
    given.
    """
    if chords is None:
        return radius**2 * _disc(count)
    fine = 2 * count + 40 if fine is None else fine
    return radius**2 * _within(count, lambda y: tuple(one / radius for one in chords(y * radius)), fine)


@functools.lru_cache(maxsize=32)
def _disc(count: int) -> Real:
    """Weights for the disc of radius 1, as `_within` has them, by the chords of its upper half."""
    fine = 2 * count + 40
    turns, weights = (one[fine // 2 :] for one in legendre(fine))
    y, half = np.sin(math.pi / 2 * turns), np.cos(math.pi / 2 * turns)
    # From -half to half even polynomials count twice, odd ones not at all.
    p, degrees = _polynomials(count + 1, half), np.arange(2, count, 2)[:, None]
    whole = 2 * np.concatenate([p[1:2], (p[3 : count + 1 : 2] - p[1 : count - 1 : 2]) / (2 * degrees + 1)])
    across = whole.T @ _cardinal(count)[::2]
    upper = (cardinals(count, y) * (weights * math.pi / 2 * half)[:, None]).T @ across
    return upper + upper[::-1]


def _within(count: int, chords: Chords, fine: int) -> Real:
    """Weights for a region in [-1, 1]², by so many of its chords."""
    turns, weights = legendre(fine)
    y = np.sin(math.pi / 2 * turns)
    shares = weights * math.pi / 2 * np.cos(math.pi / 2 * turns)
    low, high = chords(y)
    high = np.maximum(low, high)
    # ∫ P_m = (P_(m+1) - P_(m-1))/(2m + 1).
    ends = []
    for end in (high, low):
        p = _polynomials(count + 1, np.clip(end, -1.0, 1.0))
        whole = np.empty((count, fine))
        whole[0] = end
        m = np.arange(1, count)[:, None]
        whole[1:] = (p[2 : count + 1] - p[0 : count - 1]) / (2 * m + 1)
        ends.append(whole)
    across = (ends[0] - ends[1]).T @ _cardinal(count)
    return (cardinals(count, y) * shares[:, None]).T @ across


def interpolation(low: float, high: float, count: int, at: Real) -> tuple[Real, list[Real]]:
    """Chebyshev points between two ends, and what each adds to a value at places [...] when interpolated from them."""
    own = math.pi * (np.arange(count) + 0.5) / count
    middle, half = (high + low) / 2, max((high - low) / 2, 1e-300)
    x = np.clip((at.ravel() - middle) / half, -1.0, 1.0)
    # Chebyshev polynomials of x, and at the points by their angles.
    over = np.cos(np.outer(own, np.arange(count))) * (2 / count)
    over[:, 0] /= 2
    shares = np.empty((count, x.size))
    for i in range(0, x.size, _SLAB):
        some = x[i : i + _SLAB]
        waves = np.ones((count, len(some)))
        waves[1:2] = some
        for m in range(2, count):
            waves[m] = 2 * some * waves[m - 1] - waves[m - 2]
        shares[:, i : i + _SLAB] = over @ waves
    return middle + half * np.cos(own), list(shares.reshape(count, *at.shape))
