"""A scene's file as a model: what it reads, what a twin's numbers add, and what it refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tapetum.bench import load_scene, scene_yaml
from tapetum.errors import InputError
from tapetum.models import load_predictor
from tapetum.models.simulation import SimulationFit, read_by_scene
from tapetum.record.marks import scene_mark

SMALL = ["probe.sensor.pixels=[128, 128]", "probe.sensor.pitch=4.4 um", "sampling.accuracy=0.05", "second_beam=null"]


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    path = tmp_path / "twin.yaml"
    path.write_text(scene_yaml(load_scene("hand-held", SMALL)), encoding="utf-8")
    return path


def numbers(twin: Path, **changed: object) -> Path:
    told = {"format": "tapetum-twin", "version": 1, "scene": scene_mark(load_scene(twin)), "systematic": [3e-4, 4e-4]}
    told["options"] = {"accuracy": 0.04, "roll": False, "unevenness": 0.02, "offsets": [0.5, 0.25]}
    path = twin.with_suffix(".json")
    path.write_text(json.dumps(told | changed), encoding="utf-8")
    return path


def test_a_twins_numbers_are_used(twin: Path) -> None:
    alone = load_predictor(twin)
    assert isinstance(alone, SimulationFit)
    assert (alone.systematic, alone.accuracy, alone.unevenness) == ((0.0, 0.0), None, 0.0)
    numbers(twin)
    model = read_by_scene(twin)
    # Where a search ends, pictures become as fine as each frame asks, however fine they were in the fit.
    assert (model.systematic, model.accuracy) == ((3e-4, 4e-4), None)
    assert (model.unevenness, model.offsets) == (0.02, (0.5, 0.25))
    assert model.nuisances == ("power", "place_x", "place_y")
    numbers(twin, options={"roll": True})
    assert read_by_scene(twin).nuisances[-1] == "roll"


def test_the_place_of_photosites_that_show_is_unknown(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(scene_yaml(load_scene("rotation")), encoding="utf-8")
    numbers(path)
    model = read_by_scene(path)
    assert (model.nuisances[-2:], model.accuracy) == (("phase_x", "phase_y"), None)


def test_systematic_deviations_widen_the_intervals(twin: Path) -> None:
    import tapetum as tp

    scene = load_scene("hand-held", [*SMALL, "target.rotation=[0.3 deg, 0.2 deg]"])
    frame = tp.expose(tp.retroreflect(scene), scene.probe, seed=1)
    models = [
        SimulationFit(load_scene(twin), starts=1, nodes=9, systematic=systematic)
        for systematic in ((0.0, 0.0), (3e-4, 4e-4))
    ]
    models[1]._pictures = models[0]._pictures
    narrow, wide = (one.predict(frame) for one in models)
    np.testing.assert_array_equal(narrow.value, wide.value)
    half = [(one.upper - one.lower)[0] / 2 / 1.645 for one in (narrow, wide)]
    np.testing.assert_allclose(half[1], np.hypot(half[0], [3e-4, 4e-4]), rtol=1e-3)
    assert half[0].max() < 2e-4


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"scene": "scene:of-another"}, "holds the numbers of another scene than twin.yaml"),
        ({"systematic": ["wide", 0]}, "cannot be used"),
        ({"systematic": [-1, 0]}, "systematic: must be two numbers of the field, 0 or more"),
        ({"options": {"offsets": None}}, "cannot be used"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(twin: Path, changed: dict[str, object], told: str) -> None:
    numbers(twin, **changed)
    with pytest.raises(InputError, match=told):
        read_by_scene(twin)


def test_files_of_something_else_are_no_numbers(twin: Path) -> None:
    for text in ("{}", "no JSON", '{"format": "tapetum-twin", "version": 1}'):
        twin.with_suffix(".json").write_text(text, encoding="utf-8")
        assert read_by_scene(twin).systematic == (0.0, 0.0)


def test_a_scene_that_is_missing_or_cannot_be_fitted_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no-such.yaml"):
        load_predictor(tmp_path / "no-such.yaml")
    path = tmp_path / "phones.yaml"
    path.write_text(scene_yaml(load_scene("phones")), encoding="utf-8")
    with pytest.raises(InputError, match="a phone"):
        load_predictor(path)
