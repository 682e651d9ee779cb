"""The bundled ResNet-18: filmed, trained and scored on the virtual bench, with the seeds fixed here."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from tapetum.bench import load_scene
from tapetum.data import build_dataset, open_dataset
from tapetum.models import EpochReport, ResNet18, load_model, save_model
from tapetum.progress import Progress, quiet
from tapetum.record import Session, film, label_recording, open_recording
from tapetum.record.layout import is_recording
from tapetum.report.evaluate import evaluate_model

__all__ = [
    "CROP",
    "EPOCHS",
    "FRESH_SEED",
    "NAME",
    "SCENE",
    "SECONDS",
    "TRAIN_SEEDS",
    "labelled_recording",
    "make_pretrained",
]

NAME = "thin-lens-gaze"
SCENE = "hand-held"
TRAIN_SEEDS = (101, 102, 103, 104, 105, 106)
FRESH_SEED = 201
SECONDS = 80.0
EPOCHS = 12
# The second RR lies 90 pixels beside the first, whose disc is 130 pixels wide.
CROP = 320


def labelled_recording(path: Path, session: Session, scene: str = SCENE, *, progress: Progress = quiet) -> None:
    """Film a scene and label it, unless a finished recording of this length and seed is there already."""
    if is_recording(path):
        there = open_recording(path)
        same = there.meta.get("seed") == session.seed and there.meta.get("seconds") == session.seconds
        if same and there.finished and there.truth() is not None:
            if there.labels() is None:
                label_recording(there, progress)
            return
    label_recording(film(load_scene(scene), path, session, progress=progress, overwrite=True), progress)


def make_pretrained(
    work: Path,
    out: Path,
    *,
    epochs: int = EPOCHS,
    progress: Progress = quiet,
    on_epoch: Callable[[EpochReport], None] | None = None,
) -> ResNet18:
    """Film the training recordings, train a ResNet-18 on all of them, score it on a fresh one, save it.

    Parameters
    ----------
    work
        Keeps recordings, datasets and the checkpoint: an interrupted run goes on where it stopped.
    out
        The model's folder: half precision, its card with seeds, command and figures.
    epochs
        Passes over the training frames.
    progress, on_epoch
        Show how far it is.
    """
    work.mkdir(parents=True, exist_ok=True)
    for seed in (*TRAIN_SEEDS, FRESH_SEED):
        labelled_recording(work / f"{seed}.rec", Session(SECONDS, seed=seed), progress=progress)
    parts = {"train": (TRAIN_SEEDS, 0.0), "fresh": ((FRESH_SEED,), 0.2)}
    for name, (seeds, test_fraction) in parts.items():
        if not (work / f"{name}.zarr").exists():
            recordings = [work / f"{seed}.rec" for seed in seeds]
            build_dataset(recordings, work / f"{name}.zarr", test_fraction=test_fraction, progress=progress)
    train, fresh = open_dataset(work / "train.zarr"), open_dataset(work / "fresh.zarr")
    start = time.monotonic()
    model = ResNet18(target="gaze", crop=CROP, epochs=epochs).fit(
        train, progress=progress, checkpoint=work / "checkpoint", resume=True, on_epoch=on_epoch
    )
    notes = {
        "command": "make models",
        "scene": SCENE,
        "seeds": list(TRAIN_SEEDS),
        "fresh_seed": FRESH_SEED,
        "seconds_a_recording": SECONDS,
        "train_frames": int(train.sizes["frame"]),
        # Of this run: after an interruption, the part since.
        "training_seconds": round(time.monotonic() - start),
        "simulation_only": True,
    }
    save_model(model, work / NAME, notes=notes, half=True, overwrite=True)
    # The figures on the card are those of the weights on the card.
    scores = evaluate_model(load_model(work / NAME), fresh.tp.test, fresh.tp.train, progress=progress)
    save_model(model, out, metrics=scores, notes=notes, half=True, overwrite=True)
    return model
