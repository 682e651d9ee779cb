"""A thin lens's planes where the spot lies across or beyond the sensor's edge, sampled up to the edge."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch

from tapetum.bench import TargetSensor
from tapetum.optics.fourier import phasor
from tapetum.optics.grid import Grid
from tapetum.optics.grid_sampling import ACCURACIES, plan_double_pass, plan_finer
from tapetum.optics.sampling import DoublePassGeometry, RoundPlan, through_aperture
from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.foreshortening import tangents
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.sensor_edge import SensorEdge
from tapetum.simulate.sensor_plane import orders_of, reflectance_at
from tapetum.simulate.surfaces import Reflectance, Surface

__all__ = ["CutSensor"]

# Samples of the sensor for each period of its photosites, where a table of orders no longer applies.
_DETAILS = 5


class CutSensor:
    """Planes that interfere, among them the sensor (the surface of depth 0), which ends at its edge.

    `geometry`, `plan`, `output`, `surfaces` and `options` are those of `RoundPass`; `sensor` and `edge` give the
    sensor's array and outline. `accuracy` of the sampled plane is in fractions of the peak; `finer` samples it more
    finely than that, to measure its error.
    """

    def __init__(
        self,
        geometry: DoublePassGeometry,
        plan: RoundPlan,
        output: Grid,
        surfaces: Sequence[Surface],
        *,
        sensor: TargetSensor,
        edge: SensorEdge,
        accuracy: float,
        finer: bool = False,
        **options: Any,
    ) -> None:
        (self._sensor,) = (one for one in surfaces if one.depth == 0)
        self._geometry, self._output, self._edge, self._bare = geometry, output, edge, sensor
        self._plan = plan
        self._accuracy, self._options = max(accuracy, ACCURACIES[-1]), options
        self._finer = finer
        layers = [one for one in surfaces if one.depth != 0]
        self._layers: RoundPass | None = None
        if layers:
            self._layers = RoundPass(geometry, plan, output, layers, interferes=True, **options)
        self._mirrors: dict[float, DoublePass] = {}
        self.expected_error = 0.0
        """Largest error of the planes sampled so far, over a mirror's peak."""

    @property
    def layers(self) -> RoundPass:
        """The pass where the spot misses the sensor: the layers before it, of which there must be some."""
        assert self._layers is not None
        return self._layers

    def across(self, sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        """Irradiance [B, H, W] of spots that the edge cuts, by a sampled sensor plane.

        Raises InputError where the samples are too many, and for shifted microlenses, which are not sampled.
        """
        return torch.cat([self._one(sines[i : i + 1], None if centres is None else centres[i : i + 1])
                          for i in range(len(sines))])  # fmt: skip

    def _one(self, sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        k = 2 * math.pi / self._geometry.wavelength
        slopes = tangents(sines)
        tilt = torch.tensor(self._sensor.tilt, dtype=torch.float64)
        z = torch.as_tensor(self._sensor.image_distance, dtype=torch.float64)
        there = z / (1 - (slopes.cpu() * tilt).sum())
        field = self._sampled(there)(sines, centres)
        if self._layers is not None:
            phase = k * there * (slopes**2).sum(-1) + self._sensor.phase
            field = field * phasor(phase)[:, None, None].to(field.dtype) + self._layers.field(sines, centres)
        return field.real**2 + field.imag**2

    def mirror(self, sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        """Irradiance [B, H, W] of an infinite mirror in the sensor's place, as bright as its strongest order."""
        z = torch.as_tensor(self._sensor.image_distance, dtype=torch.float64)
        brightest = max(abs(order.amplitude) for order in self._sensor.orders)
        one = RoundPass(self._geometry, self._plan, self._output, [Surface(z)], **self._options)
        return brightest**2 * one(sines, centres)

    def _sampled(self, z: torch.Tensor) -> Callable[[torch.Tensor, torch.Tensor | None], torch.Tensor]:
        """The sampled plane at a distance, made once for a sensor without a tilt."""
        key = float(z.detach())
        if z.requires_grad or key not in self._mirrors:
            self._mirrors = {key: self._made(z, self._plane())}
        return self._mirrors[key].field

    def _made(self, z: torch.Tensor, mask: Reflectance) -> DoublePass:
        geometry = replace(self._geometry, image_distance=float(z.detach()))
        planned, distance, radius = geometry, self._options["distance"], self._options["probe_radius"]
        if distance is not None and radius is not None:
            planned = through_aperture(geometry, float(torch.as_tensor(distance).detach()), radius)
        array = self._bare.array
        # The light of a straight edge that returns through the lens has no finer detail.
        finest = geometry.airy_step / 2
        if array is not None or self._bare.microlens is not None:
            pitch = self._bare.pitch if array is None or array.pitch is None else array.pitch
            finest = min(finest, pitch / _DETAILS)
        pixels = self._output.rows * self._output.columns
        plan = (plan_finer if self._finer else plan_double_pass)(planned, self._accuracy, pixels=pixels, finest=finest)
        self.expected_error = max(self.expected_error, plan.expected_error)
        known = "focal_length", "distance", "probe_radius", "dtype", "device"
        options = {name: self._options[name] for name in known if name in self._options}
        return DoublePass(geometry, plan, self._output, image_distance=z, mask=mask, followed=True, **options)

    def _plane(self) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        """The sensor's reflectance, weighted as its surface, up to its edge."""
        k, (across, down) = 2 * math.pi / self._geometry.wavelength, self._sensor.tilt
        plain = replace(self._bare, mask=None, diffuse=None, reflectance=1.0)
        bare = reflectance_at(plain, self._geometry.wavelength, self._edge.window)
        # Reduced by layers and coherence: the surface's first order is the sensor's own, scaled.
        share = _scale_of(self._sensor, plain, self._geometry.wavelength)

        def plane(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
            held = bare(x, y) * share
            if across or down:
                held = held * (phasor(2 * k * down * y)[..., :, None] * phasor(2 * k * across * x)[..., None, :])
            return held

        return plane


def _scale_of(surface: Surface, plain: TargetSensor, wavelength: float) -> complex:
    first = max(surface.orders, key=lambda order: abs(order.amplitude))
    a, b = (direction - 2 * tilt for direction, tilt in zip(first.direction, surface.tilt, strict=True))
    known = orders_of(plain, wavelength, math.hypot(a, b) * (1 + 1e-6) + 1e-9)
    own = min(known, key=lambda order: math.hypot(order.direction[0] - a, order.direction[1] - b))
    return first.amplitude / own.amplitude
