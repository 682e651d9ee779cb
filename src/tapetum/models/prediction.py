"""Result of every model: values with intervals, classes with probabilities."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COVERAGE", "NONE_OF_THESE", "Prediction", "joined"]

COVERAGE = 0.9
"""Share of true values that the intervals are meant to hold."""

NONE_OF_THESE = "none of these"
"""The device of a retro-reflection that resembles no class of the training."""

# Rows of the table that a notebook shows.
_SHOWN = 10


@dataclass(frozen=True, eq=False, repr=False)
class Prediction:
    """Estimates of K quantities, and of one class among C for models with classes, for N images.

    Parameters
    ----------
    names
        K names, for example ("gaze_x", "gaze_y"); empty where only the class is estimated.
    value
        [N, K] estimates, SI units; gaze in fractions of the field of view.
    lower, upper
        [N, K] ends of intervals that hold the true value with the probability `COVERAGE`; infinite for models without
        calibration frames.
    classes
        C names of devices.
    probability
        [N, C] probability of each class, given that the image shows one of them.
    novelty
        [N] distance from the nearest class; above 1 it is none of these: `tapetum.models.novelty`.
    reason
        [N] why the model does not apply to an image, empty where it does. Numbers of images with a reason are NaN,
        unless `predict` was called with `anyway`.
    described
        Whether the model knows what its training frames look like, and so whether it applies.
    distance
        [N] how far each image is from the training frames; above 1 it has a `reason`. None where this is unknown.
    unit
        Whose intervals these are: "own", those of the copy of the camera that the model was trained on, or "other",
        those of a copy that it has not seen.
    """

    names: tuple[str, ...]
    value: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    classes: tuple[str, ...] = ()
    probability: NDArray[np.float64] | None = None
    novelty: NDArray[np.float64] | None = None
    reason: tuple[str, ...] = ()
    described: bool = False
    distance: NDArray[np.float64] | None = None
    unit: str = "own"

    def __post_init__(self) -> None:
        shape = (len(self.value), len(self.names))
        if not self.value.shape == self.lower.shape == self.upper.shape == shape:
            found = f"{self.value.shape}, {self.lower.shape} and {self.upper.shape}"
            raise InputError(f"value, lower and upper must all be {shape}, are {found}")
        if bool(self.classes) != (self.probability is not None):
            raise InputError("classes and their probabilities belong together", where="probability")
        for name, wanted in (
            ("probability", (len(self.value), len(self.classes))),
            ("novelty", shape[:1]),
            ("distance", shape[:1]),
        ):
            given = getattr(self, name)
            if given is not None and given.shape != wanted:
                raise InputError(f"must be {wanted}, is {given.shape}", where=name)
        if not self.reason:
            object.__setattr__(self, "reason", ("",) * len(self.value))
        if len(self.reason) != len(self.value):
            raise InputError(f"expected {len(self.value)} reasons, got {len(self.reason)}", where="reason")
        answered = self.applies
        numbers = [one[answered] for one in (self.value, self.probability) if one is not None]
        numbers += [] if self.novelty is None else [self.novelty]
        if not all(np.isfinite(one).all() for one in numbers) or np.isnan([self.lower, self.upper])[:, answered].any():
            remedy = "train it again; its weights are unusable"
            raise InputError("a prediction is not finite", where="model", remedy=remedy)

    def __len__(self) -> int:
        return len(self.value)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the [N] estimates of one quantity."""
        if name not in self.names:
            raise InputError(f"no estimate of {name!r}", remedy=f"there are: {', '.join(self.names) or 'classes only'}")
        return self.value[:, self.names.index(name)]

    @property
    def applies(self) -> NDArray[np.bool_]:
        """[N] False where the model does not apply, for a `reason`; True elsewhere, also where this is unknown."""
        return np.array([not one for one in self.reason], dtype=bool)

    def because(self, reason: Sequence[str], *, described: bool) -> Prediction:
        """Return the same numbers with a reason for each image, empty where the model applies."""
        return replace(self, reason=tuple(reason), described=described)

    def withheld(self) -> Prediction:
        """Return a copy with NaN for all numbers of images that have a `reason`.

        Gaze estimates past the edge of the field, whose intervals reach into it, are clipped to the edge.
        """
        refused = ~self.applies[:, None]
        value = np.where(refused, np.nan, self.value)
        for k, name in enumerate(self.names):
            if name in ("gaze_x", "gaze_y"):
                value[:, k] = np.clip(value[:, k], -0.5, 0.5)
        ends = {name: np.where(refused, np.nan, getattr(self, name)) for name in ("lower", "upper")}
        shares = None if self.probability is None else np.where(refused, np.nan, self.probability)
        return replace(self, value=value, **ends, probability=shares)

    @property
    def device(self) -> list[str]:
        """The most probable class of each image, or `NONE_OF_THESE`.

        Raises
        ------
        InputError
            When the model has no classes.
        """
        shares = self._shares
        strange = np.zeros(len(shares)) if self.novelty is None else self.novelty
        none = np.isnan(shares).any(axis=1) | (strange > 1)
        names = [self.classes[k] for k in shares.argmax(axis=1)]
        return [NONE_OF_THESE if new else name for name, new in zip(names, none, strict=True)]

    @property
    def device_probability(self) -> NDArray[np.float64]:
        """[N] probability of the most probable class, given that it is one of them."""
        shares = self._shares
        return shares.max(axis=1) if len(shares) else np.empty(0)

    @property
    def _shares(self) -> NDArray[np.float64]:
        if self.probability is None:
            remedy = "use a model trained with the target device or phone"
            raise InputError("the model knows no devices", where="model", remedy=remedy)
        return self.probability

    def __repr__(self) -> str:
        what = ", ".join([*self.names, *(["device"] if self.classes else [])])
        refused = int((~self.applies).sum())
        known = f"{refused} refused" if self.described or refused else "not known whether the model applies"
        return f"<Prediction: {what} of {len(self)} images, {known}>"

    def _repr_html_(self) -> str:
        """Return a table of the first images, for notebooks."""
        columns = self.columns()
        heads = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
        rows = [
            "".join(f"<td>{html.escape(_shown(values[n]))}</td>" for values in columns.values())
            for n in range(min(len(self), _SHOWN))
        ]
        body = "".join(f"<tr><td>{n}</td>{row}</tr>" for n, row in enumerate(rows))
        words = html.escape(repr(self)[1:-1])
        return f"<p>{words}</p><table><tr><th></th>{heads}</tr>{body}</table>"

    def plot(self) -> Figure:
        """Draw each quantity with its interval over the image number, and the probability of the most probable device.

        Returns
        -------
        matplotlib.figure.Figure
            Without a window: a notebook shows it, `savefig` writes it. Refused images leave gaps.
        """
        from matplotlib.figure import Figure

        rows = len(self.names) + bool(self.classes)
        figure = Figure(figsize=(7, 1.8 * max(1, rows) + 0.4), layout="constrained")
        number = np.arange(len(self))
        for k, name in enumerate(self.names):
            axis = figure.add_subplot(rows, 1, k + 1)
            low, high = (np.where(np.isfinite(end[:, k]), end[:, k], np.nan) for end in (self.lower, self.upper))
            axis.fill_between(number, low, high, alpha=0.3, linewidth=0)
            axis.plot(number, self.value[:, k], ".", markersize=3)
            axis.set_ylabel(name)
        if self.classes:
            axis = figure.add_subplot(rows, 1, rows)
            axis.plot(number, self.device_probability, ".", markersize=3)
            axis.set_ylabel("probability of the device")
        if rows:
            figure.axes[-1].set_xlabel("image")
        return figure

    def columns(self) -> dict[str, Any]:
        """Return the columns of a table of tracks, [N] each.

        NAME, NAME_low and NAME_high for each name; `device` and `device_probability` where there are classes; `applies`
        (None where unknown) and `reason`.
        """
        table: dict[str, Any] = {}
        for k, name in enumerate(self.names):
            table |= {name: self.value[:, k], f"{name}_low": self.lower[:, k], f"{name}_high": self.upper[:, k]}
        if self.classes:
            table |= {"device": self.device, "device_probability": self.device_probability}
        known = [False if why else (True if self.described else None) for why in self.reason]
        return {**table, "applies": known, "reason": list(self.reason)}


def _shown(value: Any) -> str:
    if isinstance(value, float | np.floating):
        return "–" if np.isnan(value) else f"{value:.4g}"
    return "" if value is None else str(value)


def joined(parts: Sequence[Prediction]) -> Prediction:
    """Concatenate one or more predictions of one model."""
    first = parts[0]

    def column(name: str) -> Any:
        values = [getattr(part, name) for part in parts]
        return None if values[0] is None else np.concatenate(values)

    arrays = {name: column(name) for name in ("value", "lower", "upper", "probability", "novelty", "distance")}
    return replace(first, **arrays, reason=tuple(why for part in parts for why in part.reason))
