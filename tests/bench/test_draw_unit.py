"""Copies of a camera: drawn from tolerances with sources, the same from the same seed."""

from dataclasses import fields, replace

import numpy as np
import pytest

from tapetum.bench import (
    PhoneTarget,
    PrescriptionLens,
    Tolerances,
    draw_unit,
    load_scene,
    load_tolerances,
    scene_dict,
    scene_from_dict,
    tolerance_names,
    with_values,
)
from tapetum.errors import InputError


def test_every_bundled_tolerance_has_a_source() -> None:
    assert tolerance_names() == ["phone", "thin", "traced"]
    for name in tolerance_names():
        loaded = load_tolerances(name)
        given = [getattr(loaded, field.name) for field in fields(Tolerances)]
        assert all(len(one.source) > 10 for one in given if one is not None)
    with pytest.raises(InputError, match=r"sensor_tilt\.source: is missing"):
        from tapetum.bench.faults import build

        build(Tolerances, {"sensor_tilt": {"spread": 0.1, "limit": 0.1}}, "mine.yaml")


@pytest.mark.parametrize("name", ["hand-held", "rotation", "phones"])
def test_a_unit_is_its_seed_and_survives_a_file(name: str) -> None:
    model = load_scene(name)
    one = draw_unit(model, None, 3)
    assert one == draw_unit(name, None, 3) != draw_unit(name, None, 4)
    assert scene_from_dict(scene_dict(one)) == one
    assert hash(one) != hash(model)
    assert one.probe == model.probe
    assert one.distance == model.distance


def test_draws_are_of_the_stated_distribution() -> None:
    model, told = load_scene("hand-held"), load_tolerances("thin")
    assert told.sensor_tilt is not None
    # One tolerance alone: every quantity has its own random numbers.
    tilts = np.array([draw_unit(model, told, n).target.sensor.tilt for n in range(300)])
    alone = draw_unit(model, Tolerances(sensor_tilt=told.sensor_tilt), 7)
    assert alone.target.sensor.tilt == tuple(tilts[7])
    assert alone.target.lens == model.target.lens
    assert np.abs(tilts).max() <= told.sensor_tilt.limit
    # Cut off at two standard deviations, a normal distribution keeps 0.88 of its own.
    assert tilts.std() == pytest.approx(0.88 * told.sensor_tilt.spread, rel=0.1)
    assert abs(np.corrcoef(tilts.T)[0, 1]) < 0.2


def test_a_displaced_sensor_is_focused_elsewhere() -> None:
    model, told = load_scene("hand-held"), load_tolerances("thin")
    assert told.focus is not None
    lens, only = model.target.lens, Tolerances(focus=told.focus)
    pitch = model.target.sensor.array.pitch if model.target.sensor.array else model.target.sensor.pitch
    most = told.focus.limit * lens.focal_length / (2 * lens.aperture_radius) * (pitch or model.target.sensor.pitch)
    vergences = np.array([1 / draw_unit(model, only, n).target.object_distance for n in range(100)])
    away = (1 / model.target.object_distance - vergences) * lens.focal_length**2
    assert 0.7 * most < np.abs(away).max() <= most * (1 + 1e-9)


def test_each_camera_of_a_phone_is_drawn_for_itself() -> None:
    scene = with_values(load_scene("phones"), {"target.name": "phone-05"})
    drawn = draw_unit(scene, None, 1).target
    assert isinstance(drawn, PhoneTarget)
    cameras = drawn.phone.cameras
    assert len(cameras) > 1
    assert len({camera.sensor.decentre for camera in cameras}) == len(cameras)
    with pytest.raises(InputError, match="built describes 'phone-05', not 'phone-04'"):
        with_values(draw_unit(scene, None, 1), {"target.name": "phone-04"})
    # A phone's own fields leave a scene's short names as they were.
    assert with_values(draw_unit(scene, None, 1), {"wavelength": 7e-7}).illumination.wavelength == 7e-7


def test_a_lens_that_is_wide_open_only_closes() -> None:
    rotation, told = load_scene("rotation"), load_tolerances("traced")
    only = Tolerances(aperture=told.aperture)
    lenses = [draw_unit(rotation, only, n).target.lens for n in range(8)]
    numbers = [lens.f_number for lens in lenses if isinstance(lens, PrescriptionLens)]
    assert None in numbers
    assert all(1.40 < one < 1.48 for one in numbers if one is not None)


def test_a_seed_is_a_whole_number() -> None:
    with pytest.raises(InputError, match="seed: must be a whole number from 0 on, is -1"):
        draw_unit("hand-held", None, -1)
    assert draw_unit("hand-held", replace(load_tolerances("thin"), focus=None), 0).target.object_distance == 5.5
