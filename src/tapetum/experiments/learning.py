"""Figs. 9 to 12 and Tables 1 and 2: what the models make of the three sets, beside the Cramér-Rao limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tapetum.data.synth import make_plan
from tapetum.data.synth.plan import FOCAL_LENGTHS, OBJECT_DISTANCES
from tapetum.experiments.workshop import RECIPES, SET_SEED, Workshop
from tapetum.report.evaluation import Group, Outcome, by_device, error_map, score
from tapetum.report.evaluation.pictures import path_section
from tapetum.report.evaluation.write import samples
from tapetum.report.figures.errors import fig_error_by_distance
from tapetum.report.figures.learning import fig_by_image, fig_path
from tapetum.report.figures.maps import fig_error_map
from tapetum.report.rings import ErrorByDistance, error_by_distance
from tapetum.report.verdicts import MEAN
from tapetum.simulate.bounds import (
    ALL_UNKNOWN,
    FRAME,
    FocusBounds,
    GazeBound,
    focus_bounds,
    gaze_information,
    rings_of_gazes,
)

__all__ = ["FOCUS_MODELS", "ROTATION_MODELS", "Fig10", "Fig12", "Row", "fig9", "fig10", "fig11", "fig12"]
__all__ += ["table1", "table2"]

ROTATION_MODELS = ("rotation-resnet18", "rotation-zernike", "rotation-zernike-tuned")
FOCUS_MODELS = ("focusing-resnet18", "focusing-zernike", "focusing-zernike-tuned")
PHONES_MODEL = "phones-resnet18"

GUESS = MEAN
RADIAL = "radial"
"""The distance between the gaze estimated and the true one, in place of a quantity."""
# Rings of the field; the corner lies at 0.707.
_RINGS = np.array([0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.71])
# Where the bound is computed, and no farther: nothing returns from the corners.
_BOUND_AT = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45)
CENTRE = 0.25
"""Distance from the centre, in fractions of the field, of the centre half."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One task and model of Table 1.

    Parameters
    ----------
    task
        As the paper calls it.
    model
        Its title.
    unit
        Of the errors.
    frames
        Scored.
    mae, rmse
        Measured here.
    guess_mae, guess_rmse
        Of predicting the training part's mean.
    coverage
        Share of truths in the 90 % intervals; None where the model has none.
    printed
        What the paper's text says; its table is a picture that is not at hand. None where it says nothing.
    """

    task: str
    model: str
    unit: str
    frames: int
    mae: float
    rmse: float
    guess_mae: float | None
    guess_rmse: float | None
    coverage: float | None
    printed: str | None = None


def _rows(outcome: Outcome, model: str, tasks: Sequence[tuple[str, str, str, str | None]]) -> list[Row]:
    told, count = score(outcome), len(outcome)
    rows: list[Row] = []
    for task, quantity, unit, printed in tasks:
        if quantity == RADIAL:
            gaze, guess = told["gaze"], told.get("baseline_gaze", {})
            errors = gaze["radial"], gaze["radial_rms"], guess.get("radial"), guess.get("radial_rms")
            rows.append(Row(task, model, unit, count, *errors, None, printed))
            continue
        one = told["targets"][quantity]
        held = one["coverage"] if one["interval"] is not None else None
        errors = one["mae"], one["rmse"], one["baseline_mae"], one["baseline_rmse"]
        rows.append(Row(task, model, unit, count, *errors, held, printed))
    return rows


def table1(work: Workshop) -> tuple[list[Row], dict[str, Any]]:
    """Return the rows of Table 1, and the scores of the phones' classes."""
    rows: list[Row] = []
    field = "fraction of the field"
    gaze = [("rotation, x", "gaze_x", field, None), ("rotation, y", "gaze_y", field, None)]
    gaze.append(("rotation, distance", RADIAL, field, None))
    focus = [("object distance", "object_distance", "m", None), ("focal length", "focal_length", "m", None)]
    for name in ROTATION_MODELS:
        rows += _rows(work.outcome(name), RECIPES[name].title, gaze)
    for name in FOCUS_MODELS:
        rows += _rows(work.outcome(name), RECIPES[name].title, focus)
    phones = work.outcome(PHONES_MODEL)
    printed = "MAE 0.095, the axes not separated"
    tasks: list[tuple[str, str, str, str | None]] = [
        ("phones, x", "gaze_x", field, printed),
        ("phones, y", "gaze_y", field, printed),
        ("phones, distance", RADIAL, field, None),
    ]
    rows += _rows(phones, RECIPES[PHONES_MODEL].title, tasks)
    return rows, score(phones)["classes"]


def table2(work: Workshop) -> list[Group]:
    """Return the errors of each phone's gaze (x, y)."""
    return by_device(work.outcome(PHONES_MODEL))


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
    numbers = {**told["gaze"], "guess": told.get("baseline_gaze"), "worst": float(error.max())}
    return figure, {"frames": len(outcome), **numbers}


