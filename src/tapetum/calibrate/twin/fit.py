"""A twin: the scene that explains a labelled recording of a real camera, by maximum likelihood."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tapetum.bench import PrescriptionLens, Scene, as_scene, scene_dict
from tapetum.calibrate.twin.frames import frames_of
from tapetum.calibrate.twin.normal_equations import Linear, Normal, State, by_labels
from tapetum.calibrate.twin.parameters import chosen
from tapetum.calibrate.twin.result import Before, Twin, twin_of
from tapetum.calibrate.twin.search import LIMIT, climb, settle, two_groups, untold
from tapetum.calibrate.twin.starts import placed_in, shifts, starting
from tapetum.calibrate.twin.state import Kept
from tapetum.errors import InputError
from tapetum.progress import Progress, quiet

__all__ = ["fit_twin"]

Array = NDArray[np.float64]
# Frames of the searches from several starts, how coarse their pictures may be (factor on the accuracy, and the
# coarsest), and their steps.
_FEW, _COARSER, _COARSEST, _STEPS = 14, 3.0, 0.1, 30
# Expected fall of the squared residuals that ends them, and how far derivatives are kept, in spreads.
_ROUGHLY, _FAR = 2.0, 0.15
# Weight of the labels before anything shared is fitted: a wrong scene would pull the gazes far off.
_TIED = 1e4
# No search from another start where this one explains the frames.
_EXPLAINED = 1.05
# Least scatter of the frames' brightness: pictures are not more accurate.
_STEADY, _LOOSE = 3e-3, 0.3
# Pictures are computed so much finer, so often, until that moves no parameter by more than so many deviations, and
# changes no deviation by more than such a part.
_FINER, _LEVELS, _MOVED, _CHANGED = 3.0, 3, 0.3, 0.15
# Misfit of a start that the engine refuses; JSON has no infinity.
_REFUSED = 1e300
# Usual offset that a recording's labels have in common, in pixels of the target's camera.
_COMMON = 0.05
# Spreads by which the aperture is moved to see what the choice of rays does.
_APERTURES = (-0.2, -0.1, 0.1, 0.2)
# Fall of the squared residuals, for each pixel, that two cameras must bring over one.
_TWO = 0.5


def fit_twin(
    recording: str | os.PathLike[str],
    scene: Scene | str | os.PathLike[str],
    *,
    free: Sequence[str] | None = None,
    frames: int = 60,
    starts: int = 4,
    seed: int = 0,
    accuracy: float | None = None,
    roll: bool = False,
    window: int = 200,
    unevenness: float = 0.0,
    offsets: Sequence[float] = (0.0, 0.0),
    state: str | os.PathLike[str] | None = None,
    progress: Progress = quiet,
) -> Twin:
    """Fit a scene to a labelled recording of one camera.

    Parameters
    ----------
    recording
        A folder NAME.rec with gaze labels and, best, their standard deviations.
    scene
        What is known of the bench: a scene, or as `load_scene` takes it. The target's rotation is not used.
    free
        What is fitted: names of `GROUPS` or of single parameters; by default all groups but `probe_focus`.
    frames
        How many, 20 to 200, spread over the field.
    starts, seed
        Searches begin at this many places, drawn from the usual tolerances by the seed; at fewer where one explains the
        frames.
    accuracy
        Of the simulation to begin with, in fractions of the peak; the scene's own for None.
    roll
        Whether the target turns about its axis from frame to frame, as in a hand.
    window
        Edge in pixels of the square that is fitted.
    unevenness, offsets
        As for `SimulationFit`: what is known of the sensor's fixed pattern.
    state
        A file that keeps the search: the same call goes on from there.
    progress
        Shown over every stage.

    Returns
    -------
    Twin
        The scene with its parameters' deviations, and how well it explains the frames.

    Raises
    ------
    InputError
        For a recording without labels or of several cameras, unknown names, a scene that the engine refuses, and a kept
        state of another search.

    Notes
    -----
    Each frame's gaze is a nuisance with its label for a prior; place, brightness and, where photosites show, their
    phase are nuisances too. The likelihood is that of `SimulationFit`. Deviations follow from the Fisher information
    with all nuisances unknown, times the misfit where that exceeds 1. A parameter that the frames determine no better
    than the usual spread between copies keeps the scene's value; its uncertainty enters the deviations of the others.
    The simulation's own error must not move the result: pictures become three times finer, at most three times, until
    that moves no parameter by more than 0.3 deviations and changes no deviation by more than 15 %, or the engine
    refuses. What may be left of its error enters the deviations, and behind a traced lens what the choice of rays does;
    so does an offset of 0.05 pixels that all labels may have in common.
    """
    scene = as_scene(scene)
    parameters = chosen(scene, free)
    if isinstance(starts, bool) or starts < 1:
        raise InputError(f"must be 1 or more, is {starts}", where="starts", remedy="4 are usual")
    wide = (float(offsets[0]), float(offsets[1]))
    options: dict[str, Any] = {"accuracy": accuracy, "roll": roll, "unevenness": unevenness, "offsets": wide}
    opened, used = frames_of(recording, scene, frames, window=window, progress=progress)
    given = {"recording": opened.uuid, "frames": [one.index for one in used], "scene": scene_dict(scene)}
    given |= {"free": [one.name for one in parameters], "starts": starts, "seed": seed, "window": window, **options}
    labels = [one.gaze.tolist() for one in used]
    digest = hashlib.sha256(json.dumps([given, labels], sort_keys=True).encode()).hexdigest()
    kept = Kept.open(None if state is None else Path(state), digest)
    normal = Normal(scene, parameters, used, scatter=_LOOSE, **options)
    before = kept.before or _as_it_was(normal, kept, progress)
    best = _from_starts(normal, kept, starts, seed, progress)
    linear, converged, held = _whole(normal, kept, best, progress)
    if linear.misfit(lit=True) > LIMIT:
        _refuse_two(normal, linear, opened.path, progress)
    normal, linear, converged, left = _refined(normal, linear, converged, held, kept, progress)
    unsure = np.outer(left, left) + _grain(normal, linear, held, progress) + _of_labels(normal, linear, held)
    options |= {"accuracy": _accuracy(normal), "starts": starts, "seed": seed}
    return twin_of(normal, linear, held, before, converged, opened, options, unsure)


def _as_it_was(normal: Normal, kept: Kept, progress: Progress) -> Before:
    """Return how well the scene explains the frames before anything is fitted but the frames' nuisances."""
    at = np.array([one.read(normal.scene) for one in normal.parameters])
    linear = settle(normal, placed_in(normal, at), 2, progress)
    kept.before = Before(linear.log_likelihood, linear.misfit(), linear.misfit(lit=True))
    kept.save()
    return kept.before


