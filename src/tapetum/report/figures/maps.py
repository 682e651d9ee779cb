"""Maps of errors over object distance and focal length."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.report.figures._style import INK, LABEL, NOTE, dress, dress_bar, new_figure, part_of
from tapetum.report.formatting import look

if TYPE_CHECKING:
    from tapetum.report.evaluation.scores import ErrorMap

__all__ = ["fig_error_map"]

Array = NDArray[np.float64]
_PLAIN = FuncFormatter(lambda value, _: f"{value:g}")


def fig_error_map(
    maps: Mapping[str, Mapping[str, ErrorMap]],
    *,
    bounds: Mapping[str, ArrayLike] | None = None,
    ratio: bool = True,
    x: str = "object_distance",
    y: str = "focal_length",
    bound_name: str = "Cramér–Rao bound",
) -> Figure:
    """Map the mean absolute error over two labels (the paper's Fig. 12): a row for each quantity, a column a model.

    `maps` are by model and quantity, all over the same labels; each row has one colour scale. `bounds` adds a
    column, [Y, X] by quantity in SI units and in the measure of the errors (see `fig_error_by_distance`); `ratio` adds
    another, the first model's error over the bound.
    """
    if not maps or not next(iter(maps.values())):
        raise InputError("no map to draw", where="maps")
    first = next(iter(maps.values()))
    quantities = list(first)
    limits = {name: np.asarray(values, dtype=np.float64) for name, values in (bounds or {}).items()}
    shape = next(iter(first.values())).mae.shape
    for table in maps.values():
        if list(table) != quantities or any(one.mae.shape != shape for one in table.values()):
            raise InputError("maps differ in quantities or size", where="maps", remedy="make them of the same frames")
    if any(values.shape != shape for values in limits.values()):
        raise InputError(f"expected bounds {shape}", where="bounds")
    with_ratio = bool(limits) and ratio
    columns = len(maps) + bool(limits) + with_ratio
    cell = 0.6 if columns < 3 and shape[1] <= 7 else 0.44
    width = 0.9 + columns * (cell * shape[1] + 0.25) + (1.9 if with_ratio else 1.0)
    figure = new_figure(width, len(quantities) * (0.46 * shape[0] + 0.95) + 0.2)
    axes = figure.subplots(len(quantities), columns, squeeze=False)
    for row, quantity in enumerate(quantities):
        unit = look(quantity)
        panels = {name: table[quantity].mae * unit.scale for name, table in maps.items()}
        if quantity in limits:
            panels[bound_name] = limits[quantity] * unit.scale
        known = np.concatenate([values[np.isfinite(values)] for values in panels.values()])
        top, least = float(known.max(initial=1e-12)), float(known[known > 0].min(initial=np.inf))
        # A bound may lie decades below the errors: use a logarithmic scale.
        scale = LogNorm(least, top * 1.0001) if least < top / 50 else Normalize(0.0, top)
        drawn = None
        for column, (name, values) in enumerate(panels.items()):
            drawn = _cells(axes[row, column], first[quantity], values, scale, x, y, first_column=column == 0)
            heading = f"{unit.name}: {name}" if column == 0 else name
            dress(axes[row, column], title=heading, grid=None)
            axes[row, column].tick_params(length=0)
        if drawn is not None:
            bar = figure.colorbar(drawn, ax=list(axes[row, : len(panels)]), pad=0.015, format=_PLAIN)
            dress_bar(bar, f"MAE, {unit.unit or 'SI'}")
        for ax in axes[row, len(panels) :]:
            ax.set_visible(False)
        if with_ratio and quantity in limits:
            _ratio_panel(figure, axes[row, -1], first[quantity], limits[quantity], (x, y), next(iter(maps)))
    for ax in axes[-1]:
        ax.set_xlabel(f"true {look(x).label}", fontsize=LABEL, color=INK)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"true {look(y).label}", fontsize=LABEL, color=INK)
    return figure


def _ratio_panel(figure: Figure, ax: Axes, errors: ErrorMap, bound: Array, labels: tuple[str, str], name: str) -> None:
    ax.set_visible(True)
    ratio = np.divide(errors.mae, bound, out=np.full(bound.shape, np.nan), where=bound > 0)
    known = ratio[np.isfinite(ratio)]
    top = float(known.max(initial=1.0))
    scale = LogNorm(1.0, top * 1.0001) if top > 20 else Normalize(0.0, top)
    drawn = _cells(ax, errors, ratio, scale, *labels, first_column=False)
    dress(ax, title=f"{name} over the bound", grid=None)
    ax.tick_params(length=0)
    dress_bar(figure.colorbar(drawn, ax=ax, pad=0.03, format=_PLAIN), "ratio")


def _cells(
    ax: Axes, errors: ErrorMap, values: Array, scale: Normalize, x: str, y: str, *, first_column: bool
) -> QuadMesh:
    """Draw one map as cells with their numbers; a label's values are equally spaced."""
    cmap = part_of("YlOrBr", 0.04, 0.93)
    shown = np.ma.masked_invalid(np.maximum(values, scale.vmin or 0.0) if isinstance(scale, LogNorm) else values)
    drawn = ax.pcolormesh(shown, cmap=cmap, norm=scale, edgecolors="white", linewidth=1.2)
    for row, column in np.ndindex(values.shape):
        value = values[row, column]
        text = "–" if not np.isfinite(value) else _short(float(value))
        dark = np.isfinite(value) and float(np.asarray(scale(max(value, scale.vmin or 0.0)))) > 0.62
        where = (column + 0.5, row + 0.5)
        ax.text(*where, text, ha="center", va="center", fontsize=NOTE - 0.5, color="white" if dark else INK)
    ax.set_xticks(np.arange(len(errors.x)) + 0.5, [f"{v * look(x).scale:.3g}" for v in errors.x])
    ax.set_yticks(np.arange(len(errors.y)) + 0.5, [f"{v * look(y).scale:.3g}" for v in errors.y])
    ax.tick_params(labelleft=first_column)
    for spine in ax.spines.values():
        spine.set_visible(False)
    return drawn


def _short(value: float) -> str:
    """Write a number with two digits or three, whatever its size."""
    if value >= 100:
        return f"{value:.0f}"
    if 0 < value < 0.001:
        return f"{value:.0e}".replace("e-0", "e−")
    # From 9.95 on two digits would be "10." with a point and nothing after it.
    return f"{value:#.2g}" if value < 9.95 else f"{value:.1f}"
