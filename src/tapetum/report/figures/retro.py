"""Figures of retro-reflections: the paper's Fig. 4 grid and samples with the gaze they belong to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError, one_of
from tapetum.report.figures._style import (
    INK,
    LABEL,
    NOTE,
    QUIET,
    TICK,
    TITLE,
    dress_bar,
    gaze_array,
    new_figure,
    signed,
)

__all__ = ["draw_rr", "fig_grid", "fig_samples"]

CMAP = "inferno"
STRETCHES = ("sqrt", "linear", "log")


def stretched(image: ArrayLike, peak: float | None = None, stretch: str = "sqrt") -> NDArray[np.float64]:
    """Return an image as 0..1 of `peak` (its own when None): square root, linear, or four decades of log."""
    one_of(stretch, STRETCHES, "stretch")
    values = np.asarray(image, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.isfinite(values).all():
        raise InputError(f"expected one finite image [H, W], got shape {values.shape}", where="image")
    top = float(values.max()) if peak is None else peak
    part = np.clip(values / top, 0.0, 1.0) if top > 0 else np.zeros_like(values)
    if stretch == "sqrt":
        return np.sqrt(part)
    if stretch == "log":
        return 1.0 + np.log10(np.maximum(part, 1e-4)) / 4.0
    return part


def draw_rr(
    ax: Axes,
    image: ArrayLike,
    *,
    peak: float | None = None,
    stretch: str = "sqrt",
    extent: tuple[float, float, float, float] | None = None,
    interpolation: str = "nearest",
) -> None:
    """Draw one RR without ticks, on its own peak unless `peak` says otherwise."""
    values = stretched(image, peak, stretch)
    ax.imshow(values, cmap=CMAP, vmin=0, vmax=1, extent=extent, interpolation=interpolation)
    ax.set_xticks([])
    ax.set_yticks([])
    for spine in ax.spines.values():
        spine.set_color(QUIET)
        spine.set_linewidth(0.6)


def fig_grid(
    images: ArrayLike,
    row_labels: Sequence[str],
    col_labels: Sequence[str],
    *,
    extent: float | tuple[float, float] | None = None,
    unit: str = "µm",
    row_title: str = "object distance",
    col_title: str = "rotation",
    stretch: str = "sqrt",
    shared_peak: bool = False,
    title: str = "",
) -> Figure:
    """Draw a grid of RRs, as the paper's Fig. 4: a row for each object distance, a column for each rotation.

    Parameters
    ----------
    images
        [R, C, H, W] irradiance, any unit.
    row_labels, col_labels
        R and C labels.
    extent, unit
        Width, or (width, height), of an image in that unit: draws a scale bar.
    row_title, col_title, title
        What changes along rows and columns, and the title of the figure.
    stretch
        "sqrt" (shows rings), "linear" or "log" (four decades).
    shared_peak
        One scale for all images; else each has its own peak, as the paper's "tone mappings" do.

    Raises
    ------
    InputError
        When the shapes do not fit.
    """
    stack = np.asarray(images, dtype=np.float64)
    if stack.ndim != 4 or stack.shape[:2] != (len(row_labels), len(col_labels)) or stack.size == 0:
        raise InputError(
            f"expected images [{len(row_labels)}, {len(col_labels)}, H, W], got {stack.shape}",
            where="images",
            remedy="one label a row and a column",
        )
    one_of(stretch, STRETCHES, "stretch")
    rows, columns, height, width = stack.shape
    cell = 2.05 if max(rows, columns) <= 4 else max(0.85, 8.0 / max(rows, columns))
    figure = new_figure(
        0.95 + 0.55 + columns * cell,
        0.55 + rows * cell * height / width + (0.35 if title else 0.0),
        pictures=True,
    )
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)  # type: ignore[union-attr]
    axes = figure.subplots(rows, columns, squeeze=False)
    peak = float(stack.max()) if shared_peak else None
    for r in range(rows):
        for c in range(columns):
            ax = axes[r, c]
            draw_rr(ax, stack[r, c], peak=peak, stretch=stretch)
            if r == 0:
                ax.set_title(col_labels[c], fontsize=LABEL, color=INK, pad=5)
            if c == 0:
                ax.set_ylabel(row_labels[r], fontsize=LABEL, color=INK, labelpad=6)
            if c == 0 and r == (rows - 1) // 2:
                ax.annotate(
                    f"← {row_title}",
                    (0, 0.5),
                    xytext=(-30, 0),
                    xycoords="axes fraction",
                    textcoords="offset points",
                    rotation=90,
                    ha="center",
                    va="center",
                    fontsize=LABEL,
                    color=QUIET,
                )
    if extent is not None:
        _scale_bar(axes[rows - 1, 0], extent[0] if isinstance(extent, tuple) else extent, width, height, unit)
    lowest: Axes = list(axes[rows - 1])[(columns - 1) // 2]
    lowest.set_xlabel(f"{col_title} →", fontsize=LABEL, color=QUIET, labelpad=6)
    if title:
        figure.suptitle(title, fontsize=TITLE, color=INK)
    scale = axes[0, 0].images[0]
    each = "of the brightest image's peak" if shared_peak else "of each image's peak"
    bar = figure.colorbar(scale, ax=axes, pad=0.015, fraction=0.05, aspect=32)
    levels = {"sqrt": (0.0, 0.01, 0.1, 0.25, 0.5, 1.0), "linear": (0.0, 0.25, 0.5, 0.75, 1.0)}.get(
        stretch, (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
    )
    places = stretched(np.array([levels]), 1.0, stretch)[0]
    bar.set_ticks(places.tolist(), labels=[f"{level:g}" for level in levels])
    dress_bar(bar, f"irradiance, fraction {each}")
    return figure


def round_length(most: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is at most `length`."""
    decade = 10.0 ** np.floor(np.log10(most))
    return max(step * decade for step in (1, 2, 5) if step * decade <= most)


