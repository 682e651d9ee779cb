"""Write docs/validation.md from the numbers that the tests themselves check: `make validation`.

`--slow` runs the slow tests as well; `--from FILE` takes what a run with `--keep-validation FILE` has kept.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "validation.md"
# What the judge's sealed scenes gave, drawn once each.
SCENES = ROOT / "tests" / "references" / "scenes.md"
HEAD = """# Validation

Every line is a test that ran: what it compared, with what, how far apart the two were, and how far apart they may be.
The numbers are written by the tests themselves; nobody types them. Where a quantity was compared at several settings
the line gives the largest difference.

    make validation

runs those tests and writes this page again; `scripts/make_validation.py --slow` runs the slow ones as well{slow}.
Errors are largest differences, by default in fractions of the peak.
All of it is simulation against closed forms, independent methods and other packages. None of it says how far scalar,
paraxial light, and lenses as their prescriptions have them, are from a real camera.
"""


def main(arguments: list[str] | None = None) -> int:
    """Run the tests that validate something, and write the page; the tests' exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slow", action="store_true")
    parser.add_argument("--from", dest="kept", type=Path)
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        kept = given.kept or Path(folder) / "validation.json"
        if given.kept is None and (code := _run(kept, given.slow)):
            return code
        files = sorted(kept.parent.glob(f"{kept.name}*"))
        lines = [line for file in files for line in json.loads(file.read_text(encoding="utf-8"))]
        if not lines:
            print(f"{kept}: no numbers", file=sys.stderr)
            return 2
        # In whatever order the processes came to them.
        lines.sort(key=lambda line: (line["test"], line["what"]))
    part = PAGE.with_suffix(".part")
    part.write_text(page(lines, given.slow), encoding="utf-8")
    part.replace(PAGE)
    print(f"{PAGE.relative_to(ROOT)}: {len(lines)} comparisons")
    return 0


def _run(kept: Path, slow: bool) -> int:
    tests = sorted(
        {str(p.relative_to(ROOT)) for p in (ROOT / "tests").rglob("test_*.py") if "validated" in p.read_text()}
    )
    chosen = "slow or not slow" if slow else "not slow"
    command = [sys.executable, "-m", "pytest", "-m", chosen, "--keep-validation", str(kept), *tests]
    command += ["-n", "auto", "--dist", "loadfile"]
    return subprocess.run(command, cwd=ROOT, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"}).returncode


def page(lines: list[dict], slow: bool) -> str:
    """The page for the lines that the tests kept."""
    sections: dict[str, list[dict]] = defaultdict(list)
    for line in lines:
        sections[line["section"]].append(line)
    text = [HEAD.format(slow=", as here" if slow else "")]
    for section in sorted(sections):
        text += [
            f"## {section}",
            "",
            "| quantity | against | error | allowed | of | test |",
            "|---|---|--:|--:|---|---|",
        ]
        text += [_row(line) for line in _worst(sections[section])]
        text.append("")
    if SCENES.exists():
        text += ["## Random scenes", "", SCENES.read_text(encoding="utf-8")]
    day = dt.datetime.now(dt.UTC).date().isoformat()
    return "\n".join([*text, f"*{day}, {len(lines)} comparisons.*", ""])


def _worst(lines: list[dict]) -> list[dict]:
    """One line for each quantity: its largest share of the tolerance."""
    found: dict[tuple[str, str], dict] = {}
    for line in lines:
        key = line["what"], line["against"]
        if key not in found or _share(line) > _share(found[key]):
            found[key] = line
    return list(found.values())


def _share(line: dict) -> float:
    """Error over tolerance; of a tolerance of zero the error itself."""
    return line["error"] / (line["tolerance"] or 1.0)


def _row(line: dict) -> str:
    file = line["test"].partition("::")[0].removeprefix("tests/")
    measure = line["measure"].removeprefix("of ")
    cells = [line["what"], line["against"], f"{line['error']:.2g}", f"{line['tolerance']:.2g}", measure, f"`{file}`"]
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    sys.exit(main())
