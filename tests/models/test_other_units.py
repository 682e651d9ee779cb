"""Intervals for a copy of the camera that a model has not seen: what they hold, and when they are used."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import xarray as xr
from tests.models.conftest import pictures

from tapetum.bench import load_scene
from tapetum.bench.load import scene_dict
from tapetum.data import dataset_from_arrays
from tapetum.data.dataset import UNIT, class_variable
from tapetum.errors import InputError
from tapetum.models import NetworkEstimator, ZernikeRidge, calibrate_units, load_model, save_model
from tapetum.models.intervals import conformal_half_width
from tapetum.models.other_units import fit_unit_intervals, grouped_half_width
from tapetum.record import HandMotion, Session
from tapetum.record.marks import recording_marks, scene_mark
from tapetum.record.shot import Shot
from tapetum.track import track

UNITS, FRAMES = 15, 12


def copies(number: int = UNITS, frames: int = FRAMES, seed: int = 3) -> xr.Dataset:
    """Frames of copies whose field is displaced, each by its own part."""
    rng, images, gaze = np.random.default_rng(seed), [], []
    for n in range(number):
        seen, true = pictures(frames, seed=100 * seed + n)
        images.append(seen)
        gaze.append(true + rng.normal(0, 0.1, 2))
    at = np.concatenate(gaze)
    made = dataset_from_arrays(np.concatenate(images), {"gaze_x": at[:, 0], "gaze_y": at[:, 1]})
    return made.assign({UNIT: class_variable([f"copy-{n:02d}" for n in range(number) for _ in range(frames)])})


def held(model: ZernikeRidge, data: xr.Dataset, unit: str) -> float:
    found, truth = model.predict(data, anyway=True, unit=unit), data.tp.values(("gaze_x", "gaze_y"))
    return float(((found.lower <= truth) & (truth <= found.upper)).mean())


def test_copies_are_counted_and_not_their_frames() -> None:
    """Every frame of a copy shares its displacement: intervals of pooled frames hold too little."""
    rng = np.random.default_rng(1)
    ours, pooled = [], []
    for _ in range(600):
        sizes = np.r_[rng.integers(5, 12, 10), 400]
        unit = np.repeat(np.arange(len(sizes)), sizes)
        shift, spread = rng.normal(0, 1, len(sizes) + 1), np.r_[rng.uniform(0.5, 2, 10), 0.1, rng.uniform(0.5, 2)]
        errors = shift[unit] * spread[unit] + rng.normal(0, 0.05, len(unit))
        new = np.abs(shift[-1] * spread[-1] + rng.normal(0, 0.05, 50))
        ours.append((new <= grouped_half_width(errors[:, None], unit)[0]).mean())
        pooled.append((new <= conformal_half_width(errors[:, None])[0]).mean())
    assert np.mean(ours) > 0.9
    assert np.mean(pooled) < 0.7


def test_too_few_copies_promise_nothing() -> None:
    errors, unit = np.linspace(-1, 1, 80)[:, None], np.repeat(np.arange(8), 10)
    assert np.isinf(grouped_half_width(errors, unit)).all()
    assert np.isfinite(grouped_half_width(errors, np.arange(80))).all()
    with pytest.raises(InputError, match="8 copies"):
        fit_unit_intervals(errors, np.zeros(80), unit)


def test_frames_that_are_refused_do_not_widen_the_others() -> None:
    rng = np.random.default_rng(2)
    unit, distance = np.repeat(np.arange(20), 30), np.tile(np.linspace(0.1, 1.9, 30), 20)
    errors = np.where(distance > 1, 10.0, 1.0)[:, None] * rng.uniform(-1, 1, (600, 2))
    found = fit_unit_intervals(errors, distance, unit)
    near, far = found.at(np.array([0.99, 1.01]))
    assert (near < 1.0).all() and (far > 8.0).all()
    # A distance of exactly 1 is answered.
    np.testing.assert_array_equal(found.at(np.array([1.0]))[0], near)


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("kind", ["ridge", "network"])
def test_a_model_knows_two_kinds_of_copies(kind: str, small: xr.Dataset, tmp_path: Path) -> None:
    told = [{"name": "a", "uuid": "one"}, {"name": "b", "uuid": "two"}]
    own = small.assign_attrs(recordings=json.dumps(told))
    if kind == "ridge":
        fresh: ZernikeRidge | NetworkEstimator = ZernikeRidge(
            scales=(40,), order=4, alpha=1e-3, calibration_fraction=0.2
        )
    else:
        fresh = NetworkEstimator(crop=36, size=24, epochs=1, batch=20, device="cpu")
    model = calibrate_units(fresh.fit(own), copies())
    save_model(model, tmp_path / "model")
    model = load_model(tmp_path / "model")
    test, truth = own.tp.test, copies(seed=8)
    # Its own recordings' test part, and the widths that it had before.
    mine = model.predict(test, anyway=True)
    assert mine.unit == "own"
    np.testing.assert_allclose(
        mine.upper - mine.value, np.broadcast_to(model.intervals_.half_width[0], mine.value.shape)
    )
    # Whatever is not known to be its copy gets the wide ones, unless somebody says so.
    assert model.predict(truth, anyway=True).unit == "other"
    assert model.predict(np.asarray(test["image"].values), anyway=True).unit == "other"
    model.whose = "own"
    assert model.predict(truth, anyway=True).unit == "own"
    assert model.predict(truth, anyway=True, unit="other").unit == "other"
    model.whose = None
    assert held(model, truth, "other") > 0.85
    if kind == "ridge":
        assert held(model, truth, "own") < 0.5
    # A new training has no errors on copies yet.
    assert model.fit(own).others_ is None


def test_a_copy_of_the_training_calibrates_nothing(small: xr.Dataset) -> None:
    named = small.assign({UNIT: class_variable(["copy-03"] * small.sizes["frame"])})
    model = ZernikeRidge(scales=(40,), order=2, calibration_fraction=0.2).fit(named)
    with pytest.raises(InputError, match="trained on: copy-03"):
        calibrate_units(model, copies())
    with pytest.raises(InputError, match="does not distinguish copies"):
        calibrate_units(model, small)
    with pytest.raises(InputError, match="no intervals for another copy"):
        model.predict(small, unit="other")
    with pytest.raises(InputError, match="unit"):
        model.predict(small, unit="mine")
    assert model.predict(copies(2), anyway=True).unit == "own"


@pytest.mark.usefixtures("narrow")
def test_the_exported_file_carries_both(small: xr.Dataset, tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    from tapetum.models.export import export_onnx
    from tapetum.models.fast import FastResNet18

    own = small.assign_attrs(recordings=json.dumps([{"uuid": "one"}, {"uuid": "two"}]))
    model = NetworkEstimator(crop=36, size=24, epochs=1, batch=20, device="cpu").fit(own)
    calibrate_units(model, copies())
    read = FastResNet18(export_onnx(model, tmp_path / "both.onnx"), threads=1)
    for data, unit in ((own.tp.test, "own"), (copies(seed=8), "other")):
        wanted, found = model.predict(data, anyway=True), read.predict(data, anyway=True)
        assert wanted.unit == found.unit == unit
        np.testing.assert_allclose(found.upper, wanted.upper, rtol=0, atol=1e-4)


def test_the_scene_tells_the_copy() -> None:
    scene = load_scene("hand-held")
    same = load_scene(
        "hand-held", ["sampling.accuracy=0.03", "illumination.power=1 mW", "target.rotation=[1 deg, 0 deg]"]
    )
    assert scene_mark(scene) == scene_mark(same) == scene_mark(scene_dict(scene))
    for change in ("target.sensor.tilt=[0.1 deg, 0 deg]", "distance=5.6", "illumination.second_beam.ratio=0.11"):
        assert scene_mark(load_scene("hand-held", [change])) != scene_mark(scene)
    shot = Shot(scene, Session(1.0))
    assert shot.cameras["probe"].marks == recording_marks(shot.parameters()) == {scene_mark(scene)}
    walking = Shot(scene, Session(1.0, motion=HandMotion(walk=(4.0, 5.0))))
    assert walking.cameras["probe"].marks == recording_marks(walking.parameters()) == frozenset()


class _Filmed:
    """Frames of one recording, as a source that knows what it shows."""

    live, full_scale, rate, name = False, 255, 15.0, "filmed"
    hardware: ClassVar[dict[str, object]] = {}

    def __init__(self, frames: list, marks: frozenset[str]) -> None:
        self.frames, self.marks, self.count = frames, marks, len(frames)

    def first(self):
        return self.frames[0]

    def __iter__(self):
        return iter(self.frames)

    def __len__(self) -> int:
        return len(self.frames)

    def close(self) -> None:
        pass


def test_tracking_knows_the_copy_by_its_source(small: xr.Dataset) -> None:
    from tapetum.record.source import Frame

    own = small.assign_attrs(recordings=json.dumps([{"uuid": "one"}, {"uuid": "two"}]))
    model = ZernikeRidge(scales=(40,), order=4, alpha=1e-3, calibration_fraction=0.2).fit(own)
    calibrate_units(model, copies())
    image = np.full((60, 60), 10, np.uint8)
    image[10:50, 10:50] = np.asarray(own["image"].values)[0]
    frames = [Frame(0, 0.0, image)]

    def width(marks: frozenset[str], whose: str | None = None) -> float:
        model.whose = whose
        (row,) = next(iter(track(_Filmed(frames, marks), model=model, side=40))).rows
        return row.estimates["gaze_x_high"] - row.estimates["gaze_x_low"]

    theirs = width(frozenset())
    mine = width(frozenset({"recording:one"}))
    assert mine < 0.5 * theirs
    assert width(frozenset({"recording:three"})) == theirs == width(frozenset({"recording:one"}), "other")
    assert width(frozenset(), "own") == mine
