"""Make the parts of docs/paper.md that hold results, docs/includes/*.md, of the numbers in docs/numbers.

    .venv/bin/python scripts/make_paper_page.py [DIR …]

DIR: folders that `tapetum paper` has written; of their figures 4 to 8 the pages are copied to docs/includes and the
pictures to docs/images, and of sealed.jsonl the lines are added to docs/numbers. What networks had measured before is
made of docs/numbers/learned-0.1.0.json.
"""

from __future__ import annotations

import datetime as dt
import importlib.metadata
import json
import re
import shutil
import sys
from pathlib import Path

from tapetum.experiments.sealed import RESULTS, read_results
from tapetum.experiments.templating import render, render_text
from tapetum.files import atomic_file

ROOT = Path(__file__).parents[1]
NUMBERS, INCLUDES, IMAGES = (ROOT / "docs" / name for name in ("numbers", "includes", "images"))
SIMULATED = ("fig4", "fig5", "fig6", "fig7", "fig8")


def main(folders: list[str]) -> None:
    for folder in map(Path, folders):
        for name in SIMULATED:
            if (page := folder / f"{name}.md").exists():
                _write(INCLUDES / f"{name}.md", included(name, page.read_text(encoding="utf-8")))
                shutil.copyfile(folder / f"{name}.png", IMAGES / f"{name}.png")
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
    return {"learned": render_text(template, older), "sealed": sealed}


def included(name: str, page: str) -> str:
    """A page of `tapetum paper` as a section, with the version and the day it was measured."""
    version, day = importlib.metadata.version("tapetum"), dt.datetime.now(dt.UTC).date().isoformat()
    heading, rest = page.split("\n\n", 1)
    rest = rest.replace(f"({name}.png)", f"(images/{name}.png)")
    made_by = f"    tapetum paper {name} -o figures\n\nMeasured with Tapetum {version} on {day}.\n\n"
    return f"#{heading}\n\n{made_by}{rest}"


def _write(place: Path, text: str) -> None:
    with atomic_file(place) as part:
        part.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
