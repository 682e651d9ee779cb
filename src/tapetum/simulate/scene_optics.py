"""The numbers of a scene that the passes of all its wavelengths share, and the lengths that follow from them."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch

from tapetum.bench import Scene
from tapetum.errors import InputError
from tapetum.optics.glass import focal_length_at
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.sampling import DoublePassGeometry, aperture_samples, check_aperture
from tapetum.simulate.aperture_cut import cut_up_to
from tapetum.simulate.radiometry import beam_radius, illumination_curvature, return_radius_by_rays
from tapetum.simulate.reflections import mirrors, scatterers
from tapetum.simulate.sensor_edge import SensorEdge
from tapetum.simulate.traced_lens import TracedLens

__all__ = ["SceneOptics", "positive"]

# Wavelengths in the radius of an opening whose first dark ring is 0.12 rad from the axis.
_LEAST_WIDTH = 5
_FINITE = sys.float_info.max


@dataclass(frozen=True, eq=False)
class SceneOptics:
    """What the passes of all wavelengths share.

    Parameters
    ----------
    scene
        Target, probe and light.
    focal_length, object_distance, distance
        Of the target's lens, to what it is focused on, and to the probe, in metres; tensors that may carry gradients.
    directions
        Of an extended source's parts, (x, y, share).
    accuracy
        Wanted largest error of the irradiance, in fractions of the peak.
    pictures
        How many will be asked for, about.
    dtype, device
        Of the fields.
    lens
        The traced lens; None for a thin one.
    finite
        Whether light is carried over the distance and through the probe's aperture.
    """

    scene: Scene
    focal_length: torch.Tensor
    object_distance: torch.Tensor
    distance: torch.Tensor
    directions: Sequence[tuple[float, float, float]]
    accuracy: float
    pictures: int
    dtype: torch.dtype
    device: torch.device
    lens: TracedLens | None = None
    finite: bool = False

    @property
    def z(self) -> torch.Tensor:
        """Image distance: 1/z = 1/f - 1/x_d also holds at infinity, where the gradient of f²/(x_d - f) would be 0/0."""
        return 1 / (1 / self.focal_length - 1 / self.object_distance)

    @property
    def edge(self) -> SensorEdge:
        """Of the target's sensor."""
        return SensorEdge.of(self.scene.target.sensor)

    @property
    def away(self) -> float:
        """The distance as a number."""
        return float(self.distance.detach())

    @property
    def wavelengths(self) -> tuple[float, ...]:
        """Of the scene's lines, in metres, the first one's first."""
        light = self.scene.illumination
        return (light.wavelength, *(line.wavelength for line in light.lines))

    @property
    def curvature(self) -> torch.Tensor | float:
        """1/R of the light at the target; it follows a distance given as a tensor."""
        follows = self.scene.illumination.follows_distance
        return 1 / self.distance if follows else illumination_curvature(self.scene)

    @property
    def where(self) -> dict[str, Any]:
        """Type and device of fields."""
        return {"dtype": self.dtype, "device": self.device}

    def check(self) -> None:
        """Refuse a lens that is none, and light that is no beam: an opening of a few wavelengths radiates everywhere.

        Raises InputError.
        """
        focal_length = positive(self.focal_length, "focal_length")
        lens_numbers(focal_length, positive(self.object_distance, "object_distance", most=math.inf))
        positive(self.distance, "distance")
        scene, light = self.scene, self.scene.illumination
        least = _LEAST_WIDTH * max(self.wavelengths)
        beam = "divergence" if light.divergence is not None else "diameter"
        for radius, where in (
            (scene.target.lens.aperture_radius, "target.lens.aperture_radius"),
            (scene.probe.lens.aperture_radius, "probe.lens.aperture_radius"),
            (beam_radius(scene), f"illumination.{beam}"),
        ):
            if radius < least:
                what = f"a radius of {radius:.3g} m is too small for light that stays near its axis"
                raise InputError(what, where=where, remedy=f"give it a radius of {least:.2g} m or more")

    def focal_at(self, wavelength: float) -> torch.Tensor:
        """Focal length of a thin lens at a wavelength, in metres."""
        lens = self.scene.target.lens
        if lens.glass is None:
            return self.focal_length
        return self.focal_length * focal_length_at(1.0, lens.glass, lens.design_wavelength, wavelength)

    def geometry(self, output: Grid, wavelength: float, steepest: float) -> DoublePassGeometry:
        """The lengths that decide the sampling of a wavelength's light on the pixels of `output`."""
        scene, second = self.scene, self.scene.illumination.second_beam
        probe_f = scene.probe.lens.focal_length
        # Of the second beam, and of the source's parts.
        aside = max(math.hypot(x, y) for x, y, _ in self.directions)
        aside += math.hypot(*second.angle) if second is not None else 0.0
        return DoublePassGeometry(
            wavelength=wavelength,
            radius=scene.target.lens.aperture_radius,
            focal_length=float(self.focal_at(wavelength).detach()),
            image_distance=float(self.z.detach()),
            probe_focal_length=probe_f,
            window=math.hypot(output.width, output.height) / 2 + probe_f * math.tan(aside),
            sine=math.sin(math.asin(steepest) + aside),
            curvature=illumination_curvature(scene),
            lit_radius=beam_radius(scene),
        )

    def widest_return(self) -> float:
        """Radius at the probe of the widest return, over all mirrors and wavelengths, by rays and diffraction; metres.

        A filter before a focused sensor returns a beam much wider than the sensor's.
        """
        scene = self.scene
        radius, widest = scene.target.lens.aperture_radius, 0.0
        curvature = float(torch.as_tensor(self.curvature).detach())
        for wavelength in self.wavelengths:
            focal = float(self.focal_at(wavelength).detach())
            ring = 1.22 * wavelength * self.away / (2 * min(radius, beam_radius(scene)))
            for z, _ in mirrors(scene, wavelength, float(self.z.detach())):
                widest = max(widest, ring + return_radius_by_rays(radius, focal, z, curvature, self.away))
        return widest

    def cut_by_probe(self, output: Grid, steepest: float) -> float:
        """How much the probe's aperture changes pictures of any plane and line up to a tilt, over their peaks.

        Of returns that fit through it by rays: it cuts off their rings.
        """
        probe_radius, worst = self.scene.probe.lens.aperture_radius, 0.0
        for wavelength in self.wavelengths:
            g = replace(self.geometry(output, wavelength, 0.0), window=0.0)
            for z, _ in mirrors(self.scene, wavelength, g.image_distance):
                worst = max(worst, cut_up_to(replace(g, image_distance=z), self.away, probe_radius, steepest))
        return worst

    def reaches_aperture(self, output: Grid) -> bool:
        """Whether light behind a thin lens can be computed in the probe's aperture."""
        at = [self.geometry(output, wavelength, 0.0) for wavelength in self.wavelengths]
        try:
            for one in at:
                check_aperture(
                    partial(aperture_samples, one, self.away), self.away, self.scene.probe.lens.aperture_radius
                )
        except InputError:
            return False
        return True

    def picture_angle(self, output: Grid, steepest: float) -> float:
        """Half-angle of the widest picture of all returns behind a thin lens, by rays, in radians."""
        widest = 0.0
        for wavelength in self.wavelengths:
            g = self.geometry(output, wavelength, steepest)
            for z, _ in mirrors(self.scene, wavelength, g.image_distance):
                widest = max(widest, replace(g, image_distance=z).picture_angle)
            for one in scatterers(self.scene, wavelength, g.image_distance):
                spread = 2 * one.diffuse.spread / one.image_distance
                widest = max(widest, replace(g, image_distance=one.image_distance).picture_angle + spread)
        return widest


def positive(value: torch.Tensor, where: str, unit: tuple[str, str] = ("m", "metres"), most: float = _FINITE) -> float:
    """The number that a tensor holds; an InputError that names `where`, unless it is above 0 and at most `most`."""
    number = float(value.detach())
    if not 0 < number <= most:
        finite = "" if math.isinf(most) else " and finite"
        what = f"must be positive{finite}, is {number} {unit[0]}"
        raise InputError(what, where=where, remedy=f"give {unit[1]}")
    return number
