"""The pointer: its filter, its calibration, the guide through it."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tapetum.errors import InputError
from tapetum.live.euro import OneEuro
from tapetum.live.guide import MARKS, Guide
from tapetum.live.pointer import Calibration, Fix, Pointer, Screen, fit
from tapetum.live.state import CameraState

SCREEN = Screen(1920, 1080, across=0.6, distance=1.0)
# A camera that is rolled by a few degrees and turns off the screen's axis.
TRUE = np.array([[-2500.0, 180.0, 900.0], [-120.0, -2300.0, 600.0], [0.15, -0.1, 1.0]])


def gaze_of(x: float, y: float) -> tuple[float, float]:
    at = np.linalg.solve(TRUE, [x, y, 1.0])
    return float(at[0] / at[2]), float(at[1] / at[2])


def camera(x: float, y: float, half: float = 0.004, **said: Any) -> CameraState:
    told = {"gaze_x": (x, x - half, x + half), "gaze_y": (y, y - half, y + half), **said}
    return CameraState("a", 1, 50, 40, 5, True, 0, 0, **told)


def fixes(marks: int, rng: np.random.Generator, noise: float = 0.0) -> list[Fix]:
    made = []
    for x, y in MARKS[marks]:
        place = x * SCREEN.width, y * SCREEN.height
        gaze = np.add(gaze_of(*place), rng.normal(0, noise, 2))
        made.append(Fix(*place, float(gaze[0]), float(gaze[1]), noise))
    return made


def test_the_filter_of_a_still_cutoff_is_the_exponential_of_the_paper() -> None:
    one = OneEuro(min_cutoff=2.0)
    said = [one.update(0.0 if k == 0 else 1.0, k / 50) for k in range(30)]
    # Eq. (1) to (3): alpha = 1 / (1 + tau / Te), tau = 1 / (2 pi fc), x_k = alpha X_k + (1 - alpha) x_(k-1).
    alpha = 1 / (1 + 50 / (2 * math.pi * 2.0))
    assert said == pytest.approx([1 - (1 - alpha) ** k for k in range(30)])


def test_the_filter_opens_with_speed_by_the_paper_s_formula() -> None:
    one, step = OneEuro(1.0, 0.5, 3.0), 0.1
    assert one.update(0.0, 0.0) == 0.0
    share = 1 / (1 + 1 / (2 * math.pi * 3.0 * step))
    cutoff = 1.0 + 0.5 * abs(share * 2.0 / step)
    assert one.update(2.0, step) == pytest.approx(2.0 / (1 + 1 / (2 * math.pi * cutoff * step)))
    assert one.update(9.0, step) == one.update(9.0, 0.0), "a value that is not later changes nothing"
    assert one.update(7.0, 5.0) == 7.0, "after a gap the filter begins again"
    with pytest.raises(InputError, match="min_cutoff: must be positive, is 0"):
        OneEuro(0)


def test_nine_marks_give_the_projective_map_back_and_four_an_affine_one() -> None:
    rng = np.random.default_rng(1)
    nine = fit(SCREEN, fixes(9, rng))
    assert nine.error == pytest.approx(0, abs=0.01)
    assert nine.point(*gaze_of(700, 300)) == pytest.approx((700, 300), abs=0.01)
    assert nine.gaze(700, 300) == pytest.approx(gaze_of(700, 300), abs=1e-7)
    four = fit(SCREEN, fixes(4, rng))
    assert four.matrix[2] == pytest.approx((0, 0, 1)) and four.error is not None and 1 < four.error < 200
    assert four.degrees == pytest.approx(math.degrees(math.atan(four.error * 0.6 / 1920)))
    assert fit(Screen(1920, 1080), fixes(9, rng)).degrees is None


def test_the_leave_one_out_error_is_that_of_new_points() -> None:
    rng = np.random.default_rng(2)
    stated, met = [], []
    for _ in range(12):
        made = fit(SCREEN, fixes(9, rng, 0.004))
        assert made.error is not None
        stated.append(made.error)
        places = rng.uniform((192, 108), (1728, 972), (20, 2))
        said = [made.point(*np.add(gaze_of(x, y), rng.normal(0, 0.004, 2))) for x, y in places]
        met += [math.dist(one or (math.inf, 0), place) for one, place in zip(said, places, strict=True)]
    # Inner points are easier than left out corners: it is a bound, and not a far one.
    assert 1.0 < np.mean(stated) / math.sqrt(np.mean(np.square(met))) < 2.0


def test_one_mark_that_was_not_looked_at_bends_the_map_little_and_shows() -> None:
    made = fixes(9, np.random.default_rng(3), 0.001)
    wrong = made[4]
    made[4] = Fix(wrong.x, wrong.y, wrong.gaze_x + 0.2, wrong.gaze_y, 0.001)
    found = fit(SCREEN, made)
    at = found.point(*gaze_of(1300, 700))
    assert at is not None and math.dist(at, (1300, 700)) < 60, "least squares would be 55 to 100 off"
    assert max(found.fixes, key=lambda one: one.error or 0) == found.fixes[4]


@pytest.mark.parametrize("points", [[(0.0, 0.0)] * 4, [(0.1 * k, 0.05 * k) for k in range(4)], [(0, 0), (0.1, 0)]])
def test_gazes_that_fix_no_map_are_refused(points: list[tuple[float, float]]) -> None:
    marks = [(0, 0), (1000, 0), (1000, 900), (0, 900)]
    made = [Fix(*mark, *gaze, 0.001) for mark, gaze in zip(marks, points, strict=False)]
    with pytest.raises(InputError, match=r"calibration: .*;"):
        fit(SCREEN, made)


@pytest.mark.parametrize("marks", [4, 9])
def test_marks_that_contradict_one_another_are_refused(marks: int) -> None:
    """As where somebody looked at other places than those shown."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        made = fixes(marks, rng, 0.002)
        gazes = rng.uniform(-0.3, 0.3, (marks, 2)).tolist()
        wander = [replace(one, gaze_x=x, gaze_y=y) for one, (x, y) in zip(made, gazes, strict=True)]
        with pytest.raises(InputError, match=r"contradict one another: each lies some \d+ pixels"):
            fit(SCREEN, wander)


