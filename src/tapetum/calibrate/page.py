"""The page of a calibration: verdict, numbers, picture and checks, in one file."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Iterable, Sequence

from matplotlib.figure import Figure

from tapetum.calibrate.verdict import Check, rows, to_mend, verdict
from tapetum.report.html import bullets, facts, figure, note, page, section, table, write_page

__all__ = ["write_calibration"]


def write_calibration(
    path: str | os.PathLike[str],
    title: str,
    checks: Sequence[Check],
    numbers: Iterable[tuple[str, str]],
    picture: Figure,
    *,
    alt: str,
    caption: str,
    notes: Sequence[str] = (),
) -> None:
    """Write a calibration's page.

    Parameters
    ----------
    path, title
        The HTML file, which is replaced, and its heading.
    checks, numbers
        What was checked, and names and values of what was measured.
    picture, alt, caption
        The figure, its description, and the text below it.
    notes
        What a reader must know of the numbers.
    """
    failed = to_mend(checks)
    said = bullets(check.line for check in failed) if failed else ""
    pieces = [
        note(f"Verdict: {verdict(checks)}", said),
        section("Measured", facts(numbers)),
        section("Picture", figure(picture, alt=alt, caption=caption)),
        section("Checks", table(["", "found", "wanted", "verdict"], rows(checks))),
    ]
    if notes:
        pieces.append(section("Notes", bullets(notes)))
    write_page(path, page(title, *pieces, footer=f"Tapetum {importlib.metadata.version('tapetum')}"))
