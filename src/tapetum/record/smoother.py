"""A hand's path between the frames of a camera: a Gaussian process whose spectrum is fitted to the frames themselves.

The path is a sum of cosines and sines on a fine grid of frequencies, with normal coefficients whose variances are equal
within a bin of frequencies. The variances maximise the likelihood of the measured places, which also distinguishes
aliases: frames that are not exactly periodic, because of jitter or of a rolling shutter, show a frequency and its alias
differently. Where they do not differ, the power stays shared between them, and the deviation is wide.

The maximum is found by multiplying each variance by the ratio of the power that the data show to the power that they
would show on average (the fixed point of the likelihood's derivative; compare MacKay, Neural Computation 4, 415
(1992), and Zhou et al., J. Comput. Graph. Stat. 28, 350 (2019)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.ndimage import maximum_filter1d

from tapetum.errors import InputError

__all__ = ["Path", "Samples", "Smoothed", "block_seconds", "fit_path", "smooth"]

Array = npt.NDArray[np.float64]

HIGHEST = 20.0
"""Hz. A hand-held camera hardly moves above: tremor ends at some 12 Hz (Elble and Koller, Tremor, 1990)."""
BIN, SHARE = 0.5, 0.35  # Hz, widest bin; and widest bin as a share of its lowest frequency
SWAY, TREMOR = 3.0, 12.0  # Hz: up to the first any amplitude, above the second amplitudes fall
LARGEST = 0.02  # of the field: largest RMS of one bin above SWAY
STEPS, ENOUGH = 40, 0.05  # most steps, and the gain of log-likelihood that ends them
LEVEL = 10.0  # variance of the constant part, in squared fractions of the field: any
NOISE = (1.0, 25.0)  # range of the noise's variance over the stated one, which is the least possible
SURE = 0.5
"""Factor on the path's part of a deviation, where the frames determine the path almost completely. Fitted powers cannot
be negative, so that a fit leaves some at aliases where the hand has none, and the deviation is too wide by about this
factor; where an alias cannot be excluded, it is right. Measured on simulated hands (scripts/measure_labels.py, seeds
100 to 105, bands of the bench and random ones): the 90 % intervals hold 89 to 94 % with the factor, 91 to 99 % without.
"""
BLUR = 0.003  # deviation of a streak's middle in lengths of the streak (measured: a ghost within its reach moves it)
STAMP = (1e-12, 1e-5)  # s^2, range of the variance of time stamps; the upper end is 3 ms RMS


@dataclass(frozen=True, eq=False)
class Samples:
    """Places of a laser in a camera's frames.

    Attributes
    ----------
    times
        [N] s, rising: the middle of the exposure of the spot's own row.
    places
        [N, K] in fractions of the field.
    deviations
        [N] standard deviations of the places, from the spot's fit.
    exposure
        Exposure time in seconds, over which a place is averaged.
    """

    times: Array
    places: Array
    deviations: Array
    exposure: float = 0.0

    def __post_init__(self) -> None:
        fits = self.places.ndim == 2 and len(self.times) == len(self.places) == len(self.deviations) > 1
        if not fits or not all(np.isfinite(one).all() for one in (self.times, self.places, self.deviations)):
            what = "times [N], places [N, K] and deviations [N] must be finite, of one length, and two or more"
            raise InputError(what, where="samples", remedy="leave frames without a spot away")

    def __len__(self) -> int:
        return len(self.times)

    def part(self, chosen: npt.NDArray[np.bool_]) -> Self:
        """Return the chosen samples, [N] bool."""
        return type(self)(self.times[chosen], self.places[chosen], self.deviations[chosen], self.exposure)

    @property
    def variances(self) -> Array:
        """Stated variances [N, K] of the places, to which a spot's streak during the exposure adds."""
        return self.deviations[:, None] ** 2 + (BLUR * self.exposure * self.speeds) ** 2

    @property
    def speeds(self) -> Array:
        """Speeds [N, K] along the axes, in fields a second, from straight lines through five frames."""
        reach = np.clip(np.arange(len(self))[:, None] + np.arange(-2, 3), 0, len(self) - 1)
        times, places = self.times[reach], self.places[reach]
        since = times - times.mean(axis=1, keepdims=True)
        return (since[..., None] * places).sum(axis=1) / np.maximum((since**2).sum(axis=1), 1e-12)[:, None]


