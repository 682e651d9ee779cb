"""The figures of an evaluation, with captions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from tapetum.report.binned import binned_errors, error_by_distance
from tapetum.report.evaluation.outcome import COVARIATES, Outcome
from tapetum.report.evaluation.scores import ErrorMap, by_device, by_recording, by_snr, error_map, group, score_classes
from tapetum.report.figures.by_image import fig_by_image
from tapetum.report.figures.classes import fig_confusion, fig_reliability
from tapetum.report.figures.errors import fig_coverage, fig_error_by, fig_error_by_distance
from tapetum.report.figures.gaze import fig_gaze_over_time
from tapetum.report.figures.maps import fig_error_map
from tapetum.report.figures.path import fig_path
from tapetum.report.formatting import look, written
from tapetum.report.verdicts import MEAN

__all__ = ["MEAN", "Picture", "path_section", "pictures"]

FOCUS = ("object_distance", "focal_length")
# A label with more distinct values than this is treated as continuous.
_STEPS = 12


@dataclass(frozen=True)
class Picture:
    """A figure with its file `name` (without suffix), the page's `section`, `alt` text and `caption`."""

    name: str
    section: str
    figure: Figure
    alt: str
    caption: str


def pictures(
    outcome: Outcome,
    name: str,
    rrs: Sequence[ArrayLike] = (),
    rrs_at: Sequence[int] = (),
    others: Mapping[str, Outcome] | None = None,
) -> Iterator[Picture]:
    """Draw the figures that an outcome has data for.

    `rrs` stand beside the path of the gaze, at frames `rrs_at`; the `others` are other models' outcomes on the same
    frames.
    """
    if outcome.has_gaze:
        yield _path(outcome, name, rrs, rrs_at)
        if others:
            yield _over_time(outcome, name, others)
        yield _by_distance(outcome, name, others or {})
    if _steps(outcome):
        yield _by_image(outcome, name)
        yield _map(outcome, name)
    yield from _classes(outcome, name)
    if outcome.quantities:
        if _finite(outcome):
            yield _coverage(outcome)
        yield from _against(outcome, name)


def _finite(outcome: Outcome) -> bool:
    return bool(np.isfinite(outcome.prediction.lower).all() and np.isfinite(outcome.prediction.upper).all())


def _steps(outcome: Outcome) -> bool:
    """Whether focus is predicted and changes in steps, as in the paper's set."""
    both = set(FOCUS) <= set(outcome.quantities)
    return both and all(len(np.unique(outcome.truth[name])) <= _STEPS for name in FOCUS)


def path_section(outcome: Outcome, most: int = 120) -> tuple[int, int]:
    """Return the frames of one recording to draw as a path: the section whose gaze varies most."""
    truth, _ = outcome.pair()
    best, widest = (0, min(2, len(outcome))), -1.0
    for number in np.unique(outcome.recording):
        frames = np.flatnonzero(outcome.recording == number)
        frames = frames[: np.flatnonzero(np.diff(frames, append=frames[-1] + 2) != 1)[0] + 1]
        for start in range(0, max(1, len(frames) - most + 1), 15):
            part = truth[frames[start : start + most]]
            spread = float(np.prod(part.std(axis=0)))
            if len(part) > 1 and spread > widest:
                best, widest = (int(frames[start]), int(frames[start]) + len(part)), spread
    return best


def _path(outcome: Outcome, name: str, rrs: Sequence[ArrayLike], rrs_at: Sequence[int]) -> Picture:
    truth, said = outcome.pair()
    keep = [outcome.quantities.index(axis) for axis in ("gaze_x", "gaze_y")]
    section = path_section(outcome)
    figure = fig_path(
        truth,
        said,
        lower=outcome.prediction.lower[:, keep],
        upper=outcome.prediction.upper[:, keep],
        recording=outcome.recording,
        section=section,
        rrs=rrs,
        rrs_at=rrs_at,
        name=name,
    )
    shown = f" Numbers: the {len(rrs)} retro-reflections on the left, each with its gaze." if len(rrs) else ""
    count = len(np.unique(outcome.recording))
    videos = "the recording" if count == 1 else f"{count} recordings, parted by dashed lines"
    return Picture(
        "path",
        "Following the gaze",
        figure,
        f"The true path of the gaze and {name}'s estimates over {section[1] - section[0]} frames, and x and y of all "
        f"{len(outcome)} test frames against their number.",
        f"As the paper's Fig. 9. (a) {section[1] - section[0]} frames of one recording over the target's field of "
        f"view. Band: the truth; dots: what {name} says from each frame alone, tied to its truth by a thin line; both "
        f"coloured by the frame's number. (b, c) The same for all test frames of {videos}; the yellow stretch is the "
        f"one in (a), triangles at the edge stand for estimates beyond the axes.{shown}",
    )


