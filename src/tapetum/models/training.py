"""Resumable training in epochs, on CPU or GPUs; a checkpoint holds the last whole one."""

from __future__ import annotations

import contextlib
import copy
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import InitVar, asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tapetum.errors import InputError
from tapetum.models.augmentation import Augmentation, augment
from tapetum.models.busy import BusySample
from tapetum.models.checkpoint import (
    CHECKPOINT,
    HISTORY,
    KeptEpoch,
    TrainingState,
    read_checkpoint,
    remove_checkpoint,
)
from tapetum.models.devices import companions, make_fabric, process_count, training_device
from tapetum.models.epochs import EpochReport, TrainingSettings, kept_epoch, learning_rate, out_of_patience
from tapetum.models.losses import SmoothL1
from tapetum.models.steps import RecordedStep, Step, set_rate
from tapetum.progress import Progress, quiet

if TYPE_CHECKING:
    from lightning_fabric import Fabric

__all__ = [
    "CHECKPOINT",
    "HISTORY",
    "Augmentation",
    "EpochReport",
    "Loss",
    "SmoothL1",
    "TrainingSettings",
    "augment",
    "kept_epoch",
    "remove_checkpoint",
    "train",
]

Loss = Callable[[Tensor, Tensor], Tensor]


def train(
    network: nn.Module,
    images: Tensor,
    targets: Tensor,
    settings: TrainingSettings,
    *,
    loss: Loss = SmoothL1(),
    validate: Callable[[nn.Module], float] | None = None,
    device: str | torch.device = "auto",
    processes: int | str = 1,
    checkpoint: Path | None = None,
    resume: bool = False,
    identity: Mapping[str, Any] | None = None,
    progress: Progress = quiet,
    on_epoch: Callable[[EpochReport], None] | None = None,
) -> list[EpochReport]:
    """Train a network in place.

    Several processes split every batch and add up their gradients: batches, steps and learning rates are those of one
    process, and without augmentation so is the result, to rounding. With augmentation each process has its own random
    numbers. On GPUs batch normalisation averages over the whole batch; on a CPU each process averages over its own
    part, and the first one's running mean is kept.

    Parameters
    ----------
    network
        Maps [N, C, H, W] to [N, O].
    images
        [N, C, H, W], standardised, float32, on the CPU.
    targets
        [N, ...], standardised values or classes, as `loss` takes them.
    settings
        How to train.
    loss
        ``loss(output, target)``, a mean over the images. Several processes need one that can be pickled; on a GPU it
        must not read numbers back, as `item` does, because its kernels are recorded (`tapetum.models.steps`).
    validate
        Returns the validation error (lower is better) of the network in evaluation mode. Called in this process only.
    device
        "auto" (CUDA where there is one), "cpu", "cuda" or "cuda:1". The network stays there.
    processes
        GPUs, or processes on the CPU, that train. "auto" takes every GPU, on a CPU one.
    checkpoint
        Folder that gets checkpoint.safetensors and history.json, each complete or not at all: after every epoch where
        epochs take seconds, else every few seconds, and when the training ends or is stopped (`KeptEpoch`).
    resume
        Continue from the checkpoint in that folder, if there is one, with any number of processes.
    identity
        JSON values that identify the training besides `settings` (data hash, input size); a checkpoint of another
        identity is refused.
    progress
        Shown over the steps of each epoch.
    on_epoch
        Called with the report of every epoch, after its checkpoint.

    Returns
    -------
    list of EpochReport
        Of all epochs, those before a resumption included; `kept_epoch` returns the one whose weights are kept.

    Raises
    ------
    InputError
        When the checkpoint is damaged, of another version or training, the training diverges, or there is no such
        device.
    """
    device = training_device(device)
    count = process_count(processes, device)
    if settings.patience is not None and validate is None:
        raise InputError("stopping early needs frames to watch", where="patience", remedy="keep some aside")
    if min(settings.batch, len(images)) < 2 * count:
        what = f"a batch of {min(settings.batch, len(images))} images leaves fewer than 2 to each of {count} processes"
        raise InputError(what, where="processes" if count > 1 else "images", remedy="use larger batches or more images")
    about = json.loads(json.dumps({"settings": asdict(settings), "identity": dict(identity or {})}))
    start = checkpoint if resume and checkpoint is not None and (checkpoint / CHECKPOINT).exists() else None
    work = (settings, loss, about, start)
    calls = {"checkpoint": checkpoint, "validate": validate, "progress": progress, "on_epoch": on_epoch}
    if count == 1:
        alone = make_fabric(device, settings.precision)
        network.to(device=alone.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        return _Training(alone, network, images, targets, *work, **calls).run()
    # The others get the network's structure; its weights are broadcast from here.
    sent = (copy.deepcopy(network).to("meta"), images.numpy(), targets.numpy())
    with companions(count, device, settings.precision, _take_part, *sent, *work) as first:
        network.to(device=first.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        # Fabric may wrap and replace parts of the copy, not of the caller's network.
        copied = copy.deepcopy(network)
        history = _Training(first, copied, images, targets, *work, **calls).run()
        network.load_state_dict(copied.state_dict())
    network.eval()
    return history


def _take_part(
    ours: Fabric, network: nn.Module, images: NDArray[np.float32], targets: NDArray[np.generic], *work: Any
) -> None:
    """Run as one of the other processes, which only compute."""
    network = network.to_empty(device=ours.device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    _Training(ours, network, torch.from_numpy(images), torch.from_numpy(targets), *work).run()


@dataclass
class _Training:
    """The training loop of one process; only the first process has callbacks."""

    fabric: Fabric
    network: InitVar[nn.Module]
    images: Tensor
    targets: Tensor
    settings: TrainingSettings
    loss: Loss
    about: dict[str, Any]
    start: InitVar[Path | None]
    checkpoint: Path | None = None
    validate: Callable[[nn.Module], float] | None = None
    progress: Progress = quiet
    on_epoch: Callable[[EpochReport], None] | None = None

    def __post_init__(self, network: nn.Module, start: Path | None) -> None:
        self.images, self.targets = (_near(tensor, self.fabric.device) for tensor in (self.images, self.targets))
        self.per_epoch = max(1, len(self.images) // self.settings.batch)
        if self.fabric.world_size > 1 and self.fabric.device.type == "cuda":
            network = nn.SyncBatchNorm.convert_sync_batchnorm(network)
        self.state = TrainingState(network, _optimiser(network, self.settings), None, [])
        if start is not None:
            read_checkpoint(start, self.state, self.about)
        self.module, self.optimiser = self.fabric.setup(network, self.state.optimiser)
        self.step = self._step()

    def run(self) -> list[EpochReport]:
        state, settings = self.state, self.settings
        kept = None if self.checkpoint is None else KeptEpoch(self.checkpoint, state, self.about)
        with kept or contextlib.nullcontext():
            while not self._ended():
                report = self._epoch(len(state.history))
                state.history.append(report)
                if settings.patience is not None and report.best and self.fabric.is_global_zero:
                    state.best = {name: one.detach().cpu().clone() for name, one in state.network.state_dict().items()}
                if kept is not None:
                    kept.keep(last=self._ended())
                if self.on_epoch is not None:
                    self.on_epoch(report)
        if state.best is not None:
            state.network.load_state_dict(state.best)
        state.network.eval()
        return state.history

    def _ended(self) -> bool:
        history, settings = self.state.history, self.settings
        return len(history) >= settings.epochs or out_of_patience(history, settings.patience)

    def _epoch(self, number: int) -> EpochReport:
        settings, network, history = self.settings, self.state.network, self.state.history
        start = time.perf_counter()
        network.train()
        # Sampling each epoch would cost time, and the first epoch is slower than the others.
        measured = self.fabric.device.type == "cuda" and number == min(1, settings.epochs - 1)
        busy = BusySample(self.fabric.device, self.per_epoch // 2 if measured else -1)
        total = self._steps(number, busy)
        trained = time.perf_counter() - start
        network.eval()
        error = None
        if self.validate is not None:
            error = float(self.validate(network))
        error = self.fabric.broadcast(error)
        if not (math.isfinite(total) and (error is None or math.isfinite(error))):
            what = "training diverged: the loss is not finite"
            raise InputError(what, where="learning_rate", remedy="choose a lower one")
        lowest = min((r.validation_mae for r in history if r.validation_mae is not None), default=math.inf)
        return EpochReport(
            number + 1,
            settings.epochs,
            loss=total / len(self.images),
            validation_mae=error,
            seconds=time.perf_counter() - start,
            images_per_second=len(self.images) / trained,
            busy=busy.share,
            best=error is not None and error < lowest,
        )

    def _steps(self, epoch: int, busy: BusySample) -> float:
        """Train one epoch; return the sum of the images' losses."""
        settings, step, count, steps = self.settings, self.step, len(self.images), self.per_epoch
        rank, ranks = self.fabric.global_rank, self.fabric.world_size
        order = torch.randperm(count, generator=_generator("cpu", settings.seed, epoch, 0)).to(self.images.device)
        step.varied.manual_seed(_seed(settings.seed, epoch, 1 + rank))
        # Summed on the device: reading a number from a GPU waits for it.
        step.total.zero_()
        label = f"epoch {epoch + 1}/{settings.epochs}{_last_error(self.state.history)}"
        with step.stream():
            for k in self.progress(range(steps), label, total=steps):
                busy.before(k)
                # Batch sizes differ by at most one, so that all images are used.
                batch = order[k * count // steps : (k + 1) * count // steps]
                chosen = batch[rank::ranks]
                set_rate(
                    self.optimiser, learning_rate(epoch * steps + k, steps * settings.epochs, settings.learning_rate)
                )
                # Gradients are averaged with equal weight, while parts of a batch may differ by an image.
                step(chosen, len(chosen) * ranks / len(batch))
            busy.end()
            # Waits for the last step.
            return float(self.fabric.all_reduce(step.total, reduce_op="sum"))  # type: ignore[arg-type]

    def _step(self) -> Step:
        """The step of this process, recorded where one GPU holds all images."""
        device = self.fabric.device
        parts = self.fabric, self.module, self.optimiser, self.loss, self.images, self.targets
        varied = torch.Generator(device)
        total = torch.zeros((), dtype=torch.float64, device=device)
        alone = device.type == "cuda" and self.fabric.world_size == 1 and self.images.is_cuda and self.targets.is_cuda
        return (RecordedStep if alone else Step)(*parts, self.settings.augmentation, varied, total)


def _seed(*key: int) -> int:
    """Return the seed of a random stream of its own for every key."""
    return int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0])


def _generator(device: str | torch.device, *key: int) -> torch.Generator:
    """Return a random generator with its own stream for every key."""
    return torch.Generator(device).manual_seed(_seed(*key))


def _near(tensor: Tensor, device: torch.device) -> Tensor:
    """Return the tensor on the GPU if it has room, else unchanged."""
    if device.type != "cuda":
        return tensor
    free, _ = torch.cuda.mem_get_info(device)
    return tensor.to(device) if tensor.nbytes < free / 2 else tensor


def _last_error(history: list[EpochReport]) -> str:
    error = history[-1].validation_mae if history else None
    return "" if error is None else f", error {error:.4f}"


def _optimiser(network: nn.Module, settings: TrainingSettings) -> torch.optim.AdamW:
    matrices = [p for p in network.parameters() if p.ndim >= 2]
    vectors = [p for p in network.parameters() if p.ndim < 2]
    groups = [{"params": matrices, "weight_decay": settings.weight_decay}, {"params": vectors, "weight_decay": 0.0}]
    # On a GPU the rate is a tensor, which recorded steps read.
    on_gpu = any(parameter.is_cuda for parameter in vectors + matrices)
    rate = torch.tensor(settings.learning_rate, device=vectors[0].device) if on_gpu else settings.learning_rate
    # Fused: one pass over 11 million weights instead of a dozen, 2 to 5 times faster on the CPU.
    return torch.optim.AdamW(groups, lr=rate, fused=True, capturable=on_gpu)
