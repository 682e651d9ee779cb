"""A phone before the probe: where its cameras' returns lie, and what an idle camera still returns."""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from tapetum.bench import PhoneTarget, Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.simulate import retroreflect, traced_lens
from tapetum.simulate.camera import Camera
from tapetum.simulate.phone import PhoneCamera, open_camera, phone_scenes, seen_from_probe

TILT = torch.tensor([[0.02, 0.03]], dtype=torch.float64)


def phone(name: str, **values: object) -> Scene:
    return with_values(load_scene("phones"), {"target.name": name, "sampling.accuracy": 0.1, **values})


def several() -> str:
    """The first phone of the catalogue with two cameras."""
    return "phone-03"


def test_places_count_from_the_camera_that_gazes() -> None:
    units = phone_scenes(phone(several()))
    assert len(units) > 1
    assert any(unit.place == (0.0, 0.0) for unit in units)
    assert len({unit.place for unit in units}) == len(units)
    plain = load_scene("thin-lens")
    assert phone_scenes(plain)[0].scene is plain and len(phone_scenes(plain)) == 1


def test_a_turned_plate_is_foreshortened_along_the_tilt() -> None:
    place = torch.tensor([[0.01, 0.02]], dtype=torch.float64)
    assert torch.allclose(seen_from_probe(place, torch.zeros(1, 2, dtype=torch.float64)), place)
    seen = seen_from_probe(place, torch.tensor([[0.0, 0.6]], dtype=torch.float64))
    assert torch.allclose(seen, torch.tensor([[0.01, 0.016]], dtype=torch.float64))
    both = torch.tensor([[0.3, 0.4]], dtype=torch.float64)
    length = torch.linalg.vector_norm
    along = seen_from_probe(torch.tensor([[0.006, 0.008]], dtype=torch.float64), both)
    across = seen_from_probe(torch.tensor([[-0.008, 0.006]], dtype=torch.float64), both)
    assert float(length(along)) == pytest.approx(0.01 * (1 - 0.25) ** 0.5)
    assert float(length(across)) == pytest.approx(0.01)


def test_each_return_lies_where_the_probe_sees_its_camera() -> None:
    """The phone's picture is the sum of its cameras' own, each moved by its place over the distance."""
    scene = phone(several())
    # Fewer pixels, and the plane mirrors alone: places are what is asked for.
    units = phone_scenes(scene)[:2]
    grid = Grid(97, 97, 10e-6)
    camera = PhoneCamera.__new__(PhoneCamera)
    camera.scene, camera.output = scene, grid
    bare = [replace(unit.scene, target=replace(unit.scene.target, sensor=_mirror(unit.scene))) for unit in units]
    cameras = [Camera(one, 0.05, output=grid) for one in bare]
    camera.units = list(zip(cameras, units, strict=True))
    camera._shares = torch.zeros(2, dtype=torch.float64)
    image = camera(TILT)
    scale = scene.probe.lens.focal_length / scene.distance
    seen = [seen_from_probe(torch.tensor([unit.place]), TILT) / scene.distance for unit in units]
    apart = [
        one(unit.sines(TILT, aside), scene.probe.lens.focal_length * aside)
        for one, unit, aside in zip(cameras, units, seen, strict=True)
    ]
    assert torch.allclose(image, sum(apart[1:], apart[0]))
    # The middle of each return's light lies there.
    for one, unit in zip(apart, units, strict=True):
        want = scale * seen_from_probe(torch.tensor([unit.place]), TILT)[0]
        assert float(want.abs().max()) < 0.5 * grid.width / 2
        share = one[0].double() / one.sum()
        middle = torch.stack([(share.sum(0) * grid.x()).sum(), (share.sum(1) * grid.y()).sum()])
        assert torch.allclose(middle, want.double(), atol=3 * grid.pitch)


