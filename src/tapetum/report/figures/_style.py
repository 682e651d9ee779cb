"""One style for all figures: colours for colour-blind readers, thread-safe without pyplot and rcParams."""

from __future__ import annotations

import io
import os
import textwrap
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from tapetum.errors import InputError
from tapetum.files import atomic_file

__all__ = ["figure_png", "save_figure", "stamp"]

INK = "#1b1f24"
QUIET = "#6b7280"
RULE = "#d5d9df"
# Okabe & Ito's palette (Color Universal Design, 2008), the dark and saturated ones first.
MODELS: tuple[str, ...] = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
MARKERS: tuple[str, ...] = ("o", "s", "^", "D", "v", "P")
TITLE, LABEL, TICK, NOTE = 10.5, 9.0, 8.0, 8.0


def new_figure(width: float, height: float, *, pictures: bool = False) -> Figure:
    """Return an empty white figure of that size in inches, drawn by Agg; `pictures` packs panels closely."""
    figure = Figure(
        figsize=(width, height),
        dpi=110,
        layout="compressed" if pictures else "constrained",
        facecolor="white",
    )
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.05, h_pad=0.05)  # type: ignore[union-attr]
    return figure


def dress(ax: Axes, *, title: str = "", x: str = "", y: str = "", grid: str | None = "both", letter: str = "") -> Axes:
    """Give axes their title, labels and quiet rules; `letter` names the panel in bold."""
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(QUIET)
        ax.spines[side].set_linewidth(0.8)
    ax.tick_params(labelsize=TICK, color=QUIET, labelcolor=INK, length=3, width=0.8)
    if grid is not None:
        ax.grid(True, axis=grid, color=RULE, linewidth=0.6)  # type: ignore[arg-type]
        ax.set_axisbelow(True)
    if title or letter:
        heading = rf"$\bf{{{letter}}}$  {title}" if letter else title
        ax.set_title(heading, fontsize=TITLE, color=INK, loc="left", pad=7)
    if x:
        ax.set_xlabel(x, fontsize=LABEL, color=INK)
    if y:
        ax.set_ylabel(y, fontsize=LABEL, color=INK)
    return ax


def dress_bar(bar: object, label: str) -> None:
    """Give a colour bar its label and quiet outline."""
    ax: Axes = bar.ax  # type: ignore[attr-defined]
    bar.outline.set_visible(False)  # type: ignore[attr-defined]
    ax.tick_params(labelsize=TICK, color=QUIET, labelcolor=INK, length=2.5)
    bar.set_label(label, fontsize=LABEL, color=INK)  # type: ignore[attr-defined]


def legend(ax: Axes, **options: object) -> None:
    """Draw a frameless legend."""
    ax.legend(frameon=False, fontsize=NOTE, labelcolor=INK, **options)  # type: ignore[arg-type]


def part_of(name: str, low: float, high: float) -> Colormap:
    """Return the part low ... high (0..1) of a named colour map, without ends that vanish in the background."""
    return ListedColormap(colormaps[name](np.linspace(low, high, 256)), name=f"{name}-part")


def grey_picture(picture: ArrayLike, where: str) -> NDArray[np.float64]:
    """Return a picture [H, W] as 0..1, from its 0.5th to its 99.7th percentile; it must be finite."""
    image = np.asarray(picture, dtype=np.float64)
    if image.ndim != 2 or image.size == 0 or not np.isfinite(image).all():
        raise InputError(f"expected one finite picture [H, W], got shape {image.shape}", where=where)
    low, high = np.quantile(image, (0.005, 0.997))
    return np.clip((image - low) / max(float(high - low), 1e-12), 0.0, 1.0)


def gaze_array(values: ArrayLike, where: str, count: int | None = None) -> NDArray[np.float64]:
    """Return gaze as a finite array [N, 2]; refuses other shapes and values."""
    array = np.asarray(values, dtype=np.float64)
    shaped = array.ndim == 2 and array.shape[1] == 2 and (count is None or len(array) == count)
    if not shaped or len(array) == 0 or not np.isfinite(array).all():
        wanted = "N" if count is None else str(count)
        raise InputError(f"expected finite gaze [{wanted}, 2], got shape {array.shape}", where=where)
    return array


def runs(time: ArrayLike, gap: float = 4.0) -> list[slice]:
    """Return runs of frames without a gap: time steps of at most `gap` medians, never backwards."""
    stamps = np.asarray(time, dtype=np.float64)
    steps = np.diff(stamps)
    forward = steps[steps > 0]
    limit = gap * float(np.median(forward)) if len(forward) else np.inf
    cuts = np.flatnonzero((steps <= 0) | (steps > limit)) + 1
    edges = [0, *cuts.tolist(), len(stamps)]
    return [slice(a, b) for a, b in pairwise(edges)]


def signed(x: float, y: float) -> str:
    """Return a gaze as "+0.12, −0.30", with a true minus and no negative zero."""
    return ", ".join(f"{round(value, 2) + 0.0:+.2f}".replace("-", "−") for value in (float(x), float(y)))


def colour(index: int) -> str:
    """Return the colour of the model number `index`, the same in every figure."""
    return MODELS[index % len(MODELS)]


def marker(index: int) -> str:
    """Return the marker of the model number `index`, so that colour is not the only cue."""
    return MARKERS[index % len(MARKERS)]


def draw_dots(
    ax: Axes, at: NDArray[np.generic], values: NDArray[np.float64], limits: tuple[float, float], order: int
) -> None:
    """Draw values as dots, the first model's in front, and those beyond the limits as triangles at the edge."""
    low, high = limits
    margin = 0.015 * (high - low)
    for off, shown, sign in (
        (values > high, high - margin, "^"),
        (values < low, low + margin, "v"),
    ):
        # On an inverted axis the triangle points the other way on the page.
        ax.scatter(at[off], np.full(int(off.sum()), shown), marker=sign, s=14, color=colour(order), zorder=4)
    inside = (values >= low) & (values <= high)
    size = 4.0 if len(values) > 1000 else 9.0
    look_of = {"color": colour(order), "s": size, "linewidths": 0, "alpha": 0.75, "zorder": 4 - 0.1 * order}
    ax.scatter(at[inside], values[inside], marker=marker(order), **look_of)  # type: ignore[arg-type]


def stamp(figure: Figure, text: str) -> None:
    """Write a warning across a figure, large enough that no copy passes for a result."""
    lines = "\n".join(textwrap.wrap(text, 34))
    figure.text(0.5, 0.5, lines, fontsize=20, color="#b00020", alpha=0.45, rotation=20, ha="center", va="center")


def figure_png(figure: Figure, dpi: int = 160) -> bytes:
    """Return the figure as a PNG file's bytes."""
    stream = io.BytesIO()
    # Without date and version, equal figures give equal bytes.
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: int = 160) -> Path:
    """Write the figure as .png, .pdf or .svg, whole or not at all.

    Raises
    ------
    InputError
        When the ending is another one, or the file cannot be written.
    """
    target = Path(path)
    kinds: Sequence[str] = (".png", ".pdf", ".svg")
    if target.suffix.lower() not in kinds:
        raise InputError(
            f"cannot draw a {target.suffix or 'nameless'} file",
            where=target,
            remedy=f"use one of {', '.join(kinds)}",
        )
    with atomic_file(target) as part:
        figure.savefig(part, format=target.suffix.lower()[1:], dpi=dpi)
    return target
