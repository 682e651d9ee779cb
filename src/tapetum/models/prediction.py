"""What every estimator gives: values with intervals, classes with probabilities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

__all__ = ["COVERAGE", "NONE_OF_THESE", "Prediction", "joined"]

COVERAGE = 0.9
"""Share of true values that the intervals are meant to hold."""

NONE_OF_THESE = "none of these"
"""The device of a retro-reflection that is unlike those of every class a model was trained on."""


@dataclass(frozen=True)
class Prediction:
    """Estimates of K quantities, and of one class among C where the model knows classes, for N images.

    Parameters
    ----------
    names
        K names, for example ("gaze_x", "gaze_y"); none where only the class is estimated.
    value
        [N, K] estimates, SI units; gaze in fractions of the field of view.
    lower, upper
        [N, K] ends of an interval meant to hold the true value with the probability `COVERAGE`; infinite
        where a model was fitted without frames to calibrate on.
    classes
        C names of devices.
    probability
        [N, C], that the image shows each; given that it shows one of them.
    novelty
        [N] how unlike every class the image is. Above 1 it is none of these: `tapetum.models.novelty`.
    """

    names: tuple[str, ...]
    value: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    classes: tuple[str, ...] = ()
    probability: NDArray[np.float64] | None = None
    novelty: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        shape = (len(self.value), len(self.names))
        if not self.value.shape == self.lower.shape == self.upper.shape == shape:
            raise InputError(
                f"value, lower and upper must all be {shape},"
                f" are {self.value.shape}, {self.lower.shape} and {self.upper.shape}"
            )
        if bool(self.classes) != (self.probability is not None):
            raise InputError("classes and their probabilities belong together", where="probability")
        shares = (len(self.value), len(self.classes))
        if self.probability is not None and self.probability.shape != shares:
            raise InputError(f"must be {shares}, is {self.probability.shape}", where="probability")
        if self.novelty is not None and self.novelty.shape != shape[:1]:
            raise InputError(f"must be {shape[:1]}, is {self.novelty.shape}", where="novelty")
        told = [self.value, self.probability, self.novelty]
        if not all(np.isfinite(one).all() for one in told if one is not None) or any(
            np.isnan(end).any() for end in (self.lower, self.upper)
        ):
            raise InputError(
                "a prediction is not finite", where="model", remedy="train it again; its weights are unusable"
            )

    def __len__(self) -> int:
        return len(self.value)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the [N] estimates of one quantity."""
        if name not in self.names:
            raise InputError(f"no estimate of {name!r}", remedy=f"there are: {', '.join(self.names) or 'classes only'}")
        return self.value[:, self.names.index(name)]

    @property
    def device(self) -> list[str]:
        """The likeliest class of each image, or `NONE_OF_THESE`.

        Raises
        ------
        InputError
            When the model knows no classes.
        """
        shares = self._shares
        likeliest = [self.classes[k] for k in shares.argmax(axis=1)]
        if self.novelty is None:
            return likeliest
        return [NONE_OF_THESE if new > 1 else name for name, new in zip(likeliest, self.novelty, strict=True)]

    @property
    def device_probability(self) -> NDArray[np.float64]:
        """[N] probability of the likeliest class, given that it is one of them."""
        shares = self._shares
        return shares.max(axis=1) if len(shares) else np.empty(0)

    @property
    def _shares(self) -> NDArray[np.float64]:
        if self.probability is None:
            remedy = "use a model trained with the target device or phone"
            raise InputError("the model knows no devices", where="model", remedy=remedy)
        return self.probability

    def columns(self) -> dict[str, Any]:
        """Return the columns of a table of tracks, [N] each.

        NAME, NAME_low and NAME_high for each name, then `device` and `device_probability` where there are classes.
        """
        table: dict[str, Any] = {}
        for k, name in enumerate(self.names):
            table |= {
                name: self.value[:, k],
                f"{name}_low": self.lower[:, k],
                f"{name}_high": self.upper[:, k],
            }
        if self.classes:
            table |= {"device": self.device, "device_probability": self.device_probability}
        return table


def joined(parts: Sequence[Prediction]) -> Prediction:
    """Put predictions of one model for parts of the images, one or more of them, one behind the other."""
    first = parts[0]

    def column(name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(part, name) for part in parts])

    return Prediction(
        first.names,
        column("value"),
        column("lower"),
        column("upper"),
        first.classes,
        None if first.probability is None else column("probability"),
        None if first.novelty is None else column("novelty"),
    )
