"""Where a target's lens images a direction on its sensor: the link between tilt and gaze.

A thin lens is free of distortion: tan θ. For a traced lens, a polynomial of the tilt gives the centroid of the spot.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch

from tapetum.bench import PrescriptionLens
from tapetum.errors import InputError
from tapetum.simulate.pupil_fits import TiltNodes
from tapetum.simulate.traced_bundle import spot_middles

__all__ = ["FieldMap", "field_map"]

_COUNT = 21
_NEWTON = 6
_BISECTIONS = 12
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

    low, high = 0.0, min(_STEEPEST, 1.1 * half_diagonal / lens.focal_length)
    reached = height(high)
    if not reached < half_diagonal:
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            if height(middle) < half_diagonal:
                low = middle
            else:
                high = middle
        high = low if math.isnan(height(high)) else high
    while True:
        nodes = TiltNodes.up_to(high)
        found = FieldMap(nodes, nodes.coefficients(spot_middles(focused, nodes.sines, count=_COUNT)))
        if found.holds:
            return found
        high *= _SHORTER
