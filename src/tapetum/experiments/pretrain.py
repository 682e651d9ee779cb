"""The bundled ResNet-18: filmed, trained and scored on the virtual bench, with the seeds fixed here."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

import torch
import xarray as xr

from tapetum.bench import Scene, load_scene
from tapetum.data import build_dataset, open_dataset
from tapetum.experiments.copies import copy_films, film_copies
from tapetum.experiments.side_by_side import side_by_side
from tapetum.files import sha256_file
from tapetum.models import (
    EpochReport,
    NetworkEstimator,
    ResNet18,
    calibrate_units,
    load_model,
    model_card,
    save_model,
)
from tapetum.models.base import json_safe
from tapetum.models.devices import training_device
from tapetum.progress import Progress, quiet
from tapetum.record import HandMotion, Session, film, label_recording, open_recording
from tapetum.record.layout import LABELS, is_recording
from tapetum.record.marks import scene_mark
from tapetum.record.shot import Shot
from tapetum.report.evaluation import evaluate_model

__all__ = [
    "BUNDLED",
    "CROP",
    "FRESH_SEED",
    "NAME",
    "NEAR_AXIS",
    "QUICK",
    "SCENE",
    "SECONDS",
    "TEACHER_FRAMES",
    "TEACHER_SEEDS",
    "TRAIN_SEEDS",
    "UNIT_FRAMES",
    "UNIT_SEEDS",
    "Recipe",
    "calibrate_pretrained",
    "describe_pretrained",
    "is_made",
    "labelled_recording",
    "make_pretrained",
    "recorded_seeds",
]

NAME = "thin-lens-gaze"
SCENE = "hand-held"
TRAIN_SEEDS = (101, 102, 103, 104, 105, 106)
# Recordings of a camera that looks nearly straight at the probe, which the others hardly show: largest gazes.
NEAR_AXIS = {107: 0.1, 108: 0.04}
FRESH_SEED = 201
SECONDS = 80.0
BATCH = 64
# The second RR is 90 pixels from the first, whose disc is 130 pixels wide.
CROP = 320
# Copies of the camera that train the layers before the last with it; no evaluation may use them.
TEACHER_SEEDS = range(4_000_000, 4_000_720)
TEACHER_FRAMES = 64
# Copies of the camera on which the intervals for an unknown one are calibrated; no evaluation may use them.
UNIT_SEEDS = range(3_000_000, 3_000_120)
UNIT_FRAMES = 32
COPY_ACCURACY = 0.03


@dataclass(frozen=True)
class Recipe:
    """How long the model is trained, and beside how many copies of the camera."""

    epochs: int
    copies: int


BUNDLED = Recipe(epochs=60, copies=len(TEACHER_SEEDS))
"""What is bundled: a quarter of an hour on 16 cores and a GPU, hours on two cores."""
QUICK = Recipe(epochs=12, copies=128)
"""Half an hour on two cores."""


def recorded_seeds() -> tuple[int, ...]:
    """Seeds of the recordings of its own camera that the model learns from."""
    return (*TRAIN_SEEDS, *NEAR_AXIS)


def labelled_recording(path: Path, session: Session, scene: str = SCENE, *, progress: Progress = quiet) -> None:
    """Film a scene and label it, unless a finished recording of this very scene and session is there already."""
    if is_recording(path):
        there = open_recording(path)
        wanted = json_safe(Shot(load_scene(scene), session).parameters(), "session")
        same = all(there.meta.get(name) == value for name, value in wanted.items())
        if same and there.finished and there.truth() is not None:
            if there.labels() is None:
                label_recording(there, progress)
            return
    label_recording(film(load_scene(scene), path, session, progress=progress, overwrite=True), progress)


def make_pretrained(
    work: Path,
    out: Path,
    *,
    recipe: Recipe = BUNDLED,
    device: str = "auto",
    processes: int = 1,
    progress: Progress = quiet,
    on_epoch: Callable[[EpochReport], None] | None = None,
) -> ResNet18:
    """Film the training recordings, train a ResNet-18 on all of them, score it on a fresh one, and save it in `out`.

    The folder `work` keeps recordings, datasets and the checkpoint, from which an interrupted run resumes. Several
    `processes` film at the same time. The model is stored in half precision; its card holds seeds, command and scores.
    """
    work.mkdir(parents=True, exist_ok=True)
    # Everything in one go, so that no process waits for the longest film.
    sessions = {**_sessions(), FRESH_SEED: Session(SECONDS, seed=FRESH_SEED)}
    seeds = TEACHER_SEEDS[: recipe.copies]
    teachers = copy_films(_copied(), seeds, TEACHER_FRAMES, work / "teachers", side=CROP)
    _film([*_recordings(work, sessions), *teachers], processes, progress)
    train = _training_set(work, processes, progress)
    fresh = _built(work, "fresh", [work / f"{FRESH_SEED}.rec"], 0.2, progress)
    copies = _copies(work / "teachers", seeds, TEACHER_FRAMES, processes, progress)
    start = time.monotonic()
    model = _untrained(recipe, device).fit(
        train,
        copies=copies,
        progress=progress,
        checkpoint=work / f"checkpoint-{train.tp.hash[:8]}-{recipe.epochs}",
        resume=True,
        on_epoch=on_epoch,
    )
    notes = {
        "command": "make models",
        "scene": SCENE,
        "seeds": list(TRAIN_SEEDS),
        "near_axis": {str(seed): extent for seed, extent in NEAR_AXIS.items()},
        "teacher_seeds": [seeds[0], seeds[-1]],
        "teacher_frames": int(copies.sizes["frame"]),
        "fresh_seed": FRESH_SEED,
        "seconds_a_recording": SECONDS,
        "train_frames": int(train.sizes["frame"]),
        # Of this run only: after an interruption, the time since.
        "training_seconds": round(time.monotonic() - start),
        "trained_on": _trained_on(device),
        "simulation_only": True,
    }
    save_model(model, work / NAME, notes=notes, half=True, overwrite=True)
    # Score the weights as stored, in half precision.
    scores = evaluate_model(load_model(work / NAME), fresh.tp.test, fresh.tp.train, progress=progress)
    save_model(model, out, metrics=scores, notes=notes, half=True, overwrite=True)
    calibrate_pretrained(work, out, processes=processes, progress=progress)
    return model


def describe_pretrained(work: Path, out: Path, *, processes: int = 1, progress: Progress = quiet) -> None:
    """Teach the model in `out` where it applies and how copies differ; its weights stay.

    What it learned from is filmed again.
    """
    work.mkdir(parents=True, exist_ok=True)
    train = _training_set(work, processes, progress)
    model, card = load_model(out), model_card(out)
    assert isinstance(model, NetworkEstimator)
    notes = {**card["notes"], "described_seeds": list(recorded_seeds()), "described_frames": int(train.sizes["frame"])}
    model.describe(train, progress=progress)
    model.learn_copies(
        _copies(work / "teachers", TEACHER_SEEDS, TEACHER_FRAMES, processes, progress), progress=progress
    )
    save_model(model, out, metrics=card["metrics"], notes=notes, half=True, overwrite=True)


def calibrate_pretrained(work: Path, out: Path, *, processes: int = 1, progress: Progress = quiet) -> None:
    """Give the model in `out` intervals for copies of its camera that it has not seen; its weights stay.

    The copies are drawn from the tolerances of the scene's target, with seeds of their own.
    """
    copies = _copies(work / "copies", UNIT_SEEDS, UNIT_FRAMES, processes, progress)
    model, card = load_model(out), model_card(out)
    assert isinstance(model, NetworkEstimator)
    # Cards of older versions do not name what the model was trained on.
    own = {"films": [scene_mark(load_scene(SCENE))]}
    model.training_ = {**own, **(model.training_ or {})}
    calibrate_units(model, copies, progress=progress)
    notes = {**card["notes"], "unit_seeds": [UNIT_SEEDS[0], UNIT_SEEDS[-1]], "unit_frames": UNIT_FRAMES}
    save_model(model, out, metrics=card["metrics"], notes=notes, half=True, overwrite=True)


def is_made(out: Path, recipe: Recipe = BUNDLED) -> bool:
    """Whether the model in a folder is the one that `make_pretrained` makes today."""
    if not out.exists():
        return False
    card = model_card(out)
    notes, wanted = card.get("notes"), _untrained(recipe)
    about = {
        "scene": SCENE,
        "seeds": list(TRAIN_SEEDS),
        "near_axis": {str(seed): extent for seed, extent in NEAR_AXIS.items()},
        "teacher_seeds": [TEACHER_SEEDS[0], TEACHER_SEEDS[: recipe.copies][-1]],
        "seconds_a_recording": SECONDS,
    }
    told = isinstance(notes, dict) and all(notes.get(name) == value for name, value in about.items())
    return told and card["parameters"] == wanted.parameters() and card["versions"].get("tapetum") == version("tapetum")


def _trained_on(device: str) -> str:
    """The GPU's name, or that it was none, and torch's version."""
    chosen = training_device(device)
    return f"{torch.cuda.get_device_name(chosen) if chosen.type == 'cuda' else 'CPU'}, torch {torch.__version__}"


def _untrained(recipe: Recipe, device: str = "auto") -> ResNet18:
    # bfloat16 halves the time on processors that have it.
    return ResNet18(target="gaze", crop=CROP, epochs=recipe.epochs, batch=BATCH, precision="bf16", device=device)


def _sessions() -> dict[int, Session]:
    """The recordings of its own camera that the model learns from, by seed."""
    sessions = {seed: Session(SECONDS, seed=seed) for seed in TRAIN_SEEDS}
    return sessions | {
        seed: Session(SECONDS, seed=seed, motion=HandMotion(extent=most)) for seed, most in NEAR_AXIS.items()
    }


def _recordings(work: Path, sessions: dict[int, Session]) -> list[partial[None]]:
    """Return what films and labels each recording."""
    return [partial(labelled_recording, work / f"{seed}.rec", session) for seed, session in sessions.items()]


def _film(films: list[partial[None]], processes: int, progress: Progress) -> None:
    for _ in progress(side_by_side(films, processes), "filming", total=len(films)):
        pass


def _training_set(work: Path, processes: int, progress: Progress) -> xr.Dataset:
    """Film and cut what the model learns of its own camera."""
    sessions = _sessions()
    _film(_recordings(work, sessions), processes, progress)
    return _built(work, "train", [work / f"{seed}.rec" for seed in sessions], 0.0, progress)


def _copies(work: Path, seeds: range, frames: int, processes: int, progress: Progress) -> xr.Dataset:
    return film_copies(_copied(), seeds, frames, work, side=CROP, processes=processes, progress=progress)


def _copied() -> Scene:
    """The scene whose camera's copies are filmed."""
    return load_scene(SCENE, [f"sampling.accuracy={COPY_ACCURACY}"])


def _built(work: Path, name: str, recordings: list[Path], test_fraction: float, progress: Progress) -> xr.Dataset:
    """Cut a set, unless one of these recordings, with these labels, is there already."""
    about = [(open_recording(path).uuid, sha256_file(path / LABELS)) for path in recordings]
    key = hashlib.sha256(json.dumps([about, test_fraction, version("tapetum")]).encode()).hexdigest()
    path = work / f"{name}-{key[:8]}.zarr"
    if not path.exists():
        build_dataset(recordings, path, test_fraction=test_fraction, progress=progress)
    return open_dataset(path)