def person(
    guide: Guide, rng: np.random.Generator, *, rate: float = 20.0, noise: float = 0.003, reach: float = 1.0
) -> float:
    """Somebody who reaches each new mark in `reach` s, trembles a little, and is missed in every tenth frame."""
    time, mark, since, before = 0.0, (0.5, 0.5), 0.0, (0.5, 0.5)
    at = gaze_of(960, 540)
    while not guide.done and time < 60:
        share = min(1.0, (time - since) / reach)
        share = share * share * (3 - 2 * share)
        x, y = (a + share * (b - a) for a, b in zip(before, mark, strict=True))
        at = np.add(gaze_of(x * SCREEN.width, y * SCREEN.height), rng.normal(0, noise, 2))
        step = guide.update(None if rng.random() < 0.1 else camera(float(at[0]), float(at[1])), time)
        if step.mark is not None and step.mark != mark:
            before, mark, since = mark, step.mark, time
        time += 1 / rate
    return time


@pytest.mark.parametrize(("marks", "longest"), [(9, 30.0), (4, 14.0)])
def test_a_guided_calibration_of_somebody_who_trembles(marks: int, longest: float) -> None:
    rng = np.random.default_rng(4)
    guide = Guide(SCREEN, marks)
    assert person(guide, rng) < longest
    made = guide.result(7)
    for one in made.fixes:
        assert math.dist((one.gaze_x, one.gaze_y), gaze_of(one.x, one.y)) < 0.006, "a sample was taken on the way"
    assert made.utc_ns == 7 and made.error is not None and (marks == 4 or made.error < 25)


def test_a_slow_watch_calibrates_too() -> None:
    """At four frames a second no 0.8 s hold six samples: the window grows."""
    guide = Guide(SCREEN, 4)
    assert person(guide, np.random.default_rng(6), rate=4.0) < 40
    for one in guide.result().fixes:
        assert math.dist((one.gaze_x, one.gaze_y), gaze_of(one.x, one.y)) < 0.01


