"""Gain, read noise, full well and fixed pattern of a sensor from dark and flat frames: the photon-transfer method.

Shot noise ties the variance of a pixel to its signal: variance = K·signal + readout, in digital numbers, with the gain
K in digital numbers per electron. J. R. Janesick, Photon Transfer (2007); EMVA Standard 1288, release 4.0 (2021),
sections 2 and 6. Differences from that standard: the line is fitted over the tiles of every level, weighted by their
statistics, its intercept is free, and uncertainties come from leaving out one tile at a time, so that they contain
whatever differs over the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.calibrate.levels import Level
from tapetum.calibrate.uncertainty import Measured, jackknife, left_out, mean_and_error, root_of
from tapetum.errors import InputError

__all__ = ["PhotonTransfer", "good_pixels", "photon_transfer"]

Array = NDArray[np.float64]

_RANGE = 0.7  # of the signal at saturation, up to which the line is fitted (EMVA 1288)
# Noise in steps of the converter from which rounding adds 1/12 of a step squared and no more: at 0.7 the next term of
# the series of W. R. Bennett (1948) is 1e-4.
_RESOLVED = 0.7
_CLIPPED = 1e-3  # share of pixels at an end of the range from which a tile is clipped
_COLLAPSED = 0.5  # of the line's variance: below, a level saturates
_DEFECT = 6.0  # deviations from the neighbourhood from which a pixel of the dark frames is a defect


@dataclass(frozen=True, eq=False)
class PhotonTransfer:
    """Numbers of a sensor from dark and flat frames.

    Attributes
    ----------
    gain
        Digital numbers per electron.
    offset
        Digital number without light.
    read_noise, full_well
        In electrons. The full well is where the pixel or its converter clips.
    full_well_is
        Whether it is "clipped" by the pixel, by the "converter", or "not reached".
    pattern, sensitivity
        RMS over the pixels of the offsets in electrons (DSNU), and of the relative sensitivity (PRNU).
    dark_current
        In electrons per pixel and second; None without dark frames of three exposures or more.
    read_noise_is
        Whether the read noise is "measured", or "hidden" by rounding or clipping: then it is only an upper limit.
    line
        Intercept and slope of variance over signal.
    curvature
        Part of the variance at the line's end that a square term adds, over the line's.
    linearity
        Signal of each level with a known exposure over that of the straight line through them, less 1; empty for
        fewer than four.
    dark, darks, flats
        The dark level that the numbers rest on, all dark levels, and the flat levels by rising signal.
    signal, variance, used
        Of each flat level: its signal and temporal variance (flicker out), mean over the tiles, and the share of its
        tiles that the line is fitted to.
    saturated
        Which flat levels saturate.
    capacity
        Signal in digital numbers at which frames saturate, as far as is known.
    bits, step, defects
        Depth of the frames, step of their numbers, and share of pixels left out as defects of the dark frames.
    """

    gain: Measured
    offset: Measured
    read_noise: Measured
    full_well: Measured
    full_well_is: str
    pattern: Measured
    sensitivity: Measured
    dark_current: Measured | None
    read_noise_is: str
    line: tuple[float, float]
    curvature: Measured
    linearity: Array
    dark: Level
    darks: tuple[Level, ...]
    flats: tuple[Level, ...]
    signal: Array
    variance: Array
    used: Array
    saturated: NDArray[np.bool_]
    capacity: float
    bits: int
    step: int
    defects: float


def good_pixels(dark: Level) -> NDArray[np.bool_]:
    """Return the pixels [H, W] of a dark level within six robust deviations of their median, one step at least."""
    rest = dark.image - np.median(dark.image)
    spread = 1.4826 * float(np.median(np.abs(rest)))
    return np.abs(rest) <= max(_DEFECT * spread, dark.step)


@dataclass(frozen=True, eq=False)
class _Points:
    """Signal and variance of the tiles of all flat levels, [L, T], and their weights' parts."""

    signal: Array
    variance: Array
    freedom: Array  # [L, T] independent numbers behind each variance
    dark: Array  # [T] variance of the dark frames
    dark_freedom: Array
    usable: NDArray[np.bool_]

    def without(self, tile: int) -> _Points:
        def cut(values: NDArray[Any]) -> NDArray[Any]:
            return np.delete(values, tile, axis=-1)

        names = ("signal", "variance", "freedom", "dark", "dark_freedom", "usable")
        return _Points(*(cut(getattr(self, name)) for name in names))


