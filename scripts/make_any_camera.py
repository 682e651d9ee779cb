"""Make the backbone `any-camera`: gaze, learned from many lenses, copies, distances, focus and light.

make any-camera (minutes of filming on many cores and of training on a GPU; hours on two cores)

Films `UNITS` cameras of the virtual bench, each one copy drawn from its tolerances, `FRAMES` frames of each at gazes
spread over its field; trains a ResNet-18 on four fifths of the cameras; and sets its intervals by the other fifth,
which it has not seen: they include what no retro-reflection shows of an unknown camera (where its point of symmetry
lies, how large its sensor is). In training each camera has a last layer of its own; in the end one for all is fitted.
Two lenses of the catalogue, `HELD_OUT`, are in no camera here: they stand for a lens that nobody has filmed. Copies
have seeds from `FIRST_UNIT` on; no evaluation may use these. An interrupted run goes on.
"""

from __future__ import annotations

import argparse
import hashlib
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import Ridge

from tapetum.bench import Scene, draw_unit, load_scene, with_values
from tapetum.data.write import Rules
from tapetum.errors import InputError
from tapetum.experiments.side_by_side import side_by_side
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import NetworkEstimator, load_model, model_card, save_model
from tapetum.models.architectures import Network
from tapetum.models.augmentation import Augmentation
from tapetum.models.devices import training_device
from tapetum.models.domain import fit_domain, picture_features
from tapetum.models.inputs import prepare
from tapetum.models.intervals import Intervals
from tapetum.models.last_layer import Correction, LastLayer, corrected
from tapetum.models.other_units import grouped_half_width
from tapetum.models.own_layers import OwnLayers, beside_copies
from tapetum.models.snr import crop_snr
from tapetum.models.training import EpochReport, TrainingSettings, augment, train
from tapetum.progress import Progress, bar
from tapetum.record.noise import counts
from tapetum.record.patch import add_patch
from tapetum.record.returns import returns_of
from tapetum.record.shot import frame_rng
from tapetum.record.stray import FixedPattern, Ground
from tapetum.simulate.exposure import gain_of

NAME = "any-camera"
SEED = 20261127
UNITS, FRAMES = 510, 64
FIRST_UNIT = 2_000_000
HELD_OUT = ("compact-6mm-f1.9", "photo-50mm-f1.8")
CROP, SIZE, EPOCHS, BATCH, RATE = 288, 96, 80, 64, 2e-3
# Looks are kept in bytes: so many steps to 1, from the lowest on. A step is as large as the noise of a dark pixel.
_STEPS, _LOWEST = 200, -0.15
# Epochs between two looks at the cameras aside.
_SHOWN = 10
# Of five cameras one trains nothing and sets the intervals.
_ASIDE = 5
_PHONES = ("phone-a", "phone-b", "phone-c", "phone-d", "phone-e", "phone-f")
# Traced lenses with their shares, and the focal lengths in metres that they are drawn at: zooms are set to them, prime
# lenses scaled, so that the six designs of phones stand for compact cameras of any size.
_TRACED = {
    "zoom-5-15mm": (0.25, 0.0053, 0.0145),
    "zoom-18-140mm": (0.1, 0.0186, 0.026),
    "cmount-12mm-f1.4": (0.17, 0.004, 0.012),
    **dict.fromkeys(_PHONES, (0.08, 0.005, 0.012)),
}
# Largest gaze of the lenses of phones, which lose the light earlier; the others reach the field's edge.
_WIDE, _NARROW = 0.48, 0.3

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drawn:
    """A camera to film: its scene, its family, the largest gaze, and the peak at the field's middle over full scale."""

    scene: Scene
    family: str
    extent: float
    peak: float
    roll: float
    pattern: bool


