"""`tapetum evaluate`: the report, the numbers, and what it refuses."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from tapetum.record.recording import open_recording


def test_writes_a_report_and_never_over_what_is_dear(run, chain, tmp_path: Path) -> None:
    out = tmp_path / "report"
    ran = run("evaluate", chain.model, chain.dataset, "-o", out)
    assert ran.code == 0 and "4 test frames" in ran.out and f"wrote {out}" in ran.out
    page = (out / "report.html").read_text()
    assert "Zernike + ridge on spot.zarr" in page and "the training part of this dataset" in page
    assert {"path.png", "numbers.json", "error-over-field.png"} <= {path.name for path in out.iterdir()}
    numbers = json.loads((out / "numbers.json").read_text())
    printed = json.loads(run("evaluate", chain.model, chain.dataset, "--json").out)
    assert {key: numbers[key] for key in printed} == printed
    again = run("evaluate", chain.model, chain.dataset, "-o", out)
    assert again.code == 2 and "pass --overwrite" in again.complaint
    assert run("evaluate", chain.model, chain.dataset, "-o", out, "--overwrite").code == 0
    dear = tmp_path / "dear"
    dear.mkdir()
    (dear / "letter").write_text("dear")
    ran = run("evaluate", chain.model, chain.dataset, "-o", dear, "--overwrite")
    assert ran.code == 2 and "may be replaced" in ran.complaint and (dear / "letter").exists()
    ran = run("evaluate", chain.model, chain.dataset, "-o", tmp_path / "r.html")
    assert ran.code == 2 and "name a folder" in ran.complaint
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dear", "report"]


def test_an_interrupted_report_leaves_nothing(run, chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop(*_: object, **__: object) -> bytes:
        raise KeyboardInterrupt

    monkeypatch.setattr("tapetum.report.evaluation.write.figure_png", stop)
    ran = run("evaluate", chain.model, chain.dataset, "-o", tmp_path / "deep" / "report")
    assert ran.code == 130 and not list(tmp_path.iterdir())


def test_a_dataset_of_other_labels_or_smaller_crops(run, chain, tmp_path: Path) -> None:
    import shutil

    recording, other, little = tmp_path / "a.rec", tmp_path / "other.zarr", tmp_path / "little.zarr"
    shutil.copytree(chain.recording, recording)
    table = {"frame": pa.array(range(20), pa.int64()), "focal_length": np.linspace(0.05, 0.1, 20)}
    open_recording(recording).write_labels(pa.table({**table, "how": ["by hand"] * 20, "quality": np.ones(20)}))
    assert run("dataset", "build", recording, "-o", other).code == 0
    ran = run("evaluate", chain.model, other, "-o", tmp_path / "report")
    assert ran.code == 2 and "has no label gaze_x; it has: focal_length" in ran.err.splitlines()[-1]
    assert run("dataset", "build", chain.recording, "-o", little, "--side", 100).code == 0
    ran = run("evaluate", chain.model, little, "-o", tmp_path / "report")
    assert ran.code == 2 and "400 pixels does not fit crops of 100" in ran.err.splitlines()[-1]
    assert not (tmp_path / "report").exists() and "Traceback" not in ran.err


def test_a_scene_stands_where_a_model_does(run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    from tapetum.bench import load_scene, scene_yaml
    from tapetum.data import dataset_from_arrays
    from tapetum.models.simulation.pictures import Pictures
    from tapetum.simulate.exposure import digitise
    from tapetum.simulate.radiometry import dark_electrons

    changes = ["probe.sensor.pixels=[112, 112]", "probe.sensor.pitch=4.4 um", "sampling.accuracy=0.05"]
    changes += ["target.lens.aperture_radius=2 mm"]
    scene = load_scene("hand-held", [*changes, "second_beam=null"])
    rng = np.random.default_rng(1)
    gazes = rng.uniform(-0.3, 0.3, (6, 2))
    pictures = Pictures(scene, 100)
    light = torch.from_numpy(pictures.render(pictures.start(), gazes) + dark_electrons(scene.probe.sensor))
    images = np.stack([digitise(one, scene.probe.sensor, rng) for one in light])
    labels = {"gaze_x": gazes[:, 0], "gaze_y": gazes[:, 1]}
    made = dataset_from_arrays(images, labels, full_scale=255, split=np.r_[0, 0, np.ones(4, np.int8)])
    monkeypatch.setattr("tapetum.data.open_dataset", lambda path: made)
    path = tmp_path / "twin.yaml"
    path.write_text(scene_yaml(scene))
    ran = run("evaluate", path, tmp_path / "set.zarr", "--json")
    assert ran.code == 0, ran.err
    told = json.loads(ran.out)
    assert told["refused"] == 0 and all(told["targets"][name]["mae"] < 1e-3 for name in labels)
    (tmp_path / "twin.json").write_text('{"format": "tapetum-twin", "version": 1, "scene": "another"}')
    ran = run("evaluate", path, tmp_path / "set.zarr")
    assert ran.code == 2 and "twin.json: holds the numbers of another scene" in ran.complaint
    (tmp_path / "twin.json").unlink()
    for words, told in (
        (("export", path, "-o", tmp_path / "a.onnx"), "only networks become ONNX"),
        (("adapt", path, tmp_path / "set.zarr", "-o", tmp_path / "b"), "is no network that can be trained further"),
        (("calibrate", "units", path, "hand-held", "-o", tmp_path / "b"), "reads by simulation"),
    ):
        ran = run(*words)
        assert ran.code == 2 and told in ran.complaint


def test_a_models_own_file_is_no_output(run, chain, tmp_path: Path) -> None:
    """Numbers were written over the model's card."""
    model = tmp_path / "model"
    shutil.copytree(chain.model, model)
    before = (model / "model.json").read_bytes()
    ran = run("evaluate", model, chain.dataset, "-o", model / "model.json", "--overwrite")
    assert ran.code == 2 and "is a part of" in ran.complaint and (model / "model.json").read_bytes() == before


def test_a_card_edited_by_hand(run, chain, tmp_path: Path) -> None:
    model = tmp_path / "model"
    for key, value in (("units", 5), ("chosen", [1])):
        shutil.copytree(chain.model, model)
        card = json.loads((model / "model.json").read_text())
        card["training"] = {**(card.get("training") or {}), key: value}
        (model / "model.json").write_text(json.dumps(card))
        ran = run("evaluate", model, chain.dataset)
        assert ran.code == 2 and f"training.{key}" in ran.complaint
        shutil.rmtree(model)