def photon_transfer(darks: Sequence[Level], flats: Sequence[Level], *, bits: int | None = None) -> PhotonTransfer:
    """Measure a sensor.

    Parameters
    ----------
    darks, flats
        Levels without light and with even light, of the same pixels.
    bits
        Depth of the frames; by default the least of 8, 10, 12, 14 and 16 that holds all numbers.

    Raises
    ------
    InputError
        Without a dark level, with fewer than two flat ones, or where no line can be fitted.
    """
    if not darks:
        raise InputError(
            "no two dark frames were found", where="dark frames", remedy="give two or more with the cap on"
        )
    if len(flats) < 2:
        what = f"{len(flats)} flat level{'' if len(flats) == 1 else 's'} of two frames or more"
        raise InputError(what, where="flat frames", remedy="give frames under five or more different lights")
    darks = sorted(darks, key=lambda one: (one.exposure or 0.0, one.mean_of(one.mean)))
    dark = darks[0]
    flats = sorted(flats, key=lambda one: one.mean_of(one.mean))
    largest = max(level.largest for level in (*darks, *flats))
    bits = _depth(largest) if bits is None else bits
    if largest >= 2**bits:
        raise InputError(f"the frames hold {largest}, more than {bits} bits can", where="--bits", remedy="give more")
    step = math.gcd(*(level.step for level in (*darks, *flats))) or 1
    without = [_dark_of(level, darks) for level in flats]
    zero = np.array([one.mean_of(one.mean) for one in without])
    signal = np.array([level.mean_of(level.mean) for level in flats]) - zero
    points = _points(flats, without, zero, dark, step)
    variance = np.array([level.mean_of(row) for level, row in zip(flats, points.variance, strict=True)])

    top = 2**bits - 1
    # With flicker in it, which never lets a variance collapse.
    whole = np.array([level.mean_of(level.variance) for level in flats])
    points, saturated, capacity, clip = _in_range(points, flats, signal, whole, top - zero.max(), largest)
    fitted = _fit(points, step)
    if fitted is None:
        what = "no line of variance over signal could be fitted: the noise of too few unsaturated levels is resolved"
        remedy = "give five or more levels between dark and saturation, with more gain or bits"
        raise InputError(what, where="flat frames", remedy=remedy)
    intercept, slope = fitted[0], fitted[1]
    parts = [points.without(n) for n in range(points.signal.shape[1])]
    left = np.array([(_fit(part, step) or fitted)[:2] for part in parts])
    bend, bends = _bend(points, step), np.array([_bend(part, step) for part in parts])
    gain = Measured(slope, jackknife(left[:, 1]))
    current = _dark_current(darks, slope)
    exposed = current.value * (dark.exposure or 0.0) if current is not None else 0.0
    # The mean of a noise that spans few steps is pulled to whole numbers; this is the RMS of that over all places.
    noise = math.sqrt(max(min(dark.mean_of(dark.variance), intercept) - step**2 / 12, 0.0)) / step
    pulled = step * min(1 / math.sqrt(12), math.exp(-2 * (math.pi * noise) ** 2) / (math.pi * math.sqrt(2)))
    cut = dark.mean_of(dark.zero) > _CLIPPED
    if cut:
        # Part of the noise is missing below 0: the middle may lie anywhere up to a deviation and a step below.
        pulled = step * max(1.0, noise)
    offset = Measured(
        dark.mean_of(dark.mean) - slope * exposed, math.hypot(jackknife(left_out(dark.mean, dark.pixels)), pulled)
    )
    # In electrons squared. A shift of the zero of signals shifts the intercept by the slope.
    squares = (left[:, 0] - step**2 / 12) / left[:, 1] ** 2
    readout = (intercept - step**2 / 12) / slope**2 - exposed
    read_noise, hidden = root_of(Measured(readout, math.hypot(jackknife(squares), pulled / slope)), 1.0)
    used = (points.usable & _resolved(points, (intercept, slope), step)).mean(axis=1)
    pattern, sensitivity = _patterns(dark, flats, points, used > 0.5, slope)
    full_well, reached = _full_well(clip, gain, offset, step, top)
    return PhotonTransfer(
        gain=gain,
        offset=offset,
        read_noise=read_noise,
        full_well=full_well,
        full_well_is=reached,
        pattern=pattern,
        sensitivity=sensitivity,
        dark_current=current,
        read_noise_is="hidden" if hidden or cut else "measured",
        line=(intercept, slope),
        curvature=Measured(bend, jackknife(bends)),
        linearity=_linearity(flats, signal, capacity),
        dark=dark,
        darks=tuple(darks),
        flats=tuple(flats),
        signal=signal,
        variance=variance,
        used=used,
        saturated=saturated,
        capacity=capacity,
        bits=bits,
        step=step,
        defects=1 - float(np.mean(good_pixels(dark))),
    )


def _depth(largest: int) -> int:
    return next(bits for bits in (8, 10, 12, 14, 16) if largest < 2**bits)


