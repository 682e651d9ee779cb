"""The fit by simulation reaches the bound, tells the sign, says how sure it is, and refuses what it cannot fit."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import pytest
import torch

from tapetum.bench import Scene, draw_unit, load_scene, with_values
from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models.simulation.counts import CountModel
from tapetum.models.simulation.finer import apart
from tapetum.models.simulation.fit import SimulationFit
from tapetum.models.simulation.maxima import climbed, top_near
from tapetum.models.simulation.noise import Noise
from tapetum.models.simulation.pictures import Pictures, Pose, period_of
from tapetum.models.simulation.result import SimulationFitResult
from tapetum.models.simulation.search import Search, Top
from tapetum.progress import quiet
from tapetum.simulate import expose, retroreflect
from tapetum.simulate.exposure import count_moments, digitise
from tapetum.simulate.gaze import tilt_of_gaze
from tapetum.simulate.information import fisher
from tapetum.simulate.radiometry import dark_electrons

NUISANCES = ("power", "place_x", "place_y")


@pytest.fixture(scope="module")
def scene() -> Scene:
    """The demo's scene with a smaller sensor."""
    return load_scene("hand-held", ["probe.sensor.pixels=[160, 160]"])


@pytest.fixture(scope="module")
def model(scene: Scene) -> SimulationFit:
    fit = SimulationFit(scene, nodes=13, starts=2, window=128)
    fit._prepared(128, quiet)
    return fit


def filmed(scene: Scene, gazes: np.ndarray, seed: int, side: int = 150, roll: float = 0.0) -> np.ndarray:
    """Crops [N, side, side] of some gazes, each moved a little, with the sensor's noise."""
    rng = np.random.default_rng(seed)
    pictures = Pictures(scene, side)
    frames = []
    for gaze in gazes:
        place = tuple(float(one) for one in rng.uniform(-6e-6, 6e-6, 2))
        power = scene.illumination.power * rng.uniform(0.95, 1.05)
        pose = dataclasses.replace(pictures.start(), place=place, roll=roll)
        light = pictures.render(pose, gaze[None])[0] * power / scene.illumination.power
        mean = torch.from_numpy(light + dark_electrons(scene.probe.sensor))
        frames.append(digitise(mean, scene.probe.sensor, rng))
    return np.stack(frames)


def test_reaches_the_bound_and_knows_how_sure_it_is(scene: Scene, model: SimulationFit):
    # In the centre half of the field.
    gazes = np.random.default_rng(3).uniform(-0.25, 0.25, (18, 2))
    one_start = SimulationFit(scene, nodes=13, starts=1, window=128)
    one_start._pictures = model._pictures
    found = one_start.predict(filmed(scene, gazes, 4))
    errors = found.value - gazes
    bounds = []
    for gaze in gazes[:2]:
        tilt = torch.asin(tilt_of_gaze(scene, torch.from_numpy(gaze)))
        turned = dataclasses.replace(scene.target, rotation=(float(tilt[0]), float(tilt[1])))
        at = dataclasses.replace(scene, target=turned)
        limits = fisher(at, ("gaze_x", "gaze_y", *NUISANCES)).bounds
        bounds.append([limits["gaze_x"], limits["gaze_y"]])
        # The model's own bound is that of `fisher`, but for what its window cuts off.
        own = model.bounds((float(gaze[0]), float(gaze[1])))
        np.testing.assert_allclose([own["gaze_x"], own["gaze_y"]], bounds[-1], rtol=0.25)
    ratio = np.sqrt((errors**2).mean()) / np.sqrt(np.mean(np.square(bounds)))
    assert ratio < 1.5
    covered = ((found.lower <= gazes) & (gazes <= found.upper)).mean()
    assert 0.8 <= covered <= 0.97


