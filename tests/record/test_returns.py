"""Patches of retro-reflections end where no network can see it, and hold what the simulator has there."""

from __future__ import annotations

import functools
from itertools import chain
from typing import Any

import numpy as np
import pytest
import torch

import tapetum as tp
from tapetum.bench import Scene, with_values
from tapetum.data.synth import make_plan
from tapetum.record import returns
from tapetum.record.patch import Patch, add_patch
from tapetum.record.returns import returns_of
from tapetum.simulate import tilt_of_gaze, traced_lens
from tapetum.simulate.radiometry import photoelectrons


def patches(scene: Scene, gaze: np.ndarray) -> list[list[Patch]]:
    still = np.zeros(len(gaze))
    found = returns_of(scene, gaze, np.zeros_like(gaze), still, still + scene.distance)
    return [list(chain.from_iterable(one.patches(i) for one in found)) for i in range(len(gaze))]


@functools.cache
def bench_scene(name: str) -> Scene:
    if name == "out of focus":
        return with_values(
            tp.load_scene("hand-held"), {"target.object_distance": 4.0, "probe.sensor.pixels": [1400, 1200]}
        )
    if name.startswith("focusing"):
        found = next(video.scene for video in make_plan("focusing", "laptop").videos if video.name == name)
        return with_values(found, {"sampling.accuracy": 0.3})  # half the time, and windows two pixels wider
    return tp.load_scene(name)


@functools.cache
def seen(name: str, extent: float) -> tuple[list[list[Patch]], int]:
    """Patches of a bench scene's cameras all over the field, and how often a traced lens was planned for them."""
    gaze = extent * np.array([[0, 0], [0.5, 0], [0, 0.5], [-0.7, 0.7], [1, 0], [0, 1], [-0.4, -0.8]])
    planned, plan = [], traced_lens.traced_group

    def counted(*given: Any, **way: Any) -> Any:
        planned.append(given)
        return plan(*given, **way)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(traced_lens, "traced_group", counted)
        return patches(bench_scene(name), gaze), len(planned)


@pytest.mark.parametrize(
    ("name", "extent"),
    [("hand-held", 0.45), ("out of focus", 0.45), ("rotation", 0.45), ("focusing-50mm-3.5m", 0.2)],
)
def test_the_light_that_patches_leave_out_is_far_below_the_noise(name: str, extent: float) -> None:
    """It was 5e-4 of the peak, two electrons beside a background of 40: a network saw each patch's square by them."""
    frames, _ = seen(name, extent)
    peak = max(float(patch.light.max()) for patch in chain.from_iterable(frames))
    for patch in chain.from_iterable(frames):
        edges = [patch.light[k].mean() for k in (0, -1)] + [patch.light[:, k].mean() for k in (0, -1)]
        # Few patches are as wide as the crops of 400 pixels in which a network would see their edges.
        assert max(edges) < (4.5e-5 if len(patch.light) < 440 else 1.2e-4) * peak


def test_a_filmed_frame_holds_what_the_simulator_computes_for_it() -> None:
    scene = tp.load_scene("hand-held")
    gaze = np.array([[0.2, 0.1], [-0.35, 0.4], [0.02, -0.01]])
    turns = np.degrees(np.arcsin(tilt_of_gaze(scene, torch.from_numpy(gaze)).numpy()))
    wanted = tp.retroreflect(scene, rotation=turns)
    electrons = float(
        photoelectrons(torch.ones((), dtype=torch.float64), scene.probe.sensor, scene.illumination.wavelength)
    )
    columns, rows = scene.probe.sensor.pixels
    for own, image in zip(patches(scene, gaze), np.asarray(wanted), strict=True):
        frame = np.zeros((rows, columns), np.float32)
        for patch in own:
            add_patch(frame, patch, 1.0)
        left = frame - electrons * image
        # Its places are whole pixels and parts of them, computed apart: 1 % of the peak is asked for, near it.
        assert np.abs(left).max() < 0.01 * frame.max()
        # In the mean over many pixels nothing is missing: 2 electrons were, beyond a square of 309 pixels.
        blocks = left[:480, :640].reshape(24, 20, 32, 20).mean(axis=(1, 3))
        assert np.abs(blocks).max() < 2e-4 * frame.max()


def test_a_patch_is_no_larger_than_the_frame() -> None:
    scene = with_values(tp.load_scene("hand-held"), {"probe.sensor.pixels": [200, 160]})
    (one,) = returns_of(scene, np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), np.zeros(1) + scene.distance)
    usual = returns_of(tp.load_scene("hand-held"), np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), np.zeros(1) + 5.5)[
        0
    ]
    assert max(patch.light.shape[0] for patch in one.patches(0)) < max(
        patch.light.shape[0] for patch in usual.patches(0)
    )


def test_all_beams_of_a_traced_lens_share_a_plan() -> None:
    """Each window was planned by itself: at 135 mm a minute passed before the first frame."""
    frames, planned = seen("focusing-50mm-3.5m", 0.2)
    assert all(len(frame) == 2 for frame in frames)
    assert planned == 1


def test_a_film_is_planned_for_its_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    camera = returns.Camera

    def counted(*given: Any, **options: Any) -> Any:
        asked.append(options["pictures"])
        return camera(*given, **options)

    monkeypatch.setattr(returns, "Camera", counted)
    scene, still = tp.load_scene("hand-held"), np.zeros(12)
    returns_of(scene, np.zeros((12, 2)), np.zeros((12, 2)), still, still + scene.distance)
    assert asked[-1] == 12
    # Some distances each have a camera of their own.
    returns_of(scene, np.zeros((12, 2)), np.zeros((12, 2)), still, scene.distance + np.repeat([0.0, 0.5, 1.0], 4))
    assert asked[-1] == 4
