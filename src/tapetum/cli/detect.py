"""`tapetum detect`: cameras in a photograph, or in a lit and a dark one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from tapetum.cli.options import AsJson, Force, option
from tapetum.cli.outputs import check_output
from tapetum.errors import InputError

__all__ = ["detect"]

# As many finds, each with at most so many expected false alarms a frame, are said to be doubtful.
_MANY, _RARE = 6, 0.01


def detect(
    lit: Annotated[Path, typer.Argument(metavar="LIT", help="A picture taken with the probe's light on.")],
    out: Annotated[Path, option("FILE", "The table to write: .parquet, .csv or .jsonl.", "-o", "--out")],
    dark: Annotated[Path | None, option("DARK", "The same with the light off; both may be hand-held.")] = None,
    false_alarms: Annotated[
        float,
        option(
            "RATE",
            "Expected false alarms a frame: what scores lower is left out.",
            "--false-alarms-per-frame",
            "--false-alarms",
            min=1e-6,
        ),
    ] = 0.01,
    largest: Annotated[float, option("PX", "Largest diameter of a spot.", min=1.0)] = 60.0,
    channel: Annotated[str, option("NAME", "Of a colour picture: mean, red, green or blue.")] = "mean",
    picture: Annotated[Path | None, option("OUT.png", "Draw what was found into the lit picture.")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Find cameras, and other optics that look at the probe; the likeliest comes first.

    With --dark the two pictures are registered to each other, so that only what the light adds is looked at. One
    picture alone finds much less: windows, lamps and edges shine too. Places count in pixels of LIT as viewers show it.
    """
    if picture is not None and picture.suffix.lower() != ".png":
        raise InputError("cannot be drawn in this format", where=picture, remedy="name it NAME.png")
    inputs = [lit] if dark is None else [lit, dark]
    for path in (out, picture):
        check_output(path, force, sources=inputs)
    if picture is not None and picture.resolve() == out.resolve():
        raise InputError("is the table too", where="--picture", remedy="name another file")
    if dark is not None and lit.exists() and dark.exists() and lit.samefile(dark):
        raise InputError("is LIT itself", where="--dark", remedy="give the picture with the light off, or leave it out")
    from tapetum.detection import find_cameras
    from tapetum.record.images import read_image
    from tapetum.record.source import full_scale_of
    from tapetum.track.tables import checked_suffix, table_writer

    checked_suffix(out)
    read = [read_image(path, colour=True) for path in inputs]
    pictures = [image for image, _ in read]
    # A PGM says at which level it saturates.
    scales = [None if level == full_scale_of(image.dtype) else level for image, level in read]
    if len({image.dtype for image in pictures}) > 1:
        typer.echo("note: LIT and DARK differ in their bits; each is scaled by its own", err=True)
    wanted: Any = {"false_alarms": false_alarms, "largest": largest, "channel": channel, "full_scale": scales}
    try:
        found = find_cameras(*pictures, **wanted)
    except InputError as error:
        named = {"lit": lit, "dark": dark}.get(str(error.where))
        raise error if named is None else InputError(error.what, where=named, remedy=error.remedy) from error
    table = found.to_table()
    with table_writer(out, table.schema) as writer:
        for row in table.to_pylist():
            writer.write(row)
        if picture is not None:
            from tapetum.detection.draw import draw_found

            # Before the table has its name: without the picture there is none either.
            draw_found(pictures[0], found, picture)
    if found.swapped:
        typer.echo("note: what is bright in DARK alone looks more like a camera: are the two swapped?", err=True)
    if int((found.false_alarms <= _RARE).sum()) >= _MANY:
        typer.echo(
            "note: so many at once are seldom all cameras: drops, beads and glossy edges shine back as small and round "
            "as lenses; look at each from near by",
            err=True,
        )
    if as_json:
        typer.echo(json.dumps({"out": str(out), "found": table.to_pylist()}))
        return
    typer.echo(f"{out}: {len(found)} found at {false_alarms:g} expected false alarms a frame")
    for row in table.slice(0, 5).to_pylist():
        typer.echo(f"  x {row['x']:.1f}, y {row['y']:.1f}: probability {row['probability']:.2f}, snr {row['snr']:.0f}")
