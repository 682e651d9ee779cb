"""What the training loop costs: ours beside a bare torch loop over the same network and the same batches."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tapetum.models import ResNet18Network
from tapetum.models.training import Augmentation, TrainingSettings, train

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "Training ResNet-18: the loop itself, grey images of 96 × 96 pixels, batches of 32"
PEERS = ("lightning-fabric",)
_BATCH, _SIZE = 32, 96


def run(effort: Effort) -> list[Row]:
    """Train for an epoch, without augmentation and with it, beside as many bare steps; on CUDA where there is one."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    steps = effort.of(200 if device == "cuda" else 12, 2)
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(steps * _BATCH, 1, _SIZE, _SIZE, generator=generator)
    targets = torch.randn(steps * _BATCH, 2, generator=generator)
    networks = {name: ResNet18Network(2) for name in ("plain", "varied", "bare")}

    def ours(name: str, augmentation: Augmentation) -> Contender:
        settings = TrainingSettings(epochs=1, batch=_BATCH, augmentation=augmentation)
        return Contender(lambda: train(networks[name], images, targets, settings, device=device), work=len(images))

    timings = in_turns(
        {
            "plain": ours("plain", Augmentation.none()),
            "varied": ours("varied", Augmentation()),
            "bare": Contender(lambda: _bare(networks["bare"], images, targets, device), work=len(images)),
        },
        effort.rounds,
    )
    cases = {"plain": "training, without augmentation", "varied": "training, with augmentation"}
    notes = {
        "plain": "both: channels last, fused AdamW; ours draws the order, sets rates, adds up losses, starts Fabric",
        "varied": "ours also shifts, scales and adds noise to every image, the peer does not",
    }
    return [
        Row(
            f"{cases[name]} ({device})",
            Figure.rate(timings.typical(name), "images"),
            "bare torch loop",
            Figure.rate(timings.typical("bare"), "images"),
            timings.speed_up(name, "bare"),
            notes[name],
        )
        for name in cases
    ]


def _bare(network: nn.Module, images: Tensor, targets: Tensor, device: str) -> None:
    network.to(device=device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    network.train()
    optimiser = torch.optim.AdamW(network.parameters(), lr=1e-3, fused=True)
    for batch, wanted in zip(images.split(_BATCH), targets.split(_BATCH), strict=True):
        optimiser.zero_grad()
        output = network(batch.to(device).contiguous(memory_format=torch.channels_last))
        F.smooth_l1_loss(output, wanted.to(device), beta=0.1).backward()
        optimiser.step()
    if device == "cuda":
        torch.cuda.synchronize()
