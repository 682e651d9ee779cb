"""A contact sheet of a dataset: retro-reflections arranged by label, with the labels' distributions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from tapetum.data.dataset import image_batches
from tapetum.data.quality import DatasetQuality, Spread, class_names
from tapetum.errors import InputError
from tapetum.report.figures._style import INK, MODELS, NOTE, QUIET, RULE, TICK, dress, new_figure

__all__ = ["fig_contact_sheet"]

_GAZE = ("gaze_x", "gaze_y")
_CMAP = colormaps["inferno"]
_COLUMNS, _ROWS = 13, 9
_WIDE, _HIGH = 12.0, 8.4
# Margin of a cell, as a fraction of it.
_GAP = 0.04
# Counts below the corners' median plus this many of their deviations are noise: they stay dark.
_DARK = 1.0
# Share of its peak where an RR is cut off, so that its shape fills the cell.
_RIM = 0.08


def fig_contact_sheet(
    dataset: xr.Dataset, quality: DatasetQuality, *, name: str = "", notes: Sequence[str] = ()
) -> Figure:
    """Draw a dataset: retro-reflections in the order of their labels, the range of the labels, notes on its quality.

    With gaze labels only, each RR is drawn at its place in the target's field of view. With a class, or with focal
    length and object distance, there is a row for each class (or focal length), and columns by object distance or by
    the gaze's distance from the centre. Refuses a set without labels.
    """
    if not dataset.tp.targets:
        raise InputError("has no labels to sort the pictures by", where=name or "dataset", remedy="label it first")
    rows = _row_label(dataset)
    figure = new_figure(_WIDE, _HIGH)
    figure.set_layout_engine(None)
    if rows is None and set(_GAZE) <= set(dataset.tp.targets):
        _draw_field(figure, dataset)
    else:
        _draw_rows(figure, dataset, rows)
    _heading(figure, dataset, quality, name)
    _side(figure, quality, gaze=rows is not None)
    _footing(figure, dataset, notes)
    return figure


def _row_label(dataset: xr.Dataset) -> str | None:
    """Return the label of the rows: a class, or a length of few values; None for sets with gaze alone."""
    names = [n for n in ("device", "focal_length", "object_distance") if n in dataset.tp.targets]
    names += [n for n in dataset.tp.targets if n not in _GAZE and n not in names]
    spread = [n for n in names if np.ptp(np.asarray(dataset[n].values, dtype=float)) > 0]
    return spread[0] if spread else (None if set(_GAZE) <= set(dataset.tp.targets) else names[0] if names else None)


def _draw_field(figure: Figure, dataset: xr.Dataset) -> None:
    """Draw the RRs at their gaze, with the distributions of x and y along the edges."""
    gaze = dataset.tp.values(_GAZE)
    reach = 0.5 if np.abs(gaze).max() > 0.25 else max(float(np.abs(gaze).max()) * 1.05, 1e-3)
    across, down = (np.linspace(-reach, reach, n + 1) for n in (_COLUMNS, _ROWS))
    cells: dict[tuple[int, int], int] = {}
    place = np.floor((gaze / reach + 1) / 2 * (_COLUMNS, _ROWS)).clip(0, (_COLUMNS - 1, _ROWS - 1))
    for r in range(_ROWS):
        for c in range(_COLUMNS):
            here = np.flatnonzero((place == (c, r)).all(axis=1))
            if here.size:
                middle = (across[c] + across[c + 1]) / 2, (down[r] + down[r + 1]) / 2
                cells[r, c] = int(here[np.hypot(*(gaze[here] - middle).T).argmin()])
    left, bottom, width = 0.075, 0.185, 0.64
    height = width * _WIDE / _HIGH * _ROWS / _COLUMNS
    ax = figure.add_axes((left, bottom, width, height))
    _mosaic(ax, dataset, cells, _ROWS, _COLUMNS)
    ticks = np.linspace(-reach, reach, 5)
    names = [_signed(value) for value in ticks]
    for at, count, label in ((ax.xaxis, _COLUMNS, "gaze x"), (ax.yaxis, _ROWS, "gaze y")):
        at.set_ticks(((ticks / reach + 1) / 2 * count).tolist(), labels=names)
        at.set_label_text(f"{label}, fraction of the field of view", fontsize=NOTE + 0.5, color=INK)
    top = figure.add_axes((left, bottom + height + 0.008, width, 0.055))
    right = figure.add_axes((left + width + 0.006, bottom, 0.045, height))
    bins = np.linspace(-reach, reach, 4 * _COLUMNS + 1), np.linspace(-reach, reach, 4 * _ROWS + 1)
    for axis, values, edges, lying in ((top, gaze[:, 0], bins[0], False), (right, gaze[:, 1], bins[1], True)):
        counts = np.histogram(values, edges)[0]
        middle, step = (edges[:-1] + edges[1:]) / 2, 0.86 * (edges[1] - edges[0])
        (axis.barh if lying else axis.bar)(middle, counts, step, color=MODELS[0])
        (axis.set_ylim if lying else axis.set_xlim)(*((reach, -reach) if lying else (-reach, reach)))
        axis.set_axis_off()


def _signed(value: float) -> str:
    """Return a number with its sign, a true minus, and none for zero."""
    return f"{value:+.3g}".replace("-", "−") if abs(value) > 1e-9 else "0"


def _draw_rows(figure: Figure, dataset: xr.Dataset, name: str | None) -> None:
    """Draw a row for each value of a label."""
    label = name or dataset.tp.targets[0]
    values = np.asarray(dataset[label].values, dtype=float)
    groups = _groups(values)
    along, heading = _along(dataset, label)
    steps = np.unique(along)
    # Few values: a column each. Many: columns of equally many frames.
    columns = len(steps) if 1 < len(steps) <= 12 else int(np.clip(0.6 / 0.68 * _WIDE / _HIGH * len(groups), 6, 14))
    cells: dict[tuple[int, int], int] = {}
    for r, group in enumerate(groups):
        own = np.flatnonzero(group)
        for c in range(columns):
            if columns == len(steps):
                here = own[along[own] == steps[c]]
                if here.size:
                    cells[r, c] = int(here[len(here) // 2])
            elif own.size:
                ranked = own[np.argsort(along[own], kind="stable")]
                cells[r, c] = int(ranked[min(round((c + 0.5) / columns * len(ranked)), len(ranked) - 1)])
    left, bottom, most = 0.12, 0.175, (0.6, 0.68)
    side = min(most[0] * _WIDE / columns, most[1] * _HIGH / len(groups))
    width, height = side * columns / _WIDE, side * len(groups) / _HIGH
    bottom += (most[1] - height) / 2
    ax = figure.add_axes((left, bottom, width, height))
    _mosaic(ax, dataset, cells, len(groups), columns)
    ax.set_yticks((np.arange(len(groups)) + 0.5).tolist(), labels=[_value(dataset, label, values[g]) for g in groups])
    if columns == len(steps):
        ax.set_xticks((np.arange(columns) + 0.5).tolist(), labels=[f"{s:.3g}" for s in steps])
    else:
        marks = [0, columns // 2, columns - 1]
        quantile = [float(np.quantile(along, (c + 0.5) / columns)) for c in marks]
        ax.set_xticks([c + 0.5 for c in marks], labels=[f"{q:.2g}" for q in quantile])
    ax.set_xlabel(heading, fontsize=NOTE + 0.5, color=INK)
    counts = figure.add_axes((left + width + 0.006, bottom, 0.045, height))
    numbers = [int(group.sum()) for group in groups]
    counts.barh(np.arange(len(groups)) + 0.5, numbers, min(0.5, 0.1 / side), color=MODELS[0])
    for r, number in enumerate(numbers):
        counts.annotate(
            str(number), (0, r + 0.5), (0, 9), textcoords="offset points", fontsize=TICK, color=QUIET, va="center"
        )
    counts.set_ylim(len(groups), 0)
    counts.set_axis_off()


def _groups(values: NDArray[np.float64], most: int = 12) -> list[NDArray[np.bool_]]:
    distinct = np.unique(values)
    if len(distinct) <= most:
        return [values == v for v in distinct]
    edges = np.quantile(values, np.linspace(0, 1, 9))
    which = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, 7)
    return [which == n for n in range(8) if (which == n).any()]


def _along(dataset: xr.Dataset, row: str) -> tuple[NDArray[np.float64], str]:
    """Return the quantity that grows along a row, [N], and its name."""
    if "object_distance" in dataset.tp.targets and row != "object_distance":
        return np.asarray(dataset["object_distance"].values, dtype=float), "object distance, m"
    if set(_GAZE) <= set(dataset.tp.targets):
        gaze = dataset.tp.values(_GAZE)
        return np.hypot(gaze[:, 0], gaze[:, 1]), "distance of the gaze from the middle, fraction of the field of view"
    if "time" in dataset:
        return np.asarray(dataset["time"].values, dtype=float), "time in the recording, s"
    return np.arange(dataset.sizes["frame"], dtype=float), "frame"


def _value(dataset: xr.Dataset, label: str, values: NDArray[np.float64]) -> str:
    if names := class_names(dataset, label):
        return names[int(values[0])]
    if label == "focal_length":
        return f"f = {1e3 * values.mean():.4g} mm"
    return f"{values.mean():.3g}" + (" m" if dataset[label].attrs.get("units") == "m" else "")


def _mosaic(ax: Axes, dataset: xr.Dataset, cells: dict[tuple[int, int], int], rows: int, columns: int) -> None:
    """Draw the chosen frames into their cells, each on its own square-root scale; other cells stay dark."""
    frames = sorted(set(cells.values()))
    pictures = dict(
        zip(frames, (p for batch in image_batches(dataset.isel(frame=frames), 32) for p in batch), strict=True)
    )
    half = _half(list(pictures.values()))
    ax.set_facecolor(_CMAP(0.0))
    for (r, c), frame in cells.items():
        picture = np.nan_to_num(np.asarray(pictures[frame], dtype=np.float64))
        middle = picture.shape[0] / 2
        part = slice(math.floor(middle - half), math.ceil(middle + half))
        extent = (c + _GAP, c + 1 - _GAP, r + 1 - _GAP, r + _GAP)
        ax.imshow(
            _stretched(picture)[part, part], cmap=_CMAP, vmin=0, vmax=1, extent=extent, interpolation="antialiased"
        )
    ax.set(xlim=(0, columns), ylim=(rows, 0), aspect="auto")
    ax.tick_params(labelsize=TICK, color=QUIET, labelcolor=INK, length=3, width=0.8)
    for spine in ax.spines.values():
        spine.set_visible(False)
    figure = ax.get_figure(root=True)
    assert figure is not None
    told = f"each {2 * half:.0f} px wide, square root, on its own peak"
    figure.text(0.975, 0.92, told, fontsize=TICK + 0.5, color=QUIET, va="center", ha="right")


def _stretched(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    rim = np.concatenate([picture[0], picture[-1], picture[:, 0], picture[:, -1]])
    dark = float(np.median(rim) + _DARK * rim.std())
    return np.sqrt(np.clip((picture - dark) / max(float(picture.max()) - dark, 1e-9), 0, 1))


def _half(pictures: list[NDArray[Any]]) -> float:
    """Return half the width that shows three in four RRs down to `_RIM` of their peak."""
    reach = []
    for picture in pictures:
        light = _stretched(np.nan_to_num(np.asarray(picture, dtype=np.float64))) ** 2
        profile = np.maximum(light.max(axis=0), light.max(axis=1))
        bright = np.flatnonzero(profile > _RIM)
        middle = (len(profile) - 1) / 2
        reach.append(float(np.abs(bright - middle).max()) if bright.size else middle)
    side = pictures[0].shape[0] / 2
    return float(np.clip(1.1 * np.quantile(reach, 0.75), min(8, side), side))


def _heading(figure: Figure, dataset: xr.Dataset, quality: DatasetQuality, name: str) -> None:
    figure.text(0.03, 0.96, name or "dataset", fontsize=17, color=INK, weight="bold", va="center")
    recordings = len(quality.per_recording)
    told = (
        f"{quality.frames} retro-reflections of {quality.side} px",
        f"{recordings} recording{'s' * (recordings != 1)}",
    )
    line = "  ·  ".join((*told, f"{quality.train} to train on, {quality.test} to test"))
    figure.text(0.03, 0.92, line, fontsize=10, color=QUIET, va="center")


def _side(figure: Figure, quality: DatasetQuality, *, gaze: bool) -> None:
    """Draw the other distributions in a column at the right."""
    shown: list[tuple[str, Spread]] = [
        (f"{name.replace('_', ' ')}{', m' if one.unit == 'm' else ''}", one.spread)
        for name, one in quality.labels.items()
        if name not in _GAZE or gaze
    ]
    shown = [one for one in shown if one[1].least < one[1].most and "device" not in one[0]]
    shown += [("signal over noise", quality.snr), ("off centre, px", quality.off_centre)]
    if quality.quality is not None:
        shown.append(("label quality", quality.quality))
    shown.append(("pixels at full scale, share", quality.saturated_share))
    shown = shown[:6]
    top, bottom = 0.875, 0.15
    each = (top - bottom) / len(shown)
    for n, (title, spread) in enumerate(shown):
        low = top - (n + 1) * each + 0.42 * each
        ax = figure.add_axes((0.81, low, 0.165, 0.44 * each))
        dress(ax, grid=None)
        ax.spines["left"].set_visible(False)
        ax.set_yticks([])
        ax.set_title(title, fontsize=NOTE + 0.5, color=INK, loc="left", pad=4)
        if spread.least == spread.most or not spread.counts:
            ax.set_xticks([])
            value = f"{spread.least:.4g} everywhere" if spread.counts else "none"
            ax.text(0, 0.4, value, transform=ax.transAxes, fontsize=NOTE, color=QUIET, va="center")
            continue
        edges = np.asarray(spread.edges)
        ax.bar((edges[:-1] + edges[1:]) / 2, spread.counts, 0.86 * np.diff(edges), color=MODELS[0])
        ax.set_xlim(edges[0], edges[-1])
        digits = 3 if spread.most - spread.least > 0.05 * abs(spread.most) else 5
        ax.set_xticks([edges[0], edges[-1]], labels=[f"{edges[0]:.{digits}g}", f"{edges[-1]:.{digits}g}"])
        for text, side in zip(ax.get_xticklabels(), ("left", "right"), strict=True):
            text.set_horizontalalignment(side)


def _footing(figure: Figure, dataset: xr.Dataset, notes: Sequence[str]) -> None:
    lines = [note if len(note) <= 150 else note[:149] + "…" for note in notes[:4]]
    for n, line in enumerate(lines):
        figure.text(0.03, 0.102 - 0.021 * n, line, fontsize=NOTE + 0.5, color=INK, va="center")
    rule = Line2D([0.03, 0.975], [0.026, 0.026], transform=figure.transFigure, color=RULE, linewidth=0.8)
    figure.add_artist(rule)
    mark = f"sha256 {dataset.tp.hash[:16]}…  ·  drawn by Tapetum {version('tapetum')}"
    told = ", ".join(str(one.get("name", "")) for one in dataset.tp.recordings[:6])
    more = "" if len(dataset.tp.recordings) <= 6 else f" and {len(dataset.tp.recordings) - 6} more"
    source = f"from {told}{more}" if told else ""
    figure.text(0.03, 0.012, source[:110], fontsize=TICK - 0.5, color=QUIET, va="center")
    figure.text(0.975, 0.012, mark, fontsize=TICK - 0.5, color=QUIET, va="center", ha="right")
