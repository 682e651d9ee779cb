"""Focus by real rays: the sensor's place with the least wavefront error on the axis."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from tapetum.errors import InputError
from tapetum.optics.paraxial import paraxial
from tapetum.optics.rays import Lens, Rays, reversed_lens, trace

__all__ = [
    "FocusedLens",
    "best_focus",
    "bundle",
    "front_focus",
    "moved_group",
    "paraxial_image",
    "pupil_height",
    "stopped_down",
    "wavefront",
]

_NODES = 24
# Factor by which each round narrows the search for the pupil's edge.
_LADDER, _ROUNDS = 129, 2
_STEPS = 30


@dataclass(frozen=True)
class FocusedLens:
    """A lens at one wavelength, with the sensor at its focus for another. Lengths in metres.

    Parameters
    ----------
    lens
        With the indices of the wavelength asked for.
    image
        z of the sensor.
    entrance_pupil, exit_pupil
        z of the stop's paraxial images, infinite where the lens is telecentric on that side.
    entrance_radius
        Paraxial radius of the stop's image in object space.
    focal_length
        Paraxial.
    """

    lens: Lens
    image: float
    entrance_pupil: float
    exit_pupil: float
    entrance_radius: float
    focal_length: float


def bundle(height: torch.Tensor, pupil: float, distance: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Rays through the pupil at heights [N] along y (metres), from a point on the axis `distance` before it.

    `pupil` is z of the entrance pupil; `distance` is `inf` for parallel rays. Returns positions on the plane of the
    pupil and directions, [N, 3], and the path so far beyond that of the ray on the axis, [N].
    """
    zero = torch.zeros_like(height)
    position = torch.stack([zero, height, zero + pupil], -1)
    if math.isinf(distance):
        return position, torch.stack([zero, zero, zero + 1], -1), zero
    length = torch.sqrt(height**2 + distance**2)
    direction = torch.stack([zero, height / length, distance / length], -1)
    # Without cancellation of two long paths.
    return position, direction, height**2 / (length + distance)


# Checks of a scene, its sensor's place and its planning ask for the same lens's.
@functools.lru_cache(maxsize=256)
def pupil_height(lens: Lens, distance: float = math.inf) -> float:
    """Height in the entrance pupil of the outermost ray, from a point on the axis, that passes all semi-diameters.

    Raises
    ------
    InputError
        Where not even the rays next to the axis pass, or the pupil lies at infinity.
    """
    cardinal = paraxial(lens)
    if not math.isfinite(cardinal.entrance_pupil) or not math.isfinite(cardinal.focal_length):
        remedy = "use a lens with a focal length whose stop has an image"
        raise InputError("the lens is telecentric towards the object, or afocal", where="lens", remedy=remedy)
    low, high, edge = 0.0, 1.6 * cardinal.entrance_radius, 0.0
    for _ in range(_ROUNDS):
        heights = torch.linspace(low, high, _LADDER, dtype=torch.float64)
        position, direction, _ = bundle(heights, cardinal.entrance_pupil, distance)
        rays = trace(lens, position, direction)
        stopped = torch.nonzero(~_passes(rays))
        if len(stopped) == 0:
            return high
        first = int(stopped[0])
        if first == 0:
            raise InputError("no ray gets through", where="lens", remedy="mend its thicknesses and semi-diameters")
        low, high = float(heights[first - 1]), float(heights[first])
        inside, outside = (float(rays.height[i].max()) for i in (first - 1, first))
        if bool(rays.good[first]) and outside > inside:
            # Linear interpolation between two heights.
            edge = low + (high - low) * (1 - inside) / (outside - inside)
        else:
            edge = low
    return edge


def stopped_down(lens: Lens, f_number: float) -> Lens:
    """The lens with its stop set to an F-number: it passes a parallel bundle of diameter focal length / F-number.

    The bundle is of real rays. Only the stop changes; other surfaces still stop what they stopped.

    Raises
    ------
    InputError
        Where the bundle's outermost ray does not reach the stop.
    """
    cardinal = paraxial(lens)
    height = torch.tensor([cardinal.focal_length / (2 * f_number)], dtype=torch.float64)
    position, direction, _ = bundle(height, cardinal.entrance_pupil, math.inf)
    rays = trace(lens, position, direction)
    if not bool(rays.good):
        raise InputError(f"no ray is as far out as f/{f_number:g} asks", where="f_number", remedy="give a larger one")
    semi_diameter = lens.semi_diameter.clone()
    semi_diameter[lens.stop] *= torch.sqrt(rays.height[0, lens.stop])
    return replace(lens, semi_diameter=semi_diameter)


