"""From the places that were screened to candidates: where they are, how high, how wide, and their features."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from tapetum.detection.candidates import HALF, SIGMAS, Cut, Layer, Place, cut_out, layers, patches, screened
from tapetum.detection.features import OF_A_FRAME, OF_A_PAIR, beside_rivals, looks
from tapetum.detection.registration import MATCHED, Registered, local_mean, register

__all__ = [
    "DECOYS",
    "FULL",
    "MOST_ALONE",
    "MOST_OF_A_PAIR",
    "Candidates",
    "candidates_with_looks",
    "swapped_candidates",
    "with_decoys",
]

FULL = 255.0
"""Level at which a frame saturates."""
MOST_OF_A_PAIR, MOST_ALONE = 100, 200
"""Most candidates of a pair, and of one frame alone."""
DECOYS = 24
"""Most decoys of a pair."""
_OUTLIER = OF_A_FRAME.index("outlier")
# Of an octave's places that only the dark frame shows bright, how many candidates are compared with.
_RIVALS = 24
# Of a pixel's light, what a neighbour has at least where a lens draws it: a spot of 0.4 pixels shows 0.13 of it.
_SHARED = 0.1
# Diameter below which a candidate may be a single pixel: on a wide spot the noise of one counts for nothing.
_SMALL = 7.0

Array = NDArray[np.float64]


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
        most = MOST_ALONE if registered is None else MOST_OF_A_PAIR
    return with_decoys(layers(lit, registered, largest), registered, most, lit)


def with_decoys(
    octaves: list[Layer], registered: Registered | None, most: int, lit: NDArray
) -> tuple[Candidates, Candidates | None]:
    """At most so many candidates of a frame's octaves, and in a pair its decoys, as `candidates_with_looks`."""
    screens = _screened(octaves, most)
    found = _candidates(octaves, screens, registered, most, lit)
    if registered is None:
        return found, None
    turned = [(rivals, places.first(len(rivals.x))) for places, rivals in screens]
    swapped = [one.swapped() for one in octaves]
    # A few decoys do not show what is usual in the frame: the candidates' heights do.
    return found, _candidates(swapped, turned, registered, DECOYS, lit, swapped=True, among=found.columns["snr"])


def swapped_candidates(octaves: list[Layer], registered: Registered, most: int, lit: NDArray) -> Candidates:
    """At most so many candidates of a pair whose frames are taken the other way round."""
    turned = [one.swapped() for one in octaves]
    return _candidates(turned, _screened(turned, most), registered, most, lit, swapped=True)


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
    features = looks(cut, _at(mean, table, shape), FULL, None if registered is None else registered.coarse)
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
