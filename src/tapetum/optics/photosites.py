"""Shapes of photosites, in pitches: to add one, write its class here and name it in `Shape` and `SHAPES`."""

# SciPy types its functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false

from __future__ import annotations

import itertools
import math
from typing import ClassVar, Literal, Protocol

import numpy as np
import numpy.typing as npt
from scipy.special import j1

__all__ = ["SHAPES", "Hexagon", "Photosite", "Round", "Shape", "Square", "covered"]

Real = npt.NDArray[np.float64]
Shape = Literal["square", "round", "hexagon"]
"""What `target.sensor.array.shape` may be."""

# Lines across one square along which the area under an edge is summed.
_LINES = 16
# Frequencies below which a transform equals the area.
_SLOW = 1e-6


class Photosite(Protocol):
    """A photosite in the middle of its cell, covering a share `fill` of it, symmetric left-right and up-down.

    `largest` is the most that it can fill of a square cell. `breaks` are its edges in x and y where the product of two
    steps is exact, else None.
    """

    largest: ClassVar[float]
    breaks: tuple[float, ...] | None

    def __init__(self, fill: float) -> None: ...

    def transform(self, across: Real, down: Real) -> Real:
        """∫ exp(-2πi ν·x) over it, [rows, columns] at frequencies [columns] and [rows] in cycles a pitch."""
        ...

    def half_width(self, y: Real) -> Real:
        """Half of its width at heights y; 0 beyond it."""
        ...


class Square:
    """Sides along rows and columns (Goodman, Introduction to Fourier Optics, chapter 2)."""

    largest: ClassVar[float] = 1.0

    def __init__(self, fill: float) -> None:
        self._side = math.sqrt(fill)
        self.breaks: tuple[float, ...] | None = (-self._side / 2, self._side / 2)

    def transform(self, across: Real, down: Real) -> Real:
        w = self._side
        return w**2 * np.outer(np.sinc(w * down), np.sinc(w * across))

    def half_width(self, y: Real) -> Real:
        return np.where(np.abs(y) < self._side / 2, self._side / 2, 0.0)


class Round:
    """A disc: (a/ν) J1(2π a ν) (Goodman, chapter 2)."""

    largest: ClassVar[float] = math.pi / 4

    def __init__(self, fill: float) -> None:
        self._radius = math.sqrt(fill / math.pi)
        self.breaks: tuple[float, ...] | None = None

    def transform(self, across: Real, down: Real) -> Real:
        a, nu = self._radius, np.hypot(*np.meshgrid(across, down))
        slow = nu < _SLOW
        safe = np.where(slow, 1.0, nu)
        return np.where(slow, math.pi * a**2, a * j1(2 * math.pi * a * safe) / safe)

    def half_width(self, y: Real) -> Real:
        return np.sqrt(np.maximum(self._radius**2 - y**2, 0.0))


class Hexagon:
    """Regular, with a corner above and one below."""

    # One pitch from corner to corner.
    largest: ClassVar[float] = 3 * math.sqrt(3) / 8

    def __init__(self, fill: float) -> None:
        self._corner = math.sqrt(2 * fill / math.sqrt(27))
        self._fill = fill
        self.breaks: tuple[float, ...] | None = None

    def transform(self, across: Real, down: Real) -> Real:
        """As of `Photosite`, by Gauss's theorem: each side adds its flux of exp(-2πi ν·x) i ν/2πν²."""
        x, y = np.meshgrid(across, down)
        square = x**2 + y**2
        slow = square < _SLOW**2
        safe = np.where(slow, 1.0, square)
        turn = np.pi / 3 * np.arange(7) + np.pi / 2
        corners = self._corner * np.stack([np.cos(turn), np.sin(turn)], axis=1)
        total = np.zeros_like(x)
        for (x0, y0), (x1, y1) in itertools.pairwise(corners):
            # Opposite sides make the sum real: i exp(-iφ) becomes sin φ.
            phase = np.pi * ((x0 + x1) * x + (y0 + y1) * y)
            flux = (y1 - y0) * x - (x1 - x0) * y
            total += flux * np.sinc((x1 - x0) * x + (y1 - y0) * y) * np.sin(phase)
        return np.where(slow, self._fill, total / (2 * np.pi * safe))

    def half_width(self, y: Real) -> Real:
        return np.clip(math.sqrt(3) * (self._corner - np.abs(y)), 0.0, math.sqrt(3) / 2 * self._corner)


SHAPES: dict[Shape, type[Photosite]] = {"square": Square, "round": Round, "hexagon": Hexagon}


def covered(edges: Real, site: Photosite) -> Real:
    """Share of each square between the edges of an even number of steps about the origin that a photosite covers."""
    step = edges[1] - edges[0]
    if site.breaks is not None:
        low, high = site.breaks
        line = np.diff(np.clip(edges, low, high)) / step
        return np.outer(line, line)
    # By symmetry one quadrant suffices.
    edges = edges[len(edges) // 2 :]
    y = (edges[:-1, None] + (np.arange(_LINES) + 0.5) / _LINES * step).ravel()
    inside = np.diff(np.minimum(edges[None, :], site.half_width(y)[:, None]), axis=1) / step
    quadrant = inside.reshape(len(edges) - 1, _LINES, -1).mean(1)
    half = np.concatenate([quadrant[::-1], quadrant])
    return np.concatenate([half[:, ::-1], half], axis=1)
