"""The words and tables of an evaluation's page."""

from __future__ import annotations

from typing import Any

import numpy as np

from tapetum.models.prediction import NONE_OF_THESE
from tapetum.report import html
from tapetum.report.evaluation.outcome import Outcome
from tapetum.report.evaluation.scores import Group, by_device, by_recording, by_snr, score_classes
from tapetum.report.figures.errors import look
from tapetum.report.html import Html
from tapetum.report.verdicts import MEAN, NARROW, warnings

__all__ = ["devices", "everything", "opening", "parts", "reading"]


def _number(quantity: str, value: float | None) -> str:
    """Write an error in the unit of figures."""
    if value is None:
        return "–"
    shown = look(quantity).scale * value
    return f"{shown:.3f}" if shown < 10 else f"{shown:.1f}"


def _plain(quantity: str) -> str:
    """Return a quantity's name without the formula that figures write."""
    return look(quantity).name.split(" $")[0]


def _percent(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{100 * value:.{digits}f} %"


def opening(scores: dict[str, Any], name: str) -> Html:
    """Return the numbers a reader came for, and a sentence that says whether they beat a guess."""
    numbers: list[tuple[str, str]] = []
    targets = scores["targets"]
    if "gaze" in scores:
        numbers.append((f"{scores['gaze']['mae_overall']:.3f}", "gaze: mean error, fraction of the field of view"))
        if "baseline_gaze" in scores:
            text = f"the same for a guess that never looks: {MEAN}"
            numbers.append((f"{scores['baseline_gaze']['mae_overall']:.3f}", text))
    for quantity, one in targets.items():
        if quantity in ("gaze_x", "gaze_y") and "gaze" in scores:
            continue
        guess = one["baseline_mae"]
        beside = "" if guess is None else f"; {MEAN}: {_number(quantity, guess)}"
        unit = look(quantity).unit
        numbers.append((f"{_number(quantity, one['mae'])} {unit}", f"{_plain(quantity)}: mean error{beside}"))
    if "classes" in scores:
        one = scores["classes"]
        numbers.append(
            (_percent(one["top_1"]), f"of {one['frames']} frames: the right device of {len(one['per_class'])}")
        )
        numbers.append((f"{one['expected_calibration_error']:.3f}", "expected calibration error of its probabilities"))
        if one["unknown"]["auroc"] is not None:
            numbers.append((f"{one['unknown']['auroc']:.3f}", "AUROC: unknown devices against known ones"))
    if any(one["interval"] is not None for one in targets.values()):
        numbers.append((_percent(scores["coverage"]["all"]), "of true values inside the 90 % intervals"))
    return html.join([html.headline(numbers), *_verdict(scores, name)])


def _verdict(scores: dict[str, Any], name: str) -> list[Html]:
    said: list[Html] = []
    ratios = {
        quantity: one["baseline_mae"] / max(one["mae"], 1e-300)
        for quantity, one in scores["targets"].items()
        if one["baseline_mae"] is not None
    }
    verdicts = {quantity: scores["targets"][quantity]["verdict"] for quantity in ratios}
    better = [f"{_plain(q)} {ratio:.1f} times" for q, ratio in ratios.items() if not warnings(verdicts[q])]
    if better:
        said.append(html.paragraph(f"{name} errs less than predicting {MEAN}: {', '.join(better)}."))
    poor = [f"{_plain(q)} is {verdict}" for q, verdict in verdicts.items() if warnings(verdict)]
    if poor:
        said.append(html.note(f"{'; '.join(poor)}. Do not use such estimates."))
    off = [f"{_plain(q)}: {one['intervals']}" for q, one in scores["targets"].items() if one["intervals"] == NARROW]
    if off:
        said.append(html.note(f"The 90 % intervals hold too few true values ({'; '.join(off)})."))
    return said


def everything(scores: dict[str, Any], name: str) -> Html:
    """Return the tables over all test frames."""
    pieces: list[Html] = []
    if scores["targets"]:
        rows = [
            [
                f"{_plain(quantity)}, {look(quantity).unit}" if look(quantity).unit else _plain(quantity),
                f"{_number(quantity, one['mae'])} / {_number(quantity, one['rmse'])}",
                f"{_number(quantity, one['baseline_mae'])} / {_number(quantity, one['baseline_rmse'])}",
                "–" if one["interval"] is None else _percent(one["coverage"]),
                "infinite" if one["interval"] is None else f"± {_number(quantity, one['interval'])}",
            ]
            for quantity, one in scores["targets"].items()
        ]
        pieces.append(
            html.table(
                ["", name, f"predicting {MEAN}", "in 90 % interval", "its median"],
                rows,
                numeric=range(1, 5),
                caption=f"MAE / RMSE of {scores['frames']} test frames, as the paper's Table 1 gives them. MAE: mean "
                "of the error's size; RMSE: root of the mean of its square, which weighs large errors more.",
            )
        )
    if "gaze" in scores:
        pieces.append(_gaze(scores, name))
    return html.join(pieces)


def _gaze(scores: dict[str, Any], name: str) -> Html:
    every = {name: scores["gaze"]}
    if "baseline_gaze" in scores:
        every[f"predicting {MEAN}"] = scores["baseline_gaze"]
    thirds = scores["gaze"]["thirds"]
    names = [f"{t['inner']:.2f} – {t['outer']:.2f}" if t["outer"] else f"beyond {t['inner']:.2f}" for t in thirds]
    rows = [
        [
            who,
            f"{one['mae_overall']:.3f} / {one['rmse_overall']:.3f}",
            f"{one['radial']:.3f} / {one['radial_rms']:.3f}",
            *("–" if t["mae"] is None else f"{t['mae']:.3f} / {t['rmse']:.3f}" for t in one["thirds"]),
            *(_percent(part, 0) for part in one["sign_right"]),
        ]
        for who, one in every.items()
    ]
    counts = ", ".join(str(t["count"]) for t in thirds)
    return html.table(
        ["gaze", "both axes", "distance", *names, "sign x", "sign y"],
        rows,
        numeric=range(1, 8),
        caption="MAE / RMSE in fractions of the field of view (its width for x, its height for y): over both axes, and "
        f"in thirds of the field by the true distance from its centre ({counts} frames). Distance: mean and root "
        "mean square of how far the estimate lies from the truth. Sign: share of frames on the right side of the "
        f"centre, among those farther than {scores['gaze']['sign_threshold']:g} from it.",
    )


def devices(outcome: Outcome) -> Html | None:
    """Return the table by device (the paper's Table 2), and what was measured of classes."""
    scores = score_classes(outcome)
    groups = by_device(outcome) if outcome.quantities else []
    if scores is None and len(groups) < 2:
        return None
    recall = {} if scores is None else dict(zip(scores.names, scores.recall, strict=True))
    names = sorted(set(outcome.device or ()))
    count = {name: (outcome.device or ()).count(name) for name in names}
    told = {one.name: one for one in groups}
    columns = ["device", "frames", *(["correct"] if scores else [])]
    columns += [f"{_plain(q)}" for q in outcome.quantities]
    gaze = [outcome.quantities.index(axis) for axis in ("gaze_x", "gaze_y")] if outcome.has_gaze else []
    columns += ["gaze"] if gaze else []
    rows = []
    for name in names:
        row = [name if scores is None or name in recall else f"{name} (unknown)", str(count[name])]
        row += [_percent(recall.get(name))] if scores else []
        if name in told:
            row += _errors(outcome, told[name])
            row += [_both(told[name], gaze)] if gaze else []
        rows.append(row)
    pieces: list[Html] = []
    if scores is not None:
        pieces.append(html.paragraph(_class_words(scores)))
    pieces.append(
        html.table(
            columns,
            rows,
            numeric=range(1, len(columns)),
            caption="By device, as the paper's Table 2. "
            + ("Correct: share of its frames whose likeliest device is the true one. " if scores else "")
            + ("Errors are MAE / RMSE; “gaze” is over both axes, in fractions of the field." if gaze else ""),
        )
    )
    return html.join(pieces)


def _class_words(scores: Any) -> str:
    guess = "" if scores.baseline is None else f", always saying the commonest one {_percent(scores.baseline)}"
    text = (
        f"The likeliest device is the right one in {_percent(scores.top_1, 2)} of {scores.count} frames{guess}. "
        f"Expected calibration error {scores.reliability.error:.4f} ({len(scores.reliability.count)} bins of equal "
        f"numbers of frames), Brier score {scores.brier:.4f} (0 is perfect, 2 the worst). “{NONE_OF_THESE}” was the "
        f"answer to {_percent(scores.told_none)} of the frames of known devices"
    )
    if scores.unknown:
        text += f", and to {_percent(scores.unknown_told_none)} of {scores.unknown} frames of devices it never saw"
    if scores.auroc is not None:
        text += f"; the area under the ROC curve of its novelty is {scores.auroc:.3f} (0.5: a guess, 1: perfect)"
    return text + "."


def _errors(outcome: Outcome, one: Group) -> list[str]:
    return [f"{_number(q, a)} / {_number(q, b)}" for q, a, b in zip(outcome.quantities, one.mae, one.rmse, strict=True)]


def _both(one: Group, columns: list[int]) -> str:
    """MAE and RMSE over both axes of the gaze."""
    mean = np.mean([one.mae[k] for k in columns])
    root = np.sqrt(np.mean([one.rmse[k] ** 2 for k in columns]))
    return f"{mean:.3f} / {root:.3f}"


def parts(outcome: Outcome) -> Html | None:
    """Return the errors and intervals of every recording and every quarter of SNR."""
    if not outcome.quantities:
        return None
    pieces: list[Html] = []
    names = [_plain(q) for q in outcome.quantities]
    for title, groups in (("recording", by_recording(outcome)), ("signal over noise", by_snr(outcome))):
        rows = [
            [one.name, str(one.count), *_errors(outcome, one), *(_percent(held) for held in one.coverage)]
            for one in groups
        ]
        caption = "MAE / RMSE, and the share of true values inside the 90 % interval."
        columns = [title, "frames", *names, *(f"{name} inside" for name in names)]
        pieces.append(html.table(columns, rows, numeric=range(1, len(columns)), caption=caption))
    return html.join(pieces)


def reading(outcome: Outcome) -> Html:
    """Return what the numbers do not say."""
    items = [
        "Test frames are the last part of each video by default, as in the paper: the same camera, probe and alignment "
        "as in training, at another time. What a model does on a new recording is usually worse; evaluate it on one.",
        "Frames of a video resemble their neighbours: numbers vary more from recording to recording than the number of "
        "frames suggests.",
    ]
    if outcome.simulated:
        items.insert(0, "Simulation: the virtual bench filmed these frames. No real camera was filmed.")
    else:
        items.insert(0, "The dataset does not say whether a real camera or a simulated one was filmed.")
    if outcome.guess is None:
        items.append("The set holds no training frames, so that there is no mean of theirs to beat.")
    return html.bullets(items)
