"""Measure how much film of a new camera a model needs: learning curves over seconds of labelled video.

For every kind of camera and every unit (a seed of its tolerances) one video is filmed on the virtual bench and labelled
by the laser in its own pictures; its end tests. Compared are a bundled network adapted by `tapetum.models.adapt`, with
frames spread over the field or the first in a row; a ResNet-18 trained from scratch on the same spread frames; and the
tuned ridge. Each result is a file of its own in the work folder, so that an interrupted run goes on; --write gathers
them all into docs/numbers/adapt.json and a picture.

Unit seeds from 900000 on were used to develop the adaptation: report others.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from tapetum.bench import Scene, draw_unit, load_scene
from tapetum.data import open_dataset
from tapetum.data.film_parts import first_seconds, spread_over
from tapetum.data.synth import Plan, Video, synthesise
from tapetum.data.write import Rules
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import NetworkEstimator, Predictor, ZernikeRidge, adapt, load_model, pretrained
from tapetum.progress import bar
from tapetum.record import HandMotion, Session
from tapetum.simulate.hypotheses import point_of_symmetry

KINDS: dict[str, tuple[str, tuple[str, ...], float]] = {
    # The scene, what is changed of it, and the largest gaze.
    "another unit": ("hand-held", ("sampling.accuracy=0.03",), 0.48),
    "another unit of the Rotation camera": ("rotation", (), 0.48),
    "another catalogue lens": (
        "rotation",
        ("target.lens.name=zoom-5-15mm", "target.lens.focal_length=8 mm"),
        0.48,
    ),
    "a lens in no training set": (
        "rotation",
        ("target.lens.name=compact-6mm-f1.9", "target.lens.focal_length=null"),
        0.48,
    ),
    "a plausible other unit": (
        "hand-held",
        (
            "sampling.accuracy=0.03",
            "target.sensor.tilt=[0.2 deg, 0.1 deg]",
            "target.sensor.decentre=[0.1 mm, 0 mm]",
            "target.object_distance=5.2 m",
            "target.lens.aperture_radius=3.8 mm",
            "illumination.second_beam.ratio=0.07",
        ),
        0.48,
    ),
    "one metre farther": (
        "hand-held",
        ("sampling.accuracy=0.03", "distance=6.5 m", "target.object_distance=6.5 m"),
        0.48,
    ),
}
# Of these the camera is as it is described and no copy is drawn; the number sets the film alone.
AS_DESCRIBED = ("a plausible other unit", "one metre farther")
NUMBERS = Path("docs/numbers/adapt.json")
NAMES = ("gaze_x", "gaze_y")
SIDE = 320
RATE = 15.0
SCALES = (80, 160, 240, 320)
# A training from scratch gets as many passes as an adaptation, at least.
PASSES = 6000
# Between the seeds of two films of a unit.
APART = 500_000
# Of the field: an estimate that is farther off counts as far, and as the opposite gaze, about the camera's point of
# symmetry, where it is that near to it.
FAR = 0.1
# Degrees to the slope by which gazes are counted that lie more than this from the point of symmetry.
ANGLES, OUT = ((0, 30), (30, 60), (60, 75), (75, 90)), 0.25


@dataclass(frozen=True)
class Wanted:
    """One measurement: a kind of camera, its unit, what learns, from which model, of how many seconds chosen how."""

    kind: str
    unit: int
    method: str
    base: str
    seconds: float
    spread: bool
    films: int = 1

    @property
    def key(self) -> str:
        how = "spread" if self.spread else "row"
        words = [self.kind, str(self.unit), self.method, Path(self.base).name or "none", f"{self.seconds:g}", how]
        if self.films > 1:
            words.append(f"{self.films} films")
        return "--".join(word.replace(" ", "-") for word in words)


def unit_scene(kind: str, unit: int) -> Scene:
    name, changes, _ = KINDS[kind]
    scene = load_scene(name, changes)
    return scene if kind in AS_DESCRIBED else draw_unit(scene, None, unit)


def filmed(work: Path, kind: str, unit: int, seconds: float, films: int = 1) -> xr.Dataset:
    """Film one unit, so often, or open the set where it was filmed before."""
    videos = []
    for k in range(films):
        session = Session(seconds, RATE, seed=70_000 + unit + k * APART, motion=HandMotion(extent=KINDS[kind][2]))
        name = f"unit-{unit}" if films == 1 else f"unit-{unit}-{k}"
        videos.append(Video(name, unit_scene(kind, unit), session))
    plan = Plan("adapt", "laptop", unit, tuple(videos), Rules(side=SIDE))
    path = work / f"{kind.replace(' ', '-')}-{unit}-{plan.digest[:8]}.zarr"
    if not path.exists():
        synthesise(plan, path, progress=bar)
    return open_dataset(path)


def shared(data: xr.Dataset, seconds: float, spread: bool) -> xr.Dataset:
    """Return so many seconds of the training frames, those that `adapt` chooses."""
    train = data.tp.train
    count = first_seconds(train, seconds)
    places = spread_over(train.tp.values(NAMES), count, 0) if spread else np.arange(count)
    return train.isel(frame=places)


def learned(one: Wanted, data: xr.Dataset, precision: str) -> Predictor:
    if one.method == "base":
        return load(one.base)
    if one.method == "adapt":
        return adapt(load(one.base), data, seconds=one.seconds, spread=one.spread, precision=precision, name=one.base)
    part = shared(data, one.seconds, one.spread)
    if one.method == "ridge":
        return ZernikeRidge("gaze", scales=SCALES, alpha="cv", standardise=True, calibration_fraction=0.15).fit(part)
    epochs = max(12, min(80, PASSES // part.sizes["frame"]))
    return NetworkEstimator("gaze", epochs=epochs, precision=precision, device="cpu").fit(part)


def load(base: str) -> NetworkEstimator:
    model = load_model(base) if Path(base).is_dir() else pretrained(base)
    assert isinstance(model, NetworkEstimator)
    model.device = "cpu"
    return model


def scored(one: Wanted, data: xr.Dataset, precision: str) -> dict[str, Any]:
    start, begun = time.process_time(), time.perf_counter()
    model = learned(one, data, precision)
    took, passed = time.process_time() - start, time.perf_counter() - begun
    test = data.tp.test
    # All methods read the end of the first film.
    test = test.isel(frame=np.flatnonzero(test["recording"].values == 0))
    found, truth = model.predict(test, anyway=True), test.tp.values(NAMES)
    error, answered = np.abs(found.value - truth), found.applies
    held = (found.lower <= truth) & (truth <= found.upper)

    def mean(values: np.ndarray, of: np.ndarray) -> list[float] | None:
        return values[of].mean(axis=0).tolist() if of.any() else None

    everything = np.ones(len(truth), bool)
    width = np.median(found.upper - found.lower, axis=0)
    chosen = (getattr(model, "training_", None) or {}).get("chosen") or {}
    return {
        **one.__dict__,
        "base": Path(one.base).name,
        "frames": len(truth),
        "mae": mean(error, everything),
        "held": mean(held, everything),
        "answered": float(answered.mean()),
        "mae_answered": mean(error, answered),
        "held_answered": mean(held, answered),
        **misses(found.value, truth, unit_scene(one.kind, one.unit)),
        "width": width.tolist() if np.isfinite(width).all() else None,
        # A model as it is does not know this copy of the camera.
        "intervals": found.unit,
        "processor_seconds": round(took, 1),
        "seconds_passed": round(passed, 1),
        "chosen": chosen.get("fitted"),
        "residuals": chosen.get("residuals"),
    }


def misses(value: np.ndarray, truth: np.ndarray, scene: Scene) -> dict[str, Any]:
    """Which share of gazes [N, 2] is far off, and which comes out as the opposite one; the median error, and the mean
    of those not far off; of a sloping sensor, also the share that is far off by the angle to the slope."""
    from_middle, error = truth - point_of_symmetry(scene).numpy(), np.abs(value - truth)
    far = error.max(axis=1) > FAR
    opposite = far & (np.abs(value - truth + 2 * from_middle).max(axis=1) <= FAR)
    told: dict[str, Any] = {
        "far": float(far.mean()),
        "opposite": float(opposite.mean()),
        "median": np.median(error, axis=0).tolist(),
        "mae_but_far": error[~far].mean(axis=0).tolist() if not far.all() else None,
    }
    slope = np.array(scene.target.sensor.tilt)
    if slope.any():
        along, out = np.abs(from_middle @ slope), np.linalg.norm(from_middle, axis=1)
        angle = np.degrees(np.arccos(np.clip(along / np.maximum(out * np.linalg.norm(slope), 1e-12), 0, 1)))
        for least, most in ANGLES:
            there = (angle >= least) & (angle <= most) & (out > OUT)
            told[f"far_at_{least}_to_{most}"] = float(far[there].mean()) if there.any() else None
    return told


def measurements(options: argparse.Namespace) -> Iterator[Wanted]:
    for kind in options.kinds:
        for unit in options.units:
            for base in options.bases:
                yield Wanted(kind, unit, "base", base, 0.0, True)
                for seconds in options.seconds:
                    yield Wanted(kind, unit, "adapt", base, seconds, True, options.films)
                    if options.row and seconds <= options.row:
                        yield Wanted(kind, unit, "adapt", base, seconds, False)
            for seconds in options.seconds:
                yield Wanted(kind, unit, "ridge", "", seconds, True)
                if seconds in options.scratch:
                    yield Wanted(kind, unit, "scratch", "", seconds, True)


def gathered(work: Path) -> list[dict[str, Any]]:
    return [json.loads(path.read_text(encoding="utf-8")) for path in sorted((work / "results").glob("*.json"))]


def table(rows: list[dict[str, Any]]) -> str:
    """Return the mean over units of every measurement as Markdown: MAE x / y, what the intervals hold, refused."""
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for row in rows:
        how = (row["kind"], row["method"], row["base"], row["spread"], row["seconds"], row.get("films", 1))
        groups.setdefault(how, []).append(row)
    lines = [
        "| camera | method | film | units | MAE x / y | intervals hold | answered |",
        "|---|---|--:|--:|---|--:|--:|",
    ]
    for (kind, method, base, spread, seconds, films), own in sorted(groups.items()):
        mae = np.mean([one["mae"] for one in own], axis=0)
        held = 100 * np.mean([one["held"] for one in own])
        answered = 100 * np.mean([one["answered"] for one in own])
        name = f"{method} {base}".strip() + ("" if spread else ", in a row") + (f", of {films} films" * (films > 1))
        said = f"{mae[0]:.4f} / {mae[1]:.4f} | {held:.0f} % | {answered:.0f} %"
        lines.append(f"| {kind} | {name} | {seconds:g} s | {len(own)} | {said} |")
    return "\n".join(lines)


def picture(rows: list[dict[str, Any]], out: Path) -> None:
    """Draw the error over seconds of film, one panel for each kind of camera."""
    from matplotlib.figure import Figure

    kinds = [kind for kind in KINDS if any(row["kind"] == kind for row in rows)]
    figure = Figure(figsize=(4.2 * len(kinds), 3.4), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(kinds), sharey=True))
    # A name has one colour in all panels.
    colours: dict[str, str] = {}
    for panel, kind in zip(panels, kinds, strict=True):
        curves: dict[str, dict[float, list[float]]] = {}
        for row in rows:
            if row["kind"] != kind or row.get("films", 1) > 1:
                continue
            name = {"scratch": "ResNet-18 from scratch", "ridge": "tuned ridge"}.get(row["method"])
            name = name or f"{row['base']} adapted{'' if row['spread'] else ', in a row'}"
            # Where nothing was filmed yet, the model as it is.
            at = max(row["seconds"], 1.5)
            curves.setdefault(name, {}).setdefault(at, []).append(float(np.mean(row["mae"])))
        for name, points in sorted(curves.items()):
            x = sorted(points)
            colour = colours.setdefault(name, f"C{len(colours)}")
            panel.plot(x, [np.mean(points[one]) for one in x], "o-", color=colour, label=name)
            panel.plot([one for one in x for _ in points[one]], [y for one in x for y in points[one]], ".", color="0.7")
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_xticks([1.5, 5, 10, 30, 100], ["0", "5", "10", "30", "100"])
        panel.minorticks_off()
        panel.set_title(kind)
        panel.set_xlabel("seconds of labelled film")
        panel.grid(alpha=0.3)
        panel.legend(fontsize=7)
    panels[0].set_ylabel("MAE, fractions of the field")
    with atomic_file(out) as part:
        figure.savefig(part, dpi=110)


def main() -> None:
    """Measure what is missing; print the table; with --write keep it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--units", nargs="*", type=int, default=[])
    parser.add_argument("--film", type=float, default=130.0, help="seconds filmed of each unit; the last fifth tests")
    parser.add_argument("--films", type=int, default=1, help="films over which what is adapted to is spread")
    parser.add_argument("--seconds", nargs="*", type=float, default=[5, 10, 30, 100])
    parser.add_argument(
        "--scratch", nargs="*", type=float, default=[5, 10, 30, 100], help="seconds trained from scratch"
    )
    parser.add_argument("--row", type=float, default=0, help="adapt to frames in a row too, up to so many seconds")
    parser.add_argument("--bases", nargs="*", default=["thin-lens-gaze"])
    parser.add_argument("--precision", default="float32", choices=["float32", "bf16"])
    parser.add_argument("--work", type=Path, default=Path("adapt-work"))
    parser.add_argument(
        "--write", action="store_true", help="write --numbers, and the picture of docs/numbers/adapt.json"
    )
    parser.add_argument("--numbers", type=Path, default=NUMBERS)
    options = parser.parse_args()
    if options.films < 1:
        parser.error(f"--films {options.films}: adapt to one film or more")
    keep_big_blocks()
    results = options.work / "results"
    results.mkdir(parents=True, exist_ok=True)
    for one in measurements(options):
        path = results / f"{one.key}.json"
        if path.exists():
            continue
        data = filmed(options.work, one.kind, one.unit, options.film, one.films)
        found = scored(one, data, options.precision)
        with atomic_file(path) as part:
            told = {"precision": options.precision, "film_seconds": options.film}
            part.write_text(json.dumps(found | told) + "\n", encoding="utf-8")
        print(one.key, np.round(found["mae"], 4), "held", np.round(found["held"], 2), found["answered"], flush=True)
    rows = gathered(options.work)
    print(table(rows))
    if options.write:
        about = {"units": sorted({row["unit"] for row in rows}), "rows": rows}
        with atomic_file(options.numbers) as part:
            part.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
        if options.numbers == NUMBERS:
            picture(rows, Path("docs/images/adapt-curves.png"))


if __name__ == "__main__":
    main()
