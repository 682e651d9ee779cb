"""The twin: a scene fitted to a labelled recording of a unit that differs from it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch

from tapetum.bench import Scene, draw_unit, load_scene, scene_yaml, with_values
from tapetum.calibrate.twin import fit_twin
from tapetum.calibrate.twin.fit import _from_starts, _grain, _refined
from tapetum.calibrate.twin.frames import TwinFrame, frames_of
from tapetum.calibrate.twin.normal_equations import Linear, Normal, State, by_labels, by_parameters
from tapetum.calibrate.twin.parameters import GROUPS, chosen, parameters_of, placed
from tapetum.calibrate.twin.search import climb, covariance, settle, two_groups, untold
from tapetum.calibrate.twin.starts import placed_in
from tapetum.calibrate.twin.state import Kept
from tapetum.cli.app import main
from tapetum.errors import InputError
from tapetum.models.simulation.pictures import Pictures, Pose
from tapetum.progress import quiet
from tapetum.record import Session, film, open_recording
from tapetum.simulate.information import slopes_of

SMALL = ["probe.sensor.pixels=[96, 96]", "probe.sensor.pitch=4.4 um", "illumination.power=12 uW", "second_beam=null"]
SMALL += ["sampling.accuracy=0.05"]
UNIT = {"target.lens.aperture_radius": 3.9e-3, "target.sensor.tilt": [2e-3, -1e-3], "illumination.power": 11e-6}
FREE = ["aperture", "tilt", "light", "background"]


@pytest.fixture(scope="module")
def bench() -> Scene:
    return load_scene("hand-held", SMALL)


@pytest.fixture(autouse=True)
def _searched_on_few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    # The search only has to come near: what is asserted is found with all frames.
    monkeypatch.setattr("tapetum.calibrate.twin.fit._FEW", 5)


@pytest.fixture(scope="module")
def filmed(bench: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a unit, whose labels are the truth with known errors."""
    path = tmp_path_factory.mktemp("twin") / "unit.rec"
    label(film(with_values(bench, UNIT), path, Session(2.0, 15.0, seed=4, target_rate=1.0)).path)
    return path


def label(path: Path, error: float = 1e-4, device: list[str] | None = None) -> None:
    recording = open_recording(path)
    truth = recording.truth()
    assert truth is not None
    probe = truth.filter(pa.array([one == "probe" for one in truth["stream"].to_pylist()]))
    rng, count = np.random.default_rng(1), len(probe)
    columns = {"frame": probe["frame"], "how": pa.array(["truth"] * count), "quality": pa.array(np.ones(count))}
    for name in ("gaze_x", "gaze_y"):
        columns[name] = pa.array(probe[name].to_numpy() + error * rng.standard_normal(count))
        columns[f"{name}_std"] = pa.array(np.full(count, error))
    if device is not None:
        columns["device"] = pa.array(device)
    recording.write_labels(pa.table(columns))


def test_a_twin_finds_the_unit_and_what_it_says_of_its_deviations_holds(bench: Scene, filmed: Path) -> None:
    found = fit_twin(filmed, bench, free=FREE, frames=20, starts=1)
    true = with_values(bench, UNIT)
    assert found.converged and found.explains and found.misfit_lit < 1.05 < found.before.misfit_lit
    assert found.gain > 100
    assert not found.untold
    # By the offset that all labels may have in common alone: 0.05 pixels of the target's camera.
    offset = 0.05 / np.array(bench.target.sensor.pixels)
    assert (offset < found.systematic).all() and (found.systematic < 3 * offset).all()
    for one, fitted in zip(chosen(bench, FREE), found.parameters, strict=True):
        assert fitted.deviation is not None
        assert abs(one.read(found.scene) - one.read(true)) < 4 * fitted.deviation < one.spread, one.name


