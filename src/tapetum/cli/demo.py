"""`tapetum demo`: from film to trained model and tracks, on the virtual bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tapetum.cli.options import Device, Force, Seed
from tapetum.cli.outputs import filling
from tapetum.defaults import SEED
from tapetum.progress import bar

_FILES = {
    "report.html": None,
    "tracks.parquet": None,
    "demo.rec": "tapetum-recording",
    "demo.zarr": "tapetum-dataset",
    "zernike": "tapetum-model",
}


def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for everything it makes.")] = Path("demo-out"),
    seconds: Annotated[float, typer.Option(help="Length of the recording.", min=8.0)] = 60.0,
    seed: Seed = SEED,
    train: Annotated[
        bool, typer.Option("--train", help="Train the ResNet-18 here; about half an hour on 2 cores.")
    ] = False,
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Film a target, label it, train, track a held-out part, and write report.html.

    After an interruption the same command goes on. With --overwrite everything is made again, except a recording of the
    same seed and length.
    """
    # Torch, scikit-learn and Matplotlib take seconds to import; print a line first.
    typer.echo(
        "Tapetum films a hand-held camera on the virtual bench and reads its gaze from the light it throws back."
    )
    from tapetum.experiments.demo import run_demo

    with filling(out, _FILES, force):
        outcome = run_demo(
            out,
            seconds=seconds,
            seed=seed,
            train=train,
            device=device,
            progress=bar,
            say=lambda text: typer.echo(f"* {text}"),
        )
    scores = outcome.scores
    typer.echo(
        f"\nDone in {outcome.seconds:.0f} s. Gaze on frames neither model was fitted to, fractions of the field:"
    )
    for name, one in (*scores.models, ("predicting the mean", scores.baseline)):
        typer.echo(
            f"  {name:<20} MAE x {one.mae[0]:.3f}  y {one.mae[1]:.3f}   RMSE x {one.rmse[0]:.3f}  y {one.rmse[1]:.3f}"
        )
    typer.echo(f"\nOpen  {outcome.report}\nThen  tapetum simulate thin-lens --sweep rotation=0,0.5,1 -o rr.png")
    typer.echo(
        f"      tapetum demo --train --overwrite -o {out}" if not train else "      tapetum demo --seed 7 -o demo-7"
    )
