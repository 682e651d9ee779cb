"""Trains the detector's third stage (src/tapetum/detection/third-pair.safetensors) on drawn scenes.

    OMP_NUM_THREADS=1 python scripts/train_third.py [SCENES [FOLDER]]

Scenes are those of varied_scenes.py; no photograph is used. They are others than the second stage learned from, which
would have more to say of its own. In every tenth there are 8 to 40 cameras, and every tenth is larger. The stored
networks are of 8,000 scenes, which take 25 minutes of one core to draw and search and 2 to learn. What each scene
gives is kept in FOLDER (build/third-stage), 250 scenes a file, so that an interrupted run goes on; the weights of the
features and the second stage are those that are stored, which decide what is seen here: train again after them.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.numpy import save
from torch import nn

from tapetum.detection.find import told_of
from tapetum.detection.measured import Candidates, candidates_with_looks
from tapetum.detection.score import load_score
from tapetum.detection.third import FARTHEST, third_input
from tapetum.errors import InputError
from tapetum.files import atomic_file
from train_second import PLAIN
from varied_scenes import Varied, varied

OUT = Path(__file__).parents[1] / "src" / "tapetum" / "detection" / "third-pair.safetensors"
SCENES, PART, EPOCHS, BATCH = 8000, 250, 12, 2048
FIRST_SEED = 400_000
EVERY, LARGER, CROWD = 10, (480, 640), (8, 41)
NETWORKS, WIDE = 5, 64


def scene_of(seed: int) -> Varied:
    """A drawn scene, now and then a larger one or one of many cameras."""
    if seed % EVERY == 0:
        return varied(seed, cameras=int(np.random.default_rng([9, seed]).integers(*CROWD)))
    return varied(seed, shape=LARGER) if seed % EVERY == 1 else varied(seed)


def examples(scene: Varied) -> tuple[np.ndarray, np.ndarray] | None:
    """The third stage's input for every candidate, [N, features], and which are cameras, 1, or are not, 0.

    What cannot be told from a camera, and what lies about one, is left out.
    """
    try:
        found, decoys = candidates_with_looks(scene.lit, scene.dark)
    except InputError:
        return None
    if decoys is None or not len(found.looks):
        return None
    label = labelled(found, scene)
    kept = label >= 0
    features = third_input(*told_of(found, decoys, load_score(pair=True)))
    return features[kept].astype(np.float32), label[kept].astype(np.int8)


def labelled(found: Candidates, scene: Varied) -> np.ndarray:
    """Of each candidate, [N]: 1 for a camera, 0 for none, -1 for what counts neither way."""
    places = np.stack([found.columns["x"], found.columns["y"]], 1)
    label = np.zeros(len(places), int)
    for place in scene.unresolved:
        label[np.hypot(*(places - place).T) <= 6] = -1
    for place, diameter, seen in zip(scene.places, scene.diameter, scene.seen, strict=True):
        reach, apart = max(2.5, 0.4 * diameter), np.hypot(*(places - place).T)
        label[(apart <= 2 * reach) & (label == 0)] = -1
        near = np.flatnonzero(apart <= reach)
        if len(near) and seen >= PLAIN:
            label[near[np.argmax(found.columns["snr"][near])]] = 1
    return label


def trained(features: np.ndarray, label: np.ndarray, seed: int) -> nn.Sequential:
    """One network, from a random start."""
    torch.manual_seed(seed)
    network = nn.Sequential(
        nn.Linear(features.shape[1], WIDE), nn.ReLU(), nn.Dropout(0.1), nn.Linear(WIDE, WIDE), nn.ReLU(),
        nn.Linear(WIDE, 1),
    )  # fmt: skip
    own, wanted = torch.from_numpy(features), torch.from_numpy(label * np.float32(0.998) + np.float32(0.001))
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-3)
    steps = len(label) // BATCH + 1
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, 5e-3, EPOCHS * steps)
    for epoch in range(EPOCHS):
        total = 0.0
        for batch in torch.randperm(len(label)).split(BATCH):
            loss = nn.functional.binary_cross_entropy_with_logits(network(own[batch])[:, 0], wanted[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            rate.step()
            total += loss.item()
        print(f"network {seed + 1}, epoch {epoch + 1}: loss {total / steps:.5f}", flush=True)
    return network.eval()


def weights_of(networks: list[nn.Sequential], mean: np.ndarray, spread: np.ndarray) -> dict[str, np.ndarray]:
    """By the names of `Third`, in half precision but for the scale of the input."""
    found = {}
    for name, at in (("1", 0), ("2", 3), ("3", 5)):
        layers = [one[at] for one in networks]
        found[name] = np.stack([one.weight.detach().numpy().T for one in layers])
        found[f"{name}.bias"] = np.stack([one.bias.detach().numpy()[None] for one in layers])
    # Safetensors writes the memory as it lies.
    half = {name: np.ascontiguousarray(one, dtype=np.float16) for name, one in found.items()}
    return half | {"mean": mean.astype(np.float32), "spread": spread.astype(np.float32)}


def drawn(count: int, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Examples of so many scenes; kept in a folder, a part a file."""
    folder.mkdir(parents=True, exist_ok=True)
    parts, start = [], time.monotonic()
    for first in range(FIRST_SEED, FIRST_SEED + count, PART):
        seeds = range(first, min(first + PART, FIRST_SEED + count))
        file = folder / f"{first}-{len(seeds)}.npz"
        if not file.exists():
            found = [one for one in (examples(scene_of(seed)) for seed in seeds) if one is not None]
            features, label = (np.concatenate([one[n] for one in found]) for n in (0, 1))
            with atomic_file(file) as part, part.open("wb") as stream:
                np.savez(stream, features=features, label=label)
            print(f"{seeds.stop - FIRST_SEED} of {count} scenes, {time.monotonic() - start:.0f} s", flush=True)
        with np.load(file) as kept:
            parts.append((kept["features"], kept["label"]))
    return np.concatenate([one[0] for one in parts]), np.concatenate([one[1] for one in parts])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=int, nargs="?", default=SCENES)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("build") / "third-stage", help="keeps examples")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.use_deterministic_algorithms(True)
    features, label = drawn(options.scenes, options.folder)
    print(f"{len(label)} candidates, {(label == 1).sum()} of them cameras", flush=True)
    mean, spread = features.mean(0), features.std(0) + np.float32(1e-3)
    scaled = np.clip((features - mean) / spread, -FARTHEST, FARTHEST)
    networks = [trained(scaled, label.astype(np.float32), seed) for seed in range(NETWORKS)]
    with atomic_file(OUT) as part:
        part.write_bytes(save(weights_of(networks, mean, spread)))


if __name__ == "__main__":
    main()
