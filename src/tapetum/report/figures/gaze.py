"""Figures of gaze over time and against the truth, and of the label error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.report.figures._style import (
    INK,
    NOTE,
    QUIET,
    colour,
    draw_dots,
    dress,
    gaze_array,
    legend,
    marker,
    new_figure,
    runs,
)

__all__ = ["fig_gaze_over_time", "fig_label_error"]

Array = NDArray[np.float64]


def _running_axis(time: Array, stretches: Sequence[slice]) -> tuple[Array, list[float]]:
    """Concatenate the runs: the running time of each frame, and the places of the gaps."""
    running = np.empty_like(time)
    holes: list[float] = []
    start = 0.0
    whole = sum(float(time[s][-1] - time[s][0]) for s in stretches)
    gap = 0.015 * whole if whole else 1.0
    for stretch in stretches:
        running[stretch] = time[stretch] - time[stretch][0] + start
        start = float(running[stretch][-1]) + gap
        holes.append(start - gap / 2)
    return running, holes[:-1]


def fig_gaze_over_time(
    time: ArrayLike,
    truth: ArrayLike,
    predicted: Mapping[str, ArrayLike],
    *,
    interval: tuple[ArrayLike, ArrayLike] | None = None,
    limit: float = 0.55,
) -> Figure:
    """Draw x and y over time and against the truth (the paper's Fig. 9 (b, c)).

    Parameters
    ----------
    time, truth
        [N] seconds, several videos one after another; and [N, 2] gaze, fractions of the field.
    predicted
        [N, 2] by model name; the first is drawn in front.
    interval
        (lower, upper), each [N, 2]: the first model's.
    limit
        Half-width of the axes; predictions beyond it are drawn at the edge as triangles and counted.
    """
    seconds = np.asarray(time, dtype=np.float64)
    a = gaze_array(truth, "truth", len(seconds))
    models = {name: gaze_array(values, name, len(a)) for name, values in predicted.items()}
    if not models:
        raise InputError("no model to draw", where="predicted")
    limit = max(limit, 1.08 * float(np.abs(a).max()))
    stretches = runs(seconds)
    running, holes = _running_axis(seconds, stretches)
    figure = new_figure(10.2, 5.6)
    grid = figure.add_gridspec(2, 2, width_ratios=(2.75, 1.0))
    for axis, word in enumerate("xy"):
        ax = figure.add_subplot(grid[axis, 0])
        flat = figure.add_subplot(grid[axis, 1])
        for hole in holes:
            ax.axvline(hole, color=QUIET, linewidth=0.8, linestyle=(0, (2, 3)))
        for stretch in stretches:
            if interval is not None:
                low, high = (np.asarray(end, dtype=np.float64)[stretch, axis] for end in interval)
                ends = (np.clip(low, -limit, limit), np.clip(high, -limit, limit))
                ax.fill_between(running[stretch], *ends, color=colour(0), alpha=0.25, linewidth=0)
            ax.plot(running[stretch], a[stretch, axis], color=INK, linewidth=1.6, zorder=2.5)
        for order, (name, values) in enumerate(models.items()):
            for target, across in ((ax, running), (flat, a[:, axis])):
                draw_dots(target, across, values[:, axis], (-limit, limit), order)
            beyond = int((np.abs(values) > limit).sum())
            label = name + (f" ({beyond} beyond the axes)" if beyond else "")
            ax.plot([], [], marker(order), color=colour(order), markersize=5, label=label)
        ax.plot([], [], color=INK, linewidth=1.6, label="truth")
        if interval is not None:
            ax.fill_between([], [], [], color=colour(0), alpha=0.2, label=f"90 % interval, {next(iter(models))}")
        note = " of the test parts, laid end to end" if holes else ""
        dress(
            ax,
            letter="ab"[axis],
            title=f"{word} over time",
            x=f"time{note}, s" if axis else "",
            y=f"{word}, fraction of the field",
        )
        ax.set_xlim(float(running.min()), float(running.max()))
        ax.set_ylim(-limit, limit)
        flat.plot([-limit, limit], [-limit, limit], color=INK, linewidth=1.0, zorder=2.5)
        dress(
            flat,
            letter="cd"[axis],
            title=f"{word} against truth",
            x=f"true {word}" if axis else "",
            y=f"estimated {word}",
        )
        flat.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
        for end in (flat.xaxis, flat.yaxis, ax.yaxis):
            end.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        if axis == 0:
            ax.tick_params(labelbottom=False)
            handles, labels = ax.get_legend_handles_labels()
            figure.legend(
                handles,
                labels,
                loc="outside upper left",
                ncols=4,
                frameon=False,
                fontsize=NOTE,
                labelcolor=INK,
            )
    return figure


def fig_label_error(found: ArrayLike, true: ArrayLike) -> Figure:
    """Draw the distances of the detected laser spots from the true ones.

    Parameters
    ----------
    found, true
        [N, 2] pixels of the target's video; NaN where no spot was found.
    """
    a, b = np.asarray(found, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 2:
        raise InputError(f"expected two arrays [N, 2], got {a.shape} and {b.shape}", where="labels")
    error = (a - b)[np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)]
    if not len(error):
        raise InputError("no frame has a label", where="labels")
    distance = np.hypot(*error.T)
    # The axis shows the bulk; larger distances are counted in the last bin.
    reach = max(1.6 * float(np.quantile(distance, 0.98)), 1e-3)
    figure = new_figure(8.4, 3.5)
    left, right = figure.subplots(1, 2, width_ratios=(1.65, 1.0))
    edges = np.linspace(0, reach, 41)
    left.hist(np.minimum(distance, reach * (1 - 1e-9)), bins=edges.tolist(), color=colour(0), alpha=0.85)
    far = int((distance > reach).sum())
    note = f" ({far} beyond, in the last bin)" if far else ""
    marks = (
        ("median", float(np.median(distance)), "-"),
        ("95 %", float(np.quantile(distance, 0.95)), (0, (4, 2))),
    )
    for word, value, style in marks:
        left.axvline(value, color=INK, linewidth=1.2, linestyle=style, label=f"{word}: {value:.3f} px")
    dress(
        left,
        letter="a",
        title="Distance between label and truth",
        x=f"pixels of the target's video{note}",
        y="frames",
        grid="y",
    )
    legend(left, loc="upper right")
    clipped = np.clip(error, -reach, reach)
    right.scatter(*clipped.T, s=6, color=colour(0), alpha=0.45, linewidths=0)
    right.plot(*error.mean(axis=0), "+", color=INK, markersize=11, markeredgewidth=1.6, label="mean")
    dress(right, letter="b", title="Both axes", x="x, found minus true, px", y="y, px")
    right.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal")
    for end in (right.xaxis, right.yaxis):
        end.set_major_locator(MaxNLocator(5, symmetric=True))
    legend(right, loc="upper right", handletextpad=0.1, borderaxespad=0.1)
    return figure