def test_a_camera_beside_is_lit_under_another_angle() -> None:
    """As by a second beam whose return lies at the same place of the picture."""
    scene = phone(several())
    gazing, beside = phone_scenes(scene)[:2]
    aside = seen_from_probe(torch.tensor([beside.place]), TILT) / scene.distance
    assert float(aside.norm()) == pytest.approx(12.4e-3 / 5.5, rel=0.01)
    angle = torch.atan(-aside[0]).tolist()
    double = with_values(scene, {"illumination.second_beam": {"ratio": 1.0, "angle": angle}})
    camera = Camera(phone_scenes(double)[0].scene, 0.05, output=Grid(41, 41, 8e-6))
    (_, first, _), (tilts, place, _) = camera.beams(beside.sines(TILT), torch.zeros(1, 2, dtype=torch.float64))
    torch.testing.assert_close(place - first, scene.probe.lens.focal_length * aside)
    torch.testing.assert_close(beside.sines(TILT, aside), tilts, rtol=0, atol=1e-8)
    assert torch.equal(gazing.sines(TILT, aside), TILT)


def test_cameras_outside_the_lit_disc_are_dark_and_its_edge_is_refused() -> None:
    assert len(phone_scenes(phone("phone-11"))) == 4
    # The disc's radius over 5.5 m is 15 mm, 10.6 mm and 4.8 mm; cameras stand 10.5 to 21 mm aside.
    assert len(phone_scenes(phone("phone-11", **{"illumination.divergence": "0.3125 deg"}))) == 3
    with pytest.raises(InputError, match=r"illumination\.divergence: the edge of the lit disc, 0\.0106 m in radius"):
        phone_scenes(phone("phone-11", **{"illumination.divergence": "0.2208 deg"}))
    assert len(phone_scenes(phone("phone-11", **{"illumination.divergence": "0.1 deg"}))) == 1
    with pytest.raises(InputError, match=r"illumination\.vergence: cameras side by side"):
        phone_scenes(phone("phone-11", **{"illumination.vergence": 0.0}))


def test_a_camera_mounted_askew_looks_beside_the_others(tmp_path: Path) -> None:
    text = yaml.safe_load((resources.files("tapetum.bench") / "phones" / f"{several()}.yaml").read_text("utf-8"))
    text["cameras"][0]["axis"] = ["0.1 deg", "0 deg"]
    text["cameras"][1]["axis"] = ["0.6 deg", "-0.3 deg"]
    path = tmp_path / "askew.yaml"
    path.write_text(yaml.safe_dump(text), "utf-8")
    gazing, other, *_ = phone_scenes(phone(str(path), **{"target.rotation": ["20 mrad", "10 mrad"]}))
    assert gazing.axis == (0.0, 0.0) and gazing.scene.target.rotation == pytest.approx((0.02, 0.01))
    degree = torch.pi / 180
    assert other.axis == pytest.approx((0.5 * degree, -0.3 * degree))
    assert other.scene.target.rotation == pytest.approx((0.02 + 0.5 * degree, 0.01 - 0.3 * degree))
    assert torch.equal(gazing.sines(TILT), TILT)
    assert torch.allclose(torch.asin(other.sines(TILT)) - torch.asin(TILT), torch.tensor([other.axis]).double())
    # Its return is that of the camera alone, turned so much farther.
    grid = Grid(61, 61, 8e-6)
    alone = Camera(
        replace(other.scene, target=replace(other.scene.target, sensor=_mirror(other.scene))), 0.05, output=grid
    )
    camera = PhoneCamera.__new__(PhoneCamera)
    camera.scene, camera.output = other.scene, grid
    camera.units, camera._shares = [(alone, replace(other, place=(0.0, 0.0)))], torch.zeros(1, dtype=torch.float64)
    assert torch.allclose(camera(TILT), alone(other.sines(TILT)))
    assert float((camera(TILT) - alone(TILT)).abs().max()) > 0.1 * float(camera(TILT).max())


