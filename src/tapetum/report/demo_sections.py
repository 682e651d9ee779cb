"""The results in the demo's report: its headline, its tables of errors and the figures of gaze."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tapetum.report import figures, html
from tapetum.report.figures._style import runs
from tapetum.report.html import Html
from tapetum.report.metrics import GazeScores, coverage, predict_mean
from tapetum.report.rings import error_by_distance
from tapetum.report.verdicts import MEAN

if TYPE_CHECKING:
    from tapetum.report.demo_report import DemoReport, DemoScores


def share(value: float | None, digits: int = 0) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"


def seconds(value: float) -> str:
    return f"{value:.1f} s" if value < 120 else f"{value / 60:.1f} min"


def opening(content: DemoReport, scores: DemoScores) -> Html:
    """Return the numbers a reader came for, and one sentence that says whether the models beat a guess."""
    numbers = [
        (f"{one.mae_overall:.3f}", f"{name}: mean error, fraction of the field of view") for name, one in scores.models
    ]
    numbers.append((f"{scores.baseline.mae_overall:.3f}", "the same for a guess that never looks: the training mean"))
    first_name, first = scores.models[0]
    if first.sign_count[0] + first.sign_count[1]:
        pairs = [(right or 0.0) * n for right, n in zip(first.sign_right, first.sign_count, strict=True)]
        value = sum(pairs) / sum(first.sign_count)
        numbers.append((share(value), f"{first_name}: left distinguished from right and up from down"))
    numbers.append((f"{scores.labels.median:.2f} px", "median error of the labels, pixels of the target's video"))
    if content.timings:
        numbers.append((seconds(sum(value for _, value in content.timings)), "from an empty folder to this page"))
    return html.join([html.headline(numbers), *_verdict(scores)])


def _verdict(scores: DemoScores) -> list[Html]:
    """Say plainly which model beats what."""
    base = scores.baseline.mae_overall
    worse = [name for name, one in scores.models if one.mae_overall >= base]
    name, first = scores.models[0]
    said: list[Html] = []
    if first.mae_overall < base:
        said.append(
            html.paragraph(
                f"On frames it has never seen, {name} errs by {first.mae_overall:.3f} of the field on "
                f"average, {base / first.mae_overall:.1f} times less than predicting the mean of the "
                "training labels."
            )
        )
    if worse:
        said.append(
            html.note(f"Not better than predicting the training mean: {', '.join(worse)}. Do not use such estimates.")
        )
    ahead = [other for other, one in scores.models[1:] if one.mae_overall < first.mae_overall]
    if ahead:
        said.append(html.note(f"{', '.join(ahead)} did better here than {name}."))
    return said


def results(content: DemoReport, scores: DemoScores) -> Html:
    """Return the table of errors of every model and of the baseline."""

    def row(name: str, one: GazeScores, held: str) -> list[str]:
        cells = [f"{a:.3f} / {b:.3f}" for a, b in zip(one.mae, one.rmse, strict=True)]
        signs = [share(part) for part in one.sign_right]
        overall = f"{one.mae_overall:.3f} / {one.rmse_overall:.3f}"
        return [name, *cells, overall, f"{one.radial_rms:.3f}", *signs, held]

    rows = []
    for model, (name, one) in zip(content.models, scores.models, strict=True):
        held = "–"
        if model.lower is not None and model.upper is not None:
            held = " / ".join(share(float(v)) for v in coverage(content.truth, model.lower, model.upper))
        rows.append(row(name, one, held))
    rows.append(row("predicting " + MEAN, scores.baseline, "–"))
    best = int(np.argmin([one.mae_overall for _, one in scores.models] + [scores.baseline.mae_overall]))
    first = scores.models[0][1]
    main = html.table(
        ["", "x", "y", "both axes", "radius", "sign x", "sign y", "in 90 % interval"],
        rows,
        numeric=range(1, 8),
        best=best,
        caption=f"MAE / RMSE of {first.count} held-out frames in fractions of the field of view (its width "
        f"for x, its height for y), against {content.truth_is}. Radius: root mean square of the distance "
        "between estimate and truth. Sign: share of frames on the right side of the centre, among those "
        f"with |gaze| > {first.sign_threshold:g} ({first.sign_count[0]} in x, {first.sign_count[1]} in y). "
        "Last column: share of true values inside the model's 90 % interval, x / y.",
    )
    return html.join(
        [
            main,
            _thirds(scores),
            html.bullets(f"{model.name}: {model.training}" for model in content.models),
        ]
    )


def _thirds(scores: DemoScores) -> Html:
    everyone = [*scores.models, ("predicting " + MEAN, scores.baseline)]
    rings = scores.baseline.thirds
    names = [f"{r.inner:.2f} – {r.outer:.2f}" if np.isfinite(r.outer) else f"beyond {r.inner:.2f}" for r in rings]
    rows = [
        [name, *("–" if t.mae is None else f"{t.mae:.3f} / {t.rmse:.3f}" for t in one.thirds)] for name, one in everyone
    ]
    counts = ", ".join(str(ring.count) for ring in rings)
    return html.table(
        ["", *names],
        rows,
        numeric=range(1, 4),
        caption="MAE / RMSE over both axes in three rings of the field, by the true distance from its "
        f"centre (fractions of the field); {counts} frames.",
    )


def following(content: DemoReport) -> Html:
    """Return the path over the picture and the estimates over time."""
    first = content.models[0]
    stretch = runs(content.time)[0]
    begin, end = content.path if content.path is not None else (stretch.start, stretch.stop)
    marks = [
        (rr, at - begin) for rr, at in zip(content.path_rrs, content.path_rrs_at, strict=True) if begin <= at < end
    ]
    path = figures.fig_gaze_path(
        content.picture,
        content.truth[begin:end],
        first.predicted[begin:end],
        content.time[begin:end] - content.time[begin],
        name=first.name,
        rrs=[rr for rr, _ in marks],
        rrs_at=[at for _, at in marks],
    )
    interval = None if first.lower is None or first.upper is None else (first.lower, first.upper)
    over = figures.fig_gaze_over_time(
        content.time,
        content.truth,
        {model.name: model.predicted for model in content.models},
        interval=interval,
    )
    seen = "; ".join(
        f"{model.name} in {axis}: correlation {_correlation(content.truth[:, k], model.predicted[:, k])}"
        for model in content.models
        for k, axis in enumerate("xy")
    )
    return html.join(
        [
            html.figure(
                path,
                alt=f"The target's picture with the true path of the laser in it and {first.name}'s "
                f"estimates, both coloured by time over {content.time[end - 1] - content.time[begin]:.0f} "
                "seconds.",
                caption=f"A section of the held-out part ({end - begin} frames), as the paper's Fig. 9 "
                "(a). Band: where the probe's laser stands in the target's picture. Dots: where "
                f"{first.name} says it stands, from the retro-reflection alone; thin lines tie each dot to "
                "its truth. Numbers: the RRs on the left, each with its gaze.",
            ),
            html.figure(
                over,
                alt=f"Estimated against true gaze over time and as scatter, x and y. {seen}.",
                caption="Every held-out frame, as the paper's Fig. 9 (b, c). Dashed verticals part the "
                "videos. Triangles at the edge stand for estimates beyond the axes.",
            ),
        ]
    )


def _correlation(a: np.ndarray, b: np.ndarray) -> str:
    return f"{np.corrcoef(a, b)[0, 1]:.2f}" if np.std(a) > 0 and np.std(b) > 0 else "none"


def errors(content: DemoReport) -> Html:
    """Return the error against the distance from the centre."""
    truth = content.truth
    reach = float(np.hypot(*truth.T).max())
    edges = np.linspace(0.0, max(reach, 1e-6) * 1.0001, 11)
    estimates = {model.name: model.predicted for model in content.models}
    everyone = estimates | {MEAN: predict_mean(content.train, len(truth))}
    rings = {name: error_by_distance(truth, values, edges=edges) for name, values in everyone.items()}
    known = {name: one.mae[np.isfinite(one.mae)] for name, one in rings.items()}
    said = "; ".join(f"{name}: {v[0]:.3f} in the middle, {v[-1]:.3f} at the edge" for name, v in known.items())
    return html.figure(
        figures.fig_error_by_distance(rings, baseline=MEAN),
        alt=f"Mean absolute error in rings around the centre of the field. {said}.",
        caption="As the paper's Fig. 10, with the guess that never looks beside it. Bars: 95 % bootstrap "
        "intervals over blocks of 15 neighbouring frames. Below: how many frames each ring holds.",
    )
