"""Gaze and tilt of a traced lens: one is the other's inverse, distortion and all."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from traced_cases import WAVELENGTH, Case, traced

from tapetum.bench import PrescriptionLens, load_scene, with_values
from tapetum.errors import InputError
from tapetum.simulate.field_map import field_map
from tapetum.simulate.gaze import gaze_of, tilt_of_gaze
from tapetum.simulate.information import true_values
from tapetum.simulate.traced_bundle import spot_middles, trace_bundle

SECTION = "Traced lenses"
LENSES = ["phone-d", "compact-6mm-f1.9", "phone-b"]


@pytest.mark.parametrize("name", LENSES)
def test_it_is_its_own_inverse_and_follows_the_rays(name: str, validated: Any) -> None:
    case = Case(name, 20.0)
    mapped = field_map(case.lens, WAVELENGTH, math.inf, 2e-3)
    sines = torch.linspace(0, 0.97 * mapped.nodes.steepest, 30, dtype=torch.float64)
    back = mapped.sine(mapped.image(sines))
    validated(SECTION, f"tilt from the place on the sensor, {case}", float((back - sines).abs().max()), 1e-9,
              "its inverse", "in sines")  # fmt: skip
    some = sines[[3, 11, 22]]
    rays = trace_bundle(traced(Case(name, 2.0))[0], some, count=21)
    error = float((mapped.image(some) - rays.middle).abs().max())
    validated(SECTION, f"place of the spot, {case}", error / 1e-6, 0.5, "rays", "µm")


@pytest.mark.parametrize("name", LENSES)
def test_near_the_axis_it_is_a_thin_lens(name: str) -> None:
    case = Case(name, 2.0)
    mapped = field_map(case.lens, WAVELENGTH, math.inf, 2e-3)
    sine = torch.tensor([math.sin(math.radians(1.0))], dtype=torch.float64)
    thin = traced(case)[0].focal_length * math.tan(math.radians(1.0))
    assert float(mapped.image(sine)) == pytest.approx(thin, rel=2e-2)
    assert abs(float(mapped.image(torch.zeros(1, dtype=torch.float64)))) < 1e-7


def test_beyond_the_field_it_refuses() -> None:
    mapped = field_map(Case("phone-d", 2.0).lens, WAVELENGTH, math.inf, 2e-3)
    with pytest.raises(InputError, match="outside the field of the lens") as refused:
        mapped.sine(torch.tensor([3e-3], dtype=torch.float64))
    assert "\n" not in str(refused.value)


FAST = [("la1509", None), ("photo-50mm-f1.8", None), ("zoom-18-140mm", 0.135)]
SLOW = [
    ("cmount-12mm-f1.4", None), ("compact-6mm-f1.9", None), ("phone-a", None), ("phone-b", None), ("phone-c", None),
    ("phone-d", None), ("phone-e", None), ("phone-f", None), ("zoom-18-140mm", 0.02), ("zoom-5-15mm", 0.006),
    ("zoom-5-15mm", 0.014),
]  # fmt: skip


@pytest.mark.parametrize(
    ("name", "focal_length"), [*FAST, *(pytest.param(*one, marks=pytest.mark.slow) for one in SLOW)]
)
def test_it_rises_and_follows_the_rays_to_its_edge_for_every_lens(name: str, focal_length: float | None) -> None:
    """Between the traced tilts too, on a sensor larger than any lens covers."""
    lens = PrescriptionLens(name) if focal_length is None else PrescriptionLens(name, focal_length=focal_length)
    mapped = field_map(lens, WAVELENGTH, 5.0, 10 * lens.focal_length)
    sines = torch.linspace(0, mapped.nodes.steepest, 16, dtype=torch.float64)
    heights = mapped.image(sines)
    assert bool((heights.diff() > 0).all())
    rays = spot_middles(lens.focused(WAVELENGTH, 5.0), sines, count=21)
    assert float((heights - rays).abs().max()) < 3e-3 * float(heights[-1])


@pytest.mark.parametrize(
    ("name", "focal_length", "degrees"), [("zoom-18-140mm", 0.135, 5.0), ("compact-6mm-f1.9", None, 50.0)]
)
def test_a_tilt_beyond_the_field_has_no_gaze(name: str, focal_length: float | None, degrees: float) -> None:
    lens = {"kind": "prescription", "name": name} | ({} if focal_length is None else {"focal_length": focal_length})
    scene = with_values(load_scene("thin-lens"), {"target.lens": lens})
    for sign in (1, -1):
        sines = torch.tensor([[0.0, 1e-3], [0.0, sign * math.sin(math.radians(degrees))]], dtype=torch.float64)
        with pytest.raises(
            InputError, match=rf"rotation: {degrees:g} deg lies outside the field .* ends at"
        ) as refused:
            gaze_of(scene, sines)
        assert "\n" not in str(refused.value)
    # What is said of a scene that is turned so far says the same.
    if focal_length is not None:
        with pytest.raises(InputError, match="5 deg lies outside the field"):
            true_values(with_values(scene, {"target.rotation": [0.0, 5.0]}), ("gaze_x",))


def test_gradients_of_the_inverse() -> None:
    mapped = field_map(Case("phone-d", 2.0).lens, WAVELENGTH, math.inf, 2e-3)
    height = torch.tensor([2e-4, 9e-4], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(mapped.sine(height).sum(), height)
    want = (mapped.sine(height.detach() + 1e-8) - mapped.sine(height.detach() - 1e-8)) / 2e-8
    assert torch.allclose(slope, want, rtol=1e-5)


def test_gaze_and_tilt_turn_into_each_other(validated: Any) -> None:
    scene = with_values(
        load_scene("thin-lens"),
        {"target.lens": {"kind": "prescription", "name": "phone-d"}, "target.object_distance": 5.0,
         "target.sensor.pixels": [1600, 1200], "target.sensor.pitch": 1.4e-6},
    )  # fmt: skip
    gaze = torch.tensor([[0.0, 0.0], [0.3, -0.2], [-0.45, 0.4], [0.0, 0.1]], dtype=torch.float64)
    sines = tilt_of_gaze(scene, gaze)
    error = float((gaze_of(scene, sines) - gaze).abs().max())
    validated(SECTION, "gaze to tilt and back, phone-d, x_d = 5 m", error, 1e-8, "itself", "of the field")
    # Positive rotation gives positive gaze; the lens's own length sets the scale.
    assert float(sines[1, 0]) > 0 > float(sines[1, 1])
    assert float(sines[3, 1]) == pytest.approx(0.1 * 1200 * 1.4e-6 / 3.76e-3, rel=0.03)
    # A sensor that holds more than the lens covers has gazes that no light answers.
    wide = with_values(scene, {"target.sensor.pixels": [9000, 9000]})
    with pytest.raises(InputError, match="outside the field"):
        tilt_of_gaze(wide, torch.tensor([[0.5, 0.5]], dtype=torch.float64))
