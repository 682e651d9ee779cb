"""Where the target's sensor ends: nothing comes back from beside it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch

from tapetum.bench import TargetSensor
from tapetum.simulate.sensor_plane import second_derivative, widened

__all__ = ["EdgeRule", "SensorEdge", "Spots"]

EdgeRule = Literal["exact", "dimmed"]

# Share of the returning amplitude that an edge takes from a focused spot N rings λz/2r away, times N: the light of an
# Airy pattern beyond a straight line, 2/(π³N). The irradiance changes by twice that at the most.
_MISSED = 4 / math.pi**3
# Rings from an edge up to which a spot counts as cut.
_FEWEST_RINGS = 2.0


@dataclass(frozen=True)
class SensorEdge:
    """A sensor's rectangle, in metres from the lens's axis."""

    left: float
    right: float
    top: float
    bottom: float

    @classmethod
    def of(cls, sensor: TargetSensor) -> SensorEdge:
        """That of a target's sensor, which the lens's axis meets off its middle where it is decentred."""
        (columns, rows), (x, y) = sensor.pixels, sensor.decentre
        across, down = columns * sensor.pitch / 2, rows * sensor.pitch / 2
        return cls(-across - x, across - x, -down - y, down - y)

    def depths(self, places: torch.Tensor) -> torch.Tensor:
        """How far inside of each of the four edges places [B, 2] lie, negative outside: [B, 4], in metres."""
        x, y = places[:, 0], places[:, 1]
        return torch.stack([x - self.left, self.right - x, y - self.top, self.bottom - y], -1)

    def missed(self, places: torch.Tensor, spot: float, ring: float, turning: float) -> torch.Tensor:
        """What edges beside a spot at most change of the picture, over its peak: [B].

        Parameters
        ----------
        places
            [B, 2] of the spot's middle.
        spot, ring
            Its geometric radius and the width λz/2r of its rings, in metres.
        turning
            2k/z: how the light turns against what comes back, in radians for a metre from the spot and one from the
            lens's axis. Beyond an edge that is far from the axis it turns quickly, and adds up to little.
        """
        beyond = (self.depths(places) - spot).clamp_min(ring)
        sides = torch.tensor([self.left, self.right, self.top, self.bottom], dtype=places.dtype, device=places.device)
        turned = (turning * beyond * sides.abs()).clamp_min(1.0)
        return (_MISSED * ring / beyond / turned).sum(-1)

    def share(self, places: torch.Tensor, spot: float) -> torch.Tensor:
        """Share of an even round spot that the sensor holds, by rays: [B]."""
        # A corner counts as if both of its edges cut by themselves.
        along = (self.depths(places) / max(spot, 1e-9)).clamp(-1, 1)
        held = 0.5 + (along * torch.sqrt(1 - along**2) + torch.asin(along)) / math.pi
        return held.prod(-1)

    def window(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """1 on the sensor and 0 beside it, for equally spaced columns [..., n] and rows [..., m]: [..., m, n].

        Sharp edges between samples are seen as `sensor_plane.reflectance_at` sees them.
        """
        across = _between(x, self.left, self.right)
        down = _between(y, self.top, self.bottom)
        return down[..., :, None] * across[..., None, :]


@dataclass(frozen=True)
class Spots:
    """How the sensor holds the spots of some gazes.

    Parameters
    ----------
    whole, beside
        [B] bool: on the sensor as a whole, and wholly beside it. Those that are neither are cut.
    share
        [B] of each spot that the sensor holds, by rays; differentiable.
    missed
        The most that edges change of the pictures of whole spots, over their peaks.
    """

    whole: torch.Tensor
    beside: torch.Tensor
    share: torch.Tensor
    missed: float

    @classmethod
    def of(cls, edge: SensorEdge, places: torch.Tensor, spot: float, ring: float, turning: float, most: float) -> Spots:
        """Sort places [B, 2] by how their spots lie to the edge; lengths as for `SensorEdge.missed`.

        A whole spot may miss up to `most` of the picture's peak: infinite where it can be had no better.
        """
        nearest = edge.depths(places.detach()).amin(-1)
        lost = edge.missed(places.detach(), spot, ring, turning)
        whole = (nearest >= spot + _FEWEST_RINGS * ring) & (lost <= most)
        # Light of so few rings comes back with less than 1e-3 of what a spot on the sensor returns.
        beside = nearest <= -(spot + _FEWEST_RINGS * ring)
        missed = lost[whole]
        share = torch.where(whole, 1.0, torch.where(beside, 0.0, edge.share(places, spot + ring)))
        return cls(whole, beside, share, float(missed.max()) if len(missed) else 0.0)


def _between(u: torch.Tensor, low: float, high: float) -> torch.Tensor:
    padded, step = widened(u.double())
    twice = ((padded - low).clamp_min(0) ** 2 - (padded - high).clamp_min(0) ** 2) / 2
    return second_derivative(twice[..., None], step)[..., 0]
