"""Rays through a sequence of rotationally symmetric surfaces: batched, and differentiable in every number of the lens.

The surfaces stand on the z axis. Light travels towards +z; `reversed_lens` reverses the lens for returning light.
Distances along a ray may be negative: a ray can start from the entrance pupil, behind the first surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

__all__ = ["Lens", "Rays", "before", "normals", "reversed_lens", "sag", "to_plane", "trace", "trace_out"]

_ITERATIONS = 12
# Largest residual of a root of a surface's equation, over its semi-diameter; other roots are stray.
_RESIDUAL = 1e-7
# Newton's last step, in metres: a billionth of a wave in path.
_LAST_STEP = 1e-15
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
    c, kappa, powers = lens.curvature[i], lens.conic[i], lens.asphere[i]
    root = torch.sqrt((1 - (1 + kappa) * c**2 * r_squared).clamp_min(_TURNING))
    value, slope = c * r_squared / (1 + root), c / (2 * root)
    if _counts(powers):
        # Two Horner sums with their derivatives: even powers in r², odd ones in r² times r.
        for coefficients, odd in ((powers[0::2], False), (powers[1::2], True)):
            if not _counts(coefficients):
                continue
            total = torch.zeros_like(r_squared)
            derivative = torch.zeros_like(r_squared)
            for a in coefficients.flip(0):
                derivative = torch.addcmul(total, derivative, r_squared)
                total = torch.addcmul(a, total, r_squared)
            rise, steepness = total * r_squared, derivative * r_squared
            if odd:
                r = torch.sqrt(r_squared.clamp_min(1e-30))
                value, slope = value + rise * r, slope + (1.5 * total + steepness) * r
            else:
                value, slope = value + rise, slope + total + steepness
    return value, slope


def normals(lens: Lens, i: int, position: torch.Tensor) -> torch.Tensor:
    """Unit normals [..., 3] of surface i at points [..., 3] of it, towards +z."""
    _, slope = sag(lens, i, position[..., 0] ** 2 + position[..., 1] ** 2)
    return _normals(position, slope)


def _normals(position: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
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
    good = torch.ones_like(path, dtype=torch.bool)
    heights: list[torch.Tensor] = []
    for i in range(len(lens)):
        vertex = lens.z[i]
        t = _distance(lens, i, position, direction)
        position = position + t[..., None] * direction
        path = path + lens.index[i] * t
        r_squared = position[..., 0] ** 2 + position[..., 1] ** 2
        height, slope = sag(lens, i, r_squared)
        off = (position[..., 2] - vertex - height).detach().abs()
        turning = (1 - (1 + lens.conic[i]) * lens.curvature[i] ** 2 * r_squared).detach()
        good = good & (off < _RESIDUAL * lens.semi_diameter[i]) & (turning > _TURNING)
        heights.append(r_squared / lens.semi_diameter[i] ** 2)
        direction, passed = _refracted(direction, _normals(position, slope), lens.index[i] / lens.index[i + 1])
        good = good & passed
    height = torch.stack(heights, dim=-1) if heights else position.new_zeros(*path.shape, 0)
    return Rays(position, direction, path, height, good)


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


def _counts(powers: torch.Tensor) -> bool:
    """Whether any coefficient adds to the surface, or to a gradient."""
    return powers.requires_grad or bool((powers != 0).any())


def _distance(lens: Lens, i: int, position: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Along each ray, to surface i."""
    if not _counts(lens.asphere[i]):
        return _to_conic(lens, i, position, direction)
    with torch.no_grad():
        start, way = position.detach(), direction.detach()
        t = (lens.z[i] - start[..., 2]) / way[..., 2]
        t = _newton(lens, i, start.reshape(-1, 3), way.expand_as(start).reshape(-1, 3), t.reshape(-1)).reshape(t.shape)
        t = torch.nan_to_num(t)
    if any(one.requires_grad for one in (position, direction, lens.z, lens.curvature, lens.conic, lens.asphere)):
        t = t - _step(lens, i, position + t[..., None] * direction, direction)
    return t


def _newton(
    lens: Lens, i: int, start: torch.Tensor, way: torch.Tensor, t: torch.Tensor, steps: int = _ITERATIONS
) -> torch.Tensor:
    """Distances [N] to surface i along rays from `start` [N, 3], from guesses t [N]."""
    # No step exceeds the surface's width: a wild one would end at a root elsewhere.
    widest = 2 * lens.semi_diameter[i].detach()
    for done in range(1, steps + 1):
        step = _step(lens, i, start + t[:, None] * way, way)
        t = t - torch.minimum(torch.maximum(step, -widest), widest)
        far = ~(step.abs() < _LAST_STEP)
        left = int(far.sum())
        if left == 0:
            break
        # Most rays converge after a few steps; the others go on without them.
        if 4 * left < len(t) and done < steps:
            rest = far.nonzero()[:, 0]
            found = _newton(lens, i, start[rest], way[rest], t[rest], steps - done)
            return t.index_copy(0, rest, found)
    return t


def _to_conic(lens: Lens, i: int, position: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """The root of a conic's quadratic equation on the vertex's side, counted from the vertex's plane."""
    c, along = lens.curvature[i], direction[..., 2]
    start = (lens.z[i] - position[..., 2]) / along
    x = position[..., 0] + start * direction[..., 0]
    y = position[..., 1] + start * direction[..., 1]
    linear = c * (x * direction[..., 0] + y * direction[..., 1]) - along
    constant = c * (x**2 + y**2)
    # Rays that miss also get a place: it is off the surface, so they are not good.
    root = torch.sqrt((linear**2 - c * (1 + lens.conic[i] * along**2) * constant).clamp_min(1e-12))
    return start + constant / (root - linear)


def _step(lens: Lens, i: int, at: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Newton's step: the equation's value over its derivative along the ray."""
    value, slope = sag(lens, i, at[..., 0] ** 2 + at[..., 1] ** 2)
    across = at[..., 0] * direction[..., 0] + at[..., 1] * direction[..., 1]
    return (at[..., 2] - lens.z[i] - value) / (direction[..., 2] - 2 * slope * across)


def _refracted(direction: torch.Tensor, normal: torch.Tensor, ratio: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Snell's law in vector form for normals along +z, and where there is no total reflection."""
    cosine = (direction * normal).sum(-1)
    square = 1 - ratio**2 * (1 - cosine**2)
    passed = square > 0
    root = torch.sqrt(torch.where(passed, square, torch.ones_like(square)))
    return ratio * direction + (root - ratio * cosine)[..., None] * normal, passed
