"""Dark and flat frames of a sensor, gathered into levels: frames under one light and exposure, as sums over a grid.

Only sums are kept of a level, by tile of a grid over the frame, so that long videos of large frames fit into memory.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.errors import InputError
from tapetum.record.images import IMAGE_SUFFIXES, natural_key
from tapetum.record.source import Frame, Source

__all__ = ["Level", "Tiles", "exposure_in", "gather", "parts_of"]

Array = NDArray[np.float64]

_TILES, _LEAST_TILE = 8, 8  # most tiles along a side, and fewest pixels along one of theirs
# A frame whose signal differs by more from the level's so far begins another one.
_STEP = 0.08
_UNITS = {"us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ms": 1e-3, "s": 1.0}
_TIME = re.compile(r"(?<![\d.])(\d+(?:\.\d+)?) ?(us|µs|μs|ms|s)(?![a-z])", re.IGNORECASE)


@dataclass(frozen=True)
class Tiles:
    """A grid of equal tiles over frames of `height` x `width` pixels; a remainder at the lower right is left out."""

    height: int
    width: int

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 4 * _LEAST_TILE:
            what = f"{self.width} x {self.height} px are too few to separate noise from pattern"
            raise InputError(what, remedy=f"give frames of {4 * _LEAST_TILE} x {4 * _LEAST_TILE} px or more")

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return min(_TILES, self.height // _LEAST_TILE), min(_TILES, self.width // _LEAST_TILE)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of pixels in a tile."""
        return self.height // self.grid[0], self.width // self.grid[1]

    def split(self, image: NDArray[Any]) -> NDArray[Any]:
        """Return an image [H, W] as [tiles, pixels of a tile]."""
        (down, across), (rows, columns) = self.grid, self.size
        kept = image[: down * rows, : across * columns].reshape(down, rows, across, columns)
        return kept.transpose(0, 2, 1, 3).reshape(down * across, rows * columns)


@dataclass(frozen=True, eq=False)
class Level:
    """Statistics of frames under one light and exposure, in digital numbers; T tiles.

    Attributes
    ----------
    name, exposure, frames
        Where it is from, seconds if known, and how many frames.
    mean, square
        [T] mean of the pixels, and of the squares of their temporal means.
    variance
        [T] temporal variance of a pixel (n - 1), mean over the tile's pixels; the frames' common flicker is in it.
    pattern
        [T] variance over the pixels of their temporal mean, smooth changes of the light taken out; noise is in it.
    top
        [T] share of pixels that ever read the frames' largest number.
    zero
        [T] share of single readings that are 0.
    pixels
        [T] pixels counted: those of the mask.
    neighbours
        Correlation of the noise of a pixel with its neighbours', to the right and below.
    frame_means, row_spread
        [n] mean of each frame, and the RMS of the rows' means about their frame's, over what noise explains.
    repeated
        Frames that equal the one before.
    step, largest, depth
        Greatest common divisor of all numbers, the largest one, and the full scale that the source states.
    image
        [H, W] temporal mean.
    """

    name: str
    exposure: float | None
    frames: int
    mean: Array
    square: Array
    variance: Array
    pattern: Array
    top: Array
    zero: Array
    pixels: Array
    neighbours: tuple[float, float]
    frame_means: Array
    row_spread: float
    repeated: int
    step: int
    largest: int
    depth: int
    image: NDArray[np.float32] = field(repr=False)

    @property
    def flicker(self) -> float:
        """Variance of the frames' means beyond the pixels' noise, in digital numbers squared; may be below 0."""
        noise = float(np.average(self.variance, weights=self.pixels)) / float(self.pixels.sum())
        return float(np.var(self.frame_means, ddof=1)) - noise

    def mean_of(self, values: Array) -> float:
        """Mean of a quantity over the tiles, by their pixels."""
        return float(np.average(values, weights=np.maximum(self.pixels, 1e-9)))


@dataclass
class _Sums:
    """Frames of one level while they come."""

    name: str
    tiles: Tiles
    exposure: float | None
    frames: int = 0
    repeated: int = 0
    depth: int = 0
    means: list[float] = field(default_factory=list)

    def add(self, frame: Frame) -> None:
        image = frame.image
        if self.frames == 0:
            self.total = np.zeros(image.shape, np.uint64)
            self.squares = np.zeros(image.shape, np.uint64)
            self.highest = image.copy()
            self.zeros = np.zeros(image.shape, np.uint32)
            self.steps, self.products, self.rows = 0, np.zeros(3), list[Array]()
        elif np.array_equal(image, self.last):
            self.repeated += 1
        else:
            self._differences(image)
        wide = image.astype(np.uint64)
        self.total += wide
        self.squares += wide * wide
        np.maximum(self.highest, image, out=self.highest)
        self.zeros += image == 0
        self.steps = int(np.gcd.reduce(np.flatnonzero(np.bincount(image.ravel())), initial=self.steps))
        self.rows.append(image.mean(axis=1))
        self.means.append(float(self.rows[-1].mean()))
        self.depth = max(self.depth, int(frame.full_scale or 0))
        self.last = image
        self.frames += 1

    def _differences(self, image: NDArray[np.generic]) -> None:
        """Add to the products of neighbours in the difference of two frames, in which no pattern is left."""
        between = image.astype(np.float32) - self.last.astype(np.float32)
        between -= between.mean()
        across = float(np.mean(between[:, 1:] * between[:, :-1], dtype=np.float64))
        down = float(np.mean(between[1:] * between[:-1], dtype=np.float64))
        self.products += (float(np.mean(between * between, dtype=np.float64)), across, down)

    def level(self, mask: NDArray[np.bool_] | None) -> Level:
        """Return what was gathered of the pixels in a mask."""
        n, split = self.frames, self.tiles.split
        mean = self.total / n
        variance = np.maximum(self.squares - self.total * mean, 0) / (n - 1)
        wanted = np.ones(mean.shape, bool) if mask is None else mask
        inside = split(wanted).astype(np.float64)
        pixels = inside.sum(axis=1)

        def over(values: NDArray[Any]) -> Array:
            return (split(values) * inside).sum(axis=1) / np.maximum(pixels, 1)

        largest = int(self.highest.max())
        noise, across, down = self.products
        rows = np.array(self.rows)
        # Rows that brighten and darken on their own, as under lamps of the mains; their pattern stays, and goes out.
        own = rows - rows.mean(axis=0) - (rows.mean(axis=1, keepdims=True) - rows.mean())
        spread = float((own**2).sum() / max(1, (n - 1) * (own.shape[1] - 1))) - float(variance.mean()) / mean.shape[1]
        return Level(
            name=self.name,
            exposure=self.exposure,
            frames=n,
            mean=over(mean),
            square=over(mean**2),
            variance=over(variance),
            pattern=_pattern(mean, wanted, self.tiles),
            top=over(self.highest == largest),
            zero=over(self.zeros / n),
            pixels=pixels,
            neighbours=(across / noise, down / noise) if noise > 0 else (0.0, 0.0),
            frame_means=np.array(self.means),
            row_spread=float(np.sqrt(max(spread, 0.0))),
            repeated=self.repeated,
            step=max(1, self.steps),
            largest=largest,
            depth=self.depth,
            image=mean.astype(np.float32),
        )


