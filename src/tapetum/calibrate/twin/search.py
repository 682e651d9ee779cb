"""The search for a twin's maximum likelihood, and which of its parameters a recording determines.

Damped Gauss-Newton steps (Levenberg and Marquardt) on the information that is left once each frame's nuisances are
eliminated. A step is judged with the weights it was computed with, so that a larger variance does not pass for a better
fit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tapetum.calibrate.twin.normal_equations import Linear, Normal, State
from tapetum.errors import InputError
from tapetum.progress import Progress, quiet

__all__ = ["LIMIT", "Untold", "climb", "covariance", "settle", "two_groups", "untold"]

Array = NDArray[np.float64]
LIMIT = 1.2
"""Misfit of the lit pixels above which a scene does not explain a recording; a true one gives 1 to some hundredths."""
# Expected fall of the squared residuals from which a search has converged: a seventh of a standard deviation; and where
# the likelihood is no smoother, behind a traced lens, whose rays pass or not one by one (`fit._grain` states that).
_CONVERGED, _RAGGED = 0.02, 3.0
_STEPS, _HARDEST, _FARTHEST = 25, 1e8, 1.5
# Information, in inverse squared spreads, added to every step: it only slows parameters that the data hardly determine.
_SLOW = 0.1
# Component of a flat direction from which a parameter is named.
_NAMED = 0.2


def settle(normal: Normal, state: State, steps: int = 6, progress: Progress = quiet, *, doubt: float = 1.0) -> Linear:
    """Fit every frame's nuisances alone, the shared parameters fixed; a large `doubt` keeps gazes at their labels."""
    linear = normal.linear(state, shared=False, doubt=doubt)
    nothing = np.zeros(0)
    # Each step costs a picture or more of every frame.
    for _ in progress(range(steps), "fitting each frame"):
        linear = normal.linear(normal.stepped(linear, nothing), shared=False, doubt=doubt)
    return linear


def climb(
    normal: Normal,
    state: State,
    *,
    held: Sequence[int] = (),
    steps: int = _STEPS,
    enough: float | None = None,
    after: Callable[[State], None] | None = None,
    progress: Progress = quiet,
    what: str = "fitting",
    begin: Linear | None = None,
) -> tuple[Linear, bool]:
    """Return the maximum near a state, and whether the search converged.

    A step to where the engine refuses the scene is taken shorter, as one that fits worse is.

    Parameters
    ----------
    normal, state
        The frames, and where the search begins.
    held
        Numbers of parameters that stay.
    steps, enough
        The most, and the expected fall of the squared residuals that ends the search; the usual one for None.
    after
        Called with every better state.
    progress, what
        Shown over the steps.
    begin
        The frames linearised at the state, where that is done.
    """
    if enough is None:
        enough = _RAGGED if normal.sites_wander else _CONVERGED
    linear = _doubted(normal.linear(state) if begin is None else begin, np.inf)
    hardness = 1e-3
    for _ in progress(range(steps), what):
        free = _movable(normal, linear, held)
        matrix, score = linear.information[np.ix_(free, free)], linear.score[free]
        damped = matrix + np.diag(hardness * matrix.diagonal() + _SLOW * linear.doubt)
        step = np.zeros(len(linear.score))
        step[free] = np.clip(np.linalg.solve(damped, score), -_FARTHEST, _FARTHEST)
        try:
            new = normal.stepped(linear, step)
            if normal.sites_wander:
                new = normal.stepped(normal.linear(new, shared=False, doubt=linear.doubt), np.zeros(0))
            gain = linear.objective - normal.left(linear, new)
            better = normal.linear(new, near=linear, doubt=linear.doubt) if gain >= -1e-3 else None
        except InputError:
            # The engine refuses the scene there, such as light beside the lens: a shorter step.
            better = None
        if better is None:
            hardness *= 10
            if hardness > _HARDEST:
                return linear, False
            continue
        hardness = max(hardness / 10, 1e-9)
        linear = _doubted(better, linear.doubt)
        if after is not None:
            after(linear.state)
        free = _movable(normal, linear, held)
        matrix, score = linear.information[np.ix_(free, free)], linear.score[free]
        if float(score @ np.linalg.solve(_sure(matrix), score)) < enough:
            return linear, True
    return linear, False


