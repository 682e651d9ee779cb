"""Rays through a sequence of rotationally symmetric surfaces: batched, and differentiable in every number of the lens.

The surfaces stand on the z axis. Light travels towards +z; `reversed_lens` reverses the lens for returning light.
Distances along a ray may be negative: a ray can start from the entrance pupil, behind the first surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

__all__ = ["Lens", "Rays", "before", "normals", "reversed_lens", "sag", "to_plane", "trace", "trace_out"]

_ITERATIONS = 12
# Largest residual of a root of a surface's equation, over its semi-diameter; other roots are stray.
_RESIDUAL = 1e-7
# Newton's last step, in metres: its errors square, so that at any curvature below 1e5/m less than 1e-15 m is left.
_LAST_STEP = 1e-10
# Floor of 1 - (1 + κ) c² r², which is zero where a conic turns back; rays below it are not good.
_TURNING = 1e-4


@dataclass(frozen=True, eq=False)
class Lens:
    """Surfaces in sequence, as tensors in SI units (float64). Two are equal when they are the same object.

    Parameters
    ----------
    z
        [S] places of their vertices on the axis.
    curvature, conic
        [S] 1/R, positive with the centre behind the surface, and the conic constant.
    asphere
        [S, P] coefficients of r², r³, … r^(P+1), in m^(1-p).
    semi_diameter
        [S] beyond which a surface stops a ray.
    index
        [S + 1] refractive indices, before the first surface to behind the last one.
    stop
        Number of the aperture stop.
    """

    z: torch.Tensor
    curvature: torch.Tensor
    conic: torch.Tensor
    asphere: torch.Tensor
    semi_diameter: torch.Tensor
    index: torch.Tensor
    stop: int

    def __len__(self) -> int:
        return len(self.z)

    @property
    def differentiable(self) -> bool:
        """Whether gradients run through any of its numbers."""
        return any(one.requires_grad for one in vars(self).values() if isinstance(one, torch.Tensor))

    # A lens is traced many times: its numbers are read once, where no gradient runs through them.
    @cached_property
    def read(self) -> tuple[_Surface, ...]:
        """Its surfaces' numbers."""
        return tuple(_made_surface(self, i) for i in range(len(self)))

    @cached_property
    def turned(self) -> Lens:
        """The lens reversed."""
        return _made_reversed(self)


@dataclass(frozen=True)
class Rays:
    """Places of rays, and the paths that led there.

    Parameters
    ----------
    position, direction
        [..., 3] in metres, and unit vectors.
    path
        [...] optical path so far, in metres.
    height
        [..., S] squared distance from the axis at every surface over its squared semi-diameter: above 1 it is stopped.
    good
        [...] whether every surface was met and passed by refraction.
    """

    position: torch.Tensor
    direction: torch.Tensor
    path: torch.Tensor
    height: torch.Tensor
    good: torch.Tensor