@dataclass(frozen=True, eq=False)
class Path:
    """A fitted path.

    Attributes
    ----------
    frequencies, power
        [F] Hz, and variance of the cosine and of the sine of each, in squared fractions of the field: the mean over the
        axes.
    gains
        [K] quick motion's power along each axis over that mean.
    noise, stamp
        [K] variances of the measured places over the stated ones along each axis, and the variance of the time stamps
        in s^2, all fitted.
    samples
        What it was fitted to.
    surprise
        [N, K] difference of each sample from what all others predict, in standard deviations of that prediction.
    """

    frequencies: Array
    power: Array
    gains: Array
    noise: Array
    stamp: float
    samples: Samples
    surprise: Array

    def at(self, times: Array, reach: float) -> tuple[Array, Array, npt.NDArray[np.intp]]:
        """Return places [T, K] and standard deviations [T, K] at times [T] (s) from the samples within `reach` seconds.

        The deviation includes the errors of the asked times, which are taken to be as those of the samples' stamps. The
        last result is [T, 2], the first sample used and the one after the last; without samples the places are NaN and
        the deviations infinite.
        """
        samples, middle = self.samples, float(self.samples.times.mean())
        error = _error(samples, self.noise, self.stamp)
        common = error.mean(axis=1)
        own = _waves(self.frequencies, samples.times - middle, samples.exposure)
        asked = _waves(self.frequencies, times - middle, 0.0)
        among = (own * self.power) @ own.T + LEVEL
        among[np.diag_indices(len(samples))] += common
        between = (asked * self.power) @ own.T + LEVEL
        alone = float(self.power.sum() / 2) + LEVEL
        # Power whose alias frames of this rate cannot exclude.
        interval = float(np.median(np.diff(samples.times)))
        quick = float(self.power[: len(self.frequencies)][self.frequencies > 0.25 / interval].sum())
        used = np.searchsorted(samples.times, times[:, None] + np.array([-reach, reach]))
        mean = samples.places.mean(axis=0)
        found, deviation = (np.full((len(times), samples.places.shape[1]), one) for one in (np.nan, np.inf))
        late = self.stamp * np.stack([np.interp(times, samples.times, axis**2) for axis in samples.speeds.T], axis=1)
        for n, (first, last) in enumerate(used):
            if last == first:
                continue
            share = cho_solve(cho_factor(among[first:last, first:last], lower=True), between[n, first:last])
            found[n] = mean + share @ (samples.places[first:last] - mean)
            left = max(alone - float(share @ between[n, first:last]), 0.0)
            measured = share**2 @ error[first:last]
            unseen = max(left - float(share**2 @ common[first:last]), 0.0)
            open_part = np.sqrt(min(unseen / max(quick, 1e-18), 1.0))
            factor = SURE + (1 - SURE) * open_part
            deviation[n] = np.sqrt(measured + self.gains * unseen * factor**2 + late[n])
        return found, deviation, used


def _error(samples: Samples, noise: Array, stamp: float) -> Array:
    """Return the variances [N, K] of samples' places, those of their stamps included."""
    return noise * samples.variances + stamp * samples.speeds**2


def _waves(frequencies: Array, times: Array, exposure: float) -> Array:
    """Return cosines and sines [T, 2 F] averaged over an exposure (s) around times [T] (s)."""
    angle = 2 * np.pi * frequencies * times[:, None]
    return np.hstack([np.cos(angle), np.sin(angle)]) * np.tile(np.sinc(frequencies * exposure), 2)


def _bins(seconds: float) -> tuple[Array, npt.NDArray[np.intp]]:
    """Return frequencies [F] for a path of so many seconds, and the bin of each, [F]."""
    # Half the spacing of a Fourier series over that time, so that the ends of the path do not meet.
    step = 1 / (2 * seconds)
    frequencies: Array = (np.arange(1, max(2, int(HIGHEST / step)) + 1) * step).astype(np.float64)
    edges = [step / 2]
    while edges[-1] < frequencies[-1]:
        edges.append(edges[-1] + max(step, min(BIN, SHARE * edges[-1])))
    numbers = np.searchsorted(edges, frequencies, side="right") - 1
    return frequencies, np.unique(numbers, return_inverse=True)[1]


def fit_path(samples: Samples) -> Path:
    """Fit the spectrum of a hand's path to samples of it.

    Parameters
    ----------
    samples
        Some seconds of a recording: 64 samples or more give a useful spectrum.

    Returns
    -------
    Path
        Which gives the place at any time. The spectrum is a maximum of the likelihood, the place a mean over the
        process with that spectrum.
    """
    times = samples.times - samples.times.mean()
    frequencies, bins = _bins(float(np.ptp(times)))
    counts, both = np.bincount(bins), np.tile(bins, 2)
    centres = np.bincount(bins, frequencies) / counts
    waves = _waves(frequencies, times, samples.exposure)
    places = samples.places - samples.places.mean(axis=0)
    # A hand's slow sweep and a small tremor: as vague as it can be, since the likelihood decides.
    total = max(float(places.var()), 1e-12)
    power = (10 * total / (1 + (centres / 0.3) ** 4) + 1e-6 / (1 + (centres / TREMOR) ** 6)) / len(frequencies)
    # No hand swings its camera at the frame rate: frames with a rolling shutter would take such a swing for a sweep.
    fall = np.minimum(1.0, (TREMOR / centres) ** 4)
    most = np.where(centres < SWAY, np.inf, (LARGEST * fall) ** 2 / counts)
    # One spectrum for all axes, which tells aliases apart better than one for each.
    errors = np.stack([samples.variances.mean(axis=1), (samples.speeds**2).mean(axis=1)], axis=1)
    bounds, scale = np.array([NOISE, STAMP]).T, np.array([1.0, 1e-8])
    count, axes, before = len(samples), samples.places.shape[1], -np.inf
    for _ in range(STEPS):
        among = (waves * power[both]) @ waves.T + LEVEL
        among[np.diag_indices(count)] += errors @ scale
        factor = np.linalg.cholesky(among)
        solved = cho_solve((factor, True), places)
        likelihood = -0.5 * float((places * solved).sum()) - axes * float(np.log(np.diag(factor)).sum())
        if likelihood - before < ENOUGH:
            break
        before = likelihood
        root = solve_triangular(factor, np.hstack([waves, np.eye(count)]), lower=True, check_finite=False)
        expected = np.einsum("ij,ij->j", root, root)
        shown = ((waves.T @ solved) ** 2).mean(axis=1)
        ratio = np.bincount(both, shown) / np.bincount(both, expected[: len(both)])
        power = np.clip(power * ratio, 1e-18, most)
        ratios = (errors.T @ (solved**2).mean(axis=1)) / np.maximum(errors.T @ expected[len(both) :], 1e-300)
        scale = np.clip(scale * ratios, *bounds)
    among = (waves * power[both]) @ waves.T + LEVEL
    among[np.diag_indices(count)] += errors @ scale
    inverse = np.linalg.inv(among)
    solved = inverse @ places
    surprise = solved / np.sqrt(np.diag(inverse))[:, None]
    shown = power[both] @ (np.tile(frequencies > SWAY, 2)[:, None] * (waves.T @ solved) ** 2)
    return Path(
        frequencies,
        power[both],
        _of_axes(shown),
        scale[0] * _of_axes((samples.variances * solved**2).sum(axis=0)),
        float(scale[1]),
        samples,
        surprise,
    )


