"""`tapetum dataset`: build datasets from recordings, and look into them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from tapetum.cli.dataset_import import import_data
from tapetum.cli.dataset_synth import synth
from tapetum.cli.inputs import check_replaceable
from tapetum.errors import InputError
from tapetum.progress import bar

app = typer.Typer(
    help="Build datasets from recordings, and look into them.", no_args_is_help=True, rich_markup_mode=None
)
_EXAMPLE = "Example: tapetum dataset "
app.command(
    "synth", short_help="Film the paper's three sets.", epilog=_EXAMPLE + "synth rotation --size small -o rotation.zarr"
)(synth)
app.command(
    "import",
    short_help="Make a dataset of data taken elsewhere.",
    epilog=_EXAMPLE + "import theirs --mapping map.yaml -o theirs.zarr",
)(import_data)


def check_drawable(sheet: Path | None) -> None:
    """Refuse early, before every crop is looked at, what cannot be drawn."""
    kinds = (".png", ".pdf", ".svg")
    if sheet is not None and sheet.suffix.lower() not in kinds:
        what = f"cannot draw a {sheet.suffix or 'nameless'} file"
        raise InputError(what, where=sheet, remedy=f"use one of {', '.join(kinds)}")


@app.command(
    "build", short_help="Cut crops out of labelled recordings.", epilog=_EXAMPLE + "build hand.rec -o hand.zarr"
)
def build(
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Recordings, NAME.rec.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="SET", help="The dataset, NAME.zarr.")],
    side: Annotated[int, typer.Option(metavar="PX", help="Pixels along an edge of a crop.", min=8, max=4000)] = 400,
    test_fraction: Annotated[
        float, typer.Option(metavar="SHARE", help="Of every video, at its end, that tests.", min=0, max=1)
    ] = 0.2,
    embargo: Annotated[
        float,
        typer.Option(
            metavar="S",
            help="Least seconds between training and test frames, for labels smoothed further than the recording says.",
            min=0,
        ),
    ] = 0.0,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a dataset of this name.")] = False,
) -> None:
    """Cut a centred square out of every labelled frame; the end of every video tests.

    Recordings that have no labels yet get them first, from the laser in the target's video. Frames whose labels share a
    measurement with a training frame's do not test: they lie in an embargo between the two parts.
    """
    check_replaceable(out, overwrite, "zarr.json", "tapetum-dataset")
    from tapetum.data import build_dataset, open_dataset
    from tapetum.record import label_recording, open_recording

    for path in recordings:
        recording = open_recording(path)
        if recording.labels() is None and {"probe", "target"} <= set(recording.streams):
            label_recording(recording, bar)
    how: dict[str, Any] = {"side": side, "test_fraction": test_fraction, "embargo": embargo}
    build_dataset(recordings, out, **how, progress=bar, overwrite=overwrite)
    dataset = open_dataset(out)
    typer.echo(f"{out}: {dataset.tp.train.sizes['frame']} to train on, {dataset.tp.test.sizes['frame']} to test")


@app.command(
    "info",
    short_help="What a dataset holds, and what is wrong with it.",
    epilog=_EXAMPLE + "info hand.zarr --sheet hand.png",
)
def info(
    path: Annotated[Path, typer.Argument(metavar="SET", help="A dataset, NAME.zarr.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
    sheet: Annotated[
        Path | None, typer.Option("--sheet", metavar="FILE", help="Draw a contact sheet: .png, .pdf or .svg.")
    ] = None,
) -> None:
    """Look at every crop: counts, labels, duplicates, saturated and empty frames, centring, leaks.

    A leak is a label that can be read from anything but the picture of the retro-reflection.
    """
    from tapetum.cli.dataset_info import as_told, lines
    from tapetum.data import open_dataset
    from tapetum.data.corners import CornerReader
    from tapetum.data.leaks import score_leaks
    from tapetum.data.quality import inspect_dataset

    check_drawable(sheet)
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
        from tapetum.cli.dataset_info import noticed
        from tapetum.report.figures import save_figure
        from tapetum.report.figures.contact_sheet import fig_contact_sheet

        save_figure(fig_contact_sheet(dataset, quality, name=path.name, notes=noticed(quality, leaks)), sheet)
        typer.echo(f"contact sheet: {sheet}", err=as_json)
