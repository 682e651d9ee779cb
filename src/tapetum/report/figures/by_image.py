"""Predictions of focus by test image (the paper's Fig. 11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from numpy.typing import ArrayLike

from tapetum.errors import InputError
from tapetum.report.figures._style import INK, LABEL, NOTE, QUIET, colour, draw_dots, dress, marker, new_figure
from tapetum.report.formatting import look

__all__ = ["fig_by_image"]


def fig_by_image(
    truth: Mapping[str, ArrayLike],
    predicted: Mapping[str, Mapping[str, ArrayLike]],
    *,
    interval: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    order: Sequence[str] = ("object_distance", "focal_length"),
) -> Figure:
    """Draw predictions by test image (the paper's Fig. 11): a row for each quantity, a column for each model.

    `truth` and each model's `predicted` hold [N] by quantity, in SI units; `interval` is the first model's (lower,
    upper). Images are sorted by the quantities in `order`, the slowest first, so that the truth makes steps.
    """
    columns = {name: np.asarray(values, dtype=np.float64) for name, values in truth.items()}
    lengths = {values.shape for values in columns.values()}
    if not columns or not predicted or len(lengths) != 1:
        raise InputError("expected quantities of one length and a model", where="by image")
    count = next(iter(columns.values())).size
    keys = [columns[name] for name in order if name in columns] or [next(iter(columns.values()))]
    sort = np.lexsort(keys[::-1])
    steps = np.flatnonzero(np.diff(keys[0][sort])) + 1
    figure = new_figure(max(6.0, 0.8 + 5.0 * len(predicted)), 0.7 + 2.3 * len(columns))
    axes = figure.subplots(len(columns), len(predicted), squeeze=False, sharex=True, sharey="row")
    at = np.arange(count)
    for row, (quantity, values) in enumerate(columns.items()):
        unit = look(quantity)
        level = unit.scale * values[sort]
        margin = 0.35 * float(np.ptp(level)) or 0.1 * float(np.abs(level).max()) or 1.0
        limits = (float(level.min()) - margin, float(level.max()) + margin)
        for column, (model, table) in enumerate(predicted.items()):
            ax = axes[row, column]
            said = unit.scale * np.asarray(table[quantity], dtype=np.float64)
            if said.shape != (count,):
                raise InputError(f"expected {count} values, got shape {said.shape}", where=f"{model}: {quantity}")
            if column == 0 and interval is not None and quantity in interval:
                ends = [unit.scale * np.asarray(end, dtype=np.float64)[sort] for end in interval[quantity]]
                if all(np.isfinite(end).all() for end in ends):
                    shown = [np.clip(end, *limits) for end in ends]
                    ax.fill_between(at, *shown, color=colour(column), alpha=0.22, linewidth=0, step="mid")
            for step in steps:
                ax.axvline(step - 0.5, color=QUIET, linewidth=0.6, linestyle=(0, (2, 3)), zorder=1)
            draw_dots(ax, at, said[sort], limits, column)
            # A white outline keeps the steps visible among thousands of dots.
            effects = [Stroke(linewidth=2.2, foreground="white"), Normal()]
            ax.step(at, level, where="mid", color=INK, linewidth=1.3, zorder=5, path_effects=effects)
            off = int(((said < limits[0]) | (said > limits[1])).sum())
            note = f" ({off} beyond the axes)" if off else ""
            letter = "abcdefgh"[row * len(predicted) + column]
            dress(ax, letter=letter, title=f"{model}{note}", y=unit.label if column == 0 else "", grid="y")
            ax.set(xlim=(0, count), ylim=limits)
    for ax in axes[-1]:
        ax.set_xlabel("test image, sorted by the truth", fontsize=LABEL, color=INK)
    handles = [Line2D([], [], color=INK, linewidth=1.8, label="truth")]
    handles += [
        Line2D([], [], color=colour(k), marker=marker(k), linestyle="", markersize=4.5, label=model)
        for k, model in enumerate(predicted)
    ]
    figure.legend(handles=handles, loc="outside upper right", ncols=4, frameon=False, fontsize=NOTE, labelcolor=INK)
    return figure
