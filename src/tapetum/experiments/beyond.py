"""What the paper's section 5 lacks: ablations, development recordings, phones never seen, a fit without training."""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from tapetum.report.evaluation import ClassScores, Outcome, gather_parts, score_classes
from tapetum.simulate.bounds import FRAME, gaze_information
from tapetum.simulate.exposure import digitise
from tapetum.simulate.radiometry import dark_electrons

__all__ = ["Ablation", "Development", "Fitted", "Untrained", "ablations", "development", "unseen", "untrained"]

VARIED_MODEL = "rotation-resnet18-varied"
# Frames of the test part that are fitted by simulation, seconds each.
_FITTED = {"paper": 60, "laptop": 20, "small": 6}

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Ablation:
    """A model with something left out, on the Rotation set's test part.

    Parameters
    ----------
    name
        What is left of it.
    features
        Of an image; None for a network.
    mae, rmse
        Mean and root mean square over both axes, fractions of the field.
    """

    name: str
    features: int | None
    mae: float
    rmse: float


def ablations(work: Workshop) -> list[Ablation]:
    """Leave out scales and powers of the Zernike features, and the network's brightest spot."""
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
    rows: list[Ablation] = []
    for name, columns in kept.items():
        ridge = Ridge(alpha=float(model.alpha), solver="svd").fit(x[:, columns], y)
        rows.append(_ablation(name, int(columns.sum()), truth, np.asarray(ridge.predict(seen[:, columns]))))
    for name in ("rotation-zernike-tuned", "rotation-resnet18", "rotation-resnet18-hidden"):
        both = work.outcome(name).pair()
        features = x.shape[1] if name.endswith("tuned") else None
        rows.append(_ablation(RECIPES[name].title, features, *both))
    return rows


def _ablation(name: str, features: int | None, truth: Array, said: Array) -> Ablation:
    error = said - truth
    return Ablation(name, features, float(np.abs(error).mean()), float(np.sqrt(np.square(error).mean())))


@dataclass(frozen=True)
class Development:
    """Errors on development recordings beside those on the last fifth of each of the recordings trained on.

    Parameters
    ----------
    model
        Its title.
    own
        MAE over both axes on the set's own test part, fractions of the field.
    distance
        Of each development recording, in metres.
    mae
        On each.
    guess
        MAE of predicting the mean of the labels trained on, over all development recordings.
    coverage
        Share of the truths of all development recordings in the 90 % intervals; None where the model has none.
    """

    model: str
    own: float
    distance: tuple[float, ...]
    mae: tuple[float, ...]
    guess: float | None
    coverage: float | None

    @property
    def ratio(self) -> float:
        """MAE on all development recordings, each counted alike, over that on the set's own test part."""
        return float(np.mean(self.mae)) / self.own


def development(work: Workshop) -> list[Development]:
    """Let the Rotation set's models, and one that learned from varied recordings, predict the development ones."""
    found = work.dataset("development")
    rows: list[Development] = []
    for name in (*ROTATION_MODELS, VARIED_MODEL):
        own, train = work.outcome(name), work.dataset(RECIPES[name].set).tp.train
        outcome = gather_parts(work.model(name), found, train, progress=work.progress)
        truth, said = outcome.pair()
        error = np.abs(said - truth).mean(axis=1)
        distance = outcome.covariates["distance"]
        guess = None if outcome.baseline is None else np.abs(outcome.baseline - outcome.targets).mean(axis=1)
        held = (outcome.targets >= outcome.prediction.lower) & (outcome.targets <= outcome.prediction.upper)
        rows.append(
            Development(
                RECIPES[name].title,
                _mae(own),
                tuple(float(d) for d in np.unique(distance)),
                tuple(float(error[distance == d].mean()) for d in np.unique(distance)),
                None if guess is None else float(np.mean([guess[distance == d].mean() for d in np.unique(distance)])),
                float(held.mean()) if np.isfinite(outcome.prediction.lower).all() else None,
            )
        )
    return rows


def _mae(outcome: Outcome) -> float:
    truth, said = outcome.pair()
    return float(np.abs(said - truth).mean())


def unseen(work: Workshop) -> ClassScores:
    """Ask a model for devices that it was not trained on, and score its answer "none of these"."""
    scores = score_classes(work.outcome("phones-resnet18-unseen"))
    assert scores is not None
    return scores


@dataclass(frozen=True)
class Fitted:
    """What the fit by simulation says of some frames.

    Parameters
    ----------
    rmse
        Over both axes, fractions of the field.
    median
        Of a frame's error over both axes: few frames that it takes for others decide the RMSE alone.
    lost
        Frames that are off by more than ten times the limit.
    coverage
        Share of truths in its 90 % intervals.
    """

    rmse: float
    median: float
    lost: int
    coverage: float


@dataclass(frozen=True)
class Untrained:
    """The fit by simulation in the centre half of the field.

    Parameters
    ----------
    frames
        Fitted of each kind.
    filmed
        Frames of the Rotation set's test part. Filmed frames are rotated by an approximation (error 1 % of the peak).
    exact
        Frames of the same gazes, turned exactly, with the same sensor's noise and unevenness.
    limit
        Root mean square of the Cramér-Rao limits at their gazes, photosites unknown.
    network_rmse
        Of ResNet-18 on the filmed frames.
    """

    frames: int
    filmed: Fitted
    exact: Fitted
    limit: float
    network_rmse: float


def untrained(work: Workshop) -> Untrained:
    """Fit the simulation to frames of the test part, evenly spread over those in the centre half of the field."""
    network = work.outcome("rotation-resnet18")
    truth, said = network.pair()
    if network.true_gaze is not None:
        # What a label says is off by more than the fit is.
        truth = network.true_gaze
    centre = np.flatnonzero(np.hypot(*truth.T) < CENTRE)
    chosen = centre[np.linspace(0, len(centre) - 1, min(_FITTED[work.size], len(centre))).round().astype(int)]
    truth, said = truth[chosen], said[chosen]
    video = plan_of("rotation", work.size).videos[0]
    scene, session = video.scene, video.session
    nuisances = (*FRAME, "background", "roll", "phase_x", "phase_y")
    # How uneven a sensor is can be measured before a lamp; which pixel is which is left unknown.
    sensor = next(one for one in session.stray if isinstance(one, FixedPattern))
    offsets = sensor.columns, sensor.rows
    model = SimulationFit(scene, nuisances=nuisances, unevenness=sensor.gain, offsets=offsets)
    limit = _rms(gaze_information(scene, truth, progress=work.progress).bounds())

    def fitted(frames: Data) -> Fitted:
        found = model.predict(frames, progress=work.progress, anyway=True)
        each = np.sqrt(np.square(found.value - truth).mean(axis=1))
        held = (found.lower <= truth) & (truth <= found.upper)
        return Fitted(_rms(each), float(np.median(each)), int((each > 10 * limit).sum()), float(held.mean()))

    filmed = fitted(work.dataset("rotation").tp.test.isel(frame=chosen))
    return Untrained(
        len(chosen), filmed, fitted(_exact(scene, truth, sensor, session.motion.roll)), limit, _rms(said - truth)
    )


def _exact(
    scene: Scene, gazes: Array, pattern: FixedPattern, turned: float, side: int = 200
) -> NDArray[np.uint8 | np.uint16]:
    """Crops [N, side, side] of some gazes, a little off their middle and turned by some radians (RMS)."""
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
