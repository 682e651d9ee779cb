"""Light that reaches the probe straight from a phone's dot projector.

A beam that points at the probe passes its aperture. The probe is focused at infinity and sees the projector as a disc
of diameter D_p f_p/d, as any point source that overfills the aperture; far away it becomes an Airy pattern.
"""

# NumPy types these functions in part only.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench.phone import Dots
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature

__all__ = ["DIVERGENCE", "EFFICIENCY", "PASSED", "beam_directions", "beam_offsets", "dot_image", "lit_time"]
__all__ += ["dot_window", "waist_at"]

Array = npt.NDArray[np.float64]

# Full angle of one beam, to 1/e² of its middle: assumed.
DIVERGENCE = math.radians(0.5)
# Electrons a photon of 940 nm, of a silicon sensor made for visible light: assumed.
EFFICIENCY = 0.05
# Transmission at 940 nm of a filter for the probe's own laser: assumed, an optical density of 4.
PASSED = 1e-4
# Largest phase step between two samples of the aperture, in radians.
_RADIANS = 2.0
_LEAST_SAMPLES = 48
_RINGS = 12


def beam_directions(dots: Dots) -> Array:
    """Unit vectors [N, 3] of the beams, in the axes of the back plate: x right, y down, z towards the probe.

    A lens images an array of lasers, so the beams are evenly spaced in the tangents of their angles (assumed).
    """
    x, y = (
        np.tan(angle / 2) * (np.linspace(-1, 1, count) if count > 1 else np.zeros(1))
        for angle, count in zip(dots.field, (dots.columns, dots.rows), strict=True)
    )
    c, s = math.cos(dots.tilt), math.sin(dots.tilt)
    places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) @ np.array([[c, s], [-s, c]])
    along = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def beam_offsets(directions: Array, sines: Array, distance: Array) -> Array:
    """Where beams cross the plane of the probe's aperture: [T, N, 2], in metres from its middle, in the plate's axes.

    `directions` [N, 3] are those of `beam_directions`, `distance` [T] is in metres. `sines` [T, 2] tilt the phone
    against the light before it rolls: positive values put the probe right of and below the middle of the phone's
    picture. A beam that points away from the probe gets an infinite offset.
    """
    # Phone and probe face each other: right in the phone's picture is left in the probe's.
    x, y = -sines[:, 0], sines[:, 1]
    z = np.sqrt(1 - x**2 - y**2)
    # The shortest rotation that takes the direction to the probe, d, to the axis: v - d (v·(d + z))/(1 + d_z), across
    # it.
    to_probe = np.stack([x, y, z], axis=-1)
    along = to_probe @ directions.T
    lean = (along + directions[:, 2]) / (1 + z[:, None])
    across = directions[None, :, :2] - lean[..., None] * to_probe[:, None, :2]
    ahead = along > 1e-3
    return np.where(ahead[..., None], distance[:, None, None] * across / np.where(ahead, along, 1.0)[..., None], np.inf)


def waist_at(distance: float, divergence: float = DIVERGENCE) -> float:
    """Radius of a beam, to 1/e² of its middle, at a distance; metres and radians."""
    return distance * math.tan(divergence / 2)


def dot_window(distance: float, radius: float, focal_length: float, wavelength: float, pitch: float) -> Grid:
    """Pixels that hold the image of a point at a distance, without its faintest rings; lengths in metres."""
    reach = focal_length * (radius / distance + _RINGS * wavelength / (2 * radius))
    side = 2 * math.ceil(reach / pitch) + 1
    return Grid(side, side, pitch)


def dot_image(
    output: Grid,
    offsets: Array,
    *,
    power: float,
    divergence: float,
    wavelength: float,
    distance: float,
    radius: float,
    focal_length: float,
    centre: tuple[float, float] = (0.0, 0.0),
) -> torch.Tensor:
    """Irradiance [H, W] in W/m² that beams from one point make on the sensor of a probe focused at infinity.

    `offsets` [N, 2] and `centre` (the image's place on the sensor) are in metres, `power` and `divergence` (full angle,
    radians) are those of each beam; `radius` and `focal_length` are the probe lens's. Beams do not interfere: each is a
    laser of its own. Computed is the Fraunhofer integral of exp(ikρ²/2d) times a Gaussian over the aperture. The
    picture is rotated by 180° against the sensor, so light from the right of the aperture falls left in the disc.
    """
    k = 2 * math.pi / wavelength
    u, v = output.x() - centre[0], output.y() - centre[1]
    widest = math.hypot(float(u.abs().max()), float(v.abs().max())) / focal_length
    count = max(_LEAST_SAMPLES, math.ceil(2 * k * radius * (radius / distance + widest) / _RADIANS))
    aperture = disc_quadrature(radius, count, count)
    bend = aperture.weights * phasor(k / (2 * distance) * aperture.rho_squared())
    to_pixels = MatrixFourier(aperture.x, aperture.y, u, v, -k / focal_length)
    waist = waist_at(distance, divergence)
    total = torch.zeros(output.rows, output.columns, dtype=torch.float64)
    for x, y in np.asarray(offsets, np.float64).reshape(-1, 2).tolist():
        along, down = (torch.exp(-((one - at) ** 2) / waist**2) for one, at in ((aperture.x, x), (aperture.y, y)))
        total += to_pixels(down[:, None] * along * bend).abs() ** 2
    return total * (2 * power / (math.pi * waist**2) / (wavelength * focal_length) ** 2)


def lit_time(dots: Dots, times: Array, exposure: Array, phase: float) -> Array:
    """Seconds [T] for which the projector shines during exposures centred on `times`, both [T] in seconds.

    A pulse begins at `phase`, in seconds.
    """

    def before(at: Array) -> Array:
        turns = np.floor((at - phase) / dots.period)
        return turns * dots.pulse + np.minimum(at - phase - turns * dots.period, dots.pulse)

    # Rounded to nanoseconds: an exposure wholly in the dark must see nothing.
    return np.maximum(0.0, np.round(before(times + exposure / 2) - before(times - exposure / 2), 9))