def _doubted(linear: Linear, most: float) -> Linear:
    """Multiply the weight of the priors by the ratio of residuals to noise, up to `most`."""
    misfit = linear.misfit(lit=True)
    return linear.doubted(min(most, misfit) if misfit > LIMIT else 1.0)


def _movable(normal: Normal, linear: Linear, held: Sequence[int]) -> NDArray[np.int64]:
    """Return the numbers of the parameters that are not held, nor at an end of their range and drawn beyond it."""
    free = np.setdiff1d(np.arange(len(linear.score)), held)
    while len(free):
        wanted = np.linalg.solve(_sure(linear.information[np.ix_(free, free)]), linear.score[free])
        at = linear.state.coordinates[free]
        ends = [(normal.parameters[n].least, normal.parameters[n].most) for n in free]
        stuck = np.array(
            [
                (x <= least and step < 0) or (x >= most and step > 0)
                for x, (least, most), step in zip(at, ends, wanted, strict=True)
            ]
        )
        if not stuck.any():
            break
        free = free[~stuck]
    return free


def _sure(matrix: Array) -> Array:
    return matrix + _SLOW * np.eye(len(matrix))


@dataclass(frozen=True)
class Untold:
    """A parameter that a recording does not determine: its number, and those of others whose changes look like its
    own."""

    number: int
    like: tuple[int, ...]


def untold(information: Array) -> list[Untold]:
    """Return the parameters that information [P, P], per squared spread, determines no better than their spread."""
    found: list[Untold] = []
    rest = list(range(len(information)))
    while rest:
        part = information[np.ix_(rest, rest)]
        values, vectors = np.linalg.eigh(part)
        variance = (vectors**2 / np.maximum(values, 1e-12)).sum(1)
        worst = int(np.argmax(variance))
        if variance[worst] <= 1:
            break
        # The flat direction that holds most of it.
        flat = vectors[:, int(np.argmax(vectors[worst] ** 2 / np.maximum(values, 1e-12)))]
        weight = np.abs(flat) / np.abs(flat).max()
        like = tuple(rest[k] for k in range(len(rest)) if weight[k] > _NAMED and k != worst)
        found.append(Untold(rest[worst], like))
        del rest[worst]
    return found


def covariance(information: Array, held: Sequence[int]) -> Array:
    """Return the covariance [P, P], in squared spreads, where those held may lie anywhere within their usual spread."""
    prior = np.zeros(len(information))
    prior[list(held)] = 1.0
    return np.asarray(np.linalg.inv(information + np.diag(prior + 1e-12)), np.float64)


def two_groups(normal: Normal, linear: Linear, rounds: int = 30) -> tuple[NDArray[np.bool_], float]:
    """Divide the frames into two groups, each with parameters of its own, by their linearised likelihoods.

    Returns which frames [N] belong to the second group, and by how much the squared residuals fall.
    """
    parts = [normal.own_information(linear, n) for n in range(len(linear.frames))]
    matrices, scores = np.array([one for one, _ in parts]), np.array([one for _, one in parts])
    # Begin with the first half against the second: recordings are joined one after another.
    second = np.arange(len(parts)) >= len(parts) / 2
    gain = 0.0
    for _ in range(rounds):
        steps = [np.linalg.solve(_sure(matrices[g].sum(0)), scores[g].sum(0)) for g in (~second, second)]
        falls = np.array([2 * scores @ step - np.einsum("nij,i,j->n", matrices, step, step) for step in steps])
        gain = float(np.where(second, falls[1], falls[0]).sum())
        new = falls[1] > falls[0]
        if (new == second).all() or new.all() or not new.any():
            break
        second = new
    return second, gain
