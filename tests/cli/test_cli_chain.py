"""The commands one after the other: record, dataset, train, evaluate, track."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tapetum.record.recording import open_recording
from tapetum.track import read_tracks

pytestmark = pytest.mark.usefixtures("narrow")

LITTLE = (
    *("--set", "probe.sensor.pixels=[160, 120]", "--set", "target.sensor.pixels=[162, 122]"),
    *("--set", "target.sensor.pitch=35.2um"),
)


def test_record_films_and_labels(run, tmp_path: Path) -> None:
    out = tmp_path / "a.rec"
    ran = run("record", "hand-held", "-o", out, "--seconds", 1, "--seed", 3, *LITTLE)
    assert ran.code == 0
    assert "15 probe frames, seed 3" in ran.out and "labelled" in ran.out
    recording = open_recording(out)
    labels = recording.labels()
    assert recording.finished and recording.meta["seed"] == 3 and labels is not None
    assert labels.num_rows == len(recording.frames("probe"))
    again = run("record", "hand-held", "-o", out, "--seconds", 1, *LITTLE)
    assert again.code == 2 and "exists already" in again.complaint
    assert open_recording(out).uuid == recording.uuid


def test_dataset_build_and_info(run, chain) -> None:
    told = json.loads(run("dataset", "info", chain.dataset, "--json").out)
    assert (told["frames"], told["train"], told["test"], told["side"]) == (20, 16, 4, 400)
    assert told["labels"]["gaze_x"]["most"] == pytest.approx(0.19)
    shown = run("dataset", "info", chain.dataset).out
    assert "20 crops of 400 px: 16 to train on, 4 to test" in shown and "spot.rec: 20 of 20 frames" in shown


def test_train_leaves_a_card_with_its_metrics(run, chain) -> None:
    card = json.loads((chain.model / "model.json").read_text())
    assert card["metrics"]["targets"]["gaze_x"]["mae"] >= 0
    told = json.loads(run("evaluate", chain.model, chain.dataset, "--json").out)
    assert told == card["metrics"]


def test_evaluate_writes_the_numbers(run, chain, tmp_path: Path) -> None:
    ran = run("evaluate", chain.model, chain.dataset, "-o", tmp_path / "e.json")
    assert ran.code == 0 and "4 test frames" in ran.out and "predicting the mean" in ran.out
    assert json.loads((tmp_path / "e.json").read_text())["frames"] == 4
    ran = run("evaluate", chain.model, chain.dataset, "-o", tmp_path / "e.html")
    assert ran.code == 2 and "NAME.json" in ran.complaint


def test_a_dataset_without_test_frames_still_trains(run, chain, tmp_path: Path) -> None:
    whole = tmp_path / "whole.zarr"
    assert run("dataset", "build", chain.recording, "-o", whole, "--test-fraction", 0).code == 0
    ran = run("train", whole, "-o", tmp_path / "m")
    assert ran.code == 0 and "not evaluated" in ran.out and (tmp_path / "m" / "model.json").exists()
    ran = run("evaluate", tmp_path / "m", whole)
    assert ran.code == 2 and "no test frames" in ran.complaint


def test_track_with_a_model(run, chain, tmp_path: Path) -> None:
    out, kept = tmp_path / "t.parquet", tmp_path / "d.parquet"
    ran = run("track", chain.recording, "--model", chain.model, "-o", out, "--detections", kept, "--json")
    assert ran.code == 0 and kept.exists()
    told, table = json.loads(ran.out), read_tracks(out)
    assert told["frames"] == 20 and told["rows"] == table.num_rows
    seen = table.filter(table["seen"])
    x = seen["x"].to_numpy()
    assert np.allclose(x, 30 + 1.3 * seen["frame"].to_numpy(), atol=1)
    assert seen["gaze_x"].null_count == 0
    assert "1 track in 20 frames, 20 sightings" in run("track", chain.recording, "-o", tmp_path / "t.csv").out


def test_resnet_trains_and_drops_its_checkpoint(run, chain, tmp_path: Path) -> None:
    out = tmp_path / "net"
    ran = run("train", chain.dataset, "-o", out, "--model", "resnet18", "--epochs", 1, "--size", 48)
    assert ran.code == 0 and "epoch 1 of 1: loss" in ran.out
    assert [path.name for path in tmp_path.iterdir()] == ["net"]


def test_options_reach_the_model(run, chain, tmp_path: Path) -> None:
    tuned, net = tmp_path / "tuned", tmp_path / "net"
    assert run("train", chain.dataset, "-o", tuned, "--tuned").code == 0
    card = json.loads((tuned / "model.json").read_text())
    assert card["parameters"]["alpha"] == "cv" and card["parameters"]["standardise"]
    asked = ("--crop", 64, "--size", 32, "--epochs", 2, "--patience", 1, "--gain", 0.5, "--seed", 3, "--device", "cpu")
    ran = run("train", chain.dataset, "-o", net, "--model", "resnet18", *asked)
    assert ran.code == 0 and "images/s" in ran.out
    told = json.loads((net / "model.json").read_text())["parameters"]
    wanted = {"crop": 64, "size": 32, "epochs": 2, "patience": 1, "gain": 0.5, "seed": 3}
    assert {name: told[name] for name in wanted} == wanted


def test_an_unfinished_training_is_not_thrown_away(run, chain, tmp_path: Path) -> None:
    checkpoint = tmp_path / "net.checkpoint"
    checkpoint.mkdir()
    ran = run("train", chain.dataset, "-o", tmp_path / "net", "--model", "resnet18")
    assert ran.code == 2 and "--resume" in ran.complaint and checkpoint.exists()


@pytest.mark.parametrize(
    ("command", "made"),
    [(("dataset", "build", "{recording}", "-o"), "dataset"), (("train", "{dataset}", "-o"), "model")],
)
def test_overwrite_replaces_only_its_own_kind(run, chain, tmp_path: Path, command, made: str) -> None:
    arguments = [part.format(recording=chain.recording, dataset=chain.dataset) for part in command]
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "dear").write_text("letter")
    assert "pass --overwrite" in run(*arguments, mine).complaint
    ran = run(*arguments, mine, "--overwrite")
    assert ran.code == 2 and "may be replaced" in ran.complaint and (mine / "dear").exists()
    own = tmp_path / "own"
    assert run(*arguments, own).code == 0
    before = {path: path.stat().st_ino for path in own.iterdir()}
    assert run(*arguments, own, "--overwrite").code == 0
    assert {path: path.stat().st_ino for path in own.iterdir()} != before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "own"]


def test_the_papers_ridge_fits_every_training_frame(run, chain, tmp_path: Path) -> None:
    from tapetum.data import open_dataset
    from tapetum.models import ZernikeRidge, load_model

    data = open_dataset(chain.dataset)
    whole = ZernikeRidge("gaze", calibration_fraction=0.0).fit(data)
    kept = load_model(chain.model)
    np.testing.assert_allclose(kept.coef_, whole.coef_)
    told = json.loads((chain.model / "model.json").read_text())["training"]
    assert (told["frames"], told["fitted"], told["calibrated_on"]) == (16, 16, 0)
    assert "as in the paper" in told["intervals"] and "our reading" in told["centring"]
    assert "no intervals" in run("evaluate", chain.model, chain.dataset).out
    # Intervals are a choice of their own.
    assert run("train", chain.dataset, "-o", tmp_path / "sure", "--intervals").code == 0
    card = json.loads((tmp_path / "sure" / "model.json").read_text())
    assert card["parameters"]["calibration_fraction"] == 0.1
    assert card["training"]["fitted"] + card["training"]["calibrated_on"] <= 16 > card["training"]["fitted"]
    assert "zernike fits all training frames" in " ".join(run("train", "--help").out.split())


def test_ctrl_c_while_filming_says_what_is_kept(run, tmp_path: Path, monkeypatch) -> None:
    from tapetum.record.writer import RecordingWriter

    write = RecordingWriter.write

    def until(self: RecordingWriter, *arguments, **more) -> None:
        if sum(self.counts.values()) == 12:
            raise KeyboardInterrupt
        write(self, *arguments, **more)

    monkeypatch.setattr(RecordingWriter, "write", until)
    out = tmp_path / "a.rec"
    ran = run("record", "hand-held", "-o", out, "--seconds", 2, *LITTLE)
    assert ran.code == 130
    told = " ".join(ran.err.split())
    assert "probe frames and" in told and f"are kept in {out}, marked as unfinished" in told
    assert not open_recording(out).finished and len(open_recording(out).frames("probe")) > 3


def test_ctrl_c_while_labelling_says_what_is_kept(run, tmp_path: Path, monkeypatch) -> None:
    def interrupted(*_) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tapetum.record.label_recording", interrupted)
    out = tmp_path / "a.rec"
    ran = run("record", "hand-held", "-o", out, "--seconds", 0.4, *LITTLE)
    assert ran.code == 130 and f"the recording is kept in {out}, without labels" in " ".join(ran.err.split())
    assert open_recording(out).finished
