"""Make the paper's figures and tables and write them into a folder: a picture, its page, and the numbers."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, TypeVar

from matplotlib.figure import Figure

from tapetum.errors import InputError, one_of
from tapetum.experiments.beyond import ablations, development, unseen, untrained
from tapetum.experiments.drawings import draw_fig4, draw_fig5, draw_fig6, draw_fig7, draw_fig8
from tapetum.experiments.fig4 import simulate_fig4
from tapetum.experiments.fig5 import simulate_fig5
from tapetum.experiments.fig6 import simulate_fig6
from tapetum.experiments.fig7 import simulate_fig7
from tapetum.experiments.fig8 import simulate_fig8
from tapetum.experiments.learning import fig9, fig10, fig11, fig12, table1, table2
from tapetum.experiments.sizes import DEFAULT, SIZES, SMOKE_TEST, is_smoke_test, with_note
from tapetum.experiments.templating import render
from tapetum.experiments.workshop import Workshop
from tapetum.files import atomic_file, told_when_full
from tapetum.progress import Progress, quiet
from tapetum.report.figures import save_figure, stamp

__all__ = ["BEYOND", "FIGURES", "GROUPS", "LEARNED", "PRINTED", "Reproduction", "reproduce"]


@dataclass(frozen=True)
class Reproduction:
    """One figure or table reproduced: its name, the files written, and the numbers measured."""

    name: str
    files: tuple[Path, ...]
    numbers: dict[str, Any]


Made = tuple[Figure | None, dict[str, Any]]


class _Simulated(Protocol):
    def numbers(self) -> dict[str, Any]: ...


Found = TypeVar("Found", bound=_Simulated)


def _drawn(found: Found, draw: Callable[[Found], Figure]) -> Made:
    return draw(found), found.numbers()


_MAKERS: dict[str, Callable[[Workshop], Made]] = {
    "fig4": lambda work: _drawn(simulate_fig4(progress=work.progress), draw_fig4),
    "fig5": lambda work: _drawn(simulate_fig5(progress=work.progress), draw_fig5),
    "fig6": lambda work: _drawn(simulate_fig6(progress=work.progress), draw_fig6),
    "fig7": lambda work: _drawn(simulate_fig7(size=work.size, progress=work.progress), draw_fig7),
    "fig8": lambda work: _drawn(simulate_fig8(size=work.size, progress=work.progress), draw_fig8),
    "fig9": fig9,
    "fig10": fig10,
    "fig11": fig11,
    "fig12": fig12,
    "table1": lambda work: (None, table1(work)),
    "table2": lambda work: (None, table2(work)),
    "ablations": lambda work: (None, ablations(work)),
    "development": lambda work: (None, development(work)),
    "unseen": lambda work: (None, unseen(work)),
    "fit": lambda work: (None, untrained(work)),
}
FIGURES: tuple[str, ...] = tuple(_MAKERS)
BEYOND = FIGURES[FIGURES.index("ablations") :]
"""Experiments beyond the paper."""
PRINTED = FIGURES[: FIGURES.index("ablations")]
"""The paper's own figures and tables."""
LEARNED = FIGURES[FIGURES.index("fig9") :]
"""Figures and tables that need filmed sets and trained models."""
GROUPS: dict[str, tuple[str, ...]] = {
    "printed": PRINTED,
    "learned": tuple(name for name in PRINTED if name in LEARNED),
    "beyond": BEYOND,
    "all": FIGURES,
}
"""Names for several figures and tables at once."""


def reproduce(
    figures: Sequence[str],
    out: Path,
    *,
    size: str = DEFAULT,
    work: Workshop | None = None,
    progress: Progress = quiet,
) -> list[Reproduction]:
    """Reproduce figures and tables of the paper, each as NAME.png (not tables), NAME.md and NAME.json in a folder.

    Parameters
    ----------
    figures
        Of `FIGURES` and `GROUPS`; each is made once.
    out
        The folder, created if needed. Files of these names in it are replaced, others stay.
    size
        `laptop`, `paper`, or `small`, a smoke test: fewer images in figures 7 and 8, and shorter videos behind 9 to 12
        and the tables. Pages, pictures and numbers of section 5 state it.
    work
        Where sets and models are kept; by default the folder `work` in `out`.
    progress
        Progress callback.

    Raises
    ------
    InputError
        For an unknown figure or size or none, and for a folder that is a file or cannot be written.
    """
    named = [GROUPS.get(name) or (one_of(name, (*FIGURES, *GROUPS), "figure"),) for name in figures]
    wanted = list(dict.fromkeys(name for group in named for name in group))
    one_of(size, SIZES, "size")
    if not wanted:
        raise InputError("none is asked for", where="figure", remedy=f"choose of {', '.join(FIGURES)}")
    work = Workshop(out / "work", size, progress=progress) if work is None else work
    for folder in (out, work.folder):
        if folder.exists() and not folder.is_dir():
            raise InputError("is a file, not a folder", where=folder, remedy="choose another name")
    with told_when_full(out):
        out.mkdir(parents=True, exist_ok=True)
    made: list[Reproduction] = []
    for name in wanted:
        if name in LEARNED:
            work.folder.mkdir(parents=True, exist_ok=True)
        figure, numbers = _MAKERS[name](work)
        if name in LEARNED:
            numbers = {"size": work.size, **numbers}
        # The page must state the numbers as they are in the JSON file.
        numbers = json.loads(json.dumps(numbers, allow_nan=False))
        text = render(name, numbers)
        if name in LEARNED:
            text = with_note(text, work.size)
            if figure is not None and is_smoke_test(work.size):
                stamp(figure, SMOKE_TEST)
        picture, page, table = (out / f"{name}.{kind}" for kind in ("png", "md", "json"))
        if figure is not None:
            save_figure(figure, picture, dpi=130)
        with atomic_file(page) as part:
            part.write_text(text, encoding="utf-8")
        with atomic_file(table) as part:
            part.write_text(json.dumps(numbers, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        files = (page, table) if figure is None else (picture, page, table)
        made.append(Reproduction(name, files, numbers))
    return made
