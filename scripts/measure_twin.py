"""Measure twins: units drawn from tolerances are filmed and labelled on the virtual bench, fitted, and compared.

    .venv/bin/python scripts/measure_twin.py thin --seeds 101 102 -o docs/numbers/twin.json

A unit of `thin` is a copy of the camera in the scene `hand-held`, one of `traced` of that in `rotation`; both are drawn
by `draw_unit`. The bench films at a fraction of the scene's error, so that its own does not pass for the camera. The
fit gets the recording, with the labels that the target's own video gives, and the scene's nominal values. Printed and
kept for each unit: by how many stated deviations each parameter is off, the misfit, and the RMS error of
`SimulationFit` on the twin for fresh frames of the true unit, over the Cramér-Rao limit. Reflectance and power act
alike, so that their product is compared. Where photosites show, their place under the spot is not known to a hundredth
of a micrometre, of the twin as of the camera: their phase is a nuisance then, of the fit and of the limit. What is done
is in the file, and the same command goes on. Seeds below 100 served development, and 108 and 112; report others.

With --known no twin is fitted: frames are read through each unit's own scene, which tells the search for the gaze apart
from errors of the twin; with --accuracy by pictures that become no finer where the search ends.

With --networks FOLDER also what the bundled network errs on the test part of 130 s of labelled film of the unit:
adapted to 100 s of that film; adapted to frames of the twin alone, no frame of the unit among them; and the latter
adapted to 10 s of the film besides. Twins and films are kept in the folder.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from measure_adapt import filmed
from measure_adapt import load as bundled
from tapetum.bench import Scene, Target, draw_unit, load_scene, scene_yaml, with_values
from tapetum.calibrate.twin import Twin, fit_twin
from tapetum.calibrate.twin.parameters import chosen
from tapetum.data import dataset_from_arrays
from tapetum.data.film_parts import film_seconds
from tapetum.data.write import Rules
from tapetum.experiments.copies import film_copy
from tapetum.experiments.pretrain import NAME
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import NetworkEstimator, SimulationFit, adapt
from tapetum.models.simulation.pictures import period_of
from tapetum.models.simulation.search import PHASE
from tapetum.progress import bar
from tapetum.record import HandMotion, Session, film, label_recording
from tapetum.simulate import expose, retroreflect, tilt_of_gaze

SCENES = {"thin": "hand-held", "traced": "rotation"}
# What `measure_adapt.py` calls films of other copies of these.
FILMS = {"thin": "another unit", "traced": "another unit of the Rotation camera"}
# By how much finer than the scene asks its units are filmed. For a thin lens nothing is left out for speed then; of
# a traced one the engine refuses much finer pictures.
FINER = {"thin": 50, "traced": 5}
# Of the unit's film that networks see, the last fifth tests; and frames of its twin.
FILM_SECONDS, TWIN_FRAMES = 130.0, 4000
# Gazes of the frames that SimulationFit reads lie within this part of the field.
_FIELD = 0.35


def unit(
    kind: str, seed: int, arguments: argparse.Namespace, fitted: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Film, fit and compare one unit; `fitted` gets what the fit tells, before fresh frames are read."""
    nominal, true, shown = drawn(kind, seed)
    session = Session(arguments.seconds, arguments.rate, seed, target_rate=arguments.target_rate)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "unit.rec"
        label_recording(film(shown, path, session, progress=bar), bar)
        start = time.process_time()
        found = fit_twin(path, nominal, frames=arguments.frames, progress=bar)
        seconds = time.process_time() - start
    if arguments.networks is not None:
        arguments.networks.mkdir(parents=True, exist_ok=True)
        with atomic_file(twin_of(arguments.networks, kind, seed)) as part:
            part.write_text(scene_yaml(found.scene), "utf-8")
    told = {
        "kind": kind,
        "seed": seed,
        "off": off(found, true, nominal),
        "untold": [one.name for one in found.untold],
        "misfit": found.misfit,
        "misfit_lit": found.misfit_lit,
        "before": found.before.misfit_lit,
        "converged": found.converged,
        "accuracy": found.options["accuracy"],
        "seconds": seconds,
    }
    fitted(told)
    return told | reading(Read.by(found), true, shown, seed, arguments.read)


def drawn(kind: str, seed: int) -> tuple[Scene, Scene, Scene]:
    """The nominal scene, that of a unit, and the unit's at the accuracy at which it is filmed."""
    nominal = load_scene(SCENES[kind])
    true = draw_unit(nominal, None, seed)
    return nominal, true, replace(true, sampling=replace(true.sampling, accuracy=true.sampling.accuracy / FINER[kind]))


def known(kind: str, seed: int, count: int, accuracy: float | None = None) -> dict[str, Any]:
    """Read fresh frames of one unit through the unit's own scene."""
    _, true, shown = drawn(kind, seed)
    start = time.process_time()
    told = reading(Read(true, accuracy=accuracy), true, shown, seed, count)
    return {"kind": kind, "seed": seed, "seconds": time.process_time() - start} | told


