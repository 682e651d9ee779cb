"""One target before one probe: everything the scene says, ready for any number of gazes.

One file of more than 400 lines: here, and only here, all parts of a scene meet. Each part has its own module; what
stands here adds up their light and states the error of the whole.
"""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch

from tapetum.bench import PrescriptionLens, Scene
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.optics.sampling import Plan
from tapetum.simulate.diffuse import ScatteredLight
from tapetum.simulate.foreshortening import cosines, off_axis, turned
from tapetum.simulate.gaze import spot_places
from tapetum.simulate.light import directions, shortest, wavelengths
from tapetum.simulate.line import Line, as_many, line_of
from tapetum.simulate.pixel_area import PixelArea
from tapetum.simulate.pupil_fits import PupilFits
from tapetum.simulate.radiometry import beam_radius, irradiance_at_target
from tapetum.simulate.reflections import glinting, longest_path, mirrors
from tapetum.simulate.scene_optics import SceneOptics, positive
from tapetum.simulate.sensor_edge import EdgeRule, SpotLight, Spots
from tapetum.simulate.thin_errors import faded_by_tilted_planes, of_narrow_beam, of_the_way, of_tilted_planes
from tapetum.simulate.traced_again import tilts_like
from tapetum.simulate.traced_lens import TracedLens
from tapetum.simulate.traced_plan import TracedGroup, TracedPlan

__all__ = ["Camera", "pick_device", "sensor_grid"]

# Ring 12 of an Airy pattern is 1e-4 of its peak: less than the read noise of an unsaturated frame.
_RINGS_SHOWN = 12

# Share of the accuracy that the sensor's edges may take from a spot's outer rings before they are computed.
_EDGE_SHARE = 0.5

# Share of a picture's width from which on its plan serves a narrower one to the far field.
_AS_WIDE = 0.75

# Largest radius of a traced lens's exit pupil over that of its entrance pupil, and of a return at the probe over that
# by rays and the first dark ring.
_EXIT_PUPIL, _SPREAD = 1.3, 1.5

# Change by the probe's aperture over that of the round pupils that stand for tilted ones; and a change head on that is
# stated rather than computed, which takes tens of times as long.
_SAFETY, _LITTLE_CUT = 1.5, 0.02


