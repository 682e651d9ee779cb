"""`tapetum cameras`: what is plugged in."""

from __future__ import annotations

import json
from typing import Any

import typer

from tapetum.cli.options import AsJson


def cameras(as_json: AsJson = False) -> None:
    """List the cameras that are plugged in, what to write for each, and its modes.

    A name such as v4l2:0 or genicam:NAME goes where `record` and `track` take a source; a form and a size may follow:
    v4l2:0,Y12,1280x960. Nothing is recorded.
    """
    from tapetum.record.plugged import look_for_cameras

    found, notes = look_for_cameras()
    if as_json:
        typer.echo(json.dumps({"cameras": [one.as_dict() for one in found], "notes": notes}))
        return
    if not found:
        typer.echo("no camera is plugged in")
    for one in found:
        typer.echo(f"{one.source}  {one.name}{f' ({one.note})' if one.note else ''}")
        for mode in one.modes:
            typer.echo(f"    {_mode(mode)}")
    for note in notes:
        typer.echo(f"note: {note}", err=True)


def _mode(mode: dict[str, Any]) -> str:
    words = [str(mode["form"])] if "form" in mode else []
    if "width" in mode:
        words.append(f"{mode['width']} x {mode['height']} px")
    words.append("colour or compressed" if mode["bits"] is None else f"{mode['bits']} bit grey")
    if mode.get("rates"):
        words.append(f"up to {mode['rates'][0]:g} frames/s")
    return ", ".join(words)
