"""The engine against the judge on random scenes: each agrees within what it states, or is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest

from tapetum.bench.load import load_scene, scene_from_dict
from tapetum.simulate import retroreflect

from .compare import compared, planned_for_many, summary
from .draw import KINDS, draw
from .judge import Effort, judge, pixel_places

SECTION = "The judge of the 200 scenes"
# Scenes of a seed of their own that the judge does in a second or two each, of as many kinds as there are.
QUICK = (0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 13, 17, 18, 19)
# Of 20261122 the first 94 were looked at, of 20261201 all, of 20270214 the first 125: they found what is mended since.
# 20261210 was drawn before the last, and held as it fell (scenes.md), as did the first 70 of 20270315. Of 20270419 some
# 60 were looked at, of 20270521, 20270703, 20270819, 20270923, 20271109, 20271227 and 20280409 all, of 20280217 185.
# Of 20280707 the first 45 of the newest kind were looked at. What changes the physics draws another one.
SEALED, SCENES = 20280526, 200
# The kinds that took turns when the seeds before were drawn: without masks behind traced lenses, and with these, but
# without traced lenses through the probe's aperture.
FIRST, THEN, LATER = KINDS[:24], KINDS[:25], KINDS[:26]
SINCE = (20261127, 20270214, 20270419, 20270521, 20270703, 20270819, 20270923, 20271227, 990001)


@pytest.mark.parametrize("number", QUICK)
def test_the_engine_agrees_with_the_judge_or_refuses(number: int, tmp_path: Path) -> None:
    kind, plain = draw(4, number, tmp_path)
    line = compared(kind, plain)
    assert line["outcome"] in ("agrees", "refused"), json.dumps(line, indent=1)


# Scenes that found something wrong: an array's order that sends the faint light at a far edge back to the pupil's other
# rim, photosites that the sensor's edge cuts, an array's faint orders, a spot some rings beside the sensor before
# layers, a tilted beam narrower than the lens, in focus and out of it; the edge's waves along a tilted sensor, and on a
# sampled plane far out of focus; a tilted lens's picture beside the middle, and a narrow beam of which the lens's edge
# leaves a sliver; a tiny lens's edge waves along a tilted sensor; a traced lens's waves beyond its rays, a mirror's and
# before layers; masks of random phases whose samples missed Airy's ring, one behind a traced lens compared with
# hardly finer samples, and one whose samples' error and whose paths' add up; a tiny lens's table of returning light.
@pytest.mark.parametrize(
    ("seed", "number"),
    [
        (8, 37),
        (8, 35),
        *((20261122, n) for n in (35, 57, 90)),
        *((20261201, n) for n in (90, 104, 128)),
        *((20270214, n) for n in (43, 66)),
        (20270419, 31),
        (20270521, 40),
        (20270521, 165),
        (20261127, 90),
        *(pytest.param(20261127, n, marks=pytest.mark.slow) for n in (174, 224)),
        (990001, 57),
        pytest.param(20271227, 55, marks=pytest.mark.slow),
        *(pytest.param(20261201, n, marks=pytest.mark.slow) for n in (20, 70)),
    ],
)
def test_what_differed_before(seed: int, number: int, tmp_path: Path) -> None:
    line = compared(*draw(seed, number, tmp_path, THEN if seed in SINCE else FIRST))
    assert line["outcome"] == "agrees", json.dumps(line, indent=1)


@pytest.mark.parametrize(("slope", "dark"), [(-0.06, False), (0.06, True)])
def test_a_tilted_sensor_that_turns_the_light_out_of_the_lens_states_so(slope: float, dark: bool) -> None:
    """A mirror tilted by a returns at the slopes t what an untilted one would at t + a."""
    sine, radius, focal = 0.03, 0.85e-3, 14e-3
    scene = scene_from_dict(
        {
            "schema": "tapetum/scene/1",
            "distance": 2.0,
            "illumination": {"mode": "collimated", "wavelength": 777e-9, "power": 1e-4, "diameter": 6e-3},
            "target": {
                "lens": {"kind": "thin", "focal_length": focal, "aperture_radius": radius},
                "object_distance": math.inf,
                "rotation": [math.asin(sine), 0.0],
                "sensor": {"reflectance": 0.2, "pitch": 8e-6, "pixels": [600, 600], "tilt": [slope, 0.0]},
            },
            "probe": {
                "lens": {"focal_length": 0.1, "aperture_radius": 2e-3},
                "sensor": {"pixels": [33, 33], "pitch": 2e-5},
            },
            "sampling": {"accuracy": 0.003, "propagation": "far field"},
        }
    )
    # By rays nothing returns at t + a = 0.09: r/f is 0.061.
    assert math.isinf(retroreflect(scene).metadata["expected_error"]) == dark


# Lenses out of focus, whose returning light a near probe cuts: radius, focal length, distance focused at, distance and
# radius of the probe's aperture in metres, tilt in degrees, half of the picture's angle.
@pytest.mark.parametrize(
    ("radius", "focal", "focused", "distance", "opening", "tilt", "angle"),
    [
        (0.5e-3, 3.4e-3, 0.131, 0.37, 2.4e-3, 4.6, 0.012),
        (0.924e-3, 7e-3, 0.328, 0.297, 0.314e-3, 4.8, 0.008),
        (0.7e-3, 7e-3, 0.106, 0.25, 2.7e-3, 0.0, 0.015),
        (0.5e-3, 5e-3, 0.077, 0.15, 2.3e-3, 0.0, 0.015),
    ],
)
def test_near_probes_state_what_fresnels_chirps_miss(
    radius: float, focal: float, focused: float, distance: float, opening: float, tilt: float, angle: float, validated
) -> None:
    pixels, turn = 21, math.radians(tilt)
    scene = scene_from_dict(
        {
            "schema": "tapetum/scene/1",
            "distance": distance,
            "illumination": {"mode": "collimated", "wavelength": 650e-9, "power": 1e-4, "diameter": 4 * radius},
            "target": {
                "lens": {"kind": "thin", "focal_length": focal, "aperture_radius": radius},
                "object_distance": focused,
                "rotation": [0.0, turn],
                "sensor": {"reflectance": 0.4, "pitch": 4e-6, "pixels": [2000, 2000]},
            },
            "probe": {
                "lens": {"focal_length": 0.1, "aperture_radius": opening},
                "sensor": {"pixels": [pixels, pixels], "pitch": 0.2 * angle / pixels},
            },
            "sampling": {"accuracy": 3e-4, "propagation": "finite"},
        }
    )
    image = retroreflect(scene)
    columns, rows = (one.ravel().astype(float) for one in np.meshgrid(*2 * [np.arange(pixels)]))
    places = pixel_places(columns, rows, scene.probe.sensor.pixels, scene.probe.sensor.pitch)
    want = judge(scene, places, True, Effort.of(1e-3)).reshape(pixels, pixels)
    error = float(np.abs(image.numpy()[0] - want).max() / want.max())
    stated = float(image.metadata["expected_error"])
    # Accuracies finer than the judge's scenes are drawn with: the engine stated 3e-4, and was off by 5 to 21 times it.
    what = f"r = {radius * 1e3:g} mm, probe of {opening * 1e3:g} mm at {distance:g} m, tilt {tilt:g}°"
    validated(SECTION, what, error / stated, 1.0, "sums over exact distances", "of the stated error")


def test_rims_that_nearly_coincide(validated) -> None:
    """A lens at full aperture, whose rims cut slivers off its pupil: without them the picture is off by 0.023."""
    scene = load_scene(
        "rotation",
        [
            *("sampling.accuracy=0.005", "second_beam=null", "target.sensor.array=null"),
            *("probe.sensor.pixels=[81, 81]", "target.rotation=[16.65 deg, -12.217 deg]"),
            # The judge moves the whole lens to focus, this one moves its last group.
            "target.object_distance=inf",
        ],
    )
    image = retroreflect(scene)
    found = image.numpy()[0]
    row, column = (one[:1] for one in np.unravel_index(np.argsort(found.ravel())[::-1], found.shape))
    place = pixel_places(column.astype(float), row.astype(float), (81, 81), scene.probe.sensor.pitch)
    seen = float(judge(scene, place, False, Effort())[0])
    what = "a traced lens at full aperture, 20° off its axis, brightest pixel"
    for picture, stated in ((found, float(image.metadata["expected_error"])), planned_for_many(scene)):
        error = abs(float(picture[row, column][0]) - seen) / seen
        validated(SECTION, what, error, stated, "the judge")


def test_faint_light_of_one_plane_interferes_with_another_s(tmp_path: Path, validated) -> None:
    """Of a tilted layer and the sensor: by each plane's own irradiance it was off by 0.0065 where 0.003 was stated.

    What is stated today would cover that as well: the test compares what interferes with the judge.
    """
    plain = draw(20270819, 72, tmp_path, THEN)[1]
    sensor = plain["target"]["sensor"]
    sensor["layers"] = sensor["layers"][:1]
    scene = scene_from_dict(plain)
    image = retroreflect(scene)
    rows, columns = np.array([7, 16]), np.array([5, 16])
    places = pixel_places(columns.astype(float), rows.astype(float), (33, 33), scene.probe.sensor.pitch)
    seen = judge(scene, places, False, Effort())
    what = "a tilted layer before a traced lens's sensor, two pixels"
    for picture, stated in ((image.numpy()[0], float(image.metadata["expected_error"])), planned_for_many(scene)):
        error = float(np.abs(picture[rows, columns] - seen).max() / picture.max())
        validated(SECTION, what, error, stated, "the judge")


def test_a_spot_beside_its_mask_is_too_far_for_the_judge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the mask returns, 6e-10 of what a mirror would, lies beyond the rings that the judge sums."""
    # The brightest pixel decides; the judge takes a second and a half for each.
    monkeypatch.setattr("references.compare._few", lambda found: np.array([found.argmax()]))
    line = compared(*draw(20270703, 74, tmp_path, THEN))
    assert line["outcome"] == "too large" and "rings do not reach" in line["message"]


