"""Figs. 9 to 12 and Tables 1 and 2: the models' errors on the three sets, with the Cramér-Rao limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tapetum.data.synth import make_plan
from tapetum.data.synth.plan import FOCAL_LENGTHS, OBJECT_DISTANCES
from tapetum.experiments.workshop import RECIPES, SET_SEED, Workshop
from tapetum.report.binned import ErrorByDistance, error_by_distance
from tapetum.report.evaluation import Outcome, by_device, error_map, score
from tapetum.report.evaluation.pictures import path_section
from tapetum.report.evaluation.write import samples
from tapetum.report.figures.by_image import fig_by_image
from tapetum.report.figures.errors import fig_error_by_distance
from tapetum.report.figures.maps import fig_error_map
from tapetum.report.figures.path import fig_path
from tapetum.report.verdicts import MEAN
from tapetum.simulate.bounds import (
    ALL_UNKNOWN,
    FRAME,
    focus_bounds,
    gaze_information,
    rings_of_gazes,
)

__all__ = ["FOCUS_MODELS", "ROTATION_MODELS", "fig9", "fig10", "fig11", "fig12", "table1", "table2"]

ROTATION_MODELS = ("rotation-resnet18", "rotation-zernike", "rotation-zernike-tuned")
FOCUS_MODELS = ("focusing-resnet18", "focusing-zernike", "focusing-zernike-tuned")
PHONES_MODEL = "phones-resnet18"

GUESS = MEAN
RADIAL = "radial"
"""Name of the distance between estimated and true gaze, in place of a quantity."""
# Rings of the field; the corner lies at 0.707.
_RINGS = np.array([0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.71])
# The bound is computed up to here; the corners return no light.
_BOUND_AT = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45)
CENTRE = 0.25
"""Distance from the centre, in fractions of the field, of the centre half."""

Array = NDArray[np.float64]
# The paper's name, the quantity, its unit, and the numbers in the paper's text.
Task = tuple[str, str, str, str | None]


def _rows(outcome: Outcome, model: str, tasks: Sequence[Task]) -> list[dict[str, Any]]:
    told, rows = score(outcome), list[dict[str, Any]]()
    for task, quantity, unit, printed in tasks:
        if quantity == RADIAL:
            gaze, guess = told["gaze"], told.get("baseline_gaze", {})
            errors = gaze["radial"], gaze["radial_rms"], guess.get("radial"), guess.get("radial_rms"), None
        else:
            one = told["targets"][quantity]
            held = one["coverage"] if one["interval"] is not None else None
            errors = one["mae"], one["rmse"], one["baseline_mae"], one["baseline_rmse"], held
        measured = zip(("mae", "rmse", "guess_mae", "guess_rmse", "coverage"), errors, strict=True)
        about = {"task": task, "model": model, "unit": unit, "frames": len(outcome)}
        rows.append({**about, **dict(measured), "printed": printed})
    return rows


def table1(work: Workshop) -> dict[str, Any]:
    """Return the `rows` of Table 1 and `classes`, the scores of the phone classification.

    A row has its `task` as the paper calls it, `model`, `unit` of the errors, `frames` scored, `mae`, `rmse`,
    `guess_mae` and `guess_rmse` of predicting the training part's mean, `coverage` (None without intervals), and the
    `printed` numbers of the paper's text (its table is an image that is not available).
    """
    field, said = "fraction of the field", "MAE 0.095, the axes not separated"

    def of_gaze(name: str, printed: str | None) -> list[Task]:
        axes: list[Task] = [(f"{name}, {axis}", f"gaze_{axis}", field, printed) for axis in "xy"]
        return [*axes, (f"{name}, distance", RADIAL, field, None)]

    focus: list[Task] = [("object distance", "object_distance", "m", None), ("focal length", "focal_length", "m", None)]
    tasks: dict[str, list[Task]] = dict.fromkeys(ROTATION_MODELS, of_gaze("rotation", None))
    tasks |= dict.fromkeys(FOCUS_MODELS, focus) | {PHONES_MODEL: of_gaze("phones", said)}
    rows = [row for name, wanted in tasks.items() for row in _rows(work.outcome(name), RECIPES[name].title, wanted)]
    return {"rows": rows, "classes": score(work.outcome(PHONES_MODEL))["classes"]}


def table2(work: Workshop) -> dict[str, Any]:
    """Return the errors of the gaze for each of the `phones`, as in `tapetum.report.evaluation.Group`."""
    return {"phones": [asdict(one) for one in by_device(work.outcome(PHONES_MODEL))]}


def fig9(work: Workshop) -> tuple[Figure, dict[str, Any]]:
    """Draw the path of the gaze over the field, and x and y of all test frames."""
    outcome = work.outcome(ROTATION_MODELS[0])
    truth, said = outcome.pair()
    rrs, at = samples(outcome, work.dataset("rotation"))
    figure = fig_path(
        truth,
        said,
        lower=outcome.prediction.lower,
        upper=outcome.prediction.upper,
        recording=outcome.recording,
        section=path_section(outcome),
        rrs=rrs,
        rrs_at=at,
        name="ResNet-18",
    )
    error = np.hypot(*(said - truth).T)
    told = score(outcome)
    held = [told["targets"][axis]["coverage"] for axis in ("gaze_x", "gaze_y")]
    numbers = {**told["gaze"], "guess": told.get("baseline_gaze"), "worst": float(error.max()), "coverage": held}
    return figure, {"frames": len(outcome), **numbers}


LIMIT, FINE_LIMIT = "Cramér–Rao limit", "the same, photosites known"


def fig10(work: Workshop) -> tuple[Figure, dict[str, Any]]:
    """Draw the error by distance from the centre for all models, with the Cramér-Rao limit of one frame.

    The numbers are the rings' `errors` by model; the `limits` by prior knowledge; `rmse_over_limit`, ResNet-18's RMSE
    over the first limit at that limit's distances (None without frames); and the same for all frames of the `centre`
    half, with the labels' own error there (None where the true gaze is not known).
    """
    outcomes = {RECIPES[name].title: work.outcome(name) for name in ROTATION_MODELS}
    errors = {title: error_by_distance(*outcome.pair(), edges=_RINGS) for title, outcome in outcomes.items()}
    first = next(iter(outcomes.values()))
    truth, said = first.pair()
    if first.baseline is not None:
        errors[GUESS] = error_by_distance(truth, first.baseline, edges=_RINGS)
    scene = make_plan("rotation", "small", SET_SEED).videos[0].scene
    told = gaze_information(scene, rings_of_gazes(_BOUND_AT), progress=work.progress)
    limits = {LIMIT: told.curve(ALL_UNKNOWN), FINE_LIMIT: told.curve(FRAME)}
    figure = fig_error_by_distance(
        errors,
        baseline=GUESS if GUESS in errors else None,
        bounds={name: (one.distance, one.mae) for name, one in limits.items()},
        log=True,
    )
    # The limit applies to the true gaze, without the label error.
    looked = truth if first.true_gaze is None else first.true_gaze
    distance = np.hypot(*looked.T)
    square = np.square(said - looked).mean(axis=1)
    limit = limits[LIMIT]
    width = float(np.diff(limit.distance).min()) / 2
    near = [np.abs(distance - at) <= width for at in limit.distance]
    rmse = np.array([_rms_of(square[one]) for one in near])
    centre = distance < CENTRE
    # The limit at each frame's own gaze.
    own = np.interp(distance[centre], limit.distance, limit.rms)
    centre_rmse = _rms_of(square[centre])
    return figure, {
        "errors": {name: _rings(one) for name, one in errors.items()},
        "limits": {
            name: {"distance": one.distance.tolist(), "rms": plain(one.rms), "mae": plain(one.mae)}
            for name, one in limits.items()
        },
        "rmse_over_limit": plain(rmse / limit.rms),
        "centre": {
            "below": CENTRE,
            "rmse": centre_rmse,
            "over_limit": centre_rmse / _rms_of(np.square(own)),
            "label_rmse": None if first.true_gaze is None else _rms_of(np.square(truth - looked)[centre]),
        },
    }


def _rings(one: ErrorByDistance) -> dict[str, Any]:
    ends = {"mae": plain(one.mae), "low": plain(one.low), "high": plain(one.high)}
    return {"edges": one.edges.tolist(), "frames": one.count.tolist(), **ends}


def _rms_of(squares: Array) -> float:
    return float(np.sqrt(squares.mean())) if squares.size else float("nan")


def fig11(work: Workshop) -> tuple[Figure, dict[str, Any]]:
    """Draw the predicted object distance and focal length by test image."""
    outcomes = {RECIPES[name].title: work.outcome(name) for name in FOCUS_MODELS[:2]}
    first = next(iter(outcomes.values()))
    interval = {
        name: (first.prediction.lower[:, k], first.prediction.upper[:, k]) for k, name in enumerate(first.quantities)
    }
    predicted = {
        title: {name: outcome.prediction[name] for name in outcome.quantities} for title, outcome in outcomes.items()
    }
    figure = fig_by_image(first.truth, predicted, interval=interval)
    return figure, {"models": {title: score(outcome)["targets"] for title, outcome in outcomes.items()}}


def fig12(work: Workshop) -> tuple[Figure, dict[str, Any]]:
    """Map the error of ResNet-18 over object distance and focal length, with the Cramér-Rao limit of one frame.

    `mae` and `limit_mae` are [F, D] by quantity, in metres, over `focal_lengths` and `object_distances`; None without
    frames.
    """
    outcome = work.outcome(FOCUS_MODELS[0])
    maps = {name: error_map(outcome, name) for name in outcome.quantities}
    scene = make_plan("focusing", "small", SET_SEED).videos[0].scene
    limits = focus_bounds(scene, OBJECT_DISTANCES, FOCAL_LENGTHS, workers=work.workers or 1, progress=work.progress)
    bounds = {name: limits.mae[:, :, k].T for k, name in enumerate(maps)}
    figure = fig_error_map({RECIPES[FOCUS_MODELS[0]].title: maps}, bounds=bounds)
    one = next(iter(maps.values()))
    return figure, {
        "object_distances": one.x.tolist(),
        "focal_lengths": one.y.tolist(),
        "mae": {name: plain(each.mae) for name, each in maps.items()},
        "limit_mae": {name: plain(values) for name, values in bounds.items()},
    }


def plain(values: Array) -> list[Any]:
    """Return an array as lists; NaN and infinity become None."""
    told = values.astype(object)
    told[~np.isfinite(values)] = None
    return told.tolist()
