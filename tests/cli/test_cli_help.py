"""What a person meets first: help, version, and words that no command knows."""

from __future__ import annotations

import importlib.metadata
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from tapetum.cli.app import root_command

COMMANDS = ("demo", "simulate", "plan", "cameras", "record", "calibrate", "twin", "dataset", "train", "adapt")
COMMANDS += ("evaluate", "export", "detect", "track", "serve", "fuse", "paper")


def test_help_lists_the_commands_in_the_order_of_use(run) -> None:
    ran = run("--help")
    assert ran.code == 0 and ran.err == ""
    listed = [line.split()[0] for line in ran.out.split("Commands:")[1].splitlines() if line.strip()]
    assert listed == list(COMMANDS)
    assert "..." not in ran.out.split("Commands:")[1]


@pytest.mark.parametrize("command", [*COMMANDS, "dataset build", "dataset info", "calibrate probe"])
def test_every_command_explains_itself(run, command: str) -> None:
    ran = run(*command.split(), "-h")
    assert ran.code == 0 and ran.err == ""
    assert ran.out.startswith(f"Usage: tapetum {command} ")
    # Nothing of Python's types shows.
    assert "list[str]" not in ran.out and "{scene}" not in ran.out


def leaves() -> list[tuple[str, Any]]:
    """Every command that does something, by its words."""
    command: Any = root_command()
    found = []
    for name, one in command.commands.items():
        inner = getattr(one, "commands", None)
        found += [(name, one)] if inner is None else [(f"{name} {word}", leaf) for word, leaf in inner.items()]
    return found


@pytest.mark.parametrize(("words", "command"), leaves(), ids=[words for words, _ in leaves()])
def test_every_commands_help_has_an_example_that_parses(run, words: str, command: Any) -> None:
    shown = " ".join(run(*words.split(), "--help").out.split())
    assert "Example: tapetum" in shown
    example = shown.split("Example: ")[1]
    assert example.startswith(f"tapetum {words} ")
    arguments = shlex.split(example)[1 + len(words.split()) :]
    command.make_context("tapetum", arguments)


def test_version(run) -> None:
    assert run("--version").out.strip() == importlib.metadata.version("tapetum")


def test_no_command_shows_the_help(run) -> None:
    ran = run()
    assert ran.code == 2 and "Commands:" in ran.err
    assert "build" in run("dataset").err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["simulat"], "Did you mean 'simulate'; see tapetum --help"),
        (["simulate"], "Missing argument 'SCENE'; see tapetum simulate --help"),
        (["simulate", "thin-lens"], "Missing option"),
        (["simulate", "thin-lens", "--nonsense"], "--nonsense"),
        (["train", "x", "-o", "y", "--epochs", "0"], "--epochs"),
        (["record", "hand-held", "-o", "x.rec", "--seconds", "soon"], "--seconds"),
    ],
)
def test_a_command_line_that_cannot_be_read(run, arguments: list[str], words: str) -> None:
    ran = run(*arguments)
    assert ran.code == 2
    assert ran.complaint.startswith("error: ") and words in ran.complaint


def test_what_needs_no_torch_does_not_wait_for_it(tmp_path: Path) -> None:
    """Help, detection and tracking without a model: torch alone takes two seconds to load."""
    frame = np.random.default_rng(0).normal(60, 3, (64, 64)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "frame.png"), frame)
    code = "import sys; from tapetum.cli.app import main; codes = [main(one) for one in (['--help'], "
    code += "['detect', 'frame.png', '-o', 'found.csv'], ['track', 'frame.png', '-o', 'tracks.csv'])]; "
    code += "print(codes, 'torch' in sys.modules)"
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert shown.stdout.splitlines()[-1] == "[0, 0, 0] False"


def test_a_reader_that_leaves_early_is_no_error() -> None:
    """As `tapetum dataset info SET | head` does."""
    code = "import sys, typer\nfrom tapetum.cli import app\n"
    code += "def loud():\n    while True: typer.echo('line')\n"
    code += "app.app.command('loud')(loud)\nsys.exit(app.main(['loud']))"
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as shown:
        assert shown.stdout is not None and shown.stderr is not None
        assert shown.stdout.readline() == "line\n"
        shown.stdout.close()
        assert shown.stderr.read() == ""
        assert shown.wait(timeout=30) == 1


def test_an_interruption(run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tapetum.cli.simulate.load_scene", interrupted)
    ran = run("simulate", "thin-lens", "-o", "x.npy")
    assert ran.code == 130 and ran.err.split() == ["interrupted"]
