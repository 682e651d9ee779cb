"""How a scene shows itself: in one line, and as a sketch of the bench."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tapetum.bench.scene import Scene

__all__ = ["in_words", "sketch"]


def in_words(scene: Scene) -> str:
    """Return what a scene is, in a line."""
    light = scene.illumination
    return (
        f"{_target(scene)}, {scene.distance:g} m from the probe, focused at {scene.target.object_distance:g} m;"
        f" {light.mode} light of {light.wavelength * 1e9:g} nm, {light.power * 1e3:g} mW"
    )


def _target(scene: Scene) -> str:
    target: Any = scene.target
    if target.kind == "phone":
        return f"{target.name}{', ' + target.camera if target.camera else ''}"
    lens = target.lens
    if lens.kind == "thin":
        stop = lens.focal_length / (2 * lens.aperture_radius)
        return f"thin lens f = {lens.focal_length * 1e3:g} mm, f/{stop:.3g}"
    length = f" at {lens.focal_length * 1e3:g} mm" if lens.focal_length else ""
    return f"lens {lens.name}{length}"


def sketch(scene: Scene) -> Figure:
    """Draw the bench from the side, heights not to scale: probe, target, and where the target is focused.

    Returns
    -------
    matplotlib.figure.Figure
        It belongs to no window.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 2.2), layout="constrained")
    axis = figure.add_subplot()
    focus = scene.target.object_distance
    axis.plot([0, 0], [-1, 1], color="C0", linewidth=4, solid_capstyle="butt")
    axis.plot([scene.distance] * 2, [-0.5, 0.5], color="C1", linewidth=4, solid_capstyle="butt")
    axis.plot([0, scene.distance], [0, 0], color="0.6", linewidth=1)
    diameter = 2e3 * scene.probe.lens.aperture_radius
    axis.annotate(f"probe\n{diameter:g} mm wide", (0, 1), (0, 3), textcoords="offset points", ha="center")
    axis.annotate(_target(scene), (scene.distance, 0.5), (0, 3), textcoords="offset points", ha="center")
    if math.isfinite(focus) and focus != scene.distance:
        # Distances of the target's focus count from the target.
        axis.plot([scene.distance - focus], [0], "x", color="C1")
        axis.annotate("its focus", (scene.distance - focus, 0), (0, -14), textcoords="offset points", ha="center")
    axis.set_ylim(-1.6, 2.2)
    axis.margins(x=0.2)
    axis.set_yticks([])
    axis.set_xlabel("distance from the probe, m")
    axis.spines[["left", "right", "top"]].set_visible(False)
    return figure
