"""Interface of network architectures for training, saving and export."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor, nn

from tapetum.errors import InputError

__all__ = ["Network"]


class Network(nn.Module, ABC):
    """A network that maps images with `channels` to `outputs` numbers by a linear last layer.

    `title` is its name for people, `width` the number of features before the last layer. `seed` draws the initial
    weights without touching torch's global generator.
    """

    title: ClassVar[str]
    width: ClassVar[int]

    def __init__(self, outputs: int, channels: int = 1, *, seed: int = 0) -> None:
        if outputs < 1 or channels < 1:
            raise InputError(f"must be positive, are {outputs} and {channels}", where="outputs, channels")
        super().__init__()

    @property
    @abstractmethod
    def head(self) -> nn.Linear:
        """The last layer."""

    @abstractmethod
    def features(self, x: Tensor) -> Tensor:
        """Map images [N, channels, H, W] to the features [N, width] before the last layer."""

    def forward(self, x: Tensor) -> Tensor:
        """Map images [N, channels, H, W] to [N, outputs]."""
        return self.head(self.features(x))
