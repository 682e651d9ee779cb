"""The rim of a traced lens's pupil: the planes in which it is sharp, and where on them what it sends comes from.

Rays through one place of the rim, under different directions, cross before the lens where the probe sees that place
sharp, and behind the lens where the sensor sees it. On any other plane the rim's place depends on the direction of the
light, which differs between what enters and what leaves. Head on the plane before the lens lies across the axis. Under
a tilt it leans, in proportion to the tilt: by 0.04 a degree in compact-6mm-f1.9, and not at all where the stop stands
before all surfaces. Another surface's rim, where it cuts the pupil, is sharp in a plane of its own. And no plane holds
for all directions: what a rim sends of light that it meets under one direction to another comes from between both
places (`seen_heights`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from tapetum.optics.focus import FocusedLens
from tapetum.optics.rays import Rays, to_plane, trace

__all__ = ["anywhere", "exit_plane", "leaving_by", "pupil_depth", "rim_bend", "rim_depths", "rim_plane"]
__all__ += ["seen_heights", "sharp_plane"]

# Rays that find the rim, and how far at most its image is sought behind the entrance pupil, in radii of it.
_RIM_RAYS, _DEEPEST = 65, 2.0
# Farthest exit pupil before the sensor, in focal lengths, in place of one farther away or behind it.
_FARTHEST_PUPIL = 40.0
# Sine of the tilts between which rays from a place of the rim cross, and steps of the search for these rays.
_LITTLE_TILT, _STEPS = 1e-3, 5
# Sine of the tilt at which the plane's lean is measured, and the largest one that is believed.
_LEANING_TILT, _STEEPEST_LEAN = 0.02, 100.0
# Least and largest curvature of the rim's light over that of the light in the pupil's middle.
_RIM_CURVATURES = (0.2, 3.0)
# Least squared cosine of a direction.
_GRAZING = 1e-9
# Steps of derivatives of rays' heights: in radii of the entrance pupil, and of direction cosines.
_BESIDE, _TURNED = 1e-4, 1e-4


def anywhere(focused: FocusedLens) -> FocusedLens:
    """The lens with no sensor: the same for a sensor or a filter moved behind it."""
    return replace(focused, image=0.0)


def exit_plane(focused: FocusedLens) -> float:
    """z of the exit pupil, or of a plane far before the sensor where the lens is nearly telecentric."""
    farthest = _FARTHEST_PUPIL * abs(focused.focal_length)
    away = focused.image - focused.exit_pupil
    if not math.isfinite(away) or away <= 0 or away > farthest:
        away = farthest
    return focused.image - away


def rim_bend(focused: FocusedLens) -> float:
    """C of the light that the pupil's rim sends on under other directions than its rays', along s, in 1/m.

    Only light far from the spot feels C, and it comes from the rim: to v from where the rim lies across v, so that s is
    along v. Light from a place of the rim seems to come from where the rays through it cross behind the lens, at the
    distance L before the sensor along the axis: C is cos³θ/L. The stop's paraxial image has the L of light near the
    axis alone. With the C of the head-on rim real rays keep to the model's paths under a tilt, too.
    """
    rim = _rim(anywhere(focused))
    middle = 1 / (focused.image - exit_plane(focused))
    # Parallel rays cross nowhere.
    found = 1 / ((focused.image - rim.crossing) * (1 + rim.slope**2) ** 1.5) if math.isfinite(rim.crossing) else middle
    return min(max(found, _RIM_CURVATURES[0] * middle), _RIM_CURVATURES[1] * middle)


def pupil_depth(focused: FocusedLens) -> float:
    """How far behind the paraxial entrance pupil the probe sees the pupil's rim sharp head on, in metres."""
    return _rim(anywhere(focused)).depth


