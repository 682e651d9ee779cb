"""Foreshortening of the probe's picture: by the cosine of the tilt, along the tilt."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch

from tapetum.optics.sampling import DoublePassGeometry

__all__ = ["Tilted", "Tilts", "cosines", "flattest", "foreshortening", "foreshortens", "off_axis", "tangents", "turned"]


class _Plan(Protocol):
    @property
    def expected_error(self) -> float: ...
    @property
    def missing(self) -> float: ...


class Tilted(Protocol):
    """What foreshortening needs to know of a pass."""

    @property
    def geometry(self) -> DoublePassGeometry: ...
    @property
    def plan(self) -> _Plan: ...


def cosines(sines: torch.Tensor) -> torch.Tensor:
    """Cosine [B] of the angle between the laser and the lens's axis, for tilts [B, 2]."""
    return torch.sqrt(1 - (sines**2).sum(-1))


def tangents(sines: torch.Tensor) -> torch.Tensor:
    """Slopes [B, 2] behind a lens without distortion: light of the tilt s [B, 2] is aimed at z s/cosθ."""
    return sines / cosines(sines)[:, None]


def off_axis(sines: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
    """Sines [B, 2] of light at `angles` [2] or [B, 2], in radians along x and y, from light of the tilts [B, 2].

    The angles are the probe's. The rotation that brings the lens's axis onto the laser, without a turn about that axis,
    takes them to the lens.
    """
    slopes = torch.tan(angles)
    along = 1 / torch.sqrt(1 + slopes.square().sum(-1, keepdim=True))
    across = slopes * along
    share = (sines * across).sum(-1, keepdim=True) / (1 + cosines(sines)[:, None])
    return across + sines * (along - share)


def turned(vectors: torch.Tensor, angles: torch.Tensor) -> torch.Tensor:
    """Vectors [B, 2] turned from x to y by angles [B], in radians."""
    c, s, (x, y) = torch.cos(angles), torch.sin(angles), vectors.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y], -1)


def foreshortens(one: Tilted, sines: torch.Tensor) -> torch.Tensor:
    """Whether each tilt's cosine [B] moves anything in the picture by more than the plan's error allows."""
    if sines.requires_grad:
        return torch.ones(len(sines), dtype=torch.bool, device=sines.device)
    return (sines.detach() ** 2).sum(-1) > flattest(one)


def flattest(one: Tilted) -> float:
    """Squared sine of a tilt up to which its cosine moves nothing in the picture by more than the plan allows."""
    g = one.geometry
    reach = min(g.exit_angle + 2 * g.wavelength / g.radius, g.window / g.probe_focal_length)
    # Phase by which the picture's edge moves for the pupil's edge; its share in a picture's error is smaller.
    allowed = one.plan.expected_error - (one.plan.missing if math.isfinite(one.plan.missing) else 0.0)
    edge = 2 * math.pi / g.wavelength * g.radius * reach / 2
    return 2 * min(allowed, 1e-2) / edge if edge else math.inf


def foreshortening(sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation R and upper triangle T with R T = M, each [B, 2, 2], for tilts [B, 2]."""
    # (1 - cosθ)/sin²θ = 1/(1 + cosθ): no division by zero at zero tilt.
    scale = 1 / (1 + cosines(sines))
    eye = torch.eye(2, dtype=sines.dtype, device=sines.device)
    m = eye - scale[:, None, None] * sines[:, :, None] * sines[:, None, :]
    length = torch.sqrt(m[:, 0, 0] ** 2 + m[:, 1, 0] ** 2)
    c, s = m[:, 0, 0] / length, -m[:, 1, 0] / length
    rotation = torch.stack([torch.stack([c, s], -1), torch.stack([-s, c], -1)], -2)
    return rotation, rotation.mT @ m


@dataclass(frozen=True)
class Tilts:
    """A batch of tilts [B, 2] with the numbers that every part of a pass needs.

    Parameters
    ----------
    sines, slopes, cosines
        Of the tilts, and their tangents behind a lens: [B, 2], [B, 2] and [B].
    size
        Their squared sines, infinite where they carry gradients.
    centres
        Places of the RR's own centre on the probe's sensor [B, 2], in metres; None in its middle.
    rotation, triangle
        R and T of `foreshortening`; None where it is too small to count.
    """

    sines: torch.Tensor
    slopes: torch.Tensor
    cosines: torch.Tensor
    size: tuple[float, ...]
    centres: torch.Tensor | None
    rotation: torch.Tensor | None
    triangle: torch.Tensor | None

    @classmethod
    def of(cls, sines: torch.Tensor, centres: torch.Tensor | None = None) -> Tilts:
        """Of the sines [B, 2] along x and y."""
        found = (sines.detach() ** 2).sum(-1).cpu().numpy()
        size = tuple(math.inf if sines.requires_grad else float(one) for one in found)
        return cls(sines, tangents(sines), cosines(sines), size, centres, *foreshortening(sines))

    def some(self, which: slice, flat: float) -> Tilts:
        """Some of them; without foreshortening if all their squared sines are at most `flat`."""
        size = self.size[which]
        turned = max(size, default=0.0) > flat
        return Tilts(
            self.sines[which],
            self.slopes[which],
            self.cosines[which],
            size,
            None if self.centres is None else self.centres[which],
            self.rotation[which] if turned and self.rotation is not None else None,
            self.triangle[which] if turned and self.triangle is not None else None,
        )

    def framed(self, directions: torch.Tensor) -> torch.Tensor:
        """Directions [B, 2] in the pupil's coordinates, on which R acts."""
        return directions if self.rotation is None else (self.rotation.mT @ directions[:, :, None])[:, :, 0]
