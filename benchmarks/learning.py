"""ResNet-18's training and inference, beside MONAI's ResNet-18 in a bare torch loop."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from tapetum.data import dataset_from_arrays
from tapetum.models import ResNet18
from tapetum.models.inputs import prepare

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "ResNet-18: grey images of 96 × 96 pixels, batches of 32"
PEERS = ("monai",)
_BATCH, _SIZE = 32, 96


def run(effort: Effort) -> list[Row]:
    """One epoch of a few steps by `fit` beside as many bare steps; `predict` from crops beside a bare forward."""
    steps, count = effort.of(12, 2), effort.of(256, 32)
    rng = np.random.default_rng(0)
    crops = rng.poisson(20 * rng.random((max(count, steps * _BATCH), 1, 1)), (max(count, steps * _BATCH), 288, 288))
    images = crops.clip(0, 255).astype(np.uint8)
    del crops
    gaze = rng.uniform(-0.5, 0.5, (len(images), 2))
    part = slice(0, steps * _BATCH)
    labels = {"gaze_x": gaze[part, 0], "gaze_y": gaze[part, 1]}
    dataset = dataset_from_arrays(images[part], labels)
    inputs = prepare(images, 288, _SIZE, 255.0)
    targets = torch.from_numpy(gaze.astype(np.float32))
    bare = _peer()

    def fit() -> ResNet18:
        # No frames are kept aside: every one is a training image, as in the bare loop.
        return ResNet18(size=_SIZE, batch=_BATCH, epochs=1, calibration_fraction=0.0, device="cpu").fit(dataset)

    model = fit()

    def forward() -> list[torch.Tensor]:
        bare.eval()
        with torch.inference_mode():
            return [bare(batch) for batch in inputs[:count].split(64)]

    training = in_turns(
        {
            "ours": Contender(fit, work=steps * _BATCH, warm_up=False),
            "peer": Contender(lambda: _train(bare, inputs[part], targets[part]), work=steps * _BATCH),
        },
        effort.rounds,
    )
    inference = in_turns(
        {
            "ours": Contender(lambda: model.predict(images[:count], full_scale=255), work=count),
            "peer": Contender(forward, work=count),
        },
        effort.rounds,
    )
    notes = {
        "training": "ours reads and reduces the crops, varies every image, and builds the network; the peer does not",
        "inference": "ours starts from crops of 288 × 288 counts, the peer from what the network sees",
    }
    return [
        Row(
            case,
            Figure.rate(timings.typical("ours"), "images"),
            "MONAI's ResNet-18, bare loop",
            Figure.rate(timings.typical("peer"), "images"),
            timings.speed_up("ours", "peer"),
            notes[case],
        )
        for case, timings in (("training", training), ("inference", inference))
    ]


def _peer() -> nn.Module:
    from monai.networks.nets.resnet import resnet18

    return resnet18(
        spatial_dims=2,
        n_input_channels=1,
        num_classes=2,
        conv1_t_size=7,
        conv1_t_stride=2,
        bias_downsample=False,
    )


def _train(network: nn.Module, images: torch.Tensor, targets: torch.Tensor) -> None:
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3)
    for batch, wanted in zip(images.split(_BATCH), targets.split(_BATCH), strict=True):
        optimiser.zero_grad()
        F.smooth_l1_loss(network(batch), wanted, beta=0.1).backward()
        optimiser.step()
