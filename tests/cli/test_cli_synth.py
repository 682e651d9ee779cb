"""`tapetum dataset synth`: a set in one command, and the same command after an interruption."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

import tapetum.data.synth as synth
from tapetum.bench import load_scene, with_values
from tapetum.data import open_dataset
from tapetum.data.synth.plan import Plan
from tapetum.data.write import Rules


def little(kind: str, size: str, seed: int, units: object = None, scene: object = None) -> Plan:
    """In place of the bundled plans: one video of three seconds by little cameras."""
    values = {
        "probe.sensor.pixels": [96, 80],
        "probe.sensor.pitch": "4.4 um",
        "target.sensor.pixels": [162, 122],
        "target.sensor.pitch": "35.2 um",
    }
    plan = synth.rotation_plan(with_values(load_scene("hand-held"), values), size, seed)
    session = plan.videos[0].session
    # So little a frame holds but a quiet hand.
    session = replace(session, seconds=3.0, motion=replace(session.motion, sway=3e-3))
    video = replace(plan.videos[0], session=session)
    return replace(plan, kind=kind, videos=(video,), rules=Rules(side=24))


@pytest.fixture(autouse=True)
def _little(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(synth, "make_plan", little)


def test_synth_makes_a_dataset(run, tmp_path: Path) -> None:
    out = tmp_path / "set.zarr"
    ran = run("dataset", "synth", "rotation", "-o", out, "--seed", 3)
    assert ran.code == 0
    assert "1 videos, seed 3" in ran.out and "to train on" in ran.out
    assert open_dataset(out).attrs["synth"]["seed"] == 3
    again = run("dataset", "synth", "rotation", "-o", out, "--seed", 3)
    assert again.code == 2 and "exists already" in again.complaint
    assert run("dataset", "synth", "rotation", "-o", out, "--seed", 4, "--overwrite").code == 0
    assert open_dataset(out).attrs["synth"]["seed"] == 4


def test_an_interruption_says_how_to_go_on(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "set.zarr"

    def stop(items, what, *, total=None):
        raise KeyboardInterrupt
        yield from items

    with monkeypatch.context() as pressed:
        pressed.setattr("tapetum.cli.dataset.bar", stop)
        ran = run("dataset", "synth", "rotation", "-o", out)
    assert ran.code == 130
    assert ran.complaint == f"interrupted: what is done is kept in {out}.part, and the same command carries on"
    other = run("dataset", "synth", "rotation", "-o", out, "--seed", 2)
    assert other.code == 2 and "was begun with seed 1, not 2" in other.complaint
    assert run("dataset", "synth", "rotation", "-o", out).code == 0
    assert [path.name for path in tmp_path.iterdir()] == ["set.zarr"]


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("gaze",), "KIND: unknown value 'gaze'"),
        (("rotation", "--size", "huge"), "--size: unknown value 'huge'"),
        (("rotation", "--workers", "1", "--cluster", "tcp://127.0.0.1:1"), "two ways"),
        (("rotation", "--cluster", "nonsense://1"), "no Dask scheduler answers"),
    ],
)
def test_bad_input_is_one_line(run, tmp_path: Path, arguments, word: str) -> None:
    ran = run("dataset", "synth", *arguments, "-o", tmp_path / "set.zarr")
    assert ran.code == 2 and word in ran.complaint
    assert not (tmp_path / "set.zarr").exists()


def test_without_dask_the_extra_is_named(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    ran = run("dataset", "synth", "rotation", "--cluster", "tcp://127.0.0.1:1", "-o", tmp_path / "set.zarr")
    assert ran.code == 2 and "tapetum[cluster]" in ran.complaint


def test_what_is_no_dataset_stays(run, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    ran = run("dataset", "synth", "rotation", "-o", tmp_path / "mine", "--overwrite")
    assert ran.code == 2 and "no tapetum-dataset" in ran.complaint
