"""Settings of a training, and the report of each epoch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from tapetum.errors import InputError, one_of
from tapetum.models.augmentation import Augmentation

__all__ = ["EpochReport", "TrainingSettings", "kept_epoch", "learning_rate", "out_of_patience"]

PRECISIONS = ("float32", "bf16")


@dataclass(frozen=True)
class TrainingSettings:
    """How to train.

    Parameters
    ----------
    epochs, batch
        Passes over the training images, and images per step over all processes.
    learning_rate
        Peak of AdamW's rate, which rises over the first fifth of the steps and falls to zero along a cosine.
    weight_decay
        Of AdamW, on matrices and convolutions only.
    seed
        Of the order of the images and the augmentation. Each epoch has its own random stream, so that a resumed run
        repeats an uninterrupted one.
    augmentation
        See `Augmentation`.
    patience
        Stop after so many epochs without a lower held-out error, and keep the weights of the best epoch. None runs all
        epochs and keeps the last. The cosine spans `epochs` either way.
    precision
        "float32", or "bf16": products in bfloat16 (torch's autocast), weights and loss in float32; where the device has
        no bfloat16, all in float32, which is faster there.
    """

    epochs: int = 12
    batch: int = 32
    learning_rate: float = 2e-3
    weight_decay: float = 0.05
    seed: int = 0
    augmentation: Augmentation = field(default_factory=Augmentation)
    patience: int | None = None
    precision: str = "float32"

    def __post_init__(self) -> None:
        for name in ("epochs", "batch", "learning_rate", "patience"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"must be positive, is {value}", where=name)
        if self.batch < 2:
            raise InputError("batch normalisation needs 2 images or more", where="batch")
        if self.seed < 0:
            raise InputError(f"must not be negative, is {self.seed}", where="seed")
        one_of(self.precision, PRECISIONS, "precision")


@dataclass(frozen=True)
class EpochReport:
    """The result of an epoch.

    Parameters
    ----------
    epoch, epochs
        Number of the epoch, from 1, and of the last.
    loss
        Mean training loss.
    validation_mae
        MAE on the held-out frames in the targets' units, averaged over targets, or whatever `validate` returned; None
        without held-out frames.
    seconds
        Duration, validation included.
    images_per_second
        Training images per second over all processes, validation excluded.
    busy
        Share of time in which a kernel ran on the first GPU, over a few steps of one epoch (`tapetum.models.busy`);
        None in other epochs and on a CPU.
    best
        Whether the held-out error is lower than in all epochs before.
    """

    epoch: int
    epochs: int
    loss: float
    validation_mae: float | None
    seconds: float
    images_per_second: float = 0.0
    busy: float | None = None
    best: bool = False


def kept_epoch(history: Sequence[EpochReport], patience: int | None) -> int:
    """Return the number, from 1, of the epoch whose weights are kept: the last, or with patience the best."""
    if patience is None:
        return len(history)
    return max((report.epoch for report in history if report.best), default=len(history))


def out_of_patience(history: Sequence[EpochReport], patience: int | None) -> bool:
    """Return whether at least `patience` epochs have passed since the best one."""
    return patience is not None and len(history) - kept_epoch(history, patience) >= patience


def learning_rate(step: int, steps: int, highest: float) -> float:
    """Return the learning rate: a rising cosine over the first fifth of the steps, a falling cosine over the rest."""
    rise = max(1, steps // 5)
    if step < rise:
        return highest * (0.04 + 0.96 * 0.5 * (1 - math.cos(math.pi * (step + 1) / rise)))
    return highest * 0.5 * (1 + math.cos(math.pi * (step - rise + 1) / (steps - rise + 1)))
