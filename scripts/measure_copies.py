"""Measure how gaze and focus carry over to other copies of a camera, by the number of copies in training.

    .venv/bin/python scripts/measure_copies.py rotation --work copies-work
    .venv/bin/python scripts/measure_copies.py focusing --work copies-work

Films copies of a set's camera at gazes drawn over the set's part of the field, each copy in all of the set's videos,
and trains ResNet-18 on 1, 4 and 16 of them, with equal numbers of frames and of passes over frames. Each network is
scored on other frames of the copies that it was trained on ("same"), and on copies with other seeds ("other"). What no
retro-reflection shows of a copy, as where its point of symmetry lies, is an offset that all its frames have in common:
the errors are given with each copy's own mean error taken off, too. --causes lets the copy that the first network was
trained on differ in one thing alone, drawn from the same tolerances. --changed shows each network the first other
copies with what may tell opposite gazes apart changed: the probe's second beam turned to the opposite side, or left
out, and the sensor without its photosites. Copies and models stay in the folder, so that the same command continues an
interrupted run. The numbers go to docs/numbers/copies-SET.json, or -o.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from tapetum.bench import Scene, draw_unit, load_scene, with_values
from tapetum.bench.copies import usual_tolerances
from tapetum.bench.scene import Target
from tapetum.bench.tolerances import Tolerances
from tapetum.data import dataset_from_arrays
from tapetum.data.synth.plan import FIELDS, SETS
from tapetum.data.write import Rules
from tapetum.experiments.copies import film_copies, film_copy
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import ResNet18, load_model, save_model
from tapetum.models.epochs import PRECISIONS
from tapetum.progress import bar
from tapetum.record import HandMotion
from tapetum.simulate.hypotheses import sign_dprime

# Copies that are tested with something of the scene changed.
CHANGED = 8
# Error, in fractions of the peak, of the pictures that a best observer compares.
OBSERVED = 0.01
# Seeds of the copies of the training sets, and of those that are only tested on.
TRAIN, TEST = 4_300_000, 4_400_000
DRAWS = 1000


@dataclass(frozen=True)
class Kind:
    """What is estimated of a set's copies: `side` of the films, `crop`, `size` and `batch` of the network."""

    target: str
    names: tuple[str, ...]
    side: int
    crop: int
    size: int
    batch: int


KINDS = {
    "rotation": Kind("gaze", ("gaze_x", "gaze_y"), side=160, crop=144, size=72, batch=32),
    "focusing": Kind("focus", ("object_distance", "focal_length"), side=400, crop=400, size=80, batch=32),
}


@dataclass(frozen=True)
class Films:
    """How a set's copies are filmed: its videos' scenes and labels, and the hand."""

    kind: str
    videos: tuple[tuple[Scene, dict[str, Any]], ...]
    hand: HandMotion
    work: Path
    processes: int

    @classmethod
    def of(
        cls, kind: str, work: Path, processes: int, longest: float | None = None, changes: Sequence[str] = ()
    ) -> Films:
        """Of each label of the set once: its videos of the same camera differ in the gazes alone.

        `longest` leaves out longer focal lengths; `changes` are of the scene.
        """
        recipe = SETS[kind]
        scene = load_scene(kind, (*recipe.settings.get("paper", ()), *changes))
        labels = {json.dumps(dict(own)): dict(own) for _, own in recipe.videos}
        if longest is not None:
            labels = {key: own for key, own in labels.items() if float(own.get("focal_length", 0)) <= longest}
        placed = tuple(
            (with_values(scene, {FIELDS[key]: value for key, value in own.items()}) if own else scene, own)
            for own in labels.values()
        )
        return cls(kind, placed, HandMotion(extent=recipe.extent, sway=0.01), work, processes)

    def frames(self, seeds: Sequence[int], each: int) -> xr.Dataset:
        """Return `each` frames of each copy, as many of every video; `recording` numbers the copies."""
        side, own, parts = KINDS[self.kind].side, each // len(self.videos), []
        for number, (scene, labels) in enumerate(self.videos):
            folder, how = self.work / f"{self.kind}-{number}", {"side": side, "processes": self.processes}
            one = film_copies(scene, seeds, own, folder, motion=self.hand, progress=bar, **how)
            count = one.sizes["frame"]
            columns = {name: one[name].values for name in ("gaze_x", "gaze_y")}
            columns |= {name: np.full(count, value) for name, value in labels.items()}
            parts.append((one["image"].values, columns, one["recording"].values))
        images, recording = (np.concatenate([part[k] for part in parts]) for k in (0, 2))
        columns = {name: np.concatenate([part[1][name] for part in parts]) for name in parts[0][1]}
        # A network keeps the last tenth of each copy aside, which is to be of all its videos alike.
        order = np.lexsort((np.random.default_rng(0).random(len(recording)), recording))
        full = float(2 ** self.videos[0][0].probe.sensor.bits - 1)
        return dataset_from_arrays(
            images[order],
            {name: values[order] for name, values in columns.items()},
            full_scale=full,
            recording=recording[order],
        )


