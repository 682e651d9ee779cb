"""The steps of an adaptation: which layers are fitted again, on which frames, and how wide the intervals become.

One file of more than 400 lines: few frames and many take the same steps on the same state, in another order.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tapetum.data.dataset import STD
from tapetum.data.embargo import meeting, reach_of
from tapetum.errors import InputError
from tapetum.models.architectures import Network
from tapetum.models.base import TrainingPart
from tapetum.models.copy_prior import CopyPrior
from tapetum.models.devices import training_device
from tapetum.models.domain import fit_domain, picture_features
from tapetum.models.intervals import fit_intervals
from tapetum.models.kept_folds import WHOLE, KeptFolds
from tapetum.models.kernel import LeftOut, ResidualKernel, interpolated, left_out
from tapetum.models.last_layer import (
    FROM_COPIES,
    PENALTIES,
    Correction,
    LastLayer,
    corrected,
    folds_of,
    single_folds,
    single_frames,
)
from tapetum.models.losses import MixedLoss
from tapetum.models.network import NetworkEstimator
from tapetum.models.training import (
    EpochReport,
    TrainingSettings,
    augment,
    kept_epoch,
    train,
)
from tapetum.models.zernike_ridge import ZernikeRidge, ridge_residuals
from tapetum.progress import Progress

__all__ = ["ALL", "CARRIED", "GUESS", "LAST", "RIDGE", "Adaptation", "better_of", "epochs_of", "ridge_scales"]

Array = NDArray[np.float64]
T = TypeVar("T")

LAST, ALL = "the last layer", "all layers"
"""What may be fitted again."""
RIDGE, GUESS = "a tuned ridge of these frames alone", "their mean"
"""What an adapted network has to beat."""
CARRIED = "its residuals interpolated"
"""Of what is kept, where residuals are interpolated."""

# Up to so many frames every frame fits and calibrates, by cross-validation; of more, a part is kept aside.
_FEW = 250
_FOLDS = 4
# Forward and backward passes of one image in total, at 96 x 96 pixels, of few frames and of many: a minute or two on
# two cores. A network that sees each of many frames a few times only is no better than its corrected last layer.
# Of half a minute of film more epochs gained nothing on copies for development.
_PASSES, _PASSES_OF_MANY, _AT_SIZE = 6000, 14000, 96
_MOST_EPOCHS, _MOST_OF_MANY = 40, 17
_FEWEST_EPOCHS = 3
_BATCH, _RATE = 16, 5e-4
# All layers must err by this factor less than the last one. Frames left out lie amid those that are fitted; at the
# edges of the field, beyond them, all layers err more than they show there (on four copies for development, of which
# the choice by the smaller error took all layers for two: 0.004 and 0.008 of the field along x and y with 100 s, 0.0035
# and 0.005 by the last layer).
_CLEARLY = 0.75
# From this error of the corrected last layer on, over the labels' spread, the camera is unlike those that the base has
# seen. All layers then learn as in a first training: from a last layer of zeros, longer and at a high rate. From the
# corrected one, which fits what is peculiar to its frames, they never found better features: for two lenses that served
# development (errors of 0.32 and 0.26, with 30 s of film) 0.018 / 0.030 and 0.017 / 0.036 of the field along x and y in
# place of 0.071 / 0.101 and 0.034 / 0.084. Of 14 copies of the base's own camera that error was 0.16 at most.
_UNLIKE = 0.2
# Chosen on copy 80 of the zoom: 16 images a step in place of 32 (0.009 / 0.011 and 0.010 / 0.012 after 9,000 passes;
# of 10 s of film 0.023 / 0.037 and 0.080 / 0.150), this rate in place of half and one and a half times as much, no
# smaller images to begin with, 8 epochs of 100 s of film in place of 4 (0.009 / 0.012 and 0.013 / 0.019).
_FIRST_PASSES, _FIRST_RATE, _LEAST_OF_FIRST, _MOST_OF_FIRST = 5700, 2e-3, 8, 40
# Up to this error, over the labels' spread, the corrected last layer is kept without training all layers, which takes a
# minute or two. On three copies for development, with 5 to 100 s of film, it erred by 0.006 to 0.008, and all layers by
# 1.4 to 1.8 times as much.
_SURE = 0.01
# Shares of the frames kept aside, where they are many: to choose and to calibrate.
_CHOOSE, _CALIBRATE = 0.08, 0.17
# Side in pixels of the smallest square that separates the ridge's modes.
_SMALLEST = 16


@dataclass
class Adaptation:
    """One adaptation: the frames as the network takes them (`looks`), in the order of `part`.

    `aside` [N] are single frames that choose and calibrate, of many that are spread over a film; None where whole
    stretches of the film do.
    """

    base: NetworkEstimator
    part: TrainingPart
    looks: Tensor
    snr: Array
    features: Array
    targets: Array
    settings: TrainingSettings
    folds: NDArray[np.int64]
    few: bool
    single: bool
    aside: NDArray[np.bool_] | None
    device: str
    progress: Progress
    kept: KeptFolds
    identity: dict[str, Any]
    on_epoch: Callable[[EpochReport], None] | None = None
    started: float = 0.0
    epochs_given: bool = False
    unlike: bool = False
    sure: bool = False

    @classmethod
    def begin(
        cls,
        base: NetworkEstimator,
        part: TrainingPart,
        sparse: bool,
        scattered: bool,
        epochs: int | None,
        seed: int,
        precision: str,
        device: str,
        progress: Progress,
        checkpoint: str | Path | None,
        resume: bool,
    ) -> Adaptation:
        started = time.monotonic()
        found = base.read(part.dataset, progress=progress)
        looks, snr = found[0], found[1]
        n = len(looks)
        few = n <= _FEW
        given = epochs is not None
        if epochs is None:
            epochs = epochs_of(n, base.size)
        settings = replace(
            base.settings,
            epochs=int(epochs),
            batch=min(_BATCH, n // 2),
            learning_rate=_RATE,
            seed=seed,
            patience=None if few else int(epochs),
            precision=precision,
        )
        count = _FOLDS if few else round(1 / (_CHOOSE + _CALIBRATE))
        single = few and sparse and _deviations(part) is not None
        apart = scattered and not few and _deviations(part) is not None
        aside = single_frames(n, round(_CALIBRATE * n), seed) if apart else None
        folds = single_folds(n, count, seed) if single else folds_of(part.dataset, count)
        centre, size = part.targets.mean(axis=0), part.targets.std(axis=0)
        identity = {
            "base": base.data_hash_,
            "data": part.data_hash,
            "frames": n,
            "settings": asdict(settings),
            "single": single,
            "scattered": aside is not None,
            "residuals": "interpolated",
        }
        work = cls(
            base,
            part,
            looks,
            snr,
            np.empty((0, 0)),
            (part.targets - centre) / size,
            settings,
            folds,
            few,
            single,
            aside,
            device,
            progress,
            KeptFolds(None if checkpoint is None else Path(checkpoint), resume),
            json.loads(json.dumps(identity)),
            started=started,
            epochs_given=given,
        )
        work.features = work.outputs(base.network_, features=True)
        return work

    def outputs(self, network: Network, places: NDArray[np.intp] | None = None, *, features: bool = False) -> Array:
        """Return a network's outputs or features for some frames."""
        looks = self.looks if places is None else self.looks[torch.from_numpy(places)]
        device = training_device(self.device)
        network.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        network.eval()
        return self.base.run(network.features if features else network, looks, device)

    def seen(self, network: Network) -> tuple[Array, Array]:
        """Return a network's features [N, F] of all frames and what its last layer leaves of their targets [N, K]."""
        features = self.outputs(network, features=True)
        weight, bias = (one.detach().double().cpu().numpy() for one in network.head.parameters())
        return features, self.targets - LastLayer(weight, bias)(features)

    @property
    def sure_of(self) -> Array | None:
        """Weights [N] of the frames by their labels' deviations, where these are known."""
        return None if self.part.weights is None else self.part.weights.mean(axis=1)

    def left_out(self, features: Array, rest: Array, fit: NDArray[np.intp], at: NDArray[np.intp]) -> LeftOut:
        """Return what is left of frames `at`, without and with the residuals of those that were fitted."""
        return left_out(features, self.looks, rest, fit, at, self.sure_of)

    @property
    def spread_of(self) -> Array:
        """Standard deviations [K] of the quantities, in which `targets` are counted."""
        return self.part.targets.std(axis=0)

    def head(self, places: NDArray[np.intp], how: Correction) -> LastLayer:
        """Correct the base's last layer by some frames."""
        sure = None if self.sure_of is None else self.sure_of[places]
        return corrected(self.before, self.features[places], self.targets[places], sure, how, self.prior)

    @property
    def prior(self) -> CopyPrior | None:
        """What copies add to the base's last layer, in units of `targets`; None of many frames, which need none."""
        known = self.base.prior_ if self.few else None
        return None if known is None else known.scaled(self.base.scaling[1] / self.spread_of)

    def beside(self, asides: list[NDArray[np.bool_]], fits: list[NDArray[np.intp]]) -> dict[str, float]:
        """Return the mean errors, over the labels' spread, of what needs no network, on the frames left out."""
        parts = [(fit, np.flatnonzero(aside)) for aside, fit in zip(asides, fits, strict=True)]
        ridge = ZernikeRidge(self.base.quantities, scales=ridge_scales(self.base.crop))
        features = ridge.features(self.part.dataset, progress=self.progress)
        means = np.concatenate([self.targets[aside] - self.targets[fit].mean(axis=0) for fit, aside in parts])
        left = ridge_residuals(features, self.targets, parts)
        return {RIDGE: float(np.nanmean(np.abs(left))), GUESS: float(np.abs(means).mean())}

    @property
    def before(self) -> LastLayer:
        """The base's own last layer, for the quantities as counted here."""
        weight, bias = (one.detach().double().cpu().numpy() for one in self.base.network_.head.parameters())
        centre, size = self.base.scaling
        moved = (centre - self.part.targets.mean(axis=0)) / self.spread_of
        factor = size / self.spread_of
        return LastLayer(weight * factor[:, None], bias * factor + moved)

    def apart(self, aside: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return the frames to fit: without those whose labels share a measurement with the labels of frames aside."""
        fits = ~aside
        span = reach_of(self.part.dataset)
        if span is not None and not self.single:
            fits &= ~meeting(span, np.asarray(self.part.dataset["recording"].values), fits, aside)
        places = np.flatnonzero(fits)
        if len(places) < 4:
            what = "the labels share all measurements: no frame is left to fit beside those that calibrate"
            raise InputError(what, where="dataset", remedy="film longer, or choose frames spread over the field")
        return places

    def trained(
        self, places: NDArray[np.intp], head: LastLayer, what: str, choose: NDArray[np.intp] | None = None
    ) -> tuple[Network, list[EpochReport]]:
        """Train all layers on some frames, from a fitted last layer, or from none for a camera unlike the base's."""
        network = copy.deepcopy(self.base.network_)
        _with_outputs(network, self.targets.shape[1])
        start = LastLayer(np.zeros_like(head.weight), np.zeros_like(head.bias)) if self.unlike else head
        start.put(network)
        columns = [self.targets]
        if self.part.weights is not None:
            columns.append(self.part.weights)
        wanted = torch.from_numpy(np.concatenate(columns, axis=1)[places].astype(np.float32))
        last = choose is not None or not self.few or what == WHOLE
        folder = self.kept.folder / WHOLE if self.kept.folder is not None and last else None
        # A fold takes as many steps as the whole, else its errors would be those of a shorter training.
        epochs = round(self.settings.epochs * len(self.targets) / len(places)) if self.few else self.settings.epochs
        batch = min(self.settings.batch, max(2, len(places) // 2))
        settings = replace(self.settings, batch=batch, epochs=epochs)

        def validate(one: torch.nn.Module) -> float:
            assert choose is not None
            return float(np.abs(self.outputs(one, choose) - self.targets[choose]).mean())  # type: ignore[arg-type]

        part_of = what

        def shown(items: Iterable[T], what: str, *, total: int | None = None) -> Iterator[T]:
            return self.progress(items, f"{part_of}: {what}", total=total)

        history = train(
            network,
            self.looks[torch.from_numpy(places)],
            wanted,
            settings if choose is not None else replace(settings, patience=None),
            loss=MixedLoss(self.targets.shape[1], self.part.weights is not None),
            validate=validate if choose is not None else None,
            device=self.device,
            checkpoint=folder,
            resume=self.kept.resume and folder is not None,
            identity={**self.identity, "part": what},
            progress=shown,
            on_epoch=self.on_epoch if last else None,
        )
        return network, history

    def adapted(self, told: dict[str, Any]) -> NetworkEstimator:
        """Adapt, by folds or by parts."""
        return self._by_folds(told) if self.few else self._by_parts(told)

    def _settle(self, last: Array) -> None:
        """Decide by the corrected last layer's errors on frames left out whether and how all layers are trained."""
        error = float(np.nanmean(np.abs(last)))
        self.unlike, self.sure = error > _UNLIKE, error <= _SURE and not self.epochs_given
        if self.unlike:
            varied, n = self.settings.augmentation, len(self.targets)
            epochs = self.settings.epochs if self.epochs_given else epochs_of(n, self.base.size, unlike=True)
            self.settings = replace(
                self.settings,
                epochs=epochs,
                patience=None,
                learning_rate=_FIRST_RATE,
                # Noise is counted in the spread of the images that are learned from, `looks` in that of the base's.
                augmentation=replace(varied, noise=varied.noise * float(self.looks.std())),
            )
            self.identity |= {"settings": asdict(self.settings), "unlike": True}
        self.kept.begin(self.identity)

    def _by_folds(self, told: dict[str, Any]) -> NetworkEstimator:
        names = np.unique(self.folds)
        asides = [self.folds == k for k in names]
        fits = [self.apart(aside) for aside in asides]
        last, how = self.last_layer(asides, fits)
        self._settle(last)
        n, quantities = self.targets.shape
        found = np.full((n, 2 * quantities + 1), np.nan)
        for k, (aside, fit) in enumerate([] if self.sure else zip(asides, fits, strict=True)):
            at = np.flatnonzero(aside)
            kept = self.kept.fold(k)
            if kept is None:
                network, _ = self.trained(fit, self.head(fit, how), f"fold {k + 1} of {len(asides)}")
                one = self.left_out(*self.seen(network), fit, at)
                kept = np.column_stack([one.plain, one.carried, one.deviation])
                self.kept.keep(k, kept)
            found[at] = kept
        left = LeftOut(found[:, :quantities], found[:, quantities:-1], found[:, -1])
        everything = np.arange(n)
        errors = {LAST: float(np.abs(last).mean())}
        if not self.sure:
            errors[ALL] = left.errors[0]
        best = better_of(errors)
        head = self.head(everything, how)
        network = self._finished(best, everything, head)
        if best == LAST:
            left, shown = self.last_left_out(asides, fits, how), (self.features, self.targets - head(self.features))
        else:
            shown = self.seen(network)
        why = f"{self._said(errors)} on frames left out in turn, in {len(asides)} folds"
        intervals = f"from the errors on the frames left out in turn, in {len(asides)} folds (cross-conformal)"
        # Neighbouring frames may share the error of their labels, which a network can learn from one and repeat for the
        # other.
        wide = _deviations(self.part) if self.single else None
        own, kernel, said = self._interpolated(left, left, *shown, wide)
        summary = {
            "fitted": len(everything),
            "calibrated_on": len(everything),
            "embargo": 0,
            "chosen": {
                "fitted": f"{best}: {why}",
                "penalty": f"{how}: least error on the same frames",
                "residuals": said,
                **self._begun(best),
            },
            "left_out_error": {**errors, **_with(kernel, left), **self.beside(asides, fits)},
            "intervals": intervals,
        }
        return self._estimator(network, own, self.snr, summary, told, kernel)

    def _by_parts(self, told: dict[str, Any]) -> NetworkEstimator:
        fit, choose, calibrate = self._parted()
        last, how = self.last_layer([self._mask(choose)], [fit])
        self._settle(last)
        if self.sure:
            found = {LAST: float(np.nanmean(np.abs(last)))}
            why = f"{LAST}: {self._said(found)} on {len(choose)} frames that it had not fitted"
            return self._last_layer_of_all(why, {**found, **self.beside([self._mask(choose)], [fit])}, told)
        if self.unlike:
            # Every further frame that is fitted counts. No epoch is chosen, and one choice between two networks hardly
            # makes the errors of the same frames too small to calibrate by.
            if self.aside is None:
                fit, choose = self.apart(self._mask(calibrate)), calibrate
            else:
                choose = calibrate = np.flatnonzero(self.aside)
        head = self.head(fit, how)
        network, history = self.trained(fit, head, WHOLE, choose)
        features, rest = self.seen(network)
        errors = {
            LAST: float(np.abs(head(self.features[choose]) - self.targets[choose]).mean()),
            ALL: float(np.abs(rest[choose]).mean()),
        }
        best = better_of(errors)
        why = f"{best}: {self._said(errors)} on {len(choose)} frames that neither"
        beside = self.beside([self._mask(choose)], [fit])
        if best == LAST:
            return self._last_layer_of_all(f"{why} had fitted", {**errors, **beside}, told)
        left = self.left_out(features, rest, fit, np.arange(len(rest)))
        # Neighbours are fitted, which may share the error of their labels (see `_by_folds`).
        wide = None if self.aside is None else _deviations(self.part)
        wide = None if wide is None else wide[calibrate]
        chosen = left.at(choose)
        residuals, kernel, said = self._interpolated(chosen, left.at(calibrate), features, rest, wide)
        kept = f"{kept_epoch(history, self.settings.patience)} of {len(history)}"
        if self.unlike:
            by, epochs, apart = "had fitted", kept, "did not fit"
        else:
            by, epochs, apart = (
                "fit nor calibrate",
                f"{kept}: least error on the same frames",
                "neither fitted nor chose",
            )
        summary = {
            "fitted": len(fit),
            "calibrated_on": len(calibrate),
            "embargo": len(self.targets) - len(fit) - len(np.union1d(calibrate, choose)),
            "chosen": {
                "fitted": f"{why} {by}",
                "penalty": f"{how}: least error on frames that it had not fitted",
                "epochs": epochs,
                "residuals": said,
                **self._begun(ALL),
            },
            "left_out_error": {**errors, **_with(kernel, chosen), **beside},
            "intervals": f"from {'stretches' if self.aside is None else 'single frames'} of the film that {apart}",
        }
        return self._estimator(network, residuals, self.snr[calibrate], summary, told, kernel)

    def _interpolated(
        self, judged: LeftOut, calibrating: LeftOut, features: Array, rest: Array, wide: Array | None
    ) -> tuple[Array, ResidualKernel | None, str]:
        """Return errors to calibrate by [n, K], in the labels' units, the kernel that is kept, and why.

        `features` and `rest` are of all frames, as `seen` returns them for the network that is kept; `wide` [n, K] is
        added to the errors.
        """
        kernel, said = interpolated(judged, calibrating, features, self.looks, rest, self.sure_of)
        left, deviation = calibrating.under(kernel)
        own = np.abs(left) * self.spread_of + (0 if wide is None else wide)
        return own / deviation[:, None], kernel, said

    def _parted(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Return the frames that fit, choose and calibrate: stretches of the part kept aside do the last two by turns.

        All frames of one stretch do the same. Single frames may share measurements of their labels with those fitted.
        """
        if self.aside is not None:
            places = np.flatnonzero(self.aside)
            return np.flatnonzero(~self.aside), places[::3], np.delete(places, np.s_[::3])
        aside = self.folds == np.unique(self.folds)[-1]
        places = np.flatnonzero(aside)
        edges = np.flatnonzero(np.diff(places) > 1) + 1
        stretches = np.split(places, edges)
        every = max(2, round((_CHOOSE + _CALIBRATE) / _CHOOSE))
        if len(stretches) < every:
            cut = round(len(places) * _CHOOSE / (_CHOOSE + _CALIBRATE))
            choose, calibrate = places[:cut], places[cut:]
        else:
            choose = np.concatenate(stretches[::every])
            calibrate = np.setdiff1d(places, choose)
        return self.apart(aside), self._away(choose, calibrate), calibrate

    def _mask(self, places: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return which of all frames these are, [N]."""
        mask = np.zeros(len(self.targets), bool)
        mask[places] = True
        return mask

    def _last_layer_of_all(self, why: str, left_out: dict[str, float], told: dict[str, Any]) -> NetworkEstimator:
        """The base with its last layer corrected by every frame: that takes no time, so each calibrates too."""
        asides = [self.folds == k for k in np.unique(self.folds)]
        fits = [self.apart(aside) for aside in asides]
        _, how = self.last_layer(asides, fits)
        n, folds = len(self.targets), f"in {len(asides)} folds"
        head = self.head(np.arange(n), how)
        left = self.last_left_out(asides, fits, how)
        own, kernel, said = self._interpolated(left, left, self.features, self.targets - head(self.features), None)
        summary = {
            "fitted": n,
            "calibrated_on": n,
            "embargo": 0,
            "chosen": {
                "fitted": why,
                "penalty": f"{how}: least error on frames left out in turn, {folds}",
                "residuals": said,
                **self._begun(LAST),
            },
            "left_out_error": {**left_out, **_with(kernel, left)},
            "intervals": f"from the errors on the frames left out in turn, {folds} (cross-conformal)",
        }
        return self._estimator(self._finished(LAST, np.arange(n), head), own, self.snr, summary, told, kernel)

    def _away(self, these: NDArray[np.intp], others: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return those of the frames whose labels share no measurement with the others'."""
        span = reach_of(self.part.dataset)
        if span is None:
            return these
        one, other = (np.isin(np.arange(len(span)), places) for places in (these, others))
        kept = one & ~meeting(span, np.asarray(self.part.dataset["recording"].values), one, other)
        return np.flatnonzero(kept) if kept.any() else these

    def last_layer(self, asides: list[NDArray[np.bool_]], fits: list[NDArray[np.intp]]) -> tuple[Array, Correction]:
        """Return the last layer's errors [N, K] on the frames left out, and the correction with the smallest ones."""
        best, least, chosen = np.empty(0), np.inf, PENALTIES[0]
        for how in PENALTIES if self.prior is None else (*PENALTIES, *FROM_COPIES):
            errors = np.full_like(self.targets, np.nan)
            for aside, fit in zip(asides, fits, strict=True):
                errors[aside] = self.targets[aside] - self.head(fit, how)(self.features[aside])
            error = float(np.nanmean(np.abs(errors)))
            if error < least:
                best, least, chosen = errors, error, how
        return best, chosen

    def last_left_out(self, asides: list[NDArray[np.bool_]], fits: list[NDArray[np.intp]], how: Correction) -> LeftOut:
        """Return what the corrected last layer leaves of the frames left out, all frames in the end."""
        found = LeftOut(np.empty_like(self.targets), np.empty_like(self.targets), np.ones(len(self.targets)))
        for aside, fit in zip(asides, fits, strict=True):
            at = np.flatnonzero(aside)
            one = self.left_out(self.features, self.targets - self.head(fit, how)(self.features), fit, at)
            found.plain[at], found.carried[at], found.deviation[at] = one.plain, one.carried, one.deviation
        return found

    def _finished(self, what: str, places: NDArray[np.intp], head: LastLayer) -> Network:
        """Return the network that is kept: all layers trained on some frames, or only the last layer."""
        if what == ALL:
            return self.trained(places, head, WHOLE)[0]
        network = copy.deepcopy(self.base.network_)
        _with_outputs(network, self.targets.shape[1])
        head.put(network)
        return network

    def _begun(self, kept: str) -> dict[str, str]:
        """What the card says of where the training of all layers began and whether it was in vain, or that there was
        none."""
        if self.sure:
            return {"all layers": f"not trained, as the corrected last one errs by {_SURE:g} of the spread at most"}
        why = f"the corrected one errs by more than {_UNLIKE:g} of the labels' spread"
        end = "" if kept == ALL else "; they did not become clearly better, and were not kept"
        return {"start": f"all layers learned from a last layer of zeros, as {why}{end}"} if self.unlike else {}

    def _said(self, errors: dict[str, float]) -> str:
        # The mean of the quantities, each over its spread: quantities may differ in units.
        said = ", ".join(f"{error:.3g} with {what}" for what, error in errors.items())
        return f"mean error over the labels' spread {said}"

    def _estimator(
        self,
        network: Network,
        residuals: Array,
        snr: Array,
        summary: dict[str, Any],
        told: dict[str, Any],
        kernel: ResidualKernel | None,
    ) -> NetworkEstimator:
        base, part, settings = self.base, self.part, self.settings
        state = {name: tensor.detach().cpu().clone() for name, tensor in network.state_dict().items()}
        scaling = {"centre": part.targets.mean(axis=0), "spread": self.spread_of, "unit": np.array([base.unit])}
        state |= {f"scaling.{name}": torch.from_numpy(np.asarray(one, float)) for name, one in scaling.items()}
        state |= fit_intervals(residuals, snr).state("scaling.")
        generator = torch.Generator().manual_seed(settings.seed)
        seen = [picture_features(augment(some, settings.augmentation, generator)) for some in self.looks.split(64)]
        domain = fit_domain(np.concatenate(seen), np.asarray(part.dataset["recording"].values))
        for learned in (domain, kernel):
            state |= {} if learned is None else learned.state()
        own = {
            "epochs": settings.epochs,
            "batch": settings.batch,
            "learning_rate": settings.learning_rate,
            "seed": settings.seed,
            "patience": settings.patience,
            "precision": settings.precision,
            "calibration_fraction": _CALIBRATE,
            "interpolate": kernel is not None,
        }
        model = type(base).from_state({**base.parameters(), **own}, state, architecture=base.kind)
        model.device = self.device
        model.data_hash_ = part.data_hash
        took = {"took_seconds": round(time.monotonic() - self.started, 1)}
        model.training_ = {**part.summary, **summary, "adapted_from": {**told, **took}}
        return model


def _with(kernel: ResidualKernel | None, left: LeftOut) -> dict[str, float]:
    """What the card says of the errors of interpolated residuals, where they are."""
    return {} if kernel is None else {CARRIED: left.errors[1]}


def better_of(errors: Mapping[str, float]) -> str:
    """Return what is kept, `ALL` or `LAST`, by the errors of both on frames that neither has fitted.

    Where all layers were not trained, they have no error.
    """
    return ALL if errors.get(ALL, np.inf) < _CLEARLY * errors[LAST] else LAST


def epochs_of(frames: int, size: int, *, unlike: bool = False) -> int:
    """Return how often all layers see so many frames of `size` pixels a side, within a minute or two.

    Much film of a camera `unlike` those that the base has seen takes longer: fewer passes teach less than less film.
    """
    least = _FEWEST_EPOCHS
    if frames <= _FEW:
        each, passes, most = frames * _FOLDS, _PASSES, _MOST_EPOCHS
    elif unlike:
        each, passes, least, most = frames * (1 - _CALIBRATE), _FIRST_PASSES, _LEAST_OF_FIRST, _MOST_OF_FIRST
    else:
        each, passes, most = frames * (1 - _CHOOSE - _CALIBRATE), _PASSES_OF_MANY, _MOST_OF_MANY
    return int(np.clip(passes * (_AT_SIZE / size) ** 2 / each, least, most))


def ridge_scales(crop: int) -> tuple[int, ...]:
    """Return the sides of what the ridge beside a network looks at: four parts of the network's crop, in pixels."""
    return tuple(sorted({max(crop * k // 4, _SMALLEST) for k in range(1, 5)}))


def _deviations(part: TrainingPart) -> Array | None:
    """Return the standard deviations [N, K] of the labels; 0 where labels reach no other frame, None where unknown."""
    names = [f"{name}{STD}" for name in part.quantities]
    if all(name in part.dataset for name in names):
        return np.stack([np.asarray(part.dataset[name].values, float) for name in names], axis=1)
    return None if reach_of(part.dataset) is not None else np.zeros(part.targets.shape)


def _with_outputs(network: Network, outputs: int) -> None:
    """Check that the last layer has one output for each quantity."""
    if network.head.out_features != outputs:
        what = f"the last layer has {network.head.out_features} outputs for {outputs} quantities"
        raise InputError(what, where="model", remedy="give a model of quantities alone")
