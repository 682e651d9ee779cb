"""Errors of estimates: MAE and RMSE in fractions of the field of view, as in the paper (§5.1.1).

Also the error of a guess without images (the training mean), the share of correct signs of the gaze, and the error by
distance from the field's centre. Probabilities of classes are scored in `tapetum.report.evaluation.classes`.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr
from scipy.stats import binomtest

from tapetum.errors import InputError, number

__all__ = [
    "SIGN_THRESHOLD",
    "GazeScores",
    "LabelScores",
    "PartScores",
    "coverage",
    "mae",
    "predict_mean",
    "rmse",
    "score_gaze",
    "score_labels",
    "sign_right",
    "wilson_interval",
]

SIGN_THRESHOLD = 0.05
"""Gaze (fraction of the field) from which its sign counts; nearer to the axis it is meaningless."""

THIRDS = (0.0, 0.5 / 3, 1.0 / 3, np.inf)
"""Edges of the thirds of the half field, by distance from its centre; the corners belong to the outer one."""

Pair = tuple[float, float]


def finite(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0:
        raise InputError("holds no frame", where=name, remedy="score at least one")
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise InputError(
            f"{bad} of {array.size} values are not finite",
            where=name,
            remedy="leave out frames without a label",
        )
    return array


def matched(
    truth: ArrayLike, predicted: ArrayLike, width: int | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = finite(truth, "truth"), finite(predicted, "predicted")
    if a.shape != b.shape or (width is not None and (a.ndim != 2 or a.shape[1] != width)):
        wanted = "equal shapes" if width is None else f"two arrays [N, {width}]"
        raise InputError(f"expected {wanted}, got {a.shape} and {b.shape}", where="truth and predicted")
    return a, b


def mae(truth: ArrayLike, predicted: ArrayLike) -> NDArray[np.float64]:
    """Return the mean absolute error along the first axis, [] or [K].

    Parameters
    ----------
    truth, predicted
        [N] or [N, K], any unit, the same for both.

    Raises
    ------
    InputError
        When the shapes differ, a value is not finite or there is none.

    Examples
    --------
    >>> float(mae([0.0, 1.0], [0.5, 1.5]))
    0.5
    """
    a, b = matched(truth, predicted)
    return np.abs(b - a).mean(axis=0)


def rmse(truth: ArrayLike, predicted: ArrayLike) -> NDArray[np.float64]:
    """Return the root of the mean squared error along the first axis; see `mae`.

    Examples
    --------
    >>> float(rmse([0.0, 0.0], [3.0, -3.0]))
    3.0
    """
    a, b = matched(truth, predicted)
    return np.sqrt(np.square(b - a).mean(axis=0))


def predict_mean(train: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return the guess that looks at no image: the mean of the training labels [N, K], as [count, K]."""
    return np.tile(finite(train, "training labels").mean(axis=0), (count, 1))


def sign_right(truth: ArrayLike, predicted: ArrayLike, threshold: float = SIGN_THRESHOLD) -> tuple[int, int]:
    """Count the frames whose sign is predicted correctly, and the frames with |truth| above `threshold`.

    Parameters
    ----------
    truth, predicted
        [N] one axis of the gaze, fractions of the field. A prediction of exactly 0 is wrong.
    threshold
        Fraction of the field.
    """
    number(threshold, "sign_threshold", "give a fraction of the field", least=0)
    a, b = matched(truth, predicted)
    far = np.abs(a) > threshold
    return int(np.count_nonzero(far & (np.sign(a) == np.sign(b)))), int(np.count_nonzero(far))


def wilson_interval(right: int, counted: int, z: float = 1.96) -> Pair:
    """Return the Wilson score interval of a fraction `right / counted`.

    Frames are treated as independent; consecutive video frames are not, so the true interval is wider.
    Source: Wilson, J. Am. Stat. Assoc. 22, 209 (1927).

    Raises
    ------
    InputError
        When nothing was counted.
    """
    if counted <= 0 or not 0 <= right <= counted:
        raise InputError(f"no fraction: {right} of {counted}", where="sign")
    ends = binomtest(right, counted).proportion_ci(2 * float(ndtr(z)) - 1, method="wilson")
    return float(ends.low), float(ends.high)


@dataclass(frozen=True)
class PartScores:
    """Errors in one part of the field, fractions of the field.

    Parameters
    ----------
    inner, outer, count
        Part with inner <= distance from the centre < outer, and its number of frames.
    mae, rmse
        Mean over both axes; None where there is no frame.
    """

    inner: float
    outer: float
    count: int
    mae: float | None
    rmse: float | None


