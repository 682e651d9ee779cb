"""Paths of a thin lens's light beyond the terms that a round table holds, followed along its rays.

A table by one radius includes the parabola ρ²/2R of the incoming light, and the transform over the distance that of the
light that leaves. It leaves out that the tilted lens is foreshortened, that waves are spheres, and that a tilted
sensor's distance changes along it. Each of these is a small path that varies slowly over the pupil, so it is taken
along the ray: from x0, where it enters, over u on the sensor to x, where it leaves. The largest one, the foreshortened
parabola of the incoming light, also moves the ray: the table is read where the ray would be without it
(docs/conventions.md, "What a table does not hold").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from tapetum.errors import InputError
from tapetum.optics.fourier import phasor
from tapetum.optics.sampling import DoublePassGeometry

__all__ = ["Leg", "TruePaths", "check_squash", "neglected_path"]

# Rings of a focused spot used in the estimate for its own tilt.
_RINGS = 3
# β z of returning light focused in the lens.
_STRAIGHT = 1e-6
# Largest s²/(Rβ) at which the round lens's rays are a valid start.
_MOST_SQUASHED = 0.1


@dataclass(frozen=True)
class Leg:
    """One order of one plane for a batch of gazes, all vectors [B, 2] in the pupil's coordinates.

    `sines` and `slopes` are s and t of the tilt, `turn` is τ, the order's direction; `image_distance` [B] is z where
    the gaze meets the plane; `tilt` is the plane's a, None for an untilted one.
    """

    sines: torch.Tensor
    slopes: torch.Tensor
    turn: torch.Tensor
    image_distance: torch.Tensor
    tilt: torch.Tensor | None = None


def neglected_path(g: DoublePassGeometry, sine: float, *, distance: float | None = None, tilt: float = 0.0) -> float:
    """Largest error, in metres, of any path by table and transform, up to the tilt of this sine."""
    r, v = g.radius, abs(g.curvature)
    missed = v * (r * sine) ** 2 / 2 + v**2 * sine * r**3 / 2 + v**3 * r**4 / 8
    if distance is not None:
        missed += (r * sine) ** 2 / (2 * distance)
    if tilt:
        spot = g.spot_radius + _RINGS * g.airy_step
        slope = sine / math.sqrt(1 - sine**2) + (r + spot) / g.image_distance
        missed += 2 * tilt * spot * slope * (r + spot) / g.image_distance
    return missed


def check_squash(g: DoublePassGeometry) -> None:
    """Refuse light of a near source that a tilted lens returns too far from round.

    Raises InputError where s²/(Rβ) is not small, β being the bend of the light that returns.
    """
    beta = g.curvature - 1 / g.focal_length + 1 / (2 * g.image_distance)
    if g.curvature == 0 or g.sine == 0:
        return
    if g.sine**2 * abs(g.curvature) > _MOST_SQUASHED * abs(beta):
        source = f"a source at {1 / g.curvature:.3g} m" if g.curvature > 0 else f"a vergence of {g.curvature:.3g}/m"
        raise InputError(
            f"{source} and a tilt of {math.degrees(math.asin(g.sine)):.3g} deg bring the light back to the lens nearly "
            "in a point, far from round: neither table nor rays hold it",
            where="illumination",
            remedy="turn the target less, or move the source farther away than twice its focal length",
        )


class TruePaths:
    """The paths of one scene's light.

    `wavenumber`, `radius`, `focal_length` and `curvature` are k, r, f and 1/R as scalars; tensors carry gradients.
    `distance` is that of the probe's aperture in metres, None where light goes to the far field.
    """

    def __init__(
        self,
        wavenumber: torch.Tensor,
        radius: torch.Tensor,
        focal_length: torch.Tensor,
        curvature: torch.Tensor,
        distance: torch.Tensor | None = None,
    ) -> None:
        self._k, self._r, self._f, self._v = wavenumber, radius, focal_length, curvature
        self._distance = distance

    def __call__(
        self, x: torch.Tensor, y: torch.Tensor, leg: Leg, straight: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Where to read the table, ξ and η [B, rows, columns] in metres, and the factor for the value read there.

        `x` and `y` are the pupil's columns and rows; `straight` is z of the plane for which the pupil's own bend was
        made.
        """
        z = leg.image_distance[:, None, None]
        x, y = x[None, None, :], y[None, :, None]
        sx, sy = _both(leg.sines)
        tx, ty = _both(leg.slopes)
        ox, oy = _both(leg.turn)
        wx, wy = x - z * (2 * tx + ox), y - z * (2 * ty + oy)
        # Along the tilt the entering wave bends less: β becomes the matrix β - s sᵀ/R.
        beta = self._v - 1 / self._f + 1 / (2 * z)
        # Light that all returns to one point has no ray of its own: any small bend serves.
        beta = torch.where(beta.abs() * z < _STRAIGHT, _STRAIGHT / z, beta)
        squash = 1 - (sx**2 + sy**2) * self._v / beta
        along = (sx * wx + sy * wy) * (self._v / beta / squash)
        read_x, read_y = wx + sx * along, wy + sy * along
        x0, y0 = read_x / (2 * z * beta), read_y / (2 * z * beta)
        # Light without a ray comes from the pupil's edge.
        inside = (self._r / torch.sqrt(x0**2 + y0**2 + 1e-30)).clamp(max=1)
        x0, y0 = x0 * inside, y0 * inside
        path = ((read_x - wx) * x0 + (read_y - wy) * y0) / (2 * z)
        path = path + (read_x**2 - wx**2 + read_y**2 - wy**2) / (4 * z)
        came = sx * x0 + sy * y0
        square = x0**2 + y0**2
        sphere = (2 * came + self._v * square) / (torch.sqrt(1 + 2 * self._v * came + self._v**2 * square) + 1)
        path = path + sphere - came - self._v * square / 2
        # The wave's strength and the lens's visible width both change along the tilt.
        size = (1 - 1.5 * self._v * came) / torch.sqrt(squash)
        if leg.tilt is not None:
            path = path + self._tilted(x, y, x0, y0, leg)
        path = path + (1 / z - 1 / straight) * (x**2 + y**2) / 2
        if self._distance is not None:
            # For the probe the lens is foreshortened along the tilt, and its places lie farther away there.
            out = sx * x + sy * y
            path, size = path - out**2 / (2 * self._distance), size * (1 - 1.5 * out / self._distance)
        return read_x, read_y, phasor(self._k * path) * size

    def _tilted(self, x: torch.Tensor, y: torch.Tensor, x0: torch.Tensor, y0: torch.Tensor, leg: Leg) -> torch.Tensor:
        """The change of focus along a tilted plane, within the spot."""
        assert leg.tilt is not None
        z = leg.image_distance[:, None, None]
        ax, ay = _both(leg.tilt)
        tx, ty = _both(leg.slopes)
        ox, oy = _both(leg.turn)
        ux, uy = (x0 + x - z * ox) / 2, (y0 + y - z * oy) / 2
        farther = ax * (ux - z * tx) + ay * (uy - z * ty)
        ways = (ux - x0) ** 2 + (uy - y0) ** 2 + (ux - x) ** 2 + (uy - y) ** 2
        # The order's direction already includes the part that is constant over the spot.
        return farther * (tx**2 + ty**2) - ways * farther / (2 * z * (z + farther))


def _both(vector: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    return vector[:, 0, None, None], vector[:, 1, None, None]
