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
# Binning along each axis, and largest distance of an RR from the crop's middle, in binned pixels.
_BIN, _REACH = 2, 20
# Poses rendered at once: alone, each costs several times as much.
_TOGETHER = 12


class Templates:
    """Images of some poses, ready to be matched to crops at any place.

    Images depend on the photosites' phase, so those half a period apart are averaged, which cancels the lowest orders;
    the others hold little of a crop's light.
    """

    def __init__(self, pictures: Pictures, poses: Sequence[Pose], progress: Progress = quiet) -> None:
        self.pictures, self.poses = pictures, list(poses)
        period = pictures.period
        steps = np.zeros((1, 2)) if period is None else np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * period / 2
        # Multiples of 16 transform fast.
        size = -(-(pictures.side // _BIN + 2 * _REACH) // 16) * 16
        self._shape = (size, size)
        self._templates: list[tuple[NDArray[np.complex128], NDArray[np.complex128]]] = []
        for some in progress(_alike(self.poses), "rendering the field"):
            shifted = [(pose, np.array(pose.gaze) + step) for pose in some for step in steps]
            made = pictures.render_each([replace(pose, gaze=(float(x), float(y))) for pose, (x, y) in shifted])
            for light in made.reshape(len(some), len(steps), *made.shape[1:]).mean(1):
                binned = _binned(light)
                self._templates.append((fft.rfft2(binned, self._shape), fft.rfft2(binned**2, self._shape)))

    def match(self, electrons: Array, weight: Array, numbers: Sequence[int] | None = None) -> list[tuple[Pose, float]]:
        """Return every pose at the place and power that fit a crop best, with the weighted squares that it explains.

        `electrons` and `weight` are [side, side] of a crop and its pixels' inverse variances, 0 where saturated;
        `numbers` are those of the poses that are wanted.
        """
        weights = _binned(weight)
        values = _binned(electrons * weight) / np.maximum(weights, 1e-30)
        values = values - float((weights * values).sum() / weights.sum())
        known = fft.rfft2(weights, self._shape), fft.rfft2(weights * values, self._shape)
        wanted = range(len(self.poses)) if numbers is None else numbers
        return [self._placed(number, known, float(weights.sum())) for number in wanted]

    def _placed(
        self, number: int, known: tuple[NDArray[np.complex128], NDArray[np.complex128]], total: float
    ) -> tuple[Pose, float]:
        """Fit a template's scale, background and shift by least squares; return its pose and explained squares."""
        template, square = self._templates[number]
        weights, weighted = known
        rows = np.r_[-_REACH : _REACH + 1]
        st, stt, sdt = (
            fft.irfft2(one, self._shape)[np.ix_(rows, rows)]
            for one in (weights * template.conj(), weights * square.conj(), weighted * template.conj())
        )
        # The values have weighted mean 0, so only the template's mean remains of the background.
        spread = np.maximum(stt - st**2 / total, 1e-9 * float(stt.max()))
        scale = sdt / spread
        score = np.where(scale > 0, scale * sdt, 0.0)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        pose, step = self.poses[number], _BIN * self.pictures.pitch
        place = (pose.place[0] + float(rows[column]) * step, pose.place[1] + float(rows[row]) * step)
        power = max(1e-3, float(scale[row, column])) * self.pictures.scene.illumination.power
        return replace(pose, place=place, power=power), float(score[row, column])


class Bank:
    """Images of one target at `nodes` x `nodes` gazes over its field, for each pose (one per focus)."""

    def __init__(self, pictures: Pictures, poses: list[Pose], nodes: int, progress: Progress = quiet) -> None:
        self.pictures, self.nodes = pictures, nodes
        line = np.linspace(-0.48, 0.48, nodes) if nodes > 1 else np.zeros(1)
        self.gazes = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        every = [replace(pose, gaze=(float(x), float(y))) for pose in poses for x, y in self.gazes]
        self._templates = Templates(pictures, every, progress)

    def match(self, electrons: Array, weight: Array, count: int) -> list[Pose]:
        """Return the best `count` starting poses, no two neighbours, the opposite of the best gaze among them.

        `electrons` and `weight` as for `Templates.match`.
        """
        placed = self._templates.match(electrons, weight)
        best, *others = (pose for pose, _ in sorted(placed, key=lambda one: -one[1]))
        focused = [pose for pose, _ in placed if pose.object_distance == best.object_distance]
        opposite = min(focused, key=lambda pose: float(np.hypot(*np.add(pose.gaze, best.gaze))))
        apart = 1.5 * (0.96 / max(1, self.nodes - 1))
        chosen: list[Pose] = []
        for pose in [best, opposite, *others]:
            near = any(np.hypot(*np.subtract(pose.gaze, other.gaze)) < apart for other in chosen)
            if not near and len(chosen) < count:
                chosen.append(pose)
        return chosen


def _alike(poses: Sequence[Pose]) -> list[list[Pose]]:
    """Return runs of poses that are rendered together: of one focus, and all turned or none."""
    runs = groupby(poses, key=lambda one: (one.object_distance, one.focal_length, one.roll != 0))
    return [some[k : k + _TOGETHER] for _, own in runs for some in [list(own)] for k in range(0, len(some), _TOGETHER)]


def _binned(picture: Array) -> Array:
    """Return means over squares of `_BIN` pixels, [side / _BIN, side / _BIN]; an odd last row or column is dropped."""
    side = len(picture) // _BIN * _BIN
    return picture[:side, :side].reshape(side // _BIN, _BIN, side // _BIN, _BIN).mean((1, 3))
