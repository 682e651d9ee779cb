"""`tapetum calibrate units`: how far a model errs on copies of its camera that it has not seen."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.cli.models import find_model
from tapetum.cli.options import Device, Force, ModelName, Split, option
from tapetum.cli.outputs import check_output
from tapetum.defaults import SEED
from tapetum.errors import InputError
from tapetum.progress import bar

if TYPE_CHECKING:
    import xarray as xr

_USUAL_UNITS = 40


def units(
    model: ModelName,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SET_OR_SCENE",
            help="A set of 10 or more copies, each named in unit; or a scene of the bench, whose copies are drawn from "
            "tolerances and filmed.",
        ),
    ],
    out: Annotated[Path, option("MODEL", "The folder of the model with the new intervals.", "-o", "--out")],
    count: Annotated[int | None, option("N", "Of a scene: copies to film (40), 10 or more.", "--units", min=1)] = None,
    frames: Annotated[int | None, option("N", "Of a scene: frames of each copy (32).", min=1)] = None,
    seed: Annotated[
        int | None, option("N", "Of a scene: the first copy's seed, from which the others count up.", min=0)
    ] = None,
    split: Split = "time",
    device: Device = "auto",
    force: Force = False,
) -> None:
    """Calibrate a model's intervals for copies of its camera that it has not seen, on several such copies.

    Nothing else of the model changes. track, serve and evaluate use these intervals unless the copy is known to be the
    one the model was trained on. Copies of a scene are kept in MODEL.copies until the model is saved.
    """
    check_output(out, force, "tapetum-model")
    from tapetum.models import Estimator, NetworkEstimator, ZernikeRidge, calibrate_units, model_card, save_model

    fitted = find_model(model, device)
    if fitted.kind == "simulation":
        remedy = "give a network or a ridge, and take the twin for the scene of the copies"
        raise InputError("reads by simulation, and learns nothing from copies", where=model, remedy=remedy)
    if not isinstance(fitted, NetworkEstimator | ZernikeRidge):
        raise InputError("cannot be changed: it is exported", where=model, remedy="give the model's folder")
    if isinstance(fitted, NetworkEstimator) and not fitted.quantities:
        raise InputError("estimates no quantity", where=model, remedy="only quantities have intervals")
    assert isinstance(fitted, Estimator)
    kept = out.with_name(f"{out.name}.copies")
    if Path(source).suffix == ".zarr" or "://" in source:
        for name, value in (("--units", count), ("--frames", frames), ("--seed", seed)):
            if value is not None:
                raise InputError("is of a scene", where=name, remedy="leave it out: the set has its own copies")
        from tapetum.data import open_dataset, split_by

        data = split_by(open_dataset(source), split)
    else:
        if split != "time":
            raise InputError("is of a set", where="--split", remedy="leave it out")
        from tapetum.models.other_units import FEWEST_UNITS

        if count is not None and count < FEWEST_UNITS:
            raise InputError(f"{count} copies are too few", where="--units", remedy=f"film {FEWEST_UNITS} or more")
        first = 3_000_000 + SEED if seed is None else seed
        data = _filmed(source, fitted, range(first, first + (count or _USUAL_UNITS)), frames or 32, kept)
    calibrate_units(fitted, data, progress=bar)
    card = model_card(model) if Path(model).is_dir() else {}
    save_model(fitted, out, metrics=card.get("metrics"), notes=card.get("notes"), overwrite=force)
    if kept.is_dir():
        import shutil

        shutil.rmtree(kept)
    told = (fitted.training_ or {})["other_units"]
    typer.echo(f"saved {out}: intervals for another copy, from {told['frames']} frames of {told['copies']} copies")
    assert fitted.others_ is not None
    own, other = fitted.intervals_.half_width, fitted.others_.half_width
    for k, name in enumerate(fitted.quantities):
        typer.echo(f"  {name}: ±{other[0, k]:.3g} nearest to the training frames, ±{own[-1, k]:.3g} on its own copy")


def _filmed(scene: str, model: object, seeds: range, frames: int, kept: Path) -> xr.Dataset:
    from tapetum.bench import load_scene
    from tapetum.experiments.copies import film_copies

    side = int(getattr(model, "crop", 0) or max(getattr(model, "scales", (400,))))
    return film_copies(load_scene(scene), seeds, frames, kept, side=side, progress=bar)
