"""Fine-tuning: a network that has seen other cameras, adapted to one camera by few labelled frames of it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from tapetum.data.dataset import DEVICE
from tapetum.data.film_parts import check_one_camera, film_seconds, first_seconds, spread_over
from tapetum.errors import InputError
from tapetum.models.base import training_part
from tapetum.models.fine_tuning import Adaptation
from tapetum.models.network import NetworkEstimator
from tapetum.models.training import EpochReport
from tapetum.progress import Progress, quiet

__all__ = ["adapt"]

# With fewer frames not even the estimates' mean is known.
_FEWEST = 12
# Frames spread over the field lie as far apart in time as in the field where they are at most this share of the film.
_SPARSE = 0.25


# A training needs gradients, whatever the caller's mode.
@torch.inference_mode(mode=False)
@torch.enable_grad()
def adapt(
    base: NetworkEstimator,
    dataset: xr.Dataset,
    *,
    seconds: float | None = None,
    spread: bool = True,
    epochs: int | None = None,
    seed: int = 0,
    precision: str = "float32",
    device: str = "auto",
    name: str | None = None,
    checkpoint: str | Path | None = None,
    resume: bool = False,
    progress: Progress = quiet,
    on_epoch: Callable[[EpochReport], None] | None = None,
) -> NetworkEstimator:
    """Return a network for the camera of a dataset, from one that was trained on others.

    The last layer of `base` is corrected by ridge regression on its features, or, of few frames, from what copies of
    its camera differ by (`tapetum.models.copy_prior`). Where it then errs by at most a hundredth of the labels' spread
    on frames left out, it is kept. Otherwise all layers are trained from there (A. Kumar et al., ICLR (2022)), or, for
    a camera unlike those that `base` has seen, from a last layer of zeros; frames that neither has fitted decide which
    of the two is kept: all layers where they err by a quarter less. With up to 250 frames these are all frames in turn,
    in 4 folds: the errors of the folds also set the intervals (cross-conformal prediction, V. Vovk, Ann. Math. Artif.
    Intell. 74, 9 (2015)), and the network that is returned is fitted to every frame. With more frames, 8 % of them
    decide, about the epoch too, and 17 % calibrate; of a camera unlike those that `base` has seen the 17 % do both, and
    no epoch is chosen. Where `seconds` spreads many frames over a longer film, 17 % of them, single ones at random,
    calibrate, of which a third decides instead unless the camera is unlike the others. Where the last layer wins, it is
    fitted to all frames, and calibrated in folds. Frames of different folds or parts share no measurement of their
    labels, except where frames are divided one by one, many ones and those that are spread over a film at least four
    times as long: then the labels' standard deviations are added to their errors. What the network that is kept leaves
    of the labels is interpolated between frames that look alike (`tapetum.models.kernel`) where that errs less on the
    frames left out. Test frames are never used.

    Parameters
    ----------
    base
        Of any architecture, for quantities. It is not changed.
    dataset
        Labelled frames of one camera.
    seconds
        How many seconds of labelled film to use, of the training part; by default all.
    spread
        Choose these frames spread over the labels' range, not the first ones in a row.
    epochs
        Passes of all layers over the frames, even where the last layer is enough; by default as many as take some two
        minutes on two cores, four of much film.
    seed
        Of the choice of frames, their order and their augmentation.
    precision
        See `tapetum.models.training.TrainingSettings`.
    device
        "auto" (CUDA if present), "cpu" or "cuda".
    name
        Of `base`, for the card.
    checkpoint, resume
        A folder that keeps finished folds and the last complete epoch, and whether to go on from there.
    progress, on_epoch
        Shown over all steps; called with the report of every epoch of the network that is kept.

    Returns
    -------
    NetworkEstimator
        With intervals and the domain of the new frames, and an account in its `training_`.

    Raises
    ------
    InputError
        For a model that is no network or knows devices, a set that lacks its labels, has too few frames or mixes
        cameras, more seconds than were filmed, and a checkpoint of another adaptation.

    Examples
    --------
    >>> from tapetum.data import open_dataset
    >>> from tapetum.models import pretrained
    >>> mine = adapt(pretrained("thin-lens-gaze"), open_dataset("mine.zarr"), seconds=10)  # doctest: +SKIP
    """
    _check_base(base)
    check_one_camera(dataset, base.target_names)
    if resume and checkpoint is None:
        raise InputError("resume needs the folder of a checkpoint", where="checkpoint", remedy="pass checkpoint=FOLDER")
    chosen, told = _chosen(dataset, base, seconds, spread, seed)
    part = training_part(chosen, base.target_names, 0.0)
    sparse = spread and told["frames"] <= dataset.tp.train.sizes["frame"] * _SPARSE
    scattered = spread and told["frames"] < dataset.tp.train.sizes["frame"]
    work = Adaptation.begin(
        base, part, sparse, scattered, epochs, seed, precision, device, progress, checkpoint, resume
    )
    work.on_epoch = on_epoch
    return work.adapted({**_origin(base, name), **told})


def _check_base(base: Any) -> None:
    if not isinstance(base, NetworkEstimator):
        kind = getattr(base, "kind", type(base).__name__)
        remedy = "give a network that `tapetum train` saved as a folder, or the bundled thin-lens-gaze"
        raise InputError(f"cannot be adapted: it is no trainable network ({kind})", where="model", remedy=remedy)
    if DEVICE in base.target_names:
        remedy = "train it again with the new camera's frames added"
        raise InputError("recognises devices: it cannot be adapted to one camera", where="model", remedy=remedy)


def _origin(base: NetworkEstimator, name: str | None) -> dict[str, Any]:
    told = {"model": name, "kind": base.kind, "training_data": base.data_hash_}
    return {key: value for key, value in told.items() if value is not None}


def _chosen(
    dataset: xr.Dataset, base: NetworkEstimator, seconds: float | None, spread: bool, seed: int
) -> tuple[xr.Dataset, dict[str, Any]]:
    """Return the frames to adapt to, and what the card says of them."""
    lacking = [name for name in base.target_names if name not in dataset]
    if lacking:
        have = ", ".join(dataset.tp.targets) or "none"
        what = f"has no label {lacking[0]}, which the model estimates ({', '.join(base.target_names)})"
        raise InputError(what, where=dataset.tp.source, remedy=f"it has: {have}")
    if base.crop > dataset.tp.side:
        what = f"has crops of {dataset.tp.side} pixels, the model looks at {base.crop}"
        raise InputError(what, where=dataset.tp.source, remedy=f"build it with --side {base.crop} or more")
    train = dataset.tp.train
    count = train.sizes["frame"] if seconds is None else first_seconds(train, seconds)
    if count < _FEWEST:
        what = f"{count} labelled frames are too few to adapt to, at least {_FEWEST} are needed"
        raise InputError(what, where=dataset.tp.source, remedy="film more")
    places = spread_over(train.tp.values(base.quantities), count, seed) if spread else np.arange(count)
    part = train.isel(frame=places)
    part.encoding.update(dataset.encoding)
    told: dict[str, Any] = {"frames": int(count)}
    if "time" in train:
        told["seconds"] = round(film_seconds(train) * count / train.sizes["frame"], 3)
    whole = count == train.sizes["frame"]
    how = "spread over the field" if spread else "the first ones in a row"
    told["choice"] = "all training frames" if whole else f"{how}, of {train.sizes['frame']} training frames"
    return part, told
