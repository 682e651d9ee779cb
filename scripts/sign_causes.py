"""What breaks the point symmetry of a retro-reflection, and how much of the gaze's sign each such thing tells."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from matplotlib.colors import TwoSlopeNorm
from matplotlib.figure import Figure

from tapetum.bench import Scene, load_scene, with_values
from tapetum.report.figures._style import INK, NOTE, TITLE, new_figure
from tapetum.simulate import Camera, sign_dprime, tilt_of_gaze
from tapetum.simulate.gaze import largest_sine
from tapetum.simulate.hypotheses import point_of_symmetry
from tapetum.simulate.radiometry import electrons

__all__ = [
    "ANGLES",
    "Cause",
    "Row",
    "Target",
    "by_direction",
    "direction_table",
    "fig_sign_causes",
    "markdown",
    "phone_target",
    "sign_causes",
    "sloped_scene",
    "thin_target",
]

# d' from which a cause counts as telling the sign: right in 93 of 100 frames.
TELLS = 3.0

ANGLES = (0.0, 22.5, 45.0, 67.5, 90.0)
"""Degrees from the direction in which a tilted sensor slopes."""
_OUT = 0.4  # of the field, from the point of symmetry


@dataclass(frozen=True)
class Cause:
    """One thing that breaks the symmetry: its name, its size in words and where that comes from, the scene's values.

    With `about_symmetry` gazes and their opposites lie about the point of symmetry in place of the field's middle.
    """

    name: str
    size: str
    source: str
    values: dict[str, Any] = field(default_factory=dict[str, Any])
    about_symmetry: bool = False


@dataclass(frozen=True)
class Target:
    """A scene as symmetric as can be, gazes [N, 2] to test it at, how well to simulate it, and what breaks it."""

    scene: Scene
    gazes: torch.Tensor
    accuracy: float
    causes: tuple[Cause, ...]


@dataclass(frozen=True)
class Row:
    """d' [N] of one cause."""

    cause: Cause
    dprime: torch.Tensor

    @property
    def median(self) -> float:
        """Of d' over the gazes: of an even number the mean of the middle two."""
        return float(self.dprime.quantile(0.5))

    @property
    def telling(self) -> float:
        """Share of the gazes with d' above 3."""
        return float((self.dprime > TELLS).double().mean())


# About half of the largest values that makers of machine-vision cameras give (sources: docs/sign.md).
_TILT, _DECENTRE = ["0.2 deg", "-0.27 deg"], ["0.12 mm", "-0.1 mm"]
_TILTED, _DECENTRED = "0.2° and -0.27°", "0.12 mm and -0.1 mm"
_ALIGNED = "half of a maker's largest: 40 um over the sensor, 0.16 to 0.63° [1]"
_CENTRED = "half of two makers' largest: ±0.25 mm [1, 2]"
_BEAM = {"illumination.second_beam": {"ratio": 0.1, "angle": ["0.9 mrad", "0.4 mrad"]}}


def thin_target() -> Target:
    """The demo's thin lens without its second beam."""
    scene = with_values(load_scene("hand-held"), {"illumination.second_beam": None})
    gazes = [[0.1, 0.05], [0.2, 0.1], [-0.1, 0.2], [0.05, -0.3], [0.3, -0.2], [0.35, 0.1]]
    causes = _causes("2.2 um", "2.0e-5", "6.6 um", "R = f = 100 mm", "4 m")
    return Target(scene, torch.tensor(gazes, dtype=torch.float64), 3e-3, causes)


