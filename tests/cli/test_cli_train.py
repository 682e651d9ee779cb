"""`tapetum train` never loses what it has computed: a finished training is saved before anything is asked of it."""

from __future__ import annotations

import json
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
import zarr

from tapetum.data import open_dataset
from tapetum.durable import sole_writer
from tapetum.models import load_model

pytestmark = pytest.mark.usefixtures("narrow")

TINY = ("--crop", 32, "--size", 16, "--epochs", 2, "--device", "cpu")


def without_test_labels(dataset: Path, out: Path) -> Path:
    """Copy a set; take the labels of its test frames away."""
    shutil.copytree(dataset, out)
    group = zarr.open_group(str(out), mode="r+", zarr_format=3)
    labels = np.asarray(group["gaze_x"][:])  # type: ignore[index]
    labels[np.asarray(group["split"][:]) == 1] = np.nan  # type: ignore[index]
    group["gaze_x"][:] = labels  # type: ignore[index]
    return out


@pytest.mark.parametrize("options", [(), ("--model", "resnet18", *TINY)])
def test_an_evaluation_that_fails_leaves_the_model(run, chain, tmp_path: Path, options) -> None:
    data, out = without_test_labels(chain.dataset, tmp_path / "nan.zarr"), tmp_path / "m"
    ran = run("train", data, "-o", out, *options)
    assert ran.code == 2 and "Traceback" not in ran.err
    complaint = ran.err.splitlines()[-1]
    assert "labels gaze_x are no numbers" in complaint
    assert f"tapetum evaluate {out} {data}" in complaint and f"saved {out}" in ran.out
    model = load_model(out)
    assert np.isfinite(model.predict(open_dataset(data).tp.train)["gaze_x"]).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m", "nan.zarr"]


def test_an_error_of_the_program_in_the_evaluation_leaves_the_model(run, chain, tmp_path: Path, monkeypatch) -> None:
    def broken(*given: object, **named: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("tapetum.report.evaluation.evaluate_model", broken)
    with pytest.raises(ZeroDivisionError):
        run("train", chain.dataset, "-o", tmp_path / "m")
    assert load_model(tmp_path / "m").target_names == ("gaze_x", "gaze_y")


def test_of_two_trainings_of_one_model_one_is_refused(run, chain, tmp_path: Path) -> None:
    """Both would write the checkpoint and the model: the second is stopped before it trains."""
    held, over = threading.Event(), threading.Event()

    def other() -> None:
        with sole_writer(tmp_path / "m"):
            held.set()
            over.wait(60)

    thread = threading.Thread(target=other)
    thread.start()
    try:
        assert held.wait(60)
        ran = run("train", chain.dataset, "-o", tmp_path / "m", "--model", "resnet18", *TINY)
    finally:
        over.set()
        thread.join()
    assert ran.code == 2 and "m: is being written by process" in ran.err and not list(tmp_path.iterdir())
    assert run("train", chain.dataset, "-o", tmp_path / "deep" / "m").code == 0


def test_ctrl_c_in_the_evaluation_leaves_the_model(run, chain, tmp_path: Path, monkeypatch) -> None:
    def interrupted(*given: object, **named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tapetum.report.evaluation.evaluate_model", interrupted)
    ran = run("train", chain.dataset, "-o", tmp_path / "m")
    assert ran.code == 130 and f"saved {tmp_path / 'm'}" in ran.out and (tmp_path / "m" / "model.json").exists()


def test_ctrl_c_in_the_training_says_how_to_go_on(run, chain, tmp_path: Path, monkeypatch) -> None:
    from tapetum.cli import train as command

    def interrupted(report) -> None:
        del report
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(command, "say_epoch", interrupted)
        ran = run("train", chain.dataset, "-o", tmp_path / "m", "--model", "resnet18", *TINY)
    assert ran.code == 130
    told = " ".join(ran.err.split())
    assert "1 of 2 epochs" in told and str(tmp_path / "m.checkpoint") in told and "--resume" in told
    ran = run("train", chain.dataset, "-o", tmp_path / "m", "--model", "resnet18", *TINY, "--resume")
    assert ran.code == 0 and "epoch 2 of 2" in ran.out and "epoch 1 of 2" not in ran.out
    card = json.loads((tmp_path / "m" / "model.json").read_text())
    assert card["metrics"]["frames"] == 4


def test_ctrl_c_before_the_first_epoch_promises_nothing(run, chain, tmp_path: Path, monkeypatch) -> None:
    def interrupted(*given: object, **named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tapetum.models.training._Training._steps", interrupted)
    ran = run("train", chain.dataset, "-o", tmp_path / "m", "--model", "resnet18", *TINY)
    assert ran.code == 130 and "--resume" not in ran.err and not list(tmp_path.iterdir())


def small_set(tmp_path: Path, side: int) -> Path:
    """Write pictures of an importable kind, of this side, and import them."""
    rng = np.random.default_rng(0)
    np.save(tmp_path / "images.npy", rng.integers(0, 255, (30, side, side), dtype=np.uint8))
    np.save(tmp_path / "gaze_x.npy", rng.uniform(-0.5, 0.5, 30))
    text = f"""
schema: tapetum/import/1
side: {side}
centred: true
stacks:
  - images: {{file: images.npy}}
    labels:
      gaze_x: {{file: gaze_x.npy}}
"""
    (tmp_path / "map.yaml").write_text(text)
    return tmp_path / "small.zarr"


def test_crops_smaller_than_the_papers_are_trained_on_and_it_is_said(run, tmp_path: Path) -> None:
    data = small_set(tmp_path, 200)
    assert run("dataset", "import", tmp_path, "-o", data, "--mapping", tmp_path / "map.yaml").code == 0
    ran = run("train", data, "-o", tmp_path / "ridge", "--target", "gaze_x")
    assert ran.code == 0 and "200 pixels: scales 50, 100, 150, 200 in place of the paper's" in ran.out
    assert load_model(tmp_path / "ridge").parameters()["scales"] == [50, 100, 150, 200]
    ran = run("train", data, "-o", tmp_path / "chosen", "--target", "gaze_x", "--scales", "60,200")
    assert ran.code == 0 and "in place of" not in ran.out
    assert load_model(tmp_path / "chosen").parameters()["scales"] == [60, 200]
    network = ("--model", "resnet18", "--size", 32, "--epochs", 1, "--device", "cpu")
    ran = run("train", data, "-o", tmp_path / "net", "--target", "gaze_x", *network)
    assert ran.code == 0 and "looks at 200, reduced to 32, in place of 288" in ran.out
    assert load_model(tmp_path / "net").parameters()["crop"] == 200
    for wrong in ("0", "a,b", "100,", "-5"):
        ran = run("train", data, "-o", tmp_path / "no", "--target", "gaze_x", "--scales", wrong)
        assert ran.code == 2 and "--scales: must be sides in pixels" in ran.complaint
    ran = run("train", data, "-o", tmp_path / "no", "--scales", "60", *network)
    assert ran.code == 2 and "--scales: has no meaning for resnet18" in ran.complaint
