"""ResNet-18 as an estimator: from centred crops to gaze, or any other label, with intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch
import torch.nn.functional as F
import xarray as xr
from numpy.typing import NDArray
from torch import Tensor, nn

from tapetum.errors import InputError
from tapetum.models.base import (
    Data,
    Prediction,
    batches,
    checked_state,
    conformal_half_width,
    frame_count,
    target_names,
    training_part,
)
from tapetum.models.network import ResNet18Network
from tapetum.models.training import Augmentation, EpochReport, TrainingSettings, train
from tapetum.progress import Progress, quiet

__all__ = ["ResNet18", "prepare"]

_BATCH = 64


def prepare(images: NDArray[np.generic], crop: int, size: int, full_scale: float) -> Tensor:
    """Turn crops into what the network sees.

    The central `crop` x `crop` pixels, averaged over areas to `size` x `size`, square root of the intensity
    (shot noise then has the same spread everywhere), less the root of the image's median: the background
    becomes 0 whatever its level, the brightness of the RR, which tells of its distance from the axis, stays.

    Parameters
    ----------
    images
        [N, side, side], counts.
    crop, size
        Pixels along an edge, of what is used and of what comes out.
    full_scale
        Count that becomes 1.

    Returns
    -------
    Tensor
        [N, 1, size, size], float32, about -0.1 ... 1.

    Raises
    ------
    InputError
        When the crops are smaller than `crop`, negative or not finite.
    """
    side = images.shape[1]
    if crop > side:
        what = f"the model looks at {crop} pixels, the crops have {side}"
        raise InputError(what, where="images", remedy=f"cut crops of at least {crop} pixels")
    edge = (side - crop) // 2
    cut = np.ascontiguousarray(images[:, edge : edge + crop, edge : edge + crop])
    if cut.dtype.kind != "u" and not (np.isfinite(cut).all() and cut.min(initial=0) >= 0):
        raise InputError("intensities must be finite and not negative", where="images", remedy="clip them at 0")
    cut = cut if cut.dtype == np.uint8 else cut.astype(np.float32)
    small = F.interpolate(torch.from_numpy(cut)[:, None].float(), size=(size, size), mode="area") / full_scale
    background = small.flatten(1).median(dim=1).values[:, None, None, None]
    return small.sqrt() - background.sqrt()


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError(
            f"no device is called {name!r}", where="device", remedy='use "auto", "cpu" or "cuda"'
        ) from error


class ResNet18:
    """ResNet-18 on centred crops (paper, section 5), trained from scratch.

    Parameters
    ----------
    target
        "gaze", "focus", or names of labels.
    crop, size
        The central `crop` x `crop` pixels of each image are reduced to `size` x `size` for the network.
    epochs, batch, learning_rate, weight_decay
        See `tapetum.models.training.TrainingSettings`.
    gain, shift, noise
        See `tapetum.models.training.Augmentation`.
    seed
        Of the initial weights, the order of the images and the augmentation. Equal seeds give equal weights
        on one machine with one number of threads.
    calibration_fraction
        Share of the training frames, the last ones of each recording, that is kept out of the fit: it shows
        the error after each epoch and sets the intervals. The weights kept are always the last epoch's, never
        the best on these frames.
    device
        "auto" (CUDA where there is one), "cpu" or "cuda". Not part of a saved model.

    Attributes
    ----------
    network_
        The trained `tapetum.models.network.ResNet18Network`.
    history_
        List of `tapetum.models.training.EpochReport` (empty after loading).
    half_width_
        [K] half-widths of the intervals: split-conformal, see `tapetum.models.base.conformal_half_width`.
    data_hash_
        Hash of the dataset fitted to, where known.

    Examples
    --------
    >>> from tapetum.data import open_dataset
    >>> dataset = open_dataset("rotation.zarr")  # doctest: +SKIP
    >>> model = ResNet18(epochs=8).fit(dataset.tp.train, checkpoint="run", resume=True)  # doctest: +SKIP
    >>> model.predict(dataset.tp.test)["gaze_x"]  # doctest: +SKIP
    """

    kind: ClassVar[str] = "resnet18"

    network_: ResNet18Network
    history_: list[EpochReport]
    half_width_: NDArray[np.float64]
    data_hash_: str | None

    def __init__(
        self,
        target: str | Sequence[str] = "gaze",
        *,
        crop: int = 288,
        size: int = 96,
        epochs: int = 12,
        batch: int = 32,
        learning_rate: float = 2e-3,
        weight_decay: float = 0.05,
        gain: float = 0.1,
        shift: float = 1.5,
        noise: float = 0.03,
        seed: int = 0,
        calibration_fraction: float = 0.1,
        device: str = "auto",
    ) -> None:
        self.target = target if isinstance(target, str) else tuple(target)
        self.target_names = target_names(self.target)
        self.crop, self.size, self.seed = int(crop), int(size), int(seed)
        if not 0 < self.size <= self.crop:
            raise InputError(f"must lie in 1 ... crop = {crop}, is {size}", where="size", remedy="96 of 288 is usual")
        self.settings = TrainingSettings(
            int(epochs), int(batch), learning_rate, weight_decay, self.seed, Augmentation(gain, shift, noise)
        )
        self.calibration_fraction = float(calibration_fraction)
        self.data_hash_ = None
        self.device = device
        _device(device)

    def fit(
        self,
        dataset: xr.Dataset,
        *,
        progress: Progress = quiet,
        checkpoint: str | Path | None = None,
        resume: bool = False,
        on_epoch: Callable[[EpochReport], None] | None = None,
    ) -> Self:
        """Train on the training frames of a dataset; frames marked for testing are left alone.

        Parameters
        ----------
        dataset
            From `tapetum.data.open_dataset` or `tapetum.data.dataset_from_arrays`.
        progress
            Shown over the reading and over the steps of each epoch.
        checkpoint
            Folder for a checkpoint after every epoch. After Ctrl-C or a kill it holds the last whole epoch.
        resume
            Go on from the checkpoint, if there is one; the result is that of a run without a break.
        on_epoch
            Called with the report of every epoch.

        Returns
        -------
        ResNet18
            Itself.

        Raises
        ------
        InputError
            When there is too little to train on, or the checkpoint is of another training.
        """
        if resume and checkpoint is None:
            raise InputError(
                "resume needs the folder of a checkpoint", where="checkpoint", remedy="pass checkpoint=FOLDER"
            )
        part = training_part(dataset, self.target_names, self.calibration_fraction)
        images = self._inputs(part.dataset, None, progress)
        centre, spread = part.targets[part.fit].mean(axis=0), part.targets[part.fit].std(axis=0)
        if not (spread > 0).all():
            stuck = self.target_names[int(np.argmin(spread))]
            raise InputError(f"{stuck} never changes: nothing to learn", where="dataset", remedy="record more of it")
        self._centre, self._spread = centre, spread
        self._unit = float(images[part.fit].std())
        if not self._unit > 0:
            raise InputError("all images are blank", where="dataset", remedy="check the exposure of the probe")
        images /= self._unit
        network = ResNet18Network(len(self.target_names), seed=self.seed)
        aside, device = part.calibrate, _device(self.device)
        scaled = torch.from_numpy(((part.targets - centre) / spread).astype(np.float32))

        def validate(trained: nn.Module) -> float:
            return float(np.abs(self._run(trained, images[aside], device) - part.targets[aside]).mean())

        identity = {**self.parameters(), "data": part.data_hash, "frames": len(part.targets)}
        fit = torch.from_numpy(part.fit)
        self.history_ = train(
            network,
            images[fit],
            scaled[fit],
            self.settings,
            validate=validate if len(aside) else None,
            device=device,
            checkpoint=None if checkpoint is None else Path(checkpoint),
            resume=resume,
            identity=identity,
            progress=progress,
            on_epoch=on_epoch,
        )
        residuals = part.targets[aside] - self._run(network, images[aside], device)
        self.network_, self.half_width_ = network, conformal_half_width(residuals)
        self.data_hash_ = part.data_hash
        return self

    def _inputs(self, data: Data, full_scale: float | None, progress: Progress) -> Tensor:
        total = -(-frame_count(data) // _BATCH)
        parts = [
            prepare(images, self.crop, self.size, depth)
            for images, depth in progress(batches(data, full_scale, _BATCH), "reading the images", total=total)
        ]
        return torch.cat(parts) if parts else torch.empty(0, 1, self.size, self.size)

    def _run(self, network: nn.Module, images: Tensor, device: torch.device) -> NDArray[np.float64]:
        """Return the estimates [N, K] for prepared and scaled images."""
        found = [np.empty((0, len(self.target_names)))]
        with torch.inference_mode():
            for batch in images.split(_BATCH):
                output = network(batch.to(device).contiguous(memory_format=torch.channels_last))
                found.append(output.double().cpu().numpy() * self._spread + self._centre)
        return np.concatenate(found)

    def predict(self, data: Data, *, full_scale: float | None = None, progress: Progress = quiet) -> Prediction:
        """Estimate the target for every image.

        Parameters
        ----------
        data
            A dataset or crops [N, side, side], centred as those of the training were.
        full_scale
            Largest count of the camera, for crops that are not uint8.
        progress
            Shown over the batches.

        Returns
        -------
        Prediction

        Raises
        ------
        InputError
            When the model is not fitted or the images do not fit it.
        """
        if not hasattr(self, "network_"):
            raise InputError("the model is not fitted", where="ResNet18", remedy="call fit or load_model first")
        device = _device(self.device)
        self.network_.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.network_.eval()
        total = -(-frame_count(data) // _BATCH)
        found = [
            self._run(self.network_, prepare(images, self.crop, self.size, depth) / self._unit, device)
            for images, depth in progress(batches(data, full_scale, _BATCH), "ResNet-18", total=total)
        ]
        value = np.concatenate(found) if found else np.empty((0, len(self.target_names)))
        return Prediction(self.target_names, value, value - self.half_width_, value + self.half_width_)

    def parameters(self) -> dict[str, Any]:
        """Return the arguments of ``__init__``, fit for JSON, without the device."""
        settings, varied = self.settings, self.settings.augmentation
        return {
            "target": self.target if isinstance(self.target, str) else list(self.target),
            "crop": self.crop,
            "size": self.size,
            "epochs": settings.epochs,
            "batch": settings.batch,
            "learning_rate": settings.learning_rate,
            "weight_decay": settings.weight_decay,
            "gain": varied.gain,
            "shift": varied.shift,
            "noise": varied.noise,
            "seed": self.seed,
            "calibration_fraction": self.calibration_fraction,
        }

    def state(self) -> dict[str, Tensor]:
        """Return everything that was learned: weights under torchvision's names, and ``scaling.*``."""
        if not hasattr(self, "network_"):
            raise InputError("the model is not fitted", where="ResNet18", remedy="call fit first")
        learned = {name: tensor.detach().cpu().clone() for name, tensor in self.network_.state_dict().items()}
        scaling = {
            "centre": self._centre,
            "spread": self._spread,
            "half_width": self.half_width_,
            "unit": [self._unit],
        }
        for name, values in scaling.items():
            learned[f"scaling.{name}"] = torch.from_numpy(np.array(values, dtype=np.float64))
        return learned

    @classmethod
    def from_state(cls, parameters: Mapping[str, Any], state: Mapping[str, Tensor]) -> Self:
        """Make a fitted model of what `parameters` and `state` returned."""
        model = cls(**parameters)
        k = len(model.target_names)
        shapes = {
            "scaling.centre": (k,),
            "scaling.spread": (k,),
            "scaling.half_width": (k,),
            "scaling.unit": (1,),
        }
        scaling = checked_state(state, shapes)
        network = ResNet18Network(k)
        try:
            network.load_state_dict({n: t for n, t in state.items() if not n.startswith("scaling.")})
        except RuntimeError as error:
            remedy = "the model's card and its weights do not belong together"
            raise InputError("weights do not fit a ResNet-18 of this card", where="weights", remedy=remedy) from error
        model.network_, model.history_ = network.eval(), []
        model._centre, model._spread = scaling["scaling.centre"], scaling["scaling.spread"]
        model.half_width_, model._unit = scaling["scaling.half_width"], float(scaling["scaling.unit"][0])
        return model
