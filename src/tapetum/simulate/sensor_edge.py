"""The edge of the target's sensor, beyond which nothing returns: which spots it cuts, and by how much."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch

from tapetum.bench import TargetSensor

__all__ = ["EdgeRule", "SensorEdge", "Spots"]

EdgeRule = Literal["exact", "dimmed"]

# Share of the returning amplitude that an edge N rings λz/2r away removes from a focused spot, times N: the light of an
# Airy pattern beyond a straight line, 2/(π³N). The irradiance changes by at most twice that.
_MISSED = 4 / math.pi**3
# Rings from an edge within which a spot counts as cut, on the sensor and beside it: farther beside it less than 2e-3 of
# the amplitude, 4e-6 of the irradiance, returns.
_FEWEST_RINGS, _FAR_BESIDE = 2.0, 30.0


@dataclass(frozen=True)
class SpotLight:
    """The light of a spot on a sensor.

    `spot` is its geometric radius and `ring` the width λz/2r of its rings, in metres; `wavenumber`, `image_distance`
    and `radius` are k, z and the lens's radius; `orders` [M, 3] hold each order's amplitude (modulus) and direction
    sines.
    """

    spot: float
    ring: float
    wavenumber: float
    image_distance: float
    radius: float
    orders: torch.Tensor


@dataclass(frozen=True)
class SensorEdge:
    """A sensor's rectangle, in metres from the lens's axis."""

    left: float
    right: float
    top: float
    bottom: float

    @classmethod
    def of(cls, sensor: TargetSensor) -> SensorEdge:
        """The rectangle of a target's sensor, off the lens's axis where it is decentred."""
        (columns, rows), (x, y) = sensor.pixels, sensor.decentre
        across, down = columns * sensor.pitch / 2, rows * sensor.pitch / 2
        return cls(-across - x, across - x, -down - y, down - y)

    def depths(self, places: torch.Tensor) -> torch.Tensor:
        """Distances [B, 4] of places [B, 2] inside the four edges, negative outside, in metres."""
        x, y = places[:, 0], places[:, 1]
        return torch.stack([x - self.left, self.right - x, y - self.top, self.bottom - y], -1)

    def missed(self, places: torch.Tensor, light: SpotLight) -> torch.Tensor:
        """Largest change [B] of the picture, over its peak, by edges beside a spot, for places [B, 2] of its middle.

        The faint light at an edge comes from the pupil's rim on either side, returns to the rim, and its phase varies
        quickly along the sensor, so that it mostly cancels. It does not cancel where an order sends it back to its
        origin on the rim, or to the opposite rim.
        """
        beyond = (self.depths(places) - light.spot).clamp_min(light.ring)
        sides = torch.tensor([self.left, self.right, self.top, self.bottom], dtype=places.dtype, device=places.device)
        z, r, k = light.image_distance, light.radius, light.wavenumber
        sizes, directions = light.orders.to(places)[:, 0], light.orders.to(places)[:, 1:]
        # Orders that meet the lens again.
        away = ((2 * places[:, None, :] / z + directions) ** 2).sum(-1).sqrt()
        brightest = (sizes * (1 - away * z / (2 * r)).clamp_min(1e-3)).amax(-1)
        slopes = 2 * sides / z + directions[:, [0, 0, 1, 1]]
        adds_up = torch.zeros_like(beyond)
        for rims, weight in ((0.0, 1.0), (2 * r / z, 0.5), (-2 * r / z, 0.5)):
            turned = (k * (slopes + rims).abs() * beyond[:, None, :]).clamp_min(1.0)
            adds_up = adds_up + weight * (sizes[:, None] / turned).sum(1)
        return (_MISSED * light.ring / beyond * adds_up).sum(-1) / brightest

    def share(self, places: torch.Tensor, spot: float) -> torch.Tensor:
        """Share of an even round spot that the sensor holds, by rays: [B]."""
        # A corner counts as both of its edges separately.
        along = (self.depths(places) / max(spot, 1e-9)).clamp(-1, 1)
        held = 0.5 + (along * torch.sqrt(1 - along**2) + torch.asin(along)) / math.pi
        return held.prod(-1)

    @property
    def window(self) -> tuple[float, float, float, float]:
        """Left, right, upper and lower edge in metres, as `sensor_plane.reflectance_at` takes them."""
        return self.left, self.right, self.top, self.bottom


@dataclass(frozen=True)
class Spots:
    """How the sensor holds the spots of some gazes.

    `whole` and `beside` [B] mark spots wholly on the sensor and wholly off it; all others are cut. `share` [B] is the
    part of each spot on the sensor, by rays; differentiable. `missed` is the largest change by edges of the pictures of
    whole spots, over their peaks.
    """

    whole: torch.Tensor
    beside: torch.Tensor
    share: torch.Tensor
    missed: float

    @classmethod
    def of(cls, edge: SensorEdge, places: torch.Tensor, light: SpotLight, most: float) -> Spots:
        """Sort spots at places [B, 2] by their position against the edge.

        A whole spot may miss up to `most` of the picture's peak; infinite where no better method is available.
        """
        nearest = edge.depths(places.detach()).amin(-1)
        lost, spot, ring = edge.missed(places.detach(), light), light.spot, light.ring
        whole = (nearest >= spot + _FEWEST_RINGS * ring) & (lost <= most)
        beside = nearest <= -(spot + _FAR_BESIDE * ring)
        missed = lost[whole]
        share = torch.where(whole, 1.0, torch.where(beside, 0.0, edge.share(places, spot + ring)))
        return cls(whole, beside, share, float(missed.max()) if len(missed) else 0.0)