def drawn_camera(number: int) -> Drawn:
    """Return the camera of a number: equal numbers give equal cameras."""
    rng = np.random.default_rng([SEED, number])

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    family = str(rng.choice(["hand-held", "rotation", "thin", "traced"], p=[0.25, 0.2, 0.1, 0.45]))
    changes: dict[str, Any] = {"sampling.accuracy": 0.03, "probe.sensor.pixels": [480, 480]}
    extent = _WIDE
    if family == "thin":
        changes |= {"target.lens.focal_length": log(0.07, 0.14), "target.lens.aperture_radius": log(0.003, 0.005)}
    elif family == "hand-held" and rng.random() < 0.3:
        changes["target.lens.aperture_radius"] = log(0.0035, 0.0045)
    elif family == "traced":
        name = str(rng.choice(list(_TRACED), p=[share for share, _, _ in _TRACED.values()]))
        extent = _NARROW if name in _PHONES else _WIDE
        changes |= {"target.lens.name": name, "target.lens.focal_length": log(*_TRACED[name][1:])}
        if name in _PHONES:
            changes |= {"target.sensor.pixels": [640, 480], "target.sensor.pitch": 5.6e-6}
    scene = load_scene("hand-held" if family in ("hand-held", "thin") else "rotation")
    distance = log(4.5, 7.0) if rng.random() < 0.3 else 5.5
    changes["distance"] = distance
    changes["target.object_distance"] = distance * (log(0.93, 1.08) if rng.random() < 0.3 else 1.0)
    if rng.random() < 0.2:
        changes["illumination.wavelength"] = float(rng.uniform(520e-9, 860e-9))
    if rng.random() < 0.2:
        changes["probe.lens.focal_length"] = scene.probe.lens.focal_length * log(0.8, 1.25)
    if rng.random() < 0.25:
        size, turn = log(0.5e-3, 1.5e-3), rng.uniform(0, 2 * math.pi)
        beam = {"ratio": log(0.02, 0.3), "angle": [size * math.cos(turn), size * math.sin(turn)]}
        changes |= {f"illumination.second_beam.{name}": value for name, value in beam.items()}
    changes["probe.sensor.background"] = float(rng.uniform(5, 100))
    peak, roll, pattern = log(0.25, 1.0), 0.02 if rng.random() < 0.5 else 0.0, bool(rng.random() < 0.5)
    unit = draw_unit(with_values(scene, changes), None, FIRST_UNIT + number)
    return Drawn(unit, family, extent, peak, roll, pattern)


def film(camera: Drawn, number: int) -> dict[str, NDArray[Any]]:
    """Return a camera's looks [N, SIZE, SIZE], gazes [N, 2] and SNRs [N], of visible RRs."""
    rng = np.random.default_rng([SEED, number, 1])
    scene, rules = camera.scene, Rules(side=CROP)
    # The first frame, head on, sets the brightness and is not kept.
    gaze = np.r_[np.zeros((1, 2)), rng.uniform(-camera.extent, camera.extent, (FRAMES, 2))]
    n = len(gaze)
    place, roll = rng.normal(0, 2e-3, (n, 2)), rng.normal(0, camera.roll, n) if camera.roll else np.zeros(n)
    returns = returns_of(scene, gaze, place, roll, np.full(n, scene.distance))
    ground = Ground.of(scene, (FixedPattern(),) if camera.pattern else (), int(rng.integers(2**31)))
    sensor = scene.probe.sensor
    most = max(float(np.max(patch.light)) for one in returns for patch in one.patches(0))
    power = camera.peak * (2**sensor.bits - 1) / (gain_of(sensor) * most)
    found: dict[str, list[Any]] = {"look": [], "gaze": [], "snr": []}
    for i in range(1, n):
        mean = ground.lit(1.0)
        light = power * rng.normal(1, 0.01)
        for one in returns:
            for patch in one.patches(i):
                add_patch(mean, patch, light)
        image = counts(ground.seen(mean), sensor, frame_rng(SEED + number, 3, i))
        cut = rules.cut(image)
        if cut is None:
            continue
        crops, full = cut[0][None], float(2**sensor.bits - 1)
        look = prepare(crops, CROP, SIZE, full)[0, 0].numpy()
        found["look"].append(np.clip(np.rint((look - _LOWEST) * _STEPS), 0, 255).astype(np.uint8))
        found["snr"].append(crop_snr(crops, full)[0])
        found["gaze"].append(gaze[i])
    shapes = {"look": (-1, SIZE, SIZE), "gaze": (-1, 2), "snr": (-1,)}
    return {name: np.array(values).reshape(shapes[name]) for name, values in found.items()}