def _from_starts(normal: Normal, kept: Kept, starts: int, seed: int, progress: Progress) -> Array:
    """Return the coordinates of the best of several searches over a few frames, coarsely simulated."""
    usual = _accuracy(normal)
    coarse = max(usual, min(_COARSEST, _COARSER * usual))
    few = _few(normal, coarse)
    at = np.array([one.read(normal.scene) for one in normal.parameters])
    if kept.starts is None:
        found = shifts(few, at, progress)
        kept.starts = [starting(few, one, found[n % len(found)]) for n, one in enumerate(_drawn(few, at, starts, seed))]
        kept.save()
    for n in range(len(kept.searched), len(kept.starts)):
        if kept.searched and kept.searched[-1][2] < _EXPLAINED:
            break
        what = f"start {n + 1} of {len(kept.starts)}"
        try:
            first = placed_in(few, kept.starts[n]) if kept.search is None else kept.search
            state = settle(few, first, 3, doubt=_TIED).state if kept.search is None else first
            after = kept.searching
            linear, _ = climb(few, state, steps=_STEPS, enough=_ROUGHLY, after=after, progress=progress, what=what)
        except InputError:
            # The engine refuses some scenes, and a start at random may be one; the first is the scene given.
            if not n:
                raise
            kept.done(kept.starts[n], -_REFUSED, _REFUSED)
            continue
        kept.done(linear.state.coordinates, linear.log_likelihood, linear.misfit(lit=True))
    return max(kept.searched, key=lambda one: one[1])[0]


def _few(normal: Normal, accuracy: float) -> Normal:
    chosen = np.linspace(0, len(normal.frames) - 1, min(_FEW, len(normal.frames))).round().astype(int)
    return normal.over([normal.frames[n] for n in chosen], accuracy=accuracy, near=_FAR)