def sharp_plane(focused: FocusedLens, sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Of the plane in which the probe sees the rim sharp under tilts of sines [F]: its slope along the tilt, and how
    far behind the plane that e is counted in it meets the axis of the light, in metres, [F] each."""
    rim = _rim(anywhere(focused))
    return rim.lean * sines, rim.deeper * sines**2


def rim_plane(focused: FocusedLens, sines: torch.Tensor) -> torch.Tensor:
    """Where the axis of light under tilts of sines [F] meets the plane that e is counted in, [F, 3]."""
    depth = pupil_depth(focused)
    aside = depth * sines / torch.sqrt(1 - sines**2)
    return torch.stack([torch.zeros_like(sines), aside, torch.full_like(sines, focused.entrance_pupil + depth)], -1)


def leaving_by(
    focused: FocusedLens, sines: torch.Tensor, position: torch.Tensor, direction: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Places e [F, N, 2] by which light leaves the pupil, and its path [F, N] to there, less the tilt's.

    The light, at `position` [F, N, 3] with `direction` [F, N, 3], is taken where it crosses the plane in which the rim
    is sharp under its tilt. From there e lies along the tilt, in the plane across the axis in which entering light is
    counted, so that light that returns the way it came has the e that it had. Sines are [F].
    """
    middle = rim_plane(focused, sines)[:, None]
    lean, deeper = (one[:, None] for one in sharp_plane(focused, sines))
    at, way = to_plane(position, direction, middle[..., 2])
    beside = at - middle
    more = (deeper + lean * beside[..., 1]) / (direction[..., 2] - lean * direction[..., 1])
    beside = beside + more[..., None] * direction
    e = beside[..., :2].clone()
    e[..., 1] -= beside[..., 2] * (sines / torch.sqrt(1 - sines**2))[:, None]
    along = sines[:, None] * beside[..., 1] + torch.sqrt(1 - sines**2)[:, None] * beside[..., 2]
    return e, way + more + along


def seen_heights(
    focused: FocusedLens,
    sines: torch.Tensor,
    e: torch.Tensor,
    turned: torch.Tensor,
    own: torch.Tensor,
    surfaces: Sequence[int],
) -> torch.Tensor:
    """Squared heights over the rims of surfaces that cut what rays' light sends along the tilt, [F, N, K].

    A rim that is not sharp in the plane of `leaving_by` has another place there for each direction: rays meet it at one
    place, light along the tilt sees it at another. The wave from a place of the rim has the slope q where light of the
    direction q crosses the plane, at x(q). So what the rim sends along the tilt of light of the slope Q has the phase
    of that light at x(Q), less ∫ q dx from x(Q) on: by parts it is that of an edge at the mean of x over the directions
    from the tilt's to the ray's. Heights have the same mean. Radau's rule of two points takes it from the ray itself
    and the direction at a third of its turn.

    Parameters
    ----------
    focused, sines
        The lens, and those of the tilts, [F].
    e, turned
        Places [F, N, 2] by which rays leave, and their direction cosines less those of exact retro-reflection.
    own
        [F, N, K] the rays' own heights at the surfaces.
    surfaces
        Numbers of K surfaces.
    """
    lean, deeper = (one[:, None] for one in sharp_plane(focused, sines))
    slope = (sines / torch.sqrt(1 - sines**2))[:, None]
    # Where light along the tilt crosses the plane.
    behind = (deeper + lean * e[..., 1]) / (1 - lean * slope)
    start = torch.cat([e, behind[..., None]], -1) + rim_plane(focused, sines)[:, None]
    start[..., 1] += behind * slope
    way = torch.stack([torch.zeros_like(sines), sines], -1)[:, None] - turned / 3
    way = torch.cat([way, torch.sqrt((1 - (way**2).sum(-1, keepdim=True)).clamp_min(_GRAZING))], -1)
    third = trace(focused.lens, start, way).height[..., surfaces]
    return torch.where(torch.isfinite(third), (own + 3 * third) / 4, own)


def rim_depths(
    focused: FocusedLens, places: torch.Tensor, directions: torch.Tensor, surfaces: torch.Tensor
) -> torch.Tensor:
    """How far behind the plane across the axis that e is counted in the rims of surfaces are sharp, in metres, [N].

    For each of the rays with direction cosines `directions` [N, 2] across the axis that meets the rim of one of the
    `surfaces` [N], nearest to `places` [N, 2] of the paraxial entrance pupil.
    """
    _, nearest = _depths(focused, places, directions, surfaces)
    return _depths(focused, nearest, directions, surfaces)[0] - pupil_depth(focused)


@dataclass(frozen=True)
class _Rim:
    """Where rays through a place of the rim, under tilts of either sign, cross: z behind the lens, infinite where they
    do not, and `depth` behind the entrance pupil before it. `slope` is that of the ray head on behind the lens. Under a
    tilt of the sine σ the plane before the lens has the slope σ `lean`, and lies σ² `deeper` farther behind."""

    crossing: float
    slope: float
    depth: float
    lean: float
    deeper: float


@functools.lru_cache(maxsize=32)
def _rim(lens: FocusedLens) -> _Rim:
    sines = torch.tensor([0.0, -_LITTLE_TILT, _LITTLE_TILT], dtype=torch.float64)
    line = torch.linspace(0, 2.2 * lens.entrance_radius, _RIM_RAYS, dtype=torch.float64)

    def sent(y: torch.Tensor, tilts: torch.Tensor) -> Rays:
        """Rays through heights [F, N] of the entrance pupil."""
        start = torch.stack([torch.zeros_like(y), y, torch.full_like(y, lens.entrance_pupil)], -1)
        way = torch.stack([torch.zeros_like(tilts), tilts, torch.sqrt(1 - tilts**2)], -1)[:, None]
        return trace(lens.lens, start, way.expand_as(start))

    rays = sent(line[None], sines[:1])
    stopped = ~(rays.good & (rays.height <= 1).all(-1))[0]
    first = int(torch.nonzero(stopped)[0]) if bool(stopped.any()) else _RIM_RAYS - 1
    # Just beyond the edge head on: the highest ray is that at the surface whose rim stops it.
    y = line[max(first, 1)]
    rim = int(torch.nan_to_num(sent(y.expand(1, 1), sines[:1]).height[0, 0]).argmax())

    def met() -> torch.Tensor:
        """Heights [F, 1] in the entrance pupil of rays under the tilts that meet the rim."""
        at = y.expand(len(sines), 1)
        beyond, inside = (torch.sqrt(sent(share * at, sines).height[..., rim]) for share in (1.0, 0.9))
        rate = (beyond - inside) / (0.1 * at)
        for _ in range(_STEPS):
            at = at + (1 - torch.sqrt(sent(at, sines).height[..., rim])) / rate
        return at

    at = met()
    rays = sent(at, sines)
    place, _ = to_plane(rays.position, rays.direction, 0.0)
    slope = rays.direction[:, 0, 1] / rays.direction[:, 0, 2]
    crossing = float((place[1, 0, 1] - place[2, 0, 1]) / (slope[2] - slope[1]))
    depth = float((at[1, 0] - at[2, 0]) / (2 * math.tan(math.asin(_LITTLE_TILT))))
    if not math.isfinite(crossing + depth):
        # No ray gets through just beyond the edge: as of a lens without aberrations.
        return _Rim(math.inf, -lens.entrance_radius / lens.focal_length, 0.0, 0.0, 0.0)
    # Above, below, beside, and head on.
    ends = float(at[0, 0]) * torch.tensor([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0], [1.0, 0.0]], dtype=torch.float64)
    tilts = torch.tensor([[0.0, _LEANING_TILT]] * 3 + [[0.0, 0.0]], dtype=torch.float64)
    top, bottom, side, straight = map(float, _depths(lens, ends, tilts, torch.full((4,), rim))[0])
    lean = (top - bottom) / (2 * float(at[0, 0]) * _LEANING_TILT)
    deeper = ((top + bottom) / 4 + side / 2 - straight) / _LEANING_TILT**2
    deepest = _DEEPEST * lens.entrance_radius
    if not (math.isfinite(lean + deeper) and abs(lean) <= _STEEPEST_LEAN and abs(deeper) <= _STEEPEST_LEAN * deepest):
        lean = deeper = 0.0
    return _Rim(crossing, float(slope[0]), min(max(depth, -deepest), deepest), lean, deeper)