def phone_target() -> Target:
    """A phone's lens, 4.06 mm f/2.3, before the probe of the scene `rotation`; head-on its spot has 3000 electrons."""
    values = {
        "target.lens": {"kind": "prescription", "name": "phone-f", "design_wavelength": "640 nm"},
        "target.sensor": {"reflectance": 0.1, "pixels": [1600, 1200], "pitch": "2 um"},
        "illumination.second_beam": None,
    }
    scene = with_values(load_scene("rotation"), values)
    peak = float(electrons(Camera(scene, 1e-6)(torch.zeros(1, 2).double()), scene.probe.sensor, 640e-9).max())
    scene = with_values(scene, {"illumination.power": scene.illumination.power * 3000 / peak})
    gazes = [[0.02, 0.03], [0.05, 0.02], [-0.04, 0.08], [0.08, -0.06]]
    return Target(
        scene, torch.tensor(gazes, dtype=torch.float64), 1e-2, _causes("2 um", "6.7e-4", "4.4 um", "R = 3 mm", "1 m")
    )


def _causes(pitch: str, shift: str, focal: str, exit_pupil: str, focus: str) -> tuple[Cause, ...]:
    sensor = "target.sensor."
    array = {sensor + "array": {"pitch": pitch, "fill": 0.5, "surround": 0.3}}
    lenses = array | {sensor + "microlens": {"focal_length": focal, "fill": 0.95}}
    shifted = array | {sensor + "microlens": {"focal_length": focal, "fill": 0.95, "shift": float(shift)}}
    diffuse = {sensor + "diffuse": {"albedo": 0.02, "spread": "5 um"}}
    clipped = {"probe.lens.aperture_radius": "2 mm", "sampling.propagation": "finite"}
    tilt, decentre = {sensor + "tilt": _TILT}, {sensor + "decentre": _DECENTRE}
    everything = _BEAM | shifted | diffuse | clipped | tilt | decentre
    return (
        Cause("nothing", "a perfect lens and a flat mirror", "the finite Fresnel number alone"),
        Cause("second beam", "10 % at (0.9, 0.4) mrad", "assumed, as in every scene here", _BEAM),
        Cause("pixel array", f"{pitch}, fill 0.5, surround 0.3", "assumed", array),
        Cause("array and microlenses", f"f = {focal}, 0.95 of the pitch", "assumed", lenses),
        Cause("the same, microlenses shifted", f"{shift} of the height", f"gap 3 um, n = 1.5, {exit_pupil}", shifted),
        Cause("diffuse return", "albedo 0.02, spread 5 um", "assumed", diffuse),
        Cause("probe vignetting", "aperture radius 2 mm", "assumed", clipped),
        Cause("out of focus", f"focused at {focus}, not 5.5 m", "assumed", {"target.object_distance": focus}),
        Cause("sensor tilt", _TILTED, _ALIGNED, tilt),
        Cause("the same, about its point of symmetry", _TILTED, _ALIGNED, tilt, True),
        Cause("lens decentre", _DECENTRED, _CENTRED, decentre),
        Cause("the same, about its point of symmetry", _DECENTRED, _CENTRED, decentre, True),
        Cause("all but the focus", "as above", "", everything),
    )


def sign_causes(target: Target) -> Iterator[Row]:
    """d' of each gaze against its opposite, cause after cause."""
    for cause in target.causes:
        scene = with_values(target.scene, cause.values)
        centre = point_of_symmetry(scene) if cause.about_symmetry else torch.zeros(2, dtype=torch.float64)
        found = sign_dprime(scene, target.gazes + centre, accuracy=target.accuracy, centre=centre)
        yield Row(cause, found)