def told(model: Any, frames: xr.Dataset, names: Sequence[str]) -> dict[str, Any]:
    """MAE [K] and its 90 % interval where whole copies are drawn anew, and the same without each copy's mean error."""
    truth = frames.tp.values(tuple(names))
    found = model.predict(frames, anyway=True, unit="own", progress=bar)
    error = found.value - truth
    copies = np.asarray(frames["recording"].values)
    rows = [np.flatnonzero(copies == one) for one in np.unique(copies)]
    offset = np.array([error[own].mean(axis=0) for own in rows])
    apart = np.concatenate([error[own] - mean for own, mean in zip(rows, offset, strict=True)])
    rng = np.random.default_rng(0)
    draws = [np.concatenate([rows[n] for n in rng.integers(0, len(rows), len(rows))]) for _ in range(DRAWS)]
    spread = np.quantile([np.abs(error[one]).mean(axis=0) for one in draws], [0.05, 0.95], axis=0)
    # What an RR hardly shows of a gaze is its sign: estimates that are nearer to the opposite gaze.
    turned = np.abs(found.value + truth)
    nearer = np.hypot(*turned.T) < np.hypot(*error.T)
    sign = {
        "opposite": float(nearer.mean()),
        "opposite_by_copy": [float(nearer[own].mean()) for own in rows],
        "mae_but_for_sign": np.where(nearer[:, None], turned, np.abs(error)).mean(axis=0).tolist(),
    }
    return {
        "copies": len(rows),
        "frames": len(error),
        "mae": np.abs(error).mean(axis=0).tolist(),
        "mae_interval": spread.tolist() if len(rows) > 1 else None,
        "mae_without_offset": np.abs(apart).mean(axis=0).tolist(),
        "coverage": ((found.lower <= truth) & (truth <= found.upper)).mean(axis=0).tolist(),
        "answered": float(np.mean(found.applies)),
        "guess": np.abs(truth - truth.mean(axis=0)).mean(axis=0).tolist(),
        **(sign if "gaze_x" in names else {}),
    }


def changes_of(scene: Scene) -> dict[str, list[str]]:
    """What may tell opposite gazes apart, changed, as settings of a scene."""
    second = scene.illumination.second_beam
    assert second is not None
    x, y = second.angle
    return {
        "second beam turned": [f"illumination.second_beam.angle=[{-x} rad, {-y} rad]"],
        "no second beam": ["illumination.second_beam=null"],
        "no photosites": ["target.sensor.array=null"],
    }


def best_observers(scene: Scene) -> dict[str, float]:
    """Median d' of opposite gazes for a best observer, of a camera without tilt and decentre, changed or not.

    Such a camera is alike in both directions, so that neither its tilt nor its point of symmetry tells the sign.
    """
    straight = with_values(scene, {"target.sensor.tilt": ["0 deg", "0 deg"], "target.sensor.decentre": ["0 m", "0 m"]})
    straight = with_values(straight, {"sampling.accuracy": OBSERVED})
    changed = {
        "as they are": straight,
        "no second beam": with_values(straight, {"illumination.second_beam": None}),
        "no photosites": with_values(straight, {"target.sensor.array": None}),
        "neither": with_values(straight, {"illumination.second_beam": None, "target.sensor.array": None}),
    }
    gazes = torch.as_tensor(np.random.default_rng(0).uniform(-0.35, 0.35, (8, 2)))
    return {name: float(sign_dprime(one, gazes, accuracy=OBSERVED).median()) for name, one in changed.items()}


def _tilt(scene: Scene) -> tuple[float, float]:
    """The tilt of a scene's sensor, in radians."""
    assert isinstance(scene.target, Target)
    return scene.target.sensor.tilt


def causes(kind: str, model: Any, work: Path, copies: int, frames: int) -> list[dict[str, Any]]:
    """Score a network of the first copy on that copy with one thing drawn anew: as in other copies, in each in turn."""
    ((scene, _),) = Films.of(kind, work, 1).videos
    one, hand = draw_unit(scene, None, TRAIN), HandMotion(extent=SETS[kind].extent, sway=0.01)
    rows, usual = [], usual_tolerances(scene)
    for name in (field.name for field in fields(Tolerances)):
        alone = Tolerances(**{name: getattr(usual, name)})
        changed = [draw_unit(one, alone, seed) for seed in range(TEST, TEST + copies)]
        if all(other == one for other in changed):
            continue
        found = []
        for number, other in enumerate(bar(changed, f"filming {name}", total=copies)):
            path = work / f"{kind}-{name}-{number}-{frames}.npz"
            found.append(film_copy(other, TEST + number, frames, path, Rules(side=KINDS[kind].side), hand))
        images, gazes = (np.concatenate([film[k] for film in found]) for k in (0, 1))
        data = dataset_from_arrays(
            images,
            {"gaze_x": gazes[:, 0], "gaze_y": gazes[:, 1]},
            full_scale=float(2**scene.probe.sensor.bits - 1),
            recording=np.repeat(np.arange(copies), [len(film[0]) for film in found]),
        )
        rows.append({"differs": name, **told(model, data, KINDS[kind].names)})
        print(json.dumps(rows[-1]), flush=True)
    return rows


