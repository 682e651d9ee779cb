"""`tapetum train`: fit a model to a dataset and save it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tapetum.cli.options import Device, Force, Processes, SeedIfGiven, SetPath, Split, count_of, option
from tapetum.cli.outputs import check_output
from tapetum.defaults import SEED
from tapetum.errors import InputError, StoppedError, one_of
from tapetum.files import reserved
from tapetum.progress import bar

if TYPE_CHECKING:
    import xarray as xr

    from tapetum.models import NetworkEstimator, ZernikeRidge
    from tapetum.models.epochs import EpochReport


def train(
    dataset: SetPath,
    out: Annotated[Path, option("MODEL", "The model's folder.", "-o", "--out")],
    kind: Annotated[str, option("KIND", "Of the new model: zernike, resnet18 or convnext-pico.")] = "zernike",
    label: Annotated[
        str, option("NAME", "What it learns: gaze, focus, device, phone (gaze and device), or a label of the set.")
    ] = "gaze",
    tuned: Annotated[
        bool,
        typer.Option("--tuned", help="zernike, not the paper's: standardised, its penalty chosen by cross-validation."),
    ] = False,
    scales: Annotated[
        str | None, option("PX,PX,…", "zernike: sides of what it looks at. The paper's 100,200,300,400 where they fit.")
    ] = None,
    intervals: Annotated[
        bool | None,
        typer.Option(
            "--intervals/--no-intervals",
            help="Keep the last tenth of each recording's training frames out of the fit, to set 90 % intervals. By "
            "default zernike fits all training frames, as the paper does, and has no intervals; networks keep them.",
            show_default=False,
        ),
    ] = None,
    epochs: Annotated[int | None, option("N", "networks: passes over the images (12).", min=1)] = None,
    patience: Annotated[
        int | None, option("N", "networks: stop after N epochs without a better held-out error.", min=1)
    ] = None,
    crop: Annotated[int | None, option("PX", "networks: side of what it looks at (288).", min=16)] = None,
    size: Annotated[int | None, option("PX", "networks: side it is reduced to (96).", min=16)] = None,
    background: Annotated[
        str | None, option("HOW", "networks: take the background off before the root (level, usual) or after (root).")
    ] = None,
    gain: Annotated[
        float | None, option("X", "networks: inputs are multiplied by exp(u), u at random up to this (0.1).", min=0)
    ] = None,
    interpolate: Annotated[
        bool,
        typer.Option(
            "--interpolate",
            help="networks: interpolate what is left of the labels between frames that look alike, where that errs "
            "less on the frames kept aside.",
        ),
    ] = False,
    copies: Annotated[
        Path | None,
        option("COPIES", "networks: a set of further copies of the camera, which train all layers but the last too."),
    ] = None,
    split: Split = "time",
    seed: SeedIfGiven = None,
    device: Device = "auto",
    processes: Processes = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="networks: go on with an interrupted training from its last whole epoch.")
    ] = False,
    force: Force = False,
) -> None:
    """Fit a model to the training part of a dataset, save it, and print its error on the test part.

    A network keeps a checkpoint beside the model, MODEL.checkpoint, until the model is saved. The model is saved before
    it is evaluated: where the evaluation fails, the model stays.
    """
    network = kind != "zernike"
    if network:
        from tapetum.models.architectures import ARCHITECTURES

        one_of(kind, ("zernike", *ARCHITECTURES), "--kind")
    if network and intervals is False and patience is not None:
        raise InputError("needs frames kept aside", where="--patience", remedy="leave out --no-intervals")
    if network and intervals is False and interpolate:
        raise InputError("needs frames kept aside", where="--interpolate", remedy="leave out --no-intervals")
    networks_own = {
        "epochs": epochs,
        "patience": patience,
        "crop": crop,
        "size": size,
        "background": background,
        "gain": gain,
        "interpolate": interpolate or None,
        "seed": seed,
        "device": None if device == "auto" else device,
        "processes": count_of(processes),
        "resume": resume or None,
    }
    options: dict[str, Any] = {name: value for name, value in networks_own.items() if value is not None}
    ridges_own = [name for name, value in (("tuned", tuned), ("scales", scales)) if value]
    foreign = ridges_own if network else [*options, *(["copies"] if copies is not None else [])]
    if foreign:
        raise InputError(f"has no meaning for {kind}", where=f"--{foreign[0]}", remedy="leave it out")
    check_output(out, force, "tapetum-model")
    checkpoint = out.with_name(f"{out.name}.checkpoint")
    if network and checkpoint.exists() and not (resume or force):
        remedy = "go on with --resume, or start over with --overwrite"
        raise InputError("an unfinished training is kept here", where=checkpoint, remedy=remedy)
    from tapetum.data import open_dataset, split_by
    from tapetum.models import ZernikeRidge, save_model
    from tapetum.models.training import remove_checkpoint

    data = split_by(open_dataset(dataset), split)
    if intervals is not None:
        options["calibration_fraction"] = 0.1 if intervals else 0.0
    with reserved(out):
        fitted: ZernikeRidge | NetworkEstimator
        if network:
            beside = None if copies is None else open_dataset(copies)
            fitted = _fitted_network(kind, label, {"seed": SEED, **options}, data, beside, checkpoint)
        else:
            if tuned:
                options |= {"alpha": "cv", "standardise": True}
            options["scales"] = _fitting_scales(data.tp.side) if scales is None else _numbers(scales)
            fitted = ZernikeRidge(label, **options).fit(data.tp.train, progress=bar)
        save_model(fitted, out, overwrite=force)
        remove_checkpoint(checkpoint)
    typer.echo(f"saved {out}")
    if not data.tp.test.sizes["frame"]:
        typer.echo("no test frames: not evaluated")
        return
    save_evaluation(fitted, data, dataset, out)


def _fitted_network(
    kind: str, label: str, options: dict[str, Any], data: xr.Dataset, copies: xr.Dataset | None, checkpoint: Path
) -> NetworkEstimator:
    """Train a network; after Ctrl-C, report what is kept and how to resume."""
    from tapetum.models import NetworkEstimator

    resume = options.pop("resume", False)
    network = NetworkEstimator(label, architecture=kind, **_fitting_look(options, data.tp.side))
    done: list[EpochReport] = []

    def told(report: EpochReport) -> None:
        done.append(report)
        say_epoch(report)

    try:
        return network.fit(
            data.tp.train, copies=copies, progress=bar, checkpoint=checkpoint, resume=resume, on_epoch=told
        )
    except KeyboardInterrupt as error:
        if not checkpoint.exists():
            raise
        epochs = f"{done[-1].epoch} of {done[-1].epochs} epochs are" if done else "the last whole epoch is"
        what = f"{epochs} kept in {checkpoint}; go on with the same command and --resume"
        raise StoppedError(what) from error


def save_evaluation(model: ZernikeRidge | NetworkEstimator, data: xr.Dataset, dataset: Path, out: Path) -> None:
    """Print the errors of a model that is saved, and put them on its card."""
    from tapetum.models.store import write_metrics
    from tapetum.report.evaluation import describe, evaluate_model

    try:
        scores = evaluate_model(model, data.tp.test, data.tp.train, progress=bar)
    except InputError as error:
        remedy = f"the model is saved: mend the set, then `tapetum evaluate {out} {dataset}`"
        raise InputError(f"not evaluated: {error.what}", where=error.where, remedy=remedy) from error
    write_metrics(out, scores)
    typer.echo(describe(scores))


def _fitting_scales(side: int) -> tuple[int, ...]:
    """The paper's scales, reduced in proportion for smaller crops."""
    from tapetum.models.features import SCALES

    if side >= max(SCALES):
        return SCALES
    fitting = tuple(max(1, side * one // max(SCALES)) for one in SCALES)
    typer.echo(f"the crops have {side} pixels: scales {_listed(fitting)} in place of the paper's {_listed(SCALES)}")
    return fitting


def _fitting_look(options: dict[str, Any], side: int) -> dict[str, Any]:
    """The options of the network; by default its crop is at most the dataset's."""
    from tapetum.models import NetworkEstimator

    usual = NetworkEstimator()
    if "crop" in options or side >= usual.crop:
        return options
    size = options.get("size", min(usual.size, side))
    typer.echo(
        f"the crops have {side} pixels: the network looks at {side}, reduced to {size}, in place of {usual.crop}"
    )
    return {**options, "crop": side, "size": size}


def _numbers(listed: str) -> tuple[int, ...]:
    parts = [one.strip() for one in listed.split(",")]
    if not all(one.isascii() and one.isdigit() and int(one) > 0 for one in parts):
        raise InputError(f"must be sides in pixels, is {listed!r}", where="--scales", remedy="give 100,200 for example")
    return tuple(int(one) for one in parts)


def _listed(numbers: tuple[int, ...]) -> str:
    return ", ".join(map(str, numbers))


def say_epoch(report: EpochReport) -> None:
    held_out = "" if report.validation_mae is None else f", held-out error {report.validation_mae:.4f}"
    busy = "" if report.busy is None else f", GPU busy {report.busy:.0%}"
    speed = f"{report.images_per_second:.0f} images/s{busy}"
    typer.echo(
        f"epoch {report.epoch} of {report.epochs}: loss {report.loss:.4f}{held_out} ({report.seconds:.0f} s, {speed})"
    )
