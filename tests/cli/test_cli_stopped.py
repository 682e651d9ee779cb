"""Commands that are stopped, fail while they save, or meet another command that writes the same."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tapetum.errors import InputError
from tapetum.files import reserved


@contextmanager
def another_command(path: Path) -> Iterator[None]:
    """Hold a name as another command that writes it does."""
    held, done = threading.Event(), threading.Event()

    def hold() -> None:
        with reserved(path):
            held.set()
            done.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    assert held.wait(20)
    yield
    done.set()
    thread.join()


class Twin:
    """What a search has found, and how saving it ends."""

    explains, parameters = True, ()

    def __init__(self, error: BaseException | None = None) -> None:
        self.error = error

    def write_page(self, path: Path) -> None:
        path.write_text("page")

    def save_numbers(self, path: Path) -> None:
        path.write_text("{}")
        if self.error is not None:
            raise self.error

    def save(self, path: Path) -> None:
        path.write_text("scene")

    def as_dict(self) -> dict[str, Any]:
        return {}


@pytest.mark.parametrize(
    ("error", "code", "begins"),
    [
        (KeyboardInterrupt(), 130, "interrupted: "),
        (InputError("no room", where="a.json"), 2, "error: a.json: no room; "),
    ],
)
def test_a_twin_stopped_while_it_is_saved(run, tmp_path: Path, monkeypatch, error, code: int, begins: str) -> None:
    def found(*_: object, state: Path, **__: object) -> Twin:
        state.write_text("the search")
        return Twin(ends.pop())

    ends = [None, error]
    monkeypatch.setattr("tapetum.calibrate.twin.fit_twin", found)
    words = ("twin", "x.rec", "--scene", "thin-lens", "-o", tmp_path / "a.yaml", "--json")
    ran = run(*words)
    assert ran.code == code
    assert ran.complaint == f"{begins}what is done is kept in {tmp_path / 'a.part'}, and the same command goes on"
    assert [path.name for path in tmp_path.iterdir()] == ["a.part"]
    assert run(*words).code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.html", "a.json", "a.yaml"]


def test_a_twin_that_was_stopped_before_it_kept_anything(run, tmp_path: Path, monkeypatch) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tapetum.calibrate.twin.fit_twin", stopped)
    assert run("twin", "x.rec", "--scene", "thin-lens", "-o", tmp_path / "a.yaml").complaint == "interrupted"


def test_of_two_commands_that_write_one_file_the_second_is_refused(run, chain, tmp_path: Path) -> None:
    for name, words in (
        ("t.csv", ("track", chain.recording, "-o", tmp_path / "t.csv")),
        ("a.yaml", ("twin", chain.recording, "--scene", "thin-lens", "-o", tmp_path / "a.yaml")),
        ("m", ("train", chain.dataset, "-o", tmp_path / "m")),
        ("o", ("paper", "fig4", "-o", tmp_path / "o")),
    ):
        with another_command(tmp_path / name):
            assert f"{tmp_path / name}: is being written by process {os.getpid()}; wait" in run(*words).complaint
    assert not list(tmp_path.iterdir())


def test_a_place_where_nothing_may_be_written_is_refused_before_any_work(
    run, chain, tmp_path: Path, monkeypatch
) -> None:
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path and access(path, mode))
    for words in (
        ("train", chain.dataset, "-o", tmp_path / "deep" / "m"),
        ("dataset", "synth", "rotation", "-o", tmp_path / "s.zarr"),
        ("twin", chain.recording, "--scene", "thin-lens", "-o", tmp_path / "a.yaml"),
        ("demo", "-o", tmp_path / "o"),
    ):
        assert "may not be written; choose a folder you own" in run(*words).complaint
    assert not list(tmp_path.iterdir())
