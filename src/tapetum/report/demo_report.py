"""The report of `tapetum demo`: recording, models, accuracy and limitations."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.report import figures, html
from tapetum.report.binned import ErrorByDistance, error_by_distance
from tapetum.report.figures import SignRate
from tapetum.report.figures._style import runs
from tapetum.report.metrics import (
    SIGN_THRESHOLD,
    GazeScores,
    LabelScores,
    coverage,
    predict_mean,
    score_gaze,
    score_labels,
)
from tapetum.report.verdicts import MEAN

__all__ = [
    "DemoReport",
    "DemoScores",
    "ModelResult",
    "SignEvidence",
    "Tracking",
    "score_demo",
    "write_demo_report",
]

Array = NDArray[np.float64]
AnyArray = NDArray[np.generic]


@dataclass(frozen=True)
class ModelResult:
    """A model's predictions for the held-out frames.

    Parameters
    ----------
    name, training
        Its usual name ("ResNet-18"), and one sentence on its training data.
    predicted
        [N, 2] gaze, fractions of the field.
    lower, upper
        [N, 2] ends of its 90 % intervals, if it has any.
    """

    name: str
    predicted: Array
    training: str
    lower: Array | None = None
    upper: Array | None = None


@dataclass(frozen=True)
class SignEvidence:
    """Evidence for the sign of the gaze.

    Parameters
    ----------
    x, y
        [X], [Y] gaze of the map, fractions of the field, rising.
    with_beam, without_beam
        [Y, X] d' of +gaze against -gaze in one frame, with and without the probe's second beam.
    rates
        Measured shares of correct signs by model.
    beam
        The second beam in words: "10 % of the first, at 0.9 mrad".
    """

    x: Array
    y: Array
    with_beam: Array
    without_beam: Array
    rates: Sequence[SignRate] = ()
    beam: str = ""


@dataclass(frozen=True)
class Tracking:
    """Tracks found in the whole probe frames of the held-out part.

    Parameters
    ----------
    frame, frames
        [H, W] one probe frame, and the number of frames tracked.
    track, x, y, time, snr
        [M] a row each: track, place (pixels), seconds, signal-to-noise ratio (NaN while coasting).
    truth, predicted
        [K, 2] true and predicted gaze of the rows that have a label.
    file
        Where the tracks were written.
    """

    frame: AnyArray
    track: AnyArray
    x: Array
    y: Array
    time: Array
    snr: Array
    frames: int
    truth: Array | None = None
    predicted: Array | None = None
    file: str = "tracks.parquet"


@dataclass(frozen=True)
class DemoReport:
    """Content of the demo's report; every number in the report is computed from it.

    Parameters
    ----------
    made
        Date and time, in words.
    recording
        (name, value) of how the recording was made: scene, streams, noise, motion.
    picture
        [H, W] a frame of the target's video.
    time, truth, truth_is
        [N] seconds and [N, 2] gaze of the held-out frames, in the order of filming; `truth_is` says where the truth
        comes from, by default labels from the target's video.
    train
        [M, 2] gaze of the training frames: their mean is the baseline.
    models
        The best-known model first.
    samples, sample_gaze
        [S, h, w] and [S, 2]: RRs to show.
    path
        Held-out frames to draw as a path: (first, last + 1); up to the first gap when None.
    path_rrs, path_rrs_at
        RRs [h, w] beside the path, and their indices among the N frames.
    spots_found, spots_true, spots_joined
        [L, 2] pixels of the target's video: spots found (NaN where none), the bench's true spots, and the true spots
        joined and interpolated as the found ones are, as from a perfect detector.
    sign, tracking
        Optional sections.
    timings, seeds, sizes, versions
        (name, value) rows; timings in seconds, versions by software.
    limits
        Further limitations, one sentence each.
    files, next_steps
        (file beside the report, what it is) and (command, what it does).
    """

    made: str
    recording: Sequence[tuple[str, str]]
    picture: AnyArray
    time: Array
    truth: Array
    train: Array
    models: Sequence[ModelResult]
    samples: AnyArray
    sample_gaze: Array
    spots_found: Array
    spots_true: Array
    spots_joined: Array | None = None
    path: tuple[int, int] | None = None
    path_rrs: Sequence[AnyArray] = ()
    path_rrs_at: Sequence[int] = ()
    sign: SignEvidence | None = None
    tracking: Tracking | None = None
    truth_is: str = "the labels found in the target's video"
    sign_threshold: float = SIGN_THRESHOLD
    timings: Sequence[tuple[str, float]] = ()
    seeds: Sequence[tuple[str, int]] = ()
    sizes: Sequence[tuple[str, str]] = ()
    versions: Sequence[tuple[str, str]] = ()
    limits: Sequence[str] = field(default_factory=tuple)
    files: Sequence[tuple[str, str]] = ()
    next_steps: Sequence[tuple[str, str]] = ()


@dataclass(frozen=True)
class DemoScores:
    """The report's numbers.

    Parameters
    ----------
    models
        (name, scores), in the report's order.
    baseline, labels
        Scores of predicting the training mean, and the label error.
    """

    models: tuple[tuple[str, GazeScores], ...]
    baseline: GazeScores
    labels: LabelScores


def score_demo(content: DemoReport) -> DemoScores:
    """Compute the report's numbers, as the report itself does.

    Raises
    ------
    InputError
        When there is no model, two have one name, or the arrays do not fit each other.
    """
    names = [model.name for model in content.models]
    if not names or len(set(names)) != len(names):
        raise InputError(f"need at least one model, each with its own name, got {names}", where="models")

    def score(values: Array) -> GazeScores:
        return score_gaze(content.truth, values, sign_threshold=content.sign_threshold)

    return DemoScores(
        models=tuple((model.name, score(model.predicted)) for model in content.models),
        baseline=score(predict_mean(content.train, len(content.truth))),
        labels=score_labels(content.spots_found, content.spots_true),
    )


def write_demo_report(path: str | os.PathLike[str], content: DemoReport) -> DemoScores:
    """Write the demo's report as one HTML file and return the numbers in it.

    Raises
    ------
    InputError
        When arrays do not fit each other or the file cannot be written.
    """
    scores, rings = score_demo(content), _rings(content)
    best = int(np.argmin([one.mae_overall for _, one in scores.models] + [scores.baseline.mae_overall]))
    first = scores.models[0][1].mae_overall
    body = html.render(
        "demo.html",
        content=content,
        scores=scores,
        drawn=_figures(content, rings),
        best=best,
        worse=[name for name, one in scores.models if one.mae_overall >= scores.baseline.mae_overall],
        ahead=[name for name, one in scores.models[1:] if one.mae_overall < first],
        total=sum(value for _, value in content.timings),
        **_measured(content, rings),
    )
    text = html.page(
        "Where does that camera look?",
        body,
        subtitle="Tapetum read a camera's gaze from the light it throws back. The camera, the laser and "
        "the light are simulated; everything after the videos is what real recordings would get.",
        contents=html.headings(body),
        footer=f"Made by `tapetum demo`, {content.made}. This file is self-contained and makes no network requests.",
    )
    html.write_page(Path(path), text)
    return scores


def _section(content: DemoReport) -> tuple[int, int]:
    """Return the frames that are drawn as a path: (first, last + 1)."""
    whole = runs(content.time)[0]
    return content.path if content.path is not None else (whole.start, whole.stop)


def _rings(content: DemoReport) -> dict[str, ErrorByDistance]:
    edges = np.linspace(0.0, max(float(np.hypot(*content.truth.T).max()), 1e-6) * 1.0001, 11)
    everyone = {model.name: model.predicted for model in content.models}
    everyone[MEAN] = predict_mean(content.train, len(content.truth))
    return {name: error_by_distance(content.truth, values, edges=edges) for name, values in everyone.items()}


def _figures(content: DemoReport, rings: Mapping[str, ErrorByDistance]) -> dict[str, Figure]:
    first, (begin, end) = content.models[0], _section(content)
    marks = [
        (rr, at - begin) for rr, at in zip(content.path_rrs, content.path_rrs_at, strict=True) if begin <= at < end
    ]
    drawn = {
        "path": figures.fig_gaze_path(
            content.picture,
            content.truth[begin:end],
            first.predicted[begin:end],
            content.time[begin:end] - content.time[begin],
            name=first.name,
            rrs=[rr for rr, _ in marks],
            rrs_at=[at for _, at in marks],
        ),
        "over_time": figures.fig_gaze_over_time(
            content.time,
            content.truth,
            {model.name: model.predicted for model in content.models},
            interval=None if first.lower is None or first.upper is None else (first.lower, first.upper),
        ),
        "errors": figures.fig_error_by_distance(rings, baseline=MEAN),
        "labels": figures.fig_label_error(content.spots_found, content.spots_true),
        "samples": figures.fig_samples(content.samples, content.sample_gaze),
    }
    if content.sign is not None:
        one = content.sign
        drawn["sign_map"] = figures.fig_sign_map(one.x, one.y, one.with_beam, one.without_beam)
        if one.rates:
            drawn["sign_rates"] = figures.fig_sign_rates(one.rates)
    if content.tracking is not None:
        one = content.tracking
        drawn["tracks"] = figures.fig_tracks(one.frame, one.track, one.x, one.y, one.time, one.snr)
    return drawn


def _measured(content: DemoReport, rings: Mapping[str, ErrorByDistance]) -> dict[str, Any]:
    """Return the further numbers on the page."""
    begin, end = _section(content)
    known = {name: one.mae[np.isfinite(one.mae)] for name, one in rings.items()}
    told: dict[str, Any] = {
        "held": [_coverage(content.truth, model) for model in content.models] + ["–"],
        "path_frames": end - begin,
        "path_seconds": content.time[end - 1] - content.time[begin],
        "correlations": [
            (model.name, axis, _correlation(content.truth[:, k], model.predicted[:, k]))
            for model in content.models
            for k, axis in enumerate("xy")
        ],
        "rings": [(name, values[0], values[-1]) for name, values in known.items()],
        "clock": None,
    }
    if content.spots_joined is not None:
        # Two parts of the label error: the detector's, and motion between the two cameras' frames.
        joined = np.isfinite(content.spots_joined).all(axis=1)
        told["finder"] = score_labels(content.spots_found[joined], content.spots_joined[joined])
        told["clock"] = score_labels(content.spots_joined, content.spots_true)
    if content.sign is not None:
        told["with_beam"] = float(np.median(content.sign.with_beam))
        told["without_beam"] = float(np.median(content.sign.without_beam))
    if content.tracking is not None:
        one = content.tracking
        told["tracked"] = {
            "seen": len(np.unique(one.time[np.isfinite(one.snr)])),
            "lengths": np.unique(one.track, return_counts=True)[1].tolist(),
            "gaze": None if one.truth is None or one.predicted is None else score_gaze(one.truth, one.predicted),
        }
    return told


def _coverage(truth: Array, model: ModelResult) -> str:
    if model.lower is None or model.upper is None:
        return "–"
    return " / ".join(html.share(float(part)) for part in coverage(truth, model.lower, model.upper))


def _correlation(a: Array, b: Array) -> str:
    return f"{np.corrcoef(a, b)[0, 1]:.2f}" if np.std(a) > 0 and np.std(b) > 0 else "none"