def off(found: Twin, true: Scene, nominal: Scene) -> dict[str, float]:
    """By how many stated deviations each parameter that is told is off."""
    assert isinstance(true.target, Target) and isinstance(nominal.target, Target)
    brighter = true.target.sensor.reflectance / nominal.target.sensor.reflectance
    deviations = np.sqrt(found.covariance.diagonal())
    parameters = chosen(nominal, None)
    told: dict[str, float] = {}
    for one, fitted, deviation in zip(parameters, found.parameters, deviations, strict=True):
        if fitted.told:
            value = one.read(true) * (brighter if one.name == "power" else 1.0)
            told[one.name] = (one.read(found.scene) - value) / float(deviation)
    return told


@dataclass(frozen=True)
class Read:
    """The scene that frames are read through, the error that readings have in common, and the pictures' accuracy."""

    scene: Scene
    systematic: tuple[float, float] = (0.0, 0.0)
    accuracy: float | None = None

    @classmethod
    def by(cls, found: Twin) -> Read:
        """As `read_by_scene` does."""
        x, y = found.systematic
        return cls(found.scene, (x, y))


def reading(by: Read, true: Scene, shown: Scene, seed: int, count: int) -> dict[str, Any]:
    """RMS error of the fit by simulation on a scene, and the Cramér-Rao limit of the true unit, for fresh frames.

    Frames are pictures of `shown`, the true unit at a finer accuracy.
    """
    if not count:
        return {}
    rng = np.random.default_rng([seed, 0xF1])
    gazes = rng.uniform(-_FIELD, _FIELD, (count, 2))
    unknown = ("power", "place_x", "place_y", *(PHASE if period_of(true) is not None else ()))
    ideal = SimulationFit(true, nuisances=unknown, starts=2, nodes=2)
    model = SimulationFit(by.scene, nuisances=unknown, starts=2, accuracy=by.accuracy, systematic=by.systematic)
    errors, limits, stated, held, misfits = [], [], [], [], []
    # Together: planning a traced lens so finely takes many seconds.
    pictures = retroreflect(shown, torch.rad2deg(torch.asin(tilt_of_gaze(true, torch.from_numpy(gazes)))))
    for number, (gaze, light) in enumerate(zip(gazes, pictures, strict=True)):
        frame = expose(replace(pictures, irradiance=light[None]), shown.probe, seed=seed * 1000 + number)[0]
        read = model.fit_image(frame)
        errors.append((read.values - gaze).tolist())
        stated.append(np.sqrt(read.covariance.diagonal()).tolist())
        misfits.append(float(read.misfit))
        held.append([bool(one) for one in (read.lower <= gaze) & (gaze <= read.upper)])
        limits.append(list(ideal.bounds((float(gaze[0]), float(gaze[1]))).values()))
    rms, limit = (float(np.sqrt(np.square(one).mean())) for one in (errors, limits))
    return {
        "read_rms": rms,
        "limit_rms": limit,
        "read_over_limit": rms / limit,
        "gazes": gazes.tolist(),
        "errors": errors,
        "stated": stated,
        "held": held,
        "misfits": misfits,
        "systematic": list(by.systematic),
    }


def twin_of(folder: Path, kind: str, seed: int) -> Path:
    return folder / f"twin-{kind}-{seed}.yaml"