@dataclass(frozen=True)
class GazeScores:
    """Errors of gaze estimates in fractions of the field of view (its width for x, its height for y).

    Parameters
    ----------
    count
        Frames scored.
    mae, rmse
        (x, y).
    mae_overall, rmse_overall
        Mean of both axes' MAE, and root of the mean of both axes' squared errors.
    radial, radial_rms
        Mean and root mean square of the distance between estimate and truth; the latter is the radius of the paper's
        "ball" (§5.1.1).
    thirds
        The field in three rings by the true distance from its centre, inner to outer.
    sign_right, sign_count, sign_threshold
        (x, y) share of frames whose sign is right (None without frames), among the frames with |gaze| > threshold.
    """

    count: int
    mae: Pair
    rmse: Pair
    mae_overall: float
    rmse_overall: float
    radial: float
    radial_rms: float
    thirds: tuple[PartScores, PartScores, PartScores]
    sign_right: tuple[float | None, float | None]
    sign_count: tuple[int, int]
    sign_threshold: float

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values; the infinite outermost edge becomes None."""
        table = asdict(self)
        for part in table["thirds"]:
            part["outer"] = part["outer"] if np.isfinite(part["outer"]) else None
        return table


def score_gaze(truth: ArrayLike, predicted: ArrayLike, *, sign_threshold: float = SIGN_THRESHOLD) -> GazeScores:
    """Score estimates of gaze.

    Parameters
    ----------
    truth, predicted
        [N, 2] gaze (x, y), fractions of the field of view.
    sign_threshold
        |gaze| above which its sign counts.

    Raises
    ------
    InputError
        When the shapes are not [N, 2], a value is not finite or there is none.
    """
    a, b = matched(truth, predicted, 2)
    error = b - a
    distance = np.hypot(a[:, 0], a[:, 1])
    per_mae, per_rmse = mae(a, b), rmse(a, b)
    radial = np.hypot(error[:, 0], error[:, 1])
    parts: list[PartScores] = []
    for inner, outer in pairwise(THIRDS):
        inside = error[(distance >= inner) & (distance < outer)]
        parts.append(
            PartScores(
                float(inner),
                float(outer),
                len(inside),
                float(np.abs(inside).mean()) if len(inside) else None,
                float(np.sqrt(np.square(inside).mean())) if len(inside) else None,
            )
        )
    signs = [sign_right(a[:, k], b[:, k], sign_threshold) for k in (0, 1)]
    shares = [right / counted if counted else None for right, counted in signs]
    return GazeScores(
        count=len(a),
        mae=(float(per_mae[0]), float(per_mae[1])),
        rmse=(float(per_rmse[0]), float(per_rmse[1])),
        mae_overall=float(per_mae.mean()),
        rmse_overall=float(np.sqrt(np.square(error).mean())),
        radial=float(radial.mean()),
        radial_rms=float(np.sqrt(np.square(radial).mean())),
        thirds=(parts[0], parts[1], parts[2]),
        sign_right=(shares[0], shares[1]),
        sign_count=(signs[0][1], signs[1][1]),
        sign_threshold=sign_threshold,
    )


def coverage(truth: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> NDArray[np.float64]:
    """Return the share of true values [N, K] within lower ... upper [N, K] by column; infinite ends are allowed."""
    a = finite(truth, "truth")
    low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
    if not a.shape == low.shape == high.shape or np.isnan(low).any() or np.isnan(high).any():
        raise InputError(
            f"expected intervals {a.shape} without NaN, got {low.shape} and {high.shape}", where="intervals"
        )
    return ((a >= low) & (a <= high)).mean(axis=0)


@dataclass(frozen=True)
class LabelScores:
    """Distances of the laser spots found in the target's video from the true ones, in that video's pixels.

    Parameters
    ----------
    count, total
        Frames labelled, and all frames.
    rms, median, p95, largest
        Of the distance between found and true, pixels.
    bias
        (x, y) mean of found minus true, pixels.
    """

    count: int
    total: int
    rms: float
    median: float
    p95: float
    largest: float
    bias: Pair


def score_labels(found: ArrayLike, true: ArrayLike) -> LabelScores:
    """Score the labels against the virtual bench's own truth.

    Parameters
    ----------
    found, true
        [N, 2] (x, y) pixels; NaN in `found` where there is no spot.

    Raises
    ------
    InputError
        When no frame has a label, or the shapes are not [N, 2].
    """
    a, b = np.asarray(found, dtype=np.float64), finite(true, "true spots")
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 2:
        raise InputError(f"expected two arrays [N, 2], got {a.shape} and {b.shape}", where="labels")
    have = np.isfinite(a).all(axis=1)
    if not have.any():
        raise InputError(f"none of {len(a)} frames has a label", where="labels", remedy="label the recording first")
    error = (a - b)[have]
    distance = np.hypot(error[:, 0], error[:, 1])
    bias = error.mean(axis=0)
    return LabelScores(
        count=int(have.sum()),
        total=len(a),
        rms=float(np.sqrt(np.square(distance).mean())),
        median=float(np.median(distance)),
        p95=float(np.quantile(distance, 0.95)),
        largest=float(distance.max()),
        bias=(float(bias[0]), float(bias[1])),
    )
