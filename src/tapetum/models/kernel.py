"""What a network leaves of its labels, interpolated between labelled frames that look alike.

A network that learned from few frames errs alike on frames that look alike. Its residuals on the labelled frames are
interpolated by Gaussian-process regression (C. E. Rasmussen, C. K. I. Williams, *Gaussian Processes for Machine
Learning*, 2006, chapter 2) over the network's last features (A. G. Wilson et al., *Deep kernel learning*, AISTATS 2016)
and the frame itself in few pixels. Far from all labelled frames nothing is added to what the network says. The standard
deviation of the process says how far a frame is from them, and intervals widen with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_solve, cholesky, solve_triangular
from torch import Tensor

from tapetum.errors import InputError
from tapetum.models.inputs import area_average
from tapetum.models.state import MISMATCH, checked_state

__all__ = [
    "LEAST",
    "LeftOut",
    "ResidualKernel",
    "fit_kernel",
    "interpolated",
    "left_out",
    "small_area",
    "small_pictures",
]

Array = NDArray[np.float64]

LEAST = 1e-6
"""Smallest variance of the process, over that far from all frames: below it rounding decides."""

_STATE = "kernel."
# Pixels along each side of the small picture in a description.
_SIDE = 12
# Chosen on copy 80 of the zoom (docs/learning.md). The width of the kernel is so many times the median distance to the
# fifth nearest frame; the small picture's distance counts by half; the noise is counted in the residuals' variance.
# Half or twice each changes the error by a twentieth.
_WIDTH, _NEIGHBOUR, _LOOK, _NOISE = 3.0, 5, 0.5, 3e-3
# Residuals are interpolated where errors on frames left out are at most this share of those without: a model without is
# smaller.
_WORTH = 0.95
# Fewer have no typical distance. More would make the matrix of their correlations large, which an ONNX file holds.
_FEWEST, _MOST = 20, 3000


def small_area(side: int) -> Tensor:
    """Return the matrix that makes small pictures of images of `side` pixels, for `small_pictures`."""
    return area_average(side, _SIDE)


def small_pictures(looks: Tensor, area: Tensor) -> Tensor:
    """Return images [N, 1, S, S] in few pixels, [N, 144]."""
    return (area @ looks @ area.T).flatten(1)


@dataclass(frozen=True)
class ResidualKernel:
    """An addition to a network's quantities, from the labelled frames that look most alike.

    Parameters
    ----------
    units
        [2], by which features and small pictures are divided: a distance of 1 is one width of the kernel.
    references
        [R, F + 144] the divided descriptions of labelled frames.
    coefficients
        [R, K], counted as the network's last layer counts.
    noise
        [R] variances of the labelled frames' residuals beside what frames that look alike share, over the shared one.
    unit
        Standard deviation of the process, over that far from all frames, which counts as 1.
    """

    units: Array
    references: Array
    coefficients: Array
    noise: Array
    unit: float = 1.0

    def __call__(self, features: Array, looks: Tensor) -> tuple[Array, Array]:
        """Return what is added [N, K] and the standard deviations [N] in `unit`.

        Parameters
        ----------
        features, looks
            [N, F] and [N, 1, S, S], last features and images as the network takes them.
        """
        alike = _alike(_divided(features, _small(looks), self.units), self.references)
        known = (solve_triangular(self.factor, alike.T, lower=True) ** 2).sum(axis=0)
        return alike @ self.coefficients, np.sqrt(np.maximum(1 - known, LEAST)) / self.unit

    @cached_property
    def factor(self) -> Array:
        """Cholesky factor [R, R], lower, of the covariance of the labelled frames' residuals."""
        return _factor(self.references, self.noise)

    def state(self) -> dict[str, Tensor]:
        """Return everything as tensors, float64; the many references in float32, and exact in half precision."""
        return {
            f"{_STATE}units": torch.from_numpy(self.units),
            f"{_STATE}references": torch.from_numpy(self.references).float(),
            f"{_STATE}coefficients": torch.from_numpy(self.coefficients),
            f"{_STATE}noise": torch.from_numpy(self.noise),
            f"{_STATE}unit": torch.tensor([self.unit], dtype=torch.float64),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Tensor], quantities: int, width: int) -> ResidualKernel | None:
        """Rebuild from what `state` returned; None where a model has none; raises as `checked_state`."""
        references = state.get(f"{_STATE}references")
        if references is None:
            return None
        rows = len(references) if references.ndim else 0
        look = {"units": (2,), "references": (rows, width + _SIDE**2)}
        shapes = {**look, "coefficients": (rows, quantities), "noise": (rows,), "unit": (1,)}
        found = checked_state(state, shapes, _STATE)
        unit = float(found.pop("unit")[0])
        if not (unit > 0 and (found["units"] > 0).all() and (found["noise"] > 0).all()):
            raise InputError(f"{_STATE}* must be positive", where="weights", remedy=MISMATCH)
        return cls(**found, unit=unit)


