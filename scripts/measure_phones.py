"""Measure how well a network recognises phones of which it was trained on other copies, by their number.

    .venv/bin/python scripts/measure_phones.py --work phones-work

Films copies of the phones of the Phones set at gazes drawn over the part of the field that returns light, and trains
ResNet-18 on the first 1, 2, 4, ... copies of eight phones, the paper page's three unknown ones left out, and on all
copies of all eleven. Each network is scored on other frames of the copies that it was trained on ("same"), and on
copies with other seeds ("other"): the share of frames in which the likeliest phone is the true one, the area under the
ROC curve of recognising the phones left out as unknown, and the error of the gaze. Copies and models stay in the
folder, so that the same command continues an interrupted run. The numbers go to docs/numbers/phones-copies.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from tapetum.bench import draw_unit, load_scene, with_values
from tapetum.cli.memory import keep_big_blocks
from tapetum.data.dataset import DEVICE, dataset_from_arrays
from tapetum.data.synth.plan import FIELDS, PHONES, SETS
from tapetum.experiments.copies import film_copy
from tapetum.experiments.workshop import UNSEEN
from tapetum.files import atomic_file
from tapetum.models import ResNet18, load_model, save_model
from tapetum.progress import bar
from tapetum.record import HandMotion
from tapetum.report.evaluation import evaluate_model

# Seeds of the copies of the training sets, and of those that are only tested on.
TRAIN, TEST = 4_100_000, 4_200_000
CROP, SIZE, EPOCHS, BATCH = 400, 80, 20, 16
# Of so many frames of a copy in a training set, one is tested on.
EVERY = 5
_RECIPE = SETS["phones"]
# Sideways motion of the hand in metres, as in the set.
_HAND = HandMotion(extent=_RECIPE.extent, sway=0.01)


def filmed(seeds: Sequence[int], frames: int, work: Path) -> xr.Dataset:
    """Return all phones' copies of these seeds; `recording` numbers the copies of one phone."""
    scene, images, gazes, names, copies = load_scene("phones"), [], [], [], []
    jobs = [(seed, name) for seed in seeds for name in PHONES]
    for seed, name in bar(jobs, "filming phones", total=len(jobs)):
        # Copies of two phones are not to have the same tilt.
        own = seed + 1000 * PHONES.index(name)
        unit = draw_unit(with_values(scene, {FIELDS[DEVICE]: name}), None, own)
        found = film_copy(unit, own, frames, work / f"{name}-{own}-{frames}.npz", _RECIPE.rules, _HAND)
        images.append(found[0])
        gazes.append(found[1])
        names += [name] * len(found[0])
        copies += [seed] * len(found[0])
    gaze = np.concatenate(gazes)
    split = np.concatenate([np.arange(len(one)) % EVERY == EVERY - 1 for one in gazes]).astype(np.int8)
    labels = {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1], DEVICE: names}
    return dataset_from_arrays(np.concatenate(images), labels, split=split, recording=np.array(copies) - seeds[0])


def trained(data: xr.Dataset, path: Path) -> Any:
    """Return the network of a training set, from its folder where it was trained before."""
    if not path.exists():
        model = ResNet18("phone", crop=CROP, size=SIZE, epochs=EPOCHS, batch=BATCH, seed=1)
        model.fit(data.tp.train, progress=bar)
        save_model(model, path)
    return load_model(path)


def picked(data: xr.Dataset, keep: np.ndarray) -> xr.Dataset:
    """Return the frames of a mask."""
    return data.isel(frame=np.flatnonzero(keep))


def told(model: Any, test: xr.Dataset, train: xr.Dataset) -> dict[str, Any]:
    """The scores that the table shows."""
    found = evaluate_model(model, test, train, progress=bar)
    classes = found["classes"]
    return {
        "frames": found["frames"],
        "top_1": classes["top_1"],
        "auroc": classes["unknown"]["auroc"],
        "refused": found["refused"],
        "gaze_mae": [found["targets"][name]["mae"] for name in ("gaze_x", "gaze_y")],
        "gaze_held": [found["targets"][name]["coverage"] for name in ("gaze_x", "gaze_y")],
        "mean_mae": [found["targets"][name]["baseline_mae"] for name in ("gaze_x", "gaze_y")],
        "per_class": {one["name"]: one["recall"] for one in classes["per_class"]},
    }


def main() -> None:
    """Film, train, score, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("phones-work"))
    parser.add_argument(
        "--copies", type=int, nargs="+", default=[1, 2, 4, 8], help="copies in the training sets, rising"
    )
    parser.add_argument("--tested", type=int, default=4, help="copies to test on")
    parser.add_argument("--frames", type=int, default=160, help="gazes of a copy of a phone")
    parser.add_argument("--films", action="store_true", help="only film")
    options = parser.parse_args()
    keep_big_blocks()
    torch.set_num_threads(1)
    options.work.mkdir(parents=True, exist_ok=True)
    data = filmed(range(TRAIN, TRAIN + options.copies[-1]), options.frames, options.work)
    test = filmed(range(TEST, TEST + options.tested), options.frames, options.work)
    if options.films:
        return
    names = np.array(data[DEVICE].attrs["classes"])
    device, copy = names[data[DEVICE].values], data["recording"].values
    rows: list[dict[str, Any]] = []
    cases = [(count, UNSEEN) for count in options.copies] + [(options.copies[-1], ())]
    for count, left in cases:
        own = copy < count
        train = picked(data, own & ~np.isin(device, left))
        model = trained(train, options.work / f"model-{count}-without-{len(left)}")
        row = {"copies": count, "left_out": list(left), "training_frames": int(train.tp.train.sizes["frame"])}
        same = picked(data, own).tp.test
        rows.append(row | {"same": told(model, same, train), "other": told(model, test, train)})
        print(json.dumps(rows[-1]), flush=True)
        with atomic_file(Path("docs/numbers/phones-copies.json")) as part:
            part.write_text(json.dumps({"seeds": [TRAIN, TEST], "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
