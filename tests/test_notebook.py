"""In a notebook: things show themselves, draw themselves, turn into arrays, and take what the command line takes."""

from __future__ import annotations

import importlib.metadata
import inspect
import pydoc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import tapetum as tp
from tapetum.data import build_dataset, dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import Prediction, ResNet18
from tapetum.record.recording import RecordingWriter, StreamInfo
from tapetum.simulate.information import FisherInformation

SMALL = ["probe.sensor.pixels=[32, 24]", "sampling.accuracy=0.1"]


@pytest.fixture(scope="module")
def image() -> tp.Image:
    return tp.retroreflect(tp.load_scene("hand-held", SMALL), rotation=[0, 0.5, 1])


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("rec") / "a.rec"
    with RecordingWriter(path, streams={"probe": StreamInfo(8, 12)}, rate=15.0, start_utc_ns=10**18) as writer:
        for n in range(3):
            writer.write("probe", np.full((8, 12), n, np.uint8), monotonic_ns=n + 1, utc_ns=10**18 + n)
    return tp.open_recording(path)


def prediction() -> Prediction:
    value = np.array([[0.1, 0.2], [0.3, np.nan]])
    value[1] = np.nan
    shares = np.array([[0.9, 0.1], [np.nan, np.nan]])
    return Prediction(("gaze_x", "gaze_y"), value, value, value, ("<a>", "b"), shares, None, ("", "unlike"), True)


def dataset() -> Any:
    images = np.random.default_rng(0).integers(0, 255, (30, 16, 16), dtype=np.uint8)
    return dataset_from_arrays(images, {"gaze_x": np.linspace(-0.4, 0.4, 30), "device": ["one", "two"] * 15})


def test_things_draw_and_show_themselves(image, recording):
    things = {"image": image, "scene": tp.load_scene("phones"), "recording": recording, "prediction": prediction()}
    for name, thing in things.items():
        assert isinstance(thing.plot(), Figure), name
        thing.plot().savefig("/dev/null", format="png")
        assert thing._repr_html_().startswith("<"), name
        assert len(repr(thing)) < 160 and "\n" not in repr(thing), name
    assert isinstance(dataset().tp.plot(), Figure)
    assert len(dataset().tp.plot(5).axes) == 5
    assert "_repr_html_" in dir(dataset())


def test_what_is_shown_is_escaped_and_says_what_was_refused():
    page = prediction()._repr_html_()
    assert "&lt;a&gt;" in page and "<a>" not in page
    assert "unlike" in page and "1 refused" in page


def test_what_holds_arrays_is_equal_to_itself_alone(image):
    one, other = prediction(), prediction()
    assert one == one and one != other
    assert image == image and image != tp.retroreflect(tp.load_scene("hand-held", SMALL), rotation=[0, 0.5, 1])
    one, other = (FisherInformation(("gaze_x", "gaze_y"), (0.1, 0.2), torch.eye(2)) for _ in range(2))
    assert one == one and one != other


def test_the_version_is_that_of_the_package():
    assert tp.__version__ == importlib.metadata.version("tapetum") and "__version__" in dir(tp)


def test_an_image_is_an_array(image):
    array = np.asarray(image)
    assert array.shape == (3, 24, 32) and array.dtype == np.float64
    np.testing.assert_array_equal(array, image.numpy())
    assert np.asarray(image, dtype=np.float32).dtype == np.float32
    labelled = image.to_xarray()
    assert labelled.dims == ("image", "y", "x") and labelled.attrs["units"] == "W/m^2"
    np.testing.assert_array_equal(labelled.values, array)
    np.testing.assert_allclose(labelled["rotation_x"], [0, 0.5, 1])
    np.testing.assert_allclose(np.diff(labelled["x"]), image.pitch)
    assert float(labelled["y"].mean()) == pytest.approx(0, abs=1e-12)


def test_names_are_those_meant_for_users():
    seen = [name for name in dir(tp) if not name.startswith("__")]
    assert seen == sorted(tp.__all__)
    told = pydoc.plain(pydoc.render_doc(tp.track))
    assert "Find the retro-reflections in frames, follow them" in told
    assert told.index("Find the retro-reflections") < told.index("PACKAGE CONTENTS")
    assert "model" in inspect.signature(tp.track).parameters


def test_arguments_may_be_what_the_command_line_takes(tmp_path: Path, image):
    scene = tp.load_scene("hand-held", SMALL)
    from tapetum.bench import scene_yaml

    path = tmp_path / "small.yaml"
    path.write_text(scene_yaml(scene))
    for given in (path, str(path)):
        np.testing.assert_array_equal(np.asarray(tp.retroreflect(given, [0, 0.5, 1])), np.asarray(image))
        assert tp.link_budget(given) == tp.link_budget(scene)
    np.testing.assert_array_equal(tp.expose(image, scene, seed=1), tp.expose(image, scene.probe, seed=1))
    np.testing.assert_array_equal(tp.expose(image, path, seed=1), tp.expose(image, scene.probe, seed=1))
    tp.film(path, tmp_path / "a.rec", tp.Session(seconds=0.1))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: tp.load_scene(None), "scene: must be a name or a path, is None"),  # type: ignore[arg-type]
        (lambda: tp.retroreflect(3), "scene: must be a name or a path, is 3"),  # type: ignore[arg-type]
        (lambda: tp.retroreflect("thin-lenz"), "thin-lenz: no such scene"),
        (lambda: tp.film("thin-lenz", "x.rec"), "thin-lenz: no such scene"),
        (lambda: tp.retroreflect("thin-lens", device="tpu"), "device: no device is called 'tpu'"),
        (lambda: tp.retroreflect("thin-lens", device="cuda:99"), "device: cannot compute on 'cuda:99'"),
        (lambda: ResNet18(device="tpu"), "device: no device is called 'tpu'"),
        (lambda: build_dataset(["a.rec"], "a.zarr", side=100000), "side: is larger than the 4000 pixels"),
        (lambda: tp.label_recording("a.rec"), "a.rec: does not exist"),
        (lambda: tp.label_recording(3), "recording: is of type int; give its folder NAME.rec"),  # type: ignore[arg-type]
        (lambda: list(tp.track([np.zeros((9, 9), np.uint8)])), "source[0]: is of type ndarray; give Frames"),
        (lambda: tp.detect(np.broadcast_to(np.uint8(0), (20000, 20000))), "20000 x 20000 pixels are more than"),
    ],
)
def test_wrong_arguments_get_one_line(wrong, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as caught:
        wrong()
    assert words in str(caught.value) and "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())