def networks(kind: str, twin: Scene, seed: int, folder: Path) -> dict[str, Any]:
    """MAE [2] of the bundled network on the unit's test frames, adapted in three ways, and what its intervals hold."""
    film = filmed(folder, FILMS[kind], seed, FILM_SECONDS)
    shown, base = film.tp.test, bundled(NAME)
    told: dict[str, Any] = {}

    def score(name: str, model: NetworkEstimator) -> None:
        found, truth = model.predict(shown, anyway=True, unit="own"), shown.tp.values(base.quantities)
        held = (found.lower <= truth) & (truth <= found.upper)
        told[name] = {"mae": np.abs(found.value - truth).mean(axis=0).tolist(), "held": held.mean(axis=0).tolist()}
        print(
            f"{seed}, {name}: MAE {np.round(told[name]['mae'], 4)}, held {np.round(held.mean(axis=0), 2)}", flush=True
        )

    start = time.process_time()
    easier = with_values(twin, {"sampling.accuracy": 0.03})
    path = folder / f"frames-{kind}-{seed}-{TWIN_FRAMES}.npz"
    images, gazes = film_copy(easier, 5_000_000 + seed, TWIN_FRAMES, path, Rules(side=base.crop), HandMotion())
    labels = {"gaze_x": gazes[:, 0], "gaze_y": gazes[:, 1]}
    drawn = dataset_from_arrays(images, labels, full_scale=float(2**twin.probe.sensor.bits - 1))
    of_twin = adapt(base, drawn, device="cpu", name=NAME)
    told["processor_seconds"] = round(time.process_time() - start)
    score("frames of the twin", of_twin)
    score("and 10 s of film", adapt(of_twin, film, seconds=10, device="cpu"))
    # A frame or two without a label leave a little less.
    whole = min(100.0, film_seconds(film.tp.train))
    score("100 s of film", adapt(base, film, seconds=whole, device="cpu", name=NAME))
    return told


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The shares that the rows reach, by kind."""
    told: dict[str, Any] = {}
    for kind in SCENES:
        own = [row for row in rows if row["kind"] == kind]
        if not own:
            continue
        every = np.abs([value for row in own for value in row["off"].values()])
        told[kind] = {
            "units": len(own),
            "parameters": len(every),
            "within_3": float((every <= 3).mean()),
            "within_2": float((every <= 2).mean()),
            "worst": float(every.max()),
            "untold": sorted({name for row in own for name in row["untold"]}),
            "misfit_lit_most": max(row["misfit_lit"] for row in own),
            "read_over_limit": [row.get("read_over_limit") for row in own],
            "read_held": [float(np.mean(row["held"])) for row in own if "held" in row],
            "seconds": float(np.median([row["seconds"] for row in own])),
        }
        trained = [row["networks"] for row in own if "networks" in row]
        if trained:
            names = [name for name in trained[0] if name != "processor_seconds"]
            told[kind]["networks_mae"] = {
                name: np.mean([one[name]["mae"] for one in trained], axis=0).tolist() for name in names
            }
    return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=SCENES)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--seconds", type=float, default=30.0, help="length of the recordings")
    parser.add_argument("--rate", type=float, default=15.0, help="frames a second of the probe")
    parser.add_argument("--target-rate", type=float, default=60.0, help="frames a second of the target's camera")
    parser.add_argument("--read", type=int, default=6, help="frames that SimulationFit reads on the twin")
    parser.add_argument("--known", action="store_true", help="fit no twin: read through the units' own scenes")
    parser.add_argument("--accuracy", type=float, help="of all pictures, with --known; default: finer where it ends")
    parser.add_argument("--networks", type=Path, metavar="FOLDER", help="adapt networks to the twins, too")
    parser.add_argument("-o", "--out", type=Path, required=True)
    arguments = parser.parse_args()
    keep_big_blocks()
    options = {name: getattr(arguments, name) for name in ("frames", "seconds", "rate", "target_rate", "read")}
    rows = json.loads(arguments.out.read_text("utf-8"))["units"] if arguments.out.exists() else []
    if arguments.networks is not None and arguments.known:
        parser.error("--networks: adapts to frames of a twin, and --known fits none; leave one of them out")
    if arguments.accuracy is not None and not (arguments.known and arguments.accuracy > 0):
        parser.error(f"--accuracy: is {arguments.accuracy}; give a positive number, together with --known")
    if arguments.known and arguments.read < 1:
        parser.error("--read: --known needs frames to read; give 1 or more")
    if arguments.known != all("off" not in row for row in rows) and rows:
        parser.error(f"-o: {arguments.out} holds twins, or readings through known scenes; give another file for these")
    if arguments.known:
        for seed in arguments.seeds:
            if (arguments.kind, seed) not in [(row["kind"], row["seed"]) for row in rows]:
                rows.append(known(arguments.kind, seed, arguments.read, arguments.accuracy))
                with atomic_file(arguments.out) as part:
                    part.write_text(json.dumps({"units": rows}, indent=1) + "\n", "utf-8")
                told = f"read at {rows[-1]['read_over_limit']:.2f} of the limit, misfit {max(rows[-1]['misfits']):.3f}"
                print(f"{arguments.kind} {seed}: {told}, {rows[-1]['seconds']:.0f} s", flush=True)
        return

    def keep() -> None:
        with atomic_file(arguments.out) as part:
            part.write_text(json.dumps({"summary": summary(rows), "units": rows}, indent=1) + "\n", "utf-8")

    for seed in arguments.seeds:
        done = [row for row in rows if (row["kind"], row["seed"]) == (arguments.kind, seed)]

        def fitted(told: dict[str, Any]) -> None:
            rows.append(told | {"options": options})
            keep()

        row = done[0] if done else unit(arguments.kind, seed, arguments, fitted) | {"options": options}
        if not done:
            rows[-1] = row
            keep()
        if arguments.networks is not None and "networks" not in row:
            twin = load_scene(twin_of(arguments.networks, arguments.kind, seed))
            row["networks"] = networks(arguments.kind, twin, seed, arguments.networks)
            keep()
        if done:
            continue
        worst = max(row["off"], key=lambda name: abs(row["off"][name]))
        ratio = row.get("read_over_limit", float("nan"))
        told = (
            f"{arguments.kind} {seed}: misfit {row['misfit_lit']:.3f}, worst {worst} {row['off'][worst]:.2f} deviations"
        )
        print(f"{told}, read at {ratio:.2f} of the limit, {row['seconds']:.0f} s", flush=True)
    print(json.dumps(summary(rows), indent=1))


if __name__ == "__main__":
    main()
