"""The path of the gaze over the field of view, true and estimated, coloured by time (the paper's Fig. 9)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
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
    draw_dots,
    dress,
    dress_bar,
    gaze_array,
    grey_picture,
    new_figure,
    part_of,
    runs,
    signed,
)
from tapetum.report.figures.retro import draw_rr

__all__ = ["fig_gaze_path", "fig_path"]

Array = NDArray[np.float64]
_FIELD = 0.5
_COLOURS = part_of("plasma", 0.0, 0.9)


def _panel(
    ax: Axes,
    truth: Array,
    predicted: Array,
    when: NDArray[np.generic],
    stretches: Sequence[slice],
    *,
    picture: ArrayLike | None = None,
    width: float = 4.5,
) -> PathCollection:
    """Draw the true path [N, 2] as a band that breaks between stretches, and the estimates as dots tied to it.

    Both are coloured by `when` [N]; a line from each estimate to its truth shows the error.
    """
    ax.set(xlim=(-_FIELD, _FIELD), ylim=(_FIELD, -_FIELD))
    if picture is not None:
        # Faded, so that the path's colours match the colour bar.
        image = 0.58 + 0.4 * grey_picture(picture, "picture")
        extent = (-_FIELD, _FIELD, _FIELD, -_FIELD)
        ax.imshow(image, cmap="gray", vmin=0, vmax=1, extent=extent, aspect="auto", interpolation="nearest")
    scale = Normalize(float(when.min()), float(when.max()))  # type: ignore[arg-type]
    for stretch in stretches:
        points = truth[stretch]
        if len(points) < 2:
            continue
        segments = list(np.stack([points[:-1], points[1:]], axis=1))
        band = LineCollection(segments, cmap=_COLOURS, norm=scale, linewidths=width, capstyle="round", zorder=2)
        band.set_array(when[stretch][1:])
        band.set_path_effects([Stroke(linewidth=width + 1.9, foreground="white"), Normal()])
        ax.add_collection(band)
    ties = list(np.stack([truth, predicted], axis=1))
    ax.add_collection(LineCollection(ties, colors=INK, linewidths=0.55, alpha=0.35, zorder=3))
    dress(ax, grid=None)
    look = {"cmap": _COLOURS, "norm": scale, "s": 16, "edgecolors": INK, "linewidths": 0.65, "zorder": 4}
    return ax.scatter(*predicted.T, c=when, **look)  # type: ignore[arg-type]


def _number(ax: Axes, number: int, place: Array) -> None:
    """Write the number of an RR beside its place on the path."""
    ax.annotate(
        f"{number}",
        (float(place[0]), float(place[1])),
        xytext=(9, 9),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=NOTE,
        color="white",
        zorder=6,
        bbox={"boxstyle": "circle,pad=0.2", "facecolor": INK, "edgecolor": "white", "linewidth": 0.8},
    )


def _beside(figure: FigureBase, rrs: Sequence[ArrayLike], gaze: Array) -> None:
    """Stack RRs, each with the number of its place on the path and its gaze."""
    axes = np.ravel(figure.subplots(len(rrs), 1, squeeze=False))
    for number, (ax, image, (x, y)) in enumerate(zip(axes, rrs, gaze, strict=True), start=1):
        draw_rr(ax, image)
        ax.set_title(rf"$\bf{{{number}}}$  {signed(x, y)}", fontsize=NOTE, color=INK, pad=3, loc="left")


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
        [N] seconds; the lines break at gaps in it.
    name
        The model's name.
    rrs, rrs_at
        RRs [h, w] to show beside it, and their frames (0 ... N - 1).

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
        _beside(parts[0], rrs, a[list(rrs_at)])
    ax = main.add_subplot()
    dots = _panel(ax, a, b, seconds, runs(seconds), picture=picture, width=5.5)
    for lines in (ax.axhline, ax.axvline):
        lines(0, color="white", linewidth=0.9, zorder=1.5)
    for number, frame in enumerate(rrs_at, start=1):
        _number(ax, number, a[frame])
        ax.plot(*a[frame], "o", markersize=5, color="white", markeredgecolor=INK, zorder=5)
    ax.set_xlabel("x, fraction of the field's width", fontsize=LABEL, color=INK)
    ax.set_ylabel("y, fraction of the field's height", fontsize=LABEL, color=INK)
    ax.set_aspect(aspect)
    outside = int((np.abs(b) > _FIELD).any(axis=1).sum())
    said = f"{name}, from the RR alone" + (f" ({outside} outside)" if outside else "")
    tint, truth_said = _COLOURS(0.45), "truth: the laser's place in the target's picture"
    handles = [
        Line2D([], [], color=tint, linewidth=5.5, label=truth_said),
        Line2D([], [], color=INK, linewidth=0.7, marker="o", markersize=4.2, markerfacecolor=tint, label=said),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2, frameon=False, fontsize=NOTE, labelcolor=INK)
    dress_bar(main.colorbar(dots, ax=ax, pad=0.02, fraction=0.04, aspect=26, shrink=0.93), "time, s")
    return figure


def fig_path(
    truth: ArrayLike,
    predicted: ArrayLike,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    recording: ArrayLike | None = None,
    section: tuple[int, int] | None = None,
    picture: ArrayLike | None = None,
    rrs: Sequence[ArrayLike] = (),
    rrs_at: Sequence[int] = (),
    name: str = "ResNet-18",
) -> Figure:
    """Draw predictions of the gaze (the paper's Fig. 9).

    (a) The path of a section of the frames, coloured by frame number; (b, c) x and y of all frames, with intervals.
    Gaze and its interval are [N, 2] (x right, y down) in fractions of the field; infinite intervals are not drawn.
    Lines break between recordings ([N] indices). `section` is (first, last + 1), by default up to 100 frames of the
    first recording. `picture` and `rrs` are those of `fig_gaze_path`.
    """
    a = gaze_array(truth, "truth")
    b = gaze_array(predicted, "predicted", len(a))
    number = np.zeros(len(a), dtype=int) if recording is None else np.asarray(recording)
    ends = None if lower is None or upper is None else (np.asarray(lower, float), np.asarray(upper, float))
    if number.shape != (len(a),) or len(rrs) != len(rrs_at) or (ends and any(e.shape != a.shape for e in ends)):
        raise InputError(f"recordings {number.shape}, {len(rrs)} RRs at {len(rrs_at)} for {len(a)} gazes", where="path")
    cuts = [0, *(np.flatnonzero(np.diff(number)) + 1).tolist(), len(a)]
    begin, end = section if section is not None else (0, min(cuts[1], 100))
    if not 0 <= begin < end <= len(a) or end - begin < 2:
        raise InputError(f"frames {begin} to {end} of {len(a)}", where="section", remedy="take at least two")
    aspect = 0.75 if picture is None else np.shape(picture)[0] / np.shape(picture)[1]
    figure = new_figure(11.4, 4.9)
    ratios = (0.95, 3.9, 5.0) if len(rrs) else (4.4, 5.0)
    parts = np.ravel(np.asarray(figure.subfigures(1, len(ratios), width_ratios=ratios, wspace=0.0), dtype=object))
    if len(rrs):
        _beside(parts[0], rrs, a[list(rrs_at)])
    ax = _path(parts[-2], a[begin:end], b[begin:end], np.arange(begin, end), picture, aspect)
    for number, frame in enumerate(rrs_at, start=1):
        if begin <= frame < end:
            _number(ax, number, a[frame])
    _coordinates(parts[-1], a, b, ends, cuts, (begin, end))
    handles = [
        Line2D([], [], color=INK, linewidth=1.8, label="truth"),
        Line2D([], [], color=colour(0), marker="o", linestyle="", markersize=4, label=name),
    ]
    if ends is not None and np.isfinite(ends[0]).all() and np.isfinite(ends[1]).all():
        handles.append(Patch(facecolor=colour(0), alpha=0.3, label="90 % interval"))  # type: ignore[arg-type]
    parts[-1].legend(handles=handles, loc="outside upper right", ncols=3, frameon=False, fontsize=NOTE, labelcolor=INK)
    return figure


def _path(
    figure: FigureBase,
    truth: Array,
    predicted: Array,
    frames: NDArray[np.int64],
    picture: ArrayLike | None,
    aspect: float,
) -> Axes:
    """Draw a stretch of frames as a path, coloured by their number."""
    ax = figure.add_subplot()
    # Estimates beyond the field are drawn at its edge, and counted.
    outside = int((np.abs(predicted) > _FIELD).any(axis=1).sum())
    shown = np.clip(predicted, -_FIELD, _FIELD)
    dots = _panel(ax, truth, shown, frames, [slice(None)], picture=picture)
    dots.set_clip_on(False)
    title, x, y = "Path over the field of view", "x, fraction of the width", "y, fraction of the height"
    dress(ax, letter="a", title=title, x=x, y=y)
    for spine in ax.spines.values():
        spine.set(visible=True, color=QUIET, linewidth=0.8)
    for lines in (ax.axhline, ax.axvline):
        lines(0, color=QUIET, linewidth=0.7, zorder=1)
    ax.set_aspect(aspect)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(4, steps=[1, 2.5, 5]))
    bar = figure.colorbar(dots, ax=ax, orientation="horizontal", pad=0.02, fraction=0.05, aspect=34, shrink=0.9)
    bar.ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    note = f"; {outside} of {len(shown)} estimates lie outside" if outside else ""
    dress_bar(bar, f"frame (band: truth, dots: estimates{note})")
    return ax


def _coordinates(
    figure: FigureBase,
    truth: Array,
    predicted: Array,
    ends: tuple[Array, Array] | None,
    cuts: Sequence[int],
    section: tuple[int, int],
) -> None:
    """Draw x and y of all frames against their numbers."""
    axes = np.ravel(figure.subplots(2, 1, sharex=True))
    frames, limit = np.arange(len(truth)), max(0.55, 1.06 * float(np.abs(truth).max()))
    for k, (ax, word) in enumerate(zip(axes, "xy", strict=True)):
        ax.axvspan(*section, color="#fff1d6", linewidth=0, zorder=0)
        for first, last in pairwise(cuts):
            at = slice(first, last)
            if ends is not None and np.isfinite(ends[0][at, k]).all() and np.isfinite(ends[1][at, k]).all():
                low, high = (np.clip(e[at, k], -limit, limit) for e in ends)
                ax.fill_between(frames[at], low, high, color=colour(0), alpha=0.3, linewidth=0, step="mid")
            # A white outline keeps the truth visible among thousands of dots.
            seam = [Stroke(linewidth=1.9, foreground="white"), Normal()]
            ax.plot(frames[at], truth[at, k], color=INK, linewidth=1.0, zorder=5, path_effects=seam)
        for cut in cuts[1:-1]:
            ax.axvline(cut - 0.5, color=QUIET, linewidth=0.7, linestyle=(0, (2, 3)))
        draw_dots(ax, frames, predicted[:, k], (-limit, limit), 0)
        off = int((np.abs(predicted[:, k]) > limit).sum())
        note = f" ({off} beyond the axes)" if off else ""
        dress(ax, letter="bc"[k], title=f"{word}{note}", y="fraction of the field")
        ax.set(xlim=(0, len(truth)), ylim=(limit, -limit) if word == "y" else (-limit, limit))
        ax.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    axes[-1].set_xlabel("frame of the test parts, laid end to end", fontsize=LABEL, color=INK)
