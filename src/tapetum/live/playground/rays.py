"""A drawing of the light's way through the target, in the plane of its gaze, by the engine's own rays."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from tapetum.bench import PrescriptionLens, Scene, Target
from tapetum.optics.focus import FocusedLens, bundle
from tapetum.optics.grid import lens_numbers
from tapetum.optics.rays import Lens, Rays, reversed_lens, sag, to_plane, trace
from tapetum.simulate.gaze import field_size

__all__ = ["Drawing", "Line", "draw_rays"]

Line = tuple[tuple[float, float], ...]
"""Points (z, y) in metres: z along the target's axis away from the probe, y in the plane of the gaze."""

_RAYS = 9
_BEFORE = 0.45
"""Length drawn before the lens, in fractions of that from its front to the sensor."""


@dataclass(frozen=True)
class Drawing:
    """Lines to draw, in metres.

    Parameters
    ----------
    rays_in, rays_back
        From outside to the sensor, and back out of the lens; those that a rim stops end there.
    glass
        Closed outlines of elements; of a thin lens one line.
    sensor, stop
        The sensor's plane, tilted as it is, and the two ends of the aperture.
    notes
        What the drawing leaves out.
    """

    rays_in: tuple[Line, ...]
    rays_back: tuple[Line, ...]
    glass: tuple[Line, ...]
    sensor: Line
    stop: Line
    notes: tuple[str, ...] = ()


def draw_rays(scene: Scene) -> Drawing:
    """Draw the rays of the first beam through the target at its rotation; of a phone, through the camera that gazes."""
    target = scene.target
    notes: list[str] = []
    if not isinstance(target, Target):
        notes.append(f"camera {target.unit.name!r} alone")
        target = next(one for one, place in target.cameras() if place == (0.0, 0.0))
    sines = [math.sin(angle) for angle in target.rotation]
    steep = math.hypot(*sines)
    way = (sines[0] / steep, sines[1] / steep) if steep > 1e-9 else (0.0, 1.0)
    # The picture's y points down; in the drawing a positive gaze lies below too.
    slope = sum(a * b for a, b in zip(target.sensor.tilt, way, strict=True))
    across = sum(a * b for a, b in zip(target.sensor.tilt, (-way[1], way[0]), strict=True))
    if abs(across) > 1e-6:
        notes.append(f"the sensor's tilt of {math.degrees(across):.2g} deg across this plane is not drawn")
    half = float(field_size(scene).norm()) / 2
    curvature = scene.illumination.curvature(scene.distance)
    if isinstance(target.lens, PrescriptionLens):
        focused = target.lens.focused(scene.illumination.wavelength, target.object_distance)
        return _traced(focused, steep, slope, half, curvature, tuple(notes))
    return _thin(target, steep, slope, half, curvature, tuple(notes))


def _thin(target: Target, sine: float, slope: float, half: float, curvature: float, notes: tuple[str, ...]) -> Drawing:
    lens = target.lens
    radius, image = lens.aperture_radius, lens_numbers(lens.focal_length, target.object_distance)[0]
    start, tangent = -_BEFORE * image, sine / math.sqrt(1 - sine**2)
    rays_in: list[Line] = []
    rays_back: list[Line] = []
    for k in range(_RAYS):
        height = radius * (2 * k / (_RAYS - 1) - 1) * 0.98
        before = tangent + height * curvature
        inside = before - height / lens.focal_length
        z = (image + slope * height) / (1 - slope * inside)
        y = height + inside * z
        rays_in.append(((start, height + before * start), (0.0, height), (z, y)))
        # Off the plane z = image + slope y, whose normal is (1, -slope).
        turned = 2 * (1 - slope * inside) / (1 + slope**2)
        back = (inside + turned * slope) / (turned - 1)
        out = y + back * z
        if abs(out) > radius:
            rays_back.append(((z, y), (0.0, out)))
            continue
        away = back - out / lens.focal_length
        rays_back.append(((z, y), (0.0, out), (start, out - away * start)))
    sensor = tuple((image + slope * y, y) for y in (-half, half))
    rim = ((0.0, -radius), (0.0, radius))
    return Drawing(tuple(rays_in), tuple(rays_back), (rim,), sensor, rim, notes)


