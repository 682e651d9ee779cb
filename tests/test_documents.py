"""What README and documentation tell a reader to type works: Python blocks run, commands parse."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "docs" / "guide.md"


def blocks(path: Path, language: str) -> list[str]:
    found = re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert found, f"no {language} block in {path.name}"
    return found


def execute(code: str, names: dict[str, Any], where: str) -> None:
    exec(compile(code, where, "exec"), names)


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A reader's empty folder, without a screen."""
    from tapetum.simulate import Image

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Image, "show", lambda self: None)
    return tmp_path


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter than the guide's minute of film and dozen epochs, all else as it stands."""
    from tapetum.models import ResNet18
    from tapetum.record import Session

    # The room's function hides the module of its name.
    monkeypatch.setattr(sys.modules["tapetum.record.film"], "Session", lambda: Session(seconds=1.4))
    defaults = ResNet18.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "epochs", 1)
    monkeypatch.setitem(defaults, "size", 32)


# What takes minutes, or cameras: it is parsed below, and tested elsewhere.
LONG = re.compile(r"tapetum (demo|paper|dataset synth|record phones|record camera|track phone\.rec)")
# What makes a command quicker, its last option counting.
QUICKER = {
    "simulate": ["--set", "sampling.accuracy=0.02", "--set", "probe.sensor.pixels=[48, 48]"],
    "record": ["--seconds", "2.4"],
}
# Traced lenses take most of their time for an accuracy that nothing here looks at.
ROUGHER = ("sampling.accuracy=0.05", "sampling.accuracy=0.3")


def steps(path: Path) -> Iterator[tuple[str, str]]:
    """What a page has its reader type, in order: ("python", a block) or ("tapetum", a line)."""
    text = path.read_text(encoding="utf-8").replace("\\\n", " ")
    for found in re.finditer(r"^```python\n(.*?)^```$|^    (tapetum [^\n]+)$", text, re.DOTALL | re.MULTILINE):
        yield ("python", found[1]) if found[1] else ("tapetum", found[2])


def follow(path: Path, languages: tuple[str, ...] = ("python", "tapetum")) -> dict[str, Any]:
    """Do what a page says from its top to its end, in the current folder and one Python; return the names it made."""
    from tapetum.cli.app import main

    names: dict[str, Any] = {}
    for language, text in steps(path):
        if language not in languages:
            continue
        if language == "python":
            execute(text.replace(*ROUGHER), names, path.name)
            continue
        words = shlex.split(text, comments=True)[1:]
        if LONG.match(text):
            if words[:2] == ["dataset", "synth"]:
                a_set(Path(words[words.index("-o") + 1]))
            continue
        assert main([*words, *QUICKER.get(words[0], [])]) == 0, text
    return names


def a_set(out: Path) -> None:
    """Something to train on in the place of a set that takes minutes to film."""
    import tapetum as tp

    recording = tp.film("hand-held", f"{out.stem}-short.rec", tp.Session(seconds=1.4))
    tp.label_recording(recording)
    tp.build_dataset([recording.path], out)


# Python alone on every run, with the commands between in the long one.
PYTHON = pytest.param(("python",), id="python")
ALL = pytest.param(("python", "tapetum"), id="all", marks=pytest.mark.slow)


@pytest.mark.parametrize("languages", [PYTHON, ALL])
def test_the_readme_can_be_followed_in_an_empty_folder(reader: Path, brief, capsys, languages: tuple[str, ...]):
    names = follow(ROOT / "README.md", languages)
    assert names["frames"].shape == (3, 256, 256)
    assert "gaze_x" in capsys.readouterr().out
    made = ["rr.tif", "hand.rec/probe.mkv"]
    if "tapetum" in languages:
        made += ["fig4.png", "real.png", "rotation.png", "report/report.html", "network/model.json"]
    assert [one for one in made if not (reader / one).is_file()] == []


@pytest.mark.parametrize("languages", [PYTHON, ALL])
def test_the_guide_can_be_followed_in_an_empty_folder(
    reader: Path, brief, capsys, monkeypatch: pytest.MonkeyPatch, languages: tuple[str, ...]
):
    from tapetum.models.architectures import resnet18

    # Its network is the reader's own, of any width.
    monkeypatch.setattr(resnet18, "_WIDTHS", (8, 16, 32, 64))
    monkeypatch.setattr(resnet18.ResNet18Network, "width", 64)
    names = follow(GUIDE, languages)
    assert names["images"].irradiance.shape == (3, 256, 256)
    assert names["turn"].grad.abs().sum() > 0
    assert names["mine"].target.object_distance == 5.0
    assert names["turned"].irradiance.shape == (3, 64, 64)
    # An open app makes the phone flash.
    assert names["opened"].irradiance.max() > 10 * names["closed"].irradiance.max()
    assert names["prediction"].value.shape == (len(names["test"]), 2)
    assert "gaze_x" in capsys.readouterr().out
    made = ["my-bench.yaml", "rr.tif", "fig10.png", "my-model/model.json"]
    if "tapetum" in languages:
        made += ["rr.png", "sweep.npy", "fig4.png", "tracks.csv", "b.csv", "report/report.html"]
    assert [one for one in made if not (reader / one).is_file()] == []


def test_the_page_on_lenses_can_be_followed(reader: Path):
    assert follow(ROOT / "docs" / "lenses.md")["rays"] is not None


def test_the_guides_scene_is_a_scene(reader: Path):
    import tapetum as tp

    (reader / "bench.yaml").write_text(blocks(GUIDE, "yaml")[0], encoding="utf-8")
    assert tp.load_scene("bench.yaml").target.object_distance == 5.0


def commands() -> Iterator[tuple[str, str]]:
    """Lines of code that call tapetum, joined where they go on; patterns with [options] are not for typing."""
    for path in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        text = path.read_text(encoding="utf-8").replace("\\\n", " ")
        typed = re.findall(r"^    (tapetum .+)$", text, re.MULTILINE) + re.findall(r"`(tapetum [^`]+)`", text)
        yield from ((path.name, line) for line in typed if not re.search(r"\[--|…|\|", line))


def test_there_are_commands_to_check():
    assert len(list(commands())) >= 8


@pytest.mark.parametrize(("where", "line"), list(commands()))
def test_a_documented_command_parses(where: str, line: str):
    from tapetum.cli.app import root_command

    command: Any = root_command()
    arguments = shlex.split(line)[1:]
    context = click.Context(command, info_name="tapetum")
    while isinstance(command, click.Group):
        name = arguments.pop(0)
        assert name in command.commands, f"{where}: {line}"
        command = command.commands[name]
    if arguments:
        command.make_context("tapetum", arguments, parent=context)
