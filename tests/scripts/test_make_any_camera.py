"""The recipe of the backbone: which cameras it draws, and what its loss counts."""

from __future__ import annotations

import numpy as np
import torch

from make_any_camera import FIRST_UNIT, HELD_OUT, OwnHeads, drawn_camera, few_shot
from tapetum.bench import PrescriptionLens


def test_cameras_are_of_many_kinds_and_never_of_a_lens_held_out() -> None:
    drawn = [drawn_camera(number) for number in range(40)]
    names = {one.scene.target.lens.name for one in drawn if isinstance(one.scene.target.lens, PrescriptionLens)}
    assert not names & set(HELD_OUT) and len(names) >= 3
    assert {one.family for one in drawn} == {"hand-held", "rotation", "thin", "traced"}
    assert drawn_camera(3) == drawn[3] != drawn[4]
    assert FIRST_UNIT > 1_000_000


def test_each_image_counts_by_the_layer_of_all_and_its_own_cameras() -> None:
    loss, output = OwnHeads(), torch.zeros(2, 8, requires_grad=True)
    loss(output, torch.tensor([[1.0, 1.0, 0.0], [1.0, 1.0, 2.0]])).backward()
    assert output.grad is not None
    touched = output.grad.view(2, 4, 2).abs().sum(dim=2) > 0
    # The first two outputs are everybody's.
    np.testing.assert_array_equal(touched, [[True, True, False, False], [True, False, False, True]])


def test_few_frames_of_a_camera_give_its_linear_map() -> None:
    rng = np.random.default_rng(0)

    class Frames:
        camera = np.repeat([0, 5], 40)
        gaze = np.empty((80, 2))

    features = rng.normal(size=(80, 4))
    for number in (0, 5):
        own = number == Frames.camera
        Frames.gaze[own] = features[own] @ rng.normal(size=(4, 2)) + number
    found = few_shot(features, Frames, np.arange(80))  # type: ignore[arg-type]
    assert found.shape == (32, 2) and np.abs(found).mean() < np.abs(Frames.gaze - Frames.gaze.mean(axis=0)).mean()
