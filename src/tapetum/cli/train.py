"""`tapetum train`: fit a model to a dataset and save it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tapetum.cli.inputs import check_replaceable
from tapetum.errors import InputError, one_of
from tapetum.progress import bar

if TYPE_CHECKING:
    from tapetum.models import ResNet18, ZernikeRidge
    from tapetum.models.epochs import EpochReport

KINDS = ("zernike", "resnet18")


def train(
    dataset: Annotated[Path, typer.Argument(metavar="SET", help="A dataset, NAME.zarr.")],
    out: Annotated[Path, typer.Option("-o", "--out", metavar="MODEL", help="The model's folder.")],
    model: Annotated[str, typer.Option(metavar="KIND", help=f"{' or '.join(KINDS)}.")] = "zernike",
    target: Annotated[
        str,
        typer.Option(metavar="NAME", help="What to predict: gaze, focus, device, phone (gaze and device), or a label."),
    ] = "gaze",
    tuned: Annotated[
        bool,
        typer.Option("--tuned", help="zernike, not the paper's: standardised, its penalty chosen by cross-validation."),
    ] = False,
    epochs: Annotated[int | None, typer.Option(metavar="N", help="resnet18: passes over the images.", min=1)] = None,
    patience: Annotated[
        int | None,
        typer.Option(metavar="N", help="resnet18: stop after N epochs without a better held-out error.", min=1),
    ] = None,
    crop: Annotated[int | None, typer.Option(metavar="PX", help="resnet18: side of what it looks at.", min=16)] = None,
    size: Annotated[int | None, typer.Option(metavar="PX", help="resnet18: side it is reduced to.", min=16)] = None,
    background: Annotated[
        str | None,
        typer.Option(metavar="HOW", help="resnet18: take the background off before the root (level) or after (root)."),
    ] = None,
    gain: Annotated[
        float | None, typer.Option(metavar="X", help="resnet18: how far brightness is varied, in parts of e.", min=0)
    ] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="N", help="resnet18: of weights, order and augmentation.", min=0)
    ] = None,
    device: Annotated[str | None, typer.Option(metavar="NAME", help="resnet18: auto, cpu, cuda or cuda:1.")] = None,
    processes: Annotated[
        str | None, typer.Option(metavar="N", help="resnet18: how many GPUs, or processes on a CPU; auto: all GPUs.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="resnet18: go on with an interrupted training from its last whole epoch.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a model or a checkpoint of this name.")
    ] = False,
) -> None:
    """Fit a model to the training part of a dataset; print its error on the test part.

    ResNet-18 keeps a checkpoint beside the model, MODEL.checkpoint, until the model is saved.
    """
    one_of(model, KINDS, "--model")
    given: dict[str, Any] = {
        "epochs": epochs,
        "patience": patience,
        "crop": crop,
        "size": size,
        "background": background,
        "gain": gain,
        "seed": seed,
        "device": device,
        "processes": _count(processes),
    }
    options = {name: value for name, value in given.items() if value is not None}
    foreign = [*options, *(["resume"] if resume else [])] if model == "zernike" else ["tuned"] if tuned else []
    if foreign:
        raise InputError(f"has no meaning for {model}", where=f"--{foreign[0]}", remedy="leave it out")
    check_replaceable(out, overwrite, "model.json", "tapetum-model")
    checkpoint = out.with_name(f"{out.name}.checkpoint")
    if model == "resnet18" and checkpoint.exists() and not (resume or overwrite):
        remedy = "go on with --resume, or begin anew with --overwrite"
        raise InputError("an unfinished training is kept here", where=checkpoint, remedy=remedy)
    from tapetum.data import open_dataset
    from tapetum.models import ResNet18, ZernikeRidge, save_model
    from tapetum.models.training import remove_checkpoint
    from tapetum.report.evaluate import describe, evaluate_model

    data = open_dataset(dataset)
    fitted: ZernikeRidge | ResNet18
    if model == "zernike":
        chosen: dict[str, Any] = {"alpha": "cv", "standardise": True} if tuned else {}
        fitted = ZernikeRidge(target, **chosen).fit(data.tp.train, progress=bar)
    else:
        network = ResNet18(target, **options)
        fitted = network.fit(data.tp.train, progress=bar, checkpoint=checkpoint, resume=resume, on_epoch=_say_epoch)
    # A dataset that only trains is no reason to lose the model.
    tested = bool(data.tp.test.sizes["frame"])
    scores = evaluate_model(fitted, data.tp.test, data.tp.train, progress=bar) if tested else None
    save_model(fitted, out, metrics=scores, overwrite=overwrite)
    remove_checkpoint(checkpoint)
    typer.echo("no test frames: not evaluated" if scores is None else describe(scores))
    typer.echo(f"saved {out}")


def _count(processes: str | None) -> int | str | None:
    if processes is None or processes == "auto":
        return processes
    if not processes.isdigit():
        raise InputError(f"must be a number or auto, is {processes!r}", where="--processes")
    return int(processes)


def _say_epoch(report: EpochReport) -> None:
    held_out = "" if report.validation_mae is None else f", held-out error {report.validation_mae:.4f}"
    busy = "" if report.busy is None else f", GPU busy {report.busy:.0%}"
    speed = f"{report.images_per_second:.0f} images/s{busy}"
    typer.echo(
        f"epoch {report.epoch} of {report.epochs}: loss {report.loss:.4f}{held_out} ({report.seconds:.0f} s, {speed})"
    )
