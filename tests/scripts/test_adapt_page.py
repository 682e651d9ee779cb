"""What docs/learning.md says of other lenses is what docs/numbers/adapt-lenses.json holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[2] / "docs"
LENSES = {"zoom": "another catalogue lens", "compact": "a lens in no training set"}
NAMES = {"zoom": "zoom-5-15mm", "compact": "compact-6mm-f1.9"}


def rows(lens: str, method: str, base: str = "", *, before: bool = False) -> dict[int, dict]:
    """Of every copy; `before` residuals were interpolated, or those that the table is of."""
    told = json.loads((DOCS / "numbers" / "adapt-lenses.json").read_text(encoding="utf-8"))["rows"]
    own = [one for one in told if (one["kind"], one["method"], one["base"]) == (LENSES[lens], method, base)]
    return {one["unit"]: one for one in own if one.get("before", False) == before}


def page(begins: str) -> str:
    return (DOCS / "learning.md").read_text(encoding="utf-8").partition(begins)[2]


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
    (line,) = [one for one in page("**Another lens**").splitlines() if one.startswith(begins)]
    cells = [one.strip() for one in line.strip("|").split("|")]
    zoom, compact = (list(rows(lens, method, base).values()) for lens in LENSES)
    assert cells[2:6] == [*mean(zoom), *mean(compact)]
    assert cells[6] == f"{100 * np.mean([one['answered'] for one in zoom + compact]):.0f} %"


@pytest.mark.parametrize("lens", LENSES)
def test_half_a_minute_is_worth_100_seconds_from_scratch(lens: str) -> None:
    """In the mean of copies, ten and other ones, as the page says."""
    adapted, scratch = rows(lens, "adapt", "thin-lens-gaze"), rows(lens, "scratch")
    assert len(adapted) >= 10 and len(scratch) >= 3
    ours, theirs = (np.mean([one["mae"] for one in of.values()], axis=0) for of in (adapted, scratch))
    assert (ours <= theirs).all()


def test_the_page_names_the_medians_and_the_copy_that_errs_most() -> None:
    told = " ".join(page("The medians of the ten are").split("\n\n")[0].split())
    adapted = [rows(lens, "adapt", "thin-lens-gaze") for lens in LENSES]
    medians = (np.median([one["mae"] for one in of.values()], axis=0) for of in adapted)
    assert told.startswith("{:.3f} / {:.3f} and {:.3f} / {:.3f}.".format(*(x for of in medians for x in of)))
    assert {max(of, key=lambda unit, of=of: sum(of[unit]["mae"])) for of in adapted} == {105}
    assert f"by {' and '.join(mean([of[105]])[0] for of in adapted)};" in told


def test_the_page_names_the_means_of_the_copies_that_nobody_had_seen_and_the_seconds() -> None:
    adapted = [rows(lens, "adapt", "thin-lens-gaze") for lens in LENSES]
    told = " ".join(page("the seven others alone").split("\n\n`make any-camera`")[0].split())
    (one, held), (other, there) = (mean([row for unit, row in of.items() if unit > 102]) for of in adapted)
    assert f"have {one} (intervals hold {held}) and {other} ({there})." in told
    seconds = [row["processor_seconds"] for of in adapted for row in of.values()]
    assert f"took {min(seconds):.0f} to {max(seconds):.0f} s of one core" in told


def test_the_networks_of_both_columns_are_the_same_and_the_page_says_what_is_gained() -> None:
    pairs = []
    for lens in LENSES:
        before, after = (rows(lens, "adapt", "thin-lens-gaze", before=one) for one in (True, False))
        assert all(before[unit]["chosen"] == after[unit]["chosen"] for unit in before)
        pairs += [(before[unit], after[unit]) for unit in before]
    old, new = (np.mean([pair[k]["mae"] for pair in pairs], axis=0) for k in (0, 1))
    x, y = 100 * (1 - new / old)
    told = " ".join((DOCS / "learning.md").read_text(encoding="utf-8").split())
    assert told.count(f"{x:.0f} % of the error along x and {y:.0f} % along y") == 2
    more = np.mean([one["processor_seconds"] - other["processor_seconds"] for other, one in pairs])
    assert f"and {more:.0f} s more than before in the mean of the six" in told


def test_residuals_were_interpolated_on_all_copies() -> None:
    for lens in LENSES:
        assert all("interpolated between" in one["residuals"] for one in rows(lens, "adapt", "thin-lens-gaze").values())


def test_the_page_says_what_interpolated_residuals_change_of_every_copy_that_was_adapted_both_ways() -> None:
    told, lines = page("What that changes"), 0
    for lens, name in NAMES.items():
        before, after = (rows(lens, "adapt", "thin-lens-gaze", before=one) for one in (True, False))
        for unit in before:
            cells = " | ".join(" | ".join(mean([one])) for one in (before[unit], after[unit]))
            assert f"| {name}, {unit} | {cells} |" in told
            lines += 1
    assert lines == sum(told.count(f"\n| {name}, ") for name in NAMES.values()) > 0
