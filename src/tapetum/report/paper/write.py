"""Make the paper's figures and write them into a folder: a picture, the text beside it, and the numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tapetum.errors import InputError, one_of
from tapetum.files import atomic_file, told_when_full
from tapetum.progress import Progress, quiet
from tapetum.report.figures import save_figure
from tapetum.report.figures.paper import draw_fig4, draw_fig5, draw_fig6, draw_fig7, draw_fig8
from tapetum.report.paper.fig4 import DISTANCES, FOCAL_LENGTHS, ROTATIONS, simulate_fig4
from tapetum.report.paper.fig5 import simulate_fig5
from tapetum.report.paper.fig6 import simulate_fig6
from tapetum.report.paper.fig7 import simulate_fig7
from tapetum.report.paper.fig8 import simulate_fig8
from tapetum.report.paper.text import text_fig4, text_fig5, text_fig6, text_fig7, text_fig8

__all__ = ["FIGURES", "SIZES", "Reproduction", "reproduce"]

SIZES = ("small", "paper")


@dataclass(frozen=True)
class Reproduction:
    """One figure made anew: its name, the files written, and the numbers measured."""

    name: str
    files: tuple[Path, ...]
    numbers: dict[str, Any]


def _fig4(progress: Progress, _size: str) -> tuple[Figure, str, dict[str, Any]]:
    found = simulate_fig4(progress=progress)
    return draw_fig4(found, FOCAL_LENGTHS, DISTANCES, ROTATIONS), text_fig4(found), found.numbers()


def _fig5(progress: Progress, _size: str) -> tuple[Figure, str, dict[str, Any]]:
    found = simulate_fig5(progress=progress)
    return draw_fig5(found), text_fig5(found), found.numbers()


def _fig6(progress: Progress, _size: str) -> tuple[Figure, str, dict[str, Any]]:
    found = simulate_fig6(progress=progress)
    return draw_fig6(found), text_fig6(found), found.numbers()


def _fig7(progress: Progress, size: str) -> tuple[Figure, str, dict[str, Any]]:
    found = simulate_fig7(size=size, progress=progress)
    return draw_fig7(found), text_fig7(found), found.numbers()


def _fig8(progress: Progress, size: str) -> tuple[Figure, str, dict[str, Any]]:
    found = simulate_fig8(size=size, progress=progress)
    return draw_fig8(found), text_fig8(found), found.numbers()


_MAKERS: dict[str, Callable[[Progress, str], tuple[Figure, str, dict[str, Any]]]] = {
    "fig4": _fig4,
    "fig5": _fig5,
    "fig6": _fig6,
    "fig7": _fig7,
    "fig8": _fig8,
}
FIGURES: tuple[str, ...] = tuple(_MAKERS)


def reproduce(
    figures: Sequence[str], out: Path, *, size: str = "paper", progress: Progress = quiet
) -> list[Reproduction]:
    """Make figures of the paper anew, each as NAME.png, NAME.md and NAME.json in a folder.

    Parameters
    ----------
    figures
        Of `FIGURES`; each is made once.
    out
        The folder; it is made where it is not there. Files of these names in it are replaced, others stay.
    size
        `paper`, or `small` for fewer images in the figures of samples, 7 and 8.
    progress
        Shows how far it is.

    Raises
    ------
    InputError
        For an unknown figure or size or none, and for a folder that is a file or cannot be written.
    """
    wanted = list(dict.fromkeys(one_of(name, FIGURES, "figure") for name in figures))
    one_of(size, SIZES, "size")
    if not wanted:
        raise InputError("none is asked for", where="figure", remedy=f"choose of {', '.join(FIGURES)}")
    if out.exists() and not out.is_dir():
        raise InputError("is a file, not a folder", where=out, remedy="choose another name")
    with told_when_full(out):
        out.mkdir(parents=True, exist_ok=True)
    made: list[Reproduction] = []
    for name in wanted:
        figure, text, numbers = _MAKERS[name](progress, size)
        picture, page, table = (out / f"{name}.{kind}" for kind in ("png", "md", "json"))
        save_figure(figure, picture, dpi=130)
        with atomic_file(page) as part:
            part.write_text(text, encoding="utf-8")
        with atomic_file(table) as part:
            part.write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        made.append(Reproduction(name, (picture, page, table), numbers))
    return made
