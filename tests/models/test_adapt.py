"""A network adapted to another camera: what it learns of few frames, what it may not look at, what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.spatial import KDTree
from tests.models.conftest import pictures

from tapetum.data import dataset_from_arrays
from tapetum.data.film_parts import spread_over
from tapetum.errors import InputError
from tapetum.models import NetworkEstimator, ZernikeRidge, adapt, fine_tuning, kernel, load_model, save_model
from tapetum.models.fine_tuning import ALL, CARRIED, GUESS, LAST, RIDGE, better_of, epochs_of
from tapetum.models.last_layer import Correction, single_frames
from tapetum.record import HandMotion

pytestmark = pytest.mark.usefixtures("narrow")

TINY = {"crop": 36, "size": 24, "epochs": 6, "batch": 20, "device": "cpu"}
RATE = 15.0


@pytest.fixture(autouse=True)
def _another_copy_is_like_the_base(monkeypatch: pytest.MonkeyPatch) -> None:
    # So small a network errs by 0.25 of the labels' spread even on another copy.
    monkeypatch.setattr(fine_tuning, "_UNLIKE", 0.5)
    # From weak to strong as ever, a quarter as many: each is tried in every fold, which takes a third of the time.
    monkeypatch.setattr(fine_tuning, "PENALTIES", fine_tuning.PENALTIES[::4])


@pytest.fixture(scope="module")
def base(small: xr.Dataset) -> NetworkEstimator:
    return NetworkEstimator(**TINY).fit(small)


def other(train: int = 60, test: int = 150, *, seed: int = 5, reach: float | None = None) -> xr.Dataset:
    """Another copy of the camera: its field is displaced and stretched against the pictures."""
    images, gaze = pictures(train + test, seed=seed)
    gaze = gaze * np.array([0.8, 1.1]) + np.array([0.08, -0.05])
    split = (np.arange(train + test) >= train).astype(int)
    made = dataset_from_arrays(images, {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}, split=split)
    made["time"] = xr.Variable(("frame",), np.arange(train + test) / RATE)
    if reach is not None:
        for name in ("label_back", "label_ahead"):
            made[name] = xr.Variable(("frame",), np.full(train + test, reach))
    return made


def error(model: NetworkEstimator, dataset: xr.Dataset) -> float:
    found = model.predict(dataset.tp.test, anyway=True).value
    return float(np.abs(found - dataset.tp.test.tp.values(("gaze_x", "gaze_y"))).mean())


def bias(model: NetworkEstimator, dataset: xr.Dataset) -> list[float]:
    found = model.predict(dataset.tp.test, anyway=True).value
    return list(np.abs((found - dataset.tp.test.tp.values(("gaze_x", "gaze_y"))).mean(axis=0)))


def labelled(dataset: xr.Dataset, **columns: object) -> xr.Dataset:
    return dataset.assign({name: xr.Variable(("frame",), np.asarray(one)) for name, one in columns.items()})


def test_few_frames_of_another_copy_are_enough_and_the_base_stays(base: NetworkEstimator) -> None:
    data, before = other(), {name: one.clone() for name, one in base.state().items()}
    mine = adapt(base, data, epochs=3, name="base")
    assert error(mine, data) < 0.75 * error(base, data)
    # The field's displacement is gone, not only the spread of the errors.
    assert max(bias(mine, data)) < 0.03 < 0.06 < max(bias(base, data))
    assert all(torch.equal(one, before[name]) for name, one in base.state().items())
    told = mine.training_ or {}
    assert told["adapted_from"]["model"] == "base" and told["adapted_from"]["frames"] == 60
    assert told["adapted_from"]["seconds"] == pytest.approx(4.0)
    assert told["chosen"]["fitted"].startswith((ALL, LAST)) and "4 folds" in told["intervals"]
    truth, found = data.tp.test.tp.values(("gaze_x", "gaze_y")), mine.predict(data.tp.test, anyway=True)
    held = ((found.lower <= truth) & (truth <= found.upper)).mean()
    # Frames of the folds miss a quarter of the others, so the intervals are rather too wide.
    assert 0.85 <= held <= 0.995
    assert mine.domain_ is not None and mine.domain_.unit != base.domain_.unit  # type: ignore[union-attr]


def test_the_card_says_what_an_adapted_network_has_to_beat(base: NetworkEstimator) -> None:
    data, rng = other(), np.random.default_rng(3)
    for name in ("gaze_x", "gaze_y"):
        data = labelled(data, **{name: rng.permutation(data[name].values)})
    taught, confused = (adapt(base, one, epochs=2).training_ or {} for one in (other(), data))
    best = [min(told["left_out_error"][how] for how in (ALL, LAST)) for told in (taught, confused)]
    guess = [told["left_out_error"][GUESS] for told in (taught, confused)]
    ridge = [told["left_out_error"][RIDGE] for told in (taught, confused)]
    # Of labels that have nothing to do with the pictures neither learns anything.
    assert best[0] < 0.4 * guess[0] and best[1] > 0.9 * guess[1]
    assert ridge[0] < 0.7 * guess[0] and ridge[1] > 0.9 * guess[1]


def test_all_layers_are_kept_where_they_are_clearly_better() -> None:
    """They err more at the edges of the field than frames left out amid the others show."""
    assert better_of({LAST: 1.0, ALL: 0.8}) == LAST == better_of({LAST: 1.0, ALL: 2.0})
    assert better_of({LAST: 1.0, ALL: 0.7}) == ALL


def test_what_tests_is_never_looked_at(base: NetworkEstimator) -> None:
    data = other()
    blind = data.copy(deep=True)
    blind["gaze_x"].values[data["split"].values == 1] = np.nan
    blind["image"].values[data["split"].values == 1] = 0
    for one, same in zip(
        adapt(base, data, epochs=1).state().values(), adapt(base, blind, epochs=1).state().values(), strict=True
    ):
        assert torch.equal(one, same)


def test_many_frames_keep_a_part_aside(base: NetworkEstimator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A last layer that may hardly change: training all layers wins.
    monkeypatch.setattr(fine_tuning, "PENALTIES", (Correction(1e9),))
    monkeypatch.setattr(fine_tuning, "_RATE", 1e-4)
    monkeypatch.setattr(fine_tuning, "_UNLIKE", np.inf)
    data = other(300, 60, reach=0.05)
    mine = adapt(base, data, epochs=4)
    told = mine.training_ or {}
    assert told["chosen"]["fitted"].startswith(ALL)
    assert 0 < told["calibrated_on"] < 80 and told["fitted"] < 240 and told["embargo"] > 0
    assert "that neither fit nor calibrate" in told["chosen"]["fitted"] and "neither" in told["intervals"]
    save_model(mine, tmp_path / "m")
    again = load_model(tmp_path / "m")
    assert again.training_ == told
    np.testing.assert_array_equal(again.predict(data.tp.test).value, mine.predict(data.tp.test).value)


@pytest.mark.parametrize(("frames", "unlike"), [(60, False), (60, True), (300, True)])
def test_a_camera_unlike_the_bases_is_learned_from_a_last_layer_of_zeros(
    base: NetworkEstimator, monkeypatch: pytest.MonkeyPatch, frames: int, unlike: bool
) -> None:
    """From the corrected layer, which fits what is peculiar to its frames, no better features were found."""
    begun: list[tuple[float, float]] = []

    def seen(network: torch.nn.Module, looks: torch.Tensor, *rest: object, **more: object) -> object:
        settings = rest[1]
        begun.append((float(network.head.weight.detach().abs().max()), settings.learning_rate))  # type: ignore[attr-defined]
        return train(network, looks, *rest, **more)  # type: ignore[arg-type]

    train = fine_tuning.train
    monkeypatch.setattr(fine_tuning, "train", seen)
    data = other(frames)
    if unlike:
        # No RR shows these gazes: the last layer cannot be corrected to them.
        noise = np.random.default_rng(2).normal(0, 0.2, (len(data["frame"]), 2))
        labels = {name: data[name] * 0 + noise[:, k] for k, name in enumerate(("gaze_x", "gaze_y"))}
        data = data.assign(labels)
    told = adapt(base, data, epochs=1).training_ or {}
    assert ("start" in told["chosen"]) == unlike
    # What was learned in vain is said to be.
    kept = told["chosen"]["fitted"].startswith(ALL)
    assert ("were not kept" in told["chosen"].get("start", "")) == (unlike and not kept)
    assert begun and all((weight == 0.0) == unlike for weight, _ in begun)
    assert {rate for _, rate in begun} == {2e-3 if unlike else 5e-4}


def test_of_a_camera_unlike_the_bases_only_frames_that_calibrate_are_not_fitted(
    base: NetworkEstimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a sixth kept aside half the passes gave the error that they all gave with a quarter."""
    monkeypatch.setattr(fine_tuning, "_UNLIKE", 0.0)
    monkeypatch.setattr(fine_tuning, "_CLEARLY", np.inf)
    told = adapt(base, other(300, 10), epochs=2).training_ or {}
    assert told["fitted"] + told["calibrated_on"] == 300 and told["calibrated_on"] < 0.19 * 300
    assert told["chosen"]["epochs"] == "2 of 2" and "did not fit" in told["intervals"]


