"""Mean and variance of a pixel's digital number for its mean electrons, rounding included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import gammaln, ndtr

from tapetum.bench import ProbeSensor
from tapetum.simulate.exposure import count_moments, gain_of

__all__ = ["CountModel"]

Array = NDArray[np.float64]
# Spacing of the table in square roots of electrons: 1/50 of the shot noise's standard deviation.
_STEP = 0.01
# Standard deviation in digital numbers from which rounding only adds 1/12 to the variance (mean error below 1e-8).
_FINE = 1.0
# Least variance: the square of a seventh of a digital number.
_LEAST = 0.02
# Mean electrons up to which the counts of a coarse scale are summed one by one; beyond, a series serves (error 1e-6).
_SUMMED = 400.0
# Digital numbers that are summed on either side of the mean, and how many electrons, in standard deviations.
_REACH, _DEVIATIONS = 9, 10
# Nodes of the average over the pixels' sensitivities.
_SENSITIVITIES = 9


class CountModel:
    """Mean, slope and variance of the digital numbers of a probe's sensor, hot pixels excluded.

    `unevenness` is the RMS of the pixels' relative sensitivity, over which the moments are averaged.
    `exposure.count_moments` adds 1/12 for rounding, which holds where the noise spans some digital numbers. An 8-bit
    probe's dark pixels scatter by only a quarter of one: there the moments are summed over the digital numbers, for
    electrons that are Poisson distributed with normal read noise. Normal ones of the same variance would put the mean
    off by up to a hundredth of a digital number, which a background over many pixels shows.
    """

    def __init__(self, sensor: ProbeSensor, unevenness: float = 0.0) -> None:
        self.sensor = replace(sensor, hot_pixels=0.0)
        gain = gain_of(sensor)
        top = min(2**sensor.bits - 1, gain * sensor.full_well + sensor.offset)
        most = max(0.0, (top - sensor.offset) / gain)
        last = most + 20 * (most + sensor.read_noise**2) ** 0.5 + 400
        self._nodes = np.square(np.arange(2 + int(last**0.5 / _STEP)) * _STEP)
        numbers, variance = (one.numpy() for one in count_moments(torch.from_numpy(self._nodes), self.sensor))
        coarse = gain * np.sqrt(self._nodes + sensor.read_noise**2) < _FINE
        if coarse.any():
            numbers[coarse], variance[coarse] = _rounded(self._nodes[coarse], sensor, np.rint(top))
        if unevenness:
            numbers, variance = self._averaged(numbers, variance, unevenness)
        self._expected, self._variance = numbers, np.maximum(variance, _LEAST)
        slope = np.gradient(numbers, self._nodes)
        # Rounding errors would leave a slope in saturation.
        self._slope = np.where(slope > 1e-6 * gain, slope, 0.0)
        self._steps = tuple(np.diff(table) for table in (self._expected, self._slope, self._variance))

    def __call__(self, mean: Array) -> tuple[Array, Array, Array]:
        """Return expected digital numbers, their derivative by the mean electrons, and their variance; any shape."""
        # The nodes are evenly spaced in the root, so that none has to be searched for.
        inside = np.clip(mean, 0.0, self._nodes[-1])
        below = np.minimum((np.sqrt(inside) * (1 / _STEP)).astype(np.intp), len(self._nodes) - 2)
        start = self._nodes[below]
        share = (inside - start) / (self._nodes[below + 1] - start)
        expected, slope, variance = (
            table[below] + share * steps[below]
            for table, steps in zip((self._expected, self._slope, self._variance), self._steps, strict=True)
        )
        return expected, slope, variance

    def _averaged(self, numbers: Array, variance: Array, unevenness: float) -> tuple[Array, Array]:
        """Return mean and variance of pixels whose sensitivities are normally distributed."""
        places, weights = np.polynomial.hermite_e.hermegauss(_SENSITIVITIES)
        first, second = np.zeros_like(numbers), np.zeros_like(numbers)
        for place, weight in zip(places, weights / weights.sum(), strict=True):
            at = self._nodes * max(0.0, 1 + unevenness * place)
            own = np.interp(at, self._nodes, numbers)
            first += weight * own
            # About the number of the mean sensitivity: squares of the numbers themselves would lose digits.
            second += weight * (np.interp(at, self._nodes, variance) + (own - numbers) ** 2)
        return first, second - (first - numbers) ** 2


def _rounded(light: Array, sensor: ProbeSensor, top: float) -> tuple[Array, Array]:
    """Return mean and variance of the digital numbers, 0 to `top`, for mean electrons [M] whose noise is below one."""
    gain = gain_of(sensor)
    middle = np.rint(gain * light + sensor.offset)
    numbers = middle[:, None] + np.arange(-_REACH, _REACH + 1)
    edges = np.asarray((numbers[:, 1:] - 0.5 - sensor.offset) / gain, np.float64)
    below = np.empty_like(edges)
    few = light <= _SUMMED
    below[few] = _summed(light[few], edges[few], sensor.read_noise)
    below[~few] = _in_series(light[~few], edges[~few], sensor.read_noise)
    chance = np.diff(below, axis=1, prepend=0.0, append=1.0)
    kept = np.clip(numbers, 0, top)
    mean = (chance * kept).sum(1)
    return mean, (chance * (kept - mean[:, None]) ** 2).sum(1)


def _summed(light: Array, edges: Array, read_noise: float) -> Array:
    """Return the chance [M, E] of fewer electrons than `edges`, for Poisson electrons of mean [M] with read noise."""
    if not len(light):
        return np.zeros(edges.shape)
    most = float(light.max())
    count = np.arange(int(most + _DEVIATIONS * (most + 1) ** 0.5) + 10)
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.where(count == 0, 0.0, count * np.log(light)[:, None])
    chance = np.exp(log - light[:, None] - gammaln(count + 1))
    # Edges repeat from node to node.
    single, which = np.unique(edges, return_inverse=True)
    noise = max(read_noise, 1e-6)
    total = chance @ ndtr((single - count[:, None]) / noise)
    return np.take_along_axis(total, which.reshape(edges.shape), 1)


def _in_series(light: Array, edges: Array, read_noise: float) -> Array:
    """Return the same by Edgeworth's series to the second order.

    M. G. Kendall, A. Stuart, The Advanced Theory of Statistics 1, chapter 6.
    """
    variance = (light + read_noise**2)[:, None]
    z = (edges - light[:, None]) / np.sqrt(variance)
    skewness, excess = light[:, None] / variance**1.5, light[:, None] / variance**2
    two, three, five = z**2 - 1, z**3 - 3 * z, z**5 - 10 * z**3 + 15 * z
    density = np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)
    return ndtr(z) - density * (skewness / 6 * two + excess / 24 * three + skewness**2 / 72 * five)
