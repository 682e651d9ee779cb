"""Figures of the sign of the gaze: its discriminability, and the models' shares of correct signs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import PercentFormatter
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.report.figures._style import INK, NOTE, QUIET, colour, dress, dress_bar, new_figure
from tapetum.report.metrics import wilson_interval

__all__ = ["SignRate", "fig_sign_map", "fig_sign_rates"]


@dataclass(frozen=True)
class SignRate:
    """Share of frames in which a model got the sign of the gaze right.

    Parameters
    ----------
    model
        Its name.
    second_beam
        Whether the probe had its second beam, in training and in test.
    right, counted
        (x, y) frames with the right sign, and (x, y) frames that count; see `metrics.sign_right`.
    """

    model: str
    second_beam: bool
    right: tuple[int, int]
    counted: tuple[int, int]


def _map(values: ArrayLike, name: str, shape: tuple[int, int]) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all() or (array < 0).any():
        raise InputError(f"expected a finite d-prime [{shape[0]}, {shape[1]}] >= 0, got {array.shape}", where=name)
    return array


def fig_sign_map(x: ArrayLike, y: ArrayLike, with_beam: ArrayLike, without_beam: ArrayLike) -> Figure:
    """Map d′, the discriminability of a gaze and its opposite for an ideal observer of one frame.

    d′ is the distance of the two hypotheses' means in standard deviations; at equal odds the sign is right with
    probability Φ(d′/2).

    Parameters
    ----------
    x, y
        [X], [Y] gaze, fractions of the field, rising.
    with_beam, without_beam
        [Y, X] d′ between (x, y) and (-x, -y), with and without the probe's second beam.
    """
    across, down = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if across.ndim != 1 or down.ndim != 1 or len(across) < 2 or len(down) < 2:
        raise InputError(f"expected two axes, got {across.shape} and {down.shape}", where="x and y")
    shape = (len(down), len(across))
    maps = {
        "with the second beam": _map(with_beam, "with_beam", shape),
        "without it": _map(without_beam, "without_beam", shape),
    }
    together = np.concatenate([m[m > 0].ravel() for m in maps.values()])
    high = float(together.max()) if together.size else 1.0
    # Near the axis both hypotheses coincide and d' falls to 0; show three decades.
    low = float(together.min()) if together.size else 1e-3
    # Within a decade, a linear scale has better ticks.
    scale = (
        Normalize(0.0, max(high, 1e-12))
        if low > high / 10
        else LogNorm(max(high * 1e-3, low), max(high, 1e-12) * 1.0001)
    )
    figure = new_figure(8.6, 3.75)
    axes: Sequence[Axes] = figure.subplots(1, 2, sharex=True, sharey=True)
    drawn = None
    for ax, letter, (name, values) in zip(axes, "ab", maps.items(), strict=True):
        drawn = ax.pcolormesh(
            across,
            down,
            np.maximum(values, scale.vmin or 0),
            cmap="cividis",
            norm=scale,
            shading="nearest",
            rasterized=True,
        )
        dress(
            ax,
            letter=letter,
            title=f"d′ {name}",
            x="gaze x, fraction of the field",
            y="gaze y, fraction of the field" if letter == "a" else "",
            grid=None,
        )
        levels = [level for level in (1.0, 3.0) if values.min() < level < values.max()]
        if levels:
            lines = ax.contour(across, down, values, levels=levels, colors="white", linewidths=1.2)
            ax.clabel(lines, fmt=lambda level: f"d′ = {level:g}", fontsize=NOTE)
        note = f"median d′ = {np.median(values):.3g}"
        ax.text(
            0.03,
            0.04,
            note,
            transform=ax.transAxes,
            fontsize=NOTE,
            color=INK,
            bbox={"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 2.5},
        )
        ax.set_aspect("equal")
    axes[0].invert_yaxis()
    if drawn is not None:
        dress_bar(figure.colorbar(drawn, ax=list(axes), pad=0.02, aspect=26), "d′ of +gaze against −gaze, one frame")
    return figure


def fig_sign_rates(rates: Sequence[SignRate]) -> Figure:
    """Draw each model's share of correct signs, with and without the second beam, both axes.

    Bars are 95 % Wilson intervals that treat frames as independent; the true ones are wider.
    """
    if not rates:
        raise InputError("no rate to draw", where="rates")
    names = list(dict.fromkeys(rate.model for rate in rates))
    figure = new_figure(6.6, 1.35 + 0.62 * len(names))
    ax = figure.add_subplot()
    ax.axvline(0.5, color=QUIET, linewidth=1.1, linestyle=(0, (4, 2)))
    ax.text(0.503, -0.52, "a guess", fontsize=NOTE, color=QUIET, va="center")
    for rate in rates:
        for axis, (right, counted) in enumerate(zip(rate.right, rate.counted, strict=True)):
            if not counted:
                continue
            row = names.index(rate.model) + (-0.24 if rate.second_beam else 0.08) + 0.16 * axis
            low, high = wilson_interval(right, counted)
            tint = colour(0) if rate.second_beam else colour(1)
            ax.plot([low, high], [row, row], color=tint, linewidth=1.6)
            ax.plot(
                right / counted,
                row,
                "os"[axis],
                color=tint,
                markersize=6.5,
                markerfacecolor=tint if axis == 0 else "white",
                markeredgewidth=1.5,
            )
    handles = [
        Line2D([], [], color=colour(0), linewidth=3, label="with the second beam"),
        Line2D([], [], color=colour(1), linewidth=3, label="without it"),
        Line2D([], [], color=INK, marker="o", linestyle="", markersize=6, label="x"),
        Line2D([], [], color=INK, marker="s", linestyle="", markersize=6, markerfacecolor="white", label="y"),
    ]
    dress(ax, x="frames whose sign is predicted correctly", grid="x")
    figure.legend(handles=handles, loc="outside upper left", ncols=4, frameon=False, fontsize=NOTE, labelcolor=INK)
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.4, -0.62)
    lowest = min((r / c for rate in rates for r, c in zip(rate.right, rate.counted, strict=True) if c), default=0.4)
    ax.set_xlim(min(0.35, lowest - 0.08), 1.02)
    ax.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
    return figure
