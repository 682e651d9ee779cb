"""The scripts' command lines: each says what it takes, and begins nothing that was not asked for."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).parents[2] / "scripts"
RUN = sorted(path.name for path in SCRIPTS.glob("*.py") if "__main__" in path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", RUN)
def test_help_helps_and_a_wrong_word_is_refused(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    if name == "watch_pictures.py":
        pytest.importorskip("playwright")
    monkeypatch.chdir(tmp_path)
    for word, code in (("--help", 0), ("--no-such-flag", 2)):
        monkeypatch.setattr(sys, "argv", [name, word])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(SCRIPTS / name), run_name="__main__")
        assert ended.value.code == code
        told = capsys.readouterr()
        assert "usage: " in (told.err if code else told.out)
    assert not list(tmp_path.iterdir())
