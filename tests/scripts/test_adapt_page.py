"""What docs/learning.md says of other lenses is what docs/numbers/adapt-lenses.json holds."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

DOCS = Path(__file__).parents[2] / "docs"
LENSES = {"zoom": "another catalogue lens", "compact": "a lens in no training set"}
SHARES = ("far", "opposite", "far_at_75_to_90", "far_at_0_to_30")
NAMES = {"zoom": "zoom-5-15mm", "compact": "compact-6mm-f1.9"}


def rows(lens: str, method: str, base: str = "", *, before: bool = False, films: int = 1) -> dict[int, dict]:
    """Of every copy; `before` residuals were interpolated, or those that the table is of; adapted to so many films."""
    told = json.loads((DOCS / "numbers" / "adapt-lenses.json").read_text(encoding="utf-8"))["rows"]
    own = [one for one in told if (one["kind"], one["method"], one["base"]) == (LENSES[lens], method, base)]
    return {one["unit"]: one for one in own if one.get("before", False) == before and one.get("films", 1) == films}


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


@pytest.mark.parametrize(("lens", "copies"), [("zoom", set(range(100, 110))), ("compact", {100, 101, 105})])
def test_half_a_minute_is_worth_100_seconds_from_scratch(lens: str, copies: set[int]) -> None:
    """On each of the copies on which both were tried, as the page says, and in the mean."""
    adapted, scratch = rows(lens, "adapt", "thin-lens-gaze"), rows(lens, "scratch")
    assert set(adapted) == set(range(100, 110)) and set(adapted) & set(scratch) == copies
    for copy in copies:
        assert (np.array(adapted[copy]["mae"]) < scratch[copy]["mae"]).all()
    ours, theirs = (np.mean([one["mae"] for one in of.values()], axis=0) for of in (adapted, scratch))
    assert (ours < theirs).all()


def test_the_page_names_the_copies_from_scratch_the_means_of_the_shared_ones_and_the_medians() -> None:
    told = " ".join(page("**Another lens**").split("**Copy 105**")[0].split())
    adapted, scratch = rows("compact", "adapt", "thin-lens-gaze"), rows("compact", "scratch")
    assert set(rows("zoom", "scratch")) == set(range(100, 110)) and set(scratch) == {82, 83, 94, 100, 101, 105}
    assert "of the zoom on the same ten copies" in told and "100, 101 and 105 of the ten and on 82, 83 and 94" in told
    assert {unit for unit, one in scratch.items() if one["precision"] == "bf16"} == {82, 83}
    shared = [mean([of[unit] for unit in set(adapted) & set(scratch)])[0] for of in (adapted, scratch)]
    assert f"({shared[0]} and {shared[1]})" in told
    medians = (
        np.median([one["mae"] for one in rows(lens, "adapt", "thin-lens-gaze").values()], axis=0) for lens in LENSES
    )
    assert (
        "The medians of the ten are {:.3f} / {:.3f} and {:.3f} / {:.3f}.".format(*(x for of in medians for x in of))
        in told
    )


def test_the_page_says_why_one_copy_errs_most() -> None:
    told = " ".join(page("**Copy 105**").split("\n\n")[0].split())
    everything = [rows(lens, "adapt", "thin-lens-gaze") for lens in LENSES]
    assert {max(of, key=lambda unit, of=of: sum(of[unit]["mae"])) for of in everything} == {105}
    ours, scratch = [of[105] for of in everything], [rows(lens, "scratch")[105] for lens in LENSES]

    def pair(own: list[dict], name: str) -> str:
        return " and ".join("{:.3f} / {:.3f}".format(*one[name]) for one in own)

    assert f"by {pair(ours, 'mae')}, and as much from scratch, by {pair(scratch, 'mae')}." in told
    assert f"err by less than {pair(ours, 'median')}." in told and f"the means are {pair(ours, 'mae_but_far')}." in told
    percent = {name: " and ".join(f"{100 * one[name]:.0f}" for one in ours) for name in SHARES}
    assert (
        f"But {percent['far']} % are off" in told and f"{percent['opposite']} % come out as the opposite gaze" in told
    )
    assert f"within 15° of that direction, {percent['far_at_75_to_90']} % are far off" in told
    assert f"of those within 30° of the slope {percent['far_at_0_to_30']} %." in told
    wide = rows("zoom", "adapt", "thin-lens-gaze", films=3)[105]
    error, held = mean([wide])
    falls = (
        f"falls to {error}, the share of opposite gazes to {100 * wide['opposite']:.0f} %, and intervals hold {held}."
    )
    assert falls in told and wide["opposite"] < ours[0]["opposite"]
    assert (np.array(wide["mae"]) < ours[0]["mae"]).all()


def test_the_page_names_the_means_of_the_copies_that_nobody_had_seen_and_the_seconds() -> None:
    adapted = [rows(lens, "adapt", "thin-lens-gaze") for lens in LENSES]
    told = " ".join(page("the seven others alone").split("`make any-camera`")[0].split())
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
