"""Figures of errors by distance from the field's centre and by SNR, and of coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, PercentFormatter
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.report.binned import ErrorByDistance
from tapetum.report.figures._style import (
    INK,
    NOTE,
    QUIET,
    TICK,
    colour,
    dress,
    legend,
    marker,
    new_figure,
)
from tapetum.report.formatting import look

if TYPE_CHECKING:
    from tapetum.report.binned import Binned
    from tapetum.report.evaluation.scores import Group

__all__ = ["fig_coverage", "fig_error_by", "fig_error_by_distance"]

Array = NDArray[np.float64]
_WANTED = (0.88, 0.92)
_BOUND_LINES: tuple[tuple[float, tuple[float, ...]], ...] = ((0, (6, 2)), (0, (1, 1.4)), (0, (6, 2, 1, 2)))


def _plain_ticks(axis: Axis, limits: tuple[float, float], most: float) -> None:
    """Label a logarithmic axis with plain numbers, also at 2 and 5 times powers of ten if it spans less than `most`."""
    several = limits[1] / limits[0] < most
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if several else (1,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def fig_error_by_distance(
    errors: Mapping[str, ErrorByDistance],
    *,
    baseline: str | None = None,
    bounds: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    log: bool = False,
    measure: str = "MAE",
) -> Figure:
    """Draw the error against the distance from the field's centre, and the frames (the paper's Fig. 10).

    Parameters
    ----------
    errors
        `ErrorByDistance` by name, all with the same rings.
    baseline
        The name of the guess that looks at no image: drawn in grey.
    bounds
        By name (distance from the centre [M], value [M]), in the measure of the errors: for mean absolute errors, a
        standard deviation times sqrt(2/pi), the mean absolute value of a normal error.
    log
        Whether the error's axis is logarithmic, for bounds far below the errors.
    measure
        Label of the error's axis.

    Raises
    ------
    InputError
        When there is no error, the rings differ, or a bound is no pair of columns of one length.
    """
    if not errors:
        raise InputError("no error to draw", where="errors")
    first = next(iter(errors.values()))
    if any(not np.array_equal(one.edges, first.edges) for one in errors.values()):
        raise InputError("the rings differ between models", where="errors", remedy="give each the same edges")
    figure = new_figure(6.4, 4.9)
    grid = figure.add_gridspec(2, 1, height_ratios=(4.2, 1.0), hspace=0.02)
    ax = figure.add_subplot(grid[0])
    below = figure.add_subplot(grid[1], sharex=ax)
    if log:
        ax.set_yscale("log", nonpositive="clip")
    width = float(np.diff(first.edges).mean())
    spread = np.linspace(-0.13, 0.13, len(errors)) * width if len(errors) > 1 else np.zeros(1)
    order = 0
    for shift, (name, one) in zip(spread, errors.items(), strict=True):
        have = np.isfinite(one.mae)
        plain = name == baseline
        _curve(ax, one.centre[have] + shift, one.mae[have], (one.low[have], one.high[have]), name, order, plain)
        order += 0 if plain else 1
    for k, (name, (at, value)) in enumerate((bounds or {}).items()):
        x, y = np.asarray(at, dtype=np.float64), np.asarray(value, dtype=np.float64)
        if x.shape != y.shape or x.ndim != 1:
            raise InputError(f"expected two columns of one length, got {x.shape} and {y.shape}", where=name)
        ax.plot(x, y, color=INK, linewidth=1.3, linestyle=_BOUND_LINES[k % len(_BOUND_LINES)], label=name)
    dress(ax, y=f"{measure}, fraction of the field")
    if log:
        _plain_ticks(ax.yaxis, ax.get_ylim(), 30)
    else:
        ax.set_ylim(bottom=0)
    ax.tick_params(labelbottom=False)
    # Matplotlib lists lines before error bars; list the models first, then the bounds.
    found = dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    labels = [*errors, *(bounds or {})]
    handles = [found[label] for label in labels]
    # Above the axes, because on a logarithmic one no corner is always free.
    figure.legend(handles, labels, loc="outside upper left", ncols=2, frameon=False, fontsize=NOTE, labelcolor=INK)
    below.bar(first.centre, first.count, width=0.92 * np.diff(first.edges), color="#c3c9d2")
    dress(below, x="true distance of the laser from the centre, fraction of the field", y="frames", grid="y")
    below.set_xlim(float(first.edges[0]), float(first.edges[-1]))
    below.yaxis.set_major_locator(MaxNLocator(3, integer=True))
    below.tick_params(labelsize=TICK)
    figure.align_ylabels([ax, below])
    return figure


def _curve(ax: Axes, x: Array, y: Array, ends: tuple[Array, Array], name: str, order: int, plain: bool) -> None:
    """Draw a curve with error bars; a plain one is the guess that looks at no image."""
    bars = np.abs(np.stack([y - ends[0], ends[1] - y]))
    ax.errorbar(
        x,
        y,
        yerr=bars,
        color=QUIET if plain else colour(order),
        marker="x" if plain else marker(order),
        markersize=5.5,
        linewidth=1.2 if plain else 1.7,
        linestyle=(0, (4, 2)) if plain else "-",
        elinewidth=1.1,
        capsize=2.5,
        label=name,
    )


def fig_error_by(
    errors: Mapping[str, Binned],
    *,
    x: str,
    y: str = "MAE",
    baseline: str | None = None,
    log_x: bool = False,
    log_y: bool = False,
) -> Figure:
    """Draw `Binned` errors by model name against another quantity, such as SNR; `x` and `y` label the axes with units.

    `baseline` names the guess that looks at no image; it is drawn in grey.
    """
    if not errors:
        raise InputError("no error to draw", where="errors")
    figure = new_figure(5.4, 3.7)
    ax = figure.add_subplot()
    if log_x:
        ax.set_xscale("log")
    if log_y:
        ax.set_yscale("log", nonpositive="clip")
    order = 0
    for name, one in errors.items():
        plain = name == baseline
        _curve(ax, one.x, one.mean, (one.low, one.high), name, order, plain)
        order += 0 if plain else 1
    dress(ax, x=x, y=y)
    if log_y:
        _plain_ticks(ax.yaxis, ax.get_ylim(), 30)
    else:
        ax.set_ylim(bottom=0)
    if log_x:
        _plain_ticks(ax.xaxis, ax.get_xlim(), 200)
    legend(ax, loc="best")
    return figure


def fig_coverage(groups: Mapping[str, Sequence[Group]], quantities: Sequence[str], *, wanted: float = 0.9) -> Figure:
    """Draw the share of truths inside the intervals for `Group`s under headings ("by recording").

    `quantities` are in the groups' order; a line marks the `wanted` share, a band the accepted 88 to 92 %.
    """
    rows = [(heading, one) for heading, found in groups.items() for one in found]
    if not rows or not quantities:
        raise InputError("no interval to draw", where="groups")
    # A free row before each heading's own.
    places, place, before = [], -1.0, None
    for heading, _ in rows:
        place += 1.0 if heading == before else 1.55
        places.append(place)
        before = heading
    figure = new_figure(7.0, 1.15 + 0.225 * (places[-1] + 1))
    ax = figure.add_subplot()
    ax.axvspan(*_WANTED, color="#009e73", alpha=0.13, linewidth=0)
    ax.axvline(wanted, color="#009e73", linewidth=1.1)
    shift = np.linspace(-0.2, 0.2, len(quantities)) if len(quantities) > 1 else np.zeros(1)
    for k, quantity in enumerate(quantities):
        held = [one.coverage[k] for _, one in rows]
        ax.plot(held, np.array(places) + shift[k], marker(k), color=colour(k), markersize=5, label=look(quantity).name)
    low = min(0.8, min(min(one.coverage) for _, one in rows) - 0.03)
    ax.set_xlim(max(-0.02, low), 1.01)
    dress(ax, x="share of true values inside the intervals; band: 88 – 92 %", grid="x")
    for y in places:
        ax.axhline(y, color="#eceff3", linewidth=0.6, zorder=0)
    names = [f"{one.name}  ({one.count})" for _, one in rows]
    ax.yaxis.set_major_locator(FixedLocator(places))
    ax.set_yticks(places, names)
    ax.tick_params(axis="y", length=0)
    ax.set_ylim(places[-1] + 0.7, -0.5)
    for k, (heading, _) in enumerate(rows):
        if k == 0 or rows[k - 1][0] != heading:
            where = {"transform": ax.get_yaxis_transform(), "fontsize": TICK, "color": QUIET}
            ax.text(0.005, places[k] - 0.78, heading, va="center", ha="left", style="italic", **where)
    ax.xaxis.set_major_locator(MaxNLocator(9, steps=[1, 2, 5, 10]))
    ax.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0, symbol=" %"))
    figure.legend(loc="outside upper right", ncols=4, frameon=False, fontsize=NOTE, labelcolor=INK)
    return figure
