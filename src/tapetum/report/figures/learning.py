"""The paper's figures of predictions: the path of the gaze (Fig. 9), and focus by test image (Fig. 11)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
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
    dress,
    dress_bar,
    gaze_array,
    grey_picture,
    marker,
    new_figure,
    part_of,
    signed,
)
from tapetum.report.figures.errors import look
from tapetum.report.figures.retro import draw_rr

__all__ = ["fig_by_image", "fig_path"]

Array = NDArray[np.float64]
_FIELD = 0.5


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

    (a) The path of a section over the field of view, coloured by the frame's number. (b, c) x and y of all frames
    against their numbers, the intervals shaded.

    Parameters
    ----------
    truth, predicted
        [N, 2] gaze (x right, y down), fractions of the field.
    lower, upper
        [N, 2] ends of the intervals; infinite ones are not drawn.
    recording
        [N] number of the recording of each frame: lines break between them.
    section
        Frames drawn as a path: (first, last + 1); the first recording, or 100 frames of it, when None.
    picture
        [H, W] a frame of the target's video behind the path; it spans the field.
    rrs, rrs_at
        Some RRs [h, w] to show beside it, and the frames (0 ... N - 1) they belong to.
    name
        Of the model.

    Raises
    ------
    InputError
        When a shape does not fit, a value is not finite or the section holds no two frames.
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
    _path(parts[-2], a, b, (begin, end), picture, aspect, [k for k in rrs_at if begin <= k < end], list(rrs_at))
    _coordinates(parts[-1], a, b, ends, cuts, (begin, end))
    handles = [
        Line2D([], [], color=INK, linewidth=1.8, label="truth"),
        Line2D([], [], color=colour(0), marker="o", linestyle="", markersize=4, label=name),
    ]
    if ends is not None and np.isfinite(ends[0]).all() and np.isfinite(ends[1]).all():
        handles.append(Patch(facecolor=colour(0), alpha=0.3, label="90 % interval"))  # type: ignore[arg-type]
    parts[-1].legend(handles=handles, loc="outside upper right", ncols=3, frameon=False, fontsize=NOTE, labelcolor=INK)
    return figure


def _beside(figure: FigureBase, rrs: Sequence[ArrayLike], gaze: Array) -> None:
    axes = np.ravel(figure.subplots(len(rrs), 1, squeeze=False))
    for number, (ax, image, (x, y)) in enumerate(zip(axes, rrs, gaze, strict=True), start=1):
        draw_rr(ax, image)
        ax.set_title(rf"$\bf{{{number}}}$  {signed(x, y)}", fontsize=NOTE, color=INK, pad=3, loc="left")


def _path(
    figure: FigureBase,
    truth: Array,
    predicted: Array,
    section: tuple[int, int],
    picture: ArrayLike | None,
    aspect: float,
    marks: Sequence[int],
    numbered: Sequence[int],
) -> None:
    """Draw the true path as a band and the predictions as dots tied to it, both coloured by the frame's number."""
    ax = figure.add_subplot()
    extent = (-_FIELD, _FIELD, _FIELD, -_FIELD)
    if picture is not None:
        image = 0.58 + 0.4 * grey_picture(picture, "picture")
        ax.imshow(image, cmap="gray", vmin=0, vmax=1, extent=extent, interpolation="nearest")
    begin, end = section
    a, b = truth[begin:end], predicted[begin:end]
    frames = np.arange(begin, end)
    colours, scale = part_of("plasma", 0.0, 0.9), Normalize(begin, end - 1)
    band = LineCollection(list(np.stack([a[:-1], a[1:]], axis=1)), cmap=colours, norm=scale, linewidths=4.5, zorder=2)
    band.set_array(frames[1:])
    band.set_capstyle("round")
    band.set_path_effects([Stroke(linewidth=6.3, foreground="white"), Normal()])
    ax.add_collection(band)
    # Estimates beyond the field are drawn at its edge, and counted.
    shown = np.clip(b, -_FIELD, _FIELD)
    outside = int((np.abs(b) > _FIELD).any(axis=1).sum())
    ax.add_collection(LineCollection(list(np.stack([a, shown], axis=1)), colors=INK, linewidths=0.5, alpha=0.35))
    dots = ax.scatter(*shown.T, c=frames, cmap=colours, norm=scale, s=15, edgecolors=INK, linewidths=0.6, zorder=4)
    dots.set_clip_on(False)
    for frame in marks:
        ax.annotate(
            f"{numbered.index(frame) + 1}",
            truth[frame],
            xytext=(9, 9),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=NOTE,
            color="white",
            zorder=6,
            bbox={"boxstyle": "circle,pad=0.2", "facecolor": INK, "edgecolor": "white", "linewidth": 0.8},
        )
    dress(ax, letter="a", title="Path over the field of view", x="x, fraction of the width")
    ax.set_ylabel("y, fraction of the height", fontsize=LABEL, color=INK)
    for spine in ax.spines.values():
        spine.set_visible(True)
        spine.set_color(QUIET)
        spine.set_linewidth(0.8)
    ax.axhline(0, color=QUIET, linewidth=0.7, zorder=1)
    ax.axvline(0, color=QUIET, linewidth=0.7, zorder=1)
    ax.set(xlim=(-_FIELD, _FIELD), ylim=(_FIELD, -_FIELD))
    ax.set_aspect(aspect)
    ticks = MaxNLocator(4, steps=[1, 2.5, 5])
    ax.xaxis.set_major_locator(ticks)
    ax.yaxis.set_major_locator(MaxNLocator(4, steps=[1, 2.5, 5]))
    bar = figure.colorbar(dots, ax=ax, orientation="horizontal", pad=0.02, fraction=0.05, aspect=34, shrink=0.9)
    bar.ax.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    note = f"; {outside} of {len(b)} estimates lie outside" if outside else ""
    dress_bar(bar, f"frame (band: truth, dots: estimates{note})")


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
            # On a white seam: the truth stays visible among thousands of dots.
            seam = [Stroke(linewidth=1.9, foreground="white"), Normal()]
            ax.plot(frames[at], truth[at, k], color=INK, linewidth=1.0, zorder=5, path_effects=seam)
        for cut in cuts[1:-1]:
            ax.axvline(cut - 0.5, color=QUIET, linewidth=0.7, linestyle=(0, (2, 3)))
        _dots(ax, frames, predicted[:, k], (-limit, limit), 0)
        off = int((np.abs(predicted[:, k]) > limit).sum())
        note = f" ({off} beyond the axes)" if off else ""
        dress(ax, letter="bc"[k], title=f"{word}{note}", y="fraction of the field")
        ax.set(xlim=(0, len(truth)), ylim=(limit, -limit) if word == "y" else (-limit, limit))
        ax.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    axes[-1].set_xlabel("frame of the test parts, laid end to end", fontsize=LABEL, color=INK)


