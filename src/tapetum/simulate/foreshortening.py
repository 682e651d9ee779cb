"""Foreshortening of the probe's picture: by the cosine of the tilt, along the tilt."""

from __future__ import annotations

import math
from typing import Protocol

import torch

from tapetum.optics.sampling import DoublePassGeometry

__all__ = ["Tilted", "cosines", "foreshortening", "foreshortens", "off_axis", "tangents", "twisted"]


class _Plan(Protocol):
    @property
    def expected_error(self) -> float: ...
    @property
    def missing(self) -> float: ...


class Tilted(Protocol):
    """What a pass reports here of itself."""

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
    """Sines [B, 2] of light at `angles` [2], in radians along x and y, from light of the tilts [B, 2].

    The angles are the probe's. The rotation that brings the lens's axis onto the laser, without a turn about that axis,
    takes them to the lens.
    """
    slopes = torch.tan(angles)
    along = 1 / torch.sqrt(1 + slopes.square().sum())
    across = slopes * along
    share = (sines * across).sum(-1, keepdim=True) / (1 + cosines(sines)[:, None])
    return across + sines * (along - share)


def foreshortens(one: Tilted, sines: torch.Tensor) -> bool:
    """Whether the cosine of the tilt moves anything in the picture by more than the plan's error allows."""
    if sines.requires_grad:
        return True
    tilt = float((sines.detach() ** 2).sum(-1).max()) if len(sines) else 0.0
    g = one.geometry
    reach = min(g.exit_angle + 2 * g.wavelength / g.radius, g.window / g.probe_focal_length)
    # Phase by which the picture's edge moves for the pupil's edge; its share in a picture's error is smaller.
    allowed = one.plan.expected_error - (one.plan.missing if math.isfinite(one.plan.missing) else 0.0)
    return 2 * math.pi / g.wavelength * g.radius * reach * tilt / 2 > 2 * min(allowed, 1e-2)


def foreshortening(sines: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation R and lower triangle T with R T = M, each [B, 2, 2], for tilts [B, 2]."""
    # (1 - cosθ)/sin²θ = 1/(1 + cosθ): no division by zero at zero tilt.
    scale = 1 / (1 + cosines(sines))
    eye = torch.eye(2, dtype=sines.dtype, device=sines.device)
    m = eye - scale[:, None, None] * sines[:, :, None] * sines[:, None, :]
    length = torch.sqrt(m[:, 0, 1] ** 2 + m[:, 1, 1] ** 2)
    c, s = m[:, 1, 1] / length, m[:, 0, 1] / length
    rotation = torch.stack([torch.stack([c, s], -1), torch.stack([-s, c], -1)], -2)
    return rotation, rotation.mT @ m


def twisted(directions: torch.Tensor, sines: torch.Tensor) -> torch.Tensor:
    """Directions [B, 2] in the pupil's coordinates when R of the tilts [B, 2] acts on the pupil."""
    rotation, _ = foreshortening(sines)
    return (rotation.mT @ directions[:, :, None])[:, :, 0]
