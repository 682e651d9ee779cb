"""ConvNeXt (Liu et al., CVPR 2022) in the size that timm calls pico, for grey images, with timm's parameter names."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from tapetum.models.architectures.base import Network
from tapetum.models.onnx_graph import Graph, array

__all__ = ["ConvNeXtPico"]

_DEPTHS, _WIDTHS = (2, 2, 6, 2), (64, 128, 256, 512)
_EPSILON, _FIRST_SCALE = 1e-6, 1e-6


class _Norm(nn.LayerNorm):
    """Normalises the channels of each pixel of [N, C, H, W]."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=_EPSILON)

    def forward(self, input: Tensor) -> Tensor:
        """Return the same shape."""
        return super().forward(input.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class _Perceptron(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.fc1, self.act, self.fc2 = nn.Conv2d(width, 4 * width, 1), nn.GELU(), nn.Conv2d(4 * width, width, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the same shape."""
        return self.fc2(self.act(self.fc1(x)))


class _Block(nn.Module):
    """A 7 x 7 convolution of each channel alone, then two layers of each pixel alone, beside a shortcut."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv_dw = nn.Conv2d(width, width, 7, padding=3, groups=width)
        self.norm, self.mlp = _Norm(width), _Perceptron(width)
        self.gamma = nn.Parameter(torch.full((width,), _FIRST_SCALE))

    def forward(self, x: Tensor) -> Tensor:
        """Return the same shape."""
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
        """The last layer."""
        return self._top.fc

    def features(self, x: Tensor) -> Tensor:
        """Map images [N, channels, H, W] to features [N, 512]."""
        return self._top.norm(self.stages(self.stem(x)).mean((2, 3), keepdim=True)).flatten(1)

    def to_onnx(self, graph: Graph, x: str, unit: float) -> str:
        """Add the network up to its last layer."""
        x = _norm_to_onnx(graph, "stem.1", graph.convolution("stem.0", x, self.stem[0], unit=unit), self.stem[1])
        for k, stage in enumerate(self.stages):
            assert isinstance(stage, _Stage)
            if isinstance(stage.downsample, nn.Sequential):
                norm, smaller = stage.downsample
                x = _norm_to_onnx(graph, f"stages.{k}.norm", x, norm)
                x = graph.convolution(f"stages.{k}.downsample", x, smaller)
            for n, block in enumerate(stage.blocks):
                assert isinstance(block, _Block)
                x = _block_to_onnx(graph, f"stages.{k}.{n}", x, block)
        pooled = graph.add("pooled", "GlobalAveragePool", x)
        return graph.add("features", "Flatten", _norm_to_onnx(graph, "head.norm", pooled, self._top.norm))


def _norm_to_onnx(graph: Graph, name: str, x: str, norm: nn.Module) -> str:
    assert isinstance(norm, _Norm)
    last = graph.add(f"{name}.in", "Transpose", x, perm=[0, 2, 3, 1])
    gain = graph.constant(f"{name}.gain", array(norm.weight))
    offset = graph.constant(f"{name}.offset", array(norm.bias))
    out = graph.add(f"{name}.norm", "LayerNormalization", last, gain, offset, axis=-1, epsilon=norm.eps)
    return graph.add(f"{name}.out", "Transpose", out, perm=[0, 3, 1, 2])


def _block_to_onnx(graph: Graph, name: str, x: str, block: _Block) -> str:
    out = _norm_to_onnx(graph, f"{name}.norm", graph.convolution(f"{name}.conv_dw", x, block.conv_dw), block.norm)
    wide = graph.convolution(f"{name}.fc1", out, block.mlp.fc1)
    # GELU is x (1 + erf(x/√2)) / 2: as one operator it came with a later opset.
    root, one, half = (graph.constant(f"{name}.{value:.2f}", value) for value in (0.5**0.5, 1.0, 0.5))
    bent = graph.add(f"{name}.erf", "Erf", graph.add(f"{name}.scaled", "Mul", wide, root))
    doubled = graph.add(f"{name}.doubled", "Mul", wide, graph.add(f"{name}.share", "Add", bent, one))
    narrow = graph.convolution(f"{name}.fc2", graph.add(f"{name}.gelu", "Mul", doubled, half), block.mlp.fc2)
    gamma = graph.constant(f"{name}.gamma", array(block.gamma)[:, None, None])
    return graph.add(f"{name}.sum", "Add", x, graph.add(f"{name}.scale", "Mul", narrow, gamma))
