"""How quantities are written in figures and pages."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["Look", "look", "written"]


def written(value: float) -> str:
    """Write a number with three decimals; a small one with two digits, a large one with one decimal."""
    if 0 < abs(value) < 0.01:
        return f"{value:.{1 - math.floor(math.log10(abs(value)))}f}"
    return f"{value:.3f}" if value < 10 else f"{value:.1f}"


class Look(NamedTuple):
    """How a quantity is written in figures and pages: its name, its unit, and the factor on its SI value."""

    name: str
    unit: str
    scale: float = 1.0

    @property
    def label(self) -> str:
        """Name with unit."""
        return f"{self.name}, {self.unit}" if self.unit else self.name

    @property
    def plain(self) -> str:
        """Name without the formula that figures write."""
        return self.name.split(" $")[0]

    def shown(self, value: float | None) -> str:
        """Write a value in this unit; a dash where there is none."""
        if value is None:
            return "–"
        return written(self.scale * value)


_LOOKS = {
    "gaze_x": Look("gaze x", "fraction of the field"),
    "gaze_y": Look("gaze y", "fraction of the field"),
    "object_distance": Look("object distance $x_d$", "m"),
    "focal_length": Look("focal length $f_t$", "mm", 1e3),
}


def look(quantity: str) -> Look:
    """Return how a quantity is written; an unknown one by its own name, in its own unit."""
    return _LOOKS.get(quantity, Look(quantity.replace("_", " "), ""))
