"""Network architectures by name; a new one is a `Network` in its own file, named here."""

from tapetum.models.architectures.base import Network
from tapetum.models.architectures.convnext import ConvNeXtPico
from tapetum.models.architectures.resnet18 import ResNet18Network

__all__ = ["ARCHITECTURES", "Network", "ResNet18Network"]

ARCHITECTURES: dict[str, type[Network]] = {"resnet18": ResNet18Network, "convnext-pico": ConvNeXtPico}
