"""From a scene to the light on the probe's pixels."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
import torch

from tapetum.bench import Scene, as_scene, outside_of_model
from tapetum.errors import InputError
from tapetum.simulate.gaze import largest_sine
from tapetum.simulate.image import Image
from tapetum.simulate.phone import open_camera
from tapetum.simulate.pixel_area import change_by_area

if TYPE_CHECKING:
    from tapetum.optics.sampling import Plan

__all__ = ["plan_scene", "retroreflect"]

Rotation = (
    float
    | Sequence[float]
    | Sequence[Sequence[float]]
    | Sequence[torch.Tensor]
    | npt.NDArray[np.float64]
    | torch.Tensor
)
_DTYPES = (torch.complex64, torch.complex128)


def retroreflect(
    scene: Scene | str | os.PathLike[str],
    rotation: Rotation | None = None,
    *,
    object_distance: torch.Tensor | float | None = None,
    focal_length: torch.Tensor | float | None = None,
    accuracy: float | None = None,
    dtype: torch.dtype = torch.complex64,
    device: torch.device | str = "auto",
) -> Image:
    """Simulate the light on the probe's sensor.

    Parameters
    ----------
    scene
        A scene, or its name or path, as for `tapetum.bench.load_scene`.
    rotation
        In degrees. One number or [B]: about x, as the paper turns its target. [B, 2]: about y and about x. Default: the
        scene's own.
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
        [B, H, W] in W/m², at the pixels' middles or, with `probe.sensor.fill`, the means over them; what the former
        leave out is `metadata["change_by_area"]`, in fractions of the peak. Gradients flow through rotation,
        object_distance and focal_length given as tensors.

    Raises
    ------
    InputError
        For values that make no camera, grids that would alias, and scenes too large for the memory allowed.

    Notes
    -----
    Paper, equations 1 to 6. Light that fits into the probe's aperture is carried straight to the far field, other light
    over the distance and through the aperture; the metadata say which. Beams, wavelengths, directions of the source and
    scattered light add as intensity, planes within the coherence length as fields. Behind a traced lens few gazes are
    computed on more samples than many, see `Camera`: one gaze's pictures differ by less than the accuracy then.
    """
    scene = as_scene(scene)
    if dtype not in _DTYPES:
        raise InputError(f"unknown dtype {dtype}", where="dtype", remedy="use torch.complex64 or torch.complex128")
    degrees = _degrees(scene, rotation)
    tilt = torch.sin(torch.deg2rad(degrees))
    camera = open_camera(
        scene,
        largest_sine(tilt),
        object_distance=object_distance,
        focal_length=focal_length,
        pictures=len(tilt),
        accuracy=accuracy,
        dtype=dtype,
        device=device,
    )
    irradiance = camera(tilt)
    equivalent = camera(tilt, equivalent=True) if camera.polychromatic else None
    metadata: dict[str, Any] = {
        "rotation_deg": [(float(about_y), float(about_x)) for about_y, about_x in degrees.detach().cpu()],
        "wavelength": scene.illumination.wavelength,
        **camera.metadata(),
        # Of pixels that count as points: what taking them for that leaves out.
        "change_by_area": 0.0 if scene.probe.sensor.fill else change_by_area(irradiance, camera.output, camera.finest),
    }
    return Image(irradiance, scene.probe.sensor.pitch, metadata, equivalent)


def plan_scene(scene: Scene, steepest: float, accuracy: float | None = None) -> Plan:
    """The sampling that `retroreflect` would use for a few gazes of this scene."""
    return open_camera(scene, steepest, accuracy=accuracy).plan


def _degrees(scene: Scene, rotation: Rotation | None) -> torch.Tensor:
    if rotation is None:
        return torch.rad2deg(torch.tensor([scene.target.rotation], dtype=torch.float64))
    try:
        degrees = _doubles(rotation)
    except (TypeError, ValueError, RuntimeError) as error:
        remedy = "give a number, [B] or [B, 2] in degrees"
        raise InputError(f"is no number: {rotation!r:.40}", where="rotation", remedy=remedy) from error
    if degrees.ndim == 0:
        degrees = degrees[None]
    if degrees.ndim == 1:
        degrees = torch.stack([torch.zeros_like(degrees), degrees], -1)
    if degrees.ndim != 2 or degrees.shape[1] != 2 or len(degrees) == 0:
        shape = tuple(degrees.shape)
        raise InputError(f"has shape {shape}", where="rotation", remedy="give a number, [B] or [B, 2] in degrees")
    if not bool(torch.isfinite(degrees).all()):
        raise InputError("holds a value that is not finite", where="rotation", remedy="give degrees")
    for about_y, about_x in torch.deg2rad(degrees.detach()).cpu():
        too_steep = outside_of_model((float(about_y), float(about_x)), scene.target.lens.kind)
        if too_steep is not None:
            what, _, remedy = too_steep.partition("; ")
            raise InputError(what, where="rotation", remedy=remedy)
    return degrees


def _doubles(value: Any) -> torch.Tensor:
    """Numbers in any container as float64; of tensors, or a sequence with tensors in it, gradients are kept.

    Raises a TypeError, ValueError or RuntimeError for what is no number, or has no regular shape.
    """
    if isinstance(value, torch.Tensor):
        return value.to(torch.float64)
    if _holds_tensors(value):
        return torch.stack([_doubles(one) for one in value])
    # NumPy would read numbers from text.
    if np.asarray(value).dtype.kind not in "biufO":
        raise TypeError(f"{value!r:.40} holds no numbers")
    # A copy in the machine's own order of bytes, which PyTorch takes whatever the array was.
    return torch.as_tensor(np.array(value, dtype=np.float64, order="C"))


def _holds_tensors(value: Any) -> bool:
    if not isinstance(value, list | tuple):
        return False
    return any(isinstance(one, torch.Tensor) or _holds_tensors(one) for one in cast("Sequence[Any]", value))
