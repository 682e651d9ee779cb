"""`tapetum track`: detect and track the retro-reflections of a video, a folder of images or a recording."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.cli.models import find_model
from tapetum.cli.options import WAYS, AsJson, Device, Force, Models, Smooth, Systematic, TracksOut, option
from tapetum.cli.outputs import check_output, says_what_is_kept
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

if TYPE_CHECKING:
    import pyarrow as pa


def track(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="A camera:0, video, folder of images, image, recording, bench:SCENE, or a table of --detections.",
        ),
    ],
    out: TracksOut,
    models: Models = None,
    detections: Annotated[
        Path | None, option("FILE", "Keep what was detected here too, to track again without the video.")
    ] = None,
    min_snr: Annotated[float, option("RATIO", "Least signal-to-noise ratio of a detection.", min=1.0)] = 6.0,
    largest: Annotated[
        float, option("PX", "Largest diameter of a retro-reflection: wider spots are walls and lamps.", min=1.0)
    ] = 400.0,
    smooth: Smooth = None,
    systematic: Systematic = 1.0,
    stream: Annotated[str, option("NAME", "Which stream of a recording.")] = "probe",
    seconds: Annotated[
        float | None, option("S", "Track so long; else to the end, or of a camera to Ctrl-C.", min=0.01)
    ] = None,
    device: Device = "auto",
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Track every retro-reflection, and estimate its camera's gaze with models."""
    if detections is not None and detections.resolve() == out.resolve():
        raise InputError("is the file of the tracks too", where="--detections", remedy="name another file")
    if smooth is not None:
        one_of(smooth, WAYS, "--smooth")
    if source.exists() and source.resolve() == out.resolve():
        raise InputError("is the source itself", where="--out", remedy="name another file")
    for path in (out, detections):
        check_output(path, force)
    from tapetum.files import free_name
    from tapetum.track import track_to_file, write_tracks
    from tapetum.track.formats import FORMATS
    from tapetum.track.tables import checked_suffix

    if source.suffix.lower() in FORMATS and source.is_file():
        if models or detections is not None:
            remedy = "leave --model and --detections out, or give the video"
            raise InputError("holds detections, not frames", where=source, remedy=remedy)
        _again(source, out, smooth, systematic)
        return
    if smooth is not None and not models:
        raise InputError("without a model there is nothing to smooth", where="--smooth", remedy="give --model")
    checked_suffix(out)
    # What is smoothed takes its name only when it is; until then, and if it cannot be, the tracks are kept beside.
    raw = out if smooth is None else free_name(out, "unsmoothed")
    with says_what_is_kept():
        summary = track_to_file(
            source,
            raw,
            model=[find_model(name, device) for name in models or ()],
            detections=detections,
            detect_options={"min_snr": min_snr, "largest": largest},
            stream=stream,
            seconds=seconds,
            progress=bar,
        )
    if smooth is not None:
        from tapetum.track import read_tracks

        try:
            write_tracks(_smoothed(read_tracks(raw), smooth, systematic), out)
        except InputError as error:
            remedy = "; ".join(filter(None, (error.remedy, f"the tracks as they are stand in {raw}")))
            raise InputError(error.what, where=error.where, remedy=remedy) from error
        raw.unlink()
    if as_json:
        typer.echo(json.dumps({**asdict(summary), "out": str(out)}))
        return
    counts = (("track", summary.tracks), ("frame", summary.frames), ("sighting", summary.seen))
    tracks, frames, seen = (f"{count} {word}{'' if count == 1 else 's'}" for word, count in counts)
    typer.echo(f"{out}: {tracks} in {frames}, {seen}{f', {summary.lost} frames lost' if summary.lost else ''}")


def _smoothed(table: pa.Table, way: str | None, systematic: float) -> pa.Table:
    """Smooth a table of tracks; one without rows, or whose models refuse every row, stays as it is."""
    from tapetum.track.smooth import smooth_tracks

    applies = set(table["applies"].to_pylist() if "applies" in table.column_names else ()) - {None}
    if way is None or not table.num_rows or applies == {False}:
        return table
    return smooth_tracks(table, causal=way == "live", systematic=systematic)


def _again(source: Path, out: Path, smooth: str | None, systematic: float) -> None:
    """Track stored detections again, with their estimates."""
    from tapetum.track import retrack, write_tracks

    tracks = _smoothed(retrack(source), smooth, systematic)
    write_tracks(tracks, out)
    number = len(set(tracks["track"].to_pylist()))
    typer.echo(f"{out}: {number} track{'' if number == 1 else 's'} in {tracks.num_rows} rows, from kept detections")
