"""A sealed test: recordings that nobody looks at, filmed and scored by one command; only the scores are kept.

Inspecting the development recordings changed the method, so scores on them may be too good. The sealed recordings are
drawn from a salt of their own: distance, room, seed, and the camera's assembly within tolerances. Crops are deleted
after scoring, and no setting of the package may be chosen by the result.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from tapetum.bench import Scene, load_scene, with_values
from tapetum.data import open_dataset
from tapetum.data.synth import Plan, make_plan, rotation_plan, synthesise
from tapetum.data.synth.plan import Video
from tapetum.errors import InputError
from tapetum.experiments.recordings import before_room
from tapetum.experiments.templating import render
from tapetum.experiments.workshop import RECIPES, Workshop
from tapetum.files import atomic_file, told_when_full
from tapetum.models import Predictor
from tapetum.progress import Progress, quiet
from tapetum.report.evaluation import by_recording, gather_parts, score
from tapetum.report.verdicts import against_mean

__all__ = ["RESULTS", "SALT", "append_results", "read_results", "run_sealed", "score_sealed", "sealed_plan"]

SALT = "tapetum/sealed/2026-11"
"""Seed text of the recordings. No test and no other set may use it."""

RESULTS, PAGE = "sealed.jsonl", "sealed.md"
MODELS = ("rotation-resnet18", "rotation-resnet18-varied", "rotation-zernike", "rotation-zernike-tuned")
"""Models scored by default."""

_COUNT = {"paper": 12, "laptop": 6, "small": 2}
_SECONDS = {"paper": 20.0, "laptop": 8.0, "small": 2.0}
# Largest tolerances in data sheets of machine-vision cameras: Basler pilot, Prosilica GT.
_TILT, _DECENTRE = np.radians(0.63), 0.25e-3
# Assumed: accuracy of manual focus and of the aperture, and variation of beam splitters.
_FOCUS, _STOP, _RATIO, _ANGLE = 0.1, 1.15, (0.05, 0.15), 0.2
_DISTANCES, _BACKGROUND, _ROOM = (3.0, 8.0), (20.0, 160.0), (3.0, 60.0)


def sealed_plan(size: str, salt: str = SALT, scene: Scene | None = None) -> Plan:
    """Return the plan of the sealed recordings of a size (`paper`, `laptop` or `small`: their number and length).

    They are drawn from `salt`, around the nominal camera in `scene` (by default the Rotation set's).
    """
    scene = load_scene("rotation") if scene is None else scene
    videos = [_drawn(scene, size, salt, number) for number in range(_COUNT[size])]
    plan = make_plan("rotation", "small", 0)
    return replace(plan, size=size, videos=tuple(videos), rules=replace(plan.rules, test_fraction=1.0))


def _drawn(scene: Scene, size: str, salt: str, number: int) -> Video:
    words = np.frombuffer(hashlib.sha256(f"{salt}/{number}".encode()).digest(), np.uint32)
    rng = np.random.default_rng(words)

    def evenly(ends: tuple[float, float]) -> float:
        return float(np.exp(rng.uniform(*np.log(ends))))

    def in_disc(radius: float) -> list[float]:
        angle = rng.uniform(0, 2 * np.pi)
        return (radius * np.sqrt(rng.uniform()) * np.array([np.cos(angle), np.sin(angle)])).tolist()

    lens, beam = scene.target.lens, scene.illumination.second_beam
    stop = rng.uniform(1, _STOP)
    values: dict[str, Any] = {
        "target.sensor.tilt": in_disc(_TILT),
        "target.sensor.decentre": in_disc(_DECENTRE),
        "target.object_distance": scene.target.object_distance * (1 + rng.uniform(-_FOCUS, _FOCUS)),
    }
    if lens.kind == "thin":
        values["target.lens.aperture_radius"] = lens.aperture_radius / stop
    else:
        values["target.lens.f_number"] = _F_NUMBER * stop
    if beam is not None:
        ratio = float(rng.uniform(*_RATIO))
        angle = [part * (1 + rng.uniform(-_ANGLE, _ANGLE)) for part in beam.angle]
        values["illumination.second_beam"] = {"ratio": ratio, "angle": angle}
    made = rotation_plan(with_values(scene, values), "small", 0).videos[0]
    made = replace(made, session=replace(made.session, seed=int(rng.integers(2**31))))
    name, far = f"sealed-{number + 1}", float(rng.uniform(*_DISTANCES))
    return before_room(made, name, far, _SECONDS[size], background=evenly(_BACKGROUND), room=evenly(_ROOM))


# Of the Rotation set's lens, wide open.
_F_NUMBER = 1.45


def score_sealed(
    models: Mapping[str, Predictor],
    folder: Path,
    *,
    size: str = "laptop",
    workers: int | None = None,
    plan: Plan | None = None,
    progress: Progress = quiet,
) -> list[dict[str, Any]]:
    """Film the sealed recordings (or those of `plan`) in `folder`, score gaze models on them, and delete them.

    Returns for each model: date, version, errors of the gaze by axis and radial, those of predicting the mean of its
    own training labels, a verdict, coverage, and the spread over recordings. The same call resumes after an
    interruption. Raises an InputError when a model does not predict gaze, or the disk is full.
    """
    for name, model in models.items():
        if not {"gaze_x", "gaze_y"} <= set(model.quantities):
            raise InputError("does not show the gaze", where=name, remedy="the sealed test has no other labels")
    plan = sealed_plan(size) if plan is None else plan
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / f"sealed-{plan.digest[:12]}.zarr"
    try:
        if not place.exists():
            synthesise(plan, place, processes=workers, progress=progress)
        dataset = open_dataset(place)
        heading = {
            "date": datetime.now(UTC).strftime("%Y-%m-%d"),
            "version": version("tapetum"),
            "size": size,
            "recordings": plan.digest[:12],
        }
        return [heading | _scored(name, model, dataset, progress) for name, model in models.items()]
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _scored(name: str, model: Predictor, dataset: xr.Dataset, progress: Progress) -> dict[str, Any]:
    # The baseline is the mean of its own training labels, not of these.
    learned = getattr(model, "training_", None) or {}
    outcome = gather_parts(model, dataset.tp.test, dataset.tp.train, progress=progress)
    outcome = replace(outcome, guess=learned.get("mean"))
    told, parts = score(outcome), by_recording(outcome)
    gaze, guess = told["gaze"], told.get("baseline_gaze")
    held = [one["coverage"] for one in told["targets"].values() if one["interval"] is not None]
    each = [float(np.mean(one.mae)) for one in parts]
    return {
        "model": name,
        "training_data": model.data_hash_,
        "frames": told["frames"],
        **{key: gaze[key] for key in ("mae", "rmse", "radial", "radial_rms")},
        "guess": None if guess is None else {key: guess[key] for key in ("mae", "rmse", "radial", "radial_rms")},
        "verdict": None
        if guess is None
        else against_mean(gaze["radial"], guess["radial"], gaze["radial_rms"], guess["radial_rms"]),
        "coverage": float(np.mean(held)) if held else None,
        "recording_mae": {"least": min(each), "median": float(np.median(each)), "most": max(each)},
    }


def run_sealed(out: Path, work: Workshop, models: Mapping[str, Predictor] | None = None) -> list[dict[str, Any]]:
    """Score gaze models (by default the Rotation models of `work`) on the sealed recordings.

    The scores are appended to `sealed.jsonl` in the folder `out`, and `sealed.md` is written.
    """
    given = models or {RECIPES[name].title: work.model(name) for name in MODELS}
    rows = score_sealed(given, work.folder, size=work.size, workers=work.workers, progress=work.progress)
    append_results(out, rows)
    with atomic_file(out / PAGE) as part:
        part.write_text(render("sealed", {"results": read_results(out)}), encoding="utf-8")
    return rows


def append_results(out: Path, rows: list[dict[str, Any]]) -> Path:
    """Add results to `sealed.jsonl` in a folder, a line each, after the existing ones."""
    file = out / RESULTS
    with told_when_full(out):
        out.mkdir(parents=True, exist_ok=True)
        text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
        with file.open("a", encoding="utf-8") as opened:
            opened.write(text)
            opened.flush()
            os.fsync(opened.fileno())
    return file


def read_results(out: Path) -> list[dict[str, Any]]:
    """Return all results in a folder, oldest first; refuses a damaged line."""
    file = out / RESULTS
    try:
        lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
        return [json.loads(line) for line in lines]
    except ValueError as error:
        raise InputError(f"damaged: {error}", where=file, remedy="remove the line that is not whole") from error
