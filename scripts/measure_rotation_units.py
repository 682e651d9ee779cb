"""Measure how the gaze of the Rotation camera carries over to other copies, by the number of copies in training.

    .venv/bin/python scripts/measure_rotation_units.py --work rotation-units-work

Films copies of the camera in the scene `rotation` at gazes drawn over its field, and trains ResNet-18 on 1, 4 and 16 of
them, with equal numbers of frames and of passes over frames. Each network is scored on other frames of the copies that
it was trained on ("same"), and on copies with other seeds ("other"). What no retro-reflection shows of a copy is where
its point of symmetry lies, an offset that all its gazes have in common: the errors are given with each copy's own mean
error taken off, too. Copies and models stay in the folder, so that the same command continues an interrupted run.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from tapetum.bench import draw_unit, load_scene
from tapetum.data import dataset_from_arrays
from tapetum.data.write import Rules
from tapetum.experiments.copies import film_copy
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import ResNet18, load_model, save_model
from tapetum.progress import bar
from tapetum.record import HandMotion

# Seeds of the copies of the training sets, and of those that are only tested on.
TRAIN, TEST = 4_300_000, 4_400_000
SIDE, CROP, SIZE, BATCH = 160, 144, 72, 32
TEST_FRAMES = 60
DRAWS = 1000

Array = NDArray[np.float64]


def filmed(seeds: range, frames: int, work: Path) -> xr.Dataset:
    """Return frames of copies; `recording` numbers the copies."""
    scene, found = load_scene("rotation"), []
    for seed in bar(seeds, "filming copies", total=len(seeds)):
        path = work / f"copy-{seed}-{frames}.npz"
        images, gazes = film_copy(draw_unit(scene, None, seed), seed, frames, path, Rules(side=SIDE), HandMotion())
        found.append((images, gazes))
    images, gazes = (np.concatenate([one[k] for one in found]) for k in (0, 1))
    number = np.repeat(np.arange(len(found)), [len(one[0]) for one in found])
    full = float(2**scene.probe.sensor.bits - 1)
    return dataset_from_arrays(
        images, {"gaze_x": gazes[:, 0], "gaze_y": gazes[:, 1]}, full_scale=full, recording=number
    )


def told(model: Any, frames: xr.Dataset) -> dict[str, Any]:
    """MAE [2] and its 90 % interval where whole copies are drawn anew, and the same without each copy's mean error."""
    truth = frames.tp.values(("gaze_x", "gaze_y"))
    error = model.predict(frames, anyway=True, unit="own", progress=bar).value - truth
    copies = np.asarray(frames["recording"].values)
    rows = [np.flatnonzero(copies == one) for one in np.unique(copies)]
    offset = np.array([error[own].mean(axis=0) for own in rows])
    apart = np.concatenate([error[own] - mean for own, mean in zip(rows, offset, strict=True)])
    rng = np.random.default_rng(0)
    draws = [np.concatenate([rows[n] for n in rng.integers(0, len(rows), len(rows))]) for _ in range(DRAWS)]
    spread = np.quantile([np.abs(error[one]).mean(axis=0) for one in draws], [0.05, 0.95], axis=0)
    return {
        "copies": len(rows),
        "frames": len(error),
        "mae": np.abs(error).mean(axis=0).tolist(),
        "mae_interval": spread.tolist() if len(rows) > 1 else None,
        "mae_without_offset": np.abs(apart).mean(axis=0).tolist(),
        "guess": np.abs(truth - truth.mean(axis=0)).mean(axis=0).tolist(),
    }


def main() -> None:
    """Film, train, score, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("rotation-units-work"))
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 4, 16], help="copies in the training sets")
    parser.add_argument("--frames", type=int, default=6400, help="frames of a training set, of all its copies together")
    parser.add_argument("--passes", type=int, default=100_000, help="passes over frames of each training")
    parser.add_argument("--tested", type=int, default=8, help="copies to test on")
    parser.add_argument("--films", action="store_true", help="only film")
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/numbers/rotation-units.json"))
    options = parser.parse_args()
    keep_big_blocks()
    options.work.mkdir(parents=True, exist_ok=True)
    other = filmed(range(TEST, TEST + options.tested), TEST_FRAMES, options.work)
    rows: list[dict[str, Any]] = []
    for count in options.copies:
        seeds, each = range(TRAIN, TRAIN + count), options.frames // count
        whole = filmed(seeds, each + TEST_FRAMES, options.work)
        # The last frames of each copy are tested on.
        copies = np.asarray(whole["recording"].values)
        late = np.concatenate([np.arange((copies == one).sum()) >= each for one in np.unique(copies)])
        train, same = (whole.isel(frame=np.flatnonzero(mask)) for mask in (~late, late))
        if options.films:
            continue
        path = options.work / f"model-{count}-{options.frames}-{options.passes}"
        if not path.exists():
            epochs = max(1, round(options.passes / train.sizes["frame"]))
            model = ResNet18("gaze", crop=CROP, size=SIZE, epochs=epochs, batch=BATCH, precision="bf16", device="cpu")
            kept = path.with_suffix(".part")
            save_model(model.fit(train, progress=bar, checkpoint=kept, resume=kept.exists(), on_epoch=print), path)
        model = load_model(path)
        rows.append({"copies": count, "training_frames": train.sizes["frame"]})
        rows[-1] |= {"same": told(model, same), "other": told(model, other)}
        print(json.dumps(rows[-1]), flush=True)
        about = {"seeds": [TRAIN, TEST], "frames": options.frames, "passes": options.passes, "rows": rows}
        with atomic_file(options.out) as part:
            part.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
