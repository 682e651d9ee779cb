"""`tapetum fuse`: one track of a target from several probes."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from tapetum.cli.options import SYSTEMATIC, AsJson, Force, Smooth, Systematic, TracksOut, check_smoothing, option
from tapetum.cli.outputs import check_output
from tapetum.errors import InputError


def fuse(
    tables: Annotated[list[Path], typer.Argument(metavar="TRACKS...", help="The tracks of each probe.")],
    out: TracksOut,
    places: Annotated[
        list[str] | None,
        option(
            "X,Y",
            "Place of each further probe relative to the first, in metres as the target sees it: right, down.",
            "--place",
        ),
    ] = None,
    distance: Annotated[float | None, option("METRES", "Distance of the target from the probes.")] = None,
    field: Annotated[str | None, option("W,H", "The target's whole field of view, in degrees.")] = None,
    roll_spread: Annotated[float, option("DEGREES", "How far the target rolls about its axis (RMS).", min=0.0)] = 0.0,
    offsets: Annotated[
        list[str] | None,
        option(
            "X,Y",
            "In place of the three: what to add to each further probe's gaze to make it the first one's.",
            "--offset",
        ),
    ] = None,
    starts: Annotated[
        list[float] | None,
        option("SECONDS", "How much later each further table's time 0 is; by default from UTC.", "--start"),
    ] = None,
    numbers: Annotated[
        list[int] | None, option("N", "The target's track in each table, where there are several.", "--track")
    ] = None,
    correlation: Annotated[
        float, option("R", "Correlation of two probes' errors; 1 is always safe.", min=0.0, max=1.0)
    ] = 0.5,
    smooth: Smooth = None,
    systematic: Systematic = SYSTEMATIC,
    max_gap: Annotated[
        float | None, option("SECONDS", "Longest gap that is bridged; three frames by default.", min=0.0)
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fuse the tracks of several probes that watch the same target, by their intervals.

    The gaze is given as the first probe sees it. Where two probes contradict each other (chi-square test, 1 in 1000)
    the interval spans both; of three or more the odd one is left out.
    """
    check_smoothing(smooth, systematic)
    if len(tables) < 2:
        raise InputError("a single probe cannot be fused", where=tables[0], remedy="give the tracks of two or more")
    if any(one.resolve() == out.resolve() for one in tables):
        raise InputError("is one of the tables to fuse", where="--out", remedy="name another file")
    for n, one in enumerate(tables):
        if any(one.exists() and other.exists() and one.samefile(other) for other in tables[:n]):
            raise InputError("is given twice: it would count as two probes", where=one, remedy="name each table once")
    check_output(out, force)
    from tapetum.track.fuse import Places, fuse_tracks
    from tapetum.track.smooth import smooth_tracks
    from tapetum.track.tables import checked_suffix, read_tracks, write_tracks

    checked_suffix(out)
    further = len(tables) - 1
    standing: Places | list[tuple[float, float]]
    if offsets:
        if places or distance is not None or field is not None:
            raise InputError("takes the place of --place, --distance and --field", where="--offset", remedy="choose")
        if roll_spread:
            raise InputError("needs --place", where="--roll-spread", remedy="leave it out with --offset")
        standing = [(0.0, 0.0), *_pairs(offsets, "--offset", further)]
    elif places and distance is not None and field is not None:
        degrees = _pair(field, "--field")
        if not all(0 < one < 180 for one in degrees):
            raise InputError(f"must lie between 0 and 180 degrees, is {field}", where="--field")
        if not 0 < distance < math.inf:
            raise InputError(f"must be positive, is {distance:g} m", where="--distance")
        if not math.isfinite(roll_spread):
            raise InputError(f"must be finite, is {roll_spread}", where="--roll-spread", remedy="give degrees")
        width, height = map(math.radians, degrees)
        around = ((0.0, 0.0), *_pairs(places, "--place", further))
        standing = Places(around, distance, (width, height), roll_spread=math.radians(roll_spread))
    else:
        remedy = "give --place, --distance and --field, or --offset"
        raise InputError("it is not known where the probes stand", where="fuse", remedy=remedy)
    if starts is not None and len(starts) != further:
        raise InputError(f"{len(starts)} for {further} further probes", where="--start", remedy="give one for each")
    if starts is not None and not all(map(math.isfinite, starts)):
        told = ", ".join(f"{one:g}" for one in starts)
        raise InputError(f"must be finite, is {told}", where="--start", remedy="give seconds")
    read = [read_tracks(one) for one in tables]
    if smooth is not None:
        read = [smooth_tracks(one, causal=smooth == "live", systematic=systematic) for one in read]
    fused = fuse_tracks(
        read,
        standing,
        tracks=numbers,
        starts=None if starts is None else [0.0, *starts],
        correlation=correlation,
        max_gap=max_gap,
        names=[str(one) for one in tables],
    )
    write_tracks(fused.table, out)
    rows = fused.table.num_rows
    if as_json:
        told = {"rows": rows, "used": fused.used, "dropped": fused.dropped, "disagree": fused.disagree}
        typer.echo(json.dumps({**told, "out": str(out)}))
        return
    shares = ", ".join(f"{table.name} in {used}" for table, used in zip(tables, fused.used, strict=True))
    typer.echo(f"{out}: {rows} rows ({shares}); contradictions: {fused.dropped} settled, {fused.disagree} open")


def _pair(text: str, where: str) -> tuple[float, float]:
    try:
        first, second = (float(one) for one in text.split(","))
    except ValueError as error:
        what = f"{text!r} is not two numbers"
        raise InputError(what, where=where, remedy="write them with a comma between, such as 0.3,0") from error
    if not (math.isfinite(first) and math.isfinite(second)):
        raise InputError(f"{text!r} is not two finite numbers", where=where, remedy="give two such as 0.3,0")
    return first, second


def _pairs(texts: list[str], where: str, count: int) -> list[tuple[float, float]]:
    if len(texts) != count:
        raise InputError(f"{len(texts)} for {count} further probes", where=where, remedy="give one for each")
    return [_pair(text, where) for text in texts]
