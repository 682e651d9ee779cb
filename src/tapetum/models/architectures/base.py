"""What an architecture of networks is to those who train, save and export it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from torch import Tensor, nn

from tapetum.errors import InputError

__all__ = ["Network"]


class Network(nn.Module, ABC):
    """A network of images with a linear last layer.

    Parameters
    ----------
    outputs
        Numbers an image is mapped to.
    channels
        Channels of an image.
    seed
        Of the initial weights. torch's own generator is not touched.

    Attributes
    ----------
    title
        What people call it.
    width
        Features of an image that the last layer weighs.
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
        """Map images [N, channels, H, W] to the features [N, width] that the last layer weighs."""

    def forward(self, x: Tensor) -> Tensor:
        """Map images [N, channels, H, W] to [N, outputs]."""
        return self.head(self.features(x))
