"""Starting poses of a fit: a coarse bank of images over the field, matched to a crop by weighted least squares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby

import numpy as np
from numpy import fft
from numpy.typing import NDArray

from tapetum.models.simulation.pictures import Pictures, Pose
from tapetum.progress import Progress, quiet

__all__ = ["Bank", "Templates"]

Array = NDArray[np.float64]
# Binning along each axis, and largest distance of an RR from the crop's middle, in pixels.
_BIN, _REACH = 2, 40
# Binning that a bank is first searched with, in single precision.
_COARSE = 4
# Best matches of that search about which neighbours are compared as well.
_FIRST = 4
# Poses rendered at once: alone, each costs several times as much.
_TOGETHER = 12


class Templates:
    """Images of some poses, ready to be matched to crops at any place.

    Images depend on the photosites' phase, so those half a period apart are averaged, which cancels the lowest orders;
    the others hold little of a crop's light. With `coarse` they are kept at a coarser binning, too, for `rank`.
    """

    def __init__(
        self, pictures: Pictures, poses: Sequence[Pose], progress: Progress = quiet, *, coarse: bool = False
    ) -> None:
        self.pictures, self.poses = pictures, list(poses)
        period = pictures.period
        steps = np.zeros((1, 2)) if period is None else np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * period / 2
        self._fine = _Scale(pictures.side, _BIN, np.float64)
        self._coarse = _Scale(pictures.side, _COARSE, np.float32) if coarse else None
        for some in progress(_alike(self.poses), "rendering the field"):
            shifted = [(pose, np.array(pose.gaze) + step) for pose in some for step in steps]
            made = pictures.render_each([replace(pose, gaze=(float(x), float(y))) for pose, (x, y) in shifted])
            light = made.reshape(len(some), len(steps), *made.shape[1:]).mean(1)
            self._fine.add(light)
            if self._coarse is not None:
                self._coarse.add(light)

    def match(self, electrons: Array, weight: Array, numbers: Sequence[int] | None = None) -> list[tuple[Pose, float]]:
        """Return every pose at the place and power that fit a crop best, with the weighted squares that it explains.

        `electrons` and `weight` are [side, side] of a crop and its pixels' inverse variances, 0 where saturated;
        `numbers` are those of the poses that are wanted.
        """
        wanted = list(range(len(self.poses)) if numbers is None else numbers)
        found = self._fine.fitted(electrons, weight, wanted)
        step, usual = _BIN * self.pictures.pitch, self.pictures.scene.illumination.power
        placed: list[tuple[Pose, float]] = []
        for number, (score, scale, row, column) in zip(wanted, found.tolist(), strict=True):
            pose = self.poses[number]
            place = (pose.place[0] + column * step, pose.place[1] + row * step)
            placed.append((replace(pose, place=place, power=max(1e-3, scale) * usual), score))
        return placed

    def rank(self, electrons: Array, weight: Array) -> Array:
        """Return about how much [T] of a crop's weighted squares each pose explains, from coarse images."""
        assert self._coarse is not None
        return self._coarse.fitted(electrons, weight, range(len(self.poses)))[:, 0]


