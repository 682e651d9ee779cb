"""How a frame of a traced lens changes with its unknowns, by differences of pictures on the same samples.

A traced lens is not differentiated automatically: on the axis the tilt has no azimuth to differentiate by, and focus is
found by iteration. Errors of sampling nearly cancel in a difference of two pictures on the same samples, so lenses with
a slightly changed focus or zoom use the samples planned for the scene's own.
"""

# Torch types argmax and stack in part only.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from tapetum.bench import PhoneTarget, PrescriptionLens, Scene, with_values
from tapetum.errors import InputError
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.simulate.camera import Camera
from tapetum.simulate.gaze import field_size, largest_sine, tilt_of_gaze
from tapetum.simulate.radiometry import dark_electrons, illumination_curvature, photoelectrons
from tapetum.simulate.round_pass import Surface
from tapetum.simulate.traced_again import pass_again
from tapetum.simulate.traced_plan import TracedGroup
from tapetum.simulate.unknowns import NUISANCES, PHOTOSITES, TRACED, checked_parameters, has_photosites

__all__ = ["NUISANCES", "TRACED", "TracedSlopes", "sensor_part"]

# Steps of gaze and place, as shares of the finest detail: spot or photosite on the sensor, fringe at the probe. Smaller
# steps show the picture's sampling, larger ones average the change.
_SHARE = 1 / 25
# Phase change, in radians, at the pupil's edge by a step of focus or focal length.
_TURN = 0.1
# Phase change, in radians, at the pupil's edge that even a focused picture shows: ten of its rings.
_IN_FOCUS = 60.0
# Largest step of a length, as a share of it.
_LONGEST = 0.03
# Extra tilt that a step may need, as a share of the steepest one asked for.
_MARGIN = 0.01


