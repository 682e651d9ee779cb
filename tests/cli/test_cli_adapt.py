"""`tapetum adapt`: from a trained network and a film of one camera to a model, and one clear line for each mistake."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

from tapetum.data import open_dataset
from tapetum.models import load_model

pytestmark = pytest.mark.usefixtures("narrow")

TINY = ("--kind", "resnet18", "--crop", 32, "--size", 16, "--epochs", 2, "--device", "cpu", "--no-intervals")


@pytest.fixture(scope="module")
def network(chain, tmp_path_factory) -> Path:
    """A tiny network, trained once."""
    from tapetum.cli.app import main

    out = tmp_path_factory.mktemp("adapt") / "net"
    assert main([str(one) for one in ("train", chain.dataset, "-o", out, *TINY)]) == 0
    return out


def few(*more: object) -> tuple[object, ...]:
    return ("--epochs", 1, "--device", "cpu", *more)


@pytest.mark.parametrize("of", ["dataset", "recording"])
def test_a_film_adapts_a_network(run, chain, network: Path, tmp_path: Path, of: str) -> None:
    ran = run("adapt", network, getattr(chain, of), "-o", tmp_path / "m", *few())
    assert ran.code == 0, ran.err
    assert f"saved {tmp_path / 'm'}" in ran.out and "adapted from" in ran.out and "MAE" in ran.out
    card = json.loads((tmp_path / "m" / "model.json").read_text())
    told = card["training"]
    assert told["adapted_from"]["model"] == str(network) and told["adapted_from"]["frames"] == told["frames"]
    assert "layer" in told["chosen"]["fitted"] and card["metrics"]["frames"] == 4
    model = load_model(tmp_path / "m")
    assert np.isfinite(model.predict(open_dataset(chain.dataset), anyway=True)["gaze_x"]).all()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_a_network_that_learns_nothing_of_the_camera_is_said_to_be_of_no_use(
    run, chain, network: Path, tmp_path: Path
) -> None:
    # Labels of other frames: nothing of them shows in the pictures.
    film = tmp_path / "film.zarr"
    shutil.copytree(chain.dataset, film)
    rng, written = np.random.default_rng(0), zarr.open_group(film, mode="r+")
    for name in ("gaze_x", "gaze_y"):
        labels = written[name]
        assert isinstance(labels, zarr.Array)
        labels[:] = rng.permutation(np.asarray(labels[:]))
    ran = run("adapt", network, film, "-o", tmp_path / "m", *few())
    assert ran.code == 0, ran.err
    assert "without the network: " in ran.out and "little better than the labels' mean" in " ".join(ran.err.split())


def test_ctrl_c_says_what_is_kept_and_how_to_go_on(run, chain, network: Path, tmp_path: Path, monkeypatch) -> None:
    from tapetum.models import fine_tuning

    begun, train = list[object](), fine_tuning.train

    def interrupted(*given, **named):
        begun.append(given)
        if len(begun) == 3:
            raise KeyboardInterrupt
        return train(*given, **named)

    with monkeypatch.context() as patched:
        patched.setattr(fine_tuning, "train", interrupted)
        ran = run("adapt", network, chain.dataset, "-o", tmp_path / "m", *few())
    told = " ".join(ran.err.split())
    assert ran.code == 130 and f"kept in {tmp_path / 'm'}.checkpoint" in told and "--resume" in told
    again = run("adapt", network, chain.dataset, "-o", tmp_path / "m", *few())
    assert again.code == 2 and "an unfinished adaptation is kept here" in again.complaint
    assert run("adapt", network, chain.dataset, "-o", tmp_path / "m", *few("--resume")).code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["m"]


def test_each_mistake_is_one_line(run, chain, network: Path, tmp_path: Path) -> None:
    from tests.cli.conftest import filmed

    unlabelled = filmed(tmp_path / "plain.rec", labels=False)
    onnx = tmp_path / "net.onnx"
    assert run("export", network, "-o", onnx).code == 0
    for arguments, said in (
        ((network, unlabelled), "has no labels"),
        ((chain.model, chain.dataset), "is no network that can be trained further (zernike)"),
        ((onnx, chain.dataset), "is no network that can be trained further"),
        (("nobody", chain.dataset), "bundled model"),
        ((network, tmp_path / "nothing.zarr"), "does not exist"),
        ((network, chain.dataset, "--seconds", 100), "asks for 100 s of film"),
        ((network, chain.dataset, "--seconds", 0), "must be positive"),
        ((network, chain.dataset, "--label", "focus"), "estimates gaze_x, gaze_y, not object_distance, focal_length"),
        ((network, chain.dataset, "--unit", "mine"), "does not distinguish copies of its camera"),
        ((network, chain.dataset, "--precision", "half"), "--precision"),
    ):
        ran = run("adapt", *arguments, "-o", tmp_path / "m", *few())
        assert ran.code == 2 and "Traceback" not in ran.err, (arguments, ran.err)
        assert said in " ".join(ran.err.split()), (said, ran.err)
        assert not (tmp_path / "m").exists()


def test_a_set_without_the_labels_of_the_model_is_refused(run, chain, network: Path, tmp_path: Path) -> None:
    import shutil

    shutil.copytree(chain.dataset, tmp_path / "other.zarr")
    group = zarr.open_group(str(tmp_path / "other.zarr"), mode="r+", zarr_format=3)
    group.attrs["targets"] = ["gaze_y"]
    del group["gaze_x"]
    ran = run("adapt", network, tmp_path / "other.zarr", "-o", tmp_path / "m", *few())
    assert ran.code == 2 and "has no label gaze_x, which the model estimates" in ran.complaint
