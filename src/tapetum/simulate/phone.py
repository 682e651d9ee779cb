"""A phone before the probe: several cameras on one plate, each with its own return."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import torch

from tapetum.bench import PhoneTarget, Scene
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.simulate.camera import Camera, sensor_grid
from tapetum.simulate.foreshortening import foreshortening, off_axis
from tapetum.simulate.radiometry import beam_radius

__all__ = ["PhoneCamera", "Unit", "open_camera", "phone_scenes", "seen_from_probe"]

# Irradiance beyond the pixels computed of a return, in the accuracy asked for.
_LEFT_OUT = 0.1


@dataclass(frozen=True)
class Unit:
    """One camera of a phone as a scene of its own.

    Parameters
    ----------
    scene
        Of this camera alone.
    place
        (x, y) on the plate from the camera whose gaze is meant, in metres.
    axis
        Direction it looks in against that camera's, (x, y) in radians.
    """

    scene: Scene
    place: tuple[float, float]
    axis: tuple[float, float] = (0.0, 0.0)

    def sines(self, gazing: torch.Tensor, aside: torch.Tensor | None = None) -> torch.Tensor:
        """Sines [B, 2] of its tilts where the camera that gazes has these.

        `aside` [B, 2] is the angle from that camera to this one as the probe sees them, in radians along the axes of
        the tilts: light of the probe meets this camera under it.
        """
        if self.axis != (0.0, 0.0):
            gazing = torch.sin(torch.asin(gazing) + torch.tensor(self.axis).to(gazing))
        # Its return lies on the other side of the probe's axis than that of a second beam at this angle.
        return gazing if aside is None or self.place == (0.0, 0.0) else off_axis(gazing, -aside.to(gazing))


def phone_scenes(scene: Scene) -> tuple[Unit, ...]:
    """The scene of every camera that is lit; of a single camera its own.

    Raises
    ------
    InputError
        When the edge of the lit disc crosses a camera's aperture, or light that does not come from the probe meets
        several cameras.
    """
    if not isinstance(scene.target, PhoneTarget):
        return (Unit(scene, (0.0, 0.0)),)
    x, y = scene.target.rotation
    units = [
        Unit(replace(scene, target=target), place, (target.rotation[0] - x, target.rotation[1] - y))
        for target, place in scene.target.cameras()
    ]
    lit, light = beam_radius(scene), scene.illumination
    for unit in units:
        if not _lit(unit, lit) and math.hypot(*unit.place) < lit + unit.scene.target.lens.aperture_radius:
            aside = math.hypot(*unit.place)
            what = (
                f"the edge of the lit disc, {lit:.3g} m in radius, crosses the camera {aside:.3g} m beside the gaze's"
            )
            where = "illumination." + ("divergence" if light.divergence is not None else "diameter")
            raise InputError(what, where=where, remedy="make it wider or narrower, or name a phone of one camera")
    found = tuple(unit for unit in units if _lit(unit, lit))
    if len(found) > 1 and not math.isclose(light.curvature(scene.distance) * scene.distance, 1.0, rel_tol=1e-3):
        where = "illumination.mode" if light.vergence is None else "illumination.vergence"
        what = "cameras side by side are computed in light that comes from the probe alone"
        raise InputError(what, where=where, remedy="use mode 'diverging' or 'fixed_area' without a vergence")
    return found


def _lit(unit: Unit, lit: float) -> bool:
    """Whether a disc of this radius about the camera that gazes holds all of a unit's aperture, in metres."""
    return unit.place == (0.0, 0.0) or math.hypot(*unit.place) + unit.scene.target.lens.aperture_radius <= lit


def seen_from_probe(places: torch.Tensor, sines: torch.Tensor) -> torch.Tensor:
    """Where the probe sees places [B or 1, 2] on a plate turned by tilts [B, 2], foreshortened: [B, 2] in metres."""
    rotation, triangle = foreshortening(sines)
    return (rotation @ triangle @ places.to(sines)[..., None])[..., 0]


