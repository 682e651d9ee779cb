"""`tapetum track`: find, follow and read the retro-reflections of a video, a folder of images or a recording."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.cli.inputs import find_model, says_what_is_kept
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

if TYPE_CHECKING:
    import pyarrow as pa

# Which `--detections` writes, and a source may therefore be.
TABLE_SUFFIXES = (".parquet", ".csv", ".jsonl", ".arrow")
WAYS = ("live", "whole")


def track(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="SOURCE",
            help="A camera:0, video, folder of images, image, recording, or a table of --detections.",
        ),
    ],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="TRACKS", help="The tracks: .parquet, .csv or .jsonl.")],
    models: Annotated[
        list[str] | None,
        typer.Option(
            "--model",
            metavar="MODEL",
            help="A model's folder, a network exported to NAME.onnx, or the bundled thin-lens-gaze; may be repeated.",
        ),
    ] = None,
    detections: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Keep what was detected here too, to track again without the video."),
    ] = None,
    min_snr: Annotated[
        float, typer.Option(metavar="RATIO", help="Least signal-to-noise ratio of a detection.", min=1.0)
    ] = 6.0,
    largest: Annotated[
        float,
        typer.Option(
            metavar="PX", help="Largest diameter of a retro-reflection: wider spots are walls and lamps.", min=1.0
        ),
    ] = 400.0,
    smooth: Annotated[
        str | None,
        typer.Option(metavar="WAY", help="Smooth estimates over time: live (by earlier frames alone) or whole."),
    ] = None,
    systematic: Annotated[
        float, typer.Option(metavar="SHARE", help="Of the intervals, what smoothing may not take away.", min=0.0)
    ] = 1.0,
    stream: Annotated[str, typer.Option(metavar="NAME", help="Which stream of a recording.")] = "probe",
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", help="Track so long; else to the end, or of a camera to Ctrl-C.", min=0.01),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Track every retro-reflection, and let models say where its camera looks."""
    if detections is not None and detections.resolve() == out.resolve():
        raise InputError("is the file of the tracks too", where="--detections", remedy="name another file")
    if smooth is not None:
        one_of(smooth, WAYS, "--smooth")
    if source.suffix.lower() in TABLE_SUFFIXES and source.is_file():
        _again(source, out, smooth, systematic, given=bool(models) or detections is not None)
        return
    if smooth is not None and not models:
        raise InputError("without a model there is nothing to smooth", where="--smooth", remedy="give --model")
    from tapetum.files import free_name
    from tapetum.track import track_to_file
    from tapetum.track.tables import checked_suffix

    checked_suffix(out)
    # What is smoothed takes its name only when it is; until then, and if it cannot be, the tracks are kept beside.
    raw = out if smooth is None else free_name(out, "unsmoothed")
    with says_what_is_kept():
        summary = track_to_file(
            source,
            raw,
            model=[find_model(name) for name in models or ()],
            detections=detections,
            detect_options={"min_snr": min_snr, "largest": largest},
            stream=stream,
            seconds=seconds,
            progress=bar,
        )
    if smooth is not None:
        try:
            _write_smooth(raw, out, smooth, systematic)
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


def _write_smooth(tracks: Path | pa.Table, out: Path, way: str, systematic: float) -> None:
    """Smooth a table of tracks and write it; one without a row needs no smoothing."""
    from tapetum.track import read_tracks, write_tracks
    from tapetum.track.smooth import smooth_tracks

    table = read_tracks(tracks) if isinstance(tracks, Path) else tracks
    said = set(table["applies"].to_pylist() if "applies" in table.column_names else ()) - {None}
    # Where the models refuse every row there is nothing to smooth.
    if table.num_rows and said != {False}:
        table = smooth_tracks(table, causal=way == "live", systematic=systematic)
    write_tracks(table, out)


def _again(table: Path, out: Path, smooth: str | None, systematic: float, *, given: bool) -> None:
    """Make tracks again from kept detections; their estimates come along."""
    if given:
        raise InputError(
            "holds detections, not frames", where=table, remedy="leave --model and --detections out, or give the video"
        )
    if table.resolve() == out.resolve():
        raise InputError("is the table of detections itself", where="--out", remedy="name another file")
    from tapetum.track import retrack, write_tracks

    tracks = retrack(table)
    if smooth is None:
        write_tracks(tracks, out)
    else:
        _write_smooth(tracks, out, smooth, systematic)
    number = len(set(tracks["track"].to_pylist()))
    typer.echo(f"{out}: {number} track{'' if number == 1 else 's'} in {tracks.num_rows} rows, from kept detections")
