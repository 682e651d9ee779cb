"""Where a model applies: what its training frames look like, and how far another frame lies from the nearest of them.

The distance to the nearest training frame is that of Y. Sun et al., ICML 2022, here between whitened features of the
picture. One distance to the mean of all (Mahalanobis) would refuse whatever is rare among the training frames, as a
camera that looks straight at the probe, and let pass what lies amid them and is like none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tapetum.errors import InputError
from tapetum.models.prediction import Prediction
from tapetum.models.state import checked_state
from tapetum.optics.zernike import mode_count, noll_to_nm, zernike_basis

__all__ = ["FALSE_REFUSALS", "Domain", "described", "fit_domain", "judged", "magnitudes", "picture_features"]

Array = NDArray[np.float64]

FALSE_REFUSALS = 0.01
"""Share of frames like the training frames that are refused; it sets the limit."""

ORDER = 8
"""Highest radial order of the Zernike modes that describe a picture."""

# Share of a feature's variance added to each direction: directions with little variance by chance would dominate.
_SHRINKAGE = 0.01
_FOLDS = 5
# With fewer frames, covariance and limit are meaningless; more would only make the model's file larger.
_FEWEST, _MOST = 40, 8000
# How far past the field's edge an estimate with an infinite interval may lie.
_MARGIN = 0.05
_HALF_FIELD = 0.5


@dataclass(frozen=True)
class Domain:
    """Distance of a frame from the nearest training frame.

    Parameters
    ----------
    mean
        [F] of their features.
    whitening
        [F, F] matrix that turns the features' covariance, with shrinkage, into the unit matrix.
    references
        [R, F] whitened features of training frames. Of models before these were kept: one row of zeros, so that the
        distance is that of Mahalanobis.
    unit
        Distance that counts as 1: that of all but the share `FALSE_REFUSALS` of training frames, each left out of mean,
        covariance and references.
    """

    mean: Array
    whitening: Array
    references: Array
    unit: float

    def __call__(self, features: Array) -> Array:
        """Return the distances [N] of features [N, F] in `unit`; above 1 the model does not apply."""
        white = (features - self.mean) @ self.whitening
        squares = (white**2).sum(axis=1)[:, None] + self._squares - 2 * white @ self.references.T
        return np.sqrt(np.maximum(squares.min(axis=1), 0)) / self.unit

    @cached_property
    def _squares(self) -> Array:
        return (self.references**2).sum(axis=1)

    def state(self) -> dict[str, torch.Tensor]:
        """Return everything as tensors, float64; the many references in float32."""
        return {
            "domain.mean": torch.from_numpy(self.mean),
            "domain.whitening": torch.from_numpy(self.whitening),
            "domain.references": torch.from_numpy(self.references).float(),
            "domain.unit": torch.tensor([self.unit], dtype=torch.float64),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, torch.Tensor], features: int) -> Domain | None:
        """Rebuild the domain from `state`, or None for a model saved without one; raises as `checked_state`."""
        if not any(name.startswith("domain.") for name in state):
            return None
        references = state.get("domain.references", torch.zeros(1, features))
        rows = max(1, len(references)) if references.ndim else 1
        shapes = {"mean": (features,), "whitening": (features, features), "references": (rows, features), "unit": (1,)}
        found = checked_state({"domain.references": references, **state}, shapes, "domain.")
        if not found["unit"][0] > 0:
            raise InputError("domain.unit must be positive", where="weights", remedy="train the model again")
        return cls(found["mean"], found["whitening"], found["references"], float(found["unit"][0]))


def fit_domain(features: Array, recording: NDArray[np.integer]) -> Domain | None:
    """Fit the distance to the training frames, of which at most 8000 are used; None with fewer than 40.

    Parameters
    ----------
    features
        [N, F] of the training frames.
    recording
        [N] number of each frame's recording. Contiguous fifths of every recording are left out in turn and their
        distances set the limit: neighbouring frames are nearly equal, so frames within the fit would lie too near.
    """
    if len(features) < _FEWEST:
        return None
    if len(features) > _MOST:
        some = np.linspace(0, len(features) - 1, _MOST).round().astype(int)
        features, recording = features[some], recording[some]
    fold = np.empty(len(features), dtype=np.int64)
    for number in np.unique(recording):
        places = np.flatnonzero(recording == number)
        fold[places] = np.arange(len(places)) * _FOLDS // len(places)
    distances = np.empty(len(features))
    for k in np.unique(fold):
        rest = features[fold != k]
        distances[fold == k] = _around(rest if len(rest) > 1 else features)(features[fold == k])
    limit = float(np.quantile(distances, 1 - FALSE_REFUSALS, method="higher"))
    return replace(_around(features), unit=max(limit, np.finfo(float).tiny))


def _around(features: Array) -> Domain:
    """Return the distance to the nearest of some frames, in units of 1."""
    mean, whitening = _moments(features)
    # Rounded as they are saved, so that a saved model judges alike.
    references = ((features - mean) @ whitening).astype(np.float32).astype(np.float64)
    return Domain(mean, whitening, references, 1.0)


def _moments(features: Array) -> tuple[Array, Array]:
    """Return the mean [F] and the whitening [F, F]."""
    mean, spread = features.mean(axis=0), features.std(axis=0)
    # The lower limit keeps rounding errors of a constant feature from counting.
    spread = np.maximum(spread, max(1e-4 * float(np.abs(mean).max(initial=0.0)), np.finfo(float).tiny))
    scaled = (features - mean) / spread
    values, vectors = np.linalg.eigh(scaled.T @ scaled / len(scaled))
    return mean, vectors / np.sqrt(np.maximum(values, 0) + _SHRINKAGE) / spread[:, None]


def groups(order: int) -> NDArray[np.float64]:
    """Return [modes, P]: 1 where a mode belongs to a magnitude, which joins sine and cosine of one (n, |m|)."""
    modes = [noll_to_nm(j) for j in range(1, mode_count(order) + 1)]
    kinds = sorted({(n, abs(m)) for n, m in modes})
    return np.array([[float((n, abs(m)) == kind) for kind in kinds] for n, m in modes])


def magnitudes(coefficients: Array, order: int) -> Array:
    """Return √(Σ c²) over the sine and cosine of each (n, |m|): [N, modes n ≤ `order`] to [N, P].

    A rotation of the image, and so the direction of the gaze, does not change them.
    """
    return np.sqrt(coefficients**2 @ groups(order))


@lru_cache(maxsize=4)
def projection(size: int) -> NDArray[np.float64]:
    """Return [size², 2 modes]: least-squares Zernike fits, n ≤ 8, of an image's disc and of that of its middle half."""
    found = np.zeros((2, size, size, mode_count(ORDER)))
    for whole, side in zip(found, (size, max(size // 2, 1)), strict=True):
        at = (2 * torch.arange(side, dtype=torch.float64) + 1) / side - 1
        y, x = torch.meshgrid(at, at, indexing="ij")
        inside = x * x + y * y <= 1
        fit = torch.linalg.pinv(zernike_basis(ORDER, x[inside], y[inside]))
        edge = (size - side) // 2
        whole[edge : edge + side, edge : edge + side][inside.numpy()] = fit.numpy()
    return np.concatenate(found.reshape(2, size * size, -1), axis=1)


def picture_width() -> int:
    """Return the number of features of `picture_features`."""
    return 2 * groups(ORDER).shape[1] + 2


def picture_features(images: Tensor) -> Array:
    """Return rotation-invariant features of a network's input.

    Parameters
    ----------
    images
        [N, 1, size, size], prepared (`tapetum.models.inputs.prepare`).

    Returns
    -------
    ndarray
        [N, 52]: `magnitudes` of the Zernike coefficients n ≤ 8 over the inscribed disc and over that of the middle
        half, the root mean square, and the maximum.
    """
    return described(images.detach().cpu(), torch.float64).numpy()


def described(images: Tensor, precision: torch.dtype) -> Tensor:
    """Return `picture_features` of prepared images, summed in `precision`; the ONNX export traces this function."""
    flat, width = images.flatten(1), images.shape[-1]
    modes = flat @ torch.from_numpy(projection(width)).to(flat)
    kinds = torch.from_numpy(np.kron(np.eye(2), groups(ORDER))).to(precision)
    squares = modes.to(precision).square() @ kinds
    others = [flat.square().mean(dim=1, keepdim=True).sqrt(), flat.amax(dim=1, keepdim=True)]
    return torch.cat([squares.sqrt(), *(one.to(precision) for one in others)], 1)


def judged(prediction: Prediction, distance: Array | None) -> Prediction:
    """Add to a prediction the reasons why the model does not apply.

    Parameters
    ----------
    prediction
        For N frames.
    distance
        [N] of `Domain`; None for a model without one.

    Returns
    -------
    Prediction
        With a reason where the distance exceeds 1, or where the interval of a gaze lies wholly outside the field of
        view.
    """
    reasons = [""] * len(prediction)
    if distance is not None:
        for n in np.flatnonzero(~(distance <= 1)):
            reasons[n] = f"unlike the training frames: {distance[n]:.3g} times the limit"
    for name in ("gaze_x", "gaze_y"):
        if name not in prediction.names:
            continue
        k = prediction.names.index(name)
        value, width = prediction.value[:, k], prediction.upper[:, k] - prediction.value[:, k]
        reach = np.where(np.isfinite(width), width, _MARGIN)
        for n in np.flatnonzero(np.abs(value) - reach > _HALF_FIELD):
            reasons[n] = reasons[n] or f"{name} {value[n]:.2f} lies outside the field of view"
    return replace(prediction.because(reasons, described=distance is not None), distance=distance)
