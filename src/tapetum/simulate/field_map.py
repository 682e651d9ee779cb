"""Where a target's lens images a direction on its sensor: the link between tilt and gaze.

A thin lens is free of distortion: tan θ. For a traced lens, a polynomial of the tilt gives the centroid of the spot.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from tapetum.bench import PrescriptionLens
from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens
from tapetum.simulate.pupil_fits import TiltNodes
from tapetum.simulate.traced_bundle import spot_middles

__all__ = ["FieldMap", "field_map"]

_COUNT = 21
_NEWTON = 6
_BISECTIONS = 12
# Tangents of the tilts up to which a wider map is tried, over that of the sensor's corner without distortion; and how
# far beyond the corner the field ends, in fractions of its sine.
_WIDER, _BEYOND = (1.03, 1.2), 1e-4
# Sine of the steepest tilt to be tried.
_STEEPEST = 0.95
# Largest misfit, over the height at the field's edge; beyond it the field is shortened by this factor. Far beyond a
# lens's field rays cross, and a tilt's light has no single place.
_TRUE, _SHORTER = 1e-3, 0.9
# Number of last coefficients whose sum estimates the next ones'; places at which the slope is checked.
_TAIL, _LOOKED_AT = 3, 200
_EDGE = 1 + 1e-9


@dataclass(frozen=True)
class FieldMap:
    """Height of the spot on the sensor by the sine of the tilt.

    `nodes` are the traced tilts, up to the edge of the lens's field or of the sensor; `height` [T] are Chebyshev
    coefficients, in metres.
    """

    nodes: TiltNodes
    height: torch.Tensor

    def image(self, size: torch.Tensor) -> torch.Tensor:
        """Height in metres for sines of the tilt [...]; differentiable. Raises InputError beyond the traced field."""
        most = float(size.detach().max())
        if not most <= self.nodes.steepest * _EDGE:
            asked, edge = (math.degrees(math.asin(min(one, 1.0))) for one in (most, self.nodes.steepest))
            raise InputError(
                f"{asked:.3g} deg lies outside the field of the target's lens and sensor, "
                f"which ends at {edge:.3g} deg: there is no gaze",
                where="rotation",
                remedy=f"stay within {edge:.3g} degrees, or use a larger sensor if the lens covers more",
            )
        return self._height(size)

    def _height(self, size: torch.Tensor) -> torch.Tensor:
        return (self.nodes.terms(size) * self.height.to(size.device)).sum(-1)

    def sine(self, height: torch.Tensor) -> torch.Tensor:
        """Sine of the tilt for heights [...] in metres; differentiable. Raises InputError beyond the traced field."""
        steepest = torch.tensor(self.nodes.steepest, dtype=torch.float64)
        most = float(self._height(steepest))
        if float(height.detach().max()) > most * (1 + 1e-6):
            asked = float(height.detach().max())
            raise InputError(
                f"a spot {asked * 1e3:.3g} mm from the axis lies outside the field of the lens, {most * 1e3:.3g} mm",
                where="gaze",
                remedy="stay nearer to the middle",
            )
        with torch.no_grad():
            found = height.detach() / most * steepest
            for _ in range(_NEWTON):
                found = (found - (self._height(found) - height.detach()) / self._slope(found)).clamp(0, float(steepest))
        # One more step, which carries gradients.
        return found - (self._height(found) - height) / self._slope(found)

    @property
    def holds(self) -> bool:
        """Whether each place has one tilt, and the fit has converged to the rays."""
        tail = float(self.height[-_TAIL:].abs().sum())
        sizes = torch.linspace(0, self.nodes.steepest, _LOOKED_AT, dtype=torch.float64)
        heights = self._height(sizes)
        return bool((heights.diff() > 0).all()) and tail < _TRUE * float(heights[-1])

    def _slope(self, size: torch.Tensor) -> torch.Tensor:
        step = 1e-6 * self.nodes.steepest
        return (self._height(size + step) - self._height(size - step)).detach() / (2 * step)


@functools.lru_cache(maxsize=64)
def field_map(lens: PrescriptionLens, wavelength: float, object_distance: float, half_diagonal: float) -> FieldMap:
    """Trace a lens's field up to a sensor's corner (`half_diagonal`, metres), or to where no ray passes any more."""
    focused = lens.focused(wavelength, object_distance)

    def height(sine: float) -> float:
        try:
            at = torch.tensor([sine], dtype=torch.float64)
            return float(spot_middles(focused, at, count=_COUNT)[0])
        except InputError:
            return math.nan

    steepest = _beyond_corner(focused, half_diagonal)
    if steepest is None:
        steepest = _by_halving(height, min(_STEEPEST, 1.1 * half_diagonal / lens.focal_length), half_diagonal)
    while not (found := _traced(focused, steepest)).holds:
        steepest *= _SHORTER
    return found


def _traced(focused: FocusedLens, steepest: float) -> FieldMap:
    nodes = TiltNodes.up_to(steepest)
    return FieldMap(nodes, nodes.coefficients(spot_middles(focused, nodes.sines, count=_COUNT)))


def _beyond_corner(focused: FocusedLens, half_diagonal: float) -> float | None:
    """Sine of a tilt just beyond that of the sensor's corner, by a wider map; None where no wider one is had."""
    for wider in _WIDER:
        with contextlib.suppress(InputError):
            found = _traced(focused, math.sin(math.atan(wider * half_diagonal / focused.focal_length)))
            # It raises where the map does not reach the corner.
            if found.holds:
                return float(found.sine(torch.tensor(half_diagonal, dtype=torch.float64))) * (1 + _BEYOND)
    return None


def _by_halving(height: Callable[[float], float], high: float, half_diagonal: float) -> float:
    """As `_beyond_corner`, or up to `high` where a tilt has the height of the corner; else the last that has one."""
    low = 0.0
    if not height(high) < half_diagonal:
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            if height(middle) < half_diagonal:
                low = middle
            else:
                high = middle
        high = low if math.isnan(height(high)) else high
    return high