def _mirror(scene: Scene) -> object:
    sensor = scene.target.sensor
    return replace(sensor, array=None, microlens=None, layers=(), reflectance=0.3)


def test_a_phone_states_what_its_cameras_state(tmp_path: Path) -> None:
    """What a sensor's edge takes of a spot's rings counts too, in shares of the picture's peak."""
    text = yaml.safe_load((resources.files("tapetum.bench") / "phones" / "phone-02.yaml").read_text("utf-8"))
    text["cameras"][0]["sensor"] |= {"pixels": [12, 12], "layers": []}
    text["cameras"][0]["lens"]["coating"] = 0.0
    path = tmp_path / "tiny.yaml"
    path.write_text(yaml.safe_dump(text), "utf-8")
    light = {"illumination.wavelength": 640e-9, "illumination.second_beam": None, "target.imaging": True}
    scene = phone(str(path), **light, **{"sampling.accuracy": 0.03})
    (unit,) = phone_scenes(scene)
    alone, whole = Camera(unit.scene, 0.001), PhoneCamera(scene, 0.001)
    centred = torch.zeros(1, 2, dtype=torch.float64)
    alone(centred), whole(centred)
    edge = alone.metadata()["expected_error"]
    assert edge > 2 * alone.plan.expected_error
    assert whole.metadata()["expected_error"] == pytest.approx(edge, rel=0.2)
    # Of two cameras each counts as far as its light does.
    both = PhoneCamera(phone(several()), 0.05)
    picture = both(TILT)
    parts = [(one(unit.sines(TILT)).max(), one.metadata()["expected_error"]) for one, unit in both.units]
    want = sum(float(peak) * error for peak, error in parts) / float(picture.max())
    assert both.metadata()["expected_error"] == pytest.approx(want, rel=0.15)


def test_an_idle_camera_keeps_its_filters() -> None:
    """`imaging: false` takes the sensor's return away and nothing else."""
    scene = phone("phone-01")
    assert isinstance(scene.target, PhoneTarget)
    idle = phone("phone-01", **{"target.imaging": False})
    for awake, asleep in zip(phone_scenes(scene), phone_scenes(idle), strict=True):
        assert awake.place == asleep.place
        assert asleep.scene.target.sensor.reflectance == 0
        assert asleep.scene.target.sensor.layers == awake.scene.target.sensor.layers


def test_one_camera_and_a_phone_open_alike() -> None:
    scene = phone("phone-01")
    assert isinstance(open_camera(scene, 0.02, output=Grid(5, 5, 4e-5)), PhoneCamera)
    assert isinstance(open_camera(load_scene("thin-lens"), 0.02, output=Grid(5, 5, 4e-5)), Camera)


def with_second_beam(accuracy: float) -> PhoneCamera:
    beam = {"angle": ["0.06 deg", "-0.05 deg"], "ratio": 0.3}
    scene = phone(several(), **{"sampling.accuracy": accuracy, "illumination.second_beam": beam})
    # As steep as elsewhere here, the second beam included: the lenses are traced once.
    steepest = 0.05 - math.radians(math.hypot(0.06, 0.05))
    return PhoneCamera(scene, steepest, output=Grid(145, 145, 8.8e-6), device="cpu")


@pytest.fixture(scope="module")
def whole() -> PhoneCamera:
    """All cameras on all pixels, as accurate as any window here."""
    camera = with_second_beam(1e-2)
    whole = PhoneCamera.__new__(PhoneCamera)
    whole.scene, whole.output = camera.scene, camera.output
    whole.units = [(one.on(camera.output), unit) for one, unit in camera.units]
    whole._shares = torch.zeros(len(whole.units), dtype=torch.float64)
    return whole