@dataclass(frozen=True)
class Fig10:
    """Errors of the gaze by distance from the centre, and their limits.

    Parameters
    ----------
    errors
        By model.
    limits
        Of one frame, by what an estimate knows beforehand.
    ratio
        [R] RMSE of ResNet-18 over the first limit, at that limit's distances; NaN where there is no frame.
    centre_rmse, centre_ratio
        Of ResNet-18 in the centre half of the field, and over the first limit there.
    label_rmse
        Of the labels themselves there; None where the true gaze is not known, and labels stand in for it.
    """

    errors: dict[str, ErrorByDistance]
    limits: dict[str, GazeBound]
    ratio: Array
    centre_rmse: float
    centre_ratio: float
    label_rmse: float | None

    def numbers(self) -> dict[str, Any]:
        """Everything measured, fit for JSON."""
        rings = {
            name: {
                "edges": one.edges.tolist(),
                "frames": one.count.tolist(),
                "mae": plain(one.mae),
                "low": plain(one.low),
                "high": plain(one.high),
            }
            for name, one in self.errors.items()
        }
        limits = {
            name: {"distance": one.distance.tolist(), "rms": plain(one.rms), "mae": plain(one.mae)}
            for name, one in self.limits.items()
        }
        centre = {
            "below": CENTRE,
            "rmse": self.centre_rmse,
            "over_limit": self.centre_ratio,
            "label_rmse": self.label_rmse,
        }
        return {"errors": rings, "limits": limits, "rmse_over_limit": plain(self.ratio), "centre": centre}


LIMIT, FINE_LIMIT = "Cramér–Rao limit", "the same, photosites known"


def fig10(work: Workshop) -> tuple[Figure, Fig10]:
    """Draw the error by distance from the centre for all models, with the Cramér-Rao limit."""
    outcomes = {RECIPES[name].title: work.outcome(name) for name in ROTATION_MODELS}
    errors: dict[str, ErrorByDistance] = {}
    for title, outcome in outcomes.items():
        truth, said = outcome.pair()
        errors[title] = error_by_distance(truth, said, edges=_RINGS)
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
    # The limit is of the distance from where the target looked, to which the labels' own error would be added.
    looked = truth if first.true_gaze is None else first.true_gaze
    distance = np.hypot(*looked.T)
    square = np.square(said - looked).mean(axis=1)
    limit = limits[LIMIT]
    width = float(np.diff(limit.distance).min()) / 2
    near = [np.abs(distance - at) <= width for at in limit.distance]
    rmse = np.array([np.sqrt(square[one].mean()) if one.any() else np.nan for one in near])
    centre = distance < CENTRE
    # The limit of each frame of the centre half, not that of some place in it.
    own = np.interp(distance[centre], limit.distance, limit.rms)
    centre_rmse = float(np.sqrt(square[centre].mean())) if centre.any() else float("nan")
    ratio = centre_rmse / float(np.sqrt(np.square(own).mean())) if centre.any() else float("nan")
    label_rmse = None if first.true_gaze is None else float(np.sqrt(np.square(truth - looked)[centre].mean()))
    return figure, Fig10(errors, limits, rmse / limit.rms, centre_rmse, ratio, label_rmse)


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
    return figure, {title: score(outcome)["targets"] for title, outcome in outcomes.items()}


@dataclass(frozen=True)
class Fig12:
    """Errors of ResNet-18 over object distance and focal length, and their limits.

    Parameters
    ----------
    mae
        [F, D] by quantity, in metres; NaN where there is no frame.
    limits
        Of one frame.
    object_distances, focal_lengths
        [D], [F] in metres.
    """

    mae: dict[str, Array]
    limits: FocusBounds
    object_distances: Array
    focal_lengths: Array

    def numbers(self) -> dict[str, Any]:
        """Everything measured, fit for JSON."""
        limits = {name: plain(self.limits.mae[:, :, k].T) for k, name in enumerate(self.mae)}
        return {
            "object_distances": self.object_distances.tolist(),
            "focal_lengths": self.focal_lengths.tolist(),
            "mae": {name: plain(values) for name, values in self.mae.items()},
            "limit_mae": limits,
        }


def fig12(work: Workshop) -> tuple[Figure, Fig12]:
    """Map the error of ResNet-18 over object distance and focal length, with the Cramér-Rao limit."""
    outcome = work.outcome(FOCUS_MODELS[0])
    maps = {name: error_map(outcome, name) for name in outcome.quantities}
    scene = make_plan("focusing", "small", SET_SEED).videos[0].scene
    limits = focus_bounds(scene, OBJECT_DISTANCES, FOCAL_LENGTHS, workers=work.workers or 1, progress=work.progress)
    bounds = {name: limits.mae[:, :, k].T for k, name in enumerate(("object_distance", "focal_length"))}
    figure = fig_error_map({RECIPES[FOCUS_MODELS[0]].title: maps}, bounds=bounds)
    one = next(iter(maps.values()))
    return figure, Fig12({name: each.mae for name, each in maps.items()}, limits, one.x, one.y)


def plain(values: Array) -> list[Any]:
    """Return an array as lists; what is not finite becomes None."""
    told = values.astype(object)
    told[~np.isfinite(values)] = None
    return told.tolist()
