"""Rays through surfaces against closed forms, their own way back, and finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from tapetum.optics.rays import Lens, Rays, reversed_lens, sag, to_plane, trace

F64 = torch.float64
SECTION = "Ray tracing"


def lens(
    z: list[float],
    curvature: list[float],
    index: list[float],
    *,
    conic: list[float] | None = None,
    asphere: list[list[float]] | None = None,
    semi_diameter: float = 10e-3,
    stop: int = 0,
) -> Lens:
    """A lens from plain numbers."""
    return Lens(
        z=torch.tensor(z, dtype=F64),
        curvature=torch.tensor(curvature, dtype=F64),
        conic=torch.tensor(conic or [0.0] * len(z), dtype=F64),
        asphere=torch.tensor(asphere or [[0.0]] * len(z), dtype=F64),
        semi_diameter=torch.full((len(z),), semi_diameter, dtype=F64),
        index=torch.tensor(index, dtype=F64),
        stop=stop,
    )


def fan(half_angle: float, count: int = 21, height: float = 0.0, z: float = -5e-3) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays from a point in front of the lens, in two planes."""
    angle = torch.linspace(-half_angle, half_angle, count, dtype=F64)
    direction = torch.stack([0.3 * torch.sin(angle), torch.sin(angle), torch.cos(angle)], -1)
    direction = direction / direction.norm(dim=-1, keepdim=True)
    return torch.tensor([0.0, height, z], dtype=F64).expand_as(direction), direction


def parallel(radius: float, count: int = 21) -> tuple[torch.Tensor, torch.Tensor]:
    side = torch.linspace(-radius, radius, count, dtype=F64)
    at = torch.cartesian_prod(side, side)
    at = at[(at**2).sum(-1) <= radius**2]
    position = torch.cat([at, torch.zeros_like(at[:, :1]) - 1e-3], -1)
    return position, torch.tensor([0.0, 0.0, 1.0], dtype=F64).expand_as(position)


# A doublet with every kind of term in it: odd and even powers, conics, a cemented surface, a flat.
RICH = lens(
    [0.0, 3e-3, 4.2e-3, 6e-3],
    [40.0, -55.0, -20.0, 0.0],
    [1.0, 1.5168, 1.7, 1.0, 1.52],
    conic=[-0.6, 0.3, 1.1, 0.0],
    asphere=[[2.0, -400.0, 3e4, 0.0, -1e8], [0.0] * 5, [-1.5, 0.0, 2e4, 3e5, 0.0], [0.0] * 5],
    semi_diameter=4e-3,
)


def test_snells_law_at_a_plane(validated) -> None:
    flat = lens([0.0], [0.0], [1.0, 1.6])
    position, direction = fan(1.4)
    rays = trace(flat, position, direction)
    sines = direction[:, :2] / 1.6
    error = (rays.direction[:, :2] - sines).abs().max()
    validated(SECTION, "Directions behind a flat of n = 1.6, to 80° of incidence", error, 1e-15, "Snell's law", "")
    assert (rays.direction.norm(dim=-1) - 1).abs().max() < 1e-15
    assert rays.good.all()


def test_path_through_a_plate(validated) -> None:
    n, thick = 1.5168, 2e-3
    plate = lens([0.0, thick], [0.0, 0.0], [1.0, n, 1.0])
    position, direction = fan(1.2)
    rays = trace(plate, position, direction)
    cosine = direction[:, 2]
    inside = torch.sqrt(1 - (1 - cosine**2) / n**2)
    path = 5e-3 / cosine + n * thick / inside
    error = (rays.path - path).abs().max()
    validated(SECTION, "Optical path to behind a plate of 2 mm", error, 1e-15, "5 mm/cos i + n d/cos r", "m")
    assert (rays.direction - direction).abs().max() < 1e-15


@pytest.mark.parametrize("n", [1.5, 1.8])
def test_a_stigmatic_surface_from_air(n: float, validated) -> None:
    """An ellipsoid of conic -1/n² unites a plane wave from air in its far focus, f = nR/(n - 1): by any ray alike."""
    radius = 8e-3
    ellipsoid = lens([0.0], [1 / radius], [1.0, n], conic=[-1 / n**2])
    position, direction = parallel(5e-3)
    rays = trace(ellipsoid, position, direction)
    focus = n * radius / (n - 1)
    landed, way = to_plane(rays.position, rays.direction, focus)
    path = rays.path + n * way
    against = f"the ellipsoid of conic -1/n², n = {n}"
    validated(SECTION, "Where a plane wave lands", landed[:, :2].abs().max(), 1e-15, against, "m")
    validated(SECTION, "Its optical path", (path - (1e-3 + n * focus)).abs().max(), 1e-12, against, "m")


