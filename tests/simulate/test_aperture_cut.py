"""The probe's aperture and a return that fits through it by rays: computed, or part of the stated error."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from tapetum.bench import Scene, load_scene, with_values
from tapetum.optics.grid import Grid
from tapetum.simulate import Camera
from tapetum.simulate.aperture_cut import cut_by_aperture

SECTION = "Propagation to the probe"
SINES = torch.sin(torch.deg2rad(torch.tensor([[0.0, 0.0], [0.3, 0.0], [0.5, 0.4]], dtype=torch.float64)))


def scene(**changes: Any) -> Scene:
    return with_values(load_scene("thin-lens"), {f"{k.replace('__', '.')}": value for k, value in changes.items()})


def camera(one: Scene, way: str) -> Camera:
    first = Camera(one, 0.0).geometry
    wide = 2.2 * (first.exit_angle + 3 * first.wavelength / first.radius) * first.probe_focal_length
    given = with_values(one, {"sampling.propagation": way})
    return Camera(given, 0.02, output=Grid(65, 65, wide / 65), dtype=torch.complex128, device="cpu")


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
    apart = abs(float(found[0]) - estimate) / max(float(found[0]), estimate)
    validated(SECTION, f"change by the aperture head on, {of}", apart, 0.5, "sums over rings, head on", "the larger")
    auto = camera(one, "auto")
    auto(SINES)
    assert auto.finite == (1.5 * estimate > 0.02)
    if not auto.finite:
        assert float(found.max()) < auto.metadata()["cut_by_aperture"] <= auto.metadata()["expected_error"]
    assert camera(one, "far field").metadata()["cut_by_aperture"] == 0


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
        assert exact < cut_by_aperture(*given) < 30 * exact
        monkeypatch.undo()
        cut_by_aperture.cache_clear()


def test_where_the_aperture_cannot_be_sampled_its_cut_is_stated() -> None:
    one = scene(distance=0.6, target__object_distance=0.35, probe__lens__aperture_radius=25e-3)
    found = Camera(one, 0.0)
    assert found.finite or found.metadata()["cut_by_aperture"] > 0
