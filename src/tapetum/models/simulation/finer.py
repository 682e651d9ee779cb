"""Pictures that become finer where a search ends, until their error moves no estimate.

A bright image tells far smaller differences than the accuracy that a scene asks for. A search by pictures as accurate
as that is fast and ends near the maximum; a few more steps by finer ones lead to it.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import Scene
from tapetum.errors import InputError
from tapetum.models.simulation.maxima import HOPELESS, LOST
from tapetum.models.simulation.pictures import Pictures
from tapetum.models.simulation.result import values_of
from tapetum.models.simulation.search import PHASE, SLOW, Search, Top

__all__ = ["COARSER", "SAME_BOUND", "Finer", "apart", "refined"]

Array = NDArray[np.float64]

COARSER = 1.3
"""By how much an accuracy is made coarser where the engine refuses it."""
SAME_BOUND = 0.05
"""Share by which a bound may still change with finer pictures."""
# By how much pictures become finer at a step, and to what accuracy at best.
_STEP, _FINEST = 3.0, 1e-3
# Share of its standard deviation by which an estimate may still move at the last step.
_STILL = 0.2
# Misfit above which errors of pictures are not what keeps the scene from explaining the image.
_ROUGH = 2.0


class Finer:
    """Pictures of a scene in rising accuracy, each three times as fine as those before; they are kept.

    Behind a traced lens the last ones are as fine as the engine allows. `count` as for `Pictures`.
    """

    def __init__(self, scene: Scene, count: int) -> None:
        self.scene, self._count = scene, count
        self._made: dict[tuple[int, int], Pictures | None] = {}

    def steps(self, side: int) -> Iterator[Pictures]:
        """Yield pictures of `side` x `side` pixels, finer than the scene's own accuracy, until there are none."""
        for step in itertools.count(1):
            if (side, step) not in self._made:
                self._made[side, step] = self._next(side, self.scene.sampling.accuracy / _STEP ** (step - 1))
            pictures = self._made[side, step]
            if pictures is None:
                return
            yield pictures

    def _next(self, side: int, before: float) -> Pictures | None:
        accuracy = before / _STEP
        while _FINEST <= accuracy < before / COARSER:
            pictures = Pictures(self.scene, side, accuracy, count=self._count)
            with contextlib.suppress(InputError):
                # The engine plans, and may refuse, with the first picture.
                pictures.render_each([pictures.start()])
                return pictures
            accuracy *= COARSER
        return None


def refined(
    search: Search, tops: list[Top], finer: Finer, quantities: Sequence[str], *, phase_known: bool
) -> tuple[Search, list[Top], Array]:
    """Follow maxima by finer pictures until the best one stays.

    Parameters
    ----------
    search
        By the scene's own accuracy.
    tops
        Its maxima, best first. Those that do not explain the image stay as they are, unless none does.
    finer
        The finer pictures.
    quantities
        P names of what is estimated.
    phase_known
        As for `apart`.

    Returns
    -------
    search
        By the last pictures.
    tops
        The maxima by them, best first.
    moved
        [P] how far what is estimated still moved at the last step, where no finer pictures are to be had; else 0.
    """
    moved, likely = np.zeros(len(quantities)), [n == 0 or top.misfit <= LOST for n, top in enumerate(tops)]
    still, others = ([top for top, own in zip(tops, likely, strict=True) if own is kept] for kept in (True, False))
    if still[0].misfit > _ROUGH:
        return search, tops, moved
    for pictures in finer.steps(search.pictures.side):
        search = Search(pictures, search.counts, search.model, search.free, search.offsets)
        before = still[0]
        climbed = [search.climb(top.pose, phase=PHASE[0] in top.names, slow=top.slow) for top in still]
        best, *less = sorted(climbed, key=lambda top: -top.log_likelihood)
        still = [best, *(top for top in less if top.log_likelihood > best.log_likelihood - HOPELESS)]
        others += less[len(still) - 1 :]
        moved, deviations = apart(before, best, quantities, pictures.period if phase_known else None)
        if (moved <= _STILL * deviations).all():
            moved = np.zeros(len(quantities))
            break
    return search, [*still, *others], moved


def apart(one: Top, other: Top, quantities: Sequence[str], period: Array | None) -> tuple[Array, Array]:
    """How far what is estimated [P] lies apart at two maxima, and its standard deviations [P] at the second.

    Where the photosites' `period` [2] is given, as their place is known, the gaze is as precise as their phase: which
    period it lies in is determined afterwards.
    """
    names, tops = list(quantities), [one, other]
    if period is not None:
        tops = [replace(top, slow=np.zeros(2)) for top in tops]
    before, after = (values_of(top, tuple(quantities), np.zeros(2)) for top in tops)
    found = np.abs(after - before)
    for n, name in enumerate(SLOW):
        if period is not None and name in names:
            at = names.index(name)
            found[at] = abs(math.remainder(found[at], float(period[n])))
            names[at] = PHASE[n]
    deviations = np.sqrt(np.maximum(other.covariance.diagonal(), 0.0))
    return found, deviations[[other.names.index(name) for name in names]]
