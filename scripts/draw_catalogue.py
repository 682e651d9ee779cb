"""Draw the bundled lenses and phones for docs/lenses.md: docs/images/lenses.png and docs/images/phones.png.

.venv/bin/python scripts/draw_catalogue.py
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from tapetum.bench import Phone, PrescriptionLens, lens_names, load_lens, load_phone, phone_names
from tapetum.bench.zoom import focal_range
from tapetum.errors import InputError
from tapetum.optics.focus import FocusedLens
from tapetum.optics.rays import Lens, sag, to_plane, trace
from tapetum.report.figures import save_figure
from tapetum.report.figures._style import INK, MODELS, NOTE, QUIET, RULE, new_figure

# Focal lengths, in metres, at which zooms are drawn.
ZOOMS = {"zoom-5-15mm": (8e-3,), "zoom-18-140mm": (50e-3, 135e-3)}
IMAGES = Path(__file__).parents[1] / "docs" / "images"
_WAVELENGTH = 587.56e-9
_RAYS = 5
# Of the half field.
_FIELDS = (0.0, 0.6, 0.95)
_GLASS = "#dbe7f0"
# Half of what each panel shows, in millimetres.
_HALF = 19.0


def fig_lenses(lenses: Sequence[PrescriptionLens], *, columns: int = 3) -> Figure:
    """One panel a lens, focused at infinity, each at a scale of its own.

    Parameters
    ----------
    lenses
        One to sixteen.
    columns
        Panels side by side.

    Raises
    ------
    InputError
        When there are none or too many.
    """
    if not 1 <= len(lenses) <= 16:
        raise InputError(f"has {len(lenses)} entries", where="lenses", remedy="give one to sixteen")
    rows = math.ceil(len(lenses) / columns)
    figure = new_figure(3.4 * columns, 2.5 * rows)
    for k, lens in enumerate(lenses):
        ax = figure.add_subplot(rows, columns, k + 1)
        draw_lens(ax, lens)
        number = lens.focal_length / (2 * lens.aperture_radius)
        title = f"{lens.name}: {lens.focal_length * 1e3:.3g} mm f/{number:.2g}"
        ax.set_title(title, fontsize=NOTE, color=INK, loc="left")
    return figure


def draw_lens(ax: Axes, lens: PrescriptionLens) -> None:
    """Glass, stop, sensor and the rays of three fields, in millimetres."""
    focused = lens.focused(_WAVELENGTH, math.inf)
    section = focused.lens
    index = section.index.tolist()
    profiles = [_profile(section, i) for i in range(len(section))]
    for i, (z, y) in enumerate(profiles):
        if index[i + 1] != 1.0 and i + 1 < len(section):
            far_z, far_y = profiles[i + 1]
            ax.fill(np.r_[z, far_z[::-1]], np.r_[y, far_y[::-1]], facecolor=_GLASS, edgecolor=INK, linewidth=0.6)
    stop_z, stop_y = profiles[section.stop]
    reach = max(float(np.abs(y).max()) for _, y in profiles)
    for side in (-1, 1):
        rim = side * float(np.abs(stop_y).max())
        ax.plot([stop_z[0], stop_z[-1]], [rim, rim + 0.15 * side * reach], color=INK, linewidth=1.6)
    half_field, highest = _half_field(lens), 0.0
    for colour, share in zip(MODELS, _FIELDS, strict=False):
        for z, y in _ray_paths(focused, share * half_field):
            ax.plot(z, y, color=colour, linewidth=0.6)
            highest = max(highest, abs(float(y[-1])))
    image = 1e3 * focused.image
    ax.plot([image, image], [-highest, highest], color=QUIET, linewidth=1.6)
    ax.set_aspect("equal", adjustable="datalim")
    ax.tick_params(labelsize=NOTE - 1, color=RULE, labelcolor=QUIET, length=2)
    for spine in ax.spines.values():
        spine.set_color(RULE)


def _half_field(lens: PrescriptionLens) -> float:
    """In radians; a zoom covers a picture of one size."""
    prescription = load_lens(lens.name)
    widest = prescription.states[0].half_field or math.radians(10)
    if len(prescription.states) == 1:
        return widest
    return math.atan(math.tan(widest) * focal_range(prescription, lens.design_wavelength)[0] / lens.focal_length)


def _profile(lens: Lens, i: int) -> tuple[np.ndarray, np.ndarray]:
    """z and y of a surface's section, in millimetres."""
    y = torch.linspace(-1, 1, 61, dtype=torch.float64) * lens.semi_diameter[i]
    z = lens.z[i] + sag(lens, i, y**2)[0]
    return 1e3 * z.numpy(), 1e3 * y.numpy()