@pytest.mark.parametrize("frames", [60, 300])
def test_a_last_layer_that_errs_little_needs_no_training(
    base: NetworkEstimator, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, frames: int
) -> None:
    monkeypatch.setattr(fine_tuning, "_SURE", 0.4)
    # Training all layers would take minutes: nothing may start it.
    monkeypatch.setattr(fine_tuning, "train", lambda *_, **__: pytest.fail("all layers are trained"))
    data, epochs = other(frames), []
    mine = adapt(base, data, checkpoint=tmp_path / "kept", on_epoch=epochs.append)
    told = mine.training_ or {}
    assert told["chosen"]["fitted"].startswith(LAST) and "not trained" in told["chosen"]["all layers"]
    assert ALL not in told["left_out_error"] and told["left_out_error"][LAST] < told["left_out_error"][GUESS]
    assert told["fitted"] == told["calibrated_on"] == frames and not epochs
    truth, found = data.tp.test.tp.values(("gaze_x", "gaze_y")), mine.predict(data.tp.test, anyway=True)
    assert 0.8 <= ((found.lower <= truth) & (truth <= found.upper)).mean() <= 0.995
    assert error(mine, data) < 0.75 * error(base, data)
    # Who asks for epochs gets them.
    with pytest.raises(pytest.fail.Exception):
        adapt(base, data, epochs=1)


