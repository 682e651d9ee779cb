"""From mean electrons to digital numbers: the noise of `simulate.exposure`, fast and reproducible.

Every pixel consumes the same random numbers whatever its light, so frames whose light differs in the last bit differ in
almost no pixel. Rejection sampling would shift the noise of all later pixels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from tapetum.bench import ProbeSensor
from tapetum.simulate.exposure import gain_of

__all__ = ["counts", "poisson"]

Frame = npt.NDArray[np.float32]
# Mean electrons from which the series for the Poisson quantile is right to 1e-4 in probability.
_MANY = 12.0
# Pixels processed at a time, few enough for the processor's caches.
_AT_ONCE = 1 << 14


def counts(mean: Frame, sensor: ProbeSensor, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Draw digital numbers [H, W] from mean electrons: Poisson noise, read noise, full well, gain, rounding.

    `mean` includes dark current and hot pixels (`stray.Ground`); the numbers are uint8 up to 8 bits, uint16 above.
    """
    gain, top = np.float32(gain_of(sensor)), np.float32(2**sensor.bits - 1)
    numbers = np.empty(mean.shape, np.uint8 if sensor.bits <= 8 else np.uint16)
    flat, out = mean.reshape(-1), numbers.reshape(-1)
    for begin in range(0, flat.size, _AT_ONCE):
        light = flat[begin : begin + _AT_ONCE]
        electrons = poisson(light, rng)
        if sensor.read_noise:
            read = rng.standard_normal(light.shape, dtype=np.float32)
            read *= np.float32(sensor.read_noise)
            electrons += read
        np.minimum(electrons, np.float32(sensor.full_well), out=electrons)
        electrons *= gain
        if sensor.offset:
            electrons += np.float32(sensor.offset)
        np.rint(electrons, out=electrons)
        np.clip(electrons, 0, top, out=electrons)
        out[begin : begin + _AT_ONCE] = electrons
    return numbers


def poisson(mean: Frame, rng: np.random.Generator) -> Frame:
    """Return Poisson numbers for means [N] as float32, each from one normal number by the Poisson quantile.

    For means of 12 and more, the quantile is a series to the order 1/mean (M. B. Giles, ACM Trans. Math. Softw. 42, 7
    (2016), section 2) with an error below 1e-4 in cumulative probability; for smaller ones the distribution is summed.
    """
    w = rng.standard_normal(mean.shape, dtype=np.float32)
    few = mean < _MANY
    # Without masks where all means are of one kind, which is twice as fast.
    if few.all():
        return _few(mean, w)
    if not few.any():
        return _many(mean, w)
    drawn = np.empty_like(w)
    for these, draw in ((few, _few), (~few, _many)):
        drawn[these] = draw(mean[these], w[these])
    return drawn


def _many(mean: Frame, w: Frame) -> Frame:
    root = np.sqrt(mean)
    inverse = np.float32(1) / root
    ww = w * w
    # mean + 1/3 + w²/6 + w √mean - (w + w³/2)/(36 √mean) + (-8/405 + 7w²/810 + w⁴/270)/mean, rounded down.
    term = ww * np.float32(1 / 270)
    term += np.float32(7 / 810)
    term *= ww
    term -= np.float32(8 / 405)
    term *= inverse
    odd = ww * np.float32(-1 / 72)
    odd -= np.float32(1 / 36)
    odd *= w
    term += odd
    term *= inverse
    root *= w
    term += root
    ww *= np.float32(1 / 6)
    term += ww
    term += mean
    term += np.float32(1 / 3)
    np.floor(term, out=term)
    return np.maximum(term, 0, out=term)


def _few(mean: Frame, w: Frame) -> Frame:
    # Upper tails, where small probabilities keep their digits: P(normal > w), and P(more than `count`).
    above = ndtr(-w)
    chance = np.exp(-mean)
    rest = np.float32(1) - chance
    drawn = np.zeros_like(mean)
    # Counts above 60 are negligible for means below 12.
    for count in range(1, 60):
        more = above < rest
        if not more.any():
            break
        drawn += more
        chance *= mean
        chance *= np.float32(1 / count)
        rest -= chance
    return drawn
