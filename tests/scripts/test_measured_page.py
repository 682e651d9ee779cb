"""docs/measured.md and parts of docs/rooms.md hold no number of their own: they follow from docs/numbers."""

from __future__ import annotations

import json
from typing import Any

import pytest

import make_measured_page as script


def test_the_pages_are_made_of_their_numbers() -> None:
    for name, text in script.made().items():
        assert script.PAGES[name].read_text(encoding="utf-8") == text, f"run {script.__file__}"
    rooms = (script.ROOT / "docs" / "rooms.md").read_text(encoding="utf-8")
    assert '--8<-- "detection.md"' in rooms and '--8<-- "room-films.md"' in rooms


def test_verdicts_follow_the_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = script._numbers

    def other(name: str) -> Any:
        found = usual(name)
        if name == "copies-rotation":
            last = found["rows"][-1]
            last["other"]["mae"] = last["other"]["guess"]
            last["changed"]["no photosites"]["opposite"] = 0.2
        if name == "adapt":
            for row in found["rows"]:
                row["mae"] = [value / 10 if row["seconds"] == 100 else value for value in row["mae"]]
        return found

    monkeypatch.setattr(script, "_numbers", other)
    text = " ".join(script.made()["measured"].split())
    assert text.count("| no better than a guess |") == 1
    assert "None of these alone tells the sign" in text and "diffract**" not in text
    assert "further copies would help" in text and "would add little" not in text
    assert "More film than 5 s helps" in text and "serve as well as 100 s" not in text


def test_errors_are_written_to_two_digits() -> None:
    assert script.pair([0.0123, 0.345]) == "0.012 / 0.345"
    assert script.pair([4.23e-5, 5.7e-5]) == "4.2e-5 / 5.7e-5"
    assert script.pair([0.0123, 0.345], 2) == "0.01 / 0.34"
    assert script.guess([0.1, 0.2], [0.2, 0.2]) == "50 to 100 % of a guess's"
    assert script.guess([0.19, 0.2], [0.2, 0.2]) == "no better than a guess"


def test_rows_of_copies_are_gathered() -> None:
    rows = [
        {"kind": "a", "unit": unit, "mae": [0.1 * unit, 0.2], "held": [0.8, 1.0], "answered": 1.0, "films": films}
        for unit, films in ((1, None), (3, None), (1, 3))
    ]
    found = script.Adapted(rows, kind="a", films=None)
    assert found.units == [1, 3] and found.mae == pytest.approx([0.2, 0.2]) and found.held_both == pytest.approx(0.9)
    assert found.worst["unit"] == 3 and found.of([1]).mae == pytest.approx([0.1, 0.2])
    assert found.better(script.Adapted([dict(rows[0], mae=[0.2, 0.3])])) == 1
    for wrong in ({"kind": "b"}, {"kind": "a"}):
        with pytest.raises(KeyError):
            script.Adapted(json.loads(json.dumps(rows)), **wrong)


LENSES = {"another catalogue lens": list(range(100, 110)), "a lens in no training set": [100, 101, 105]}


@pytest.mark.parametrize("kind", LENSES)
def test_half_a_minute_of_another_lens_is_worth_100_seconds_from_scratch(kind: str) -> None:
    """As the guides say: on each copy on which both were tried."""
    rows = script._numbers("adapt-lenses")["rows"]
    adapted = script.Adapted(rows, kind=kind, method="adapt", films=None, residuals="interpolated")
    scratch = script.Adapted(rows, kind=kind, method="scratch")
    assert sorted(adapted.units) == list(range(100, 110))
    assert sorted(set(adapted.units) & set(scratch.units)) == LENSES[kind]
    assert adapted.better(scratch) == len(LENSES[kind])
    assert adapted.worst["unit"] == 105


def test_five_seconds_of_another_copy_serve_as_well_as_100() -> None:
    rows = script._numbers("adapt")["rows"]
    short, long = (script.Adapted(rows, kind="another unit", method="adapt", seconds=one) for one in (5.0, 100.0))
    assert short.units == long.units == list(range(84, 94))
    assert all(a < 1.25 * b for a, b in zip(short.mae, long.mae, strict=True))
