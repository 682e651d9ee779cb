"""From watts at the laser to electrons on the probe's pixels."""

from __future__ import annotations

import math

import torch

from tapetum.bench import ProbeSensor, Scene
from tapetum.optics.grid import lens_numbers

__all__ = [
    "beam_radius",
    "electrons",
    "illumination_curvature",
    "irradiance_at_target",
    "return_radius_at_probe",
]

_PLANCK = 6.62607015e-34  # J s, exact (SI)
_LIGHT = 299792458.0  # m/s, exact (SI)


def beam_radius(scene: Scene) -> float:
    """Radius of the lit disc at the target, in metres (paper, figure 3).

    Collimated: half the diameter, the probe's own aperture where none is given. Diverging: from a point at the probe.
    """
    light = scene.illumination
    if light.divergence is not None:
        return scene.distance * math.tan(light.divergence / 2)
    if light.diameter is not None:
        return light.diameter / 2
    return scene.probe.lens.aperture_radius


def irradiance_at_target(scene: Scene) -> float:
    """Irradiance of the first beam on the target's aperture, in W/m², spread evenly over the lit disc."""
    return scene.illumination.power / (math.pi * beam_radius(scene) ** 2)


def illumination_curvature(scene: Scene) -> float:
    """1/R of the wave that reaches the target, in 1/m: 0 collimated, 1/distance from a source at the probe."""
    return 0.0 if scene.illumination.mode == "collimated" else 1 / scene.distance


def return_radius_at_probe(scene: Scene) -> float:
    """Radius of the returning beam at the probe, by rays and diffraction, in metres.

    Above the probe's aperture radius part of the return misses the probe. This version does not model that loss.
    """
    lens, distance = scene.target.lens, scene.target.object_distance
    # By rays: collimated light leaves with curvature 2/(x_d + f), converging; light from a source at the probe arrives
    # with a slope of its own.
    slope_in = 1 / lens.focal_length - illumination_curvature(scene)
    z, _ = lens_numbers(lens.focal_length, distance)
    gain = 1 - 2 * z * slope_in
    curvature = slope_in / gain + 1 / lens.focal_length
    rays = lens.aperture_radius * abs(1 - scene.distance * curvature)
    return rays + 1.22 * scene.illumination.wavelength * scene.distance / (2 * lens.aperture_radius)


def electrons(irradiance: torch.Tensor, sensor: ProbeSensor, wavelength: float) -> torch.Tensor:
    """Mean electrons a pixel and frame, background and dark current included; differentiable.

    Parameters
    ----------
    irradiance
        On the sensor, in W/m², any shape.
    sensor
        Its pitch, exposure and quantum efficiency.
    wavelength
        In metres.
    """
    photon = _PLANCK * _LIGHT / wavelength
    gain = sensor.pitch**2 * sensor.exposure * sensor.quantum_efficiency / photon
    return irradiance * gain + (sensor.background + sensor.dark_current * sensor.exposure)
