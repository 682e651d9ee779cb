"""`tapetum export`: a trained network as one ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tapetum.cli.models import find_model
from tapetum.cli.options import Force, option
from tapetum.cli.outputs import check_output
from tapetum.errors import InputError


def export(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="A network's folder, or the bundled thin-lens-gaze.")],
    out: Annotated[Path, option("FILE", "Where to write it: NAME.onnx.", "-o", "--out")],
    force: Force = False,
) -> None:
    """Write a network to one ONNX file, preparation included: counts in, estimates out.

    Needs the extra `fast`. The file's metadata, under "tapetum", describe its inputs, outputs, units and intervals.
    """
    if out.suffix.lower() != ".onnx":
        raise InputError(f"unknown kind of export {out.suffix!r}", where=out, remedy="name it NAME.onnx")
    check_output(out, force)
    from tapetum.models.export import export_onnx

    export_onnx(find_model(model), out)
    typer.echo(f"{out}: {out.stat().st_size / 1e6:.0f} MB")