def markdown(rows: Sequence[Row]) -> str:
    """The table of the docs' page."""
    lines = [
        "| what breaks the symmetry | size | where the size comes from | median d′ | d′ > 3 |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        one = row.cause
        lines.append(f"| {one.name} | {one.size} | {one.source} | {row.median:.3g} | {100 * row.telling:.0f} % |")
    return "\n".join(lines) + "\n"


def sloped_scene(values: dict[str, Any] | None = None) -> Scene:
    """Return the scene `rotation` with a short zoom of F/3 or so and a tilted sensor of no photosites, with changes.

    Photosites would change the picture with their place under the spot, which is no part of the question here.
    """
    lens = {"target.lens.name": "zoom-5-15mm", "target.lens.focal_length": "8 mm"}
    sensor = {"target.sensor.array": None, "target.sensor.tilt": _TILT}
    return with_values(load_scene("rotation"), lens | sensor | (values or {}))


def by_direction(
    scene: Scene, slope: tuple[float, float], accuracy: float, angles: Sequence[float] = ANGLES
) -> torch.Tensor:
    """d' [N] of gazes at angles [N] (degrees) from a slope's direction against their opposites, about the point of
    symmetry."""
    turned = torch.deg2rad(torch.tensor(angles, dtype=torch.float64)) + math.atan2(slope[1], slope[0])
    centre = point_of_symmetry(scene)
    gazes = centre + _OUT * torch.stack([turned.cos(), turned.sin()], 1)
    return sign_dprime(scene, gazes, accuracy=accuracy, centre=centre)


def direction_table(columns: dict[str, torch.Tensor]) -> str:
    """The table of the docs' page: a row an angle, a column a sensor."""
    lines = [f"| angle to the slope | {' | '.join(columns)} |", "|--:|" + "--:|" * len(columns)]
    for k, angle in enumerate(ANGLES):
        lines.append(f"| {angle:g}° | {' | '.join(f'{float(one[k]):.3g}' for one in columns.values())} |")
    return "\n".join(lines) + "\n"


def fig_sign_causes(target: Target, names: Sequence[str], gaze: int = 1, half: int = 60) -> Figure:
    """The picture at a gaze, at its opposite, the latter turned by half a turn, and the difference that tells the sign.

    Parameters
    ----------
    target
        What to draw.
    names
        Of the causes, one row each.
    gaze
        Which of the target's gazes.
    half
        Half the side of what is shown, in pixels of the probe.
    """
    causes = [next(one for one in target.causes if one.name == name) for name in names]
    figure = new_figure(7.6, 1.95 * len(causes), pictures=True)
    axes = figure.subplots(len(causes), 4, squeeze=False)
    one = target.gazes[gaze]
    for i, (cause, row) in enumerate(zip(causes, axes, strict=True)):
        plus, minus = _pictures(
            with_values(target.scene, cause.values), torch.stack([one, -one]), target.accuracy, half
        )
        peak = float(torch.maximum(plus.max(), minus.max()))
        part = (plus - minus) / peak
        most = max(float(part.abs().max()), 1e-12)
        shown = (plus / peak).sqrt(), (minus / peak).sqrt(), (minus.flip(0, 1) / peak).sqrt(), part
        titles = "+gaze", "−gaze", "−gaze, turned by 180°", "+gaze less −gaze"
        for j, (ax, picture) in enumerate(zip(row, shown, strict=True)):
            last = j == 3
            norm = TwoSlopeNorm(0.0, -most, most) if last else None
            options: dict[str, Any] = (
                {"cmap": "RdBu_r", "norm": norm} if last else {"cmap": "gray", "vmin": 0, "vmax": 1}
            )
            ax.imshow(picture.numpy(), interpolation="nearest", **options)
            ax.set_xticks([])
            ax.set_yticks([])
            if i == 0:
                ax.set_title(titles[j], fontsize=TITLE - 1, color=INK)
            if last:
                ax.set_xlabel(f"up to {100 * most:.2g} % of the peak", fontsize=NOTE)
        row[0].set_ylabel(cause.name, fontsize=NOTE)
    return figure


def _pictures(scene: Scene, gazes: torch.Tensor, accuracy: float, half: int) -> torch.Tensor:
    """Irradiance [B, n, n] about the RRs' centres of light, as the test lays them on each other."""
    sines = tilt_of_gaze(scene, gazes)
    side = 2 * half + 1
    output = replace(Camera(scene, largest_sine(sines)).output, rows=side, columns=side)
    camera = Camera(scene, largest_sine(sines), accuracy=accuracy, output=output)
    light, place = camera(sines).double(), output.x()
    total = light.sum((1, 2))
    middle = torch.stack([(light.sum(1) @ place) / total, (light.sum(2) @ place) / total], -1)
    return camera(sines, -middle).double()
