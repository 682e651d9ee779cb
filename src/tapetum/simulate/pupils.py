"""What the sampled pass asks of a lens: its light on the way in and on the way out, as seen from the spot.

Directions are sines or slopes of rays from the pupil's samples to the spot's middle u0, in a frame of columns and rows
on the sensor: the sensor's own, or one turned for a mirror, which looks the same from all sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch

from tapetum.simulate.probe_path import ProbePath
from tapetum.simulate.spot_window import RimLight

__all__ = ["Entering", "Gazes", "Leaving", "Pupil"]


@dataclass(frozen=True)
class Entering:
    """Light that meets the spot; the batch is 1 where it does not depend on the gaze.

    Parameters
    ----------
    columns, rows
        Directions [B or 1, n] and [B or 1, m] of the samples.
    strength
        Amplitude for 1 W/m² times a sample's solid angle, [B or 1, m, n].
    path
        Ψ there, in metres.
    mirrored
        Whether the columns, and whether the rows, are those on one side of the middle, from it outwards, for equal
        light on both sides; a sample in the middle itself has half its strength.
    """

    columns: torch.Tensor
    rows: torch.Tensor
    strength: torch.Tensor
    path: torch.Tensor
    mirrored: tuple[bool, bool] = (False, False)


@dataclass(frozen=True)
class Leaving:
    """The pupil on the way out.

    Parameters
    ----------
    columns, rows
        Directions [B or 1, n] and [B or 1, m] in which to compute the returning light.
    wave
        What multiplies it where it leaves, complex [B or 1, rows, columns].
    x, y
        Columns and rows of the entrance pupil, in metres.
    read_at
        Where between `columns`, and where between `rows`, which are equally spaced then, each sample of the pupil lies,
        counted in them from 0, [B, rows, columns]; None where the samples are at `columns` and `rows` themselves.
    mirrored
        Whether light returns equally on both sides of the middle column, so that the columns may be those on one side.
    length
        N where columns and rows are λ/(N Δ) apart, Δ being the spot's step: they are then found by fast transforms.
    """

    columns: torch.Tensor
    rows: torch.Tensor
    wave: torch.Tensor
    x: torch.Tensor
    y: torch.Tensor
    read_at: tuple[torch.Tensor, torch.Tensor] | None = None
    mirrored: bool = False
    length: int | None = None


class Gazes(Protocol):
    """A pupil seen under a batch of tilts."""

    @property
    def axes(self) -> torch.Tensor:
        """Rotations [B, 2, 2] from the sensor's x and y to the frame's columns and rows."""
        ...

    @property
    def place(self) -> torch.Tensor:
        """Middles u0 [B, 2] of the spots, in metres from the optical axis, along the sensor's own x and y."""
        ...

    @property
    def turn(self) -> torch.Tensor:
        """Directions t [B, 2] in the frame that are left out of the samples' on either way."""
        ...

    @property
    def middle(self) -> torch.Tensor:
        """Directions [B, 2] in the frame of the pupil's middle."""
        ...

    @property
    def bend(self) -> torch.Tensor:
        """C of both ways, in 1/m, [1]."""
        ...

    def entering(self) -> Entering:
        """The light on its way in."""
        ...

    def leaving(self) -> Leaving:
        """The pupil on the way out."""
        ...

    def to_probe(
        self,
        field: torch.Tensor,
        x: torch.Tensor,
        y: torch.Tensor,
        centres: torch.Tensor | None,
        *,
        squared: bool = False,
    ) -> torch.Tensor:
        """Field on the probe's pixels [B, H, W] of what leaves, at columns x and rows y; or its absolute square."""
        ...


class Pupil(Protocol):
    """A lens, and the way from it to the probe's pixels."""

    @property
    def path(self) -> ProbePath:
        """From the lens to the pixels."""
        ...

    @property
    def fixed(self) -> bool:
        """Whether spot and directions are the same for all gazes."""
        ...

    @property
    def rim(self) -> RimLight | None:
        """Where a mirror's light beyond the window is added to it (`SpotWindow`)."""
        ...

    def meets(self, farthest: float) -> float:
        """Distance of an order's direction from the pupil's within which it returns light from up to `farthest` metres
        of the spot's middle; infinite where the samples hold all light that misses the pupil."""
        ...

    def returns(self, sines: torch.Tensor) -> torch.Tensor:
        """Whether anything returns from tilts [B, 2]."""
        ...

    def foreshortens(self, sines: torch.Tensor) -> torch.Tensor:
        """Which tilts [B, 2] are drawn in another way than the others, and so not together with them."""
        ...

    def gazes(self, sines: torch.Tensor, own: bool, roll: torch.Tensor | None = None) -> Gazes:
        """Itself under tilts [B, 2], in the sensor's `own` columns and rows or in those that suit it.

        `roll` [B] turns the lens and what is behind it about the optical axis, in radians from x to y; only traced
        lenses take it.
        """
        ...
