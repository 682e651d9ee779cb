"""Measure how well a network recognises phones of which it was trained on other copies, by their number.

    .venv/bin/python scripts/measure_phones.py --work phones-work

Films copies of the phones of the Phones set at gazes drawn over the part of the field that returns light, and trains
ResNet-18 on the first 1, 2, 4, ... copies of eight phones, the paper page's three unknown ones left out, and on all
copies of all eleven with --whole, each with as many passes over frames. Each network is scored on other frames of the
copies that it was trained on ("same"), and on copies with other seeds ("other"): the share of frames in which the
likeliest phone is the true one, the area under the ROC curve of recognising the phones left out as unknown, and the
error of the gaze, with 90 % intervals by drawing whole copies anew; and for phones that are taken for each other how
near their frames come. Copies and models stay in the folder, so that the same command continues an interrupted run. The
numbers go to docs/numbers/phones-copies.json, or -o.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr

from tapetum.bench import draw_unit, load_scene, with_values
from tapetum.data.dataset import DEVICE, dataset_from_arrays
from tapetum.data.synth.plan import FIELDS, PHONES, SETS
from tapetum.experiments.copies import film_copy
from tapetum.experiments.workshop import UNSEEN
from tapetum.files import atomic_file
from tapetum.memory import keep_big_blocks
from tapetum.models import ResNet18, load_model, save_model
from tapetum.progress import bar
from tapetum.record import HandMotion
from tapetum.report.evaluation import novelty_auroc

# Seeds of the copies of the training sets, and of those that are only tested on.
TRAIN, TEST = 4_100_000, 4_300_000
CROP, BATCH = 400, 16
# Of so many frames of a copy in a training set, one is tested on.
EVERY = 5
# Phones that are taken for each other, the one that is confused first.
ALIKE = (("phone-01", "phone-02"), ("phone-02", "phone-01"))
# Most repetitions of a frame of a rare phone.
MOST = 6
# Side of the crops' middle in pixels, and counts of the brightest pixel, of frames that are compared with each other.
MIDDLE, BRIGHT = 100, 60
# Draws of copies that intervals are made of.
DRAWS = 1000
_RECIPE = SETS["phones"]
# Sideways motion of the hand in metres, as in the set.
_HAND = HandMotion(extent=_RECIPE.extent, sway=0.01)


def filmed(seeds: Sequence[int], frames: int, work: Path) -> xr.Dataset:
    """Return all phones' copies of these seeds; `recording` numbers them, the phones of one seed after one another."""
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
        copies += [(seed - seeds[0]) * len(PHONES) + PHONES.index(name)] * len(found[0])
    gaze = np.concatenate(gazes)
    split = np.concatenate([np.arange(len(one)) % EVERY == EVERY - 1 for one in gazes]).astype(np.int8)
    labels = {"gaze_x": gaze[:, 0], "gaze_y": gaze[:, 1], DEVICE: names}
    return dataset_from_arrays(np.concatenate(images), labels, split=split, recording=np.array(copies))


def trained(data: xr.Dataset, path: Path, size: int, passes: int, precision: str) -> Any:
    """Return the network of a training set, from its folder where it was trained before."""
    if not path.exists():
        epochs = max(1, round(passes / data.tp.train.sizes["frame"]))
        model = ResNet18("phone", crop=CROP, size=size, epochs=epochs, batch=BATCH, seed=1, precision=precision)
        kept = path.with_suffix(".part")
        model.fit(data.tp.train, progress=bar, checkpoint=kept, resume=kept.exists())
        save_model(model, path)
    return load_model(path)


def picked(data: xr.Dataset, keep: np.ndarray) -> xr.Dataset:
    """Return the frames of a mask."""
    return data.isel(frame=np.flatnonzero(keep))


def balanced(data: xr.Dataset) -> xr.Dataset:
    """Return a set whose training part shows its phones about equally often: frames of rare ones are repeated.

    A phone that returns light in few gazes is rare in training, and would be taken for its likest neighbour. Repeated
    frames follow each other, so that those kept aside for calibration are not fitted.
    """
    device, training = data[DEVICE].values, data["split"].values == 0
    counts = np.bincount(device[training], minlength=device.max() + 1)
    times = np.clip(np.rint(counts.max() / np.maximum(counts, 1)).astype(int), 1, MOST)
    return data.isel(frame=np.repeat(np.arange(len(device)), np.where(training, times[device], 1)))


def with_interval(score: Callable[[np.ndarray], float | None], copies: np.ndarray) -> list[float | None]:
    """Return a score of all frames, and the ends of its 90 % interval where copies are drawn anew."""
    rng, rows = np.random.default_rng(0), [np.flatnonzero(copies == one) for one in np.unique(copies)]
    drawn = [score(np.concatenate([rows[n] for n in rng.integers(0, len(rows), len(rows))])) for _ in range(DRAWS)]
    known = [one for one in drawn if one is not None]
    return [score(np.arange(len(copies))), *(np.quantile(known, [0.05, 0.95]).tolist() if known else (None, None))]


