"""`tapetum evaluate`: the errors of a model on a dataset's test part."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import typer

from tapetum.cli.models import find_model, warn_of_intervals
from tapetum.cli.options import AsJson, Device, Force, ModelName, SetPath, Split, WhoseIntervals, option
from tapetum.cli.outputs import check_output
from tapetum.errors import InputError
from tapetum.progress import bar

# Suffixes of files; the output is a folder.
_FILES = (".html", ".htm", ".pdf", ".md", ".txt", ".csv", ".png", ".yaml", ".zip")


def evaluate(
    model: ModelName,
    dataset: SetPath,
    out: Annotated[
        Path | None,
        option(
            "REPORT",
            "A folder to write: report.html, numbers.json and the figures. NAME.json: the numbers alone.",
            "-o",
            "--out",
        ),
    ] = None,
    split: Split = "time",
    unit: WhoseIntervals = None,
    device: Device = "auto",
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Evaluate a model on a dataset's test part, compared with a guess without images: the training mean."""
    numbers_alone = out is not None and out.suffix.lower() == ".json"
    if out is not None and out.suffix.lower() in _FILES:
        remedy = "name a folder for the whole report, or NAME.json for the numbers alone"
        raise InputError(f"unknown kind of report {out.suffix!r}", where=out, remedy=remedy)
    check_output(out, force, None if numbers_alone else "tapetum-evaluation", sources=[model, dataset])
    from tapetum.data import open_dataset, split_by
    from tapetum.data.marks import marks_of
    from tapetum.files import atomic_file
    from tapetum.models import model_card
    from tapetum.report.evaluation import describe, gather, score, write_evaluation
    from tapetum.report.evaluation.write import samples, subject_of

    fitted = find_model(model, device, unit)
    data = split_by(open_dataset(dataset), split)
    trained = set((getattr(fitted, "training_", None) or {}).get("units") or ())
    if split == "unit" and (both := sorted(trained & set(data.tp.test.tp.units))):
        what = f"the model was trained on {', '.join(both)}, which is to test it"
        raise InputError(what, where="--split", remedy="train it with --split unit, or leave the option out")
    outcome = gather(fitted, data, progress=bar)
    scores = score(outcome)
    if out is not None and numbers_alone:
        with atomic_file(out) as part:
            part.write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")
    elif out is not None:
        card = model_card(model) if Path(model).is_dir() else None
        how = ("" if split == "time" else f" --split {split}") + ("" if unit is None else f" --unit {unit}")
        subject = subject_of(fitted, data, model_name=model, card=card)
        subject = dataclasses.replace(subject, command=f"tapetum evaluate {model} {dataset}{how} -o {out}")
        rrs, rrs_at = samples(outcome, data)
        write_evaluation(out, outcome, subject, rrs=rrs, rrs_at=rrs_at, overwrite=force, progress=bar)
    typer.echo(json.dumps(scores) if as_json else describe(scores))
    warn_of_intervals([model], [fitted.unsure(marks_of(data))])
    if outcome.prediction.unit == "other" and not as_json:
        typer.echo(
            "intervals: those for a copy of the camera that the model was not trained on (--unit own for its own)"
        )
    chosen = (getattr(fitted, "training_", None) or {}).get("chosen") or {}
    for what, why in {} if as_json else chosen.items():
        typer.echo(f"chosen in training: {what}: {why}")
    if out is not None and not as_json:
        typer.echo(f"wrote {out if numbers_alone else out / 'report.html'}")
