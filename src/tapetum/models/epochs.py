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
    epochs
        Passes over the training images.
    batch
        Images a step, over all processes together.
    learning_rate
        Of AdamW, at its highest: it rises over the first fifth of the steps and falls to nothing along a
        cosine.
    weight_decay
        Of AdamW, on matrices and convolutions only.
    seed
        Of the order of the images and the augmentation. Epoch e draws from its own stream, so a resumed run
        repeats an uninterrupted one.
    augmentation
        See `Augmentation`.
    patience
        Stop after so many epochs without a lower held-out error, and keep the weights of the epoch with the
        lowest. Where left out, all epochs are run and the last one's weights kept. The learning rate's cosine
        spans `epochs` either way.
    precision
        "float32", or "bf16": the network's products in bfloat16 (torch's autocast), weights and loss in
        float32.
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
        Its number, from 1, and how many there will be at most.
    loss
        Mean training loss.
    validation_mae
        Mean absolute error on the frames kept out of the fit, in the targets' units, mean over targets; None
        without. Whatever `validate` returned, where that is another measure.
    seconds
        Time it took, validation included.
    images_per_second
        Images trained on a second, validation left out, all processes together.
    busy
        Share of the time in which a kernel ran on the first GPU, over a few steps in the middle of the epoch;
        see `tapetum.models.busy`. Measured in one epoch of a training, None in the others and on a CPU.
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
    """Return the number, from 1, of the epoch whose weights a training leaves: the last, or with patience the best."""
    if patience is None:
        return len(history)
    return max((report.epoch for report in history if report.best), default=len(history))


def out_of_patience(history: Sequence[EpochReport], patience: int | None) -> bool:
    """Whether `patience` epochs or more have passed since the best one."""
    return patience is not None and len(history) - kept_epoch(history, patience) >= patience


def learning_rate(step: int, steps: int, highest: float) -> float:
    """Return the learning rate: a cosine up over the first fifth, a cosine down over the rest."""
    rise = max(1, steps // 5)
    if step < rise:
        return highest * (0.04 + 0.96 * 0.5 * (1 - math.cos(math.pi * (step + 1) / rise)))
    return highest * 0.5 * (1 + math.cos(math.pi * (step - rise + 1) / (steps - rise + 1)))