def _ray_paths(focused: FocusedLens, angle: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Some of the rays of a field that reach the sensor, evenly over what gets through."""
    lens = focused.lens
    height = torch.linspace(-3, 3, 601, dtype=torch.float64) * focused.entrance_radius
    zero = torch.zeros_like(height)
    position = torch.stack([zero, height, zero + focused.entrance_pupil], -1)
    direction = torch.stack([zero, zero + math.sin(angle), zero + math.cos(angle)], -1)
    rays = trace(lens, position, direction)
    passed = torch.nonzero(rays.good & (rays.height <= 1).all(-1)).flatten()
    if len(passed) == 0:
        return []
    chosen = passed[torch.linspace(0, len(passed) - 1, _RAYS).round().long()]
    position, direction = position[chosen], direction[chosen]
    before = -0.12 * focused.image
    points = [to_plane(position, direction, before)[0]]
    for k in range(1, len(lens) + 1):
        rays = trace(_front(lens, k), position, direction)
        points.append(rays.position)
    points.append(to_plane(rays.position, rays.direction, focused.image)[0])
    way = 1e3 * torch.stack(points).numpy()
    return [(way[:, j, 2], way[:, j, 1]) for j in range(way.shape[1])]


def _front(lens: Lens, count: int) -> Lens:
    """Its first surfaces only."""
    first = {name: getattr(lens, name)[:count] for name in ("z", "curvature", "conic", "asphere", "semi_diameter")}
    return replace(lens, **first, index=lens.index[: count + 1])


def fig_phones(phones: Sequence[Phone], *, columns: int = 4) -> Figure:
    """One panel a phone, all at one scale: rims of the front lenses, entrance pupils, and the dot projector.

    Parameters
    ----------
    phones
        One to twenty.
    columns
        Panels side by side.

    Raises
    ------
    InputError
        When there are none or too many.
    """
    if not 1 <= len(phones) <= 20:
        raise InputError(f"has {len(phones)} entries", where="phones", remedy="give one to twenty")
    figure = new_figure(2.5 * columns, 2.6 * math.ceil(len(phones) / columns), pictures=True)
    for k, phone in enumerate(phones):
        ax = figure.add_subplot(math.ceil(len(phones) / columns), columns, k + 1)
        for camera in phone.cameras:
            x, y = (1e3 * place for place in camera.position)
            lens = camera.lens.focused(camera.lens.design_wavelength, math.inf).lens
            rim = 1e3 * float(lens.semi_diameter.max())
            ax.add_patch(Circle((x, y), rim, facecolor="#eef1f4", edgecolor=INK, linewidth=0.8))
            ax.add_patch(Circle((x, y), 1e3 * camera.lens.aperture_radius, color=MODELS[0]))
            said = f"{camera.name} {1e3 * camera.lens.focal_length:.2g}"
            ax.text(x, y + rim + 1.9, said, fontsize=NOTE - 1.5, color=QUIET, ha="center", va="center")
        if phone.dots is not None:
            x, y = (1e3 * place for place in phone.dots.position)
            ax.plot([x], [y], marker="s", markersize=5, color=MODELS[1])
            ax.text(x, y + 2.4, "dots", fontsize=NOTE - 1.5, color=QUIET, ha="center", va="center")
        ax.set_xlim(-_HALF, _HALF)
        ax.set_ylim(_HALF, -_HALF)
        ax.set_aspect("equal")
        ax.set_xticks([])
        ax.set_yticks([])
        for spine in ax.spines.values():
            spine.set_color(RULE)
        ax.set_title(phone.name, fontsize=NOTE, color=INK, loc="left")
    return figure


def main() -> None:
    lenses = [PrescriptionLens(name) for name in lens_names() if name not in ZOOMS]
    lenses += [PrescriptionLens(name, focal_length=f) for name, lengths in ZOOMS.items() for f in lengths]
    save_figure(fig_lenses(lenses), IMAGES / "lenses.png", dpi=110)
    save_figure(fig_phones([load_phone(name) for name in phone_names()]), IMAGES / "phones.png", dpi=90)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    main()