def measured_before(out: Path, options: argparse.Namespace) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return what holds for all rows of a file, and those that are there: further copies are added to them."""
    shared = {name: getattr(options, name) for name in ("set", "size", "precision", "longest")}
    about: dict[str, Any] = {**shared, "seeds": [TRAIN, TEST]}
    before = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
    if any(before.get(name) != value for name, value in about.items()):
        return about, []
    rows = before.pop("rows")
    return before, rows


def main() -> None:
    """Film, train, score, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set", choices=KINDS)
    parser.add_argument("--work", type=Path, default=Path("copies-work"))
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 4, 16], help="copies in the training sets")
    parser.add_argument("--frames", type=int, default=6400, help="frames of a training set, of all its copies together")
    parser.add_argument("--passes", type=int, default=100_000, help="passes over frames of each training")
    parser.add_argument("--tested", type=int, default=8, help="copies to test on")
    parser.add_argument("--test-frames", type=int, default=72, help="frames of each copy that are tested on")
    parser.add_argument("--longest", type=float, help="leave longer focal lengths out, in metres")
    parser.add_argument("--size", type=int, help="side of the networks' images; the page's by default")
    parser.add_argument("--precision", choices=PRECISIONS, default="float32", help="of the networks' products")
    parser.add_argument("--processes", type=int, default=1, help="that film")
    parser.add_argument("--causes", type=int, default=0, help="copies that differ in one thing, of each thing")
    parser.add_argument("--changed", action="store_true", help="test with what may tell the sign of a gaze changed")
    parser.add_argument("--films", action="store_true", help="only film")
    parser.add_argument("-o", "--out", type=Path)
    options = parser.parse_args()
    if options.changed and options.set != "rotation":
        parser.error("--changed is of rotation")
    if options.causes and (options.set != "rotation" or 1 not in options.copies):
        parser.error("--causes is of rotation and a network of one copy")
    keep_big_blocks()
    kind, out = KINDS[options.set], options.out or Path(f"docs/numbers/copies-{options.set}.json")
    size = options.size or kind.size
    films = Films.of(options.set, options.work, options.processes, options.longest)
    least = min(options.test_frames, options.frames // max(options.copies))
    if not 0 < len(films.videos) <= least:
        parser.error(f"{len(films.videos)} videos want as many frames of each copy at least, and get {least}")
    other = films.frames(range(TEST, TEST + options.tested), options.test_frames)
    about, rows = measured_before(out, options)
    changed: dict[str, xr.Dataset] = {}
    if options.causes:
        scene, seeds = films.videos[0][0], {"trained": range(TRAIN, TRAIN + max(options.copies))}
        seeds["tested"] = range(TEST, TEST + options.tested)
        about["tilts"] = {
            what: [list(_tilt(draw_unit(scene, None, one))) for one in own] for what, own in seeds.items()
        }
    if options.changed:
        scene = films.videos[0][0]
        first = range(TEST, TEST + min(CHANGED, options.tested))
        about["dprime"] = best_observers(scene)
        changed["as they are"] = films.frames(first, options.test_frames)
        for name, settings in changes_of(scene).items():
            folder = options.work / name.replace(" ", "-")
            with_it = Films.of(options.set, folder, options.processes, changes=settings)
            changed[name] = with_it.frames(first, options.test_frames)
    for count in options.copies:
        each = options.frames // count
        whole = films.frames(range(TRAIN, TRAIN + count), each + options.test_frames)
        # The first frames of each copy, in an order that was drawn, are tested on.
        copies, share = np.asarray(whole["recording"].values), options.test_frames / (each + options.test_frames)
        tested = np.zeros(len(copies), bool)
        for one in np.unique(copies):
            own = np.flatnonzero(copies == one)
            tested[own[: round(len(own) * share)]] = True
        train, same = (whole.isel(frame=np.flatnonzero(mask)) for mask in (~tested, tested))
        if options.films:
            continue
        path = options.work / f"model-{options.set}-{count}-{options.frames}-{options.passes}-{size}"
        if not path.exists():
            epochs = max(1, round(options.passes / train.sizes["frame"]))
            model = ResNet18(
                kind.target,
                crop=kind.crop,
                size=size,
                epochs=epochs,
                batch=kind.batch,
                precision=options.precision,
            )
            kept = path.with_suffix(".part")
            save_model(model.fit(train, progress=bar, checkpoint=kept, resume=kept.exists(), on_epoch=print), path)
        model = load_model(path)
        rows = [row for row in rows if row["copies"] != count]
        rows.append({"copies": count, "training_frames": train.sizes["frame"], "passes": options.passes})
        rows[-1] |= {"same": told(model, same, kind.names), "other": told(model, other, kind.names)}
        if changed:
            rows[-1]["changed"] = {name: told(model, frames, kind.names) for name, frames in changed.items()}
        print(json.dumps(rows[-1]), flush=True)
        if options.causes and count == 1:
            about["causes"] = causes(options.set, model, options.work, options.causes, options.test_frames)
        with atomic_file(out) as part:
            found = {**about, "rows": sorted(rows, key=lambda row: row["copies"])}
            part.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
