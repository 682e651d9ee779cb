"""`tapetum paper`: reproduce the paper's figures and tables, with its own numbers and the differences."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.cli.models import find_model
from tapetum.cli.options import AsJson, Cluster, Device, Force, Models, Processes, film_count, option
from tapetum.cli.outputs import filling
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

if TYPE_CHECKING:
    from tapetum.experiments import Workshop
    from tapetum.models import Predictor

# Repeated for the help, which must not import torch; a test compares them with the experiments'.
FIGURES = ("fig4", "fig5", "fig6", "fig7", "fig8", "fig9", "fig10", "fig11", "fig12", "table1", "table2")
FIGURES += ("ablations", "development", "unseen", "fit")
SEALED = "sealed"
GROUPS = ("printed", "learned", "beyond", "all")


class Figure(str):
    """A figure's, table's or group's name: the help shows this class in the place of `str`."""


SIZES = ("laptop", "small", "paper")


def paper(
    out: Annotated[Path, option("DIR", "Folder for the figures.", "-o", "--out")],
    figures: Annotated[
        list[Figure],
        typer.Argument(
            parser=Figure,
            default_factory=lambda: ["printed"],
            show_default=False,
            metavar="FIGURE",
            help=f"Of {', '.join((*FIGURES, *GROUPS))}, or {SEALED}; see above. By default printed.",
        ),
    ],
    size: Annotated[
        str,
        option(
            "SIZE", "laptop; paper: sets as long as the paper's; small: a smoke test, whose networks learn nothing."
        ),
    ] = "laptop",
    work: Annotated[Path | None, option("DIR", "Where sets and models are kept; OUT/work by default.")] = None,
    processes: Processes = None,
    cluster: Cluster = None,
    device: Device = "auto",
    model: Models = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Simulate the paper's figures and tables, measure, and say beside them what it reports and what differs.

    fig4: a thin lens, turned and refocused (section 4.1). fig5: head-on from 0.5 to 5 m (section 4.2). fig6: a mirror
    and cardboard (section 4.3). fig7 and fig8: samples of the three sets (sections 4.4 and 4.5), minutes each.

    fig9 to fig12, table1 and table2 (section 5), and beyond the paper ablations, development (recordings at other
    distances, which were looked at while the method was made), unseen (phones it never saw) and fit (by simulation,
    without training): the three sets are filmed and the models trained. What is whole is kept in the folder of --work
    and not made again; after an interruption the same command goes on.

    printed: all of the paper's own, fig4 to table2. learned: those of section 5. beyond: what the paper lacks.

    --size laptop makes those of section 5 in about an hour on two cores; paper takes hours there; small
    takes minutes and is a smoke test: it shows that every step runs, and nothing about the method.

    sealed: films recordings that nobody looks at, scores the Rotation set's models on them, or those of --model,
    deletes them, and adds the numbers to sealed.jsonl and sealed.md. Nothing may be chosen by them.

    Each other becomes NAME.png (not the tables), NAME.md and NAME.json. The networks' and the sets' seeds are fixed.
    """
    # The deprecated name, accepted for one release.
    wanted = ["development" if figure == "fresh" else figure for figure in figures]
    for figure in wanted:
        one_of(figure, (*FIGURES, *GROUPS, SEALED), "FIGURE")
    if SEALED in wanted and wanted != [SEALED]:
        raise InputError("is a command of its own", where=SEALED, remedy="name nothing beside it")
    if model and wanted != [SEALED]:
        raise InputError("has a meaning for sealed alone", where="--model", remedy="leave it out")
    one_of(size, SIZES, "--size")
    # Torch and Matplotlib take seconds to import.
    from tapetum.experiments import GROUPS as MEMBERS
    from tapetum.experiments import SMOKE_TEST, Workshop, is_smoke_test, reproduce

    kept, workers = work or out / "work", film_count(processes if processes or cluster else "auto")
    if is_smoke_test(size):
        typer.echo(f"--size {size} is {SMOKE_TEST}", err=True)
    shop = Workshop(kept, size, workers, cluster=cluster, device=device, progress=bar)
    if wanted == [SEALED]:
        _sealed(out, shop, {name: find_model(name, device) for name in model or ()}, as_json)
        return
    names = [one for figure in wanted for one in MEMBERS.get(figure, (figure,))]
    files = dict.fromkeys(f"{name}.{kind}" for name in names for kind in ("png", "md", "json"))
    with filling(out, files, force, work=kept):
        made = reproduce(wanted, out, size=size, work=shop, progress=bar)
    if as_json:
        done = [{"name": one.name, "files": [str(file) for file in one.files], **one.numbers} for one in made]
        typer.echo(json.dumps({"out": str(out), "figures": done}, allow_nan=False))
    else:
        for one in made:
            typer.echo(f"{one.name}: " + ", ".join(str(file) for file in one.files))
    if is_smoke_test(size):
        typer.echo(f"made at size {size}, {SMOKE_TEST}; the default size, laptop, trains networks that learn", err=True)


def _sealed(out: Path, work: Workshop, models: dict[str, Predictor], as_json: bool) -> None:
    from tapetum.experiments.sealed import run_sealed

    # Results are published, so they must not contain local paths of models.
    short = {Path(name).name: model for name, model in models.items()}
    rows = run_sealed(out, work, (short if len(short) == len(models) else models) or None)
    if as_json:
        typer.echo(json.dumps({"out": str(out), "sealed": rows}, allow_nan=False))
        return
    for row in rows:
        errors = f"MAE {row['mae'][0]:.4f}, {row['mae'][1]:.4f}, distance {row['radial']:.4f}"
        typer.echo(f"{row['model']}: {errors}: {row['verdict'] or 'no mean to compare with'}")
    typer.echo(f"sealed: {out / 'sealed.md'}, {out / 'sealed.jsonl'}")
