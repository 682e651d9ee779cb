"""From a frame, or a lit and a dark one, to the cameras in it: which candidates are likely to be one."""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.detection.candidates import layers
from tapetum.detection.features import OF_A_FRAME
from tapetum.detection.found import Found
from tapetum.detection.measured import (
    DECOYS,
    FULL,
    MOST_ALONE,
    MOST_OF_A_PAIR,
    Candidates,
    swapped_candidates,
    with_decoys,
)
from tapetum.detection.registration import register
from tapetum.detection.score import Score, load_score
from tapetum.detection.second import load_second, views
from tapetum.detection.third import SUREST, Told, load_third, third_input
from tapetum.errors import InputError, one_of

__all__ = [
    "CHANNELS",
    "DECOYS_LOOKED_AGAIN",
    "LARGEST_FRAME",
    "LOOKED_AGAIN",
    "clutter_of_frame",
    "clutter_of_pair",
    "depth_of",
    "find_cameras",
    "joined",
    "judged",
    "second_look",
    "told_of",
]

CHANNELS = ("mean", "red", "green", "blue")
"""What of a colour frame is searched: the mean of all three, or the one that the laser's wavelength falls into."""
LARGEST_FRAME = 2**26
"""Most pixels of a frame: the search keeps about a hundred bytes for each."""
LOOKED_AGAIN = 40
"""How many of the first candidates of a pair the second stage judges."""
DECOYS_LOOKED_AGAIN = 8
"""How many of its decoys."""
_SATURATED = OF_A_FRAME.index("saturated")
_ELONGATION = OF_A_FRAME.index("elongation")
# How many of a pair's likeliest decoys say how cluttered it is.
_CLUTTER = 3
# Of one frame alone, the candidates that say how cluttered it is, by their rank.
_RANKS = (30, 50)
# Expected false alarms a frame above which nothing is likely to be a camera, and below which something is.
_LIKELY_NONE, _LIKELY_ONE = 0.2, 0.02
# Bits of cameras.
_DEPTHS = (8, 10, 12, 14, 16)

Array = NDArray[np.float64]


