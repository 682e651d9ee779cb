"""Networks as estimators: from centred crops to gaze, focus and device, with intervals and probabilities.

One file of more than 400 lines: the state that a network learns is set, used, stored and read back in one class.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray
from torch import Tensor, nn

from tapetum.data.dataset import DEVICE
from tapetum.errors import InputError, one_of
from tapetum.models.architectures import ARCHITECTURES, Network
from tapetum.models.augmentation import augment
from tapetum.models.base import Estimator, TrainingPart, plain_target, quantities_of, target_names, training_part
from tapetum.models.calibration import fit_temperature, probabilities
from tapetum.models.copy_prior import CopyPrior, fit_copy_prior
from tapetum.models.devices import training_device
from tapetum.models.domain import Domain, fit_domain, picture_features, picture_width
from tapetum.models.inputs import BACKGROUNDS, prepare
from tapetum.models.intervals import OTHER, Intervals, fit_intervals, has_intervals
from tapetum.models.kernel import ResidualKernel, interpolated, left_out
from tapetum.models.losses import MixedLoss
from tapetum.models.novelty import Novelty, fit_novelty
from tapetum.models.own_layers import OwnLayers, beside_copies, copies_of, targets_beside, without_copies
from tapetum.models.prediction import Prediction
from tapetum.models.snr import crop_snr
from tapetum.models.state import MISMATCH, checked_state
from tapetum.models.training import Augmentation, EpochReport, TrainingSettings, kept_epoch, train
from tapetum.progress import Progress, quiet

__all__ = ["NetworkEstimator", "ResNet18"]

# Most frames per class that fit the novelty.
_FRAMES_A_CLASS = 500


class NetworkEstimator(Estimator):
    """A network on centred crops (paper, section 5), trained from scratch.

    Parameters
    ----------
    target
        "gaze", "focus", "device", "phone" (gaze and device), or names of labels.
    architecture
        One of `tapetum.models.architectures.ARCHITECTURES`; the paper's is "resnet18".
    crop, size
        The central `crop` x `crop` pixels of each image are averaged to `size` x `size`.
    hide
        Radius in pixels of a central disc that the network never sees, to test what it learns without the brightest
        spot.
    background
        How the background is subtracted, "root" or "level": see `tapetum.models.inputs.root_over_background`.
    epochs, batch, learning_rate, weight_decay, patience, precision
        See `tapetum.models.training.TrainingSettings`.
    gain, shift, noise
        See `tapetum.models.training.Augmentation`.
    seed
        Of the initial weights, the order of the images and the augmentation. Equal seeds give equal weights on the CPU
        of one machine with one number of threads and processes. On a GPU the last bits differ: its libraries choose
        algorithms by speed and do not fix the order of sums.
    calibration_fraction
        Share of the training frames, the last ones of each recording, that is held out: it shows the error after each
        epoch and sets the intervals. With `patience` the first half chooses the epoch whose weights are kept, and the
        second half sets the intervals.
    interpolate
        Interpolate the residuals of the training frames between frames that look alike (`tapetum.models.kernel`) where
        that errs less on the frames held out.
    device, processes
        "auto" (CUDA if present), "cpu" or "cuda"; and how many GPUs or processes train, "auto" for all GPUs. Not saved
        with a model.

    Attributes
    ----------
    network_
        The trained `tapetum.models.architectures.Network`.
    history_
        List of `tapetum.models.training.EpochReport` (empty after loading).
    classes_
        Names of the devices learned, sorted.
    temperature_
        Of the class probabilities, fitted to held-out frames: `tapetum.models.calibration`.
    novelty_
        `tapetum.models.novelty.Novelty`, or None without classes.
    kernel_
        `tapetum.models.kernel.ResidualKernel`, or None where residuals are not interpolated.

    Examples
    --------
    >>> from tapetum.data import open_dataset
    >>> dataset = open_dataset("rotation.zarr")  # doctest: +SKIP
    >>> model = NetworkEstimator(epochs=8).fit(dataset.tp.train, checkpoint="run", resume=True)  # doctest: +SKIP
    >>> model.predict(dataset.tp.test)["gaze_x"]  # doctest: +SKIP
    """

    kind: str = "resnet18"

    network_: Network
    history_: list[EpochReport]
    classes_: tuple[str, ...]
    temperature_: float
    novelty_: Novelty | None
    prior_: CopyPrior | None = None
    kernel_: ResidualKernel | None = None

    def __init__(
        self,
        target: str | Sequence[str] = "gaze",
        *,
        architecture: str = "resnet18",
        crop: int = 288,
        size: int = 96,
        hide: int = 0,
        background: str = "level",
        epochs: int = 12,
        batch: int = 32,
        learning_rate: float = 2e-3,
        weight_decay: float = 0.05,
        patience: int | None = None,
        precision: str = "float32",
        gain: float = 0.1,
        shift: float = 1.5,
        noise: float = 0.03,
        seed: int = 0,
        calibration_fraction: float = 0.1,
        interpolate: bool = False,
        device: str = "auto",
        processes: int | str = 1,
    ) -> None:
        self.kind = one_of(architecture, tuple(ARCHITECTURES), "architecture")
        self.target = target if isinstance(target, str) else tuple(target)
        self.target_names = target_names(self.target)
        self.quantities = quantities_of(self.target_names)
        self.crop, self.size, self.hide, self.seed = int(crop), int(size), int(hide), int(seed)
        if not 0 < self.size <= self.crop:
            raise InputError(f"must lie in 1 ... crop = {crop}, is {size}", where="size", remedy="96 of 288 is usual")
        if not 0 <= self.hide < self.crop / 2:
            raise InputError(f"must lie in 0 ... {crop / 2:g}, is {hide}", where="hide", remedy="0 hides nothing")
        self.background = one_of(background, BACKGROUNDS, "background")
        self.settings = TrainingSettings(
            int(epochs),
            int(batch),
            learning_rate,
            weight_decay,
            self.seed,
            Augmentation(gain, shift, noise),
            patience,
            precision,
        )
        self.calibration_fraction, self.interpolate = float(calibration_fraction), bool(interpolate)
        if interpolate and not (self.quantities and self.calibration_fraction):
            what = "needs frames held out" if self.quantities else "has no meaning for a device"
            remedy = "leave it out" + (", or hold some out, as is usual" if self.quantities else "")
            raise InputError(what, where="interpolate", remedy=remedy)
        self.data_hash_ = self.training_ = None
        self.device, self.processes = device, processes
        training_device(device)

    # A training needs gradients, whatever the caller's mode.
    @torch.inference_mode(mode=False)
    @torch.enable_grad()
    def fit(
        self,
        dataset: xr.Dataset,
        *,
        copies: xr.Dataset | None = None,
        progress: Progress = quiet,
        checkpoint: str | Path | None = None,
        resume: bool = False,
        on_epoch: Callable[[EpochReport], None] | None = None,
    ) -> Self:
        """Train on the training frames of a dataset; test frames are not used.

        Parameters
        ----------
        dataset
            From `tapetum.data.open_dataset` or `tapetum.data.dataset_from_arrays`.
        copies
            Training frames of further copies of the camera, with the variable `unit`. They train the layers before the
            last too; each copy has a last layer of its own, which is dropped in the end
            (`tapetum.models.own_layers`). Intervals and where the model applies are learned from `dataset` alone.
        progress
            Shown over the reading and over the steps of each epoch.
        checkpoint
            Folder for checkpoints; after an interruption it holds the last complete epoch.
        resume
            Continue from the checkpoint, if there is one; the result is that of an uninterrupted run.
        on_epoch
            Called with the report of every epoch.

        Raises
        ------
        InputError
            When there is too little to train on, the checkpoint is of another training, or copies cannot be used.
        """
        if resume and checkpoint is None:
            what = "resume needs the folder of a checkpoint"
            raise InputError(what, where="checkpoint", remedy="pass checkpoint=FOLDER")
        patience = self.settings.patience
        part = training_part(dataset, self.target_names, self.calibration_fraction, select=patience is not None)
        if copies is not None and part.classes:
            what = "frames of copies cannot train a model that recognises devices"
            raise InputError(what, where="copies", remedy="put them into the set")
        beside = None if copies is None else copies_of(copies, self.quantities)
        images, snr = self._read_part(part, progress)
        self._centre, self._spread = part.targets[part.fit].mean(axis=0), part.targets[part.fit].std(axis=0)
        self._unit = float(images[part.fit].std())
        if not self._unit > 0:
            raise InputError("all images are blank", where="dataset", remedy="check the exposure of the probe")
        images /= self._unit
        self.classes_ = part.classes
        k, device = len(self.quantities), training_device(self.device)
        columns = [(part.targets - self._centre) / self._spread]
        weights = part.weights
        if weights is not None:
            columns.append(weights)
        if part.camera is not None:
            columns.append(part.camera[:, None].astype(np.float64))
        fit = torch.from_numpy(part.fit)
        shown, wanted = images[fit], torch.from_numpy(np.concatenate(columns, axis=1)[part.fit].astype(np.float32))
        identity = {"kind": self.kind, **self.parameters(), "data": part.data_hash, "frames": len(part.targets)}
        if beside is None:
            network = ARCHITECTURES[self.kind](k + len(part.classes), seed=self.seed)
            loss = MixedLoss(k, weights is not None)
        else:
            shots, labels, number = beside
            more = self._map_batches(self._prepared, "reading the copies", shots, progress=progress)
            shown = torch.cat([shown, *(seen / self._unit for seen in more)])
            wanted = targets_beside(wanted, (labels - self._centre) / self._spread, number)
            network, loss = beside_copies(self.kind, k, number.max(), self.seed), OwnLayers(k, weights is not None)
            identity["copies"] = shots.tp.hash
        # Without patience no frame chooses, so the calibration frames show the error.
        aside = part.calibrate if patience is None else part.choose

        def validate(trained: nn.Module) -> float:
            outputs = self.run(trained, images[aside], device)
            if k:
                return float(np.abs(self._scaled(outputs) - part.targets[aside]).mean())
            assert part.camera is not None  # a model estimates one or the other
            return float((outputs.argmax(axis=1) != part.camera[aside]).mean())

        self.history_ = train(
            network,
            shown,
            wanted,
            self.settings,
            loss=loss,
            validate=validate if len(aside) else None,
            device=self.device,
            processes=self.processes,
            checkpoint=None if checkpoint is None else Path(checkpoint),
            resume=resume,
            identity=identity,
            progress=progress,
            on_epoch=on_epoch,
        )
        self.data_hash_, self.training_ = part.data_hash, part.summary
        if beside is not None:
            network = without_copies(network, k)
            self.training_["copies"] = {"copies": int(beside[2].max()), "frames": len(beside[2])}
        self.network_, self.prior_, self.kernel_ = network, None, None
        if beside is not None:
            self._learn_copies(shown[len(part.fit) :], *beside[1:])
        if patience is not None:
            kept = f"{kept_epoch(self.history_, patience)} of {len(self.history_)}"
            why = f"least error on {len(aside)} training frames that neither fit nor calibrate"
            self.training_["chosen"]["epochs"] = f"{kept}: {why}"
        self._calibrate(part, images, snr, device)
        # Those of another training are not of these weights.
        self.others_ = None
        self._describe(images, np.asarray(part.dataset["recording"].values))
        return self

    def describe(self, dataset: xr.Dataset, *, progress: Progress = quiet) -> Self:
        """Learn where the model applies from the training frames of a dataset, and change nothing else.

        For a model of an older version, which was saved without; the frames must be those that it was trained on.

        Raises
        ------
        InputError
            When the dataset lacks the model's labels or has too few training frames.
        """
        part = training_part(dataset, self.target_names, self.calibration_fraction)
        images, _ = self.read(part.dataset, progress=progress)
        self._describe(images, np.asarray(part.dataset["recording"].values))
        return self

    def learn_copies(self, copies: xr.Dataset, *, progress: Progress = quiet) -> Self:
        """Learn from frames of copies what they add to the last layer, and change nothing else.

        For a model of an older version; `adapt` begins from it where there are few frames.

        Raises
        ------
        InputError
            When the frames do not name their copy or lack the model's labels.
        """
        shots, labels, number = copies_of(copies, self.quantities)
        return self._learn_copies(self.read(shots, progress=progress)[0], labels, number)

    def _learn_copies(self, images: Tensor, labels: NDArray[np.float64], number: NDArray[np.int64]) -> Self:
        device = training_device(self.device)
        self.network_.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        features = self.run(self.network_.eval().features, images, device)
        weight, bias = (one.detach().double().cpu().numpy() for one in self.network_.head.parameters())
        left = (labels - self._centre) / self._spread - features @ weight.T - bias
        self.prior_ = fit_copy_prior(features, left, number)
        return self

    def _describe(self, images: Tensor, recording: NDArray[np.integer]) -> None:
        # The training frames are augmented as in training, but by a separate generator: the result must not depend on
        # the number of epochs.
        generator, varied = torch.Generator().manual_seed(self.seed), self.settings.augmentation
        seen = [picture_features(augment(some, varied, generator)) for some in images.split(self._batch)]
        self.domain_ = fit_domain(np.concatenate(seen), recording)

    def _calibrate(self, part: TrainingPart, images: Tensor, snr: NDArray[np.float64], device: torch.device) -> None:
        """Fit intervals, temperature and novelty to the held-out frames."""
        aside, k = part.calibrate, len(self.quantities)
        found = self.run(self.network_, images[aside], device)
        residuals = part.targets[aside] - self._scaled(found)
        if self.interpolate:
            residuals = self._interpolate(part, images, device)
        self.intervals_ = fit_intervals(residuals, snr[aside])
        self.temperature_, self.novelty_ = 1.0, None
        if part.camera is None:
            return
        self.temperature_ = fit_temperature(found[:, k:], part.camera[aside])
        own = part.camera[part.fit]
        few = np.concatenate([_spread_over(part.fit[own == c], _FRAMES_A_CLASS) for c in range(len(part.classes))])
        self.novelty_ = fit_novelty(
            self.run(self.network_.features, images[few], device),
            part.camera[few],
            len(part.classes),
            self.run(self.network_.features, images[aside], device),
        )

    def _interpolate(self, part: TrainingPart, images: Tensor, device: torch.device) -> NDArray[np.float64]:
        """Interpolate residuals where that pays; return what calibrates the intervals [n, K]."""
        features, k = self.run(self.network_.features, images, device), len(self.quantities)
        weight, bias = (one.detach().double().cpu().numpy()[:k] for one in self.network_.head.parameters())
        rest = (part.targets - self._centre) / self._spread - features @ weight.T - bias
        weights = None if part.weights is None else part.weights.mean(axis=1)
        calibrating = judged = left_out(features, images, rest, part.fit, part.calibrate, weights)
        if self.settings.patience is not None:
            # The frames that chose the epoch choose here too.
            judged = left_out(features, images, rest, part.fit, part.choose, weights)
        self.kernel_, why = interpolated(judged, calibrating, features, images, rest, weights)
        assert self.training_ is not None
        self.training_["chosen"]["residuals"] = why
        left, deviation = calibrating.under(self.kernel_)
        return left * self._spread / deviation[:, None]

    def _read_part(self, part: TrainingPart, progress: Progress) -> tuple[Tensor, NDArray[np.float64]]:
        """Return a part's prepared images, and the SNR of those that calibrate, which is NaN for the others.

        An image's SNR takes twice as long as its preparation.
        """
        wanted = np.isin(np.arange(len(part.targets)), part.calibrate)
        snr, places = np.full(len(wanted), np.nan), iter(np.arange(len(wanted)))

        def read(images: NDArray[np.generic], full_scale: float) -> Tensor:
            some = np.fromiter(itertools.islice(places, len(images)), np.intp, len(images))
            chosen = wanted[some]
            if chosen.any():
                snr[some[chosen]] = crop_snr(images[chosen], full_scale)
            return self._prepared(images, full_scale)

        return torch.cat(self._map_batches(read, "reading the images", part.dataset, progress=progress)), snr

    def _prepared(self, images: NDArray[np.generic], full_scale: float) -> Tensor:
        return prepare(images, self.crop, self.size, full_scale, self.hide, self.background)

    def _read(self, images: NDArray[np.generic], full_scale: float) -> tuple[Tensor, NDArray[np.float64]]:
        """Return prepared images [N, 1, size, size] and their SNR [N]."""
        return self._prepared(images, full_scale), crop_snr(images, full_scale)

    def run(self, network: Callable[[Tensor], Tensor], images: Tensor, device: torch.device) -> NDArray[np.float64]:
        """Return a network's outputs [N, ...] for prepared and scaled images."""
        with torch.inference_mode():
            found = [
                network(batch.to(device).contiguous(memory_format=torch.channels_last)).double().cpu().numpy()
                for batch in images.split(self._batch)
            ]
        return np.concatenate(found)

    def _scaled(self, found: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the quantities [N, K] in their units."""
        return found[:, : len(self.quantities)] * self._spread + self._centre

    @property
    def unit(self) -> float:
        """Standard deviation of the training images' pixels, by which `read` divides."""
        self._check_fitted()
        return self._unit

    @property
    def scaling(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Mean and standard deviation of the quantities, [K] each, in which the last layer counts them."""
        self._check_fitted()
        return self._centre, self._spread

    def read(self, dataset: xr.Dataset, *, progress: Progress = quiet) -> tuple[Tensor, NDArray[np.float64]]:
        """Return a dataset's images as the fitted network takes them, [N, 1, size, size], and their SNR [N]."""
        found = self._map_batches(self._read, "reading the images", dataset, progress=progress)
        return torch.cat([seen for seen, _ in found]) / self.unit, np.concatenate([one for _, one in found])

    def _progress_label(self) -> str:
        return ARCHITECTURES[self.kind].title

    def _estimate(self, images: NDArray[np.generic], full_scale: float, own: bool = True) -> Prediction:
        self._check_fitted()
        device, k = training_device(self.device), len(self.quantities)
        self.network_.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.network_.eval()
        seen = self._prepared(images, full_scale) / self._unit
        # The network runs once, for the features and for the outputs of its last layer.
        features = self.run(self.network_.features, seen, device)
        weight, bias = (one.detach().double().cpu().numpy() for one in self.network_.head.parameters())
        found = features @ weight.T + bias
        added, deviation = (0.0, None) if self.kernel_ is None else self.kernel_(features, seen)
        return self._prediction(
            self._scaled(found[:, :k] + added),
            lambda: crop_snr(images, full_scale),
            None if self.domain_ is None else self.domain_(picture_features(seen)),
            probabilities(found[:, k:], self.temperature_) if self.classes_ else None,
            None if self.novelty_ is None else self.novelty_(features),
            own,
            deviation,
        )

    def parameters(self) -> dict[str, Any]:
        """Return the arguments of ``__init__`` for JSON, except device, processes and architecture (see `kind`)."""
        settings = asdict(self.settings)
        varied = settings.pop("augmentation")
        own = {name: getattr(self, name) for name in ("crop", "size", "hide", "background", "calibration_fraction")}
        # Named only where it is true, see `tapetum.models.card`.
        own |= {"interpolate": True} if self.interpolate else {}
        return {"target": plain_target(self.target), **own, **settings, **varied}

    def state(self) -> dict[str, Tensor]:
        """Return everything that was learned: weights under the architecture's usual names, and ``scaling.*``."""
        self._check_fitted()
        learned = {name: tensor.detach().cpu().clone() for name, tensor in self.network_.state_dict().items()}
        scaling = {"centre": self._centre, "spread": self._spread, "unit": [self._unit]}
        if self.classes_:
            scaling["temperature"] = [self.temperature_]
        for name, values in scaling.items():
            learned[f"scaling.{name}"] = torch.from_numpy(np.array(values, dtype=np.float64))
        learned |= self.intervals_.state("scaling.")
        learned |= {} if self.others_ is None else self.others_.state(OTHER)
        for one in (self.novelty_, self.domain_, self.prior_, self.kernel_):
            learned |= {} if one is None else one.state()
        return learned

    def classes(self) -> tuple[str, ...]:
        return self.classes_

    @classmethod
    def from_state(
        cls,
        parameters: Mapping[str, Any],
        state: Mapping[str, Tensor],
        classes: tuple[str, ...] = (),
        *,
        architecture: str = "resnet18",
    ) -> Self:
        """Rebuild a fitted model of an architecture from the results of `parameters`, `state` and `classes`."""
        # Older cards do not name the background.
        model = cls(**{"background": "root", **parameters, "architecture": architecture})
        k = len(model.quantities)
        if (DEVICE in model.target_names) != bool(classes):
            what = f"expected {'names' if not classes else 'no names'} of devices"
            raise InputError(what, where="card", remedy=MISMATCH)
        shapes: dict[str, tuple[int, ...]] = {"centre": (k,), "spread": (k,), "unit": (1,)}
        if classes:
            shapes["temperature"] = (1,)
        scaling = checked_state(state, shapes, "scaling.")
        # On the meta device no random initial weights are drawn, which would take most of the time.
        with torch.device("meta"):
            network = ARCHITECTURES[architecture](k + len(classes))
        # As copies, so that no later training changes `state`; in the network's precision, as weights may be half.
        layers = network.state_dict()
        own = {name: state[name].to(one.dtype, copy=True) for name, one in layers.items() if name in state}
        try:
            network.load_state_dict(own, assign=True)
        except RuntimeError as error:
            what = f"weights do not fit a {network.title} of this card"
            raise InputError(what, where="weights", remedy=MISMATCH) from error
        model.network_, model.history_, model.classes_ = network.eval(), [], classes
        model._centre, model._spread = scaling["centre"], scaling["spread"]
        model._unit = float(scaling["unit"][0])
        model.temperature_ = float(scaling["temperature"][0]) if classes else 1.0
        model.intervals_ = Intervals.from_state(state, k, "scaling.")
        model.others_ = Intervals.from_state(state, k, OTHER) if has_intervals(state, OTHER) else None
        model.novelty_ = Novelty.from_state(state, len(classes), network.width) if classes else None
        model.domain_ = Domain.from_state(state, picture_width())
        model.prior_ = CopyPrior.from_state(state, k, network.width)
        model.kernel_ = ResidualKernel.from_state(state, k, network.width)
        return model


class ResNet18(NetworkEstimator):
    """The paper's architecture."""


def _spread_over(places: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Return at most `most` of the places, evenly spread."""
    return places[:: -(-len(places) // most)]
