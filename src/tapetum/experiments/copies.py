"""Frames of copies of a camera, drawn from its tolerances: what intervals for an unknown copy are calibrated on."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import xarray as xr

from tapetum.bench import Scene, as_scene, draw_unit
from tapetum.data.dataset import UNIT, class_variable, dataset_from_arrays
from tapetum.data.write import Rules
from tapetum.errors import InputError
from tapetum.experiments.side_by_side import side_by_side
from tapetum.files import atomic_file
from tapetum.progress import Progress, quiet
from tapetum.record import HandMotion
from tapetum.record.film import probe_frames

__all__ = ["copy_films", "film_copies", "film_copy"]

# Files that are read at once.
_READERS = 8


def film_copies(
    scene: Scene | str,
    seeds: Sequence[int],
    frames: int,
    work: Path,
    *,
    side: int,
    motion: HandMotion | None = None,
    processes: int = 1,
    progress: Progress = quiet,
) -> xr.Dataset:
    """Film copies of a scene's camera at gazes that are spread over its field, and return them as one dataset.

    The gaze of every frame is drawn independently, evenly over the field, with the sway and tremor of a hand; so few
    frames of a copy say more than seconds of film. Labels are the truth.

    Parameters
    ----------
    scene
        The model of the camera; its copies are those of `tapetum.bench.draw_unit`.
    seeds
        Of the copies.
    frames
        Frames of each; those without a visible RR are left out.
    work
        Folder that keeps every copy, from which an interrupted run goes on.
    side
        Of the crops, in pixels.
    motion
        Extent, sway and tremor.
    processes
        Copies that are filmed at the same time, each by a process of its own.
    progress
        Shown over the copies.

    Raises
    ------
    InputError
        For a scene that cannot be filmed, a film that cannot be read, or a process that ends before its time.
    """
    model = as_scene(scene)
    films = copy_films(model, seeds, frames, work, side=side, motion=motion)
    for _ in progress(side_by_side(films, processes), "filming copies", total=len(films)):
        pass
    # Most of the time of reading is spent unpacking, which threads share.
    with ThreadPoolExecutor(_READERS) as readers:
        found = list(readers.map(lambda film: _kept(film.keywords["path"]), films))
    images, gazes = (np.concatenate([one[k] for one in found]) for k in (0, 1))
    number = np.repeat(np.arange(len(found)), [len(one[0]) for one in found])
    full = float(2**model.probe.sensor.bits - 1)
    labels = {"gaze_x": gazes[:, 0], "gaze_y": gazes[:, 1]}
    data = dataset_from_arrays(images, labels, full_scale=full, recording=number)
    return data.assign({UNIT: class_variable([f"copy-{seeds[k]}" for k in number.tolist()])})


def copy_films(
    scene: Scene, seeds: Sequence[int], frames: int, work: Path, *, side: int, motion: HandMotion | None = None
) -> list[partial[None]]:
    """Return what films each copy for `film_copies`, which see, unless it was filmed: for `side_by_side`."""
    work.mkdir(parents=True, exist_ok=True)
    hand, rules = motion or HandMotion(), Rules(side=side)
    paths = [work / f"copy-{seed}-{frames}-{side}.npz" for seed in seeds]
    return [
        partial(_film_seed, scene, seed, frames, path=path, rules=rules, hand=hand)
        for seed, path in zip(seeds, paths, strict=True)
    ]


def film_copy(
    scene: Scene, seed: int, frames: int, path: Path, rules: Rules, hand: HandMotion
) -> tuple[np.ndarray, np.ndarray]:
    """Film one copy, as `film_copies` films each; take it from its file where that was done before.

    Parameters
    ----------
    scene
        The copy.
    seed, frames
        Of the gazes, places and noise, and their number.
    path
        The file to keep, `.npz`.
    rules
        By which frames are kept and cut.
    hand
        Extent of the gazes, tremor and sway.

    Returns
    -------
    tuple of numpy.ndarray
        Crops [n, side, side] and gazes [n, 2] of the frames that show an RR.

    Raises
    ------
    InputError
        For a scene that cannot be filmed, or a file that is no such file.
    """
    if path.exists():
        return _kept(path)
    rng = np.random.default_rng([seed, 2])
    gaze = rng.uniform(-hand.extent, hand.extent, (frames, 2)) + rng.normal(0, hand.tremor, (frames, 2))
    place = rng.normal(0, hand.sway, (frames, 2))
    cut = [rules.cut(image) for image in probe_frames(scene, gaze, place, seed)]
    seen = [k for k, one in enumerate(cut) if one is not None]
    images = np.stack([one[0] for one in cut if one is not None]) if seen else np.empty((0, rules.side, rules.side))
    with atomic_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, image=images, gaze=gaze[seen])
    return images, gaze[seen]


def _film_seed(model: Scene, seed: int, frames: int, *, path: Path, rules: Rules, hand: HandMotion) -> None:
    """Film the copy of a seed, unless its file is there."""
    film_copy(draw_unit(model, None, seed), seed, frames, path, rules, hand)


def _kept(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the crops and gazes of a copy that was filmed."""
    try:
        with np.load(path) as file:
            return file["image"], file["gaze"]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"cannot be read ({error})", where=path, remedy="remove it: it is made again") from error
