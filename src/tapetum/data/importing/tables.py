"""Tables of text: CSV and its kin, read whole and strictly."""

from __future__ import annotations

import csv
from pathlib import Path

from tapetum.errors import InputError
from tapetum.record.source import existing

__all__ = ["TABLE_SUFFIXES", "read_table"]

TABLE_SUFFIXES = (".csv", ".tsv", ".txt")
_AGAIN = "copy or export it again"


def _number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def read_table(path: str | Path) -> dict[str, list[str]]:
    """Read a table with a comma, semicolon, tab or blank between its cells.

    Parameters
    ----------
    path
        A text file. Its first line names the columns, unless it holds numbers only: then they are called 0, 1, 2 …

    Returns
    -------
    dict
        The cells of every column, as text.

    Raises
    ------
    InputError
        When it is missing, empty, no text, or a line has more or fewer cells than the first.
    """
    file = existing(path)
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot be read as text ({error})", where=file, remedy="save it as CSV in UTF-8") from error
    if "\0" in text:
        raise InputError("holds bytes that are no text", where=file, remedy=_AGAIN)
    head = text.partition("\n")[0]
    between = next((one for one in ",;\t" if one in head), " " if " " in head.strip() else ",")
    try:
        reader = csv.reader(text.splitlines(), delimiter=between, skipinitialspace=True, strict=True)
        lines = [(reader.line_num, [cell.strip() for cell in row]) for row in reader if any(map(str.strip, row))]
    except csv.Error as error:
        raise InputError(f"is no table ({error})", where=file, remedy=_AGAIN) from error
    if not lines:
        raise InputError("is empty", where=file, remedy=_AGAIN)
    named = not all(map(_number, lines[0][1]))
    names = lines[0][1] if named else [str(n) for n in range(len(lines[0][1]))]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"has two columns {twice!r}", where=file, remedy="rename one of them")
    rows = lines[1:] if named else lines
    if not rows:
        raise InputError("has no rows below its names", where=file, remedy=_AGAIN)
    for number, cells in rows:
        if len(cells) != len(names):
            raise InputError(f"line {number} has {len(cells)} cells, the first {len(names)}", where=file, remedy=_AGAIN)
    return dict(zip(names, map(list, zip(*(cells for _, cells in rows), strict=True)), strict=True))
