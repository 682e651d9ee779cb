"""`tapetum paper`: which figures are made where, and what cannot be made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tapetum.cli import paper
from tapetum.experiments import FIGURES, GROUPS, SIZES
from tapetum.experiments import write as writing
from tapetum.report.figures._style import new_figure


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures of nothing: the real ones are tested with the report."""

    def maker(name: str) -> Any:
        return lambda work: (
            new_figure(1, 1),
            {"measured": len(list(work.progress(range(3), name))), "size": work.size, "kept": str(work.folder)},
        )

    for name in FIGURES:
        monkeypatch.setitem(writing._MAKERS, name, maker(name))
    monkeypatch.setattr(writing, "render", lambda name, numbers: f"# {name}\n")


def test_it_offers_what_there_is() -> None:
    assert paper.FIGURES == FIGURES and paper.SIZES == SIZES and tuple(GROUPS) == paper.GROUPS


def test_one_figure(run, tmp_path: Path, quick) -> None:
    ran = run("paper", "fig5", "-o", tmp_path / "out")
    assert ran.code == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["fig5.json", "fig5.md", "fig5.png"]
    assert "fig5.png" in ran.out and "fig5: 3 in" in ran.err


@pytest.mark.parametrize(
    ("given", "size"), [([], "laptop"), (["--size", "small"], "small"), (["--size", "paper"], "paper")]
)
def test_the_size_asked_for(run, tmp_path: Path, quick, given: list[str], size: str) -> None:
    told = json.loads(run("paper", "fig8", "-o", tmp_path, "--json", *given).out)
    assert [one["size"] for one in told["figures"]] == [size]


@pytest.mark.parametrize(
    ("which", "names"),
    [
        ([], FIGURES[:11]),
        (["printed"], FIGURES[:11]),
        (["learned"], ("fig9", "fig10", "fig11", "fig12", "table1", "table2")),
        (["beyond"], ("ablations", "development", "unseen", "fit")),
        (["all"], FIGURES),
        (["fig9", "fig10"], ("fig9", "fig10")),
        (["fig5", "beyond", "fig5"], ("fig5", "ablations", "development", "unseen", "fit")),
    ],
)
def test_several_figures_as_json(run, tmp_path: Path, quick, which: list[str], names: tuple[str, ...]) -> None:
    ran = run("paper", *which, "-o", tmp_path, "--json")
    assert ran.code == 0
    told = json.loads(ran.out)
    assert told["out"] == str(tmp_path) and [one["name"] for one in told["figures"]] == list(names)
    for one in told["figures"]:
        assert one["measured"] == 3 and all(Path(file).stat().st_size for file in one["files"])


def test_small_is_said_to_be_a_smoke_test(run, tmp_path: Path, quick) -> None:
    assert "smoke test" in run("paper", "--help").out
    small, laptop = (run("paper", "fig9", "-o", tmp_path / size, "--size", size) for size in ("small", "laptop"))
    assert small.err.count("shows that every step runs, and nothing about the method") == 2
    assert "smoke test" not in laptop.err + laptop.out


@pytest.mark.parametrize("given", [[], ["--workers", "3"]])
def test_all_cores_film_unless_told_otherwise(run, tmp_path: Path, monkeypatch, given: list[str]) -> None:
    seen: list[int | None] = []

    def made(work: Any) -> Any:
        seen.append(work.workers)
        return new_figure(1, 1), {}

    monkeypatch.setitem(writing._MAKERS, "fig9", made)
    monkeypatch.setattr(writing, "render", lambda name, numbers: f"# {name}\n")
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0, 1, 4, 5, 6}, raising=False)
    assert run("paper", "fig9", "-o", tmp_path, *given).code == 0
    assert seen == [3 if given else 5]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["fig3", "-o", "out"],
            "use one of fig4, fig5, fig6, fig7, fig8, fig9, fig10, fig11, fig12, table1, table2, ablations",
        ),
        (["fig7", "-o", "out", "--size", "large"], "use one of laptop, small, paper"),
        (["fig4"], "Missing option"),
        (["fig4", "-o", "f"], "f:"),
    ],
)
def test_what_cannot_be_made(run, tmp_path: Path, monkeypatch, quick, arguments: list[str], words: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("f").write_text("")
    ran = run("paper", *arguments)
    assert ran.code == 2 and words in ran.complaint
    assert [p.name for p in tmp_path.iterdir()] == ["f"] and Path("f").read_text() == ""
