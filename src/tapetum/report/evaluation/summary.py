"""Errors of a fitted model on a dataset, as numbers and as text."""

from __future__ import annotations

from typing import Any

import xarray as xr

from tapetum.models import Predictor
from tapetum.progress import Progress, quiet
from tapetum.report.evaluation.outcome import gather_parts
from tapetum.report.evaluation.scores import score
from tapetum.report.verdicts import NOT_TO_USE, warnings

__all__ = ["describe", "evaluate_model"]


def evaluate_model(
    model: Predictor, test: xr.Dataset, train: xr.Dataset, *, progress: Progress = quiet
) -> dict[str, Any]:
    """Score a model on a dataset's test part, and the training part's mean as baseline: see `score`.

    Raises
    ------
    InputError
        When the dataset lacks a label that the model predicts, has no test frames, or shows one class only.
    """
    return score(gather_parts(model, test, train, progress=progress))


def describe(scores: dict[str, Any]) -> str:
    """The numbers of `evaluate_model` in one line a label."""
    lines = [f"{scores['frames']} test frames" + (", simulated" if scores["simulation"] else "")]
    for name, one in scores["targets"].items():
        beside = ""
        if one["baseline_mae"] is not None:
            beside = f" (predicting the mean: {one['baseline_mae']:.4f}, {one['baseline_rmse']:.4f})"
        held = "no intervals: nothing was set aside for them"
        if one["interval"] is not None:
            held = f"90 % intervals hold {one['coverage']:.0%}: {one['intervals']}"
        said = "" if one["verdict"] is None else f": {one['verdict']}"
        lines.append(f"{name}: MAE {one['mae']:.4f}, RMSE {one['rmse']:.4f}{beside}{said}; {held}")
    if "gaze" in scores:
        gaze, guess = scores["gaze"], scores.get("baseline_gaze")
        beside = "" if guess is None else f" (predicting the mean: {guess['radial']:.4f}, {guess['radial_rms']:.4f})"
        lines.append(f"gaze, distance: mean {gaze['radial']:.4f}, RMS {gaze['radial_rms']:.4f}{beside}")
    if scores.get("refused") is None:
        lines.append("whether the model applies to these frames is not known: train it again to let it learn that")
    elif scores["refused"]:
        share = scores["refused"] / scores["frames"]
        lines.append(
            f"does not apply to {scores['refused']} of the frames ({share:.0%}), which count above all the same"
        )
    poor = [name for name, one in scores["targets"].items() if warnings(one["verdict"])]
    if poor:
        lines.append(f"{', '.join(poor)}: no better than a guess that looks at no image; {NOT_TO_USE}")
    classes = scores.get("classes")
    if classes is not None:
        guess = classes["baseline_top_1"]
        beside = "" if guess is None else f" (always the commonest: {guess:.2%})"
        lines.append(
            f"device: {classes['top_1']:.2%} right{beside}; expected calibration error "
            f"{classes['expected_calibration_error']:.4f}, Brier score {classes['brier']:.4f}"
        )
        unknown = classes["unknown"]
        if unknown["frames"] and unknown["auroc"] is not None:
            lines.append(f"unknown devices: {unknown['frames']} frames, AUROC of novelty {unknown['auroc']:.3f}")
    return "\n".join(lines)
