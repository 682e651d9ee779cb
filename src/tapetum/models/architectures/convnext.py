"""ConvNeXt (Liu et al., CVPR 2022) in the size that timm calls pico, for grey images, with timm's parameter names."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tapetum.models.architectures.base import Network

__all__ = ["ConvNeXtPico"]

_DEPTHS, _WIDTHS = (2, 2, 6, 2), (64, 128, 256, 512)
_EPSILON, _FIRST_SCALE = 1e-6, 1e-6


class _Norm(nn.LayerNorm):
    """Normalises the channels of each pixel of [N, C, H, W]."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=_EPSILON)

    def forward(self, input: Tensor) -> Tensor:
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class _Perceptron(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1, self.act, self.fc2 = nn.Conv2d(width, 4 * width, 1), nn.GELU(), nn.Conv2d(4 * width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(self.act(self.fc1(x)))


class _Block(nn.Module):
    """A 7 x 7 convolution of each channel alone, then two layers of each pixel alone, beside a shortcut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv_dw = nn.Conv2d(width, width, 7, padding=3, groups=width)
        self.norm, self.mlp = _Norm(width), _Perceptron(width)
        self.gamma = nn.Parameter(torch.full((width,), _FIRST_SCALE))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.gamma[:, None, None] * self.mlp(self.norm(self.conv_dw(x)))


class _Stage(nn.Module):
    def __init__(self, inputs: int, outputs: int, depth: int) -> None:
        super().__init__()
        self.downsample: nn.Module = nn.Identity()
        if inputs != outputs:
            self.downsample = nn.Sequential(_Norm(inputs), nn.Conv2d(inputs, outputs, 2, 2))
        self.blocks = nn.Sequential(*(_Block(outputs) for _ in range(depth)))

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, inputs, H, W] to [N, outputs, H/2, W/2], or to its own size where the widths are alike."""
        return self.blocks(self.downsample(x))


class _Head(nn.Module):
    def __init__(self, width: int, outputs: int) -> None:
        super().__init__()
        self.norm, self.fc = _Norm(width), nn.Linear(width, outputs)


class ConvNeXtPico(Network):
    """ConvNeXt with 9 million weights: see `Network`. Weights start as the paper's, normal about 0 with σ = 0.02."""

    title, width = "ConvNeXt-pico", _WIDTHS[-1]

    def __init__(self, outputs: int, channels: int = 1, *, seed: int = 0) -> None:
        super().__init__(outputs, channels)
        with torch.random.fork_rng(devices=[]):
            self.stem = nn.Sequential(nn.Conv2d(channels, _WIDTHS[0], 4, 4), _Norm(_WIDTHS[0]))
            before = (_WIDTHS[0], *_WIDTHS)
            stages = (_Stage(a, b, n) for a, b, n in zip(before, _WIDTHS, _DEPTHS, strict=False))
            self.stages = nn.Sequential(*stages)
            # timm keeps its last layer here.
            self._modules["head"] = _Head(self.width, outputs)
        # Whatever torch.set_default_dtype says, before weights are drawn.
        self.float()
        # On the meta device there are no values to draw, and torch would import its compiler for it: seconds.
        if self.head.weight.is_meta:
            return
        generator = torch.Generator().manual_seed(seed)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.trunc_normal_(module.weight, std=0.02, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    @property
    def _top(self) -> _Head:
        top = self._modules["head"]
        assert isinstance(top, _Head)
        return top

    @property
    def head(self) -> nn.Linear:
        return self._top.fc

    def features(self, x: Tensor) -> Tensor:
        return self._top.norm(self.stages(self.stem(x)).mean((2, 3), keepdim=True)).flatten(1)
