"""Pages in Markdown: tables, and paragraphs broken at one width."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Sequence

__all__ = ["filled", "table_of"]


def table_of(names: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table in Markdown."""
    lines = [names, ["---"] * len(names), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def filled(page: str) -> str:
    """Break a page's paragraphs and points at one width; headings, pictures, tables and code stay as they are."""
    done: list[str] = []
    for block in re.split(r"\n{2,}", page.strip()):
        if block[0] in "#!|" or block.startswith("    "):
            done.append(block)
            continue
        points = [" ".join(point.split()) for point in re.split(r"\n(?=- )", block)]
        indent = "  " if block.startswith("- ") else ""
        fill = textwrap.TextWrapper(120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False).fill
        done.append("\n".join(fill(point) for point in points))
    return "\n\n".join(done) + "\n"