def find_cameras(
    lit: NDArray[np.generic],
    dark: NDArray[np.generic] | None = None,
    *,
    false_alarms: float = 0.01,
    largest: float = 60.0,
    most: int | None = None,
    channel: str = "mean",
    swaps: bool = True,
    full_scale: float | Sequence[float | None] | None = None,
) -> Found:
    """Find cameras, and other optics that look at the probe, in one frame or in a lit and a dark one.

    Parameters
    ----------
    lit
        [H, W] grey or [H, W, 3] red, green, blue, lit by the probe: uint8, uint16, or float levels from 0 to 255.
    dark
        The same without the probe's light, of the same size. Both may be taken by hand: they are registered.
    false_alarms
        Expected false alarms a frame: what scores lower is left out. `math.inf` returns every candidate.
    largest
        Largest diameter of a spot in pixels.
    most
        Most candidates that are searched closely; default: 100, of one frame alone at more than one false alarm 200.
    channel
        Of a colour frame: mean, red, green or blue. The mean shows the glint of a white flash, and that of a
        near-infrared lamp, which is in all three; for a red laser "red" has less of the room's own light in it.
    swaps
        Whether to look, where nothing is likely in a pair, if the two are swapped. It takes half the time again.
    full_scale
        Level at which pixels saturate, of both or of each. None: 255, of uint16 what `depth_of` finds in the two.

    Returns
    -------
    Found
        The likeliest camera first.

    Raises
    ------
    InputError
        When a frame is no picture, the two differ in size or show different scenes, or an option is out of range.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> dark = rng.normal(60, 2, (96, 128)).astype(np.float32) + 40 * (np.arange(128) // 8 % 2)
    >>> lit = dark + rng.normal(0, 2, dark.shape).astype(np.float32)
    >>> lit[40:43, 70:73] += 120
    >>> found = find_cameras(lit, dark)
    >>> len(found), round(float(found.x[0])), round(float(found.y[0]))
    (1, 71, 41)
    """
    if not false_alarms > 0:
        raise InputError(f"must be positive, is {false_alarms}", where="false_alarms", remedy="0.01 is usual")
    if not largest > 0:
        raise InputError(f"must be positive, is {largest}", where="largest", remedy="give a diameter in pixels")
    if most is not None and not (isinstance(most, numbers.Integral) and most >= 1):
        raise InputError(f"must be a whole number from 1, is {most!r}", where="most")
    frames = {"lit": lit} if dark is None else {"lit": lit, "dark": dark}
    given = list(full_scale) if isinstance(full_scale, Sequence) else [full_scale] * len(frames)
    if len(given) != len(frames) or not all(one is None or 0 < one < math.inf for one in given):
        raise InputError(f"must be positive, is {full_scale}", where="full_scale", remedy="255 is usual")
    one_of(channel, CHANNELS, "channel")
    arrays = [_checked(image, name, own) for (name, image), own in zip(frames.items(), given, strict=True)]
    if channel != CHANNELS[0] and (
        name := next((n for n, one in zip(frames, arrays, strict=True) if one.ndim == 2), "")
    ):
        raise InputError(f"is grey: it has no channel {channel!r}", where=name, remedy="leave channel out")
    wide = [one for one in arrays if one.dtype == np.uint16]
    depth = depth_of(*wide) if wide else FULL
    scales = [own or (depth if one.dtype == np.uint16 else FULL) for one, own in zip(arrays, given, strict=True)]
    grey = [_levels(one, channel, scale) for one, scale in zip(arrays, scales, strict=True)]
    first, second = grey[0], grey[1] if len(grey) > 1 else None
    score = load_score(pair=second is not None)
    if second is not None and first.dtype != second.dtype:
        first, second = first.astype(np.float32), second.astype(np.float32)
    registered = None if second is None else register(first, second)
    if most is None:
        # What stands behind a hundred other places is rarely among the likeliest.
        most = MOST_ALONE if registered is None and false_alarms > 1 else MOST_OF_A_PAIR
    octaves = layers(first, registered, largest)
    candidates, decoys = with_decoys(octaves, registered, most, first)
    found, measured = candidates.columns, candidates.looks
    log_odds, clutter = judged(candidates, decoys, score)
    alarms = score.false_alarms(log_odds, clutter)
    swapped = False
    if swaps and registered is not None and not (alarms < _LIKELY_NONE).any():
        others = swapped_candidates(octaves, registered, most, first)
        swapped = bool((score.false_alarms(*judged(others, candidates.first(DECOYS), score)) < _LIKELY_ONE).any())
    order = np.argsort(-log_odds, kind="stable")
    # An octave holds spots up to twice the width of its finest.
    order = order[(alarms[order] <= false_alarms) & (found["diameter"][order] <= largest)]
    probability = score.probability(log_odds, clutter)
    return Found(
        x=found["x"][order],
        y=found["y"][order],
        probability=probability[order],
        false_alarms=alarms[order],
        snr=found["clear"][order],
        flux=found["flux"][order],
        diameter=found["diameter"][order],
        elongation=np.exp(measured[order, _ELONGATION]),
        peak=found["peak"][order],
        saturated=measured[order, _SATURATED] > 0,
        swapped=swapped,
    )


def judged(candidates: Candidates, decoys: Candidates | None, score: Score) -> tuple[Array, float]:
    """Log odds of candidates, [N], and how cluttered their frame is; `decoys` are those of a pair.

    Of one frame alone the features tell; in a pair the third stage besides, which is told what the second one sees.
    """
    odds = score.log_odds(candidates.looks)
    if decoys is None:
        return odds, clutter_of_frame(odds, candidates.columns["worth"])
    found, others = told_of(candidates, decoys, score)
    return joined(odds, score.log_odds(others.looks), found, others, score)


def joined(odds: Array, of_decoys: Array, found: Told, decoys: Told, score: Score) -> tuple[Array, float]:
    """Log odds of a pair's candidates, [N], and its clutter, from log odds by the features of both, [N] and [M]."""
    third = load_third().log_odds(third_input(found, decoys))
    return score.joined(odds, third), clutter_of_pair(score.joined(of_decoys, decoys.again))


def clutter_of_pair(odds: Array) -> float:
    """How likely a pair's clutter is to pass for cameras: the mean log odds of its three likeliest decoys.

    As in searches of mass spectra against reversed sequences (Elias and Gygi 2007), the scores of matches that cannot
    be true show how high chance scores.
    """
    best = np.full(_CLUTTER, -SUREST)
    best[: len(odds)] = np.sort(odds)[::-1][:_CLUTTER]
    return float(np.maximum(best, -SUREST).mean())


