"""The light of one wavelength: its passes off a scene's sensor, layers and mask, planned for the probe's pixels.

Behind a thin lens they are round ones, behind a traced lens and with a mask sampled ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import torch

from tapetum.bench import Scene
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
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
from tapetum.simulate.double_pass import DoublePass
from tapetum.simulate.faint import FaintPass, Pass
from tapetum.simulate.glints import Glints
from tapetum.simulate.light import reach_of_interference
from tapetum.simulate.radiometry import beam_radius
from tapetum.simulate.reflections import Scatterer, reaching_sensor, scatterers, specular_groups
from tapetum.simulate.round_pass import RoundPass
from tapetum.simulate.scene_optics import SceneOptics
from tapetum.simulate.sensor_end import SensorEnd, thin_end, traced_end
from tapetum.simulate.sensor_plane import reflectance_at
from tapetum.simulate.surfaces import Mask, Surface
from tapetum.simulate.traced_lens import TracedLens
from tapetum.simulate.traced_plan import TracedGroup
from tapetum.simulate.true_paths import check_squash

__all__ = ["Line", "as_many", "line_of"]

_T = TypeVar("_T")

# A mirror's single order.
_MIRRORS = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64)


@dataclass(frozen=True)
class Line:
    """Light of one wavelength.

    Parameters
    ----------
    wavelength
        In metres.
    power
        Over that of the scene's first line.
    passes, plans
        Of its specular light, and how they are sampled; without any pass the plan of a mirror's.
    scatterers, glints
        Its scattered light, and that of a traced lens's surfaces.
    geometry
        The lengths that decided the sampling.
    ends
        For each pass, its return where the sensor does not hold the whole spot; None without a sensor.
    orders
        [M, 3] amplitudes and directions of the sensor's, as in `SpotLight`.
    masked
        The pass of the sensor's mask.
    """

    wavelength: float
    power: torch.Tensor
    passes: tuple[Pass, ...]
    plans: tuple[Plan, ...]
    scatterers: tuple[Scatterer, ...]
    geometry: DoublePassGeometry
    glints: Glints | None = None
    ends: tuple[SensorEnd | None, ...] = ()
    orders: torch.Tensor = _MIRRORS
    masked: FaintPass | None = None

    @property
    def missed(self) -> float:
        """Largest error of a mask's faint pictures so far."""
        return 0.0 if self.masked is None else self.masked.missed


def line_of(
    optics: SceneOptics,
    output: Grid,
    wavelength: float,
    watts: float,
    steepest: float,
    *,
    like: Line | None = None,
    wider: bool = False,
) -> Line:
    """Plan the passes of one wavelength.

    Parameters
    ----------
    optics
        What all wavelengths share.
    output
        Samples of the probe's pixels.
    wavelength, watts
        Of the light, in metres, and its power.
    steepest
        Sine of the steepest tilt.
    like, wider
        A line whose samples are used again, behind a traced lens: of a scene that differs by little or, where `wider`,
        of the same on more pixels.

    Raises
    ------
    InputError
        For light that cannot be computed.
    """
    scene, lens, geometry = optics.scene, optics.lens, optics.geometry(output, wavelength, steepest)
    if lens is not None:
        # Scattered light is computed for a thin lens with the prescription's focus at this wavelength.
        geometry = replace(geometry, focal_length=lens.thin_focal_length(wavelength))
        # Orders beyond twice the aperture and the steepest tilt do not leave the lens again.
        widest = 4 * lens.aperture_sine(wavelength)
    else:
        widest = 2 * (geometry.return_radius + geometry.radius) / geometry.image_distance + 2 * geometry.tangent
    groups = specular_groups(scene, wavelength, optics.z, widest)
    made: list[tuple[RoundPass | TracedGroup, SensorEnd | None]] = []
    for group, planned in zip(groups, as_many(() if like is None else like.passes, len(groups)), strict=True):
        if lens is None:
            made.append(_thin(optics, output, geometry, group))
        else:
            made.append(_traced(optics, lens, output, wavelength, group, planned, wider=wider))
    passes: list[Pass] = [one for one, _ in made]
    plans: list[Plan] = [one.plan for one, _ in made]
    ends = [end for _, end in made]
    masked = None
    if scene.target.sensor.mask is not None:
        _check_masked_alone(scene, groups, wavelength)
        masked, plan = _masked(optics, output, geometry, wavelength)
        passes.append(masked)
        plans.append(plan)
        ends.append(None)
    if not plans:
        # Without a mirror the scattered light uses the plan of a mirror's light.
        plans.append(plan_round(geometry, max(optics.accuracy, 1e-2)))
    glints = None
    if lens is not None:
        way = optics.away if optics.finite else None
        glints = lens.glints(output, wavelength, way, optics.dtype.to_real(), optics.accuracy)
    return Line(
        wavelength,
        watts / scene.illumination.power * torch.ones((), dtype=torch.float64, device=optics.device),
        tuple(passes),
        tuple(plans),
        tuple(scatterers(scene, wavelength, geometry.image_distance)),
        geometry,
        glints,
        tuple(ends),
        _orders_of(groups),
        masked,
    )


def _traced(
    optics: SceneOptics,
    lens: TracedLens,
    output: Grid,
    wavelength: float,
    group: Sequence[Surface],
    planned: Pass | None,
    *,
    wider: bool,
) -> tuple[TracedGroup, SensorEnd | None]:
    """The pass of planes that interfere behind a traced lens, and its return where the sensor ends."""
    own = output, wavelength, optics.accuracy, optics.away if optics.finite else None

    def opened(group: Sequence[Surface]) -> TracedGroup:
        return lens.group(group, *own, pictures=optics.pictures, **optics.where)

    if isinstance(planned, TracedGroup) and len(planned.passes) == len(group):
        one = lens.again(planned, None if wider else group, *own, **optics.where)
    else:
        one = opened(group)
    return one, traced_end(group, opened, output)


