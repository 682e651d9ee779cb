"""Put the errors at the sizes laptop and paper side by side into docs/paper.md.

    .venv/bin/python scripts/make_sizes.py [DIR …]

DIR: folders that `tapetum paper learned -o DIR` has written, of any of these sizes; their table1.json is copied to
docs/numbers/table1-SIZE.json. Without one the table is made of what is there already.
"""

from __future__ import annotations

import datetime as dt
import importlib.metadata
import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tapetum.errors import InputError
from tapetum.experiments.templating import table_of
from tapetum.files import atomic_file

ROOT = Path(__file__).parents[1]
NUMBERS, PAGE = ROOT / "docs" / "numbers", ROOT / "docs" / "paper.md"
SIZES = ("laptop", "paper")
_UNITS = {"fraction of the field": ""}


def main(folders: list[str]) -> None:
    for folder in folders:
        told = json.loads((Path(folder) / "table1.json").read_text(encoding="utf-8"))
        if told["size"] not in SIZES:
            raise InputError(f"is of the size {told['size']}, which shows nothing", where=folder)
        told |= {"version": importlib.metadata.version("tapetum"), "date": dt.datetime.now(dt.UTC).date().isoformat()}
        with atomic_file(NUMBERS / f"table1-{told['size']}.json") as part:
            part.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    with atomic_file(PAGE) as part:
        part.write_text(between(text, "sizes", table()), encoding="utf-8")


def table() -> str:
    """The table of what stands in docs/numbers."""
    found = [NUMBERS / f"table1-{size}.json" for size in SIZES]
    return side_by_side([json.loads(one.read_text(encoding="utf-8")) for one in found if one.exists()])


def side_by_side(tables: Sequence[Mapping[str, Any]]) -> str:
    """Write the errors of several table1.json as one table in Markdown.

    Parameters
    ----------
    tables
        Each with `size`, `version`, `date`, `rows` as `table1.json` has them, and `classes` with `top_1` and
        `frames`. A row that one of them lacks becomes a dash there.

    Returns
    -------
    str
        A row for each task and model: MAE, and in brackets that of predicting the training part's mean. An error that
        is not below the mean's is marked as worse.
    """
    rows = [{(row["task"], row["model"]): row for row in one["rows"]} for one in tables]
    keys = list(dict.fromkeys(key for one in rows for key in one))
    lines = [(*key, *(_cell(one.get(key)) for one in rows)) for key in keys]
    classes = [one.get("classes") for one in tables]
    told = ["–" if one is None else f"{100 * one['top_1']:.1f} % of {one['frames']}" for one in classes]
    if any(classes):
        lines.append(("phones identified, top-1", "ResNet-18", *told))
    heads = [f"`{one['size']}`: MAE (the mean's)" for one in tables]
    made = "; ".join(f"`{one['size']}`: Tapetum {one['version']}, {one['date']}" for one in tables)
    return f"{table_of(('task', 'model', *heads), lines)}\n\n*{made}.*"


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "–"
    verdict = "" if row["mae"] < row["guess_mae"] else ", no better than the mean"
    return f"{row['mae']:.3g} ({row['guess_mae']:.3g}{verdict}) {_UNITS.get(row['unit'], row['unit'])}".rstrip()


def between(text: str, name: str, block: str) -> str:
    """Return a document with what stands between `<!-- NAME -->` and `<!-- end NAME -->` replaced.

    Raises
    ------
    ValueError
        When it does not hold exactly one such pair.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end {name} -->"
    pattern = re.compile(rf"{re.escape(begin)}.*?{re.escape(end)}", re.DOTALL)
    if len(pattern.findall(text)) != 1:
        raise ValueError(f"expected one pair of markers {begin} … {end}")
    return pattern.sub(lambda _: f"{begin}\n{block}\n{end}", text)


if __name__ == "__main__":
    main(sys.argv[1:])