def _drawn(normal: Normal, at: Array, starts: int, seed: int) -> list[Array]:
    """Return the scene's own coordinates, and others at random, a spread about them."""
    rng, drawn = np.random.default_rng([seed, 0x7717]), [at]
    for _ in range(starts - 1):
        moved = at + normal.spread * rng.standard_normal(len(at))
        drawn.append(np.array([one.clipped(x) for one, x in zip(normal.parameters, moved, strict=True)]))
    return drawn


def _whole(normal: Normal, kept: Kept, best: Array, progress: Progress) -> tuple[Linear, bool, list[int]]:
    """Return the maximum for all frames, and the parameters they do not determine, which keep the scene's values."""
    own = np.array([one.read(normal.scene) for one in normal.parameters])
    state = kept.whole or settle(normal, placed_in(normal, best), 2, progress).state
    if kept.scatter is None:
        kept.scatter = _scatter(state)
    normal.scatter = kept.scatter
    linear, converged = climb(normal, state, after=kept.wholly, progress=progress, what="fitting all frames")
    scatter = _scatter(linear.state)
    if not 0.7 < scatter / normal.scatter < 1.5:
        normal.scatter = kept.scatter = scatter
        linear, converged = climb(normal, linear.state, after=kept.wholly, progress=progress, what="fitting again")
    held: list[int] = []
    while more := [one.number for one in untold(linear.information) if one.number not in held]:
        held += more
        coordinates = linear.state.coordinates.copy()
        coordinates[held] = own[held]
        moved = normal.moved(linear.state, coordinates)
        linear, converged = climb(
            normal, moved, held=held, after=kept.wholly, progress=progress, what="with those held"
        )
        if len(held) == len(own):
            break
    return linear, converged, sorted(held)


def _accuracy(normal: Normal) -> float:
    return normal.scene.sampling.accuracy if normal.accuracy is None else normal.accuracy


def _refined(
    normal: Normal, linear: Linear, converged: bool, held: Sequence[int], kept: Kept, progress: Progress
) -> tuple[Normal, Linear, bool, Array]:
    """Return the maximum with pictures fine enough, and by how much [P] their error may still move it, in spreads."""
    left = np.zeros(len(linear.score))
    free = np.setdiff1d(np.arange(len(left)), held)
    if linear.misfit(lit=True) > LIMIT or not len(free):
        # What the scene does not explain is far more than the simulation's error.
        return normal, linear, converged, left
    for _ in range(_LEVELS):
        finer = normal.over(normal.frames, accuracy=_accuracy(normal) / _FINER)
        if _alike(normal, finer, linear.state):
            normal = finer
            continue
        try:
            # With derivatives of its own: what the frames seem to tell of the weakest parameters may be the error's.
            told = finer.linear(linear.state, doubt=linear.doubt, progress=progress)
        except InputError:
            # The engine cannot compute finer ones: its error falls with what is asked, or faster.
            left /= _FINER - 1
            break
        information = told.information[np.ix_(free, free)]
        left = np.zeros(len(left))
        left[free] = np.linalg.solve(information, told.score[free])
        deviations = np.sqrt(np.linalg.inv(information).diagonal())
        before = np.sqrt(np.linalg.inv(linear.information[np.ix_(free, free)]).diagonal())
        changed = float(np.abs(deviations / before - 1).max())
        if changed <= _CHANGED and (np.abs(left[free]) <= _MOVED * deviations).all():
            break
        normal, own = finer, linear.state.coordinates
        linear, converged = climb(
            normal, linear.state, held=held, after=kept.wholly, progress=progress, what="more finely", begin=told
        )
        left = (linear.state.coordinates - own) / normal.spread
        if changed <= _FINER * _CHANGED and (np.abs(left[free]) <= _FINER * _MOVED * deviations).all():
            # The next level would change a third of that, which is little enough.
            left /= _FINER - 1
            break
    return normal, linear, converged, left


def _alike(normal: Normal, finer: Normal, state: State) -> bool:
    """Return whether finer pictures are the same, as a thin lens's are where far better ones cost nothing."""
    try:
        own, other = (one.pictures(state.coordinates).render_each(state.poses[:1]) for one in (normal, finer))
    except InputError:
        return False
    return np.array_equal(own, other)


