"""From a frame, or a lit and a dark one, to the cameras in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from tapetum.detection.candidates import HALF, SIGMAS, Cut, Layer, Place, cut_out, layers, patches, screened
from tapetum.detection.features import OF_A_FRAME, OF_A_PAIR, beside_rivals, looks
from tapetum.detection.found import Found
from tapetum.detection.registration import MATCHED, Registered, local_mean, register
from tapetum.detection.score import Score, load_score
from tapetum.detection.second import load_second, views
from tapetum.detection.third import SUREST, Told, load_third, third_input
from tapetum.errors import InputError, one_of

__all__ = [
    "CHANNELS",
    "DECOYS_LOOKED_AGAIN",
    "LARGEST_FRAME",
    "LOOKED_AGAIN",
    "Candidates",
    "candidates_with_looks",
    "clutter_of_frame",
    "clutter_of_pair",
    "find_cameras",
    "judged",
    "second_look",
    "told_of",
]

CHANNELS = ("mean", "red", "green", "blue")
"""What of a colour frame is searched: the mean of all three, or the one that the laser's wavelength falls into."""
LARGEST_FRAME = 2**26
"""Most pixels of a frame: the search keeps about a hundred bytes for each."""
_OUTLIER = OF_A_FRAME.index("outlier")
_SATURATED = OF_A_FRAME.index("saturated")
_ELONGATION = OF_A_FRAME.index("elongation")
_FULL = 255.0
_MOST_OF_A_PAIR, _MOST_ALONE = 100, 200
LOOKED_AGAIN = 40
"""How many of the first candidates of a pair the second stage judges."""
DECOYS_LOOKED_AGAIN = 8
"""How many of its decoys."""
# Of an octave's places that only the dark frame shows bright, how many candidates are compared with.
_RIVALS = 24
# Decoys of a pair, and how many of the likeliest say how cluttered it is.
_DECOYS, _CLUTTER = 24, 3
# Of one frame alone, the candidates that say how cluttered it is, by their rank.
_RANKS = (30, 50)
# Expected false alarms a frame above which nothing is likely to be a camera, and below which something is.
_LIKELY_NONE, _LIKELY_ONE = 0.2, 0.02

