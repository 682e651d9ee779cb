"""Trains the detector's second stage (src/tapetum/detection/second-{pair,frame}.safetensors) on drawn scenes.

    OMP_NUM_THREADS=1 python scripts/train_second.py [SCENES [FOLDER]]

Scenes are those of varied_scenes.py; no photograph is used. Equal seeds, versions and processors give equal weights.
Examples are kept in FOLDER, 250 scenes a file, so that an interrupted run goes on (build/second-stage).
A candidate is a camera only where the frame shows one: where an overexposed wall hides it, the candidate says nothing.
Strong light that only the lit frame shows and that is no camera, tape and reflections, counts little: it is drawn far
more often than it was met in real frames, and a network that sees it so often distrusts what is bright. Of one frame
alone, what is small, bright and round says nothing: nothing tells it from a camera.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.numpy import save
from torch import nn

from tapetum.detection.find import candidates_with_looks
from tapetum.detection.looks import OF_A_FRAME, OF_A_PAIR
from tapetum.detection.second import STRIDES, views
from tapetum.errors import InputError
from tapetum.files import atomic_file
from varied_scenes import Varied, varied

FOLDER = Path(__file__).parents[1] / "src" / "tapetum" / "detection"
SCENES, PART, EPOCHS, BATCH = 3000, 250, 9, 384
FIRST_SEED = 100_000
BEST, OTHERS = 16, 4
"""Of each scene: how many candidates that are no camera, of the likeliest and of the others."""
LIT_ONLY = 0.05
PLAIN = 6.0
"""How far over the noise a filter of its shape must answer a camera that is learned from."""
WIDE = (24, 32, 48, 64)
"""Channels of the convolutions and of the hidden layer."""
KERNELS = (5, 3, 3)
LIKELY = {"isolation": 1, "alone": 1, "elongation": -1, "outlier": 1, "clear": 0.5, "fresh": 0.5, "vanishes": 0.5}
"""What puts a candidate first here: not the fitted weights, which would change these examples when they change."""
KINDS = {True: ("pair", 3, OF_A_FRAME + OF_A_PAIR), False: ("frame", 2, OF_A_FRAME)}
FIELDS = ("near", "far", "looks", "label")
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Network(nn.Module):
    """What `tapetum.detection.second.Second` computes, to be trained."""

    def __init__(self, channels: int, looks: int) -> None:
        super().__init__()
        self.near, self.far = (self._view(channels) for _ in range(2))
        self.drop = nn.Dropout(0.2)
        self.hidden, self.out = nn.Linear(13 * WIDE[2] + looks, WIDE[3]), nn.Linear(WIDE[3], 1)

    def _view(self, channels: int) -> nn.Sequential:
        layers: list[nn.Module] = []
        for before, after, side, stride in zip((channels, *WIDE), WIDE, KERNELS, STRIDES, strict=False):
            layers += [nn.Conv2d(before, after, side, stride), nn.ReLU()]
        return nn.Sequential(*layers, nn.Flatten())

    def forward(self, near: torch.Tensor, far: torch.Tensor, looks: torch.Tensor) -> torch.Tensor:
        seen = [looks, self.drop(self.near(near)), self.drop(self.far(far))]
        return self.out(torch.relu(self.hidden(torch.cat(seen, 1))))[:, 0]


def examples(scene: Varied, pair: bool, rng: np.random.Generator) -> Arrays | None:
    """Views and looks of all cameras, of the likeliest candidates that are none and of some others, and which is what.

    What cannot be told from a camera, and what lies about one, is left out.
    """
    try:
        found = candidates_with_looks(scene.lit, scene.dark if pair else None)
    except InputError:
        return None
    if found.cut is None:
        return None
    places = np.stack([found.columns["x"], found.columns["y"]], 1)
    label = np.zeros(len(places), int)
    for place in scene.unresolved if pair else scene.alike:
        label[np.hypot(*(places - place).T) <= 6] = -1
    for place, diameter, seen in zip(scene.places, scene.diameter, scene.seen, strict=True):
        reach, apart = max(2.5, 0.4 * diameter), np.hypot(*(places - place).T)
        label[(apart <= 2 * reach) & (label == 0)] = -1
        near = np.flatnonzero(apart <= reach)
        if len(near):
            label[near] = -1
            if seen >= PLAIN:
                label[near[np.argmax(found.columns["snr"][near])]] = 1
    names = KINDS[pair][2]
    order = np.argsort(
        -sum(k * found.looks[:, names.index(one)] for one, k in LIKELY.items() if one in names), kind="stable"
    )
    wrong = order[label[order] == 0]
    others = rng.permutation(wrong[BEST:])[:OTHERS]
    kept = np.sort(np.concatenate([np.flatnonzero(label == 1), wrong[:BEST], others]))
    near, far = views(found.cut, found.rows[kept])
    return near.astype(np.float16), far.astype(np.float16), found.looks[kept].astype(np.float32), label[kept]


def trained(data: Arrays, pair: bool) -> tuple[Network, np.ndarray, np.ndarray]:
    """The network, and mean and standard deviation of the looks."""
    name, channels, names = KINDS[pair]
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    near, far, looks, label = data
    mean, spread = looks.mean(0), looks.std(0) + 1e-3
    weight = np.ones(len(label), np.float32)
    if pair:
        lit_only = (looks[:, names.index("vanishes")] > 0.6) & (looks[:, names.index("fresh")] > 1.2)
        weight[lit_only & (label == 0)] = LIT_ONLY
    looks = np.clip((looks - mean) / spread, -3, 3)
    network, steps = Network(channels, len(names)), max(1, len(label) // BATCH)
    optimiser = torch.optim.AdamW(network.parameters(), weight_decay=1e-3)
    rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, EPOCHS * steps)
    for epoch in range(EPOCHS):
        order, total = rng.permutation(len(label)), 0.0
        for batch in np.array_split(order, steps):
            sides = [torch.from_numpy(one[batch]).float().movedim(-1, 1) for one in (near, far)]
            flips = [axis for axis in (2, 3) if rng.random() < 0.5]
            sides = [one.flip(flips) for one in sides]
            if rng.random() < 0.5:
                sides = [one.transpose(2, 3) for one in sides]
            own = torch.from_numpy(looks[batch])
            # Looks that are missing now and then: the network must not lean on a single one.
            own = own * (torch.rand(len(own), 1) > 0.15) * (torch.rand_like(own) > 0.1)
            wanted = torch.from_numpy(label[batch]) * 0.99 + 0.002
            weights = torch.from_numpy(weight[batch])
            loss = nn.functional.binary_cross_entropy_with_logits(network(*sides, own), wanted.float(), weights)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            rate.step()
            total += loss.item()
        print(f"{name}, epoch {epoch + 1}: loss {total / steps:.4f}", flush=True)
    return network.eval(), mean, spread


def weights_of(network: Network, mean: np.ndarray, spread: np.ndarray) -> dict[str, np.ndarray]:
    """By the names of `Second`, with channels last, in half precision but for the scale of the looks."""
    state = {name: one.numpy() for name, one in network.state_dict().items()}
    found = {"hidden.bias": state["hidden.bias"], "out": state["out.weight"].T, "out.bias": state["out.bias"]}
    for view in ("near", "far"):
        for layer in range(len(STRIDES)):
            found[f"{view}.{layer + 1}"] = state[f"{view}.{2 * layer}.weight"].transpose(2, 3, 1, 0)
            found[f"{view}.{layer + 1}.bias"] = state[f"{view}.{2 * layer}.bias"]
    # Torch flattens channels first.
    last, looks = WIDE[2], len(mean)
    own, near, far = np.split(state["hidden.weight"].T, [looks, looks + 9 * last])
    sides = [one.reshape(last, -1, WIDE[3]).transpose(1, 0, 2).reshape(-1, WIDE[3]) for one in (near, far)]
    found["hidden"] = np.concatenate([own, *sides])
    half = {name: np.ascontiguousarray(one, dtype=np.float16) for name, one in found.items()}
    return half | {"mean": mean.astype(np.float32), "spread": spread.astype(np.float32)}


def drawn(count: int, folder: Path) -> dict[bool, Arrays]:
    """Examples of so many scenes, of pairs and of their lit frames alone; kept in a folder, a part a file."""
    folder.mkdir(parents=True, exist_ok=True)
    parts: dict[bool, list[Arrays]] = {True: [], False: []}
    start = time.monotonic()
    for first in range(FIRST_SEED, FIRST_SEED + count, PART):
        file = folder / f"{first}-{min(PART, FIRST_SEED + count - first)}.npz"
        if not file.exists():
            listed: dict[bool, list[Arrays]] = {True: [], False: []}
            for seed in range(first, min(first + PART, FIRST_SEED + count)):
                scene = varied(seed)
                for pair, found in listed.items():
                    if (one := examples(scene, pair, np.random.default_rng([5, seed]))) is not None:
                        found.append(one)
            joined = {KINDS[pair][0]: _joined(found) for pair, found in listed.items()}
            kept = {
                f"{name}-{field}": one for name, all_ in joined.items() for field, one in zip(FIELDS, all_, strict=True)
            }
            with atomic_file(file) as part, part.open("wb") as stream:
                np.savez(stream, **kept)
            print(f"{first + PART - FIRST_SEED} of {count} scenes, {time.monotonic() - start:.0f} s", flush=True)
        with np.load(file) as kept:
            for pair, (name, *_) in KINDS.items():
                near, far, looks, label = (kept[f"{name}-{field}"] for field in FIELDS)
                parts[pair].append((near, far, looks, label))
    return {pair: _joined(listed) for pair, listed in parts.items()}


def _joined(parts: list[Arrays]) -> Arrays:
    near, far, looks, label = (np.concatenate([one[n] for one in parts]) for n in range(len(FIELDS)))
    return near, far, looks, label


def main() -> None:
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.use_deterministic_algorithms(True)
    count = int(sys.argv[1]) if len(sys.argv) > 1 else SCENES
    folder = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("build") / "second-stage"
    for pair, data in drawn(count, folder).items():
        name = KINDS[pair][0]
        print(f"{name}: {len(data[3])} candidates, {(data[3] == 1).sum()} of them cameras", flush=True)
        with atomic_file(FOLDER / f"second-{name}.safetensors") as part:
            part.write_bytes(save(weights_of(*trained(data, pair))))


if __name__ == "__main__":
    main()
