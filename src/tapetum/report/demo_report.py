"""The page that `tapetum demo` ends with: what was filmed, what was learned, and how far to trust it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.report import demo_background as behind
from tapetum.report import demo_sections as part
from tapetum.report import html
from tapetum.report.figures import SignRate
from tapetum.report.metrics import (
    SIGN_THRESHOLD,
    GazeScores,
    LabelScores,
    predict_mean,
    score_gaze,
    score_labels,
)

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
    """What a model made of the held-out frames.

    Parameters
    ----------
    name
        As people call it: "ResNet-18".
    predicted
        [N, 2] gaze, fractions of the field.
    training
        One sentence on what it learned from: "bundled; trained on 24 recordings with other seeds".
    lower, upper
        [N, 2] ends of its 90 % intervals, where it gives any.
    """

    name: str
    predicted: Array
    training: str
    lower: Array | None = None
    upper: Array | None = None


@dataclass(frozen=True)
class SignEvidence:
    """What the sign of the gaze rests on.

    Parameters
    ----------
    x, y
        [X], [Y] gaze of the map, fractions of the field, rising.
    with_beam, without_beam
        [Y, X] d' of +gaze against -gaze in one frame, with and without the probe's second beam.
    rates
        How often models got the sign right, where measured.
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
    """How the whole probe frames of the held-out part were tracked.

    Parameters
    ----------
    frame
        [H, W] one probe frame.
    track, x, y, time, snr
        [M] a row each: track, place (pixels), seconds, signal-to-noise ratio (NaN while coasting).
    frames
        Frames given to the tracker.
    truth, predicted
        [K, 2] gaze of the rows that have a label, and what the model said of them.
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
    """Everything the demo's report shows; every number in it is computed from what stands here.

    Parameters
    ----------
    made
        When, in words.
    recording
        (name, value) of how the recording was made: scene, streams, noise, motion.
    picture
        [H, W] a frame of the target's video.
    time, truth
        [N] seconds and [N, 2] gaze of the held-out frames, in the order of filming; the truth is the label
        from the target's video unless `truth_is` says otherwise.
    train
        [M, 2] gaze of the training frames: their mean is the baseline.
    models
        The best known first.
    samples, sample_gaze
        [S, h, w] and [S, 2]: RRs to show.
    path
        Frames of the held-out part to draw as a path: (first, last + 1); up to its first hole when None.
    path_rrs, path_rrs_at
        RRs [h, w] beside the path, and the frames (of the N) they belong to.
    spots_found, spots_true
        [L, 2] pixels of the target's video, NaN where none was found; and the bench's own truth.
    spots_joined
        [L, 2] what a perfect finder would give: the target's true spots, joined and interpolated as the found ones are.
    sign, tracking
        The sections of those names, left out when None.
    truth_is
        What the models are scored against.
    timings, seeds, sizes
        (what, value) rows; timings in seconds.
    versions
        (software, version).
    limits
        Further honest limits, a sentence each.
    files, next_steps
        (name, what it is) beside the report; (command, what it does).
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
    baseline
        Scores of predicting the training mean.
    labels
        Label error.
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
    """Compose the demo's report and write it, whole or not at all.

    Parameters
    ----------
    path
        The HTML file.
    content
        What it shows.

    Returns
    -------
    DemoScores
        The numbers in it, for the last lines on the terminal.

    Raises
    ------
    InputError
        When arrays do not fit each other or the file cannot be written.
    """
    scores = score_demo(content)
    sections: list[tuple[str, html.Html | None]] = [
        ("Results", part.results(content, scores)),
        ("Following the gaze", part.following(content)),
        ("Where the errors are", part.errors(content)),
        ("How the recording was made", behind.recording(content)),
        ("The labels", behind.labels(content, scores)),
        ("Retro-reflections", behind.retro_reflections(content)),
        ("What the sign rests on", behind.sign(content, scores)),
        ("Tracking", behind.tracking(content)),
        ("Limits", behind.limits(content)),
        ("Beside the paper", behind.paper(scores)),
        ("Seeds, sizes, times", behind.bookkeeping(content)),
    ]
    present = [(title, body) for title, body in sections if body is not None]
    text = html.page(
        "Where does that camera look?",
        part.opening(content, scores),
        *(html.section(title, body) for title, body in present),
        subtitle="Tapetum read a camera's gaze from the light it throws back. The camera, the laser and "
        "the light are simulated; everything after the videos is what real recordings would get.",
        contents=[title for title, _ in present],
        footer=f"Made by `tapetum demo`, {content.made}. This file stands alone: it asks nothing of any network.",
    )
    html.write_page(Path(path), text)
    return scores