class TracedSlopes:
    """Derivatives of the mean electrons of a traced target's frame, at any number of gazes. Build it once.

    Parameters
    ----------
    scene
        With a prescription as lens; its own rotation is not used.
    names
        Of `TRACED` and `NUISANCES`: what to differentiate by.
    gazes
        [G, 2] in fractions of the field.
    step
        Factor on all steps, to check that the differences do not depend on them.
    accuracy, dtype, device
        As for `Camera`; by default half the scene's accuracy, for differences keep more of a sampling's error than
        pictures do.

    Raises
    ------
    InputError
        For names that are neither, phones, focus and focal length where anything but the sensor's mirror answers, and
        as `Camera`.

    Notes
    -----
    Central differences. The gaze, as the spot's place on the sensor, stays where focus and focal length change. With
    the focal length a prime is scaled as a whole; a zoom's groups and stop follow its states, or with an `f_number` the
    stop keeps that one. Either is focused on the same object distance again. Steps are a 25th of the finest detail on
    the sensor (gaze), of the finest fringe of the picture (place), or turn the light at the pupil's edge by 0.1 rad
    (focus, focal length, and the gaze of a bare mirror, by half a spot at the most), which leaves an error of some 0.2
    % from the third derivative.

    With `photosite_x` or `photosite_y` the gaze is stepped by a whole photosite, and the effect of the array's
    displacement is added back from the derivative by the array's own place: the two agree to 1 part in some 300, which
    small steps of each would not separate.
    """

    def __init__(
        self,
        scene: Scene,
        names: Sequence[str],
        gazes: torch.Tensor,
        *,
        step: float = 1.0,
        accuracy: float | None = None,
        dtype: torch.dtype = torch.complex128,
        device: torch.device | str = "auto",
    ) -> None:
        if not isinstance(scene.target, PhoneTarget) and not isinstance(scene.target.lens, PrescriptionLens):
            what = f"a lens of kind {scene.target.lens.kind!r} is differentiated, not traced"
            raise InputError(what, where="target.lens", remedy="use fisher, or a lens by prescription")
        checked_parameters(scene, names, (*TRACED, *NUISANCES))
        self.scene, self.names, self._gazes = scene, tuple(names), gazes.to(torch.float64)
        self._steps = _Steps.of(scene, step)
        self._by_sites = bool(PHOTOSITES & set(self.names))
        if self._by_sites:
            # A whole photosite's step, so the spot falls alike on the next one: the difference is not due to the
            # photosites.
            wide, high = field_size(scene).tolist()
            self._steps = replace(self._steps, gaze=(_period(scene) / wide, _period(scene) / high))
        around = torch.tensor([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
        self._tilts = tilt_of_gaze(scene, self._gazes[:, None] + around * torch.tensor(self._steps.gaze))
        steepest = largest_sine(self._tilts.reshape(-1, 2)) * (1 + _MARGIN)
        if accuracy is None:
            accuracy = scene.sampling.accuracy / 2
        given: dict[str, Any] = {"pictures": self._tilts.numel() // 2, "accuracy": accuracy}
        given |= {"dtype": dtype, "device": device}
        camera = _Camera(scene, steepest, **given)
        # Only the pixels that hold both beams' RR without the faintest rings.
        seen = _inside(camera.window(), scene)
        if seen is not None:
            camera = _Camera(scene, steepest, output=seen, **given)
        self._camera = camera
        self._others: dict[str, tuple[_Camera, _Camera]] = {}
        for name in ("object_distance", "focal_length"):
            if name in self.names:
                self._others[name] = self._neighbours(name)
        for axis, name in enumerate(("photosite_x", "photosite_y")):
            if self._by_sites:
                d = self._steps.photosite
                self._others[name] = camera.with_sites_moved(axis, d), camera.with_sites_moved(axis, -d)

    @property
    def output(self) -> Grid:
        """The pixels."""
        return self._camera.output

    @property
    def expected_error(self) -> float:
        """Of the pictures, in fractions of the peak; in differences most of it cancels."""
        return self._camera.plan.expected_error

    def __len__(self) -> int:
        return len(self._gazes)

    @torch.no_grad()
    def __call__(self, number: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean electrons [H, W] without those of hot pixels, and their slopes [P, H W], at the gaze of this number."""
        own = self._tilts[number]
        # One batch: the unchanged gaze, then two steps of each kind.
        tilts = own if (PHOTOSITES | {"gaze_x", "gaze_y"}) & set(self.names) else own[:1]
        made = self._electrons(self._camera, tilts)
        slopes: dict[str, torch.Tensor] = {"power": made[0] / self.scene.illumination.power}
        if len(tilts) > 1:
            slopes["gaze_x"] = (made[1] - made[2]) / (2 * self._steps.gaze[0])
            slopes["gaze_y"] = (made[3] - made[4]) / (2 * self._steps.gaze[1])
        if {"place_x", "place_y", "roll"} & set(self.names):
            slopes |= self._moved(own[:1])
        steps = vars(self._steps)
        for name, (more, less) in self._others.items():
            light = [self._electrons(one, one.tilts_like(self._camera, own[:1]))[0] for one in (more, less)]
            slopes[name] = (light[0] - light[1]) / (2 * (self._steps.photosite if name in PHOTOSITES else steps[name]))
        if self._by_sites:
            # Moving the array under a fixed spot replaces moving the spot over the array.
            for axis, side in zip("xy", field_size(self.scene).tolist(), strict=True):
                slopes[f"gaze_{axis}"] = slopes[f"gaze_{axis}"] - side * slopes[f"photosite_{axis}"]
        jacobian = torch.stack([slopes[name].flatten() for name in self.names])
        return made[0] + dark_electrons(self.scene.probe.sensor), jacobian

    def _electrons(self, camera: Camera, tilts: torch.Tensor) -> torch.Tensor:
        irradiance = camera(tilts, equivalent=True).to(torch.float64)
        return photoelectrons(irradiance, self.scene.probe.sensor, self.scene.illumination.wavelength)

    def _moved(self, tilt: torch.Tensor) -> dict[str, torch.Tensor]:
        """Slopes of the place and of the roll: every beam's RR turns about its own place, not about the first one's."""
        camera, h = self._camera, self._steps.place
        around = h * torch.tensor([[1, 0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
        x, y = self.output.x(), self.output.y()[:, None]
        across, down, roll = (torch.zeros(self.output.rows, self.output.columns, dtype=torch.float64) for _ in range(3))
        for sines, place, share in camera.beams(tilt, torch.zeros(1, 2, dtype=torch.float64)):
            image = camera.render(sines.expand(4, -1), place + around, share, equivalent=True).to("cpu", torch.float64)
            made = photoelectrons(image, self.scene.probe.sensor, self.scene.illumination.wavelength)
            right, lower = (made[0] - made[1]) / (2 * h), (made[2] - made[3]) / (2 * h)
            across, down = across + right, down + lower
            roll = roll + (x - place[0, 0]) * lower - (y - place[0, 1]) * right
        found = {"place_x": across, "place_y": down, "roll": roll}
        return {name: one.to(camera.device) for name, one in found.items()}

    def _neighbours(self, name: str) -> tuple[_Camera, _Camera]:
        scene, h = self.scene, float(vars(self._steps)[name])
        field = {"object_distance": "target.object_distance", "focal_length": "target.lens.focal_length"}[name]
        own = scene.target.object_distance if name == "object_distance" else scene.target.lens.focal_length
        more, less = (self._camera.set_to(with_values(scene, {field: own + d})) for d in (h, -h))
        return more, less


@dataclass(frozen=True)
class _Steps:
    """Steps of the differences: gaze in fractions of the field, the others in metres."""

    gaze: tuple[float, float]
    photosite: float
    place: float
    object_distance: float
    focal_length: float

    @classmethod
    def of(cls, scene: Scene, factor: float) -> _Steps:
        target, light = scene.target, scene.illumination
        lens = target.lens
        r, k = lens.aperture_radius, 2 * math.pi / light.wavelength
        spot = light.wavelength * lens.focal_length / (2 * r)
        # On both passes the phase at the edge is k r²/x_d, plus that of the incoming wave.
        away = k * r**2 * abs(1 / target.object_distance - illumination_curvature(scene))
        # A mirror's picture shears only slowly with the pupil, by two steps of the spot.
        shear = min(spot / 2, _TURN * r / (4 * away)) if away > 0 else spot / 2
        finest = _SHARE * min(spot, _period(scene)) if has_photosites(scene) else shear
        x, y = (factor * finest / side for side in field_size(scene).tolist())
        far = target.object_distance
        focus = min(_TURN * far / (k * r**2), _LONGEST) * far if math.isfinite(far) else 0.0
        return cls(
            (x, y),
            factor * _SHARE * _period(scene),
            factor * _SHARE * light.wavelength * scene.probe.lens.focal_length / (2 * r),
            factor * focus,
            factor * _TURN / (2 * away + _IN_FOCUS) * lens.focal_length,
        )


class _Camera(Camera):
    """A camera whose lens can be set to neighbouring values on the same samples."""

    def set_to(self, scene: Scene) -> _Camera:
        """Another focus or focal length."""
        given: dict[str, Any] = {"accuracy": self.accuracy, **self._optics.where}
        return _Camera(scene, self._steepest, output=self.output, like=self, **given)

    def with_sites_moved(self, axis: int, by: float) -> _Camera:
        """The same with its pixel array moved under the spot, in metres: the phases of its orders change."""

        other = copy.copy(self)
        lines = list(self._lines)
        for i, line in enumerate(lines):
            made: list[TracedGroup] = []
            for group in map(_group, line.passes):
                moved = [
                    pass_again(
                        one, (one.fits, one.orders), _moved_sites(one.surface, axis, by, line.wavelength), one.path
                    )
                    for one in group.passes
                ]
                made.append(TracedGroup(moved, group.plan))
            lines[i] = replace(line, passes=tuple(made))
        other._lines = lines
        return other


def _period(scene: Scene) -> float:
    """Of the photosites, in metres, and of the lenses over them."""
    sensor = scene.target.sensor
    return sensor.pitch if sensor.array is None or sensor.array.pitch is None else sensor.array.pitch


def _group(one: object) -> TracedGroup:
    assert isinstance(one, TracedGroup)
    return one


def _moved_sites(surface: Surface, axis: int, by: float, wavelength: float) -> Surface:
    """An array moved by d: the phase of its order of direction τ changes by -kτd."""
    orders = []
    for order in surface.orders:
        tau = order.direction[axis] - 2 * surface.tilt[axis]
        turn = complex(phasor(torch.tensor(-2 * math.pi / wavelength * tau * by, dtype=torch.float64)))
        series = order.series and replace(order.series, coefficients=order.series.coefficients * turn)
        orders.append(replace(order, amplitude=order.amplitude * turn, series=series))
    return replace(surface, orders=tuple(orders))


def _inside(window: Grid, scene: Scene) -> Grid | None:
    """The sensor's own pixels that hold a beam's window, the second one's too; None where they are too few."""
    second, lens = scene.illumination.second_beam, scene.probe.lens
    apart = lens.focal_length * max(math.tan(abs(one)) for one in second.angle) if second is not None else 0.0
    return sensor_part(scene, window.rows + 2 * math.ceil(apart / window.pitch), window.pitch)


def sensor_part(scene: Scene, side: int, pitch: float) -> Grid | None:
    """The middle of the probe's sensor, `side` of its own pixels or one less; None where they are too few."""
    columns, rows = scene.probe.sensor.pixels
    if side >= min(rows, columns):
        return None
    # An even number of pixels has a border in the middle, an odd one a pixel.
    return Grid(side - (side + rows) % 2, side - (side + columns) % 2, pitch)
