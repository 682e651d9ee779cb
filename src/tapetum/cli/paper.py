"""`tapetum paper`: the paper's figures and tables made anew, with what it reports and what differs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from tapetum.errors import one_of
from tapetum.progress import bar

# Known without torch, for the help: a test holds them to those of the report.
FIGURES = ("fig4", "fig5", "fig6", "fig7", "fig8", "fig9", "fig10", "fig11", "fig12", "table1", "table2")
FIGURES += ("ablations", "fresh", "unseen", "fit")
SIZES = ("small", "paper")


def paper(
    out: Annotated[Path, typer.Option("-o", "--out", metavar="DIR", help="Folder for the figures.")],
    figure: Annotated[
        str, typer.Argument(metavar="[FIGURE]", help=f"One of {', '.join(FIGURES)}, or all of them.")
    ] = "all",
    size: Annotated[
        str,
        typer.Option(
            metavar="SIZE", help="paper, or small: fewer images in fig7 and fig8, small sets behind the rest."
        ),
    ] = "paper",
    work: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where sets and models are kept; OUT/work where left out.")
    ] = None,
    workers: Annotated[
        int | None, typer.Option(metavar="N", help="Processes that film the sets (extra cluster).", min=1)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print what was done, and the numbers, as JSON.")] = False,
) -> None:
    """Simulate the paper's figures and tables, measure, and say beside them what it reports and what differs.

    fig4: a thin lens, turned and refocused (section 4.1). fig5: head-on from 0.5 to 5 m (section 4.2). fig6: a mirror
    and cardboard (section 4.3). fig7 and fig8: samples of the three sets (sections 4.4 and 4.5), minutes each.

    fig9 to fig12, table1 and table2 (section 5), and beyond the paper ablations, fresh (recordings at other distances),
    unseen (phones it never saw) and fit (by simulation, without training): the three sets are filmed and the models
    trained, hours at paper size on two cores. What is whole is kept in the folder of --work and not made again; after
    an interruption the same command goes on.

    Each becomes NAME.png (not the tables), NAME.md and NAME.json; files of these names are replaced.
    """
    one_of(figure, (*FIGURES, "all"), "FIGURE")
    one_of(size, SIZES, "--size")
    # Torch and Matplotlib take seconds to import.
    from tapetum.report.paper import Workshop, reproduce

    shop = Workshop(out / "work" if work is None else work, size, workers, progress=bar)
    made = reproduce(FIGURES if figure == "all" else (figure,), out, size=size, work=shop, progress=bar)
    if as_json:
        figures = [{"name": one.name, "files": [str(file) for file in one.files], **one.numbers} for one in made]
        typer.echo(json.dumps({"out": str(out), "figures": figures}, allow_nan=False))
    else:
        for one in made:
            typer.echo(f"{one.name}: " + ", ".join(str(file) for file in one.files))
