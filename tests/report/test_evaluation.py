"""Evaluations: what is gathered, the numbers of them, and the report."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
from scipy.stats import norm

from tapetum.data import dataset_from_arrays
from tapetum.errors import InputError
from tapetum.models import NONE_OF_THESE, Prediction, ZernikeRidge, crop_snr
from tapetum.report import html
from tapetum.report.evaluation import (
    Outcome,
    Subject,
    binned_errors,
    brier_score,
    by_device,
    by_recording,
    by_snr,
    confusion,
    describe,
    error_map,
    evaluate_model,
    gather,
    novelty_auroc,
    reliability,
    score,
    score_classes,
    top_1,
    write_evaluation,
)
from tapetum.report.evaluation.write import samples, subject_of

NAMES = ("A", "B", "C")


def opening(scores: dict[str, Any], name: str) -> str:
    return " ".join(html.render("evaluation_opening.html", scores=scores, name=name).split())


class Told:
    """A model that says what it was told to say."""

    kind = "told"
    data_hash_ = None

    def __init__(self, prediction: Prediction) -> None:
        self.prediction, self.quantities = prediction, prediction.names
        self.target_names = (*prediction.names, *(("device",) if prediction.classes else ()))

    def predict(self, data: Any, **_: Any) -> Prediction:
        return self.prediction

    def parameters(self) -> dict[str, Any]:
        return {"target": list(self.target_names), "strength": 3}


def outcome_of(truth: Mapping[str, np.ndarray], value: np.ndarray, half: np.ndarray | float, **more: Any) -> Outcome:
    count = len(value)
    given: dict[str, Any] = {
        "dataset": "made.zarr",
        "recording": np.zeros(count, dtype=int),
        "recordings": ("one", "two", "three"),
        "time": np.arange(count) / 15,
        "snr": np.linspace(5, 50, count),
        "guess": dict.fromkeys(truth, 0.0),
    }
    classes = {key: more.pop(key) for key in ("classes", "probability", "novelty") if key in more}
    return Outcome(
        prediction=Prediction(tuple(truth), value, value - half, value + half, **classes), truth=truth, **given | more
    )


def gaze_outcome(count: int = 4000, seed: int = 0, **more: Any) -> Outcome:
    """Normal errors of deviation 0.05 in two recordings, with intervals of 90 %."""
    rng = np.random.default_rng(seed)
    gaze = rng.uniform(-0.5, 0.5, (count, 2))
    value = gaze + 0.05 * rng.normal(size=gaze.shape)
    given = {"recording": (np.arange(count) >= count // 4).astype(int), **more}
    return outcome_of({"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}, value, 0.05 * norm.ppf(0.95), **given)


def focus_outcome() -> Outcome:
    """Three focal lengths, two distances, ten frames of each; the error is known in each cell."""
    f = np.repeat([0.05, 0.085, 0.135], 20)
    d = np.tile(np.repeat([3.0, 5.0], 10), 3)
    value = np.stack([d + 0.1 * d * np.resize([1, -1], 60), f], axis=1)
    return outcome_of({"object_distance": d, "focal_length": f}, value, np.array([1.0, 0.01]))


def device_outcome(seed: int = 0, count: int = 3000) -> Outcome:
    """Three known devices and a strange one; probabilities are right as often as they say."""
    rng = np.random.default_rng(seed)
    probability = rng.dirichlet((0.3, 0.3, 0.3), count)
    truth = np.array([NAMES[rng.choice(3, p=row)] for row in probability])
    truth[-count // 4 :] = "D"
    novelty = np.where(truth == "D", 1.5, 0.5) + 0.5 * rng.normal(size=count)
    empty = np.empty((count, 0))
    prediction = Prediction((), empty, empty, empty, NAMES, probability, novelty)
    return Outcome(
        "devices.zarr",
        prediction,
        {},
        np.zeros(count, dtype=int),
        ("one",),
        np.arange(count) / 15,
        np.ones(count),
        device=tuple(truth.tolist()),
        commonest="A",
    )


@pytest.fixture(scope="module")
def small() -> xr.Dataset:
    """Spots whose width tells a focal length: 60 to train, 20 to test, in two recordings."""
    rng = np.random.default_rng(1)
    width = rng.uniform(2, 5, 80)
    at = np.arange(40) - 19.5
    images = 10 + 150 * np.exp(-(at[:, None] ** 2 + at**2) / (2 * width[:, None, None] ** 2))
    images = np.clip(images + rng.normal(0, 2, images.shape), 0, 255).astype(np.uint8)
    recording = np.arange(80) % 2
    made = dataset_from_arrays(images, {"focal_length": width / 50}, split=np.arange(80) >= 60, recording=recording)
    scene = {"distance": 5.5, "probe": {"sensor": {"exposure": 0.004}}}
    told = [{"name": "near", "parameters": {"scene": scene}, "distance": 3.0}]
    told += [{"name": "far", "parameters": {"scene": scene}}]
    made.attrs["recordings"] = json.dumps(told)
    return made


@pytest.fixture(scope="module")
def ridge(small: xr.Dataset) -> ZernikeRidge:
    torch.set_num_threads(1)
    return ZernikeRidge("focal_length", scales=(40,), order=4, calibration_fraction=0.3).fit(small)


def test_gathers_what_is_known_of_the_test_frames(small: xr.Dataset, ridge: ZernikeRidge) -> None:
    found = gather(ridge, small)
    assert len(found) == 20 and found.quantities == ("focal_length",)
    assert found.truth["focal_length"] == pytest.approx(small.tp.test["focal_length"].values)
    assert found.snr == pytest.approx(crop_snr(np.asarray(small.tp.test["image"].values)))
    assert found.guess == {"focal_length": pytest.approx(float(small.tp.train["focal_length"].mean()))}
    # By the recording's own entry before the scene that the bench filmed.
    assert found.covariates["distance"].tolist() == [3.0, 5.5] * 10
    assert found.covariates["exposure"].tolist() == [0.004] * 20
    assert found.simulated and [one.name for one in by_recording(found)] == ["near", "far"]
    assert gather(ridge, small, covariates={"distance": np.ones(20)}).covariates["distance"].tolist() == [1.0] * 20
    assert found.true_gaze is None
    count = small.sizes["frame"]
    looked = small.assign(true_gaze_x=("frame", np.arange(count) / 1e3), true_gaze_y=("frame", -np.arange(count) / 1e3))
    told = gather(ridge, looked).true_gaze
    assert told is not None and told[0].tolist() == [0.06, -0.06] and told.shape == (20, 2)


def test_scores_agree_with_hand_made_ones_and_with_the_words(small: xr.Dataset, ridge: ZernikeRidge) -> None:
    told = evaluate_model(ridge, small.tp.test, small.tp.train)
    truth = small.tp.test["focal_length"].values.astype(float)
    value = ridge.predict(small.tp.test).value[:, 0]
    one = told["targets"]["focal_length"]
    assert one["mae"] == pytest.approx(np.abs(value - truth).mean())
    guess = float(small.tp.train["focal_length"].values.astype(float).mean())
    assert one["baseline_rmse"] == pytest.approx(np.sqrt(np.mean((truth - guess) ** 2)))
    assert one["mae"] < one["baseline_mae"]
    assert f"MAE {one['mae']:.4f}" in describe(told) and "20 test frames" in describe(told)
    json.dumps(told, allow_nan=False)


def test_without_training_frames_or_intervals_the_numbers_say_so(small: xr.Dataset) -> None:
    model = ZernikeRidge("focal_length", scales=(40,), order=2, calibration_fraction=0.0).fit(small)
    alone = small.copy()
    alone["split"] = ("frame", np.ones(80, dtype=np.int8))
    told = score(gather(model, alone))
    one = told["targets"]["focal_length"]
    assert (one["baseline_mae"], one["interval"]) == (None, None)
    assert "no intervals" in describe(told) and "predicting the mean" not in describe(told)
    json.dumps(told, allow_nan=False)


def test_what_cannot_be_evaluated_is_refused(small: xr.Dataset, ridge: ZernikeRidge) -> None:
    with pytest.raises(InputError, match="no test frames"):
        gather(ridge, small.isel(frame=slice(0, 60)))
    with pytest.raises(InputError, match="has no label focal_length"):
        gather(ridge, small.drop_vars("focal_length"))
    with pytest.raises(InputError, match="40 pixels does not fit crops of 30"):
        gather(ridge, small.isel(x=slice(0, 30), y=slice(0, 30)))
    bad = small.copy(deep=True)
    bad["focal_length"][70] = np.nan
    with pytest.raises(InputError, match="1 of 20 labels focal_length are no numbers"):
        gather(ridge, bad)
    one_class = dataset_from_arrays(np.ones((4, 9, 9), np.uint8), {"device": ["A"] * 4}, split=[0, 0, 1, 1])
    empty = np.empty((2, 0))
    told = Told(Prediction((), empty, empty, empty, NAMES, np.full((2, 3), 1 / 3), np.zeros(2)))
    with pytest.raises(InputError, match="all test frames show one class, A"):
        gather(told, one_class)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"true_gaze: expected shape \(3, 2\)"):
        outcome_of({"focal_length": np.ones(3)}, np.ones((3, 1)), 1.0, true_gaze=np.ones((3, 1)))
    with pytest.raises(InputError, match="expected 3 values"):
        outcome_of({"focal_length": np.ones(3)}, np.ones((3, 1)), 1.0, snr=np.ones(2))


def test_coverage_of_normal_errors_is_what_their_quantile_says() -> None:
    told = score(gaze_outcome())
    # The standard error of 4000 frames is 0.5 %.
    for part in (told["targets"]["gaze_x"], told["targets"]["gaze_y"]):
        assert part["coverage"] == pytest.approx(0.9, abs=0.015)
    assert told["targets"]["gaze_x"]["mae"] == pytest.approx(0.05 * np.sqrt(2 / np.pi), rel=0.04)
    assert [one["frames"] for one in told["recordings"]] == [1000, 3000]
    assert told["gaze"]["thirds"][0]["mae"] == pytest.approx(told["gaze"]["mae_overall"], rel=0.1)
    json.dumps(told, allow_nan=False)


def test_intervals_too_narrow_for_faint_frames_show_in_their_quarter() -> None:
    rng = np.random.default_rng(3)
    count = 4000
    value = np.where(np.arange(count) < 1000, 3.0, 1.0)[:, None] * rng.normal(size=(count, 1))
    found = by_snr(outcome_of({"focal_length": np.zeros(count)}, value, 1.645))
    assert [one.count for one in found] == [1000] * 4
    held = [one.coverage[0] for one in found]
    assert held[0] == pytest.approx(2 * norm.cdf(1.645 / 3) - 1, abs=0.04)
    assert held[1:] == pytest.approx([0.9] * 3, abs=0.03)
    assert found[0].mae[0] == pytest.approx(3 * found[1].mae[0], rel=0.15)


def test_error_map_averages_each_cell() -> None:
    found = error_map(focus_outcome(), "object_distance")
    assert found.x.tolist() == [3.0, 5.0] and found.y.tolist() == [0.05, 0.085, 0.135]
    assert found.mae == pytest.approx(np.tile([0.3, 0.5], (3, 1)))
    assert found.count.tolist() == [[10, 10]] * 3
    with pytest.raises(InputError, match="too many for a map"):
        error_map(gaze_outcome(100), "gaze_x", "gaze_x", "gaze_y")
    with pytest.raises(InputError, match="gaze_x: is not among"):
        error_map(focus_outcome(), "gaze_x")


def test_errors_in_bins_average_to_the_whole_and_know_their_neighbours() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=900)
    shared = np.repeat(np.abs(rng.normal(size=60)), 15)
    blocks, single = binned_errors(x, shared), binned_errors(x, shared, block=1)
    assert len(blocks.x) == 8 and blocks.count.sum() == 900 and np.ptp(blocks.count) <= 1
    assert float(np.average(blocks.mean, weights=blocks.count)) == pytest.approx(shared.mean())
    assert ((blocks.low <= blocks.mean) & (blocks.mean <= blocks.high)).all()
    one = np.ones(900)
    assert (binned_errors(one, shared).high - binned_errors(one, shared).low)[0] > 2.5 * (
        binned_errors(one, shared, block=1).high - binned_errors(one, shared, block=1).low
    )[0]
    assert single.mean == pytest.approx(blocks.mean)
    few = binned_errors([3, 5, 3, 8], [1.0, 2.0, 3.0, 4.0])
    assert few.x.tolist() == [3, 5, 8] and few.mean.tolist() == [2, 2, 4]
    with pytest.raises(InputError, match="two finite columns"):
        binned_errors([1.0, np.nan], [1.0, 1.0])


def test_calibration_error_is_small_where_honest_and_the_excess_where_not() -> None:
    rng = np.random.default_rng(4)
    sure = rng.uniform(0.5, 1.0, 20_000)
    right = rng.uniform(size=20_000) < sure
    assert reliability(sure, right).error < 0.015
    # Right 10 points less often than it says.
    assert reliability(sure, rng.uniform(size=20_000) < sure - 0.1).error == pytest.approx(0.1, abs=0.01)
    assert len(reliability(sure, right).count) == 15 and np.ptp(reliability(sure, right).count) <= 1


def test_frames_equally_sure_count_alike_whatever_their_order() -> None:
    right = np.arange(100) < 90
    assert reliability(np.full(100, 0.9), right).error == pytest.approx(0.0, abs=1e-12)
    assert reliability(np.ones(100), right).error == pytest.approx(0.1)
    with pytest.raises(InputError, match="probabilities"):
        reliability([1.5], [True])


def test_class_measures_of_known_cases() -> None:
    assert top_1(["A", "B", "B"], ["A", "B", "C"]) == pytest.approx(2 / 3)
    assert confusion(["A", "B", "B"], ["A", "B", "C"], NAMES).tolist() == [[1, 0, 0], [0, 1, 1], [0, 0, 0]]
    assert brier_score([[0.8, 0.2], [0.3, 0.7]], ["A", "A"], ("A", "B")) == pytest.approx((0.08 + 0.98) / 2)
    rng = np.random.default_rng(5)
    strange = np.arange(8000) >= 4000
    # Two normal distributions one deviation apart.
    assert novelty_auroc(rng.normal(size=8000) + strange, strange) == pytest.approx(norm.cdf(1 / np.sqrt(2)), abs=0.015)
    assert novelty_auroc([1.0, 2.0], [False, False]) is None
    with pytest.raises(InputError, match="'D' is not among the classes"):
        confusion(["D"], ["A"], NAMES)


def test_classes_are_scored_among_known_devices_only() -> None:
    found = score_classes(device_outcome())
    assert found is not None
    assert found.count == 2250 and found.unknown == 750 and found.confusion.sum() == 2250
    assert found.top_1 == pytest.approx(np.trace(found.confusion) / 2250)
    # Probabilities are honest: it is right as often as it is sure.
    sure = device_outcome().prediction.device_probability[:2250].mean()
    assert found.top_1 == pytest.approx(sure, abs=0.03)
    assert found.reliability.error < 0.03
    assert found.auroc == pytest.approx(norm.cdf(np.sqrt(2)), abs=0.02)
    # Novelty of known devices is 0.5 +- 0.5, of the strange one 1.5 +- 0.5: a sixth of each lies beyond 1.
    assert found.told_none == pytest.approx(norm.cdf(-1), abs=0.03)
    assert found.unknown_told_none == pytest.approx(norm.cdf(1), abs=0.04)
    told = score(device_outcome())
    assert told["classes"]["baseline_top_1"] == pytest.approx(1 / 3, abs=0.05)
    assert "AUROC" in describe(told) and f"{found.top_1:.2%} right" in describe(told)
    json.dumps(told, allow_nan=False)


def test_devices_that_the_model_never_learned_alone_are_refused() -> None:
    one = device_outcome(count=100)
    with pytest.raises(InputError, match="none of the devices that the model knows"):
        score(Outcome(**{**vars(one), "device": ("D", "E") * 50}))


def test_gaze_by_device_is_the_papers_second_table() -> None:
    count = 400
    device = ("A",) * 200 + ("B",) * 200
    gaze = np.zeros((count, 2))
    value = gaze + np.where(np.arange(count) < 200, 0.1, 0.02)[:, None]
    one = outcome_of({"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}, value, 0.05, device=device)
    assert [(found.name, found.mae[0], found.coverage[0]) for found in by_device(one)] == [
        ("A", pytest.approx(0.1), 0.0),
        ("B", pytest.approx(0.02), 1.0),
    ]
    assert by_device(gaze_outcome(100)) == []


CASES = {
    "gaze": (lambda: gaze_outcome(300, covariates={"distance": np.resize([3.0, 5.0], 300)}, simulated=True)),
    "focus": focus_outcome,
    "devices": lambda: device_outcome(count=400),
}
DRAWN = {
    "gaze": {"path", "error-over-field", "coverage", "error-by-snr", "error-by-distance"},
    "focus": {"by-image", "error-map", "coverage", "error-by-snr"},
    "devices": {"confusion", "reliability"},
}


@pytest.mark.parametrize("case", CASES)
def test_report_holds_its_figures_and_asks_nothing_of_any_network(case: str, tmp_path: Path) -> None:
    outcome = CASES[case]()
    subject = Subject("My <model>", [("kind", "told")], [("dataset", "made")], "tapetum evaluate m s -o r")
    told = write_evaluation(tmp_path / "r", outcome, subject)
    page = (tmp_path / "r" / "report.html").read_text()
    assert {path.stem for path in (tmp_path / "r").glob("*.png")} == DRAWN[case]
    assert page.count("<img") == page.count("data:image/png;base64") == len(DRAWN[case])
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    assert "My &lt;model&gt;" in page and "<model>" not in page
    assert ("Simulation: the virtual bench" in page) == (case == "gaze")
    kept = json.loads((tmp_path / "r" / "numbers.json").read_text())
    assert kept == json.loads(json.dumps(told)) and kept["format"] == "tapetum-evaluation"
    assert [path.name for path in tmp_path.iterdir()] == ["r"]
    with pytest.raises(InputError, match="exists already"):
        write_evaluation(tmp_path / "r", outcome, subject)


def test_an_interrupted_report_leaves_nothing(tmp_path: Path) -> None:
    def stop(items: Any, what: str, *, total: int | None = None) -> Any:
        yield next(iter(items))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_evaluation(tmp_path / "deep" / "r", focus_outcome(), Subject("M"), progress=stop)
    assert not list(tmp_path.iterdir())


def test_a_model_no_better_than_a_guess_is_called_so() -> None:
    gaze = gaze_outcome(100)
    useless = outcome_of(gaze.truth, np.full((100, 2), 0.001), 0.5)
    for name, outcome in (("good", gaze), ("useless", useless)):
        said = opening(score(outcome), "M")
        assert ("Do not use such estimates" in said) == (name == "useless")
        assert ("M errs less" in said) == (name == "good")


def test_subject_says_what_the_model_learned_from(small: xr.Dataset, ridge: ZernikeRidge) -> None:
    told = dict(subject_of(ridge, small, card={"notes": {"seed": 3}}).model)
    assert told["kind"] == "Zernike + ridge" and told["notes"] == "seed: 3"
    assert told["learned from"] == "the training part of this dataset"
    other = small.assign(focal_length=small["focal_length"] * 2).assign_attrs(
        synth={"kind": "rotation", "size": "small", "seed": 1}
    )
    assert dict(subject_of(ridge, other).model)["learned from"].startswith("another dataset")
    assert "dataset synth rotation --size small --seed 1" in dict(subject_of(ridge, other).data)["filmed by"]


def test_samples_run_from_the_highest_gaze_to_the_lowest() -> None:
    rng = np.random.default_rng(0)
    y = np.linspace(0.3, -0.3, 30)
    images = np.zeros((30, 9, 9), np.uint8)
    images[:, 4, 4] = np.arange(30)
    x = rng.uniform(-0.3, 0.3, 30)
    data = dataset_from_arrays(images, {"gaze_x": x, "gaze_y": y}, split=np.ones(30))
    one = outcome_of({"gaze_x": x, "gaze_y": y}, np.zeros((30, 2)), 1.0)
    rrs, at = samples(one, data)
    assert at == [29, 15, 0] or at == [29, 14, 0]
    assert [int(rr[4, 4]) for rr in rrs] == at


def test_none_of_these_is_no_class() -> None:
    found = score_classes(device_outcome(count=200))
    assert found is not None and NONE_OF_THESE not in found.names


def test_a_model_worse_than_the_mean_is_called_that() -> None:
    rng = np.random.default_rng(0)
    gaze = rng.uniform(-0.5, 0.5, (600, 2))
    truth = {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1]}
    # x is estimated well, y is off by more than the field; the intervals fit x alone.
    value = gaze + rng.normal(0, 1, gaze.shape) * np.array([0.02, 0.6])
    told = score(outcome_of(truth, value, 0.02 * norm.ppf(0.95)))
    x, y = told["targets"]["gaze_x"], told["targets"]["gaze_y"]
    assert (x["verdict"], y["verdict"]) == ("better than the training mean", "worse than the training mean")
    assert (x["intervals"], y["intervals"]) == ("as wide as they should be", "too narrow")
    lines = describe(told).splitlines()
    assert "worse than the training mean" in lines[2] and "too narrow" in lines[2] and "worse" not in lines[1]
    assert lines[-1] == "gaze_y: no better than a guess that looks at no image; do not use such estimates"
    apart = np.hypot(*(value - gaze).T)
    assert f"gaze, distance: mean {apart.mean():.4f}, RMS {np.sqrt((apart**2).mean()):.4f}" in lines[3]
    assert told["gaze"]["radial"] == pytest.approx(apart.mean())
    said = opening(told, "M")
    assert "worse than the training mean" in said and "hold too few true values" in said
    # Better by the mean error, worse by its square: a few wild estimates.
    wild = gaze + 0.02 * rng.normal(size=gaze.shape)
    wild[:12] += 5
    assert score(outcome_of(truth, wild, 1.0))["targets"]["gaze_x"]["verdict"] == "worse than the training mean"
    hardly = score(outcome_of(truth, 0.05 * gaze, 1.0))["targets"]["gaze_x"]
    assert hardly["verdict"] == "hardly better than the training mean"


def test_the_map_says_where_the_error_is_largest() -> None:
    from tapetum.report.evaluation.pictures import pictures

    caption = next(one.caption for one in pictures(focus_outcome(), "M") if one.name == "error-map")
    assert "least accurate at focal length 50 mm, object distance 5 m: 0.5 m" in caption and "hardly" not in caption
