"""Tables of an evaluation's page whose columns depend on what is estimated."""

from __future__ import annotations

import numpy as np

from tapetum.report import html
from tapetum.report.evaluation.outcome import Outcome
from tapetum.report.evaluation.scores import Group, by_device, by_recording, by_snr, score_classes
from tapetum.report.formatting import look, written
from tapetum.report.html import Html

__all__ = ["devices", "parts"]


def devices(outcome: Outcome) -> Html | None:
    """Return the table by device (the paper's Table 2); None for a single device without classes."""
    scores = score_classes(outcome)
    groups = by_device(outcome) if outcome.quantities else []
    if scores is None and len(groups) < 2:
        return None
    recall = {} if scores is None else dict(zip(scores.names, scores.recall, strict=True))
    names = sorted(set(outcome.device or ()))
    count = {name: (outcome.device or ()).count(name) for name in names}
    told = {one.name: one for one in groups}
    columns = ["device", "frames", *(["correct"] if scores else [])]
    columns += [look(q).plain for q in outcome.quantities]
    gaze = [outcome.quantities.index(axis) for axis in ("gaze_x", "gaze_y")] if outcome.has_gaze else []
    columns += ["gaze"] if gaze else []
    rows = []
    for name in names:
        row = [name if scores is None or name in recall else f"{name} (unknown)", str(count[name])]
        row += [html.share(recall.get(name), 1)] if scores else []
        if name in told:
            row += _errors(outcome, told[name])
            row += [_both(told[name], gaze)] if gaze else []
        rows.append(row)
    return html.table(
        columns,
        rows,
        numeric=range(1, len(columns)),
        caption="By device, as the paper's Table 2. "
        + ("Correct: share of its frames whose likeliest device is the true one. " if scores else "")
        + ("Errors are MAE / RMSE; “gaze” is over both axes, in fractions of the field." if gaze else ""),
    )


def _errors(outcome: Outcome, one: Group) -> list[str]:
    return [
        f"{look(q).shown(a)} / {look(q).shown(b)}"
        for q, a, b in zip(outcome.quantities, one.mae, one.rmse, strict=True)
    ]


def _both(one: Group, columns: list[int]) -> str:
    """MAE and RMSE over both axes of the gaze."""
    mean = np.mean([one.mae[k] for k in columns])
    root = np.sqrt(np.mean([one.rmse[k] ** 2 for k in columns]))
    return f"{written(float(mean))} / {written(float(root))}"


def parts(outcome: Outcome) -> list[Html]:
    """Return the errors and intervals of every recording and every quarter of SNR; nothing without quantities."""
    pieces: list[Html] = []
    names = [look(q).plain for q in outcome.quantities]
    for title, groups in (("recording", by_recording), ("signal over noise", by_snr)) if names else ():
        rows = [
            [one.name, str(one.count), *_errors(outcome, one), *(html.share(held, 1) for held in one.coverage)]
            for one in groups(outcome)
        ]
        caption = "MAE / RMSE, and the share of true values inside the 90 % interval."
        columns = [title, "frames", *names, *(f"{name} inside" for name in names)]
        pieces.append(html.table(columns, rows, numeric=range(1, len(columns)), caption=caption))
    return pieces
