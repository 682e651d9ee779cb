"""`tapetum calibrate units` and `--unit`: intervals for copies of a camera, made and chosen on the command line."""

from __future__ import annotations

import json
import shutil
import socket
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
import zarr

from tapetum.data import open_dataset
from tapetum.errors import InputError
from tapetum.models import load_model, save_model
from tapetum.models.intervals import Intervals

UNITS = 10


@pytest.fixture(scope="module")
def copies(chain, tmp_path_factory) -> Path:
    """The chain's frames as those of ten copies of unknown origin."""
    path = tmp_path_factory.mktemp("units") / "copies.zarr"
    shutil.copytree(chain.dataset, path)
    frames = open_dataset(path).sizes["frame"]
    group = zarr.open_group(str(path), mode="r+", zarr_format=3)
    told = json.loads(str(group.attrs["recordings"]))
    group.attrs["recordings"] = json.dumps([{"name": "elsewhere", "uuid": ""} for _ in told])
    numbers = np.arange(frames, dtype=np.int32) % UNITS
    names = [f"copy-{n}" for n in range(UNITS)]
    array = group.create_array("unit", data=numbers, dimension_names=["frame"], fill_value=-1)
    array.attrs["classes"] = names
    return path


def test_a_model_learns_how_it_errs_on_copies(run, chain, copies: Path, tmp_path: Path) -> None:
    out = tmp_path / "m"
    ran = run("calibrate", "units", chain.model, copies, "-o", out)
    assert ran.code == 0, ran.err
    assert f"saved {out}" in ran.out and f"of {UNITS} copies" in ran.out and "gaze_x: ±" in ran.out
    before, model = load_model(chain.model), load_model(out)
    assert model.others_ is not None and np.isfinite(model.others_.half_width).all()
    np.testing.assert_array_equal(before.coef_, model.coef_)
    card = json.loads((out / "model.json").read_text())
    assert card["training"]["other_units"]["copies"] == UNITS
    assert card["metrics"] == json.loads((chain.model / "model.json").read_text())["metrics"]
    # Its own set has its own intervals; the copies, whose origin nobody knows, those for copies.
    other = "for a copy of the camera that the model was not trained on"
    assert other not in run("evaluate", out, chain.dataset).out
    assert other in run("evaluate", out, copies).out
    assert json.loads(run("evaluate", out, copies, "--json").out)["coverage"]["unit"] == "other"
    assert other in run("evaluate", out, chain.dataset, "--unit", "other").out
    assert other not in run("evaluate", out, copies, "--unit", "own").out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_track_takes_the_intervals_that_are_asked_for(run, chain, copies: Path, tmp_path: Path) -> None:
    from tapetum.track import read_tracks

    assert run("calibrate", "units", chain.model, copies, "-o", tmp_path / "m").code == 0

    def width(*more: object) -> float:
        out = tmp_path / "t.csv"
        ran = run("track", chain.recording, "--model", tmp_path / "m", "-o", out, "--overwrite", *more)
        assert ran.code == 0, ran.err
        rows = read_tracks(out)
        wide = np.asarray(rows["gaze_x_high"], float) - np.asarray(rows["gaze_x_low"], float)
        known = wide[np.isfinite(wide)]
        return float(np.median(known)) if len(known) else float("inf")

    # The chain's ridge fits every frame, as in the paper: it has no intervals of its own.
    assert np.isfinite(width("--unit", "other"))
    assert not np.isfinite(width("--unit", "own")) and not np.isfinite(width())


