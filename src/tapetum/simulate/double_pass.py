"""The double pass on grids: through the target's lens, off its sampled sensor, back, and to the probe's focal plane.

This is the slower engine, for any sensor plane; `RoundPass` computes mirrors and gratings from the table of a round
field.

The quadratic phases of lens and free space are removed before sampling; defocus and a tilt remain (paper, equations 1
to 6, in the form of docs/conventions.md, "The double pass"):

    G(v)  = 1/(iλz) ∫ P(x) exp(iφ_in(x)) exp(-ik x·v/z) d²x            the spot, seen from its own centre u0 = z t
    U3(x) = 1/(iλz) ∫ Arr G(v) exp(ik|v|²/z) exp(-ik (x - 2u0)·v/z) d²v
    U5(q) = cosθ/(iλf_p) ∫ P(x) exp(iφ_out(x)) U3(x) exp(-ik x·Mq/f_p) d²x

G does not depend on the gaze, so one instance serves a whole sweep. Arr is the sensor's reflectance at the spot, u0 +
v; t are the tangents of the tilt. M foreshortens the probe's picture by the cosine of the tilt, along the tilt.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch

from tapetum.optics.fourier import MatrixFourier, phasor
from tapetum.optics.grid import Grid
from tapetum.optics.grid_sampling import SamplingPlan
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.sampling import DoublePassGeometry
from tapetum.simulate.foreshortening import cosines, foreshortens, tangents, twisted
from tapetum.simulate.probe_path import ProbeAperture, ProbePath
from tapetum.simulate.true_paths import Leg, TruePaths

__all__ = ["DoublePass"]

# Working memory of one batch of gazes, in bytes: batches larger than the processor's caches are no faster.
_BATCH_BYTES = 192 << 20


class DoublePass:
    """The retro-reflection of a thin lens before a plane mirror or mask, for any number of gazes.

    The spot on the sensor and all fixed kernels are computed once, when the instance is made.

    Parameters
    ----------
    geometry
        Lengths of the scene, as numbers.
    plan
        Its grids.
    output
        Pixels of the probe's sensor.
    focal_length, image_distance
        Of the target, in metres, as float64 scalars, which may carry gradients.
    mask
        Complex reflectance [B, m, n] of the sensor plane at columns x [B, n] and rows y [B, m], in metres from the
        optical axis; plan the grids for its finest detail. Default: a perfect mirror.
    distance, probe_radius
        Both given, the light of a mask travels this distance and through the probe's round aperture, in metres.
    followed
        Whether to follow the paths of `true_paths`, along the rays of a mirror.
    dtype
        complex64 or complex128.
    device
        Where to compute.
    """

    def __init__(
        self,
        geometry: DoublePassGeometry,
        plan: SamplingPlan,
        output: Grid,
        focal_length: torch.Tensor | float | None = None,
        image_distance: torch.Tensor | float | None = None,
        *,
        mask: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] | None = None,
        distance: torch.Tensor | float | None = None,
        probe_radius: float | None = None,
        followed: bool = False,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.geometry, self.plan, self.output, self.dtype = geometry, plan, output, dtype
        self._mask = mask
        self.device = torch.device(device)
        f = _scalar(geometry.focal_length if focal_length is None else focal_length, device)
        z = _scalar(geometry.image_distance if image_distance is None else image_distance, device)
        self._z = z
        self._k = 2 * math.pi / geometry.wavelength

        disc = disc_quadrature(geometry.radius, plan.columns, plan.rows)
        self._x, self._y = disc.x.to(device), disc.y.to(device)
        rho_squared = disc.rho_squared().to(device)
        weights = disc.weights.to(device)
        defocus = self._k / 2 * (1 / z - 1 / f) * rho_squared
        illumination = self._k / 2 * geometry.curvature * rho_squared

        sensor = Grid(plan.sensor_count, plan.sensor_count, 2 * plan.sensor_half_width / plan.sensor_count)
        self._v = sensor.x(device=device)
        to_sensor = MatrixFourier(self._x, self._y, self._v, self._v, self._k / z, torch.complex128)
        wave = 1j * geometry.wavelength * z
        spot = to_sensor(weights * phasor(defocus + illumination)) / wave
        v_squared = self._v[None, :] ** 2 + self._v[:, None] ** 2
        spot = (
            spot * phasor(self._k * v_squared / z) * _window(v_squared.sqrt(), plan.sensor_flat, plan.sensor_half_width)
        )
        self._to_pupil = MatrixFourier(self._v, self._v, self._x, self._y, self._k / z, dtype)
        aperture, way = None, None
        if distance is not None and probe_radius is not None:
            way = _scalar(distance, device)
            aperture = ProbeAperture.behind_thin(geometry, way, probe_radius)
        self._path = ProbePath(
            output,
            self._x,
            self._y,
            wavelength=geometry.wavelength,
            probe_focal_length=geometry.probe_focal_length,
            aperture=aperture,
            dtype=dtype,
            device=device,
        )
        # The spot includes all constants, so that the hot loop has only products and phases.
        self._spot = (spot * (sensor.pitch**2 / wave * self._path.constant)).to(dtype)
        self._exit = (weights * phasor(defocus + self._path.chirp * rho_squared)).to(dtype)
        k, radius, curvature = (_scalar(value, device) for value in (self._k, geometry.radius, geometry.curvature))
        self._paths = TruePaths(k, radius, f, curvature, way, probe_radius) if followed else None

    def __call__(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Irradiance [B, H, W] on the probe's pixels, in W/m² for 1 W/m² at the target.

        `sines` [B, 2] are those of the tilt along x and y; `centres` [B, 2] place the RR's own centre on the probe's
        sensor, in metres, by default in the middle.
        """
        sines = sines.to(self.device, torch.float64)
        size = self._batch(sines.requires_grad)
        starts = range(0, len(sines), size)
        images = [self.field(sines[i : i + size], None if centres is None else centres[i : i + size]) for i in starts]
        return torch.cat([(u.real**2 + u.imag**2) for u in images])

    def exit_pupil(self, sines: torch.Tensor) -> torch.Tensor:
        """Field leaving the lens, tilt removed, times weights and constants: [B, rows, columns]."""
        sines = sines.to(self.device, torch.float64)
        # A mirror may rotate with the pupil, a mask may not.
        turned = self._mask is None and foreshortens(self, sines)
        slopes = tangents(sines)
        offset = 2 * self._k * (twisted(slopes, sines) if turned else slopes)
        column = phasor(offset[:, 0, None, None] * self._v[None, None, :]).to(self.dtype)
        row = phasor(offset[:, 1, None, None] * self._v[None, :, None]).to(self.dtype)
        returned = self._spot * column * row
        if self._mask is not None:
            places = self._z * slopes[:, :, None] + self._v
            returned = returned * self._mask(places[:, 0], places[:, 1]).to(self.dtype)
        pupil = self._to_pupil(returned) * self._exit
        if self._paths is not None:
            z = self._z.expand(len(sines))
            leg = Leg(sines, slopes, torch.zeros_like(slopes), z)
            pupil = pupil * self._paths(self._x, self._y, leg, self._z)[2].to(self.dtype)
        return pupil * torch.sqrt(cosines(sines))[:, None, None].to(self.dtype)

    def field(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Complex amplitude U5 on the probe's pixels, [B, H, W], in W^½/m; arguments as for the call."""
        sines = sines.to(self.device, torch.float64)
        # A tilted pupil's light spreads over a foreshortened picture.
        pupil = self.exit_pupil(sines) * torch.sqrt(cosines(sines))[:, None, None].to(self.dtype)
        shortened = foreshortens(self, sines) or self._path.aperture is not None
        if self._mask is not None and shortened:
            gathered = self._path.gather_unturned(pupil, sines, centres)
        else:
            rows = slice(0, self.plan.rows)
            gathered = self._path.gather(pupil, rows, sines if foreshortens(self, sines) else None, centres)
        return self._path.to_image(gathered, centres)

    def _batch(self, gradients: bool) -> int:
        size = 16 if self.dtype == torch.complex128 else 8
        masked = self._mask is not None
        one = self.plan.bytes_needed(1, self.output.rows * self.output.columns, size, masked=masked)
        # Gradients keep every intermediate result anyway.
        return 1 << 20 if gradients else max(1, _BATCH_BYTES // one)


def _window(radius: torch.Tensor, flat: float, end: float) -> torch.Tensor:
    """1 up to `flat`, then a raised cosine to 0 at `end`."""
    fade = torch.cos(((radius - flat) / (end - flat)).clamp(0, 1) * (math.pi / 2)) ** 2
    # What cos² of a rounded right angle leaves is so small that the processor multiplies it a hundred times slower.
    return torch.where(radius < end, fade, 0.0)


def _scalar(value: torch.Tensor | float, device: torch.device | str) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device=device)
