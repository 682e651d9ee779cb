"""From starting poses to the maxima of one crop's likelihood: which starts are followed, and when more are tried."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tapetum.models.simulation.pictures import Pose
from tapetum.models.simulation.search import Search, Top

__all__ = ["EXPLAINED", "HOPELESS", "LOST", "climbed", "farther", "periods_of", "top_near"]

EXPLAINED, LOST = 1.1, 1.3
"""Misfits up to which a search may end (a true scene gives 1.00 ± 0.05), and above which a scene is not the image's."""
HOPELESS = 200.0
"""How far behind another a maximum's log-likelihood is that is not worth following."""
# Steps after which a hopeless start is dropped; while nothing explains the image, only where its misfit is above this,
# too: the right maximum's may still be less. Strange images leave far more.
_FIRST_STEPS, _STRANGE = 4, 6.0
# Compared photosite periods: those within this difference of log-likelihood, and their largest number.
_UNLIKELY, _PERIODS_ASKED = 20.0, 9
# How often the phase is sought again at most, and the rise of the log-likelihood from which on it is once more.
_AGAIN, _RISEN = 3, 1.0


def climbed(search: Search, poses: Sequence[Pose]) -> list[Top]:
    """Return the maxima near poses, best first."""
    tops = [top_near(search, poses[0])]
    for pose in poses[1:]:
        # The opposite of a maximum is nearly one itself, so that one step shows how high it is.
        mirrored = tops[0].misfit <= LOST and np.allclose(np.add(pose.gaze, poses[0].gaze), 0.0)
        pose = replace(pose, gaze=_opposite(tops[0])) if mirrored else pose
        tops.append(top_near(search, pose, tops, 1 if mirrored else _FIRST_STEPS))
    return _best_first(search, tops)


def farther(search: Search, tops: Sequence[Top], begun: Sequence[Pose], poses: Sequence[Pose], most: int) -> list[Top]:
    """Return the maxima, best first, with those near further poses until one explains the image or `most` were tried.

    The first pose is opposite to the best maximum, which is more precise than those of a bank; of the others the
    ones that were `begun` from are left out.
    """
    known = {_place(pose) for pose in begun}
    others = (pose for pose in poses if _place(pose) not in known)
    opposite = replace(tops[0].pose, gaze=_opposite(tops[0]))
    found = list(tops)
    for pose in itertools.chain([opposite], itertools.islice(others, most)):
        found.append(top_near(search, pose, found))
        if found[-1].misfit <= EXPLAINED:
            break
    return _best_first(search, found)


def top_near(search: Search, pose: Pose, others: Sequence[Top] = (), first: int = _FIRST_STEPS) -> Top:
    """Return the maximum near a pose; a search that falls far behind others stops after its `first` steps."""
    phase, pose = search.pictures.period is not None, search.in_phase(pose)
    best = max(others, key=lambda one: one.log_likelihood, default=None)
    if best is None:
        top = search.climb(pose, phase=phase)
    else:
        top = search.climb(pose, phase=phase, steps=first)
        near = top.log_likelihood > best.log_likelihood - HOPELESS
        near |= best.misfit > LOST and top.misfit < _STRANGE
        if near and not top.settled:
            top = search.climb(top.pose, phase=phase, slow=top.slow)
    if not phase or top.misfit <= LOST or (best is not None and top.log_likelihood <= best.log_likelihood):
        return top
    return _in_phase_again(search, top)


def periods_of(search: Search, top: Top) -> list[Top]:
    """Return the maxima of the photosite periods that the slow gaze of a maximum leaves likely, best first."""
    period = search.pictures.period
    assert period is not None
    # Curvature of the log-likelihood along the slow gaze, maximised over all else.
    slow = np.linalg.inv(top.covariance[:2, :2]) / max(1.0, top.misfit)
    away = np.rint(top.slow / period)
    steps = [np.array(one) + away for one in itertools.product(range(-6, 7), repeat=2)]
    rises = [float((one * period - top.slow) @ slow @ (one * period - top.slow)) for one in steps]
    order = np.argsort(rises)[:_PERIODS_ASKED]
    found: list[Top] = []
    for number in order:
        if rises[number] > rises[order[0]] + _UNLIKELY:
            break
        gaze = np.array(top.pose.gaze) + steps[number] * period
        at = replace(top.pose, gaze=(float(gaze[0]), float(gaze[1])))
        found.append(search.climb(at, phase=False, steps=8))
    return sorted(found, key=lambda one: -one.log_likelihood)


def _opposite(top: Top) -> tuple[float, float]:
    """Return the gaze opposite to a maximum's, within the bank's field."""
    x, y = np.clip(np.array(top.pose.gaze) + top.slow, -0.48, 0.48)
    return -float(x), -float(y)


def _best_first(search: Search, tops: list[Top]) -> list[Top]:
    """Return maxima by likelihood, the best one with the photosites' phase sought again."""
    first, *others = sorted(tops, key=lambda top: -top.log_likelihood)
    # A wrong phase may explain the image nearly as well.
    return [first if search.pictures.period is None else _in_phase_again(search, first), *others]


def _in_phase_again(search: Search, top: Top) -> Top:
    """Return the maximum from where a search ended, with the photosites' phase sought again there, while that rises.

    While the slow gaze was far off, the phase may have settled at another maximum than it has here.
    """
    for _ in range(_AGAIN):
        x, y = np.array(top.pose.gaze) + top.slow
        again = search.climb(search.in_phase(replace(top.pose, gaze=(float(x), float(y)))), phase=True)
        if again.log_likelihood <= top.log_likelihood + _RISEN:
            break
        top = again
    return top


def _place(pose: Pose) -> tuple[float, float]:
    """Return a bank's gaze in a form that compares."""
    x, y = np.round(pose.gaze, 6)
    return float(x), float(y)
