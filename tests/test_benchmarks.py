"""The benchmarks' own arithmetic and the tables they write; what they measure is never a gate."""

from __future__ import annotations

import datetime as dt
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(autouse=True)
def _from_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))


def test_ratios_are_formed_within_each_round():
    from benchmarks.measure import Timings

    # The machine slowed down threefold in the second round, which hit both.
    timings = Timings({"ours": (1.0, 3.0, 1.0), "peer": (4.0, 12.0, 5.0)})
    assert timings.speed_up("ours", "peer") == (4.0, 4.0, 5.0)
    assert timings.typical("ours") == 1.0


def test_contenders_take_turns_and_time_is_told_a_unit():
    from benchmarks.measure import Contender, in_turns

    calls: list[str] = []
    contenders = {
        "ours": Contender(lambda: calls.append("ours"), work=10, repeats=2),
        "peer": Contender(lambda: calls.append("peer"), warm_up=False),
    }
    timings = in_turns(contenders, 2)
    assert calls == ["ours", "ours", "ours", "peer", "peer", "ours", "ours"]
    assert len(timings.seconds["ours"]) == len(timings.seconds["peer"]) == 2
    with pytest.raises(ValueError, match="one round"):
        in_turns(contenders, 0)


def test_rows_read_well():
    from benchmarks.measure import Figure, Row

    row = Row("case", Figure.rate(0.02, "frames"), "peer", Figure.duration(12.3), (1234.0, 980.0, 1500.0))
    assert row.cells == ("case", "50 frames/s", "12 s (peer)", "1 234× (980–1 500)", "")
    assert Row("case", Figure.duration(0.0042)).cells[1:4] == ("4.2 ms", "–", "–")


def test_a_table_replaces_only_its_own(tmp_path: Path):
    from benchmarks.measure import Figure, Row
    from benchmarks.table import markdown, replaced, write

    rows = [Row("a | b", Figure(3.0, "frames/s"))]
    table = markdown(rows, "a machine", dt.date(2026, 1, 2))
    assert "| a \\| b | 3 frames/s | – | – |  |" in table
    assert table.endswith("*2026-01-02; a machine.*")
    text = "before\n<!-- benchmark x -->\nold\n<!-- end x -->\n<!-- benchmark y -->\nkept\n<!-- end y -->\nafter\n"
    document = tmp_path / "performance.md"
    document.write_text(text, encoding="utf-8")
    write("x", rows, "a machine", document)
    new = document.read_text(encoding="utf-8")
    assert "old" not in new and "3 frames/s" in new and "kept" in new
    assert new.startswith("before\n") and new.endswith("after\n")
    assert [path.name for path in tmp_path.iterdir()] == ["performance.md"]
    with pytest.raises(ValueError, match="markers"):
        replaced(text, "z", table)


def test_the_document_has_a_place_for_each_benchmark():
    from benchmarks.__main__ import NAMES
    from benchmarks.table import DOCUMENT, replaced

    text = DOCUMENT.read_text(encoding="utf-8")
    modules = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} - {"__init__", "__main__", "measure", "table"}
    assert modules == set(NAMES)
    for name in NAMES:
        assert "a table" in replaced(text, name, "a table")
        benchmark = importlib.import_module(f"benchmarks.{name}")
        assert benchmark.TITLE and isinstance(benchmark.PEERS, tuple)


def test_unknown_names_are_refused(capsys):
    from benchmarks.__main__ import main

    for arguments, told in ((["nonsense"], "no benchmark nonsense"), (["--quick", "--write"], "--quick")):
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 2
        assert told in capsys.readouterr().err
