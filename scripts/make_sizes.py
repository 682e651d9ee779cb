"""Put the errors at the sizes laptop and paper side by side into docs/paper.md.

    .venv/bin/python scripts/make_sizes.py [DIR …]

DIR: folders that `tapetum paper learned -o DIR` has written, of any of these sizes; their table1.json is copied to
docs/numbers/table1-SIZE.json. Without one the table is made of what is there already.
"""

from __future__ import annotations

import datetime as dt
import importlib.metadata
import json
import sys
from pathlib import Path

from tapetum.errors import InputError
from tapetum.experiments.side_by_side import between, side_by_side
from tapetum.files import atomic_file

ROOT = Path(__file__).parents[1]
NUMBERS, PAGE = ROOT / "docs" / "numbers", ROOT / "docs" / "paper.md"
SIZES = ("laptop", "paper")


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


if __name__ == "__main__":
    main(sys.argv[1:])
