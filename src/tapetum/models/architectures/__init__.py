"""Architectures of networks by name: to add one, write a `Network` in a file of its own and name it here."""

from tapetum.models.architectures.base import Network
from tapetum.models.architectures.convnext import ConvNeXtPico
from tapetum.models.architectures.resnet18 import ResNet18Network

__all__ = ["ARCHITECTURES", "Network", "ResNet18Network"]

ARCHITECTURES: dict[str, type[Network]] = {"resnet18": ResNet18Network, "convnext-pico": ConvNeXtPico}
