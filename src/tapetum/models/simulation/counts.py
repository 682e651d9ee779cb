"""Mean and variance of a pixel's digital number for its mean electrons, rounding included."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import ndtr

from tapetum.bench import ProbeSensor
from tapetum.simulate.exposure import count_moments, gain_of

__all__ = ["CountModel"]

Array = NDArray[np.float64]
# Spacing of the table in square roots of electrons: 1/25 of the shot noise's standard deviation.
_STEP = 0.02
# Standard deviation in digital numbers from which rounding only adds 1/12 to the variance (mean error below 1e-8).
_FINE = 1.0
# Least variance: the square of a seventh of a digital number.
_LEAST = 0.02


class CountModel:
    """Mean, slope and variance of the digital numbers of a probe's sensor, hot pixels excluded.

    `unevenness`, the RMS of the pixels' relative sensitivity, counts as noise. `exposure.count_moments` adds 1/12 for
    rounding, which holds where the noise spans some digital numbers. An 8-bit probe's dark pixels scatter by only a
    quarter of one: there the moments are summed over the digital numbers for normally distributed electrons, so that
    the mean follows the staircase and estimates are not biased.
    """

    def __init__(self, sensor: ProbeSensor, unevenness: float = 0.0) -> None:
        self.sensor = replace(sensor, hot_pixels=0.0)
        gain = gain_of(sensor)
        top = min(2**sensor.bits - 1, gain * sensor.full_well + sensor.offset)
        most = max(0.0, (top - sensor.offset) / gain)
        last = most + 20 * (most + sensor.read_noise**2) ** 0.5 + 400
        self._nodes = np.square(np.arange(2 + int(last**0.5 / _STEP)) * _STEP)
        numbers, variance = (one.numpy() for one in count_moments(torch.from_numpy(self._nodes), self.sensor))
        centre = gain * self._nodes + sensor.offset
        noise = self._nodes + sensor.read_noise**2 + (unevenness * self._nodes) ** 2
        deviation = gain * np.sqrt(noise)
        variance = variance + (gain * unevenness * self._nodes) ** 2
        coarse = deviation < _FINE
        if coarse.any():
            numbers[coarse], variance[coarse] = _rounded(centre[coarse], deviation[coarse], np.rint(top))
        self._expected, self._variance = numbers, np.maximum(variance, _LEAST)
        slope = np.gradient(numbers, self._nodes)
        # Rounding errors would leave a slope in saturation.
        self._slope = np.where(slope > 1e-6 * gain, slope, 0.0)

    def __call__(self, mean: Array) -> tuple[Array, Array, Array]:
        """Return expected digital numbers, their derivative by the mean electrons, and their variance; any shape."""
        expected, slope, variance = (
            np.interp(mean, self._nodes, table) for table in (self._expected, self._slope, self._variance)
        )
        return expected, slope, variance


def _rounded(centre: Array, deviation: Array, top: float) -> tuple[Array, Array]:
    """Return mean and variance of round(x), clipped to 0 ... `top`, for normal x [M] with deviations below 1."""
    reach = 9
    deviation = np.maximum(deviation, 1e-6)
    numbers = np.rint(centre)[:, None] + np.arange(-reach, reach + 1)
    below = ndtr((numbers[:, 1:] - 0.5 - centre[:, None]) / deviation[:, None])
    chance = np.diff(below, axis=1, prepend=0.0, append=1.0)
    kept = np.clip(numbers, 0, top)
    mean = (chance * kept).sum(1)
    return mean, (chance * (kept - mean[:, None]) ** 2).sum(1)