def test_shared_noise_is_divided_by_as_its_whole_matrix():
    rng = np.random.default_rng(5)
    slope, variance = rng.uniform(0, 0.1, (4, 6)), rng.uniform(0.2, 2, 24)
    slope[1, 2] = 0  # saturated
    whole = np.diag(variance)
    for axis, deviation, count in ((1, 3.0, 6), (0, 2.0, 4)):
        for number in range(count):
            line = np.where(np.indices(slope.shape)[axis] == number, slope, 0).ravel() * deviation
            whole += np.outer(line, line)
    noise = Noise(slope, variance, (3.0, 2.0))
    one, other = rng.standard_normal((2, 24)), rng.standard_normal((3, 24))
    np.testing.assert_allclose(noise(one, other), one @ np.linalg.solve(whole, other.T), rtol=1e-9)
    assert noise.log_determinant == pytest.approx(np.linalg.slogdet(whole)[1])
    np.testing.assert_allclose(Noise(slope, variance, (0.0, 0.0))(one, other), (one / variance) @ other.T)


@pytest.mark.slow
def test_columns_and_rows_with_offsets_are_taken_into_account(scene: Scene):
    gazes = np.random.default_rng(3).uniform(-0.25, 0.25, (24, 2))
    rng, pictures = np.random.default_rng(1), Pictures(scene, 150)
    frames = []
    for gaze in gazes:
        light = pictures.render(pictures.start(), gaze[None])[0] + dark_electrons(scene.probe.sensor)
        light = light + 9 * rng.standard_normal(150) + 3 * rng.standard_normal(150)[:, None]
        frames.append(digitise(torch.from_numpy(light).clamp_min(0), scene.probe.sensor, rng))
    told = {}
    for offsets in ((0.0, 0.0), (9.0, 3.0)):
        fit = SimulationFit(
            scene, nuisances=(*NUISANCES, "background"), nodes=13, starts=1, window=128, offsets=offsets
        )
        # `predict` refuses frames with so much more than their noise.
        found = [fit.fit_image(frame) for frame in frames]
        held = np.mean([(one.lower <= gaze) & (gaze <= one.upper) for one, gaze in zip(found, gazes, strict=True)])
        told[offsets] = (
            np.sqrt(np.mean([(one.values - gaze) ** 2 for one, gaze in zip(found, gazes, strict=True)])),
            held,
        )
    (blind, few), (aware, many) = told.values()
    # Given them it errs less and says how much; without them it is too sure.
    assert aware < 0.95 * blind and few < 0.8 and 0.82 <= many <= 0.97


def test_shows_how_far_it_is_one_bar_after_the_other(scene: Scene):
    told: list[str] = []
    inside = 0

    def shown(items, what, *, total=None):
        nonlocal inside
        assert inside == 0, "a bar within a bar"
        told.append(f"{what}: {total}")
        inside += 1
        yield from items
        inside -= 1

    # Near nodes of the bank, where the first start explains a frame.
    frames = filmed(scene, np.array([[0.23, 0.01], [-0.01, 0.23]]), 5)
    small = SimulationFit(scene, nodes=5, starts=1, window=128)
    found = small.predict(frames, progress=shown)
    assert told[-1] == "fitting: 2"
    assert len(told) == 2
    np.testing.assert_array_equal(found.value, small.predict(frames).value)
    assert len(small.predict(frames[:0])) == 0


def test_tells_a_gaze_from_its_opposite(scene: Scene, model: SimulationFit):
    for gaze in ([0.21, -0.13], [-0.21, 0.13]):
        result = model.fit_image(filmed(scene, np.array([gaze]), 6)[0])
        np.testing.assert_allclose(result.values, gaze, atol=1e-3)
        rivals = [mode for mode in result.modes if np.abs(mode.values - result.values).max() > 0.01]
        assert rivals and all(mode.log_likelihood < result.log_likelihood - 100 for mode in rivals)
        assert result.converged and result.misfit == pytest.approx(1, abs=0.05)


def test_looks_farther_where_no_start_explains_the_image(
    scene: Scene, model: SimulationFit, monkeypatch: pytest.MonkeyPatch
):
    # As fine as banks become.
    monkeypatch.setattr("tapetum.models.simulation.fit._NODES", 13)
    gaze = np.array([0.21, -0.13])
    frame = filmed(scene, gaze[None], 6)[0]
    one = SimulationFit(scene, nodes=13, starts=1, window=128)
    one._pictures = model._pictures
    assert one.fit_image(frame).starts == 1
    bank = model._pictures[128][1]
    best = bank.match

    def worst_first(*given: object) -> list[Pose]:
        return best(*given)[::-1]  # type: ignore[arg-type]

    monkeypatch.setattr(bank, "match", worst_first)
    found = one.fit_image(frame)
    assert 1 < found.starts <= 5
    assert found.misfit == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(found.values, gaze, atol=1e-3)
    # An image that this scene cannot explain is not climbed for ever, and the misfit says so.
    stray = np.random.default_rng(1).integers(0, 200, frame.shape).astype(frame.dtype)
    found = one.fit_image(stray)
    assert found.starts <= 5
    assert found.misfit > 1.3


