"""One target before one probe: everything the scene says, ready for any number of gazes.

One file of more than 600 lines: here, and only here, all parts of a scene meet. Each part has its own module; what
stands here chooses among them, adds up their light and states the error of the whole.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import torch

from tapetum.bench import PrescriptionLens, Scene
from tapetum.errors import InputError
from tapetum.optics.glass import focal_length_at
from tapetum.optics.grid import Grid, lens_numbers
from tapetum.optics.grid_sampling import ACCURACIES, SamplingPlan, plan_double_pass, plan_finer
from tapetum.optics.sampling import (
    DoublePassGeometry,
    Plan,
    aperture_samples,
    check_aperture,
    check_table,
    plan_aside,
    plan_round,
    through_aperture,
)
from tapetum.simulate.diffuse import DiffuseProfile, corner, diffuse_profile
from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.faint import FaintPass, Pass
from tapetum.simulate.foreshortening import cosines, off_axis, turned
from tapetum.simulate.gaze import spot_places
from tapetum.simulate.glints import Glints
from tapetum.simulate.light import directions, wavelengths
from tapetum.simulate.pixel_area import PixelArea
from tapetum.simulate.pupil_fits import PupilFits
from tapetum.simulate.radiometry import (
    beam_radius,
    illumination_curvature,
    irradiance_at_target,
    return_radius_by_rays,
)
from tapetum.simulate.reflections import (
    Scatterer,
    glinting,
    longest_path,
    mirrors,
    reaching_sensor,
    scatterers,
    specular_groups,
)
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.sensor_edge import EdgeRule, SensorEdge, SpotLight, Spots
from tapetum.simulate.sensor_end import SensorEnd, thin_end, traced_end
from tapetum.simulate.sensor_plane import reflectance_at
from tapetum.simulate.surfaces import Mask, Surface
from tapetum.simulate.thin_errors import faded_by_tilted_planes, of_narrow_beam, of_the_way, of_tilted_planes
from tapetum.simulate.traced_again import tilts_like
from tapetum.simulate.traced_lens import TracedLens
from tapetum.simulate.traced_plan import TracedGroup, TracedPlan
from tapetum.simulate.true_paths import check_squash

__all__ = ["Camera", "pick_device", "scene_geometry", "sensor_grid"]

# Ring 12 of an Airy pattern is 1e-4 of its peak: less than the read noise of an unsaturated frame.
_RINGS_SHOWN = 12
# Wavelengths in the radius of an opening whose first dark ring is 0.12 rad from the axis.
_LEAST_WIDTH = 5

# Share of the accuracy that the sensor's edges may take from a spot's outer rings before they are computed.
_EDGE_SHARE = 0.5

# Share of a picture's width from which on its plan serves a narrower one to the far field.
_AS_WIDE = 0.75

# Largest radius of a traced lens's exit pupil over that of its entrance pupil, and of a return at the probe over that
# by rays and the first dark ring.
_EXIT_PUPIL, _SPREAD = 1.3, 1.5

# Steps in which the reach of the scattered light's tables grows.
_FARTHER = 1.2

_T = TypeVar("_T")

# A mirror's single order.
_MIRRORS = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)


@dataclass(frozen=True)
class _Line:
    """Light of one wavelength: its power over the scene's first line, and its passes."""

    wavelength: float
    power: torch.Tensor
    passes: tuple[Pass, ...]
    scatterers: tuple[Scatterer, ...]
    geometry: DoublePassGeometry
    glints: Glints | None = None
    # For each pass, its return where the sensor does not hold the whole spot; None without a sensor.
    ends: tuple[SensorEnd | None, ...] = ()
    # Of the sensor, as in `SpotLight`.
    orders: torch.Tensor = _MIRRORS


