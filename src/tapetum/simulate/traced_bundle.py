"""Bundles of rays through a real lens, in the coordinates in which its diffraction is computed.

A bundle starts on the plane in which the pupil's rim is sharp for the probe, at e, and goes through the lens to the
sensor. A ray with the direction cosines d (transverse part) that lands at y0 + w, y0 being the middle of the spot, is
known by

    s = d - C w
    Ψ = path(e … y0 + w) - s·w - w·Cw/2   phase of the light from e, referred to y0, in metres

and the field on the sensor at y0 + v is ∫ A exp(ikΨ(s)) exp(ik(s·v + v·Cv/2)) d²s: only the departure from a point
image is sampled. Whatever C is, each ray has its place, phase and strength there. C is that of light which a place of
the pupil's rim sends on under other directions than its ray's: by diffraction, far from the spot. The lens is
rotationally symmetric: tilts are along y.

One file of more than 400 lines, because tracing a bundle and searching the box of rays to trace share their starts.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace
from typing import Protocol

import torch

from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens
from tapetum.optics.rays import Rays, to_plane, trace
from tapetum.simulate.pupil_rim import anywhere, exit_plane, rim_bend, rim_plane

__all__ = ["BEYOND", "Bundle", "Passing", "length", "limiting_surfaces", "mirrored", "right_half", "spot_middles"]
__all__ += ["trace_bundle"]

# Rays a side of the two bundles that find the pupil.
_COARSEST, _COARSE = 29, 49
# Tilts a sine at which the pupil's box is searched, four times as many where a range holds fewer than the second
# number; and how many are searched together.
_BOXES_A_SINE, _FEWEST_BOXES, _BOXES_AT_ONCE = 64, 4, 8
# Share of the box's half width by which it may be enlarged for tilts between those searched.
_MOST_MARGIN = 0.05
# Displacement of the rays beside each, in radii of the entrance pupil.
_BESIDE = 3e-6
# Rays a side up to which each bundle's own box is searched.
_FEW = 21
# How far rays extend beyond the pupil's edge, so that its polynomials hold on both sides of it.
BEYOND = 1.06
# Places between two rays, along either axis, where rims are compared.
_BETWEEN = 8


class Passing(Protocol):
    """Rays that may be stopped."""

    @property
    def passing(self) -> torch.Tensor: ...
    @property
    def near(self) -> torch.Tensor: ...


@dataclass(frozen=True)
class Bundle:
    """Rays of F fields, N each, tilted along y. Lengths in metres; s has no unit.

    Parameters
    ----------
    e
        [F, N, 2] where they cross the plane of the pupil's rim, from where the axis of the light does.
    direction
        [F, N, 2] direction cosines across the axis at the sensor.
    landing
        [F, N, 2] where they meet the sensor.
    path
        [F, N] of the wave up to there.
    slopes
        [F, N, 2, 2, 2] derivatives of `direction` and `landing` by e; NaN where they were not asked for.
    middle
        [F] y of y0 on the sensor.
    radius
        [F] distance R of y0 from the exit pupil's middle.
    bend
        C in 1/m, `rim_bend` of the lens.
    before
        [F, N] path of the wave before e.
    rays
        Behind the last surface.
    """

    e: torch.Tensor
    direction: torch.Tensor
    landing: torch.Tensor
    path: torch.Tensor
    slopes: torch.Tensor
    middle: torch.Tensor
    radius: torch.Tensor
    bend: float
    before: torch.Tensor
    rays: Rays

    @property
    def beside(self) -> torch.Tensor:
        """[F, N, 2] from y0 to where they meet the sensor."""
        y0 = torch.stack([torch.zeros_like(self.middle), self.middle], -1)
        return self.landing - y0[:, None]

    @property
    def s(self) -> torch.Tensor:
        """[F, N, 2], see the module."""
        return self.direction - self.bend * self.beside

    @property
    def psi(self) -> torch.Tensor:
        """[F, N], see the module."""
        w = self.beside
        return self.path - ((self.direction - self.bend / 2 * w) * w).sum(-1)

    @property
    def jacobian(self) -> torch.Tensor:
        """[F, N] |∂s/∂e|, in 1/m²."""
        by_e = self.slopes[..., 0, :, :] - self.bend * self.slopes[..., 1, :, :]
        return (by_e[..., 0, 0] * by_e[..., 1, 1] - by_e[..., 0, 1] * by_e[..., 1, 0]).abs()

    @property
    def near(self) -> torch.Tensor:
        """[F, N] rays that pass or miss by little, to which functions of the pupil are fitted."""
        return self.good & (self.height <= BEYOND**2).all(-1)

    @property
    def height(self) -> torch.Tensor:
        """[F, N, S] squared heights at the surfaces over squared semi-diameters."""
        return self.rays.height

    @property
    def good(self) -> torch.Tensor:
        """[F, N] whether they came through, vignetting apart."""
        return self.rays.good

    @property
    def passing(self) -> torch.Tensor:
        """[F, N] rays that no rim stops."""
        return self.good & (self.height <= 1).all(-1)


def trace_bundle(
    focused: FocusedLens,
    sines: torch.Tensor,
    *,
    curvature: float = 0.0,
    middle: torch.Tensor | None = None,
    count: int = 37,
    box: tuple[torch.Tensor, torch.Tensor] | None = None,
    sloped: bool = True,
) -> Bundle:
    """Trace the light of a far source (or of one at 1/curvature) under tilts along y.

    Parameters
    ----------
    focused
        The lens.
    sines
        [F] sines of the tilt.
    curvature
        Of the wave at the entrance pupil, in 1/m.
    middle
        [F] y of the points that phases are referred to; default: the spots' own.
    count
        Rays a side of each bundle.
    box
        Corners [F, 2] of where rays start on the entrance pupil, in metres, symmetric left and right; default: all of
        it.
    sloped
        Whether to compute the `jacobian`, which takes about half of the time.

    Raises
    ------
    InputError
        Where no ray gets through.
    """
    if box is None:
        ways = _kept_ways(anywhere(focused), _tilts(sines), curvature, count, sloped)
    else:
        ways = _followed(anywhere(focused), _starts(box, count), sines, curvature, sloped)
    way = (focused.image - ways.place[..., 2]) / ways.direction[..., 2]
    places = ways.place + way[..., None] * ways.direction
    landing, direction, path = places[:, 0, :, :2], ways.direction[:, 0, :, :2], ways.path + way[:, 0]
    slopes = torch.full((*landing.shape, 2, 2), torch.nan, dtype=landing.dtype)
    good = ways.rays.good & torch.isfinite(path)
    if sloped:
        # Derivatives of both by e, from the rays beside each.
        both = torch.stack([ways.direction[..., :2], places[..., :2]], -2)
        slopes = torch.stack([both[:, 1] - both[:, 0], both[:, 2] - both[:, 0]], -1) / ways.step
        good = good & ways.together & torch.isfinite(slopes).flatten(2).all(-1)
    middle = _middle(landing, ways.rays) if middle is None else middle
    radius = torch.hypot(middle, torch.full_like(middle, focused.image - exit_plane(focused)))
    rays = replace(ways.rays, good=good)
    return Bundle(ways.e, direction, landing, path, slopes, middle, radius, rim_bend(focused), ways.before, rays)


@dataclass(frozen=True)
class _Ways:
    """Rays of a bundle behind the lens; where the sensor stands does not matter.

    `place` and `direction` [F, 1 or 3, N, 3] are those of each ray at z = 0, and of two that start `step` metres beside
    it across and along the tilt; `together` [F, N] is whether all three came through, `path` [F, N] that of each ray,
    `before` [F, N] that of the wave before e.
    """

    e: torch.Tensor
    rays: Rays
    before: torch.Tensor
    place: torch.Tensor
    direction: torch.Tensor
    path: torch.Tensor
    together: torch.Tensor
    step: float


def _tilts(sines: torch.Tensor) -> tuple[float, ...]:
    return tuple(float(one) for one in sines)


# Planes that interfere, and the checks of each, ask for the same bundles of a lens.
@functools.lru_cache(maxsize=8)
def _kept_ways(lens: FocusedLens, tilts: tuple[float, ...], curvature: float, count: int, sloped: bool) -> _Ways:
    sines = torch.tensor(tilts, dtype=torch.float64)
    # The mean of few rays depends on where the box ends.
    boxes = _searched_boxes if count <= _FEW else _pupil_boxes
    lower, upper = boxes(lens, sines, curvature)
    more = (upper - lower) / 2 * (BEYOND - 1)
    return _followed(lens, _starts((lower - more, upper + more), count), sines, curvature, sloped)


def _followed(focused: FocusedLens, e: torch.Tensor, sines: torch.Tensor, curvature: float, sloped: bool) -> _Ways:
    right, count, step = right_half(e), math.isqrt(e.shape[1]), _BESIDE * focused.entrance_radius
    fields, wide = right.shape[:2]
    # Rays beside each, whose places give the derivatives: three rays take less than one with its gradients.
    starts = [[0.0, 0.0], [step, 0.0], [0.0, step]] if sloped else [[0.0, 0.0]]
    right = (right[:, None] + torch.tensor(starts, dtype=e.dtype)[:, None]).flatten(1, 2)
    start, way, before = _incoming(focused, right, sines, curvature)
    rays = trace(focused.lens, start, way)
    # The index behind the lens is 1: the sensor stands in air.
    place, back = to_plane(rays.position, rays.direction, 0.0)
    path = before + rays.path + back
    turn = place.new_tensor([-1.0, 1.0, 1.0])

    def whole(values: torch.Tensor, turn: torch.Tensor | None = None) -> torch.Tensor:
        """[F, 1 or 3, N, …] of values on the right of the middle, mirrored to the left."""
        parts = values.reshape(fields, -1, wide, *values.shape[2:])
        return torch.stack([_both(part, count, turn) for part in parts.unbind(1)], 1)

    places, directions = whole(place, turn), whole(rays.direction, turn)
    if sloped:
        # Left of the middle the ray beside stands on the other side.
        left = torch.zeros(count, count, dtype=torch.bool)
        left[:, : count // 2] = True
        left = left.flatten()[:, None]
        places, directions = (
            torch.stack([one[:, 0], torch.where(left, 2 * one[:, 0] - one[:, 1], one[:, 1]), one[:, 2]], 1)
            for one in (places, directions)
        )
    own = Rays(**{name: value[:, :wide] for name, value in vars(rays).items()})
    return _Ways(
        e,
        mirrored(own, count),
        _both(before[:, :wide], count),
        places,
        directions,
        _both(path[:, :wide], count),
        whole(rays.good).all(1),
        step,
    )


def right_half(values: torch.Tensor) -> torch.Tensor:
    """Of values [F, n², …] on a square of rays, those from its middle column to the right: tilts are along y."""
    count = math.isqrt(values.shape[1])
    square = values.reshape(values.shape[0], count, count, *values.shape[2:])
    return square[:, :, count // 2 :].flatten(1, 2)


def mirrored(rays: Rays, count: int) -> Rays:
    """All n² rays from those of the `right_half`."""
    turn = rays.position.new_tensor([-1.0, 1.0, 1.0])
    return Rays(
        _both(rays.position, count, turn),
        _both(rays.direction, count, turn),
        _both(rays.path, count),
        _both(rays.height, count),
        _both(rays.good, count),
    )


def _both(values: torch.Tensor, count: int, turn: torch.Tensor | None = None) -> torch.Tensor:
    """Values [F, n², …] from those of the right half, mirrored to the left; vectors are mirrored too."""
    right = values.reshape(values.shape[0], count, -1, *values.shape[2:])
    left = right[:, :, count % 2 :].flip(2)
    return torch.cat([left if turn is None else left * turn, right], 2).flatten(1, 2)


def spot_middles(focused: FocusedLens, sines: torch.Tensor, *, count: int) -> torch.Tensor:
    """Mean y in metres, [F], at which the light of a far source meets the sensor, as `trace_bundle` has it.

    Parameters and errors are the same. Without derivatives it takes half the time.
    """
    return trace_bundle(focused, sines, count=count, sloped=False).middle


def _starts(box: tuple[torch.Tensor, torch.Tensor], count: int) -> torch.Tensor:
    """Where the rays of each bundle cross the entrance pupil's plane, [F, N, 2], within its box."""
    lower, upper = box
    line = torch.linspace(-1, 1, count, dtype=torch.float64)
    grid = torch.stack(torch.meshgrid(line, line, indexing="xy"), -1).reshape(-1, 2)
    return (upper + lower)[:, None, :] / 2 + (upper - lower)[:, None, :] / 2 * grid