class Camera:
    """One target before one probe, ready for any number of gazes. Build it once and call it for many.

    Parameters
    ----------
    scene
        Target, probe and light; the scene's own rotation is not used.
    steepest
        Sine of the steepest tilt that will be asked for: from 0, below 1.
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
        if not 0 <= steepest < 1:
            what = f"must be a sine from 0, below 1, is {steepest}"
            raise InputError(what, where="steepest", remedy="give the sine of the steepest tilt")
        self.scene, self.output = scene, output or sensor_grid(scene)
        self._edge_rule: EdgeRule = edge
        self._edge_error, self._faded = 0.0, 1.0
        target, light, found = scene.target, scene.illumination, pick_device(device)
        if scene.sampling.sensor is not None and target.sensor.mask is None:
            what = f"{scene.sampling.sensor} samples have no meaning without a mask: no sensor plane is sampled"
            raise InputError(what, where="sampling.sensor", remedy="leave it out, or use sampling.pupil")

        def scalar(value: torch.Tensor | float | None, otherwise: float) -> torch.Tensor:
            return torch.as_tensor(otherwise if value is None else value, dtype=torch.float64, device=found)

        self._power = scalar(power, light.power)
        optics = SceneOptics(
            scene,
            scalar(focal_length, target.lens.focal_length),
            scalar(object_distance, target.object_distance),
            scalar(distance, scene.distance),
            directions(light, shortest(light) / (2 * target.lens.aperture_radius)),
            scene.sampling.accuracy if accuracy is None else accuracy,
            pictures,
            dtype,
            found,
        )
        optics.check()
        positive(self._power, "power", ("W", "watts"))
        self._optics, self._steepest = optics, steepest
        self._return_radius = optics.widest_return()
        self._like: Camera | None = None
        # Lines that were planned for more pixels.
        self._wider: list[Line] | None = None
        if isinstance(target.lens, PrescriptionLens):
            for name, forced in (("pupil", scene.sampling.pupil), ("sensor", scene.sampling.sensor)):
                if forced is not None:
                    what = f"{forced} samples cannot be forced on a traced lens, which chooses its own"
                    where = f"sampling.{name}"
                    raise InputError(what, where=where, remedy="leave it out, or change sampling.accuracy")
            if any(one.requires_grad for one in (optics.focal_length, optics.object_distance)):
                what = "carries gradients, which a traced lens has for the gaze alone"
                raise InputError(what, where="object_distance", remedy="give a number, or use a thin lens")
            at = float(optics.object_distance)
            if like is None or like._optics.lens is None:
                lens = TracedLens(scene, at, steepest)
                self._return_radius = max(self._return_radius, lens.return_radius)
            else:
                self._like, lens = like, like._optics.lens.set_to(scene, at)
                self._return_radius = like._return_radius
            optics = replace(optics, lens=lens)
        finite = self._is_finite() if self._like is None else self._like.finite
        self._optics = replace(optics, finite=finite)
        self._set_to_pixels()

    def _set_to_pixels(self) -> None:
        """What depends on the output alone, and is found without planning."""
        scene, optics = self.scene, self._optics
        self.area = PixelArea.of(self.output, scene.probe.sensor.fill, self.finest, optics.accuracy)
        self.geometry = optics.geometry(self.area.samples, scene.illumination.wavelength, self._steepest)
        self._scattered = ScatteredLight(
            self.area.samples,
            self.output.pitch,
            optics.away,
            scene.probe.lens.aperture_radius,
            beam_radius(scene),
            self.real,
        )

    def tilts_like(self, other: Camera, sines: torch.Tensor) -> torch.Tensor:
        """Tilts [B, 2] that put the spot on the photosites where another camera's tilts [B, 2] put it.

        Both are those of traced lenses.
        """
        own, wanted = self._pupil, other._pupil
        axes = [torch.tensor(one.scene.target.sensor.decentre, dtype=torch.float64) for one in (other, self)]
        shift = (axes[0] - axes[1]).to(self.device)
        if own is wanted and not bool(shift.any()):
            return sines
        return tilts_like(own, wanted, sines.to(self.device), shift)

    @property
    def _pupil(self) -> PupilFits:
        group = self._lines[0].passes[0]
        assert isinstance(group, TracedGroup)
        return group.passes[0].fits

    @cached_property
    def _lines(self) -> list[Line]:
        light, lens, width = self.scene.illumination, self._optics.lens, 2 * self.geometry.radius
        angle = max(
            self._optics.picture_angle(self.area.samples, self._steepest), 0.0 if lens is None else lens.exit_angle
        )
        spread = width * angle + _RINGS_SHOWN * max(self._optics.wavelengths)
        lines = wavelengths(light, spread, longest_path(self.scene), self.accuracy)
        if self._wider is not None:
            before = {line.wavelength: line for line in self._wider}
            likes = [before.get(length) for length, _ in lines]
        else:
            likes = as_many([] if self._like is None else self._like._lines, len(lines))
        wider = self._wider is not None
        return [
            line_of(self._optics, self.area.samples, length, watts, self._steepest, like=like, wider=wider)
            for (length, watts), like in zip(lines, likes, strict=True)
        ]

    @property
    def _plans(self) -> list[Plan]:
        return [plan for line in self._lines for plan in line.plans]

    @cached_property
    def plan(self) -> Plan:
        """The sampling of the plane with the largest error; planned at the first use."""
        return max(self._plans, key=lambda plan: (plan.expected_error, plan.columns))

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
        if glinting(self.scene) > 0 or self._return_radius > self.scene.probe.lens.aperture_radius:
            return True
        if _SAFETY * self._optics.cut_by_probe(self.output, 0.0) <= max(self._optics.accuracy, _LITTLE_CUT):
            return False
        # Of a thin lens the aperture's samples may be too many: then the cut is stated.
        return self.scene.target.lens.kind != "thin" or self._optics.reaches_aperture(self.output)

    @property
    def sampled(self) -> int:
        """Samples of a picture: its pixels, or more where these are means over wide ones."""
        return math.prod(self.area.samples.shape)

    @property
    def finest(self) -> float:
        """The shortest period of a picture in metres, by the width of the light that meets the probe's lens."""
        lens = self.scene.probe.lens
        radius = self.scene.target.lens.aperture_radius * (1.0 if self._optics.lens is None else _EXIT_PUPIL)
        if self.finite:
            radius = min(lens.aperture_radius, max(radius, _SPREAD * self._return_radius))
        return min(self._optics.wavelengths) * lens.focal_length / (2 * radius)

    def _scale(self) -> torch.Tensor:
        """First line's irradiance at the target times the transmission back; it follows power and distance."""
        scene, light = self.scene, self.scene.illumination
        at_target = irradiance_at_target(scene) * self._power / light.power
        if light.wave.spreads:
            at_target = at_target * (scene.distance / self._optics.distance) ** 2
        return at_target * scene.probe.transmission

    def __call__(
        self, sines: torch.Tensor, centres: torch.Tensor | None = None, *, equivalent: bool = False
    ) -> torch.Tensor:
        """Irradiance [B, H, W] in W/m² for tilts [B, 2] (sines), the RR at centres [B, 2] (metres) on the sensor.

        `equivalent`: convert each wavelength to the irradiance of the scene's first wavelength with as many photons.

        Raises an InputError for tilts that are not finite, or steeper than `steepest`: the stated error holds up to it.
        """
        steep = float(sines.detach().double().square().sum(-1).amax().sqrt()) if len(sines) else 0.0
        if not steep <= self._steepest * (1 + 1e-6) + 1e-12:
            what = f"holds a tilt of sine {steep:.6g}, and the camera is planned for {self._steepest:.6g} at most"
            remedy = f"build it with steepest={steep:.6g}, or tilt less" if steep < 1 else "give finite sines below 1"
            raise InputError(what, where="sines", remedy=remedy)
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
        return self._optics.accuracy

    @property
    def real(self) -> torch.dtype:
        """Type of the pictures of mirrors."""
        return self._optics.dtype.to_real()

    @property
    def device(self) -> torch.device:
        """Where it computes."""
        return self._optics.device

    @property
    def finite(self) -> bool:
        """Whether light is carried over the distance and through the probe's aperture; found without planning."""
        return self._optics.finite

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
            for dx, dy, share in self._optics.directions:
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
        return self._optics.lens is not None and self.scene.target.sensor.mask is None

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
                seen = cosines(sines)[:, None, None].to(self.device) ** (1 if narrow else 2)
                if spots is not None and scatterer.image_distance == line.geometry.image_distance:
                    # Only the sensor's own: its layers also scatter beside it.
                    seen = seen * spots.share[:, None, None].to(seen)
                scattered = self._scattered(line.geometry, scatterer, centres).to(self.device)
                part = (weight * seen).to(self.real) * scattered
                total = part if total is None else _sum(total, part)
            if line.glints is not None:
                beside = None if total is None else total.detach().amax((1, 2)) / weight.detach()
                part = weight.to(self.real) * line.glints(sines, places, beside).to(self.device)
                total = part if total is None else _sum(total, part)
        if total is None:
            total = torch.zeros(len(sines), *self.area.samples.shape, device=self.device)
        return self.area.means(total)

    def _left_out(self) -> float:
        """Error of the passes at any sampling, over the peak: of an aperture that is left out, and of a thin lens."""
        left_out = self._cut_off
        if self._optics.lens is not None:
            return left_out
        geometries, sensor = [line.geometry for line in self._lines], self.scene.target.sensor
        tilt = max(math.hypot(*one.tilt) for one in (sensor, *sensor.layers))
        missed = left_out + of_narrow_beam(geometries, beam_radius(self.scene), self._steepest)
        missed += of_tilted_planes(geometries, tilt, self._steepest)
        if self.finite:
            probe_radius = self.scene.probe.lens.aperture_radius
            missed += of_the_way(geometries, self._optics.away, probe_radius, self._steepest)
        return missed

    @cached_property
    def _cut_off(self) -> float:
        """What the probe's aperture would change of a picture that is computed without it, at most, over the peak."""
        if self.scene.sampling.propagation != "auto" or self.finite:
            return 0.0
        return _SAFETY * self._optics.cut_by_probe(self.output, self._steepest)

    def _note_fading(self, line: Line, sines: torch.Tensor) -> None:
        """Keep how much more than planned the peaks of a thin lens's gazes fade behind tilted mirrors."""
        sensor, g = self.scene.target.sensor, line.geometry
        # The orders of an array, and a mask, return light in many directions.
        if self._optics.lens is not None or sensor.array is not None or sensor.mask is not None or not line.passes:
            return
        planes = mirrors(self.scene, line.wavelength, g.image_distance)
        if any(tilt != (0.0, 0.0) for _, tilt in planes):
            self._faded = max(self._faded, faded_by_tilted_planes(g, planes, sines))

    def _spots(self, line: Line, sines: torch.Tensor) -> Spots:
        """Places of the gazes' spots on the sensor, and the share of each that it holds."""
        g = line.geometry
        lit = min(g.radius, beam_radius(self.scene))
        places = spot_places(self.scene, self._optics.z, sines)
        spot, ring = g.spot_radius * lit / g.radius, g.airy_step * g.radius / lit
        light = SpotLight(spot, ring, 2 * math.pi / g.wavelength, g.image_distance, g.radius, line.orders)
        sampled = self._optics.lens is None and lit == g.radius
        most = _EDGE_SHARE * self.accuracy if sampled else math.inf
        spots = Spots.of(self._optics.edge, places, light, most)
        self._edge_error = max(self._edge_error, spots.missed)
        return spots

    def window(self, *, margin: bool = False, left_out: float | None = None) -> Grid:
        """The smallest square of probe pixels that holds one beam's RR without its faintest rings.

        With `margin` it also holds the second beam's RR while the first lies within a quarter of the window. With
        `left_out` it is so wide that rings and fringes beyond stay below this fraction of the peak.
        """
        g, second = self.geometry, self.scene.illumination.second_beam
        lens, samples = self._optics.lens, self.area.samples
        exit_angle = self._optics.picture_angle(samples, self._steepest) if lens is None else lens.exit_angle
        rings, fringes = float(_RINGS_SHOWN), 4.0
        if left_out is not None:
            # The envelopes of an Airy pattern's rings, 8/(π (πn)³), and of the fringes beyond a straight edge,
            # λd/(2πx)².
            rings = max(rings, (8 / (math.pi * left_out)) ** (1 / 3) / math.pi)
            fringes = max(fringes, 1 / (2 * math.pi * math.sqrt(left_out)))
        angle = exit_angle + rings * g.wavelength / (2 * g.radius)
        if self.finite:
            # At most the width of the probe's aperture, and the fringes at its edge.
            distance, radius = self._optics.away, self.scene.probe.lens.aperture_radius
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
        least = 0.0 if self.finite else _AS_WIDE
        sides = ((output.rows, self.output.rows), (output.columns, self.output.columns))
        held = output.pitch == self.output.pitch and all(least * wide <= own <= wide for own, wide in sides)
        other._wider = self.__dict__.get("_lines") if held and self._optics.lens is not None else None
        for planned in ("_lines", "plan", "_cut_off"):
            other.__dict__.pop(planned, None)
        other.output, other._edge_error, other._faded = output, 0.0, 1.0
        other._set_to_pixels()
        return other

    def metadata(self) -> dict[str, Any]:
        """The sampling, the error it should give, and the radiometry, by name."""
        scene = self.scene
        returning = self._return_radius
        overfills = returning > scene.probe.lens.aperture_radius
        way = "finite distance, through the probe's aperture" if self.finite else "far field"
        if overfills and not self.finite:
            way += "; the return overfills the probe, which cuts off nothing here"
        return {
            "sampling": self.plan.as_dict(),
            # Over all gazes so far: the change by the sensor's edges of spots near them, and peaks that fade as tilted
            # mirrors turn their light out of the lens.
            "expected_error": self._faded
            * (max([self.plan.expected_error, *(line.missed for line in self._lines)]) + self._left_out())
            + self._edge_error
            + self.area.error,
            "irradiance_at_target": irradiance_at_target(scene),
            "beam_radius_at_target": beam_radius(scene),
            "return_radius_at_probe": returning,
            "propagation": way,
            # What the probe's aperture would change, where `auto` leaves it out: a part of the error.
            "cut_by_aperture": self._cut_off,
            # Whether no plane's picture lacks what the pupil's rim sends, see `bench.Sampling`.
            "rim_light": all(plan.rim_light for plan in self._plans if isinstance(plan, TracedPlan)),
            "wavelengths": [line.wavelength for line in self._lines],
            "planes": sum(len(line.passes) + len(line.scatterers) for line in self._lines[:1]),
        }


def _sum(total: torch.Tensor, part: torch.Tensor) -> torch.Tensor:
    """Of irradiances, in the first one's memory where nothing is differentiated."""
    part = part.to(total.dtype)
    return total + part if total.requires_grad or part.requires_grad else total.add_(part)


def sensor_grid(scene: Scene) -> Grid:
    """The probe's own pixels."""
    columns, rows = scene.probe.sensor.pixels
    return Grid(rows, columns, scene.probe.sensor.pitch)


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