def test_a_stigmatic_surface_from_glass(validated) -> None:
    """A hyperboloid of conic -n² unites a plane wave that comes from inside the glass."""
    n, radius = 1.6, -8e-3
    hyperboloid = lens([0.0], [1 / radius], [n, 1.0], conic=[-(n**2)])
    position, direction = parallel(5e-3)
    rays = trace(hyperboloid, position, direction)
    focus = -radius / (n - 1)
    landed, way = to_plane(rays.position, rays.direction, focus)
    path = rays.path + way
    against = "the hyperboloid of conic -n², n = 1.6"
    validated(SECTION, "Where a plane wave lands", landed[:, :2].abs().max(), 1e-15, against, "m")
    validated(SECTION, "Its optical path", (path - (n * 1e-3 + focus)).abs().max(), 1e-12, against, "m")


def test_a_sphere_as_a_conic_and_as_a_series() -> None:
    """A sphere's own power series as an asphere on a flat: two roads to one surface."""
    radius, powers = 20e-3, 8
    series = [0.0] * (2 * powers)
    term = 1 / (2 * radius)
    for k in range(1, powers + 1):
        series[2 * k - 2] = term
        term *= (2 * k - 1) / (2 * k + 2) / radius**2
    sphere = lens([0.0], [1 / radius], [1.0, 1.5], asphere=[[0.0] * len(series)])
    spelt = lens([0.0], [0.0], [1.0, 1.5], asphere=[series])
    r_squared = torch.linspace(0, 3e-3**2, 50, dtype=F64)
    for one, other in zip(sag(sphere, 0, r_squared), sag(spelt, 0, r_squared), strict=True):
        assert torch.allclose(one, other, rtol=1e-12, atol=0)
    position, direction = fan(0.3)
    ours, theirs = trace(sphere, position, direction), trace(spelt, position, direction)
    assert (ours.position - theirs.position).abs().max() < 1e-14


def test_slope_is_that_of_the_sag() -> None:
    r = torch.linspace(1e-4, 3e-3, 40, dtype=F64).requires_grad_()
    for i in range(len(RICH)):
        value, slope = sag(RICH, i, r**2)
        (gradient,) = torch.autograd.grad(value.sum(), r)
        assert torch.allclose(gradient, 2 * r * slope, rtol=1e-10, atol=1e-12)


def back_again(one: Lens, rays: Rays) -> Rays:
    """Turn round where the light left, and trace it back: y stays, z and the direction of travel turn."""
    turn = torch.tensor([1.0, 1.0, -1.0], dtype=F64)
    position = rays.position * turn
    position = position + torch.tensor([0.0, 0.0, float(one.z[-1])], dtype=F64)
    return trace(reversed_lens(one), position, -rays.direction * turn)


def test_the_way_back_is_the_way_there(validated) -> None:
    position, direction = fan(0.35, height=0.4e-3)
    rays = trace(RICH, position, direction)
    assert rays.good.all() and (rays.height <= 1).all()
    back = back_again(RICH, rays)
    turn = torch.tensor([1.0, 1.0, -1.0], dtype=F64)
    start = position * turn + torch.tensor([0.0, 0.0, float(RICH.z[-1])], dtype=F64)
    home, way = to_plane(back.position, back.direction, start[0, 2])
    against = "the way there"
    validated(SECTION, "Position after the way back", (home - start).abs().max(), 1e-14, against, "m")
    validated(
        SECTION, "Direction after the way back", (back.direction + direction * turn).abs().max(), 1e-12, against, ""
    )
    validated(SECTION, "Optical path of the way back", (back.path + way - rays.path).abs().max(), 1e-15, against, "m")
    assert torch.allclose(back.height.flip(-1), rays.height, atol=1e-12)


def test_a_lens_turned_twice_is_itself() -> None:
    twice = reversed_lens(reversed_lens(RICH))
    for name in ("z", "curvature", "conic", "asphere", "semi_diameter", "index"):
        assert torch.allclose(getattr(twice, name), getattr(RICH, name), atol=1e-18)
    assert twice.stop == RICH.stop


def test_rays_may_start_behind_the_first_surface() -> None:
    """From the entrance pupil: the same rays, and the same path but for the piece that was left out."""
    position, direction = fan(0.2)
    later = position + 9e-3 * direction
    first, second = trace(RICH, position, direction), trace(RICH, later, direction)
    assert torch.allclose(first.position, second.position, atol=1e-16)
    assert torch.allclose(first.path, second.path + 9e-3, atol=1e-16)


