"""ResNet-18 (He et al., CVPR 2016) for grey images, with torchvision's parameter names."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tapetum.models.architectures.base import Network

__all__ = ["ResNet18Network"]

# Channels of the four layers; tests of what any network does train narrower ones.
_WIDTHS = (64, 128, 256, 512)


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions beside a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(outputs)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(outputs, outputs, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(outputs)
        self.downsample: nn.Sequential | None = None
        if stride != 1 or inputs != outputs:
            self.downsample = nn.Sequential(nn.Conv2d(inputs, outputs, 1, stride, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, inputs, H, W] to [N, outputs, H/stride, W/stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        out = self.relu(self.bn1(self.conv1(x)))
        return self.relu(self.bn2(self.conv2(out)) + shortcut)


def _layer(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    return nn.Sequential(BasicBlock(inputs, outputs, stride), BasicBlock(outputs, outputs, 1))


class ResNet18Network(Network):
    """ResNet-18 with a linear head: see `Network`.

    Weights start from He's normal distribution by fan-out; the last normalisation of every block starts at 0, so that
    each block starts as its shortcut (Goyal et al., arXiv:1706.02677).
    """

    title, width = "ResNet-18", _WIDTHS[-1]

    def __init__(self, outputs: int, *, channels: int = 1, seed: int = 0) -> None:
        super().__init__(outputs, channels)
        first, second, third, last = _WIDTHS
        # torch draws initial weights when it creates layers, which must not advance the caller's generator.
        with torch.random.fork_rng(devices=[]):
            self.conv1 = nn.Conv2d(channels, first, 7, 2, 3, bias=False)
            self.bn1 = nn.BatchNorm2d(first)
            self.relu = nn.ReLU(inplace=True)
            self.maxpool = nn.MaxPool2d(3, 2, 1)
            self.layer1 = _layer(first, first, 1)
            self.layer2 = _layer(first, second, 2)
            self.layer3 = _layer(second, third, 2)
            self.layer4 = _layer(third, last, 2)
            self.avgpool = nn.AdaptiveAvgPool2d(1)
            self.fc = nn.Linear(last, outputs)
        # Whatever torch.set_default_dtype says, before weights are drawn.
        self.float()
        # On the meta device there are no values to draw, and torch would import its compiler for it: seconds.
        if not self.fc.weight.is_meta:
            self._initialise(seed)

    def _initialise(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, mode="fan_out", nonlinearity="relu", generator=generator)
            elif isinstance(module, BasicBlock):
                nn.init.zeros_(module.bn2.weight)
        nn.init.normal_(self.fc.weight, std=0.01, generator=generator)
        nn.init.zeros_(self.fc.bias)

    def features(self, x: Tensor) -> Tensor:
        x = self.maxpool(self.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return torch.flatten(self.avgpool(x), 1)

    @property
    def head(self) -> nn.Linear:
        return self.fc
