"""Trains the detector's second stage (src/tapetum/detection/second-pair.safetensors) on drawn scenes.

    OMP_NUM_THREADS=1 python scripts/train_second.py [SCENES [FOLDER]]

Scenes are those of varied_scenes.py; no photograph is used. Equal seeds, versions and processors give equal weights;
the stored ones are of 18,000 scenes, which take 35 minutes of one core to draw and search and 12 to learn. Examples are
kept in FOLDER (build/second-stage), 250 scenes a file, so that an interrupted run goes on. A candidate is a camera only
where the frame shows one: where an overexposed wall hides it, the candidate says nothing. Strong light that only the
lit frame shows and that is no camera, tape and reflections, counts little: it is drawn far more often than it was met
in real frames, and a network that sees it so often distrusts what is bright.

Three times as many channels, on 12,000 scenes, lowered the loss on further scenes by 3 % after 4 passes, at some
three times the time; that was not followed up.

A network for one frame alone was trained in the same way and left out: of real frames, with no weights fitted to them,
it found 0.17, 0.28 and 0.72 at 0.1, 1 and 10 false alarms a frame, where three features of equal weights found 0.27,
0.68 and 0.96. What is drawn here is sharper and brighter than what stands in real frames: the look "contrast" of a
tenth of what is no camera exceeds 1.8 here and 0.4 to 0.8 there, so that being bright and sharp means less here than
there. Weighing bright clutter down in the training did not help. Nor did one of 4,000 scenes that sees shapes alone,
added to the rules: of real frames it found more at 0.1 and fewer at 1, of drawn ones 1 to 3 % more.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from safetensors.numpy import save
from torch import nn

from tapetum.detection.features import OF_A_FRAME, OF_A_PAIR
from tapetum.detection.measured import Candidates, candidates_with_looks
from tapetum.detection.second import STRIDES, views
from tapetum.errors import InputError
from tapetum.files import atomic_file
from varied_scenes import Varied, varied

OUT = Path(__file__).parents[1] / "src" / "tapetum" / "detection" / "second-pair.safetensors"
SCENES, PART, EPOCHS, BATCH = 18000, 250, 14, 384
FIRST_SEED = 200_000
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
LOOKS, CHANNELS = OF_A_FRAME + OF_A_PAIR, 3
FIELDS = ("near", "far", "looks", "label")
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Network(nn.Module):
    """What `tapetum.detection.second.Second` computes, to be trained."""

    def __init__(self) -> None:
        super().__init__()
        self.near, self.far = (self._view() for _ in range(2))
        self.drop = nn.Dropout(0.2)
        self.hidden, self.out = nn.Linear(13 * WIDE[2] + len(LOOKS), WIDE[3]), nn.Linear(WIDE[3], 1)

    def _view(self) -> nn.Sequential:
        layers: list[nn.Module] = []
        for before, after, side, stride in zip((CHANNELS, *WIDE), WIDE, KERNELS, STRIDES, strict=False):
            layers += [nn.Conv2d(before, after, side, stride), nn.ReLU()]
        return nn.Sequential(*layers, nn.Flatten())

    def forward(self, near: torch.Tensor, far: torch.Tensor, looks: torch.Tensor) -> torch.Tensor:
        seen = [looks, self.drop(self.near(near)), self.drop(self.far(far))]
        return self.out(torch.relu(self.hidden(torch.cat(seen, 1))))[:, 0]


def examples(scene: Varied, rng: np.random.Generator) -> Arrays | None:
    """Views and looks of all cameras, of the likeliest candidates that are none and of some others, and which is what.

    What cannot be told from a camera, and what lies about one, is left out.
    """
    try:
        found, _ = candidates_with_looks(scene.lit, scene.dark)
    except InputError:
        return None
    if found.cut is None:
        return None
    label = labelled(found, scene)
    order = np.argsort(-sum(k * found.looks[:, LOOKS.index(one)] for one, k in LIKELY.items()), kind="stable")
    wrong = order[label[order] == 0]
    others = rng.permutation(wrong[BEST:])[:OTHERS]
    kept = np.sort(np.concatenate([np.flatnonzero(label == 1), wrong[:BEST], others]))
    near, far = views(found.cut, found.rows[kept])
    return near.astype(np.float16), far.astype(np.float16), found.looks[kept].astype(np.float32), label[kept]


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


def trained(data: Arrays) -> tuple[Network, np.ndarray, np.ndarray]:
    """The network, and mean and standard deviation of the looks."""
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    near, far, looks, label = data
    mean, spread = looks.mean(0), looks.std(0) + 1e-3
    weight = np.ones(len(label), np.float32)
    lit_only = (looks[:, LOOKS.index("vanishes")] > 0.6) & (looks[:, LOOKS.index("fresh")] > 1.2)
    weight[lit_only & (label == 0)] = LIT_ONLY
    looks = np.clip((looks - mean) / spread, -3, 3)
    network, steps = Network(), max(1, len(label) // BATCH)
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
            wanted = torch.from_numpy(label[batch]) * 0.996 + 0.001
            weights = torch.from_numpy(weight[batch])
            loss = nn.functional.binary_cross_entropy_with_logits(network(*sides, own), wanted.float(), weights)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            rate.step()
            total += loss.item()
        print(f"epoch {epoch + 1}: loss {total / steps:.4f}", flush=True)
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


def drawn(
    seeds: range, folder: Path, fields: tuple[str, ...], examples: Callable[[int], tuple[np.ndarray, ...] | None]
) -> tuple[np.ndarray, ...]:
    """Examples of the scenes of some seeds, an array a field; kept in a folder, a part a file."""
    folder.mkdir(parents=True, exist_ok=True)
    parts: list[tuple[np.ndarray, ...]] = []
    start = time.monotonic()
    for first in range(seeds.start, seeds.stop, PART):
        some = range(first, min(first + PART, seeds.stop))
        file = folder / f"{first}-{len(some)}.npz"
        if not file.exists():
            kept = _joined([one for one in map(examples, some) if one is not None])
            with atomic_file(file) as part, part.open("wb") as stream:
                np.savez(stream, **dict(zip(fields, kept, strict=True)))
            told = f"{some.stop - seeds.start} of {len(seeds)} scenes, {time.monotonic() - start:.0f} s"
            print(told, flush=True)
        with np.load(file) as kept:
            parts.append(tuple(kept[field] for field in fields))
    return _joined(parts)


def _joined(parts: list[tuple[np.ndarray, ...]]) -> tuple[np.ndarray, ...]:
    return tuple(np.concatenate(some) for some in zip(*parts, strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=int, nargs="?", default=SCENES)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("build") / "second-stage", help="keeps examples")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.use_deterministic_algorithms(True)
    seeds = range(FIRST_SEED, FIRST_SEED + options.scenes)
    near, far, looks, label = drawn(
        seeds, options.folder, FIELDS, lambda seed: examples(varied(seed), np.random.default_rng([5, seed]))
    )
    print(f"{len(label)} candidates, {(label == 1).sum()} of them cameras", flush=True)
    with atomic_file(OUT) as part:
        part.write_bytes(save(weights_of(*trained((near, far, looks, label)))))


if __name__ == "__main__":
    main()
