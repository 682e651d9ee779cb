"""What README and documentation tell a reader to type works: Python blocks run, commands parse."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
import typer

from tapetum.errors import InputError

ROOT = Path(__file__).parents[1]
GUIDE = ROOT / "docs" / "guide.md"


def blocks(path: Path, language: str) -> list[str]:
    found = re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert found, f"no {language} block in {path.name}"
    return found


def sections(path: Path) -> dict[str, list[str]]:
    """The Python blocks under each heading."""
    parts = re.split(r"^## (.+)$", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    pairs = zip(parts[1::2], parts[2::2], strict=True)
    return {title: re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE) for title, text in pairs}


def execute(code: str, names: dict[str, Any], where: str) -> None:
    exec(compile(code, where, "exec"), names)


@pytest.fixture
def reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A reader's folder, without a screen, with the scene file that the guide prints."""
    from tapetum.simulate import Image

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Image, "show", lambda self: None)
    (tmp_path / "my-bench.yaml").write_text(blocks(GUIDE, "yaml")[0], encoding="utf-8")
    return tmp_path


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorter than the guide's minute of film and dozen epochs, all else as it stands."""
    from tapetum.models import ResNet18
    from tapetum.record import Session

    # The room's function hides the module of its name.
    monkeypatch.setattr(sys.modules["tapetum.record.film"], "Session", lambda: Session(seconds=1.2))
    defaults = ResNet18.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "epochs", 1)
    monkeypatch.setitem(defaults, "size", 32)


def readme() -> tuple[str, str]:
    (code,) = blocks(ROOT / "README.md", "python")
    first, _, rest = code.partition("\n\nmodel = ")
    assert rest
    return first, f"import tapetum as tp\nmodel = {rest}"


def test_the_readmes_simulation_runs(reader: Path, capsys):
    names: dict[str, Any] = {}
    execute(readme()[0], names, "README.md")
    assert 0 < float(capsys.readouterr().out) < 0.01
    assert (reader / "rr.tif").is_file()
    assert names["frames"].shape == (3, 256, 256)


def test_the_readmes_tracking_runs(reader: Path, capsys):
    import tapetum as tp

    try:
        tp.pretrained("thin-lens-gaze")
    except InputError as error:
        pytest.skip(f"the bundled model is not there ({error})")
    tp.film(tp.load_scene("hand-held"), "short.rec", tp.Session(seconds=0.4))
    shutil.copy("short.rec/probe.mkv", "probe.mkv")
    execute(readme()[1], {}, "README.md")
    assert "gaze_x" in capsys.readouterr().out


def test_the_guides_scenes_and_simulation_run(reader: Path):
    found, names = sections(GUIDE), {}
    for title in ("Scenes", "Simulate"):
        for code in found[title]:
            execute(code, names, f"guide.md, {title}")
    assert names["images"].irradiance.shape == (3, 256, 256)
    assert (reader / "rr.tif").is_file()
    assert names["turn"].grad.abs().sum() > 0
    assert names["mine"].target.object_distance == 5.0


def test_the_guides_real_lenses_run(reader: Path):
    names: dict[str, Any] = {}
    execute("import tapetum as tp", names, "guide.md")
    for code in sections(GUIDE)["Real lenses and phones"]:
        execute(code, names, "guide.md, Real lenses and phones")
    assert names["turned"].irradiance.shape == (3, 64, 64)
    # An open app makes the phone flash.
    assert names["opened"].irradiance.max() > 1.2 * names["closed"].irradiance.max()


def test_the_guides_recording_to_tracks_runs(reader: Path, brief, capsys):
    found, names = sections(GUIDE), {}
    assert set(found) == {
        "Scenes",
        "Simulate",
        "Real lenses and phones",
        "Recordings",
        "Datasets and models",
        "Scores",
        "Track",
        "Examples",
        "When something is wrong",
    }
    execute("import tapetum as tp", names, "guide.md")
    for title in ("Recordings", "Datasets and models", "Scores", "Track"):
        if title == "Track":
            shutil.copy("hand.rec/probe.mkv", "probe.mkv")
        for code in found[title]:
            execute(code, names, f"guide.md, {title}")
    assert names["prediction"].value.shape == (len(names["test"]), 2)
    assert (reader / "fig10.png").stat().st_size > 5000
    assert "gaze_x" in capsys.readouterr().out


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
    from tapetum.cli.app import app

    command: Any = typer.main.get_command(app)
    arguments = shlex.split(line)[1:]
    context = click.Context(command, info_name="tapetum")
    while isinstance(command, click.Group):
        name = arguments.pop(0)
        assert name in command.commands, f"{where}: {line}"
        command = command.commands[name]
    if arguments:
        command.make_context("tapetum", arguments, parent=context)


def test_the_guides_commands_simulate(reader: Path):
    from tapetum.cli.app import main

    lines = [line for where, line in commands() if where == "guide.md" and line.startswith("tapetum simulate")]
    assert len(lines) == 4
    for line in lines:
        coarse = ["--set", "sampling.accuracy=0.02", "--set", "probe.sensor.pixels=[48, 48]"]
        assert main([*shlex.split(line)[1:], *coarse]) == 0
    for name in ("rr.png", "sweep.npy", "fig4.png", "real.png"):
        assert (reader / name).stat().st_size > 0
