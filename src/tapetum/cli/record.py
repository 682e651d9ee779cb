"""`tapetum record`: a recording, from the virtual bench."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from tapetum.bench import load_scene
from tapetum.errors import InputError
from tapetum.progress import bar


def record(
    source: Annotated[
        str, typer.Argument(metavar="SCENE", help="What to film: a bundled scene (hand-held) or a YAML file.")
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="REC", help="The recording's folder, NAME.rec.")],
    seconds: Annotated[float, typer.Option(metavar="S", help="Length.", min=0.1)] = 60.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Frames a second of both cameras.", min=0.1)] = 15.0,
    seed: Annotated[int, typer.Option(metavar="N", help="Of everything random.", min=0)] = 0,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change any field of the scene; may be repeated."),
    ] = None,
    no_labels: Annotated[bool, typer.Option("--no-labels", help="Do not look for the laser afterwards.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a recording of this name.")] = False,
) -> None:
    """Film a hand-held target, and label every frame by the laser in the target's own video."""
    for name, value in (("--seconds", seconds), ("--rate", rate)):
        if not math.isfinite(value):
            raise InputError(f"must be finite, is {value}", where=name, remedy="give a number")
    scene = load_scene(source, changes or ())
    from tapetum.record import Session, film, label_recording

    recording = film(scene, out, Session(seconds, rate, seed), progress=bar, overwrite=overwrite)
    typer.echo(f"{out}: {seconds:g} s, {len(recording.frames('probe'))} probe frames, seed {seed}")
    if not no_labels:
        summary = label_recording(recording, bar)
        typer.echo(f"labelled {summary.labelled} of {summary.n} frames")
