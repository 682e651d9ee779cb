"""The numbers of an evaluation: errors, coverage and classes, for all frames and by part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.models.prediction import COVERAGE, NONE_OF_THESE
from tapetum.report.evaluation.classes import (
    Reliability,
    brier_score,
    confusion,
    novelty_auroc,
    reliability,
    top_1,
)
from tapetum.report.evaluation.outcome import Outcome
from tapetum.report.metrics import coverage, mae, rmse, score_gaze
from tapetum.report.verdicts import against_mean, intervals

__all__ = [
    "ClassScores",
    "ErrorMap",
    "Group",
    "by_device",
    "by_recording",
    "by_snr",
    "error_map",
    "score",
    "score_classes",
]

QUARTERS = 4


@dataclass(frozen=True)
class Group:
    """Scores of a part of the frames.

    Parameters
    ----------
    name, count
        The part in words, and its number of frames.
    mae, rmse, coverage
        One for each quantity, in the outcome's order; coverage is the share of truths inside the intervals.
    radial, radial_rms
        Mean and root mean square of the gaze's distance from the truth; None where the gaze is not predicted.
    """

    name: str
    count: int
    mae: tuple[float, ...]
    rmse: tuple[float, ...]
    coverage: tuple[float, ...]
    radial: float | None = None
    radial_rms: float | None = None

    def to_dict(self, names: Sequence[str]) -> dict[str, Any]:
        """Return plain numbers, by quantity."""
        parts = {key: dict(zip(names, getattr(self, key), strict=True)) for key in ("mae", "rmse", "coverage")}
        gaze = {} if self.radial is None else {"radial": self.radial, "radial_rms": self.radial_rms}
        return {"name": self.name, "frames": self.count, **parts, **gaze}


def group(outcome: Outcome, name: str, frames: NDArray[np.bool_]) -> Group:
    """Score the frames of a mask [N]."""
    truth, said = outcome.targets[frames], outcome.prediction
    held = coverage(truth, said.lower[frames], said.upper[frames])
    errors = mae(truth, said.value[frames]), rmse(truth, said.value[frames])
    told = [tuple(float(value) for value in column) for column in (*errors, held)]
    if not outcome.has_gaze:
        return Group(name, int(frames.sum()), told[0], told[1], told[2])
    apart = np.hypot(*np.subtract(*(side[frames] for side in outcome.pair())).T)
    radial = float(apart.mean()), float(np.sqrt(np.square(apart).mean()))
    return Group(name, int(frames.sum()), told[0], told[1], told[2], *radial)


def by_recording(outcome: Outcome) -> list[Group]:
    """Score every recording separately."""
    numbers = np.unique(outcome.recording)
    return [group(outcome, outcome.recordings[int(n)], outcome.recording == n) for n in numbers]


def by_device(outcome: Outcome) -> list[Group]:
    """Score the frames of every device separately (the paper's Table 2); empty without devices."""
    if outcome.device is None:
        return []
    told = np.array(outcome.device)
    return [group(outcome, str(name), told == name) for name in np.unique(told)]


def by_snr(outcome: Outcome, parts: int = QUARTERS) -> list[Group]:
    """Score quarters of equal numbers of frames, from the faintest to the brightest."""
    edges = np.quantile(outcome.snr, np.arange(1, parts) / parts)
    place = np.searchsorted(edges, outcome.snr, side="right")
    found: list[Group] = []
    for k in np.unique(place):
        inside = place == k
        ends = (float(outcome.snr[inside].min()), float(outcome.snr[inside].max()))
        low, high = (f"{end:.0f}" if end >= 10 else f"{end:.2g}" for end in ends)
        found.append(group(outcome, f"SNR {low} – {high}", inside))
    return found


@dataclass(frozen=True)
class ClassScores:
    """Scores of the device classification over the frames of known devices.

    Parameters
    ----------
    names, count
        C classes, and the frames of known devices.
    top_1, baseline
        Share of frames whose likeliest class is true, whatever the novelty; and the same for always predicting the
        commonest class of the training part (None where unknown).
    confusion
        [C, C] frames by true (row) and likeliest (column) class.
    reliability, brier
        Reliability of the likeliest class' probability, and the Brier score.
    told_none
        Share of known frames classified as `NONE_OF_THESE`.
    unknown, unknown_told_none
        Frames of devices that the model does not know, and the share of them classified as `NONE_OF_THESE`
        (None without any).
    auroc
        Area under the ROC curve of novelty, unknown against known; None without unknown frames.
    """

    names: tuple[str, ...]
    count: int
    top_1: float
    baseline: float | None
    confusion: NDArray[np.int64]
    reliability: Reliability
    brier: float
    told_none: float
    unknown: int
    unknown_told_none: float | None
    auroc: float | None

    @property
    def recall(self) -> list[float | None]:
        """Share predicted correctly of the frames of each class; None where a class has none."""
        frames, right = self.confusion.sum(axis=1), np.diag(self.confusion)
        return [float(r / n) if n else None for r, n in zip(right, frames, strict=True)]

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        rows = zip(self.names, self.confusion.sum(axis=1).tolist(), self.recall, strict=True)
        bins = {name: values.tolist() for name, values in asdict(self.reliability).items()}
        return {
            "frames": self.count,
            "top_1": self.top_1,
            "baseline_top_1": self.baseline,
            "expected_calibration_error": self.reliability.error,
            "calibration_bins": f"{len(self.reliability.count)} of equal numbers of frames",
            "brier": self.brier,
            "told_none_of_these": self.told_none,
            "unknown": {"frames": self.unknown, "told_none_of_these": self.unknown_told_none, "auroc": self.auroc},
            "per_class": [{"name": name, "frames": frames, "recall": share} for name, frames, share in rows],
            "confusion": self.confusion.tolist(),
            "reliability": bins,
        }


def score_classes(outcome: Outcome) -> ClassScores | None:
    """Score the classes; None where the model knows none, or the dataset does not hold the devices.

    Raises
    ------
    InputError
        When the model knows none of the dataset's devices.
    """
    said = outcome.prediction
    if said.probability is None or outcome.device is None:
        return None
    truth = np.array(outcome.device)
    known = np.isin(truth, said.classes)
    if not known.any():
        what = f"shows none of the devices that the model knows ({', '.join(said.classes)})"
        raise InputError(what, where=outcome.dataset, remedy="add recordings of some of them")
    likeliest = np.array(said.classes)[said.probability.argmax(axis=1)]
    none = np.array(said.device) == NONE_OF_THESE
    own, told = truth[known].tolist(), likeliest[known].tolist()
    guess = outcome.commonest
    return ClassScores(
        names=said.classes,
        count=int(known.sum()),
        top_1=top_1(own, told),
        baseline=None if guess is None else top_1(own, [guess] * len(own)),
        confusion=confusion(own, told, said.classes),
        reliability=reliability(said.device_probability[known], truth[known] == likeliest[known]),
        brier=brier_score(said.probability[known], own, said.classes),
        told_none=float(none[known].mean()),
        unknown=int((~known).sum()),
        unknown_told_none=None if known.all() else float(none[~known].mean()),
        auroc=None if said.novelty is None else novelty_auroc(said.novelty, ~known),
    )


@dataclass(frozen=True)
class ErrorMap:
    """Mean absolute error of one quantity over two true labels (the paper's Fig. 12).

    Parameters
    ----------
    x, y
        [X], [Y] values of the labels, rising.
    mae, count
        [Y, X] error, NaN without frames; and number of frames.
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    mae: NDArray[np.float64]
    count: NDArray[np.int64]


def error_map(outcome: Outcome, quantity: str, x: str = "object_distance", y: str = "focal_length") -> ErrorMap:
    """Average a quantity's absolute error for each pair of values of two labels.

    Raises
    ------
    InputError
        When a label is not predicted, or takes too many values for a map.
    """
    for name in (quantity, x, y):
        if name not in outcome.truth:
            raise InputError("is not among the labels predicted", where=name)
    across, column = np.unique(outcome.truth[x], return_inverse=True)
    down, row = np.unique(outcome.truth[y], return_inverse=True)
    if max(len(across), len(down)) > 30:
        what = f"takes {max(len(across), len(down))} values: too many for a map"
        raise InputError(what, where=x if len(across) > 30 else y, remedy="use labels that change in steps")
    total, count = np.zeros((len(down), len(across))), np.zeros((len(down), len(across)), dtype=np.int64)
    np.add.at(total, (row, column), np.abs(outcome.prediction[quantity] - outcome.truth[quantity]))
    np.add.at(count, (row, column), 1)
    return ErrorMap(across, down, np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0), count)


def score(outcome: Outcome) -> dict[str, Any]:
    """Return every number of an evaluation, ready for JSON.

    Returns
    -------
    dict
        `frames`; `refused`, frames outside the model's domain (None where it cannot know), which all other numbers
        include; `simulation` (True, or None where unknown); `targets`, by label: `mae`, `rmse`, `baseline_mae`,
        `baseline_rmse` (None without training frames), `verdict` (`tapetum.report.verdicts.against_mean`), `coverage`,
        the share of truths inside the model's 90 % intervals, `interval`, their median half-width (None if infinite),
        all in the label's own unit, and `intervals`, a verdict on them; `gaze` with errors by axis and radial (see
        `GazeScores`) and `baseline_gaze` where both coordinates are predicted; `classes` where devices are (see
        `ClassScores`); `coverage`, the wanted and the found share of all, and whose intervals they are
        (`Prediction.unit`); `recordings`, `snr` and `devices`: the same by part.

    Raises
    ------
    InputError
        When the model knows none of the dataset's devices.
    """
    names = outcome.quantities
    told: dict[str, Any] = {"frames": len(outcome), "simulation": outcome.simulated, "targets": _targets(outcome)}
    refused = int((~outcome.prediction.applies).sum())
    told["refused"] = refused if refused or outcome.prediction.described else None
    if outcome.has_gaze:
        truth, said = outcome.pair()
        told["gaze"] = score_gaze(truth, said).to_dict()
        base = outcome.guess
        if base is not None:
            guess = np.tile([base["gaze_x"], base["gaze_y"]], (len(outcome), 1))
            told["baseline_gaze"] = score_gaze(truth, guess).to_dict()
    classes = score_classes(outcome)
    if classes is not None:
        told["classes"] = classes.to_dict()
    if names:
        held = [target["coverage"] for target in told["targets"].values()]
        told["coverage"] = {"wanted": COVERAGE, "all": float(np.mean(held)), "unit": outcome.prediction.unit}
        parts = {"recordings": by_recording(outcome), "snr": by_snr(outcome), "devices": by_device(outcome)}
        told |= {key: [one.to_dict(names) for one in found] for key, found in parts.items() if found}
    return told


def _targets(outcome: Outcome) -> dict[str, dict[str, Any]]:
    said, base = outcome.prediction, outcome.baseline
    found: dict[str, dict[str, Any]] = {}
    for k, name in enumerate(outcome.quantities):
        truth = outcome.truth[name]
        half = float(np.median((said.upper[:, k] - said.lower[:, k]) / 2))
        found[name] = {
            "mae": float(mae(truth, said.value[:, k])),
            "rmse": float(rmse(truth, said.value[:, k])),
            "baseline_mae": None if base is None else float(mae(truth, base[:, k])),
            "baseline_rmse": None if base is None else float(rmse(truth, base[:, k])),
            "coverage": float(coverage(truth, said.lower[:, k], said.upper[:, k])),
            "interval": half if np.isfinite(half) else None,
        }
        one = found[name]
        one["verdict"] = against_mean(one["mae"], one["baseline_mae"], one["rmse"], one["baseline_rmse"])
        one["intervals"] = None if one["interval"] is None else intervals(one["coverage"])
    return found