class Camera:
    """One target before one probe, ready for any number of gazes. Build it once and call it for many.

    Parameters
    ----------
    scene
        Target, probe and light; the scene's own rotation is not used.
    steepest
        Sine of the steepest tilt that will be asked for.
    output
        Pixels to compute in place of the probe's whole sensor.
    object_distance, focal_length, distance, power
        Replace the scene's values, in metres and watts; tensors carry gradients.
    edge
        How to treat a spot that the edge of the target's sensor cuts. `exact`: compute it on a sampled sensor plane, or
        refuse it. `dimmed`: dim the return to the share of the spot that the sensor holds, by rays.
    like
        A camera of a scene that differs by little and of the same pixels: behind a traced lens pictures are computed
        on its samples, so that a difference of the two is that of the scenes. `steepest` must be its own.
    pictures
        How many will be asked for, about. From 300 on, planning a traced lens takes up to five times as long, for
        pictures that take down to half as long, as accurate as was asked for either way.
    accuracy, dtype, device
        As for `retroreflect`.

    Raises
    ------
    InputError
        As `retroreflect`.
    """

    def __init__(
        self,
        scene: Scene,
        steepest: float,
        *,
        output: Grid | None = None,
        object_distance: torch.Tensor | float | None = None,
        focal_length: torch.Tensor | float | None = None,
        distance: torch.Tensor | float | None = None,
        power: torch.Tensor | float | None = None,
        edge: EdgeRule = "exact",
        like: Camera | None = None,
        pictures: int = 1,
        accuracy: float | None = None,
        dtype: torch.dtype = torch.complex64,
        device: torch.device | str = "auto",
    ) -> None:
        self.scene, self.output = scene, output or sensor_grid(scene)
        self._edge, self._edge_error, self._faded = SensorEdge.of(scene.target.sensor), 0.0, 1.0
        self._masks: list[FaintPass] = []
        self._edge_rule: EdgeRule = edge
        self._pictures = pictures
        self._dtype, self._device = dtype, pick_device(device)
        self._accuracy = scene.sampling.accuracy if accuracy is None else accuracy
        target = scene.target
        if scene.sampling.sensor is not None and target.sensor.mask is None:
            what = f"{scene.sampling.sensor} samples have no meaning without a mask: no sensor plane is sampled"
            raise InputError(what, where="sampling.sensor", remedy="leave it out, or use sampling.pupil")
        self._focal_length = self._scalar(target.lens.focal_length if focal_length is None else focal_length)
        self._object_distance = self._scalar(target.object_distance if object_distance is None else object_distance)
        self._distance = self._scalar(scene.distance if distance is None else distance)
        self._power = self._scalar(scene.illumination.power if power is None else power)
        _check_focus(float(self._focal_length.detach()), float(self._object_distance.detach()))
        # 1/z = 1/f - 1/x_d also holds at infinity, where the gradient of x_i = f²/(x_d - f) would be 0/0.
        self._z = 1 / (1 / self._focal_length - 1 / self._object_distance)
        _check_widths(scene)
        self._return_radius = self._widest_return()
        self._finite = self._is_finite()
        light = scene.illumination
        self._directions = directions(light, light.wavelength / (2 * target.lens.aperture_radius))
        self._lens: TracedLens | None = None
        self._like: Camera | None = None
        # Lines that were planned for more pixels.
        self._wider: list[_Line] | None = None
        if isinstance(target.lens, PrescriptionLens):
            for name, forced in (("pupil", scene.sampling.pupil), ("sensor", scene.sampling.sensor)):
                if forced is not None:
                    what = f"{forced} samples cannot be forced on a traced lens, which chooses its own"
                    where = f"sampling.{name}"
                    raise InputError(what, where=where, remedy="leave it out, or change sampling.accuracy")
            if any(self._scalar(one).requires_grad for one in (self._focal_length, self._object_distance)):
                what = "carries gradients, which a traced lens has for the gaze alone"
                raise InputError(what, where="object_distance", remedy="give a number, or use a thin lens")
            at = float(self._object_distance)
            self._like = like if like is not None and like._lens is not None else None
            if self._like is None:
                self._lens = TracedLens(scene, at, steepest)
                self._return_radius = max(self._return_radius, self._lens.return_radius)
                self._finite = self._is_finite()
            else:
                assert self._like._lens is not None
                self._lens = self._like._lens.set_to(scene, at)
                self._return_radius, self._finite = self._like._return_radius, self._like._finite
        self._steepest = steepest
        self.area = self._area_of(self.output)
        self.geometry = self._geometry(light.wavelength, steepest)
        self._plans: list[Plan] = []
        self._profiles: dict[tuple[float, Scatterer, int], DiffuseProfile] = {}

    def tilts_like(self, other: Camera, sines: torch.Tensor) -> torch.Tensor:
        """Tilts [B, 2] that put the spot on the photosites where another camera's tilts [B, 2] put it.

        Both are those of traced lenses.
        """
        own, wanted = self._pupil, other._pupil
        axes = [torch.tensor(one.scene.target.sensor.decentre, dtype=torch.float64) for one in (other, self)]
        shift = (axes[0] - axes[1]).to(self._device)
        if own is wanted and not bool(shift.any()):
            return sines
        return tilts_like(own, wanted, sines.to(self._device), shift)

    @property
    def _pupil(self) -> PupilFits:
        group = self._lines[0].passes[0]
        assert isinstance(group, TracedGroup)
        return group.passes[0].fits

    @cached_property
    def _lines(self) -> list[_Line]:
        light, first = self.scene.illumination, self.geometry
        rings = first.exit_angle / (light.wavelength / (2 * first.radius)) + _RINGS_SHOWN
        path = longest_path(self.scene)
        lines = wavelengths(light, rings, path)
        if self._wider is not None:
            before = {line.wavelength: line for line in self._wider}
            likes = [before.get(length) for length, _ in lines]
        else:
            likes = _as_many([] if self._like is None else self._like._lines, len(lines))
        return [
            self._line(length, watts, self._steepest, like) for (length, watts), like in zip(lines, likes, strict=True)
        ]

    @cached_property
    def plan(self) -> Plan:
        """The sampling of the plane with the largest error; planned at the first use."""
        assert self._lines
        return max(self._plans, key=lambda plan: (plan.expected_error, plan.columns))

    def _scalar(self, value: torch.Tensor | float) -> torch.Tensor:
        return torch.as_tensor(value, dtype=torch.float64, device=self._device)

    def _is_finite(self) -> bool:
        wanted = self.scene.sampling.propagation
        if self.scene.target.sensor.mask is not None:
            if wanted == "finite":
                what = "'finite' cannot be had with a mask on the target's sensor"
                raise InputError(what, where="sampling.propagation", remedy="use 'far field', or an array for a mask")
            return False
        if wanted != "auto":
            return wanted == "finite"
        # Glints spread far beyond any probe.
        return glinting(self.scene) > 0 or self._return_radius > self.scene.probe.lens.aperture_radius

    def _area_of(self, output: Grid) -> PixelArea:
        return PixelArea.of(output, self.scene.probe.sensor.fill, self.finest, self._accuracy)

    @property
    def sampled(self) -> int:
        """Samples of a picture: its pixels, or more where these are means over wide ones."""
        return math.prod(self.area.samples.shape)

    @property
    def finest(self) -> float:
        """The shortest period of a picture in metres, by the width of the light that meets the probe's lens."""
        lens = self.scene.probe.lens
        radius = self.scene.target.lens.aperture_radius * (1.0 if self._lens is None else _EXIT_PUPIL)
        if self._finite:
            radius = min(lens.aperture_radius, max(radius, _SPREAD * self._return_radius))
        return min(self._light()) * lens.focal_length / (2 * radius)

    def _widest_return(self) -> float:
        """Radius at the probe of the widest return, over all mirrors and wavelengths, by rays and diffraction; metres.

        A filter before a focused sensor returns a beam much wider than the sensor's.
        """
        scene = self.scene
        radius, distance = scene.target.lens.aperture_radius, float(self._distance.detach())
        curvature, widest = float(self._scalar(self._curvature()).detach()), 0.0
        for wavelength in self._light():
            focal = float(self._focal_at(wavelength).detach())
            ring = 1.22 * wavelength * distance / (2 * min(radius, beam_radius(scene)))
            for z, _ in mirrors(scene, wavelength, float(self._z.detach())):
                widest = max(widest, ring + return_radius_by_rays(radius, focal, z, curvature, distance))
        return widest

    def _focal_at(self, wavelength: float) -> torch.Tensor:
        lens = self.scene.target.lens
        if lens.glass is None:
            return self._focal_length
        return self._focal_length * focal_length_at(1.0, lens.glass, lens.design_wavelength, wavelength)

    def _geometry(self, wavelength: float, steepest: float) -> DoublePassGeometry:
        f, z = float(self._focal_at(wavelength).detach()), float(self._z.detach())
        spread = max(math.hypot(x, y) for x, y, _ in self._directions)
        return scene_geometry(self.scene, steepest, f, z, self.area.samples, wavelength, spread)

    def _line(self, wavelength: float, watts: float, steepest: float, like: _Line | None = None) -> _Line:
        scene, geometry, lens = self.scene, self._geometry(wavelength, steepest), self._lens
        if lens is not None:
            # Scattered light is computed for a thin lens with the prescription's focus at this wavelength.
            geometry = replace(geometry, focal_length=lens.thin_focal_length(wavelength))
            # Orders beyond twice the aperture and the steepest tilt do not leave the lens again.
            widest = 4 * lens.aperture_sine(wavelength)
        else:
            widest = 2 * (geometry.return_radius + geometry.radius) / geometry.image_distance + 2 * geometry.tangent
        groups = specular_groups(scene, wavelength, self._z, widest)
        passes: list[Pass] = []
        ends: list[SensorEnd | None] = []
        before = _as_many(() if like is None else like.passes, len(groups))
        for group, planned in zip(groups, before, strict=True):
            one, end = self._thin(geometry, group) if lens is None else self._traced(lens, wavelength, group, planned)
            self._plans.append(one.plan)
            passes.append(one)
            ends.append(end)
        if scene.target.sensor.mask is not None:
            passes.append(self._masked(geometry, wavelength))
            ends.append(None)
        share = watts / scene.illumination.power * torch.ones((), dtype=torch.float64, device=self._device)
        found = scatterers(scene, wavelength, geometry.image_distance)
        if not self._plans:
            # Without a mirror the scattered light uses the plan of a mirror's light.
            self._plans.append(plan_round(geometry, max(self._accuracy, 1e-2)))
        way = float(self._distance.detach()) if self._finite else None
        glints = None
        if lens is not None:
            glints = lens.glints(self.area.samples, wavelength, way, self._dtype.to_real(), self._accuracy)
        orders = _orders_of(groups)
        return _Line(wavelength, share, tuple(passes), tuple(found), geometry, glints, tuple(ends), orders)

    def _traced(
        self, lens: TracedLens, wavelength: float, group: Sequence[Surface], planned: Pass | None
    ) -> tuple[TracedGroup, SensorEnd | None]:
        distance = float(self._distance.detach()) if self._finite else None
        where: dict[str, Any] = {"dtype": self._dtype, "device": self._device}

        def opened(group: Sequence[Surface]) -> TracedGroup:
            return lens.group(
                group, self.area.samples, wavelength, self._accuracy, distance, pictures=self._pictures, **where
            )

        if isinstance(planned, TracedGroup) and len(planned.passes) == len(group):
            others = group if self._wider is None else None
            own = self.area.samples, wavelength, self._accuracy, distance
            one = lens.again(planned, others, *own, **where)
        else:
            one = opened(group)
        return one, traced_end(group, opened, self.area.samples)

    def _thin(self, geometry: DoublePassGeometry, group: Sequence[Surface]) -> tuple[RoundPass, SensorEnd | None]:
        scene = self.scene
        # The plane that is most out of focus asks for the finest grid.
        lengths = [float(self._scalar(one.image_distance).detach()) for one in group]
        at = replace(geometry, image_distance=max(lengths, key=lambda z: abs(z - geometry.focal_length)))
        tilt = max(math.hypot(*order.direction) for one in group for order in one.orders) / 2
        probe_radius, planned, away = scene.probe.lens.aperture_radius, at, float(self._distance.detach())
        if self._finite:
            planned = through_aperture(at, away, probe_radius)
        pixels = self.area.samples.rows * self.area.samples.columns
        forced = scene.sampling.pupil
        plan = plan_round(planned, self._accuracy, pupil_samples=forced, pixels=pixels, orders=tilt)
        check_table(at, plan, at.tangent + tilt)
        check_squash(at)
        if self._finite:
            check_aperture(partial(aperture_samples, at, away), away, probe_radius)
        options: dict[str, Any] = {
            "distance": self._distance if self._finite else None,
            "probe_radius": probe_radius if self._finite else None,
            "focal_length": self._focal_at(geometry.wavelength),
            "curvature": self._curvature(),
            "lit_radius": min(geometry.radius, beam_radius(scene)),
            "dtype": self._dtype,
            "device": self._device,
        }
        own: dict[str, Any] = {"sensor": scene.target.sensor, "edge": self._edge, "accuracy": self._accuracy}
        mirrors_only = all(order.direction == (0.0, 0.0) for one in group for order in one.orders)
        aside = plan_aside(planned, self._accuracy, plan) if mirrors_only and forced is None else None
        one = RoundPass(at, plan, self.area.samples, group, aside=aside, **options)
        return one, thin_end(at, plan, self.area.samples, group, **own, **options)

    def _masked(self, geometry: DoublePassGeometry, wavelength: float) -> Pass:
        """The pass of a sensor's mask, with its faint pictures by a finer one."""
        sensor = self.scene.target.sensor
        assert sensor.mask is not None
        bare = reflectance_at(sensor, wavelength, self._edge.window)
        passed = math.sqrt(reaching_sensor(self.scene, wavelength))
        mask = Mask(lambda x, y: bare(x, y) * passed, sensor.mask.pitch)
        usual: TracedGroup | DoublePass
        if self._lens is None:
            usual, bright, finer = self._thin_mask(geometry, self._focal_at(wavelength), mask)
        else:
            given = mask, self.area.samples, wavelength, self._accuracy
            found = self._lens.mask(*given, dtype=self._dtype, device=self._device)
            usual, bright, finer = found.usual, found.mirror, lambda: found.finer
        self._plans.append(usual.plan)

        def mirror(sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
            return sensor.reflectance * passed**2 * bright(sines, centres)

        one = FaintPass(usual, mirror, finer)
        self._masks.append(one)
        return one

    def _thin_mask(
        self, geometry: DoublePassGeometry, focal: torch.Tensor, mask: Mask
    ) -> tuple[DoublePass, Pass, Callable[[], Pass]]:
        """As planned, a mirror's in its place, and a finer one."""
        sampling, beam = self.scene.sampling, beam_radius(self.scene)
        if beam < geometry.radius:
            raise InputError(
                f"a beam {2 * beam:.4g} m wide does not fill the target's aperture, which is sampled whole with a mask",
                where="illumination",
                remedy=f"widen it to {2 * geometry.radius:.4g} m, or use an array for a mask",
            )
        sized: dict[str, Any] = {"pixels": self.area.samples.rows * self.area.samples.columns, "finest": mask.finest}
        forced = {"pupil_samples": sampling.pupil, "sensor_samples": sampling.sensor}
        plan = plan_double_pass(geometry, max(self._accuracy, ACCURACIES[-1]), **forced, **sized)

        def made(plan: SamplingPlan, mask: Mask | None) -> DoublePass:
            held = mask and mask.reflectance
            options: dict[str, Any] = {"dtype": self._dtype, "device": self._device}
            return DoublePass(geometry, plan, self.area.samples, focal, self._z, mask=held, **options)

        def mirror(sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
            return made(plan, None)(sines, centres)

        return made(plan, mask), mirror, lambda: made(plan_finer(geometry, self._accuracy, **sized), mask)

    def _curvature(self) -> torch.Tensor | float:
        """1/R of the light at the target; it follows a distance given as a tensor."""
        follows = self.scene.illumination.follows_distance
        return 1 / self._distance if follows else illumination_curvature(self.scene)

    def _scale(self) -> torch.Tensor:
        """First line's irradiance at the target times the transmission back; it follows power and distance."""
        scene, light = self.scene, self.scene.illumination
        at_target = irradiance_at_target(scene) * self._power / light.power
        if light.wave.spreads:
            at_target = at_target * (scene.distance / self._distance) ** 2
        return at_target * scene.probe.transmission

    def __call__(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, *, equivalent: bool = False
    ) -> torch.Tensor:
        """Irradiance [B, H, W] in W/m² for tilts [B, 2] (sines), the RR at centres [B, 2] (metres) on the sensor.

        `equivalent`: convert each wavelength to the irradiance of the scene's first wavelength with as many photons.
        """
        if centres is None:
            centres = torch.zeros(len(sines), 2, dtype=torch.float64)
        total: torch.Tensor | None = None
        for tilts, places, share in self.beams(sines, centres):
            image = self.render(tilts, places, share, equivalent=equivalent)
            total = image if total is None else total + image
        assert total is not None
        return total

    @property
    def accuracy(self) -> float:
        """Wanted largest error of the irradiance, in fractions of the peak."""
        return self._accuracy

    @property
    def real(self) -> torch.dtype:
        """Type of the pictures of mirrors."""
        return self._dtype.to_real()

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return self._device

    @property
    def finite(self) -> bool:
        """Whether light is carried over the distance and through the probe's aperture; found without planning."""
        return self._finite

    @property
    def polychromatic(self) -> bool:
        """Whether there is light of more than one wavelength."""
        return len(self._lines) > 1

    def beams(self, sines: torch.Tensor, centres: torch.Tensor) -> list[tuple[torch.Tensor, torch.Tensor, float]]:
        """Tilts, centres on the probe's sensor and relative power of every beam of the probe; they add as intensity."""
        light, focal = self.scene.illumination, self.scene.probe.lens.focal_length
        sources = [(0.0, 0.0, 1.0)]
        if light.second_beam is not None and light.second_beam.ratio > 0:
            sources.append((*light.second_beam.angle, light.second_beam.ratio))
        found: list[tuple[torch.Tensor, torch.Tensor, float]] = []
        for x, y, ratio in sources:
            for dx, dy, share in self._directions:
                if (x + dx, y + dy) == (0.0, 0.0):
                    found.append((sines, centres, ratio * share))
                    continue
                angle = torch.tensor((x + dx, y + dy), dtype=torch.float64, device=sines.device)
                # It meets the target steeper by its angle, and returns along its own direction.
                place = centres.to(angle) - focal * torch.tan(angle)
                found.append((off_axis(sines.to(angle), angle), place, ratio * share))
        return found

    @property
    def takes_roll(self) -> bool:
        """Whether `render` computes a roll of the target: behind a traced lens without a mask."""
        return self._lens is not None and self.scene.target.sensor.mask is None

    def render(
        self,
        sines: torch.Tensor,
        centres: torch.Tensor,
        share: float = 1.0,
        *,
        equivalent: bool = False,
        roll: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Irradiance [B, H, W] in W/m² of one beam that carries `share` of the first one's power.

        `roll` [B], where `takes_roll`, turns the target about its optical axis, in radians from x to y; elsewhere it
        raises an InputError.
        """
        if roll is not None and not self.takes_roll:
            what = "is computed with the picture only behind a traced lens without a mask"
            raise InputError(what, where="roll", remedy="turn the tilt the other way, and the picture afterwards")
        middle = not bool(centres.any()) and not centres.requires_grad
        scale, total = self._scale() * share, None
        places, rolled = None if middle else centres, () if roll is None else (roll,)
        for line in self._lines:
            weight = scale * line.power
            narrow = beam_radius(self.scene) < line.geometry.radius
            if equivalent:
                weight = weight * (line.wavelength / self.scene.illumination.wavelength)
            own = sines if roll is None else turned(sines, -roll)
            self._note_fading(line, own)
            spots = self._spots(line, own) if line.ends or line.scatterers else None
            for one, end in itertools.zip_longest(line.passes, line.ends):
                if end is None or spots is None:
                    image = one(sines, places, *rolled)
                else:
                    image = end.seen(one, spots, self._edge_rule, sines, places, *rolled)
                if end is not None:
                    self._edge_error = max(self._edge_error, end.missed)
                if end is not None and spots is not None and end.open_beside is None and bool(spots.beside.any()):
                    # A dark picture has no peak to relate an error to.
                    self._edge_error = math.inf
                part = (
                    image * weight.to(image.dtype)
                    if image.requires_grad or weight.requires_grad
                    else image.mul_(weight)
                )
                if narrow:
                    # A beam narrower than the lens is round across its own direction and lights an ellipse on the lens.
                    part = part / cosines(sines)[:, None, None].to(part) ** 2
                total = part if total is None else _sum(total, part)
            for scatterer in line.scatterers:
                # The spot's light and the return scale with the lens's foreshortened width; a beam narrower than the
                # lens enters whole at any tilt.
                seen = cosines(sines)[:, None, None].to(self._device) ** (1 if narrow else 2)
                if spots is not None and scatterer.image_distance == line.geometry.image_distance:
                    # Only the sensor's own: its layers also scatter beside it.
                    seen = seen * spots.share[:, None, None].to(seen)
                part = (weight * seen).to(self.real) * self._scattered(line, scatterer, centres)
                total = part if total is None else _sum(total, part)
            if line.glints is not None:
                beside = None if total is None else total.detach().amax((1, 2)) / weight.detach()
                part = weight.to(self.real) * line.glints(sines, places, beside).to(self._device)
                total = part if total is None else _sum(total, part)
        if total is None:
            total = torch.zeros(len(sines), *self.area.samples.shape, device=self._device)
        return self.area.means(total)

    def _left_out(self) -> float:
        """Error of a thin lens's passes at any sampling, over the peak."""
        if self._lens is not None:
            return 0.0
        geometries, sensor = [line.geometry for line in self._lines], self.scene.target.sensor
        tilt = max(math.hypot(*one.tilt) for one in (sensor, *sensor.layers))
        missed = of_narrow_beam(geometries, beam_radius(self.scene), self._steepest)
        missed += of_tilted_planes(geometries, tilt, self._steepest)
        if self._finite:
            probe_radius, away = self.scene.probe.lens.aperture_radius, float(self._distance.detach())
            missed += of_the_way(geometries, away, probe_radius, self._steepest)
        return missed

    def _note_fading(self, line: _Line, sines: torch.Tensor) -> None:
        """Keep how much more than planned the peaks of a thin lens's gazes fade behind tilted mirrors."""
        sensor, g = self.scene.target.sensor, line.geometry
        # The orders of an array, and a mask, return light in many directions.
        if self._lens is not None or sensor.array is not None or sensor.mask is not None or not line.passes:
            return
        planes = mirrors(self.scene, line.wavelength, g.image_distance)
        if any(tilt != (0.0, 0.0) for _, tilt in planes):
            self._faded = max(self._faded, faded_by_tilted_planes(g, planes, sines))

    def _spots(self, line: _Line, sines: torch.Tensor) -> Spots:
        """Places of the gazes' spots on the sensor, and the share of each that it holds."""
        g = line.geometry
        lit = min(g.radius, beam_radius(self.scene))
        places = spot_places(self.scene, self._z, sines)
        spot, ring = g.spot_radius * lit / g.radius, g.airy_step * g.radius / lit
        light = SpotLight(spot, ring, 2 * math.pi / g.wavelength, g.image_distance, g.radius, line.orders)
        sampled = self._lens is None and lit == g.radius
        most = _EDGE_SHARE * self._accuracy if sampled else math.inf
        spots = Spots.of(self._edge, places, light, most)
        self._edge_error = max(self._edge_error, spots.missed)
        return spots

    def _scattered(self, line: _Line, scatterer: Scatterer, centres: torch.Tensor) -> torch.Tensor:
        """Expected irradiance [B or 1, H, W] of a scattering plane for 1 W/m² at the target, at zero tilt."""
        places = [(float(x), float(y)) for x, y in centres.detach().cpu()]
        if len(set(places)) == 1:
            places = places[:1]
        images = [self._profile(line, scatterer, place).on(self.area.samples, place, self.real) for place in places]
        return torch.stack(images).to(self._device)

    def _profile(self, line: _Line, scatterer: Scatterer, place: tuple[float, float]) -> DiffuseProfile:
        """Scattered light by its distance from a place; places about as far from the picture's corners share it."""
        near, reach = corner(self.area.samples) + self.output.pitch, corner(self.area.samples, place)
        # Rounded up to a step, so that what is kept does not depend on which place came first.
        steps = max(0, math.ceil(math.log(reach / near) / math.log(_FARTHER)))
        key = (line.wavelength, scatterer, steps)
        if key not in self._profiles:
            self._profiles[key] = diffuse_profile(
                line.geometry,
                float(self._distance.detach()),
                self.scene.probe.lens.aperture_radius,
                near * _FARTHER**steps,
                albedo=scatterer.diffuse.albedo * scatterer.transmittance,
                spread=scatterer.diffuse.spread,
                image_distance=scatterer.image_distance,
                lit_radius=min(line.geometry.radius, beam_radius(self.scene)),
            )
        return self._profiles[key]

    def window(self, *, margin: bool = False, left_out: float | None = None) -> Grid:
        """The smallest square of probe pixels that holds one beam's RR without its faintest rings.

        With `margin` it also holds the second beam's RR while the first lies within a quarter of the window. With
        `left_out` it is so wide that rings and fringes beyond stay below this fraction of the peak.
        """
        g, second = self.geometry, self.scene.illumination.second_beam
        exit_angle = self._picture_angle() if self._lens is None else self._lens.exit_angle
        rings, fringes = float(_RINGS_SHOWN), 4.0
        if left_out is not None:
            # The envelopes of an Airy pattern's rings, 8/(π (πn)³), and of the fringes beyond a straight edge,
            # λd/(2πx)².
            rings = max(rings, (8 / (math.pi * left_out)) ** (1 / 3) / math.pi)
            fringes = max(fringes, 1 / (2 * math.pi * math.sqrt(left_out)))
        angle = exit_angle + rings * g.wavelength / (2 * g.radius)
        if self._finite:
            # At most the width of the probe's aperture, and the fringes at its edge.
            distance, radius = float(self._distance.detach()), self.scene.probe.lens.aperture_radius
            angle = min(angle, (radius + g.radius) / distance + fringes * math.sqrt(g.wavelength / distance))
        if margin:
            angle = 1.25 * angle + (math.hypot(*second.angle) if second is not None else 0.0)
        side = 2 * math.ceil(self.scene.probe.lens.focal_length * angle / self.output.pitch) + 1
        return Grid(side, side, self.output.pitch)

    def on(self, output: Grid) -> Camera:
        """The same on other pixels, planned for them at the first use.

        Behind a traced lens, whose planning takes seconds, a plan holds for fewer pixels about the same middle too.
        """
        if output == self.output:
            return self
        other = copy.copy(self)
        # To the far field a wider picture needs more samples; behind the probe's aperture none does.
        least = 0.0 if self._finite else _AS_WIDE
        sides = ((output.rows, self.output.rows), (output.columns, self.output.columns))
        held = output.pitch == self.output.pitch and all(least * wide <= own <= wide for own, wide in sides)
        other._wider = self.__dict__.get("_lines") if held and self._lens is not None else None
        for planned in ("_lines", "plan"):
            other.__dict__.pop(planned, None)
        other.output, other._plans, other._masks, other._profiles = output, [], [], {}
        other._edge_error, other._faded = 0.0, 1.0
        other.area = self._area_of(output)
        other.geometry = other._geometry(self.scene.illumination.wavelength, self._steepest)
        return other

    def _picture_angle(self) -> float:
        """Half-angle of the widest picture of all returns behind a thin lens, by rays, in radians."""
        widest = 0.0
        for line in self._light():
            g = self._geometry(line, self._steepest)
            for z, _ in mirrors(self.scene, line, g.image_distance):
                widest = max(widest, replace(g, image_distance=z).picture_angle)
            for one in scatterers(self.scene, line, g.image_distance):
                spread = 2 * one.diffuse.spread / one.image_distance
                widest = max(widest, replace(g, image_distance=one.image_distance).picture_angle + spread)
        return widest

    def _light(self) -> tuple[float, ...]:
        light = self.scene.illumination
        return (light.wavelength, *(line.wavelength for line in light.lines))

    def metadata(self) -> dict[str, Any]:
        """The sampling, the error it should give, and the radiometry, by name."""
        scene = self.scene
        returning = self._return_radius
        overfills = returning > scene.probe.lens.aperture_radius
        way = "finite distance, through the probe's aperture" if self._finite else "far field"
        if overfills and not self._finite:
            way += "; the return overfills the probe, which cuts off nothing here"
        return {
            "sampling": self.plan.as_dict(),
            # Over all gazes so far: the change by the sensor's edges of spots near them, and peaks that fade as tilted
            # mirrors turn their light out of the lens.
            "expected_error": self._faded
            * (max([self.plan.expected_error, *(one.missed for one in self._masks)]) + self._left_out())
            + self._edge_error
            + self.area.error,
            "irradiance_at_target": irradiance_at_target(scene),
            "beam_radius_at_target": beam_radius(scene),
            "return_radius_at_probe": returning,
            "propagation": way,
            # Whether no plane's picture lacks what the pupil's rim sends, see `bench.Sampling`.
            "rim_light": all(plan.rim_light for plan in self._plans if isinstance(plan, TracedPlan)),
            "wavelengths": [line.wavelength for line in self._lines],
            "planes": sum(len(line.passes) + len(line.scatterers) for line in self._lines[:1]),
        }


def _sum(total: torch.Tensor, part: torch.Tensor) -> torch.Tensor:
    """Of irradiances, in the first one's memory where nothing is differentiated."""
    part = part.to(total.dtype)
    return total + part if total.requires_grad or part.requires_grad else total.add_(part)


def _orders_of(groups: Sequence[Sequence[Surface]]) -> torch.Tensor:
    """Amplitude and direction [M, 3] of the sensor's orders; a mirror's where only its layers reflect."""
    sensors = [one for group in groups for one in group if one.depth == 0]
    orders = [(abs(order.amplitude), *order.direction) for one in sensors for order in one.orders if order.amplitude]
    return torch.tensor(orders, dtype=torch.float64) if orders else _MIRRORS


def sensor_grid(scene: Scene) -> Grid:
    """The probe's own pixels."""
    columns, rows = scene.probe.sensor.pixels
    return Grid(rows, columns, scene.probe.sensor.pitch)


def scene_geometry(
    scene: Scene,
    steepest: float,
    focal_length: float,
    image_distance: float,
    output: Grid,
    wavelength: float | None = None,
    spread: float = 0.0,
) -> DoublePassGeometry:
    """The lengths of a scene that decide its sampling; `steepest` is a sine, `spread` the source's half angle."""
    second = scene.illumination.second_beam
    probe_f = scene.probe.lens.focal_length
    offset = math.hypot(*second.angle) if second is not None else 0.0
    return DoublePassGeometry(
        wavelength=scene.illumination.wavelength if wavelength is None else wavelength,
        radius=scene.target.lens.aperture_radius,
        focal_length=focal_length,
        image_distance=image_distance,
        probe_focal_length=probe_f,
        window=math.hypot(output.width, output.height) / 2 + probe_f * math.tan(offset + spread),
        sine=math.sin(math.asin(steepest) + offset + spread),
        curvature=illumination_curvature(scene),
        lit_radius=beam_radius(scene),
    )


def _as_many(items: Sequence[_T], count: int) -> list[_T | None]:
    """`count` items, None for those that are missing."""
    return [*items[:count], *[None] * (count - len(items))]


def pick_device(device: torch.device | str) -> torch.device:
    """The device named, or for "auto" a GPU where there is one."""
    if str(device) != "auto":
        remedy = 'use "auto", "cpu" or a CUDA device that is there'
        try:
            found = torch.device(device)
        except RuntimeError as error:
            raise InputError(f"no device is called {device!r}", where="device", remedy=remedy) from error
        cuda = torch.cuda.device_count()
        if found.type not in ("cpu", "cuda", "meta") or (found.type == "cuda" and (found.index or 0) >= cuda):
            what = f"cannot compute on {str(device)!r}: this machine has {cuda} CUDA devices"
            raise InputError(what, where="device", remedy=remedy)
        return found
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def _check_widths(scene: Scene) -> None:
    """Refuse light that is no beam: an opening of a few wavelengths radiates under any angle."""
    light = scene.illumination
    least = _LEAST_WIDTH * max(light.wavelength, *(line.wavelength for line in light.lines), 0.0)
    beam = "divergence" if light.divergence is not None else "diameter"
    for radius, where in (
        (scene.target.lens.aperture_radius, "target.lens.aperture_radius"),
        (scene.probe.lens.aperture_radius, "probe.lens.aperture_radius"),
        (beam_radius(scene), f"illumination.{beam}"),
    ):
        if radius < least:
            what = f"a radius of {radius:.3g} m is too small for light that stays near its axis"
            raise InputError(what, where=where, remedy=f"give it a radius of {least:.2g} m or more")


def _check_focus(focal_length: float, object_distance: float) -> None:
    if not focal_length > 0 or math.isinf(focal_length):
        raise InputError(f"must be positive, is {focal_length} m", where="focal_length", remedy="give metres")
    if not object_distance > 0:
        raise InputError(f"must be positive, is {object_distance} m", where="object_distance", remedy="give metres")
    lens_numbers(focal_length, object_distance)
