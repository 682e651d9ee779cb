"""From a scene to the light on the probe's pixels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import Scene
from tapetum.errors import InputError
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.sampling import DoublePassGeometry, SamplingPlan, plan_double_pass
from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.image import Image
from tapetum.simulate.radiometry import (
    beam_radius,
    illumination_curvature,
    irradiance_at_target,
    return_radius_at_probe,
)

__all__ = ["Camera", "gaze_of", "largest_sine", "pick_device", "plan_scene", "retroreflect", "tilt_of_gaze"]

Rotation = float | Sequence[float] | Sequence[Sequence[float]] | npt.NDArray[np.float64] | torch.Tensor
# Ring 12 of an Airy pattern is 1e-4 of its peak: less than the read noise of an unsaturated frame.
_RINGS_SHOWN = 12
_DTYPES = (torch.complex64, torch.complex128)


def retroreflect(
    scene: Scene,
    rotation: Rotation | None = None,
    *,
    object_distance: torch.Tensor | float | None = None,
    focal_length: torch.Tensor | float | None = None,
    accuracy: float | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str = "auto",
) -> Image:
    """Simulate what the probe's sensor receives.

    Parameters
    ----------
    scene
        What stands on the bench.
    rotation
        In degrees. One number or [B]: about x, as the paper turns its target. [B, 2]: about y and about x. The scene's
        own rotation when left out.
    object_distance, focal_length
        Of the target, in metres, in place of the scene's.
    accuracy
        Largest error of the irradiance in fractions of the peak, in place of the scene's.
    dtype
        complex64 (rounding below 1e-4 of the peak) or complex128.
    device
        "auto" takes a GPU where there is one.

    Returns
    -------
    Image
        [B, H, W] in W/m². Gradients flow through rotation, object_distance and focal_length given as tensors.

    Raises
    ------
    InputError
        For values that make no camera, grids that would alias, and scenes too large for the memory allowed.

    Notes
    -----
    Paper, equations 1 to 6, in the far field of the probe: independent of the distance but for the illumination. The
    second beam adds as intensity.
    """
    if dtype not in _DTYPES:
        raise InputError(f"unknown dtype {dtype}", where="dtype", remedy="use torch.complex64 or torch.complex128")
    degrees = _degrees(scene, rotation)
    tilt = torch.sin(torch.deg2rad(degrees))
    camera = Camera(
        scene,
        largest_sine(tilt),
        object_distance=object_distance,
        focal_length=focal_length,
        accuracy=accuracy,
        dtype=dtype,
        device=device,
    )
    irradiance = camera(tilt)
    metadata: dict[str, Any] = {
        "rotation_deg": [(float(about_y), float(about_x)) for about_y, about_x in degrees.detach().cpu()],
        "wavelength": scene.illumination.wavelength,
        **camera.metadata(),
    }
    return Image(irradiance, scene.probe.sensor.pitch, metadata)


class Camera:
    """One target before one probe, ready for any number of gazes. Holding it is the cache.

    Parameters
    ----------
    scene
        What stands on the bench; its own rotation is not used.
    steepest
        Sine of the steepest tilt that will be asked for.
    output
        Pixels to compute in place of the probe's whole sensor.
    object_distance, focal_length, accuracy, dtype, device
        As for `retroreflect`.
    """

    def __init__(
        self,
        scene: Scene,
        steepest: float,
        *,
        output: Grid | None = None,
        object_distance: torch.Tensor | float | None = None,
        focal_length: torch.Tensor | float | None = None,
        accuracy: float | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "auto",
    ) -> None:
        self.scene = scene
        self.output = output or sensor_grid(scene)
        where = pick_device(device)
        f = torch.as_tensor(
            scene.target.lens.focal_length if focal_length is None else focal_length,
            dtype=torch.float64,
            device=where,
        )
        distance = torch.as_tensor(
            scene.target.object_distance if object_distance is None else object_distance,
            dtype=torch.float64,
            device=where,
        )
        _check_focus(float(f.detach()), float(distance.detach()))
        geometry = scene_geometry(scene, steepest, float(f.detach()), float(distance.detach()), self.output)
        sampling = scene.sampling
        self.plan = plan_double_pass(
            geometry,
            sampling.accuracy if accuracy is None else accuracy,
            pupil_samples=sampling.pupil,
            sensor_samples=sampling.sensor,
            pixels=self.output.rows * self.output.columns,
        )
        # 1/z = 1/f - 1/x_d holds at infinity too, where x_i = f²/(x_d - f) would be 0/0 to its gradient.
        z = 1 / (1 / f - 1 / distance)
        self._pass = DoublePass(geometry, self.plan, self.output, f, z, dtype=dtype, device=where)
        self._scale = irradiance_at_target(scene) * scene.target.sensor.reflectance * scene.probe.transmission

    def __call__(self, sines: torch.Tensor, centres: torch.Tensor | None = None) -> torch.Tensor:
        """Irradiance [B, H, W] in W/m² for tilts [B, 2] (sines), the RR at centres [B, 2] (metres) on the sensor."""
        if centres is None:
            centres = torch.zeros(len(sines), 2, dtype=torch.float64)
        beams = [self.render(*beam) for beam in self.beams(sines, centres)]
        return torch.stack(beams).sum(0) if len(beams) > 1 else beams[0]

    def beams(self, sines: torch.Tensor, centres: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor, float]]:
        """Tilts, centres on the probe's sensor and relative power of every beam of the probe; they add as intensity."""
        first = (sines, centres, 1.0)
        second = self.scene.illumination.second_beam
        if second is None or second.ratio == 0:
            return [first]
        angle = torch.tensor(second.angle, dtype=torch.float64, device=sines.device)
        # It meets the target steeper by its angle, and comes back along its own direction.
        place = centres.to(angle) - self.scene.probe.lens.focal_length * torch.tan(angle)
        return [first, (sines + torch.sin(angle), place, second.ratio)]

    def render(self, sines: torch.Tensor, centres: torch.Tensor, share: float = 1.0) -> torch.Tensor:
        """Irradiance [B, H, W] in W/m² of one beam that carries `share` of the first one's power."""
        return (self._scale * share) * self._pass(sines, centres)

    def window(self, *, margin: bool = False) -> Grid:
        """The smallest square of probe pixels that holds one beam's RR but for its faintest rings.

        With a margin it holds the second beam's RR too, wherever the first one's lies within a window's quarter.
        """
        g, second = self._pass.geometry, self.scene.illumination.second_beam
        angle = g.exit_angle + _RINGS_SHOWN * g.wavelength / (2 * g.radius)
        if margin:
            angle = 1.25 * angle + (math.hypot(*second.angle) if second is not None else 0.0)
        side = 2 * math.ceil(self.scene.probe.lens.focal_length * angle / self.output.pitch) + 1
        return Grid(side, side, self.output.pitch)

    def metadata(self) -> dict[str, Any]:
        """The sampling, the error it should give, and the radiometry, by name."""
        scene = self.scene
        returning = return_radius_at_probe(scene)
        fits = returning <= scene.probe.lens.aperture_radius
        return {
            "sampling": self.plan.as_dict(),
            "expected_error": self.plan.expected_error,
            "irradiance_at_target": irradiance_at_target(scene),
            "beam_radius_at_target": beam_radius(scene),
            "return_radius_at_probe": returning,
            "propagation": "far field"
            if fits
            else "far field; the return overfills the probe, vignetting is not modelled",
        }


