"""The engine against the judge on random scenes: each agrees within what it states, or is refused.

    python -m tests.references.compare --seed 1 --count 100 -o compare.jsonl

One JSON line a scene: what was drawn, the error over what the engine states, the judge's own convergence. A run that
was stopped goes on where it was. The summary is printed at the end, and by `--summary` alone.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tapetum.bench import Scene
from tapetum.bench.load import scene_from_dict
from tapetum.errors import InputError
from tapetum.simulate import retroreflect
from tapetum.simulate.gaze import largest_sine
from tapetum.simulate.phone import open_camera

from .draw import KINDS, draw
from .judge import Effort, TooLargeError, judge, pixel_places

__all__ = ["compared", "planned_for_many", "summary"]

# The judge's own change, with twice the points, may be so much of what the engine states, or of how far they differ.
_OWN = 0.2
# The judge is made for claims no wider than this.
_ROUGHEST = 0.01
# Below this share of the brightest return that the aperture could send a picture counts as dark.
_DARK = 1e-10
# Pictures for which planning a traced lens takes its time.
_MANY = 1000
# Pixels of a traced lens's picture besides the bright ones, in fractions of its height and width.
_SPREAD = np.array([[0.3, 0.3], [0.25, 0.7], [0.7, 0.35], [0.65, 0.65], [0.45, 0.6], [0.55, 0.4], [0.1, 0.5]])


def compared(kind: str, plain: dict[str, Any]) -> dict[str, Any]:
    """One scene's line: `outcome` is agrees, differs, unclaimed (it states no error), refused or too large."""
    line: dict[str, Any] = {"kind": kind, "scene": plain}
    started = time.perf_counter()
    try:
        scene = scene_from_dict(plain)
        image = retroreflect(scene)
        traced = plain["target"]["lens"]["kind"] == "prescription"
        # The samples that serve many pictures count like those of one.
        many = planned_for_many(scene) if traced else None
    except InputError as error:
        return {**line, "outcome": "refused", "message": str(error), "seconds": time.perf_counter() - started}
    found = image.numpy()[0]
    way = str(image.metadata["propagation"])
    claims = {"accuracy": scene.sampling.accuracy, "expected": float(image.metadata["expected_error"])}
    # What it states of this picture; where it states nothing, as of one that hardly exists, what was asked for, and a
    # difference is counted apart.
    stated = math.isfinite(claims["expected"])
    claim = claims["expected"] if stated else claims["accuracy"]
    line |= {"way": way, "claims": claims, "engine_seconds": time.perf_counter() - started}
    rows, columns = np.indices(found.shape)
    places = pixel_places(
        columns.ravel().astype(float), rows.ravel().astype(float), scene.probe.sensor.pixels, scene.probe.sensor.pitch
    )
    if many is not None:
        # Each pixel has rays of its own: a few, the brightest one among them.
        chosen = _few(found)
        places, found = places[chosen], found.ravel()[chosen]
        many = many[0].ravel()[chosen], many[1]
    # Where next to nothing returns: fractions of what the whole aperture would send into one point.
    lens, light = scene.target.lens, scene.illumination
    ideal = (math.pi * lens.aperture_radius**2 / (light.wavelength * scene.probe.lens.focal_length)) ** 2
    dark = _DARK * ideal * float(image.metadata["irradiance_at_target"])
    # A claim of a faint picture may be wide, and a judge as rough would see another picture, and twice the same one.
    effort, own = Effort.of(min(claim, _ROUGHEST)), math.inf
    finite = way.startswith("finite")
    try:
        # The larger sum first: where it is too large nothing is lost.
        seen = judge(scene, places, finite, effort.more())
        own = _apart(judge(scene, places, finite, effort), seen, dark)
        error = _apart(found.ravel(), seen, dark)
        if own > _OWN * max(claim, error):
            before, seen = seen, judge(scene, places, finite, effort.more().more())
            own = _apart(before, seen, dark)
            error = _apart(found.ravel(), seen, dark)
        if error > claim and own <= _OWN * error and seen.max() >= dark:
            # Sums over more and more rings swing to and fro, and hardly change where they turn.
            before, seen = seen, judge(scene, places, finite, effort.more().farther())
            own = max(own, _apart(before, seen, dark))
            error = _apart(found.ravel(), seen, dark)
    except TooLargeError as error:
        line["seconds"] = time.perf_counter() - started
        return {**line, "outcome": "too large", "message": str(error), "own": own if math.isfinite(own) else None}
    changing = own * dark > _OWN * seen.max()
    if seen.max() < dark < found.max() and (changing or not seen.any()):
        # The judge sums over some rings of a traced lens's spot: a sensor or mask far beside them is dark to it, or
        # reached by their faded end alone, and then what it sees of it changes with their number.
        line |= {"outcome": "too large", "message": "the judge's rings do not reach what reflects", "own": own}
        return {**line, "seconds": time.perf_counter() - started}
    if own > _OWN * max(claim, error):
        line |= {"outcome": "too large", "message": f"the judge itself changes by {own:.2g} of the peak", "own": own}
        return {**line, "seconds": time.perf_counter() - started}
    if many is not None and (other := _apart(many[0], seen, dark)) / many[1] > error / claim:
        (found, claim), error = many, other
        claims["expected_of_many"] = claim
    return {
        **line,
        "outcome": "agrees" if error <= claim else "differs" if stated else "unclaimed",
        "error": error,
        "ratio": error / claim,
        "ratio_asked": error / claims["accuracy"],
        "own": own,
        "peak": float(seen.max()),
        "peak_ratio": float(found.max() / max(seen.max(), dark)),
        "seconds": time.perf_counter() - started,
    }