def _scale_bar(ax: Axes, extent: float, width: int, height: int, unit: str) -> None:
    """Draw a bar of a round length, at most 40 % of the image's width."""
    length = round_length(0.4 * extent)
    pixels, left, low = length / extent * width, 0.06 * width, 0.93 * height
    ax.plot([left, left + pixels], [low, low], color="white", linewidth=2.2, solid_capstyle="butt")
    ax.text(left, low - 0.03 * height, f"{length:g} {unit}", color="white", fontsize=TICK, va="bottom")


def fig_samples(images: ArrayLike, gaze: ArrayLike, *, columns: int = 6, stretch: str = "sqrt") -> Figure:
    """Draw sample RRs, each scaled to its own peak, with its gaze in a small map of the field.

    Parameters
    ----------
    images, gaze
        [N, H, W] counts or irradiance, and [N, 2] fractions of the field.
    columns
        Images a row.
    stretch
        As for `fig_grid`.
    """
    stack = np.asarray(images)
    if stack.ndim != 3 or len(stack) == 0:
        raise InputError(f"expected images [N, H, W], got {stack.shape}", where="images")
    places = gaze_array(gaze, "gaze", len(stack))
    columns = min(columns, len(stack))
    rows = -(-len(stack) // columns)
    figure = new_figure(1.62 * columns, 1.8 * rows, pictures=True)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)  # type: ignore[union-attr]
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, image, (x, y) in zip(axes, stack, places, strict=False):
        draw_rr(ax, image, stretch=stretch)
        ax.set_title(signed(x, y), fontsize=NOTE, color=INK, pad=3)
        _field_map(ax, x, y)
    for ax in axes[len(stack) :]:
        ax.set_axis_off()
    return figure


def _field_map(ax: Axes, x: float, y: float) -> None:
    """Draw the field as a small frame in the corner, with a dot at the gaze."""
    width, height, left, low = 0.25, 0.19, 0.71, 0.04
    where = ax.transAxes
    ax.add_patch(
        Rectangle(
            (left, low),
            width,
            height,
            transform=where,
            facecolor="#00000099",
            edgecolor="white",
            linewidth=0.8,
        )
    )
    ax.plot([left + width / 2] * 2, [low, low + height], transform=where, color="#ffffff55", linewidth=0.6)
    ax.plot([left, left + width], [low + height / 2] * 2, transform=where, color="#ffffff55", linewidth=0.6)
    u, v = np.clip([x, y], -0.5, 0.5)
    ax.plot(
        left + width * (u + 0.5),
        low + height * (0.5 - v),
        "o",
        transform=where,
        color="#56b4e9",
        markersize=3.4,
    )
