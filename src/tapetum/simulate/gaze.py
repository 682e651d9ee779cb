"""Gaze, in fractions of the field, and the tilts that it stands for."""

from __future__ import annotations

import torch

from tapetum.bench import Scene
from tapetum.optics.grid import lens_numbers

__all__ = ["gaze_of", "largest_sine", "tilt_of_gaze"]


def largest_sine(sines: torch.Tensor) -> float:
    """The steepest of tilts [B, 2] given as sines."""
    return float((sines.detach() ** 2).sum(-1).max().sqrt())


def gaze_of(scene: Scene, sines: torch.Tensor) -> torch.Tensor:
    """Gaze, in fractions of the field, for tilts given as sines: both [..., 2]."""
    return sines / torch.sqrt(1 - (sines**2).sum(-1, keepdim=True)) * _field_factor(scene)


def tilt_of_gaze(scene: Scene, gaze: torch.Tensor) -> torch.Tensor:
    """Sines of the tilt for a gaze in fractions of the field: both [..., 2]."""
    tangents = gaze / _field_factor(scene)
    return tangents / torch.sqrt(1 + (tangents**2).sum(-1, keepdim=True))


def _field_factor(scene: Scene) -> torch.Tensor:
    target = scene.target
    z, _ = lens_numbers(target.lens.focal_length, target.object_distance)
    columns, rows = target.sensor.pixels
    return z / target.sensor.pitch / torch.tensor([columns, rows], dtype=torch.float64)
