"""`tapetum dataset import`: a dataset from videos, images or arrays that were taken elsewhere."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.cli.dataset import say_split
from tapetum.cli.dataset_info import left_out
from tapetum.cli.options import Force, SetOut, option
from tapetum.cli.outputs import check_output
from tapetum.errors import InputError
from tapetum.files import atomic_file
from tapetum.progress import bar

if TYPE_CHECKING:
    from tapetum.data.importing import ImportMapping


def import_data(
    sources: Annotated[
        list[Path],
        typer.Argument(metavar="FOLDER_OR_FILES...", help="Where videos, images, arrays and tables are."),
    ],
    out: SetOut,
    mapping: Annotated[Path | None, option("YAML", "What the files mean; without it, a mapping is proposed.")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Import by the proposed mapping without asking.")] = False,
    side: Annotated[
        int | None, option("PX", "Pixels along an edge of a crop, in place of the mapping's.", min=8)
    ] = None,
    force: Force = False,
) -> None:
    """Make a dataset of data that was not taken with Tapetum.

    Without --mapping it lists what it finds, proposes a mapping, and asks. What it prints is a mapping file: save it,
    correct it, and pass it with --mapping.
    """
    check_output(out, force, "tapetum-dataset")
    from tapetum.data import open_dataset
    from tapetum.data.importing import common_root, import_dataset, load_mapping

    root = common_root(sources)
    chosen = load_mapping(mapping) if mapping is not None else _proposed(sources, out, yes)
    if chosen is None:
        return
    if side is not None:
        chosen = replace(chosen, side=side)
    for line in import_dataset(chosen, root, out, progress=bar, overwrite=force):
        typer.echo(line)
    say_split(out)
    for one in open_dataset(out).tp.recordings:
        if left := left_out(one):
            typer.echo(f"  {one['name']}: {one['used']} of {one['frames']} pictures{left}")


def _proposed(sources: list[Path], out: Path, yes: bool) -> ImportMapping | None:
    """Print what was found and propose a mapping; None if the user declines it."""
    from tapetum.data.importing import look_into, propose

    found = look_into(sources)
    typer.echo(f"# found in {found.root}:")
    for line in found.lines:
        typer.echo(f"#   {line}")
    if found.faults:
        raise found.faults[0]
    proposal = propose(found)
    typer.echo(proposal.text)
    if yes:
        return proposal.mapping(str(found.root))
    if not proposal.gaps and _at_terminal():
        if typer.confirm("Import it like this?"):
            return proposal.mapping(str(found.root))
        kept = out.with_suffix(".yaml")
        if not kept.exists():
            with atomic_file(kept) as part:
                part.write_text(proposal.text, encoding="utf-8")
            typer.echo(f"nothing imported; correct {kept} and pass it with --mapping")
        return None
    what = f"the proposal is incomplete: {proposal.gaps[0]}" if proposal.gaps else "nothing is imported without a yes"
    remedy = "save what was printed as map.yaml, correct it and pass --mapping map.yaml"
    raise InputError(what, where=found.root, remedy=remedy if proposal.gaps else f"pass --yes, or {remedy}")


def _at_terminal() -> bool:
    return sys.stdin.isatty() and sys.stdout.isatty()
