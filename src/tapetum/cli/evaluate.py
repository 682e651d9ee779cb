"""`tapetum evaluate`: the errors of a model on a dataset's test part."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from tapetum.cli.inputs import find_model
from tapetum.errors import InputError
from tapetum.progress import bar


def evaluate(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A model's folder, or the bundled thin-lens-gaze.")],
    dataset: Annotated[Path, typer.Argument(metavar="SET", help="A dataset, NAME.zarr.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE", help="Where to write the numbers: NAME.json.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print them as JSON.")] = False,
) -> None:
    """Print MAE and RMSE on the test part, beside predicting the training mean."""
    if out is not None and out.suffix.lower() != ".json":
        raise InputError(f"unknown kind of report {out.suffix!r}", where=out, remedy="name it NAME.json")
    from tapetum.data import open_dataset
    from tapetum.files import atomic_file
    from tapetum.report.evaluate import describe, evaluate_model

    fitted = find_model(model)
    data = open_dataset(dataset)
    scores = evaluate_model(fitted, data.tp.test, data.tp.train, progress=bar)
    if out is not None:
        with atomic_file(out) as part:
            part.write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")
    typer.echo(json.dumps(scores) if as_json else describe(scores))
