"""The laser in the images of the target's camera: its spot in one image, and in a row of them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import pairwise

import numpy as np

from tapetum.record.blobs import Candidates, find_candidates

__all__ = ["Spot", "find_spot"]

GOOD = 0.5  # least quality of a spot that counts as the laser
NEIGHBOURS = 4  # frames before and after that a spot must agree with
BRIDGE = 3  # most frames to the good spots on both sides that confirm a doubtful one
CONFIRMED = 4.0  # increase of the log-odds of a confirmed spot
LONGEST = 24  # most doubtful frames in a row that confirm each other: a sweep of the bench's hand had 17
ON_PATH = 0.8  # share of such frames that must lie between their neighbours


@dataclass(frozen=True)
class Spot:
    """The most likely laser spot of an image.

    Attributes
    ----------
    x, y
        Centre in pixels; (0, 0) is the centre of the top left pixel.
    quality
        Probability that it is the laser and not a part of the scene. Below 0.5, treat the laser as absent.
    peak, snr
        Height over the background in digital numbers (extrapolated where saturated), and its ratio to the fit's RMS
        residual.
    sigma
        Standard deviation of the Gaussian in pixels.
    """

    x: float
    y: float
    quality: float
    peak: float
    snr: float
    sigma: float


def find_spot(image: np.ndarray, background: np.ndarray | None = None, *, full_scale: float | None = None) -> Spot:
    """Find the probe's laser in a target's image.

    Parameters
    ----------
    image, background
        [H, W], of any real type, and optionally the same scene without the laser, which is subtracted.
    full_scale
        Digital number of saturation; by default the type's largest, for floats the image's largest.

    Returns
    -------
    Spot
        The most likely spot, whose `quality` says whether it is the laser. An image without any blob gives quality 0 at
        its centre. A spot fainter than the scene's own contrast has a low quality.

    Raises
    ------
    InputError
        When the image is not [H, W], smaller than 13 x 13, or holds NaN; when the background is of another size.
    """
    found = find_candidates(image, background, full_scale=full_scale)
    if not len(found):
        return Spot((image.shape[1] - 1) / 2, (image.shape[0] - 1) / 2, 0.0, 0.0, 0.0, 0.0)
    return Spot(**{field.name: float(getattr(found, field.name)[0]) for field in fields(Spot)})


def strays(times: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return which places ([K, 2] px, at times [K]) are off a path by 20 px and by five times their neighbours'
    scatter.

    The path is a robust straight line through the neighbours (Theil and Sen).
    """
    out = np.zeros(len(times), bool)
    for i in range(len(times)):
        near = np.r_[max(0, i - NEIGHBOURS) : i, i + 1 : min(len(times), i + 1 + NEIGHBOURS)]
        if len(near) < 4:
            continue
        when, where = times[near] - times[i], places[near]
        first, second = np.triu_indices(len(near), 1)
        slope = np.median((where[second] - where[first]) / (when[second] - when[first])[:, None], axis=0)
        level = where - slope * when[:, None]
        middle = np.median(level, axis=0)
        scatter = np.median(np.hypot(*(level - middle).T))
        out[i] = np.hypot(*(places[i] - middle)) > max(20.0, 5 * scatter)
    return out


def follow(times: np.ndarray, found: list[Candidates]) -> tuple[np.ndarray, np.ndarray]:
    """Choose one candidate per frame at times [N] (s); return places [N, 2] in pixels (NaN without one) and qualities
    [N].

    A good spot off the path of its neighbours loses quality; a doubtful one where two good neighbours predict it gains
    some, and so do all of a row of doubtful ones that leads from one good spot to the next, as the streaks of a fast
    gaze do. Without such neighbours no quality rises.
    """
    place = np.array([(c.x[0], c.y[0]) if len(c) else (np.nan, np.nan) for c in found]).reshape(-1, 2)
    quality = np.array([c.quality[0] if len(c) else 0.0 for c in found])
    good = np.flatnonzero(quality >= GOOD)
    off = good[strays(times[good], place[good])]
    quality[off] = np.minimum(quality[off], GOOD / 2)
    good = np.setdiff1d(good, off)
    for left, right in pairwise(good):
        row = np.arange(left + 1, right)
        if 0 < len(row) <= LONGEST:
            on = row[_leads(times[left : right + 1], place[left : right + 1])]
            quality[on] = [1 / (1 + np.exp(-(found[i].odds[0] + CONFIRMED))) for i in on]
    good = np.flatnonzero(quality >= GOOD)
    for i in np.flatnonzero(quality < GOOD):
        after = int(np.searchsorted(good, i))
        if not 0 < after < len(good) or not len(found[i]):
            continue
        left, right = good[after - 1], good[after]
        if i - left > BRIDGE or right - i > BRIDGE:
            continue
        part = (times[i] - times[left]) / (times[right] - times[left])
        expected = (1 - part) * place[left] + part * place[right]
        reach = _reach(float(np.hypot(*(place[right] - place[left]))))
        near = np.hypot(found[i].x - expected[0], found[i].y - expected[1]) <= reach
        if near.any():
            best = int(np.flatnonzero(near)[np.argmax(found[i].odds[near])])
            place[i] = found[i].x[best], found[i].y[best]
            quality[i] = 1 / (1 + np.exp(-(found[i].odds[best] + CONFIRMED)))
    return place, quality


def _leads(times: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return which places [K] between the first and the last of [K + 2] lie between their neighbours, or none where
    these do not lead from the first to the last."""
    part = (times[1:-1] - times[:-2]) / (times[2:] - times[:-2])
    expected = places[:-2] + part[:, None] * (places[2:] - places[:-2])
    step = np.hypot(*(places[2:] - places[:-2]).T)
    # A frame without a candidate has the place NaN, of which every comparison is false.
    on = np.hypot(*(places[1:-1] - expected).T) <= _reach(step)
    return on if on[0] and on[-1] and on.mean() >= ON_PATH else np.zeros(len(on), bool)


def _reach(step: np.ndarray | float) -> np.ndarray | float:
    """Return how far in pixels a spot may lie from the middle of its neighbours, which are `step` apart."""
    return 3 + 0.25 * step
