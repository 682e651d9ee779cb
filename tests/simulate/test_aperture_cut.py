"""The probe's aperture and a return that fits through it by rays: computed, or part of the stated error."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.simulate import Camera
from tapetum.simulate.aperture_cut import cut_by_aperture
from tapetum.simulate.scene_optics import SceneOptics

SECTION = "Propagation to the probe"
# Tilts, of the steepest.
SHARES = torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.5, 0.4], [0.7, 0.2], [0.0, 1.0]], dtype=torch.float64)
SINES = torch.sin(torch.deg2rad(torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.5, 0.4]], dtype=torch.float64)))


def scene(**changes: Any) -> Scene:
    return with_values(load_scene("thin-lens"), {f"{k.replace('__', '.')}": value for k, value in changes.items()})


def camera(one: Scene, way: str, steepest: float = 0.02) -> Camera:
    first = Camera(one, 0.0).geometry
    wide = 2.2 * (first.exit_angle + 3 * first.wavelength / first.radius) * first.probe_focal_length
    given = with_values(one, {"sampling.propagation": way})
    return Camera(given, steepest, output=Grid(65, 65, wide / 65), dtype=torch.complex128, device="cpu")


def changes(one: Scene) -> torch.Tensor:
    """By how much the aperture changes pictures [3], over their peaks."""
    far, near = (camera(one, way)(SINES) for way in ("far field", "finite"))
    return (far - near).abs().amax((1, 2)) / torch.maximum(far.amax((1, 2)), near.amax((1, 2)))


@pytest.mark.parametrize(
    ("told", "of"),
    [
        ({}, "the scene thin-lens"),
        ({"probe__lens__aperture_radius": 7e-3}, "through an aperture of 14 mm"),
        ({"target__object_distance": math.inf, "distance": 50.0}, "focused at infinity, 50 m away"),
    ],
)
def test_what_an_aperture_cuts_off(told: dict[str, Any], of: str, validated: Any) -> None:
    """Auto left the aperture out wherever the return fitted by rays, and stated nothing: up to 0.96 of the peak off."""
    one = scene(**told, sampling__accuracy=1e-3)
    found = changes(one)
    probe = one.probe.lens.aperture_radius
    estimate = cut_by_aperture(Camera(one, 0.0).geometry, one.distance, probe)
    apart = abs(float(found[0]) - estimate)
    validated(SECTION, f"change by the aperture head on, {of}", apart, 1e-3, "chains of Hankel transforms", "the peak")
    auto = camera(one, "auto")
    auto(SINES)
    assert auto.finite == (1.5 * estimate > 0.02)
    if not auto.finite:
        assert float(found.max()) < auto.metadata()["cut_by_aperture"] <= auto.metadata()["expected_error"]
    assert camera(one, "far field").metadata()["cut_by_aperture"] == 0


@pytest.mark.slow
def test_what_is_stated_holds_under_tilts_of_random_scenes(validated: Any) -> None:
    """Seeds that nothing was chosen on: what is claimed of lens-shaped pupils comes from round ones."""
    held: list[bool] = []
    for seed in range(800, 840):
        rng = np.random.default_rng(seed)
        focal_length = math.exp(rng.uniform(math.log(0.012), math.log(0.15)))
        radius = focal_length / math.exp(rng.uniform(math.log(8), math.log(80)))
        distance = math.exp(rng.uniform(0, math.log(30)))
        told = {
            "target.lens.focal_length": focal_length,
            "target.lens.aperture_radius": radius,
            "target.object_distance": float(rng.choice([math.inf, distance, max(3 * focal_length, 4.0)])),
            "distance": distance,
            "illumination.diameter": radius * float(rng.choice([3.0, 1.2])),
        }
        one = with_values(load_scene("thin-lens"), told)
        reach = Camera(one, 0.0).metadata()["return_radius_at_probe"] * math.exp(rng.uniform(0.1, 2.4))
        one = with_values(one, {"probe.lens.aperture_radius": min(max(reach, 2e-3), 0.06)})
        steepest = float(rng.choice([0.2, 0.4])) * radius / Camera(one, 0.0).geometry.image_distance
        try:
            found = [camera(one, way, steepest) for way in ("auto", "finite")]
            pictures = [one(SHARES * steepest) for one in found]
        except InputError:
            continue
        stated = sum(one.metadata()["expected_error"] for one in found)
        if found[0].finite or not math.isfinite(stated):
            continue
        peak = torch.maximum(*(one.amax((1, 2)) for one in pictures))
        held.append(bool(((pictures[0] - pictures[1]).abs().amax((1, 2)) <= stated * peak).all()))
    assert len(held) >= 8
    share = 1 - sum(held) / len(held)
    validated(SECTION, "random scenes in which it changes more than is stated", share, 0.1, "their number", "of all")


@pytest.mark.parametrize("aperture", [3.6e-3, 5e-3])
def test_an_aperture_beside_the_return_is_computed(aperture: float) -> None:
    one = scene(probe__lens__aperture_radius=aperture)
    assert float(changes(one).max()) > 0.05
    assert camera(one, "auto").finite


def test_of_a_near_wide_aperture_the_cut_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums over so many rings would take seconds."""
    for told in ({}, {"distance": 1.0, "target__object_distance": 1.0}, {"target__object_distance": math.inf}):
        one = scene(**told)
        given = Camera(one, 0.0).geometry, one.distance, one.probe.lens.aperture_radius
        exact = cut_by_aperture(*given)
        cut_by_aperture.cache_clear()
        monkeypatch.setattr("tapetum.simulate.aperture_cut._MOST", 0)
        assert exact < cut_by_aperture(*given) < 100 * exact
        monkeypatch.undo()
        cut_by_aperture.cache_clear()


def test_where_the_aperture_cannot_be_sampled_its_cut_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    one = scene(probe__lens__aperture_radius=7e-3)
    assert camera(one, "auto").finite
    monkeypatch.setattr(SceneOptics, "reaches_aperture", lambda *_: False)
    found = camera(one, "auto")
    assert not found.finite and found.metadata()["cut_by_aperture"] > 0.02


def test_a_near_wide_aperture_is_not_sampled() -> None:
    assert not Camera(scene(distance=0.3), 0.0)._optics.reaches_aperture(Grid(64, 64, 2e-6))
    assert Camera(scene(), 0.0)._optics.reaches_aperture(Grid(64, 64, 2e-6))