def _over_time(outcome: Outcome, name: str, others: Mapping[str, Outcome]) -> Picture:
    truth, said = outcome.pair()
    everyone = {name: said} | {other: one.pair()[1] for other, one in others.items()}
    keep = [outcome.quantities.index(axis) for axis in ("gaze_x", "gaze_y")]
    ends = outcome.prediction.lower[:, keep], outcome.prediction.upper[:, keep]
    related = "; ".join(
        f"{model} in {axis}: correlation {_correlation(truth[:, k], values[:, k])}"
        for model, values in everyone.items()
        for k, axis in enumerate("xy")
    )
    return Picture(
        "over-time",
        "Following the gaze",
        fig_gaze_over_time(outcome.time, truth, everyone, interval=ends if np.isfinite(ends).all() else None),
        f"Estimated against true gaze over time and as scatter, x and y. {related}.",
        "Every test frame and every model, as the paper's Fig. 9 (b, c). Dashed verticals part the videos. Triangles "
        "at the edge stand for estimates beyond the axes.",
    )


def _correlation(a: NDArray[np.float64], b: NDArray[np.float64]) -> str:
    return f"{np.corrcoef(a, b)[0, 1]:.2f}" if np.std(a) > 0 and np.std(b) > 0 else "none"


def _by_distance(outcome: Outcome, name: str, others: Mapping[str, Outcome]) -> Picture:
    truth, said = outcome.pair()
    edges = np.linspace(0.0, max(float(np.hypot(*truth.T).max()), 1e-6) * 1.0001, 11)
    rings = {name: error_by_distance(truth, said, edges=edges)}
    rings |= {other: error_by_distance(truth, one.pair()[1], edges=edges) for other, one in others.items()}
    if outcome.guess is not None:
        guess = np.tile([outcome.guess["gaze_x"], outcome.guess["gaze_y"]], (len(truth), 1))
        rings[MEAN] = error_by_distance(truth, guess, edges=edges)
    known = {who: one.mae[np.isfinite(one.mae)] for who, one in rings.items()}
    parts = [(who, written(mae[0]), written(mae[-1])) for who, mae in known.items()]
    ends = "; ".join(f"{who}: {middle} in the middle, {edge} at the edge" for who, middle, edge in parts)
    return Picture(
        "error-over-field",
        "Where the errors are",
        fig_error_by_distance(rings, baseline=MEAN),
        f"Mean absolute error in rings around the centre of the field. {ends}.",
        "As the paper's Fig. 10: mean absolute error, over both axes, of frames by the distance of their laser from "
        "the centre of the target's field. Grey: a guess that looks at no image. Bars: 95 % bootstrap intervals over "
        "blocks of 15 neighbouring frames. Below: the number of frames in each ring.",
    )


def _by_image(outcome: Outcome, name: str) -> Picture:
    said = outcome.prediction
    ends = {q: (said.lower[:, k], said.upper[:, k]) for k, q in enumerate(outcome.quantities)}
    truth = {quantity: outcome.truth[quantity] for quantity in FOCUS}
    return Picture(
        "by-image",
        "Focus by test image",
        fig_by_image(truth, {name: {quantity: said[quantity] for quantity in FOCUS}}, interval=ends),
        f"{name}'s estimates of object distance and focal length for {len(outcome)} test images, with the truth in "
        "steps.",
        "As the paper's Fig. 11. The test images are sorted by their true object distance, and within each by their "
        "true focal length: the black lines. Dots: the estimate from each image alone; shaded: its 90 % interval.",
    )


def _map(outcome: Outcome, name: str) -> Picture:
    maps = {quantity: error_map(outcome, quantity) for quantity in FOCUS}
    return Picture(
        "error-map",
        "Where the errors are",
        fig_error_map({name: maps}),
        "Mean absolute error of object distance and of focal length for each pair of true values.",
        "As the paper's Fig. 12: mean absolute error of object distance (above) and focal length (below) for each true "
        f"object distance and focal length. {_largest(maps['object_distance'])}",
    )


def _largest(found: ErrorMap) -> str:
    """Say where the object distance is least accurate."""
    row, column = np.unravel_index(int(np.nanargmax(found.mae)), found.mae.shape)
    at = f"focal length {1e3 * found.y[row]:.0f} mm, object distance {found.x[column]:g} m"
    return f"The object distance is least accurate at {at}: {found.mae[row, column]:.3g} m."


