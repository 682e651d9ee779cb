"""Progress: items pass unchanged, and a log gets one line for a loop that came to its end."""

from __future__ import annotations

import re

import pytest

from tapetum.progress import bar, quiet


def test_quiet_passes_items_on(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(quiet(iter("abc"), "reading", total=3)) == ["a", "b", "c"]
    assert capsys.readouterr() == ("", "")


def test_a_log_gets_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(bar(iter("abc"), "reading [a].png")) == ["a", "b", "c"]
    out, err = capsys.readouterr()
    assert out == "" and re.fullmatch(r"reading \[a\]\.png: 3 in [\d.]+ s\n", err)


def test_a_loop_that_fails_leaves_the_word_to_its_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError):
        for item in bar(range(3), "reading"):
            if item == 1:
                raise RuntimeError
    assert capsys.readouterr() == ("", "")


def test_a_terminal_gets_a_bar(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert list(bar(range(4), "reading")) == [0, 1, 2, 3]
    assert "4/4" in capsys.readouterr().err


class Endless:
    """As a loader of an iterable dataset: it has a length and does not know it."""

    def __len__(self) -> int:
        raise TypeError("object has no len()")

    def __iter__(self):
        return iter("abc")


def test_a_length_that_is_not_told(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert list(bar(Endless(), "reading")) == ["a", "b", "c"]
    assert "reading: 3 in" in capsys.readouterr().err
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert list(bar(Endless(), "reading")) == ["a", "b", "c"]
    assert "3/?" in capsys.readouterr().err