def _middle(landing: torch.Tensor, rays: Rays) -> torch.Tensor:
    """Mean y [F] at which those rays that pass meet the sensor, of landings [F, N, 2]."""
    passing = rays.good & (rays.height <= 1).all(-1)
    # A stray ray may not have landed at all.
    landed = torch.where(passing, landing[..., 1], torch.zeros_like(landing[..., 1]))
    return (landed.sum(-1) / passing.sum(-1)).detach()


def _incoming(
    focused: FocusedLens, e: torch.Tensor, sines: torch.Tensor, curvature: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Starting points [F, N, 3], directions and paths so far beyond that of the axis."""
    axis = torch.stack([torch.zeros_like(sines), sines, torch.sqrt(1 - sines**2)], -1)[:, None, :]
    across = torch.cat([e, torch.zeros_like(e[..., :1])], -1)
    middle = rim_plane(focused, sines)[:, None]
    start, along = across + middle, (across * axis).sum(-1)
    if curvature == 0:
        return start, axis.expand_as(start), along
    # From the middle of the entrance pupil, that far along the axis; the source lies 1/curvature before it.
    farther = ((middle - middle.new_tensor([0.0, 0.0, focused.entrance_pupil])) * axis).sum(-1)
    across = across + farther[..., None] * axis
    way = across * curvature + axis
    far = length(way)[..., None]
    # |e - source| - D, without cancellation.
    before = (2 * (along + farther) + curvature * (across**2).sum(-1)) / (far[..., 0] + 1)
    return start, way / far, before - farther


def _pupil_boxes(focused: FocusedLens, sines: torch.Tensor, curvature: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Corners [F, 2] of the boxes that hold the passing rays of each field.

    They are interpolated between tilts in equal steps, which all bundles of a lens share.
    """
    lens, steepest, finer = anywhere(focused), float(sines.abs().max()), _BOXES_A_SINE
    while 1e-3 < steepest < _FEWEST_BOXES / finer:
        finer *= 4
    place = sines.abs() * finer
    below = place.floor().long()
    steps = range(0, int(below.max()) + 3, _BOXES_AT_ONCE)
    edges = torch.cat([_boxes_from(lens, first, finer, curvature) for first in steps])
    # Left and right of the axis the box is the same, mirrored.
    edges = torch.cat([edges[1:2, [0, 2, 1]], edges])
    bent = (edges[2:] - 2 * edges[1:-1] + edges[:-2]).abs() / 2
    edges, share = edges[1:], (place - below)[:, None]
    # Where another rim begins to cut, the edge has a corner, at which the chord errs by at most this.
    margin = torch.maximum(bent[below], bent[below + 1])
    wide, down, up = (edges[below] * (1 - share) + edges[below + 1] * share + margin).unbind(-1)
    narrow = margin.amax(-1) < _MOST_MARGIN * torch.minimum(wide, (down + up) / 2)
    if not bool(narrow.all()):
        # The last tilts before the field ends, where the pupil changes fast or is dark: NaN is not less either.
        return _searched_boxes(lens, sines, curvature)
    down, up = torch.where(sines < 0, up, down), torch.where(sines < 0, down, up)
    return torch.stack([-wide, -down], -1), torch.stack([wide, up], -1)


@functools.lru_cache(maxsize=64)
def _boxes_from(lens: FocusedLens, first: int, finer: int, curvature: float) -> torch.Tensor:
    """Half width and reach down and up, [_BOXES_AT_ONCE, 3], of the boxes at some steps of the tilt; NaN where dark."""
    sines = torch.arange(first, first + _BOXES_AT_ONCE, dtype=torch.float64) / finer
    edges = torch.full((_BOXES_AT_ONCE, 3), torch.nan, dtype=torch.float64)
    some = sines < 1
    if bool(some.any()):
        lower, upper = _search(lens, sines[some], curvature)
        edges[some] = torch.stack([upper[:, 0], -lower[:, 1], upper[:, 1]], -1)
    return edges


def _searched_boxes(focused: FocusedLens, sines: torch.Tensor, curvature: float) -> tuple[torch.Tensor, torch.Tensor]:
    lower, upper = _search(focused, sines, curvature)
    dark = ~torch.isfinite(upper[:, 0])
    if bool(dark.any()):
        tilt = float(torch.rad2deg(torch.asin(sines[dark][0])))
        raise InputError(
            f"no ray gets through the lens at a tilt of {tilt:.3g} deg",
            where="target.lens",
            remedy="stay within the field it covers, or check its semi-diameters",
        )
    return lower, upper


def _search(focused: FocusedLens, sines: torch.Tensor, curvature: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Corners [F, 2] of the boxes, found by two grids of rays, the second within the first one's; NaN where dark."""
    reach = 2.2 * focused.entrance_radius
    lower = torch.full((len(sines), 2), -reach, dtype=torch.float64)
    upper, lit = -lower, torch.ones(len(sines), 1, dtype=torch.bool)
    # Few rays find the pupil, more its edges.
    for count in (_COARSEST, _COARSE):
        line = torch.linspace(-1, 1, count, dtype=torch.float64)
        # Left and right are symmetric: x from the middle on.
        grid = torch.stack(torch.meshgrid(line[count // 2 :], line, indexing="xy"), -1).reshape(-1, 2)
        centre, half = (upper + lower) / 2, (upper - lower) / 2
        e = centre[:, None, :] + half[:, None, :] * grid
        start, way, _ = _incoming(focused, e, sines, curvature)
        rays = trace(focused.lens, start, way)
        passing = (rays.good & (rays.height <= 1).all(-1))[..., None]
        lit = lit & passing.any(1)
        # One grid step more on either side: the edge lies between the last ray that passes and the next.
        step = 2 * half / (count - 1)
        lower = torch.where(lit, torch.where(passing, e, math.inf).amin(1) - step, lower)
        upper = torch.where(lit, torch.where(passing, e, -math.inf).amax(1) + step, upper)
        lower[:, 0] = -upper[:, 0]
    return torch.where(lit, lower, torch.nan), torch.where(lit, upper, torch.nan)


def length(vectors: torch.Tensor) -> torch.Tensor:
    """Euclidean length of vectors [..., n]: [...]."""
    return torch.sqrt((vectors**2).sum(-1))


def limiting_surfaces(bundle: Bundle) -> list[int]:
    """Numbers of the surfaces whose rims bound the pupil: few that together stop what is stopped.

    In many designs rims nearly coincide, so that one of them cuts off slivers that lie between the rays. Heights are
    interpolated there.
    """
    rays = bundle.good[..., None] & (bundle.height > 1)
    chosen = _covering(rays, [])
    return sorted(_covering(_stopped_between(bundle, chosen), chosen)) if chosen else chosen


def _covering(stopped: torch.Tensor, chosen: list[int]) -> list[int]:
    """`chosen` and the fewest surfaces that stop all else of what surfaces stop, [F, N, S]."""
    left = stopped & ~stopped[..., chosen].any(-1, keepdim=True)
    while int((count := left.sum((0, 1))).max()):
        chosen = [*chosen, int(count.argmax())]
        left = left & ~left[..., chosen[-1:]]
    return chosen


def _stopped_between(bundle: Bundle, chosen: list[int]) -> torch.Tensor:
    """Which surfaces stop places between neighbouring rays that those `chosen` may not all stop, [M, P, S]."""
    count = math.isqrt(bundle.height.shape[1])

    def corners_of(rays: torch.Tensor) -> torch.Tensor:
        square, ends = rays.reshape(len(rays), count, count, -1), (slice(None, -1), slice(1, None))
        return torch.stack([square[:, row, column] for row in ends for column in ends])

    corners, whole = corners_of(bundle.height), corners_of(bundle.good).all(0)[..., 0]
    some = whole & (corners.amax(0) > 1).any(-1) & (corners.amin(0)[..., chosen] <= 1).all(-1)
    at = (torch.arange(_BETWEEN, dtype=torch.float64) + 0.5) / _BETWEEN
    line = torch.stack([1 - at, at])
    weights = torch.einsum("ai,bj->abij", line, line).flatten(2).flatten(0, 1)
    return torch.einsum("cms,cp->mps", corners[:, some], weights) > 1
