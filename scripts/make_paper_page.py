"""Make the parts of docs/paper.md that hold results, docs/includes/*.md, of the numbers in docs/numbers.

    .venv/bin/python scripts/make_paper_page.py [DIR …]

DIR: folders that `tapetum paper` has written; of their figures 4 to 10 and ablations the pages are copied to
docs/includes and the pictures to docs/images, table1.json to docs/numbers/table1-SIZE.json, and the lines of
sealed.jsonl are added to docs/numbers. What networks had measured before is made of docs/numbers/learned-0.1.0.json.
"""

from __future__ import annotations

import argparse
import datetime as dt
import importlib.metadata
import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tapetum.errors import InputError
from tapetum.experiments.sealed import RESULTS, read_results
from tapetum.experiments.templating import render, render_text, table_of
from tapetum.files import atomic_file

ROOT = Path(__file__).parents[1]
NUMBERS, INCLUDES, IMAGES = (ROOT / "docs" / name for name in ("numbers", "includes", "images"))
PAGES = ("fig4", "fig5", "fig6", "fig7", "fig8", "fig9", "fig10", "ablations")
SIZES = ("laptop", "paper")
_UNITS = {"fraction of the field": ""}


def main(folders: list[str]) -> None:
    for folder in map(Path, folders):
        for name in PAGES:
            if (page := folder / f"{name}.md").exists():
                _write(INCLUDES / f"{name}.md", included(name, page.read_text(encoding="utf-8")))
            if (picture := folder / f"{name}.png").exists():
                shutil.copyfile(picture, IMAGES / f"{name}.png")
        if (table := folder / "table1.json").exists():
            _keep_table(table)
        if (results := folder / RESULTS).exists():
            with (NUMBERS / RESULTS).open("a", encoding="utf-8") as known:
                known.write(results.read_text(encoding="utf-8"))
    for name, text in made().items():
        _write(INCLUDES / f"{name}.md", text)


def made() -> dict[str, str]:
    """Every part that follows from docs/numbers, by name."""
    older = json.loads((NUMBERS / "learned-0.1.0.json").read_text(encoding="utf-8"))
    template = (Path(__file__).with_name("learned.md.j2")).read_text(encoding="utf-8")
    sealed = re.sub("^# ", "## ", render("sealed", {"results": read_results(NUMBERS)}))
    tables = [json.loads(file.read_text(encoding="utf-8")) for file in map(_table_of, SIZES) if file.exists()]
    return {"sizes": side_by_side(tables), "learned": render_text(template, older), "sealed": sealed}


def _table_of(size: str) -> Path:
    return NUMBERS / f"table1-{size}.json"


def _keep_table(file: Path) -> None:
    found = json.loads(file.read_text(encoding="utf-8"))
    if found["size"] not in SIZES:
        raise InputError(f"is of the size {found['size']}, which shows nothing", where=file)
    found |= {"version": importlib.metadata.version("tapetum"), "date": dt.datetime.now(dt.UTC).date().isoformat()}
    _write(_table_of(found["size"]), json.dumps(found, indent=1) + "\n")


def included(name: str, page: str) -> str:
    """A page of `tapetum paper` as a section, with the version and the day it was measured."""
    version, day = importlib.metadata.version("tapetum"), dt.datetime.now(dt.UTC).date().isoformat()
    heading, rest = page.split("\n\n", 1)
    rest = rest.replace(f"({name}.png)", f"(images/{name}.png)")
    # Where the size says how much is computed, the page is to be made at the paper's.
    size = "" if name in ("fig4", "fig5", "fig6") else " --size paper"
    made_by = f"    tapetum paper {name}{size} -o figures\n\nMeasured with Tapetum {version} on {day}.\n\n"
    return f"#{heading}\n\n{made_by}{rest}"


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
    return f"{table_of(('task', 'model', *heads), lines)}\n\n*{made}.*\n"


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "–"
    verdict = "" if row["mae"] < row["guess_mae"] else ", no better than the mean"
    return f"{row['mae']:.3g} ({row['guess_mae']:.3g}{verdict}) {_UNITS.get(row['unit'], row['unit'])}".rstrip()


def _write(place: Path, text: str) -> None:
    with atomic_file(place) as part:
        part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", metavar="DIR")
    main(parser.parse_args().folders)