def _depths(
    focused: FocusedLens, places: torch.Tensor, directions: torch.Tensor, surfaces: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Depths [N] as `rim_depths`, for the rays through these places and behind the paraxial entrance pupil; and the
    nearest places [N, 2] of rays that meet the rims."""
    step = _BESIDE * focused.entrance_radius
    # Each ray, and four beside it or turned.
    moves = torch.zeros(5, 2, 2, dtype=torch.float64)
    moves[1:3, 0], moves[3:, 1] = step * torch.eye(2).double(), _TURNED * torch.eye(2).double()
    e, q = places + moves[:, 0, None], directions + moves[:, 1, None]
    start = torch.cat([e, torch.full_like(e[..., :1], focused.entrance_pupil)], -1)
    way = torch.cat([q, torch.sqrt(1 - (q**2).sum(-1, keepdim=True))], -1)
    height = torch.sqrt(trace(focused.lens, start, way).height)
    height = height.gather(-1, surfaces.expand(5, -1)[..., None])[..., 0]
    beside, turned = (height[1:3] - height[0]) / step, (height[3:] - height[0]) / _TURNED
    # A turn of the sine is more of the slope, by which a depth moves the rim: as much across, 1/cos² more along.
    cosine = way[0, :, 2]
    along = directions / (directions**2).sum(-1, keepdim=True).clamp_min(1e-300).sqrt()
    part = (along.mT * turned).sum(0)
    turned = cosine * (turned - (1 - cosine**2) * part * along.mT)
    square = (beside**2).sum(0)
    return (turned * beside).sum(0) / square, places + ((1 - height[0]) / square * beside).mT
