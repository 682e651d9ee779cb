"""A take: any frame alone, and everything in it where the truth says it is."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyarrow.compute as pc
import pytest
import torch

from tapetum.bench import Scene, load_scene, with_values
from tapetum.errors import InputError
from tapetum.record import Glint, HandMotion, ProbeShake
from tapetum.record.laser import BlinkCode, Exposure
from tapetum.record.noise import counts
from tapetum.record.patch import bell, moved
from tapetum.record.returns import returns_of
from tapetum.record.session import Placed, Session
from tapetum.record.shot import Shot
from tapetum.record.stray import Ground
from tapetum.simulate import Camera, tilt_of_gaze
from tapetum.simulate.phone import phone_scenes

SECTION = "The virtual bench"
BUSY = HandMotion(roll=0.05, reach=0.01)


@pytest.fixture(scope="module")
def small() -> Scene:
    changes = {"probe.sensor.pixels": [160, 120], "probe.sensor.pitch": 8e-6, "target.sensor.pixels": [324, 243]}
    changes["target.sensor.pitch"] = 17.6e-6
    # Larger pixels fill sooner.
    changes["probe.sensor.exposure"] = 1.5e-5
    return with_values(load_scene("hand-held"), changes)


def column(shot: Shot, name: str, stream: str = "probe", target: int = 0) -> np.ndarray:
    truth = shot.truth()
    chosen = (np.asarray(truth["stream"]) == stream) & (truth["target"].to_numpy() == target)
    return truth[name].to_numpy()[chosen]


def test_frames_do_not_depend_on_what_else_was_asked_for(small: Scene) -> None:
    # Eight frames are rendered together: two whole batches and one of a single frame.
    small = with_values(small, {"sampling.accuracy": 0.02, "target.lens.aperture_radius": 2e-3})
    session = Session(1.15, seed=7, motion=BUSY, power_jitter=0.01, exposure=Exposure(drift=0.1))
    whole = Shot(small, session)
    probe, target = whole.probe(0, 17), whole.target(0, 17)
    assert probe.shape == (17, 120, 160)
    assert target.shape == (17, 243, 324)
    for first, last in ((5, 10), (16, 17), (8, 16), (3, 3)):
        alone = Shot(small, session)
        assert np.array_equal(alone.probe(first, last), probe[first:last])
        assert np.array_equal(alone.target(first, last), target[first:last])
    backwards = Shot(small, session)
    assert all(np.array_equal(backwards.probe(i, i + 1)[0], probe[i]) for i in range(16, -1, -1))
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1 if threads > 1 else 2)
        assert np.array_equal(Shot(small, session).probe(0, 9), probe[:9])
    finally:
        torch.set_num_threads(threads)
    with pytest.raises(IndexError):
        whole.probe(13, 18)


def test_truth_and_parameters_hold_what_was_drawn(small: Scene) -> None:
    others = (Placed((0.02, -0.01), seed=9), Placed((-0.02, 0.0), distance=4.0, seed=10))
    session = Session(0.8, seed=7, motion=BUSY, code=BlinkCode(), power_jitter=0.02, others=others)
    shot = Shot(small, session)
    truth = shot.truth()
    assert len(truth) == 3 * len(shot.beats["probe"]) + len(shot.beats["target"])
    assert set(np.unique(truth["target"].to_numpy())) == {0, 1, 2}
    assert np.ptp(column(shot, "roll")) > 0
    assert np.std(column(shot, "distance")) == pytest.approx(0.01, rel=0.9)
    assert column(shot, "distance", target=2).mean() == pytest.approx(4.0, abs=0.1)
    assert column(shot, "x", target=1).mean() == pytest.approx(79.5 + 0.02 * 0.2 / 5.5 / 8e-6, abs=15)
    for name in truth.column_names[2:]:
        assert np.isfinite(truth[name].to_numpy()).all()
    assert json.loads(json.dumps(shot.parameters()))["others"][1]["distance"] == 4.0


def test_each_target_shines_at_its_place(small: Scene) -> None:
    still = HandMotion(extent=0.0, tremor=0.0, sway=0.0)
    other = Placed((0.012, -0.008), motion=still)
    alone, two = (
        Shot(small, Session(0.2, motion=still, others=o)).probe(0, 1)[0].astype(float) for o in ((), (other,))
    )
    extra = np.clip(two - alone - 20, 0, None)
    row, col = (float((extra.sum(axis=1 - k) * np.arange(extra.shape[k])).sum() / extra.sum()) for k in (0, 1))
    # 55 and -36 pixels from the middle, and the second beam's share beside.
    assert abs(col - (79.5 + 0.012 * 0.2 / 5.5 / 8e-6)) < 4
    assert abs(row - (59.5 - 0.008 * 0.2 / 5.5 / 8e-6)) < 4


def test_both_cameras_follow_the_blinks(small: Scene) -> None:
    code = BlinkCode(bit=0.2, word=(0, 1, 1, 0, 0, 1), start=0.4)
    still = HandMotion(extent=0.1, tremor=0.0, sway=1e-3)
    shot = Shot(small, Session(2.4, seed=2, motion=still, code=code))
    laser = column(shot, "laser")
    assert set(laser) == {0.0, 1.0}
    lit = shot.probe(0, len(laser)).reshape(len(laser), -1).max(axis=1) > 30
    assert np.array_equal(lit, laser > 0.5)
    gaze = np.stack([column(shot, n, "target") for n in ("x", "y")], -1)
    pictures, share = shot.target(0, len(gaze)), column(shot, "laser", "target")
    bright = [
        int(p[round(y) - 1 : round(y) + 2, round(x) - 1 : round(x) + 2].max())
        for p, (x, y) in zip(pictures, gaze, strict=True)
    ]
    certain = (share == 0) | (share == 1)
    assert certain.sum() > 25
    assert np.array_equal(np.array(bright)[certain] > 200, share[certain] == 1)


def test_a_code_repeats_and_averages_over_an_exposure() -> None:
    code = BlinkCode(bit=0.1, word=(0, 1, 0), start=1.0, every=0.5)
    times = np.array([0.5, 1.05, 1.15, 1.25, 1.45, 1.55, 1.65])
    assert code.share(times).tolist() == [1, 0, 1, 0, 1, 0, 1]
    assert code.share(times, 0.01) == pytest.approx(code.share(times))
    assert code.share(np.array([1.0, 1.1, 1.5]), 0.04) == pytest.approx([0.5, 0.5, 0.5])
    assert code.share(np.array([1.25]), 0.5) == pytest.approx([0.6])
    drawn = BlinkCode(seed=3).sent
    assert len(drawn) == 32
    assert drawn != BlinkCode(seed=4).sent
    for wrong in ({"bit": 0.0}, {"word": (1, 2)}, {"bit": 0.2, "word": (0, 1, 0), "every": 0.5}):
        with pytest.raises(InputError):
            BlinkCode(**wrong)


def test_a_walk_goes_from_one_distance_to_the_other() -> None:
    hand = HandMotion(walk=(5.0, 3.0), reach=0.01).draw(1, 5.5, 10.0)
    d = hand.distance(np.array([0.0, 5.0, 10.0]))
    assert d == pytest.approx([5.0, 4.0, 3.0], abs=0.04)
    assert HandMotion().draw(1, 5.5).distance(np.arange(3.0)) == pytest.approx([5.5] * 3)


def test_an_automatic_exposure_follows_the_light(small: Scene) -> None:
    small = with_values(small, {"target.lens.aperture_radius": 2e-3})
    walk = HandMotion(walk=(5.5, 2.75))
    plain, auto = (Shot(small, Session(2.0, motion=walk, exposure=Exposure(follow=f))) for f in (0.0, 1.0))
    assert set(column(plain, "exposure")) == {1.5e-5}
    assert column(auto, "exposure")[[0, -1]] == pytest.approx([1.5e-5, 1.5e-5 / 4], rel=0.01)


@pytest.mark.parametrize("mode", ["diverging", "fixed_area"])
def test_rrs_between_the_nodes_of_distance(small: Scene, validated, mode: str) -> None:
    light = {"illumination.mode": mode}
    if mode == "fixed_area":
        light |= {"illumination.divergence": None, "illumination.diameter": 0.05}
    scene = with_values(small, {**light, "sampling.accuracy": 0.003})
    rng = np.random.default_rng(5)
    gaze, distance, none = rng.uniform(-0.4, 0.4, (4, 2)), rng.uniform(3.0, 6.0, 4), np.zeros(4)
    (returns,) = returns_of(scene, gaze, np.zeros((4, 2)), none, distance)
    worst = 0.0
    for i in range(4):
        patch = returns.patches(i)[0]
        camera = Camera(replace(scene, distance=float(distance[i])), 0.03, output=returns._windows[1.0])
        # Even frames have their middle between pixels.
        middle = (np.array([159, 119]) - (np.array(patch.light.shape[::-1]) - 1)) / 2 - (patch.left, patch.top)
        centre = torch.from_numpy(middle * scene.probe.sensor.pitch)[None]
        tilt = tilt_of_gaze(scene, torch.from_numpy(gaze[i : i + 1]))
        exact = returns._electrons * camera.render(tilt, centre, equivalent=True)[0].numpy()
        worst = max(worst, float(np.abs(patch.light - exact).max() / exact.max()))
    what = f"RR at a random distance of 3 to 6 m from the nearest node, {mode.replace('_', ' ')} light"
    validated(SECTION, what, worst, 0.003, "a simulation at that very distance")


def test_a_roll_turns_the_rr(small: Scene, validated) -> None:
    # Turned light for a round target, a turned picture for pixels on a square grid: here they must agree.
    scene = with_values(small, {"sampling.accuracy": 1e-3, "probe.sensor.pitch": 4e-6})
    rng = np.random.default_rng(6)
    gaze, place, roll = rng.uniform(-0.3, 0.3, (3, 2)), rng.normal(0, 1e-3, (3, 2)), np.array([0.3, -0.2, 0.05])
    returns = [returns_of(scene, gaze, place, roll, np.full(3, 5.5))[0] for _ in range(2)]
    returns[1]._round = False
    worst = 0.0
    for i in range(3):
        for one, other in zip(*(each.patches(i) for each in returns), strict=True):
            assert (one.left, one.top) == (other.left, other.top)
            worst = max(worst, float(np.abs(one.light - other.light).max() / one.light.max()))
    validated(
        SECTION, "RR of a target turned by up to 0.3 rad, its picture turned by splines", worst, 3e-3, "turned light"
    )


def test_a_quarter_turn_of_square_pixels_turns_only_the_gaze(small: Scene) -> None:
    # Odd frames have a pixel in their middle: nothing is read between pixels. An odd square sensor has one, too.
    changes = {"probe.sensor.pixels": [161, 121], "illumination.second_beam": None}
    changes |= {"target.sensor.array": {"fill": 0.5}, "target.sensor.pixels": [401, 401], "target.sensor.pitch": 8e-6}
    scene = with_values(small, changes)
    gaze, straight = np.array([[0.2, 0.1]]), np.array([[-0.1, 0.2]])
    none, far = np.zeros((1, 2)), np.full(1, 5.5)
    turned = returns_of(scene, gaze, none, np.full(1, np.pi / 2), far)[0].patches(0)[0].light
    plain = returns_of(scene, straight, none, np.zeros(1), far)[0].patches(0)[0].light
    assert turned.shape == plain.shape
    assert np.abs(turned - plain).max() < 0.01 * plain.max()


def test_a_collimated_beam_needs_one_simulation(small: Scene) -> None:
    scene = with_values(small, {"illumination.mode": "collimated", "illumination.divergence": None})
    distance = np.array([4.0, 5.0, 6.0])
    (returns,) = returns_of(scene, np.full((3, 2), 0.1), np.full((3, 2), 1e-3), np.zeros(3), distance)
    patches = [returns.patches(i)[0] for i in range(3)]
    assert returns._camera_at.cache_info().currsize == len({grid.rows for grid in returns._windows.values()})
    assert patches[0].light.max() == pytest.approx(patches[2].light.max(), rel=0.05)
    assert returns.pixels[0, 0] - 79.5 == pytest.approx(1e-3 * 0.2 / 4.0 / 8e-6)


@pytest.mark.parametrize("mean", [0.3, 6.0, 40.0, 900.0])
def test_noise_is_that_of_the_sensor(small: Scene, mean: float) -> None:
    """Frames drawn fast against frames drawn by `simulate.expose`: the same distribution of numbers."""
    from scipy.stats import chi2_contingency

    from tapetum.simulate.exposure import digitise

    sensor = with_values(small, {"probe.sensor.bits": 12, "probe.sensor.offset": 3.0}).probe.sensor
    flat = np.full((500, 400), mean, np.float32)
    fast = counts(flat.copy(), sensor, np.random.default_rng(1))
    slow = digitise(torch.from_numpy(flat), sensor, np.random.default_rng(2))
    seen = [np.bincount(one.ravel(), minlength=4096) for one in (fast, slow)]
    often = seen[0] + seen[1] > 20
    table = [[*one[often], one[~often].sum() + 1] for one in seen]
    assert chi2_contingency(table).pvalue > 1e-3


def test_a_last_bit_of_light_changes_next_to_no_pixel(small: Scene) -> None:
    """Where noise is drawn by rejection it would shift that of all pixels that follow."""
    light = np.random.default_rng(1).uniform(0, 300, (480, 640)).astype(np.float32)
    a, b = (
        counts(one, small.probe.sensor, np.random.default_rng(2))
        for one in (light, np.nextafter(light, np.float32(1e9)))
    )
    assert (a != b).mean() < 1e-4


def test_hot_pixels_and_a_full_well_are_the_sensor_s(small: Scene) -> None:
    hot = with_values(small, {"probe.sensor.hot_pixels": 0.01, "probe.sensor.hot_current": 1e9})
    frame = counts(Ground.of(hot).lit(1.0), hot.probe.sensor, np.random.default_rng(1))
    assert 0.005 < (frame > 60).mean() < 0.02
    assert (counts(np.full((9, 9), 1e6, np.float32), small.probe.sensor, np.random.default_rng(1)) == 255).all()


def test_what_cannot_be_filmed_is_refused(small: Scene) -> None:
    with pytest.raises(InputError, match="seconds"):
        Shot(small, Session(0.01))
    with pytest.raises(InputError, match="motion"):
        Shot(small, Session(0.2, motion=HandMotion(walk=(0.2, 0.1)))).probe(0, 1)
    for wrong in (lambda: HandMotion(sway=-1.0), lambda: Session(seed=-1), lambda: Exposure(factor=0.0)):
        with pytest.raises(InputError):
            wrong()


def test_a_phones_cameras_look_where_their_axes_say(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[tuple[Scene, torch.Tensor, np.ndarray]] = []

    def returns(scene: Scene, tilts: torch.Tensor, place: np.ndarray, *_: np.ndarray) -> None:
        shown.append((scene, tilts, place))

    monkeypatch.setattr("tapetum.record.returns.Returns", returns)
    scene = with_values(load_scene("phones"), {"target.name": "phone-08"})
    gaze, none = np.array([[0.1, -0.05]]), np.zeros(1)
    returns_of(scene, gaze, np.zeros((1, 2)), none, np.full(1, 5.5))
    (_, gazing, at), *others = shown
    assert len(others) == 2 and not np.asarray(at).any()
    assert torch.allclose(gazing, tilt_of_gaze(scene, torch.from_numpy(gaze)))
    for one, tilts, place in others:
        (unit,) = (unit for unit in phone_scenes(scene) if unit.scene == one)
        assert np.hypot(*place[0]) > 5e-3
        assert unit.axis != (0.0, 0.0)
        # Light from the probe meets it under another angle too.
        assert torch.allclose(tilts, unit.sines(gazing, torch.from_numpy(place) / 5.5), atol=1e-12)
        assert not torch.allclose(tilts, unit.sines(gazing), atol=1e-3)
    # A roll turns the plate, so that each camera looks where it did.
    before = {id(one): tilts for one, tilts, _ in shown}
    shown.clear()
    returns_of(scene, gaze, np.zeros((1, 2)), np.full(1, 0.4), np.full(1, 5.5))
    assert len(shown) == len(before)
    for (_, tilts, _), earlier in zip(shown, before.values(), strict=True):
        torch.testing.assert_close(tilts, earlier, rtol=0, atol=1e-12)


def test_a_probe_in_the_hand_moves_all_that_it_sees() -> None:
    """Cameras and clutter move alike, by the probe's turn times its focal length; the gaze does not."""
    scene = load_scene("hand-held")
    still = HandMotion(extent=0.1, sway=0.0)
    clutter = (Glint((0.36, -0.3), 6000.0, parallax=0.0, sway=0.0, twinkle=0.0),)
    standing = Session(1.0, 15.0, 4, motion=still, clutter=clutter)
    pixels = 20.0
    rms = pixels * scene.probe.sensor.pitch / scene.probe.lens.focal_length
    held = replace(standing, shake=ProbeShake(rms))
    one, other = Shot(scene, standing), Shot(scene, held)
    tables = [shot.truth().filter(pc.equal(shot.truth()["stream"], "probe")) for shot in (one, other)]
    a, b = (np.stack([table[name].to_numpy() for name in ("x", "y")], 1) for table in tables)
    by = b - a
    assert np.std(by) == pytest.approx(pixels, rel=0.5)
    assert tables[0]["gaze_x"].equals(tables[1]["gaze_x"])
    frame = int(np.argmax(np.abs(by).sum(1)))
    size = np.array(scene.probe.sensor.pixels)
    glint = (size - 1) / 2 + np.array([0.36, -0.3]) * size

    def centroid(image: np.ndarray, near: np.ndarray) -> np.ndarray:
        x, y = np.rint(near).astype(int)
        part = image[y - 12 : y + 13, x - 12 : x + 13].astype(float)
        part = np.maximum(part - np.median(part) - 6, 0)
        rows, columns = np.indices(part.shape)
        return np.array([x - 12 + (part * columns).sum() / part.sum(), y - 12 + (part * rows).sum() / part.sum()])

    before = centroid(one.probe(frame, frame + 1)[0], glint)
    after = centroid(other.probe(frame, frame + 1)[0], glint + by[frame])
    assert after - before == pytest.approx(by[frame], abs=0.3)
    # Parts of pixels are moved too, and no light is lost.
    patch = bell((10.0, 12.0), 5.0, 2.0, 9)
    shifted = moved(patch, (3.25, -1.5))
    assert (shifted.left, shifted.top) == (patch.left + 3, patch.top - 2)
    assert shifted.light.sum() == pytest.approx(patch.light.sum(), rel=1e-6)
