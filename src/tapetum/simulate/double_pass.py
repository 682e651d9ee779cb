"""The double pass of a thin lens on grids, off a plane mirror or any mask: `SampledPass` by the lens's numbers.

`RoundPass` computes mirrors and gratings faster, from the table of a round field. The spot does not depend on the gaze,
so one instance serves a whole sweep.
"""

from __future__ import annotations

import math

import torch

from tapetum.optics.grid import Grid
from tapetum.optics.grid_sampling import SamplingPlan
from tapetum.optics.pupil import disc_quadrature
from tapetum.optics.sampling import DoublePassGeometry
from tapetum.simulate.probe_path import ProbeAperture, ProbePath
from tapetum.simulate.sampled_pass import SampledPass
from tapetum.simulate.spot_window import SpotWindow
from tapetum.simulate.surfaces import Mask, Reflectance, Surface
from tapetum.simulate.thin_pupil import ThinPupil
from tapetum.simulate.true_paths import TruePaths

__all__ = ["DoublePass"]

# Working memory of one batch of gazes, in bytes: batches larger than the processor's caches are no faster.
_BATCH_BYTES = 192 << 20


class DoublePass(SampledPass[ThinPupil]):
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
        mask: Reflectance | None = None,
        distance: torch.Tensor | float | None = None,
        probe_radius: float | None = None,
        followed: bool = False,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.geometry, self.plan, self.output = geometry, plan, output
        f = _scalar(geometry.focal_length if focal_length is None else focal_length, device)
        z = _scalar(geometry.image_distance if image_distance is None else image_distance, device)
        disc = disc_quadrature(geometry.radius, plan.columns, plan.rows)
        aperture, way = None, None
        if distance is not None and probe_radius is not None:
            way = _scalar(distance, device)
            aperture = ProbeAperture.behind_thin(geometry, way, probe_radius)
        path = ProbePath(
            output,
            disc.x.to(device),
            disc.y.to(device),
            wavelength=geometry.wavelength,
            probe_focal_length=geometry.probe_focal_length,
            aperture=aperture,
            dtype=dtype,
            device=device,
        )
        paths = None
        if followed:
            numbers = 2 * math.pi / geometry.wavelength, geometry.radius, geometry.curvature
            k, radius, curvature = (_scalar(value, device) for value in numbers)
            paths = TruePaths(k, radius, f, curvature, way)
        size = 16 if dtype == torch.complex128 else 8
        one = plan.bytes_needed(1, output.rows * output.columns, size, masked=mask is not None)
        super().__init__(
            ThinPupil(geometry, plan, disc, f, z, path, paths, dtype=dtype),
            SpotWindow(plan.sensor_count, plan.sensor_half_width, plan.sensor_flat),
            Surface(z) if mask is None else Mask(mask),
            wavelength=geometry.wavelength,
            at_once=max(1, _BATCH_BYTES // one),
            dtype=dtype,
            device=device,
        )


def _scalar(value: torch.Tensor | float, device: torch.device | str) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.float64, device=device)
