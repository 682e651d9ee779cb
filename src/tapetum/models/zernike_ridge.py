"""The paper's linear model: ridge regression on powers of Zernike coefficients (section 5)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, Self

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray
from sklearn.linear_model import Ridge
from sklearn.model_selection import KFold

from tapetum.data.dataset import DEVICE
from tapetum.errors import InputError
from tapetum.models.base import Data, Estimator, plain_target, target_names, training_part
from tapetum.models.domain import Domain, fit_domain, magnitudes
from tapetum.models.features import ORDER, POWERS, SCALES, checked_powers, zernike_features
from tapetum.models.intervals import OTHER, Intervals, fit_intervals, has_intervals
from tapetum.models.prediction import Prediction
from tapetum.models.snr import crop_snr
from tapetum.models.state import checked_state
from tapetum.optics.zernike import mode_count
from tapetum.progress import Progress, quiet

__all__ = ["ZernikeRidge", "ridge_residuals"]

_ALPHAS = np.logspace(-6, 6, 25)
_FOLDS = 5
# Highest radial order of the modes that describe how the training frames look.
_LOOK_ORDER = 6


class ZernikeRidge(Estimator):
    """Zernike features and ridge regression.

    Parameters
    ----------
    target
        "gaze", "focus", or names of labels.
    scales, order, powers
        See `tapetum.models.features.zernike_features`; the defaults are the paper's.
    alpha
        Strength of the penalty on the squared weights. The paper's 1e-6 belongs to features that are *not* standardised
        and to intensities in 8-bit counts, whose roots run from 0 to 16. "cv" takes the best of 1e-6 ... 1e6 by
        cross-validation over contiguous fifths of the frames; a random split would always choose no penalty, because
        neighbouring video frames are nearly equal.
    standardise
        Scale every feature to unit variance first. The paper does not.
    calibration_fraction
        Share of the training frames, the last ones of each recording, that is held out of the fit to set the intervals;
        0.1 is usual. The default 0, as in the paper, fits every training frame and gives infinite intervals.

    Attributes
    ----------
    coef_, intercept_
        [K, features] and [K], for features (less `mean_`, over `scale_`).
    alpha_
        The penalty used.

    Notes
    -----
    Intensities are 8-bit counts (0 ... 255, whatever the depth) without background subtraction, since the paper
    mentions none. The fit runs in float64 with ``solver="svd"``: the normal equations would square the features' range
    of ten decades. At 1200 frames this takes 0.25 s instead of 0.125 s.

    Examples
    --------
    >>> import numpy as np
    >>> from tapetum.data import dataset_from_arrays
    >>> from tapetum.models import ZernikeRidge
    >>> images = np.random.default_rng(0).integers(0, 255, (12, 40, 40), dtype=np.uint8)
    >>> data = dataset_from_arrays(images, {"focal_length": images.mean((1, 2))})
    >>> model = ZernikeRidge("focal_length", scales=(40,), order=2).fit(data)
    >>> model.predict(images).value.shape
    (12, 1)
    """

    kind: str = "zernike"

    coef_: NDArray[np.float64]
    intercept_: NDArray[np.float64]
    mean_: NDArray[np.float64]
    scale_: NDArray[np.float64]
    alpha_: float

    def __init__(
        self,
        target: str | Sequence[str] = "gaze",
        *,
        scales: Sequence[int] = SCALES,
        order: int = ORDER,
        powers: Sequence[int] = POWERS,
        alpha: float | Literal["cv"] = 1e-6,
        standardise: bool = False,
        calibration_fraction: float = 0.0,
    ) -> None:
        self.target_names = self.quantities = target_names(target)
        self.target = target if isinstance(target, str) else self.target_names
        if DEVICE in self.target_names:
            remedy = "use a network (--kind resnet18), or name quantities"
            raise InputError("a linear model of quantities does not recognise devices", where="label", remedy=remedy)
        self.scales = tuple(int(s) for s in scales)
        self.order = int(order)
        self.powers = checked_powers(powers)
        if alpha != "cv" and not (isinstance(alpha, int | float) and alpha > 0):
            raise InputError(f'must be positive or "cv", is {alpha!r}', where="alpha", remedy="the paper's is 1e-6")
        if not self.scales:
            raise InputError("are none", where="scales", remedy="give sides in pixels")
        self.alpha: float | Literal["cv"] = alpha
        self.standardise = bool(standardise)
        self.calibration_fraction = float(calibration_fraction)
        self.data_hash_ = self.training_ = None

    def features(
        self, data: Data, *, full_scale: float | None = None, progress: Progress = quiet
    ) -> NDArray[np.float64]:
        """Return the features [N, F] of a dataset or of crops [N, side, side]."""
        return np.concatenate(self._map_batches(self._features, self._progress_label(), data, full_scale, progress))

    def _features(self, images: NDArray[np.generic], full_scale: float) -> NDArray[np.float64]:
        return zernike_features(images, self.scales, self.order, self.powers, full_scale=full_scale)

    def _read(self, images: NDArray[np.generic], full_scale: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the features [N, F] and the SNR [N] of a batch, in one pass over the images."""
        return self._features(images, full_scale), crop_snr(images, full_scale)

    def _progress_label(self) -> str:
        return "Zernike features"

    @property
    def _width(self) -> int:
        return len(self.scales) * len(self.powers) * mode_count(self.order)

    def fit(self, dataset: xr.Dataset, *, progress: Progress = quiet) -> Self:
        """Fit the training frames of a dataset; test frames are not used.

        Parameters
        ----------
        dataset
            From `tapetum.data.open_dataset` or `tapetum.data.dataset_from_arrays`.
        progress
            Shown over the batches of features.
        """
        part = training_part(dataset, self.target_names, self.calibration_fraction)
        found = self._map_batches(self._read, self._progress_label(), part.dataset, progress=progress)
        features, snr = (np.concatenate(parts) for parts in zip(*found, strict=True))
        x, y = features[part.fit], part.targets[part.fit]
        self.mean_, self.scale_ = np.zeros(self._width), np.ones(self._width)
        if self.standardise:
            spread = x.std(axis=0)
            # A constant feature carries no information: it is not scaled, and its weight becomes 0.
            self.mean_, self.scale_ = (x.mean(axis=0), np.where(spread > 1e-12 * np.abs(x).max(axis=0), spread, 1.0))
            x = (x - self.mean_) / self.scale_
        self.alpha_ = _best_alpha(x, y) if self.alpha == "cv" else float(self.alpha)
        weights = part.weights
        # One weight for a frame: the solver has one for all quantities.
        sure = None if weights is None else weights[part.fit].mean(axis=1)
        ridge = Ridge(alpha=self.alpha_, solver="svd").fit(x, y, sample_weight=sure)
        self.coef_ = np.asarray(ridge.coef_, dtype=np.float64).reshape(len(self.target_names), -1)
        self.intercept_ = np.asarray(ridge.intercept_, dtype=np.float64).reshape(-1)
        aside = part.calibrate
        self.intervals_ = fit_intervals(part.targets[aside] - self._linear(features[aside]), snr[aside])
        self.others_ = None
        self.data_hash_, self.training_ = part.data_hash, part.summary
        if self.alpha == "cv":
            why = f"{self.alpha_:.3g}: least squared error over contiguous fifths of the fitted frames, each left out"
            self.training_["chosen"]["alpha"] = why
        self.domain_ = fit_domain(self._look(features), np.asarray(part.dataset["recording"].values))
        return self

    def _linear(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        return (features - self.mean_) / self.scale_ @ self.coef_.T + self.intercept_

    def _estimate(self, images: NDArray[np.generic], full_scale: float, own: bool = True) -> Prediction:
        self._check_fitted()
        features = self._features(images, full_scale)
        distance = None if self.domain_ is None else self.domain_(self._look(features))
        return self._prediction(self._linear(features), lambda: crop_snr(images, full_scale), distance, own=own)

    def _look(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return rotation-invariant features of crops for `Domain`: low-order Zernike magnitudes at every scale."""
        power, modes = min(self.powers), mode_count(self.order)
        order = min(self.order, _LOOK_ORDER)
        all_of = features.reshape(len(features), len(self.scales), len(self.powers), modes)
        low = np.abs(all_of[:, :, self.powers.index(power), : mode_count(order)]) ** (1 / power)
        found = magnitudes(low.reshape(-1, mode_count(order)), order)
        return found.reshape(len(features), len(self.scales) * found.shape[1])

    @property
    def _look_width(self) -> int:
        return self._look(np.zeros((1, self._width))).shape[1]

    def parameters(self) -> dict[str, Any]:
        names = ("order", "alpha", "standardise", "calibration_fraction")
        lists = {"target": plain_target(self.target), "scales": list(self.scales), "powers": list(self.powers)}
        return {**lists, **{name: getattr(self, name) for name in names}}

    def state(self) -> dict[str, torch.Tensor]:
        """Return everything that was learned, in float64."""
        self._check_fitted()
        names = ("coef", "intercept", "mean", "scale")
        state = {name: torch.from_numpy(np.array(getattr(self, name + "_"), dtype=np.float64)) for name in names}
        state["alpha"] = torch.tensor([self.alpha_], dtype=torch.float64)
        state |= self.intervals_.state()
        state |= {} if self.others_ is None else self.others_.state(OTHER)
        return {**state, **({} if self.domain_ is None else self.domain_.state())}

    @classmethod
    def from_state(
        cls, parameters: Mapping[str, Any], state: Mapping[str, torch.Tensor], classes: tuple[str, ...] = ()
    ) -> Self:
        del classes
        model = cls(**parameters)
        k, width = len(model.target_names), model._width
        arrays = checked_state(
            state, {"coef": (k, width), "intercept": (k,), "mean": (width,), "scale": (width,), "alpha": (1,)}
        )
        model.coef_, model.intercept_ = arrays["coef"], arrays["intercept"]
        model.mean_, model.scale_ = arrays["mean"], arrays["scale"]
        model.intervals_, model.alpha_ = Intervals.from_state(state, k), float(arrays["alpha"][0])
        model.others_ = Intervals.from_state(state, k, OTHER) if has_intervals(state, OTHER) else None
        model.domain_ = Domain.from_state(state, model._look_width)
        return model


def ridge_residuals(
    x: NDArray[np.float64], y: NDArray[np.float64], parts: Sequence[tuple[NDArray[np.intp], NDArray[np.intp]]]
) -> NDArray[np.float64]:
    """Return a tuned ridge's errors [N, K] on frames that it has not fitted; NaN for frames in no fold.

    Parameters
    ----------
    x, y
        Features [N, F] and quantities [N, K].
    parts
        The places of the frames that are fitted and of those left out, for each fold. One penalty serves all of them:
        the one with the least mean absolute error.
    """
    errors = np.full((len(_ALPHAS), *y.shape), np.nan)
    for fit, aside in parts:
        spread = x[fit].std(axis=0)
        scale = np.where(spread > 1e-12 * np.abs(x[fit]).max(axis=0), spread, 1.0)
        for k, estimate in enumerate(_estimates(x / scale, y, fit, aside)):
            errors[k, aside] = y[aside] - estimate
    return errors[int(np.argmin(np.nanmean(np.abs(errors), axis=(1, 2))))]


def _best_alpha(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return the penalty with the least squared error over contiguous folds."""
    error = np.zeros(len(_ALPHAS))
    # Scaled, so that all quantities have equal weight.
    spread = np.maximum(y.std(axis=0), np.finfo(float).tiny)
    for rest, fold in KFold(min(_FOLDS, len(x))).split(x):
        for k, estimate in enumerate(_estimates(x, y, rest, fold)):
            error[k] += float((((estimate - y[fold]) / spread) ** 2).sum())
    return float(_ALPHAS[int(np.argmin(error))])


def _estimates(
    x: NDArray[np.float64], y: NDArray[np.float64], fit: NDArray[np.intp], aside: NDArray[np.intp]
) -> Iterator[NDArray[np.float64]]:
    """Yield the estimates of frames left out for each penalty; one SVD serves all of them."""
    x0, y0 = x[fit].mean(axis=0), y[fit].mean(axis=0)
    u, s, vt = np.linalg.svd(x[fit] - x0, full_matrices=False)
    seen, turned = u.T @ (y[fit] - y0), (x[aside] - x0) @ vt.T
    for alpha in _ALPHAS:
        yield turned @ (seen * (s / (s**2 + alpha))[:, None]) + y0
