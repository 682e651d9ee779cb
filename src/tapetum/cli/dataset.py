"""`tapetum dataset`: build datasets from recordings, and look into them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from tapetum.cli.inputs import check_replaceable
from tapetum.progress import bar

app = typer.Typer(
    help="Build datasets from recordings, and look into them.", no_args_is_help=True, rich_markup_mode=None
)


@app.command("build", short_help="Cut crops out of labelled recordings.")
def build(
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Recordings, NAME.rec.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="SET", help="The dataset, NAME.zarr.")],
    side: Annotated[int, typer.Option(metavar="PX", help="Pixels along an edge of a crop.", min=8)] = 400,
    test_fraction: Annotated[
        float, typer.Option(metavar="SHARE", help="Of every video, at its end, that tests.", min=0, max=1)
    ] = 0.2,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a dataset of this name.")] = False,
) -> None:
    """Cut a centred square out of every labelled frame; the end of every video tests.

    Recordings that have no labels yet get them first, from the laser in the target's video.
    """
    check_replaceable(out, overwrite, "zarr.json", "tapetum-dataset")
    from tapetum.data import build_dataset, open_dataset
    from tapetum.record import label_recording, open_recording

    for path in recordings:
        recording = open_recording(path)
        if recording.labels() is None and {"probe", "target"} <= set(recording.streams):
            label_recording(recording, bar)
    build_dataset(recordings, out, side=side, test_fraction=test_fraction, progress=bar, overwrite=overwrite)
    dataset = open_dataset(out)
    typer.echo(f"{out}: {dataset.tp.train.sizes['frame']} to train on, {dataset.tp.test.sizes['frame']} to test")


@app.command("info", short_help="Counts, splits and label ranges.")
def info(
    path: Annotated[Path, typer.Argument(metavar="SET", help="A dataset, NAME.zarr.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print it as JSON.")] = False,
) -> None:
    """Print counts, splits and label ranges."""
    from tapetum.data import open_dataset

    dataset = open_dataset(path)
    told: dict[str, Any] = {
        "frames": dataset.sizes["frame"],
        "train": dataset.tp.train.sizes["frame"],
        "test": dataset.tp.test.sizes["frame"],
        "side": dataset.tp.side,
        "full_scale": dataset.tp.full_scale,
        "labels": {
            name: {
                "unit": dataset[name].attrs.get("units", ""),
                "least": float(dataset[name].min()),
                "mean": float(dataset[name].mean()),
                "most": float(dataset[name].max()),
            }
            for name in dataset.tp.targets
        },
        "recordings": dataset.tp.recordings,
    }
    if as_json:
        typer.echo(json.dumps(told, default=str))
        return
    split = f"{told['train']} to train on, {told['test']} to test"
    typer.echo(f"{path}: {told['frames']} crops of {told['side']} px: {split}")
    for name, label in told["labels"].items():
        span = f"{label['least']:.3f} to {label['most']:.3f}, mean {label['mean']:.3f}"
        typer.echo(f"  {name}: {span} ({label['unit']})")
    for one in told["recordings"]:
        left = ", ".join(f"{why} {count}" for why, count in one["left_out"].items() if count)
        tail = f" (left out: {left})" if left else ""
        typer.echo(f"  {one['name']}: {one['used']} of {one['frames']} frames{tail}")
