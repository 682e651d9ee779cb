"""How quantities are written in figures and pages."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["Look", "look"]


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
        scaled = self.scale * value
        return f"{scaled:.3f}" if scaled < 10 else f"{scaled:.1f}"


_LOOKS = {
    "gaze_x": Look("gaze x", "fraction of the field"),
    "gaze_y": Look("gaze y", "fraction of the field"),
    "object_distance": Look("object distance $x_d$", "m"),
    "focal_length": Look("focal length $f_t$", "mm", 1e3),
}


def look(quantity: str) -> Look:
    """Return how a quantity is written; an unknown one by its own name, in its own unit."""
    return _LOOKS.get(quantity, Look(quantity.replace("_", " "), ""))
