"""Tables: on the terminal, and between the markers of docs/performance.md."""

from __future__ import annotations

import datetime as dt
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from .measure import Row

__all__ = ["DOCUMENT", "markdown", "replaced", "show", "write"]

DOCUMENT = Path(__file__).parents[1] / "docs" / "performance.md"
_HEAD = ("case", "Tapetum", "peer", "ratio (least to largest)", "note")


def show(title: str, rows: Sequence[Row], where: str) -> None:
    """Print one benchmark's table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(*_HEAD, title=title, title_justify="left", caption=where, caption_justify="left")
    for row in rows:
        table.add_row(*row.cells)
    # In a file or a pipe nothing should be cut to an imagined terminal's width.
    Console(width=None if sys.stdout.isatty() else 160).print(table)


def markdown(rows: Sequence[Row], where: str, day: dt.date | None = None) -> str:
    """The same as a Markdown table with a line on the machine and the day."""
    lines = ["| " + " | ".join(_HEAD) + " |", "|---|--:|--:|--:|---|"]
    lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row.cells) + " |" for row in rows]
    day = day or dt.datetime.now(dt.UTC).date()
    return "\n".join([*lines, "", f"*{day.isoformat()}; {where}.*"])


def replaced(text: str, name: str, table: str) -> str:
    """The document with what stands between one benchmark's markers replaced.

    Raises
    ------
    ValueError
        When the document does not hold exactly one such pair.
    """
    begin, end = f"<!-- benchmark {name} -->", f"<!-- end {name} -->"
    pattern = re.compile(rf"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"expected one pair of markers {begin} … {end}")
    return pattern.sub(lambda _: f"{begin}\n{table}\n{end}", text)


def write(name: str, rows: Sequence[Row], where: str, document: Path = DOCUMENT) -> None:
    """Put one benchmark's table into the document, which is then whole or as it was."""
    text = replaced(document.read_text(encoding="utf-8"), name, markdown(rows, where))
    part = document.with_name(f".{document.name}.part")
    part.write_text(text, encoding="utf-8")
    part.replace(document)
