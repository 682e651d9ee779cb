"""The mean of a picture over each pixel's sensitive area, from samples at points.

A picture holds no period shorter than λf_p/2R, R the radius of the light that meets the probe's lens, as its field
holds none shorter than λf_p/R. So few samples of it decide its means: as a filter of some taps along columns and rows,
fitted to the transform of a square by least squares. A pixel that is wider than such a period has several samples.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from tapetum.errors import InputError
from tapetum.optics.grid import Grid

__all__ = ["PixelArea", "change_by_area"]

# Samples a period at least: two hold it, as long as nothing lies just at it.
_FEWEST = 2.2

# Largest error of a mean, over the picture's peak, as a share of the accuracy.
_SHARE, _LEAST = 0.1, 1e-5
_MOST_TAPS, _MOST_PARTS = 8, 64
# Frequencies at which the fit is made.
_FITTED = 400


@dataclass(frozen=True)
class PixelArea:
    """Means over pixels of `output`, from `parts` samples a pixel along both axes.

    `taps` weigh the samples about a pixel's middle, the middle first, or the nearest pair where `parts` is even;
    `error` is the largest of a mean, over the picture's peak.
    """

    output: Grid
    parts: int
    taps: tuple[float, ...]
    error: float

    @classmethod
    def of(cls, output: Grid, fill: float, finest: float, accuracy: float) -> PixelArea:
        """The fewest samples for a square of this share of a pixel, in pictures of periods from `finest` metres on.

        Raises InputError for pixels of more than a few dozen periods.
        """
        if not fill:
            return cls(output, 1, (1.0,), 0.0)
        period, side = finest / output.pitch, math.sqrt(fill)
        most = max(_SHARE * accuracy, _LEAST)
        for parts in range(max(1, math.ceil(_FEWEST / period)), _MOST_PARTS + 1):
            for count in range(1, _MOST_TAPS + math.ceil(parts / 2) + 1):
                taps, error = _fitted(period * parts, side * parts, parts % 2 == 0, count)
                if error <= most:
                    return cls(output, parts, taps, error)
        what = f"a pixel of {output.pitch:.3g} m spans {1 / period:.3g} periods of the picture's finest fringes"
        raise InputError(what, where="probe.sensor.pitch", remedy="make pixels finer, or take a shorter probe lens")

    @property
    def samples(self) -> Grid:
        """The grid of the samples, about the same middle as the pixels."""
        if self.taps == (1.0,):
            return self.output
        reach = 2 * (len(self.taps) - 1) + (self.parts % 2 == 0)
        rows, columns = (self.parts * (count - 1) + 1 + reach for count in self.output.shape)
        return Grid(rows, columns, self.output.pitch / self.parts, self.output.centre)

    def means(self, picture: torch.Tensor) -> torch.Tensor:
        """Means [..., H, W] over pixels of a picture at the samples; differentiable."""
        if self.taps == (1.0,):
            return picture
        if picture.requires_grad or picture.is_cuda:
            return self._along(self._along(picture, -2), -1)
        # One picture after the other stays in the processor's cache.
        found = picture.new_empty(*picture.shape[:-2], *self.output.shape)
        for one, into in zip(picture.reshape(-1, *picture.shape[-2:]), found.view(-1, *self.output.shape), strict=True):
            into[...] = self._along(self._along(one, -2), -1)
        return found

    def _along(self, picture: torch.Tensor, axis: int) -> torch.Tensor:
        count = self.output.rows if axis == -2 else self.output.columns
        length, far = self.parts * (count - 1) + 1, len(self.taps) - 1
        even = self.parts % 2 == 0

        def at(first: int) -> torch.Tensor:
            part = picture.narrow(axis, first, length)
            return part if self.parts == 1 else part[..., :: self.parts, :] if axis == -2 else part[..., :: self.parts]

        total: torch.Tensor | None = None
        for n, tap in enumerate(self.taps):
            if n == 0 and not even:
                total = tap * at(far)
                continue
            pair = at(far - n) + at(far + n + even)
            total = tap * pair if total is None else torch.add(total, pair, alpha=tap)
        assert total is not None
        return total


def change_by_area(pictures: torch.Tensor, output: Grid, finest: float) -> float:
    """Largest change of pictures [B, H, W] of points by the mean over whole pixels of `output`, over their peaks.

    `finest` is their shortest period in metres. Infinite where it is so short that points do not show the picture. The
    outermost pixels, about which too little is known, are left out; of a picture of few pixels it is what the finest
    fringes lose.
    """
    if finest < _FEWEST * output.pitch:
        return math.inf
    area = PixelArea.of(output, 1.0, finest, 0.01)
    reach = len(area.taps) - 1
    if min(output.shape) <= 2 * reach:
        return 1 - float(np.sinc(output.pitch / finest)) ** 2
    inner = replace(area, output=Grid(output.rows - 2 * reach, output.columns - 2 * reach, output.pitch))
    shown = pictures.detach()
    middle = shown[..., reach : output.rows - reach, reach : output.columns - reach]
    apart = (inner.means(shown) - middle).abs().amax((-2, -1))
    return float((apart / shown.amax((-2, -1)).clamp_min(1e-30)).max())


@functools.lru_cache(maxsize=256)
def _fitted(period: float, side: float, even: bool, count: int) -> tuple[tuple[float, ...], float]:
    """Taps for a square of `side` samples in pictures of periods from `period` samples on, and their largest error.

    What is fitted is weighed by the transform of the finest picture, a pupil's autocorrelation, which falls to 0.
    """
    places = np.arange(count) + (0.5 if even else 0.0)
    top = 2 * np.pi / period
    turn = np.linspace(0, min(top, np.pi), _FITTED)
    waves = np.cos(np.outer(turn, places)) * np.where(places == 0, 1.0, 2.0)
    wanted, weight = np.sinc(side * turn / (2 * np.pi)), 1 - turn / top
    # The mean of an even picture is itself.
    rows = np.vstack([waves * weight[:, None], 1e4 * waves[:1]])
    taps = np.linalg.lstsq(rows, np.append(wanted * weight, 1e4), rcond=None)[0]
    error = 2 * float(np.abs((waves @ taps - wanted) * weight).max())
    return tuple(float(one) for one in taps), error