# Of a pixel's light, what a neighbour has at least where a lens draws it: a spot of 0.4 pixels shows 0.13 of it.
_SHARED = 0.1
# Diameter below which a candidate may be a single pixel: on a wide spot the noise of one counts for nothing.
_SMALL = 7.0

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
) -> Found:
    """Find cameras, and other optics that look at the probe, in one frame or in a lit and a dark one.

    Parameters
    ----------
    lit
        [H, W] grey or [H, W, 3] red, green, blue; uint8, uint16 or float, lit by the probe.
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
    if most is not None and most < 1:
        raise InputError(f"must be at least 1, is {most}", where="most")
    one_of(channel, CHANNELS, "channel")
    first = _levels(lit, channel, "lit")
    second = None if dark is None else _levels(dark, channel, "dark")
    score = load_score(pair=second is not None)
    if second is not None and first.dtype != second.dtype:
        first, second = first.astype(np.float32), second.astype(np.float32)
    registered = None if second is None else register(first, second)
    if most is None:
        # What stands behind a hundred other places is rarely among the likeliest.
        most = _MOST_ALONE if registered is None and false_alarms > 1 else _MOST_OF_A_PAIR
    octaves = layers(first, registered, largest)
    candidates, decoys = _with_decoys(octaves, registered, most, first)
    found, measured = candidates.columns, candidates.looks
    log_odds, clutter = judged(candidates, decoys, score)
    alarms = score.false_alarms(log_odds, clutter)
    swapped = False
    if swaps and registered is not None and not (alarms < _LIKELY_NONE).any():
        turned = [one.swapped() for one in octaves]
        others = _candidates(turned, _screened(turned, most), registered, most, first, swapped=True)
        swapped = bool((score.false_alarms(*judged(others, candidates.first(_DECOYS), score)) < _LIKELY_ONE).any())
    order = np.argsort(-log_odds, kind="stable")
    order = order[alarms[order] <= false_alarms]
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


@dataclass(frozen=True)
class Candidates:
    """Candidates of a frame: columns of `NAMES` [N], features `looks` [N, features], and their rows in a cut, [N].

    By their `worth` they were chosen from the places that were screened.
    """

    NAMES: ClassVar[tuple[str, ...]] = ("x", "y", "snr", "flux", "diameter", "peak", "clear", "worth")
    columns: dict[str, Array]
    looks: Array
    cut: Cut | None
    rows: NDArray[np.int64]

    def first(self, count: int) -> Candidates:
        """The so many of most worth, in their order."""
        best = np.sort(np.argsort(-self.columns["worth"], kind="stable")[:count])
        columns = {name: one[best] for name, one in self.columns.items()}
        return Candidates(columns, self.looks[best], self.cut, self.rows[best])

    @classmethod
    def none(cls, width: int) -> Candidates:
        """No candidates, with so many features."""
        return cls({name: np.empty(0) for name in cls.NAMES}, np.empty((0, width)), None, np.empty(0, np.int64))


def candidates_with_looks(
    lit: NDArray, dark: NDArray | None, *, largest: float = 60.0, most: int | None = None
) -> tuple[Candidates, Candidates | None]:
    """Return the candidates of a frame or a pair, before any is scored; and, of a pair, its decoys.

    Decoys are the first candidates of the swapped pair: they are bright in the dark frame alone, so none is a camera.
    Things that moved, and edges that the registration left, are as often brighter in the dark frame as in the lit one.

    Parameters
    ----------
    lit, dark
        [H, W] levels from 0 to 255, both uint8 or both float32; dark None for one frame alone.
    largest, most
        As for `find_cameras`.
    """
    registered = None if dark is None else register(lit, dark)
    if most is None:
        most = _MOST_ALONE if registered is None else _MOST_OF_A_PAIR
    return _with_decoys(layers(lit, registered, largest), registered, most, lit)


def judged(candidates: Candidates, decoys: Candidates | None, score: Score) -> tuple[Array, float]:
    """Log odds of candidates, [N], and how cluttered their frame is; `decoys` are those of a pair.

    Of one frame alone the features tell; in a pair the third stage besides, which is told what the second one sees.
    """
    odds = score.log_odds(candidates.looks)
    if decoys is None:
        return odds, clutter_of_frame(odds, candidates.columns["worth"])
    found, others = told_of(candidates, decoys, score)
    third = load_third().log_odds(third_input(found, others))
    clutter = clutter_of_pair(score.joined(score.log_odds(others.looks), others.again))
    return score.joined(odds, third), clutter


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
    usual = np.sort(odds[np.argsort(-worth, kind="stable")[:_MOST_OF_A_PAIR]])[::-1][:last]
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


def _with_decoys(
    octaves: list[Layer], registered: Registered | None, most: int, lit: NDArray
) -> tuple[Candidates, Candidates | None]:
    screens = _screened(octaves, most)
    found = _candidates(octaves, screens, registered, most, lit)
    if registered is None:
        return found, None
    turned = [(rivals, places.first(len(rivals.x))) for places, rivals in screens]
    swapped = [one.swapped() for one in octaves]
    # A few decoys do not show what is usual in the frame: the candidates' heights do.
    return found, _candidates(swapped, turned, registered, _DECOYS, lit, swapped=True, among=found.columns["snr"])


def _screened(octaves: list[Layer], most: int) -> list[tuple[Place, Place]]:
    return [screened(one, most) for one in octaves]


def _candidates(
    octaves: list[Layer],
    screens: list[tuple[Place, Place]],
    registered: Registered | None,
    most: int,
    lit: NDArray,
    *,
    swapped: bool = False,
    among: Array | None = None,
) -> Candidates:
    """At most so many candidates of screened places; `among` [M] are the heights that theirs are compared with."""
    width = len(OF_A_FRAME) + (0 if registered is None else len(OF_A_PAIR))
    places, rivals = [one for one, _ in screens], _listed(octaves, [other.first(_RIVALS) for _, other in screens])
    count = [len(one.x) for one in places]
    if not sum(count):
        return Candidates.none(width)
    at = np.concatenate([np.stack([one.x, one.y], 1) for one in places])
    height, worth = (np.concatenate([getattr(one, n) for one in places]).astype(float) for n in ("height", "worth"))
    listed = _listed(octaves, places)
    middle, step = listed[:, :2], listed[:, 4]
    shape = octaves[0].shape
    allowed = np.arange(len(at)) if registered is None else np.flatnonzero(_within(registered, middle, shape))
    x, y = middle[allowed].T
    # Of those at one place the octave that stands highest at worst, of places those that are worth most.
    kept = allowed[_one_a_place(x, y, height[allowed], 4.0 * step[allowed], len(allowed))]
    kept = kept[np.argsort(-worth[kept], kind="stable")][:most]
    of = np.repeat(np.arange(len(octaves)), count)[kept]
    # By octave, which is the order in which they are cut out.
    kept = kept[np.argsort(of, kind="stable")]
    of = np.sort(of)
    cut = cut_out((one, at[kept[of == n], 0], at[kept[of == n], 1]) for n, one in enumerate(octaves))
    if cut is None:
        return Candidates.none(width)
    table = np.concatenate([_measured(cut), worth[kept[cut.number], None]], 1)
    # The mean of the frame is that of the octave that was screened, which is smaller.
    wide = octaves[min(1, len(octaves) - 1)]
    mean = local_mean(wide.bright, MATCHED / (wide.step * wide.cell))
    features = looks(cut, _at(mean, table, shape), _FULL, None if registered is None else registered.coarse)
    if registered is not None:
        features = np.concatenate([features, beside_rivals(listed[kept[cut.number]], rivals, max(shape))], 1)
    kept = _one_a_place(table[:, 0], table[:, 1], table[:, 2], table[:, 4], most)
    kept = kept[~_stuck(table[kept], lit, registered, swapped)]
    if not len(kept):
        return Candidates.none(width)
    table, features = table[kept], features[kept]
    # Below the median, for up to half of the candidates may be cameras.
    low, middle = np.quantile(table[:, 2] if among is None or not len(among) else among, [0.2, 0.5])
    features[:, _OUTLIER] = np.log(np.maximum(table[:, 2] - middle, 0.05) / (middle - low + 0.3))
    return Candidates(dict(zip(Candidates.NAMES, table.T, strict=True)), features, cut, kept)


def _listed(octaves: list[Layer], places: list[Place]) -> Array:
    """Places of all octaves, [N, 5]: x and y in pixels of the frame, clear height, level, and pixels a step."""
    rows = []
    for octave, one in zip(octaves, places, strict=True):
        x, y = ((at + 0.5) * octave.step - 0.5 for at in (one.x, one.y))
        rows.append(np.stack([x, y, one.clear, one.level, np.full(len(x), octave.step)], 1))
    return np.concatenate(rows).astype(np.float64)


def _at(grid: NDArray[np.float32], places: Array, shape: tuple[int, ...]) -> Array:
    """Values of a grid that covers a frame [H, W] evenly, at places (x, y, …), [N]."""
    rows, columns = grid.shape[:2]
    row = np.clip((places[:, 1] + 0.5) * rows / shape[0], 0, rows - 1).astype(int)
    column = np.clip((places[:, 0] + 0.5) * columns / shape[1], 0, columns - 1).astype(int)
    return grid[row, column].astype(np.float64)


def _within(registered: Registered, places: Array, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Whether the dark frame shows places (x, y, …) and a pixel around, [N]."""
    from_x, from_y = (places[:, n] + _at(registered.coarse[..., n], places, shape) for n in (0, 1))
    return (from_x >= 1) & (from_y >= 1) & (from_x <= shape[1] - 2) & (from_y <= shape[0] - 2)


