"""What a probe sees of a phone whose camera app opens: the sensor's spot over the return of its filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from matplotlib.figure import Figure

from tapetum.bench import Scene, with_values
from tapetum.optics.grid import Grid
from tapetum.report.figures._style import INK, NOTE, TITLE, new_figure
from tapetum.simulate.phone import open_camera
from tapetum.simulate.radiometry import electrons

__all__ = ["Seen", "fig_flash", "flash", "flash_table"]


@dataclass(frozen=True)
class Seen:
    """Mean electrons [n, n] about a phone that images or not, in light of a wavelength; `ring`, of the spot, in pixels.

    The ring is the first dark one of the lens's aperture. No pixel is cut off at its full well.
    """

    wavelength: float
    imaging: bool
    electrons: torch.Tensor
    ring: float

    @property
    def inside(self) -> float:
        """Electrons within the ring."""
        n = len(self.electrons) // 2
        place = torch.arange(-n, n + 1, dtype=torch.float64)
        return float(self.electrons[torch.hypot(place[:, None], place[None, :]) < self.ring].sum())


def flash(scene: Scene, wavelengths: Sequence[float] = (785e-9, 640e-9), half: int = 75) -> list[Seen]:
    """The phone of a scene, head-on, imaging and not, in each light, without the probe's second beam."""
    found: list[Seen] = []
    pitch = scene.probe.sensor.pitch
    for wavelength in wavelengths:
        for imaging in (True, False):
            values = {"wavelength": wavelength, "target.imaging": imaging, "illumination.second_beam": None}
            one = with_values(scene, values)
            camera = open_camera(one, 1e-3, output=Grid(2 * half + 1, 2 * half + 1, pitch))
            light = camera(torch.zeros(1, 2, dtype=torch.float64))[0].double()
            ring = 0.61 * wavelength / one.target.lens.aperture_radius * one.probe.lens.focal_length / pitch
            found.append(Seen(wavelength, imaging, electrons(light, one.probe.sensor, wavelength), ring))
    return found


def flash_table(seen: Sequence[Seen]) -> str:
    """Peak and sum within the spot's ring, a line for each light."""
    lines = ["| light | camera app | peak, electrons | within the spot's first dark ring |", "|---|---|---|---|"]
    for one in seen:
        app = "open" if one.imaging else "closed"
        lines.append(f"| {one.wavelength * 1e9:.0f} nm | {app} | {float(one.electrons.max()):.3g} | {one.inside:.3g} |")
    return "\n".join(lines) + "\n"


def fig_flash(seen: Sequence[Seen]) -> Figure:
    """The pictures side by side, the root of each light on one scale."""
    figure = new_figure(2.0 * len(seen), 2.4, pictures=True)
    axes = figure.subplots(1, len(seen), squeeze=False)[0]
    for ax, one in zip(axes, seen, strict=True):
        peak = max(float(other.electrons.max()) for other in seen if other.wavelength == one.wavelength)
        ax.imshow((one.electrons / peak).clamp_min(0).sqrt().numpy(), cmap="gray", vmin=0, vmax=1)
        ax.set_xticks([])
        ax.set_yticks([])
        ax.set_title(f"{one.wavelength * 1e9:.0f} nm", fontsize=TITLE - 1, color=INK)
        ax.set_xlabel("app open" if one.imaging else "app closed", fontsize=NOTE)
    return figure
