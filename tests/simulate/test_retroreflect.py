"""`retroreflect` as people call it: rotations, gradients, distance, and what it refuses."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.simulate import Camera, gaze_of, retroreflect, tilt_of_gaze
from tapetum.simulate.retroreflect import _degrees


def scene(**changes: Any) -> Scene:
    small = {"probe.sensor.pixels": [48, 40], "probe.sensor.pitch": 8e-6, "target.lens.aperture_radius": 1.5e-3}
    return with_values(load_scene("thin-lens"), {**small, **{k.replace("__", "."): v for k, v in changes.items()}})


def test_rotations_one_or_many_about_one_axis_or_two() -> None:
    one = scene()
    alone = retroreflect(one, 0.3)
    assert alone.irradiance.shape == (1, 40, 48)
    many = retroreflect(one, [0.0, 0.3])
    assert torch.allclose(many.irradiance[1], alone.irradiance[0], rtol=1e-4, atol=1e-6 * float(alone.irradiance.max()))
    both = retroreflect(one, np.array([[0.0, 0.3]]))
    assert torch.equal(both.irradiance, alone.irradiance)
    assert both.metadata["rotation_deg"] == [(0.0, pytest.approx(0.3))]
    turned = scene(target__rotation=["0 deg", "0.3 deg"])
    assert torch.allclose(retroreflect(turned).irradiance, alone.irradiance)


def test_rotations_in_any_container() -> None:
    angles = np.array([0.3, 0.1])
    frozen = angles.copy()
    frozen.flags.writeable = False
    wanted = [(0.0, 0.3), (0.0, 0.1)]
    containers = (angles[::-1].copy()[::-1], angles.astype(">f8"), pd.Series(angles, [7, 8]), frozen)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given in (*containers, tuple(angles), list(torch.tensor(angles))):
            assert _degrees(scene(), given).tolist() == pytest.approx(np.array(wanted))
        turned = np.array(wanted)[:, ::-1]
        for given in (turned, pd.DataFrame(turned), [[0.3, torch.tensor(0.0)], torch.tensor([0.1, 0.0])]):
            assert _degrees(scene(), given).tolist() == pytest.approx(turned, abs=1e-7)
    for refused in ("0.3", ["0.3"], ["0.3", 0.1], [[0.1], [0.1, 0.2]], [torch.zeros(1), torch.zeros(2)], object()):
        with pytest.raises(InputError, match="rotation: is no number"):
            _degrees(scene(), refused)


def test_gradients_reach_tensors_in_a_list() -> None:
    x, y = (torch.tensor(one, dtype=torch.float64, requires_grad=True) for one in (0.1, 0.2))
    _degrees(scene(), [[0.0, x], [y, x]]).sum().backward()
    assert (float(x.grad or 0), float(y.grad or 0)) == (2.0, 1.0)


def test_metadata_says_how_it_was_made() -> None:
    told = retroreflect(scene()).metadata
    assert told["sampling"]["expected_error"] <= 1e-3
    # What the sensor's far edges may change of the outermost rings, and the probe's aperture, which is left out.
    assert 0 <= told["expected_error"] - told["sampling"]["expected_error"] - told["cut_by_aperture"] < 3e-5
    assert 1e-4 < told["cut_by_aperture"] < 0.001
    assert told["wavelength"] == pytest.approx(640e-9)
    assert told["propagation"] == "far field"
    # Focused at 1 m the return, of curvature 2/(x_d + f), has crossed over long before the probe.
    near = retroreflect(scene(distance=20.0, object_distance=1.0)).metadata
    assert "finite" in near["propagation"]
    assert near["return_radius_at_probe"] == pytest.approx(1.5e-3 * (20 * 2 / 1.1 - 1), rel=0.15)


@pytest.mark.parametrize(
    "rotation", [math.nan, [0.0, math.inf], [[0.0, 0.1, 0.2]], [], 45.0, [[0.0, 1.0], [math.nan, 0.0]], [[29.0, 29.0]]]
)
def test_rotations_that_mean_nothing_are_refused(rotation: Any) -> None:
    with pytest.raises(InputError, match="rotation"):
        retroreflect(scene(), rotation)


@pytest.mark.parametrize("sine", [1.0, 1.5, math.nan, math.inf])
def test_a_gaze_of_no_sine_is_refused(sine: float) -> None:
    for name in ("thin-lens", "rotation"):
        with pytest.raises(InputError, match="sines: must be below 1 in all, is"):
            gaze_of(load_scene(name), torch.tensor([[0.0, 0.0], [0.0, sine]], dtype=torch.float64))


@pytest.mark.parametrize(
    ("options", "where"),
    [
        ({"object_distance": 0.05}, "object_distance"),
        ({"object_distance": -1.0}, "object_distance"),
        ({"object_distance": math.nan}, "object_distance"),
        ({"focal_length": -0.1}, "focal_length"),
        ({"focal_length": math.inf}, "focal_length"),
        ({"focal_length": math.nan}, "focal_length"),
        ({"accuracy": 1e-9}, "accuracy"),
        ({"dtype": torch.float32}, "dtype"),
    ],
)
def test_values_that_make_no_camera_are_refused(options: dict[str, Any], where: str) -> None:
    with pytest.raises(InputError, match=where):
        retroreflect(scene(), 0.1, **options)


def test_gradients_reach_the_scene_s_parameters() -> None:
    one = scene()
    degrees = torch.tensor([[0.0, 0.2]], dtype=torch.float64, requires_grad=True)
    distance = torch.tensor(4.0, dtype=torch.float64, requires_grad=True)
    focal = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    light = retroreflect(one, degrees, object_distance=distance, focal_length=focal).irradiance
    (light**2).sum().backward()
    for value in (degrees, distance, focal):
        assert value.grad is not None
        assert bool(torch.isfinite(value.grad).all())
        assert float(value.grad.abs().max()) > 0


def test_collimated_light_does_not_care_for_the_distance() -> None:
    changes = {"sampling.propagation": "far field"}
    near, far = (retroreflect(with_values(scene(distance=d), changes), 0.2).irradiance for d in (1.0, 12.0))
    assert torch.equal(near, far)


def test_diverging_light_fades_with_the_square_of_the_distance() -> None:
    light = {"mode": "diverging", "divergence": "0.5 deg"}
    totals = []
    for d in (2.0, 8.0):
        one = scene(distance=d, object_distance=d, illumination=light, **{"probe.sensor.pitch": 16e-6})
        totals.append(float(retroreflect(one).irradiance.sum()))
    assert totals[0] / totals[1] == pytest.approx(16, rel=0.03)


def test_fixed_area_light_keeps_its_irradiance() -> None:
    light = {"mode": "fixed_area", "diameter": "40 mm"}
    told = [retroreflect(scene(distance=d, illumination=light)).metadata for d in (2.0, 8.0)]
    assert told[0]["irradiance_at_target"] == told[1]["irradiance_at_target"]
    assert told[0]["irradiance_at_target"] == pytest.approx(1e-3 / (math.pi * 0.02**2))


def test_the_image_scales_with_power_reflectance_and_transmission() -> None:
    usual = retroreflect(scene()).irradiance
    changed = scene(illumination__power=2e-3, target__sensor__reflectance=0.3, probe__transmission=0.25)
    assert torch.allclose(retroreflect(changed).irradiance, 3 * usual, rtol=1e-5)


def test_gaze_and_tilt_are_inverse_and_signed() -> None:
    one = load_scene("thin-lens")
    gaze = torch.tensor([[0.3, -0.2], [0.0, 0.0], [-0.45, 0.45]], dtype=torch.float64)
    assert torch.allclose(gaze_of(one, tilt_of_gaze(one, gaze)), gaze)
    degree = torch.sin(torch.deg2rad(torch.tensor([[1.0, 0.0]], dtype=torch.float64)))
    z = 1 / (1 / 0.1 - 1 / 5.0)
    sensor = one.target.sensor
    assert float(gaze_of(one, degree)[0, 0]) == pytest.approx(z * math.tan(math.radians(1)) / (648 * sensor.pitch))


def test_a_window_holds_the_light() -> None:
    one = load_scene("hand-held")
    whole = Camera(one, 0.02)
    sines = torch.tensor([[0.01, 0.005]], dtype=torch.float64)
    beam = whole.beams(sines, torch.zeros(1, 2, dtype=torch.float64))[0]
    part = Camera(one, 0.02, output=whole.window())
    assert float(part.render(*beam).sum()) == pytest.approx(float(whole.render(*beam).sum()), rel=0.02)
