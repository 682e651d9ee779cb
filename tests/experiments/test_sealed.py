"""The sealed test: drawn from a salt, filmed, scored and deleted; only numbers stay."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tapetum.bench import load_scene, with_values
from tapetum.cli.app import main
from tapetum.data import open_dataset
from tapetum.data.synth import Plan, make_plan, synthesise
from tapetum.data.write import Rules
from tapetum.errors import InputError
from tapetum.experiments import Workshop, sealed
from tapetum.experiments.recordings import development_plan, varied_plan
from tapetum.experiments.sealed import read_results, run_sealed, score_sealed, sealed_plan
from tapetum.models import ZernikeRidge, load_model, save_model

SALT = "a test's own salt"


def tiny_plan() -> Plan:
    """Two recordings of one and a half seconds by a little thin-lens camera, from another salt than the real ones."""
    values = {
        "probe.sensor.pixels": [96, 80],
        "probe.sensor.pitch": "4.4 um",
        "probe.sensor.exposure": "800 us",
        "target.lens.aperture_radius": "2 mm",
        "target.sensor.pixels": [162, 122],
        "target.sensor.pitch": "17.6 um",
        "sampling.accuracy": 0.1,
    }
    plan = sealed_plan("small", SALT, with_values(load_scene("hand-held"), values))
    # A hand so quiet that the little frame holds what it shows, before a wall that is no brighter than the set's.
    short = [
        replace(one, session=replace(one.session, seconds=1.5, stray=(), motion=replace(one.session.motion, sway=3e-3)))
        for one in plan.videos
    ]
    return replace(plan, videos=tuple(short), rules=Rules(side=40, test_fraction=1.0))


@pytest.fixture(scope="module")
def filmed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recordings of `tiny_plan` as a set."""
    return synthesise(tiny_plan(), tmp_path_factory.mktemp("sealed") / "set.zarr")


@pytest.fixture(scope="module")
def ridge(tmp_path_factory: pytest.TempPathFactory) -> ZernikeRidge:
    """A ridge that learned from one recording of that camera."""
    folder = tmp_path_factory.mktemp("train")
    plan = tiny_plan()
    own = replace(plan, seed=7, videos=plan.videos[:1], rules=Rules(side=40, test_fraction=0.0))
    dataset = open_dataset(synthesise(own, folder / "set.zarr"))
    # So few frames leave the paper's penalty with weights so large that rounding shows.
    return ZernikeRidge("gaze", scales=(40,), order=4, alpha=1.0, standardise=True, calibration_fraction=0.1).fit(
        dataset
    )


def test_recordings_are_drawn_from_the_salt_within_what_makers_allow() -> None:
    first, again, other = (sealed_plan("small", salt) for salt in (SALT, SALT, "another"))
    assert first.digest == again.digest != other.digest
    plan = sealed_plan("paper", SALT)
    assert len(plan.videos) == 12
    scenes = [video.scene for video in plan.videos]
    tilt = np.degrees([np.hypot(*one.target.sensor.tilt) for one in scenes])
    decentre = np.array([np.hypot(*one.target.sensor.decentre) for one in scenes])
    assert tilt.max() <= 0.63 and np.ptp(tilt) > 0.2
    assert decentre.max() <= 0.25e-3 and np.ptp(decentre) > 0.05e-3
    far = np.array([one.distance for one in scenes])
    assert 3 <= far.min() < far.max() <= 8 and len(set(far)) == 12
    assert len({one.target.object_distance for one in scenes}) == 12
    assert len({one.illumination.second_beam.ratio for one in scenes}) == 12
    assert all(1.45 <= one.target.lens.f_number <= 1.67 for one in scenes)
    seeds = {video.session.seed for video in plan.videos}
    known = [make_plan("rotation", "paper", 1), development_plan("paper"), varied_plan("paper")]
    assert len(seeds) == 12 and seeds.isdisjoint(video.session.seed for one in known for video in one.videos)
    # The salt of the real ones stands in no test.
    assert not any(sealed.SALT in file.read_text() for file in Path(__file__).parents[1].rglob("*.py"))


def test_only_numbers_stay(ridge: ZernikeRidge, filmed: Path, tmp_path: Path) -> None:
    plan = tiny_plan()
    rows = score_sealed({"ridge": ridge}, tmp_path, size="small", plan=plan)
    assert list(tmp_path.iterdir()) == []
    dataset = open_dataset(filmed)
    truth, said = dataset.tp.values(("gaze_x", "gaze_y")), ridge.predict(dataset, anyway=True).value
    row = rows[0]
    assert row["frames"] == len(truth)
    assert row["mae"] == pytest.approx(np.abs(said - truth).mean(axis=0).tolist())
    assert row["radial"] == pytest.approx(np.hypot(*(said - truth).T).mean())
    # The guess is the mean of what the model learned from.
    mean = [ridge.training_["mean"][name] for name in ("gaze_x", "gaze_y")]  # type: ignore[index]
    assert row["guess"]["mae"] == pytest.approx(np.abs(np.array(mean) - truth).mean(axis=0).tolist())
    worse = row["radial"] > row["guess"]["radial"] or row["radial_rms"] > row["guess"]["radial_rms"]
    assert row["verdict"].startswith("worse") == worse
    assert row["recording_mae"]["least"] <= row["recording_mae"]["median"] <= row["recording_mae"]["most"]
    json.dumps(rows, allow_nan=False)


def test_results_are_added_never_replaced(
    ridge: ZernikeRidge,
    filmed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sealed, "sealed_plan", lambda *_: tiny_plan())
    out, kept = tmp_path / "out", save_model(ridge, tmp_path / "ridge")
    # As an interrupted call leaves them: this one takes them up, while the command films its own below.
    shutil.copytree(filmed, tmp_path / "work" / f"sealed-{tiny_plan().digest[:12]}.zarr")
    run_sealed(out, Workshop(tmp_path / "work", "small"), {"first": ridge})
    assert not list((tmp_path / "work").iterdir())
    assert main(["paper", "sealed", "-o", str(out), "--model", str(kept), "--size", "small", "--workers", "1"]) == 0
    rows = read_results(out)
    assert [row["model"] for row in rows] == ["first", kept.name]
    assert rows[0]["mae"] == pytest.approx(rows[1]["mae"]) and rows[0]["date"] <= rows[1]["date"]
    page = (out / "sealed.md").read_text()
    assert (
        page.count("| first |") == 1
        and f"| {kept.name} |" in page
        and str(tmp_path) not in page
        and rows[0]["verdict"] in page
    )
    assert {path.name for path in out.iterdir()} <= {"sealed.jsonl", "sealed.md", "work"}
    assert not list(out.glob("work/*"))
    capsys.readouterr()
    assert main(["paper", "fig4", "-o", str(out), "--model", str(kept)]) == 2
    assert "sealed alone" in capsys.readouterr().err
    (out / "sealed.jsonl").open("a").write('{"half')
    with pytest.raises(InputError, match="damaged"):
        read_results(out)


def test_a_model_of_something_else_is_refused(tmp_path: Path, ridge: ZernikeRidge) -> None:
    other = load_model(save_model(ridge, tmp_path / "m"))
    other.quantities = ("focal_length",)
    with pytest.raises(InputError, match="does not show the gaze"):
        score_sealed({"m": other}, tmp_path / "w", plan=tiny_plan())
    assert not (tmp_path / "w").exists()
