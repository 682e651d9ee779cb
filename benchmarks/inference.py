"""ResNet-18 at 128 px on the CPU: ONNX Runtime beside torch, preparation included."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from tapetum.models import ResNet18, ResNet18Network
from tapetum.models.fast import FastResNet18

from .measure import Contender, Effort, Figure, Row, in_turns

TITLE = "ResNet-18 at 128 × 128 pixels: estimates from crops of 384 × 384 counts"
PEERS = ("onnxruntime",)
_CROP, _SIZE = 384, 128


def run(effort: Effort) -> list[Row]:
    """`predict` of one frame, of 8 and of 32, by both in turns; and how far their values are apart."""
    rng = np.random.default_rng(0)
    images = rng.poisson(20 * rng.random((32, 1, 1)), (32, _CROP, _CROP)).clip(0, 255).astype(np.uint8)
    model = _model()
    fast = FastResNet18(model)
    apart = float(np.abs(fast.predict(images, anyway=True).value - model.predict(images, anyway=True).value).max())
    rows: list[Row] = []
    for count in (1, 8, 32):
        few, repeats = images[:count], effort.of(max(1, 16 // count), 1)
        timings = in_turns(
            {
                "fast": Contender(lambda few=few: fast.predict(few), work=count, repeats=repeats),
                "torch": Contender(lambda few=few: model.predict(few), work=count, repeats=repeats),
            },
            effort.rounds,
        )
        each = Figure.duration(timings.typical("fast"))
        rows.append(
            Row(
                "one frame" if count == 1 else f"{count} frames",
                Figure.rate(timings.typical("fast"), "frames"),
                "torch, ResNet18.predict",
                Figure.rate(timings.typical("torch"), "frames"),
                timings.speed_up("fast", "torch"),
                f"{each} a frame; values differ by {apart:.1g} of the field at most",
            )
        )
    return rows


def _model() -> ResNet18:
    """Random weights take as long as trained ones."""
    model = ResNet18("gaze", crop=_CROP, size=_SIZE, device="cpu")
    network = ResNet18Network(2)
    generator = torch.Generator().manual_seed(0)
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            # Else every block would add nothing to its shortcut.
            nn.init.uniform_(module.weight, 0.5, 1.5, generator=generator)
    scaling = {"unit": [0.1], "centre": [0.0, 0.0], "spread": [0.3, 0.3], "half_width": [0.1, 0.1]}
    state = {f"scaling.{name}": torch.tensor(values, dtype=torch.float64) for name, values in scaling.items()}
    return ResNet18.from_state(model.parameters(), state | network.state_dict())
