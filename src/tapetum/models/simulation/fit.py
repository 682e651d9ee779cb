"""Maximum-likelihood fit of a scene's parameters to a crop by simulation, without training."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
import xarray as xr
from numpy.typing import NDArray

from tapetum.bench import PrescriptionLens, Scene, scene_dict, scene_from_dict
from tapetum.errors import InputError
from tapetum.models.base import Data, Estimator
from tapetum.models.domain import judged
from tapetum.models.prediction import Prediction
from tapetum.models.simulation.counts import CountModel
from tapetum.models.simulation.finer import COARSER, SAME_BOUND, Finer, refined
from tapetum.models.simulation.images import checked, looked_at
from tapetum.models.simulation.maxima import EXPLAINED, LOST, climbed, farther, periods_of
from tapetum.models.simulation.pictures import Pictures, Pose, check_scene
from tapetum.models.simulation.result import SimulationFitResult, result_of, same_top
from tapetum.models.simulation.search import FREE, PHASE, SLOW, Search, Top
from tapetum.models.simulation.starts import Bank
from tapetum.progress import Progress, quiet
from tapetum.simulate.exposure import gain_of

__all__ = ["SimulationFit"]

Array = NDArray[np.float64]

# Nodes along an edge of the bank; fewer where photosites show, whose images take longer to render.
_NODES, _NODES_SLOW = 25, 9
# Those of the bank, and some hundred for each crop.
_PICTURES = 1000
# Default window: in the bundled scenes, pixels beyond hold 1 % of the information on the gaze.
_WINDOW = 200
# By how much starts increase while none explains the image.
_FARTHER = 4


class SimulationFit(Estimator):
    """Maximum likelihood of a known scene's parameters, image by image.

    Parameters
    ----------
    scene
        The bench. All of it but the free parameters is known: the lens, the sensor, the light.
    parameters
        What is estimated: `gaze_x`, `gaze_y`; `object_distance` and, of a thin lens, `focal_length`; or a nuisance. The
        search for a focus starts at the scene's own and covers some tenths of a wave over the pupil.
    nuisances
        What else is unknown: `power`, `place_x` and `place_y` (of the RR in the crop); `background`, `roll`; `phase_x`
        and `phase_y`, the photosites' position under the spot. A gaze that is not named is a nuisance.
    starts
        Number of starting gazes: the best matches in a coarse bank of images, and the opposite of the best one. Where
        none explains the image (misfit above 1.1), the search starts again opposite to the best maximum and at the next
        best matches, up to four times as many in all.
    accuracy
        Of the pictures, in fractions of the peak. By default the scene's own for the search; where it ends the pictures
        become finer, three times each, to 0.001 at best, until what is estimated moves by less than a fifth of its
        standard deviation. Where the engine refuses an accuracy that is finer than the scene's own, as it may behind a
        traced lens, the next coarser that it allows.
    window
        Edge in pixels of the central square that is fitted.
    unevenness
        RMS of the pixels' relative sensitivities.
    offsets
        RMS of the offsets of the sensor's columns and rows, in electrons. Intervals are too narrow if they are ignored.
    systematic
        Standard deviations of gaze x and y, in fractions of the field, by what of the scene is not exactly known: those
        of a twin (`tapetum.calibrate.Twin.systematic`). They widen the intervals.
    nodes
        Of the bank along an edge of the field: by default 25, or 9 where photosites show.
    seed
        Without effect, since nothing is random; every estimator takes one.

    Notes
    -----
    A pixel's digital number is normal, with mean and variance of `exposure.count_moments`, or those of rounding where
    it is coarser than the noise; a saturated pixel has no slope and no information. The maximum is found by Fisher
    scoring (iteratively reweighted least squares) with Levenberg-Marquardt damping. Derivatives by gaze, roll and focus
    are finite differences of images; those by place, power and background follow from one image.

    Where the photosites' diffraction orders return (a fast lens), the likelihood has a narrow peak for every photosite
    period under the spot. The slow gaze and the phase are then fitted separately, and the likely periods compared
    (`tapetum.models.simulation.search`). With the phases as nuisances only the slow gaze is estimated: far less
    precise, and the limit if the photosites' place is not known to a hundredth of a micrometre.

    Examples
    --------
    >>> import tapetum as tp
    >>> from tapetum.models import SimulationFit
    >>> scene = tp.load_scene("hand-held", ["target.rotation=[0.3 deg, 0.2 deg]"])
    >>> frame = tp.expose(tp.retroreflect(scene), scene.probe, seed=1)
    >>> found = SimulationFit(scene, nodes=13).predict(frame)
    >>> [round(float(one), 2) for one in found.value[0]]
    [0.09, 0.08]
    """

    kind = "simulation"
    _batch = 1

    def __init__(
        self,
        scene: Scene,
        parameters: tuple[str, ...] = SLOW,
        nuisances: tuple[str, ...] = ("power", "place_x", "place_y"),
        *,
        starts: int = 4,
        accuracy: float | None = None,
        window: int = _WINDOW,
        unevenness: float = 0.0,
        offsets: Sequence[float] = (0.0, 0.0),
        systematic: Sequence[float] = (0.0, 0.0),
        nodes: int | None = None,
        seed: int = 0,
    ) -> None:
        self.scene, self.quantities, self.nuisances = scene, tuple(parameters), tuple(nuisances)
        self.target = self.target_names = self.quantities
        self.starts, self.accuracy, self.window, self.nodes = starts, accuracy, window, nodes
        self.unevenness, self.seed = unevenness, seed
        self.data_hash_ = self.training_ = self.domain_ = None
        check_scene(scene)
        _check_names(self.quantities, self.nuisances)
        for name, value, least in (("starts", starts, 1), ("window", window, 32), ("nodes", nodes or 2, 2)):
            if value < least:
                raise InputError(f"must be {least} or more, is {value}", where=name, remedy="give a whole number")
        if accuracy is not None and not 0 < accuracy < math.inf:
            raise InputError(f"must be positive, is {accuracy}", where="accuracy", remedy="0.01 is usual")
        if not 0 <= unevenness < 1:
            what = f"must lie from 0 to 1, is {unevenness}"
            raise InputError(what, where="unevenness", remedy="0.01 is usual")
        every = {*self.quantities, *self.nuisances}
        if "focal_length" in every and isinstance(scene.target.lens, PrescriptionLens):
            what = "the focal length of a traced lens is not fitted"
            raise InputError(what, where="parameters", remedy="leave focal_length out, or take a thin lens")
        if "object_distance" in every and np.isinf(scene.target.object_distance):
            what = "the search for a focus cannot begin at infinity"
            raise InputError(what, where="scene.target.object_distance", remedy="start from a distance in metres")
        self.offsets = _two(offsets, "offsets", "of electrons", "give those of columns and of rows: 0.5, 0.2")
        self.systematic = _two(systematic, "systematic", "of the field", "give those of gaze x and y: 1e-4, 1e-4")
        self._free = tuple(name for name in (*self.quantities, *self.nuisances) if name not in (*SLOW, *PHASE))
        self._model = CountModel(scene.probe.sensor, unevenness)
        self._pictures: dict[int, tuple[Pictures, Bank]] = {}
        self._banks_between: dict[int, Bank] = {}
        self._finer = None if accuracy is not None else Finer(scene, _PICTURES)

    def fit(self, dataset: xr.Dataset, *, progress: Progress = quiet) -> Self:
        """Check that a dataset has the estimated labels, and crops that fit this scene's probe; nothing is learned.

        Raises
        ------
        InputError
            When a label is missing, or the depth or size of the crops is not the probe's.
        """
        del progress
        dataset.tp.values(tuple(name for name in self.quantities if name in (*SLOW, "object_distance", "focal_length")))
        like = np.zeros((1, dataset.tp.side, dataset.tp.side), np.uint8)
        checked(like, dataset.tp.full_scale, self.scene.probe.sensor, self.window)
        self.data_hash_ = dataset.tp.train.tp.hash
        return self

    def predict(
        self,
        data: Data,
        *,
        full_scale: float | None = None,
        progress: Progress = quiet,
        anyway: bool = False,
        unit: str | None = None,
    ) -> Prediction:
        """As `Predictor.predict`, with 90 % intervals from each fit's own covariance; also of whole frames [N, H, W].

        `full_scale` is the largest digital number, the probe's own when None.
        """
        first, depth = next(self._batches(data, full_scale))
        for image in first:
            # Prepared here, so that its progress bar does not appear within that of the images.
            self._prepared(len(self._seen(image, depth)[0]), progress)
        return super().predict(data, full_scale=full_scale, progress=progress, anyway=anyway, unit=unit)

    def _progress_label(self) -> str:
        return "fitting"

    def _batches(self, data: Data, full_scale: float | None) -> Iterator[tuple[NDArray[np.generic], Any]]:
        if isinstance(data, xr.Dataset):
            stacks = data.tp.images(16) if data.sizes["frame"] else [np.empty((0, data.tp.side, data.tp.side))]
            full_scale = data.tp.full_scale if full_scale is None else full_scale
        else:
            stacks = [np.asarray(data)[None] if np.ndim(data) == 2 else np.asarray(data)]
        for images in stacks:
            yield from ((images[k : k + 1], full_scale) for k in range(max(1, len(images))))

    def _estimate(self, images: NDArray[np.generic], full_scale: float | None, own: bool = True) -> Prediction:
        del own  # It knows one scene alone.
        found = [self.fit_image(image, full_scale=full_scale) for image in images]
        value, lower, upper = (
            np.array([getattr(one, name) for one in found], np.float64).reshape(len(found), len(self.quantities))
            for name in ("values", "lower", "upper")
        )
        why = "the scene does not explain it: residuals {:.3g} times the noise's"
        reasons = ["" if one.misfit <= LOST else why.format(one.misfit) for one in found]
        raw = judged(Prediction(self.quantities, value, lower, upper), None)
        return raw.because([own or other for own, other in zip(reasons, raw.reason, strict=True)], described=True)

    def fit_image(
        self, image: NDArray[np.generic], *, full_scale: float | None = None, progress: Progress = quiet
    ) -> SimulationFitResult:
        """Fit one crop [side, side] or frame [H, W]; places count from its middle.

        Raises
        ------
        InputError
            For an image that the scene's probe cannot have taken.
        """
        sensor = self.scene.probe.sensor
        counts, middle = self._seen(image, full_scale)
        pictures, bank = self._prepared(len(counts), progress)
        search = Search(pictures, counts, self._model, self._free, self.offsets)
        electrons = (counts - sensor.offset) / gain_of(sensor)
        _, slope, variance = self._model(np.maximum(electrons, 1.0))

        def poses(bank: Bank) -> list[Pose]:
            found = bank.match(electrons, slope**2 / variance, _FARTHER * self.starts)
            if "power" in self._free:
                return found
            return [replace(pose, power=self.scene.illumination.power) for pose in found]

        usual = poses(bank)
        tops = climbed(search, usual[: self.starts])
        starts, (fine, found, moved) = len(tops), self._refined(search, tops)
        if found[0].misfit > EXPLAINED:
            between = poses(self._bank_between(len(counts), progress))
            tops = farther(search, tops, usual[: self.starts], between, (_FARTHER - 1) * self.starts)
            starts, (fine, found, moved) = len(tops), self._refined(search, tops)
        search, tops = fine, found
        rivals = [top for top in tops[1:] if not same_top(top, tops[0])]
        periods = periods_of(search, tops[0]) if self._phase_known(search.pictures) else tops[:1]
        systematic = dict(zip(self.quantities, moved.tolist(), strict=True))
        for name, own in zip(SLOW, self.systematic, strict=True):
            systematic[name] = math.hypot(own, systematic.get(name, 0.0))
        return result_of(self.quantities, periods, rivals, starts, middle, systematic)

    def bounds(self, gaze: tuple[float, float]) -> dict[str, float]:
        """Return the Cramér-Rao bound on each parameter's standard deviation, for one crop.

        The RR lies in the middle of the crop and all else is the scene's own; this model's nuisances are unknown. With
        `phase_x` and `phase_y` among them, the bound holds for an unknown position of the photosites; without them, for
        a known photosite period.

        Parameters
        ----------
        gaze
            Fractions of the field.
        """
        pictures, _ = self._prepared(min(self.window, *self.scene.probe.sensor.pixels), quiet)
        found = self._deviations(pictures, gaze)
        for finer in () if self._finer is None else self._finer.steps(pictures.side):
            # Near the middle of the field, where a picture changes least, their error would pass for information.
            before, found = found, self._deviations(finer, gaze)
            if (np.abs(found / before - 1) <= SAME_BOUND).all():
                break
        return dict(zip(self.quantities, found.tolist(), strict=True))

    def _deviations(self, pictures: Pictures, gaze: tuple[float, float]) -> Array:
        """Return the bounds [P] at a gaze, by these pictures."""
        blank = np.zeros((pictures.side, pictures.side))
        search = Search(pictures, blank, self._model, self._free, self.offsets)
        phase = set(PHASE) <= set(self.nuisances)
        top = search.climb(replace(pictures.start(), gaze=gaze), phase=phase, steps=0)
        deviations = np.sqrt(np.maximum(top.covariance.diagonal(), 0.0))
        return deviations[[top.names.index(name) for name in self.quantities]]

    def parameters(self) -> dict[str, Any]:
        names = ("starts", "accuracy", "window", "unevenness", "nodes", "seed")
        lists = {name: list(getattr(self, name)) for name in ("nuisances", "offsets", "systematic")}
        lists["parameters"] = list(self.quantities)
        return {"scene": scene_dict(self.scene), **lists, **{name: getattr(self, name) for name in names}}

    def state(self) -> dict[str, torch.Tensor]:
        """Return nothing, since a fit learns from no dataset."""
        return {}

    @classmethod
    def from_state(
        cls, parameters: Mapping[str, Any], state: Mapping[str, torch.Tensor], classes: tuple[str, ...] = ()
    ) -> Self:
        del state, classes
        given = dict(parameters)
        scene = scene_from_dict(given.pop("scene"))
        return cls(scene, tuple(given.pop("parameters")), tuple(given.pop("nuisances")), **given)

    def _seen(self, image: NDArray[np.generic], full_scale: float | None) -> tuple[Array, Array]:
        """Return the pixels of the window, and its middle from the image's, in metres."""
        sensor = self.scene.probe.sensor
        shown = checked(np.asarray(image)[None], full_scale, sensor, self.window)[0]
        return looked_at(shown, sensor, self.window)

    def _prepared(self, side: int, progress: Progress) -> tuple[Pictures, Bank]:
        """Return the images and the bank for crops of `side` pixels, from a cache."""
        if side not in self._pictures:
            self._pictures[side] = self._as_fine_as_can_be(side, progress)
        pictures, bank = self._pictures[side]
        if pictures.period is None and set(PHASE) & set(self.nuisances):
            what = "no photosites show in this scene's pictures"
            raise InputError(what, where="nuisances", remedy=f"leave {' and '.join(PHASE)} out")
        return pictures, bank

    def _as_fine_as_can_be(self, side: int, progress: Progress) -> tuple[Pictures, Bank]:
        """Return the images at the accuracy, or at the finest, up to the scene's own, that the whole field allows."""
        accuracy, own = self.accuracy, self.scene.sampling.accuracy
        while True:
            try:
                pictures = Pictures(self.scene, side, accuracy, count=_PICTURES)
                nodes = self.nodes or (_NODES if pictures.period is None else _NODES_SLOW)
                return pictures, Bank(pictures, nodes, progress)
            except InputError:
                if accuracy is None or accuracy >= own:
                    raise
                accuracy = min(COARSER * accuracy, own)

    def _bank_between(self, side: int, progress: Progress) -> Bank:
        """Return the bank with nodes halfway between, or the usual one where that is fine already; from a cache."""
        pictures, bank = self._pictures[side]
        if (nodes := 2 * bank.nodes - 1) > _NODES:
            return bank
        if side not in self._banks_between:
            self._banks_between[side] = Bank(pictures, nodes, progress)
        return self._banks_between[side]

    def _phase_known(self, pictures: Pictures) -> bool:
        """Whether photosites show whose place under the spot is known, so that the gaze is as precise as they tell."""
        return pictures.period is not None and not set(PHASE) <= set(self.nuisances)

    def _refined(self, search: Search, tops: list[Top]) -> tuple[Search, list[Top], Array]:
        """Return what `refined` does; where pictures have one accuracy alone, what is given."""
        if self._finer is None:
            return search, tops, np.zeros(len(self.quantities))
        return refined(search, tops, self._finer, self.quantities, phase_known=self._phase_known(search.pictures))


def _two(values: Sequence[float], where: str, what: str, remedy: str) -> tuple[float, float]:
    """Return two numbers, 0 or more."""
    if len(values) != 2 or not all(np.isfinite(one) and one >= 0 for one in values):
        raise InputError(f"must be two numbers {what}, 0 or more, is {list(values)}", where=where, remedy=remedy)
    return float(values[0]), float(values[1])


def _check_names(parameters: tuple[str, ...], nuisances: tuple[str, ...]) -> None:
    """Refuse names that are unknown or given twice."""
    known = (*SLOW, *FREE)
    for where, names, allowed in (("parameters", parameters, known), ("nuisances", nuisances, (*known, *PHASE))):
        for name in names:
            if name not in allowed:
                raise InputError(f"unknown parameter {name!r}", where=where, remedy=f"use {', '.join(allowed)}")
    every = (*parameters, *nuisances)
    if not parameters or len(set(every)) < len(every):
        what = f"{list(parameters)} and nuisances {list(nuisances)} name none, or one twice"
        raise InputError(what, where="parameters", remedy="name each once")
    if len(set(every) & set(PHASE)) == 1:
        raise InputError("one phase alone cannot be free", where="nuisances", remedy=f"name {' and '.join(PHASE)}")