def kept(path: Path, number: int) -> None:
    """Film a camera, unless its file is there."""
    if path.exists():
        return
    try:
        frames = film(drawn_camera(number), number)
    except InputError as error:
        # A drawn camera that cannot be simulated as asked has no frames: the next run must not try again.
        print(f"camera {number}: {error}", flush=True)
        frames = {"look": np.zeros((0, SIZE, SIZE), np.uint8), "gaze": np.zeros((0, 2)), "snr": np.zeros(0)}
    with atomic_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, look=frames["look"], gaze=frames["gaze"], snr=frames["snr"])


def filmed(work: Path, units: int, processes: int, progress: Progress) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
    """Yield every camera's number and frames, from the folder where it was filmed before."""
    work.mkdir(parents=True, exist_ok=True)
    paths = [work / f"camera-{number:04d}.npz" for number in range(units)]
    tasks = [partial(kept, path, number) for number, path in enumerate(paths)]
    for _ in progress(side_by_side(tasks, processes), "filming cameras", total=units):
        pass
    for number, path in enumerate(paths):
        with np.load(path) as file:
            yield number, dict(file)


@dataclass(frozen=True)
class Taught:
    """All cameras' frames together; `camera` [N] numbers them, `aside` [N] is true for those that train nothing."""

    look: torch.Tensor
    gaze: Array
    snr: Array
    camera: NDArray[np.int64]

    @classmethod
    def of(cls, work: Path, units: int, processes: int, progress: Progress) -> Taught:
        parts = list(filmed(work, units, processes, progress))
        look = torch.from_numpy(np.concatenate([part["look"] for _, part in parts]))[:, None] / _STEPS + _LOWEST
        gaze, snr = (np.concatenate([part[name] for _, part in parts]) for name in ("gaze", "snr"))
        return cls(look, gaze, snr, np.repeat([n for n, _ in parts], [len(part["gaze"]) for _, part in parts]))

    @property
    def aside(self) -> NDArray[np.bool_]:
        return self.camera % _ASIDE == 0

    @property
    def digest(self) -> str:
        """SHA-256 of the frames and what is learned of them."""
        told = hashlib.sha256(self.look.numpy().tobytes())
        for one in (self.gaze, self.camera):
            told.update(np.ascontiguousarray(one).tobytes())
        return told.hexdigest()


def outputs_of(network: Callable[[torch.Tensor], torch.Tensor], look: torch.Tensor, device: torch.device) -> Array:
    """Return a network's outputs [N, ...], computed as in use."""
    with torch.inference_mode():
        batches = [batch.to(device).contiguous(memory_format=torch.channels_last) for batch in look.split(256)]
        return np.concatenate([network(batch).double().cpu().numpy() for batch in batches])


def few_shot(
    layer: LastLayer, features: Array, wanted: Array, camera: NDArray[np.int64], shots: int = 32, penalty: float = 10.0
) -> Array:
    """Errors [n, 2] of a last layer corrected by `shots` frames of each camera, for its other frames."""
    errors = [np.empty((0, 2))]
    for number in np.unique(camera):
        x, y = features[camera == number], wanted[camera == number]
        if len(x) > shots:
            errors.append(y[shots:] - corrected(layer, x[:shots], y[:shots], None, Correction(penalty))(x[shots:]))
    return np.concatenate(errors)