def _stuck(places: Array, lit: NDArray, registered: Registered | None, swapped: bool) -> NDArray[np.bool_]:
    """Whether candidates (x, y, snr, flux, diameter, …) are single pixels of the sensor that are too bright, [N].

    Of a pair by hand: a bright pixel that the dark frame shows too, though what it sees has moved. Of one frame alone:
    a pixel whose light no neighbour shares, as no lens makes it.
    """
    at, image, other, flow = places[:, :2], lit, None, np.zeros((len(places), 2))
    if registered is not None:
        flow = np.stack([_at(registered.coarse[..., n], places, lit.shape) for n in (0, 1)], 1)
        image, other = (registered.taken, lit) if swapped else (lit, registered.taken)
        at = at + flow if swapped else at
    x, y = (np.clip(np.rint(one), 0, end - 1).astype(np.int64) for one, end in zip(at.T, lit.shape[::-1], strict=True))
    best = patches(image, x, y, 1).reshape(-1, 9).argmax(1)
    x, y = x + best % 3 - 1, y + best // 3 - 1
    around = np.maximum.reduce(np.abs(np.mgrid[-2:3, -2:3]))
    near = patches(image, x, y, 2)
    rim = np.median(near[:, around == 2], axis=1)
    height, beside = near[:, 2, 2] - rim, near[:, around == 1].max(1) - rim
    small = places[:, 4] < _SMALL
    if registered is None or other is None:
        return small & (beside < _SHARED * height)
    same = patches(other, x, y, 2)
    moved = np.hypot(*flow.T) > 1
    return (
        small
        & moved
        & (beside < 0.5 * height)
        & (same[:, 2, 2] - np.median(same[:, around == 2], axis=1) > 0.5 * height)
    )


