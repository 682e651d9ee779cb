"""What stands under the laser's spot, from what stands around it.

The laser stands at one place of the room, so that the same piece of wall lies under its spot in every frame, and the
edge of a book there draws all places of a recording to one side. Frames moved onto each other show that piece but for
what the spot hides in all of them. There it is continued as a Gaussian process whose samples have straight edges: what
is seen of an edge on either side of the spot says where it passes under it. What the process cannot know is a deviation
that the places have in common.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, cholesky, solve_triangular

from tapetum.record.streak import HALF, Streaks

__all__ = ["GROUP", "surroundings"]

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

GROUP = 8
"""Successive frames, by their numbers, that share a picture of what is under the spot; the groups before and after them
take part in it."""
# Of the spot's sigma about its streak: nearer, a pixel without the fitted spot says too little of the wall (chosen in
# simulated rooms).
_CLEAR = 2.2
_FEWEST = 3  # frames in which a pixel is clear of the spot for it to be known
_RADIUS = 9.0  # px, how far the process looks
_LEAST = 40  # pixels that it needs
# Its edges: narrow across and long along them (px), in two directions at right angles, turned as most edges around the
# spot are; a part without direction and one of noise, in parts of the edges' variance (chosen in simulated rooms).
_ACROSS, _ALONG, _DIRECTIONS, _ROUND, _NOISE = 2.0, 40.0, 2, 0.2, 5e-4
_TURNS = 18  # steps of the angle between directions
_SIDE = 2 * HALF + 1
_Y, _X = (axis.ravel().astype(float) for axis in np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1])
_DISC = np.hypot(_X, _Y) <= _RADIUS


def surroundings(
    patches: Single, found: Streaks, good: npt.NDArray[np.bool_], numbers: npt.NDArray[np.int64]
) -> tuple[Single, Array]:
    """Return what stands under spots.

    Parameters
    ----------
    patches
        [N, S, S] of frames in digital numbers, NaN where they are not to be used.
    found
        The spots' streaks in them.
    good
        [N], whether a frame shows the laser.
    numbers
        [N] of the frames, ascending.

    Returns
    -------
    tuple of numpy.ndarray
        Pictures [N, S, S] in digital numbers on the pixels of the patches, 0 where nothing is known; and how far off
        along x and y (px) what is not known of them draws a place, [N, 2], NaN where there is no picture.
    """
    pictures, deviations = np.zeros(patches.shape, np.float32), np.full((len(patches), 2), np.nan)
    lengths, groups = np.hypot(*found.state[:, 3:].T), numbers // GROUP
    usable = good & found.holds
    # What is around a spot shows through its flanks, where the fitted spot is taken off.
    moved = np.full_like(patches, np.nan)
    moved[usable] = _moved((patches - found.bells().reshape(patches.shape))[usable], found.near[usable])
    moved = np.where(found.away() > _CLEAR, moved.reshape(len(moved), -1), np.nan)
    for first, last in pairwise([*np.unique(groups, return_index=True)[1], len(groups)]):
        about = np.flatnonzero((np.abs(groups - groups[first]) <= 1) & usable)
        members = first + np.flatnonzero(usable[first:last])
        if len(about) < _FEWEST or not len(members):
            continue
        # A quick spot hides all that a slow one hides and more, and a second one beside it lies in other places.
        slow = about[lengths[about] <= np.median(lengths[about])]
        seen = np.isfinite(moved[slow])
        count = seen.sum(axis=0)
        mean = np.where(seen, moved[slow], 0).sum(axis=0, dtype=float) / np.maximum(count, 1)
        if (continued := _continued(mean, _DISC & (count >= _FEWEST))) is None:
            continue
        picture, unknown = continued
        whole = np.where(count >= _FEWEST, mean, np.nan)
        whole[_DISC] = picture
        shown = np.broadcast_to(whole.reshape(_SIDE, _SIDE).astype(np.float32), (len(members), _SIDE, _SIDE))
        pictures[members] = _moved(shown, -found.near[members])
        pulls = found.of(members).pulls(np.isfinite(patches[members]).reshape(len(members), -1))
        for axis in (0, 1):
            about_spot = _moved(pulls[:, axis].reshape(shown.shape), found.near[members]).reshape(len(members), -1)
            deviations[members, axis] = np.linalg.norm(np.nan_to_num(about_spot[:, _DISC]) @ unknown, axis=1)
    return pictures, deviations


def _moved(pictures: Single, by: Array) -> Single:
    """Return pictures [N, S, S] read at their pixels' places plus `by` [N, 2] px, by the cubic through four pixels
    along x and y, which keeps fine textures; NaN where one of these is NaN or outside."""
    whole = np.floor(by).astype(int)
    part = (by - whole).astype(np.float32)[:, :, None]
    # Catmull and Rom's: 0 at the other three pixels for places in the middle of one.
    weights = np.concatenate(
        [
            part * (-0.5 + part * (1 - 0.5 * part)),
            1 + part**2 * (1.5 * part - 2.5),
            part * (0.5 + part * (2 - 1.5 * part)),
            part**2 * (0.5 * part - 0.5),
        ],
        axis=2,
    )
    frames = np.arange(len(pictures))[:, None]
    for axis in (0, 1):
        lines = pictures.swapaxes(1, 2) if axis == 0 else pictures
        total = np.zeros_like(lines)
        for tap in range(4):
            at = np.arange(_SIDE) + whole[:, axis, None] + tap - 1
            share = np.where((at >= 0) & (at < _SIDE), weights[:, axis, tap, None], np.nan)[:, :, None]
            read = lines[frames, at.clip(0, _SIDE - 1)]
            total += np.where(weights[:, axis, tap, None, None] == 0, 0, share * read)
        pictures = total.swapaxes(1, 2) if axis == 0 else total
    return pictures


@cache
def _covariance(turn: int) -> Array:
    """Return the process' covariance between the pixels of the disc, [D, D], for edges turned by a number of steps;
    edges have the variance 1."""

    def falls(distance: Array) -> Array:
        return (1 + distance) * np.exp(-distance)

    x, y = _X[_DISC], _Y[_DISC]
    dx, dy = x[:, None] - x, y[:, None] - y
    total = _ROUND * falls(np.hypot(dx, dy) / _ACROSS)
    for angle in (np.arange(_DIRECTIONS) + turn / _TURNS) * np.pi / _DIRECTIONS:
        across, along = np.cos(angle) * dx + np.sin(angle) * dy, np.cos(angle) * dy - np.sin(angle) * dx
        total += falls(np.abs(across) / _ACROSS) * falls(np.abs(along) / _ALONG) / _DIRECTIONS
    return total


def _turn(mean: Array, known: npt.NDArray[np.bool_]) -> int:
    """Return by how many steps the edges are turned that the known pixels of a picture [P] show."""
    picture = np.where(known, mean, np.nan).reshape(_SIDE, _SIDE)
    gx, gy = (picture[1:-1, 2:] - picture[1:-1, :-2]).ravel(), (picture[2:, 1:-1] - picture[:-2, 1:-1]).ravel()
    slopes = (gx + 1j * gy)[np.isfinite(gx + gy)]
    # All directions of the process are one in this power.
    common = (np.abs(slopes) ** 2 * np.exp(2j * _DIRECTIONS * np.angle(slopes))).sum()
    return round(np.angle(common) / (2 * np.pi) * _TURNS) % _TURNS


def _continued(mean: Array, known: npt.NDArray[np.bool_]) -> tuple[Array, Array] | None:
    """Return all pixels of the disc [D] by the known ones of a picture [P], and a factor [D, H] of the covariance of
    their errors; None where too few are known."""
    given = known[_DISC]
    if given.sum() < _LEAST:
        return None
    alike = _covariance(_turn(mean, known))
    among, between, hidden = (alike[np.ix_(*ends)] for ends in ((given, given), (given, ~given), (~given, ~given)))
    level = mean[known].mean()
    try:
        lower = cholesky(among + _NOISE * np.eye(len(among)), lower=True)
        half = solve_triangular(lower, np.column_stack([mean[known] - level, between]), lower=True)
        root = cholesky(hidden - half[:, 1:].T @ half[:, 1:] + 1e-6 * np.eye(len(hidden)), lower=True)
    except LinAlgError:
        return None
    disc, factor = np.empty(len(given)), np.zeros((len(given), len(hidden)))
    disc[given], disc[~given] = mean[known], level + half[:, 1:].T @ half[:, 0]
    # The process' variance is what the known pixels show.
    factor[~given] = np.sqrt((half[:, 0] ** 2).mean()) * root
    return disc, factor
