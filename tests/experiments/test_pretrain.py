"""How the bundled model is made, at a hundredth of its size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest

from tapetum.bench import Scene, draw_unit, load_scene
from tapetum.errors import InputError
from tapetum.experiments import pretrain
from tapetum.experiments.copies import film_copies
from tapetum.models import ResNet18, load_model, model_card
from tapetum.progress import quiet
from tapetum.record import HandMotion, Session, open_recording
from tapetum.record.marks import scene_mark

pytestmark = pytest.mark.usefixtures("narrow")


def coarse_scene(name: str, values: Sequence[str] = ()) -> Scene:
    """The bundled model's bench with a smaller aperture and larger pixels: its images take a tenth of the time."""
    probe = ["probe.sensor.pixels=[160, 120]", "probe.sensor.pitch=8.8 um", "probe.sensor.exposure=200 us"]
    target = ["target.sensor.pixels=[162, 122]", "target.sensor.pitch=13.2 um", "target.lens.aperture_radius=2 mm"]
    return load_scene(name, [*values, *probe, *target, "sampling.accuracy=0.1"])


TINY = pretrain.Recipe(epochs=2, copies=2)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pretrain, "load_scene", coarse_scene)
    monkeypatch.setattr(pretrain, "CROP", 80)
    defaults = ResNet18.__init__.__kwdefaults__
    assert defaults is not None
    monkeypatch.setitem(defaults, "size", 32)
    monkeypatch.setattr(pretrain, "TRAIN_SEEDS", (101,))
    monkeypatch.setattr(pretrain, "NEAR_AXIS", {107: 0.05})
    monkeypatch.setattr(pretrain, "TEACHER_SEEDS", range(4_000_000, 4_000_004))
    monkeypatch.setattr(pretrain, "TEACHER_FRAMES", 2)
    monkeypatch.setattr(pretrain, "SECONDS", 1.2)
    monkeypatch.setattr(pretrain, "UNIT_SEEDS", range(3_000_000, 3_000_010))
    monkeypatch.setattr(pretrain, "UNIT_FRAMES", 2)


@pytest.mark.usefixtures("tiny")
def test_an_interrupted_making_goes_on_where_it_stopped(tmp_path: Path) -> None:
    work, out = tmp_path / "work", tmp_path / "model"

    def stop(_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pretrain.make_pretrained(work, out, recipe=TINY, on_epoch=stop)
    assert not out.exists()
    filmed = {file: file.stat().st_mtime_ns for file in work.rglob("*.mkv")}
    assert len(filmed) == 6

    epochs: list[int] = []
    pretrain.make_pretrained(work, out, recipe=TINY, on_epoch=lambda report: epochs.append(report.epoch))
    # Neither the films nor the first epoch are made again.
    assert {file: file.stat().st_mtime_ns for file in work.rglob("*.mkv")} == filmed
    assert epochs == [2]
    card = model_card(out)
    assert card["notes"]["seeds"] == [101]
    assert card["notes"]["near_axis"] == {"107": 0.05}
    assert card["training"]["copies"] == {"copies": 2, "frames": 4}
    assert card["notes"]["trained_on"].startswith("CPU, torch")
    assert pretrain.is_made(out, TINY) and not pretrain.is_made(out, pretrain.QUICK)
    assert card["weights"]["precision"] == "half"
    assert set(card["metrics"]["targets"]) == {"gaze_x", "gaze_y"}
    model = load_model(out)
    assert model.target_names == ("gaze_x", "gaze_y")
    # Intervals for copies of the camera, and what it knows again: its recordings and their scene.
    assert model.others_ is not None and card["training"]["other_units"] == {"copies": 10, "frames": 20}
    assert model.knows(open_recording(work / "101.rec").source().marks)
    assert not model.knows(frozenset({scene_mark(draw_unit(coarse_scene(pretrain.SCENE), None, 3_000_000))}))


@pytest.mark.usefixtures("tiny")
def test_what_was_made_before_serves_only_what_it_was_made_for(tmp_path: Path) -> None:
    path = tmp_path / "a.rec"
    session = Session(1.2, seed=7)
    pretrain.labelled_recording(path, session)
    first = open_recording(path).uuid
    pretrain.labelled_recording(path, session)
    assert open_recording(path).uuid == first
    # The same length and seed of another take.
    pretrain.labelled_recording(path, replace(session, motion=HandMotion(roll=0.2)))
    second = open_recording(path)
    assert second.uuid != first

    built = pretrain._built(tmp_path, "train", [path], 0.5, quiet)
    assert pretrain._built(tmp_path, "train", [path], 0.5, quiet).tp.hash == built.tp.hash
    labels = second.labels()
    assert labels is not None
    moved = pc.add(labels["gaze_x"], 0.01)
    second.write_labels(labels.set_column(labels.column_names.index("gaze_x"), "gaze_x", moved))
    other = pretrain._built(tmp_path, "train", [path], 0.5, quiet)
    np.testing.assert_allclose(other["gaze_x"].values, built["gaze_x"].values + 0.01, atol=1e-6)
    assert len(list(tmp_path.glob("train-*.zarr"))) == 2


def test_processes_film_the_same_copies(tmp_path: Path) -> None:
    scene, seeds = coarse_scene(pretrain.SCENE), range(5_000_100, 5_000_103)
    one, two = (film_copies(scene, seeds, 2, tmp_path / str(k), side=80, processes=k) for k in (1, 2))
    assert one.tp.hash == two.tp.hash and two.sizes["frame"] == 6
    # What is there is not filmed again; a film that is spoilt is named.
    spoilt = next((tmp_path / "2").glob(f"copy-{seeds[1]}-*.npz"))
    spoilt.write_bytes(b"spoilt")
    with pytest.raises(InputError, match=spoilt.name):
        film_copies(scene, seeds, 2, tmp_path / "2", side=80, processes=2)