def _of_axes(shown: Array) -> Array:
    """Return what each axis shows, [K], over the mean of all: 1 where none shows any."""
    mean = float(shown.mean())
    return shown / mean if mean > 0 else np.ones(len(shown))


FEWEST = 64  # samples that a spectrum is fitted to
STRAY = 5.0  # deviations by which a sample that the others do not predict is left out


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A path at times [T]; where there are too few samples, places and reach are NaN and deviations infinite.

    Attributes
    ----------
    places, deviations
        [T, K] in fractions of the field, and their standard deviations.
    reach
        [T, 2] s, how far each place reaches back and ahead to the exposures of the samples used.
    strays
        [N] the samples that the others contradict; they were not used.
    """

    places: Array
    deviations: Array
    reach: Array
    strays: npt.NDArray[np.bool_]


def block_seconds(rate: float) -> tuple[float, float, float]:
    """Return the length of the blocks that are smoothed at once, and how far the samples of a block reach before its
    beginning and beyond its end, in seconds, at a frame rate in Hz.

    Blocks begin at multiples of their length from the first frame, so that any part of a recording that holds the
    samples of a block gives the same path.
    """
    # 180 frames or more, to recognise an alias; no more than 300, for speed.
    whole = min(max(4.0, 180 / rate), 300 / rate)
    return whole / 2, whole / 2, whole / 4


def smooth(samples: Samples, times: Array, rate: float) -> Smoothed:
    """Return a hand's path at times from a camera's samples of it, by a spectrum fitted to each block of some seconds.

    Parameters
    ----------
    samples
        Of the camera; times count from its first frame.
    times
        [T] s, of the same clock.
    rate
        Nominal frame rate of the camera in Hz.
    """
    places = np.full((len(times), samples.places.shape[1]), np.nan)
    deviations, reach = np.full(places.shape, np.inf), np.full((len(times), 2), np.nan)
    strays = np.zeros(len(samples), bool)
    length, back, ahead = block_seconds(rate)
    # Frames farther than this hardly add to a place, and labels that share no frame are independent.
    near = max(0.25, 6 / rate)
    blocks = np.floor(times / length).astype(int)
    for block in np.unique(blocks):
        begin, end = (block + np.array([0, 1])) * length
        around = (samples.times >= begin - back) & (samples.times < end + ahead)
        if np.count_nonzero(around) < FEWEST:
            continue
        path = fit_path(samples.part(around))
        surprise = np.abs(path.surprise).max(axis=1)
        # A stray makes its neighbours look odd too.
        odd = (surprise > STRAY) & (surprise == maximum_filter1d(surprise, 9))
        if 0 < np.count_nonzero(odd) < 0.1 * len(odd):
            chosen = around.copy()
            chosen[np.flatnonzero(around)[odd]] = False
            strays |= around & ~chosen
            path = fit_path(samples.part(chosen))
        asked = np.flatnonzero(blocks == block)
        found, deviation, used = path.at(times[asked], near)
        own = path.samples.times
        # A path is known between samples, not beyond them.
        middle = np.searchsorted(own, times[asked])
        held = (used[:, 0] < middle) & (middle < used[:, 1]) | np.isin(times[asked], own)
        first, last = own[np.minimum(used[:, 0], len(own) - 1)], own[np.maximum(used[:, 1] - 1, 0)]
        half = float(np.median(np.diff(own))) / 2
        span = np.stack([times[asked] - first, last - times[asked]], axis=1) + half
        known = asked[held]
        places[known], deviations[known], reach[known] = found[held], deviation[held], span[held]
    return Smoothed(places, deviations, reach, strays)