@pytest.mark.parametrize("accuracy", [0.1, 1e-2])
def test_windows_hold_what_the_whole_sensor_sees(accuracy: float, whole: PhoneCamera) -> None:
    """Each return on its own pixels, against all cameras on all pixels; off the middle, and partly off the sensor."""
    camera = with_second_beam(accuracy)
    assert all(one.output.rows < camera.output.rows for one, _ in camera.units)
    tilts = TILT.expand(3, 2)
    centres = torch.tensor([[0.0, 0.0], [1.234e-4, -2.5e-4], [6.4e-4, 1e-5]], dtype=torch.float64)
    like = whole(tilts, centres)
    # The plan for all pixels serves the windows: what they leave out is meant here, no other plan's error.
    all_pixels = [one for one, _ in whole.units]
    camera.units = [(one.on(own.output), unit) for one, (own, unit) in zip(all_pixels, camera.units, strict=True)]
    found = camera(tilts, centres)
    assert found.shape == like.shape == (3, 145, 145)
    apart = float(((found - like).abs().amax((1, 2)) / like.amax((1, 2))).max())
    assert float(found[2].max()) > 0
    # Far beyond the sensor nothing is computed.
    assert float(camera(TILT, torch.tensor([[0.1, 0.0]], dtype=torch.float64)).max()) == 0
    # A tenth of the accuracy for each camera and beam.
    assert 0 < apart < 0.2 * accuracy


def test_a_plan_for_a_wide_picture_serves_a_narrow_one_of_all_planes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through the probe's aperture, of a sensor and its filter; a wider picture is planned by itself."""
    unit = PhoneCamera(phone("phone-03"), 0.05, device="cpu").units[0][0]
    assert unit.finite and len(unit.scene.target.sensor.layers) > 0
    planned = []
    plan = traced_lens.traced_group

    def counted(*given: Any, **way: Any) -> Any:
        planned.append(given)
        return plan(*given, **way)

    monkeypatch.setattr(traced_lens, "traced_group", counted)
    pitch, tilts = 2 * unit.output.pitch, torch.tensor([[0.01, -0.004], [0.0, 0.03]], dtype=torch.float64)
    wide = unit.on(Grid(161, 161, pitch))
    whole = wide(tilts)
    assert len(planned) == 1
    narrow = wide.on(Grid(81, 101, pitch))
    found = narrow(tilts)
    assert len(planned) == 1 and narrow.plan == wide.plan
    # The aperture has samples of its own for either picture.
    assert float((found - whole[:, 40:-40, 30:-30]).abs().max()) < 0.05 * wide.accuracy * float(whole.max())
    alone = narrow.on(Grid(91, 101, pitch))
    again = alone(tilts)
    assert len(planned) == 2 and again.shape == (2, 91, 101)
    assert float((found - again[:, 5:-5]).abs().max()) <= wide.accuracy * float(again.max())


def test_to_the_far_field_a_much_narrower_picture_is_planned_by_itself() -> None:
    camera = Camera(with_values(load_scene("rotation"), {"sampling.accuracy": 0.1}), 0.01, device="cpu")
    assert not camera.finite
    wide = camera.on(Grid(201, 201, 2.2e-6))
    samples = wide.plan
    near, far = wide.on(Grid(161, 161, 2.2e-6)), wide.on(Grid(101, 101, 2.2e-6))
    assert near.plan is samples and far.plan is not samples


@pytest.mark.slow
def test_what_a_pupils_rim_sends_of_a_filters_light_is_computed_where_it_is_asked_for() -> None:
    """A fifth of the peak here; 1615 samples across the pupil were once said to be too few for it."""
    scene = phone("phone-03", **{"target.rotation": (1.0, 1 / 3), "sampling.accuracy": 0.03})
    with_it, without = (retroreflect(with_values(scene, {"sampling.rim_light": one})) for one in (True, False))
    assert with_it.metadata["expected_error"] <= 0.03
    assert with_it.metadata["rim_light"] and not without.metadata["rim_light"]
    apart = np.abs(with_it.numpy() - without.numpy()).max() / with_it.numpy().max()
    assert apart > 0.15