def _classes(outcome: Outcome, name: str) -> Iterator[Picture]:
    scores = score_classes(outcome)
    if scores is None:
        return
    yield Picture(
        "confusion",
        "Devices",
        fig_confusion(scores.confusion, scores.names),
        f"Which device was taken for which: {scores.top_1:.1%} of {scores.count} frames are right.",
        "A row for each true device, a column for what the model said: all on the diagonal would be perfect. Numbers "
        "are frames, colours the share of the row. The likeliest device counts, however sure the model was.",
    )
    yield Picture(
        "reliability",
        "Devices",
        fig_reliability({name: scores.reliability}),
        f"Share correct against the probability given; expected calibration error {scores.reliability.error:.3f}.",
        f"Frames are sorted by the probability of their likeliest device into {len(scores.reliability.count)} bins of "
        "equal numbers. On the dashed line a model is right as often as it says. The expected calibration error is the "
        "mean distance from that line. Bars: 95 % Wilson intervals that treat frames as independent; neighbours in a "
        "video are not, so they are too short.",
    )


def _coverage(outcome: Outcome) -> Picture:
    everything = group(outcome, "all test frames", np.ones(len(outcome), dtype=bool))
    parts = {"": [everything], "by recording": by_recording(outcome), "by signal over noise": by_snr(outcome)}
    devices = by_device(outcome)
    if len(devices) > 1 and [one.name for one in devices] != [one.name for one in parts["by recording"]]:
        parts["by device"] = devices
    if len(parts["by recording"]) == 1:
        del parts["by recording"]
    return Picture(
        "coverage",
        "Intervals",
        fig_coverage(parts, outcome.quantities),
        "Share of true values inside the 90 % intervals: "
        + ", ".join(f"{q} {c:.1%}" for q, c in zip(outcome.quantities, everything.coverage, strict=True))
        + ".",
        "Share of truths inside the model's intervals, nominally 90 %"
        + (", those for a copy of the camera that it was not trained on" if outcome.prediction.unit == "other" else "")
        + ". The number of frames is in brackets. Errors of "
        "neighbouring frames are correlated, so the share in one recording scatters more than that number suggests.",
    )


def _against(outcome: Outcome, name: str) -> Iterator[Picture]:
    """Draw the error against SNR and other covariates of the frames."""
    error, base, label = _error(outcome)
    known: dict[str, tuple[NDArray[np.float64], str]] = {"SNR": (outcome.snr, "signal-to-noise ratio of the crop")}
    known |= {key: (values, f"{key}, {COVARIATES.get(key, '')}") for key, values in outcome.covariates.items()}
    for key, (values, text) in known.items():
        if len(np.unique(values)) < 2:
            continue
        curves = {name: binned_errors(values, error)}
        if base is not None:
            curves[MEAN] = binned_errors(values, base)
        low, high = curves[name].mean[0], curves[name].mean[-1]
        ends = curves[name].x
        wide = float(values.min()) > 0 and bool(ends[-1] > 6 * ends[0])
        yield Picture(
            f"error-by-{key.lower()}",
            "What the error depends on",
            fig_error_by(curves, x=text, y=label, baseline=MEAN, log_x=wide),
            f"Mean error against {key}: {low:.3g} where it is least, {high:.3g} where it is most.",
            f"Mean error of frames by their {text.split(',')[0]}, in bins. Bars: 95 % "
            "bootstrap intervals over blocks of 15 neighbouring frames. It shows correlation, not causation: "
            "faint frames may be faint because the gaze is far from the centre.",
        )


def _error(outcome: Outcome) -> tuple[NDArray[np.float64], NDArray[np.float64] | None, str]:
    """Return one absolute error a frame, the guess', and its label; of several units, in parts of the guess' error."""
    off = np.abs(outcome.prediction.value - outcome.targets)
    base = outcome.baseline
    guess = None if base is None else np.abs(base - outcome.targets)
    units = {look(quantity).unit for quantity in outcome.quantities}
    if len(units) == 1:
        scale = look(outcome.quantities[0]).scale
        unit = look(outcome.quantities[0]).unit
        return scale * off.mean(axis=1), None if guess is None else scale * guess.mean(axis=1), f"MAE, {unit}"
    # Object distance and focal length are comparable only relative to their spread.
    each = outcome.targets.std(axis=0) if guess is None else guess.mean(axis=0)
    each = np.maximum(each, np.finfo(float).tiny)
    label = "MAE over the labels' deviation" if guess is None else f"MAE over that of {MEAN}"
    return (off / each).mean(axis=1), None if guess is None else (guess / each).mean(axis=1), label
