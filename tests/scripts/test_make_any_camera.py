"""The recipe of the backbone: which cameras it draws, and what its loss counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from make_any_camera import FIRST_UNIT, HELD_OUT, Taught, calibrate, drawn_camera, few_shot
from tapetum.bench import PrescriptionLens
from tapetum.errors import InputError
from tapetum.models import load_model, pretrained, save_model
from tapetum.models.last_layer import LastLayer
from tapetum.models.other_units import grouped_half_width


def test_cameras_are_of_many_kinds_and_never_of_a_lens_held_out() -> None:
    drawn = [drawn_camera(number) for number in range(24)]
    names = {one.scene.target.lens.name for one in drawn if isinstance(one.scene.target.lens, PrescriptionLens)}
    assert not names & set(HELD_OUT) and len(names) >= 3
    assert {one.family for one in drawn} == {"hand-held", "rotation", "thin", "traced"}
    assert drawn_camera(3) == drawn[3] != drawn[4]
    assert FIRST_UNIT > 1_000_000


def test_few_frames_of_a_camera_correct_the_layer_of_all() -> None:
    rng = np.random.default_rng(0)
    camera, features, weight = np.repeat([0, 5], 60), rng.normal(size=(120, 4)), rng.normal(size=(2, 4))
    wanted = features @ weight.T + camera[:, None]
    found = few_shot(LastLayer(weight, np.zeros(2)), features, wanted, camera)
    # The layer knows all but how far each camera's field is displaced.
    assert found.shape == (56, 2) and np.abs(found).max() < 1e-6


def test_intervals_are_set_by_cameras_that_train_nothing(tmp_path: Path) -> None:
    """Of a saved model anew, where its frames are the same; cameras are counted, not frames."""
    rng, camera = np.random.default_rng(1), np.repeat(np.arange(60), 2)
    look = torch.from_numpy(rng.uniform(0, 1, (120, 1, 32, 32))).float()
    taught = Taught(look, rng.uniform(-0.4, 0.4, (120, 2)), np.ones(120), camera)
    model = pretrained("thin-lens-gaze")
    save_model(model, tmp_path / "m", data_hash=taught.digest)
    calibrate(tmp_path / "m", taught)
    after = load_model(tmp_path / "m")
    aside = taught.aside
    with torch.inference_mode():
        out = after.network_(look[torch.from_numpy(np.flatnonzero(aside))] / after.unit).double().numpy()
    left = taught.gaze[aside] - (out * after.scaling[1] + after.scaling[0])
    wanted = grouped_half_width(left, camera[aside])
    np.testing.assert_allclose(after.intervals_.half_width, wanted[None], rtol=1e-5)
    assert not np.allclose(after.intervals_.half_width[0], model.intervals_.half_width[0])
    save_model(model, tmp_path / "m", data_hash="another", overwrite=True)
    with pytest.raises(InputError, match="other frames"):
        calibrate(tmp_path / "m", taught)