@pytest.mark.slow
def test_a_sum_that_turns_is_not_believed(tmp_path: Path) -> None:
    """Near the turn two windows agreed on a pixel that the engine misses by 1.26 times what it states; wider ones do
    not."""
    line = compared(*draw(20270819, 20, tmp_path, THEN))
    assert line["outcome"] != "differs", json.dumps(line, indent=1)


@pytest.mark.parametrize(("growth", "outcome"), [(1.0, "differs"), (2.0, "too large")])
def test_light_where_the_judge_sees_none_differs_unless_the_judge_is_still_changing(
    growth: float, outcome: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[float] = []

    def dark(scene: object, places: np.ndarray, finite: bool, effort: object) -> np.ndarray:
        calls.append(1e-30 * growth ** len(calls))
        return np.full(len(places), calls[-1])

    monkeypatch.setattr("references.compare.judge", dark)
    assert compared(*draw(4, 1, tmp_path))["outcome"] == outcome


@pytest.mark.slow
def test_two_hundred_scenes(tmp_path: Path) -> None:
    lines, number = list[dict](), 0
    # A scene too large for the judge is drawn again.
    while sum(line["outcome"] != "too large" for line in lines) < SCENES:
        lines.append({"number": number, **compared(*draw(SEALED, number, tmp_path, THEN))})
        number += 1
    print(summary(lines))
    wrong = [line for line in lines if line["outcome"] == "differs"]
    assert not wrong, summary(lines)
    # What is refused or too large is no proof.
    assert sum(line["outcome"] == "agrees" for line in lines) >= SCENES / 2


def test_a_picture_of_a_slightly_other_scene_differs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kind, plain = draw(4, 19, tmp_path)

    def other(scene: object) -> object:
        turned = [1.05 * angle for angle in plain["target"]["rotation"]]
        return retroreflect(scene_from_dict({**plain, "target": {**plain["target"], "rotation": turned}}))

    assert compared(kind, plain)["outcome"] == "agrees"
    monkeypatch.setattr("references.compare.retroreflect", other)
    assert compared(kind, plain)["outcome"] == "differs"


def test_scenes_are_drawn_by_seed_and_number_alone(tmp_path: Path) -> None:
    first = [draw(5, number, tmp_path) for number in range(len(KINDS))]
    again = [draw(5, number, tmp_path) for number in reversed(range(len(KINDS)))][::-1]
    assert first == again
    assert [kind for kind, _ in first] == list(KINDS)
    assert len({json.dumps(plain) for _, plain in first}) == len(KINDS)
    # Numbers of older seeds stay the scenes that they were.
    assert draw(5, 24, tmp_path)[0] == "traced, mask" and draw(5, 24, tmp_path, FIRST)[0] == "mirror"
    assert draw(5, 25, tmp_path)[0] == "traced, near" and draw(5, 25, tmp_path, THEN)[0] == "mirror"
    assert draw(5, 26, tmp_path)[0] == "traced, far out" and draw(5, 26, tmp_path, LATER)[0] == "mirror"
