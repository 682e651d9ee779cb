"""Figures of the classification: confusion matrix and reliability diagram."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from tapetum.errors import InputError
from tapetum.report.figures._style import (
    INK,
    LABEL,
    NOTE,
    QUIET,
    colour,
    dress,
    dress_bar,
    legend,
    marker,
    new_figure,
    part_of,
)
from tapetum.report.metrics import wilson_interval

if TYPE_CHECKING:
    from tapetum.report.evaluation.classes import Reliability

__all__ = ["fig_confusion", "fig_reliability"]


def fig_confusion(counts: ArrayLike, names: Sequence[str]) -> Figure:
    """Draw the confusion matrix: `counts` [C, C] by true (row) and predicted (column) class, written into the cells."""
    table = np.asarray(counts)
    if table.shape != (len(names), len(names)) or not len(names):
        raise InputError(f"expected counts [{len(names)}, {len(names)}], got {table.shape}", where="confusion")
    total = table.sum(axis=1, keepdims=True)
    share = np.divide(table, total, out=np.zeros(table.shape), where=total > 0)
    size = len(names)
    figure = new_figure(2.3 + 0.42 * size, 1.75 + 0.36 * size)
    ax = figure.add_subplot()
    drawn = ax.pcolormesh(share, cmap=part_of("Blues", 0.0, 0.95), vmin=0, vmax=1, edgecolors="#eceff3", linewidth=0.8)
    for row, column in zip(*np.nonzero(table), strict=True):
        tint = "white" if share[row, column] > 0.55 else INK
        where = (column + 0.5, row + 0.5)
        ax.text(*where, f"{table[row, column]}", ha="center", va="center", fontsize=NOTE - 0.5, color=tint)
    dress(ax, grid=None)
    # Escape dollars, which would start a formula.
    shown = [name.replace("$", r"\$") for name in names]
    ax.set_xticks(np.arange(size) + 0.5, shown, rotation=45, ha="right", rotation_mode="anchor")
    ax.set_yticks(np.arange(size) + 0.5, [f"{name}  ({n})" for name, n in zip(shown, total[:, 0], strict=True)])
    ax.tick_params(length=0)
    ax.set_ylim(size, 0)
    ax.set_xlabel("predicted", fontsize=LABEL, color=INK)
    ax.set_ylabel("true (frames)", fontsize=LABEL, color=INK)
    dress_bar(figure.colorbar(drawn, ax=ax, pad=0.02, fraction=0.05), "share of the true class")
    return figure


def fig_reliability(models: dict[str, Reliability] | Reliability, *, name: str = "model") -> Figure:
    """Draw accuracy against predicted probability, for `Reliability` by model name or one alone, called `name`.

    Bars are 95 % Wilson intervals that treat frames as independent. Where all bins lie near 1 the axes show that part.
    """
    shown = models if isinstance(models, dict) else {name: models}
    if not shown:
        raise InputError("no model to draw", where="models")
    figure = new_figure(4.6, 4.4)
    ax = figure.add_subplot()
    least = 1.0
    for order, (label, one) in enumerate(shown.items()):
        ends = np.array([wilson_interval(round(a * n), int(n)) for a, n in zip(one.accuracy, one.count, strict=True)])
        bars = np.abs(np.stack([one.accuracy - ends[:, 0], ends[:, 1] - one.accuracy]))
        text = f"{label}: expected calibration error {one.error:.3f}"
        ax.errorbar(
            one.confidence,
            one.accuracy,
            yerr=bars,
            color=colour(order),
            marker=marker(order),
            markersize=5,
            linewidth=1.2,
            elinewidth=0.9,
            capsize=2,
            label=text,
        )
        least = min(least, float(one.confidence.min()), float(one.accuracy.min()), float(ends.min()))
    low = max(0.0, least - 0.06 * (1 - least) - 0.005)
    ax.plot([low, 1], [low, 1], color=QUIET, linewidth=1.1, linestyle=(0, (4, 2)), label="as sure as right")
    dress(ax, x="probability it gave (mean of a bin)", y="share predicted correctly")
    top = 1 + 0.03 * (1 - low)
    ax.set(xlim=(low, top), ylim=(low, top), aspect="equal")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    legend(ax, loc="lower right")
    return figure
