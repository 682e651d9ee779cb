"""What docs/learning.md says of other lenses is what docs/numbers/adapt-lenses.json holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[2] / "docs"
LENSES = {"zoom": "another catalogue lens", "compact": "a lens in no training set"}


def rows(lens: str, method: str, base: str = "", calibrates: str | None = None) -> dict[int, dict]:
    told = json.loads((DOCS / "numbers" / "adapt-lenses.json").read_text(encoding="utf-8"))["rows"]
    wanted = (LENSES[lens], method, base, calibrates)
    names = ("kind", "method", "base", "calibrates")
    return {one["unit"]: one for one in told if tuple(one.get(name) for name in names) == wanted}


def mean(found: list[dict]) -> tuple[str, str]:
    x, y = np.mean([one["mae"] for one in found], axis=0)
    return f"{x:.3f} / {y:.3f}", f"{100 * np.mean([one['held'] for one in found]):.0f} %"


@pytest.mark.parametrize(
    ("begins", "method", "base"),
    [
        ("| `thin-lens-gaze` as it is | 0 s |", "base", "thin-lens-gaze"),
        ("| adapted | 30 s |", "adapt", "thin-lens-gaze"),
        ("| tuned ridge | 30 s |", "ridge", ""),
        ("| ResNet-18 from scratch | 100 s |", "scratch", ""),
    ],
)
def test_the_table_of_other_lenses_holds_the_means(begins: str, method: str, base: str) -> None:
    page = (DOCS / "learning.md").read_text(encoding="utf-8")
    _, _, lenses = page.partition("**Another lens**")
    (line,) = [one for one in lenses.splitlines() if one.startswith(begins)]
    cells = [one.strip() for one in line.strip("|").split("|")]
    zoom, compact = (list(rows(lens, method, base).values()) for lens in LENSES)
    assert cells[2:6] == [*mean(zoom), *mean(compact)]
    assert cells[6] == f"{100 * np.mean([one['answered'] for one in zoom + compact]):.0f} %"


@pytest.mark.parametrize("lens", LENSES)
def test_half_a_minute_is_worth_100_seconds_from_scratch(lens: str) -> None:
    """In the mean of the copies that were learned both ways, as the page says."""
    adapted, scratch = rows(lens, "adapt", "thin-lens-gaze"), rows(lens, "scratch")
    assert len(scratch) >= 3
    ours, theirs = (np.mean([of[unit]["mae"] for unit in scratch], axis=0) for of in (adapted, scratch))
    assert (ours <= theirs).all()
    said, _ = mean([adapted[unit] for unit in scratch])
    assert said in (DOCS / "learning.md").read_text(encoding="utf-8").partition("On the copies that were also")[2]


def test_the_page_says_what_single_frames_change_of_every_copy_that_was_adapted_so() -> None:
    _, _, page = (DOCS / "learning.md").read_text(encoding="utf-8").partition("Single frames calibrate since.")
    lines, said = 0, {"zoom": "zoom-5-15mm", "compact": "compact-6mm-f1.9"}
    for lens, name in said.items():
        stretches, single = (rows(lens, "adapt", "thin-lens-gaze", by) for by in (None, "single frames"))
        for unit in single:
            for by, one in (("stretches", stretches[unit]), ("single frames", single[unit])):
                width = " / ".join(f"{value:.2f}" for value in one["width"])
                assert f"| {name}, {unit} | {by} | {' | '.join(mean([one]))} | {width} |" in page
                lines += 1
    assert lines == sum(page.count(f"\n| {name}, ") for name in said.values()) > 0