def _pattern(mean: Array, mask: NDArray[np.bool_], tiles: Tiles) -> Array:
    """Variance [T] of the pixels of each tile about a second-order surface, which stands for uneven light."""
    rows, columns = tiles.size
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    surface = np.stack([np.ones(x.shape), x, y, x * x, x * y, y * y], axis=-1).reshape(-1, 6)
    found = []
    for values, inside in zip(tiles.split(mean), tiles.split(mask), strict=True):
        if inside.sum() <= 2 * surface.shape[1]:
            found.append(np.nan)
            continue
        terms, here = surface[inside], values[inside]
        rest = here - terms @ np.linalg.lstsq(terms, here, rcond=None)[0]
        found.append(float((rest**2).sum() / (len(here) - surface.shape[1])))
    return np.array(found)


def exposure_in(name: str) -> float | None:
    """Return an exposure time that a name states, such as 2.5 in `flat-2.5s`, in seconds; None without one."""
    found = _TIME.findall(Path(name).name.replace("_", " "))
    return float(found[-1][0]) * _UNITS[found[-1][1].lower()] if found else None


def parts_of(source: str) -> list[str]:
    """Return the folders of images in a folder that holds no image itself, in natural order; else the source alone."""
    place = Path(source)
    if not place.is_dir() or (place / "recording.json").exists():
        return [source]
    entries = [entry for entry in place.iterdir() if not entry.name.startswith(".")]
    if any(entry.suffix.lower() in IMAGE_SUFFIXES for entry in entries if entry.is_file()):
        return [source]
    inner = [entry for entry in entries if entry.is_dir() or entry.suffix.lower() in (".npy", ".mkv", ".avi", ".mp4")]
    return [str(entry) for entry in sorted(inner, key=lambda entry: natural_key(entry.name))] or [source]


def gather(
    frames: Iterable[Frame], source: Source, *, dark: float | None = None, mask: NDArray[np.bool_] | None = None
) -> Iterator[Level]:
    """Yield the levels of a source: frames of one exposure whose mean signal agrees within 8 %, one after another.

    Levels of fewer than two frames, as while the light changes, are left out.

    Parameters
    ----------
    frames, source
        Its frames, and the source for its name.
    dark
        Mean digital number without light, from which a signal counts; None while that is not known: then all frames of
        one exposure are one level.
    mask
        [H, W] pixels that count.

    Raises
    ------
    InputError
        When the frames are too small, or differ in size.
    """
    sums: _Sums | None = None
    shape: Sequence[int] | None = None
    for frame in frames:
        if shape is not None and frame.image.shape != tuple(shape):
            what = f"{frame.name or 'a frame'} is {_size(frame.image.shape)}, the ones before are {_size(shape)}"
            raise InputError(what, where=source.name, remedy="give frames of one size")
        shape = frame.image.shape
        if mask is not None and mask.shape != frame.image.shape:
            what = f"frames are {_size(shape)}, the dark ones {_size(mask.shape)}"
            raise InputError(what, where=source.name, remedy="take dark and flat frames with the same settings")
        exposure = exposure_in(frame.name) if frame.exposure is None else frame.exposure
        exposure = exposure_in(source.name) if exposure is None else exposure
        if sums is not None and not _belongs(sums, frame, exposure, dark):
            if sums.frames > 1:
                yield sums.level(mask)
            sums = None
        if sums is None:
            sums = _Sums(source.name, Tiles(shape[0], shape[1]), exposure)
        sums.add(frame)
    if sums is not None and sums.frames > 1:
        yield sums.level(mask)


def _belongs(sums: _Sums, frame: Frame, exposure: float | None, dark: float | None) -> bool:
    if exposure != sums.exposure:
        return False
    if dark is None:
        return True
    signal, now = float(np.mean(sums.means)) - dark, float(frame.image.mean()) - dark
    # A signal below a digital number or two is as good as none.
    return abs(now - signal) <= max(_STEP * abs(signal), 2.0)


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]} x {shape[0]} px"
