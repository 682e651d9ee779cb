"""How a probe's light spreads on its way to a target. To add a mode, write its class here and name it in `MODES`."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

__all__ = ["MODES", "Collimated", "Diverging", "FixedArea", "ModeName"]

ModeName = Literal["collimated", "diverging", "fixed_area"]
"""What `illumination.mode` may be."""


class Collimated:
    """A plane wave of `diameter`, or as wide as the probe's aperture.

    Attributes
    ----------
    takes, needs
        Which of the fields `divergence` and `diameter` have a meaning, and which must be given, with an example.
    spherical
        Whether the wave comes from a point at the probe: its curvature is 1/distance.
    spreads
        Whether the lit disc grows with the distance: its irradiance falls as 1/distance².
    """

    takes: ClassVar[tuple[str, ...]] = ("diameter",)
    needs: ClassVar[dict[str, str]] = {}
    spherical: ClassVar[bool] = False
    spreads: ClassVar[bool] = False

    @staticmethod
    def radius(divergence: float | None, diameter: float | None, distance: float, aperture_radius: float) -> float:
        """Radius of the lit disc at a distance from the probe, in metres (angles in radians)."""
        return aperture_radius if diameter is None else diameter / 2


class Diverging(Collimated):
    """A spherical wave from the probe with a full angle `divergence`."""

    takes = ("divergence",)
    needs: ClassVar[dict[str, str]] = {"divergence": "0.5 deg"}
    spherical = spreads = True

    @staticmethod
    def radius(divergence: float | None, diameter: float | None, distance: float, aperture_radius: float) -> float:
        """Radius of the cone at a distance from its tip, in metres."""
        assert divergence is not None
        return distance * math.tan(divergence / 2)


class FixedArea(Collimated):
    """A spherical wave from the probe that fills `diameter` at any distance."""

    needs: ClassVar[dict[str, str]] = {"diameter": "50 mm"}
    spherical = True


MODES: dict[str, type[Collimated]] = {"collimated": Collimated, "diverging": Diverging, "fixed_area": FixedArea}
