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
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.numpy import save
from torch import nn

from tapetum.detection.find import told_of
from tapetum.detection.measured import candidates_with_looks
from tapetum.detection.score import load_score
from tapetum.detection.third import FARTHEST, third_input
from tapetum.errors import InputError
from tapetum.files import atomic_file
from train_second import drawn, labelled
from varied_scenes import Varied, varied

OUT = Path(__file__).parents[1] / "src" / "tapetum" / "detection" / "third-pair.safetensors"
SCENES, EPOCHS, BATCH = 8000, 12, 2048
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=int, nargs="?", default=SCENES)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("build") / "third-stage", help="keeps examples")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.use_deterministic_algorithms(True)
    seeds = range(FIRST_SEED, FIRST_SEED + options.scenes)
    features, label = drawn(seeds, options.folder, ("features", "label"), lambda seed: examples(scene_of(seed)))
    print(f"{len(label)} candidates, {(label == 1).sum()} of them cameras", flush=True)
    mean, spread = features.mean(0), features.std(0) + np.float32(1e-3)
    scaled = np.clip((features - mean) / spread, -FARTHEST, FARTHEST)
    networks = [trained(scaled, label.astype(np.float32), seed) for seed in range(NETWORKS)]
    with atomic_file(OUT) as part:
        part.write_bytes(save(weights_of(networks, mean, spread)))


if __name__ == "__main__":
    main()