def alike(data: xr.Dataset, one: str, other: str) -> dict[str, Any]:
    """How far a phone's bright frames are from the nearest one of its other copies, and from that of another phone.

    Distances are those of the middles of crops above their background, each of them of power 1.
    """
    names = np.array(data[DEVICE].attrs["classes"])[data[DEVICE].values]
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name in (one, other):
        rows = np.flatnonzero(names == name)
        images = data["image"].isel(frame=rows).values.astype(np.float32)
        first = (images.shape[-1] - MIDDLE) // 2
        images = images[:, first : first + MIDDLE, first : first + MIDDLE]
        images = images - np.median(images[:, :10], axis=(1, 2), keepdims=True)
        bright = images.max(axis=(1, 2)) > BRIGHT
        flat = images[bright].reshape(int(bright.sum()), -1)
        found[name] = flat / np.linalg.norm(flat, axis=1, keepdims=True), data["recording"].values[rows][bright]

    def nearest(name: str) -> list[float]:
        (own, copies), (others, their) = found[one], found[name]
        apart = np.sqrt(np.maximum(2 - 2 * own @ others.T, 0))
        apart[copies[:, None] == their] = np.inf
        return np.quantile(apart.min(axis=1), [0.1, 0.5, 0.9]).tolist()

    return {"phone": one, "other": other, "nearest_of_own": nearest(one), "nearest_of_other": nearest(other)}


def told(model: Any, frames: xr.Dataset) -> dict[str, Any]:
    """The scores that the table shows."""
    said = model.predict(frames, anyway=True, unit="own", progress=bar)
    names = np.array(frames[DEVICE].attrs["classes"])[frames[DEVICE].values]
    copies, known = frames["recording"].values, np.isin(names, said.classes)
    likeliest = np.array(said.classes)[said.probability.argmax(axis=1)]
    right = likeliest == names
    truth = np.stack([frames["gaze_x"].values, frames["gaze_y"].values], axis=1)
    off, held = np.abs(said.value - truth), (said.lower <= truth) & (truth <= said.upper)
    wrong = Counter((str(a), str(b)) for a, b in zip(names[known & ~right], likeliest[known & ~right], strict=True))
    return {
        "frames": int(known.sum()),
        "copies": len(np.unique(copies[known])),
        "top_1": with_interval(lambda rows: float(right[known][rows].mean()), copies[known]),
        "auroc": with_interval(lambda rows: novelty_auroc(said.novelty[rows], ~known[rows]), copies),
        "auroc_by_phone": {
            str(one): novelty_auroc(said.novelty[rows], ~known[rows])
            for one in np.unique(names[~known])
            for rows in [known | (names == one)]
        },
        "none_of_these": {str(one): float((said.novelty[names == one] > 1).mean()) for one in np.unique(names)},
        "frames_by_phone": dict(Counter(names.tolist())),
        "refused": int((~said.applies).sum()),
        "gaze_mae": [with_interval(lambda rows, k=k: float(off[known][rows, k].mean()), copies[known]) for k in (0, 1)],
        "gaze_held": held[known].mean(axis=0).tolist(),
        "gaze_guess": np.abs(truth[known] - truth[known].mean(axis=0)).mean(axis=0).tolist(),
        "recall": {str(one): float(right[names == one].mean()) for one in said.classes},
        "confused": [[*pair, count] for pair, count in wrong.most_common(8)],
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
    parser.add_argument("--size", type=int, default=80, help="pixels that the network looks at, a side")
    parser.add_argument("--whole", action="store_true", help="train on all phones too")
    parser.add_argument("--balanced", action="store_true", help="repeat training frames of rare phones")
    parser.add_argument("-o", "--out", type=Path, default=Path("docs/numbers/phones-copies.json"))
    parser.add_argument("--passes", type=int, default=40_000, help="passes over frames of each training")
    parser.add_argument("--precision", default="float32", choices=["float32", "bf16"])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--test-from", type=int, default=TEST, help="first seed of the copies to test on")
    parser.add_argument("--films", action="store_true", help="only film")
    options = parser.parse_args()
    keep_big_blocks()
    torch.set_num_threads(options.threads)
    options.work.mkdir(parents=True, exist_ok=True)
    data = filmed(range(TRAIN, TRAIN + options.copies[-1]), options.frames, options.work)
    test = filmed(range(options.test_from, options.test_from + options.tested), options.frames, options.work)
    if options.films:
        return
    names = np.array(data[DEVICE].attrs["classes"])
    device, copy = names[data[DEVICE].values], data["recording"].values // len(PHONES)
    rows: list[dict[str, Any]] = []
    cases = [(count, UNSEEN) for count in options.copies] + [(options.copies[-1], ())] * options.whole
    for count, left in cases:
        own = copy < count
        train = picked(data, own & ~np.isin(device, left))
        path = options.work / f"model-{count}-without-{len(left)}-{options.size}-{options.passes}-{options.precision}"
        if options.balanced:
            train, path = balanced(train), path.with_name(f"{path.name}-balanced")
        model = trained(train, path, options.size, options.passes, options.precision)
        row = {"copies": count, "left_out": list(left), "training_frames": int(train.tp.train.sizes["frame"])}
        rows.append(row | {"same": told(model, picked(data, own).tp.test), "other": told(model, test)})
        print(json.dumps(rows[-1]), flush=True)
        with atomic_file(options.out) as part:
            named = ("frames", "tested", "size", "passes", "balanced", "precision")
            compared = [alike(data, *pair) for pair in ALIKE]
            given = {"seeds": [TRAIN, options.test_from], **{name: getattr(options, name) for name in named}}
            part.write_text(json.dumps({**given, "alike": compared, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
