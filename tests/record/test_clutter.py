"""Things that are no camera: where they are, what they follow, and how much light they bring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.record import HandMotion, Session
from tapetum.record.clutter import Glint, Lamp, Stage, Tape, draw_clutter
from tapetum.record.laser import BlinkCode
from tapetum.record.shot import Shot
from tapetum.record.stray import DimRoom, FixedPattern, Gradient, Ground, draw_stray
from tapetum.track import detect

STILL = HandMotion(extent=0.0, tremor=0.0, sway=0.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    # Room enough for the discs of lamps 30 m away.
    changes = {"probe.sensor.pixels": [320, 240], "probe.sensor.pitch": 4e-6, "probe.sensor.exposure": "60 us"}
    return with_values(load_scene("hand-held"), changes)


@pytest.fixture
def stage(scene: Scene) -> Stage:
    times = np.arange(0, 3, 1 / 15)
    return Stage(scene, times, HandMotion().draw(1).place(times))


def middle_of(light: np.ndarray) -> tuple[float, float]:
    rows, columns = np.indices(light.shape)
    return float((columns * light).sum() / light.sum()), float((rows * light).sum() / light.sum())


def width_of(light: np.ndarray) -> float:
    """Pixels above half of the highest, along the row through it."""
    row = light[np.unravel_index(light.argmax(), light.shape)[0]]
    return float((row > light.max() / 2).sum())


def test_a_glint_is_as_large_as_its_facet_and_moves_by_itself(stage: Stage) -> None:
    glint = Glint((0.1, -0.2), 1000.0, facet=2e-3, twinkle=0.0)
    paint = glint.prepare(stage, np.random.default_rng(1))
    patch = paint(3)
    spread, diffraction = 2e-3 * 0.2 / 5.5 / 4e-6, 640e-9 * 0.2 / 2e-3 / 4e-6
    assert width_of(patch.light) == pytest.approx(np.hypot(spread, diffraction), abs=2)
    assert patch.light.max() == pytest.approx(1000, rel=0.01)
    x = np.array([middle_of(paint(i).light)[0] + paint(i).left for i in range(45)])
    assert x.mean() == pytest.approx(159.5 + 32, abs=15)
    own = glint.parallax * stage.place[:, 0] * 0.2 / 5.5 / 4e-6
    assert np.std(x - own) > 3
    still = replace(glint, sway=0.0, parallax=1.0).prepare(stage, np.random.default_rng(1))
    x = np.array([middle_of(still(i).light)[0] + still(i).left for i in range(45)])
    assert x == pytest.approx(159.5 + 32 + stage.place[:, 0] * 0.2 / 5.5 / 4e-6, abs=0.05)
    bright = replace(glint, twinkle=1.0).prepare(stage, np.random.default_rng(1))
    heights = [float(bright(i).light.max()) for i in range(45)]
    assert max(heights) <= 1000
    assert min(heights) < 0.7 * max(heights)


def test_a_lamp_is_the_probe_s_blur_and_flickers(stage: Stage) -> None:
    paint = Lamp((0.0, 0.0), 500.0, size=0.05, distance=30.0, flicker=0.2).prepare(stage, np.random.default_rng(1))
    light = paint(0).light
    assert width_of(light) == pytest.approx(0.05 * 0.2 / 30 / 4e-6, abs=3)
    assert np.array(middle_of(light)) + paint(0)[:2] == pytest.approx([159.5, 119.5], abs=0.01)
    heights = np.array([paint(i).light.max() for i in range(45)])
    assert heights.max() / heights.min() > 1.2
    assert heights.mean() == pytest.approx(500, rel=0.1)


def test_tape_is_speckled_and_as_large_as_its_blurred_image(stage: Stage) -> None:
    tape = Tape((0.0, 0.0), 200.0, size=(0.05, 0.01), distance=25.0, sway=0.0)
    patch = tape.prepare(stage, np.random.default_rng(1))(0)
    across, down = (patch.light.mean(axis=k) for k in (0, 1))
    width, height = ((one > one.max() / 3).sum() for one in (across, down))
    # Tape of 100 x 20 pixels, blurred by 100.
    assert 100 < width < 190
    assert 60 < height < 130
    n = len(patch.light) // 2
    middle = patch.light[n - 15 : n + 15, n - 15 : n + 15]
    assert middle.mean() == pytest.approx(200, rel=0.25)
    # A grain of 2.6 µm on pixels of 4 µm: less contrast than 1, far more than shot noise.
    assert 0.25 < middle.std() / middle.mean() < 1


def test_only_what_the_laser_lights_blinks_with_it(scene: Scene) -> None:
    code = BlinkCode(bit=0.4, word=(0, 1), start=0.0)
    for piece in (Glint((0.3, 0.3), 2500.0, twinkle=0.0), Lamp((0.3, 0.3), 2500.0), Tape((0.3, 0.3), 800.0)):
        shot = Shot(scene, Session(0.8, seed=3, motion=STILL, code=code, clutter=(piece,)))
        frames = shot.probe(0, 12)[:, 160:, 210:].astype(float).mean(axis=(1, 2))
        on = np.array([t >= 0.4 for t in shot.beats["probe"].times])
        lit, dark = frames[on].mean(), frames[~on].mean()
        assert (lit > 1.5 * dark) == piece.of_laser, piece


def test_clutter_is_drawn_from_its_seed(scene: Scene) -> None:
    assert draw_clutter(scene, 4) == draw_clutter(scene, 4)
    assert draw_clutter(scene, 4, 5)[:3] == draw_clutter(scene, 4)
    assert draw_clutter(scene, 4) != draw_clutter(scene, 5)
    kinds = {type(one) for seed in range(9) for one in draw_clutter(scene, seed)}
    assert kinds == {Glint, Lamp, Tape}
    assert draw_stray(scene, 4) == draw_stray(scene, 4)
    session = Session(0.2, clutter=draw_clutter(scene, 4), stray=draw_stray(scene, 4))
    assert {one["kind"] for one in Shot(scene, session).parameters()["clutter"]} <= {"glint", "lamp", "tape"}


def test_stray_light_is_as_bright_as_it_says(scene: Scene) -> None:
    ramp = Ground.of(scene, (Gradient(50.0, 0.6),)).light - 40
    assert (ramp.min(), ramp.max()) == pytest.approx((0, 50), abs=1e-3)
    room = Ground.of(scene, (DimRoom(30.0),), seed=2).light - 40
    assert room.mean() == pytest.approx(30, rel=1e-3)
    # A disc of 330 pixels leaves nothing that changes within a few of them.
    assert np.abs(np.diff(room, axis=1)).max() < 0.03 * room.mean()
    far = Ground.of(scene, (DimRoom(30.0, distance=200.0),), seed=2).light
    assert np.abs(np.diff(far, axis=1)).max() > np.abs(np.diff(room, axis=1)).max()


def test_the_fixed_pattern_belongs_to_the_sensor(scene: Scene) -> None:
    pattern = FixedPattern(columns=2.0, rows=0.0, pixels=0.0, gain=0.02)
    same = [Ground.of(scene, (pattern,), seed=n).seen(np.full((240, 320), 100.0, np.float32)) for n in (1, 2)]
    assert np.array_equal(*same)
    assert same[0].mean(axis=0).std() == pytest.approx(2, rel=0.15)
    assert (same[0] - same[0].mean(axis=0)).std() == pytest.approx(2, rel=0.1)
    other = with_values(scene, {"probe.sensor.serial": 1})
    assert not np.array_equal(Ground.of(other, (pattern,)).seen(np.full((240, 320), 100.0, np.float32)), same[0])


def test_a_target_is_still_found_among_clutter(scene: Scene) -> None:
    """A hand-held take in a dim room, with a lamp and tape in the corners: a spot is found at the RR."""
    clutter = (Lamp((-0.4, -0.4), 4000.0, size=0.02, distance=60.0), Tape((0.4, 0.4), 60.0, distance=60.0))
    session = Session(
        0.6, seed=2, motion=HandMotion(roll=0.02, reach=0.01), stray=draw_stray(scene, 1), clutter=clutter
    )
    shot = Shot(scene, session)
    truth = shot.truth()
    for i, frame in enumerate(shot.probe(0, 5)):
        found = detect(frame)
        off = np.hypot(found.x - truth["x"][i].as_py(), found.y - truth["y"][i].as_py())
        assert off.min() < 15


def test_clutter_without_size_or_light_is_refused() -> None:
    for wrong in (
        lambda: Glint((0, 0), -1.0),
        lambda: Lamp((0, 0), 1.0, distance=0.0),
        lambda: Tape((0, 0), 1.0, size=(0.0, 1.0)),
        lambda: Gradient(float("nan")),
        lambda: DimRoom(1.0, distance=-1.0),
        lambda: FixedPattern(gain=-1.0),
    ):
        with pytest.raises(InputError):
            wrong()