def planned_for_many(scene: Scene) -> tuple[np.ndarray, float]:
    """The picture [H, W] of a traced lens that was planned for many, and its claim."""
    sines = torch.sin(torch.tensor([scene.target.rotation], dtype=torch.float64))
    camera = open_camera(scene, largest_sine(sines), pictures=_MANY)
    picture = camera(sines)[0].double().cpu().numpy()
    expected = float(camera.metadata()["expected_error"])
    return picture, expected if math.isfinite(expected) else scene.sampling.accuracy


def _apart(one: np.ndarray, other: np.ndarray, dark: float) -> float:
    """Largest difference over the other's peak."""
    return float(np.abs(one - other).max() / max(other.max(), dark))


def _few(found: np.ndarray) -> np.ndarray:
    """The brightest pixel, some bright ones, the middle, and a coarse grid."""
    rows, columns = found.shape
    order = np.argsort(found.ravel())[::-1]
    places = {int(order[i]) for i in (0, rows // 2, 2 * rows, 5 * rows)} | {rows // 2 * columns + columns // 2}
    places |= {int(r * columns + c) for r, c in _SPREAD * (rows, columns) // 1}
    return np.array(sorted(places))


def summary(lines: list[dict[str, Any]]) -> str:
    """The distribution of error over claim, the worst scenes, and what was refused or too large, by kind."""
    by: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for line in lines:
        by[line["outcome"]].append(line)
    judged = by["agrees"] + by["differs"]
    text = [f"{len(lines)} scenes: " + ", ".join(f"{len(by[one])} {one}" for one in _OUTCOMES)]
    if judged:
        ratios = np.array([line["ratio"] for line in judged])
        parts = ", ".join(f"{name} {np.quantile(ratios, q):.2g}" for name, q in _QUANTILES)
        text.append(f"error over claim of {len(judged)} judged: {parts}, largest {ratios.max():.3g}")
        more = [line for line in judged if line["claims"]["expected"] > line["claims"]["accuracy"]]
        asked = sum(line["ratio_asked"] > 1 for line in more)
        text.append(f"{len(more)} state an error larger than the accuracy asked for; {asked} have one")
    text += [
        "",
        "| kind | agree | differ | nothing stated | refused | too large | median | largest |",
        "|---|" + 7 * "--:|",
    ]
    for kind in KINDS:
        own = [line for line in lines if line["kind"] == kind]
        if not own:
            continue
        counts = [sum(line["outcome"] == one for line in own) for one in _OUTCOMES]
        ratios = [line["ratio"] for line in own if "ratio" in line]
        shown = [f"{np.median(ratios):.2g}", f"{max(ratios):.2g}"] if ratios else ["", ""]
        text.append("| " + " | ".join([kind, *map(str, counts), *shown]) + " |")
    worst = sorted(by["differs"], key=lambda line: -line["ratio"])
    text += [""] + [f"{line['number']:4d} {line['kind']}: {line['ratio']:.3g} times its claim" for line in worst]
    refusals: dict[str, int] = defaultdict(int)
    for line in by["refused"]:
        refusals[f"{line['kind']}: {line['message'][:150]}"] += 1
    return "\n".join(text + [""] + [f"{count} × {what}" for what, count in sorted(refusals.items())])


_OUTCOMES = ("agrees", "differs", "unclaimed", "refused", "too large")
_QUANTILES = (("median", 0.5), ("90 %", 0.9), ("95 %", 0.95))


def main() -> int:
    """Run or go on with a comparison; 1 where a scene differs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--count", type=int, default=200, help="scenes that the judge can do or the engine refuses")
    parser.add_argument("--kinds", help="only kinds that hold this text")
    what = "only the first so many kinds take turns: 24 for the seeds drawn before masks behind traced lenses, "
    what += "25 for those before traced lenses through the probe's aperture were, 26 for those before most missed it"
    parser.add_argument("--first", type=int, default=len(KINDS), help=what)
    parser.add_argument("--numbers", help="only these scenes, as 3,17")
    parser.add_argument("--summary", action="store_true", help="print the summary of what there is")
    parser.add_argument("-o", "--out", type=Path, required=True)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    lines = [json.loads(text) for text in asked.out.read_text().splitlines()] if asked.out.exists() else []
    kinds = KINDS[: asked.first]
    done, number = {line["number"] for line in lines}, 0
    some = None if asked.numbers is None else [int(one) for one in asked.numbers.split(",")]
    folder = asked.out.with_suffix(".masks")
    while not asked.summary:
        # A scene too large for the judge is drawn again, and counted.
        if sum(line["outcome"] != "too large" for line in lines) >= (asked.count if some is None else len(some)):
            break
        if some is not None and number > max(some):
            break
        wanted = some is None or number in some
        if wanted and number not in done and (asked.kinds is None or asked.kinds in kinds[number % len(kinds)]):
            folder.mkdir(parents=True, exist_ok=True)
            kind, plain = draw(asked.seed, number, folder, kinds)
            line = {"number": number, "seed": asked.seed, **compared(kind, plain)}
            lines.append(line)
            with asked.out.open("a") as file:
                file.write(json.dumps(line) + "\n")
            shown = {"ratio": "ratio", "refused": "message", "too large": "message"}.get(line["outcome"], "ratio")
            print(f"{number:4d} {kind}: {line['outcome']} {line.get(shown, '')!s:.100}", file=sys.stderr, flush=True)
        number += 1
    print(summary(lines))
    return int(any(line["outcome"] == "differs" for line in lines))


if __name__ == "__main__":
    sys.exit(main())
