"""`tapetum calibrate`: the probe's sensor, the ghost of its beam splitter, and the clocks of its cameras."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Annotated, Any

import typer

from tapetum.bench.quantity import to_si
from tapetum.cli.options import AsJson, Force, option
from tapetum.cli.outputs import check_output
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

_DARKS = ("dark", "bias", "black")

PageOut = Annotated[Path | None, option("FILE", "The page to write; by default NAME.html beside the result.", "--page")]


def probe(
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="DARK FLAT...", help="Dark frames, then flat ones: folders, videos, .npy stacks or recordings."
        ),
    ],
    out: Annotated[Path, option("FILE", "The sensor to write, NAME.yaml.", "-o", "--out")],
    page: PageOut = None,
    more_darks: Annotated[list[str] | None, option("DARK", "Further dark frames; repeatable.", "--dark")] = None,
    pitch: Annotated[
        str | None, option("LENGTH", "Pitch of the pixels, '3.45 um', which no frame shows; scenes need it.")
    ] = None,
    bits: Annotated[
        int | None, option("N", "Bit depth of the frames; by default the least that holds all numbers.", min=1, max=16)
    ] = None,
    exposures: Annotated[
        str | None,
        option("TIMES", "Exposure time of each flat level, '1 ms,2 ms,…', where neither frames nor names state it."),
    ] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Measure the probe's sensor: gain, read noise, full well, linearity, fixed pattern, by photon transfer.

    The first source has the dark frames, and so has every other whose name begins with dark, bias or black. The others
    have flat ones: even light on the bare sensor, two frames or more at each of five or more brightnesses, one of which
    saturates. Writes a sensor for scenes (probe.sensor: NAME.yaml) and a page; the exit code is 1 where a check fails.
    """
    _named(out, ".yaml", ".yml")
    page = page or out.with_suffix(".html")
    for path in (out, page):
        check_output(path, force)
    if pitch is not None:
        _positive(pitch, "m", "--pitch")
    times = None if exposures is None else [_positive(one, "s", "--exposures") for one in exposures.split(",")]
    darks = [sources[0], *(one for one in sources[1:] if one.name.lower().startswith(_DARKS))]
    flats = [one for one in sources if one not in darks]
    if not flats:
        raise InputError("no flat frames are named", where="FLAT", remedy="name them after the dark ones")
    from tapetum.calibrate import calibrate_sensor

    found = calibrate_sensor([*darks, *(more_darks or ())], flats, bits=bits, exposures=times, progress=bar)
    found.save(out, pitch)
    found.write_page(page)
    _tell(found, out, page, as_json, found.as_dict())


def ghost(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="Frames of one bright, moving RR: a recording, video or folder.")
    ],
    out: Annotated[Path, option("FILE", "The ghost to write, NAME.yaml.", "-o", "--out")],
    page: PageOut = None,
    focal_length: Annotated[
        str | None, option("LENGTH", "Of the probe's lens; with --pitch, for the second beam of scenes.")
    ] = None,
    pitch: Annotated[str | None, option("LENGTH", "Pitch of the probe's pixels.")] = None,
    detector: Annotated[str, option("NAME", "What finds the spots: spots or cameras.")] = "spots",
    stream: Annotated[str, option("NAME", "Which stream of a recording.")] = "probe",
    seconds: Annotated[float | None, option("S", "Stop after so many seconds; else at the end.", min=0.1)] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Measure the ghost of the beam splitter: the offset of every RR's dim companion, and how bright it is.

    Film one camera that moves, alone in view and not saturated. Writes a file for `track --ghost` and a page; with
    --focal-length and --pitch it is also a scene's second beam (illumination.second_beam: NAME.yaml). The exit code is
    1 where a check fails.
    """
    _named(out, ".yaml", ".yml")
    page = page or out.with_suffix(".html")
    for path in (out, page):
        check_output(path, force)
    if (focal_length is None) != (pitch is None):
        where = "--pitch" if pitch is None else "--focal-length"
        raise InputError("is missing", where=where, remedy="an angle takes both --focal-length and --pitch")
    lengths = [
        None if text is None else _positive(text, "m", where)
        for text, where in ((focal_length, "--focal-length"), (pitch, "--pitch"))
    ]
    from tapetum.track.detector import DETECTORS

    one_of(detector, tuple(DETECTORS), "--detector")
    from tapetum.calibrate import calibrate_second_beam
    from tapetum.record.frames import open_frames
    from tapetum.record.reader import taken

    opened = open_frames(source, stream)
    frames = bar(taken(opened, threading.Event(), seconds), "looking for the ghost", total=opened.count)
    found = calibrate_second_beam(frames, detector=detector, focal_length=lengths[0], pitch=lengths[1])
    found.save(out)
    found.write_page(page)
    _tell(found, out, page, as_json, found.as_dict())


def sync(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="A recording of probe and target, NAME.rec.")],
    out: Annotated[Path, option("FILE", "The result to write, NAME.yaml.", "-o", "--out")],
    page: PageOut = None,
    blink: Annotated[
        int | None, option("N", "Number of the code that the laser blinked; else what the recording says.", min=0)
    ] = None,
    bit: Annotated[str | None, option("TIME", "Duration of a bit of that code (200 ms).")] = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Measure lag and drift between the two cameras of a recording by the laser's blink code.

    Blink the code once or several times (`record --blink`) while both cameras see the laser. Drift needs two words, its
    residual three. The exit code is 1 where a check fails.
    """
    _named(out, ".yaml", ".yml")
    page = page or out.with_suffix(".html")
    for path in (out, page):
        check_output(path, force)
    if bit is not None and blink is None:
        raise InputError("is that of a code", where="--bit", remedy="give its number too: --blink N")
    from tapetum.calibrate import calibrate_sync
    from tapetum.record import BlinkCode, open_recording

    code = None if blink is None else BlinkCode(_positive(bit or "200 ms", "s", "--bit"), seed=blink)
    found = calibrate_sync(open_recording(recording), code, bar)
    found.save(out)
    found.write_page(page)
    _tell(found, out, page, as_json, found.as_dict())


def _positive(text: str, unit: str, where: str) -> float:
    value = _quantity(text, unit, where)
    if not value > 0:
        raise InputError(f"must be positive, is {text}", where=where, remedy="give a positive quantity")
    return value


def _tell(found: Any, out: Path, page: Path, as_json: bool, values: dict[str, Any]) -> None:
    """Print numbers and verdict; end with exit code 1 where a check fails."""
    from tapetum.calibrate.verdict import to_mend

    failed = to_mend(found.checks())
    if as_json:
        told = {**values, "verdict": found.verdict, "to_mend": [one.line for one in failed]}
        typer.echo(json.dumps({**told, "out": str(out), "page": str(page)}, allow_nan=False))
    else:
        for name, value in found.numbers():
            typer.echo(f"  {name:<36} {value}")
        typer.echo(f"{out}, {page}: {'good' if not failed else 'to correct'}")
        for one in failed:
            typer.echo(f"  {one.line}")
    if failed:
        raise typer.Exit(1)


def _named(out: Path, *suffixes: str) -> None:
    if out.suffix.lower() not in suffixes:
        raise InputError("is no name for this", where=out, remedy=f"name it NAME{suffixes[0]}")


def _quantity(text: str, unit: str, where: str) -> float:
    try:
        return to_si(text.strip(), unit)
    except ValueError as error:
        what, _, remedy = str(error).partition("; ")
        raise InputError(what, where=where, remedy=remedy or None) from error