def _traced(
    focused: FocusedLens, sine: float, slope: float, half: float, curvature: float, notes: tuple[str, ...]
) -> Drawing:
    lens = focused.lens
    front = float(lens.z[0])
    start = front - _BEFORE * (focused.image - front)
    position, direction = _entering(focused, sine, curvature)
    points, rays = _way(lens, position, direction)
    met = _on_sensor(rays.position, rays.direction, focused.image, slope)
    first = to_plane(position, direction, start)[0]
    reached = rays.good & (rays.height <= 1).all(-1)
    inward = torch.stack([first, *points, met])
    # In the reversed lens both z and the light are reversed (`trace_out`).
    normal = torch.tensor([0.0, -slope, 1.0], dtype=torch.float64)
    normal = normal / normal.norm()
    back = rays.direction - 2 * (rays.direction @ normal)[:, None] * normal
    turn, end = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64), torch.tensor([0.0, 0.0, float(lens.z[-1])])
    back_points, back_rays = _way(reversed_lens(lens), (met - end) * turn, back * turn)
    back_points = [one * turn + end for one in back_points]
    out = to_plane(back_points[-1], back_rays.direction * turn, start)[0]
    outward = torch.stack([met, *back_points, out])
    left = back_rays.good
    rays_in: list[Line] = []
    rays_back: list[Line] = []
    for k in range(len(position)):
        if not bool(reached[k]):
            continue
        rays_in.append(_line(inward[:, k]))
        stopped = torch.nonzero((back_rays.height[k] > 1) | ~left[k]).flatten()
        rays_back.append(_line(outward[:, k] if len(stopped) == 0 else outward[: int(stopped[0]) + 2, k]))
    glass = _outlines(lens)
    rim = float(lens.semi_diameter[lens.stop])
    z = float(lens.z[lens.stop] + sag(lens, lens.stop, torch.tensor(rim**2, dtype=torch.float64))[0])
    half = min(half, 1.5 * max(abs(y) for line in (*glass, *rays_in) for _, y in line))
    sensor = tuple((focused.image + slope * y, y) for y in (-half, half))
    if not rays_in:
        notes = (*notes, "no light of this direction passes the lens")
    return Drawing(tuple(rays_in), tuple(rays_back), glass, sensor, ((z, -rim), (z, rim)), notes)


def _entering(focused: FocusedLens, sine: float, curvature: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Some of the rays that pass, evenly over what gets through."""
    reach = torch.linspace(-1.5, 1.5, 241, dtype=torch.float64) * focused.entrance_radius
    zero = torch.zeros_like(reach)
    position, _, _ = bundle(reach, focused.entrance_pupil, math.inf)
    tangent = sine / math.sqrt(1 - sine**2) + reach * curvature
    length = torch.sqrt(1 + tangent**2)
    direction = torch.stack([zero, tangent / length, 1 / length], -1)
    rays = trace(focused.lens, position, direction)
    passed = torch.nonzero(rays.good & (rays.height <= 1).all(-1)).flatten()
    if len(passed) == 0:
        chosen = torch.linspace(0, len(reach) - 1, _RAYS).round().long()
    else:
        chosen = passed[torch.linspace(0, len(passed) - 1, _RAYS).round().long()]
    return position[chosen], direction[chosen]


def _way(lens: Lens, position: torch.Tensor, direction: torch.Tensor) -> tuple[list[torch.Tensor], Rays]:
    """Places on every surface, and the rays behind the last."""
    points: list[torch.Tensor] = []
    good = torch.ones(len(position), dtype=torch.bool)
    heights: list[torch.Tensor] = []
    for i in range(len(lens)):
        rays = trace(_surface(lens, i), position, direction)
        position, direction, good = rays.position, rays.direction, good & rays.good
        heights.append(rays.height[..., 0])
        points.append(position)
    return points, Rays(position, direction, torch.zeros(len(position)), torch.stack(heights, -1), good)


def _surface(lens: Lens, i: int) -> Lens:
    """One surface alone."""
    part = {name: getattr(lens, name)[i : i + 1] for name in ("z", "curvature", "conic", "asphere", "semi_diameter")}
    return replace(lens, **part, index=lens.index[i : i + 2], stop=0)


def _on_sensor(position: torch.Tensor, direction: torch.Tensor, image: float, slope: float) -> torch.Tensor:
    """Where rays meet the plane z = image + slope y."""
    gap = image + slope * position[:, 1] - position[:, 2]
    return position + direction * (gap / (direction[:, 2] - slope * direction[:, 1]))[:, None]


def _line(points: torch.Tensor) -> Line:
    return tuple((float(z), float(y)) for _, y, z in points.tolist())


def _outlines(lens: Lens) -> tuple[Line, ...]:
    """Elements of glass, front and back joined at their rims."""
    y = torch.linspace(-1, 1, 25, dtype=torch.float64)
    index, found = lens.index.tolist(), list[Line]()
    for i in range(len(lens) - 1):
        if index[i + 1] <= 1.001:
            continue
        sides: list[list[tuple[float, float]]] = []
        for k in (i, i + 1):
            heights = y * lens.semi_diameter[k]
            z = lens.z[k] + sag(lens, k, heights**2)[0]
            sides.append(list(zip(z.tolist(), heights.tolist(), strict=True)))
        found.append((*sides[0], *reversed(sides[1]), sides[0][0]))
    return tuple(found)
