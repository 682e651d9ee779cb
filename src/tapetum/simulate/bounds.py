"""Cramér-Rao bounds of the gaze by its distance from the centre, and of the focus, for the frames of training sets.

Light, second beam, exposure, background, bits and noise are the scene's. The sensor's fixed pattern (1 % of the pixels'
sensitivity) is left out, because an estimate may know it.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from tapetum.bench import Scene, with_values
from tapetum.errors import InputError
from tapetum.processes import context_of
from tapetum.progress import Progress, quiet
from tapetum.simulate.information import FisherInformation, information_of, slopes_of

__all__ = ["ALL_UNKNOWN", "FRAME", "FocusBounds", "GazeBound", "GazeInformation", "focus_bounds", "gaze_bounds"]
__all__ += ["gaze_information", "gaze_prior", "rings_of_gazes"]

FRAME = ("power", "place_x", "place_y")
"""Nuisances of every hand-held target: brightness and place of its RR."""

ALL_UNKNOWN = (*FRAME, "photosite_x", "photosite_y", "roll")
"""Those, the roll of the hand, and the spot's phase on the photosites.

The picture repeats each time that the spot moves by one photosite, some 4e-4 of the field. An estimate that knows on
which photosite the spot lies would read the gaze from this a hundred times better than from all else. Without that
knowledge the phase carries no information about the gaze, and the limit is that of the slow change from one photosite
to the next.
"""

Array = NDArray[np.float64]
_GAZE, _FOCUS = ("gaze_x", "gaze_y"), ("object_distance", "focal_length")
# MAE of a Gaussian error with the standard deviation 1.
_MAE = math.sqrt(2 / math.pi)
# Azimuths off the sensor's axes and diagonals, where the symmetry makes special cases.
_FIRST_AZIMUTH = 0.35


@dataclass(frozen=True)
class GazeBound:
    """The limit of the gaze by the distance from the field's centre.

    Parameters
    ----------
    distance
        [R] in fractions of the field.
    rms, mae
        [R] of the best unbiased estimate, mean over both axes, median over the azimuths; fractions of the field. The
        MAE assumes a Gaussian error.
    """

    distance: Array
    rms: Array
    mae: Array


@dataclass(frozen=True)
class GazeInformation:
    """Information of one frame at each of many gazes.

    Parameters
    ----------
    names
        Of the parameters; `gaze_x` and `gaze_y` first.
    gazes
        [G, 2] in fractions of the field.
    information
        [G, P, P] Fisher matrices.
    """

    names: tuple[str, ...]
    gazes: Array
    information: Array

    def bounds(self, nuisances: Sequence[str] | None = None, priors: Mapping[str, float] | None = None) -> Array:
        """Standard deviations [G, 2] of gaze_x and gaze_y while the nuisances are unknown, by default all.

        Parameters
        ----------
        nuisances
            Of `names`. All others count as known.
        priors
            Standard deviations known before the frame, by name. The bound is then van Trees', which also holds for
            biased estimates, with the information at this gaze in place of its mean over the prior.
        """
        return _bounds(self.names, self.information, _GAZE, self.names[2:] if nuisances is None else nuisances, priors)

    def curve(self, nuisances: Sequence[str] | None = None, priors: Mapping[str, float] | None = None) -> GazeBound:
        """The bounds by the distance from the centre; gazes of the same distance, to 1e-6, are combined."""
        deviation = self.bounds(nuisances, priors)
        distance = np.hypot(self.gazes[:, 0], self.gazes[:, 1]).round(6)
        rings = np.unique(distance)
        rms, mean = np.sqrt((deviation**2).mean(1)), deviation.mean(1)
        return GazeBound(
            rings,
            np.array([np.median(rms[distance == one]) for one in rings]),
            _MAE * np.array([np.median(mean[distance == one]) for one in rings]),
        )


@dataclass(frozen=True)
class FocusBounds:
    """Limits of object distance and focal length, both unknown, for pairs of them.

    Parameters
    ----------
    object_distances, focal_lengths
        [D] and [F] in metres.
    names
        Of all that is unknown.
    information
        [D, F, P, P] Fisher matrices of one frame.
    """

    object_distances: Array
    focal_lengths: Array
    names: tuple[str, ...]
    information: Array

    @property
    def deviation(self) -> Array:
        """[D, F, 2] standard deviations of object distance and focal length, in metres."""
        return self.bounds(_FOCUS)

    @property
    def mae(self) -> Array:
        """[D, F, 2] mean absolute errors of the best estimate with Gaussian errors, in metres."""
        return _MAE * self.deviation

    def bounds(self, wanted: Sequence[str], unknown: Sequence[str] | None = None) -> Array:
        """Standard deviations [D, F, W] of the wanted names while the `unknown` ones are unknown, by default all."""
        return _bounds(self.names, self.information, wanted, self.names if unknown is None else unknown)


def gaze_prior(extent: float) -> float:
    """Standard deviation, extent/π, to pass in `priors` for a gaze within ± extent.

    Van Trees' bound requires a prior density that vanishes at its ends. Of these cos²(πx/2e) has the least information,
    (π/e)². The sets' uniform density does not vanish there, and carries no more information.
    """
    return extent / math.pi


def gaze_information(
    scene: Scene,
    gazes: ArrayLike,
    nuisances: Sequence[str] = ALL_UNKNOWN,
    *,
    accuracy: float | None = None,
    progress: Progress = quiet,
) -> GazeInformation:
    """Fisher information of one frame at many gazes, by one camera that is prepared once.

    Parameters
    ----------
    scene
        Of the set, as `make_plan` has it.
    gazes
        [G, 2] in fractions of the field.
    nuisances
        Other unknowns, as `fisher` names them; of traced lenses also `roll`, `photosite_x` and `photosite_y`.
    accuracy
        Of the simulation, in place of the scene's.
    progress
        Reports how many gazes are done.

    Raises
    ------
    InputError
        For gazes of another shape, not finite, or outside the field, and as `fisher`.
    """
    at, names = _checked(gazes), (*_GAZE, *nuisances)
    slopes = slopes_of(scene, names, torch.as_tensor(at), accuracy=accuracy, dtype=torch.complex64)
    numbers = progress(range(len(at)), "bounding the gaze", total=len(at))
    found = [information_of(*slopes(number), scene.probe.sensor) for number in numbers]
    return GazeInformation(names, at, torch.stack(found).numpy())


def gaze_bounds(
    scene: Scene,
    gazes: ArrayLike,
    nuisances: Sequence[str] = FRAME,
    *,
    priors: Mapping[str, float] | None = None,
    accuracy: float | None = None,
    progress: Progress = quiet,
) -> Array:
    """Standard deviations [G, 2] of unbiased estimates of gaze_x and gaze_y from one frame, in fractions of the field.

    Parameters as for [`gaze_information`][tapetum.simulate.bounds.gaze_information], `priors` as for its `bounds`.
    """
    return gaze_information(scene, gazes, nuisances, accuracy=accuracy, progress=progress).bounds(priors=priors)


def rings_of_gazes(distances: ArrayLike, azimuths: int = 4) -> Array:
    """Gazes [G, 2] at distances from the centre, each under several azimuths; one at the centre itself."""
    found: list[tuple[float, float]] = []
    for distance in np.asarray(distances, dtype=np.float64):
        for number in range(azimuths if distance > 0 else 1):
            angle = 2 * math.pi * number / azimuths + _FIRST_AZIMUTH
            found.append((distance * math.cos(angle), distance * math.sin(angle)))
    return np.array(found)


def focus_bounds(
    scene: Scene,
    object_distances: Sequence[float],
    focal_lengths: Sequence[float],
    gaze: tuple[float, float] = (0.06, 0.04),
    nuisances: Sequence[str] = (*_GAZE, *FRAME),
    *,
    accuracy: float | None = None,
    workers: int = 1,
    progress: Progress = quiet,
) -> FocusBounds:
    """Limits of object distance and focal length, both unknown, from one frame of each pair.

    Parameters
    ----------
    scene
        Of the set; its focus and focal length are replaced.
    object_distances, focal_lengths
        In metres.
    gaze
        In fractions of the field.
    nuisances
        Other unknowns.
    accuracy, progress
        As for `gaze_information`.
    workers
        Processes to share the pairs among.

    Raises
    ------
    InputError
        As `gaze_information`, and for focal lengths and distances that the lens does not offer.
    """
    at, names = _checked([gaze]), (*_FOCUS, *nuisances)
    pairs = [(distance, length) for distance in object_distances for length in focal_lengths]
    scenes = [
        with_values(scene, {"target.object_distance": distance, "target.lens.focal_length": length})
        for distance, length in pairs
    ]
    one = functools.partial(_focus_information, names=names, at=torch.as_tensor(at), accuracy=accuracy)
    with contextlib.ExitStack() as stack:
        found = map(one, scenes)
        if workers > 1:
            context = context_of(__name__)
            pool = ProcessPoolExecutor(workers, mp_context=context, initializer=torch.set_num_threads, initargs=(1,))
            found = stack.enter_context(pool).map(one, scenes)
        matrices = torch.stack(list(progress(found, "bounding the focus", total=len(pairs)))).numpy()
    size = len(names)
    matrices = matrices.reshape(len(object_distances), len(focal_lengths), size, size)
    return FocusBounds(np.asarray(object_distances, float), np.asarray(focal_lengths, float), names, matrices)


def _focus_information(scene: Scene, names: tuple[str, ...], at: torch.Tensor, accuracy: float | None) -> torch.Tensor:
    slopes = slopes_of(scene, names, at, accuracy=accuracy, dtype=torch.complex64)
    return information_of(*slopes(0), scene.probe.sensor)


def _bounds(
    names: tuple[str, ...],
    information: Array,
    wanted: Sequence[str],
    unknown: Sequence[str],
    priors: Mapping[str, float] | None = None,
) -> Array:
    """Cramér-Rao bounds [..., W] of the wanted names from information [..., P, P], all but the unknown ones known."""
    priors, own = priors or {}, tuple(dict.fromkeys((*wanted, *unknown)))
    for name in (*own, *priors):
        if name not in names:
            raise InputError(f"{name!r} was not differentiated by", where="nuisances", remedy=f"use {', '.join(names)}")
    index = [names.index(name) for name in own]
    before = np.diag([priors[name] ** -2 if name in priors else 0.0 for name in own])
    matrices = torch.as_tensor(information[..., index, :][..., index] + before)
    found = [FisherInformation(own, (0.0,) * len(own), one).bounds for one in matrices.flatten(0, -3)]
    return np.array([[one[name] for name in wanted] for one in found]).reshape(*information.shape[:-2], len(wanted))


def _checked(gazes: ArrayLike) -> Array:
    at = np.atleast_2d(np.asarray(gazes, dtype=np.float64))
    if at.ndim != 2 or at.shape[1] != 2 or not len(at):
        raise InputError(f"must be [G, 2], are {list(at.shape)}", where="gazes", remedy="give x and y of each")
    if not (np.isfinite(at).all() and (np.abs(at) <= 0.5).all()):
        raise InputError("must be numbers from -0.5 to 0.5", where="gazes", remedy="give fractions of the field")
    return at
