"""Beyond the paper's section 5: ablations, development recordings, unknown phones, a fit without training."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import Ridge

from tapetum.bench import Scene
from tapetum.experiments.learning import CENTRE, ROTATION_MODELS
from tapetum.experiments.workshop import RECIPES, Workshop, plan_of
from tapetum.models import SimulationFit, ZernikeRidge
from tapetum.models.base import Data
from tapetum.models.features import feature_names
from tapetum.models.simulation.pictures import Pictures
from tapetum.record import FixedPattern
from tapetum.report.evaluation import Outcome, gather_parts, score_classes
from tapetum.report.metrics import coverage
from tapetum.simulate.bounds import FRAME, gaze_information
from tapetum.simulate.exposure import digitise
from tapetum.simulate.radiometry import dark_electrons

__all__ = ["ablations", "development", "unseen", "untrained"]

VARIED_MODEL = "rotation-resnet18-varied"
# Frames of the test part that are fitted by simulation, seconds each.
_FITTED = {"paper": 60, "laptop": 20, "small": 6}

Array = NDArray[np.float64]


def ablations(work: Workshop) -> dict[str, Any]:
    """Leave out scales and powers of the Zernike features, and the network's brightest spot.

    A row has the `name` of the remaining parts, the number of `features` of an image (None for a network), and `mae`
    and `rmse` over both axes, in fractions of the field.
    """
    dataset = work.dataset("rotation")
    model = RECIPES["rotation-zernike"].make(work.size)
    assert isinstance(model, ZernikeRidge)
    train, test = dataset.tp.train, dataset.tp.test
    x, y = model.features(train, progress=work.progress), train.tp.values(model.quantities)
    seen, truth = model.features(test, progress=work.progress), test.tp.values(model.quantities)
    place = np.array([name.rpartition("^")[2] for name in feature_names(model.scales, model.order, model.powers)])
    kept = {f"all {len(place)} features, as in the paper": np.ones(len(place), dtype=bool)}
    for scale in model.scales:
        kept[f"the crop of {scale} pixels alone"] = np.array([one.endswith(f" at {scale}") for one in place])
    for most in model.powers[:-1]:
        powers = tuple(f"{power} " for power in model.powers if power <= most)
        kept[f"powers up to {most}"] = np.array([one.startswith(powers) for one in place])
    rows: list[dict[str, Any]] = []
    for name, columns in kept.items():
        ridge = Ridge(alpha=float(model.alpha), solver="svd").fit(x[:, columns], y)
        rows.append(_ablation(name, int(columns.sum()), truth, np.asarray(ridge.predict(seen[:, columns]))))
    for name in ("rotation-zernike-tuned", "rotation-resnet18", "rotation-resnet18-hidden"):
        both = work.outcome(name).pair()
        features = x.shape[1] if name.endswith("tuned") else None
        rows.append(_ablation(RECIPES[name].title, features, *both))
    return {"rows": rows}


def _ablation(name: str, features: int | None, truth: Array, said: Array) -> dict[str, Any]:
    error = said - truth
    return {"name": name, "features": features, "mae": float(np.abs(error).mean()), "rmse": _rms(error)}


def development(work: Workshop) -> dict[str, Any]:
    """Score the Rotation set's models, and one trained on varied recordings, on the development recordings.

    A row has the `model`'s title; `own`, its MAE over both axes on its set's own test part in fractions of the field;
    the `distance` of each development recording in metres and the `mae` there; their mean over `own` as `ratio`; the
    `guess`, the MAE of predicting the mean training label; and the `coverage` of its 90 % intervals (None without).
    """
    found, rows = work.dataset("development"), list[dict[str, Any]]()
    for name in (*ROTATION_MODELS, VARIED_MODEL):
        own, train = _mae(work.outcome(name)), work.dataset(RECIPES[name].set).tp.train
        outcome = gather_parts(work.model(name), found, train, progress=work.progress)
        truth, said = outcome.pair()
        lower, upper = outcome.prediction.lower, outcome.prediction.upper
        distance = outcome.covariates["distance"]
        places = [distance == d for d in np.unique(distance)]
        mae = [float(np.abs(said - truth)[one].mean()) for one in places]
        base = outcome.baseline
        rows.append(
            {
                "model": RECIPES[name].title,
                "own": own,
                "distance": np.unique(distance).tolist(),
                "mae": mae,
                "guess": None if base is None else float(np.mean([np.abs(base - truth)[one].mean() for one in places])),
                "coverage": float(coverage(truth, lower, upper).mean()) if np.isfinite(lower).all() else None,
                "ratio": float(np.mean(mae)) / own,
            }
        )
    return {"rows": rows}


def _mae(outcome: Outcome) -> float:
    truth, said = outcome.pair()
    return float(np.abs(said - truth).mean())


def unseen(work: Workshop) -> dict[str, Any]:
    """Let a model classify devices that it was not trained on, and score its answers by `ClassScores`."""
    scores = score_classes(work.outcome("phones-resnet18-unseen"))
    assert scores is not None
    return scores.to_dict()


def untrained(work: Workshop) -> dict[str, Any]:
    """Fit the simulation to `frames` of the Rotation set's test part, evenly spread over the centre half of the field.

    `filmed` are those frames, rotated by the film's approximation (error 1 % of the peak); `exact` are frames at the
    same gazes, rotated exactly, with the same sensor's noise and non-uniformity. Each has the `rmse` over both axes in
    fractions of the field, the `median` of a frame's error (a few ambiguous frames dominate the RMSE), the frames
    `lost` by more than ten times the limit, and the `coverage` of its 90 % intervals. `limit` is the root mean square
    of the Cramér-Rao bounds at their gazes, photosites unknown; `network_rmse` is ResNet-18's on the filmed frames.
    """
    network = work.outcome("rotation-resnet18")
    truth, said = network.pair()
    if network.true_gaze is not None:
        # The label error exceeds the fit's.
        truth = network.true_gaze
    centre = np.flatnonzero(np.hypot(*truth.T) < CENTRE)
    chosen = centre[np.linspace(0, len(centre) - 1, min(_FITTED[work.size], len(centre))).round().astype(int)]
    truth, said = truth[chosen], said[chosen]
    video = plan_of("rotation", work.size).videos[0]
    scene, session = video.scene, video.session
    nuisances = (*FRAME, "background", "roll", "phase_x", "phase_y")
    # A sensor's non-uniformity can be measured with a lamp; the individual pixels' responses stay unknown.
    sensor = next(one for one in session.stray if isinstance(one, FixedPattern))
    offsets = sensor.columns, sensor.rows
    model = SimulationFit(scene, nuisances=nuisances, unevenness=sensor.gain, offsets=offsets)
    limit = _rms(gaze_information(scene, truth, progress=work.progress).bounds())

    def fitted(frames: Data) -> dict[str, Any]:
        found = model.predict(frames, progress=work.progress, anyway=True)
        each = np.sqrt(np.square(found.value - truth).mean(axis=1))
        return {
            "rmse": _rms(each),
            "median": float(np.median(each)),
            "lost": int((each > 10 * limit).sum()),
            "coverage": float(coverage(truth, found.lower, found.upper).mean()),
        }

    return {
        "frames": len(chosen),
        "filmed": fitted(work.dataset("rotation").tp.test.isel(frame=chosen)),
        "exact": fitted(_exact(scene, truth, sensor, session.motion.roll)),
        "limit": limit,
        "network_rmse": _rms(said - truth),
    }


def _exact(
    scene: Scene, gazes: Array, pattern: FixedPattern, turned: float, side: int = 200
) -> NDArray[np.uint8 | np.uint16]:
    """Crops [N, side, side] at some gazes, slightly off-centre and rotated by some radians (RMS)."""
    rng = np.random.default_rng(0)
    pictures, sensor = Pictures(scene, side), scene.probe.sensor
    offset, gain = (np.asarray(one, np.float64) for one in pattern.draw(scene))
    frames: list[NDArray[np.uint8 | np.uint16]] = []
    for gaze in gazes:
        off = rng.uniform(-0.5, 0.5, 2) * pictures.pitch
        roll = turned * rng.standard_normal()
        pose = replace(pictures.start(), place=(float(off[0]), float(off[1])), roll=float(roll))
        left, top = (int(rng.integers(size - side)) for size in sensor.pixels)
        here = slice(top, top + side), slice(left, left + side)
        light = pictures.render(pose, gaze[None])[0] + dark_electrons(sensor) + offset[here]
        mean = torch.from_numpy(np.maximum(light, 0.0) * gain[here])
        frames.append(digitise(mean, sensor, rng))
    return np.stack(frames)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.square(values).mean()))