def test_nine_marks_take_a_slow_watch_twenty_seconds() -> None:
    """Once the gaze at a mark is known well enough, no more frames are waited for."""
    took, met = [], []
    for seed in range(15):
        guide = Guide(SCREEN, 9)
        took.append(person(guide, np.random.default_rng([seed, 7]), rate=4.0, reach=0.6))
        made = guide.result()
        assert made.error is not None and made.error < 40
        for x, y in ((400, 300), (1500, 800), (960, 540)):
            at = made.point(*gaze_of(x, y))
            met.append(math.dist(at or (math.inf, 0), (x, y)))
    assert np.quantile(took, 0.8) <= 20
    assert math.sqrt(np.mean(np.square(met))) < 10


def test_one_mark_corrects_a_shift_within_twenty_seconds() -> None:
    before = fit(SCREEN, fixes(9, np.random.default_rng(5)))
    guide = Guide(SCREEN, 1, before)
    seconds = 0.0
    while not guide.done and seconds < 20:
        x, y = gaze_of(960, 540)
        guide.update(camera(x + 0.05, y - 0.03), seconds)
        seconds += 0.05
    assert seconds < 3
    after = guide.result()
    x, y = gaze_of(600, 800)
    assert after.point(x + 0.05, y - 0.03) == pytest.approx((600, 800), abs=0.5)
    assert after.gaze(600, 800) == pytest.approx((x + 0.05, y - 0.03))


def test_a_gaze_that_moves_or_stays_at_the_mark_before_is_not_taken() -> None:
    guide = Guide(SCREEN, 4)
    moving = [guide.update(camera(0.1 * math.sin(k / 10), 0.0), k / 20).say for k in range(200)]
    assert not guide.fixes and "hold still" in moving
    slow = [guide.update(camera(0.02 * (k / 20), 0.0, 0.001), 10 + k / 20).say for k in range(100)]
    assert not guide.fixes and "hold still" in slow, "a slow drift is a movement too"
    still = [guide.update(camera(0.1, 0.1), 20 + k / 20).say for k in range(200)]
    assert len(guide.fixes) == 1 and still.count("next") == 1
    assert guide.update(camera(0.1, 0.1, gaze_x=None), 31).say == "no gaze"
    assert guide.update(None, 32).say == "no camera"
    with pytest.raises(InputError, match="1 of 4 marks"):
        guide.result()


def test_a_calibration_is_kept_and_a_damaged_one_refused(tmp_path: Path) -> None:
    path = tmp_path / "pointer.json"
    made = fit(SCREEN, fixes(9, np.random.default_rng(6), 0.001), 5).shifted(Fix(960, 540, 0.1, 0.1))
    made.save(path)
    assert Calibration.load(path) == made
    content = json.loads(path.read_text())
    for change, said in (
        ({"schema": "tapetum/pointer/2"}, "schema"),
        ({"matrix": [[1, 2], [3, 4]]}, "matrix"),
        ({"matrix": [[1, 2, 3], [2, 4, 6], [0, 0, 1]]}, "matrix"),
        ({"screen": {"width": -3, "height": 4}}, "screen.width"),
    ):
        path.write_text(json.dumps(content | change))
        with pytest.raises(InputError, match=said):
            Calibration.load(path)
    with pytest.raises(InputError, match="calibrate again"):
        Calibration.load(tmp_path / "none.json")


def test_the_pointer_trembles_less_than_the_gaze_and_follows_it() -> None:
    rng = np.random.default_rng(7)
    pointer = Pointer(fit(SCREEN, fixes(9, rng)))
    goal = [(500.0, 500.0) if k < 100 else (1400.0, 600.0) for k in range(200)]
    said = []
    for k, place in enumerate(goal):
        x, y = np.add(gaze_of(*place), rng.normal(0, 0.003, 2))
        at = pointer.update(camera(float(x), float(y)), k / 25)
        assert at is not None and at.inside and at.half_x == pytest.approx(0.004 * 2500, rel=0.3)
        said.append((at.x, at.y))
    still = np.std(np.array(said)[40:100], axis=0)
    assert (still < 0.5 * 0.003 * 2400).all(), f"{still} px of tremble"
    assert math.dist(said[110], goal[110]) < 0.1 * 900, "a jump is followed within 0.4 s"
    assert pointer.update(camera(0, 0, gaze_y=None), 9.0) is None
