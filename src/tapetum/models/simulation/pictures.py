"""Images of one target for any gaze, place and roll, which a fit compares with a crop."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import affine_transform, spline_filter

from tapetum.bench import PhoneTarget, PrescriptionLens, Scene
from tapetum.errors import InputError
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.simulate.camera import Camera
from tapetum.simulate.foreshortening import turned as rotated
from tapetum.simulate.gaze import largest_sine, tilt_of_gaze
from tapetum.simulate.radiometry import dark_electrons, photoelectrons

__all__ = ["Pictures", "Pose", "period_of"]

Array = NDArray[np.float64]
_CAMERAS_KEPT = 8
# Margin in pixels around images that will be rotated and shifted.
_MARGIN = 24
# Largest gaze that is rendered, in fractions of the field: its edge.
_EDGE = 0.5
# Cubic splines rotate fringes at least this wide (pixels) with errors of 1e-3 of the peak; finer ones need quintic.
_WIDE_FRINGE = 7


@dataclass(frozen=True)
class Pose:
    """Everything that a fit may vary about a target and its light.

    `gaze` is in fractions of the field; `place` (metres on the probe's sensor) is the RR's from the image's middle;
    `power` is the laser's in watts; `background` includes dark current, in electrons per pixel; `roll` turns the target
    about its optical axis, in radians from x to y; the two lengths are in metres.
    """

    gaze: tuple[float, float]
    place: tuple[float, float]
    power: float
    background: float
    roll: float
    object_distance: float
    focal_length: float


class Pictures:
    """Renders the retro-reflection of a pose on `side` x `side` pixels of the probe; caches the cameras.

    The scene's own rotation is not used. `accuracy` is in fractions of the peak; None takes the scene's own. `dtype` is
    the type of the fields. `like` are those of a scene that differs by little: a traced lens is then sampled as it was
    for their scene, so that differences do not show the sampling. `count` is how many will be asked for of a focus,
    about, see `simulate.Camera`. Raises as `check_scene` and `simulate.Camera`.
    """

    def __init__(
        self,
        scene: Scene,
        side: int,
        accuracy: float | None = None,
        dtype: torch.dtype = torch.complex64,
        like: Pictures | None = None,
        count: int = 1,
    ) -> None:
        check_scene(scene)
        self.scene, self.side, self._accuracy, self._dtype = scene, side, accuracy, dtype
        self._like, self._count = like, count
        self._cameras = lru_cache(_CAMERAS_KEPT)(self._camera)
        light, target, probe = scene.illumination, scene.target, scene.probe
        self.pitch = probe.sensor.pitch
        fringe = light.wavelength * probe.lens.focal_length / (2 * target.lens.aperture_radius)
        self._order = 3 if fringe >= _WIDE_FRINGE * self.pitch else 5
        self._electrons = float(photoelectrons(torch.ones(()), probe.sensor, light.wavelength))
        field = np.array(target.sensor.pixels) * target.sensor.pitch
        self.spot: Array = light.wavelength * target.lens.focal_length / (2 * target.lens.aperture_radius) / field
        """λf/2r on the target's sensor, in fractions of the field."""
        period = period_of(scene)
        self.period: Array | None = None if period is None else period / field
        """Photosite period in fractions of the field; None where their diffraction orders do not return."""

    def start(self) -> Pose:
        """Return the scene's own values, with the target facing the probe."""
        scene = self.scene
        return Pose(
            (0.0, 0.0),
            (0.0, 0.0),
            scene.illumination.power,
            dark_electrons(scene.probe.sensor),
            0.0,
            scene.target.object_distance,
            scene.target.lens.focal_length,
        )

    def render(self, pose: Pose, gazes: Array) -> Array:
        """Return electrons [B, side, side] at the scene's laser power, for gazes [B, 2] in place of the pose's.

        Gazes beyond the field are clipped to its edge.
        """
        return self.render_each([replace(pose, gaze=(float(x), float(y))) for x, y in gazes])

    def render_each(self, poses: Sequence[Pose]) -> Array:
        """Return electrons [B, side, side] at the scene's laser power, for poses of one focus and focal length."""
        turned = any(pose.roll != 0 for pose in poses)
        aside = turned and not isinstance(self.scene.target.lens, PrescriptionLens)
        side = self.side + 2 * _MARGIN if aside else self.side
        scene, camera = self._cameras(poses[0].object_distance, poses[0].focal_length, side)
        gazes = np.array([pose.gaze for pose in poses])
        sines = self._tilts(scene, camera, torch.from_numpy(np.clip(gazes, -_EDGE, _EDGE)), side)
        places = torch.tensor([pose.place for pose in poses], dtype=torch.float64)
        angles = torch.tensor([pose.roll for pose in poses], dtype=torch.float64)
        total = np.zeros((len(sines), self.side, self.side))
        seen = rotated(sines, angles) if turned and not aside else sines
        with torch.no_grad():
            for tilts, centres, share in camera.beams(seen, places):
                if not aside:
                    roll = angles if turned else None
                    made = camera.render(tilts, centres, share, equivalent=True, roll=roll)
                    total += made.double().cpu().numpy()
                    continue
                # The RR turns with the target; further beams come from the probe and do not.
                own = sines + rotated(tilts - sines, -angles)
                made = camera.render(own, torch.zeros_like(centres), share, equivalent=True).double().cpu().numpy()
                shifts = centres.numpy() / self.pitch
                rolled = zip(made, poses, shifts, strict=True)
                total += np.stack([self._turned(one, pose.roll, shift) for one, pose, shift in rolled])
        return total * self._electrons

    def _tilts(self, scene: Scene, camera: Camera, gazes: torch.Tensor, side: int) -> torch.Tensor:
        """Return the tilts [B, 2] of gazes; as the other pictures have them, so that photosites stay in place."""
        if self._like is None or not isinstance(scene.target.lens, PrescriptionLens):
            return tilt_of_gaze(scene, gazes)
        own = self._like.scene.target
        before, other = self._like._cameras(own.object_distance, own.lens.focal_length, side)
        return camera.tilts_like(other, tilt_of_gaze(before, gazes)).cpu()

    def _turned(self, picture: Array, roll: float, shift: Array) -> Array:
        """Return an image turned from x to y about its middle and shifted by (x, y) pixels, without its margin."""
        c, s = math.cos(roll), math.sin(roll)
        # Maps (row, column) of the new image to the old one.
        back = np.array([[c, -s], [s, c]])
        middle = (np.array(picture.shape) - 1) / 2
        offset: Any = middle - back @ ((np.array([self.side, self.side]) - 1) / 2 + shift[::-1])
        fine = spline_filter(picture, self._order)
        size = (self.side, self.side)
        return affine_transform(fine, back, offset, output_shape=size, order=self._order, prefilter=False)

    def _camera(self, object_distance: float, focal_length: float, side: int) -> tuple[Scene, Camera]:
        """Return the scene with that focus, and its camera."""
        scene, target = self.scene, self.scene.target
        if (object_distance, focal_length) != (target.object_distance, target.lens.focal_length):
            lens = target.lens
            if focal_length != lens.focal_length:
                lens = replace(lens, focal_length=focal_length)
            scene = replace(scene, target=replace(target, lens=lens, object_distance=object_distance))
        corners = torch.tensor([[x, y] for x in (-_EDGE, _EDGE) for y in (-_EDGE, _EDGE)], dtype=torch.float64)
        steepest = largest_sine(tilt_of_gaze(scene, corners))
        like = None
        if self._like is not None:
            own = self._like.scene.target
            _, like = self._like._cameras(own.object_distance, own.lens.focal_length, side)
        grid = Grid(side, side, self.pitch)
        # These images are small: copying them would cost more time than a GPU gains.
        options: dict[str, Any] = {"accuracy": self._accuracy, "dtype": self._dtype, "device": "cpu"}
        return scene, Camera(scene, steepest, output=grid, edge="dimmed", like=like, pictures=self._count, **options)


def period_of(scene: Scene) -> float | None:
    """Return the period of the target's photosites in metres; None where no order returns through the lens."""
    sensor, lens = scene.target.sensor, scene.target.lens
    if sensor.array is None and sensor.microlens is None:
        return None
    pitch = sensor.pitch if sensor.array is None or sensor.array.pitch is None else sensor.array.pitch
    period = pitch * (2 if sensor.array is not None and sensor.array.bayer is not None else 1)
    if isinstance(lens, PrescriptionLens):
        length = lens.focal_length
    else:
        length, _ = lens_numbers(lens.focal_length, scene.target.object_distance)
    # An order of direction τ returns displaced by zτ.
    return period if scene.illumination.wavelength / period * length < 2 * lens.aperture_radius else None


def check_scene(scene: Scene) -> None:
    """Raise an InputError for scenes that cannot be fitted: phones, masks and hot pixels."""
    if isinstance(scene.target, PhoneTarget):
        what = "a phone, of which several cameras answer at once, is not fitted"
        raise InputError(what, where="scene.target", remedy="take one of its cameras for the target")
    if scene.target.sensor.mask is not None:
        what = "each gaze sees another piece of a mask, which leaves nothing to search along"
        raise InputError(what, where="scene.target.sensor.mask", remedy="use an array for a mask")
    if scene.probe.sensor.hot_pixels and scene.probe.sensor.hot_current:
        what = "a crop does not say where on the sensor it lay, and so not where the hot pixels are"
        raise InputError(what, where="scene.probe.sensor.hot_pixels", remedy="take them out, and set it to 0")