def _measured(cut: Cut) -> Array:
    """Place, height, flux, diameter, peak and clear height of each candidate, [N, 7], in pixels of the frame."""
    half = 6
    sigma = np.array(SIGMAS)[cut.size]
    inner = slice(HALF - half, HALF + half + 1)
    patch = cut.difference[:, inner, inner]
    along = np.arange(-half, half + 1)
    radius = np.hypot(along[:, None], along)
    rim = np.median(patch[:, radius > half - 1.5], axis=1)
    spot = np.maximum(patch - rim[:, None, None], 0)
    light = np.maximum((spot * (radius <= (2 * sigma + 1)[:, None, None])).sum((1, 2)), 1e-9)
    x, y = _centroid(spot, sigma, along)
    step = cut.step
    middle = slice(HALF - 1, HALF + 2)
    peak = cut.lit[:, middle, middle].max((1, 2))
    places = ((one + shift + 0.5) * step - 0.5 for one, shift in ((cut.x, x), (cut.y, y)))
    # The filter of width s answers a Gaussian of sigma s most.
    found = [*places, cut.height, light * step**2, 4 * sigma * step, peak, cut.clear]
    return np.stack(found, 1).astype(np.float64)


def _centroid(spot: NDArray[np.float32], sigma: Array, along: NDArray[np.int64]) -> tuple[Array, Array]:
    """Centroid [N] of spots [N, side, side] through a Gaussian window of their own width, which follows it.

    Of a Gaussian the window shows half the way to its centre: so each step goes twice as far (as in SExtractor's
    windowed positions). What lies farther out, an edge that registration left, hardly counts.
    """
    x, y = np.zeros(len(spot)), np.zeros(len(spot))
    wide = 2 * sigma[:, None] ** 2
    for _ in range(4):
        in_x, in_y = (np.exp(-((along - at[:, None]) ** 2) / wide) for at in (x, y))
        rows = (spot @ in_x[:, :, None].astype(np.float32))[..., 0]
        columns = (in_y[:, None].astype(np.float32) @ spot)[:, 0]
        light = np.maximum((rows * in_y).sum(1), 1e-9)
        x = np.clip(x + 2 * ((columns * in_x) @ along / light - x), -3, 3)
        y = np.clip(y + 2 * ((rows * in_y) @ along / light - y), -3, 3)
    return x, y


def _one_a_place(x: Array, y: Array, height: Array, diameter: Array, most: int) -> NDArray[np.int64]:
    """Numbers of the candidates, highest first, less those that lie within a higher one; at most so many."""
    order = np.argsort(-height, kind="stable")
    if not len(order):
        return order
    at = np.stack([x, y], 1)[order]
    reach = np.maximum(0.375 * diameter[order], 1)
    # Only near pairs matter, and they are few: the higher first, as its place in the order is the lower.
    pairs = KDTree(at).query_pairs(2 * float(reach.max()), output_type="ndarray")
    pairs = np.sort(pairs, axis=1)
    apart = np.linalg.norm(at[pairs[:, 0]] - at[pairs[:, 1]], axis=1)
    pairs = pairs[apart <= np.maximum(reach[pairs].max(1), 2)]
    alone = np.ones(len(order), bool)
    for higher, lower in pairs[np.argsort(pairs[:, 0], kind="stable")].tolist():
        if alone[higher]:
            alone[lower] = False
    return order[alone][:most]


def _levels(image: NDArray[np.generic], channel: str, where: str) -> NDArray:
    """The frame as grey levels from 0 to 255, [H, W]: uint8 where it was, else float32."""
    array: NDArray[Any] = np.asarray(image)
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] != 3) or min(array.shape[:2]) < 32:
        what = f"expected [H, W] or [H, W, 3] of at least 32 x 32 pixels, got shape {array.shape}"
        raise InputError(what, where=where, remedy="give a grey or an RGB picture")
    if array.shape[0] * array.shape[1] > LARGEST_FRAME:
        what = f"{array.shape[1]} x {array.shape[0]} pixels are more than can be searched at once"
        raise InputError(what, where=where, remedy=f"cut it into parts of at most {LARGEST_FRAME // 10**6} megapixels")
    if array.dtype.kind not in "uif":
        what = f"pixels of type {array.dtype} are no levels"
        raise InputError(what, where=where, remedy="give uint8, uint16 or float")
    kind = array.dtype
    if array.ndim == 3:
        array = array.mean(2, dtype=np.float32) if channel == "mean" else array[..., CHANNELS.index(channel) - 1]
    if kind == np.uint8:
        return np.ascontiguousarray(array if array.dtype == np.uint8 else array.round().astype(np.uint8))
    scale = 1.0 if kind.kind == "f" or kind == np.uint8 else _FULL / np.iinfo(str(kind)).max
    grey = array.astype(np.float32) * np.float32(scale)
    if not np.isfinite(grey).all():
        raise InputError("holds pixels that are not finite", where=where, remedy="replace NaN and infinite pixels")
    return grey