def _dark_of(level: Level, darks: Sequence[Level]) -> Level:
    """Return the dark level of the nearest exposure; the first where exposures are not known."""
    known = [(one, one.exposure) for one in darks if one.exposure]
    if not level.exposure or not known:
        return darks[0]
    wanted = level.exposure
    return min(known, key=lambda pair: abs(math.log(pair[1] / wanted)))[0]


def _points(flats: Sequence[Level], without: Sequence[Level], zero: Array, dark: Level, step: int) -> _Points:
    signal = np.stack([level.mean - one.mean for level, one in zip(flats, without, strict=True)])
    rows = []
    for level, nothing in zip(flats, zero, strict=True):
        light = level.mean_of(level.mean) - nothing
        # A light that flickers as a whole scales the signal of every pixel alike.
        share = level.flicker / light**2 if light > 0 else 0.0
        rows.append(level.variance - share * (level.square - 2 * nothing * level.mean + nothing**2))
    freedom = np.stack([(level.frames - 1) * level.pixels for level in flats])
    usable = np.stack([(level.pixels > 0) & (level.zero <= _CLIPPED) for level in flats])
    # Dark noise that rounding or the end of the range hides is not used.
    resolved = dark.mean_of(dark.variance) >= (_RESOLVED * step) ** 2 and dark.mean_of(dark.zero) <= _CLIPPED
    freedom_dark = (dark.frames - 1) * dark.pixels * resolved
    return _Points(signal, np.stack(rows), freedom, dark.variance - dark.flicker, freedom_dark, usable)


def _in_range(
    points: _Points, flats: Sequence[Level], signal: Array, variance: Array, room: float, largest: int
) -> tuple[_Points, NDArray[np.bool_], float, Measured | None]:
    """Return the points that the line may be fitted to, which levels saturate, and where: signal and digital number.

    A bright level saturates where its variance collapses beside that of the levels before, or most of its pixels read
    the largest number of all frames.
    """
    slopes = variance / np.maximum(signal, 1e-9)
    saturated = np.zeros(len(flats), bool)
    for n in range(1, len(flats)):
        before = slopes[:n][~saturated[:n] & (variance[:n] > 0)]
        collapsed = signal[n] > 0.5 * signal[-1] and len(before) and slopes[n] < _COLLAPSED * np.median(before)
        at_top = flats[n].largest >= largest and flats[n].mean_of(flats[n].top) > 0.5
        saturated[n] = bool(collapsed or at_top)
    clip, capacity = None, room
    if saturated.any():
        last = int(np.flatnonzero(saturated)[-1])
        full = flats[last]
        # The flattest tiles: those that saturate whole.
        means = full.mean[full.variance <= np.median(full.variance)]
        clip = Measured(float(np.median(means)), float(np.std(means)) / math.sqrt(len(means)))
        capacity = min(room, clip.value - (full.mean_of(full.mean) - signal[last]))
    highest = largest if clip is None else clip.value
    usable = points.usable & (points.signal <= _RANGE * capacity) & ~saturated[:, None]
    if clip is not None:
        # Tiles in which pixels read the number at which others clip are on their way there.
        usable &= np.stack([(level.top <= _CLIPPED) | (level.largest < highest - 0.5) for level in flats])
    return replace(points, usable=usable), saturated, capacity, clip


def _resolved(points: _Points, line: tuple[float, float], step: int) -> NDArray[np.bool_]:
    return line[0] + line[1] * points.signal >= (_RESOLVED * step) ** 2


def _fit(points: _Points, step: int, degree: int = 1) -> tuple[float, ...] | None:
    """Fit variance over signal by a polynomial, weights by its own values; None where too few levels are left."""
    x = np.r_[points.signal.ravel(), np.zeros(points.dark.size)]
    y = np.r_[points.variance.ravel(), points.dark]
    freedom = np.r_[points.freedom.ravel(), points.dark_freedom]
    usable = np.r_[points.usable.ravel(), points.dark_freedom > 0] & (freedom > 0)
    levels = points.usable.any(axis=1).sum() + bool((points.dark_freedom > 0).any())
    if levels <= degree:
        return None
    expected = np.maximum(y, (_RESOLVED * step) ** 2)
    found: Array | None = None
    for _ in range(4):
        here = usable & (expected >= (_RESOLVED * step) ** 2)
        if len(np.unique(x[here])) <= 2 * degree:
            return None
        root = np.sqrt(freedom[here] / 2) / expected[here]
        terms = x[here, None] ** np.arange(degree + 1)
        found = np.linalg.lstsq(terms * root[:, None], y[here] * root, rcond=None)[0]
        expected = x[:, None] ** np.arange(degree + 1) @ found
    if found is None or found[1] <= 0:
        return None
    return tuple(float(one) for one in found)


