"""Paraxial numbers of a lens: focal length, pupils, F-number."""

from __future__ import annotations

from dataclasses import dataclass

from tapetum.optics.rays import Lens

__all__ = ["Paraxial", "paraxial"]


@dataclass(frozen=True)
class Paraxial:
    """Cardinal numbers of a lens in air, in metres; z as in the lens.

    Parameters
    ----------
    focal_length
        Effective focal length, infinite for an afocal lens.
    focus
        z of the image of an object at infinity.
    entrance_pupil, exit_pupil
        z of the two images of the stop; infinite where the lens is telecentric on that side.
    entrance_radius
        Radius of the stop's image in object space.
    """

    focal_length: float
    focus: float
    entrance_pupil: float
    exit_pupil: float
    entrance_radius: float

    @property
    def f_number(self) -> float:
        """Focal length over the paraxial entrance pupil's diameter."""
        return self.focal_length / (2 * self.entrance_radius)


def paraxial(lens: Lens) -> Paraxial:
    """Follow two paraxial rays: one parallel to the axis, one through the middle of the stop."""
    n, z = [float(v) for v in lens.index], [float(v) for v in lens.z]
    power = [(n[i + 1] - n[i]) * float(lens.curvature[i] + 2 * lens.asphere[i, 0]) for i in range(len(lens))]

    def forward(y: float, u: float, first: int, last: int) -> tuple[float, float]:
        """Height and reduced angle n u behind the surface `last - 1`, from before the surface `first`."""
        for i in range(first, last):
            u = u - y * power[i]
            if i + 1 < last:
                y = y + u / n[i + 1] * (z[i + 1] - z[i])
        return y, u

    y, u = forward(1.0, 0.0, 0, len(lens))
    focal = -1 / u if u != 0 else float("inf")
    focus = z[-1] - y / u if u != 0 else float("inf")
    # From the stop's middle towards both sides.
    s = lens.stop
    y_out, u_out = forward(0.0, 1.0, s, len(lens))
    exit_pupil = z[-1] - y_out / u_out if u_out != 0 else float("inf")
    # The same light traced backwards.
    y_in, u_in = 0.0, 1.0
    for i in range(s - 1, -1, -1):
        y_in = y_in - u_in / n[i + 1] * (z[i + 1] - z[i])
        u_in = u_in + y_in * power[i]
    entrance = z[0] - y_in / u_in if u_in != 0 else float("inf")
    # The parallel ray's height at the stop scales the entrance pupil.
    height = 1.0
    if s > 0:
        y, u = 1.0, 0.0
        for i in range(s):
            u = u - y * power[i]
            y = y + u / n[i + 1] * (z[i + 1] - z[i])
        height = y
    radius = float(lens.semi_diameter[s]) / abs(height) if height != 0 else float("inf")
    return Paraxial(focal, focus, entrance, exit_pupil, radius)
