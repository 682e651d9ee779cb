"""Names mean one thing, one rule holds for outputs that exist, and old spellings of options still work."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tapetum.cli.app import root_command
from tapetum.models import load_model
from tapetum.track import read_tracks

LITTLE = ("--set", "probe.sensor.pixels=[32, 32]", "--set", "sampling.accuracy=0.02")


def leaves() -> list[tuple[str, Any]]:
    """Every command that does something, by its words."""
    found = []
    for name, one in root_command().commands.items():  # type: ignore[attr-defined]
        inner = getattr(one, "commands", None)
        found += [(name, one)] if inner is None else [(f"{name} {word}", leaf) for word, leaf in inner.items()]
    return found


def test_an_option_of_one_name_means_one_thing() -> None:
    """Beside `--size`, `--seconds`, `--seed` and `--out`, whose objects differ by command."""
    shared: dict[str, set[str | None]] = {}
    for _, command in leaves():
        for option in command.params:
            for spelling in option.opts:
                if spelling in ("--model", "--device", "--processes", "--cluster", "--overwrite", "--json", "--set"):
                    shared.setdefault(spelling, set()).add(option.help)
    assert shared and all(len(meanings) == 1 for meanings in shared.values()), shared
    everything = " ".join(" ".join(option.opts) for _, command in leaves() for option in command.params)
    assert not {"--force", "--workers", "--target"} & set(everything.split())


def test_every_command_that_writes_has_one_rule() -> None:
    for words, command in leaves():
        spellings = {spelling for option in command.params for spelling in option.opts}
        assert ("--overwrite" in spellings) == ("--out" in spellings or "--sheet" in spellings), words


@pytest.mark.parametrize(
    "command",
    [
        "simulate thin-lens -o {out}.npy",
        "simulate thin-lens -o {out}.zarr",
        "record hand-held -o {out}.rec",
        "dataset build {chain.recording} -o {out}.zarr",
        "dataset synth rotation -o {out}.zarr",
        "dataset import {folder} -o {out}.zarr",
        "dataset info {chain.dataset} --sheet {out}.png",
        "train {chain.dataset} -o {out}",
        "adapt thin-lens-gaze {chain.dataset} -o {out}",
        "evaluate {chain.model} {chain.dataset} -o {out}",
        "evaluate {chain.model} {chain.dataset} -o {out}.json",
        "export thin-lens-gaze -o {out}.onnx",
        "track {chain.recording} -o {out}.csv",
        "track {chain.recording} -o {folder}/other.csv --detections {out}.csv",
        "fuse a.csv b.csv -o {out}.jsonl",
        "calibrate probe a.npy b.npy -o {out}.yaml",
        "calibrate probe a.npy b.npy -o {folder}/s.yaml --page {out}.html",
        "calibrate ghost {chain.recording} -o {out}.yaml",
        "calibrate sync {chain.recording} -o {out}.yaml",
        "paper fig4 -o {folder}",
        "demo -o {folder}",
    ],
)
def test_what_exists_is_refused_before_any_work(run, chain, tmp_path: Path, command: str) -> None:
    folder, out = tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    words = command.format(chain=chain, folder=folder, out=out).split()
    stands = next((Path(word) for word in words if word.startswith(f"{out}")), folder / f"{'fig4.md'}")
    if words[0] == "demo":
        stands = folder / "report.html"
    stands.write_text("dear")
    ran = run(*words)
    assert ran.code == 2 and f"{stands}: exists already; choose another name or pass --overwrite" in ran.complaint
    assert stands.read_text() == "dear" and ran.out.count("\n") <= 1
    assert {path.name for path in tmp_path.rglob("*")} == {"in", stands.name}


def test_force_replaces_a_file_once_the_new_one_is_whole(run, chain, tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "t.csv"
    out.write_text("of an earlier run")

    def broken(*given: object, **named: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("tapetum.track.Tracker.update", broken)
        assert run("track", chain.recording, "-o", out, "--overwrite").code == 130
    assert out.read_text() == "of an earlier run"
    assert run("track", chain.recording, "-o", out, "--overwrite").code == 0
    assert read_tracks(out).num_rows == 20
    assert run("simulate", "thin-lens", *LITTLE, "-o", tmp_path / "x.zarr").code == 0
    assert run("simulate", "thin-lens", *LITTLE, "-o", tmp_path / "x.zarr", "--overwrite").code == 0


def test_a_folder_that_was_being_filled_is_filled_on(run, tmp_path: Path, monkeypatch) -> None:
    """`paper` and `demo` go on after an interruption; what an interrupted run left is not refused."""
    from tapetum.experiments import write as writing
    from tapetum.report.figures._style import new_figure

    def maker(error: BaseException | None) -> Callable[[object], object]:
        def make(work: object) -> object:
            if error is not None:
                raise error
            return new_figure(1, 1), {}

        return make

    monkeypatch.setattr(writing, "render", lambda name, numbers: f"# {name}\n")
    monkeypatch.setitem(writing._MAKERS, "fig4", maker(None))
    monkeypatch.setitem(writing._MAKERS, "fig5", maker(KeyboardInterrupt()))
    ran = run("paper", "fig4", "fig5", "-o", tmp_path / "o")
    assert ran.code == 130
    assert ran.complaint == f"interrupted: what is done is kept in {tmp_path / 'o'}, and the same command goes on"
    assert (tmp_path / "o" / "fig4.md").exists()
    monkeypatch.setitem(writing._MAKERS, "fig5", maker(None))
    assert run("paper", "fig4", "fig5", "-o", tmp_path / "o").code == 0
    assert "pass --overwrite" in run("paper", "fig5", "-o", tmp_path / "o").complaint
    assert run("paper", "fig5", "-o", tmp_path / "o", "--overwrite").code == 0
    assert not [path for path in (tmp_path / "o").iterdir() if path.name.startswith(".")]
    # A run that made nothing leaves nothing.
    monkeypatch.setitem(writing._MAKERS, "fig5", maker(KeyboardInterrupt()))
    assert run("paper", "fig5", "-o", tmp_path / "deep").code == 130 and not (tmp_path / "deep").exists()


def test_old_spellings_mean_what_they_meant(run, chain, tmp_path: Path) -> None:
    command = root_command()
    for words, old, new in (
        ("train x -o y", "--model resnet18 --target=focus", "--kind resnet18 --label=focus"),
        ("record a -o y", "--target b", "--target-source b"),
        ("dataset synth rotation -o y", "--workers 2", "--processes 2"),
        ("paper -o y", "--workers 2 --model m", "--processes 2 --model m"),
    ):
        leaf, context = command, None
        given = words.split()
        while hasattr(leaf, "commands"):
            leaf = leaf.commands[given.pop(0)]  # type: ignore[union-attr]
        found = [leaf.make_context("x", [*given, *more.split()], parent=context).params for more in (old, new)]
        assert found[0] == found[1]
        assert not set(old.split()[::2]) & set(run(*words.split()[:1], "--help").out.split()) - {"--model"}
    assert run("train", chain.dataset, "-o", tmp_path / "m", "--kind", "zernike", "--label", "gaze_x").code == 0
    assert load_model(tmp_path / "m").target_names == ("gaze_x",)
    # After -- there are no options.
    assert "--model" in run("simulate", "-o", tmp_path / "x.npy", "--", "--model").complaint


def test_one_seed_for_all(run, chain, tmp_path: Path) -> None:
    from tapetum.data.synth.plan import SEED as SETS
    from tapetum.defaults import SEED
    from tapetum.experiments.demo import DEMO_SEED

    assert SEED == SETS == DEMO_SEED == 1
    little = ("--kind", "resnet18", "--crop", 32, "--size", 16, "--epochs", 1)
    assert run("train", chain.dataset, "-o", tmp_path / "net", *little).code == 0
    assert json.loads((tmp_path / "net" / "model.json").read_text())["parameters"]["seed"] == SEED
    ran = run("record", "hand-held", "-o", tmp_path / "a.rec", "--seconds", 0.2, "--no-labels", *LITTLE)
    assert f"seed {SEED}" in ran.out


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("track {chain.recording} -o {out}.csv --model {chain.model} --device cuda:99", "on the processor alone"),
        ("track {chain.recording} -o {out}.csv --model thin-lens-gaze --device cuda:99", "device"),
        ("evaluate {chain.model} {chain.dataset} --device cuda:99", "on the processor alone"),
        ("simulate thin-lens -o {out}.npy --device cuda:99", "CUDA devices"),
        ("dataset synth rotation -o {out}.zarr --processes some", "--processes: must be a number or auto"),
        ("dataset synth rotation -o {out}.zarr --processes 0", "--processes: must be a number or auto"),
        ("paper fig9 -o {out} --processes -1", "--processes: must be a number or auto"),
        ("track {out}.csv -o {out}.csv", "does not exist"),
    ],
)
def test_where_work_is_done_is_checked(run, chain, tmp_path: Path, command: str, words: str) -> None:
    ran = run(*command.format(chain=chain, out=tmp_path / "out").split())
    assert ran.code == 2 and words in ran.complaint
    assert not list(tmp_path.iterdir())
