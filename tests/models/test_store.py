"""Models on disk: whole, checked, never unpickled."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tapetum.bench import load_scene
from tapetum.errors import InputError
from tapetum.models import ResNet18, SimulationFit, ZernikeRidge, load_model, model_card, pretrained, save_model
from tapetum.models import store as store_module
from tapetum.models.store import CARD, WEIGHTS


@pytest.fixture(scope="module")
def ridge(small) -> ZernikeRidge:
    return ZernikeRidge(scales=(20, 40), order=3, calibration_fraction=0.1).fit(small)


@pytest.fixture(scope="module")
def resnet(small) -> ResNet18:
    return ResNet18(crop=36, size=24, epochs=1, batch=20, device="cpu").fit(small)


@pytest.fixture
def saved(ridge, tmp_path: Path) -> Path:
    return save_model(ridge, tmp_path / "model")


def test_a_ridge_comes_back_exactly(ridge, small, tmp_path: Path):
    for half in (False, True):  # linear models stay in float64 either way
        loaded = load_model(save_model(ridge, tmp_path / f"{half}", half=half))
        np.testing.assert_array_equal(loaded.predict(small).value, ridge.predict(small).value)
        np.testing.assert_array_equal(loaded.predict(small).upper, ridge.predict(small).upper)
        assert loaded.data_hash_ == small.tp.train.tp.hash


def test_a_resnet_comes_back(resnet, small, tmp_path: Path):
    small = small.isel(frame=slice(200, 240))
    full = save_model(resnet, tmp_path / "full")
    np.testing.assert_allclose(load_model(full).predict(small).value, resnet.predict(small).value, atol=1e-6)
    half = save_model(resnet, tmp_path / "half", half=True)
    loaded = load_model(half)
    assert isinstance(loaded, ResNet18)
    assert {str(p.dtype) for p in loaded.network_.parameters()} == {"torch.float32"}
    np.testing.assert_allclose(loaded.predict(small).value, resnet.predict(small).value, atol=5e-3)
    assert (half / WEIGHTS).stat().st_size < 25e6 < (full / WEIGHTS).stat().st_size


def test_the_card_says_what_it_is(ridge, small, tmp_path: Path):
    path = save_model(ridge, tmp_path / "m", metrics={"mae": np.float64(0.1).item()}, notes={"seeds": [1, 2]})
    card = model_card(path)
    assert card["format"] == "tapetum-model"
    assert (card["kind"], card["targets"]) == ("zernike", ["gaze_x", "gaze_y"])
    assert card["units"]["gaze_x"] == "fraction of the field of view"
    assert card["training_data"] == small.tp.train.tp.hash
    assert card["metrics"] == {"mae": 0.1}
    assert card["notes"] == {"seeds": [1, 2]}
    assert {"torch", "numpy", "tapetum"} <= set(card["versions"])
    assert sorted(p.name for p in path.iterdir()) == [CARD, WEIGHTS]


def test_figures_that_json_cannot_hold_are_refused(ridge, tmp_path: Path):
    for value in (float("nan"), np.zeros(2)):
        with pytest.raises(InputError, match="metrics"):
            save_model(ridge, tmp_path / "m", metrics={"mae": value})
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_unasked(ridge, saved: Path):
    with pytest.raises(InputError, match="exists already"):
        save_model(ridge, saved)
    save_model(ridge, saved, overwrite=True)


def test_a_folder_of_something_else_is_never_replaced(ridge, tmp_path: Path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="no tapetum-model that may be replaced"):
        save_model(ridge, tmp_path, overwrite=True)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("name", [CARD, WEIGHTS])
def test_a_missing_file_is_told(saved: Path, name: str):
    (saved / name).unlink()
    with pytest.raises(InputError, match=f"lacks {name}"):
        load_model(saved)


def test_a_missing_folder_is_told(tmp_path: Path):
    with pytest.raises(InputError, match="no such model"):
        load_model(tmp_path / "none")


def test_altered_weights_are_told(saved: Path):
    data = bytearray((saved / WEIGHTS).read_bytes())
    data[-1] ^= 1
    (saved / WEIGHTS).write_bytes(data)
    with pytest.raises(InputError, match="altered"):
        load_model(saved)


def change(saved: Path, **fields) -> None:
    card = json.loads((saved / CARD).read_text())
    if isinstance(fields.get("parameters"), dict) and "kind" not in fields:
        fields["parameters"] = {**card["parameters"], **fields["parameters"]}
    (saved / CARD).write_text(json.dumps({**card, **fields}))


@pytest.mark.parametrize(
    ("fields", "word"),
    [
        ({"format": "pickle"}, "not the card"),
        ({"version": 3}, "update Tapetum"),
        ({"kind": "oracle"}, "unknown kind"),
        ({"parameters": None}, "parameters: must be a valid dictionary"),
        ({"parameters": {"scales": [20, 40], "order": 4}}, "expected coef"),
        ({"parameters": {"colour": 3}}, "parameters.colour: unknown key"),
        ({"parameters": {"scales": "wide"}}, "scales: must be a valid list, is 'wide'"),
    ],
)
def test_an_altered_card_is_told(saved: Path, fields, word: str):
    change(saved, **fields)
    with pytest.raises(InputError, match=word):
        load_model(saved)


def test_a_broken_card_is_told(saved: Path):
    (saved / CARD).write_text("{")
    with pytest.raises(InputError, match="cannot be read"):
        load_model(saved)


def test_weights_of_another_network_are_told(resnet, ridge, saved: Path, tmp_path: Path):
    change(saved, kind="resnet18", parameters=resnet.parameters())
    with pytest.raises(InputError, match="expected scaling"):
        load_model(saved)


def test_a_bundled_model_is_loaded_by_name(ridge, small, tmp_path: Path, monkeypatch):
    monkeypatch.setattr(store_module, "_PRETRAINED", tmp_path)
    with pytest.raises(InputError, match="no bundled model"):
        pretrained("mine")
    save_model(ridge, tmp_path / "mine")
    np.testing.assert_array_equal(pretrained("mine").predict(small).value, ridge.predict(small).value)
    with pytest.raises(InputError, match="bundled: mine"):
        pretrained("yours")


def test_what_cannot_be_loaded_again_is_not_saved(tmp_path: Path):
    fit = SimulationFit(load_scene("thin-lens"))
    with pytest.raises(InputError, match="learns nothing that a folder could keep"):
        save_model(fit, tmp_path / "m")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [[], {}, None, 3])
def test_a_kind_that_is_no_name_is_one_line(ridge, tmp_path: Path, kind):
    path = save_model(ridge, tmp_path / "m")
    card = json.loads((path / "model.json").read_text())
    (path / "model.json").write_text(json.dumps(card | {"kind": kind}))
    with pytest.raises(InputError, match="unknown kind"):
        load_model(path)
