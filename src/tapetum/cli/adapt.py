"""`tapetum adapt`: fit a network that has seen other cameras to one camera, by few labelled frames of it."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tapetum.cli.models import find_model
from tapetum.cli.options import Device, Force, SeedIfGiven, option
from tapetum.cli.outputs import check_output
from tapetum.cli.train import save_evaluation, say_epoch
from tapetum.defaults import SEED
from tapetum.durable import clean_leftovers, part_name
from tapetum.errors import InputError, StoppedError, one_of
from tapetum.files import reserved, told_when_full
from tapetum.progress import bar

if TYPE_CHECKING:
    import xarray as xr

    from tapetum.models import NetworkEstimator
    from tapetum.models.epochs import EpochReport

_MODEL = "A network's folder, or the bundled thin-lens-gaze."
_FROM = "A dataset, NAME.zarr, or a labelled recording, NAME.rec, of the one camera."
# From this share of the error of the labels' mean on, estimates are said to be little better.
_LITTLE_BETTER = 0.75


def adapt(
    model: Annotated[str, typer.Argument(metavar="MODEL", help=_MODEL)],
    film: Annotated[Path, typer.Argument(metavar="SET_OR_REC", help=_FROM)],
    out: Annotated[Path, option("MODEL", "The adapted model's folder.", "-o", "--out")],
    seconds: Annotated[
        float | None, option("S", "Seconds of labelled film to use, of the training part; all by default.")
    ] = None,
    spread: Annotated[
        bool,
        typer.Option("--spread/--in-a-row", help="Which frames --seconds takes: spread over the field, or the first."),
    ] = True,
    unit: Annotated[str | None, option("NAME", "Of a set of several copies of a camera: the one to adapt to.")] = None,
    label: Annotated[
        str | None, option("NAME", "What it learns, which must be what MODEL estimates; that is the default.")
    ] = None,
    epochs: Annotated[
        int | None,
        option("N", "Passes of all layers over the frames; by default a minute or two, or none if needless.", min=1),
    ] = None,
    precision: Annotated[str, option("HOW", "float32, or bf16: twice as fast on processors with it.")] = "float32",
    seed: SeedIfGiven = None,
    device: Device = "auto",
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with an interrupted adaptation from what it has kept.")
    ] = False,
    force: Force = False,
) -> None:
    """Fine-tune a network on a few labelled frames of another copy, lens or distance; print its error on the test part.

    Its intervals, and where it applies, are learned from the same frames; test frames are never used. Finished steps
    are kept beside the model, in MODEL.checkpoint, until the model is saved.
    """
    check_output(out, force, "tapetum-model")
    one_of(precision, ("float32", "bf16"), "--precision")
    checkpoint = out.with_name(f"{out.name}.checkpoint")
    if checkpoint.exists() and not (resume or force):
        remedy = "go on with --resume, or start over with --overwrite"
        raise InputError("an unfinished adaptation is kept here", where=checkpoint, remedy=remedy)
    from tapetum.data.film_parts import of_unit
    from tapetum.models import NetworkEstimator, save_model
    from tapetum.models import adapt as adapt_network
    from tapetum.models.devices import has_bfloat16, training_device
    from tapetum.models.kept_folds import remove_kept

    if precision == "bf16" and not has_bfloat16(training_device(device)):
        typer.echo("note: this device has no bfloat16: float32 takes its place", err=True)
    base = find_model(model, "cpu")
    if not isinstance(base, NetworkEstimator):
        remedy = "give a network that `tapetum train` saved as a folder, or the bundled thin-lens-gaze"
        raise InputError(f"is no network that can be trained further ({base.kind})", where=model, remedy=remedy)
    _check_label(label, base, model)
    with _opened(film, base.crop, out) as data:
        data = data if unit is None else of_unit(data, unit)
        with reserved(out):
            done: list[EpochReport] = []

            def told(report: EpochReport) -> None:
                done.append(report)
                say_epoch(report)

            options: dict[str, Any] = {"seconds": seconds, "spread": spread, "epochs": epochs, "precision": precision}
            options |= {"seed": SEED if seed is None else seed, "device": device, "name": model}
            try:
                adapted = adapt_network(
                    base, data, **options, checkpoint=checkpoint, resume=resume, progress=bar, on_epoch=told
                )
            except KeyboardInterrupt as error:
                if not checkpoint.exists():
                    raise
                what = f"what is done is kept in {checkpoint}; go on with the same command and --resume"
                raise StoppedError(what) from error
            save_model(adapted, out, overwrite=force)
            remove_kept(checkpoint)
        typer.echo(f"saved {out}")
        _say(adapted)
        if not data.tp.test.sizes["frame"]:
            typer.echo("no test frames: not evaluated")
            return
        save_evaluation(adapted, data, film, out)


def _check_label(label: str | None, base: NetworkEstimator, name: str) -> None:
    from tapetum.models.base import target_names

    if label is not None and target_names(label) != base.target_names:
        what = f"{name} estimates {', '.join(base.target_names)}, not {', '.join(target_names(label))}"
        remedy = f"leave --label out, or train a model of it: `tapetum train SET --kind {base.kind} --label {label}`"
        raise InputError(what, where="--label", remedy=remedy)


@contextlib.contextmanager
def _opened(film: Path, side: int, out: Path) -> Iterator[xr.Dataset]:
    """Open a dataset, or cut one from a labelled recording, hidden beside `out`, which lasts as long as the block."""
    from tapetum.data import build_dataset, open_dataset
    from tapetum.record.layout import is_recording

    if not is_recording(film):
        yield open_dataset(film)
        return
    # What a killed run left goes first.
    clean_leftovers(out)
    folder, stood = part_name(out, end=".part-film"), out.absolute().parent.exists()
    try:
        with told_when_full(out):
            folder.mkdir(parents=True)
        cut = build_dataset([film], folder / "film.zarr", side=side, progress=bar)
        data = open_dataset(cut)
        data.encoding["source"] = str(film)
        yield data
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if not stood:
            with contextlib.suppress(OSError):  # the model is in it
                out.absolute().parent.rmdir()


def _say(adapted: NetworkEstimator) -> None:
    told = adapted.training_ or {}
    of = told.get("adapted_from", {})
    seconds = f" ({of['seconds']:g} s)" if "seconds" in of else ""
    typer.echo(f"adapted from {of.get('model')} by {of['frames']} frames{seconds}: {of['choice']}")
    for what, why in told["chosen"].items():
        typer.echo(f"chosen: {what}: {why}")
    _warn_of(told["left_out_error"], adapted.crop)


def _warn_of(errors: dict[str, float], crop: int) -> None:
    """Say where an adapted network is no better than what needs none."""
    from tapetum.models.fine_tuning import CARRIED, GUESS, RIDGE, better_of, ridge_scales

    best, ridge, guess = errors.get(CARRIED, errors[better_of(errors)]), errors[RIDGE], errors[GUESS]
    typer.echo(f"without the network: {ridge:.3g} with {RIDGE}, {guess:.3g} with {GUESS}")
    if best >= _LITTLE_BETTER * guess:
        typer.echo(
            "note: its estimates are little better than the labels' mean: the film is too short, or the camera too "
            "unlike those that MODEL has seen",
            err=True,
        )
    if ridge < best:
        scales = ",".join(map(str, ridge_scales(crop)))
        command = f"tapetum train SET --kind zernike --tuned --scales {scales} -o MODEL"
        typer.echo(f"note: a ridge errs less on the same frames: `{command}`", err=True)