def sag(lens: Lens, i: int, r_squared: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Sag of surface i at squared distances from the axis, in metres, and its slope over twice the distance.

    sag = c r²/(1 + sqrt(1 - (1 + κ) c² r²)) + Σ a_p r^p. The second value is d sag/d(r²): times 2x it is d sag/dx.
    """
    return _sag(_surface(lens, i), r_squared)


def normals(lens: Lens, i: int, position: torch.Tensor) -> torch.Tensor:
    """Unit normals [..., 3] of surface i at points [..., 3] of it, towards +z."""
    _, slope = sag(lens, i, position[..., 0] ** 2 + position[..., 1] ** 2)
    normal = torch.stack([-2 * slope * position[..., 0], -2 * slope * position[..., 1], torch.ones_like(slope)], dim=-1)
    return normal / torch.sqrt((normal**2).sum(-1, keepdim=True))


def trace(lens: Lens, position: torch.Tensor, direction: torch.Tensor) -> Rays:
    """Send rays through all surfaces.

    Parameters
    ----------
    lens
        The surfaces.
    position, direction
        [..., 3], float64: any point of each ray before the first surface's refraction, and its unit direction.

    Returns
    -------
    Rays
        At the last surface, directions behind it. Rays that miss a surface or are totally reflected hold finite,
        meaningless numbers and are not `good`; vignetted rays continue (see `height`).

    Notes
    -----
    Intersections with conics solve a quadratic equation. For aspheres Newton's method finds them without recording
    gradients; one more step with gradients makes the derivative exact (implicit function theorem). A root counts only
    where its residual vanishes: beyond the clear aperture of an asphere Newton finds roots that belong to no ray.
    """
    path = torch.zeros_like(position[..., 0])
    if len(lens) == 0:
        return Rays(position, direction, path, position.new_zeros(*path.shape, 0), torch.ones_like(path).bool())
    good = torch.ones_like(path, dtype=torch.bool)
    heights: list[torch.Tensor] = []
    # Coordinates apart: each operation then runs over one dense row of numbers.
    x, y, z = (one.contiguous() for one in position.unbind(-1))
    a, b, c = (one.contiguous() for one in direction.expand_as(position).unbind(-1))
    for i in range(len(lens)):
        surface, index, behind = _surface(lens, i), _number(lens.index[i]), _number(lens.index[i + 1])
        t = _distance(surface, (x, y, z), (a, b, c))
        x, y, z = torch.addcmul(x, t, a), torch.addcmul(y, t, b), torch.addcmul(z, t, c)
        path = path + index * t
        r_squared = torch.addcmul(x * x, y, y)
        height, slope = _sag(surface, r_squared)
        off = (z - surface.z - height).detach().abs()
        turning = (1 - surface.bend * r_squared).detach()
        good = good & (off < _RESIDUAL * _plain(surface.semi_diameter)) & (turning > _TURNING)
        heights.append(r_squared / surface.semi_diameter**2)
        # Snell's law in vector form, for the normal (-2 slope x, -2 slope y, 1) over its length.
        ratio, twice = index / behind, 2 * slope
        shorter = torch.rsqrt(torch.addcmul(torch.ones_like(slope), twice * twice, r_squared))
        cosine = (c - twice * torch.addcmul(x * a, y, b)) * shorter
        square = 1 - ratio**2 * (1 - cosine * cosine)
        passed = square > 0
        root = torch.sqrt(torch.where(passed, square, torch.ones_like(square)))
        along = (root - ratio * cosine) * shorter
        across = twice * along
        a, b, c = ratio * a - across * x, ratio * b - across * y, ratio * c + along
        good = good & passed
    at, way = torch.stack([x, y, z], -1), torch.stack([a, b, c], -1)
    return Rays(at, way, path, torch.stack(heights, dim=-1), good)


def trace_out(lens: Lens, position: torch.Tensor, direction: torch.Tensor) -> Rays:
    """Send rays that come from behind the lens, towards -z, out through all surfaces; arguments as for `trace`.

    Returns
    -------
    Rays
        At the first surface, in the lens's own coordinates, heights in the order of its surfaces.
    """
    if len(lens) == 0:
        return trace(lens, position, direction)
    # In the reversed lens both z and the light are reversed.
    flip, end = position.new_tensor([1.0, 1.0, -1.0]), lens.z[-1] * position.new_tensor([0.0, 0.0, 1.0])
    rays = trace(reversed_lens(lens), (position - end) * flip, direction * flip)
    return replace(
        rays, position=rays.position * flip + end, direction=rays.direction * flip, height=rays.height.flip(-1)
    )


def before(lens: Lens, surface: int) -> Lens:
    """The surfaces before one of this number; the stop is the nearest of them where it lies behind."""
    return replace(
        lens,
        z=lens.z[:surface],
        curvature=lens.curvature[:surface],
        conic=lens.conic[:surface],
        asphere=lens.asphere[:surface],
        semi_diameter=lens.semi_diameter[:surface],
        index=lens.index[: surface + 1],
        stop=min(lens.stop, max(surface - 1, 0)),
    )


def to_plane(position: torch.Tensor, direction: torch.Tensor, z: torch.Tensor | float) -> tuple[torch.Tensor, ...]:
    """Where rays meet a plane across the axis, [..., 3], and the distance to it along each, [...]."""
    t = (z - position[..., 2]) / direction[..., 2]
    return position + t[..., None] * direction, t


def reversed_lens(lens: Lens) -> Lens:
    """The lens reversed: z is counted from the old last vertex, towards the old first one."""
    return _made_reversed(lens) if lens.differentiable else lens.turned


def _made_reversed(lens: Lens) -> Lens:
    return replace(
        lens,
        z=(lens.z[-1] - lens.z).flip(0),
        curvature=-lens.curvature.flip(0),
        conic=lens.conic.flip(0),
        asphere=-lens.asphere.flip(0),
        semi_diameter=lens.semi_diameter.flip(0),
        index=lens.index.flip(0),
        stop=len(lens) - 1 - lens.stop,
    )


_Numbers = npt.NDArray[np.float64]
# Coordinates x, y, z of points, or components of directions, [...] each.
_Three = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


class _Surface(NamedTuple):
    """One surface's numbers: floats, which are cheaper to compute with, or tensors where gradients are asked for.

    `bend` is (1 + κ) c²; `even` and `odd` are the coefficients of r², r⁴, … and of r³, r⁵, …, empty where all vanish.
    """

    z: torch.Tensor | float
    curvature: torch.Tensor | float
    conic: torch.Tensor | float
    bend: torch.Tensor | float
    even: tuple[torch.Tensor, ...]
    odd: tuple[torch.Tensor, ...]
    semi_diameter: torch.Tensor | float
    differentiable: bool


def _number(value: torch.Tensor) -> torch.Tensor | float:
    return value if value.requires_grad else float(value)


def _plain(value: torch.Tensor | float) -> float:
    return float(value.detach()) if isinstance(value, torch.Tensor) else value


def _surface(lens: Lens, i: int) -> _Surface:
    return _made_surface(lens, i) if lens.differentiable else lens.read[i]


def _made_surface(lens: Lens, i: int) -> _Surface:
    c, kappa, powers = _number(lens.curvature[i]), _number(lens.conic[i]), lens.asphere[i]

    def kept(coefficients: torch.Tensor) -> tuple[torch.Tensor, ...]:
        # Coefficients count where they add to the surface, or to a gradient; the highest first, as Horner takes them.
        counts = coefficients.requires_grad or bool((coefficients != 0).any())
        return coefficients.flip(0).unbind(0) if counts else ()

    return _Surface(
        _number(lens.z[i]),
        c,
        kappa,
        (1 + kappa) * c**2,
        kept(powers[0::2]),
        kept(powers[1::2]),
        _number(lens.semi_diameter[i]),
        any(one.requires_grad for one in (lens.z, lens.curvature, lens.conic, lens.asphere)),
    )


def _sag(surface: _Surface, r_squared: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    c = surface.curvature
    root = torch.sqrt((1 - surface.bend * r_squared).clamp_min(_TURNING))
    value, slope = c * r_squared / (1 + root), 0.5 * c / root
    # Two Horner sums with their derivatives: even powers in r², odd ones in r² times r.
    for coefficients, odd in ((surface.even, False), (surface.odd, True)):
        if not coefficients:
            continue
        total = torch.zeros_like(r_squared) + coefficients[0]
        derivative = torch.zeros_like(r_squared)
        for one in coefficients[1:]:
            derivative = torch.addcmul(total, derivative, r_squared)
            total = torch.addcmul(one, total, r_squared)
        rise, steepness = total * r_squared, derivative * r_squared
        if odd:
            r = torch.sqrt(r_squared.clamp_min(1e-30))
            value, slope = value + rise * r, slope + (1.5 * total + steepness) * r
        else:
            value, slope = value + rise, slope + total + steepness
    return value, slope


def _distance(surface: _Surface, at: _Three, way: _Three) -> torch.Tensor:
    """Along each ray, to a surface."""
    if not surface.even and not surface.odd:
        return _to_conic(surface, at, way)
    t = _newton(surface, at, way)
    if surface.differentiable or any(one.requires_grad for one in (*at, *way)):
        t = t - _step(surface, at, way, t)
    return t


def _newton(surface: _Surface, start: _Three, way: _Three) -> torch.Tensor:
    """Distances along rays [...] to a surface, without gradients. NumPy: small arrays cost it a fifth of the time."""
    shape, device = start[0].shape, start[0].device
    along = [one.detach().cpu().reshape(-1).numpy() for one in (*start, *way)]
    along[2] = along[2] - _plain(surface.z)
    even, odd = ([_plain(one) for one in some] for some in (surface.even, surface.odd))
    plain = surface._replace(
        curvature=_plain(surface.curvature), bend=_plain(surface.bend), even=tuple(even), odd=tuple(odd)
    )
    # No step exceeds the surface's width: a wild one would end at a root elsewhere.
    widest = 2 * _plain(surface.semi_diameter)
    found = -along[2] / along[5]
    t, where = found, None
    with np.errstate(all="ignore"):
        for _ in range(_ITERATIONS):
            step = _plain_step(plain, along, t)
            size = np.abs(step)
            far = ~(size < _LAST_STEP)
            t = t - (step if size.max(initial=0.0) <= widest else np.clip(step, -widest, widest))
            left = np.count_nonzero(far)
            if left == 0:
                break
            # Most rays converge after a few steps: the others go on without them.
            if 2 * left < len(t):
                found = _put(found, where, t)
                rest = far.nonzero()[0]
                t, along, where = t[rest], [one[rest] for one in along], rest if where is None else where[rest]
        found = _put(found, where, t)
    return torch.as_tensor(np.nan_to_num(found), device=device).reshape(shape)


def _put(into: _Numbers, where: npt.NDArray[np.int64] | None, values: _Numbers) -> _Numbers:
    """All distances, those at some places or all replaced."""
    if where is None:
        return values
    into[where] = values
    return into


def _plain_step(surface: _Surface, along: Sequence[_Numbers], t: _Numbers) -> _Numbers:
    """As `_step`, of rays as arrays whose z is counted from the surface's vertex."""
    x, y, z, a, b, c = along
    at_x, at_y = x + t * a, y + t * b
    square = at_x * at_x + at_y * at_y
    root = np.sqrt(np.maximum(1 - surface.bend * square, _TURNING))
    value, slope = surface.curvature * square / (1 + root), (0.5 * surface.curvature) / root
    for coefficients, odd in ((surface.even, False), (surface.odd, True)):
        if not coefficients:
            continue
        total: Any = coefficients[0]
        derivative: Any = 0.0
        for one in coefficients[1:]:
            derivative = total + derivative * square
            total = one + total * square
        rise, steepness = total * square, derivative * square
        if odd:
            r = np.sqrt(np.maximum(square, 1e-30))
            value, slope = value + rise * r, slope + (1.5 * total + steepness) * r
        else:
            value, slope = value + rise, slope + total + steepness
    return (z + t * c - value) / (c - 2 * slope * (at_x * a + at_y * b))


def _to_conic(surface: _Surface, at: _Three, way: _Three) -> torch.Tensor:
    """The root of a conic's quadratic equation on the vertex's side, counted from the vertex's plane."""
    curvature, (a, b, c) = surface.curvature, way
    start = (surface.z - at[2]) / c
    x, y = torch.addcmul(at[0], start, a), torch.addcmul(at[1], start, b)
    linear = curvature * torch.addcmul(x * a, y, b) - c
    constant = curvature * torch.addcmul(x * x, y, y)
    # Rays that miss also get a place: it is off the surface, so they are not good.
    square = linear * linear - curvature * (1 + surface.conic * (c * c)) * constant
    return start + constant / (torch.sqrt(square.clamp_min(1e-12)) - linear)


def _step(surface: _Surface, at: _Three, way: _Three, t: torch.Tensor) -> torch.Tensor:
    """Newton's step at distances t: the equation's value over its derivative along the ray."""
    (a, b, c), x, y = way, torch.addcmul(at[0], t, way[0]), torch.addcmul(at[1], t, way[1])
    value, slope = _sag(surface, torch.addcmul(x * x, y, y))
    across = torch.addcmul(x * a, y, b)
    return (torch.addcmul(at[2] - surface.z, t, c) - value) / (c - 2 * slope * across)