class PhoneCamera:
    """All cameras of a phone, for any number of gazes. Their irradiances add.

    Overlapping returns of two cameras would interfere in fringes of λ f_p over their distance, a few pixels wide. The
    slightest motion averages them out, so they are left out.

    Each camera is computed on the pixels about its return, see `Camera.window`; those beyond get none of its light.

    Parameters
    ----------
    scene
        With a `PhoneTarget`.
    steepest, output, options
        As for `Camera`; `options` are its further arguments.
    """

    def __init__(self, scene: Scene, steepest: float, *, output: Grid | None = None, **options: Any) -> None:
        self.scene, self.output = scene, output or sensor_grid(scene)
        self.units: list[tuple[Camera, Unit]] = []
        for unit in phone_scenes(scene):
            aside = math.hypot(*unit.axis) + math.hypot(*unit.place) / scene.distance
            camera = Camera(unit.scene, steepest + aside, output=self.output, **options)
            window = camera.window(left_out=_LEFT_OUT * camera.accuracy)
            # Each return covers few of the sensor's pixels.
            if window.rows < self.output.rows and window.columns < self.output.columns:
                camera = camera.on(window)
            self.units.append((camera, unit))
        # Of each camera: its own largest irradiance over the picture's, at most of all pictures so far.
        self._shares = torch.zeros(len(self.units), dtype=torch.float64)

    def __call__(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, *, equivalent: bool = False
    ) -> torch.Tensor:
        """As `Camera.__call__`; the centre is that of the camera that gazes."""
        focal, distance = self.scene.probe.lens.focal_length, self.scene.distance
        first = self.units[0][0]
        total = torch.zeros(len(sines), self.output.rows, self.output.columns, dtype=first.real, device=first.device)
        peaks: list[torch.Tensor] = []
        for camera, unit in self.units:
            seen = seen_from_probe(torch.tensor([unit.place], device=sines.device), sines.double()) / distance
            at = focal * seen if centres is None else centres + focal * seen
            peaks.append(self._add(total, camera, unit.sines(sines, seen), at, equivalent))
        whole = total.detach().amax((1, 2)).double().cpu()
        shares = torch.stack(peaks) / whole.clamp_min(torch.finfo(torch.float64).tiny)
        self._shares = torch.maximum(self._shares, shares.amax(1)) if len(sines) else self._shares
        return total

    def _add(
        self, total: torch.Tensor, camera: Camera, sines: torch.Tensor, centres: torch.Tensor, equivalent: bool
    ) -> torch.Tensor:
        """Add one camera's light on all pixels, computed on the camera's own about each beam's return.

        Returns its own largest irradiance [B], or what its beams' add up to, which is no less.
        """
        output, window = self.output, camera.output
        peaks = torch.zeros(len(sines), dtype=torch.float64)
        if (window.rows, window.columns) == (output.rows, output.columns):
            image = camera(sines, centres, equivalent=equivalent)
            total += image
            return image.detach().amax((1, 2)).double().cpu()
        # All beams at once: a few frames are no work for the processor.
        beams = camera.beams(sines, centres)
        tilts = torch.cat([one.double() for one, _, _ in beams])
        places = torch.cat([one.double() for _, one, _ in beams])
        # Windows start on whole pixels; the rest of each place is rendered.
        apart = torch.tensor([output.columns - window.columns, output.rows - window.rows]).to(places) / 2
        corner = (apart + places.detach() / output.pitch).round()
        left, top = corner.to(torch.long).unbind(-1)
        meets = (left > -window.columns) & (left < output.columns) & (top > -window.rows) & (top < output.rows)
        here = meets.nonzero()[:, 0]
        if not len(here):
            return peaks
        images = camera.render(tilts[here], (places - (corner - apart) * output.pitch)[here], equivalent=equivalent)
        for one, image in zip(here, images, strict=True):
            number = int(one)
            x, y = int(left[number]), int(top[number])
            rows = slice(max(y, 0), min(y + window.rows, output.rows))
            columns = slice(max(x, 0), min(x + window.columns, output.columns))
            part = image[rows.start - y : rows.stop - y, columns.start - x : columns.stop - x]
            strength = beams[number // len(sines)][2]
            total[number % len(sines), rows, columns].add_(part, alpha=strength)
            peaks[number % len(sines)] += strength * float(part.detach().max())
        return peaks

    @property
    def plan(self) -> Any:
        """The plan of the camera with the largest claimed error."""
        return max((camera.plan for camera, _ in self.units), key=lambda plan: plan.expected_error)

    @property
    def sampled(self) -> int:
        """Samples of a picture as wide as the sensor."""
        parts = max(camera.area.parts for camera, _ in self.units)
        return parts**2 * math.prod(self.output.shape)

    @property
    def finest(self) -> float:
        """The shortest period of a picture in metres."""
        return min(camera.finest for camera, _ in self.units)

    @property
    def polychromatic(self) -> bool:
        """Whether there is light of more than one wavelength."""
        return any(camera.polychromatic for camera, _ in self.units)

    def metadata(self) -> dict[str, Any]:
        """Of the first camera, with the places of all, and whether all have the light of their rims.

        The error is the sum of all cameras', each in shares of the picture's peak: of pictures so far, or where there
        is none as if each camera's were the brightest.
        """
        each = [camera.metadata() for camera, _ in self.units]
        cut = max(one["cut_by_aperture"] for one in each)
        shown = bool(self._shares.any())
        shares: list[float] = [float(one) if shown else 1.0 for one in self._shares]
        error = sum(one["expected_error"] * share for one, share in zip(each, shares, strict=True) if share)
        whole = all(one["rim_light"] for one in each)
        places = [unit.place for _, unit in self.units]
        return {**each[0], "expected_error": error, "cut_by_aperture": cut, "rim_light": whole, "cameras": places}


def open_camera(scene: Scene, steepest: float, **options: Any) -> Camera | PhoneCamera:
    """The target of a scene, one camera or a phone of several; arguments as for `Camera`."""
    return (PhoneCamera if isinstance(scene.target, PhoneTarget) else Camera)(scene, steepest, **options)
