"""The paper's Figs. 4 to 8, drawn from the simulations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from tapetum.experiments.fig4 import DISTANCES, ROTATIONS
from tapetum.report.figures._style import (
    INK,
    LABEL,
    NOTE,
    QUIET,
    TICK,
    TITLE,
    colour,
    dress,
    legend,
    marker,
    new_figure,
)
from tapetum.report.figures.retro import CMAP, draw_rr, round_length

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tapetum.experiments.fig4 import Fig4
    from tapetum.experiments.fig5 import Fig5
    from tapetum.experiments.fig6 import Fig6
    from tapetum.experiments.fig7 import Fig7, Sample
    from tapetum.experiments.fig8 import Fig8

Array = NDArray[np.float64]

__all__ = ["draw_fig4", "draw_fig5", "draw_fig6", "draw_fig7", "draw_fig8"]

_FRAMES = "Frames with their noise, 400 x 400 pixels; brightness is the square root of counts over full scale."
_TONE = "Each image to its own peak; brightness is the square root of the irradiance."


def draw_fig4(found: Fig4) -> Figure:
    """One block of images for each focal length: a row for each object distance, a column for each rotation.

    The first block is large, the others small beside it; each row has its own scale bar.
    """
    blocks = len(found.images)
    figure = new_figure(9.9 if blocks > 1 else 6.6, 6.75)
    lengths = [f"f = {one['focal_length_mm']:g} mm" for one in found.rows[:: len(DISTANCES) * len(ROTATIONS)]]
    parts: list[Figure | SubFigure] = [figure]
    if blocks > 1:
        first, rest = _parted(figure.subfigures(1, 2, width_ratios=(6.5, 3.4)))
        parts = [first, *_parted(rest.subfigures(blocks - 1, 1, squeeze=False))]
    for block, part in enumerate(parts):
        large = block == 0
        part.suptitle(lengths[block], fontsize=TITLE if large else LABEL, color=INK, fontweight="bold")
        names = [rf"$x_d$ = {distance:g} m" for distance in DISTANCES]
        rows = list(zip(names, found.images[block], found.windows, strict=True))
        size = LABEL if large else NOTE
        _grid(part, rows, [f"θ = {rotation:g}°" for rotation in ROTATIONS], size, size, 0.3, small=not large)
    figure.supxlabel(f"{_TONE} A row has one scale.", fontsize=NOTE, color=QUIET)
    return figure


def draw_fig5(found: Fig5) -> Figure:
    """A strip of frames a case, and below them signal and size over the distance."""
    distances = np.array(found.distances)
    figure = new_figure(11.0, 7.2)
    above, below = _parted(figure.subfigures(2, 1, height_ratios=(len(found.strips) * 1.2 + 0.2, 3.4)))
    rows: list[tuple[str, Array, float]] = []
    for strip in found.strips:
        # One scale for all images of a strip, that of the brightest.
        wanted = min(found.window, 1.45 * float(strip.diameter.max()))
        parts = _middle(strip.frames, wanted / found.window)
        shown = found.window * parts.shape[-1] / strip.frames.shape[-1]
        rows.append((strip.name.replace(" at", "\nat").replace(" on", "\non"), np.maximum(parts, 0.0), shown))
    _grid(above, rows, [f"{d:g} m" for d in distances], NOTE, LABEL, 0.5)
    above.supxlabel(f"{_TONE} A row has one scale.", fontsize=NOTE, color=QUIET)
    left, right = below.subplots(1, 2)
    near = float(distances.min())
    fine = np.geomspace(near, float(distances.max()), 50)
    for index, strip in enumerate(found.strips):
        # Scaled by the beam's area from the nearest distance on, as the paper expects.
        start = strip.signal[int(distances.argmin())]
        left.plot(fine, start * (near / fine) ** 2, color=colour(index), linewidth=0.9, alpha=0.7)
        text = f"{strip.name}: {strip.measured.words}"
        left.plot(distances, strip.signal, marker(index), color=colour(index), markersize=5, label=text)
        right.plot(
            distances,
            1e3 * strip.diameter,
            "-",
            marker=marker(index),
            color=colour(index),
            lw=1.0,
            ms=4.5,
            label=strip.name,
        )
    dress(left, title="signal (points) and 1/beam area (lines)", x="distance (m)", letter="a")
    left.set_ylabel("sum above the noise floor (electrons)", fontsize=LABEL, color=INK)
    left.set_xscale("log")
    left.set_yscale("log")
    _plain_x(left, distances)
    dress(right, title="circle with 80 % of the light", x="distance (m)", y="diameter (mm)", letter="b")
    right.set_ylim(bottom=0)
    low, high = left.get_ylim()
    left.set_ylim(low / 12, high)
    legend(left, loc="lower left", title="fitted exponents", title_fontsize=NOTE)
    legend(right, loc="upper right")
    return figure


def draw_fig6(found: Fig6) -> Figure:
    """A row of images a surface, and below them size and brightness over the distance."""
    shown = [surface for surface in found.surfaces if "," not in surface.name]
    distances = np.array(found.distances)
    figure = new_figure(9.0, 1.72 * len(shown) + 3.9)
    above, below = _parted(figure.subfigures(2, 1, height_ratios=(1.72 * len(shown) + 0.3, 3.6)))
    rows = [(one.name.replace(" mm before", " mm\nbefore"), one.images, one.window) for one in shown]
    _grid(above, rows, [f"{d:g} m" for d in distances], LABEL, LABEL, 0.4)
    above.supxlabel(f"{_TONE} A row has one scale.", fontsize=NOTE, color=QUIET)
    left, right = below.subplots(1, 2)
    left.plot(distances, 1e3 * found.aperture_image, color=QUIET, linewidth=1.0, label=r"$D_p\,f_p/d$")
    for index, surface in enumerate(found.surfaces):
        lines = 0.9 if "mirror" in surface.name or "no spread" in surface.name else 0.0
        left.plot(
            distances,
            1e3 * surface.diameter,
            marker=marker(index),
            color=colour(index),
            # The filter's markers coincide with the cardboard's; keep both visible.
            markersize=9 if surface.name == "white cardboard" else 4.5,
            linewidth=lines,
            label=surface.name,
        )
        right.plot(distances, surface.peak, marker=marker(index), color=colour(index), markersize=5, linewidth=0.9)
    for ax in (left, right):
        ax.set_xscale("log")
        ax.set_yscale("log")
        _plain_x(ax, distances)
    dress(left, title="size", x="distance (m)", y="diameter of the equal disc (mm)", letter="a")
    dress(right, title="brightness", x="distance (m)", y="peak irradiance (W/m²)", letter="b")
    left.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    left.set_ylim(0.04, 90)
    legend(left, loc="upper right", ncols=2)
    return figure


def draw_fig7(found: Fig7) -> Figure:
    """Three rows: gaze, object distance and focal length; cells that cannot be simulated are empty."""
    names = {"a": "gaze below the middle", "b": "object distance, f = 135 mm", "c": "focal length, 5.5 m"}
    columns = max(len(samples) for _, samples in found.rows())
    figure = new_figure(1.42 * columns + 0.4, 5.6)
    axes = figure.subplots(3, columns, squeeze=False)
    for r, (letter, samples) in enumerate(found.rows()):
        _samples(axes[r], samples, found.full_scale, found.pitch)
        axes[r, 0].set_ylabel(f"({letter}) {names[letter]}", fontsize=NOTE, color=INK)
    figure.suptitle("Simulated; stand-ins for the paper's lenses", fontsize=LABEL, color=INK)
    figure.supxlabel(_FRAMES, fontsize=NOTE, color=QUIET)
    return figure


def draw_fig8(found: Fig8) -> Figure:
    """The phones in two rows, and below them those with the camera app closed."""
    columns = max(2, -(-len(found.opened) // 2))
    rows = [found.opened[:columns], found.opened[columns:], found.shut]
    names = ["app open", "app open", "app shut"]
    shown = [(name, row) for name, row in zip(names, rows, strict=True) if row]
    figure = new_figure(1.55 * columns + 0.4, 1.8 * len(shown) + 0.6)
    axes = figure.subplots(len(shown), columns, squeeze=False)
    for r, (name, row) in enumerate(shown):
        _samples(axes[r], row, found.full_scale, found.pitch)
        axes[r, 0].set_ylabel(name, fontsize=LABEL, color=INK)
    figure.suptitle("Simulated phones of the catalogue, none of them the paper's", fontsize=LABEL, color=INK)
    figure.supxlabel(_FRAMES, fontsize=NOTE, color=QUIET)
    return figure


def _samples(axes: NDArray[np.object_], samples: Sequence[Sample], full_scale: int, pitch: float) -> None:
    """A row of crops on one brightness scale: the square root of the fraction of full scale."""
    for c, ax in enumerate(axes):
        if c >= len(samples):
            ax.set_axis_off()
            continue
        one = samples[c]
        shown = np.sqrt(one.counts.astype(np.float64) / full_scale)
        ax.imshow(shown, cmap=CMAP, vmin=0, vmax=1, interpolation="antialiased", extent=(0, 1, 0, 1))
        ax.set_xticks([])
        ax.set_yticks([])
        ax.set_title(one.name, fontsize=LABEL, color=INK, pad=3)
        if one.refused:
            ax.text(0.5, 0.5, "not simulated", color="white", fontsize=TICK, ha="center", va="center")
    _bar(axes[0], samples[0].counts.shape[1] * pitch, 0.4, small=True)


def _grid(
    part: FigureBase,
    rows: Sequence[tuple[str, Array, float]],
    headings: Sequence[str],
    name_size: float,
    heading_size: float,
    most: float,
    *,
    small: bool = True,
) -> None:
    """Draw rows of a name, images [C, H, W] and their width in metres, each with a scale bar; headings above."""
    axes = part.subplots(len(rows), len(headings), squeeze=False)
    for r, (name, images, width) in enumerate(rows):
        for ax, image in zip(axes[r], images, strict=True):
            # Averaged where several pixels fall on one of the figure's, or rings would alias.
            draw_rr(ax, image, interpolation="antialiased", extent=(0, 1, 0, 1))
        axes[r, 0].set_ylabel(name, fontsize=name_size, color=INK)
        _bar(axes[r, 0], width, most, small=small)
    for ax, heading in zip(axes[0], headings, strict=True):
        ax.set_title(heading, fontsize=heading_size, color=INK, pad=4)


def _middle(frames: Array, part: float) -> Array:
    """Return the central part of the frames, a fraction of width and height."""
    cut = (frames.shape[-1] - max(2, round(part * frames.shape[-1]))) // 2
    return frames[:, cut:-cut, cut:-cut] if cut > 0 else frames


def _parted(found: object) -> list[SubFigure]:
    # Matplotlib returns one axis or an array, typed as one.
    return list(np.atleast_1d(np.asarray(found, dtype=object)).ravel())


def _bar(ax: Axes, width: float, most: float, *, small: bool) -> None:
    """Draw a scale bar of a round length, at most that part of the image's width, which is in metres."""
    length = round_length(most * width)
    text = f"{1e3 * length:g} mm" if length >= 1e-3 else f"{1e6 * length:g} µm"
    ax.plot([0.06, 0.06 + length / width], [0.06, 0.06], color="white", linewidth=2.0, solid_capstyle="butt")
    ax.text(0.06, 0.09, text, color="white", fontsize=TICK - 1 if small else TICK, va="bottom")
    ax.set_xlim(0, 1)
    ax.set_ylim(0, 1)


def _plain_x(ax: Axes, distances: NDArray[np.float64]) -> None:
    """Label a logarithmic axis with the plain distances that have room."""
    ticks = [d for d in (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0) if distances.min() <= d <= distances.max()]
    ax.set_xticks(ticks, labels=[f"{d:g}" for d in ticks])
    ax.xaxis.set_minor_formatter(NullFormatter())