def _bend(points: _Points, step: int) -> float:
    """Return the variance that a square term adds at the range's end, over the line's; NaN where none is fitted."""
    found = _fit(points, step, degree=2)
    if found is None:
        return math.nan
    return found[2] * float(points.signal[points.usable].max()) / found[1]


def _full_well(clip: Measured | None, gain: Measured, offset: Measured, step: int, top: int) -> tuple[Measured, str]:
    if clip is None:
        most, reached = Measured(float(top), 0.0), "not reached"
    else:
        most, reached = clip, "converter" if clip.value >= top - step / 2 else "clipped"
    electrons = (most.value - offset.value) / gain.value
    error = math.hypot(most.error, step / math.sqrt(12), offset.error) / gain.value
    return Measured(electrons, math.hypot(error, electrons * gain.error / gain.value)), reached


@dataclass(frozen=True, eq=False)
class _Spread:
    """Squared signal, variance over the pixels without their noise, and its own variance: [levels, T]."""

    square: Array
    variance: Array
    error: Array

    def fit(self, keep: NDArray[np.bool_]) -> tuple[float, float]:
        """Return offset and slope of the variance over the squared signal, of the tiles to keep."""
        weight = 1 / np.sqrt(self.error[:, keep].ravel())
        terms = np.stack([np.ones(weight.size), self.square[:, keep].ravel()], axis=-1)
        found = np.linalg.lstsq(terms * weight[:, None], self.variance[:, keep].ravel() * weight, rcond=None)[0]
        return float(found[0]), float(found[1])


def _patterns(
    dark: Level, flats: Sequence[Level], points: _Points, wanted: NDArray[np.bool_], slope: float
) -> tuple[Measured, Measured]:
    """Return DSNU in electrons and PRNU: the pixels' variance grows with the square of the signal by the latter.

    The levels `wanted` [L] count, and the dark one where its noise is resolved.
    """
    levels = [(flat, points.signal[n], points.variance[n]) for n, flat in enumerate(flats) if wanted[n]]
    if (points.dark_freedom > 0).any():
        levels.append((dark, np.zeros(len(dark.mean)), points.dark))
    if len(levels) < 2:
        return Measured(math.nan, math.inf), Measured(math.nan, math.inf)
    frames = np.array([level.frames for level, _, _ in levels])[:, None]
    pixels = np.stack([np.maximum(level.pixels, 1) for level, _, _ in levels])
    pattern = np.stack([level.pattern for level, _, _ in levels])
    noise = np.stack([variance for _, _, variance in levels]) / frames
    # Weights of the levels' means: a tile's own variance in its weight would favour low ones.
    whole, quiet = (np.nanmean(values, axis=1, keepdims=True) for values in (pattern, noise))
    error = 2 * (whole**2 + quiet**2 / (frames - 1)) / pixels
    spread = _Spread(np.stack([signal for _, signal, _ in levels]) ** 2, pattern - noise, np.maximum(error, 1e-12))
    every = np.asarray(np.isfinite(pattern).all(axis=0))
    left = np.array([spread.fit(every & (np.arange(len(every)) != n)) for n in np.flatnonzero(every)])
    offset, share = (Measured(value, jackknife(left[:, n])) for n, value in enumerate(spread.fit(every)))
    return root_of(offset, slope)[0], root_of(share, 1.0)[0]


def _dark_current(darks: Sequence[Level], slope: float) -> Measured | None:
    known = [(one.exposure, one.mean) for one in darks if one.exposure]
    if len({exposure for exposure, _ in known}) < 3:
        return None
    times = np.array([exposure for exposure, _ in known])
    means = np.stack([mean for _, mean in known])
    rates = ((times - times.mean())[:, None] * means).sum(axis=0) / ((times - times.mean()) ** 2).sum()
    found = mean_and_error(rates, darks[0].pixels)
    return Measured(max(found.value, 0.0) / slope, found.error / slope)


def _linearity(flats: Sequence[Level], signal: Array, capacity: float) -> Array:
    """Return by how much the signal leaves the straight line over exposure, of [L] levels; NaN where not counted.

    The line minimises relative deviations, from 5 to 95 % of the range (EMVA 1288, section 7).
    """
    exposure = np.array([level.exposure or np.nan for level in flats])
    counted = np.isfinite(exposure) & (signal >= 0.05 * capacity) & (signal <= 0.95 * capacity)
    if len(np.unique(exposure[counted])) < 4:
        return np.empty(0)
    weight = 1 / signal[counted]
    terms = np.stack([np.ones(counted.sum()), exposure[counted]], axis=-1)
    line = np.linalg.lstsq(terms * weight[:, None], signal[counted] * weight, rcond=None)[0]
    out = np.full(len(flats), np.nan)
    out[counted] = signal[counted] / (terms @ line) - 1
    return out
