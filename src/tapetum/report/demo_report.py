"""The report of `tapetum demo`: the evaluation of its first model, and how recording, labels and tracks came about."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.report import figures, html
from tapetum.report.evaluation.outcome import Outcome
from tapetum.report.evaluation.pictures import Picture, path_section, pictures
from tapetum.report.evaluation.scores import score
from tapetum.report.evaluation.write import More, Subject, page_body
from tapetum.report.figures import SignRate, figure_png
from tapetum.report.metrics import GazeScores, LabelScores, score_gaze, score_labels

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
    """A model on the held-out frames: its usual name ("ResNet-18"), its outcome, one sentence on its training data."""

    name: str
    outcome: Outcome
    training: str


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
    models
        Models of the gaze on the same frames. The first is the subject of the page, the others stand beside it.
    subject
        (name, value) rows on the first model, and on the data.
    samples, sample_gaze
        [S, h, w] and [S, 2]: RRs to show.
    path_rrs, path_rrs_at
        RRs [h, w] beside the path, and their indices among the held-out frames.
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
    models: Sequence[ModelResult]
    samples: AnyArray
    sample_gaze: Array
    spots_found: Array
    spots_true: Array
    subject: Subject | None = None
    spots_joined: Array | None = None
    path_rrs: Sequence[AnyArray] = ()
    path_rrs_at: Sequence[int] = ()
    sign: SignEvidence | None = None
    tracking: Tracking | None = None
    timings: Sequence[tuple[str, float]] = ()
    seeds: Sequence[tuple[str, int]] = ()
    sizes: Sequence[tuple[str, str]] = ()
    versions: Sequence[tuple[str, str]] = ()
    limits: Sequence[str] = ()
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
        When there is no model, two have one name, one does not predict the gaze, or there is no training mean.
    """
    names = [model.name for model in content.models]
    if not names or len(set(names)) != len(names):
        raise InputError(f"need at least one model, each with its own name, got {names}", where="models")
    first = content.models[0].outcome
    guess = first.baseline
    if guess is None:
        raise InputError("the set holds no training frames", where="models", remedy="split it")
    keep = [first.quantities.index(axis) for axis in ("gaze_x", "gaze_y")]
    return DemoScores(
        models=tuple((model.name, score_gaze(*model.outcome.pair())) for model in content.models),
        baseline=score_gaze(first.pair()[0], guess[:, keep]),
        labels=score_labels(content.spots_found, content.spots_true),
    )


def write_demo_report(path: str | os.PathLike[str], content: DemoReport) -> DemoScores:
    """Write the demo's report as one HTML file and return the numbers in it.

    Raises
    ------
    InputError
        When arrays do not fit each other or the file cannot be written.
    """
    scores = score_demo(content)
    subject, *others = content.models
    beside = {model.name: model.outcome for model in others}
    first, total = scores.models[0][1], sum(value for _, value in content.timings)
    drawn = {"labels": figures.fig_label_error(content.spots_found, content.spots_true)}
    drawn["samples"] = figures.fig_samples(content.samples, content.sample_gaze)
    if content.sign is not None:
        one = content.sign
        drawn["sign_map"] = figures.fig_sign_map(one.x, one.y, one.with_beam, one.without_beam)
        if one.rates:
            drawn["sign_rates"] = figures.fig_sign_rates(one.rates)
    if content.tracking is not None:
        one = content.tracking
        drawn["tracks"] = figures.fig_tracks(one.frame, one.track, one.x, one.y, one.time, one.snr)
    numbers = [(f"{scores.labels.median:.2f} px", "median error of the labels, pixels of the target's video")]
    counted = [(share or 0.0, count) for share, count in zip(first.sign_right, first.sign_count, strict=True)]
    if sum(first.sign_count):
        right = sum(share * count for share, count in counted) / sum(first.sign_count)
        numbers.insert(0, (html.share(right), f"{subject.name}: left distinguished from right and up from down"))
    if content.timings:
        took = f"{total:.1f} s" if total < 120 else f"{total / 60:.1f} min"
        numbers.append((took, "from an empty folder to this page"))
    limits = [
        *content.limits,
        "One thin lens, a mirror for a sensor, scalar monochromatic light. Another camera, focus or alignment needs a "
        "model of its own.",
    ]
    if content.sign is not None:
        limits.append(
            "Defocus and the probe's second beam show the sign of the gaze here; another camera or probe may not have "
            "them."
        )
    more = More(
        others=beside,
        training=[(model.name, model.training) for model in content.models],
        numbers=numbers,
        sections=html.render(
            "demo.html", content=content, scores=scores, drawn=drawn, total=total, **_measured(content)
        ),
        limits=limits,
    )
    shown = {picture.name: picture for picture in pictures(subject.outcome, subject.name, others=beside)}
    shown["path"] = _path(content)
    body = page_body(
        subject.outcome,
        content.subject or Subject(subject.name),
        score(subject.outcome),
        [(picture, figure_png(picture.figure)) for picture in shown.values()],
        more,
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


def _path(content: DemoReport) -> Picture:
    """The path of the gaze over a picture of the target's own video."""
    name, outcome = content.models[0].name, content.models[0].outcome
    (begin, end), (truth, said), time = path_section(outcome), outcome.pair(), outcome.time
    marks = [
        (rr, at - begin) for rr, at in zip(content.path_rrs, content.path_rrs_at, strict=True) if begin <= at < end
    ]
    drawn = figures.fig_gaze_path(
        content.picture,
        truth[begin:end],
        said[begin:end],
        time[begin:end] - time[begin],
        name=name,
        rrs=[rr for rr, _ in marks],
        rrs_at=[at for _, at in marks],
    )
    return Picture(
        "path",
        "Following the gaze",
        drawn,
        f"The target's picture with the true path of the laser in it and {name}'s estimates, both coloured by time "
        f"over {time[end - 1] - time[begin]:.0f} seconds.",
        f"A section of the held-out part ({end - begin} frames), as the paper's Fig. 9 (a). Band: where the probe's "
        f"laser stands in the target's picture. Dots: where {name} says it stands, from the retro-reflection alone; "
        "thin lines tie each dot to its truth. Numbers: the RRs on the left, each with its gaze.",
    )


def _measured(content: DemoReport) -> dict[str, Any]:
    """Return the further numbers of the demo's own sections."""
    told: dict[str, Any] = {"clock": None}
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
