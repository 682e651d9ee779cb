"""`tapetum train`: fit a model to a dataset and save it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tapetum.cli.inputs import check_replaceable
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

if TYPE_CHECKING:
    from tapetum.models.training import EpochReport

KINDS = ("zernike", "resnet18")


def train(
    dataset: Annotated[Path, typer.Argument(metavar="SET", help="A dataset, NAME.zarr.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="MODEL", help="The model's folder.")],
    model: Annotated[str, typer.Option(metavar="KIND", help=f"{' or '.join(KINDS)}.")] = "zernike",
    target: Annotated[
        str, typer.Option(metavar="NAME", help="What to predict: gaze, focus, or a label's name.")
    ] = "gaze",
    epochs: Annotated[int | None, typer.Option(metavar="N", help="Of ResNet-18.", min=1)] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of ResNet-18's weights, order and augmentation.", min=0)] = 0,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an interrupted ResNet-18 from its last whole epoch.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a model or a checkpoint of this name.")
    ] = False,
) -> None:
    """Fit a model to the training part of a dataset; print its error on the test part.

    ResNet-18 keeps a checkpoint beside the model, MODEL.checkpoint, until the model is saved.
    """
    one_of(model, KINDS, "--model")
    check_replaceable(out, overwrite, "model.json", "tapetum-model")
    checkpoint = out.with_name(f"{out.name}.checkpoint")
    if model != "resnet18" and (resume or epochs is not None):
        option = "--resume" if resume else "--epochs"
        raise InputError(f"has no meaning for {model}", where=option, remedy="leave it out")
    if model == "resnet18" and checkpoint.exists() and not (resume or overwrite):
        remedy = "go on with --resume, or begin anew with --overwrite"
        raise InputError("an unfinished training is kept here", where=checkpoint, remedy=remedy)
    from tapetum.data import open_dataset
    from tapetum.models import ResNet18, ZernikeRidge, save_model
    from tapetum.models.training import remove_checkpoint
    from tapetum.report.evaluate import describe, evaluate_model

    data = open_dataset(dataset)
    if model == "zernike":
        fitted = ZernikeRidge(target=target).fit(data.tp.train, progress=bar)
    else:
        network = ResNet18(target=target, seed=seed)
        network = network if epochs is None else ResNet18(target=target, seed=seed, epochs=epochs)
        fitted = network.fit(data.tp.train, progress=bar, checkpoint=checkpoint, resume=resume, on_epoch=_say_epoch)
    # A dataset that only trains is no reason to lose the model.
    tested = bool(data.tp.test.sizes["frame"])
    scores = evaluate_model(fitted, data.tp.test, data.tp.train, progress=bar) if tested else None
    save_model(fitted, out, metrics=scores, overwrite=overwrite)
    remove_checkpoint(checkpoint)
    typer.echo("no test frames: not evaluated" if scores is None else describe(scores))
    typer.echo(f"saved {out}")


def _say_epoch(report: EpochReport) -> None:
    held_out = "" if report.validation_mae is None else f", held-out MAE {report.validation_mae:.4f}"
    typer.echo(f"epoch {report.epoch} of {report.epochs}: loss {report.loss:.4f}{held_out} ({report.seconds:.0f} s)")
