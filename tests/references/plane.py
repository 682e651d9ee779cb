"""What reflects behind a lens, as the judge takes it: a plane with its edge, its photosites, microlenses or mask.

Coordinates are those of the sensor, from the optical axis. `points` lays out the points of a sum over the plane so that
no edge runs between two of them: rows at heights v, each with its own places u.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .quadrature import Complex, Real, panels, phasor, round_panels

__all__ = ["Cells", "Mask", "Plane", "Points", "Rectangle", "TooLargeError", "points"]


# Points of a sum over a plane.
_MOST, _MOST_ROWS = 1.5e7, 8000


class TooLargeError(Exception):
    """The scene takes more points than the judge may have."""


@dataclass(frozen=True)
class Rectangle:
    """Where a sensor ends: its middle against the axis, and its width and height, in metres."""

    middle: tuple[float, float]
    size: tuple[float, float]


@dataclass(frozen=True)
class Cells:
    """Photosites in rows and columns from a corner, with a microlens over each where there are some.

    `side` or `radius` of a photosite; the amplitude of the `surround`; `tiles` [rows, columns] the amplitudes of the
    colours; of a microlens the focal length, the radius, and how far it stands off by the metre of image height.
    """

    corner: tuple[float, float]
    pitch: float
    side: float | None
    radius: float | None
    surround: complex
    tiles: Real
    wavenumber: float
    lens: tuple[float, float, float] | None = None
    middle: tuple[float, float] = (0.0, 0.0)

    @property
    def separate(self) -> bool:
        """Whether all edges run along rows and columns."""
        return self.lens is None and self.side is not None

    @property
    def steepest(self) -> float:
        """Steepest phase of its own, in rad/m."""
        return 0.0 if self.lens is None else 2 * self.wavenumber * self.lens[1] / self.lens[0]

    def centres(self, axis: int, low: float, high: float) -> Real:
        """Of the photosites that an interval touches, and one more on either side."""
        first = math.floor((low - self.corner[axis]) / self.pitch) - 1
        last = math.floor((high - self.corner[axis]) / self.pitch) + 1
        return self.corner[axis] + (np.arange(first, last + 1) + 0.5) * self.pitch

    def lenses(self, axis: int, centres: Real) -> Real:
        """Centres of the microlenses that belong to these photosites."""
        shift = 0.0 if self.lens is None else self.lens[2]
        return centres - shift * (centres - self.middle[axis])

    def breaks(self, axis: int, low: float, high: float, off: Real | None = None) -> Real:
        """Where something ends along an axis: [m], or [N, m] in rows that lie at `off` [N] across the other axis."""
        centres = self.centres(axis, low, high)
        half = self.side / 2 if self.side is not None else self.radius
        assert half is not None
        rows = np.zeros(1) if off is None else off
        halves = np.full(len(rows), half)
        if off is not None and self.radius is not None:
            nearest = self._nearest(1 - axis, off)
            halves = np.sqrt(np.maximum(self.radius**2 - (off - nearest) ** 2, 0.0))
        found = [
            np.broadcast_to(centres - self.pitch / 2, (len(rows), len(centres))),
            centres - halves[:, None],
            centres + halves[:, None],
        ]
        if self.lens is not None:
            lenses, radius = self.lenses(axis, centres), np.full(len(rows), self.lens[1])
            if off is not None:
                apart = off - self.lenses(1 - axis, self._nearest(1 - axis, off, True))
                radius = np.sqrt(np.maximum(self.lens[1] ** 2 - apart**2, 0.0))
            found += [lenses - radius[:, None], lenses + radius[:, None]]
            between = (lenses[1:] + lenses[:-1]) / 2
            found.append(np.broadcast_to(between, (len(rows), len(between))))
        every = np.sort(np.clip(np.concatenate(found, axis=1), low, high), axis=1)
        ends = np.full((len(rows), 1), low), np.full((len(rows), 1), high)
        every = np.concatenate([ends[0], every, ends[1]], axis=1)
        return every[0] if off is None else every

    def _nearest(self, axis: int, at: Real, of_lenses: bool = False) -> Real:
        """Centres of the photosites that places lie in; or those whose microlens is the nearest one."""
        if of_lenses and self.lens is not None:
            # Centre c has its lens at c (1 - shift) + shift middle.
            shift = self.lens[2]
            at = (at - shift * self.middle[axis]) / (1 - shift)
        return self.corner[axis] + (np.floor((at - self.corner[axis]) / self.pitch) + 0.5) * self.pitch

    def __call__(self, x: Real, y: Real) -> Complex:
        """Amplitude at places, before the sensor's own reflectance."""
        column = np.floor((x - self.corner[0]) / self.pitch)
        row = np.floor((y - self.corner[1]) / self.pitch)
        dx = x - self.corner[0] - (column + 0.5) * self.pitch
        dy = y - self.corner[1] - (row + 0.5) * self.pitch
        if self.side is not None:
            inside = (np.abs(dx) < self.side / 2) & (np.abs(dy) < self.side / 2)
        else:
            assert self.radius is not None
            inside = dx**2 + dy**2 < self.radius**2
        rows, columns = self.tiles.shape
        values = np.where(inside, 1.0, self.surround)
        values = values * self.tiles[np.mod(row, rows).astype(int), np.mod(column, columns).astype(int)]
        if self.lens is not None:
            focal, radius, _ = self.lens
            lx = x - self.lenses(0, self._nearest(0, x, True))
            ly = y - self.lenses(1, self._nearest(1, y, True))
            values = values * phasor(-self.wavenumber / focal * np.minimum(lx**2 + ly**2, radius**2))
        return np.asarray(values, np.complex128)


