"""Trains the detector's second stage (src/tapetum/detection/second-pair.safetensors) on drawn scenes.

    python scripts/train_second.py [SCENES]

Scenes are those of varied_scenes.py; no photograph is used. The weights that come along are of 3,834 scenes, the first
1,235 of them drawn before there were cameras in twos and twinkling leaves. Strong light that only the lit frame shows
and that is no camera, tape and reflections, counts a hundredth: it is drawn forty times as often as it was met in real
frames, and a network that sees it so often distrusts what is bright.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from safetensors.numpy import save
from torch import nn

from tapetum.detection.find import candidates_with_looks
from tapetum.detection.looks import OF_A_FRAME, OF_A_PAIR
from tapetum.detection.score import load_score
from tapetum.detection.second import views
from tapetum.errors import InputError
from tapetum.files import atomic_file
from varied_scenes import Varied, varied

OUT = Path(__file__).parents[1] / "src" / "tapetum" / "detection" / "second-pair.safetensors"
SCENES, EPOCHS, BATCH, BEST = 3834, 9, 384, 28
FIRST_SEED = 10_000
KEPT, LIT_ONLY = 0.4, 0.01
WIDE = (12, 24, 32)
_LOOKS = OF_A_FRAME + OF_A_PAIR
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class Network(nn.Module):
    """What `tapetum.detection.second.Second` computes, to be trained."""

    def __init__(self) -> None:
        super().__init__()
        first, second, hidden = WIDE
        self.near, self.far = (
            nn.Sequential(nn.Conv2d(2, first, 3, 2), nn.ReLU(), nn.Conv2d(first, second, 3, 2), nn.ReLU(), nn.Flatten())
            for _ in range(2)
        )
        self.drop = nn.Dropout(0.2)
        self.hidden, self.out = nn.Linear(32 * second + len(_LOOKS), hidden), nn.Linear(hidden, 1)

    def forward(self, near: torch.Tensor, far: torch.Tensor, looks: torch.Tensor) -> torch.Tensor:
        seen = [looks, self.drop(self.near(near)), self.drop(self.far(far))]
        return self.out(torch.relu(self.hidden(torch.cat(seen, 1))))[:, 0]


def examples(scene: Varied) -> Arrays | None:
    """Views and looks of the candidates that the rules put first and of all cameras, and which of them are cameras.

    What cannot be told from a camera, and what lies about one, is left out.
    """
    try:
        found = candidates_with_looks(scene.lit, scene.dark)
    except InputError:
        return None
    if found.cut is None:
        return None
    places = np.stack([found.columns["x"], found.columns["y"]], 1)
    label = np.zeros(len(places), int)
    for place in scene.unresolved:
        label[np.hypot(*(places - place).T) <= 6] = -1
    for place, diameter in zip(scene.places, scene.diameter, strict=True):
        reach, apart = max(2.5, 0.4 * diameter), np.hypot(*(places - place).T)
        label[(apart <= 2 * reach) & (label == 0)] = -1
        near = np.flatnonzero(apart <= reach)
        if len(near):
            label[near] = -1
            label[near[np.argmax(found.columns["snr"][near])]] = 1
    order = np.argsort(-load_score(pair=True).log_odds(found.looks))
    first = np.zeros(len(places), bool)
    first[order[:BEST]] = True
    kept = np.flatnonzero((first & (label == 0)) | (label == 1))
    near, far = views(found.cut, found.rows[kept])
    return near.astype(np.float16), far.astype(np.float16), found.looks[kept].astype(np.float32), label[kept]


def trained(data: Arrays) -> tuple[Network, np.ndarray, np.ndarray]:
    """The network, and mean and standard deviation of the looks."""
    rng = np.random.default_rng(0)
    torch.manual_seed(0)
    mean, spread = data[2].mean(0), data[2].std(0) + 1e-3
    chosen = (data[3] == 1) | (rng.random(len(data[3])) < KEPT)
    near, far, looks, label = (one[chosen] for one in data)
    lit_only = (looks[:, _LOOKS.index("vanishes")] > 0.6) & (looks[:, _LOOKS.index("fresh")] > 1.2)
    weight = np.where(label == 1, 1.0, np.where(lit_only, LIT_ONLY, 1.0) / KEPT).astype(np.float32)
    looks = np.clip((looks - mean) / spread, -3, 3)
    network, steps = Network(), len(label) // BATCH
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
        print(f"epoch {epoch + 1}: loss {total / steps:.4f}")
    return network.eval(), mean, spread


def weights_of(network: Network, mean: np.ndarray, spread: np.ndarray) -> dict[str, np.ndarray]:
    """By the names of `Second`, with channels last, in half precision but for the scale of the looks."""
    state = {name: one.numpy() for name, one in network.state_dict().items()}
    found = {"hidden.bias": state["hidden.bias"], "out": state["out.weight"].T, "out.bias": state["out.bias"]}
    for view in ("near", "far"):
        for layer, number in (("1", 0), ("2", 2)):
            found[f"{view}.{layer}"] = state[f"{view}.{number}.weight"].transpose(2, 3, 1, 0)
            found[f"{view}.{layer}.bias"] = state[f"{view}.{number}.bias"]
    own, *sides = np.split(state["hidden.weight"].T, [len(_LOOKS), len(_LOOKS) + 16 * WIDE[1]])
    last = [one.reshape(WIDE[1], 16, -1).transpose(1, 0, 2).reshape(16 * WIDE[1], -1) for one in sides]
    found["hidden"] = np.concatenate([own, *last])
    half = {name: np.ascontiguousarray(one, dtype=np.float16) for name, one in found.items()}
    return half | {"mean": mean.astype(np.float32), "spread": spread.astype(np.float32)}


def main() -> None:
    count = int(sys.argv[1]) if len(sys.argv) > 1 else SCENES
    found = [examples(varied(seed)) for seed in range(FIRST_SEED, FIRST_SEED + count)]
    data = tuple(np.concatenate(parts) for parts in zip(*(one for one in found if one is not None), strict=True))
    near, far, looks, label = data
    print(f"{len(label)} candidates of {count} scenes, {(label == 1).sum()} of them cameras")
    with atomic_file(OUT) as part:
        part.write_bytes(save(weights_of(*trained((near, far, looks, label)))))


if __name__ == "__main__":
    main()