def test_a_model_without_intervals_for_copies_says_so_where_the_camera_is_unknown(
    run, chain, copies: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, none = tmp_path / "m", "it has none for another copy of it"
    # The chain has too few frames to calibrate any.
    narrow = load_model(chain.model)
    narrow.intervals_ = Intervals(np.empty(0), np.full((1, 2), 0.1))
    save_model(narrow, model)
    ran = run("evaluate", model, copies)
    assert ran.code == 0 and none in ran.err and "tapetum calibrate units" in ran.err and none not in ran.out
    # Neither of its own films, nor where somebody says that it is its camera, nor of a model without intervals.
    for words in ((model, chain.dataset), (model, copies, "--unit", "own"), (chain.model, copies)):
        assert none not in run("evaluate", *words).err
    video = next(chain.recording.glob("probe*"))
    for source, said in ((chain.recording, False), (video, True)):
        ran = run("track", source, "--model", model, "-o", tmp_path / "t.csv", "--overwrite")
        assert ran.code == 0 and (none in ran.err) == said, ran.err
    told = json.loads(run("track", video, "--model", model, "-o", tmp_path / "t.csv", "--overwrite", "--json").out)
    assert len(told["unsure"]) == 1 and none in told["unsure"][0]

    with warnings.catch_warnings():
        # Starlette's client wants another version of httpx.
        warnings.simplefilter("ignore")
        from starlette.testclient import TestClient

    def begin_and_end(app: Any, bound: socket.socket, *_: object) -> None:
        bound.close()
        with TestClient(app):
            pass

    monkeypatch.setattr("tapetum.cli.serve._run", begin_and_end)
    for source, said in ((chain.recording, False), (video, True)):
        ran = run("serve", source, "--model", model, "--port", 0)
        assert ran.code == 0 and (none in ran.err) == said, ran.err


def test_copies_train_a_network_with_their_camera(run, chain, copies: Path, tmp_path: Path) -> None:
    tiny = ("--kind", "resnet18", "--crop", 32, "--size", 16, "--epochs", 1, "--device", "cpu")
    ran = run("train", chain.dataset, *tiny, "--copies", copies, "-o", tmp_path / "m")
    assert ran.code == 0, ran.err
    frames = open_dataset(copies).tp.train.sizes["frame"]
    card = json.loads((tmp_path / "m" / "model.json").read_text())
    assert card["training"]["copies"] == {"copies": UNITS, "frames": frames}
    assert load_model(tmp_path / "m").quantities == ("gaze_x", "gaze_y")
    for words, why in (
        ((*tiny, "--copies", chain.dataset), "copies: has no training frames whose copy of the camera is known"),
        (("--copies", copies), "--copies: has no meaning for zernike"),
        ((*tiny, "--copies", tmp_path / "none.zarr"), "none.zarr"),
    ):
        ran = run("train", chain.dataset, *words, "-o", tmp_path / "n")
        assert ran.code == 2 and why in ran.err and "Traceback" not in ran.err
        assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_what_calibrates_nothing(run, chain, copies: Path, tmp_path: Path) -> None:
    for words, why in (
        ((chain.model, chain.dataset), "does not distinguish copies of its camera"),
        ((chain.model, copies, "--units", 3), "--units: is of a scene"),
        ((chain.model, "hand-held", "--units", 3), "--units: 3 copies are too few"),
        ((chain.model, copies, "--split", "unit"), "are too few"),
        ((chain.model, "no-such-scene"), "no-such-scene"),
    ):
        ran = run("calibrate", "units", *words, "-o", tmp_path / "m")
        assert ran.code == 2 and why in ran.err, (words, ran.err)
        assert "Traceback" not in ran.err and not (tmp_path / "m").exists()
    ran = run("evaluate", chain.model, chain.dataset, "--unit", "other")
    assert ran.code == 2 and "has no intervals for another copy" in ran.complaint
    ran = run("evaluate", chain.model, chain.dataset, "--unit", "mine")
    assert ran.code == 2 and "--unit" in ran.complaint


def test_copies_of_a_scene_are_filmed_and_kept_until_the_model_is_saved(
    run, chain, copies: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[range, int]] = []

    def film(scene: object, seeds: range, frames: int, work: Path, **_: object) -> xr.Dataset:
        asked.append((seeds, frames))
        work.mkdir(exist_ok=True)
        (work / "copy").write_text("filmed")
        if len(asked) == 1:
            raise InputError("stopped")
        return open_dataset(copies)

    monkeypatch.setattr("tapetum.experiments.copies.film_copies", film)
    words = ("calibrate", "units", chain.model, "hand-held", "--units", 12, "--frames", 2, "--seed", 5)
    assert run(*words, "-o", tmp_path / "m").code == 2
    assert (tmp_path / "m.copies" / "copy").exists()
    assert run(*words, "-o", tmp_path / "m").code == 0
    assert asked == [(range(5, 17), 2)] * 2
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]
