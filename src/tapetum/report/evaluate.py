"""Errors of a fitted model on a dataset, as numbers and as words."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from tapetum.errors import InputError
from tapetum.models import Estimator
from tapetum.progress import Progress, quiet
from tapetum.report.metrics import coverage, mae, rmse

__all__ = ["describe", "evaluate_model"]


def evaluate_model(
    model: Estimator, test: xr.Dataset, train: xr.Dataset, *, progress: Progress = quiet
) -> dict[str, Any]:
    """Score a model on a dataset's test part, beside predicting the mean of its training part.

    Returns
    -------
    dict
        `frames`, and by label: `mae`, `rmse`, `baseline_mae`, `baseline_rmse` and `coverage`, the share of truths
        inside the model's 90 % intervals; all in the label's own unit.

    Raises
    ------
    InputError
        When the dataset lacks a label that the model predicts, or has no test frames.
    """
    names = model.target_names
    missing = [name for name in names if name not in test]
    if missing:
        raise InputError(
            f"has no label {missing[0]}", where="dataset", remedy="use a model of what it is labelled with"
        )
    if not test.sizes["frame"]:
        raise InputError("has no test frames", where="dataset", remedy="build it with a test fraction above 0")
    predicted = model.predict(test, progress=progress)
    told: dict[str, Any] = {"frames": int(test.sizes["frame"]), "targets": {}}
    for k, name in enumerate(names):
        truth = np.asarray(test[name], dtype=float)
        mean = np.full(len(truth), float(train[name].mean()))
        told["targets"][name] = {
            "mae": float(mae(truth, predicted.value[:, k])),
            "rmse": float(rmse(truth, predicted.value[:, k])),
            "baseline_mae": float(mae(truth, mean)),
            "baseline_rmse": float(rmse(truth, mean)),
            "coverage": float(coverage(truth, predicted.lower[:, k], predicted.upper[:, k])),
        }
    return told


def describe(scores: dict[str, Any]) -> str:
    """The numbers of `evaluate_model` in one line a label."""
    lines = [
        f"{name}: MAE {s['mae']:.4f}, RMSE {s['rmse']:.4f} (predicting the mean: {s['baseline_mae']:.4f}, "
        f"{s['baseline_rmse']:.4f}); 90 % intervals hold {s['coverage']:.0%}"
        for name, s in scores["targets"].items()
    ]
    return "\n".join([f"{scores['frames']} test frames", *lines])