def _dots(ax: Axes, at: Array | NDArray[np.int64], values: Array, limits: tuple[float, float], order: int) -> None:
    """Draw values as dots, those beyond the limits as triangles at the edge."""
    low, high = limits
    margin = 0.015 * (high - low)
    for off, shown, sign in (
        (values > high, high - margin, "^"),
        (values < low, low + margin, "v"),
    ):
        # An axis may run downwards: the triangle then points the other way on the paper, as it should.
        ax.scatter(at[off], np.full(int(off.sum()), shown), marker=sign, s=14, color=colour(order), zorder=4)
    inside = (values >= low) & (values <= high)
    size = 4.0 if len(values) > 1000 else 9.0
    look_of = {"color": colour(order), "s": size, "linewidths": 0, "alpha": 0.75, "zorder": 3}
    ax.scatter(at[inside], values[inside], marker=marker(order), **look_of)  # type: ignore[arg-type]


def fig_by_image(
    truth: Mapping[str, ArrayLike],
    predicted: Mapping[str, Mapping[str, ArrayLike]],
    *,
    interval: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    order: Sequence[str] = ("object_distance", "focal_length"),
) -> Figure:
    """Draw predictions by test image (the paper's Fig. 11): a row for each quantity, a column for each model.

    Images are sorted by the true object distance, and for each by the true focal length, so that the truth makes steps.

    Parameters
    ----------
    truth
        [N] for each quantity, SI units.
    predicted
        For each model, for each quantity [N].
    interval
        The first model's (lower, upper) for each quantity, [N] each.
    order
        Quantities that the images are sorted by, the slowest first; those not among `truth` are passed over.

    Raises
    ------
    InputError
        When there is no model or quantity, or lengths differ.
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
            _dots(ax, at, said[sort], limits, column)
            # In white first: the steps stay visible among thousands of dots.
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