def test_differences_are_the_derivatives_of_the_automatic_chain(bench: Scene) -> None:
    gaze = np.array([0.1, -0.05])
    frame = TwinFrame(0, 0.0, np.zeros((96, 96)), gaze, np.full(2, 1e-4))
    normal = Normal(bench, chosen(bench, ["focus", "focal_length"]), [frame])
    at = np.array([one.read(bench) for one in normal.parameters])
    pose = replace(normal.pictures(at).start(), gaze=(0.1, -0.05))
    linear = normal.linear(State(at, (pose,), np.zeros((1, 2))))
    names = ["object_distance", "focal_length"]
    _, slopes = slopes_of(bench, names, torch.tensor([gaze.tolist()]), device="cpu")(0)
    # The fit counts focus by the inverse distance, and both in spreads.
    factors = np.array([-(bench.target.object_distance**2), 1.0]) * normal.spread
    wanted = slopes.numpy() * factors[:, None]
    for mine, theirs in zip(linear.frames[0].rows, wanted, strict=True):
        assert np.linalg.norm(mine - theirs) < 0.01 * np.linalg.norm(theirs)


@pytest.mark.slow
def test_an_interrupted_search_goes_on(bench: Scene, filmed: Path, tmp_path: Path) -> None:
    kept, seen = tmp_path / "twin.part", list[str]()

    def stops(items: Iterable[object], what: str, *, total: int | None = None) -> Iterator[object]:
        del total
        for item in items:
            if what == "fitting all frames":
                raise KeyboardInterrupt
            yield item

    def notes(items: Iterable[object], what: str, *, total: int | None = None) -> Iterator[object]:
        del total
        seen.append(what)
        yield from items

    options = {"free": ["tilt", "aperture", "light"], "frames": 20, "starts": 1, "state": kept}
    with pytest.raises(KeyboardInterrupt):
        fit_twin(filmed, bench, **options, progress=stops)  # pyright: ignore[reportArgumentType]
    assert kept.exists()
    found = fit_twin(filmed, bench, **options, progress=notes)  # pyright: ignore[reportArgumentType]
    assert "fitting all frames" in seen and "start 1 of 1" not in seen
    assert found.converged and found.explains
    with pytest.raises(InputError, match="another recording, scene or options"):
        fit_twin(filmed, bench, **(options | {"free": ["aperture"]}))  # pyright: ignore[reportArgumentType]