def test_looks_between_the_nodes_where_no_start_explains_the_image(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    gaze = np.array([0.096, 0.207])
    frame = filmed(scene, gaze[None], 2)[0]
    monkeypatch.setattr("tapetum.models.simulation.fit._NODES", 3)
    coarse = SimulationFit(scene, nodes=3, starts=1, window=128)
    assert coarse.fit_image(frame).misfit > 1.3
    monkeypatch.setattr("tapetum.models.simulation.fit._NODES", 5)
    found = coarse.fit_image(frame)
    assert found.misfit == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(found.values, gaze, atol=1e-3)


class Scripted:
    """A search whose climbs end as told, and which says where they began and in how many steps."""

    def __init__(self, pictures: Pictures, *misfits: float) -> None:
        self.pictures, self.misfits, self.begun = pictures, list(misfits), list[tuple[tuple[float, float], int]]()

    def in_phase(self, pose: Pose) -> Pose:
        return pose

    def climb(self, pose: Pose, *, phase: bool, slow: np.ndarray | None = None, steps: int = 25) -> Top:
        self.begun.append((pose.gaze, steps))
        misfit = self.misfits.pop(0)
        return Top(pose, np.array([0.01, 0.02]), (), np.eye(1), -1e4 * misfit, misfit, steps == 25)


def test_a_phase_that_settled_wrong_is_sought_again_where_the_search_ended(model: SimulationFit):
    pictures = Pictures(model.scene, 32)
    pictures.period = np.array([1e-3, 1e-3])
    pose = dataclasses.replace(pictures.start(), gaze=(0.1, 0.2))
    search = Scripted(pictures, 2.9, 1.0, 1.0)
    assert top_near(search, pose).misfit == 1.0  # type: ignore[arg-type]
    assert search.begun[1:] == [(pytest.approx((0.11, 0.22)), 25), (pytest.approx((0.12, 0.24)), 25)]
    # Of a maximum that explains the image well, once at the end.
    search = Scripted(pictures, 1.02, 1.0, 1.0)
    assert climbed(search, [pose])[0].misfit == 1.0  # type: ignore[arg-type]
    # Worse than before: the first one stays.
    assert top_near(Scripted(pictures, 2.9, 3.0), pose).misfit == 2.9  # type: ignore[arg-type]
    pictures.period = None
    assert top_near(Scripted(pictures, 2.9, 1.0), pose).misfit == 2.9  # type: ignore[arg-type]


def test_what_is_estimated_moves_by_whole_periods_for_nothing(scene: Scene):
    names = ("gaze_x", "gaze_y", "phase_x", "phase_y", "power")
    information = np.diag([1e4, 1e4, 1e12, 1e12, 1.0])
    pose, period = Pictures(scene, 32).start(), np.array([1e-3, 2e-3])

    def top(gaze: tuple[float, float], slow: tuple[float, float]) -> Top:
        return Top(dataclasses.replace(pose, gaze=gaze), np.array(slow), names, information, 0.0, 1.0, True)

    one, other = top((0.1, 0.2), (1e-4, 0.0)), top((0.101 + 2e-6, 0.196), (-4e-4, 5e-4))
    # The slow gaze is what is estimated where the photosites' place is unknown.
    moved, deviations = apart(one, other, ("gaze_x", "gaze_y"), None)
    np.testing.assert_allclose(moved, [5.02e-4, 3.5e-3], rtol=1e-6)
    np.testing.assert_allclose(deviations, 1e-2)
    moved, deviations = apart(one, other, ("gaze_x", "gaze_y"), period)
    np.testing.assert_allclose(moved, [2e-6, 0.0], atol=1e-12)
    np.testing.assert_allclose(deviations, 1e-6)


@pytest.mark.parametrize(
    ("best", "first", "ends"), [(1.5, 1.9, 1.0), (1.5, 5.9, 1.0), (1.5, 6.1, 6.1), (1.2, 1.9, 1.9), (20.0, 30.0, 30.0)]
)
def test_no_start_is_dropped_early_for_little_while_none_explains_the_image(
    model: SimulationFit, best: float, first: float, ends: float
):
    pictures = Pictures(model.scene, 32)
    pose = pictures.start()
    other = Scripted(pictures, best).climb(pose, phase=False)
    assert top_near(Scripted(pictures, first, 1.0), pose, [other]).misfit == ends  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "number"), [(211, 2), (214, 12), (216, 1), (242, 2), (250, 18)])
