"""The playground, without a server: its settings, its pictures against the simulator's, its rays."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest
import torch

from tapetum.bench import Scene, load_scene, scene_dict, scene_from_dict
from tapetum.errors import InputError
from tapetum.live.playground import SETTINGS, Playground, apply, core, settings_of
from tapetum.live.playground.rays import draw_rays
from tapetum.simulate import expose, fisher, gaze_of, retroreflect
from tapetum.simulate.gaze import field_size

LENS = {"lens": "cmount-12mm-f1.4", "f_number": 5.6}


@pytest.fixture(scope="module")
def base() -> Scene:
    return load_scene("thin-lens")


def far(found: object, expected: object) -> float:
    """Largest difference of two pictures over the peak."""
    a, b = np.asarray(found), np.asarray(expected)
    return float(np.abs(a - b).max() / b.max())


@pytest.mark.parametrize("setting", SETTINGS, ids=lambda one: one.name)
def test_a_setting_is_read_as_it_was_set(setting, base):
    scene = load_scene("phones") if setting.name in ("phone", "imaging") else base
    around = {"photosite_pitch": {"photosites": "square"}, "fill": {"photosites": "square"}}
    around |= {"filter_depth": {"filter": 0.1}, "second_x": {"second_beam": 0.1}, "second_y": {"second_beam": 0.1}}
    around |= {"divergence": {"mode": "diverging"}, "focus": {"focal_length": 50.0}}
    if setting.choices:
        value = setting.choices[-1]
    else:
        value = math.sqrt(setting.low * setting.high) if setting.log else 0.7 * setting.low + 0.3 * setting.high
    changed = apply(scene, {**around.get(setting.name, {}), setting.name: value})
    found = settings_of(changed)[setting.name]
    assert found == value if setting.choices else found == pytest.approx(value, rel=1e-6)
    # A file of it gives the same scene.
    assert scene_from_dict(scene_dict(changed)) == changed


def test_the_gaze_stays_where_focus_and_lens_change(base):
    for others in ({"focus": 1.5}, {"focal_length": 50.0}, LENS, {"focus": 1000.0}):
        found = settings_of(apply(base, {"gaze_x": 0.11, "gaze_y": -0.07, **others}))
        assert (found["gaze_x"], found["gaze_y"]) == pytest.approx((0.11, -0.07), abs=1e-6)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"gaze_x": 0.6}, "gaze_x: 0.6 is out of range"),
        ({"power": math.nan}, "power: must be a number"),
        ({"power": True}, "power: must be a number"),
        ({"lens": "/etc/passwd"}, "lens: unknown value"),
        ({"lens": 3.0}, "lens: unknown value"),
        ({"target.lens": "x"}, "target.lens: there is no such setting"),
        ({"phone": "phone-01"}, "phone: this scene has no such setting"),
        ({"focus": 0.2, "focal_length": 300.0}, "not beyond the focal length"),
    ],
)
def test_what_cannot_be_set_is_refused_in_one_line(values, says, base):
    with pytest.raises(InputError, match=says):
        apply(base, values)


def test_a_thin_lens_gives_the_simulators_picture_and_frame(base):
    ground = Playground()
    values = {"gaze_x": 0.1, "gaze_y": 0.05, "focus": 4.5, "second_beam": 0.1}
    for power in (1.0, 3.0):
        scene = apply(base, {**values, "power": power})
        expected = retroreflect(scene)
        found = ground.result(scene, seed=7)
        assert far(found.image.irradiance, expected.irradiance) < 1e-6
        assert found.image.metadata["expected_error"] == expected.metadata["expected_error"]
        # A last digit of the light may move one electron.
        assert (np.abs(found.frame.astype(int) - expose(expected, scene, 7)[0].astype(int)) > 0).mean() < 1e-3
    # The second one differs in power alone, so its target was there.
    assert found.prepared and not found.draft


def test_a_traced_lens_keeps_its_target_while_it_turns(base):
    ground = Playground()
    first = apply(base, {**LENS, "gaze_x": 0.2})
    draft = ground.result(first, draft=True)
    full = ground.result(first)
    assert (draft.draft, full.draft) == ("few samples", "")
    told = full.image.metadata
    assert told["expected_error"] - told["cut_by_aperture"] <= first.sampling.accuracy
    turned = apply(base, {**LENS, "gaze_x": 0.19, "gaze_y": 0.03})
    found, expected = ground.result(turned, draft=True), retroreflect(turned)
    assert found.prepared and not found.draft
    stated = found.image.metadata["expected_error"] + expected.metadata["expected_error"]
    assert far(found.image.irradiance, expected.irradiance) < stated
    off = far(draft.image.irradiance, full.image.irradiance)
    assert off < draft.image.metadata["expected_error"] + full.image.metadata["expected_error"]


def test_a_lens_not_traced_yet_is_first_a_thin_one_of_its_focal_length_and_aperture(base):
    ground, values = Playground(), {**LENS, "focus": 3.5, "gaze_x": 0.1, "gaze_y": -0.05}
    scene, first = ground.first(base, values)
    assert first.draft == "thin lens"
    lens, real = scene.target.lens, apply(base, values).target.lens
    assert (lens.kind, lens.focal_length, lens.aperture_radius) == ("thin", real.focal_length, real.aperture_radius)
    assert settings_of(scene)["gaze_x"] == pytest.approx(0.1)
    ground.result(apply(base, values))
    # Now its rays are known, whatever its sensor.
    assert ground.first(base, {**values, "tilt_x": 0.1})[1].draft == "few samples"
    assert ground.first(base, values)[1].draft == ""


def test_only_the_last_targets_are_kept(base):
    ground = Playground(most=2)
    for focus in (3.0, 4.0, 5.0):
        ground.result(apply(base, {"focus": focus}))
    assert len(ground) == 2
    assert ground.result(apply(base, {"focus": 5.0, "read_noise": 9.0})).prepared
    assert not ground.result(apply(base, {"focus": 3.0})).prepared


def test_more_pixels_than_a_page_shows_are_refused():
    large = load_scene("thin-lens", ("probe.sensor.pixels=[4096, 4096]",))
    for compute in (Playground().result, Playground().limit):
        with pytest.raises(InputError, match=r"probe\.sensor\.pixels: 4096 x 4096 pixels are more"):
            compute(large)


def test_more_samples_than_a_page_can_wait_for_are_refused(base):
    with pytest.raises(InputError, match=r"sampling: \d+ x \d+ samples over the pupil are more"):
        Playground().result(apply(base, {"focus": 1.0, "f_number": 4.0}))


def test_the_limit_is_that_of_the_plan_within_one_percent(base):
    scene = apply(base, {"gaze_x": 0.1, "focus": 4.0})
    found = Playground().limit(scene).found
    exact = fisher(scene, found.parameters).bounds
    assert found.bounds == pytest.approx(exact, rel=0.01)


def test_what_has_no_limit_says_why(base):
    phone = Playground().limit(load_scene("phones"))
    assert phone.found is None and "phone" in phone.left_out["gaze_x"]


@pytest.mark.parametrize("values", [{}, LENS], ids=["thin", "traced"])
def test_rays_meet_the_sensor_at_the_gaze_and_return_the_way_they_came(values, base):
    scene = apply(base, {**values, "gaze_x": 0.04, "gaze_y": -0.03, "focus": 1000.0})
    rays = draw_rays(scene)
    gaze = gaze_of(scene, torch.sin(torch.tensor(scene.target.rotation, dtype=torch.float64)))
    place = float((gaze * field_size(scene)).norm())
    returned = 0
    for inward, back in zip(rays.rays_in, rays.rays_back, strict=True):
        # Aberrations of a real lens move its rays by some micrometres.
        assert inward[-1][1] == pytest.approx(place, abs=2e-5 if values else 1e-9)
        if len(back) == len(inward):
            returned += 1
            slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in (inward[:2], back[-2:])]
            assert slopes[0] == pytest.approx(slopes[1], abs=1e-3)
    # Under a tilt the pupil of the returning light is shifted, and cuts off some.
    assert 5 <= returned < len(rays.rays_in)


def test_a_tilted_sensor_turns_the_light_back_by_twice_its_tilt(base):
    scene = apply(base, {"focus": 1000.0, "tilt_y": 1.0})
    middle = draw_rays(scene).rays_back[4]
    (z, y), (_, out) = middle[:2]
    assert abs(math.degrees(math.atan((out - y) / z))) == pytest.approx(2.0, abs=1e-3)


def test_a_scene_is_slow_by_its_own_time_and_not_by_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, ground, image = load_scene("thin-lens"), Playground(), core._image

    def late(*given: Any) -> Any:
        time.sleep(core._SLOW)
        return image(*given)

    monkeypatch.setattr(core, "_image", late)
    monkeypatch.setattr(core, "fisher", lambda *_, **__: None)
    ground.result(scene)
    assert ground.limit(scene).left_out == {}
    monkeypatch.setattr(core, "_SLOW", 0.0)
    assert "takes long in this scene" in ground.limit(scene).left_out["gaze_x"]