def taught_network(
    taught: Taught, work: Path, epochs: int, device: torch.device, progress: Progress
) -> tuple[NetworkEstimator, dict[str, Any]]:
    """Train the network, set its intervals by the cameras aside, and learn which frames it applies to."""
    fit, aside = np.flatnonzero(~taught.aside), np.flatnonzero(taught.aside)
    centre, spread = taught.gaze[fit].mean(axis=0), taught.gaze[fit].std(axis=0)
    unit = float(taught.look[fit].std())
    look, places = taught.look / unit, torch.from_numpy(fit)
    wanted = (taught.gaze - centre) / spread
    cameras, own = np.unique(taught.camera[fit], return_inverse=True)
    # No image tells how large a camera's sensor is and where its point of symmetry lies: each has a last layer of its
    # own, which adds to that of all, so that the layers before it need not guess.
    network = beside_copies("resnet18", 2, len(cameras), seed=0)

    def adapted(layer: LastLayer, features: Array) -> list[float]:
        """Mean errors on cameras that train nothing, the last layer corrected by some of their frames."""
        return (spread * np.abs(few_shot(layer, features, wanted[aside], taught.camera[aside])).mean(axis=0)).tolist()

    # bfloat16 halves the time on processors that have it.
    settings = TrainingSettings(epochs, BATCH, RATE, 0.05, 0, Augmentation(), None, "bf16")

    error, epoch = 0.0, 0

    def validate(trained: torch.nn.Module) -> float:
        """Show the error now and then; nothing is chosen by it."""
        nonlocal error, epoch
        assert isinstance(trained, Network)
        if epoch % _SHOWN == 0:
            error = float(np.mean(adapted(_shared(trained), outputs_of(trained.features, look[aside], device))))
        epoch += 1
        return error

    def told(report: EpochReport) -> None:
        error = f"corrected by 32 frames of a camera aside {report.validation_mae:.4f}"
        print(f"epoch {report.epoch}: loss {report.loss:.4f}, {error}", flush=True)

    train(
        network,
        look[places],
        torch.from_numpy(np.concatenate([wanted[fit], own[:, None] + 1], axis=1).astype(np.float32)),
        settings,
        loss=OwnLayers(2),
        validate=validate,
        device=device,
        checkpoint=work / f"checkpoint-{taught.digest[:8]}-{epochs}",
        resume=True,
        identity={"data": taught.digest, "heads": len(cameras)},
        progress=progress,
        on_epoch=told,
    )
    features = outputs_of(network.to(device).eval().features, look, device)
    network.cpu()
    scores: dict[str, Any] = {"few_shot": adapted(_shared(network), features[aside])}
    # For a camera of which nothing is known, one last layer for all; cameras left out in turn choose its penalty.
    unit_alpha = float(features[fit].var(axis=0).mean()) * len(fit)
    folds = taught.camera[fit] % 7 % 5

    def error_at(penalty: float) -> float:
        found = np.empty_like(wanted[fit])
        for k in np.unique(folds):
            rest, these = fit[folds != k], fit[folds == k]
            one = Ridge(penalty * unit_alpha).fit(features[rest], wanted[rest])
            found[folds == k] = one.predict(features[these])
        return float(np.abs(found - wanted[fit]).mean())

    penalty = min((float(one) for one in np.logspace(-4, 2, 13)), key=error_at)
    general = Ridge(penalty * unit_alpha).fit(features[fit], wanted[fit])
    residuals = taught.gaze[aside] - (general.predict(features[aside]) * spread + centre)
    state = network.state_dict()
    state["fc.weight"] = torch.from_numpy(np.asarray(general.coef_, np.float32))
    state["fc.bias"] = torch.from_numpy(np.asarray(general.intercept_, np.float32))
    scaling = (("centre", centre), ("spread", spread), ("unit", np.array([unit])))
    state |= {f"scaling.{name}": torch.from_numpy(np.asarray(values, float)) for name, values in scaling}
    state |= unit_intervals(residuals, taught.camera[aside]).state("scaling.")
    # In order of the cameras, as one recording: whole cameras are left out in turn, and set the limit.
    generator, varied = torch.Generator().manual_seed(0), settings.augmentation
    seen = [picture_features(augment(some, varied, generator)) for some in look[places].split(64)]
    domain = fit_domain(np.concatenate(seen), np.zeros(len(fit), np.int64))
    assert domain is not None
    usual = NetworkEstimator("gaze", crop=CROP, size=SIZE, epochs=epochs, batch=BATCH, learning_rate=RATE)
    model = NetworkEstimator.from_state({**usual.parameters(), "precision": settings.precision}, state | domain.state())
    model.data_hash_ = taught.digest
    model.training_ = {
        "frames": len(taught.gaze),
        "fitted": len(fit),
        "calibrated_on": len(aside),
        "embargo": 0,
        "chosen": {"penalty": f"{penalty:.3g}: least error on training cameras left out in turn"},
        "intervals": "from cameras that trained nothing: they hold for a camera that the model has not seen",
        "centring": Rules().centring,
        "cameras": len(np.unique(taught.camera)),
        "mean": dict(zip(model.quantities, taught.gaze.mean(axis=0).tolist(), strict=True)),
    }
    none = np.abs(residuals).mean(axis=0).tolist()
    guess = np.abs(taught.gaze[aside] - taught.gaze[fit].mean(axis=0)).mean(axis=0).tolist()
    cameras_aside = len(np.unique(taught.camera[aside]))
    return model, {"cameras": cameras_aside, "frames": len(aside), "mae": none, "guess": guess, **scores}


