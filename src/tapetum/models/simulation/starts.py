"""Where a fit begins: a coarse bank of pictures over the field, laid over a crop by weighted least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy import fft
from numpy.typing import NDArray

from tapetum.models.simulation.pictures import Pictures, Pose
from tapetum.progress import Progress, quiet

__all__ = ["Bank", "Start"]

Array = NDArray[np.float64]
# Pixels binned along an edge, and how far an RR may lie from the middle of its crop, in binned pixels.
_BIN, _REACH = 2, 20


@dataclass(frozen=True)
class Start:
    """A pose to begin with, and the weighted squares that it explains."""

    pose: Pose
    score: float


class Bank:
    """Pictures of one target at nodes over its field.

    Parameters
    ----------
    pictures
        Renders them.
    poses
        One for each focus to be tried.
    nodes
        Along an edge of the field.
    progress
        Shown while they are rendered.

    Notes
    -----
    Photosites make a picture depend on where within their period the spot lies. Pictures half a period apart are
    averaged, which takes out what the lowest orders do; what the others do is a small part of a crop's light.
    """

    def __init__(self, pictures: Pictures, poses: list[Pose], nodes: int, progress: Progress = quiet) -> None:
        self.pictures, self.nodes = pictures, nodes
        line = np.linspace(-0.48, 0.48, nodes) if nodes > 1 else np.zeros(1)
        self.gazes = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
        self.poses = [replace(pose, gaze=(float(x), float(y))) for pose in poses for x, y in self.gazes]
        period = pictures.period
        steps = np.zeros((1, 2)) if period is None else np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * period / 2
        # Multiples of 16 transform fast.
        size = -(-(pictures.side // _BIN + 2 * _REACH) // 16) * 16
        self._shape = (size, size)
        self._templates: list[tuple[NDArray[np.complex128], NDArray[np.complex128]]] = []
        for pose in progress(self.poses, "rendering the field"):
            made = _binned(pictures.render(pose, np.array(pose.gaze) + steps).mean(0))
            self._templates.append((fft.rfft2(made, self._shape), fft.rfft2(made**2, self._shape)))

    def match(self, electrons: Array, weight: Array, count: int) -> list[Start]:
        """The best `count` starts, no two of them neighbours; among them the opposite of the best one's gaze.

        Parameters
        ----------
        electrons, weight
            [side, side] of a crop, and the inverse variances of its pixels: 0 for those that tell nothing.
        count
            How many.
        """
        # The mean of a bin with weights that differ; its own weight is their sum.
        weights = _binned(weight)
        values = _binned(electrons * weight) / np.maximum(weights, 1e-30)
        level = float((weights * values).sum() / weights.sum())
        values = values - level
        known = fft.rfft2(weights, self._shape), fft.rfft2(weights * values, self._shape)
        found = [self._lay(number, known, float(weights.sum())) for number in range(len(self.poses))]
        order = sorted(range(len(found)), key=lambda n: -found[n].score)
        chosen: list[Start] = []
        best = found[order[0]]
        opposite = self._nearest(best, found)
        apart = 1.5 * (0.96 / max(1, self.nodes - 1))
        for one in [best, opposite, *(found[n] for n in order[1:])]:
            near = [np.hypot(*np.subtract(one.pose.gaze, other.pose.gaze)) < apart for other in chosen]
            if not any(near) and len(chosen) < count:
                chosen.append(one)
        return chosen

    def _nearest(self, best: Start, found: list[Start]) -> Start:
        """What was found at the gaze opposite to the best one's, at its focus."""
        focus = best.pose.object_distance
        alike = [one for one in found if one.pose.object_distance == focus]
        return min(alike, key=lambda one: float(np.hypot(*np.add(one.pose.gaze, best.pose.gaze))))

    def _lay(self, number: int, known: tuple[NDArray[np.complex128], NDArray[np.complex128]], total: float) -> Start:
        """Scale, background and shift of one template, by weighted least squares at all shifts at once."""
        template, square = self._templates[number]
        weights, weighted = known
        st, stt, sdt = (
            fft.irfft2(one, self._shape)
            for one in (weights * template.conj(), weights * square.conj(), weighted * template.conj())
        )
        rows = np.r_[-_REACH : _REACH + 1]
        near = np.ix_(rows, rows)
        st, stt, sdt = st[near], stt[near], sdt[near]
        # The values' weighted mean has been taken off: what is left of the background is that of the template.
        spread = np.maximum(stt - st**2 / total, 1e-9 * float(stt.max()))
        scale = sdt / spread
        score = np.where(scale > 0, scale * sdt, 0.0)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        gain = max(1e-3, float(scale[row, column]))
        pose, step = self.poses[number], _BIN * self.pictures.pitch
        place = (pose.place[0] + float(rows[column]) * step, pose.place[1] + float(rows[row]) * step)
        power = gain * self.pictures.scene.illumination.power
        return Start(replace(pose, place=place, power=power), float(score[row, column]))


def _binned(picture: Array) -> Array:
    """Mean over squares of `_BIN` pixels, [side / _BIN, side / _BIN]; a last odd row or column is left out."""
    side = len(picture) // _BIN * _BIN
    return picture[:side, :side].reshape(side // _BIN, _BIN, side // _BIN, _BIN).mean((1, 3))
