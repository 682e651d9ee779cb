"""From watts at the laser to electrons on the probe's pixels."""

# SciPy and NumPy type these functions in part only.
# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false

from __future__ import annotations

import functools
import math

import numpy as np
import numpy.typing as npt
import torch
from scipy.special import j0, j1

from tapetum.bench import Layer, ProbeSensor, Scene, TargetSensor, at_wavelength
from tapetum.errors import InputError
from tapetum.simulate.sensor_plane import orders_of

__all__ = [
    "beam_radius",
    "dark_electrons",
    "electrons",
    "encircled_energy",
    "illumination_curvature",
    "irradiance_at_target",
    "layer_transmittance",
    "line_of",
    "photoelectrons",
    "photon_energy",
    "return_radius_by_rays",
    "share_in_disc",
    "specular_reflectance",
]

_PLANCK = 6.62607015e-34  # J s, exact (SI)
_LIGHT = 299792458.0  # m/s, exact (SI)
# Largest phase that is integrated, at 0.8 nodes a radian (a factor of 1.6 above Nyquist's).
_MOST_RADIANS = 400.0


def beam_radius(scene: Scene) -> float:
    """Radius of the lit disc at the target, in metres (paper, figure 3).

    Collimated light: half the diameter, by default the probe's own aperture. Diverging light: from a point at the
    probe.
    """
    return scene.illumination.radius(scene.distance, scene.probe.lens.aperture_radius)


def irradiance_at_target(scene: Scene) -> float:
    """Irradiance of the first beam on the target's aperture, in W/m², spread evenly over the lit disc."""
    return scene.illumination.power / (math.pi * beam_radius(scene) ** 2)


def illumination_curvature(scene: Scene) -> float:
    """1/R of the wave at the target, in 1/m: the illumination's `vergence` where it has one.

    Otherwise 0 for collimated light and 1/distance for a source at the probe.
    """
    return scene.illumination.curvature(scene.distance)


def return_radius_by_rays(
    radius: float, focal_length: float, image_distance: float, curvature: float, distance: float
) -> float:
    """Geometric radius of a thin-lens target's returning beam at `distance` from it, in metres.

    `image_distance` is from the lens to the reflecting plane; `curvature`, in 1/m, is positive from a source at R.
    """
    # Collimated light leaves with curvature 2/(x_d + f), converging; other light enters with a slope of its own.
    slope_in = 1 / focal_length - curvature
    # A ray that entered at x leaves at gain·x with the slope slope_out·x, if that is inside the aperture.
    gain = 1 - 2 * image_distance * slope_in
    slope_out = slope_in + gain / focal_length
    return radius / max(1.0, abs(gain)) * abs(gain - distance * slope_out)


def encircled_energy(disc: float, radius: float, wavelength: float, distance: float) -> float:
    """Share of a uniform, round, plane wave that falls on a disc far away.

    1 - J0²(v) - J1²(v), v = 2π r R/(λ d) for an aperture of radius r and a disc of radius R, in metres, at a distance d
    (Lord Rayleigh, Phil. Mag. 11, 214 (1881); M. Born and E. Wolf, Principles of Optics, section 8.5.2).
    """
    v = 2 * math.pi * radius * disc / (wavelength * distance)
    return float(1 - j0(v) ** 2 - j1(v) ** 2)


def share_in_disc(disc: float, radius: float, spread: float, wavelength: float, distance: float) -> float:
    """Share of a uniform, round, spherical wave that falls on a disc of radius `disc` on its axis. All in metres.

    `radius` is the beam's where it begins, `spread` its geometric one at the disc; whether it converges or diverges has
    no further effect. Fresnel's integral is taken by Gauss-Legendre quadrature in the plane of the disc and over the
    disc. Where the phase turns too often for that, the result is the ratio of the areas times `encircled_energy`,
    within 3 % of the light.
    """
    v = 2 * math.pi * radius * disc / (wavelength * distance)
    turns = math.pi * radius * spread / (wavelength * distance)
    if v + turns > _MOST_RADIANS:
        by_rays = min(1.0, (disc / spread) ** 2) if spread > 0 else 1.0
        return by_rays * encircled_energy(disc, radius, wavelength, distance)
    x, w = _gauss(40 + int(0.8 * (v + turns)))
    field = j0(v * x[:, None] * x[None, :]) @ (np.exp(1j * turns * x**2) * x * w)
    return float((np.abs(field) ** 2 * x * w).sum() * 2 * v**2)


@functools.lru_cache(maxsize=256)
def _gauss(count: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Places in 0 … 1 and weights of Gauss-Legendre quadrature; finding them takes as long as the integral."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return (nodes + 1) / 2, weights / 2


def line_of(scene: Scene, wavelength: float | None = None) -> tuple[float, float]:
    """Wavelength in metres and power in watts of the illumination's line at a wavelength, by default its first.

    Raises InputError when the scene has no such line.
    """
    light = scene.illumination
    known = [(light.wavelength, light.power), *((line.wavelength, line.power) for line in light.lines)]
    if wavelength is None:
        return known[0]
    nearest = min(known, key=lambda line: abs(line[0] - wavelength))
    # Wavelengths of single precision too.
    if math.isclose(nearest[0], wavelength, rel_tol=1e-6):
        return nearest
    names = ", ".join(f"{one * 1e9:g}" for one, _ in known)
    what = f"the scene has no light of {wavelength * 1e9:g} nm"
    raise InputError(what, where="wavelength", remedy=f"choose one of {names} nm")


def specular_reflectance(sensor: TargetSensor, wavelength: float) -> float:
    """Power reflectance of a target's sensor in the mirror's direction (order 0, on the axis); masks are ignored."""
    if sensor.mask is not None:
        return sensor.reflectance
    orders = orders_of(sensor, wavelength, 0.0)
    return abs(complex(orders[0].at(torch.zeros(1, 2, dtype=torch.float64)))) ** 2 if orders else 0.0


def layer_transmittance(layer: Layer, wavelength: float) -> float:
    """Power transmittance of one passage; by default 1 less reflection and scattering."""
    if layer.transmittance is not None:
        return at_wavelength(layer.transmittance, wavelength)
    scattered = layer.diffuse.albedo if layer.diffuse is not None else 0.0
    return max(0.0, 1 - at_wavelength(layer.reflectance, wavelength) - scattered)


def photon_energy(wavelength: float) -> float:
    """hc/λ in joules, for a wavelength in metres."""
    return _PLANCK * _LIGHT / wavelength


def photoelectrons(irradiance: torch.Tensor, sensor: ProbeSensor, wavelength: float) -> torch.Tensor:
    """Mean electrons a pixel and frame from irradiance (W/m², any shape) of one wavelength; differentiable.

    For several wavelengths sum them, and add `dark_electrons` once.
    """
    gain = sensor.pitch**2 * sensor.exposure * sensor.quantum_efficiency / photon_energy(wavelength)
    return irradiance * gain


def dark_electrons(sensor: ProbeSensor) -> float:
    """Mean electrons a pixel and frame without the illumination: background and dark current; no hot pixels."""
    return sensor.background + sensor.dark_current * sensor.exposure


def electrons(irradiance: torch.Tensor, sensor: ProbeSensor, wavelength: float) -> torch.Tensor:
    """Mean electrons a pixel and frame, `photoelectrons` and `dark_electrons` together; differentiable."""
    return photoelectrons(irradiance, sensor, wavelength) + dark_electrons(sensor)