@pytest.mark.parametrize("frames", [120, 300])
def test_residuals_are_interpolated_where_that_errs_less_on_frames_left_out(
    base: NetworkEstimator, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, frames: int
) -> None:
    # A last layer that may hardly change leaves what frames that look alike share.
    monkeypatch.setattr(fine_tuning, "PENALTIES", (Correction(1e3),))
    monkeypatch.setattr(fine_tuning, "_SURE", np.inf)
    data, given, left = other(frames), [], []
    fit, judge = fine_tuning.fit_intervals, fine_tuning.interpolated
    monkeypatch.setattr(fine_tuning, "fit_intervals", lambda errors, *rest: given.append(errors) or fit(errors, *rest))
    monkeypatch.setattr(fine_tuning, "interpolated", lambda *all: left.append(all[1]) or judge(*all))
    mine = adapt(base, data)
    # Errors without what is interpolated, each over its deviation, calibrate.
    wanted = np.abs(left[0].carried) / (left[0].deviation / np.median(left[0].deviation))[:, None]
    np.testing.assert_allclose(given[0], wanted * mine.scaling[1])
    monkeypatch.setattr(kernel, "_WORTH", 0.0)
    plain = adapt(base, data)
    told, without = (one.training_ or {} for one in (mine, plain))
    assert told["chosen"]["residuals"].startswith("interpolated") and mine.kernel_ is not None
    assert without["chosen"]["residuals"].startswith("not interpolated") and plain.kernel_ is None
    assert (
        told["left_out_error"][CARRIED] < 0.95 * told["left_out_error"][LAST]
        and CARRIED not in without["left_out_error"]
    )
    assert error(mine, data) < 0.8 * error(plain, data)
    truth, found = data.tp.test.tp.values(("gaze_x", "gaze_y")), mine.predict(data.tp.test, anyway=True)
    assert 0.8 <= ((found.lower <= truth) & (truth <= found.upper)).mean() <= 0.99
    # Frames unlike those labelled have wider intervals.
    widths = (found.upper - found.lower)[:, 0]
    assert np.isfinite(widths).all() and widths.max() > 1.2 * widths.min()
    assert np.ptp((before := plain.predict(data.tp.test, anyway=True)).upper[:, 0] - before.lower[:, 0]) < 1e-9
    for half in (False, True):
        save_model(mine, tmp_path / f"m{half}", half=half)
        again = load_model(tmp_path / f"m{half}").predict(data.tp.test, anyway=True)
        np.testing.assert_allclose(again.value, found.value, rtol=0, atol=2e-3 if half else 0)