def _thin(
    optics: SceneOptics, output: Grid, geometry: DoublePassGeometry, group: Sequence[Surface]
) -> tuple[RoundPass, SensorEnd | None]:
    """The pass of planes that interfere behind a thin lens, and its return where the sensor ends."""
    scene, away = optics.scene, optics.away
    # The plane that is most out of focus asks for the finest grid.
    lengths = [float(torch.as_tensor(one.image_distance).detach()) for one in group]
    at = replace(geometry, image_distance=max(lengths, key=lambda z: abs(z - geometry.focal_length)))
    tilt = max(math.hypot(*order.direction) for one in group for order in one.orders) / 2
    probe_radius = scene.probe.lens.aperture_radius
    planned = through_aperture(at, away, probe_radius) if optics.finite else at
    forced = scene.sampling.pupil
    plan = plan_round(planned, optics.accuracy, pupil_samples=forced, pixels=output.rows * output.columns, orders=tilt)
    check_table(at, plan, at.tangent + tilt)
    check_squash(at)
    if optics.finite:
        check_aperture(partial(aperture_samples, at, away), away, probe_radius)
    options: dict[str, Any] = {
        "distance": optics.distance if optics.finite else None,
        "probe_radius": probe_radius if optics.finite else None,
        "focal_length": optics.focal_at(geometry.wavelength),
        "curvature": optics.curvature,
        "lit_radius": min(geometry.radius, beam_radius(scene)),
        **optics.where,
    }
    own: dict[str, Any] = {"sensor": scene.target.sensor, "edge": optics.edge, "accuracy": optics.accuracy}
    mirrors_only = all(order.direction == (0.0, 0.0) for one in group for order in one.orders)
    aside = plan_aside(planned, optics.accuracy, plan) if mirrors_only and forced is None else None
    one = RoundPass(at, plan, output, group, aside=aside, **options)
    return one, thin_end(at, plan, output, group, **own, **options)


def _check_masked_alone(scene: Scene, groups: Sequence[Sequence[Surface]], wavelength: float) -> None:
    """Refuse a layer whose light interferes with a mask's, which is computed by itself; raises an InputError."""
    reach = reach_of_interference(scene.illumination, wavelength)
    near = [one for group in groups for one in group if 2 * one.index * one.depth < reach]
    if near:
        what = f"light of the layer {near[0].depth:.3g} m before the mask interferes with the mask's, which is left out"
        remedy = "use an array for a mask, a layer of reflectance 0, or a shorter illumination.coherence_length"
        raise InputError(what, where="target.sensor.mask", remedy=remedy)


def _masked(
    optics: SceneOptics, output: Grid, geometry: DoublePassGeometry, wavelength: float
) -> tuple[FaintPass, Plan]:
    """The pass of a sensor's mask, with its faint pictures by a finer one."""
    sensor = optics.scene.target.sensor
    assert sensor.mask is not None
    bare = reflectance_at(sensor, wavelength, optics.edge.window)
    passed = math.sqrt(reaching_sensor(optics.scene, wavelength))
    mask = Mask(lambda x, y: bare(x, y) * passed, sensor.mask.pitch)
    usual: TracedGroup | DoublePass
    if optics.lens is None:
        usual, bright, finer = _thin_mask(optics, output, geometry, mask)
    else:
        found = optics.lens.mask(mask, output, wavelength, optics.accuracy, **optics.where)
        usual, bright, finer = found.usual, found.mirror, lambda: found.finer

    def mirror(sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        return sensor.reflectance * passed**2 * bright(sines, centres)

    return FaintPass(usual, mirror, finer), usual.plan


def _thin_mask(
    optics: SceneOptics, output: Grid, geometry: DoublePassGeometry, mask: Mask
) -> tuple[DoublePass, Pass, Callable[[], Pass]]:
    """As planned, a mirror's in its place, and a finer one."""
    sampling, beam = optics.scene.sampling, beam_radius(optics.scene)
    if beam < geometry.radius:
        raise InputError(
            f"a beam {2 * beam:.4g} m wide does not fill the target's aperture, which is sampled whole with a mask",
            where="illumination",
            remedy=f"widen it to {2 * geometry.radius:.4g} m, or use an array for a mask",
        )
    sized: dict[str, Any] = {"pixels": output.rows * output.columns, "finest": mask.finest}
    forced = {"pupil_samples": sampling.pupil, "sensor_samples": sampling.sensor}
    plan = plan_double_pass(geometry, max(optics.accuracy, ACCURACIES[-1]), **forced, **sized)
    focal = optics.focal_at(geometry.wavelength)

    def made(plan: SamplingPlan, mask: Mask | None) -> DoublePass:
        held = mask and mask.reflectance
        return DoublePass(geometry, plan, output, focal, optics.z, mask=held, **optics.where)

    def mirror(sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
        return made(plan, None)(sines, centres)

    return made(plan, mask), mirror, lambda: made(plan_finer(geometry, optics.accuracy, **sized), mask)


def _orders_of(groups: Sequence[Sequence[Surface]]) -> torch.Tensor:
    """Amplitude and direction [M, 3] of the sensor's orders; a mirror's where only its layers reflect."""
    sensors = [one for group in groups for one in group if one.depth == 0]
    orders = [(abs(order.amplitude), *order.direction) for one in sensors for order in one.orders if order.amplitude]
    return torch.tensor(orders, dtype=torch.float64) if orders else _MIRRORS


def as_many(items: Sequence[_T], count: int) -> list[_T | None]:
    """`count` items, None for those that are missing."""
    return [*items[:count], *[None] * (count - len(items))]
