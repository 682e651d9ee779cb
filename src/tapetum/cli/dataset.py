"""`tapetum dataset build`, `info` and `synth`: datasets from recordings, and what they hold."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from tapetum.cli.options import AsJson, Cluster, Force, Processes, Seed, SetOut, SetPath, film_count, option
from tapetum.cli.outputs import check_output, says_what_is_kept
from tapetum.defaults import SEED
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

__all__ = ["build", "info", "say_split", "synth"]

_DRAWABLE = (".png", ".pdf", ".svg")
_SIZES = "paper; laptop: 8 to 30 s of every video; small: 2 to 4 s, a smoke test with too few frames to learn from."


def say_split(out: Path, before: str = "") -> None:
    """Print the numbers of training and test frames of a new dataset."""
    from tapetum.data import open_dataset

    dataset = open_dataset(out)
    train, test = dataset.tp.train.sizes["frame"], dataset.tp.test.sizes["frame"]
    typer.echo(f"{out}: {before}{train} to train on, {test} to test")


def build(
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Recordings, NAME.rec.")],
    out: SetOut,
    side: Annotated[int, option("PX", "Pixels along an edge of a crop.", min=8, max=4000)] = 400,
    test_fraction: Annotated[
        float, option("SHARE", "Share of every video, at its end, for the test part.", min=0, max=1)
    ] = 0.2,
    embargo: Annotated[
        float,
        option(
            "S",
            "Least seconds between training and test frames, for labels smoothed further than the recording says.",
            min=0,
        ),
    ] = 0.0,
    force: Force = False,
) -> None:
    """Cut a centred square out of every labelled frame; the end of every video is the test part.

    Recordings without labels are labelled first, by the laser in the target's video. Frames whose labels share a
    measurement with a training frame's are not in the test part: they are left out, as an embargo between the two
    parts.
    """
    check_output(out, force, "tapetum-dataset")
    from tapetum.data import build_dataset
    from tapetum.record import label_recording, open_recording

    for path in recordings:
        recording = open_recording(path)
        if recording.labels() is None and {"probe", "target"} <= set(recording.streams):
            label_recording(recording, bar)
    how: dict[str, Any] = {"side": side, "test_fraction": test_fraction, "embargo": embargo}
    build_dataset(recordings, out, **how, progress=bar, overwrite=force)
    say_split(out)


def info(
    path: SetPath,
    as_json: AsJson = False,
    sheet: Annotated[Path | None, option("FILE", "Draw a contact sheet: .png, .pdf or .svg.", "--sheet")] = None,
    force: Force = False,
) -> None:
    """Look at every crop: counts, labels, duplicates, saturated and empty frames, centring, leaks.

    A leak is a label that can be read from anything but the picture of the retro-reflection.
    """
    if sheet is not None and sheet.suffix.lower() not in _DRAWABLE:
        what = f"cannot draw a {sheet.suffix or 'nameless'} file"
        raise InputError(what, where=sheet, remedy=f"use one of {', '.join(_DRAWABLE)}")
    check_output(sheet, force)
    from tapetum.cli.dataset_info import as_told, lines, noticed
    from tapetum.data import open_dataset
    from tapetum.data.corners import CornerReader
    from tapetum.data.leaks import score_leaks
    from tapetum.data.quality import inspect_dataset

    dataset = open_dataset(path)
    corners = CornerReader(dataset)
    quality = inspect_dataset(dataset, also=[corners.add], progress=bar)
    leaks = score_leaks(dataset, corners.read(), progress=bar)
    if as_json:
        typer.echo(json.dumps(as_told(dataset, quality, leaks)))
    else:
        for line in lines(str(path), dataset, quality, leaks):
            typer.echo(line)
    if sheet is not None:
        from tapetum.report.figures import save_figure
        from tapetum.report.figures.contact_sheet import fig_contact_sheet

        save_figure(fig_contact_sheet(dataset, quality, name=path.name, notes=noticed(quality, leaks)), sheet)
        typer.echo(f"contact sheet: {sheet}", err=as_json)


def synth(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="rotation, focusing or phones.")],
    out: SetOut,
    size: Annotated[str, option("SIZE", _SIZES)] = "small",
    seed: Seed = SEED,
    units: Annotated[
        int | None, option("N", "Copies of every camera, drawn from tolerances; each films all its videos.", min=1)
    ] = None,
    tolerances: Annotated[
        str | None, option("FILE", "With --units: thin, traced, phone or a YAML file; by default the camera's kind.")
    ] = None,
    target_rate: Annotated[
        float | None, option("HZ", "Frames a second of the target's camera, which labels (15).", min=1, max=1000)
    ] = None,
    scene: Annotated[
        str | None, option("SCENE", "Film this scene in place of the set's own, such as a twin's YAML file.", "--scene")
    ] = None,
    processes: Processes = None,
    cluster: Cluster = None,
    force: Force = False,
) -> None:
    """Film one of the paper's three sets on the virtual bench, on one core, several or many machines.

    What is done is kept in SET.part: after an interruption, the same command carries on.
    """
    check_output(out, force, "tapetum-dataset")
    if tolerances is not None and units is None:
        raise InputError("has no meaning without --units", where="--tolerances", remedy="say how many copies")
    from tapetum.bench import load_scene
    from tapetum.data.synth import KINDS, SIZES, Units, make_plan, synthesise

    copies = None if units is None else Units(units, tolerances)
    shown = None if scene is None else load_scene(scene)
    plan = make_plan(one_of(kind, KINDS, "KIND"), one_of(size, SIZES, "--size"), seed, copies, shown)
    plan = plan if target_rate is None else plan.with_target_rate(target_rate)
    with says_what_is_kept():
        synthesise(plan, out, processes=film_count(processes), cluster=cluster, progress=bar, overwrite=force)
    told = f"{len(plan.units)} units, " if plan.units else ""
    say_split(out, f"{told}{len(plan.videos)} videos, seed {seed}: ")
