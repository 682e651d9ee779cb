"""Figures of gaze: its path over the target's picture, over time, against truth, and where the errors are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.report.figures._style import (
    INK,
    LABEL,
    NOTE,
    QUIET,
    colour,
    dress,
    dress_bar,
    gaze_array,
    grey_picture,
    legend,
    marker,
    new_figure,
    part_of,
    runs,
    signed,
)
from tapetum.report.figures.retro import draw_rr

__all__ = ["fig_gaze_over_time", "fig_gaze_path", "fig_label_error"]

Array = NDArray[np.float64]


def fig_gaze_path(
    picture: ArrayLike,
    truth: ArrayLike,
    predicted: ArrayLike,
    time: ArrayLike,
    *,
    name: str = "ResNet-18",
    rrs: Sequence[ArrayLike] = (),
    rrs_at: Sequence[int] = (),
) -> Figure:
    """Draw the path of the gaze over the target's picture, coloured by time (the paper's Fig. 9 (a)).

    Parameters
    ----------
    picture
        [H, W] a frame of the target's video; it spans the field, -0.5 ... 0.5 in both directions.
    truth, predicted
        [N, 2] gaze (x right, y down), fractions of the field.
    time
        [N] seconds; the lines break at holes in it.
    name
        Of the model that predicted.
    rrs, rrs_at
        Some RRs [h, w] to show beside it, and the frame (0 ... N - 1) each belongs to.

    Raises
    ------
    InputError
        When a shape does not fit or a value is not finite.
    """
    a = gaze_array(truth, "truth")
    b = gaze_array(predicted, "predicted", len(a))
    seconds = np.asarray(time, dtype=np.float64)
    if seconds.shape != (len(a),) or len(rrs) != len(rrs_at):
        raise InputError(f"{len(a)} gazes, times {seconds.shape}, {len(rrs)} RRs at {len(rrs_at)} frames", where="path")
    image = grey_picture(picture, "picture")
    aspect = image.shape[0] / image.shape[1]
    figure = new_figure(6.9 + (1.75 if len(rrs) else 0.0), 5.75 * aspect + 0.95)
    main: FigureBase = figure
    if len(rrs):
        parts = np.ravel(figure.subfigures(1, 2, width_ratios=(1.0, 4.0), wspace=0.0, squeeze=False))
        main = parts[1]
        _beside(parts[0], rrs, [a[frame] for frame in rrs_at])
    ax = main.add_subplot()
    # Washed out, so that the colours of the path stay what the bar says they are.
    extent = (-0.5, 0.5, 0.5, -0.5)
    ax.imshow(0.58 + 0.4 * image, cmap="gray", vmin=0, vmax=1, extent=extent, aspect=aspect, interpolation="nearest")
    ax.axhline(0, color="white", linewidth=0.9, zorder=1.5)
    ax.axvline(0, color="white", linewidth=0.9, zorder=1.5)
    colours, scale = part_of("plasma", 0.0, 0.9), Normalize(float(seconds.min()), float(seconds.max()))
    stretches = runs(seconds)
    for stretch in stretches:
        points = a[stretch]
        if len(points) > 1:
            segments = np.stack([points[:-1], points[1:]], axis=1)
            band = LineCollection(list(segments), cmap=colours, norm=scale, linewidths=5.5, capstyle="round", zorder=2)
            band.set_array(seconds[stretch][1:])
            band.set_path_effects([Stroke(linewidth=7.5, foreground="white"), Normal()])
            ax.add_collection(band)
    # A line from each estimate to its truth shows the error where it is made; joined estimates would hide it.
    ties = LineCollection(list(np.stack([a, b], axis=1)), colors=INK, linewidths=0.6, alpha=0.35, zorder=3)
    ax.add_collection(ties)
    outside = int((np.abs(b) > 0.5).any(axis=1).sum())
    dots = ax.scatter(*b.T, c=seconds, cmap=colours, norm=scale, s=17, edgecolors=INK, linewidths=0.7, zorder=4)
    for number, frame in enumerate(rrs_at, start=1):
        ax.annotate(
            f"{number}",
            a[frame],
            xytext=(9, 9),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=NOTE,
            color="white",
            zorder=6,
            bbox={"boxstyle": "circle,pad=0.22", "facecolor": INK, "edgecolor": "white", "linewidth": 0.9},
        )
        ax.plot(*a[frame], "o", markersize=5, color="white", markeredgecolor=INK, zorder=5)
    dress(ax, x="x, fraction of the field's width", grid=None)
    ax.set_ylabel("y, fraction of the field's height", fontsize=LABEL, color=INK)
    ax.set_xlim(-0.5, 0.5)
    ax.set_ylim(0.5, -0.5)
    handles = [
        Line2D(
            [],
            [],
            color=colours(0.45),
            linewidth=5.5,
            label="truth: the laser's place in the target's picture",
        ),
        Line2D(
            [],
            [],
            color=INK,
            linewidth=0.7,
            marker="o",
            markersize=4.2,
            markerfacecolor=colours(0.45),
            label=f"{name}, from the RR alone" + (f" ({outside} outside)" if outside else ""),
        ),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False, fontsize=NOTE, labelcolor=INK)
    dress_bar(main.colorbar(dots, ax=ax, pad=0.02, fraction=0.04, aspect=26, shrink=0.93), "time, s")
    return figure


def _beside(figure: FigureBase, rrs: Sequence[ArrayLike], gaze: Sequence[Array]) -> None:
    """Stack RRs, each with the number of its place on the path and its gaze."""
    axes = np.ravel(figure.subplots(len(rrs), 1, squeeze=False))
    for number, (ax, image, (x, y)) in enumerate(zip(axes, rrs, gaze, strict=True), start=1):
        draw_rr(ax, image)
        ax.set_title(rf"$\bf{{{number}}}$   {signed(x, y)}", fontsize=NOTE, color=INK, pad=3, loc="left")


def _running_axis(time: Array, stretches: Sequence[slice]) -> tuple[Array, list[float]]:
    """Lay the stretches one after another: the running time of each frame, and where the holes are."""
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
    time
        [N] seconds; stretches of several videos are laid one after another.
    truth
        [N, 2] gaze, fractions of the field.
    predicted
        For each model's name [N, 2]; the first is drawn in front, and has the interval.
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
            shown = np.clip(values[:, axis], -0.985 * limit, 0.985 * limit)
            off = np.abs(values[:, axis]) > limit
            beyond = int((np.abs(values) > limit).sum())
            size, depth = (9.0, 4.0) if order == 0 else (7.0, 3.0)
            look: dict[str, Any] = {"color": colour(order), "s": size, "linewidths": 0, "zorder": depth}
            large: dict[str, Any] = {**look, "s": 22.0}
            for target, across in ((ax, running), (flat, a[:, axis])):
                target.scatter(across[~off], shown[~off], marker=marker(order), alpha=0.75, **look)
                target.scatter(across[off], shown[off], marker="^", **large)
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
    """Draw how far the laser spots found lie from the true ones.

    Parameters
    ----------
    found
        [N, 2] pixels of the target's video; NaN where none was found.
    true
        [N, 2] pixels.
    """
    a, b = np.asarray(found, dtype=np.float64), np.asarray(true, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 2:
        raise InputError(f"expected two arrays [N, 2], got {a.shape} and {b.shape}", where="labels")
    error = (a - b)[np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)]
    if not len(error):
        raise InputError("no frame has a label", where="labels")
    distance = np.hypot(*error.T)
    # The bulk is the message; what lies beyond is counted in the last bin, never dropped.
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