def test_frames_of_a_traced_lens_that_were_read_at_a_wrong_maximum(seed: int, number: int):
    """Between the nodes, at a wrong phase, dropped too early, believed too soon, and by pictures too coarse."""
    scene = draw_unit(load_scene("rotation"), None, seed)
    gaze = np.random.default_rng([seed, 0xF1]).uniform(-0.35, 0.35, (24, 2))[number]
    tilts = torch.rad2deg(torch.asin(tilt_of_gaze(scene, torch.from_numpy(gaze[None]))))
    frame = expose(retroreflect(scene, tilts, accuracy=scene.sampling.accuracy / 10), scene.probe, seed=seed)[0]
    model = SimulationFit(scene, nuisances=(*NUISANCES, "phase_x", "phase_y"))
    found = model.fit_image(frame)
    assert found.misfit < 1.05
    np.testing.assert_allclose(found.values, gaze, atol=1e-3)


class Erring(Pictures):
    """Pictures whose error moves the gaze along x, by the more the coarser they are."""

    made: ClassVar[list[float]] = []

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.made.append(self.error)

    @property
    def error(self) -> float:
        return self.scene.sampling.accuracy if self._accuracy is None else self._accuracy

    def render_each(self, poses: Sequence[Pose]) -> np.ndarray:
        made = super().render_each(poses)
        aside = [dataclasses.replace(pose, gaze=(pose.gaze[0] + 0.005, pose.gaze[1])) for pose in poses]
        return made + self.error * (super().render_each(aside) - made)


class Refusing(Erring):
    """The same behind a lens of which no pictures are to be had with an error below a hundredth."""

    def render_each(self, poses: Sequence[Pose]) -> np.ndarray:
        if self.error < 0.01:
            raise InputError("light does not come back the way it went")
        return super().render_each(poses)


def take(monkeypatch: pytest.MonkeyPatch, pictures: type[Pictures]) -> None:
    """Search with these pictures, the finer ones, too."""
    for module in ("fit", "finer"):
        monkeypatch.setattr(f"tapetum.models.simulation.{module}.Pictures", pictures)


class Telling(Erring):
    """Pictures whose error shows the gaze, by the more the coarser they are."""

    def render_each(self, poses: Sequence[Pose]) -> np.ndarray:
        made = Pictures.render_each(self, poses)
        gazes = np.array([pose.gaze[0] for pose in poses])[:, None, None]
        return made + 300 * self.error * gazes * made[:, :, ::-1]