@dataclass(frozen=True)
class Mask:
    """Complex amplitudes on a grid, linear between its points and nothing a pitch beyond the outer ones."""

    values: Complex
    pitch: float
    middle: tuple[float, float] = (0.0, 0.0)

    separate = True
    steepest = 0.0

    @staticmethod
    def read(file: str, pitch: float, middle: tuple[float, float]) -> Mask:
        """A mask from its file."""
        return Mask(np.load(Path(file), allow_pickle=False).astype(np.complex128), pitch, middle)

    def breaks(self, axis: int, low: float, high: float, off: Real | None = None) -> Real:
        """The lines of the grid, and what ends the interval."""
        count = self.values.shape[1 - axis]
        lines = self.middle[axis] + (np.arange(-1, count + 1) - (count - 1) / 2) * self.pitch
        # Beyond its outer lines there is nothing to be summed.
        low, high = max(low, float(lines[0])), min(high, float(lines[-1]))
        inside = lines[(lines > low) & (lines < high)]
        every = np.concatenate([[low], inside, [max(low, high)]])
        return every if off is None else np.broadcast_to(every, (len(off), len(every)))

    def __call__(self, x: Real, y: Real) -> Complex:
        """Amplitude at places."""
        padded = np.pad(self.values, 2)
        rows, columns = self.values.shape
        across = np.clip((x - self.middle[0]) / self.pitch + (columns - 1) / 2 + 2, 0, columns + 2.999)
        down = np.clip((y - self.middle[1]) / self.pitch + (rows - 1) / 2 + 2, 0, rows + 2.999)
        i, j = np.floor(down).astype(int), np.floor(across).astype(int)
        p, q = down - i, across - j
        top = padded[i, j] * (1 - q) + padded[i, j + 1] * q
        return top * (1 - p) + (padded[i + 1, j] * (1 - q) + padded[i + 1, j + 1] * q) * p


@dataclass(frozen=True)
class Points:
    """Points of a sum over a plane: rows at `v` [N], places `u` [N, m] in each, weights [N, m] that hold the amplitude.

    With `product` all rows have the same places.
    """

    v: Real
    u: Real
    weights: Complex
    product: bool


@dataclass(frozen=True)
class Plane:
    """A plane that reflects.

    Parameters
    ----------
    distance
        z behind the lens, divided by the index where there is one between, in metres.
    amplitude
        Of its reflection, with what the layers before it take.
    path
        By how much the way to it and back is shorter than the sensor's, in metres of air.
    tilt
        It lies a·u farther at the place u.
    edge
        Where it ends; None where it does not.
    pattern
        What is on it; None for a mirror.
    depth, index
        Of a layer: where it lies before the sensor, for lenses that are traced.
    """

    distance: float
    amplitude: float = 1.0
    path: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)
    edge: Rectangle | None = None
    pattern: Cells | Mask | None = None
    depth: float = 0.0
    index: float = 1.0

    def cuts(self, centre: Real, half: float) -> bool:
        """Whether the plane's edge runs through a square about a place."""
        if self.edge is None:
            return False
        return bool((np.abs(centre - self.edge.middle) + half > np.array(self.edge.size) / 2).any())

    def endless(self) -> Plane:
        """The plane without its edge."""
        return replace(self, edge=None)


def points(plane: Plane, centre: Real, half: float, flat: float, density: float, effort: float) -> Points | None:
    """Points of a sum over what of a plane lies within `half` of a centre [2]; beyond `flat` they fade out.

    Parameters
    ----------
    plane, centre, half, flat
        What of which plane, lengths in metres.
    density
        Steepest phase of what is summed, in rad/m, along either axis.
    effort
        Times the points needed by the rule of thumb.

    Returns
    -------
    Points or None
        None where nothing of the plane lies there.
    """
    low, high = centre - half, centre + half
    pattern = plane.pattern
    if plane.edge is not None:
        middle, size = np.array(plane.edge.middle), np.array(plane.edge.size)
        low, high = np.maximum(low, middle - size / 2), np.minimum(high, middle + size / 2)
        if (low >= high).any():
            return None
    steep = density + (0.0 if pattern is None else pattern.steepest)
    curved = pattern is not None and not pattern.separate
    if pattern is None:
        rows, across = (np.linspace(low[i], high[i], 2 + int(steep * (high[i] - low[i]) / 24)) for i in (1, 0))
    else:
        rows, across = pattern.breaks(1, low[1], high[1]), pattern.breaks(0, low[0], high[0])
    v, dv = (round_panels if curved else panels)(rows, _count(rows, steep * (1.6 if curved else 1), effort))
    if curved and len(v) < _MOST_ROWS:
        across = pattern.breaks(0, low[0], high[0], v)
    count = _count(across, steep, effort)
    if len(v) >= _MOST_ROWS or len(v) * across.shape[-1] * count > _MOST:
        raise TooLargeError(f"{len(v)} rows of {across.shape[-1] * count} points of the plane")
    u, du = panels(across, count)
    u, du = np.broadcast_to(u, (len(v), u.shape[-1])), np.broadcast_to(du, (len(v), du.shape[-1]))
    weights = du * dv[:, None] * plane.amplitude
    away = np.hypot(u - centre[0], v[:, None] - centre[1])
    t = np.clip((half - away) / (half - flat), 0.0, 1.0)
    weights = (weights * (t**3 * (10 - 15 * t + 6 * t**2))).astype(np.complex128)
    if pattern is not None:
        weights = weights * pattern(u, np.broadcast_to(v[:, None], u.shape))
    return Points(v, u, weights, not curved)


def _count(edges: Real, steep: float, effort: float) -> int:
    """Points of a panel: the longest one's phase decides."""
    phase = steep * float(np.diff(edges, axis=-1).max()) / 2
    return max(2, math.ceil(effort * (0.75 * phase + 2)))
