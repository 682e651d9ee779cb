"""`tapetum track`: detect and track the retro-reflections of a video, a folder of images or a recording."""

from __future__ import annotations

import json
import threading
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tapetum.cli.models import find_model, warn_of_intervals
from tapetum.cli.options import (
    SYSTEMATIC,
    AsJson,
    Device,
    Force,
    Models,
    Smooth,
    Systematic,
    TracksOut,
    WhoseIntervals,
    check_smoothing,
    option,
)
from tapetum.cli.outputs import check_output, says_what_is_kept
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

if TYPE_CHECKING:
    import pyarrow as pa

_PROBE, _AUTO = "probe", "auto"


def track(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="A camera:0, rtsp://…, video, folder of images, image, recording, bench:SCENE, or a table of "
            "--detections.",
        ),
    ],
    out: TracksOut,
    models: Models = None,
    detections: Annotated[
        Path | None, option("FILE", "Keep what was detected here too, to track again without the video.")
    ] = None,
    detector: Annotated[
        str, option("NAME", "What finds them: spots, in the beam of a dark bench, or cameras, in a room.")
    ] = "spots",
    false_alarms: Annotated[
        float | None,
        option("RATE", "Of cameras: expected false alarms a frame (0.01).", "--false-alarms-per-frame", min=1e-6),
    ] = None,
    min_snr: Annotated[
        float | None, option("RATIO", "Least signal-to-noise ratio of a detection: of spots 7, of cameras 1.", min=1.0)
    ] = None,
    largest: Annotated[
        float | None,
        option("PX", "Largest diameter, of spots 400, of cameras 60: wider ones are walls and lamps.", min=1.0),
    ] = None,
    ghost: Annotated[
        Path | None,
        option(
            "FILE",
            "A calibrated ghost (calibrate ghost), or the probe's scene: only what stands at its place is dropped.",
        ),
    ] = None,
    calibrate: Annotated[
        bool,
        typer.Option("--calibrate-ghost", help="Find the beam splitter's ghost of one moving camera: -o NAME.json."),
    ] = False,
    activity: Annotated[
        bool,
        typer.Option(
            "--activity", help="Say whether a phone's camera images; its filter must overfill the probe's lens."
        ),
    ] = False,
    smooth: Smooth = None,
    systematic: Systematic = SYSTEMATIC,
    stream: Annotated[str, option("NAME", "Which stream of a recording.")] = _PROBE,
    seconds: Annotated[
        float | None, option("S", "Stop after so many seconds; else at the end, of a camera by Ctrl-C.", min=0.01)
    ] = None,
    unit: WhoseIntervals = None,
    device: Device = _AUTO,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Track every retro-reflection, and estimate its camera's gaze with models.

    --detector cameras compares lit frames with dark ones where the source knows which is which.
    """
    if false_alarms is not None and detector != "cameras":
        raise InputError("is of the detector of cameras", where="--false-alarms-per-frame", remedy="--detector cameras")
    if detections is not None and detections.resolve() == out.resolve():
        raise InputError("is the file of the tracks too", where="--detections", remedy="name another file")
    check_smoothing(smooth, systematic)
    for path in (out, detections):
        check_output(path, force, sources=[source])
    from tapetum.track.detector import DETECTORS

    one_of(detector, tuple(DETECTORS), "--detector")
    options = _given(min_snr=min_snr, largest=largest, false_alarms=false_alarms)
    if calibrate:
        for flag, value in (("--model", models), ("--activity", activity), ("--smooth", smooth), ("--ghost", ghost)):
            if value:
                raise InputError("is not used while a ghost is sought", where=flag, remedy="leave it out")
        _calibrate(source, out, detector, options, stream, seconds, as_json)
        return
    from tapetum.files import free_name
    from tapetum.track import track_to_file, write_tracks
    from tapetum.track.formats import FORMATS
    from tapetum.track.pipeline import make_detector
    from tapetum.track.tables import checked_suffix

    table = Path(source)
    if table.suffix.lower() in FORMATS and table.is_file():
        _refuse_of_frames(
            table,
            {
                "--model": models,
                "--detections": detections,
                "--false-alarms-per-frame": false_alarms,
                "--min-snr": min_snr,
                "--largest": largest,
                "--ghost": ghost,
                "--activity": activity or None,
                "--stream": None if stream == _PROBE else stream,
                "--seconds": seconds,
                "--unit": unit,
                "--device": None if device == _AUTO else device,
            },
        )
        _again(table, out, detector, smooth, systematic, as_json)
        return
    if smooth is not None and not models:
        raise InputError("without a model there is nothing to smooth", where="--smooth", remedy="give --model")
    if unit is not None and not models:
        raise InputError("says whose intervals a model gives", where="--unit", remedy="give --model")
    checked_suffix(out)
    # What is smoothed takes its name only when it is; until then, and if it cannot be, the tracks are kept beside.
    raw = out if smooth is None else free_name(out, "unsmoothed")
    if ghost is not None:
        from tapetum.bench import load_scene
        from tapetum.track.ghosts import Ghost, is_ghost

        options["known_ghost"] = Ghost.load(ghost) if is_ghost(ghost) else Ghost.of(load_scene(str(ghost)))
    # Ghosts that are kept aside are marked.
    options["ghosts"] = "drop" if detections is None else "mark"
    find = make_detector(detector, options)
    with says_what_is_kept():
        summary = track_to_file(
            source,
            raw,
            model=[find_model(name, device, unit) for name in models or ()],
            detections=detections,
            detector=find,
            stream=stream,
            activity=activity,
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
    warn_of_intervals(models or (), summary.unsure)
    for reason, count in getattr(find, "notes", {}).items():
        frames = f"{count} lit frame{'' if count == 1 else 's'}"
        typer.echo(f"note: {frames} searched alone, which finds less: {reason}", err=True)
    if as_json:
        typer.echo(json.dumps({**asdict(summary), "out": str(out)}))
        return
    counts = (("track", summary.tracks), ("frame", summary.frames), ("sighting", summary.seen), ("frame", summary.lost))
    tracks, frames, seen, missed = (f"{count} {word}{'' if count == 1 else 's'}" for word, count in counts)
    lost = f", {missed} lost" if summary.lost else ""
    typer.echo(f"{out}: {tracks} in {frames}, {seen}{lost}")


def _given(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


def _calibrate(
    source: str, out: Path, detector: str, options: dict[str, Any], stream: str, seconds: float | None, as_json: bool
) -> None:
    """Find the ghost in a source's frames and write it."""
    if out.suffix.lower() != ".json":
        raise InputError("cannot hold a ghost", where=out, remedy="name it NAME.json")
    from tapetum.record.frames import open_frames
    from tapetum.record.reader import taken
    from tapetum.track.ghosts import APART, ghost_apart, ghost_of, ghost_pairs
    from tapetum.track.pipeline import make_detector

    # The rule of the bench would drop whatever is dim near a brighter one, marked or not.
    free = {"ghost_ratio": 0.0, "stray": 0.0} if detector == "spots" else {}
    find = make_detector(detector, {**options, **free, "ghosts": "mark"})
    frames = taken(open_frames(source, stream), threading.Event(), seconds)
    pairs = ghost_pairs(find(frame) for frame in frames)
    found = ghost_of(pairs)
    found.save(out)
    if (apart := ghost_apart(pairs)) < APART:
        told = f"the ghost stands {apart:.2f} diameters of its spot away, and is cut by it where that is under {APART}"
        typer.echo(f"note: {told}; make the spots smaller by the target's focus", err=True)
    if as_json:
        typer.echo(json.dumps({**asdict(found), "out": str(out)}))
        return
    typer.echo(
        f"{out}: the ghost stands {found.dx:+.1f}, {found.dy:+.1f} px away, {found.ratio:.3f} as high; "
        f"within {found.reach:.1f} px it is dropped by --ghost"
    )