def clutter_of_frame(odds: Array, worth: Array) -> float:
    """How likely the clutter of one frame alone is to pass for cameras: the mean log odds of its candidates of ranks 31
    to 50, among the hundred of most worth.

    So up to thirty cameras do not count as clutter, and it is the same however many places are searched closely. Where
    there are fewer candidates, there is little to mistake.
    """
    first, last = _RANKS
    ranked = np.full(last, -SUREST)
    usual = np.sort(odds[np.argsort(-worth, kind="stable")[:MOST_OF_A_PAIR]])[::-1][:last]
    ranked[: len(usual)] = usual
    return float(np.maximum(ranked[first:], -SUREST).mean())


def second_look(candidates: Candidates, odds: Array, most: int = LOOKED_AGAIN) -> Array:
    """Log odds by the second stage of a pair's candidates, [N]: of those with the highest odds; others get the
    lowest."""
    again = np.full(len(odds), -SUREST)
    if candidates.cut is not None:
        best = np.sort(np.argsort(-odds, kind="stable")[:most])
        told = load_second().log_odds(*views(candidates.cut, candidates.rows[best]), candidates.looks[best])
        again[best] = np.clip(told, -SUREST, SUREST)
    return again


def told_of(candidates: Candidates, decoys: Candidates, score: Score) -> tuple[Told, Told]:
    """What the third stage is told of a pair's candidates and of its decoys."""
    return (
        _told(candidates, score.log_odds(candidates.looks), LOOKED_AGAIN),
        _told(decoys, score.log_odds(decoys.looks), DECOYS_LOOKED_AGAIN),
    )


def _told(candidates: Candidates, odds: Array, most: int) -> Told:
    return Told(candidates.looks, candidates.columns["clear"], second_look(candidates, odds, most))


def depth_of(*images: NDArray[np.generic]) -> int:
    """Level at which pixels of 16-bit images saturate: of 8, 10, 12, 14 or 16 bits the fewest that hold all of them.

    Cameras of 10 or 12 bits store their numbers in 16; files do not say how many are used.
    """
    highest = max(int(one.max(initial=0)) for one in images)
    return next(2**bits - 1 for bits in _DEPTHS if highest < 2**bits)


def _checked(image: NDArray[np.generic], where: str, full_scale: float | None) -> NDArray[Any]:
    """The frame as an array of levels; InputError where it is no picture or its levels mean nothing."""
    array: NDArray[Any] = np.asarray(image)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3) or min(array.shape[:2]) < 32:
        what = f"expected [H, W] or [H, W, 3] of at least 32 x 32 pixels, got shape {array.shape}"
        raise InputError(what, where=where, remedy="give a grey or an RGB picture")
    if array.shape[0] * array.shape[1] > LARGEST_FRAME:
        what = f"{array.shape[1]} x {array.shape[0]} pixels are more than can be searched at once"
        raise InputError(what, where=where, remedy=f"cut it into parts of at most {LARGEST_FRAME // 10**6} megapixels")
    if array.dtype.kind not in "uif":
        raise InputError(
            f"pixels of type {array.dtype} are no levels", where=where, remedy="give uint8, uint16 or float"
        )
    if array.dtype.kind != "f" and array.dtype not in (np.uint8, np.uint16) and full_scale is None:
        what = f"pixels of type {array.dtype} do not say at which level they saturate"
        raise InputError(what, where=where, remedy="give uint8, uint16 or float from 0 to 255, or full_scale")
    if array.dtype.kind == "f":
        if not np.isfinite(array).all():
            raise InputError("holds pixels that are not finite", where=where, remedy="replace NaN and infinite pixels")
        if full_scale is None and 0 < float(array.max()) <= 1:
            what = f"the highest level is {float(array.max()):.3g} where 255 is white"
            raise InputError(what, where=where, remedy="give levels from 0 to 255, or full_scale=1")
        if full_scale is None and float(array.max()) > FULL:
            what = f"the highest level is {float(array.max()):.6g} where {FULL:g} is white"
            raise InputError(what, where=where, remedy="give levels from 0 to 255, or full_scale=4095")
    return array


def _levels(array: NDArray[Any], channel: str, scale: float) -> NDArray[Any]:
    """The frame as grey levels from 0 to 255, [H, W]: uint8 where it was, else float32. It saturates at `scale`."""
    kind = array.dtype
    if array.ndim == 3:
        array = array.mean(2, dtype=np.float32) if channel == "mean" else array[..., CHANNELS.index(channel) - 1]
    if kind == np.uint8 and scale == FULL:
        return np.ascontiguousarray(array if array.dtype == np.uint8 else array.round().astype(np.uint8))
    return array.astype(np.float32) * np.float32(FULL / scale)