class _Scale:
    """Transforms of images [T, side, side], binned, and of their squares, for a fit at any shift."""

    def __init__(self, side: int, step: int, precision: type[np.floating]) -> None:
        self._step, self._precision, self._reach = step, precision, _REACH // step
        # Multiples of 16 transform fast.
        size = -(-(side // step + 2 * self._reach) // 16) * 16
        self._shape = (size, size)
        self._templates: list[NDArray[np.complexfloating]] = []

    def add(self, light: Array) -> None:
        for one in light:
            binned = _binned(one, self._step).astype(self._precision)
            self._templates.append(fft.rfft2(np.stack([binned, binned**2]), self._shape).conj())

    def fitted(self, electrons: Array, weight: Array, numbers: Sequence[int]) -> Array:
        """Fit scale, background and shift of some templates by least squares.

        Returns [T, 4]: the squares that are explained, the scale, and the rows and columns of the shift.
        """
        weights = _binned(weight, self._step)
        values = _binned(electrons * weight, self._step) / np.maximum(weights, 1e-30)
        total = float(weights.sum())
        values = values - float((weights * values).sum() / total)
        known = fft.rfft2(np.stack([weights, weights * values]).astype(self._precision), self._shape)
        rows = np.r_[-self._reach : self._reach + 1]
        near = np.ix_(rows, rows)
        found = np.empty((len(numbers), 4))
        for at, number in enumerate(numbers):
            template, square = self._templates[number]
            made = np.stack([known[0] * template, known[0] * square, known[1] * template])
            st, stt, sdt = fft.irfft2(made, self._shape)[:, near[0], near[1]]
            # The values have weighted mean 0, so only the template's mean remains of the background.
            spread = np.maximum(stt - st**2 / total, 1e-9 * float(stt.max()))
            scale = sdt / spread
            score = np.where(scale > 0, scale * sdt, 0.0)
            row, column = np.unravel_index(int(np.argmax(score)), score.shape)
            found[at] = score[row, column], scale[row, column], rows[row], rows[column]
        return found


class Bank:
    """Images of one target at `nodes` x `nodes` gazes over its field."""

    def __init__(self, pictures: Pictures, nodes: int, progress: Progress = quiet) -> None:
        self.nodes = nodes
        line = np.linspace(-0.48, 0.48, nodes) if nodes > 1 else np.zeros(1)
        self.gazes = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        self.spacing = 0.96 / max(1, nodes - 1)
        poses = [replace(pictures.start(), gaze=(float(x), float(y))) for x, y in self.gazes]
        self._templates = Templates(pictures, poses, progress, coarse=True)

    def match(self, electrons: Array, weight: Array, count: int) -> list[Pose]:
        """Return the best `count` starting poses, no two neighbours, the opposite of the best gaze among them.

        `electrons` and `weight` as for `Templates.match`. Coarse images choose those that are compared closely.
        """
        likely = self._apart(np.argsort(-self._templates.rank(electrons, weight)).tolist(), count)
        near = [np.flatnonzero(self._away(number) < 1.1 * self.spacing) for number in likely[:_FIRST]]
        numbers = np.unique(np.concatenate([likely, *near])).tolist()
        placed = dict(zip(numbers, self._templates.match(electrons, weight, numbers), strict=True))
        best = max(placed, key=lambda one: placed[one][1])
        opposite = int(np.argmin(np.hypot(*(self.gazes + self.gazes[best]).T)))
        placed |= {opposite: self._templates.match(electrons, weight, [opposite])[0]}
        others = sorted(placed, key=lambda one: -placed[one][1])
        return [placed[one][0] for one in self._apart([best, opposite, *others], count)]

    def _away(self, number: int) -> Array:
        """Return the distances of all gazes from one of them."""
        return np.hypot(*(self.gazes - self.gazes[number]).T)

    def _apart(self, order: Sequence[int], count: int) -> list[int]:
        """Return the first `count` numbers of gazes of which no two are neighbours."""
        chosen: list[int] = []
        free = np.ones(len(self.gazes), bool)
        for number in order:
            if len(chosen) < count and free[number]:
                chosen.append(number)
                free &= self._away(number) >= 1.5 * self.spacing
        return chosen


def _alike(poses: Sequence[Pose]) -> list[list[Pose]]:
    """Return runs of poses that are rendered together: of one focus, and all turned or none."""
    runs = groupby(poses, key=lambda one: (one.object_distance, one.focal_length, one.roll != 0))
    return [some[k : k + _TOGETHER] for _, own in runs for some in [list(own)] for k in range(0, len(some), _TOGETHER)]


def _binned(picture: Array, step: int) -> Array:
    """Return means over squares of `step` pixels, [side / step, side / step], without rows and columns left over."""
    side = len(picture) // step
    return picture[: side * step, : side * step].reshape(side, step, side, step).mean((1, 3))
