"""Speckle: coherent light from a rough plane of the target, one pattern for each roughness."""

# NumPy types what torch takes from it in part only.
# pyright: reportUnknownMemberType=false

from __future__ import annotations

import math
from typing import Unpack

import torch

from tapetum.errors import InputError
from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.sampling import DoublePassGeometry
from tapetum.simulate.scattering import PlaneOptions, radiance, scattering_plane

__all__ = ["speckle_return"]

_MOST_BYTES = 3 << 29
# Radians between two samples of a pupil: π is the Nyquist limit.
_TURN = 1.5


def speckle_return(
    geometry: DoublePassGeometry,
    distance: float,
    probe_radius: float,
    output: Grid,
    *,
    seed: int,
    centre: tuple[float, float] = (0.0, 0.0),
    count: int = 1,
    rings: float = 12.0,
    **options: Unpack[PlaneOptions],
) -> torch.Tensor:
    """Speckle patterns of a scattering plane of the target, in coherent light.

    Parameters
    ----------
    geometry, distance, probe_radius, output, centre, **options
        With `albedo`, `spread`, `image_distance` and `lit_radius` as for `diffuse_return`, which is the mean of many.
    seed
        Of the plane's roughness; the same seed gives the same patterns.
    count
        Number of patterns.
    rings
        Airy rings of the spot that scatter, beyond its geometric radius. About 0.2/rings of the light lies outside and
        is left out.

    Returns
    -------
    torch.Tensor
        [count, H, W] float64, W/m² for 1 W/m² at the target, at the middle of each pixel.

    Raises
    ------
    InputError
        For a number out of its range, or where the grids exceed the memory allowed.

    Notes
    -----
    The plane's field is circular Gaussian white noise of the variance λ² L(v)/dv² (J. W. Goodman, Speckle Phenomena in
    Optics, 2007, sections 2.2 and 4.5); samples at half the Airy ring's width make its coherence on the pupil exact. A
    clipped pattern passes the probe's aperture by two matrix Fourier transforms. Polarisation is left out: a
    depolarising plane shows two independent patterns at once, and the contrast falls to 1/√2.
    """
    plane = scattering_plane(geometry, distance, probe_radius, **options)
    if count < 1:
        raise InputError(f"must be at least 1, is {count}", where="count", remedy="ask for one pattern or more")
    if not rings > 0:
        raise InputError(f"must be positive, is {rings}", where="rings", remedy="leave it out")
    k, r, z, f_p = plane.wavenumber, plane.radius, plane.z, geometry.probe_focal_length
    q_x, q_y = output.x() - centre[0], output.y() - centre[1]
    image = max(float(q_x.abs().max()), float(q_y.abs().max())) / f_p
    airy = plane.wavelength * z / (2 * r)
    half = z * plane.lit * abs(plane.inward) + rings * airy * r / plane.lit + 4 * plane.spread
    side = 2 * math.ceil(2 * half / airy)
    sensor = Grid(side, side, 2 * half / side)
    bend = r * abs(plane.outward)
    clipped = math.isfinite(probe_radius)
    # Steepest slopes of the field on the target's pupil and on the probe's, each against its next plane.
    onward = r / distance + probe_radius / distance if clipped else image
    columns = max(48, math.ceil(2 * r * k * (half / z + bend + onward) / _TURN))
    stop = math.ceil(2 * probe_radius * k * ((r + probe_radius) / distance + image) / _TURN) if clipped else 0
    stop = max(48, stop) if clipped else 0
    grids = side**2 + 1.2 * (columns**2 + stop**2) + side * columns + columns * stop + 2 * output.rows * output.columns
    if 16 * 3 * grids > _MOST_BYTES:
        what = f"speckle needs {side}² samples of the sensor, {columns}² of its pupil and {stop}² of the probe's"
        remedy = "take a smaller aperture or spread, or the expected image of `diffuse_return`"
        raise InputError(what, where="speckle", remedy=remedy)

    v = sensor.x()
    distances = torch.hypot(v[None, :], v[:, None]).numpy()
    lit = torch.from_numpy(radiance(plane, half * math.sqrt(2))(distances)).clamp_min(0)
    amplitude = (lit / 2).sqrt() * plane.wavelength * sensor.pitch
    pupil = disc_quadrature(r, columns, math.ceil(1.2 * columns))
    phase = k / 2 * plane.outward * pupil.rho_squared()
    onto_pupil = MatrixFourier(v, v, pupil.x, pupil.y, k / z)
    scale = 1 / (plane.wavelength * z) / (plane.wavelength * f_p)
    steps: list[MatrixFourier] = [onto_pupil]
    # Factors of the field after each transform.
    screens = [pupil.weights * phasor(phase) * scale]
    end = pupil
    if clipped:
        end = disc_quadrature(probe_radius, stop, math.ceil(1.2 * stop))
        screens[0] = screens[0] * phasor(k / (2 * distance) * pupil.rho_squared())
        steps.append(MatrixFourier(pupil.x, pupil.y, end.x, end.y, k / distance))
        screens.append(end.weights * phasor(k / (2 * distance) * end.rho_squared()) / (plane.wavelength * distance))
    onto_image = MatrixFourier(end.x, end.y, q_x, q_y, k / f_p)
    random = torch.Generator().manual_seed(seed)
    patterns: list[torch.Tensor] = []
    for _ in range(count):
        noise = torch.randn(2, side, side, generator=random, dtype=torch.float64)
        field = torch.complex(noise[0], noise[1]) * amplitude
        for step, screen in zip(steps, screens, strict=True):
            field = step(field) * screen
        patterns.append(onto_image(field).abs() ** 2)
    return torch.stack(patterns)
