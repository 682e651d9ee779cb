"""Whatever is changed about the structure of a saved file: it is refused in one line, or it makes no difference."""

from __future__ import annotations

import copy
import functools
import json
import math
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import ResNet18, ZernikeRidge, load_model, save_model, store
from tapetum.record.recording import RecordingWriter, StreamInfo, open_recording

pytestmark = pytest.mark.usefixtures("narrow")

WRONG: dict[str, list[Any]] = {
    "str": ["", 7, None, ["a"]],
    "int": [-1, "7", 1.5, True, None, math.nan, 10**300, [1]],
    "float": [-1.0, "x", True, None, math.nan, math.inf, 1e308, [0.5]],
    "bool": ["yes", 2, None],
    "NoneType": [7, "x", [], {}],
    "list": [{}, "x", 7, None, [], [[]]],
    "dict": [[], "x", 7, None, {}],
}


def mutated(content: Any) -> Iterator[tuple[str, Any]]:
    """Every key removed, and every value of another type, negative, not a number or huge."""

    def places(part: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
        keys = list(part) if isinstance(part, dict) else range(len(part)) if isinstance(part, list) else ()
        for key in keys:
            yield (*path, key)
            yield from places(part[key], (*path, key))

    for path in places(content, ()):
        for change in ("removed", *range(10)):
            whole = copy.deepcopy(content)
            inner = whole
            for step in path[:-1]:
                inner = inner[step]
            name = ".".join(map(str, path))
            if change == "removed":
                del inner[path[-1]]
                yield f"{name} removed", whole
                continue
            wrong = WRONG[type(inner[path[-1]]).__name__]
            if int(change) < len(wrong):
                inner[path[-1]] = wrong[int(change)]
                yield f"{name} = {wrong[int(change)]!r:.20}", whole


def survivors(file: Path, load: Callable[[], Any]) -> list[str]:
    """What loads, and then is not what it was; or is refused by anything but one line."""
    whole = file.read_text(encoding="utf-8")
    wanted, bad = load(), []
    for name, content in mutated(json.loads(whole)):
        file.write_text(json.dumps(content), encoding="utf-8")
        try:
            found = load()
        except InputError as error:
            if "\n" in str(error):
                bad.append(f"{name}: {error}")
        except Exception as error:
            bad.append(f"{name}: {type(error).__name__} {error}")
        else:
            if found != wanted:
                bad.append(f"{name}: loads")
    file.write_text(whole, encoding="utf-8")
    return bad


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    rng = np.random.default_rng(0)
    images = rng.integers(0, 255, (60, 24, 24), dtype=np.uint8)
    labels = {"gaze_x": rng.uniform(-0.5, 0.5, 60), "gaze_y": rng.uniform(-0.5, 0.5, 60)}
    dataset = dataset_from_arrays(images, {**labels, "device": ["a", "b"] * 30})
    save_model(ZernikeRidge(scales=(12, 24), order=3).fit(dataset), folder / "zernike", metrics={"frames": 3})
    network = ResNet18("phone", crop=24, size=16, epochs=1, device="cpu").fit(dataset)
    save_model(network, folder / "resnet18", notes={"seeds": [1, 2]})
    return folder


@pytest.mark.parametrize("kind", ["zernike", "resnet18"])
def test_a_models_card(fitted: Path, tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch):
    # The weights, of which a card holds the digest, stay as they are: they are read once.
    monkeypatch.setattr(store, "sha256_file", functools.cache(store.sha256_file))
    shutil.copytree(fitted / kind, tmp_path / "m")
    images = np.random.default_rng(1).integers(0, 255, (2, 24, 24), dtype=np.uint8)

    def load() -> Any:
        model = load_model(tmp_path / "m")
        said = model.predict(images, anyway=True)
        return said.columns().keys(), said.value.tolist(), said.upper.tolist(), said.classes, said.reason

    assert not survivors(tmp_path / "m" / "model.json", load)


def test_older_cards_stay_readable(fitted: Path, tmp_path: Path):
    shutil.copytree(fitted / "resnet18", tmp_path / "m")
    file = tmp_path / "m" / "model.json"
    card = json.loads(file.read_text())
    card["version"] = 1
    del card["training"]
    for name in ("hide", "background", "patience", "precision"):
        del card["parameters"][name]
    file.write_text(json.dumps(card))
    assert load_model(tmp_path / "m").parameters()["background"] == "root"


def test_a_recordings_card(tmp_path: Path):
    path = tmp_path / "a.rec"
    with RecordingWriter(path, streams={"probe": StreamInfo(8, 12)}, rate=15.0, start_utc_ns=10**18) as writer:
        for n in range(3):
            writer.write("probe", np.full((8, 12), n, np.uint8), monotonic_ns=n + 1, utc_ns=10**18 + n)

    def load() -> Any:
        opened = open_recording(path)
        frames = [frame.image.tolist() for frame in opened.source("probe")]
        return opened.uuid, opened.finished, opened.streams, frames

    assert not survivors(path / "recording.json", load)
