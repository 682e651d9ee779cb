"""The backs of phones: where their cameras stand, and how wide each one opens."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.patches import Circle

from tapetum.bench import Phone
from tapetum.errors import InputError
from tapetum.report.figures._style import INK, MODELS, NOTE, QUIET, RULE, new_figure

__all__ = ["fig_phones"]

# Half of what each panel shows, in millimetres.
_HALF = 19.0


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