def _smoothed(table: pa.Table, way: str | None, systematic: float) -> pa.Table:
    """Smooth a table of tracks; one without rows, or whose models refuse every row, stays as it is."""
    from tapetum.track.smooth import smooth_tracks

    applies = set(table["applies"].to_pylist() if "applies" in table.column_names else ()) - {None}
    if way is None or not table.num_rows or applies == {False}:
        return table
    return smooth_tracks(table, causal=way == "live", systematic=systematic)


def _refuse_of_frames(table: Path, given: dict[str, Any]) -> None:
    """Refuse what applies to frames where the source holds detections."""
    flags = [flag for flag, value in given.items() if value]
    if flags:
        raise InputError(
            f"holds detections, not frames: {', '.join(flags)} can change nothing of them",
            where=table,
            remedy=f"leave {'them' if len(flags) > 1 else 'it'} out, or give the video",
        )


def _again(source: Path, out: Path, detector: str, smooth: str | None, systematic: float, as_json: bool) -> None:
    """Track stored detections again, with their estimates."""
    from tapetum.track import retrack, write_tracks
    from tapetum.track.pipeline import make_detector, usual_tracker

    try:
        found = retrack(source, tracker=usual_tracker(make_detector(detector)))
    except InputError as error:
        # Errors of single values name a column.
        if error.where == source:
            raise
        where = f"{source}, {error.where}" if error.where else source
        raise InputError(error.what, where=where, remedy=error.remedy) from error
    tracks = _smoothed(found, smooth, systematic)
    write_tracks(tracks, out)
    number = len(set(tracks["track"].to_pylist()))
    if as_json:
        typer.echo(json.dumps({"tracks": number, "rows": tracks.num_rows, "out": str(out)}))
        return
    typer.echo(f"{out}: {number} track{'' if number == 1 else 's'} in {tracks.num_rows} rows, from kept detections")
