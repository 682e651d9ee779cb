"""A target that rolls about its optical axis behind a traced lens: computed, and not turned as a picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from scipy.ndimage import affine_transform

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.optics.grid import Grid
from tapetum.record.returns import returns_of
from tapetum.simulate import Camera, tilt_of_gaze
from tapetum.simulate.foreshortening import turned
from tapetum.simulate.phone import phone_scenes

SECTION = "Traced lenses"
STEEPEST = math.sin(math.radians(15))
TILTS = STEEPEST * torch.tensor([[0.0, 0.0], [0.6, 0.3], [-0.2, 0.7]], dtype=torch.float64)
# Metres on the probe's sensor.
PLACES = torch.tensor([[2e-6, -5e-6], [0.0, 0.0], [8e-6, 3e-6]], dtype=torch.float64)


def wide(**changes: Any) -> Scene:
    """The Rotation camera: photosites and a tilted sensor behind a wide-angle lens."""
    return with_values(load_scene("rotation"), {"sampling.accuracy": 0.01, **changes})


def phone() -> Scene:
    """A camera of a phone with a filter before its sensor."""
    scene = with_values(load_scene("phones"), {"target.name": "phone-01", "sampling.accuracy": 0.03})
    return phone_scenes(scene)[0].scene


CASES = [
    pytest.param(wide, 3e-3, id="photosites on a tilted sensor"),
    pytest.param(
        lambda: wide(**{"sampling.propagation": "finite", "probe.lens.aperture_radius": 5e-3}),
        3e-3,
        id="through the probe's aperture",
    ),
    pytest.param(phone, 0.01, id="a phone's filter and microlenses"),
]


@pytest.mark.parametrize(("scene", "tolerance"), CASES)
def test_a_quarter_turn_turns_picture_gaze_and_place(
    scene: Any, tolerance: float, validated: Any, request: pytest.FixtureRequest
) -> None:
    camera = Camera(scene(), STEEPEST, output=Grid(161, 161, 2.2e-6), edge="dimmed")
    assert camera.takes_roll
    unturned = camera.render(TILTS, PLACES).numpy()
    roll = (torch.arange(1, 4, dtype=torch.float64) * math.pi / 2).repeat_interleave(len(TILTS))
    tilts, places = TILTS.repeat(3, 1), PLACES.repeat(3, 1)
    all_rolled = camera.render(tilts, places, roll=roll).numpy()
    all_upright = camera.render(turned(tilts, -roll), turned(places, -roll)).numpy()
    worst, apart = 0.0, 0.0
    for quarters in (1, 2, 3):
        some = slice((quarters - 1) * len(TILTS), quarters * len(TILTS))
        rolled = all_rolled[some]
        # From x to y, y pointing down.
        expected = np.rot90(all_upright[some], -quarters, axes=(1, 2))
        worst = max(worst, float(np.abs(rolled - expected).max() / expected.max()))
        apart = max(apart, float(np.abs(rolled - unturned).max() / expected.max()))
    # What the sensor holds does turn.
    assert apart > 10 * tolerance
    what = f"RR of a target behind a traced lens turned by quarters: {request.node.callspec.id}"
    validated(SECTION, what, worst, tolerance, "the turned picture")


def test_any_turn_agrees_with_a_turned_fine_picture(validated: Any) -> None:
    """Splines turn a picture well where pixels are far finer than its detail."""
    pitch, side = 0.8e-6, 321
    camera = Camera(wide(), STEEPEST, output=Grid(side, side, pitch), edge="dimmed")
    roll = torch.tensor([0.4, -0.15, 1.0], dtype=torch.float64)
    rolled = camera.render(TILTS, torch.zeros_like(TILTS), roll=roll).numpy()
    upright = camera.render(turned(TILTS, -roll), torch.zeros_like(TILTS)).numpy()
    worst, middle = 0.0, np.full(2, (side - 1) / 2)
    rows, columns = np.indices((side, side)) - (side - 1) / 2
    inside = np.hypot(rows, columns) < side / 2 - 8
    for one, other, angle in zip(rolled, upright, roll.tolist(), strict=True):
        back = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        expected = affine_transform(other.astype(float), back, middle - back @ middle, order=5)
        worst = max(worst, float(np.abs(one - expected)[inside].max() / other.max()))
    validated(
        SECTION, "RR of a target behind a traced lens turned by up to 1 rad", worst, 3e-3, "a turned fine picture"
    )


def test_the_sensors_edge_turns_with_it() -> None:
    """A spot beyond a short side of the sensor is on it after a quarter turn."""
    scene = wide(**{"target.sensor.pixels": [648, 120], "sampling.accuracy": 0.03})
    tilt = torch.tensor([[0.0, 0.25]], dtype=torch.float64)
    # As steep as elsewhere here: the lens is traced once.
    camera, place = Camera(scene, STEEPEST, output=Grid(81, 81, 2.2e-6), edge="dimmed"), torch.zeros(1, 2)
    quarter = torch.full((1,), math.pi / 2, dtype=torch.float64)
    assert float(camera.render(tilt, place).max()) == 0
    assert float(camera.render(tilt, place, roll=quarter).max()) > 0


def test_a_roll_that_is_not_computed_is_refused() -> None:
    camera = Camera(load_scene("thin-lens"), 0.01, output=Grid(33, 33, 2.2e-6))
    assert not camera.takes_roll
    with pytest.raises(InputError, match="roll: is computed with the picture only behind a traced lens"):
        camera.render(TILTS[:1], PLACES[:1], roll=torch.zeros(1))


def test_films_compute_the_roll_of_a_traced_lens() -> None:
    """Fringes finer than pixels cannot be turned as a picture: up to 17 % of the peak were off at 135 mm."""
    scene = wide(**{"sampling.accuracy": 0.03, "illumination.second_beam": None})
    gaze, place, roll = np.array([[0.1, -0.05], [0.0, 0.2]]), np.zeros((2, 2)), np.array([0.05, -0.03])
    (returns,) = returns_of(scene, gaze, place, roll, np.full(2, scene.distance))
    camera = returns._camera_at(scene.distance, returns._windows[1.0])
    tilts, turn = tilt_of_gaze(scene, torch.from_numpy(gaze)), torch.from_numpy(roll)
    for frame in range(2):
        (patch,) = returns.patches(frame)
        middle = (np.array(scene.probe.sensor.pixels) - 1) / 2
        corner = np.array([patch.left, patch.top]) + (np.array(patch.light.shape[::-1]) - 1) / 2
        centre = torch.from_numpy((middle - corner) * scene.probe.sensor.pitch)[None]
        some = slice(frame, frame + 1)
        seen = camera.render(turned(tilts[some], turn[some]), centre, equivalent=True, roll=turn[some])[0].numpy()
        seen = seen * returns._electrons
        assert np.abs(patch.light - seen).max() < 1e-5 * seen.max()
