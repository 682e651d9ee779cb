"""Draws docs/images/first-bench.svg: the set-up of a first bench, from above, not to scale."""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Ellipse, FancyArrowPatch, Polygon, Rectangle

from tapetum.report.figures._style import INK, QUIET, RULE, new_figure

RED, BLUE = "#d55e00", "#0072b2"
OUT = Path(__file__).parents[1] / "docs" / "images" / "first-bench.svg"


def box(ax: Axes, x: float, y: float, width: float, height: float, words: str, **style: object) -> None:
    ax.add_patch(Rectangle((x, y), width, height, facecolor="white", edgecolor=INK, linewidth=1.2, zorder=3))
    ax.text(x + width / 2, y + height / 2, words, ha="center", va="center", fontsize=8, color=INK, zorder=4, **style)


def lens(ax: Axes, x: float, y: float, height: float, words: str, below: float) -> None:
    ax.add_patch(Ellipse((x, y), 0.22, height, facecolor="#e8f1f8", edgecolor=INK, linewidth=1.2, zorder=3))
    ax.text(x, y - height / 2 - below, words, ha="center", va="top", fontsize=8, color=INK)


def ray(ax: Axes, *points: tuple[float, float], colour: str, back: bool = False) -> None:
    style = {"color": colour, "linewidth": 1.3, "linestyle": (0, (4, 2)) if back else "-", "zorder": 2}
    for start, end in itertools.pairwise(points):
        ax.plot(*zip(start, end, strict=True), **style)
    (x0, y0), (x1, y1) = points[-2:]
    middle = (x0 + 0.62 * (x1 - x0), y0 + 0.62 * (y1 - y0))
    before = (x0 + 0.58 * (x1 - x0), y0 + 0.58 * (y1 - y0))
    ax.add_patch(
        FancyArrowPatch(before, middle, arrowstyle="-|>", mutation_scale=10, color=colour, linewidth=0, zorder=2)
    )


def draw(path: Path) -> None:
    """Draw the bench and write it as SVG."""
    mpl.rcParams["svg.hashsalt"] = "first-bench"  # the same picture gives the same file
    figure = new_figure(10, 4.4)
    ax = figure.add_subplot()
    ax.set_xlim(-0.4, 13.4)
    ax.set_ylim(-1.1, 4.7)
    ax.set_aspect("equal")
    ax.set_axis_off()

    # The probe: laser above, splitter, camera to the left, all on one plate.
    ax.add_patch(Rectangle((-0.2, -0.55), 4.95, 5.1, facecolor="#fafbfc", edgecolor=RULE, linewidth=1, zorder=0))
    ax.text(-0.05, 4.3, "probe", fontsize=9, color=QUIET, style="italic")
    box(ax, 2.6, 3.65, 0.9, 0.65, "laser")
    ax.add_patch(Ellipse((3.05, 3.1), 0.75, 0.16, facecolor="#e8f1f8", edgecolor=INK, linewidth=1.2, zorder=3))
    ax.text(3.6, 3.1, "laser's lens: sets\nthe divergence", ha="left", va="center", fontsize=8, color=INK)
    plate = [(2.6, 1.85), (3.5, 0.95), (3.57, 1.02), (2.67, 1.92)]
    ax.add_patch(Polygon(plate, facecolor="#d8e6f0", edgecolor=INK, zorder=3))
    ax.text(3.65, 0.75, "beam\nsplitter", ha="left", va="center", fontsize=8, color=INK)
    lens(ax, 1.75, 1.4, 1.3, "probe\nlens", 0.08)
    box(ax, 0.1, 1.0, 0.75, 0.8, "probe\ncamera")
    ax.add_patch(Rectangle((2.58, -0.28), 0.95, 0.12, facecolor=INK, edgecolor=INK, zorder=3))
    ax.text(3.65, -0.22, "beam dump", ha="left", va="center", fontsize=8, color=INK)

    # The target.
    lens(ax, 11.1, 1.4, 1.0, "target's lens,\nfocused on the probe", 0.1)
    box(ax, 12.0, 1.0, 0.65, 0.8, "target\ncamera")
    ax.add_patch(Circle((12.0, 1.4), 0.05, color=RED, zorder=5))

    # Light out, and back.
    ray(ax, (3.05, 3.65), (3.05, 1.45), colour=RED)
    ray(ax, (3.05, 1.45), (11.1, 1.75), colour=RED)
    ray(ax, (3.05, 1.45), (11.1, 1.05), colour=RED)
    ray(ax, (11.1, 1.75), (12.0, 1.4), colour=RED)
    ray(ax, (11.1, 1.05), (12.0, 1.4), colour=RED)
    ray(ax, (3.05, 1.45), (3.05, -0.16), colour=RED)
    ray(ax, (11.1, 1.55), (3.0, 1.5), (1.75, 1.5), (0.85, 1.4), colour=BLUE, back=True)
    ray(ax, (11.1, 1.25), (3.0, 1.3), (1.75, 1.3), (0.85, 1.4), colour=BLUE, back=True)

    ax.annotate("", (10.95, 0.1), (3.1, 0.1), arrowprops={"arrowstyle": "<->", "color": QUIET, "linewidth": 1})
    ax.text(7.0, 0.0, "distance, 2 to 6 m for a start", ha="center", va="top", fontsize=8, color=QUIET)
    ax.text(
        8.4, 2.05, "light out (solid) and back (dashed)\non one axis", ha="center", va="bottom", fontsize=8, color=INK
    )
    box(ax, 6.0, 3.45, 2.4, 0.7, "computer: tapetum record")
    for across, up in (([0.48, 0.48, 6.6, 6.6], [1.8, 2.6, 2.6, 3.45]), ([12.33, 12.33, 8.4], [1.8, 3.8, 3.8])):
        ax.plot(across, up, color=QUIET, linewidth=0.9, zorder=1)
    ax.plot([3.5, 6.0], [3.98, 3.98], color=QUIET, linewidth=0.9, zorder=1)
    ax.text(4.9, 4.05, "blink driver", ha="center", va="bottom", fontsize=8, color=QUIET)
    figure.savefig(path, format="svg", metadata={"Date": None})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, nargs="?", default=OUT)
    draw(parser.parse_args().out)