def test_scenes_that_the_engine_refuses_are_gone_around(
    bench: Scene, filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = ["aperture", "tilt", "light"]
    parameters = chosen(bench, free)
    (aperture,) = (n for n, one in enumerate(parameters) if one.name == "aperture")
    own, most, refused = parameters[aperture].read(bench), 3.95e-3, list[float]()
    assert parameters[aperture].read(with_values(bench, UNIT)) < most < own
    usual = {"linear": Normal.linear, "left": Normal.left}

    def but_wide_ones(name: str) -> Callable[..., Any]:
        def asked(self: Normal, *given: Any, **more: Any) -> Any:
            at = float(given[-1].coordinates[aperture])
            # Wide apertures, and the first step whichever it is.
            if most < at != own or (name == "left" and not refused):
                refused.append(at)
                raise InputError("its light passes beside the lens")
            return usual[name](self, *given, **more)

        return asked

    for name in usual:
        monkeypatch.setattr(Normal, name, but_wide_ones(name))
    # All starts are searched from, not only until one explains the frames.
    monkeypatch.setattr("tapetum.calibrate.twin.fit._EXPLAINED", 0.0)
    used = frames_of(filmed, bench, 20)[1][::4]
    kept = Kept(None, "")
    found = _from_starts(Normal(bench, parameters, used), kept, 2, 4, quiet)
    assert found[aperture] == pytest.approx(3.9e-3, rel=1e-3)
    # The second start was at a wide one.
    assert len(refused) == 2 and kept.searched[1][1] < kept.searched[0][1]


def test_what_two_parameters_change_alike_is_not_told() -> None:
    # Per squared spread: the sum of the first two is known to 0.01, their difference to 3 spreads; the third to 0.1.
    sum_of, apart = np.array([1, 1, 0]) / 2**0.5, np.array([1, -1, 0]) / 2**0.5
    information = 1e4 * np.outer(sum_of, sum_of) + np.outer(apart, apart) / 9 + 100 * np.outer([0, 0, 1], [0, 0, 1])
    (found,) = untold(information)
    assert found.number in (0, 1) and found.like == (1 - found.number,)
    known = covariance(information, [found.number])
    # The other is known no better than the one that is held: within its usual spread.
    assert 0.8 < known[1 - found.number, 1 - found.number] < 1.1
    assert known[2, 2] == pytest.approx(0.01)


def test_frames_of_two_cameras_are_told_apart(bench: Scene, filmed: Path) -> None:
    _, frames = frames_of(filmed, bench, 20)
    wider = with_values(bench, {"target.lens.aperture_radius": 4.4e-3})
    normal = Normal(wider, chosen(bench, ["aperture"]), frames)
    at = np.array([one.read(with_values(bench, UNIT)) for one in normal.parameters])
    state = placed_in(normal, at)
    # The second half of the frames is replaced by what a smaller aperture shows.
    other = normal.pictures(at - 5 * normal.spread)
    moved = [
        replace(one, counts=normal.model(pose.background + made.ravel())[0].reshape(made.shape))
        for one, pose, made in zip(frames, state.poses, other.render_each(state.poses), strict=True)
    ]
    mixed = [*frames[:10], *moved[10:]]
    joined = normal.over(mixed)
    # Between the two, as a search for one camera ends: from either of them the other is too far for derivatives.
    between = at - 2.5 * normal.spread
    second, gain = two_groups(joined, joined.linear(settle(joined, placed_in(joined, between), 3).state))
    agree = (second == (np.arange(len(frames)) >= 10)).mean()
    assert max(agree, 1 - agree) == 1
    assert gain > 100


def test_every_group_is_read_and_written() -> None:
    for name in ("hand-held", "rotation", "focusing"):
        scene = load_scene(name)
        for one in parameters_of(scene):
            moved = (
                one.read(scene) - 0.3 * one.spread
                if one.most == one.read(scene)
                else one.read(scene) + 0.3 * one.spread
            )
            assert one.group in GROUPS
            assert one.read(one.write(scene, moved)) == pytest.approx(moved, rel=1e-6), one.name


@pytest.mark.parametrize(
    ("free", "said"),
    [
        (["focuss"], "unknown name 'focuss'"),
        (["microlens"], "the scene has nothing that 'microlens' names"),
        (["tilt", "tilt_x"], "names 'tilt_x' twice"),
        ([], "names nothing"),
    ],
)
def test_names_that_make_no_fit_are_refused(bench: Scene, free: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        chosen(bench, free)


def test_recordings_that_have_no_twin_are_refused(bench: Scene, filmed: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must lie from 20 to 200, is 7"):
        frames_of(filmed, bench, 7)
    with pytest.raises(InputError, match="the scene's probe 640 x 480"):
        frames_of(filmed, load_scene("hand-held"), 20)
    with pytest.raises(InputError, match="a phone"):
        fit_twin(filmed, "phones", frames=20)
    bare = film(bench, tmp_path / "bare.rec", Session(1.0, 4.0, target_rate=1.0)).path
    with pytest.raises(InputError, match="the recording has no labels"):
        frames_of(bare, bench, 20)
    label(bare, device=["a", "b", "b", "b"][: len(open_recording(bare).frames("probe"))])
    with pytest.raises(InputError, match="shows 2 cameras, a, b"):
        frames_of(bare, bench, 20)


def test_the_command_writes_a_scene_or_says_that_it_does_not_explain(
    bench: Scene, filmed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, out = tmp_path / "bench.yaml", tmp_path / "twin.yaml"
    scene.write_text(scene_yaml(bench))
    common = [str(filmed), "--scene", str(scene), "--frames", "20", "--starts", "1", "-o", str(out)]
    assert main(["twin", *common, "--free", "light,nothing"]) == 2
    assert "unknown name 'nothing'" in capsys.readouterr().err
    # The laser's power alone explains neither another aperture nor a tilt.
    assert main(["twin", *common, "--free", "light", "--json"]) == 1
    told = json.loads(capsys.readouterr().out)
    assert not told["explains"] and told["misfit_lit"] > told["limit"]
    assert load_scene(str(out)).illumination.power != bench.illumination.power
    assert "does not explain" in (tmp_path / "twin.html").read_text("utf-8")
    assert not (tmp_path / "twin.part").exists()
    assert main(["twin", *common]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.fixture(scope="module")
def unit() -> tuple[Pictures, list[Pose], np.ndarray]:
    """Pictures of a unit with a traced lens, planned for many, with two poses and how it shows them."""
    own = Pictures(draw_unit(load_scene("rotation"), None, 11), 120, None, torch.complex128, count=1000)
    poses = [replace(own.start(), gaze=gaze) for gaze in ((0.1, -0.2), (-0.3, 0.25))]
    return own, poses, own.render_each(poses)


@pytest.mark.parametrize("name", ["decentre_x", "focal_length"])
def test_a_traced_lens_is_differentiated_on_the_same_samples(
    unit: tuple[Pictures, list[Pose], np.ndarray], name: str
) -> None:
    # Along the decentre the plan changes within a step of the derivative: planned afresh, slopes of 3e-4 and 1e-2 of a
    # spread differ by more than their size. Along the focal length the map from gazes to tilts does, which moves the
    # photosites under the spot: they differ by a third.
    own, poses, base = unit
    scene, parameters = own.scene, parameters_of(own.scene)
    at = [one.read(scene) for one in parameters]
    n = next(n for n, one in enumerate(parameters) if one.name == name)

    def slope(step: float) -> np.ndarray:
        moved = [value + step * parameters[n].spread * (k == n) for k, value in enumerate(at)]
        other = Pictures(placed(scene, parameters, moved), 120, None, torch.complex128, like=own)
        target = other.scene.target
        focus = {"object_distance": target.object_distance, "focal_length": target.lens.focal_length}
        return (other.render_each([replace(pose, **focus) for pose in poses]) - base) / step

    small, large = slope(3e-4), slope(1e-2)
    assert np.abs(small - large).max() < 0.05 * np.abs(large).max()


def test_labels_hold_the_gazes_while_the_scene_is_wrong(bench: Scene, filmed: Path) -> None:
    parameters = chosen(bench, FREE)
    _, frames = frames_of(filmed, bench, 20)
    frames = frames[:6]
    normal = Normal(bench, parameters, frames)
    at = np.array([one.read(bench) for one in parameters])
    labels = np.array([one.gaze for one in frames])
    # The unit's tilt looks like another gaze: the pixels, taken for true, draw every gaze by many label deviations.
    drawn = settle(normal, placed_in(normal, at), 3).state
    assert np.abs(drawn.gazes - labels).max() > 10 * 1e-4
    for first in (placed_in(normal, at), drawn):
        held = settle(normal, first, 3, doubt=1e4).state
        assert np.abs(held.gazes - labels).max() < 1e-4


def test_an_offset_of_all_labels_moves_the_score_as_foreseen(bench: Scene, filmed: Path) -> None:
    parameters = chosen(bench, FREE)
    _, frames = frames_of(filmed, bench, 20)
    normal, offset = Normal(bench, parameters, frames[:6]), np.array([2e-5, -3e-5])
    moved = normal.over([replace(one, gaze=one.gaze + offset) for one in frames[:6]])
    at = np.array([one.read(bench) for one in parameters])
    linear = normal.linear(settle(normal, placed_in(normal, at), 2).state)
    change = moved.linear(linear.state, near=linear).score - linear.score
    assert np.abs(change).max() > 1
    assert np.allclose(offset @ by_labels(normal, linear), change, rtol=1e-6, atol=1e-6 * np.abs(change).max())


def test_a_gaze_that_is_read_moves_with_a_parameter_as_foreseen(bench: Scene) -> None:
    # A frame without noise, read with a scene that is slightly another one.
    gaze = np.array([0.1, -0.05])
    pictures, parameters = Pictures(bench, 96), chosen(bench, ["tilt", "decentre", "aperture"])
    pose = replace(pictures.start(), gaze=(0.1, -0.05))
    mean = pose.background + pictures.render_each([pose])[0]
    blank = Normal(bench, parameters, [TwinFrame(0, 0.0, np.zeros((96, 96)), gaze, np.full(2, 1e-4))])
    normal = blank.over([replace(blank.frames[0], counts=blank.model(mean)[0])])
    at = np.array([one.read(bench) for one in parameters])
    (slopes,) = by_parameters(normal.linear(State(at, (pose,), np.zeros((1, 2)))))
    assert slopes.shape == (2, 5)
    for n, part in enumerate((0.02, 0.02, 0.02, 0.02, 0.05)):
        beside = at + part * normal.spread * (np.arange(5) == n)
        top = normal.search(normal.frames[0], normal.pictures(beside)).climb(pose, phase=False)
        moved = np.array(top.pose.gaze) - gaze
        assert np.hypot(*(moved - part * slopes[:, n])) < 0.05 * np.hypot(*moved) + 3e-6, parameters[n].name


def test_pictures_become_finer_until_their_error_moves_nothing(
    bench: Scene, filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parameters = chosen(bench, FREE)
    _, frames = frames_of(filmed, bench, 20)
    coarse = Normal(bench, parameters, frames[:2], accuracy=0.3)
    true = np.array([one.read(with_values(bench, UNIT)) for one in parameters])
    first, converged = climb(coarse, settle(coarse, placed_in(coarse, true), 2).state)
    deviations = np.sqrt(covariance(first.information, []).diagonal())

    def refined() -> tuple[float | None, np.ndarray]:
        normal, found, _, left = _refined(coarse, first, converged, [], Kept(None, ""), quiet)
        assert (np.abs(found.state.coordinates - true) < 5 * deviations * normal.spread).all()
        return normal.accuracy, left / deviations

    # A thin lens's pictures are far better than asked for.
    accuracy, left = refined()
    assert accuracy == pytest.approx(0.3 / 27) and not left.any()
    monkeypatch.setattr("tapetum.calibrate.twin.fit._alike", lambda *_: False)
    accuracy, left = refined()
    assert accuracy == 0.3 and 0 < np.abs(left).max() < 0.3
    monkeypatch.setattr("tapetum.calibrate.twin.fit._MOVED", 0.0)
    accuracy, last = refined()
    assert accuracy == pytest.approx(0.3 / 27) and np.abs(last).max() < 0.3
    usual = Normal.linear

    def refuses(self: Normal, *given: Any, **more: Any) -> Linear:
        if self.accuracy is not None and self.accuracy < 0.05:
            raise InputError("too fine")
        return usual(self, *given, **more)

    monkeypatch.setattr(Normal, "linear", refuses)
    accuracy, unsure = refined()
    assert accuracy == pytest.approx(0.1)
    # Half of what the last step moved is left where each is three times finer.
    monkeypatch.setattr(Normal, "linear", usual)
    monkeypatch.setattr("tapetum.calibrate.twin.fit._LEVELS", 1)
    assert unsure == pytest.approx(refined()[1] / 2, abs=1e-6)


def test_what_an_error_of_the_pictures_seems_to_tell_is_not_believed(
    bench: Scene, filmed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error of a picture may depend on the focal length by more than the retro-reflection does."""
    parameters = chosen(bench, ["focal_length", "focus", "tilt", "aperture"])
    (at,) = (n for n, one in enumerate(parameters) if one.name == "focal_length")
    rough = Normal(bench, parameters, frames_of(filmed, bench, 20)[1][::10])
    true = np.array([one.read(with_values(bench, UNIT)) for one in parameters])
    first, converged = climb(rough, settle(rough, placed_in(rough, true), 2).state)
    # The first level's pictures are the same, those of the second are finer.
    monkeypatch.setattr("tapetum.calibrate.twin.fit._LEVELS", 2)
    normal, found, _, _ = _refined(rough, first, converged, [], Kept(None, ""), quiet)
    told, right = (covariance(one.information, []).diagonal()[at] ** 0.5 for one in (first, found))
    assert normal.accuracy == pytest.approx(0.05 / 9) and right > 1.3 * told


class Ragged:
    """A likelihood of two parameters about a maximum, whose score is off by a kick that depends on the aperture."""

    information = np.array([[400.0, 100.0], [100.0, 900.0]])

    def __init__(self, scene: Scene, kick: float, refused: tuple[float, ...] = ()) -> None:
        self.scene, self.kick, self.refused, self.frames = scene, kick, refused, ()
        self.accuracy = scene.sampling.accuracy
        self.parameters = chosen(scene, ["aperture", "focal_length"])
        self.spread = np.array([one.spread for one in self.parameters])
        self.own = np.array([one.read(scene) for one in self.parameters])
        self.at = [one.name for one in self.parameters].index("aperture")

    def over(self, frames: object, *, accuracy: float, near: float) -> Ragged:
        assert near >= 0.2
        other = Ragged(self.scene, self.kick, self.refused if accuracy < 2 * self.accuracy else ())
        other.accuracy = accuracy
        return other

    def moved(self, state: object, coordinates: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(coordinates=coordinates)

    def stepped(self, linear: SimpleNamespace, step: np.ndarray) -> SimpleNamespace:
        return linear.state

    def linear(self, state: SimpleNamespace, **_: object) -> SimpleNamespace:
        away = (state.coordinates - self.own) / self.spread
        if any(abs(away[self.at] - by) < 1e-6 for by in self.refused):
            raise InputError("its light passes beside the lens")
        score = -self.information @ away
        score[self.at] += self.kick * np.sign(away[self.at])
        told = {"score": score, "information": self.information, "state": state}
        return SimpleNamespace(**told, misfit=lambda lit: 1.0)


def test_what_the_choice_of_rays_leaves_unsure_is_in_the_deviations() -> None:
    traced = load_scene("rotation")

    def grain(normal: Ragged, held: tuple[int, ...] = ()) -> np.ndarray:
        best = normal.linear(SimpleNamespace(coordinates=normal.own))
        return _grain(normal, best, held, quiet)  # pyright: ignore[reportArgumentType]

    # A smooth likelihood leads back from every aperture.
    assert np.abs(grain(Ragged(traced, 0.0))).max() < 1e-20
    ragged = Ragged(traced, 3.0)
    kicked = 3.0 * (np.arange(2) == ragged.at)
    missed = np.linalg.solve(ragged.information, kicked)
    assert np.allclose(grain(ragged), np.outer(missed, missed) / 2)
    # Apertures that the engine refuses are left out; all of them, and coarser pictures serve.
    for refused in ((0.1, 0.2), (-0.2, -0.1, 0.1, 0.2)):
        assert np.allclose(grain(Ragged(traced, 3.0, refused)), np.outer(missed, missed) / 2)
    # It is the aperture that chooses rays, and a thin lens has none.
    assert not grain(ragged, (ragged.at,)).any()
    assert not grain(Ragged(load_scene("hand-held"), 3.0)).any()