def test_rays_that_miss_or_are_reflected_are_not_good() -> None:
    ball = lens([0.0], [1 / 2e-3], [1.0, 1.5], semi_diameter=10e-3)
    position, direction = parallel(5e-3)
    rays = trace(ball, position, direction)
    inside = position[:, :2].norm(dim=-1) < 1.99e-3
    assert rays.good[inside].all() and not rays.good[position[:, :2].norm(dim=-1) > 2e-3].any()
    assert torch.isfinite(rays.position).all() and torch.isfinite(rays.path).all()
    # Out of glass at a flat, beyond the critical angle of 41.8°.
    flat = lens([0.0], [0.0], [1.5, 1.0])
    angle = torch.tensor([0.70, 0.76], dtype=F64)
    direction = torch.stack([0 * angle, torch.sin(angle), torch.cos(angle)], -1)
    assert trace(flat, torch.zeros_like(direction), direction).good.tolist() == [True, False]


def test_stray_roots_beyond_an_asphere_are_refused() -> None:
    """A steep power makes the surface turn back: what Newton finds there belongs to no ray."""
    wild = lens([0.0], [300.0], [1.0, 1.5], conic=[-20.0], asphere=[[0.0, 0.0, 0.0, 0.0, -5e11]], semi_diameter=2e-3)
    position, direction = fan(0.9, count=201, z=-3e-3)
    rays = trace(wild, position, direction)
    height, _ = sag(wild, 0, (rays.position[:, :2] ** 2).sum(-1))
    off = (rays.position[:, 2] - height).abs()
    assert (off[rays.good] < 1e-9).all()
    assert torch.isfinite(rays.direction).all()


def test_height_tells_what_a_rim_stops() -> None:
    small = replace(RICH, semi_diameter=torch.full((4,), 1e-3, dtype=F64))
    position, direction = parallel(1.5e-3)
    rays = trace(small, position, direction)
    outside = position[:, :2].norm(dim=-1) > 1e-3
    assert rays.good.all()
    assert ((rays.height[:, 0] > 1) == outside).all()


@pytest.mark.parametrize("name", ["z", "curvature", "conic", "asphere", "index"])
def test_gradients_of_every_number(name: str) -> None:
    """By finite differences: of the landing point, the direction and the path."""
    position, direction = fan(0.25, count=5, height=0.3e-3)
    scale = {"z": 1e-3, "curvature": 50.0, "conic": 1.0, "index": 1.0}.get(name)
    base = getattr(RICH, name)
    # In units of its own size, so that one step of the difference suits all of them.
    size = torch.tensor([1.0, 300.0, 2e4, 1e6, 1e8], dtype=F64) if scale is None else torch.tensor(scale, dtype=F64)

    def landing(steps: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rays = trace(replace(RICH, **{name: base + steps * size}), position, direction)
        landed, way = to_plane(rays.position, rays.direction, 20e-3)
        return 1e3 * landed[:, :2], rays.direction, 1e3 * (rays.path + way)

    steps = torch.zeros_like(base).requires_grad_()
    assert torch.autograd.gradcheck(landing, (steps,), eps=1e-6, atol=1e-6, rtol=1e-5)


def test_gradients_of_the_rays_themselves() -> None:
    position, direction = fan(0.2, count=4)

    def landing(at: torch.Tensor, way: torch.Tensor) -> tuple[torch.Tensor, ...]:
        rays = trace(RICH, 1e-3 * at, way / way.norm(dim=-1, keepdim=True))
        return 1e3 * rays.position, rays.direction, 1e3 * rays.path

    at = (1e3 * position).clone().requires_grad_()
    assert torch.autograd.gradcheck(landing, (at, direction.clone().requires_grad_()), eps=1e-6, atol=1e-6, rtol=1e-5)


def test_a_batch_is_its_rays() -> None:
    position, direction = fan(0.2, count=6)
    one = trace(RICH, position.reshape(2, 3, 3), direction.reshape(2, 3, 3))
    each = [trace(RICH, p, d) for p, d in zip(position, direction, strict=True)]
    assert torch.equal(one.path.reshape(-1), torch.stack([ray.path for ray in each]))
    assert one.height.shape == (2, 3, 4) and one.good.shape == (2, 3)
    assert math.isclose(float(one.direction.norm(dim=-1).max()), 1.0, rel_tol=1e-14)