def unit_intervals(residuals: Array, camera: NDArray[np.int64]) -> Intervals:
    """Intervals of a camera that the model has not seen: cameras are counted, and not their frames."""
    return Intervals(np.empty(0), grouped_half_width(residuals, camera)[None])


def calibrate(folder: Path, taught: Taught) -> None:
    """Set the intervals of a saved model anew by the cameras that trained nothing; all else of it stays."""
    model, card = load_model(folder), model_card(folder)
    assert isinstance(model, NetworkEstimator)
    if card["training_data"] != taught.digest:
        raise InputError("was trained on other frames", where=folder, remedy="train it again")
    aside = np.flatnonzero(taught.aside)
    look = taught.look[torch.from_numpy(aside)] / model.unit
    found = model.run(model.network_.eval(), look, torch.device("cpu"))
    centre, spread = model.scaling
    model.intervals_ = unit_intervals(taught.gaze[aside] - (found * spread + centre), taught.camera[aside])
    save_model(model, folder, metrics=card["metrics"], notes=card["notes"], half=True, overwrite=True)


def _shared(network: Network) -> LastLayer:
    """The last layer of all cameras, in training."""
    weight, bias = (one.detach().double().cpu().numpy() for one in network.head.parameters())
    return LastLayer(weight[:2], bias[:2])


def main() -> None:
    """Film, train, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("models-work") / NAME, help="keeps what a later run needs")
    parser.add_argument("--out", type=Path, default=Path("src/tapetum/models/pretrained") / NAME)
    parser.add_argument("--units", type=int, default=UNITS)
    parser.add_argument("--epochs", type=int, default=EPOCHS)
    parser.add_argument("--device", default="auto", help="that trains: auto, cpu or cuda")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1, help="that film at the same time")
    parser.add_argument("--calibrate", action="store_true", help="set only the intervals of the model in --out anew")
    options = parser.parse_args()
    keep_big_blocks()
    start = time.monotonic()
    taught = Taught.of(options.work, options.units, options.processes, bar)
    if options.calibrate:
        calibrate(options.out, taught)
        return
    device = training_device(options.device)
    model, scores = taught_network(taught, options.work, options.epochs, device, bar)
    notes = {
        "command": "make any-camera",
        "recipe": "scripts/make_any_camera.py",
        "seed": SEED,
        "cameras": options.units,
        "first_unit": FIRST_UNIT,
        "held_out_lenses": list(HELD_OUT),
        # Of this run only: after an interruption, the time since.
        "seconds": round(time.monotonic() - start),
        "simulation_only": True,
    }
    metrics = {"frames": scores["frames"], "unseen_cameras": scores}
    save_model(model, options.out, metrics=metrics, notes=notes, half=True, overwrite=True)
    print(f"saved {options.out}: {scores}")


if __name__ == "__main__":
    main()