def wavefront(lens: Lens, distance: float, image: float, heights: torch.Tensor) -> torch.Tensor:
    """Optical path of rays from a point on the axis to a sphere about the axial image point, [N], in metres.

    The sphere goes through the middle of the exit pupil; only differences between rays have a meaning.
    """
    cardinal = paraxial(lens)
    position, direction, before = bundle(heights, cardinal.entrance_pupil, distance)
    rays = trace(lens, position, direction)
    return before + rays.path + lens.index[-1] * _to_sphere(rays, image, cardinal.exit_pupil)


def best_focus(lens: Lens, object_distance: float) -> float:
    """z, in the lens's coordinates, with the least RMS wavefront error of a point on the axis, by real rays.

    The pupil is evenly lit; `object_distance` is from the point to the entrance pupil, in metres or `inf`.

    Raises
    ------
    InputError
        Where no ray gets through, or no real image is made behind the lens.
    """
    if not object_distance > 0:
        what = f"{object_distance:g} m is no distance before the entrance pupil"
        raise InputError(what, where="object_distance", remedy="give a positive one")
    edge = pupil_height(lens, object_distance)
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    # Evenly spaced in the pupil's area: in the square of the height.
    heights = torch.tensor(edge * np.sqrt((nodes + 1) / 2))
    weight = torch.tensor(weights / weights.sum())
    cardinal = paraxial(lens)
    position, direction, before = bundle(heights, cardinal.entrance_pupil, object_distance)
    rays = trace(lens, position, direction)
    n = lens.index[-1]

    def path(image: float) -> torch.Tensor:
        found = before + rays.path + n * _to_sphere(rays, image, cardinal.exit_pupil)
        return found - (weight * found).sum()

    image = paraxial_image(lens, object_distance)
    if not math.isfinite(image) or image <= float(lens.z[-1]):
        focus = cardinal.focal_length
        raise InputError(
            f"an object {object_distance:g} m away has no image behind a lens of f = {focus:.4g} m",
            where="object_distance",
            remedy="focus farther away",
        )
    # Gauss-Newton steps: the path is nearly linear in z.
    nudge = 1e-4 * abs(cardinal.focal_length)
    for _ in range(_STEPS):
        slope = (path(image + nudge) - path(image - nudge)) / (2 * nudge)
        step = float((weight * path(image) * slope).sum() / (weight * slope**2).sum())
        image -= step
        if abs(step) < 1e-13:
            break
    return image


def moved_group(lens: Lens, group: tuple[int, int], shift: float) -> Lens:
    """The lens with the surfaces from the first to the last of a group moved along the axis."""
    z = lens.z.clone()
    z[group[0] : group[1] + 1] += shift
    return replace(lens, z=z)


def _passes(rays: Rays) -> torch.Tensor:
    # Rounding in a published table must not stop the outermost ray.
    return rays.good & (rays.height <= 1 + 1e-9).all(-1)


def paraxial_image(lens: Lens, distance: float) -> float:
    """z of the paraxial image of a point before the entrance pupil, infinite where there is no real one."""
    cardinal = paraxial(lens)
    if math.isinf(distance):
        return cardinal.focus
    front = front_focus(lens)
    # Newton's form of the lens equation.
    before = front - (cardinal.entrance_pupil - distance)
    return cardinal.focus + cardinal.focal_length**2 / before if before > 0 else math.inf


def front_focus(lens: Lens) -> float:
    """z of the point on the object side whose light leaves the lens parallel."""
    return float(lens.z[-1]) - paraxial(reversed_lens(lens)).focus


def _to_sphere(rays: Rays, image: float, pupil: float) -> torch.Tensor:
    """Path along each ray from the last surface to the sphere about the image through the exit pupil."""
    centre = torch.zeros_like(rays.position)
    centre[..., 2] = image
    to_centre = centre - rays.position
    along = (to_centre * rays.direction).sum(-1)
    if math.isinf(pupil):
        return along
    radius = image - pupil
    miss = (to_centre**2).sum(-1) - along**2
    # sqrt(R² - miss) - R, without cancellation. A pupil behind the image has a negative radius.
    return along + math.copysign(1.0, radius) * miss / (torch.sqrt((radius**2 - miss).clamp_min(0)) + abs(radius))