def test_an_error_that_shows_the_gaze_does_not_count_in_bounds(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    coarse = dataclasses.replace(scene, sampling=dataclasses.replace(scene.sampling, accuracy=0.1))

    def bound(accuracy: float | None = None) -> float:
        return SimulationFit(coarse, nodes=2, window=64, accuracy=accuracy).bounds((0.05, 0.1))["gaze_x"]

    true = bound()
    take(monkeypatch, Telling)
    assert bound(0.1) < 0.7 * true
    assert bound() == pytest.approx(true, rel=0.06)


def test_pictures_become_finer_until_their_error_moves_no_estimate(scene: Scene, monkeypatch: pytest.MonkeyPatch):
    coarse = dataclasses.replace(scene, sampling=dataclasses.replace(scene.sampling, accuracy=0.1))
    gaze = np.array([0.21, -0.13])
    frame = filmed(scene, gaze[None], 6)[0]

    def read(pictures: type[Pictures], accuracy: float | None = None) -> tuple[SimulationFitResult, float]:
        """A reading, and by how many standard deviations it lies aside of that by pictures without error."""
        take(monkeypatch, pictures)
        found = SimulationFit(coarse, nodes=5, starts=1, window=64, accuracy=accuracy).fit_image(frame)
        return found, float(found.values[0] - true.values[0]) / math.sqrt(true.covariance[0, 0])

    take(monkeypatch, Pictures)
    true = SimulationFit(scene, nodes=5, starts=1, window=64).fit_image(frame)
    _, aside = read(Erring, 0.1)
    assert aside < -5
    Erring.made.clear()
    found, aside = read(Erring)
    assert abs(aside) < 0.3
    assert found.covariance[0, 0] == pytest.approx(true.covariance[0, 0], rel=0.1)
    # The last ones are there to see that nothing moves any more.
    assert Erring.made == pytest.approx([0.1, 0.1 / 3, 0.1 / 9, 0.1 / 27, 0.1 / 81])
    # Where no finer ones are to be had, intervals hold what the last step still moved.
    found, aside = read(Refusing)
    assert 0.3 < abs(aside) < 5
    assert found.covariance[0, 0] > true.covariance[0, 0] * (1 + aside**2)


def test_an_image_with_more_than_its_noise_is_searched_farther_or_refused(
    scene: Scene, model: SimulationFit, monkeypatch: pytest.MonkeyPatch
):
    # As fine as banks become.
    monkeypatch.setattr("tapetum.models.simulation.fit._NODES", 13)
    gaze, rng = np.array([[0.21, -0.13]]), np.random.default_rng(2)
    frame = filmed(scene, gaze, 6)[0].astype(np.float64)
    one = SimulationFit(scene, nodes=13, starts=1, window=128)
    one._pictures = model._pictures
    pictures = Pictures(scene, 150)
    light = pictures.render(pictures.start(), gaze)[0] + dark_electrons(scene.probe.sensor)
    deviation = np.sqrt(CountModel(scene.probe.sensor)(light)[2])
    seen: list[SimulationFitResult] = []
    read = one.fit_image
    monkeypatch.setattr(one, "fit_image", lambda *given, **named: seen.append(read(*given, **named)) or seen[-1])
    for more, applies, starts in ((0.05, True, 1), (0.18, True, 5), (0.6, False, 5)):
        noisy = np.clip(np.rint(frame + np.sqrt(more) * deviation * rng.standard_normal(frame.shape)), 0, 255)
        found = one.predict(noisy.astype(np.uint8))
        assert bool(np.isfinite(found.value).all()) == applies, more
        assert ("does not explain" in found.reason[0]) != applies
        assert seen[-1].starts == starts


def test_whole_frames_and_power(scene: Scene, model: SimulationFit):
    frame = filmed(scene, np.array([[0.1, 0.05]]), 7, side=160)[0]
    frame = np.roll(frame, (9, -12), (0, 1))
    fit = SimulationFit(scene, ("gaze_x", "gaze_y", "place_x", "place_y", "power"), (), nodes=13, starts=2, window=128)
    fit._pictures = model._pictures
    result = fit.fit_image(frame)
    assert result["gaze_x"] == pytest.approx(0.1, abs=3e-4) and result["gaze_y"] == pytest.approx(0.05, abs=3e-4)
    place = np.array([result["place_x"], result["place_y"]]) / 2.2e-6
    np.testing.assert_allclose(place, [-12, 9], atol=3)
    assert result["power"] == pytest.approx(scene.illumination.power, rel=0.06)
    assert result.covariance.shape == (5, 5)


def test_focus_of_a_thin_lens(scene: Scene, model: SimulationFit):
    fit = SimulationFit(scene, ("gaze_x", "gaze_y", "object_distance"), NUISANCES, nodes=13, starts=1, window=128)
    fit._pictures = model._pictures
    nearer = dataclasses.replace(scene, target=dataclasses.replace(scene.target, object_distance=5.42))
    result = fit.fit_image(filmed(nearer, np.array([[0.1, -0.08]]), 8)[0])
    deviation = np.sqrt(result.covariance.diagonal())
    # Grids change with the focus: a thousandth of its value is what the scene's accuracy of 1e-2 leaves.
    assert result["object_distance"] == pytest.approx(5.42, abs=5 * deviation[2] + 5e-3)
    np.testing.assert_allclose(result.values[:2], [0.1, -0.08], atol=1e-3)


def test_derivatives_by_roll_and_place_are_those_of_the_pictures(scene: Scene, model: SimulationFit):
    pictures = model._pictures[128][0]
    search = Search(pictures, np.zeros((128, 128)), CountModel(scene.probe.sensor), ("roll", "place_x", "power"))
    pose = dataclasses.replace(pictures.start(), gaze=(0.1, 0.05), place=(3e-6, -2e-6), roll=0.01)
    names = ("gaze_x", "gaze_y", "roll", "place_x", "power")
    mean, slopes = search.tangent(pose, np.zeros(2), names)
    for name, step in (("roll", 2e-3), ("place_x", 2e-7), ("power", 1e-7)):
        ends = [
            search.tangent(dataclasses.replace(pose, **{name: getattr(pose, name) + sign * step}), np.zeros(2), names)[
                0
            ]
            if name != "place_x"
            else search.tangent(dataclasses.replace(pose, place=(3e-6 + sign * step, -2e-6)), np.zeros(2), names)[0]
            for sign in (1, -1)
        ]
        difference = (ends[0] - ends[1]) / (2 * step)
        found = slopes[names.index(name)]
        assert np.linalg.norm(found - difference) < 0.03 * np.linalg.norm(difference), name
    assert mean.shape == (128 * 128,)


def test_counts_follow_the_staircase_of_the_rounding(scene: Scene):
    sensor = scene.probe.sensor
    # 40 electrons are 1.57 digital numbers that scatter by a quarter of one; 6500 are the full well.
    for level in (3.0, 22.0, 40.0, 63.0, 900.0, 6450.0):
        drawn = digitise(torch.full((400_000,), level), sensor, np.random.default_rng(9)).astype(float)
        expected, slope, variance = CountModel(sensor)(np.array([level]))
        deviation = max(float(drawn.std()), 1e-3)
        assert abs(expected[0] - drawn.mean()) < 5 * deviation / 632, level
        assert variance[0] == pytest.approx(max(drawn.var(), 0.02), rel=0.12), level
        assert slope[0] >= 0
    # What is saturated tells nothing.
    assert CountModel(sensor)(np.array([8000.0]))[1][0] == 0
    # Where the steps are finer than the noise the two models are one.
    fine = dataclasses.replace(sensor, bits=12, read_noise=8.0)
    smooth = count_moments(torch.tensor([500.0], dtype=torch.float64), fine)
    expected, _, variance = CountModel(fine)(np.array([500.0]))
    assert expected[0] == pytest.approx(float(smooth[0]), rel=1e-6)
    assert variance[0] == pytest.approx(float(smooth[1]), rel=1e-3)


def test_photosites_show_behind_a_fast_lens_only(scene: Scene):
    assert period_of(scene) is None
    sites = load_scene("hand-held", ["target.sensor.array.pitch=2.2 um", "target.sensor.array.fill=0.5"])
    assert period_of(sites) is None
    assert period_of(load_scene("rotation")) == pytest.approx(2.2e-6)


def test_parameters_come_back(model: SimulationFit):
    given = json.loads(json.dumps(model.parameters()))
    again = SimulationFit.from_state(given, model.state(), model.classes())
    assert again.parameters() == model.parameters() and again.scene == model.scene


def test_fit_asks_for_labels_and_the_probes_own_crops(scene: Scene, model: SimulationFit):
    images = np.zeros((6, 100, 100), np.uint8)
    labels = {"gaze_x": np.linspace(-0.2, 0.2, 6), "gaze_y": np.zeros(6)}
    assert model.fit(dataset_from_arrays(images, labels)) is model
    with pytest.raises(InputError, match="has no label 'gaze_x'"):
        model.fit(dataset_from_arrays(images, {"focal_length": np.ones(6)}))
    with pytest.raises(InputError, match="160 x 160"):
        model.fit(dataset_from_arrays(np.zeros((6, 200, 200), np.uint8), labels))


def test_bad_input_gets_one_line(scene: Scene, model: SimulationFit):
    hot = ["probe.sensor.hot_pixels=0.01", "probe.sensor.hot_current=1000"]
    cases = [
        (lambda: SimulationFit(load_scene("phones")), "phone"),
        (lambda: SimulationFit(scene, ("gaze",)), "unknown parameter 'gaze'"),
        (lambda: SimulationFit(scene, ("gaze_x", "gaze_x")), "one twice"),
        (lambda: SimulationFit(scene, nuisances=("power", "phase_x")), "phase_x and phase_y"),
        (lambda: SimulationFit(load_scene("rotation"), ("focal_length",)), "focal length of a traced lens"),
        (lambda: SimulationFit(scene, starts=0), "starts"),
        (lambda: SimulationFit(scene, accuracy=0.0), "accuracy"),
        (lambda: SimulationFit(scene, accuracy=float("nan")), "accuracy"),
        (lambda: SimulationFit(scene, offsets=(0.5,)), "offsets: must be two numbers"),
        (lambda: SimulationFit(scene, offsets=(0.5, -1)), "offsets: must be two numbers"),
        (
            lambda: SimulationFit(load_scene("hand-held", hot)),
            "hot pixels",
        ),
        (lambda: model.fit_image(np.zeros((300, 300), np.uint8)), "300 x 300"),
        (lambda: model.fit_image(np.zeros((80, 70), np.uint8)), "80"),
        (lambda: model.fit_image(np.zeros((100, 100, 3), np.uint8)), "grey"),
        (lambda: model.predict(np.zeros((1, 100, 100), np.uint16), full_scale=4095), "4095"),
        (lambda: model.fit_image(np.full((100, 100), 300.0)), "0 to 255"),
    ]
    for call, words in cases:
        with pytest.raises(InputError, match=words) as caught:
            call()
            pytest.fail(f"nothing was said of {words!r}")
        assert "\n" not in str(caught.value)


def test_a_slow_gaze_halfway_between_two_periods_does_not_go_to_and_fro(model: SimulationFit):
    """The image that the slow gaze is counted from is another one only where that is clearly the nearer."""
    pictures = Pictures(model.scene, 32)
    period = np.array([1e-3, 2e-3])
    search = Search(pictures, np.zeros((32, 32)), CountModel(model.scene.probe.sensor), ())
    pictures.period = period
    names = ("gaze_x", "gaze_y", "phase_x", "phase_y")

    def after(periods: float) -> tuple[np.ndarray, np.ndarray]:
        """Where a pose and its slow gaze go that are so many periods apart."""
        pose, slow = search.moved(pictures.start(), np.array([periods, -periods]) * period, names, np.zeros(4))
        return np.array(pose.gaze) / period, slow / period

    for periods, there in ((0.3, 0.0), (0.6, 0.0), (0.7, 0.0), (0.9, 1.0), (1.4, 1.0), (2.1, 2.0)):
        gaze, slow = after(periods)
        # The whole gaze stays, only what it is counted from moves.
        assert gaze + slow == pytest.approx([periods, -periods])
        assert gaze == pytest.approx([there, -there]), periods


def test_an_accuracy_that_is_refused_becomes_coarser(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A twin's fit asks for what its frames allow; the whole field may allow less."""
    tried: list[float | None] = []

    class Refusing(Pictures):
        def __init__(self, scene: Scene, side: int, accuracy: float | None = None, **other: Any) -> None:
            tried.append(accuracy)
            if accuracy is not None and accuracy < 0.008:
                raise InputError("light does not come back the way it went", where="target")
            super().__init__(scene, side, accuracy, **other)

    monkeypatch.setattr("tapetum.models.simulation.fit.Pictures", Refusing)
    fit = SimulationFit(scene, accuracy=0.005, nodes=5, window=64)
    assert fit.bounds((0.1, 0.1))["gaze_x"] > 0
    assert tried == [0.005, pytest.approx(0.0065), pytest.approx(0.00845)]
    # No coarser than the scene asks.
    with pytest.raises(InputError, match="does not come back"):
        SimulationFit(with_values(scene, {"sampling.accuracy": 0.004}), accuracy=0.003, window=64).bounds((0.1, 0.1))
