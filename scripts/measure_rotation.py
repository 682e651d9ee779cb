"""Measure how near ResNet-18 comes to the Cramér-Rao limit on Rotation sets of target cameras of several rates.

    .venv/bin/python scripts/measure_rotation.py --work rotation-work --rates 15 60

For each rate of the target camera, which is how often the gaze is labelled, the Rotation set is filmed and the paper
page's models are trained on it; what Fig. 10 says of them goes to docs/numbers/rotation-rates.json, or -o. Sets,
checkpoints and models stay in the folder, so that the same command continues an interrupted run. The network takes the
page's epochs in single precision unless --epochs or --precision say otherwise, and carries residuals to frames that
look alike with --interpolate.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from tapetum.data import open_dataset
from tapetum.data.synth import make_plan, synthesise
from tapetum.experiments import RECIPES, SIZES, Workshop
from tapetum.experiments.learning import fig10
from tapetum.experiments.workshop import SET_SEED
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import NetworkEstimator
from tapetum.models.epochs import PRECISIONS, EpochReport
from tapetum.progress import bar


def changed(epochs: int | None, precision: str, interpolate: bool) -> None:
    """Give the page's ResNet-18 other epochs or another precision, or let it interpolate residuals."""
    name = "rotation-resnet18"
    recipe = RECIPES[name]

    def make(size: str) -> NetworkEstimator:
        model = recipe.make(size)
        assert isinstance(model, NetworkEstimator)
        own = {"precision": precision, "interpolate": interpolate, **({} if epochs is None else {"epochs": epochs})}
        return type(model)(**{**model.parameters(), **own})

    RECIPES[name] = replace(recipe, make=make)


def measured(rate: float, size: str, work: Path, processes: int) -> dict[str, Any]:
    """Return what Fig. 10 says of the set that a target camera of `rate` frames a second labels."""
    place = work / f"rotation-{size}-{rate:g}.zarr"
    if not place.exists():
        plan = make_plan("rotation", size, SET_SEED).with_target_rate(rate)
        synthesise(plan, place, processes=processes, progress=bar)
    dataset = open_dataset(place)
    workshop = Workshop(work, size, sets={"rotation": dataset}, progress=bar, on_epoch=_say)
    _, numbers = fig10(workshop)
    return {"rate": rate, "frames": dataset.sizes["frame"], "test": dataset.tp.test.sizes["frame"], **numbers}


def _say(report: EpochReport) -> None:
    print(report, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True, help="folder of sets and models")
    parser.add_argument("--rates", type=float, nargs="+", default=[15.0, 60.0], help="of the target camera, per second")
    parser.add_argument("--size", choices=SIZES, default="paper")
    parser.add_argument("--processes", type=int, default=2, help="that film")
    parser.add_argument("--epochs", type=int, help="of the network; the page's by default")
    parser.add_argument("--precision", choices=PRECISIONS, default="float32", help="of the network's products")
    parser.add_argument("--interpolate", action="store_true", help="residuals, as `tapetum train --interpolate`")
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/numbers/rotation-rates.json"))
    options = parser.parse_args()
    keep_big_blocks()
    changed(options.epochs, options.precision, options.interpolate)
    options.work.mkdir(parents=True, exist_ok=True)
    rows = [measured(rate, options.size, options.work, options.processes) for rate in options.rates]
    with atomic_file(options.out) as part:
        told = {name: getattr(options, name) for name in ("size", "epochs", "precision", "interpolate")}
        part.write_text(json.dumps({**told, "seed": SET_SEED, "rows": rows}, indent=1) + "\n")
    for row in rows:
        centre = row["centre"]
        print(
            f"{row['rate']:g} frames/s, centre half: labels {centre['label_rmse']:.2g} of the field, ResNet-18 "
            f"{centre['rmse']:.2g}, {centre['over_limit']:.1f} times the limit"
        )


if __name__ == "__main__":
    main()
