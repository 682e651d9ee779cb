"""Gaze, in fractions of the field, and the tilts that correspond to it."""

from __future__ import annotations

import math

import torch

from tapetum.bench import PrescriptionLens, Scene
from tapetum.errors import InputError
from tapetum.optics.grid import lens_numbers
from tapetum.simulate.field_map import FieldMap, field_map
from tapetum.simulate.pupil_fits import rounded_up

__all__ = ["field_size", "gaze_of", "largest_sine", "spot_places", "tilt_of_gaze"]

_NO_TILT = 1e-12
# Nearer to the axis a traced lens counts as linear: the fit's offset there, some 1e-11 m, would spoil the slope.
_NEAR_TILT, _NEAR_PLACE = 1e-4, 1e-6


def largest_sine(sines: torch.Tensor) -> float:
    """The steepest of tilts [B, 2] given as sines."""
    return float((sines.detach() ** 2).sum(-1).max().sqrt())


def gaze_of(scene: Scene, sines: torch.Tensor) -> torch.Tensor:
    """Gaze, in fractions of the field, for tilts given as sines: both [..., 2].

    Raises
    ------
    InputError
        For a tilt beyond the field that a traced lens and its sensor cover, and for sines of 1 or more, or not finite.
    """
    size = torch.sqrt((sines**2).sum(-1, keepdim=True).clamp_min(_NO_TILT**2))
    if not bool((size < 1).all()):
        what = f"must be below 1 in all, is {float(size.detach().max()):g}"
        raise InputError(what, where="sines", remedy="give the sines of angles below 90 degrees")
    traced = _traced(scene)
    if traced is not None:
        size = size.clamp_min(_NEAR_TILT)
        place = sines / size * traced.image(size[..., 0])[..., None]
    else:
        place = sines / torch.sqrt(1 - size**2) * _image_distance(scene)
    return (place + _axis(scene)) / field_size(scene)


def tilt_of_gaze(scene: Scene, gaze: torch.Tensor) -> torch.Tensor:
    """Sines of the tilt for a gaze in fractions of the field: both [..., 2].

    Raises
    ------
    InputError
        For a gaze beyond what a traced lens covers.
    """
    place = gaze * field_size(scene) - _axis(scene)
    traced = _traced(scene)
    if traced is not None:
        height = torch.sqrt((place**2).sum(-1, keepdim=True).clamp_min(_NEAR_PLACE**2))
        return place / height * traced.sine(height[..., 0])[..., None]
    tangents = place / _image_distance(scene)
    return tangents / torch.sqrt(1 + (tangents**2).sum(-1, keepdim=True))


def spot_places(scene: Scene, image_distance: torch.Tensor, sines: torch.Tensor) -> torch.Tensor:
    """Places [B, 2] of the spots of tilts [B, 2] on the target's sensor, in metres from the lens's axis.

    Beyond the field of a traced lens the place is infinite: no light arrives.
    """
    size = torch.sqrt((sines**2).sum(-1, keepdim=True).clamp_min(_NO_TILT**2))
    traced = _traced(scene)
    if traced is None:
        return sines / torch.sqrt(1 - size**2) * image_distance.to(sines.device)
    edge = traced.nodes.steepest
    height = traced.image(size[..., 0].clamp(_NEAR_TILT, edge))[..., None]
    return torch.where(size > edge * (1 + 1e-9), math.inf, height) * (sines / size.clamp_min(_NEAR_TILT))


def field_size(scene: Scene) -> torch.Tensor:
    """Width and height of the target's sensor, in metres."""
    sensor = scene.target.sensor
    return torch.tensor(sensor.pixels, dtype=torch.float64) * sensor.pitch


def _axis(scene: Scene) -> torch.Tensor:
    """Where the lens's axis meets the sensor, in metres from its middle, where gaze is zero."""
    return torch.tensor(scene.target.sensor.decentre, dtype=torch.float64)


def _image_distance(scene: Scene) -> float:
    z, _ = lens_numbers(scene.target.lens.focal_length, scene.target.object_distance)
    return z


def _traced(scene: Scene) -> FieldMap | None:
    target = scene.target
    if not isinstance(target.lens, PrescriptionLens):
        return None
    sensor = target.sensor
    # From the lens's axis to the corner farthest from it.
    half_diagonal = math.hypot(*sensor.pixels) * sensor.pitch / 2 + rounded_up(math.hypot(*sensor.decentre))
    return field_map(target.lens, scene.illumination.wavelength, target.object_distance, half_diagonal)