def plan_scene(scene: Scene, steepest: float, accuracy: float | None = None) -> SamplingPlan:
    """The sampling that `retroreflect` would use for this scene."""
    return Camera(scene, steepest, accuracy=accuracy).plan


def sensor_grid(scene: Scene) -> Grid:
    """The probe's own pixels."""
    columns, rows = scene.probe.sensor.pixels
    return Grid(rows, columns, scene.probe.sensor.pitch)


def scene_geometry(
    scene: Scene, steepest: float, focal_length: float, object_distance: float, output: Grid
) -> DoublePassGeometry:
    """The lengths of a scene that decide its sampling."""
    z, _ = lens_numbers(focal_length, object_distance)
    second = scene.illumination.second_beam
    probe_f = scene.probe.lens.focal_length
    offset = math.hypot(*second.angle) if second is not None else 0.0
    return DoublePassGeometry(
        wavelength=scene.illumination.wavelength,
        radius=scene.target.lens.aperture_radius,
        focal_length=focal_length,
        image_distance=z,
        probe_focal_length=probe_f,
        window=math.hypot(output.width, output.height) / 2 + probe_f * offset,
        sine=steepest + offset,
        curvature=illumination_curvature(scene),
    )


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


def pick_device(device: torch.device | str) -> torch.device:
    """The device named, or for "auto" a GPU where there is one."""
    if str(device) != "auto":
        return torch.device(device)
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _degrees(scene: Scene, rotation: Rotation | None) -> torch.Tensor:
    if rotation is None:
        return torch.rad2deg(torch.tensor([scene.target.rotation], dtype=torch.float64))
    degrees = torch.as_tensor(rotation, dtype=torch.float64)
    if degrees.ndim == 0:
        degrees = degrees[None]
    if degrees.ndim == 1:
        degrees = torch.stack([torch.zeros_like(degrees), degrees], -1)
    if degrees.ndim != 2 or degrees.shape[1] != 2 or len(degrees) == 0:
        shape = tuple(degrees.shape)
        raise InputError(f"has shape {shape}", where="rotation", remedy="give a number, [B] or [B, 2] in degrees")
    if not bool(torch.isfinite(degrees).all()):
        raise InputError("holds a value that is not finite", where="rotation", remedy="give degrees")
    if float(degrees.detach().abs().max()) >= 30:
        raise InputError(
            f"{float(degrees.detach().abs().max()):g} deg is outside the paraxial model",
            where="rotation",
            remedy="stay below 30 degrees",
        )
    return degrees


def _check_focus(focal_length: float, object_distance: float) -> None:
    if not focal_length > 0 or math.isinf(focal_length):
        raise InputError(f"must be positive, is {focal_length} m", where="focal_length", remedy="give metres")
    if not object_distance > 0:
        raise InputError(f"must be positive, is {object_distance} m", where="object_distance", remedy="give metres")
    lens_numbers(focal_length, object_distance)