def test_residuals_of_all_layers_are_interpolated_too(
    base: NetworkEstimator, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(fine_tuning, "_CLEARLY", np.inf)
    monkeypatch.setattr(fine_tuning, "_RATE", 1e-6)
    monkeypatch.setattr(fine_tuning, "PENALTIES", (Correction(1e3),))
    for data in (other(120), other(300, reach=0.05)):
        folder = tmp_path / str(data.sizes["frame"])
        mine = adapt(base, data, epochs=1, checkpoint=folder)
        with monkeypatch.context() as without:
            without.setattr(kernel, "_WORTH", 0.0)
            # Whether they pay is decided after the trainings, which are not done again.
            plain = adapt(base, data, epochs=1, checkpoint=folder, resume=True)
        told = mine.training_ or {}
        assert told["chosen"]["fitted"].startswith(ALL) and told["chosen"]["residuals"].startswith("interpolated")
        assert mine.kernel_ is not None and len(mine.kernel_.references) == data.tp.train.sizes["frame"]
        assert error(mine, data) < 0.9 * error(plain, data)


def test_a_last_layer_that_wins_is_fitted_to_all_frames_and_calibrated_by_all(
    base: NetworkEstimator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 300 frames a quarter neither fitted nor, but for a few, calibrated: its intervals rested on some 50."""
    monkeypatch.setattr(fine_tuning, "_RATE", 0.05)
    data = other(300, 60)
    mine = adapt(base, data, epochs=1)
    told = mine.training_ or {}
    assert told["chosen"]["fitted"].startswith(LAST) and "frames that neither had fitted" in told["chosen"]["fitted"]
    assert told["fitted"] == told["calibrated_on"] == 300 and told["embargo"] == 0
    truth, found = data.tp.test.tp.values(("gaze_x", "gaze_y")), mine.predict(data.tp.test, anyway=True)
    assert 0.8 <= ((found.lower <= truth) & (truth <= found.upper)).mean() <= 0.99
    assert error(mine, data) < 0.75 * error(base, data)


def test_seconds_choose_frames_spread_over_the_field_or_the_first_ones(base: NetworkEstimator) -> None:
    data = other(120)
    spread, row = adapt(base, data, seconds=2, epochs=1), adapt(base, data, seconds=2, epochs=1, spread=False)
    for model, choice in ((spread, "spread over the field"), (row, "the first ones in a row")):
        of = (model.training_ or {})["adapted_from"]
        assert of["frames"] == 30 and of["seconds"] == 2.0 and choice in of["choice"]
    first = data.isel(frame=slice(0, 30))
    assert row.data_hash_ == first.tp.hash != spread.data_hash_


@pytest.mark.parametrize("unlike", [False, True])
def test_of_much_film_single_frames_choose_and_calibrate(
    base: NetworkEstimator, monkeypatch: pytest.MonkeyPatch, unlike: bool
) -> None:
    """Of stretches of spread frames, whose places nothing else shows, errors were up to four times the test's."""
    monkeypatch.setattr(fine_tuning, "_UNLIKE", 0.0 if unlike else np.inf)
    # All layers are kept, whatever they err by.
    monkeypatch.setattr(fine_tuning, "_CLEARLY", np.inf)
    monkeypatch.setattr(fine_tuning, "_SURE", 0.0)
    # Interpolated residuals make widths relative to their deviations.
    monkeypatch.setattr(kernel, "_WORTH", 0.0)
    sure, unsure = (
        adapt(base, labelled(other(900, 10, reach=0.2), gaze_x_std=wide, gaze_y_std=wide), seconds=20, epochs=1)
        for wide in (np.full(910, 0.03), np.full(910, 0.13))
    )
    told = sure.training_ or {}
    assert told["adapted_from"]["frames"] == 300 and told["fitted"] == 249
    assert "single frames of the film" in told["intervals"]
    assert told["calibrated_on"] == (51 if unlike else 34) and told["embargo"] == 0
    # Neighbours may share the error of their labels, so that it is added.
    np.testing.assert_allclose(unsure.intervals_.half_width, sure.intervals_.half_width + 0.1, rtol=0, atol=1e-4)
    # Labels of unknown deviation, that reach other frames, are divided by stretches, and so is a whole film.
    for kept in (adapt(base, other(900, 10, reach=0.2), seconds=20, epochs=1), adapt(base, other(300, 10), epochs=1)):
        assert "stretches of the film" in (kept.training_ or {})["intervals"]


def test_single_frames_of_spread_ones_lie_as_near_to_the_others_as_a_test_does_and_stretches_do_not() -> None:
    """So errors on the one are those of a test, in a hand's films, and on the other larger."""
    nearest: list[tuple[float, float, float]] = []
    for seed in range(8):
        gaze = HandMotion(extent=0.48).draw(seed, seconds=135).gaze(np.arange(2025) / RATE)
        film, test = gaze[:1560], gaze[1640:]
        chosen = film[spread_over(film, 450, seed)]
        single, stretch = single_frames(450, 76, seed), np.arange(450) * 24 // 450 % 6 == 0
        tree = KDTree(chosen[~single])
        left = KDTree(chosen[~stretch]).query(chosen[stretch])[0]
        nearest.append((tree.query(chosen[single])[0].mean(), tree.query(test)[0].mean(), left.mean()))
    one, tested, stretches = np.mean(nearest, axis=0)
    assert abs(one / tested - 1) < 0.1 and stretches > 1.25 * tested


def interrupted(base: NetworkEstimator, data: xr.Dataset, folder: Path, after: int) -> None:
    """Adapt, and stop as Ctrl-C does when so many loops have begun."""
    begun = 0

    def progress(items, what, *, total=None):
        nonlocal begun
        begun += "epoch" in what
        if begun > after:
            raise KeyboardInterrupt
        yield from items

    with pytest.raises(KeyboardInterrupt):
        adapt(base, data, epochs=1, checkpoint=folder, progress=progress)


@pytest.mark.parametrize(("frames", "unlike"), [(60, False), (300, False), (60, True), (300, True)])
def test_an_interrupted_adaptation_goes_on_to_the_same_result(
    base, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, frames: int, unlike: bool
) -> None:
    data, seen = other(frames, 10), list[str]()
    if unlike:
        monkeypatch.setattr(fine_tuning, "_UNLIKE", 0.0)
    whole = adapt(base, data, epochs=1)
    assert ("start" in (whole.training_ or {})["chosen"]) == unlike
    interrupted(base, data, tmp_path / "kept", 2 if frames == 60 else 0)

    def progress(items, what, *, total=None):
        seen.append(what)
        yield from items

    again = adapt(base, data, epochs=1, checkpoint=tmp_path / "kept", resume=True, progress=progress)
    for one, same in zip(whole.state().values(), again.state().values(), strict=True):
        assert torch.equal(one, same)
    if frames == 60:
        assert not any(what.startswith(("fold 1", "fold 2")) for what in seen)
        assert any(what.startswith("fold 3") for what in seen)
    with pytest.raises(InputError, match="other settings or other data"):
        adapt(base, other(frames, 10, seed=6), epochs=1, checkpoint=tmp_path / "kept", resume=True)


def bench_camera(focal: float) -> dict:
    return {"parameters": {"scene": {"target": {"lens": {"focal_length": focal}, "sensor": {}}}}}


def mixed(how: str) -> xr.Dataset:
    data, half = other(), np.arange(210) % 2
    if how == "units":
        data = labelled(data, unit=half)
        data["unit"].attrs["classes"] = ["mine", "yours"]
    elif how == "devices":
        data = labelled(data, device=half)
        data["device"].attrs["classes"] = ["left", "right"]
    elif how == "lenses":
        data = labelled(data, focal_length=np.where(half, 0.05, 0.085))
    else:
        import json

        data = labelled(data, recording=half)
        told = [{"name": "one", **bench_camera(0.05)}, {"name": "two", **bench_camera(0.1)}]
        data.attrs["recordings"] = json.dumps(told)
    return data


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("units", "2 copies of a camera mixed: mine, yours"),
        ("devices", "2 cameras mixed: left, right"),
        ("lenses", "several focal lengths mixed: 50 mm, 85 mm"),
        ("recordings", "two cameras mixed: one and two"),
    ],
)
def test_two_cameras_mixed_are_refused(base: NetworkEstimator, how: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        adapt(base, mixed(how), epochs=1)


def test_what_cannot_be_adapted_is_said(base: NetworkEstimator, small: xr.Dataset) -> None:
    data = other()
    ridge = ZernikeRidge("gaze", scales=(40,), order=2).fit(small)
    with pytest.raises(InputError, match=r"no trainable network \(zernike\)"):
        adapt(ridge, data)  # type: ignore[arg-type]
    devices = NetworkEstimator("device", **TINY)
    with pytest.raises(InputError, match="recognises devices"):
        adapt(devices, data)
    with pytest.raises(InputError, match="not fitted"):
        adapt(NetworkEstimator(**TINY), data)
    with pytest.raises(InputError, match="has no label gaze_x, which the model estimates"):
        adapt(base, dataset_from_arrays(pictures(30)[0], {"object_distance": np.linspace(3, 5, 30)}))
    with pytest.raises(InputError, match=r"asks for 30 s of film, the training frames are 4 s"):
        adapt(base, data, seconds=30)
    with pytest.raises(InputError, match="must be positive"):
        adapt(base, data, seconds=-1)
    with pytest.raises(InputError, match="does not know when its frames were taken"):
        adapt(base, data.drop_vars("time"), seconds=1)
    with pytest.raises(InputError, match="7 labelled frames are too few"):
        adapt(base, other(7))
    with pytest.raises(InputError, match="crops of 30 pixels, the model looks at 36"):
        adapt(base, data.isel(x=slice(0, 30), y=slice(0, 30)))
    with pytest.raises(InputError, match="share all measurements"):
        adapt(base, other(reach=100.0))
    with pytest.raises(InputError, match="resume needs"):
        adapt(base, data, resume=True)


def test_minutes_of_film_are_seen_as_often_as_half_a_minute_nearly() -> None:
    """With a minute and more each frame was once seen five times only, and the network was worse than before."""
    assert epochs_of(1500, 96) >= 12
    assert 17 == epochs_of(450, 96) >= epochs_of(1500, 96) >= epochs_of(10_000, 96) == 3


def test_another_lens_is_learned_from_half_a_minute_of_film_in_two_minutes() -> None:
    # 50 passes a second were measured on two slow cores.
    assert 4500 < epochs_of(450, 96, unlike=True) * 450 * 0.83 < 2 * 60 * 50
    assert epochs_of(1500, 96, unlike=True) == 8
