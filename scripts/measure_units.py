"""Measure what the bundled model's intervals hold on copies of its camera that it has not seen.

Films copies of its scene with seeds that calibrated nothing, and writes docs/numbers/other-units.json. Seeds from
3,000,000 to 3,000,119 calibrated the intervals.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from tapetum.bench import load_scene
from tapetum.experiments.copies import film_copies
from tapetum.experiments.pretrain import COPY_ACCURACY, CROP, NAME, SCENE, UNIT_FRAMES, UNIT_SEEDS
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import pretrained
from tapetum.progress import bar


def held_by(data: xr.Dataset, unit: str) -> dict[str, Any]:
    """Return shares [x, y] of the frames whose gaze the intervals of `unit` hold, all and those answered."""
    model = pretrained(NAME)
    found, truth = model.predict(data, anyway=True, unit=unit), data.tp.values(model.quantities)
    held, answered = (found.lower <= truth) & (truth <= found.upper), found.applies
    number = np.asarray(data["recording"].values)
    each = {int(n): number == n for n in np.unique(number)}
    equal = [held[own & answered].mean(axis=0) for own in each.values() if (own & answered).any()]
    width = (found.upper - found.lower)[answered] / 2
    return {
        "frames": len(truth),
        "answered": float(answered.mean()),
        "held": held.mean(axis=0).tolist(),
        "held_answered": held[answered].mean(axis=0).tolist(),
        "held_answered_copies_equal": np.mean(equal, axis=0).tolist(),
        "held_by_copy": [held[own].mean(axis=0).tolist() for own in each.values()],
        "mae_answered": np.abs(truth - found.value)[answered].mean(axis=0).tolist(),
        "half_width_median_answered": np.median(width, axis=0).tolist(),
    }


def main() -> None:
    """Film, score, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=UNIT_SEEDS[-1] + 1, help="seed of the first copy")
    parser.add_argument("--units", type=int, default=20)
    parser.add_argument("--work", type=Path, default=Path("models-work"))
    options = parser.parse_args()
    if options.first < UNIT_SEEDS.stop and options.first + options.units > UNIT_SEEDS.start:
        parser.error("these copies calibrated the intervals")
    keep_big_blocks()
    torch.set_num_threads(1)
    scene = load_scene(SCENE, [f"sampling.accuracy={COPY_ACCURACY}"])
    seeds = range(options.first, options.first + options.units)
    data = film_copies(scene, seeds, UNIT_FRAMES, options.work / "copies", side=CROP, progress=bar)
    numbers = {"seeds": [seeds[0], seeds[-1]], **{unit: held_by(data, unit) for unit in ("own", "other")}}
    with atomic_file(Path("docs/numbers/other-units.json")) as part:
        part.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    for unit in ("own", "other"):
        print(unit, {name: np.round(value, 3).tolist() for name, value in numbers[unit].items()})


if __name__ == "__main__":
    main()
