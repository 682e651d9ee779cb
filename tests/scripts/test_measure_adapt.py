"""Of what kind the errors of an adapted network are."""

from __future__ import annotations

import numpy as np
import pytest

from measure_adapt import misses
from tapetum.bench import Scene, load_scene
from tapetum.simulate.hypotheses import point_of_symmetry


def scene(tilt: list[str]) -> Scene:
    return load_scene("hand-held", [f"target.sensor.tilt=[{', '.join(tilt)}]"])


def test_opposite_gazes_lie_about_the_point_of_symmetry_and_angles_are_those_to_the_slope() -> None:
    sloping = scene(["0.1 deg", "0 deg"])
    middle = point_of_symmetry(sloping).numpy()
    assert np.abs(middle).max() > 0.02
    # The sensor slopes along x.
    truth = np.array([[0.4, 0.0], [0.0, 0.4], [-0.4, 0.0], [0.0, -0.4], [0.04, 0.0]])
    value = np.array([[0.45, 0.0], [0.0, -0.4], [0.4, 0.0], [0.2, -0.4], [0.04, 0.0]])
    told = misses(middle + value, middle + truth, sloping)
    assert (told["far"], told["opposite"]) == (0.6, 0.4)
    assert told["far_at_0_to_30"] == 0.5 and told["far_at_75_to_90"] == 1.0 and told["far_at_30_to_60"] is None
    assert told["median"] == pytest.approx([0.05, 0.0]) and told["mae_but_far"] == pytest.approx([0.025, 0.0])


def test_a_sensor_that_does_not_slope_has_no_angles() -> None:
    truth = np.array([[0.3, 0.1], [0.0, 0.2]])
    assert misses(truth, truth, scene(["0 deg", "0 deg"])) == {
        "far": 0.0,
        "opposite": 0.0,
        "median": [0.0, 0.0],
        "mae_but_far": [0.0, 0.0],
    }