def fit_kernel(
    features: Array, looks: Tensor, residuals: Array, weights: Array | None = None, unit: float = 1.0
) -> ResidualKernel | None:
    """Fit the kernel to the residuals of labelled frames.

    Parameters
    ----------
    features, looks
        [N, F] last features and [N, 1, S, S] images, as the network takes them, of labelled frames. Of more than 3000
        frames so many are used, evenly.
    residuals
        [N, K], labels less what the network says, as its last layer counts.
    weights
        [N] of the frames, inversely as the variance of their labels; None where all have the same.
    unit
        See `ResidualKernel`.

    Returns
    -------
    ResidualKernel
        None with fewer than 20 frames, and where frames do not differ.
    """
    if len(residuals) < _FEWEST:
        return None
    some = np.linspace(0, len(residuals) - 1, min(len(residuals), _MOST)).round().astype(np.intp)
    residuals = residuals[some]
    both = features[some], _small(looks[torch.from_numpy(some)])
    units = np.array([_WIDTH * _typical(one) for one in both])
    units[1] /= _LOOK
    if not (units > 0).all():
        return None
    # Rounded to half precision, so that a model saved in it adds the same.
    references = _divided(*both, units).astype(np.float16).astype(np.float64)
    noise = _NOISE / (np.ones(len(residuals)) if weights is None else np.maximum(weights[some], _NOISE))
    if not np.isfinite(references).all():
        return None
    coefficients = cho_solve((_factor(references, noise), True), residuals)
    return ResidualKernel(units, references, coefficients, noise, unit)


@dataclass(frozen=True)
class LeftOut:
    """What a network leaves of the targets of n frames that it has not fitted.

    Parameters
    ----------
    plain
        [n, K], the network's own residuals.
    carried
        [n, K], what is left where its residuals on the frames fitted are interpolated.
    deviation
        [n] of that kernel.
    """

    plain: Array
    carried: Array
    deviation: Array

    @property
    def errors(self) -> tuple[float, float]:
        """Mean absolute errors, without and with the kernel."""
        return float(np.nanmean(np.abs(self.plain))), float(np.nanmean(np.abs(self.carried)))

    @property
    def worth(self) -> bool:
        """Whether residuals are to be interpolated."""
        plain, carried = self.errors
        return carried <= _WORTH * plain

    def at(self, places: NDArray[np.intp]) -> LeftOut:
        """Return the same of some of the frames."""
        return LeftOut(self.plain[places], self.carried[places], self.deviation[places])

    def under(self, kernel: ResidualKernel | None) -> tuple[Array, Array]:
        """Return the residuals [n, K] and deviations [n] that calibrate intervals, with this kernel or none."""
        if kernel is None:
            return self.plain, np.ones(len(self.plain))
        return self.carried, self.deviation / kernel.unit


def left_out(
    features: Array,
    looks: Tensor,
    rest: Array,
    fit: NDArray[np.intp],
    at: NDArray[np.intp],
    weights: Array | None = None,
) -> LeftOut:
    """Return what is left of frames `at`, without and with the residuals of the frames `fit`, which were fitted.

    Parameters
    ----------
    features, looks, rest, weights
        As `fit_kernel` takes them, of all frames.
    fit, at
        Places of frames.
    """
    kernel = _of(features, looks, rest, weights, fit)
    if kernel is None:
        return LeftOut(rest[at], rest[at], np.ones(len(at)))
    added, deviation = kernel(features[at], looks[torch.from_numpy(at)])
    return LeftOut(rest[at], rest[at] - added, deviation)


def interpolated(
    judged: LeftOut,
    calibrating: LeftOut,
    features: Array,
    looks: Tensor,
    rest: Array,
    weights: Array | None = None,
) -> tuple[ResidualKernel | None, str]:
    """Return the kernel of all labelled frames, or None where it is not worth it, and the reason.

    Frames that were left out of the fit show what the network leaves of frames that it has not seen: with them the
    kernel errs less still.

    Parameters
    ----------
    judged, calibrating
        Of frames left out: the errors of the former decide, the median deviation of the latter is the kernel's unit.
    features, looks, rest, weights
        As `fit_kernel` takes them, of all frames and the network that is kept.
    """
    plain, carried = judged.errors
    errors = f"mean error over the labels' spread {carried:.3g} with it and {plain:.3g} without, on the same frames"
    unit, everything = float(np.median(calibrating.deviation)), np.arange(len(rest))
    kernel = _of(features, looks, rest, weights, everything, unit) if judged.worth else None
    if kernel is None:
        return None, f"not interpolated: {errors}"
    return kernel, f"interpolated between labelled frames that look alike: {errors}"


def _of(
    features: Array, looks: Tensor, rest: Array, weights: Array | None, places: NDArray[np.intp], unit: float = 1.0
) -> ResidualKernel | None:
    own = None if weights is None else weights[places]
    return fit_kernel(features[places], looks[torch.from_numpy(places)], rest[places], own, unit)


def _factor(references: Array, noise: Array) -> Array:
    return cholesky(_alike(references, references) + np.diag(noise), lower=True)


def _small(looks: Tensor) -> Array:
    looks = looks.detach().double().cpu()
    return small_pictures(looks, small_area(looks.shape[-1])).numpy()


def _divided(features: Array, small: Array, units: Array) -> Array:
    return np.concatenate([features / units[0], small / units[1]], axis=1)


def _squares(one: Array, other: Array) -> Array:
    """Return the squared distances [N, R] of rows [N, D] and [R, D]."""
    found = (one**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * one @ other.T
    return np.maximum(found, 0)


def _alike(one: Array, other: Array) -> Array:
    return np.exp(-0.5 * _squares(one, other))


def _typical(points: Array) -> float:
    """Return the median distance of a point [N, D] to its fifth nearest neighbour."""
    squares = _squares(points, points)
    # The nearest is the point itself.
    return float(np.sqrt(np.median(np.partition(squares, _NEIGHBOUR, axis=1)[:, _NEIGHBOUR])))
