"""`tapetum dataset synth`: the paper's three sets, filmed on the virtual bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tapetum.cli.inputs import check_replaceable
from tapetum.errors import one_of
from tapetum.progress import bar

_INTERRUPTED = 130
_SIZES = "paper; laptop: 8 to 30 s of every video; small: 2 to 4 s, a smoke test with too few frames to learn from."


def synth(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="rotation, focusing or phones.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="SET", help="The dataset, NAME.zarr.")],
    size: Annotated[str, typer.Option(metavar="SIZE", help=_SIZES)] = "small",
    seed: Annotated[int, typer.Option(metavar="N", help="Of everything random.", min=0)] = 1,
    processes: Annotated[
        int | None, typer.Option("--processes", "--workers", metavar="N", help="Processes on this machine.", min=1)
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, tcp://HOST:8786 (extra: cluster).")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a dataset of this name.")] = False,
) -> None:
    """Film one of the paper's three sets on the virtual bench, on one core, several or many machines.

    What is done is kept in SET.part: after an interruption, the same command carries on.
    """
    check_replaceable(out, overwrite, "zarr.json", "tapetum-dataset")
    from tapetum.data import open_dataset
    from tapetum.data.synth import KINDS, SIZES, make_plan, synthesise

    plan = make_plan(one_of(kind, KINDS, "KIND"), one_of(size, SIZES, "--size"), seed)
    try:
        synthesise(plan, out, processes=processes, cluster=cluster, progress=bar, overwrite=overwrite)
        interrupted = False
    except KeyboardInterrupt:
        interrupted = True
    if interrupted:
        # Only now, when the error and the frames it held are gone, is the bar off the screen.
        typer.echo("interrupted: what is done is kept, and the same command carries on", err=True)
        raise SystemExit(_INTERRUPTED)
    dataset = open_dataset(out)
    split = f"{dataset.tp.train.sizes['frame']} to train on, {dataset.tp.test.sizes['frame']} to test"
    typer.echo(f"{out}: {len(plan.videos)} videos, seed {seed}: {split}")
