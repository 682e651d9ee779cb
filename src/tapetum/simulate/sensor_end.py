"""Returns of planes where the spot lies across or beyond the sensor's edge (`sensor_edge` says where)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch

from tapetum.bench import TargetSensor
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.optics.sampling import DoublePassGeometry, RoundPlan
from tapetum.simulate.cut_sensor import CutSensor
from tapetum.simulate.faint import FaintPass, Pass
from tapetum.simulate.sensor_edge import EdgeRule, Spots
from tapetum.simulate.surfaces import Surface
from tapetum.simulate.traced_plan import TracedGroup

__all__ = ["SensorEnd", "thin_end", "traced_end"]

_REMEDY = "turn the target until its spot lies on the sensor or beside it, or film it: films dim such a return by rays"


@dataclass(frozen=True)
class SensorEnd:
    """What a group of planes returns beyond its sensor's edge, on the pixels of `output`.

    `open_beside` makes the pass of the layers alone, None where there are none; `open_across` that of a spot which the
    edge cuts, None where it cannot be computed.
    """

    open_beside: Callable[[], Pass] | None
    open_across: Callable[[], FaintPass] | None
    output: Grid

    @property
    def missed(self) -> float:
        """Largest error of cut spots' pictures above the planned one so far, over their peaks."""
        across = vars(self).get("_across")
        return 0.0 if across is None else across.missed

    @cached_property
    def _beside(self) -> Pass | None:
        return None if self.open_beside is None else self.open_beside()

    @cached_property
    def _across(self) -> FaintPass:
        if self.open_across is None:
            what = "the spot lies across the edge of the target's sensor, which is not computed behind a traced lens"
            raise InputError(what, where="rotation", remedy=_REMEDY)
        return self.open_across()

    def seen(
        self,
        whole: Pass,
        spots: Spots,
        rule: EdgeRule,
        sines: torch.Tensor,
        centres: torch.Tensor | None,
        *roll: torch.Tensor,
    ) -> torch.Tensor:
        """Irradiance [B, H, W] of the group for 1 W/m², `whole` being its pass for spots that the sensor holds.

        `spots` are those of the gazes; a `roll` [B] is given where the passes take one.
        """
        if bool(spots.whole.all()):
            return whole(sines, centres, *roll)
        parts: list[tuple[torch.Tensor, torch.Tensor]] = []
        cut = ~(spots.whole | spots.beside)
        for some, kind in ((spots.whole, "whole"), (spots.beside, "beside"), (cut, "cut")):
            which = torch.nonzero(some)[:, 0]
            if not len(which):
                continue
            moved = None if centres is None else centres[which.to(centres.device)]
            given = sines[which.to(sines.device)], moved, *(one[which.to(one.device)] for one in roll)
            if kind == "whole":
                image = whole(*given)
            elif kind == "beside":
                image = self._layers(*given)
            elif rule == "exact":
                image = self._across(*given)
            else:
                image = whole(*given)
                share = spots.share[which][:, None, None].to(image)
                image = share * image + (1 - share) * self._layers(*given).to(image)
            parts.append((which, image))
        order = torch.argsort(torch.cat([which for which, _ in parts]))
        like = max((image for _, image in parts), key=lambda image: image.is_cuda)
        return torch.cat([image.to(like.device) for _, image in parts])[order.to(like.device)]

    def _layers(self, sines: torch.Tensor, centres: torch.Tensor | None, *roll: torch.Tensor) -> torch.Tensor:
        if self._beside is not None:
            return self._beside(sines, centres, *roll)
        # Zero, with a gradient where one is asked for.
        return 0 * sines.sum(-1)[:, None, None] * torch.ones(self.output.rows, self.output.columns).to(sines)


def thin_end(
    geometry: DoublePassGeometry,
    plan: RoundPlan,
    output: Grid,
    surfaces: Sequence[Surface],
    *,
    sensor: TargetSensor,
    **options: Any,
) -> SensorEnd | None:
    """The end for planes behind a thin lens, with the arguments of `CutSensor`; None without a sensor among them."""
    if all(one.depth != 0 for one in surfaces):
        return None

    def cut(*, finer: bool = False) -> CutSensor:
        return CutSensor(geometry, plan, output, surfaces, sensor=sensor, finer=finer, **options)

    def across() -> FaintPass:
        lit = options["lit_radius"]
        if lit < geometry.radius:
            what = "the spot of a beam narrower than the lens lies across the edge of the target's sensor"
            raise InputError(what, where="rotation", remedy=_REMEDY)
        made = cut()

        def one(sines: torch.Tensor, centres: torch.Tensor | None) -> torch.Tensor:
            try:
                image = made.across(sines, centres)
            except InputError as error:
                what = f"the spot lies across the edge of the target's sensor, and there {error.what}"
                raise InputError(what, where="rotation", remedy=_REMEDY) from error
            # The sampled plane's error may exceed that of a spot wholly on the sensor.
            passed.missed = max(passed.missed, made.expected_error - plan.expected_error)
            return image

        passed = FaintPass(one, made.mirror, lambda: cut(finer=True).across)
        return passed

    layers = any(one.depth != 0 for one in surfaces)
    return SensorEnd((lambda: cut().layers) if layers else None, across, output)


def traced_end(
    surfaces: Sequence[Surface], opened: Callable[[Sequence[Surface]], TracedGroup], output: Grid
) -> SensorEnd | None:
    """The end for planes behind a traced lens, `opened` making a group's pass; None without a sensor among them."""
    layers = [one for one in surfaces if one.depth != 0]
    if len(layers) == len(surfaces):
        return None
    return SensorEnd((lambda: opened(layers)) if layers else None, None, output)
