"""`tapetum twin`: the scene that explains a labelled recording of a real camera."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from tapetum.cli.calibrate import PageOut
from tapetum.cli.options import AsJson, Changes, Force, Seed, option
from tapetum.cli.outputs import check_output, says_what_is_kept
from tapetum.defaults import SEED
from tapetum.errors import InputError, noted
from tapetum.files import reserved
from tapetum.progress import bar

__all__ = ["twin"]


def twin(
    recording: Annotated[Path, typer.Argument(metavar="REC", help="A labelled recording of one camera, NAME.rec.")],
    scene: Annotated[str, option("SCENE", "What is known of the bench: a bundled scene or a YAML file.", "--scene")],
    out: Annotated[Path, option("FILE", "The scene to write, NAME.yaml.", "-o", "--out")],
    page: PageOut = None,
    free: Annotated[
        str | None,
        option(
            "NAMES",
            "What to fit, by commas: focus, focal_length, aperture, tilt, decentre, array, microlens, filter_depth, "
            "second_beam, probe_scale, probe_focus, background, light, or single parameters (all but probe_focus).",
        ),
    ] = None,
    frames: Annotated[int, option("N", "Frames to fit, spread over the field: 20 to 200.")] = 60,
    starts: Annotated[int, option("N", "Places at which searches begin, at most.", min=1, max=50)] = 4,
    accuracy: Annotated[
        float | None,
        option(
            "SHARE", "Accuracy of the simulation, in fractions of the peak; by default the scene's.", min=1e-5, max=0.5
        ),
    ] = None,
    roll: Annotated[
        bool, typer.Option("--roll", help="Fit each frame's roll too: the camera turns about its axis, as in a hand.")
    ] = False,
    unevenness: Annotated[
        float, option("SHARE", "RMS of the relative sensitivities of the probe's pixels.", min=0, max=0.9)
    ] = 0.0,
    seed: Seed = SEED,
    changes: Changes = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit a scene to a labelled recording of one real camera: focus, aperture, tilt, light and more.

    Writes the twin, a scene for every other command; a page with pictures; and NAME.json with the numbers. A parameter
    that the recording does not determine keeps the scene's value and is named. After Ctrl-C the same command goes on
    from NAME.part. The exit code is 1 where the scene cannot explain the recording.
    """
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise InputError("is no name for a scene", where=out, remedy="name it NAME.yaml")
    page, numbers, kept = page or out.with_suffix(".html"), out.with_suffix(".json"), out.with_suffix(".part")
    files = (page, numbers, out)
    for path in files:
        check_output(path, force)
    from tapetum.bench import load_scene
    from tapetum.calibrate.twin import fit_twin
    from tapetum.calibrate.twin.page import shown, verdict

    names = None if free is None else [one.strip() for one in free.split(",") if one.strip()]
    known = load_scene(scene, changes or ())

    def search() -> str:
        return f"what is done is kept in {kept}, and the same command goes on" if kept.exists() else ""

    with reserved(out), says_what_is_kept():
        with noted(search, KeyboardInterrupt):
            found = fit_twin(
                recording,
                known,
                free=names,
                frames=frames,
                starts=starts,
                seed=seed,
                accuracy=accuracy,
                roll=roll,
                unevenness=unevenness,
                state=kept,
                progress=bar,
            )
        with noted(search, KeyboardInterrupt, InputError), _none_half_written(files):
            found.write_page(page)
            found.save_numbers(numbers)
            found.save(out)
        kept.unlink(missing_ok=True)
    if as_json:
        written = {"out": str(out), "page": str(page), "numbers": str(numbers)}
        typer.echo(json.dumps({**found.as_dict(), **written}, allow_nan=False))
    else:
        for one in found.parameters:
            known_to = f"± {shown(one, one.deviation)}" if one.told else "not determined by this recording"
            typer.echo(f"  {one.name:<24} {shown(one, one.value):>18}  {known_to}")
        typer.echo(f"{out}, {numbers}, {page}: {verdict(found)}")
    if not found.explains:
        raise typer.Exit(1)


@contextlib.contextmanager
def _none_half_written(files: Sequence[Path]) -> Iterator[None]:
    """After a failure leave none of the files that are new: they would stop the same command."""
    new = [path for path in files if not path.exists()]
    try:
        yield
    except BaseException:
        for path in new:
            path.unlink(missing_ok=True)
        raise