def _of_labels(normal: Normal, linear: Linear, held: Sequence[int]) -> Array:
    """Return the covariance [P, P], in squared spreads, of an offset that all labels have in common.

    What the target sees about the laser's place, which stays there in the room, and the second beam's spot beside it
    draw labels some hundredths of a pixel to one side. No number of frames averages that out, and the tilt and the
    decentre show it.
    """
    free = np.setdiff1d(np.arange(len(linear.score)), held)
    found = np.zeros((len(linear.score), len(linear.score)))
    inverse = np.linalg.inv(linear.information[np.ix_(free, free)])
    for push, pixels in zip(by_labels(normal, linear), normal.scene.target.sensor.pixels, strict=True):
        moved = np.zeros(len(found))
        moved[free] = inverse @ push[free] * (_COMMON / pixels)
        found += np.outer(moved, moved)
    return found


def _grain(normal: Normal, linear: Linear, held: Sequence[int], progress: Progress) -> Array:
    """Return the covariance [P, P], in squared spreads, that the choice of rays behind a traced lens adds.

    Functions are fitted to the rays that pass; these change one by one with the aperture, and with them the pictures by
    less than their asked error but by more than many frames' noise. Moved apertures should be found back: how far they
    are not shows it twice, once at either end.
    """
    found = np.zeros((len(linear.score), len(linear.score)))
    names = [one.name for one in normal.parameters]
    n = names.index("aperture") if "aperture" in names else -1
    free = np.setdiff1d(np.arange(len(names)), held)
    if n not in free or not isinstance(normal.scene.target.lens, PrescriptionLens):
        return found
    if linear.misfit(lit=True) > LIMIT:
        return found
    own = linear.state.coordinates
    apertures = {normal.parameters[n].clipped(float(own[n] + by * normal.spread[n])) for by in _APERTURES} - {own[n]}
    inverse = np.linalg.inv(linear.information[np.ix_(free, free)])
    for level in range(_LEVELS + 1):
        # Where the engine refuses every moved aperture, coarser pictures say more than enough.
        coarser = _FINER**level * _accuracy(normal)
        # The derivatives serve over all of these.
        wide = normal.over(normal.frames, accuracy=coarser, near=2 * max(_APERTURES))
        moved = list[Array]()
        for at in progress(sorted(apertures), "varying the rays"):
            coordinates = own.copy()
            coordinates[n] = at
            try:
                state = wide.moved(linear.state, coordinates)
                state = wide.stepped(wide.linear(state, shared=False), np.zeros(0))
                score = wide.linear(state, near=linear).score
            except InputError:
                if level == _LEVELS and not moved:
                    raise
                continue
            missed = (coordinates - own) / normal.spread
            missed[free] += inverse @ score[free]
            moved.append(np.outer(missed, missed) / 2)
        if moved:
            return np.mean(moved, axis=0)
    return found


def _scatter(state: State) -> float:
    """Return the relative scatter of the frames' brightness."""
    power = np.array([pose.power for pose in state.poses])
    return float(np.clip(power.std(ddof=1) / power.mean(), _STEADY, _LOOSE))


def _refuse_two(normal: Normal, linear: Linear, where: Path, progress: Progress) -> None:
    """Raise an InputError where two cameras explain the frames and one does not."""
    second, gain = two_groups(normal, linear)
    pixels = sum(one.lit for one in linear.frames)
    if min(second.sum(), (~second).sum()) < 4 or gain < _TWO * pixels * (linear.misfit(lit=True) - 1):
        return
    misfits = []
    for group in (~second, second):
        part = [n for n in range(len(second)) if group[n]]
        few = part[:: max(1, len(part) // _FEW)]
        state = linear.state
        own = State(state.coordinates, tuple(state.poses[n] for n in few), state.slow[few])
        found, _ = climb(
            normal.over([normal.frames[n] for n in few]),
            own,
            steps=_STEPS,
            progress=progress,
            what="one of two cameras",
        )
        misfits.append(found.misfit(lit=True))
    if max(misfits) < LIMIT:
        times = [[normal.frames[n].time for n in range(len(second)) if group[n]] for group in (~second, second)]
        shown = " and ".join(f"{min(one):.1f} to {max(one):.1f} s" for one in times)
        what = f"it shows two cameras, at {shown}: each is explained alone, both by one scene not"
        raise InputError(what, where=where, remedy="give a recording of one camera")
